"""A session that is being recorded and solved while it runs; knows nothing of the middleware."""

from __future__ import annotations

import time
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from enum import IntEnum

from ..bags import Journal
from ..calibration import Calibration
from ..calibrator import Calibrator, Review, Setup
from ..cdr import Kind, Malformed, Messages
from ..errors import ImuCalibError, InputError
from ..stream import Block, ImuBlock, JointBlock, SetpointBlock, TemperatureBlock

_LATE = 500_000_000
_PATIENCE = 2.0
_BLOCKS = {
    Kind.IMU: ImuBlock,
    Kind.JOINTS: JointBlock,
    Kind.SETPOINTS: SetpointBlock,
    Kind.TEMPERATURES: TemperatureBlock,
}


class Phase(IntEnum):
    """As in imu_calib_msgs/CalibrationProgress."""

    WAITING = 0
    COLLECTING = 1
    DETERMINED = 2
    FINISHED = 3
    FAILED = 4


@dataclass(eq=False)
class Intake:
    """One topic of the session.

    Attributes:
        kind: What it carries.
        topic: Full name.
        malformed: Messages that were left out.
        count: Samples taken in, those of the journal included.
        newest: Stamp of the newest, ns; None before the first.
        heard: When it came, s of the steady clock.

    """

    kind: Kind
    topic: str
    malformed: Malformed
    heard: float
    count: int = 0
    newest: int | None = None


