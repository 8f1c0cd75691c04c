"""Kinematics of a turntable: joint angles to attitude and back, and its limits."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from ..common.arguments import checked
from ..common.config import Section, numbers_of
from ..common.errors import InputError
from ..common.keys import field_keys, key, part, read_record, record, records
from ..common.rotations import angle_about, rotation
from ..common.stream import Floats, Mode, Setpoint
from ..common.units import ARCSEC, DEG, PPM, Dimension, counted
from .table_errors import (
    FINEST,
    LEVELLED,
    JointPoses,
    TableErrors,
    attitude_errors,
    error_key,
    read_deviation,
)

TURN = 2 * math.pi  #: rad.
_UP = np.array([0.0, 0.0, 1.0])  #: Up, in east, north, up.
_REACH_TOLERANCE = 1e-6  #: rad: rounding of rotation matrices in plans.
FARTHEST = 1e6 * TURN
"""rad: larger encoder angles are refused, of continuous joints too. Beyond, two neighbouring
doubles are further apart than 1e-9 rad, the rounding of `Table.check`."""
_PARALLEL = 1e-7
"""rad between two axes that count as one: the other joint's angle then has the rounding of
matrices, 1e-16, over this."""
_NO_AMPLITUDE = 1e-12  #: Of an equation a cos x + b sin x = c: below, x has no effect but rounding.
_WORST_CLOCK = 1e-3
"""Ten times the largest error of plain quartz: a larger number is in another unit."""
_LETTERS = {'x': (1.0, 0.0, 0.0), 'y': (0.0, 1.0, 0.0), 'z': (0.0, 0.0, 1.0)}


def read_axis(section: Section, name: str) -> tuple[float, float, float]:
    """Read the direction of an axis as a unit vector."""
    return _axis(section.raw(name), section.key(name))


def _axis(value: object, where: str) -> tuple[float, float, float]:
    if isinstance(value, str) and value.removeprefix('-') in _LETTERS:
        sign = -1.0 if value.startswith('-') else 1.0
        x, y, z = (sign * c if c else 0.0 for c in _LETTERS[value.removeprefix('-')])
        return x, y, z
    components = numbers_of(value)
    if components is not None and components.shape == (3,):
        norm = math.hypot(*components)
        if 0 < norm < math.inf:
            x, y, z = (float(c) / norm for c in components)
            return x, y, z
    raise InputError(f'{where}: found {value!r}, expected x, y, z, -x, -y, -z or three numbers.')


@dataclass(frozen=True)
class Turns:
    """Rotation of the body axes on the last joint, rad."""

    yaw: float = key('turn about z, in this order', Dimension.ANGLE, default='0 deg')
    pitch: float = key('turn about y, in this order', Dimension.ANGLE, default='0 deg')
    roll: float = key('turn about x, in this order', Dimension.ANGLE, default='0 deg')


def read_mount(section: Section, name: str) -> Floats:
    """Read the body axes on the last joint: three axes, or yaw, pitch and roll."""
    if not isinstance(section.raw(name), list):
        turns = record(section, name, Turns)
        mount = np.eye(3)
        for angle, letter in ((turns.yaw, 'z'), (turns.pitch, 'y'), (turns.roll, 'x')):
            mount = mount @ rotation(np.array(_LETTERS[letter]), angle)
        return mount
    axes = section.items(name)
    columns = [_axis(a, f'{section.key(name)}[{i}]') for i, a in enumerate(axes)]
    mount = np.array(columns).T
    if mount.shape != (3, 3) or not np.allclose(mount.T @ mount, np.eye(3), atol=1e-9):
        raise InputError(f'{section.key(name)}: found {axes}, expected three perpendicular axes.')
    if np.linalg.det(mount) < 0:
        raise InputError(f'{section.key(name)}: the three axes are left-handed.')
    return mount


@dataclass(frozen=True)
class Limits:
    """Range of the encoder angle of a joint, rad; infinite for a continuous one."""

    lower: float = key('lowest angle of the encoder', Dimension.ANGLE)
    upper: float = key('highest angle; above lower', Dimension.ANGLE)


def read_limits(section: Section, name: str) -> Limits:
    """Read the limits of a joint: continuous, or lower and upper."""
    if section.raw(name) == 'continuous':
        return Limits(-math.inf, math.inf)
    if not isinstance(section.raw(name), dict):
        raise InputError(
            f'{section.key(name)}: found {section.raw(name)!r}, expected continuous or '
            '{lower: -90 deg, upper: 90 deg}.'
        )
    limits = record(section, name, Limits)
    if limits.lower >= limits.upper:
        raise InputError(f'{section.key(name)}: lower is not below upper.')
    return limits


def read_azimuth(section: Section, name: str) -> float | None:
    """Read a heading, rad; None if it is unknown."""
    if section.raw(name) == 'unknown':
        return None
    return section.quantity(name, Dimension.ANGLE)


def read_clock_rate(section: Section, name: str) -> float:
    """Read the standard deviation of the rate of a table's clock, relative."""
    clock = section.quantity(name, Dimension.RATIO, least=0)
    if clock > _WORST_CLOCK:
        raise InputError(
            f'{section.key(name)}: found {clock / PPM:g} ppm, expected at most '
            f'{_WORST_CLOCK / PPM:g} ppm.'
        )
    return clock


