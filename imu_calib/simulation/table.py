"""A simulated turntable: setpoints in, true joint angles and encoder readings out."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from operator import attrgetter

import numpy as np

from ..common.errors import InputError
from ..common.rotations import rotation
from ..common.stream import Floats, Mode, Setpoint
from ..common.units import DEG
from ..session.table import TURN, Joint, Table
from .motion import Link, Motion, Track, braking, side_by_side, trapezoid
from .options import TableOptions
from .true_table import TableSizes, TrueTable

_STANDS = 1e-7
"""rad: closer goals need no move: the rounding of a table's inverse kinematics."""

_CONTENT = attrgetter(*(f.name for f in fields(Setpoint) if f.name != 'stamp'))
"""The fields that a repeated setpoint shares with the one before."""


@dataclass(frozen=True, eq=False)
class TableState:
    """Present state of the table."""

    time: float  #: s since the table's epoch.
    angles: Floats  #: (k,) encoder readings, rad.
    rates: Floats  #: (k,) rad/s.
    at_rest: bool  #: Whether every joint is at rest.
    step: int | None  #: Index of the plan's step accepted last, None before the first.
    stopped: str  #: Why it stopped before its goal; empty while it follows setpoints.


@dataclass(frozen=True, eq=False)
class _Order:
    """Goal of the joints: commanded, by the encoder, true; and rates.

    `turns` is whether a joint turns whole turns.
    """

    goal: Floats
    encoder: Floats
    true: Floats
    cruise: Floats
    turns: bool = False


