"""A session that is recorded and solved while it runs, with its part of journal and solver."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from enum import IntEnum
from pathlib import Path
from typing import Any

from ...calibration.calibration import Calibration
from ...calibration.calibrator import Calibrator
from ...calibration.hand import Guidance, HandCalibrator, HandReview, Stage
from ...calibration.results import Review
from ...common.errors import ImuCalibError, InputError
from ...common.stream import Block, ImuBlock, JointBlock, Mode, SetpointBlock
from ...estimation.setup import Setup
from ...model.parameters import Parameter
from ...recordings.cdr import Malformed, Messages
from ...recordings.cdr_codec import Kind
from ...recordings.writer import Journal
from ...session.metadata import described_origin, file_hashes
from ..middleware import in_step
from .intake import CalibratorFeed, FormerSession, TopicIntake

AnyCalibrator = Calibrator | HandCalibrator
Concluding = Callable[[Sequence[AnyCalibrator], Sequence[str]], Sequence[Review | ImuCalibError]]


class SharedJournal:
    """One open recording of several sessions: data of the common topics is written once."""

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
        """Close the recording with its last session; secure the data of the others until then."""
        if any(part.open for part in self._parts):
            self.journal.flush()
        else:
            self.journal.close(finished=all(part.finished for part in self._parts))


class JournalPart:
    """The journal as one session sees it; data refused by a full disk is held and retried."""

    def __init__(self, shared: SharedJournal) -> None:
        self._shared = shared
        self.open = True  #: Whether the session still writes.
        self.finished = False  #: Whether it came to its end.
        self.trouble = ''  #: Why the disk refuses data, else empty.

    @property
    def path(self) -> Path:
        """Folder of the recording."""
        return self._shared.journal.path

    @property
    def origin(self) -> dict[str, Any]:
        """What the provenance of a result states of the recording."""
        journal = self._shared.journal
        content = {'sha256': journal.sha256} if journal.sha256 else {}
        described = described_origin(journal.description)
        described |= file_hashes(journal.description, '')
        return {'recording': journal.path.name, **content, **described}

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
        #: Ends when all sessions are concluded; None before that begins.
        self.conclusion: Future[None] | None = None
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
        futures = [future for _, future in taken]
        self.conclusion = self.threads.submit(self._work, snapshots, serials, futures)

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
    """The solver as one session sees it: it solves snapshots of a calibrator that continues."""

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
        if work.final and not (self._shared.conclusion and self._shared.conclusion.done()):
            # All end in the same round, after which the journal is finished.
            return None
        self._work = None
        if not work.final:
            self._shared.reviewed()
        return work

    def close(self) -> None:
        """Begin no more reviews for this session."""
        self._last = None


_LATE = 500_000_000
"""ns by which the last samples may be older than the table's last message: half a second of
delay."""
_PATIENCE = 2.0
"""s to wait for data older than the table's last message; later data is lost."""


class SessionPhase(IntEnum):
    """As in imu_calib_msgs/CalibrationProgress."""

    WAITING = 0
    COLLECTING = 1
    DETERMINED = 2
    FINISHED = 3
    FAILED = 4


