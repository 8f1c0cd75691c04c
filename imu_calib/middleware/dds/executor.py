"""Waits for messages and timers and calls back, in the thread that spins."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from .context import Context, get_default_context
from .participant import delete

if TYPE_CHECKING:
    from .future import Future
    from .node import Node

_SLICE = 50_000_000
"""Longest wait, ns: a signal's handler runs, and a cancelled spin ends, no later than that."""


class ExternalShutdownException(Exception):
    """The context was shut down while somebody spun."""


class SingleThreadedExecutor:
    """Runs the callbacks of its nodes one after the other.

    `spin_once` runs all that is ready rather than one callback, as rclpy does.
    """

    def __init__(self, *, context: Context | None = None) -> None:
        self._context = context or get_default_context()
        self._nodes: list[Node] = []
        self._waitset: Any = None
        self._never: Any = None
        self._waits_for: tuple[Any, ...] = ()
        self._shut = False

    def add_node(self, node: Node) -> bool:
        """Add a node; return whether it is new here."""
        if node in self._nodes:
            return False
        self._nodes.append(node)
        return True

    def remove_node(self, node: Node) -> None:
        """Leave a node alone from now on."""
        if node in self._nodes:
            self._nodes.remove(node)

    def get_nodes(self) -> list[Node]:
        """Return the nodes."""
        return list(self._nodes)

    def shutdown(self, timeout_sec: float | None = None) -> bool:  # noqa: ARG002 (rclpy's)
        """Stop for good."""
        self._shut = True
        self._forget()
        return True

    def spin(self) -> None:
        """Run callbacks until shutdown.

        Raises:
            ExternalShutdownException: The context is shut down.

        """
        while not self._shut:
            self.spin_once(timeout_sec=None)

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Run what is ready, waiting for it if need be.

        Args:
            timeout_sec: Longest wait, none or a negative one for ever.

        Raises:
            ExternalShutdownException: The context is shut down.

        """
        endless = timeout_sec is None or timeout_sec < 0
        end = time.monotonic_ns() + (0 if endless else int(timeout_sec * 1e9))  # type: ignore[operator]
        while not self._shut:
            if not self._context.ok():
                self._forget()
                raise ExternalShutdownException
            left = _SLICE if endless else end - time.monotonic_ns()
            if self._run_ready() or (not endless and left <= 0):
                return
            self._wait(min(left, _SLICE))

    def spin_until_future_complete(self, future: Future, timeout_sec: float | None = None) -> None:
        """Run callbacks until a future is done or the time is over."""
        end = None if timeout_sec is None or timeout_sec < 0 else time.monotonic() + timeout_sec
        while not future.done() and not self._shut:
            left = 0.05 if end is None else end - time.monotonic()
            if left <= 0:
                return
            self.spin_once(timeout_sec=min(left, 0.05))

    def _run_ready(self) -> bool:
        ready = False
        for node in list(self._nodes):
            if node in self._context.nodes:
                ready |= node.execute()
        return ready

    def _wait(self, nanoseconds: int) -> None:
        """Wait for a message, at most until the next timer."""
        from cyclonedds.core import DDSException

        for node in self._nodes:
            for timer in node.timers_:
                left = timer.time_until_next_call()
                if left is not None and not timer.clock.ros_time_is_active:
                    nanoseconds = min(nanoseconds, left)
        try:
            self._attach()
            if nanoseconds > 0:
                self._waitset.wait(nanoseconds)
        except DDSException:
            # Another thread has shut down, or destroyed an endpoint, in the meantime.
            self._forget()
            if self._context.ok() and not self._shut:
                raise

    def _attach(self) -> None:
        """Make the wait set anew where the readers have changed."""
        from cyclonedds.core import GuardCondition, WaitSet

        if self._context.participant is None:
            raise ExternalShutdownException
        participant = self._context.participant.entity
        conditions = tuple(c for node in self._nodes for c in node.conditions())
        if self._waitset is not None and (participant, *conditions) == self._waits_for:
            return
        self._forget()
        self._waitset = WaitSet(participant)
        # An empty wait set does not wait; this one always holds a condition that is never met.
        self._never = GuardCondition(participant)
        for condition in (self._never, *conditions):
            self._waitset.attach(condition)
        self._waits_for = (participant, *conditions)

    def _forget(self) -> None:
        if self._waitset is not None:
            delete(self._waitset)
            delete(self._never)
        self._waitset, self._never, self._waits_for = None, None, ()


_global: SingleThreadedExecutor | None = None


def _executor() -> SingleThreadedExecutor:
    global _global  # noqa: PLW0603 (the default executor, as in rclpy)
    if _global is None:
        _global = SingleThreadedExecutor()
    return _global


def spin_once(node: Node, *, timeout_sec: float | None = None) -> None:
    """Run what is ready of one node; see `SingleThreadedExecutor.spin_once`."""
    executor = _executor()
    executor.add_node(node)
    try:
        executor.spin_once(timeout_sec=timeout_sec)
    finally:
        executor.remove_node(node)


def spin(node: Node) -> None:
    """Run the callbacks of one node until shutdown."""
    while node.context.ok():
        spin_once(node, timeout_sec=None)


def spin_until_future_complete(
    node: Node,
    future: Future,
    executor: SingleThreadedExecutor | None = None,
    timeout_sec: float | None = None,
) -> None:
    """Run the callbacks of one node until a future is done or the time is over."""
    chosen = executor or _executor()
    chosen.add_node(node)
    try:
        chosen.spin_until_future_complete(future, timeout_sec)
    finally:
        chosen.remove_node(node)
