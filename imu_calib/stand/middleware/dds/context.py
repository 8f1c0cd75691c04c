"""State of a process: the DDS participant, the arguments, the graph."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from enum import IntEnum
from functools import partialmethod
from typing import IO, TYPE_CHECKING, Any, TypeAlias

from ....common.errors import ImuCalibError
from ....common.stream import NS
from ...network import refuse_to_pretend, runtime
from ..running import domain_id
from . import memory
from .arguments import Arguments, parse
from .graph import Graph
from .wire import WireParticipant

if TYPE_CHECKING:
    from collections.abc import Sequence

# Log lines in ROS's console format; nothing is published on /rosout.


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


AnyParticipant: TypeAlias = WireParticipant | memory.Participant


class Context:
    """One participant, shared by the nodes of a process, from init to shutdown.

    It is in a domain of DDS, or in this process alone if the runtime is `embedded`.
    """

    def __init__(self) -> None:
        self.arguments = Arguments()
        self.participant: AnyParticipant | None = None
        self.graph: Graph | memory.Graph
        self.nodes: list[Any] = []
        self.works: list[Any] = []
        self.log: IO[str] | None = None

    def ok(self) -> bool:
        """Return whether the context is between init and shutdown."""
        return self.participant is not None

    def init(self, args: Sequence[str] | None = None) -> None:
        """Join the domain.

        Raises:
            ImuCalibError: It has joined before; an argument is wrong; the domain is out of range;
                Cyclone DDS cannot join.
        """
        if self.ok():
            raise ImuCalibError('init() is called twice without shutdown().')
        self.arguments = parse(sys.argv[1:] if args is None else args)
        for logger, level in self.arguments.levels:
            set_logger_level(logger, _severity(level))
        if runtime() == 'embedded':
            self.participant = memory.Participant()
            self.graph = memory.Graph(self.participant)
            return
        refuse_to_pretend()
        self.participant = joined = WireParticipant(domain_id())
        self.graph = Graph(joined)

    @contextmanager
    def given(self, args: Sequence[str], log: IO[str]) -> Iterator[None]:
        """Give the nodes made in this block arguments and a log of their own."""
        former, self.arguments, self.log = self.arguments, parse(args), log
        try:
            yield
        finally:
            self.arguments, self.log = former, None

    def joined(self) -> AnyParticipant:
        """Return the participant.

        Raises:
            ImuCalibError: It is not, or no longer, in the domain.
        """
        if self.participant is None:
            raise ImuCalibError('The context is shut down, or init() was not called.')
        return self.participant

    def announce(self) -> None:
        """Announce the nodes and endpoints of this participant to the others."""
        self.graph.announce(self.nodes)

    def shutdown(self) -> None:
        """Destroy the nodes and leave the domain; do nothing after that."""
        if self.participant is None:
            return
        for node in list(self.nodes):
            node.destroy_node()
        self.graph.close()
        self.works.clear()
        # ok() must turn false first for a thread that spins.
        former, self.participant = self.participant, None
        former.leave()


def _severity(text: str) -> LoggingSeverity:
    try:
        return LoggingSeverity[text.upper()]
    except KeyError:
        known = ', '.join(s.name.lower() for s in LoggingSeverity)
        raise ImuCalibError(f'--log-level {text!r}, expected one of {known}.') from None


CONTEXT = Context()
"""The context of this process."""


def init(*, args: Sequence[str] | None = None) -> None:
    """Join the domain; arguments as rclpy's, errors as `Context.init`."""
    CONTEXT.init(args)


def ok() -> bool:
    """Return whether the process is between init and shutdown."""
    return CONTEXT.ok()


def shutdown() -> None:
    """Destroy all nodes and leave the domain.

    Raises:
        ImuCalibError: init was not called, or shutdown was.
    """
    if not CONTEXT.ok():
        raise ImuCalibError('shutdown() without init().')
    CONTEXT.shutdown()


def try_shutdown() -> None:
    """Shut down unless that is done."""
    CONTEXT.shutdown()