@dataclass(frozen=True)
class Joint:
    """One axis of the table: angles in rad, rates in rad/s, accelerations in rad/s^2."""

    name: str = key('as in joint states and setpoints; no two alike', Section.text)
    #: Unit vector.
    axis: tuple[float, float, float] = key(
        'in the frame of the joint before it; of any length', read_axis
    )
    zero: float = key("added to the encoder's angle", Dimension.ANGLE, default='0 deg')
    limits: Limits = key(
        'range of rotation; rate tests need a continuous one', read_limits, default='continuous'
    )
    max_rate: float = key('largest commanded rate', Dimension.RATE, above=0, value=math.inf)
    max_acceleration: float = key(
        'of its starts and stops', Dimension.ANGULAR_ACCELERATION, above=0, value=math.inf
    )

    @property
    def lower(self) -> float:
        """Lowest encoder angle, rad; -inf for a continuous joint."""
        return self.limits.lower

    @property
    def upper(self) -> float:
        """Highest encoder angle, rad; inf for a continuous joint."""
        return self.limits.upper

    @property
    def continuous(self) -> bool:
        """Whether the joint turns without end."""
        return math.isinf(self.lower) and math.isinf(self.upper)


@dataclass(frozen=True, eq=False)
class Table:
    """A turntable: joints from the base outwards, and the mount of the unit on the last."""

    name: str = key('of the table, for messages', Section.text)
    joints: tuple[Joint, ...] = key('from the base outwards', records, Joint, most=3)
    #: (3, 3) columns are the body axes in the frame of the last joint.
    mount: Floats = key(
        'where the body axes X, Y, Z lie on the last joint: perpendicular and right-handed',
        read_mount,
        value=np.eye(3),
        otherwise='`[x, y, z]`',
    )
    #: About up, rad; None when unknown.
    azimuth: float | None = key(
        "heading of the table's zero, from north about up", read_azimuth, default='unknown'
    )
    #: rad, as the level.
    positioning: float = error_key('of a stopped joint, not shown by the encoder', '2 arcsec')
    level: float = error_key(
        'of the tilt of the table, about either horizontal axis',
        f'{LEVELLED / ARCSEC:g} arcsec',
        LEVELLED,
        above=0,
    )
    #: Unknown errors of its axes, zeros and encoders.
    errors: TableErrors = part(TableErrors)
    simulated: bool = key(
        'whether it is a simulated one: of others less than 1 arcsec counts as 1 arcsec',
        Section.flag,
        default=False,
    )
    #: Standard deviation, relative; 0 when not stated.
    clock: float = key(
        'of the rate of the clock that stamps the joint states', read_clock_rate, default='0 ppm'
    )
    assumed: tuple[str, ...] = ()  #: Keys missing in its file: usual values are assumed.
    clock_assumed: bool = False  #: Whether its file says nothing of its clock: it counts as exact.
    raised: tuple[str, ...] = ()  #: Keys with stated values below `FINEST`, which replaces them.
    #: The table as described in its file, if a session contradicts that (`as_the_best`); else None.
    described: Table | None = None

    def __repr__(self) -> str:
        return f'<Table {self.name}: {counted(len(self.joints), "joint")}>'

    @property
    def assumption(self) -> str:
        """Sentences on the assumptions about its errors; empty without."""
        figures = ', '.join(f'{key} {ASSUMED[key] / ARCSEC:g} arcsec' for key in self.assumed)
        sentences = []
        if self.assumed:
            sentences.append(
                f'Table {self.name} is assumed to be as good as a laboratory table where its file '
                f'says nothing: {figures} (standard deviations); state its own under these keys.'
            )
        if self.raised:
            sentences.append(
                f'Table {self.name} states less than {FINEST / ARCSEC:g} arcsec of '
                f'{", ".join(self.raised)}, which no known table reaches: '
                f'{FINEST / ARCSEC:g} arcsec is used.'
            )
        return ' '.join(sentences)

    @property
    def not_stated(self) -> tuple[str, ...]:
        """Keys of errors whose sizes differ from, or are missing in, its file."""
        return (*self.assumed, *self.raised)

    @property
    def understated_errors(self) -> tuple[str, ...]:
        """Keys of errors with stated values below `FINEST`."""
        return self._errors_below(FINEST)

    def _errors_below(self, least: float) -> tuple[str, ...]:
        sizes = {**self.error_sizes, 'level': math.inf}
        return tuple(key for key in self.error_keys if sizes[key] < least)

    @property
    def error_sizes(self) -> dict[str, float]:
        """Standard deviations of the errors that it has, by key, rad."""
        sizes = {'positioning': self.positioning, 'level': self.level, **vars(self.errors)}
        return {key: sizes[key] for key in self.error_keys}

    @property
    def error_keys(self) -> tuple[str, ...]:
        """Keys of the errors that a table of so many joints has."""
        between = set() if len(self.joints) > 1 else {'zeros', 'orthogonality'}
        return tuple(key for key in ASSUMED if key not in between)

    def with_errors(self, keys: Iterable[str], size: float) -> Table:
        """Return the table with one size of some errors, rad."""
        sizes = dict.fromkeys(keys, size)
        positioning = sizes.pop('positioning', self.positioning)
        return replace(self, positioning=positioning, errors=replace(self.errors, **sizes))

    def as_the_best(self) -> Table:
        """Return the table with stated values below `FINEST` raised to it."""
        understated = self.understated_errors
        raised = (*self.raised, *understated)
        return replace(self.with_errors(understated, FINEST), raised=raised, described=self)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Joint names in order."""
        return tuple(joint.name for joint in self.joints)

    def check_limited(self, needs: str) -> None:
        """Refuse joints without limits of rate and acceleration; `needs` says what needs them."""
        for joint in self.joints:
            if not (math.isfinite(joint.max_rate) and math.isfinite(joint.max_acceleration)):
                raise InputError(
                    f'Table {self.name}, joint {joint.name}: {needs} max_rate and max_acceleration.'
                )

    def attitude(self, angles: Floats) -> Floats:
        """Return R_nb: columns are the body axes in east, north, up of the table's own azimuth.

        An unknown azimuth counts as zero: north is then the direction of the table's zero.

        Args:
            angles: (..., k) encoder angles, rad.

        Returns:
            (..., 3, 3)
        """
        result = np.broadcast_to(rotation(_UP, self.azimuth or 0.0), (*angles.shape[:-1], 3, 3))
        for k, joint in enumerate(self.joints):
            result = result @ rotation(np.array(joint.axis), angles[..., k] + joint.zero)
        return np.asarray(result @ self.mount)

    def attitude_errors(self, angles: Floats) -> Floats:
        """Return the rotation of attitudes by the table's unknown errors.

        Args:
            angles: (n, k) encoder angles, rad.

        Returns:
            (n, 3, e) rotations about the body axes by one standard deviation of each error, rad.
        """
        poses: list[JointPoses] = []
        body = np.broadcast_to(self.mount, (len(angles), 3, 3))
        for k in reversed(range(len(self.joints))):
            joint, read = self.joints[k], angles[:, k]
            turned = rotation(np.array(joint.axis), read + joint.zero)
            poses.append(JointPoses(np.array(joint.axis), read, turned, body))
            body = turned @ body
        return attitude_errors(poses[::-1], self.errors)

    def joint_axis(self, index: int, angles: Floats) -> Floats:
        """Return the axis (..., 3) of a joint at (..., k) angles of all, rad, in the body frame."""
        axis = np.broadcast_to(np.array(self.joints[index].axis), (*angles.shape[:-1], 3))
        for k in range(index + 1, len(self.joints)):
            turned = rotation(np.array(self.joints[k].axis), angles[..., k] + self.joints[k].zero)
            axis = np.einsum('...ji,...j->...i', turned, axis)
        return np.asarray(axis @ self.mount)

    def vertical_joint(self, angles: Floats) -> int | None:
        """Return the first joint whose axis is vertical at these angles, None if none is."""
        up = self.attitude(angles).T @ _UP
        for k in range(len(self.joints)):
            if abs(self.joint_axis(k, angles) @ up) > 1 - 1e-9:
                return k
        return None

    def angles(self, attitude: Floats, near: Floats | None = None) -> Floats:
        """Return the encoder angles that bring the unit into an attitude.

        Of the solutions within the limits the one with the least travel from `near` is taken.

        Args:
            attitude: (3, 3) R_nb wanted.
            near: (k,) angles to come from, rad; zeros if not given.

        Returns:
            (k,) rad.

        Raises:
            InputError: The table cannot reach it; states the smallest difference.
        """
        start = np.zeros(len(self.joints)) if near is None else near
        base = rotation(_UP, self.azimuth or 0.0)
        target = base.T @ attitude @ self.mount.T
        axes = [np.array(joint.axis) for joint in self.joints]
        zeros = np.array([joint.zero for joint in self.joints])
        best: Floats | None = None
        closest = math.inf
        beyond: list[tuple[float, Joint, float]] = []
        for solution in _inverse(axes, target):
            reached = np.eye(3)
            for axis, angle in zip(axes, solution, strict=True):
                reached = reached @ rotation(axis, angle)
            miss = float(np.linalg.norm(reached - target)) / math.sqrt(2)
            closest = min(closest, miss)
            if miss > _REACH_TOLERANCE:
                continue
            beyond.append(self._farthest_beyond(solution - zeros))
            candidate = self._within_limits(solution - zeros, start)
            if candidate is not None and (
                best is None or _travel(candidate, start) < _travel(best, start) - 1e-9
            ):
                best = candidate
        if best is None:
            if closest > _REACH_TOLERANCE:
                joints = ', '.join(self.names)
                few = len(self.joints) < 3
                advice = ' Only three joints reach any attitude.' if few else ''
                raise InputError(
                    f'Table {self.name} (joints: {joints}) cannot reach the attitude: its '
                    f'closest is {closest / DEG:.3g} deg away.{advice}'
                )
            _, joint, angle = min(beyond, key=lambda each: each[0])
            raise InputError(
                f'The attitude lies outside the joint limits of table {self.name}: joint '
                f'{joint.name} would need {angle / DEG:.6g} deg; its limits are '
                f'{joint.lower / DEG:g} to {joint.upper / DEG:g} deg.'
            )
        return best

    def _within_limits(self, angles: Floats, near: Floats) -> Floats | None:
        """Shift angles by whole turns: near the present angles, and within the limits."""
        result = np.empty_like(angles)
        for k, joint in enumerate(self.joints):
            angle = angles[k] + TURN * round((near[k] - angles[k]) / TURN)
            options = [angle, angle - TURN, angle + TURN, angles[k] % TURN, angles[k] % TURN - TURN]
            inside = [a for a in options if joint.lower - 1e-9 <= a <= joint.upper + 1e-9]
            if not inside:
                return None
            result[k] = _nearest(inside, float(near[k]))
        return result

    def _farthest_beyond(self, angles: Floats) -> tuple[float, Joint, float]:
        """Return the angle farthest beyond the limits of its joint: by how much, joint, angle."""
        nearest = []
        for joint, angle in zip(self.joints, angles.tolist(), strict=True):
            options = [
                (max(joint.lower - turned, turned - joint.upper), joint, turned)
                for turned in (angle, angle - TURN, angle + TURN)
            ]
            nearest.append(min(options, key=lambda each: each[0]))
        return max(nearest, key=lambda each: each[0])

    def demanded(self, setpoint: Setpoint, angles: Floats) -> tuple[Floats, Floats]:
        """Return the (k,) angles, rad, and rates, rad/s, that a setpoint demands.

        Args:
            setpoint: POSITION, whose rates are 0, or RATE.
            angles: (k,) of the joints, rad: those it does not name stay.

        Raises:
            InputError: Its lists differ in length, it names a joint that is not there or one twice,
                or it turns another number than one by other than whole turns.
        """
        goal, rates = angles.copy(), np.zeros(len(angles))
        names, count = list(self.names), len(setpoint.joints)
        turns = setpoint.mode is Mode.RATE
        if len(setpoint.angles) != count or len(setpoint.rates) not in {count, count * turns}:
            raise InputError(
                f'{setpoint.where}: found {len(setpoint.angles)} angles and {len(setpoint.rates)} '
                f'rates, expected those of its {count} joints.'
            )
        if len(set(setpoint.joints)) != count:
            raise InputError(f'{setpoint.where}: it names a joint twice.')
        for k, name in enumerate(setpoint.joints):
            if name not in names:
                raise InputError(
                    f'{setpoint.where}: found joint {name!r}, expected {", ".join(names)}.'
                )
            goal[names.index(name)] = setpoint.angles[k]
            if turns:
                rates[names.index(name)] = setpoint.rates[k]
        turning = int(np.count_nonzero(rates))
        whole = setpoint.turns >= 1 and float(setpoint.turns).is_integer()
        if turns and not (whole and turning == 1):
            raise InputError(
                f'{setpoint.where}: found {setpoint.turns:g} turns of {counted(turning, "joint")}, '
                'expected whole turns of one joint.'
            )
        return goal, rates

    def check(self, angles: Floats, rates: Floats, where: str) -> None:
        """Refuse angles (k,), rad, or rates, rad/s, beyond the limits; `where` names a position."""
        for joint, angle, rate in zip(self.joints, angles, rates, strict=True):
            lower, upper = max(joint.lower, -FARTHEST), min(joint.upper, FARTHEST)
            if not (lower - 1e-9 <= angle <= upper + 1e-9):
                raise InputError(
                    f'{where}: joint {joint.name} at {angle / DEG:g} deg, table {self.name} '
                    f'allows {lower / DEG:g} to {upper / DEG:g} deg.'
                )
            if not abs(rate) <= joint.max_rate * (1 + 1e-9):
                raise InputError(
                    f'{where}: joint {joint.name} at {rate / DEG:g} deg/s, table {self.name} '
                    f'allows {joint.max_rate / DEG:g} deg/s.'
                )


def _nearest(options: list[float], near: float) -> float:
    """Return the option with the least travel; at equal travel the one that unwinds the cable."""
    return min(options, key=lambda a: (round(abs(a - near), 9), round(abs(a), 9), -a))


def _travel(angles: Floats, near: Floats) -> float:
    return float(np.abs(angles - near).sum())


def _inverse(axes: list[Floats], target: Floats) -> list[Floats]:
    """List joint angles that may reach a rotation; the caller checks them.

    Three joints: the middle angle follows from the angle between the outer axes, a1.(R2 a3) =
    a1.(G a3), with two solutions; then each neighbour from the remaining rotation.
    """
    if len(axes) == 1:
        return [np.array([angle_about(axes[0], target)])]
    if len(axes) == 2:
        first = _angle_between(axes[0], axes[1], target @ axes[1])
        rest = rotation(axes[0], first).T @ target
        return [np.array([first, angle_about(axes[1], rest)])]
    first_axis, middle, last = axes
    cosine = first_axis @ last - (first_axis @ middle) * (middle @ last)
    sine = first_axis @ np.cross(middle, last)
    wanted = first_axis @ target @ last - (first_axis @ middle) * (middle @ last)
    amplitude = math.hypot(cosine, sine)
    phase = math.atan2(sine, cosine)
    spread = (
        math.acos(float(np.clip(wanted / amplitude, -1, 1))) if amplitude > _NO_AMPLITUDE else 0.0
    )
    solutions = []
    for second in (phase + spread, phase - spread):
        turned = rotation(middle, second) @ last
        if np.linalg.norm(np.cross(first_axis, turned)) < _PARALLEL:
            # Outer and inner axis coincide: the inner stays at zero, the outer makes the rotation.
            first = angle_about(first_axis, target @ rotation(middle, second).T)
            solutions.append(np.array([first, second, 0.0]))
            continue
        first = _angle_between(first_axis, turned, target @ last)
        rest = (rotation(first_axis, first) @ rotation(middle, second)).T @ target
        solutions.append(np.array([first, second, angle_about(last, rest)]))
    return solutions


def _angle_between(axis: Floats, start: Floats, end: Floats) -> float:
    """Return the angle about an axis from one vector to another."""
    along_start, along_end = start - axis * (axis @ start), end - axis * (axis @ end)
    return math.atan2(
        float(axis @ np.cross(along_start, along_end)), float(along_start @ along_end)
    )


ASSUMED = {
    name: declared.usual
    for kind in (Table, TableErrors)
    for name, declared in field_keys(kind).items()
    if declared.read is read_deviation
}
"""Standard deviations assumed where a table's file states none, by key, rad: its defaults."""
_ROUNDING = 1e-9  #: Relative tolerance for a number read with its unit.


