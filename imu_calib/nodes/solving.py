"""Reviews of a session in a thread of their own, one at a time."""

from __future__ import annotations

import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

from ..calibrator import Calibrator, HandCalibrator, Review


@dataclass(frozen=True, eq=False)
class Solved:
    """A review: one that is being made, or has come to its end.

    Attributes:
        future: What it found, or the error that it raised.
        final: Whether it was the session's last.
        until: Stamp up to which it reaches, ns.

    """

    future: Future[Review]
    final: bool
    until: int


class Solver:
    """Solves snapshots of a calibrator, which goes on meanwhile."""

    def __init__(self) -> None:
        self._threads = ThreadPoolExecutor(1, 'solver')
        self._work: Solved | None = None
        self._since = 0.0
        self._rested_at = 0.0

    @property
    def busy(self) -> bool:
        """Whether it solves."""
        return self._work is not None

    @property
    def concludes(self) -> bool:
        """Whether it solves for the last time."""
        return self._work is not None and self._work.final

    @property
    def rested(self) -> bool:
        """Whether as much time has gone by since the last solving as that took.

        Long sessions take longer to solve, and what comes in must be journaled meanwhile.
        """
        return time.monotonic() >= self._rested_at

    def begin(self, calibrator: Calibrator | HandCalibrator, until: int, *, final: bool) -> None:
        """Begin to solve what a calibrator has taken in, up to a stamp in ns; not while busy."""
        assert self._work is None, 'one at a time'
        self._since = time.monotonic()
        snapshot = calibrator.snapshot()
        work = snapshot.conclude if final else snapshot.review
        self._work = Solved(self._threads.submit(work), final, until)

    def poll(self) -> Solved | None:
        """Return what came to its end since; None where nothing did."""
        work = self._work
        if work is None or not work.future.done():
            return None
        self._work = None
        now = time.monotonic()
        self._rested_at = now + (now - self._since)
        return work

    def close(self) -> None:
        """Begin nothing more; do not wait for what is under way."""
        self._threads.shutdown(wait=False, cancel_futures=True)
