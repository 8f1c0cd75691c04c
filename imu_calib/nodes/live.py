"""A session that is being recorded and solved while it runs; knows nothing of the middleware."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from enum import IntEnum

# The core loads these when it first solves something, and then a table would wait.
import scipy.linalg
import scipy.special  # noqa: F401

from ..bags import Journal
from ..calibration import Calibration
from ..calibrator import Calibrator, HandCalibrator, Review, Setup, calibrator_of
from ..calibrator.by_hand import HandReview
from ..calibrator.guidance import Guidance, Stage
from ..cdr import Kind, Malformed, Messages
from ..errors import ImuCalibError, InputError
from ..instants import at
from ..model import Parameter, skewed_parameters
from ..segmentation.segmenter import INTERRUPTION, interruption
from ..stream import Block, ImuBlock, JointBlock, Mode, SetpointBlock
from .intake import TopicIntake
from .shared import JournalPart, SolverPart
from .solving import Solver

_LATE = 500_000_000
"""ns by which the last samples may be older than the table's last word: half a second of delay."""
_PATIENCE = 2.0
"""s that are waited for data older than the table's last word; what comes later is lost."""
_SET_BACK = 10_000_000_000
"""ns that stamps may begin before a journal's last: less than the shortest step of the plans."""
_SKEW_AWAITED = 10.0
"""How much the IMU may say while a skewed gyro says nothing: s by its stamps and by the clock."""