class SimulatedTable:
    """A turntable that follows setpoints with trapezoidal profiles.

    Time only increases. A setpoint is in force from `command` on; repeating it keeps the table
    moving, a new one makes it brake and go to the new goal, HOLD brakes. Reading at a future time
    commits the table to its motion until then, including the stop without setpoints.

    Live: call `command(setpoint, now)` for each setpoint, then `advance(now)`, `motion(now)`.
    """

    def __init__(
        self,
        table: Table,
        options: TableOptions | None = None,
        rng: np.random.Generator | None = None,
        *,
        epoch: int = 0,
        start: Floats | None = None,
    ) -> None:
        """Put the table at rest.

        Args:
            table: Joints and limits.
            options: Its errors; the defaults if not given.
            rng: Source of the errors.
            epoch: Stamp at which the table's time is zero, ns.
            start: (k,) initial encoder angles, rad; zeros if not given.

        Raises:
            InputError: A joint has no limit of rate or acceleration.
        """
        table.check_limited('the simulation needs')
        self.table = table
        self.options = options or TableOptions()
        self.epoch = epoch
        count = len(table.joints)
        streams = (rng or np.random.default_rng()).spawn(6)
        self._errors, self._servo_errors, self._rate_errors = streams[:3]
        self._stop_errors, self._stops, self._readings = streams[3:]
        self._encoders, self._truths = slice(0, count), slice(count, 2 * count)
        self._fastest = np.array([joint.max_rate for joint in table.joints])
        encoder = np.zeros(count) if start is None else np.array(start, dtype=float)
        true = encoder + self._hidden()
        self._track = Track.standing(0.0, np.concatenate([encoder, true]))
        self._base = Track.standing(0.0, self._base_error())
        self._motion: tuple[tuple[Track, Track], Motion] | None = None
        self._order = _Order(encoder, encoder, true, self._fastest)
        self._setpoint: Setpoint | None = None
        self._deadline = math.inf
        self._stopped = ''
        self._time = 0.0

    @property
    def rest_time(self) -> float:
        """Time at which the table is at rest, s, if setpoints continue."""
        return self._track.end

    @property
    def busy_until(self) -> float:
        """Time until which the last setpoint needs no other, s: it moves the table, then dwells."""
        setpoint = self._setpoint
        if setpoint is None or self._stopped or setpoint.mode is Mode.HOLD:
            return self._time
        return self._track.end + setpoint.dwell

    def command(self, setpoint: Setpoint, time: float, step: float = 0.0) -> None:
        """Take a setpoint. HOLD is obeyed whatever the age of its stamp: clocks may differ.

        Args:
            setpoint: As received from the topic.
            time: Time of its arrival, s since the epoch.
            step: Duration of the step that time has just taken, s: its sender knew no later time
                than the start of the step.

        Raises:
            InputError: Refused, with the reason; the table continues unchanged.
        """
        self._pass(time)
        age = time - (setpoint.stamp - self.epoch) * 1e-9
        oldest = step + self.options.setpoint_age
        if setpoint.mode is not Mode.HOLD and not -self.options.setpoint_age <= age <= oldest:
            raise InputError(
                f'{setpoint.where}: its stamp is {age:.3g} s old '
                f'(allowed: {self.options.setpoint_age:g} s).'
            )
        if self._setpoint is None or not _repeats(setpoint, self._setpoint):
            self._accept(setpoint, time)
            self._setpoint = setpoint
        elif self._stopped and setpoint.mode is not Mode.HOLD:
            self._go(time)
        self._stopped = ''
        self._deadline = time + self.options.setpoint_timeout

    def sent_until(self, time: float) -> None:
        """Assume that the last setpoint was repeated often enough, up to `time`, s."""
        self._time = time
        self._deadline = time + self.options.setpoint_timeout

    def keep_setpoint(self, begin: float, end: float) -> None:
        """Assume that a setpoint in force at `begin` is repeated until `end`, s.

        Nobody could repeat it within a step that is longer than its timeout.
        """
        if end - begin > self.options.setpoint_timeout and begin <= self._deadline < math.inf:
            self._deadline = end

    def advance(self, time: float) -> TableState:
        """Advance the time to `time` (s since the epoch) and return the state then.

        Raises:
            InputError: The time is in the past.
        """
        self._pass(time)
        angles, rates = self._read(np.array([time]))
        return TableState(
            time,
            angles[0],
            rates[0],
            time >= self._track.end,
            None if self._setpoint is None else self._setpoint.step,
            self._stopped,
        )

    def read(self, times: Floats) -> tuple[Floats, Floats]:
        """Return encoder angles (n, k) in rad and rates (n, k) in rad/s at (n,) times."""
        self._reach(times)
        angles, rates = self._read(times)
        noise = self.options.encoder_noise
        if noise:
            angles = self._rounded(angles + noise * self._readings.standard_normal(angles.shape))
        return angles, rates

    def angles(self, times: Floats) -> Floats:
        """Return the true joint angles (n, k) at (n,) times, rad."""
        self._reach(times)
        return self._track.at(times)[0][:, self._truths]

    def motion(self, until: float) -> Motion:
        """Return the true motion, valid up to `until`, s since the epoch."""
        self._reach(np.array([until]))
        course = self._track, self._base
        if self._motion is None or self._motion[0] != course:
            self._motion = course, self._true_motion()
        return self._motion[1]

    def _true_motion(self) -> Motion:
        azimuth = self.table.azimuth if self.options.azimuth is None else self.options.azimuth
        tilt = np.array([*self.options.tilt, 0.0])
        size = float(np.linalg.norm(tilt))
        level = rotation(tilt / size, size) if size else np.eye(3)
        base = level @ rotation(np.array([0.0, 0.0, 1.0]), azimuth or 0.0)
        track = self._track.columns(self._truths)
        if self.options.true is None and not self._leans:
            axes = np.array([joint.axis for joint in self.table.joints])
            zeros = np.array([joint.zero for joint in self.table.joints])
            return Motion(base, axes, zeros, self.table.mount, track)
        true = self.options.true or TrueTable.drawn(self.table, TableSizes(), 0)
        axes, zeros, links = true.axes_and_links(3)
        return Motion(
            base,
            np.vstack([np.eye(3), axes]),
            np.concatenate([np.zeros(3), zeros]),
            self.table.mount,
            side_by_side([self._base, track]),
            links=(*(Link(k) for k in range(3)), *links),
        )

    def drop_before(self, before: float) -> None:
        """Drop the past before a time (s since the epoch), to limit the memory of a live table."""
        self._track = self._track.since(before)
        self._base = self._base.since(before)

    def _pass(self, time: float) -> None:
        if time < self._time:
            raise InputError(f'The table is at {self._time:.9f} s, found {time:.9f} s: backwards.')
        if time > self._deadline:
            if self._track.end > self._deadline:
                self._stop_joints(self._deadline)
                self._stopped = f'no setpoint for {self.options.setpoint_timeout:g} s'
            self._deadline = math.inf
        self._time = time

    def _reach(self, times: Floats) -> None:
        self._pass(float(times.max(initial=self._time)))

    def _read(self, times: Floats) -> tuple[Floats, Floats]:
        values, rates = self._track.at(times)
        return self._rounded(values[:, self._encoders]), rates[:, self._encoders]

    def _rounded(self, angles: Floats) -> Floats:
        """Return angles as the encoders deliver them."""
        step = self.options.encoder_resolution
        if step:
            angles = np.rint(angles / step) * step
        if self.options.wrapped:
            angles = angles - TURN * np.rint(angles / TURN)
        return angles

    @property
    def _leans(self) -> bool:
        return bool(self.options.stop_tilt or self.options.stop_heading)

    def _hidden(self) -> Floats:
        """Draw the positioning errors of stopping joints, rad."""
        hidden = self._draw(self._errors, self.options.positioning_error)
        if self.options.stop_error:
            hidden = hidden + self.options.stop_error * self._stop_errors.standard_normal(
                len(hidden)
            )
        return hidden

    def _base_error(self) -> Floats:
        """Draw the tilt about the base's x and y and the rotation about z at a stop, rad."""
        sizes = np.array([self.options.stop_tilt] * 2 + [self.options.stop_heading])
        return np.asarray(sizes * self._stops.standard_normal(3) if self._leans else sizes)

    def _draw(self, stream: np.random.Generator, bound: float) -> Floats:
        return bound * stream.uniform(-1.0, 1.0, len(self.table.joints))

    def _accept(self, setpoint: Setpoint, time: float) -> None:
        if setpoint.mode is Mode.HOLD:
            self._stop_joints(time)
            self._order = self._standstill()
            return
        before = self._standstill() if self._stopped else self._order
        angles, rates = self.table.demanded(setpoint, before.goal)
        self.table.check(angles, rates, setpoint.where)
        if setpoint.mode is Mode.POSITION:
            self._order = self._aim(angles, before)
        else:
            self._order = self._aim_turn(setpoint, angles, rates, before)
        self._go(time)

    def _standstill(self) -> _Order:
        """Return the order to stay where the joints come to rest in any case."""
        rest = self._track.value[-1]
        encoder, true = rest[self._encoders], rest[self._truths]
        arrives = np.abs(encoder - self._order.encoder) < _STANDS
        return _Order(np.where(arrives, self._order.goal, encoder), encoder, true, self._fastest)

    def _aim(self, goal: Floats, before: _Order) -> _Order:
        """Set a goal position; a joint already at that goal keeps its place and its error."""
        hidden = self._hidden()
        servo = self._draw(self._servo_errors, self.options.servo_error)
        stays = np.abs(goal - before.goal) < _STANDS
        encoder = np.where(stays, before.encoder, goal + servo)
        true = np.where(stays, before.true, encoder + hidden)
        return _Order(np.where(stays, before.goal, goal), encoder, true, self._fastest)

    def _aim_turn(
        self, setpoint: Setpoint, angles: Floats, rates: Floats, before: _Order
    ) -> _Order:
        """Set a goal of whole turns: a joint that returns to its angle has the same error again.

        The turn beyond those asked for is used to start and stop.
        """
        where = setpoint.where
        self._check_rest(angles, rates, before, where)
        j = int(np.flatnonzero(rates)[0])
        goal = before.goal.copy()
        goal[j] += math.copysign(TURN * (setpoint.turns + 1), rates[j])
        self.table.check(goal, rates, where)
        run_up = rates[j] ** 2 / self._acceleration(self.table.joints[j])
        if run_up > TURN * (1 + 1e-9):
            raise InputError(
                f'{where}: joint {self.table.names[j]} needs {run_up / DEG:.4g} deg to start and '
                f'stop at {rates[j] / DEG:g} deg/s, the table leaves 360 deg.'
            )
        error = float(self._draw(self._rate_errors, self.options.rate_error)[j])
        cruise = self._fastest.copy()
        cruise[j] = min(abs(rates[j]) * (1 + error), cruise[j])
        servo = self._draw(self._servo_errors, self.options.servo_error)
        hidden = before.true - before.encoder
        if self.options.stop_error:
            hidden = np.where(rates != 0, self._hidden(), hidden)
        encoder = np.where(rates != 0, goal + servo, before.encoder)
        return _Order(goal, encoder, encoder + hidden, cruise, turns=True)

    def _check_rest(self, angles: Floats, rates: Floats, before: _Order, where: str) -> None:
        """Refuse a turn of a table that moves, or is elsewhere."""
        if self._time < self._track.end:
            raise InputError(f'{where}: RATE starts from rest, and the table still moves.')
        off = np.where(rates != 0, 0.0, np.abs(angles - before.goal))
        k = int(off.argmax())
        if off[k] > 0.01 * DEG:
            raise InputError(
                f'{where}: RATE holds joint {self.table.names[k]} at {angles[k] / DEG:g} deg, '
                f'but it stands at {before.goal[k] / DEG:g} deg.'
            )

    def _go(self, time: float) -> None:
        """Move to the goal of the order, each joint by itself, after a stop if needed."""
        self._stop_joints(time)
        start = max(time, self._track.end)
        last = self._track.value[-1]
        moves: list[Track] = []
        truths: list[Track] = []
        for k, joint in enumerate(self.table.joints):
            origin, target = float(last[k]), float(self._order.encoder[k])
            true = float(last[self._truths][k])
            if abs(target - origin) < _STANDS:
                moves.append(Track.standing(start, np.array([origin])))
                truths.append(Track.standing(start, np.array([true])))
                continue
            rate = float(self._order.cruise[k])
            move = trapezoid(start, origin, target, rate, self._acceleration(joint))
            moves.append(move)
            stops = float(self._order.true[k])
            if self.options.stop_error and self._order.turns:
                # A turning joint has no positioning error; at its stop a new one is drawn.
                truths.append(move.stopping(true - origin, stops))
            else:
                truths.append(move.mapped(true, stops))
        self._track = self._track.followed_by(side_by_side(moves + truths))
        if self._leans and self._track.end > start:
            self._base = self._base.followed_by(self._leaning(start, self._track.end))

    def _leaning(self, start: float, end: float) -> Track:
        """Return a track of the tilt from its present value to a new one, at a constant rate."""
        value, target = self._base.at(np.array([start]))[0][0], self._base_error()
        still = np.zeros(3)
        return Track(
            np.array([start, end]),
            np.array([value, target]),
            np.array([(target - value) / (end - start), still]),
            np.array([still, still]),
        )

    def _acceleration(self, joint: Joint) -> float:
        return min(joint.max_acceleration, self.options.acceleration)

    def _stop_joints(self, time: float) -> None:
        """Brake, if the table moves; the order stays, so that a repeated setpoint finishes it."""
        if time >= self._track.end:
            return
        values, rates = (x[0] for x in self._track.at(np.array([time])))
        count = len(self.table.joints)
        stops = [
            braking(time, values[k::count], rates[k::count], self._acceleration(joint))
            for k, joint in enumerate(self.table.joints)
        ]
        encoders, truths = ([stop.columns(slice(c, c + 1)) for stop in stops] for c in (0, 1))
        self._track = self._track.followed_by(side_by_side(encoders + truths))


def _repeats(setpoint: Setpoint, earlier: Setpoint) -> bool:
    return bool(_CONTENT(setpoint) == _CONTENT(earlier))
