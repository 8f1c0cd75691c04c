"""Log lines in ROS's console format; nothing is published on /rosout."""

from __future__ import annotations

import sys
import time
from contextlib import suppress
from enum import IntEnum
from functools import partialmethod
from typing import TextIO

from ...instants import NS


class LoggingSeverity(IntEnum):
    """Levels of a log line."""

    DEBUG = 10
    INFO = 20
    WARN = 30
    ERROR = 40
    FATAL = 50


_levels = {'': LoggingSeverity.INFO}
_outputs: dict[str, TextIO] = {}


def set_logger_output(name: str, output: TextIO | None) -> None:
    """Set where a logger writes; None for the standard error output."""
    if output is None:
        _outputs.pop(name, None)
    else:
        _outputs[name] = output


def set_logger_level(name: str, level: LoggingSeverity) -> None:
    """Set the lowest level that a logger writes; the empty name sets it for all."""
    _levels[name] = level


class Logger:
    """Writes `[LEVEL] [time] [name]: text` on the standard error output, or where it is told to."""

    def __init__(self, name: str) -> None:
        self.name = name

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
            output = _outputs.get(self.name, sys.stderr)
            output.write(line)
            output.flush()

    debug = partialmethod(_write, LoggingSeverity.DEBUG)
    info = partialmethod(_write, LoggingSeverity.INFO)
    warning = partialmethod(_write, LoggingSeverity.WARN)
    error = partialmethod(_write, LoggingSeverity.ERROR)
    fatal = partialmethod(_write, LoggingSeverity.FATAL)