class SessionPhase(IntEnum):
    """As in imu_calib_msgs/CalibrationProgress."""

    WAITING = 0
    COLLECTING = 1
    DETERMINED = 2
    FINISHED = 3
    FAILED = 4


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
        worked_until: Stamp up to which the last review reaches, ns: of the joints, of the IMU
            where there is no table.
        frame_id: The IMU's frame.
        steps_seen: Steps of the plan that have been commanded: up to the last one seen.
        without_skew: Whether the session goes on without a skewed gyro.

    Args:
        setup: What is calibrated, and how.
        journal: Open; what it holds from before a crash is taken in first.
        topics: Full topic names by what they carry; a skewed gyro is awaited where its topic is
            among them.
        solver: What solves; None for one of its own.
        solved: As what the session is solved where that is not how the table runs: without the
            plan, of a unit whose axes are not as the plan has them.

    Raises:
        InputError: The journal holds what does not go with the set-up.

    """

    def __init__(
        self,
        setup: Setup,
        journal: Journal | JournalPart,
        topics: dict[Kind, str],
        solver: Solver | SolverPart | None = None,
        solved: Setup | None = None,
    ) -> None:
        self.setup = setup
        self._solved = solved or setup
        self.journal = journal
        now = time.monotonic()
        self.intakes = {k: TopicIntake(k, topic, Malformed(), now) for k, topic in topics.items()}
        self.phase = SessionPhase.WAITING
        self.failure = ''
        self.trouble = ''
        self.notes: list[str] = []
        self.review: Review | None = None
        self.calibration: Calibration | None = None
        self.worked_until = 0
        self.frame_id = ''
        self.steps_seen = 0
        self.without_skew = False
        self._began = now
        self._held: list[Block] = []
        self._calibrator: Calibrator | HandCalibrator | None = None
        # A plan that its method cannot solve is refused now, whenever it is begun with.
        calibrator_of(self._solved)
        if setup.imu.skewed is None or Kind.SKEW not in topics:
            self._begin(with_skew=False)
        self._solver = solver or Solver()
        self._ending = False
        self._done_at: int | None = None
        self._done_heard = 0.0
        self._left_at: int | None = None
        self._left: dict[Kind, int] = {}
        kinds = {topic: kind for kind, topic in topics.items()}
        for topic, block in journal.replay():
            self.feed_former(kinds[topic], block)
        if journal.resumed:
            self.go_on(journal.losses)

    @property
    def over(self) -> bool:
        """Whether nothing is taken in any more."""
        return self.phase in {SessionPhase.FINISHED, SessionPhase.FAILED}

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """What the session's method estimates."""
        return self._solved.parameters

    @property
    def guidance(self) -> Guidance | None:
        """What a person with the unit in hand should do next; None where a table turns it."""
        return self.review.guidance if isinstance(self.review, HandReview) else None

    @property
    def _leader(self) -> TopicIntake:
        """The topic that says how far the session has come."""
        return self.intakes[Kind.JOINTS if Kind.JOINTS in self.intakes else Kind.IMU]

    @property
    def _closed(self) -> bool:
        """Whether nothing more is taken in: the recording is to hold what the result rests on."""
        return self.over or self._solver.concludes

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
        if kind is Kind.SKEW and self.without_skew:
            # The recording is to hold what the result rests on.
            return
        if kind is Kind.SETPOINTS:
            sound = [p for p in payloads if self._of_the_plan(p)]
            intake.ignored += len(payloads) - len(sound)
            if not sound:
                return
            payloads = sound
        messages = Messages.join(payloads)
        blocks = list(kind.decode(messages, intake.malformed))
        if self._was_set_back(intake, blocks):
            return
        self._write(intake, messages, now)
        intake.heard = time.monotonic()
        for block in blocks:
            if isinstance(block, ImuBlock) and len(block):
                self._name_the_gap(int(block.stamp[0]))
                self.frame_id = block.frame_id
            self._feed(kind, block)

    def feed_former(self, kind: Kind, block: Block) -> None:
        """Take in a block of what a session before a crash left."""
        self._feed(kind, block)

    def go_on(self, losses: Sequence[str]) -> None:
        """Note that all of what was left has been taken in, and what of it could not be read."""
        self.notes += losses
        self._left_at = self.intakes[Kind.IMU].newest
        timed = {k: self.intakes[k] for k in (Kind.IMU, Kind.JOINTS) if k in self.intakes}
        self._left = {k: intake.newest for k, intake in timed.items() if intake.newest is not None}

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
            if self._calibrator is None:
                self._begin(with_skew=self.intakes[Kind.SKEW].count > 0)
            self.solve()

    @property
    def rested(self) -> bool:
        """Whether as much time has gone by since the last solving as that took."""
        return self._solver.rested

    def solve(self) -> None:
        """Begin to solve with what is here, unless it is being done already."""
        if not (self._solver.busy or self.over or self._calibrator is None):
            until = self._leader.newest or 0
            self._solver.begin(self._calibrator, until, final=self._ending)

    def poll(self) -> bool:
        """Look for what the solver found, and for the end; return whether there is news."""
        if self._done_at is not None and not self._ending and self._all_here(self._done_at):
            self.end()
        solved = self._solver.poll()
        if solved is None or self.over:
            return False
        try:
            self.review = solved.future.result()
        except ImuCalibError as error:
            self.fail(str(error))
            return True
        self.worked_until = solved.until
        self._conclude(self.review, final=solved.final)
        return True

    def fail(self, reason: str, *, finished: bool = True) -> None:
        """End the session without a result.

        Args:
            reason: Why.
            finished: Whether the journal is kept to be looked into alone; else it can be gone on
                with.

        """
        self.phase = SessionPhase.FAILED
        self.failure = reason
        self.calibration = None
        self._close_journal(finished=finished)

    def close(self) -> None:
        """Leave the journal such that it can be gone on with."""
        self._solver.close()
        if not self.over:
            self._close_journal(finished=False)

    def _all_here(self, done_at: int) -> bool:
        """Say whether all data up to the table's last word has come in."""
        awaited = {Kind.IMU: _LATE, Kind.JOINTS: 0}
        if Kind.SKEW in self.intakes and not self.without_skew:
            awaited[Kind.SKEW] = _LATE
        newest = [(self.intakes[kind].newest, late) for kind, late in awaited.items()]
        if all(stamp is not None and stamp >= done_at - late for stamp, late in newest):
            return True
        return time.monotonic() - self._done_heard > _PATIENCE

    def _conclude(self, review: Review, *, final: bool) -> None:
        result = review.result
        if final:
            self._finish(review)
        elif self._ending:
            # It was begun before the last data came in.
            self.solve()
        elif result is not None and not self.trouble:
            self.phase = SessionPhase.DETERMINED
            self.calibration = self._with_notes(result.calibration)
            if self.guidance is not None and self.guidance.stage is Stage.ENOUGH:
                self.end()
        elif self.intakes[Kind.IMU].count:
            self.phase = SessionPhase.COLLECTING
            self.calibration = None

    def _finish(self, review: Review) -> None:
        if review.result is None:
            self.fail(review.refusal)
        elif self._close_journal(finished=True):
            self.phase = SessionPhase.FINISHED
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

    def _write(self, intake: TopicIntake, messages: Messages, now: int) -> None:
        try:
            self.journal.write(intake.topic, intake.kind.type_name, messages, now)
        except InputError as error:
            # Held in memory, and written with the next flush that succeeds.
            self.trouble = str(error)

    def _feed(self, kind: Kind, block: Block) -> None:
        if isinstance(block, SetpointBlock):
            # A table that is held is on its way to no step.
            name = self.setup.plan.name
            steps = [s.step for s in block.setpoints if s.plan == name and s.mode is not Mode.HOLD]
            self.steps_seen = max([self.steps_seen, *(step + 1 for step in steps)])
        strange = isinstance(block, JointBlock) and not self._of_the_table(block)
        self.intakes[kind].note(block, strange=strange)
        if self._calibrator is None:
            self._held.append(block)
            self._await_skew()
        else:
            self._calibrator.feed(block)

    def _of_the_plan(self, payload: bytes) -> bool:
        """Say whether a setpoint may be the leader's: those of another plan are a stranger's."""
        blocks = Kind.SETPOINTS.decode(Messages.join([payload]), Malformed())
        named = {s.plan for b in blocks if isinstance(b, SetpointBlock) for s in b.setpoints}
        return not named or self.setup.plan.name in named

    def _of_the_table(self, block: JointBlock) -> bool:
        """Say whether joint states are the table's: other joints may share its topic."""
        table = self.setup.table
        return table is None or block.of(table.names) is not None

    def _await_skew(self) -> None:
        """Decide whether there is a skewed gyro, as reprocessing will: by what has come of it."""
        imu = self.intakes[Kind.IMU]
        if self.intakes[Kind.SKEW].count:
            self._begin(with_skew=True)
        elif imu.oldest is not None and imu.newest is not None:
            spanned = (imu.newest - imu.oldest) * 1e-9
            if min(spanned, time.monotonic() - self._began) > _SKEW_AWAITED:
                self._begin(with_skew=False)

    def _begin(self, *, with_skew: bool) -> None:
        """Begin to calibrate, first of all with what has come in before."""
        self.without_skew = not with_skew
        imu = self.setup.imu if with_skew else replace(self.setup.imu, skewed=None)
        self._calibrator = calibrator_of(replace(self._solved, imu=imu))
        held, self._held = self._held, []
        for block in held:
            self._calibrator.feed(block)
        if held and self.without_skew and self.setup.method_name == 'skewed':
            lost = ', '.join(p.name for p in skewed_parameters(1))
            self.fail(
                f'Nothing comes on {self.intakes[Kind.SKEW].topic}, while '
                f'{self.intakes[Kind.IMU].topic} does: {lost} cannot be determined. Let the '
                'driver publish it (imu_node: a device file with the field skew), and call ~/reset.'
            )

    def _was_set_back(self, intake: TopicIntake, blocks: Sequence[Block]) -> bool:
        """Fail where stamps begin so far before the journal's last that steps would be lost.

        Samples older than those before them are left out, one by one and until the old time is
        reached: of a simulation that began anew that may be the whole session.
        """
        timed = [b for b in blocks if isinstance(b, ImuBlock | JointBlock) and len(b)]
        last = self._left.pop(intake.kind, None) if timed else None
        if last is None or (first := int(timed[0].stamp[0])) > last - _SET_BACK:
            return False
        self.fail(
            f'Stamps on {intake.topic} begin at {at(first)}, {(last - first) * 1e-9:.0f} s before '
            f'the end of the journal {self.journal.path}: the clock was set back, or a simulation '
            'began anew. Up to then nothing could be used. Set the clock right, or give another '
            'journal, and start again.',
            finished=False,
        )
        return True

    def _name_the_gap(self, first: int) -> None:
        """Say how long the session was interrupted, where the stream alone does not tell."""
        if self._left_at is not None and first - self._left_at <= INTERRUPTION:
            self.notes.append(f'{interruption(self._left_at, first)}.')
        self._left_at = None
