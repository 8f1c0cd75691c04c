"""Plans: the positions, rates and dwells of a session, read from YAML and checked whole."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path

import numpy as np

from ..common.arguments import checked
from ..common.config import Section
from ..common.errors import InputError
from ..common.keys import key, read_record, record, records
from ..common.rotations import rotation
from ..common.stream import Floats, Mode, Setpoint
from ..common.units import DEG, Dimension, counted, parse
from .imu import NEARLY, ImuSpec
from .table import TURN, Table

COMPASS = {
    'E': (1.0, 0.0, 0.0),
    'N': (0.0, 1.0, 0.0),
    'U': (0.0, 0.0, 1.0),
    'W': (-1.0, 0.0, 0.0),
    'S': (0.0, -1.0, 0.0),
    'D': (0.0, 0.0, -1.0),
}
METHOD_NAMES = (
    'free_positions',
    'joint',
    'joint_33',
    'n_positions',
    'off_axis_four',
    'rate_24',
    'six_position',
    'skewed',
    'static_six',
    'twelve_position',
)
"""The names of `methods.METHODS`, which imports plans: a test compares."""

BODY_AXES = {'X': np.array([1.0, 0, 0]), 'Y': np.array([0, 1.0, 0]), 'Z': np.array([0, 0, 1.0])}


BY_HAND = 'by hand'  #: Variant of the keys of a rate test.


def read_rates(section: Section, name: str) -> tuple[float, ...]:
    """Read rates, rad/s, none of them zero."""
    rates = tuple(
        parse(r, Dimension.RATE, section.key(name))
        for r in section.items(name, 'rates: [10 deg/s, -10 deg/s]')
    )
    if any(rate == 0 for rate in rates):
        raise InputError(f'{section.key(name)}: found a rate of 0, expected other rates only.')
    return rates


@dataclass(frozen=True, eq=False)
class RateTest:
    """Turns about the vertical at a position, before its dwell."""

    #: rad/s; empty when the turn is made by hand.
    rates: tuple[float, ...] = key(
        'signed rates about up, in order; not with `by_hand`', read_rates, value=()
    )
    turns: int = key(
        'whole turns at each rate; the table adds one for starting and stopping',
        Section.whole,
        1,
        default=1,
        variants=('key', BY_HAND),
    )


def read_rate_test(section: Section, name: str) -> RateTest:
    """Read the turns of a plan; those by hand have no rates."""
    by_hand = section.flag('by_hand', default=False)
    return record(section, name, RateTest, BY_HAND if by_hand else 'key')


@dataclass(frozen=True, eq=False)
class Position:
    """One attitude of the plan."""

    id: str  #: Name, unique within the plan.
    #: (3, 3) R_nb, columns are the body axes in east, north, up of the table's azimuth.
    attitude: Floats
    dwell: float  #: Duration of the dwell, s; 0 for turns alone.
    rate_test: RateTest | None = None  #: Turns made here before the dwell.

    @property
    def up(self) -> Floats:
        """Up in body axes, (3,)."""
        return np.asarray(self.attitude[2])

    def saturates(self, rate: float, imu: ImuSpec) -> bool:
        """Return whether turns here at a rate about up, rad/s, reach the end of a gyro's range."""
        return abs(rate) * float(np.abs(self.up).max()) >= NEARLY * imu.gyro.range


@dataclass(frozen=True, eq=False)
class Step:
    """One setpoint of the plan on a given table."""

    index: int  #: From 0.
    position: str  #: Id of the plan's position.
    mode: Mode  #: POSITION or RATE.
    angles: Floats  #: (k,) joint angles, rad.
    rates: Floats  #: (k,) joint rates, rad/s.
    turns: int  #: Whole turns of a RATE step.
    dwell: float  #: Duration of the dwell afterwards, s.

    def setpoint(self, plan: str, joints: tuple[str, ...], stamp: int = 0) -> Setpoint:
        """Return the setpoint of the step: of a plan and joints by their names, at a stamp, ns."""
        return Setpoint(
            stamp=stamp,
            plan=plan,
            step=self.index,
            position=self.position,
            mode=self.mode,
            joints=joints,
            angles=tuple(self.angles.tolist()),
            rates=tuple(self.rates.tolist()),
            turns=float(self.turns),
            dwell=float(self.dwell),
        )


