"""Work beside callbacks: in a thread, or between the rounds of a process that has all nodes."""

from __future__ import annotations

import time
from typing import Any

from ..beside import Beside, Work, guarded
from . import memory
from .context import CONTEXT


class InTurn:
    """Work that the container calls when no message waits; see `Beside`."""

    def __init__(self, work: Work) -> None:
        self._work = work
        self._due = 0.0
        self._done = False
        CONTEXT.works.append(self)

    def run(self) -> float | None:
        """Work if it is time; return the seconds until the next time, None when it is done."""
        if self._done:
            return None
        rest = self._due - time.monotonic()
        if rest > 0:
            return rest
        found = self._work()
        self._done = found is None
        self._due = time.monotonic() + found if found else 0.0
        return found

    def finish(self, patience: float) -> None:
        """Work until it is done, at most so many seconds."""
        end = time.monotonic() + patience
        while (rest := self.run()) is not None and time.monotonic() < end:
            time.sleep(rest)
        if self in CONTEXT.works:
            CONTEXT.works.remove(self)


def run_beside(node: Any, work: Work, name: str) -> Beside | InTurn:
    """Call a function again and again, beside the callbacks of a node; see `Beside`."""
    if isinstance(CONTEXT.participant, memory.Participant):
        return InTurn(guarded(node, work, name))
    return Beside(node, work, name)
