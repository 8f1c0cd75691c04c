"""What a process shares: the DDS participant, the arguments, the state of the graph."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

from ...errors import ImuCalibError
from ...security import refuse_to_pretend
from ..domain import LAST_DOMAIN, domain_id
from . import logging
from .arguments import Arguments, parse
from .graph import Graph
from .participant import Participant

if TYPE_CHECKING:
    from collections.abc import Sequence


class Context:
    """One DDS participant, shared by the nodes of a process, from init to shutdown."""

    def __init__(self) -> None:
        self.arguments = Arguments()
        self.participant: Participant | None = None
        self.graph: Graph
        self.nodes: list[Any] = []

    def ok(self) -> bool:
        """Tell whether it stands between init and shutdown."""
        return self.participant is not None

    def init(self, args: Sequence[str] | None = None, domain: int | None = None) -> None:
        """Join the domain.

        Raises:
            ImuCalibError: Joined before; a wrong argument; a domain that is out of range;
                Cyclone DDS cannot join.

        """
        if self.ok():
            raise ImuCalibError('init() is called twice without shutdown().')
        self.arguments = parse(sys.argv[1:] if args is None else args)
        for logger, level in self.arguments.levels:
            logging.set_logger_level(logger, _severity(level))
        refuse_to_pretend()
        number = domain_id() if domain is None else domain
        if not 0 <= number <= LAST_DOMAIN:
            raise ImuCalibError(f'The domain is {number}, expected 0 to {LAST_DOMAIN}.')
        self.participant = Participant(number)
        self.graph = Graph(self.participant)

    def joined(self) -> Participant:
        """Return the participant.

        Raises:
            ImuCalibError: It is not yet, or no longer, in the domain.

        """
        if self.participant is None:
            raise ImuCalibError('The context is shut down, or init() was not called.')
        return self.participant

    def announce(self) -> None:
        """Tell the other participants which nodes and endpoints are in this one."""
        self.graph.announce(self.nodes)

    def shutdown(self) -> None:
        """Destroy the nodes and leave the domain; nothing where that is done."""
        if self.participant is None:
            return
        for node in list(self.nodes):
            node.destroy_node()
        self.graph.close()
        # Who spins in another thread sees ok() turn false first.
        left, self.participant = self.participant, None
        left.leave()


def _severity(text: str) -> logging.LoggingSeverity:
    try:
        return logging.LoggingSeverity[text.upper()]
    except KeyError:
        known = ', '.join(s.name.lower() for s in logging.LoggingSeverity)
        raise ImuCalibError(f'--log-level {text!r}, expected one of {known}.') from None


_default = Context()


def get_default_context() -> Context:
    """Return the context of init() and shutdown() without arguments."""
    return _default


def init(
    *,
    args: Sequence[str] | None = None,
    context: Context | None = None,
    domain_id: int | None = None,
    signal_handler_options: Any = None,  # noqa: ARG001 (no handlers are installed here)
) -> None:
    """Join the domain; arguments as rclpy's, errors as `Context.init`."""
    (context or _default).init(args, domain_id)


def ok(*, context: Context | None = None) -> bool:
    """Tell whether a context stands between init and shutdown."""
    return (context or _default).ok()


def shutdown(*, context: Context | None = None, uninstall_handlers: bool | None = None) -> None:  # noqa: ARG001
    """Destroy all nodes and leave the domain.

    Raises:
        ImuCalibError: init was not called, or shutdown before.

    """
    chosen = context or _default
    if not chosen.ok():
        raise ImuCalibError('shutdown() without init().')
    chosen.shutdown()


def try_shutdown(*, context: Context | None = None, uninstall_handlers: bool | None = None) -> None:  # noqa: ARG001
    """Shut down where that is not done yet."""
    (context or _default).shutdown()
