"""Remaining steps of a plan, their order and duration."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence

import numpy as np

from ..session.plan import Plan, Step
from ..session.table import Table
from .rules import Rules
from .steps import end_of, motion_time, steps_of_plan


class Itinerary:
    """The steps of a plan from the table's present position, and the way back there.

    Attributes:
        current: The current or next step; None before the plan is laid out.
    """

    def __init__(self, plan: Plan, table: Table, rules: Rules) -> None:
        self._plan = plan
        self._table = table
        self._rules = rules
        self._steps: tuple[Step, ...] = ()
        self._return_step: Step | None = None
        self._queue: deque[Step] = deque()
        self._repeated: Counter[int] = Counter()
        self._times: dict[str | int, float] = {}
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
        """Recompute the steps.

        Args:
            angles: Present angles of the table, rad.

        Raises:
            InputError: The steps are beyond the table's limits.
        """
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

    def take(self) -> Step | None:
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
