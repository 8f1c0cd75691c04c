"""A managed node: rclpy's, which may start by itself."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn

from ...common.errors import ImuCalibError


class ManagedNode(LifecycleNode):  # type: ignore[misc,unused-ignore]
    """A node with the states of ROS 2 (design.ros2.org/articles/node_lifecycle.html).

    Subclasses implement four steps without arguments: `configure`, `activate`, `deactivate` and
    `cleanup`. If a step raises ImuCalibError, it fails and the node keeps its state.
    """

    def __init__(self, node_name: str) -> None:
        super().__init__(node_name)
        self._wrong: ImuCalibError | None = None
        self._begins = False
        # rclpy ends the process at a request for a transition that the state does not have.
        self._change_state = self._service_change_state.callback
        self._service_change_state.callback = self._on_change_state

    def _on_change_state(self, request: Any, response: Any) -> Any:
        try:
            return self._change_state(request, response)
        except rclpy_implementation.RCLError as error:
            self.get_logger().warning(f'A change of state is refused: {error}')
            response.success = False
            return response

    def configure(self) -> None:
        """Read what is needed; open and publish nothing."""

    def activate(self) -> None:
        """Start working."""

    def deactivate(self) -> None:
        """Stop working."""

    def cleanup(self) -> None:
        """Discard what was read."""

    def begin(self, *, autostart: bool) -> None:
        """Configure and activate, unless a lifecycle manager does so.

        Raises:
            ImuCalibError: As the step that fails.
        """
        if not autostart:
            return
        self._begins = True
        for trigger in (self.trigger_configure, self.trigger_activate):
            if trigger() is not TransitionCallbackReturn.SUCCESS:
                raise self._wrong or ImuCalibError('A transition failed; the log says why.')
        self._begins = False

    def on_configure(self, state: Any) -> Any:  # noqa: ARG002
        """Run `configure` for rclpy."""
        return self._try(self.configure)

    def on_activate(self, state: Any) -> Any:
        """Run `activate` for rclpy."""
        super().on_activate(state)
        return self._try(self.activate)

    def on_deactivate(self, state: Any) -> Any:
        """Run `deactivate` for rclpy."""
        super().on_deactivate(state)
        return self._try(self.deactivate)

    def on_cleanup(self, state: Any) -> Any:  # noqa: ARG002
        """Run `cleanup` for rclpy."""
        return self._try(self.cleanup)

    def on_shutdown(self, state: Any) -> Any:
        """Stop all work for rclpy."""
        if state.label == 'active':
            self.deactivate()
        return TransitionCallbackReturn.SUCCESS

    def _try(self, step: Callable[[], None]) -> TransitionCallbackReturn:
        try:
            step()
        except ImuCalibError as error:
            self._wrong = error
            if not self._begins:
                self.get_logger().error(str(error))
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS
