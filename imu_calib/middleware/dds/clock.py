"""Time, durations and clocks with rclpy's names."""

from __future__ import annotations

import time
from enum import IntEnum
from typing import Any

from .messages import message_class

NS = 1_000_000_000
"""Of a second."""


class ClockType(IntEnum):
    """Which clock: ROS time (simulated where /clock says so), the system's, the steady one."""

    ROS_TIME = 1
    SYSTEM_TIME = 2
    STEADY_TIME = 3


class Duration:
    """A span of time in nanoseconds."""

    def __init__(self, *, seconds: float = 0, nanoseconds: int = 0) -> None:
        self.nanoseconds = int(seconds * NS) + int(nanoseconds)

    def to_msg(self) -> Any:
        """Return a builtin_interfaces/Duration."""
        sec, nanosec = divmod(self.nanoseconds, NS)
        return message_class('builtin_interfaces/msg/Duration')(sec=sec, nanosec=nanosec)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Duration) and self.nanoseconds == other.nanoseconds

    def __lt__(self, other: Duration) -> bool:
        return self.nanoseconds < other.nanoseconds

    def __le__(self, other: Duration) -> bool:
        return self.nanoseconds <= other.nanoseconds

    def __hash__(self) -> int:
        return hash(self.nanoseconds)

    def __repr__(self) -> str:
        return f'Duration(nanoseconds={self.nanoseconds})'


class Time:
    """A point in time in nanoseconds, of one clock."""

    def __init__(
        self,
        *,
        seconds: float = 0,
        nanoseconds: int = 0,
        clock_type: ClockType = ClockType.SYSTEM_TIME,
    ) -> None:
        self.nanoseconds = int(seconds * NS) + int(nanoseconds)
        self.clock_type = clock_type

    def to_msg(self) -> Any:
        """Return a builtin_interfaces/Time."""
        sec, nanosec = divmod(self.nanoseconds, NS)
        return message_class('builtin_interfaces/msg/Time')(sec=sec, nanosec=nanosec)

    def __add__(self, other: Duration) -> Time:
        return Time(nanoseconds=self.nanoseconds + other.nanoseconds, clock_type=self.clock_type)

    def __sub__(self, other: Any) -> Any:
        difference = self.nanoseconds - other.nanoseconds
        if isinstance(other, Duration):
            return Time(nanoseconds=difference, clock_type=self.clock_type)
        self._same_clock(other)
        return Duration(nanoseconds=difference)

    def _same_clock(self, other: Time) -> None:
        if self.clock_type != other.clock_type:
            raise TypeError("Can't compare times with different clock types")

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Time) and self.nanoseconds == other.nanoseconds

    def __lt__(self, other: Time) -> bool:
        self._same_clock(other)
        return self.nanoseconds < other.nanoseconds

    def __le__(self, other: Time) -> bool:
        self._same_clock(other)
        return self.nanoseconds <= other.nanoseconds

    def __hash__(self) -> int:
        return hash(self.nanoseconds)

    def __repr__(self) -> str:
        return f'Time(nanoseconds={self.nanoseconds}, clock_type={self.clock_type.name})'


class Clock:
    """A clock of one type; ROS time follows /clock while `simulated` holds a time."""

    def __init__(self, *, clock_type: ClockType = ClockType.SYSTEM_TIME) -> None:
        self.clock_type = clock_type
        self.simulated: int | None = None

    @property
    def ros_time_is_active(self) -> bool:
        """Whether this clock is driven by /clock."""
        return self.simulated is not None

    def nanoseconds(self) -> int:
        """Return the time as a number."""
        if self.clock_type is ClockType.STEADY_TIME:
            return time.monotonic_ns()
        if self.simulated is not None and self.clock_type is ClockType.ROS_TIME:
            return self.simulated
        return time.time_ns()

    def now(self) -> Time:
        """Return the time; zero before the first message of /clock where time is simulated."""
        return Time(nanoseconds=self.nanoseconds(), clock_type=self.clock_type)