@dataclass(frozen=True, eq=False)
class Plan:
    """A calibration session: positions in order, each with its dwell and its rate test."""

    name: str  #: Name of the plan.
    title: str  #: One line for a person.
    source: str  #: Document and section.
    method: str  #: Default method of the plan.
    positions: tuple[Position, ...]  #: In the order of the run.
    by_hand: bool = False  #: Turned by hand: the angle of a turn is known, its rate is not.

    def __repr__(self) -> str:
        return f'<Plan {self.name}: {counted(len(self.positions), "position")}>'

    @property
    def is_stated(self) -> bool:
        """Whether the plan is known: `UNPLANNED` has no positions."""
        return bool(self.positions)

    def position(self, name: str) -> Position:
        """Return a position by its id."""
        for position in self.positions:
            if position.id == name:
                return position
        raise KeyError(name)

    def text(self, name: str) -> str:
        """Return the text of the plan's file, under a name.

        Raises:
            InputError: An attitude is not that of axes along compass directions, turned about one.
        """
        head = {'name': name, 'title': self.title, 'source': self.source, 'method': self.method}
        dwells = {position.dwell for position in self.positions} - {0.0}
        usual = f'{max(dwells, default=1.0):.6g} s'
        lines = [f'{key}: {json.dumps(value)}' for key, value in head.items()]
        lines += [f'dwell: {usual}', *(['by_hand: true'] if self.by_hand else [])]
        tests = [position.rate_test for position in self.positions if position.rate_test]
        if tests:
            rates = ', '.join(f'{rate / DEG:.9g} deg/s' for rate in tests[0].rates)
            lines += ['rate_test:', *([f'  rates: [{rates}]'] if rates else [])]
            lines.append(f'  turns: {tests[0].turns}')
        lines.append('positions:')
        for position in self.positions:
            words = [f'id: {json.dumps(position.id)}', _attitude_text(position.attitude)]
            if (dwell := f'{position.dwell:.6g} s') != usual:
                words.append(f'dwell: {dwell}')
            if position.rate_test is not None:
                words.append('rate_test: true')
            lines.append(f'  - {{{", ".join(words)}}}')
        return '\n'.join([*lines, ''])

    def steps(self, table: Table, start: Floats | None = None) -> tuple[Step, ...]:
        """Return the setpoints of the plan on a table in order, checked, from (k,) angles, rad.

        A rate test ends where it began: the joint returns to the same azimuth, modulo a turn.
        """
        steps: list[Step] = []
        angles = np.zeros(len(table.joints)) if start is None else start
        still = np.zeros(len(table.joints))

        def add(position: Position, mode: Mode, rates: Floats, turns: int, dwell: float) -> None:
            step = Step(len(steps), position.id, mode, angles.copy(), rates, turns, dwell)
            where = f'plan {self.name}, position {position.id}'
            table.check(step.angles, step.rates, where)
            steps.append(step)

        for position in self.positions:
            try:
                angles = table.angles(position.attitude, angles)
            except InputError as error:
                raise InputError(f'plan {self.name}, position {position.id}: {error}') from None
            if position.rate_test is not None:
                joint = self._turning_joint(table, position, angles)
                sense = self._sense(table, joint, angles)
                add(position, Mode.POSITION, still, 0, 0.0)
                for rate in position.rate_test.rates:
                    self._check_run_up(table, joint, rate, position.id)
                    rates = still.copy()
                    rates[joint] = sense * rate
                    add(position, Mode.RATE, rates, position.rate_test.turns, 0.0)
                    travel = math.copysign(TURN * (position.rate_test.turns + 1), rates[joint])
                    angles[joint] += travel
                angles = table.angles(position.attitude, angles)
            add(position, Mode.POSITION, still, 0, position.dwell)
        return tuple(steps)

    def check_range(self, imu: ImuSpec) -> None:
        """Refuse turns that saturate the gyros."""
        for position in self.positions:
            for rate in position.rate_test.rates if position.rate_test else ():
                if position.saturates(rate, imu):
                    raise InputError(
                        f'plan {self.name}, position {position.id}: turns at {rate / DEG:g} deg/s '
                        f'saturate the gyros of IMU {imu.id}, whose range is '
                        f'{imu.gyro.range / DEG:g} deg/s. State lower rates in a plan of your own '
                        '(rate_test), or correct the range in the file of the IMU.'
                    )

    def _check_run_up(self, table: Table, joint: int, rate: float, position: str) -> None:
        """Refuse a rate that the table cannot reach and leave within the extra turn."""
        needed = rate**2 / table.joints[joint].max_acceleration
        if needed > TURN:
            raise InputError(
                f'plan {self.name}, position {position}: to start and stop at {rate / DEG:g} deg/s '
                f'takes joint {table.joints[joint].name} of table {table.name} '
                f'{needed / DEG:.0f} deg, and only one turn is there for it: state a lower rate.'
            )

    def _turning_joint(self, table: Table, position: Position, angles: Floats) -> int:
        joint = table.vertical_joint(angles)
        if joint is None:
            raise InputError(
                f'plan {self.name}, position {position.id}: the rate test needs a vertical axis, '
                f'table {table.name} has none in this attitude.'
            )
        if not table.joints[joint].continuous:
            raise InputError(
                f'plan {self.name}, position {position.id}: the rate test turns joint '
                f'{table.joints[joint].name}, which table {table.name} limits to '
                f'{table.joints[joint].lower / DEG:g} to {table.joints[joint].upper / DEG:g} deg.'
            )
        return joint

    def _sense(self, table: Table, joint: int, angles: Floats) -> float:
        up = table.attitude(angles).T @ np.array([0.0, 0.0, 1.0])
        return math.copysign(1.0, float(table.joint_axis(joint, angles) @ up))


