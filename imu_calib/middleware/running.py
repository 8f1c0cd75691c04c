"""A node's life from init to shutdown, with a last word when a signal ends it."""

from __future__ import annotations

import math
import signal
import threading
import time
from typing import TYPE_CHECKING, Any, Protocol

from .chosen import (
    ExternalShutdownException,
    acknowledged,
    init,
    ok,
    spin_once,
    try_shutdown,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence


class Stoppable(Protocol):
    """A node with a last word."""

    def stop(self) -> Sequence[Any]:
        """Publish the last messages; return the publishers whose peers must have them."""


class _Flag:
    """Whether a signal has come.

    No threading.Event: a second signal that comes while the first one's handler holds the lock of
    the event would wait for it for ever.
    """

    def __init__(self) -> None:
        self.is_set = False

    def set(self, *_: Any) -> None:
        """Take a signal."""
        self.is_set = True


_TICK = 0.05
"""s that a node waits for events before it looks whether it is to end."""
_LAST_WORD = 2.0
"""s for readers to acknowledge the last messages as a node ends; a choice."""
_LOOK_AROUND = 2.0
"""s between two looks at whether the network is still there."""


def run(
    node_factory: Callable[[], Any],
    *,
    args: Sequence[str] | None = None,
    done: Callable[[Any], bool] | None = None,
    ends: bool = False,
) -> bool:
    """Spin a node until SIGINT, SIGTERM, shutdown, or until it is done.

    The signal's handler sets a flag only. Then `node.stop()`, where the node has it, publishes its
    last messages and returns their publishers; these are waited for until their subscriptions have
    acknowledged, and only then is the node destroyed and the middleware shut down.

    Args:
        node_factory: Makes the node, after init.
        args: Command line with --ros-args; none for that of the process.
        done: Asked with the node after each round; true ends the run.
        ends: Whether the process ends with the run: it is then not cut short by a signal that comes
            later, SIGTERM after SIGINT, where the end takes a launcher too long.

    Returns:
        Whether every last message was acknowledged.

    """
    stop = _Flag()
    former = _handle(stop.set)
    init(args=args)
    heard = True
    try:
        node = node_factory()
        try:
            look = time.monotonic() + _LOOK_AROUND
            while ok() and not stop.is_set and not (done is not None and done(node)):
                spin_once(node, timeout_sec=_TICK)
                if time.monotonic() > look:
                    look = math.inf
                    _warn_of_namesakes(node)
        except ExternalShutdownException:
            pass
        finally:
            heard = ok() and _last_word(node)
            node.destroy_node()
    finally:
        try_shutdown()
        for number, handler in former.items():
            signal.signal(number, signal.SIG_IGN if ends else handler)
    return heard


def _handle(handler: Callable[..., None]) -> dict[signal.Signals, Any]:
    """Install a handler; return the former ones. Signals come to the main thread only."""
    if threading.current_thread() is not threading.main_thread():
        return {}
    return {n: signal.signal(n, handler) for n in (signal.SIGINT, signal.SIGTERM)}


def _warn_of_namesakes(node: Any) -> None:
    """Say so where another node has the same name: both would answer to the same services."""
    own = node.get_name(), node.get_namespace()
    same = [n for n in node.get_node_names_and_namespaces() if n == own]
    if len(same) > 1:
        node.get_logger().warning(
            f'{len(same)} nodes are called {node.get_fully_qualified_name()}; rename one of them '
            'with --ros-args -r __node:=NAME.'
        )


def _last_word(node: Any) -> bool:
    stop = getattr(node, 'stop', None)
    publishers = stop() if stop is not None else None
    heard = [acknowledged(p, _LAST_WORD) for p in publishers or ()]
    return all(heard)
