"""Steps of a plan as setpoints: end positions, durations, limits of the table."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np

from ..common.errors import ImuCalibError, InputError
from ..common.stream import LAST_SECOND, NS, Floats, JointBlock, Mode, Setpoint
from ..common.units import DEG
from ..session.plan import Plan, Step
from ..session.table import FARTHEST, TURN, Course, Table, moving, travel_time


def steps_of_plan(plan: Plan, table: Table, start: Floats) -> tuple[tuple[Step, ...], Step]:
    """Return the steps of a plan from the table's present position, and the way back there.

    Args:
        plan: The plan.
        table: The table.
        start: (k,) present angles of the table, rad.

    Raises:
        InputError: Beyond the table's limits: names joint, value and limit.
    """
    still = np.zeros(len(start))
    table.check(start, still, 'Where the table stands')
    steps = plan.steps(table, start)
    if not steps:
        raise InputError(f'Plan {plan.name} has no positions.')
    for step in steps:
        check(step, table)
    return steps, Step(steps[-1].index, '', Mode.POSITION, start, still, 0, 0.0)


def check(step: Step, table: Table) -> None:
    """Refuse steps beyond the table's limits of angle, rate and acceleration.

    Raises:
        InputError: Names joint, value and limit.
    """
    where = f'Step {step.index + 1}, position {step.position or "of the start"}'
    table.check(step.angles, step.rates, where)
    table.check(end_of(step), step.rates, where)
    for joint, rate in zip(table.joints, step.rates, strict=True):
        # One extra turn is available for run-up and run-down, which use v^2 / a of it.
        needed = float(rate) ** 2 / TURN
        if needed > joint.max_acceleration * (1 + 1e-9):
            raise InputError(
                f'{where}: to {rate / DEG:g} deg/s and back within a turn joint {joint.name} '
                f'needs {needed / DEG:.4g} deg/s^2, table {table.name} allows '
                f'{joint.max_acceleration / DEG:g} deg/s^2.'
            )


def end_of(step: Step) -> Floats:
    """Return the (k,) angles at rest after a step, rad."""
    travel = np.where(step.rates == 0, 0.0, np.copysign(TURN * (step.turns + 1), step.rates))
    return np.asarray(step.angles + travel)


def approach_step(step: Step) -> Step:
    """Return the step that moves to the start of a turn."""
    still = np.zeros(len(step.rates))
    return replace(step, mode=Mode.POSITION, rates=still, turns=0, dwell=0.0)


def motion_time(step: Step, before: Floats, table: Table) -> float:
    """Return the duration of a step's motion from (k,) angles at the table's limits, s."""
    ways = end_of(step) - before
    return max(
        travel_time(
            float(way), abs(float(rate)) if rate else joint.max_rate, joint.max_acceleration
        )
        for way, rate, joint in zip(ways, step.rates, table.joints, strict=True)
    )


def setpoint_of(step: Step, plan: str, joints: tuple[str, ...]) -> Setpoint:
    """Return the setpoint of a step, not yet stamped."""
    return Setpoint(
        stamp=0,
        plan=plan,
        step=step.index,
        position=step.position,
        mode=step.mode,
        joints=joints,
        angles=tuple(step.angles.tolist()),
        rates=tuple(step.rates.tolist()),
        turns=float(step.turns),
        dwell=float(step.dwell),
    )


def held(current: Step | None, angles: Sequence[float] | None, plan: str, table: Table) -> Setpoint:
    """Return the setpoint that stops a table where it is; the sender sets its stamp.

    Args:
        current: The interrupted step, if any.
        angles: Present angles, rad, for the record; None if unknown.
        plan: Name of the plan.
        table: The table.
    """
    joints = table.joints
    known = (0.0,) * len(joints) if angles is None else angles
    return Setpoint(
        stamp=0,
        plan=plan,
        step=0 if current is None else current.index,
        position='' if current is None else current.position,
        mode=Mode.HOLD,
        joints=table.names,
        angles=tuple(min(max(a, j.lower), j.upper) for a, j in zip(known, joints, strict=True)),
        rates=(0.0,) * len(joints),
        turns=0.0,
        dwell=0.0,
    )


class Phase(IntEnum):
    """Phase of the table; values as in imu_calib_msgs/TurntableState."""

    IDLE = 0
    MOVING = 1
    SETTLING = 2
    TURNING = 3
    DWELLING = 4
    PAUSED = 5
    DONE = 6
    ABORTED = 7

    @property
    def at_a_step(self) -> bool:
        """Whether the table is at a step of the plan."""
        return self in {Phase.MOVING, Phase.SETTLING, Phase.TURNING, Phase.DWELLING}


@dataclass(frozen=True)
class Rules:
    """Tolerances and times; all times are by the stamps of the joint states."""

    settle: float = 1.0  #: From the arrival at a step's end to the start of its dwell, s.
    arrival: float = 0.01 * DEG  #: Largest distance from its goal of a joint that has arrived, rad.
    #: Largest distance of a joint beyond its goal, or off its way, rad.
    overshoot: float = 0.5 * DEG
    feedback_timeout: float = 0.5  #: Longest gap between joint states, s.
    supervised: bool = True  #: Whether a calibrator requests repetitions of steps.
    repeats: int = 2  #: Most repetitions of a step at the calibrator's request.
    #: Longest wait for the calibrator's reply at the end of the plan, s.
    repeat_wait: float = 600.0


@dataclass(frozen=True)
class SequencerState:
    """State of the sequencer: the content of imu_calib_msgs/TurntableState."""

    plan: str  #: Name of the plan.
    step: int  #: Index of the current or last step.
    steps: int  #: Number of steps, 0 before the first start.
    position: str  #: Id of the plan's position, empty on the way back to the start.
    phase: Phase  #: Present phase.
    #: Why it is PAUSED or ABORTED, DONE without the calibrator's reply, or what happened to an idle
    #: table; else empty.
    reason: str
    fault: bool  #: Whether there was a fault, not a requested stop.
    waits_for: str  #: What an accepted start waits for, else empty.
    angles: tuple[float, ...]  #: (k,) measured, unwrapped, rad; empty before the first joint state.
    rates: tuple[float, ...]  #: (k,) measured, rad/s.
    turns_done: float  #: Turns at rate of the current RATE step, without sign.
    seconds_left: float  #: Expected time to the end of the plan, s.


WINDOW = 0.1
"""s without motion after which a table is at rest; derived rates are means over this time."""

_WINDOW = round(WINDOW * NS)
"""ns: `WINDOW`."""

_LATEST = (LAST_SECOND + 1) * NS - 1
"""ns: the largest stamp of a header. A message may exceed it with more than 1e9 ns in a second."""

_JITTER = 5 * DEG
"""Largest change of angle between two joint states that stamp jitter may cause, rad. A judgement:
50 ms at 100 deg/s, and a 72nd of the turn that is recognised."""

_FASTEST = 1.1
"""Of a joint's largest rate: the watch stops a turn that is faster (`watch`, `_RATE_TOLERANCE`)."""


