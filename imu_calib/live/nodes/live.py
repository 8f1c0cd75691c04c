"""A session that is recorded and solved while it runs; independent of the middleware."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from enum import IntEnum
from pathlib import Path

from ...calibration.calibration import Calibration
from ...calibration.calibrator import Calibrator, calibrator_of
from ...calibration.hand import Guidance, HandCalibrator, HandReview, Stage
from ...calibration.results import Review
from ...common.errors import ImuCalibError
from ...common.stream import Block, ImuBlock, JointBlock, Mode, SetpointBlock, at
from ...estimation.setup import Setup
from ...model.parameters import Parameter, skewed_parameters
from ...recordings.cdr import Malformed, Messages
from ...recordings.cdr_codec import Kind
from ...segmentation.interruptions import INTERRUPTION, interruption
from .shared import JournalPart, SolverPart
from .subscriptions import TopicIntake

_SKEW_AWAITED = 10.0
"""Longest time for which IMU samples come without the skewed gyro: s, by stamps and by the
clock."""


class CalibratorFeed:
    """Holds blocks back until the calibrator can be created, then feeds it.

    Args:
        setup: What is calibrated, and how.
        topics: Full topic names by content; a skewed gyro is expected if its topic is among them.

    Attributes:
        calibrator: None while the presence of a skewed gyro is unknown.
        without_skew: Whether the session continues without a skewed gyro.

    Raises:
        InputError: The method cannot solve the plan.
    """

    def __init__(self, setup: Setup, topics: Mapping[Kind, str]) -> None:
        self._setup = setup
        self._topics = topics
        self._began = time.monotonic()
        self._held: list[Block] = []
        self.without_skew = False
        # Refuse a plan that the method cannot solve now, before the calibrator is created.
        calibrator_of(setup)
        self.calibrator: Calibrator | HandCalibrator | None = None
        if setup.imu.skewed is None or Kind.SKEW not in topics:
            self.begin(with_skew=False)

    def add_block(self, block: Block, intakes: Mapping[Kind, TopicIntake]) -> str:
        """Add a block, or hold it back; return as `begin`.

        The received samples decide on the skewed gyro, as in reprocessing.
        """
        if self.calibrator is not None:
            self.calibrator.add_block(block)
            return ''
        self._held.append(block)
        imu = intakes[Kind.IMU]
        if intakes[Kind.SKEW].count:
            return self.begin(with_skew=True)
        if imu.oldest is not None and imu.newest is not None:
            spanned = (imu.newest - imu.oldest) * 1e-9
            if min(spanned, time.monotonic() - self._began) > _SKEW_AWAITED:
                return self.begin(with_skew=False)
        return ''

    def begin(self, *, with_skew: bool) -> str:
        """Create the calibrator, and feed it with the blocks received before.

        Returns:
            Why the session cannot succeed, in sentences; else empty.
        """
        self.without_skew = not with_skew
        imu = self._setup.imu if with_skew else replace(self._setup.imu, skewed=None)
        self.calibrator = calibrator_of(replace(self._setup, imu=imu))
        held, self._held = self._held, []
        for block in held:
            self.calibrator.add_block(block)
        if with_skew or not held or self._setup.method_name != 'skewed':
            return ''
        lost = ', '.join(p.name for p in skewed_parameters(1))
        return (
            f'{self._topics[Kind.IMU]} is received, {self._topics[Kind.SKEW]} is not: {lost} '
            'cannot be determined. Let the driver publish it (imu_node: a device file with the '
            'field skew), and call ~/reset.'
        )


_SET_BACK = 10_000_000_000
"""ns that stamps may begin before a journal's last: less than the shortest step of the plans."""


class FormerSession:
    """The last stamps of a journal, compared with the first ones after it.

    Args:
        journal: Its folder.
        intakes: The topics after the whole journal was read.
    """

    def __init__(self, journal: Path, intakes: Mapping[Kind, TopicIntake]) -> None:
        self._journal = journal
        self._imu_end = intakes[Kind.IMU].newest
        timed = {k: intakes[k].newest for k in (Kind.IMU, Kind.JOINTS) if k in intakes}
        self._ends = {k: newest for k, newest in timed.items() if newest is not None}

    def adjust_to_journal(self, intake: TopicIntake, blocks: Sequence[Block]) -> str:
        """Return a warning if stamps begin so far before the journal's last that steps are lost.

        Samples older than the preceding ones are dropped until the old time is reached: after a
        restart of a simulation that may be the whole session.
        """
        timed = [b for b in blocks if isinstance(b, ImuBlock | JointBlock) and len(b)]
        last = self._ends.pop(intake.kind, None) if timed else None
        if last is None or (first := int(timed[0].stamp[0])) > last - _SET_BACK:
            return ''
        return (
            f'Stamps on {intake.topic} begin at {at(first)}, {(last - first) * 1e-9:.0f} s before '
            f'the end of the journal {self._journal}: the clock was set back, or a simulation '
            'began anew, and these samples are ignored. Set the clock right or give another '
            'journal, and start again.'
        )

    def gap(self, first: int) -> str:
        """Return how long the session was interrupted, where the stream alone does not show it.

        Args:
            first: Stamp of the first IMU sample after it, ns; later ones are ignored.
        """
        last, self._imu_end = self._imu_end, None
        if last is None or first - last > INTERRUPTION:
            return ''
        return f'{interruption(last, first)}.'


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

    Attributes:
        setup: What is calibrated, and how.
        journal: Its part of the recording.
        intakes: The topics by content.
        phase: Progress of the session.
        failure: Why it failed, else empty.
        notes: Messages for the user in addition to the calibration's findings.
        review: Result of the last solution; None before the first.
        calibration: The result so far; None while it is not determined.
        worked_until: Stamp up to which the last review reaches, ns: of the joints, of the IMU
            without a table.
        frame_id: The IMU's frame.
        steps_seen: Steps of the plan that have been commanded: up to the last one seen.

    Args:
        setup: What is calibrated, and how.
        journal: Its part of the recording.
        topics: Full topic names by content; a skewed gyro is expected if its topic is among them.
        solver: Solves the session.
        solved: The set-up used to solve: without the plan for a unit whose axes differ from the
            plan's.

    Raises:
        InputError: The method cannot solve the plan.
    """

    def __init__(
        self,
        setup: Setup,
        journal: JournalPart,
        topics: dict[Kind, str],
        solver: SolverPart,
        solved: Setup,
    ) -> None:
        self.setup = setup
        self.journal = journal
        self._solved = solved
        now = time.monotonic()
        self.intakes = {k: TopicIntake(k, topic, Malformed(), now) for k, topic in topics.items()}
        self.phase = SessionPhase.WAITING
        self.failure = ''
        self.notes: list[str] = []
        self.review: Review | None = None
        self.calibration: Calibration | None = None
        self.worked_until = 0
        self.frame_id = ''
        self.steps_seen = 0
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
        """Add serialised messages of a topic.

        Args:
            kind: Content of the topic.
            payloads: At least one message.
            now: Host time, ns.
        """
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

    def fail(self, reason: str, *, finished: bool = True) -> None:
        """End the session without a result.

        Args:
            reason: Why.
            finished: Whether the journal is kept for inspection only; else it can be resumed.
        """
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
        provenance = {'recording': self.journal.path.name, **calibration.provenance}
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
