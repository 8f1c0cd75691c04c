"""The sessions of all units on one table: they begin, receive data, and end together."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ...calibration.calibration import Calibration
from ...calibration.calibrator import estimate_together
from ...calibration.results import Result, Review
from ...common.errors import ImuCalibError, InputError
from ...estimation.setup import Setup
from ...recordings.cdr_codec import Kind
from ...recordings.writer import Journal
from ...session.metadata import LEFT_OUT
from ...session.units_file import namespace
from .. import middleware as ros
from ..middleware import messages
from ..rules import Severity
from . import qos
from .convert import calibration_message, final_status, refusal_message
from .diagnostics import Diagnostics, PartOfDiagnostics
from .live import LiveSession, SessionPhase
from .session_parameters import StatedUnit
from .session_reports import is_fed, progress_message, report_session, session_sentence
from .shared import AnyCalibrator, SharedJournal, SharedSolver, SolverPart

_LEFT_OUT = 'The unit was left out of the session.'


class Sessions:
    """A `LiveSession` for each unit, with a common journal.

    Attributes:
        all: One for each unit, in their order.
        left_out: Places of the units that the user has excluded.

    Args:
        units: At least one.
        topics: Full names of each unit's topics by content.
        journal: Open; data from before a crash is read first, in one pass.
        common: Full names of the table's topics by content.

    Raises:
        InputError: The journal does not match the set-up.
    """

    def __init__(
        self,
        units: Sequence[StatedUnit],
        topics: Sequence[Mapping[Kind, str]],
        journal: Journal,
        common: Mapping[Kind, str],
    ) -> None:
        self.left_out: set[int] = set()
        self.journal = journal
        self._names = [unit.name for unit in units]
        self._solver = SharedSolver(concluded)
        self._parts = [SolverPart(self._solver, unit.setup.serial_number) for unit in units]
        shared = SharedJournal(journal, frozenset(common.values()))
        self.all = tuple(
            LiveSession(unit.setup, shared.part(), {**common, **own}, part, unit.solved)
            for unit, own, part in zip(units, topics, self._parts, strict=True)
        )
        if journal.resumed:
            self._replay_journal()
        else:
            for session in self.all:
                session.notes += journal.losses

    def _replay_journal(self) -> None:
        """Feed the sessions with the journal's data from before a crash."""
        fed: dict[str, list[tuple[LiveSession, Kind]]] = {}
        for session in self.all:
            for kind, intake in session.intakes.items():
                fed.setdefault(intake.topic, []).append((session, kind))
        for topic, block in self.journal.replay():
            for session, kind in fed[topic]:
                session.feed_former(kind, block)
        for session in self.all:
            session.end_of_journal(self.journal.losses)
        for name in filter(None, self.journal.former.get(LEFT_OUT, '').split(',')):
            self.leave_out(self._names.index(name))

    @property
    def is_over(self) -> bool:
        """Whether no more messages are accepted."""
        return all(session.is_over for session in self.all)

    @property
    def open(self) -> list[LiveSession]:
        """The sessions of the units that were not excluded."""
        return [s for k, s in enumerate(self.all) if k not in self.left_out]

    @property
    def may_review(self) -> bool:
        """Whether the pause since the last round of reviews is as long as that round."""
        return self._solver.may_review

    def add_common_messages(self, kind: Kind, payloads: Sequence[bytes], now: int) -> None:
        """Add messages of the table; see `LiveSession.add_messages`."""
        for session in self.all:
            if not session.is_over:
                session.add_messages(kind, payloads, now)

    def record(self, topic: str, type_name: str, payload: bytes, now: int) -> None:
        """Record a message that calibration does not use."""
        for session in self.all:
            if not session.is_over:
                session.record(topic, type_name, payload, now)
                return

    def leave_out(self, place: int) -> None:
        """Continue without a unit: its session ends without a result, its topic is not recorded.

        The recording states this, so that reprocessing excludes it too.
        """
        self.left_out.add(place)
        names = ','.join(self._names[k] for k in sorted(self.left_out))
        self.journal.note({LEFT_OUT: names})
        self.all[place].fail(_LEFT_OUT)

    def poll(self) -> list[int]:
        """Check for results of the solver and for the end; return the units with news."""
        news = [place for place, session in enumerate(self.all) if session.poll()]
        parts = [p for p, s in zip(self._parts, self.all, strict=True) if not s.is_over]
        if parts and all(part.ready for part in parts):
            self._solver.conclude(parts)
        return news

    def solve(self) -> None:
        """Begin a round of reviews, one of each session, if the last one is long enough ago."""
        if self.may_review:
            for session in self.all:
                session.solve()

    def end(self) -> None:
        """Solve the received data for the final results."""
        for session in self.all:
            session.end()

    def flush(self) -> None:
        """Secure the received data, and retry what a full disk refused."""
        for session in self.all:
            session.flush()

    def close(self) -> None:
        """Close the journal so that it can be resumed."""
        self._solver.threads.shutdown(wait=False, cancel_futures=True)
        for session in self.all:
            session.close()

    @property
    def held(self) -> int:
        """Number of messages taken, those of the journal included."""
        counts = {i.topic: i.count for session in self.all for i in session.intakes.values()}
        return sum(counts.values())

    @property
    def phase(self) -> SessionPhase:
        """The least advanced phase of the open sessions; the worst once one failed.

        With several units it is FINISHED as soon as one of them has a result.
        """
        phases = [session.phase for session in self.open]
        if phases and all(session.is_over for session in self.open):
            return SessionPhase.FINISHED if SessionPhase.FINISHED in phases else phases[0]
        if SessionPhase.FAILED in phases or not phases:
            return SessionPhase.FAILED
        return min(phases)


