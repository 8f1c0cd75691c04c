"""Actions of ROS 2: three services and two topics below the action's name."""

from __future__ import annotations

import secrets
from functools import cache
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from ..shared import ENDS, GoalStatus
from .context import Future
from .message_types import message_class
from .qos import DurabilityPolicy, QoSProfile

if TYPE_CHECKING:
    from collections.abc import Callable

    from .node import Node


_KEPT = 16
"""Number of ended goals whose results may still be requested."""
_NONE, _REJECTED, _UNKNOWN, _TERMINATED = range(4)
"""Return codes of action_msgs/srv/CancelGoal."""


@cache
def action_type(name: str) -> Any:
    """Return an action's type, with Goal, Result and Feedback, by its full name."""

    def service(full: str) -> Any:
        return SimpleNamespace(
            Request=message_class(f'{full}_Request'), Response=message_class(f'{full}_Response')
        )

    return SimpleNamespace(
        **{part: message_class(f'{name}_{part}') for part in ('Goal', 'Result', 'Feedback')},
        Impl=SimpleNamespace(
            SendGoalService=service(f'{name}_SendGoal'),
            GetResultService=service(f'{name}_GetResult'),
            CancelGoalService=service('action_msgs/srv/CancelGoal'),
            FeedbackMessage=message_class(f'{name}_FeedbackMessage'),
        ),
    )


class ServerGoal:
    """A goal that was accepted; see `GoalServer`."""

    def __init__(self, server: GoalServer, identity: bytes, request: Any, stamp: Any) -> None:
        self._server = server
        self.identity = identity
        self.request = request
        self.stamp = stamp
        self.status = GoalStatus.EXECUTING
        self.answer = Future()

    @property
    def is_cancel_requested(self) -> bool:
        """Whether a client has requested to cancel it, and the request was accepted."""
        return self.status is GoalStatus.CANCELING

    def publish_feedback(self, feedback: Any) -> None:
        """Publish the progress of the goal."""
        self._server.publish_feedback(self, feedback)

    def end(self, status: GoalStatus, result: Any) -> None:
        """End it; clients receive its result.

        Args:
            status: One of `running.ENDS`; CANCELED only after a request to cancel, as in ROS.
            result: Of the action's type.
        """
        self._server.end(self, status, result)


class GoalServer:
    """Serves an action; a goal is executed from its acceptance until its `end` is called.

    Args:
        node: The node that serves.
        kind: The action's type.
        name: Of the action; relative, absolute or private.
        accept: Returns whether a goal is accepted.
        begin: Called with the accepted `ServerGoal`.
        cancel: Returns whether a goal will be cancelled.
    """

    def __init__(
        self,
        node: Node,
        kind: Any,
        name: str,
        *,
        accept: Callable[[Any], bool],
        begin: Callable[[ServerGoal], None],
        cancel: Callable[[ServerGoal], bool],
    ) -> None:
        self._node, self._kind = node, kind
        self._accept, self._begin, self._cancel = accept, begin, cancel
        self._goals: dict[bytes, ServerGoal] = {}
        self._array = message_class('action_msgs/msg/GoalStatusArray')
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        below = f'{name}/_action'
        self._feedback = node.create_publisher(kind.Impl.FeedbackMessage, f'{below}/feedback', 10)
        self._status = node.create_publisher(self._array, f'{below}/status', latched)
        impl = kind.Impl
        node.create_service(impl.SendGoalService, f'{below}/send_goal', self._on_goal)
        node.create_service(impl.CancelGoalService, f'{below}/cancel_goal', self._on_cancel)
        node.create_service(impl.GetResultService, f'{below}/get_result', self._on_result)

    def publish_feedback(self, goal: ServerGoal, feedback: Any) -> None:
        """Publish the progress of a goal."""
        message = self._kind.Impl.FeedbackMessage(feedback=feedback)
        message.goal_id.uuid = list(goal.identity)
        self._feedback.publish(message)

    def end(self, goal: ServerGoal, status: GoalStatus, result: Any) -> None:
        """End a goal."""
        goal.status = status
        response = self._kind.Impl.GetResultService.Response(status=int(status), result=result)
        goal.answer.set_result(response)
        ended = [k for k, g in self._goals.items() if g.status in ENDS]
        for identity in ended[:-_KEPT]:
            del self._goals[identity]
        self._publish_status()

    def _on_goal(self, request: Any, response: Any) -> Any:
        identity = bytes(request.goal_id.uuid)
        if identity in self._goals or not self._accept(request.goal):
            return response
        response.accepted = True
        response.stamp = self._node.get_clock().now().to_msg()
        goal = self._goals[identity] = ServerGoal(self, identity, request.goal, response.stamp)
        self._publish_status()
        self._begin(goal)
        return response

    def _on_cancel(self, request: Any, response: Any) -> Any:
        wanted = self._wanted(request.goal_info)
        active = [goal for goal in wanted if goal.status not in ENDS]
        agreed = [g for g in active if g.is_cancel_requested or self._cancel(g)]
        for goal in agreed:
            goal.status = GoalStatus.CANCELING
        response.goals_canceling = [self._info(goal) for goal in agreed]
        if agreed:
            self._publish_status()
            response.return_code = _NONE
        elif active:
            response.return_code = _REJECTED
        elif any(request.goal_info.goal_id.uuid):
            response.return_code = _TERMINATED if wanted else _UNKNOWN
        return response

    def _wanted(self, info: Any) -> list[ServerGoal]:
        """Return the goals that a cancel request selects, as action_msgs/srv/CancelGoal defines."""
        identity, until = bytes(info.goal_id.uuid), _seconds(info.stamp)
        if not any(identity) and until == (0, 0):
            return list(self._goals.values())
        return [
            goal
            for key, goal in self._goals.items()
            if key == identity or (until != (0, 0) and _seconds(goal.stamp) <= until)
        ]

    def _on_result(self, request: Any, response: Any) -> Any:
        """Answer with the result, now or later; for an unknown goal with status UNKNOWN."""
        goal = self._goals.get(bytes(request.goal_id.uuid))
        return response if goal is None else goal.answer

    def _info(self, goal: ServerGoal) -> Any:
        info = message_class('action_msgs/msg/GoalInfo')(stamp=goal.stamp)
        info.goal_id.uuid = list(goal.identity)
        return info

    def _publish_status(self) -> None:
        kind = message_class('action_msgs/msg/GoalStatus')
        listed = [kind(goal_info=self._info(g), status=int(g.status)) for g in self._goals.values()]
        self._status.publish(self._array(status_list=listed))


