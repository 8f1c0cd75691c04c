"""The present command to the table, and the check that the table follows it."""

from __future__ import annotations

from dataclasses import replace

from ..common.stream import Mode, Setpoint
from ..session.plan import Step
from ..session.table import Table
from .idle_watch import IdleWatch
from .plan_steps import Feedback, Rest
from .rules import Rules
from .steps import held, setpoint_of
from .table_watch import Standing, Watch


class Orders:
    """The present setpoint, from its sending on, and the watch on its execution.

    Args:
        plan: Name of the plan.
        table: The table.
        rules: Tolerances.

    Attributes:
        revision: Changes with the setpoint.
        motion: The motion that was ordered last; None once the table was commanded to hold.
        turns_done: Turns at rate of the last motion, without sign.
        idle: Motion of the table while idle.
    """

    def __init__(self, plan: str, table: Table, rules: Rules) -> None:
        self._plan = plan
        self._table = table
        self._rules = rules
        self.revision = 0
        self.motion: Step | None = None
        self.turns_done = 0.0
        self.idle = IdleWatch(table, rules, None)
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
        return held(current, angles, self._plan, self._table)

    def hold(self, current: Step | None, at: Feedback | None) -> None:
        """Command the table to hold; the present watch is kept.

        Args:
            current: The interrupted step, if any.
            at: The last joint state, if any.
        """
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
        self._order(setpoint_of(motion, self._plan, self._table.names), motion)

    def watch_goal(self, goal: tuple[float, ...], at: Feedback | None) -> None:
        """Watch that the table stays at its goal, (k,) angles, rad."""
        self._watch = Standing(self._table, self._rules, at)
        self._watch.keep(goal)

    def to_send(self, stamp: int, at: Feedback | None) -> Setpoint | None:
        """Return the present setpoint, None before the first; it counts as sent now.

        Args:
            stamp: Time of sending, ns.
            at: The last joint state, if any: the watch on a motion begins there.
        """
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
