"""Work that a node does beside its callbacks, such as the life of simulated hardware."""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING, Any, TypeAlias

from ...common.errors import ImuCalibError

if TYPE_CHECKING:
    from collections.abc import Callable

Work: TypeAlias = 'Callable[[], float | None]'
"""Returns the seconds until its next call, None when it is done."""


class Beside:
    """Call a function again and again in a thread of its own.

    Args:
        node: Logs the error of the package that ends the work.
        work: The function.
        name: Of the work, as a noun.
    """

    def __init__(self, node: Any, work: Work, name: str) -> None:
        self._work = guarded(node, work, name)
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def finish(self, patience: float) -> None:
        """Wait until the work is done, at most so many seconds."""
        self._thread.join(timeout=patience)

    def _run(self) -> None:
        while (rest := self._work()) is not None:
            if rest:
                time.sleep(rest)


def guarded(node: Any, work: Work, name: str) -> Work:
    """Return work that an error of the package ends, with a line in the log."""

    def attempt() -> float | None:
        try:
            return work()
        except ImuCalibError as error:
            node.get_logger().fatal(f'The {name} ends: {error}')
            return None

    return attempt
