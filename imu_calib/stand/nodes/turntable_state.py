"""turntable/state of the node that runs the plan, as the calibrator receives it."""

from __future__ import annotations

import math
from typing import Any

from ...common.stream import NS
from ...session.plan import Plan
from ..middleware import Node, messages
from ..rules import Phase
from .diagnostics import Diagnostics, Level
from .done import DoneCheck
from .publishers import OnePublisher
from .sessions import Sessions

STATE_TYPE = 'imu_calib_msgs/msg/TurntableState'

_RUNS = frozenset(phase for phase in Phase if phase.at_a_step)


class TurntableStateIntake:
    """Passes to sessions whether the table runs, is done, or runs another plan; records the state.

    Args:
        node: The node that subscribes.
        plan: Name of the plan that is calibrated.
        steps: Number of its steps.
        diagnostics: Receives the reason why a DONE is not accepted.

    Attributes:
        topic: Full name.
        seconds_left: Remaining time of the plan as the table states, s; else NaN.
        phase: Of the table, a constant of TurntableState; None before the first message.
    """

    def __init__(self, node: Node, plan: Plan, steps: int, diagnostics: Diagnostics) -> None:
        self.topic = node.resolve_topic_name('turntable/state')
        self.seconds_left = math.nan
        self.phase: int | None = None
        self._plan = plan
        self._diagnostics = diagnostics
        self._publisher = OnePublisher(node, self.topic)
        self._done = DoneCheck(plan.name, steps)
        self._unrecorded: list[bytes] = []

    def keep(self, payload: bytes) -> None:
        """Keep a serialised message for recording."""
        self._unrecorded.append(payload)

    def record(self, sessions: Sessions, now: int) -> None:
        """Record the messages received since the last call, at `now`, host time in ns."""
        for payload in self._unrecorded:
            sessions.record(self.topic, STATE_TYPE, payload, now)
        self._unrecorded.clear()

    def check_publishers(self, now: float) -> None:
        """Check its publishers at a time of the steady clock, s."""
        self._publisher.fault(now)

    def take(self, state: Any, sessions: Sessions, now: float) -> bool:
        """Take a message after all earlier data; return whether it ended the sessions.

        Args:
            state: imu_calib_msgs/TurntableState.
            sessions: The sessions it concerns.
            now: Of the steady clock, s.
        """
        if state.plan and state.plan != self._plan.name:
            for session in sessions.all:
                session.fail(
                    f'The table runs plan {state.plan}, this calibrator expects {self._plan.name}.'
                )
            return True
        self.seconds_left, self.phase = float(state.seconds_left), state.phase
        if state.phase != messages.TurntableState.DONE:
            self._done.deny()
            for session in sessions.all:
                session.table_running()
            return False
        refusal = self._done.refusal(
            state.plan,
            state.steps,
            max(session.steps_seen for session in sessions.all),
            alone=self._publisher.is_alone(now),
        )
        if not refusal and self._done.is_repeated:
            stamp = state.header.stamp
            for session in sessions.all:
                session.table_done(stamp.sec * NS + stamp.nanosec)
        text = f'{self.topic} reports DONE, which is ignored: {refusal}.'
        self._diagnostics.report(
            'turntable state',
            Level.WARN if refusal else Level.OK,
            text if refusal else f'{self.topic} says DONE.',
        )
        return False

    @property
    def runs(self) -> bool:
        """Whether the table is at a step of the plan."""
        return self.phase in _RUNS

    @property
    def paused(self) -> bool:
        """Whether the plan is interrupted, and may be resumed."""
        return self.phase == Phase.PAUSED