class ClientGoalHandle:
    """rclpy's class: a goal that a server has accepted or rejected."""

    def __init__(self, client: ActionClient, identity: bytes, response: Any) -> None:
        self._client = client
        self.identity = identity
        self.accepted = bool(response.accepted)
        self.stamp = response.stamp

    def get_result_async(self) -> Future:
        """Request the result; the future holds `status` and `result` when the goal has ended."""
        return self._client.ask_for_result(self.identity)

    def cancel_goal_async(self) -> Future:
        """Request to cancel it; the future holds the answer of the server."""
        return self._client.ask_to_cancel(self.identity)


class ActionClient:
    """rclpy's class without feedback: sends goals to a server."""

    def __init__(self, node: Node, kind: Any, name: str) -> None:
        self._kind = kind
        impl, below = kind.Impl, f'{name}/_action'
        self._send = node.create_client(impl.SendGoalService, f'{below}/send_goal')
        self._result = node.create_client(impl.GetResultService, f'{below}/get_result')
        self._cancel = node.create_client(impl.CancelGoalService, f'{below}/cancel_goal')

    def server_is_ready(self) -> bool:
        """Return whether the action has a server."""
        clients = (self._send, self._result, self._cancel)
        return all(client.service_is_ready() for client in clients)

    def send_goal_async(self, goal: Any) -> Future:
        """Send a goal; the future holds its `ClientGoalHandle` when the server has answered."""
        identity = secrets.token_bytes(16)
        request = self._kind.Impl.SendGoalService.Request(goal=goal)
        request.goal_id.uuid = list(identity)
        handle = Future()
        self._send.call_async(request).add_done_callback(
            lambda done: handle.set_result(ClientGoalHandle(self, identity, done.result()))
        )
        return handle

    def ask_for_result(self, identity: bytes) -> Future:
        """Request the result of a goal."""
        request = self._kind.Impl.GetResultService.Request()
        request.goal_id.uuid = list(identity)
        return self._result.call_async(request)

    def ask_to_cancel(self, identity: bytes) -> Future:
        """Request to cancel a goal."""
        request = self._kind.Impl.CancelGoalService.Request()
        request.goal_info.goal_id.uuid = list(identity)
        return self._cancel.call_async(request)


def _seconds(stamp: Any) -> tuple[int, int]:
    return stamp.sec, stamp.nanosec
