"""Log lines as ROS writes them to the console; nothing goes to /rosout."""

from __future__ import annotations

import sys
import time
from enum import IntEnum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable


class LoggingSeverity(IntEnum):
    """Levels of a log line."""

    DEBUG = 10
    INFO = 20
    WARN = 30
    ERROR = 40
    FATAL = 50


default_level = LoggingSeverity.INFO
_levels: dict[str, LoggingSeverity] = {}
_throttled: dict[tuple[str, str], float] = {}


def set_logger_level(name: str, level: LoggingSeverity) -> None:
    """Set the lowest level that a logger writes."""
    _levels[name] = LoggingSeverity(level)


def _writes(severity: LoggingSeverity) -> Callable[..., bool]:
    """Return the method of one level; arguments and result are those of `Logger.log`."""

    def method(
        logger: Logger,
        message: str,
        *,
        once: bool = False,
        throttle_duration_sec: float | None = None,
    ) -> bool:
        return logger.log(message, severity, once=once, throttle_duration_sec=throttle_duration_sec)

    return method


class Logger:
    """Writes `[LEVEL] [time] [name]: text` on the standard error output."""

    def __init__(self, name: str) -> None:
        self.name = name

    def get_effective_level(self) -> LoggingSeverity:
        """Return the level of this logger or of the nearest above it."""
        name = self.name
        while name:
            if name in _levels:
                return _levels[name]
            name = name.rpartition('.')[0]
        return _levels.get('', default_level)

    def log(
        self,
        message: str,
        severity: LoggingSeverity,
        *,
        once: bool = False,
        throttle_duration_sec: float | None = None,
    ) -> bool:
        """Write a line.

        Args:
            message: Text.
            severity: Level.
            once: Write this text once only.
            throttle_duration_sec: Write from this place no more often than that.

        Returns:
            Whether it was written.

        """
        if severity < self.get_effective_level():
            return False
        if (once or throttle_duration_sec) and self._too_early(throttle_duration_sec):
            return False
        sec, nanosec = divmod(time.time_ns(), 1_000_000_000)
        line = f'[{severity.name}] [{sec}.{nanosec:09d}] [{self.name}]: {message}\n'
        sys.stderr.write(line)
        sys.stderr.flush()
        return True

    def _too_early(self, seconds: float | None) -> bool:
        # Like rclpy, the place in the code that logs is what is throttled, not its text.
        frame = sys._getframe(3)
        key = self.name, f'{frame.f_code.co_filename}:{frame.f_lineno}'
        last, now = _throttled.get(key), time.monotonic()
        if last is not None and (seconds is None or now - last < seconds):
            return True
        _throttled[key] = now
        return False

    debug = _writes(LoggingSeverity.DEBUG)
    info = _writes(LoggingSeverity.INFO)
    warning = _writes(LoggingSeverity.WARN)
    error = _writes(LoggingSeverity.ERROR)
    fatal = _writes(LoggingSeverity.FATAL)


def get_logger(name: str) -> Logger:
    """Return the logger of a name."""
    return Logger(name)