def _attitude_text(attitude: Floats) -> str:
    """Return an attitude as the file of a plan states it, turned by the smallest angle."""
    found = []
    for letters in permutations(COMPASS, 3):
        left = np.array([COMPASS[letter] for letter in letters]) @ attitude
        for k, about in enumerate(BODY_AXES):
            by = math.atan2(left[k - 1, k - 2], left[k - 2, k - 2]) / DEG
            if np.allclose(left, rotation(BODY_AXES[about], by * DEG), atol=1e-9):
                turned = f', turned: {{about: {about}, by: {by:.9g} deg}}'
                found.append((round(abs(by), 6), by < 0, f'axes: [{", ".join(letters)}]', turned))
    if not found:
        raise InputError(
            f'Attitude {attitude.round(6).tolist()}: a file of a plan states axes along compass '
            'directions, turned about one of them.'
        )
    size, _, axes, turned = min(found)
    return axes + turned if size else axes


UNPLANNED = Plan('', 'whatever the table did', '', 'joint', ())
"""Plan of a session that followed none, or an unknown one: attitudes are known from the joint
states, and dwells and turns are named by them."""


_DAY = 86400.0  #: s.
_LONGEST = 30 * _DAY
"""s of all dwells: longer than any session; that of hours in place of seconds is beyond it."""


@checked
def load_plan(name: str | Path) -> Plan:
    """Read a plan's YAML file, shipped (by name) or the user's (by path)."""
    return read_plan(Section.named('plans', name))


def read_axes(section: Section, name: str) -> Floats:
    """Read the directions of the body axes, (3, 3): columns are X, Y, Z in east, north, up."""
    letters, where = section.items(name), section.key(name)
    if len(letters) != 3 or not all(isinstance(c, str) and c in COMPASS for c in letters):
        raise InputError(f'{where}: found {letters}, expected three of E, N, U, W, S, D.')
    attitude = np.array([COMPASS[letter] for letter in letters]).T
    if abs(np.linalg.det(attitude) - 1) > 1e-9:
        raise InputError(f'{where}: X, Y, Z along {letters} do not form a right-handed frame.')
    return attitude


@dataclass(frozen=True, eq=False)
class Turned:
    """A rotation about a body axis."""

    about: Floats = key('body axis', Section.choice, BODY_AXES)
    by: float = key('angle', Dimension.ANGLE)


@dataclass(frozen=True, eq=False)
class StatedPosition:
    """A position as a file states it."""

    id: str = key('name; no two alike', Section.text)
    axes: Floats = key(
        "where X, Y and Z point, in this order, when the table's zero points north; a "
        'right-handed frame',
        read_axes,
    )
    turned: Turned | None = key('a further turn about a body axis', record, Turned, default=None)
    dwell: float | None = key(
        'at this position; 0 only with turns',
        Dimension.TIME,
        least=0,
        otherwise='`dwell` of the plan',
    )
    rate_test: bool = key(
        'whether turns are made here, before the dwell', Section.flag, default=False
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class StatedPlan:
    """A plan as a file states it."""

    name: str = key('of the plan', Section.text)
    title: str = key('one line for a person', Section.text)
    source: str = key('document and section', Section.text)
    method: str = key(
        'the solver of the plan ([methods](../methods.md))',
        Section.choice,
        {name: name for name in METHOD_NAMES},
    )
    dwell: float = key(
        'time to stand still at a position; 30 days in all at most', Dimension.TIME, above=0
    )
    by_hand: bool = key(
        'turned by hand: the angle is known, the rate is not', Section.flag, default=False
    )
    rate_test: RateTest | None = key(
        'turns about the vertical',
        read_rate_test,
        otherwise='none; must be given if a position has one',
    )
    positions: tuple[StatedPosition, ...] = key('in the order of the run', records, StatedPosition)


def read_plan(section: Section) -> Plan:
    """Read a plan from its YAML mapping."""
    stated = read_record(section, StatedPlan)
    positions = tuple(
        _position(stated, *each)
        for each in zip(stated.positions, section.sections('positions'), strict=True)
    )
    names = [p.id for p in positions]
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise InputError(f'{section.key("positions")}: two positions have the id {twice[0]!r}.')
    standing = sum(position.dwell for position in positions)
    if standing > _LONGEST:
        raise InputError(
            f'{section.where}: its dwells last {standing / _DAY:.4g} days in all, expected at most '
            f'{_LONGEST / _DAY:g}: is their unit right?'
        )
    heading = stated.name, stated.title, stated.source, stated.method
    return Plan(*heading, positions, stated.by_hand)


def _position(plan: StatedPlan, stated: StatedPosition, section: Section) -> Position:
    dwell = plan.dwell if stated.dwell is None else stated.dwell
    if dwell == 0 and not stated.rate_test:
        raise InputError(
            f'{section.key("dwell")}: found {section.raw("dwell")}, expected above 0, as no turns '
            'are made here.'
        )
    if stated.rate_test and plan.rate_test is None:
        raise InputError(
            f'{section.key("rate_test")}: asks for turns, but the plan has no rate_test.'
        )
    attitude = stated.axes
    if stated.turned is not None:
        attitude = attitude @ rotation(stated.turned.about, stated.turned.by)
    return Position(stated.id, attitude, dwell, plan.rate_test if stated.rate_test else None)
