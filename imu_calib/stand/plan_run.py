"""Run the steps of a plan one after another."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum, auto

import numpy as np

from ..common.errors import InputError
from ..common.stream import Mode
from ..session.plan import Plan, Step
from ..session.table import Table
from .itinerary import Itinerary
from .orders import Orders
from .plan_steps import Feedback, Rest
from .rules import Phase, Rules
from .steps import approach_step, check, end_of


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
    """Run a table from step to step, each confirmed by the joint states.

    Args:
        plan: The plan.
        table: The table.
        rules: Tolerances and times.

    Attributes:
        itinerary: The steps in order.
        orders: The commands to the table.
        leg: Stage within the plan; STOPPING while idle.
        remark: How the plan ended, in a sentence; else empty.
    """

    def __init__(self, plan: Plan, table: Table, rules: Rules) -> None:
        self._table = table
        self._rules = rules
        self.itinerary = Itinerary(plan, table, rules)
        self.orders = Orders(plan.name, table, rules)
        self.leg = Leg.STOPPING
        self.remark = ''
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
        """Continue with the remaining plan once the table is at rest.

        Args:
            at: The last joint state.
            done: Steps that need not be run.
        """
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
        return fault or self._go_on(now, there)

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

    def _go_on(self, now: Feedback, there: bool) -> str:
        """Go on to the next leg where it is due; return a sentence on a fault, or nothing."""
        if there and self.leg in {Leg.STOPPING, Leg.MOVING}:
            return self._next(now) if self.leg is Leg.STOPPING else self._arrive(now)
        elapsed = (now.stamp - self._since) * 1e-9
        if self.leg is Leg.SETTLING and elapsed >= self._rules.settle:
            self._enter(Leg.DWELLING, now)
            elapsed = 0.0
        if self.leg is Leg.DWELLING and elapsed >= self._dwell:
            return self._finish(now)
        if self.leg is Leg.REVIEWING and elapsed > self._rules.repeat_wait:
            self.remark = (
                f'The calibrator did not report within {self._rules.repeat_wait:g} s '
                'whether steps are to be repeated.'
            )
            return self._begin(self.itinerary.return_step, now)
        return ''

    def _next(self, at: Feedback) -> str:
        """Begin the next step; after the last one ask the calibrator, then go home."""
        step = self.itinerary.take()
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
            check(motion, self._table)
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

    def _finish(self, now: Feedback) -> str:
        if self.itinerary.is_returning:
            self._stop(Leg.HOME, now)
            return ''
        self._ended = now.stamp
        return self._next(now)