@checked
def load_table(name: str | Path) -> Table:
    """Read a table's YAML file, shipped (by name) or the user's (by path)."""
    return read_table(Section.named('tables', name))


def read_table(section: Section) -> Table:
    """Read a table from its YAML mapping."""
    table = read_record(section, Table)
    if len(set(table.names)) != len(table.joints):
        raise InputError(f'{section.key("joints")}: two joints have the same name.')
    left_out = [key for key in ASSUMED if not section.has(key)]
    table = table.with_errors((key for key in left_out if key not in table.error_keys), 0.0)
    raised = () if table.simulated else table._errors_below(FINEST * (1 - _ROUNDING))
    assumed = tuple(key for key in table.error_keys if key in left_out)
    clock_assumed = not (table.simulated or section.has('clock'))
    table = table.with_errors(raised, FINEST)
    return replace(table, assumed=assumed, raised=raised, clock_assumed=clock_assumed)


# Motion of a table at its limits: travel times, and courses of piecewise constant acceleration.

_SAME_INSTANT = 1e-9  #: s: one nanosecond, the resolution of stamps.


def travel_time(distance: float, rate: float, acceleration: float) -> float:
    """Return the duration, s, of the fastest motion over a distance, rad, from rest to rest."""
    way = abs(distance)
    peak = min(rate, math.sqrt(way * acceleration))
    return way / peak + peak / acceleration if peak else 0.0


