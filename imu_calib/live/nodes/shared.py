"""What the sessions of several units share: one journal, and one solver thread."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...calibration.calibrator import Calibrator
from ...calibration.hand import HandCalibrator
from ...calibration.results import Review
from ...common.errors import ImuCalibError, InputError
from ...recordings.cdr import Messages
from ...recordings.writer import Journal
from ..middleware import in_step

AnyCalibrator = Calibrator | HandCalibrator
Concluding = Callable[[Sequence[AnyCalibrator], Sequence[str]], Sequence[Review | ImuCalibError]]


class SharedJournal:
    """One recording of several sessions: common data is written once.

    Args:
        journal: Open.
        common: Topics of the table, which feed every session.
    """

    def __init__(self, journal: Journal, common: frozenset[str]) -> None:
        self.journal = journal
        self._common = common
        self._parts: list[JournalPart] = []
        self._flushed: set[JournalPart] = set()
        self._refused: InputError | None = None

    def part(self) -> JournalPart:
        """Return the journal as seen by one more session."""
        self._parts.append(JournalPart(self))
        return self._parts[-1]

    def writes(self, part: JournalPart, topic: str) -> bool:
        """Return whether a session writes a topic: the first open one does."""
        if topic not in self._common:
            return True
        return next((one for one in self._parts if one.open), part) is part

    def flush(self, part: JournalPart) -> None:
        """Flush once for all sessions that request it in turn.

        Raises:
            InputError: The disk accepts no more data.
        """
        if not self._flushed or part in self._flushed:
            self._flushed.clear()
            self._refused = None
            try:
                self.journal.flush()
            except InputError as error:
                self._refused = error
        self._flushed.add(part)
        if self._refused is not None:
            raise self._refused

    def settle(self) -> None:
        """Close the recording with its last session; secure the data of the others until then.

        Raises:
            InputError: The disk accepts no more data.
        """
        if any(part.open for part in self._parts):
            self.journal.flush()
        else:
            self.journal.close(finished=all(part.finished for part in self._parts))


class JournalPart:
    """The journal as one session sees it; data refused by a full disk is held and retried.

    Attributes:
        open: Whether the session still writes.
        finished: Whether it came to its end.
        trouble: Why the disk refuses data, else empty.
    """

    def __init__(self, shared: SharedJournal) -> None:
        self._shared = shared
        self.open = True
        self.finished = False
        self.trouble = ''

    @property
    def path(self) -> Path:
        """Folder of the recording."""
        return self._shared.journal.path

    def write(self, topic: str, type_name: str, messages: Messages, now: int) -> None:
        """Record messages received at `now`, host time in ns, unless another session does."""
        if self._shared.writes(self, topic):
            try:
                self._shared.journal.write(topic, type_name, messages, now)
            except InputError as error:
                # Held in memory, and written with the next successful flush.
                self.trouble = str(error)

    def flush(self) -> bool:
        """Secure the received data; return whether the memory can hold what the disk refuses."""
        self.trouble = ''
        try:
            self._shared.flush(self)
        except InputError as error:
            self.trouble = str(error)
        return not self._shared.journal.overfull

    def close(self, *, finished: bool) -> bool:
        """End this session's part, and the recording with the last; return whether it is saved.

        Args:
            finished: Whether it is kept for inspection only; else it can be resumed.
        """
        self.open, self.finished = False, finished
        try:
            self._shared.settle()
        except InputError as error:
            self.trouble = str(error)
            return False
        return True


@dataclass(frozen=True, eq=False)
class PendingReview:
    """A running or completed review."""

    future: Future[Review]  #: Its result or error.
    final: bool  #: Whether it was the session's last.
    until: int  #: Stamp of the last data used, ns.


class ImmediateExecutor:
    """Executes at once, in the thread that asks, what a thread pool would do meanwhile."""

    def submit(self, work: Callable[..., Any], *args: Any) -> Future[Any]:
        """Return the future of a function that has been called."""
        future: Future[Any] = Future()
        try:
            future.set_result(work(*args))
        except Exception as error:
            future.set_exception(error)
        return future

    def shutdown(self, **_: Any) -> None:
        """Do nothing: nothing is left to be done."""


class SharedSolver:
    """One thread for all sessions: reviews in turn, the final ones together.

    The table errors that the units share are estimated from all of them at the end. Therefore
    sessions are concluded when all open ones are ready, and together.

    Args:
        concluded: Concludes the sessions of units with these serial numbers: returns a review or an
            error for each.
    """

    def __init__(self, concluded: Concluding) -> None:
        self._concluded = concluded
        self._reviews = 0
        self._since = self._rested_at = 0.0
        self.threads = ImmediateExecutor() if in_step() else ThreadPoolExecutor(1, 'solver')

    @property
    def may_review(self) -> bool:
        """Whether the pause since the last round of reviews is as long as that round.

        A round has one review of each session; the pause leaves time to record incoming data.
        """
        return not self._reviews and (in_step() or time.monotonic() >= self._rested_at)

    def review(self, calibrator: AnyCalibrator) -> Future[Review]:
        """Begin to review the data of a calibrator."""
        if not self._reviews:
            self._since = time.monotonic()
        self._reviews += 1
        return self.threads.submit(calibrator.snapshot().review)

    def reviewed(self) -> None:
        """Record that a review has ended."""
        self._reviews -= 1
        now = time.monotonic()
        self._rested_at = now + (now - self._since)

    def conclude(self, parts: Sequence[SolverPart]) -> None:
        """Conclude sessions that are all ready for it."""
        serials = [part.serial_number for part in parts]
        taken = [part.final_calibrator() for part in parts]
        snapshots = [snapshot for snapshot, _ in taken]
        self.threads.submit(self._work, snapshots, serials, [future for _, future in taken])

    def _work(
        self,
        snapshots: Sequence[AnyCalibrator],
        serials: Sequence[str],
        futures: Sequence[Future[Review]],
    ) -> None:
        """Conclude sessions in the solver's thread, each with a result or an error."""
        try:
            found = self._concluded(snapshots, serials)
        except BaseException as error:
            for future in futures:
                future.set_exception(error)
            raise
        for future, one in zip(futures, found, strict=True):
            if isinstance(one, ImuCalibError):
                future.set_exception(one)
            else:
                future.set_result(one)


