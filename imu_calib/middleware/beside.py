"""Work that a node does beside its callbacks, such as the life of simulated hardware."""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable


class Beside:
    """Call a function again and again in a thread of its own.

    Args:
        work: Returns the seconds until its next call, None when it is done.
        name: Of the thread.
    """

    def __init__(self, work: Callable[[], float | None], name: str) -> None:
        self._work = work
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def finish(self, patience: float) -> None:
        """Wait until the work is done, at most so many seconds."""
        self._thread.join(timeout=patience)

    def _run(self) -> None:
        while (rest := self._work()) is not None:
            if rest:
                time.sleep(rest)
