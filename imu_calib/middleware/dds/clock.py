"""Time and clocks with rclpy's names."""

from __future__ import annotations

import time
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from ...instants import NS
from .message_classes import message_class


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
        return Time(self.nanoseconds())
