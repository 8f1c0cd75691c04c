"""Waits for messages and timers and runs callbacks, in the thread that spins."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, Any, TypeAlias

from .context import CONTEXT
from .wire import TransportError

if TYPE_CHECKING:
    from .context import AnyParticipant, Future
    from .endpoints import Client, Service, Subscription
    from .node import Node

    _Awaited: TypeAlias = Subscription | Service | Client

_SLICE = 50_000_000
"""Longest wait, ns: the latest time for a signal's handler to run or a cancelled spin to end."""

_CALLBACKS_PER_ROUND = 64
"""Messages of one subscription per turn; then the others and the timers follow."""


class ExternalShutdownException(Exception):
    """The context was shut down during a spin."""


class SingleThreadedExecutor:
    """Runs the callbacks of its nodes one after the other.

    `spin_once` runs everything that is ready; rclpy runs one callback.
    """

    def __init__(self) -> None:
        self._nodes: list[Node] = []
        self._waitset: Any | None = None
        self._participant: AnyParticipant | None = None
        self._awaited: list[_Awaited] = []
        self._shut = False

    def add_node(self, node: Node) -> bool:
        """Add a node; return whether it is new."""
        if node in self._nodes:
            return False
        self._nodes.append(node)
        return True

    def remove_node(self, node: Node) -> None:
        """Stop serving a node."""
        if node in self._nodes:
            self._nodes.remove(node)

    def shutdown(self, timeout_sec: float | None = None) -> bool:  # noqa: ARG002 (rclpy's)
        """Stop permanently."""
        self._shut = True
        self._forget()
        return True

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Run what is ready, after waiting for it if needed.

        Args:
            timeout_sec: Longest wait, s; None or negative: unlimited.

        Raises:
            ExternalShutdownException: The context is shut down.
        """
        endless = timeout_sec is None or timeout_sec < 0
        end = time.monotonic_ns() + (0 if endless else int(timeout_sec * 1e9))  # type: ignore[operator]
        while not self._shut:
            if not CONTEXT.ok():
                self._forget()
                raise ExternalShutdownException
            remaining = _SLICE if endless else min(end - time.monotonic_ns(), _SLICE)
            if self._run(self._wait(remaining)) or (not endless and remaining <= 0):
                return

    def _run(self, ready: list[_Awaited]) -> bool:
        """Run callbacks of ready endpoints and of due timers; return whether there were any."""
        ran = False
        for one in ready:
            # A callback may have destroyed the next one.
            if not one.destroyed:
                ran |= one.execute(_CALLBACKS_PER_ROUND)
        for node in list(self._nodes):
            if node in CONTEXT.nodes:
                ran |= node.run_timers()
        return ran

    def _wait(self, nanoseconds: int) -> list[_Awaited]:
        """Wait for messages, at most until the next timer; return the endpoints with messages."""
        for node in self._nodes:
            for timer in node.timers_:
                remaining = timer.time_until_next_call()
                # Simulated time advances by a message; a timer that is due is due on any clock.
                if remaining is not None and (remaining <= 0 or not timer.clock.ros_time_is_active):
                    nanoseconds = min(nanoseconds, remaining)
        try:
            waitset = self._attached()
            ready = waitset.wait(max(0, nanoseconds))
            return [self._awaited[k] for k in ready]
        except TransportError:
            # Another thread has shut down or destroyed an endpoint.
            self._forget()
            if CONTEXT.ok() and not self._shut:
                raise
            return []

    def _attached(self) -> Any:
        """Return the wait set; create a new one if the readers have changed."""
        participant: Any = CONTEXT.participant
        if participant is None:
            raise ExternalShutdownException
        awaited = [one for node in self._nodes for one in node.awaited()]
        if self._waitset is None or (participant, awaited) != (self._participant, self._awaited):
            self._forget()
            self._waitset = participant.wait_set([one.reader for one in awaited])
            self._participant, self._awaited = participant, awaited
        return self._waitset

    def _forget(self) -> None:
        if self._waitset is not None:
            self._waitset.delete()
        self._waitset, self._participant, self._awaited = None, None, []


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
    while CONTEXT.ok():
        spin_once(node, timeout_sec=None)


def spin_until_future_complete(
    node: Node, future: Future, *, timeout_sec: float | None = None
) -> None:
    """Run the callbacks of one node until a future is done or the time has passed."""
    end = math.inf if timeout_sec is None else time.monotonic() + timeout_sec
    while not future.done() and (remaining := end - time.monotonic()) > 0:
        spin_once(node, timeout_sec=min(remaining, 0.05))