class LiveSession:
    """Journals what comes in, feeds the calibrator, and solves in a thread of its own.

    What it ends with is what `imu-calib calibrate` makes of the journal, bit for bit: the same
    calibrator is fed with the same messages, and a snapshot of it is solved.

    Attributes:
        setup: What is calibrated, and how.
        journal: The recording.
        intakes: The topics by what they carry.
        phase: How far it has come.
        failure: Why it failed, else empty.
        trouble: What is wrong with the journal at the moment, else empty.
        notes: What a person should know beyond the calibration's own findings.
        review: What the last solving found; None before the first.
        calibration: The result as far as it goes; None while it is not determined.
        worked_until: Joint stamp up to which the last review reaches, ns.
        frame_id: The IMU's frame.

    Args:
        setup: What is calibrated, and how.
        journal: Open; what it holds from before a crash is taken in first.
        topics: Full topic names by what they carry.

    Raises:
        InputError: The journal holds what does not go with the set-up.

    """

    def __init__(self, setup: Setup, journal: Journal, topics: dict[Kind, str]) -> None:
        self.setup = setup
        self.journal = journal
        now = time.monotonic()
        self.intakes = {k: Intake(k, topic, Malformed(), now) for k, topic in topics.items()}
        self.phase = Phase.WAITING
        self.failure = ''
        self.trouble = ''
        self.notes: list[str] = []
        self.review: Review | None = None
        self.calibration: Calibration | None = None
        self.worked_until = 0
        self.frame_id = ''
        self.steps_seen = 0
        self._calibrator = Calibrator(setup)
        self._solver = ThreadPoolExecutor(1, 'solver')
        self._pending: Future[Review] | None = None
        self._pending_is_final = False
        self._pending_until = 0
        self._ending = False
        self._done_at: int | None = None
        self._done_heard = 0.0
        for block in journal.replay():
            self._feed(block)
        self.notes += journal.losses
        self._left_at = self.intakes[Kind.IMU].newest if journal.resumed else None

    @property
    def over(self) -> bool:
        """Whether nothing is taken in any more."""
        return self.phase in {Phase.FINISHED, Phase.FAILED}

    @property
    def _closed(self) -> bool:
        """Whether nothing more is taken in: the recording is to hold what the result rests on."""
        return self.over or (self._pending is not None and self._pending_is_final)

    def take(self, kind: Kind, payloads: Sequence[bytes], now: int) -> None:
        """Take serialised messages of a topic in.

        Args:
            kind: Of which topic.
            payloads: At least one message.
            now: Host time, ns.

        """
        if self._closed:
            return
        intake = self.intakes[kind]
        messages = Messages.join(payloads)
        blocks = list(kind.decode(messages, intake.malformed))
        self._write(intake, messages, now)
        intake.heard = time.monotonic()
        for block in blocks:
            if isinstance(block, ImuBlock) and len(block):
                self._name_the_gap(int(block.stamp[0]))
                self.frame_id = block.frame_id
            self._feed(block)

    def record(self, topic: str, type_name: str, payload: bytes, now: int) -> None:
        """Keep a message that is not calibrated from."""
        if self._closed:
            return
        try:
            self.journal.write(topic, type_name, Messages.join([payload]), now)
        except InputError as error:
            self.trouble = str(error)

    def backwards(self, kind: Kind, payloads: Sequence[bytes]) -> bool:
        """Tell whether messages are older than what came in before: a second publisher's."""
        newest = self.intakes[kind].newest
        blocks = kind.decode(Messages.join(payloads), Malformed())
        return newest is not None and any(
            bool((block.stamp <= newest).any()) for block in blocks if isinstance(block, ImuBlock)
        )

    def flush(self) -> None:
        """Secure what came in, and try again what a full disk refused."""
        if self.over:
            return
        try:
            self.journal.flush()
        except InputError as error:
            self.trouble = str(error)
        else:
            self.trouble = ''
        if self.journal.overfull:
            self.fail(f'{self.trouble} The memory takes no more either.')

    def table_done(self, stamp: int) -> None:
        """Note that the table ran its plan to the end, at a stamp in ns."""
        if self._done_at is None:
            self._done_at, self._done_heard = stamp, time.monotonic()

    def table_running(self) -> None:
        """Note that the table runs."""
        self._done_at = None

    def end(self) -> None:
        """Solve for good with what is here."""
        if not self.over:
            self._ending = True
            self.solve()

    def solve(self) -> None:
        """Begin to solve with what is here, unless it is being done already."""
        if self._pending is not None or self.over:
            return
        self._pending_is_final = self._ending
        self._pending_until = self.intakes[Kind.JOINTS].newest or 0
        self._pending = self._solver.submit(self._calibrator.snapshot().review)

    def poll(self) -> bool:
        """Look for what the solver found, and for the end; return whether there is news."""
        if self._done_at is not None and not self._ending and self._all_here(self._done_at):
            self.end()
        if self._pending is None or not self._pending.done():
            return False
        pending, self._pending = self._pending, None
        if self.over:
            return False
        try:
            self.review = pending.result()
        except ImuCalibError as error:
            self.fail(str(error))
            return True
        self.worked_until = self._pending_until
        self._conclude(self.review)
        return True

    def fail(self, reason: str) -> None:
        """End the session without a result."""
        self.phase = Phase.FAILED
        self.failure = reason
        self.calibration = None
        # What came in is kept, to be looked into; more would not make it better.
        self._close_journal(finished=True)

    def close(self) -> None:
        """Leave the journal such that it can be gone on with."""
        self._solver.shutdown(wait=False, cancel_futures=True)
        if not self.over:
            self._close_journal(finished=False)

    def _all_here(self, done_at: int) -> bool:
        """Say whether all data up to the table's last word has come in."""
        joints, imu = self.intakes[Kind.JOINTS].newest, self.intakes[Kind.IMU].newest
        if joints is not None and imu is not None and joints >= done_at and imu >= done_at - _LATE:
            return True
        return time.monotonic() - self._done_heard > _PATIENCE

    def _conclude(self, review: Review) -> None:
        result = review.result
        if self._pending_is_final:
            self._finish(review)
        elif self._ending:
            # It was begun before the last data came in.
            self.solve()
        elif result is not None and not self.trouble:
            self.phase = Phase.DETERMINED
            self.calibration = self._with_notes(result.calibration)
        elif self.intakes[Kind.IMU].count:
            self.phase = Phase.COLLECTING
            self.calibration = None

    def _finish(self, review: Review) -> None:
        if review.result is None:
            self.fail(review.refusal)
        elif self._close_journal(finished=True):
            self.phase = Phase.FINISHED
            self.calibration = self._with_notes(review.result.calibration)
        else:
            self.fail(f'The session cannot be kept: {self.trouble}')

    def _with_notes(self, calibration: Calibration) -> Calibration:
        provenance = {'recording': self.journal.path.name, **calibration.provenance}
        findings = (*calibration.findings, *self.notes)
        return replace(calibration, provenance=provenance, findings=findings)

    def _close_journal(self, *, finished: bool) -> bool:
        try:
            self.journal.close(finished=finished)
        except InputError as error:
            self.trouble = str(error)
            return False
        return True

    def _write(self, intake: Intake, messages: Messages, now: int) -> None:
        try:
            self.journal.write(intake.topic, intake.kind.type_name, messages, now)
        except InputError as error:
            # Held in memory, and written with the next flush that succeeds.
            self.trouble = str(error)

    def _feed(self, block: Block) -> None:
        intake = self.intakes[_kind(block)]
        intake.count += len(block)
        if isinstance(block, SetpointBlock):
            steps = [s.step for s in block.setpoints if s.plan == self.setup.plan.name]
            self.steps_seen = max([self.steps_seen, *(step + 1 for step in steps)])
            intake.newest = block.setpoints[-1].stamp if block.setpoints else intake.newest
        elif len(block):
            intake.newest = int(block.stamp[-1])
        try:
            self._calibrator.feed(block)
        except InputError as error:
            self.fail(str(error))

    def _name_the_gap(self, first: int) -> None:
        """Say, once, how long the session was interrupted."""
        if self._left_at is None:
            return
        gap = (first - self._left_at) * 1e-9
        self.notes.append(
            f'The session was interrupted: {gap:.1f} s are missing, from '
            f'{self._left_at * 1e-9:.3f} s.'
        )
        self._left_at = None


def _kind(block: Block) -> Kind:
    for kind, blocks in _BLOCKS.items():
        if isinstance(block, blocks):
            return kind
    raise TypeError(type(block).__name__)