def distance_from_rest(time: float, rate: float, acceleration: float) -> float:
    """Return the distance from rest in a time (s) within two limits, rad."""
    ramp = min(time, rate / acceleration)
    return acceleration * ramp**2 / 2 + rate * (time - ramp)


@dataclass(frozen=True, eq=False)
class Course:
    """Joint angles over time with constant acceleration between the knots, at rest at the end.

    The cubic between two neighbouring knots, as in joint_trajectory_controller, is exactly this
    motion.
    """

    time: Floats  #: (m,) s from the start, increasing from 0.
    angles: Floats  #: (m, k) rad.
    rates: Floats  #: (m, k) rad/s.

    @property
    def end(self) -> float:
        """Time of rest, s."""
        return float(self.time[-1])

    def at(self, times: Floats) -> tuple[Floats, Floats]:
        """Return angles (n, k) and rates (n, k) at (n,) times, s."""
        inside = np.clip(times, 0.0, self.end)
        piece = np.clip(np.searchsorted(self.time, inside, side='right') - 1, 0, len(self.time) - 1)
        following = np.minimum(piece + 1, len(self.time) - 1)
        span = (self.time[following] - self.time[piece])[:, None]
        elapsed = (inside - self.time[piece])[:, None]
        share = np.divide(elapsed, span, out=np.zeros_like(elapsed), where=span > 0)
        rates = self.rates[piece] + share * (self.rates[following] - self.rates[piece])
        return self.angles[piece] + (self.rates[piece] + rates) / 2 * elapsed, rates

    def until(self, time: float, accelerations: Sequence[float]) -> Course:
        """Return this course up to a time, then the stop at (k,) accelerations."""
        if time >= self.end:
            return self
        angles, rates = (x[0] for x in self.at(np.array([time])))
        stop = stopping(angles, rates, accelerations)
        kept = self.time < time - _SAME_INSTANT
        return Course(
            np.concatenate([self.time[kept], time + stop.time]),
            np.concatenate([self.angles[kept], stop.angles]),
            np.concatenate([self.rates[kept], stop.rates]),
        )