def concluded(
    calibrators: Sequence[AnyCalibrator], serials: Sequence[str]
) -> list[Review | ImuCalibError]:
    """Conclude sessions: each by itself, then their common table errors from all of them.

    Args:
        calibrators: With all data.
        serials: Serial numbers of the units.

    Returns:
        A review of each, or the error that prevented it.
    """
    each = [_reviewed(calibrator) for calibrator in calibrators]
    if len(each) == 1:
        return each
    # In the order of names: floating-point sums depend on the order.
    order = sorted(range(len(each)), key=lambda k: namespace(serials[k]))
    results = [one.result if isinstance(one, Review) else None for one in each]
    shared = estimate_together([results[k] for k in order], [serials[k] for k in order]).results
    for k, result in zip(order, shared, strict=True):
        one = each[k]
        if isinstance(one, Review):
            each[k] = _with(one, result)
    return each


def _with(review: Review, result: Result | None) -> Review:
    """Return a review with another result of its session."""
    if result is None or result is review.result:
        return review
    std = dict(zip(result.calibration.parameters, result.calibration.std, strict=True))
    return replace(
        review, result=result, std=np.array([std.get(p, np.nan) for p in review.parameters])
    )


def _reviewed(calibrator: AnyCalibrator) -> Review | ImuCalibError:
    try:
        return calibrator.conclude()
    except ImuCalibError as error:
        return error


_ENDS = frozenset({SessionPhase.FINISHED, SessionPhase.FAILED})


def progress_of_all(
    sessions: Sessions, each: Sequence[Any], imu_timeout: float, folder: Path
) -> Any:
    """Return the common progress of the sessions; the node that runs the plan uses it.

    The standard deviation of a parameter is that of the unit with the largest. Steps are repeated
    if any unit whose session continues lacks their data. Excluded units do not count.

    Args:
        sessions: Of all units.
        each: imu_calib_msgs/CalibrationProgress of each, in their order.
        imu_timeout: Longest silence of a unit against the table, s.
        folder: Folder of the results.
    """
    open_ = [(s, m) for s, m in zip(sessions.all, each, strict=True) if s in sessions.open]
    running = [(s, m) for s, m in open_ if not s.is_over] or open_ or [(sessions.all[0], each[0])]
    std: dict[str, float] = {}
    for _, message in running:
        pairs = zip(message.parameter_names, message.standard_deviations, strict=True)
        for name, value in pairs:
            # A NaN is worse than any number, and is kept.
            least = std.get(name, 0.0)
            std[name] = math.nan if math.isnan(value + least) else max(least, float(value))
    state, text = _state(sessions, imu_timeout)
    first = each[0]
    common = messages.CalibrationProgress(
        plan=first.plan,
        step=max(int(message.step) for message in each),
        steps=first.steps,
        state=int(state),
        text=text,
        parameter_names=list(std),
        standard_deviations=list(std.values()),
        seconds_left=first.seconds_left,
        repeat_steps=sorted({int(k) for _, message in running for k in message.repeat_steps}),
        file=str(folder.absolute()),
        journal=first.journal,
        serial_numbers=[session.setup.serial_number for session in sessions.open],
    )
    stamps = [message.header.stamp for _, message in running]
    common.header.stamp = min(stamps, key=lambda stamp: (stamp.sec, stamp.nanosec))
    return common


