"""The present command to the table, and whether the table follows it."""

from __future__ import annotations

from dataclasses import replace

from ..plan import Step
from ..stream import Mode, Setpoint
from ..turntable import Table
from .encoders import Feedback
from .idle_watch import IdleWatch
from .rules import Rules
from .steps import held, setpoint_of
from .watch import Standing, Watch


class Orders:
    """The setpoint of the moment, from when it was sent on, and the watch on what comes of it.

    Args:
        plan: Name of the plan.
        table: Which table.
        rules: Tolerances.

    Attributes:
        revision: Changes with the setpoint.
        motion: The motion that was ordered last; None once the table was commanded to hold.
        turns_done: Turns at rate of the last motion, without sign.
        idle: What the table did while it was not led.

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

    def to_hold(self, current: Step | None, at: Feedback | None) -> Setpoint:
        """Return the setpoint that stops the table where it is, not yet stamped."""
        angles = None if at is None else at.angles
        return held(current, angles, self._plan, self._table)

    def hold(self, current: Step | None, at: Feedback | None) -> None:
        """Tell the table to hold; who watches it, and for what, stays as it is.

        Args:
            current: The step that is interrupted, where there is one.
            at: The last joint state, where there is one.

        """
        self._order(self.to_hold(current, at), None)

    def stop(self, current: Step | None, at: Feedback | None) -> None:
        """Tell the table to hold, and watch it come to rest; arguments as of `hold`."""
        led = isinstance(self._watch, Watch) or self._watch.led
        self.idle = IdleWatch(self._table, self._rules, at, led=led)
        self._watch = Standing(self._table, self._rules, at, led=led)
        self.hold(current, at)

    def move(self, motion: Step) -> None:
        """Tell the table to move; it is watched once that was sent."""
        self.turns_done = 0.0
        self._order(setpoint_of(motion, self._plan, self._table.names), motion)

    def stay(self, goal: tuple[float, ...], at: Feedback | None) -> None:
        """Watch that the table stays at (k,) angles, rad, at which it has arrived."""
        self._watch = Standing(self._table, self._rules, at)
        self._watch.keep(goal)

    def to_send(self, stamp: int, at: Feedback | None) -> Setpoint | None:
        """Return the setpoint of the moment, None before the first; it counts as sent now.

        Args:
            stamp: When it is sent, ns.
            at: The last joint state, where there is one: a motion is watched from there.

        """
        if self._setpoint is None:
            return None
        if not self._sent:
            self._sent = True
            if self.motion is not None and at is not None:
                self._watch = Watch(self._table, self._rules, self.motion, at)
        return replace(self._setpoint, stamp=stamp)

    @property
    def under_way(self) -> bool:
        """Whether the setpoint has left: what was measured before says nothing of what it does."""
        return self._sent

    def look(self, now: Feedback) -> tuple[bool, str]:
        """Return whether the motion is complete, and what is wrong, in a sentence."""
        there, fault = self._watch.look(now)
        if isinstance(self._watch, Watch):
            self.turns_done = self._watch.turns_done
        return there, fault

    def _order(self, setpoint: Setpoint, motion: Step | None) -> None:
        self._setpoint, self.motion, self._sent = setpoint, motion, False
        self.revision += 1
