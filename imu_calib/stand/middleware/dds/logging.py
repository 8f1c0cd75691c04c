"""Log lines in ROS's console format; nothing is published on /rosout."""

from __future__ import annotations

import sys
import time
from contextlib import suppress
from enum import IntEnum
from functools import partialmethod
from typing import IO

from ....common.stream import NS


class LoggingSeverity(IntEnum):
    """Levels of a log line."""

    DEBUG = 10
    INFO = 20
    WARN = 30
    ERROR = 40
    FATAL = 50


_levels = {'': LoggingSeverity.INFO}


def set_logger_level(name: str, level: LoggingSeverity) -> None:
    """Set the lowest level that a logger writes; the empty name sets it for all."""
    _levels[name] = level


class Logger:
    """Writes `[LEVEL] [time] [name]: text` to a file, None for the standard error output."""

    def __init__(self, name: str, output: IO[str] | None = None) -> None:
        self.name = name
        self._output = output

    def _level(self) -> LoggingSeverity:
        """Return the level of this logger or of its nearest ancestor with one."""
        name = self.name
        while name and name not in _levels:
            name = name.rpartition('.')[0]
        return _levels[name]

    def _write(self, severity: LoggingSeverity, message: str) -> None:
        if severity < self._level():
            return
        sec, nanosec = divmod(time.time_ns(), NS)
        line = f'[{severity.name}] [{sec}.{nanosec:09d}] [{self.name}]: {message}\n'
        # A closed terminal or pipe must not end a node that leads a table.
        with suppress(OSError):
            output = self._output or sys.stderr
            output.write(line)
            output.flush()

    debug = partialmethod(_write, LoggingSeverity.DEBUG)
    info = partialmethod(_write, LoggingSeverity.INFO)
    warning = partialmethod(_write, LoggingSeverity.WARN)
    error = partialmethod(_write, LoggingSeverity.ERROR)
    fatal = partialmethod(_write, LoggingSeverity.FATAL)