class LiveSession:
    """Records messages in the journal, feeds the calibrator, and solves in a separate thread.

    The final result equals that of `imu-calib calibrate` on the journal, bit for bit: the same
    calibrator receives the same messages, and a snapshot of it is solved.

    `solved` is the set-up used to solve: without the plan for a unit whose axes differ from the
    plan's. A skewed gyro is expected if its topic is among the topics.
    """

    def __init__(
        self,
        setup: Setup,
        journal: JournalPart,
        topics: dict[Kind, str],
        solver: SolverPart,
        solved: Setup,
    ) -> None:
        self.setup = setup  #: What is calibrated, and how.
        self.journal = journal  #: Its part of the recording.
        self._solved = solved
        now = time.monotonic()
        #: The topics by content.
        self.intakes = {k: TopicIntake(k, topic, Malformed(), now) for k, topic in topics.items()}
        self.phase = SessionPhase.WAITING  #: Progress of the session.
        self.failure = ''  #: Why it failed, else empty.
        #: Messages for the user in addition to the calibration's findings.
        self.notes: list[str] = []
        self.review: Review | None = None  #: Result of the last solution; None before the first.
        #: The result so far; None while it is not determined.
        self.calibration: Calibration | None = None
        #: Stamp up to which the last review reaches, ns: of the joints, of the IMU without a table.
        self.worked_until = 0
        self.frame_id = ''  #: The IMU's frame.
        self.steps_seen = 0  #: Steps of the plan that have been commanded: up to the last one seen.
        self._feed = CalibratorFeed(solved, topics)
        self._solver = solver
        self._ending = False
        self._done_at: int | None = None
        self._done_received_at = 0.0
        self._former: FormerSession | None = None

    @property
    def trouble(self) -> str:
        """The present fault of the journal, else empty."""
        return self.journal.trouble

    @property
    def without_skew(self) -> bool:
        """Whether the session continues without a skewed gyro."""
        return self._feed.without_skew

    @property
    def is_over(self) -> bool:
        """Whether no more messages are accepted."""
        return self.phase in {SessionPhase.FINISHED, SessionPhase.FAILED}

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The parameters that the session's method estimates."""
        return self._solved.parameters

    @property
    def guidance(self) -> Guidance | None:
        """The next action for a person with the unit in hand; None on a table."""
        return self.review.guidance if isinstance(self.review, HandReview) else None

    @property
    def _leader(self) -> TopicIntake:
        """The topic that determines the progress of the session."""
        return self.intakes[Kind.JOINTS if Kind.JOINTS in self.intakes else Kind.IMU]

    @property
    def _closed(self) -> bool:
        """Whether no more data is accepted: the recording must hold the data of the result only."""
        return self.is_over or self._solver.concludes

    def add_messages(self, kind: Kind, payloads: Sequence[bytes], now: int) -> None:
        """Add serialised messages of a topic, at least one, received at a host time in ns."""
        if self._closed:
            return
        intake = self.intakes[kind]
        if kind is Kind.SKEW and self.without_skew:
            # The recording must hold the data of the result only.
            return
        if kind is Kind.SETPOINTS:
            sound = [p for p in payloads if self._is_of_plan(p)]
            intake.ignored += len(payloads) - len(sound)
            if not sound:
                return
            payloads = sound
        messages = Messages.join(payloads)
        blocks = list(kind.decode(messages, intake.malformed))
        if self._former is not None and (why := self._former.adjust_to_journal(intake, blocks)):
            self.fail(why, finished=False)
            return
        self.journal.write(intake.topic, kind.type_name, messages, now)
        intake.received_at = time.monotonic()
        for block in blocks:
            if isinstance(block, ImuBlock) and len(block):
                self._name_the_gap(int(block.stamp[0]))
                self.frame_id = block.frame_id
            self._add_block(kind, block)

    def feed_former(self, kind: Kind, block: Block) -> None:
        """Add a block from the session before a crash."""
        self._add_block(kind, block)

    def end_of_journal(self, losses: Sequence[str]) -> None:
        """Record that the old journal has been read, and which parts could not be."""
        self.notes += losses
        self._former = FormerSession(self.journal.path, self.intakes)

    def record(self, topic: str, type_name: str, payload: bytes, now: int) -> None:
        """Record a message that calibration does not use."""
        if not self._closed:
            self.journal.write(topic, type_name, Messages.join([payload]), now)

    def backwards(self, kind: Kind, payloads: Sequence[bytes]) -> bool:
        """Return whether messages are older than earlier ones, thus from a second publisher."""
        newest = self.intakes[kind].newest
        blocks = kind.decode(Messages.join(payloads), Malformed())
        return newest is not None and any(
            bool((block.stamp <= newest).any()) for block in blocks if isinstance(block, ImuBlock)
        )

    def flush(self) -> None:
        """Secure the received data, and retry what a full disk refused."""
        if not self.is_over and not self.journal.flush():
            self.fail(f'{self.trouble} The memory for it is full too.')

    def table_done(self, stamp: int) -> None:
        """Record that the table completed its plan, at a stamp in ns."""
        if self._done_at is None:
            self._done_at, self._done_received_at = stamp, time.monotonic()

    def table_running(self) -> None:
        """Record that the table runs."""
        self._done_at = None

    def end(self) -> None:
        """Solve the received data for the final result."""
        if not self.is_over:
            self._ending = True
            if self._feed.calibrator is None:
                self._fail_if(self._feed.begin(with_skew=self.intakes[Kind.SKEW].count > 0))
            self.solve()

    def solve(self) -> None:
        """Begin to solve the received data, unless a solution is running."""
        calibrator = self._feed.calibrator
        if not (self._solver.busy or self.is_over or calibrator is None):
            until = self._leader.newest or 0
            self._solver.begin(calibrator, until, final=self._ending)

    def poll(self) -> bool:
        """Check for results of the solver and for the end; return whether there is news."""
        if self._done_at is not None and not self._ending and self._all_here(self._done_at):
            self.end()
        solved = self._solver.poll()
        if solved is None or self.is_over:
            return False
        try:
            self.review = solved.future.result()
        except ImuCalibError as error:
            self.fail(str(error))
            return True
        self.worked_until = solved.until
        self._conclude(self.review, final=solved.final)
        return True

    def cite_journal(self) -> None:
        """State the finished recording in the result."""
        if self.calibration is not None:
            provenance = {**self.journal.origin, **self.calibration.provenance}
            self.calibration = replace(self.calibration, provenance=provenance)

    def fail(self, reason: str, *, finished: bool = True) -> None:
        """End the session without a result; a `finished` journal cannot be resumed."""
        self.phase = SessionPhase.FAILED
        self.failure = reason
        self.calibration = None
        self.journal.close(finished=finished)

    def close(self) -> None:
        """Close the journal so that it can be resumed."""
        self._solver.close()
        if not self.is_over:
            self.journal.close(finished=False)

    def _all_here(self, done_at: int) -> bool:
        """Return whether all data up to the table's last message has been received."""
        awaited = {Kind.IMU: _LATE, Kind.JOINTS: 0}
        if Kind.SKEW in self.intakes and not self.without_skew:
            awaited[Kind.SKEW] = _LATE
        newest = [(self.intakes[kind].newest, late) for kind, late in awaited.items()]
        if all(stamp is not None and stamp >= done_at - late for stamp, late in newest):
            return True
        return time.monotonic() - self._done_received_at > _PATIENCE

    def _conclude(self, review: Review, *, final: bool) -> None:
        """Apply the result of a solution."""
        result = review.result
        if final:
            self._end_with_result(review)
        elif self._ending:
            # This solution began before the last data came.
            self.solve()
        elif result is not None and not self.trouble:
            self.phase = SessionPhase.DETERMINED
            self.calibration = self._with_notes(result.calibration)
            if self.guidance is not None and self.guidance.stage is Stage.ENOUGH:
                self.end()
        elif self.intakes[Kind.IMU].count:
            self.phase = SessionPhase.COLLECTING
            self.calibration = None

    def _end_with_result(self, review: Review) -> None:
        if review.result is None:
            self.fail(review.refusal)
        elif self.journal.close(finished=True):
            self.phase = SessionPhase.FINISHED
            self.calibration = self._with_notes(review.result.calibration)
        else:
            self.fail(f'The session cannot be saved: {self.trouble}')

    def _with_notes(self, calibration: Calibration) -> Calibration:
        provenance = {**self.journal.origin, **calibration.provenance}
        findings = (*calibration.findings, *self.notes)
        return replace(calibration, provenance=provenance, findings=findings)

    def _add_block(self, kind: Kind, block: Block) -> None:
        if isinstance(block, SetpointBlock):
            # A held table does not approach a step.
            name = self.setup.plan.name
            steps = [s.step for s in block.setpoints if s.plan == name and s.mode is not Mode.HOLD]
            self.steps_seen = max([self.steps_seen, *(step + 1 for step in steps)])
        strange = isinstance(block, JointBlock) and not self._is_of_table(block)
        self.intakes[kind].note(block, strange=strange)
        self._fail_if(self._feed.add_block(block, self.intakes))

    def _fail_if(self, reason: str) -> None:
        if reason:
            self.fail(reason)

    def _is_of_plan(self, payload: bytes) -> bool:
        """Return whether a setpoint belongs to the plan; those of other plans are foreign."""
        blocks = Kind.SETPOINTS.decode(Messages.join([payload]), Malformed())
        named = {s.plan for b in blocks if isinstance(b, SetpointBlock) for s in b.setpoints}
        return not named or self.setup.plan.name in named

    def _is_of_table(self, block: JointBlock) -> bool:
        """Return whether joint states are the table's: other joints may share its topic."""
        table = self.setup.table
        return table is None or block.select_joints(table.names) is not None

    def _name_the_gap(self, first: int) -> None:
        if self._former is not None and (words := self._former.gap(first)):
            self.notes.append(words)