def moving(
    origin: Sequence[float],
    goal: Sequence[float],
    rates: Sequence[float],
    accelerations: Sequence[float],
) -> Course:
    """Return the course between (k,) angles, rad, from rest to rest, each joint by itself."""
    courses = []
    for start, end, rate, acceleration in zip(origin, goal, rates, accelerations, strict=True):
        way, sign = abs(end - start), math.copysign(1.0, end - start)
        peak = min(rate, math.sqrt(way * acceleration))
        ramp, run_up = peak / acceleration, peak**2 / acceleration / 2
        cruise = way / peak - ramp if peak else 0.0
        time = [0.0, ramp, ramp + max(cruise, 0.0), 2 * ramp + max(cruise, 0.0)]
        angle = [start, start + sign * run_up, end - sign * run_up, end]
        courses.append((time, angle, [0.0, sign * peak, sign * peak, 0.0]))
    return _together(courses)


def stopping(angles: Floats, rates: Floats, accelerations: Sequence[float]) -> Course:
    """Return the stop from (k,) angles and rates, each joint with its own acceleration."""
    courses = []
    for angle, rate, acceleration in zip(angles, rates, accelerations, strict=True):
        time = abs(float(rate)) / acceleration
        end = float(angle) + float(rate) * time / 2
        courses.append(([0.0, time], [float(angle), end], [float(rate), 0.0]))
    return _together(courses)


def _together(courses: Sequence[tuple[list[float], list[float], list[float]]]) -> Course:
    """Combine the joints: with a knot at each knot of any of them."""
    knots = np.unique(np.concatenate([time for time, _, _ in courses]))
    knots = knots[np.concatenate([[True], np.diff(knots) > _SAME_INSTANT])]
    states = []
    for time, angle, rate in courses:
        # A piece of zero length would hide the next one.
        keep = [0, *(i for i in range(1, len(time)) if time[i] - time[i - 1] > _SAME_INSTANT)]
        column = Course(
            np.array(time)[keep], np.array(angle)[keep, None], np.array(rate)[keep, None]
        )
        states.append(column.at(knots))
    return Course(knots, np.hstack([s[0] for s in states]), np.hstack([s[1] for s in states]))
