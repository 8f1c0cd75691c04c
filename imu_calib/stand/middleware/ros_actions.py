"""rclpy's action server, with goals that the node ends; see `dds.action`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy import get_global_executor
from rclpy.action import ActionServer, CancelResponse, GoalResponse

from .goals import GoalStatus


class ServerGoal:
    """A goal that was accepted; see `dds.action.ServerGoal`."""

    def __init__(self, server: _Server, handle: Any) -> None:
        self._server = server
        self._handle = handle
        self.request = handle.request

    @property
    def is_cancel_requested(self) -> bool:
        """Whether a client has requested to cancel it, and the request was accepted."""
        return bool(self._handle.is_cancel_requested)

    def publish_feedback(self, feedback: Any) -> None:
        """Publish the progress of the goal."""
        self._handle.publish_feedback(feedback)

    def end(self, status: GoalStatus, result: Any) -> None:
        """End it; clients receive its result when the node is spun."""

        def ended(handle: Any) -> Any:
            {
                GoalStatus.SUCCEEDED: handle.succeed,
                GoalStatus.CANCELED: handle.canceled,
                GoalStatus.ABORTED: handle.abort,
            }[status]()
            return result

        self._server.schedule(self._handle, ended)


class _Server(ActionServer):  # type: ignore[misc,unused-ignore]
    """Runs no execute callback: one that waits would block rclpy's executor."""

    def notify_execute(self, goal_handle: Any, execute_callback: Any) -> None:
        """Do nothing with a goal that begins."""
        if execute_callback is not None:
            super().notify_execute(goal_handle, execute_callback)

    def schedule(self, handle: Any, ended: Callable[[Any], Any]) -> None:
        """Let the executor end a goal."""
        node = self._node
        if node.executor is None:
            # The executor does not spin a node that ends; its owner spins it.
            get_global_executor().add_node(node)
        self.notify_execute(handle, ended)


class GoalServer:
    """Serves an action; see `dds.action.GoalServer`."""

    def __init__(
        self,
        node: Any,
        kind: Any,
        name: str,
        *,
        accept: Callable[[Any], bool],
        begin: Callable[[ServerGoal], None],
        cancel: Callable[[ServerGoal], bool],
    ) -> None:
        goals: dict[bytes, ServerGoal] = {}

        def accepted(handle: Any) -> None:
            goal = goals[bytes(handle.goal_id.uuid)] = ServerGoal(self._server, handle)
            handle.execute()
            begin(goal)

        def cancelled(handle: Any) -> CancelResponse:
            goal = goals[bytes(handle.goal_id.uuid)]
            return CancelResponse.ACCEPT if cancel(goal) else CancelResponse.REJECT

        self._server = _Server(
            node,
            kind,
            name,
            execute_callback=lambda _: None,
            goal_callback=lambda goal: GoalResponse.ACCEPT if accept(goal) else GoalResponse.REJECT,
            handle_accepted_callback=accepted,
            cancel_callback=cancelled,
        )
