"""Waits for messages and timers and runs callbacks: of one node, or of all in one process."""

from __future__ import annotations

import math
import time
import traceback
from typing import IO, TYPE_CHECKING, Any, TypeAlias

from ..shared import Work, WorkerThread, guarded
from . import memory
from .context import CONTEXT, STEADY, init, try_shutdown
from .wire import TransportError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

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
        """Run what is ready, after waiting for it at most so many s; None or negative: unlimited.

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


# All nodes of a stand in one process and one thread, as ROS composes nodes in a container.


_STEP = 20_000_000
"""ns of simulated steady time per step of the simulation. A choice: every timer that reads data is
due at each step, and reviews and reports, once a second, are not most of the work."""
_PACED_STEP = 100_000_000
"""ns of it per step that waited for the wall clock: that of a simulation in real time."""
_LONGEST_WAIT = 0.05
"""s: the latest time for a signal to be noticed."""


class Hosted:
    """A node in the container."""

    def __init__(self, node: Any, log: IO[str]) -> None:
        self.node = node
        self.failure = ''  #: Why it has ended; empty while it runs.
        self._log = log

    def run(self) -> bool:
        """Run what is ready; return whether there was anything. An error ends the node."""
        if self.failure:
            return False
        ran = False
        try:
            for one in self.node.awaited():
                if one.reader.waiting and not one.destroyed:
                    ran |= one.execute(_CALLBACKS_PER_ROUND)
            ran |= self.node.run_timers()
        except Exception as error:
            self.fail(error)
        return ran

    def fail(self, error: Exception) -> None:
        """End the node for an error: it sends its last messages, as at any end."""
        self.failure = f'{type(error).__name__}: {error}'
        traceback.print_exception(error, file=self._log)
        self.end()

    def end(self) -> None:
        """Let the node send its last messages, and remove it."""
        try:
            stop = getattr(self.node, 'stop', None)
            if stop is not None:
                stop()
        except Exception as error:
            traceback.print_exception(error, file=self._log)
        finally:
            self.node.destroy_node()


class Container:
    """Nodes that share a thread; messages between them are handed on in memory.

    Args:
        in_step: Whether a simulation as fast as its nodes makes the time: its steps are then the
            steady time of the nodes, and a session is the same in every run.
    """

    def __init__(self, *, in_step: bool) -> None:
        self._hosted: dict[str, Hosted] = {}
        self._rested = False
        init(args=[])
        participant = CONTEXT.joined()
        assert isinstance(participant, memory.Participant), 'the runtime is not the embedded one'
        self._arrived = participant.arrived
        STEADY.simulate(in_step)

    def load(self, name: str, factory: Callable[[], Any], args: Sequence[str], log: IO[str]) -> Any:
        """Create a node of a name with arguments of --ros-args, and return it."""
        before = list(CONTEXT.nodes)
        with CONTEXT.given(args, log):
            try:
                node = factory()
            except Exception:
                # What it had made by then would still be in the graph.
                for half in [one for one in CONTEXT.nodes if one not in before]:
                    half.destroy_node()
                raise
        self._hosted[name] = Hosted(node, log)
        return node

    def failure(self, name: str) -> str:
        """Return why a node has ended; empty while it runs."""
        return self._hosted[name].failure

    def unload(self, name: str) -> None:
        """End a node; the others take its last messages."""
        hosted = self._hosted.pop(name)
        if not hosted.failure:
            hosted.end()
            self._run_ready()

    def spin(self, seconds: float) -> None:
        """Run what is ready, and the simulation, for a time of the wall clock."""
        until = time.monotonic() + seconds
        while True:
            self._run_ready()
            rest = self._work()
            remaining = until - time.monotonic()
            if remaining <= 0:
                return
            if rest > 0:
                self._wait(min(rest, remaining))

    def shutdown(self) -> None:
        """End the nodes in reverse order of their start, and the context."""
        for name in reversed(list(self._hosted)):
            self.unload(name)
        STEADY.simulate(False)
        try_shutdown()

    def _run_ready(self) -> None:
        """Run callbacks and timers until no message waits."""
        ran = True
        while ran:
            ran = False
            # What comes from now on is either found below, or ends the next wait at once.
            self._arrived.clear()
            for hosted in list(self._hosted.values()):
                ran |= hosted.run()

    def _work(self) -> float:
        """Let the simulation take its step; return the wait until there is something to do, s."""
        rests: list[float] = [
            rest for work in list(CONTEXT.works) if (rest := work.run()) is not None
        ]
        if 0.0 in rests:
            STEADY.advance(_PACED_STEP if self._rested else _STEP)
            self._rested = False
            return 0.0
        self._rested = True
        return min([*rests, self._next_timer()])

    def _next_timer(self) -> float:
        """Return the wait until the next timer is due, s."""
        due: list[float] = [
            remaining
            for hosted in self._hosted.values()
            if not hosted.failure
            for timer in hosted.node.timers_
            if (remaining := timer.time_until_next_call()) is not None
        ]
        return max(0.0, min([*due, _LONGEST_WAIT * 1e9]) * 1e-9)

    def _wait(self, seconds: float) -> None:
        """Wait for a message."""
        self._arrived.wait(min(seconds, _LONGEST_WAIT))


class WorkInTurn:
    """Work that the container calls when no message waits; see `WorkerThread`."""

    def __init__(self, work: Work) -> None:
        self._work = work
        self._due = 0.0
        self._done = False
        CONTEXT.works.append(self)

    def run(self) -> float | None:
        """Work if it is time; return the seconds until the next time, None when it is done."""
        if self._done:
            return None
        rest = self._due - time.monotonic()
        if rest > 0:
            return rest
        found = self._work()
        self._done = found is None
        self._due = time.monotonic() + found if found else 0.0
        return found

    def wait_until_done(self, patience: float) -> None:
        """Work until it is done, at most so many seconds."""
        end = time.monotonic() + patience
        while (rest := self.run()) is not None and time.monotonic() < end:
            time.sleep(rest)
        if self in CONTEXT.works:
            CONTEXT.works.remove(self)


def run_beside(node: Any, work: Work, name: str) -> WorkerThread | WorkInTurn:
    """Call a function again and again, beside the callbacks of a node; see `WorkerThread`."""
    if isinstance(CONTEXT.participant, memory.Participant):
        return WorkInTurn(guarded(node, work, name))
    return WorkerThread(node, work, name)