class FeedbackError(InputError):
    """Joint states that are invalid for this table."""


@dataclass(frozen=True)
class Feedback:
    """One joint state."""

    stamp: int  #: ns.
    gap: float  #: Since the joint state before, s; 0 for the first one.
    angles: tuple[float, ...]  #: (k,) in the table's order, continuous, rad.
    rates: tuple[float, ...]  #: (k,) rad/s, as reported, else derived from the angles.
    still: bool  #: Whether no joint has moved over the last tenth of a second.
    #: (k,) mean rates over the last tenth of a second by the angles alone, rad/s; empty for the
    #: first one.
    means: tuple[float, ...] = ()


@dataclass(frozen=True)
class Rest:
    """A table that is to stand, and needs no decision while it does."""

    angles: tuple[float, ...]  #: (k,) continuous angles at which it stands, rad.
    stray: float  #: Largest distance from there, rad, less than a quarter of a turn.
    until: int  #: Stamp of the next decision, ns.


class Encoders:
    """Track the joint states of a table.

    Args:
        table: The table.
        quiet: Largest angle that counts as no motion, rad.
        patience: A stamp that is earlier by more than this restarts the stream, s.

    Attributes:
        ignored: Messages that lack a joint of the table.
        ignored_names: Joint names of the latest of them.
    """

    def __init__(self, table: Table, quiet: float, patience: float) -> None:
        self._table = table
        self._quiet = quiet
        self._patience = round(patience * 1e9)
        self._fastest = [joint.max_rate for joint in table.joints]
        self.ignored = 0
        self.ignored_names: tuple[str, ...] = ()
        self._past: deque[tuple[int, tuple[float, ...]]] = deque()
        self._turns = [0.0] * len(table.joints)

    def take(self, block: JointBlock) -> Iterator[Feedback]:
        """Yield the joint states of a block whose stamps increase.

        Messages that lack a joint of the table are skipped and counted: other joints may share the
        topic.

        Raises:
            FeedbackError: An angle is no number or beyond `FARTHEST`; a stamp jumps back, or is
                later than a header can state.
        """
        joints = block.select_joints(self._table.names)
        if joints is None:
            self.ignored += len(block)
            self.ignored_names = block.names
            return
        stamps = joints.stamp.tolist()
        positions, velocities = joints.position.tolist(), joints.velocity.tolist()
        for stamp, angles, rates in zip(stamps, positions, velocities, strict=True):
            if self._past and stamp <= self._past[-1][0]:
                self._check_order(stamp)
                continue
            yield self._follow(stamp, angles, rates)

    def pass_over(self, block: JointBlock, rest: Rest) -> JointBlock:
        """Return a block without the joint states at its begin that show the table at rest.

        Their stamps increase by half a window at most. The last two windows of them are kept: what
        `take` yields of those is what it yields after all the others.

        Args:
            block: Joint states.
            rest: Where the table stands, and until when.
        """
        joints = block.select_joints(self._table.names)
        if joints is None or not self._past:
            return block
        stamp, last = joints.stamp, self._past[-1]
        steps = np.diff(stamp, prepend=last[0])
        angles = joints.position + self._turns
        stands = (steps > 0) & (steps <= _WINDOW // 2) & (stamp < min(rest.until, _LATEST))
        stands &= (np.abs(angles - rest.angles) <= rest.stray).all(axis=1)
        count = len(stamp) if stands.all() else int(stands.argmin())
        if count == 0 or np.abs(np.subtract(last[1], rest.angles)).max() > rest.stray:
            return block
        count = int(np.searchsorted(stamp[:count], stamp[count - 1] - 2 * _WINDOW))
        if count:
            self._past.clear()
            self._past.append((int(stamp[count - 1]), tuple(angles[count - 1].tolist())))
        return JointBlock(
            stamp[count:], joints.names, joints.position[count:], joints.velocity[count:]
        )

    def _check_order(self, stamp: int) -> None:
        """Raise if a stamp is so much earlier that the stream was restarted."""
        back = self._past[-1][0] - stamp
        if back > self._patience:
            self._past.clear()
            raise FeedbackError(f'The stamps of the joint states jump back by {back * 1e-9:.3g} s.')

    def _follow(self, stamp: int, angles: list[float], rates: list[float]) -> Feedback:
        """Return a joint state (k,) rad and rad/s, in order, with continuous angles."""
        if stamp > _LATEST:
            raise FeedbackError(f'The joint states are stamped {stamp * 1e-9:.0f} s after 1970.')
        strange = [k for k, angle in enumerate(angles) if not abs(angle) <= FARTHEST]
        if strange:
            name, angle = self._table.names[strange[0]], angles[strange[0]]
            raise FeedbackError(f'The joint states give {angle} as the angle of joint {name}.')
        past = self._past
        if not past:
            angles = [angle + turns for angle, turns in zip(angles, self._turns, strict=True)]
            past.append((stamp, tuple(angles)))
            first = tuple(rate if math.isfinite(rate) else 0.0 for rate in rates)
            return Feedback(stamp, 0.0, tuple(angles), first, False)
        gap = (stamp - past[-1][0]) * 1e-9
        angles = self._unwrapped(angles, past[-1][1], gap)
        while len(past) > 1 and past[1][0] <= stamp - _WINDOW:
            past.popleft()
        since, before = past[0]
        span = (stamp - since) * 1e-9
        changes = [now - then for now, then in zip(angles, before, strict=True)]
        still = stamp - since >= _WINDOW and max(map(abs, changes)) <= self._quiet
        means = tuple(change / span for change in changes)
        known = tuple(
            rate if math.isfinite(rate) else mean for rate, mean in zip(rates, means, strict=True)
        )
        past.append((stamp, tuple(angles)))
        return Feedback(stamp, gap, tuple(angles), known, still, means)

    def _unwrapped(self, angles: list[float], last: tuple[float, ...], gap: float) -> list[float]:
        """Add whole turns where an angle jumps by about a turn, more than the joint can turn.

        After a gap in the joint states, only if the encoder is known to wrap: the table may have
        moved anywhere, or restarted. Other jumps are kept, for the watch to detect.
        """
        result = []
        for k, (angle, before) in enumerate(zip(angles, last, strict=True)):
            change = angle + self._turns[k] - before
            if abs(change) > math.pi:
                whole = TURN * round(change / TURN)
                reach = _FASTEST * self._fastest[k] * gap
                sound = self._turns[k] != 0 or gap * 1e9 <= self._patience
                if sound and abs(change - whole) <= reach + _JITTER < abs(change):
                    self._turns[k] -= whole
            result.append(angle + self._turns[k])
        return result


# Convert setpoints to finite trajectories, for controllers that follow points in time.
#
# joint_trajectory_controller replaces its trajectory by each new one, samples it by the time since
# its header's stamp, and holds the last point. A zero stamp starts it now, from the present joint
# positions, on a cubic to the first point.
#
# So all pieces of one motion have the stamp of its start and coincide up to where the earlier one
# brakes: transmission delays do no harm, and the table brakes if its node fails.


_LEAD = 0.1
"""s from sending the first piece of a motion to its start. A choice: one period of setpoints."""

_PIECE = 3.0
"""s that a trajectory reaches ahead: the time for which a controller moves if its node fails."""
_RENEWAL = 1.0
"""s between two trajectories: two may be lost before the last one ends."""
_SOONEST_STOP = 0.1
"""s added to the shortest stop, since the joint state at its start is old by then."""
_OLD = 0.2
"""Age of a joint state, s, above which the table's position is unknown. A judgement: ten states at
50 Hz."""


class Overtaken(ImuCalibError):
    """The next piece comes when the table brakes already: the course would jump."""


@dataclass(frozen=True, eq=False)
class Piece:
    """One trajectory."""

    stamp: int  #: Its start, ns; 0: now.
    course: Course  #: Knots; without one at time zero it starts from the present position.


class Lead:
    """Convert repeated setpoints to pieces of trajectories."""

    def __init__(self, table: Table) -> None:
        self._table = table
        self._rates = [joint.max_rate for joint in table.joints]
        self._accelerations = [joint.max_acceleration for joint in table.joints]
        self._content: tuple[object, ...] | None = None
        self._course: Course | None = None
        self._start = 0
        self._covered = 0.0
        self._sent = -math.inf

    def piece(self, setpoint: Setpoint, at: Feedback, unseen: float = 0.0) -> Piece | None:
        """Return the trajectory to send with a setpoint, None while the last one suffices.

        Args:
            setpoint: As sent, checked against the table's limits; its stamp is now.
            at: The last joint state.
            unseen: Time since it was received by the steady clock, s: a simulated clock may stand,
                and a table's be ahead.

        Raises:
            Overtaken: Too late to continue the motion without a jump.
        """
        if setpoint.mode is Mode.HOLD:
            return self._hold(setpoint, at, unseen)
        content = (setpoint.step, setpoint.mode, setpoint.angles, setpoint.rates)
        if content != self._content:
            self._begin(setpoint, at)
            self._content = content
        course = self._course
        if course is None:
            return None
        now = (setpoint.stamp - self._start) * 1e-9
        if self._covered >= course.end or now < self._covered - _PIECE + _RENEWAL:
            return None
        if now > self._covered - _LEAD and self._covered > 0:
            raise Overtaken(
                f'A motion of {course.end:.1f} s was led on for {self._covered:.1f} s, and the '
                f'next piece comes after {now:.1f} s: the table brakes already.'
            )
        self._covered = max(now, 0.0) + _PIECE
        return Piece(self._start, course.until(self._covered, self._accelerations))

    def _stop(self, at: Feedback) -> Piece:
        """Return the course to the nearest stopping point, from the present position."""
        angles, rates = np.array(at.angles), self._credible(at)
        # Slightly longer than the shortest time: the joint state is some milliseconds old.
        time = float((np.abs(rates) / self._accelerations).max()) + _SOONEST_STOP
        lower = np.minimum([joint.lower for joint in self._table.joints], angles)
        upper = np.maximum([joint.upper for joint in self._table.joints], angles)
        goal = np.clip(angles + rates * time / 2, lower, upper)
        return Piece(0, Course(np.array([time]), goal[None], np.zeros((1, len(goal)))))

    def _credible(self, at: Feedback) -> Floats:
        """Return the (k,) reported rates, or lower ones if the angles show less, rad/s.

        A stop from too high a rate is a motion, of many turns if deg/s were reported as rad/s. A
        joint at its highest acceleration is ahead of its mean rate by half of the change.
        """
        rates, means = np.array(at.rates), np.zeros(len(at.rates))
        ahead = np.array(self._rates)
        if at.means:
            means, ahead = np.array(at.means), np.array(self._accelerations) * WINDOW / 2
        shown = np.clip(rates, means - ahead, means + ahead)
        return np.asarray(np.clip(shown, np.minimum(rates, 0.0), np.maximum(rates, 0.0)))

    def _begin(self, setpoint: Setpoint, at: Feedback) -> None:
        """Plan the course of a motion from the table's present position."""
        goal, rates = list(setpoint.angles), list(self._rates)
        for k, rate in enumerate(setpoint.rates):
            if setpoint.mode is Mode.RATE and rate:
                goal[k] += math.copysign(TURN * (setpoint.turns + 1), rate)
                rates[k] = abs(rate)
        self._course = moving(at.angles, goal, rates, self._accelerations)
        self._start = setpoint.stamp + round(_LEAD * 1e9)
        self._covered = 0.0

    def _hold(self, setpoint: Setpoint, at: Feedback, unseen: float) -> Piece | None:
        """Return the trajectory that stops the table, None while the last one suffices."""
        content = (setpoint.mode,)
        now = setpoint.stamp * 1e-9
        # Once at rest the controller holds by itself.
        if content == self._content and (at.still or now < self._sent + _RENEWAL):
            return None
        self._content, self._sent = content, now
        if max(unseen, (setpoint.stamp - at.stamp) * 1e-9) > _OLD:
            return self._cut_short(setpoint)
        self._course = None
        return self._stop(at)

    def _cut_short(self, setpoint: Setpoint) -> Piece | None:
        """Brake on the present course: the table's position is unknown."""
        course, end = self._course, (setpoint.stamp - self._start) * 1e-9 + _LEAD
        if course is None or end >= self._covered:
            return None
        self._course = None
        return Piece(self._start, course.until(max(end, 0.0), self._accelerations))
