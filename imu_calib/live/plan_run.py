"""The steps of a plan as setpoints, and their run one after another."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import replace
from enum import Enum, auto

import numpy as np

from ..common.errors import InputError
from ..common.stream import Floats, Mode, Setpoint
from ..common.units import DEG
from ..session.plan import Plan, Step
from ..session.table import TURN, Table, travel_time
from .rules import Phase, Rules
from .table_watch import Feedback, IdleWatch, Rest, Standing, Watch

# The steps as setpoints: end positions, durations, limits of the table.


def steps_of_plan(plan: Plan, table: Table, start: Floats) -> tuple[tuple[Step, ...], Step]:
    """Return a plan's steps from the present (k,) angles of the table, rad, and the way back."""
    still = np.zeros(len(start))
    table.check(start, still, 'Where the table stands')
    steps = plan.steps(table, start)
    if not steps:
        raise InputError(f'Plan {plan.name} has no positions.')
    for step in steps:
        check_step(step, table)
    return steps, Step(steps[-1].index, '', Mode.POSITION, start, still, 0, 0.0)


def check_step(step: Step, table: Table) -> None:
    """Refuse steps beyond the table's limits of angle, rate and acceleration."""
    where = f'Step {step.index + 1}, position {step.position or "of the start"}'
    table.check(step.angles, step.rates, where)
    table.check(end_of(step), step.rates, where)
    for joint, rate in zip(table.joints, step.rates, strict=True):
        # One extra turn is available for run-up and run-down, which use v^2 / a of it.
        needed = float(rate) ** 2 / TURN
        if needed > joint.max_acceleration * (1 + 1e-9):
            raise InputError(
                f'{where}: to reach {rate / DEG:g} deg/s joint {joint.name} needs '
                f'{needed / DEG:.4g} deg/s^2, table {table.name} allows '
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


def stopping_setpoint(
    current: Step | None, angles: Sequence[float] | None, plan: str, table: Table
) -> Setpoint:
    """Return the setpoint, not yet stamped, that stops a table where it is."""
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


class Orders:
    """The present setpoint, from its sending on, and the watch on its execution."""

    def __init__(self, plan: str, table: Table, rules: Rules) -> None:
        self._plan = plan
        self._table = table
        self._rules = rules
        self.revision = 0  #: Changes with the setpoint.
        #: The motion that was ordered last; None once the table was commanded to hold.
        self.motion: Step | None = None
        self.turns_done = 0.0  #: Turns at rate of the last motion, without sign.
        self.idle = IdleWatch(table, rules, None)  #: Motion of the table while idle.
        self._setpoint: Setpoint | None = None
        self._sent = False
        self._watch: Watch | Standing = Standing(table, rules, None)

    @property
    def holds(self) -> bool:
        """Whether the last command was to hold."""
        return self._setpoint is not None and self._setpoint.mode is Mode.HOLD

    def hold_setpoint(self, current: Step | None, at: Feedback | None) -> Setpoint:
        """Return the setpoint that stops the table where it is, not yet stamped."""
        angles = None if at is None else at.angles
        return stopping_setpoint(current, angles, self._plan, self._table)

    def hold(self, current: Step | None, at: Feedback | None) -> None:
        """Command the table to hold; the present watch is kept."""
        self._order(self.hold_setpoint(current, at), None)

    def stop(self, current: Step | None, at: Feedback | None) -> None:
        """Command the table to hold, and watch it come to rest; arguments as of `hold`."""
        commanded = isinstance(self._watch, Watch) or self._watch.commanded
        self.idle = IdleWatch(self._table, self._rules, at, commanded=commanded)
        self._watch = Standing(self._table, self._rules, at, commanded=commanded)
        self.hold(current, at)

    def move(self, motion: Step) -> None:
        """Command a motion; it is watched once the setpoint was sent."""
        self.turns_done = 0.0
        self._order(motion.setpoint(self._plan, self._table.names), motion)

    def watch_goal(self, goal: tuple[float, ...], at: Feedback | None) -> None:
        """Watch that the table stays at its goal, (k,) angles, rad."""
        self._watch = Standing(self._table, self._rules, at)
        self._watch.keep(goal)

    def to_send(self, stamp: int, at: Feedback | None) -> Setpoint | None:
        """Return the setpoint, None before the first; it counts as sent, and is watched."""
        if self._setpoint is None:
            return None
        if not self._sent:
            self._sent = True
            if self.motion is not None and at is not None:
                self._watch = Watch(self._table, self._rules, self.motion, at)
        return replace(self._setpoint, stamp=stamp)

    def rest(self, until: int) -> Rest | None:
        """Return where the table is to stand until a stamp, ns; None if it need not stand yet."""
        watch = self._watch
        if not self._sent or isinstance(watch, Watch) or watch.rest is None:
            return None
        return Rest(watch.rest, watch.stray, until)

    @property
    def is_sent(self) -> bool:
        """Whether the setpoint was sent: earlier measurements do not show its effect."""
        return self._sent

    def check(self, now: Feedback) -> tuple[bool, str]:
        """Return whether the motion is complete, and a sentence on any fault."""
        there, fault = self._watch.check(now)
        if isinstance(self._watch, Watch):
            self.turns_done = self._watch.turns_done
        return there, fault

    def _order(self, setpoint: Setpoint, motion: Step | None) -> None:
        self._setpoint, self.motion, self._sent = setpoint, motion, False
        self.revision += 1


class Itinerary:
    """The steps of a plan from the table's present position, and the way back there."""

    def __init__(self, plan: Plan, table: Table, rules: Rules) -> None:
        self._plan = plan
        self._table = table
        self._rules = rules
        self._steps: tuple[Step, ...] = ()
        self._return_step: Step | None = None
        self._queue: deque[Step] = deque()
        self._repeated: Counter[int] = Counter()
        self._times: dict[str | int, float] = {}
        #: The current or next step; None before the plan is laid out.
        self.current: Step | None = None

    def __len__(self) -> int:
        return len(self._steps)

    @property
    def index(self) -> int:
        """Index of the current step; 0 before the plan is laid out."""
        return 0 if self.current is None else self.current.index

    @property
    def is_returning(self) -> bool:
        """Whether the current step is the way back, or the plan is not laid out yet."""
        return self.current is self._return_step

    @property
    def return_step(self) -> Step:
        """The way back to the start position."""
        assert self._return_step is not None
        return self._return_step

    def plan_steps(self, angles: Sequence[float]) -> None:
        """Recompute the steps from the present angles of the table, rad."""
        before = np.array(angles)
        self._steps, self._return_step = steps_of_plan(self._plan, self._table, before)
        self._queue = deque(self._steps)
        self.current = self._steps[0]
        self._repeated.clear()
        for step in (*self._steps, self._return_step):
            time = motion_time(step, before, self._table) + self._rules.settle + step.dwell
            self._times['home' if step is self._return_step else step.index] = time
            before = end_of(step)

    def leave_out(self, done: frozenset[int]) -> None:
        """Remove steps that were run in the session that is resumed."""
        self._queue = deque(step for step in self._queue if step.index not in done)
        self.current = self._queue[0] if self._queue else self._steps[-1]

    def repeat_current(self) -> None:
        """Run the interrupted current step first."""
        if self.current is not None:
            self._queue.appendleft(self.current)

    def pop_step(self) -> Step | None:
        """Return the next step; None after the last one."""
        return self._queue.popleft() if self._queue else None

    def repeat(self, indices: Sequence[int]) -> bool:
        """Append steps with too little data, as often as the rules allow; return whether any."""
        again = [
            step
            for step in self._steps
            if step.index in set(indices) and self._repeated[step.index] < self._rules.repeats
        ]
        self._repeated.update(step.index for step in again)
        self._queue.extend(again)
        return bool(again)

    def seconds_left(self) -> float:
        """Return the duration of all after the current step, s."""
        seconds = sum(self._time_of(step) for step in self._queue)
        if not self.is_returning and self._return_step not in self._queue:
            seconds += self._times['home']
        return seconds

    def seconds_of_current(self) -> float:
        """Return the duration of the current step: motion, settling and dwell, s."""
        return 0.0 if self.current is None else self._time_of(self.current)

    def _time_of(self, step: Step) -> float:
        return self._times['home' if step is self._return_step else step.index]


class Leg(Enum):
    """Stage within a running plan."""

    STOPPING = auto()
    """Until the table is at rest, to continue from there."""
    MOVING = auto()
    SETTLING = auto()
    DWELLING = auto()
    REVIEWING = auto()
    """Waiting for the calibrator's reply on repetitions."""
    HOME = auto()
    """Back at its start position: the plan is complete."""


_ROUNDING = 1e-6
"""s before the end of a leg from which its end is judged: more than the rounding of either."""
_WITHIN_A_STEP = frozenset({Leg.MOVING, Leg.SETTLING, Leg.DWELLING})
_PHASES = {
    Leg.STOPPING: Phase.MOVING,
    Leg.MOVING: Phase.MOVING,
    Leg.SETTLING: Phase.SETTLING,
    Leg.DWELLING: Phase.DWELLING,
    Leg.REVIEWING: Phase.DWELLING,
    Leg.HOME: Phase.DONE,
}


class Run:
    """Run a table from step to step, each confirmed by the joint states."""

    def __init__(self, plan: Plan, table: Table, rules: Rules) -> None:
        self._table = table
        self._rules = rules
        self.itinerary = Itinerary(plan, table, rules)  #: The steps in order.
        self.orders = Orders(plan.name, table, rules)  #: The commands to the table.
        self.leg = Leg.STOPPING  #: Stage within the plan; STOPPING while idle.
        self.remark = ''  #: How the plan ended, in a sentence; else empty.
        self._since = 0
        self._ended = 0
        self._place_is_known = False

    @property
    def phase(self) -> Phase:
        """Phase of the table while a plan runs."""
        motion = self.orders.motion
        if self.leg is Leg.MOVING and motion is not None and motion.mode is Mode.RATE:
            return Phase.TURNING
        return _PHASES[self.leg]

    def go(self, at: Feedback | None, done: frozenset[int] = frozenset()) -> None:
        """Continue with the plan, without steps already done, once the table is at rest."""
        if done:
            self.itinerary.leave_out(done)
        self.remark = ''
        self._place_is_known = False
        self._stop(Leg.STOPPING, at)

    def interrupt(self, at: Feedback | None) -> None:
        """Hold the table; the interrupted step is run first on continuing."""
        if self.leg in _WITHIN_A_STEP:
            self.itinerary.repeat_current()
        self._stop(Leg.STOPPING, at)

    @property
    def rest(self) -> Rest | None:
        """Where the table is to stand while it settles or dwells; None in other legs."""
        lasts = {Leg.SETTLING: self._rules.settle, Leg.DWELLING: self._dwell}
        if self.leg not in lasts:
            return None
        return self.orders.rest(self._since + round((lasts[self.leg] - _ROUNDING) * 1e9))

    def follow(self, now: Feedback) -> str:
        """Process a joint state; return a sentence on a fault, or nothing."""
        if not self.orders.is_sent:
            return ''
        there, fault = self.orders.check(now)
        return fault or self._advance_leg(now, there)

    def review(self, stamp: int, repeat_steps: Sequence[int], at: Feedback) -> str:
        """Process the calibrator's reply in REVIEWING; return a sentence on a fault.

        Args:
            stamp: Stamp of the last joint state that it has processed, ns.
            repeat_steps: Indices of steps with too little data.
            at: The last joint state.
        """
        # A reply that does not cover all joint states is too early.
        latest = at.stamp + self._rules.feedback_timeout * 1e9
        if not self._ended <= stamp <= latest:
            return ''
        again = self.itinerary.repeat(repeat_steps)
        self._place_is_known = False
        return self._next(at) if again else self._begin(self.itinerary.return_step, at)

    def seconds_left(self, at: Feedback | None) -> float:
        """Return the expected time to the end of the plan, s."""
        seconds = self.itinerary.seconds_left()
        if self.leg not in _WITHIN_A_STEP or at is None:
            return seconds
        elapsed = (at.stamp - self._since) * 1e-9
        now = {
            Leg.MOVING: self.itinerary.seconds_of_current(),
            Leg.SETTLING: self._rules.settle + self._dwell,
            Leg.DWELLING: self._dwell,
        }
        return seconds + max(now[self.leg] - elapsed, 0.0)

    @property
    def _dwell(self) -> float:
        current = self.itinerary.current
        return 0.0 if current is None else current.dwell

    def _enter(self, leg: Leg, at: Feedback | None) -> None:
        """Begin a leg."""
        self.leg = leg
        if at is not None:
            self._since = at.stamp

    def _stop(self, leg: Leg, at: Feedback | None) -> None:
        """Command the table to hold, and begin a leg."""
        self._enter(leg, at)
        self.orders.stop(self.itinerary.current, at)

    def _advance_leg(self, now: Feedback, there: bool) -> str:
        """Go on to the next leg where it is due; return a sentence on a fault, or nothing."""
        if there and self.leg in {Leg.STOPPING, Leg.MOVING}:
            return self._next(now) if self.leg is Leg.STOPPING else self._arrive(now)
        elapsed = (now.stamp - self._since) * 1e-9
        if self.leg is Leg.SETTLING and elapsed >= self._rules.settle:
            self._enter(Leg.DWELLING, now)
            elapsed = 0.0
        if self.leg is Leg.DWELLING and elapsed >= self._dwell:
            return self._end_step(now)
        if self.leg is Leg.REVIEWING and elapsed > self._rules.repeat_wait:
            self.remark = (
                f'The calibrator did not report within {self._rules.repeat_wait:g} s '
                'whether steps are to be repeated.'
            )
            return self._begin(self.itinerary.return_step, now)
        return ''

    def _next(self, at: Feedback) -> str:
        """Begin the next step; after the last one ask the calibrator, then go home."""
        step = self.itinerary.pop_step()
        if step is None and self._rules.supervised and not self.itinerary.is_returning:
            self._stop(Leg.REVIEWING, at)
            return ''
        return self._begin(step or self.itinerary.return_step, at)

    def _begin(self, step: Step, at: Feedback) -> str:
        """Command a step; a turn whose start may be off is preceded by a move there."""
        self.itinerary.current = step
        off = np.abs(step.angles - np.array(at.angles)).max()
        near = self._place_is_known and off <= self._rules.arrival
        return self._move(approach_step(step) if step.mode is Mode.RATE and not near else step, at)

    def _move(self, motion: Step, at: Feedback) -> str:
        self._enter(Leg.MOVING, at)
        try:
            check_step(motion, self._table)
        except InputError as error:
            return str(error)
        self._place_is_known = True
        self.orders.move(motion)
        return ''

    def _arrive(self, now: Feedback) -> str:
        motion, current = self.orders.motion, self.itinerary.current
        assert motion is not None
        assert current is not None
        if motion.mode is not current.mode:
            return self._move(current, now)
        self._enter(Leg.SETTLING, now)
        self.orders.watch_goal(tuple(end_of(current).tolist()), now)
        return ''

    def _end_step(self, now: Feedback) -> str:
        if self.itinerary.is_returning:
            self._stop(Leg.HOME, now)
            return ''
        self._ended = now.stamp
        return self._next(now)