class SolverPart:
    """The solver as one session sees it: it solves snapshots of a calibrator that continues.

    Args:
        shared: Solver of all sessions.
        serial_number: Of the session's unit.
    """

    def __init__(self, shared: SharedSolver, serial_number: str) -> None:
        self._shared = shared
        self.serial_number = serial_number
        self._work: PendingReview | None = None
        self._last: tuple[AnyCalibrator, int] | None = None

    @property
    def ready(self) -> bool:
        """Whether it waits for the other sessions to be ready."""
        return self._last is not None

    @property
    def busy(self) -> bool:
        """Whether it solves, or waits to conclude."""
        return self._work is not None or self.ready

    @property
    def concludes(self) -> bool:
        """Whether it solves the final result."""
        return self._work is not None and self._work.final

    def begin(self, calibrator: AnyCalibrator, until: int, *, final: bool) -> None:
        """Begin to solve the data of a calibrator up to a stamp in ns; not while busy."""
        assert not self.busy, 'one at a time'
        if final:
            self._last = calibrator, until
        else:
            self._work = PendingReview(self._shared.review(calibrator), final, until)

    def final_calibrator(self) -> tuple[AnyCalibrator, Future[Review]]:
        """Return the calibrator to conclude in its present state, and the future of its review."""
        assert self._last is not None, 'it is not ready'
        (calibrator, until), self._last = self._last, None
        future: Future[Review] = Future()
        self._work = PendingReview(future, True, until)
        return calibrator.snapshot(), future

    def poll(self) -> PendingReview | None:
        """Return a review that has ended since the last call, else None."""
        work = self._work
        if work is None or not work.future.done():
            return None
        self._work = None
        if not work.final:
            self._shared.reviewed()
        return work

    def close(self) -> None:
        """Begin no more reviews for this session."""
        self._last = None
