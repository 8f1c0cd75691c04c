"""A table behind ros2_control: trajectories as goals of its joint_trajectory_controller."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from ...common.stream import Mode, Setpoint
from ..middleware import ActionClient, Node, actions
from ..middleware.running import GoalStatus
from ..plan_steps import Feedback, Lead, Overtaken
from ..sequencer import Sequencer
from .convert import trajectory_message
from .diagnostics import Diagnostics

_ANSWER_TIMEOUT = 0.5
"""s for the controller to accept a goal: the longest accepted silence of joint states, and shorter
than the second after which a table counts as stalled."""


class Controller:
    """Sends pieces of trajectories, each a goal that replaces the previous one.

    A goal that the controller rejects, aborts, does not answer, or cancels without a request is a
    fault; a replaced goal is not. If the controller does not follow a stop, its goal is cancelled:
    it then holds the table by itself.

    Args:
        node: turntable_node.
        name: Of the action, control_msgs/FollowJointTrajectory.
        sequencer: Runs the plan; receives faults.
        hold: Sends the sequencer's setpoint at once.
    """

    def __init__(
        self, node: Node, name: str, sequencer: Sequencer, hold: Callable[[], None]
    ) -> None:
        self._kind = actions.FollowJointTrajectory
        self._client = ActionClient(node, self._kind, name)
        self._name = node.resolve_service_name(name)
        self._sequencer, self._hold = sequencer, hold
        self._lead = Lead(sequencer.table)
        self._number = 0
        self._asked_at: float | None = None
        self._stops = False
        self._handle: Any = None
        self._last: Feedback | None = None
        self._seen_at = 0.0
        self._fault = ''

    @property
    def answered(self) -> bool:
        """Whether the controller has answered the last goal, or none was sent."""
        return self._asked_at is None

    def follow(self, setpoint: Setpoint, now: float) -> None:
        """Send the piece of trajectory that is due with a setpoint.

        Args:
            setpoint: The published setpoint.
            now: Steady time, s.
        """
        at = self._sequencer.feedback
        if at is None or not self._client.server_is_ready():
            return
        if at is not self._last:
            self._last, self._seen_at = at, now
        unseen = now - self._seen_at
        try:
            piece = self._lead.piece(setpoint, at, unseen)
        except Overtaken as error:
            self._sequencer.fail(str(error))
            setpoint = self._sequencer.hold(setpoint.stamp)
            piece = self._lead.piece(setpoint, at, unseen)
        if piece is None:
            return
        self._number += 1
        self._asked_at, self._stops = now, setpoint.mode is Mode.HOLD
        if not self._stops:
            self._fault = ''
        goal = self._kind.Goal(trajectory=trajectory_message(piece, self._sequencer.table.names))
        answer = self._client.send_goal_async(goal)
        answer.add_done_callback(partial(self._on_answer, self._number))

    def check(self, now: float, diagnostics: Diagnostics) -> None:
        """Detect a controller that is missing or does not answer; report its state.

        Args:
            now: Steady time, s.
            diagnostics: Receives the report.
        """
        missing = ''
        if not self._client.server_is_ready():
            missing = (
                f'No controller serves {self._name}: start a joint_trajectory_controller, or name '
                'its action by the parameter trajectory_action.'
            )
        self._sequencer.forbid('controller', missing, awaited=True)
        if self._asked_at is not None and now - self._asked_at > _ANSWER_TIMEOUT:
            self._asked_at = None
            self._fail(f'has not answered a goal within {_ANSWER_TIMEOUT:g} s')
        fine = 'The joint_trajectory_controller accepts goals.'
        diagnostics.report_fault('controller', missing or self._fault, fine)

    def _on_answer(self, number: int, future: Any) -> None:
        """Keep an accepted goal; a rejected one is a fault."""
        handle, newest = future.result(), number == self._number
        if newest:
            self._asked_at = None
        if handle.accepted:
            self._handle = handle
            handle.get_result_async().add_done_callback(partial(self._on_result, number))
        elif newest:
            self._fail('rejects a goal')

    def _on_result(self, number: int, future: Any) -> None:
        """Report a goal that did not end as requested as a fault."""
        answer = future.result()
        if answer.status == GoalStatus.SUCCEEDED:
            return
        result, kind = answer.result, self._kind.Result
        violated = {
            kind.PATH_TOLERANCE_VIOLATED: 'the path tolerance is violated',
            kind.GOAL_TOLERANCE_VIOLATED: 'the goal tolerance is violated',
        }.get(result.error_code)
        # A replaced goal may end in any way; a violated tolerance is a fault in any case.
        if violated is None and number != self._number:
            return
        cancelled = answer.status == GoalStatus.CANCELED
        ends = 'cancels a goal without being asked to' if cancelled else 'aborts a goal'
        words = ': '.join(filter(None, (violated, result.error_string)))
        self._fail(f'{ends}: {words}' if words else ends)

    def _fail(self, what: str) -> None:
        """Stop the table because of the controller."""
        self._fault = f'The controller of {self._name} {what}'.rstrip('.') + '.'
        if self._stops and self._handle is not None:
            # Without a goal the controller holds the table.
            self._handle.cancel_goal_async()
        self._sequencer.fail(self._fault)
        self._hold()
