"""Time and clocks with rclpy's names."""

from __future__ import annotations

import time
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Any

from ....common.stream import NS
from .message_types import message_class

if TYPE_CHECKING:
    from collections.abc import Callable


class ClockType(IntEnum):
    """Which clock: ROS time (simulated where /clock says so), the system's, the steady one."""

    ROS_TIME = 1
    SYSTEM_TIME = 2
    STEADY_TIME = 3


@dataclass(frozen=True)
class Time:
    """A point in time, in nanoseconds."""

    nanoseconds: int = 0

    def to_msg(self) -> Any:
        """Return a builtin_interfaces/Time."""
        sec, nanosec = divmod(self.nanoseconds, NS)
        return message_class('builtin_interfaces/msg/Time')(sec=sec, nanosec=nanosec)


class SteadyTime:
    """The steady time of the process: the system's, or that of a simulation in this process.

    A simulation that waits for nobody has no other steady time than its own steps: the same number
    of them passes between two events in every run.
    """

    def __init__(self) -> None:
        self._simulated: int | None = None

    @property
    def is_simulated(self) -> bool:
        """Whether a simulation in this process makes the time."""
        return self._simulated is not None

    def simulate(self, on: bool) -> None:
        """Begin or end to count what `advance` is told, not the system's time."""
        self._simulated = time.monotonic_ns() if on else None

    def advance(self, nanoseconds: int) -> None:
        """Let a simulated time pass; the system's passes by itself."""
        if self._simulated is not None:
            self._simulated += nanoseconds

    def nanoseconds(self) -> int:
        """Return the time."""
        return time.monotonic_ns() if self._simulated is None else self._simulated


STEADY = SteadyTime()


def in_step() -> bool:
    """Return whether all nodes are in this process, in step with a simulation.

    Nothing in it needs to wait for the wall clock then, and what a node does in a thread of its own
    it does in turn: every run is the same.
    """
    return STEADY.is_simulated


class Clock:
    """A clock of one type; ROS time follows /clock while `simulated` holds a time.

    Attributes:
        of_the_wall: Whether steady time is the system's even beside a simulation in this process.
    """

    def __init__(
        self, *, clock_type: ClockType = ClockType.SYSTEM_TIME, of_the_wall: bool = False
    ) -> None:
        self.clock_type = clock_type
        self.simulated: int | None = None
        self.of_the_wall = of_the_wall

    @property
    def ros_time_is_active(self) -> bool:
        """Whether this clock is driven by /clock."""
        return self.simulated is not None

    def nanoseconds(self) -> int:
        """Return the time as a number."""
        if self.clock_type is ClockType.STEADY_TIME:
            return time.monotonic_ns() if self.of_the_wall else STEADY.nanoseconds()
        if self.simulated is not None and self.clock_type is ClockType.ROS_TIME:
            return self.simulated
        return time.time_ns()

    def now(self) -> Time:
        """Return the time; zero before the first message of /clock where time is simulated."""
        return Time(self.nanoseconds())


# Timers on any clock.


class Timer:
    """Calls back once per period of its clock; missed calls are skipped."""

    def __init__(self, period_ns: int, callback: Callable[[], Any], clock: Clock) -> None:
        self.timer_period_ns = period_ns
        self.callback = callback
        self.clock = clock
        self._cancelled = False
        self._last = clock.nanoseconds()
        self._next = self._last + period_ns

    def cancel(self) -> None:
        """Stop the timer."""
        self._cancelled = True

    def reset(self) -> None:
        """Restart: the next call is one period from now."""
        self._cancelled = False
        self._last = self.clock.nanoseconds()
        self._next = self._last + self.timer_period_ns

    def time_until_next_call(self) -> int | None:
        """Return nanoseconds, None if it is stopped."""
        return None if self._cancelled else self._next - self.clock.nanoseconds()

    def execute(self) -> bool:
        """Call back if it is due; return whether it was."""
        now = self.clock.nanoseconds()
        if now < self._last:
            # The clock jumped back: simulated time restarted.
            self._next = now + self.timer_period_ns
        self._last = now
        if self._cancelled or now < self._next:
            return False
        behind = (now - self._next) // max(1, self.timer_period_ns)
        self._next += (behind + 1) * self.timer_period_ns
        self.callback()
        return True


# A result that comes later.


class Future:
    """rclpy's Future without await, exceptions and cancelling."""

    def __init__(self) -> None:
        self._done = False
        self._result: Any = None
        self._callbacks: list[Callable[[Future], Any]] = []

    def done(self) -> bool:
        """Return whether the result is available."""
        return self._done

    def result(self) -> Any:
        """Return the result, None before it is available."""
        return self._result

    def set_result(self, result: Any) -> None:
        """Set the result."""
        self._result, self._done = result, True
        callbacks, self._callbacks = self._callbacks, []
        for callback in callbacks:
            callback(self)

    def add_done_callback(self, callback: Callable[[Future], Any]) -> None:
        """Call back with this future when it is done, or now if it is."""
        if self._done:
            callback(self)
        else:
            self._callbacks.append(callback)