def _state(sessions: Sessions, imu_timeout: float) -> tuple[SessionPhase, str]:
    """Return the common phase, and a sentence on it."""
    trouble = next((s.trouble for s in sessions.open if s.trouble), '')
    if trouble:
        # A full disk stops the table: further data could not be recorded.
        return SessionPhase.FAILED, trouble
    phase = sessions.phase
    failed = [s for s in sessions.open if s.phase is SessionPhase.FAILED]
    reasons = ' '.join(f'{_name(s)}: {s.failure}' for s in failed)
    if not sessions.open:
        return phase, 'All units are left out.'
    if phase in _ENDS:
        done = len(sessions.open) - len(failed)
        if sessions.is_over:
            return phase, f'{done} of {len(sessions.open)} units are calibrated. {reasons}'.strip()
        return phase, f'{reasons} Leave the unit out to go on with the others, or call ~/reset.'
    silent = [s for s in sessions.open if not is_fed(s, imu_timeout)]
    if silent and phase is not SessionPhase.FINISHED:
        names = ', '.join(_name(s) for s in silent)
        return SessionPhase.WAITING, f'No samples come from {names}.'
    running = [s for s in sessions.open if not s.is_over] or sessions.open
    known = [0 if s.review is None else int((s.review.std > 0).sum()) for s in running]
    least = running[known.index(min(known))]
    reached = f'{min(known)} of {len(least.parameters)} parameters'
    return (
        phase,
        f'{len(sessions.open)} units; {_name(least)} has the fewest determined: {reached}.',
    )


def _name(session: LiveSession) -> str:
    return session.setup.serial_number


class UnitResults:
    """The topics calibration and calibration/progress of a unit, its file, and its diagnostics.

    Args:
        node: The node that publishes.
        setup: Of the unit.
        namespace: Of its topics; empty for a single unit.
        output: File of the result.
        diagnostics: Of the node.
    """

    def __init__(
        self,
        node: ros.Node,
        setup: Setup,
        namespace: str,
        output: Path,
        diagnostics: Diagnostics,
    ) -> None:
        self._node = node
        self._setup = setup
        self.output = output
        self._shown: Calibration | None = None
        self._stand: Diagnostics | None = None
        self._diagnostics: Diagnostics | PartOfDiagnostics = diagnostics
        within = ''
        if namespace:
            within = f'{namespace}/'
            hardware = f'{setup.imu.id} {setup.serial_number}'
            self._stand = diagnostics
            self._diagnostics = PartOfDiagnostics(diagnostics, namespace, hardware)
        self.result = node.create_publisher(
            messages.ImuCalibration, f'{within}calibration', qos.latched()
        )
        self.progress = node.create_publisher(
            messages.CalibrationProgress, f'{within}calibration/progress', qos.latched()
        )

    def begin(self) -> None:
        """Begin a session."""
        self._shown = None

    def publish(self, session: LiveSession) -> Any:
        """Publish the calibration if it changed; return a final message, else None."""
        now = self._node.get_clock().now().to_msg()
        if session.phase is SessionPhase.FAILED:
            message = refusal_message(
                self._setup.imu, self._setup.plan.name, session.failure, session.frame_id, now
            )
            if self._stand is not None:
                # The serial number distinguishes several units.
                message.serial_number = self._setup.serial_number
            self.result.publish(message)
            return message
        if session.calibration is None or not self._is_news(session, session.calibration):
            return None
        self._shown = session.calibration
        final = session.phase is SessionPhase.FINISHED
        status = messages.ImuCalibration.PROVISIONAL
        if final:
            status = final_status(session.calibration)
        message = calibration_message(session.calibration, status, session.frame_id, now)
        self.result.publish(message)
        if not final:
            return None
        self.save(session)
        return message

    def _is_news(self, session: LiveSession, calibration: Calibration) -> bool:
        return (
            self._shown is None
            or session.phase is SessionPhase.FINISHED
            or calibration.provenance['samples'] != self._shown.provenance['samples']
        )

    def publish_progress(self, session: LiveSession, steps: int, seconds_left: float) -> Any:
        """Publish the progress of the session; return the message."""
        message = progress_message(session, steps, seconds_left, self.output)
        self.progress.publish(message)
        return message

    def report(self, session: LiveSession, imu_timeout: float) -> None:
        """Report the state of its streams and calibration on /diagnostics."""
        report_session(session, self._diagnostics, imu_timeout, self._stand)

    def report_part(self, part: str, level: Severity, text: str) -> None:
        """Report on a part of the unit on /diagnostics."""
        self._diagnostics.report(part, level, text)

    def save(self, session: LiveSession) -> str:
        """Write the result; return why that failed, else empty."""
        if session.calibration is None:
            return f'Nothing is written: there is no result yet. {session_sentence(session)}'
        try:
            session.calibration.save(self.output)
        except InputError as error:
            self._diagnostics.report('file', Severity.ERROR, str(error))
            return str(error)
        self._diagnostics.report('file', Severity.OK, f'{self.output} is written.')
        return ''
