"""Progress, results and /diagnostics of sessions, each and all."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ...calibration.calibration import Calibration
from ...calibration.results import Review
from ...common.errors import InputError, beginning
from ...common.finding import is_warning, without_label
from ...common.stream import NS
from ...common.units import significant
from ...estimation.setup import Setup
from ...model.parameters import Parameter, engineering
from ...recordings.cdr_codec import Kind
from .. import middleware as ros
from ..middleware import messages
from ..rules import Severity
from . import qos
from .convert import calibration_message, final_status, refusal_message
from .diagnostics import Diagnostics, PartOfDiagnostics
from .intake import TopicIntake
from .live_session import LiveSession, SessionPhase
from .qos import none_yet
from .sessions import Sessions

IMU_TIMEOUT = 0.5
"""s: default of the longest silence of the IMU against the table, as that of imu_node."""
_SILENCE_BY_HAND = 2.0
"""s of silence after which a driver counts as gone, without a table as reference; a choice."""

_APART = 60.0
"""s between the newest stamps of IMU and table that show two different clocks. A judgement: no
queue delays samples that long, even at twenty times real time."""


def session_sentence(session: LiveSession) -> str:
    """Return a sentence on the progress of a session or its fault."""
    if session.failure or session.trouble:
        return session.failure or session.trouble
    known = 0 if session.review is None else int((session.review.std > 0).sum())
    imu = session.intakes[Kind.IMU]
    if session.guidance is not None and not session.is_over:
        return session.guidance.text
    words = {
        SessionPhase.WAITING: f'Waiting for {imu.topic}.',
        SessionPhase.COLLECTING: f'{known} of {len(session.parameters)} parameters are determined.',
        SessionPhase.DETERMINED: f'{known} parameters are determined, and still improving.',
        SessionPhase.FINISHED: f'{known} parameters are determined.',
        SessionPhase.FAILED: session.failure,
    }
    return words[session.phase]


def progress_message(session: LiveSession, steps: int, seconds_left: float, file: Path) -> Any:
    """Return the progress of a session as a message."""
    review = session.review
    stamp = messages.TimeMsg(sec=session.worked_until // NS, nanosec=session.worked_until % NS)
    names = [parameter.name for parameter in session.parameters]
    guidance = session.guidance
    message = messages.CalibrationProgress(
        plan=session.setup.plan.name,
        step=session.steps_seen if guidance is None else guidance.holds,
        steps=steps,
        # A full disk stops the table: further data could not be recorded.
        state=int(SessionPhase.FAILED if session.trouble else session.phase),
        text=session_sentence(session),
        parameter_names=names,
        standard_deviations=([math.nan] * len(names) if review is None else review.std.tolist()),
        seconds_left=seconds_left,
        repeat_steps=[] if review is None else list(review.unsupported),
        next_attitudes=[] if guidance is None else [c.words for c in guidance.candidates],
        next_gains=[] if guidance is None else [float(c.gain) for c in guidance.candidates],
        file=str(file.absolute()),
        journal=str(session.journal.path.absolute()),
    )
    message.header.stamp = stamp
    return message


def report_session(
    session: LiveSession,
    diagnostics: Diagnostics | PartOfDiagnostics,
    imu_timeout: float,
    stand: Diagnostics | None = None,
) -> None:
    """Report streams and calibration on /diagnostics; of several units shared topics to `stand`."""
    shared = stand or diagnostics
    _report_imu(session, diagnostics, imu_timeout)
    _report_joint_states(session, shared)
    _report_skew(session, diagnostics)
    level = Severity.OK
    figures = {} if session.review is None else _std_figures(session.review)
    text = session_sentence(session)
    if session.phase is SessionPhase.FAILED:
        level = Severity.ERROR
    elif session.phase is SessionPhase.FINISHED and session.calibration is not None:
        findings = session.calibration.findings
        warnings = [without_label(found) for found in findings if is_warning(found)]
        level = Severity.WARN if warnings else Severity.OK
        text = ' '.join([text, *warnings])
        figures |= {f'finding {k}': found for k, found in enumerate(findings, 1)}
    if session.guidance is not None and not session.is_over:
        known = int((session.review.std > 0).sum()) if session.review is not None else 0
        total = len(session.parameters)
        text = f'{session.guidance.holds} holds, {known} of {total} parameters are determined.'
    diagnostics.report('calibration', level, text, **figures)
    if session.trouble:
        shared.report('journal', Severity.ERROR, session.trouble)
    elif not session.is_over:
        shared.report('journal', Severity.OK, journal_sentence(session.journal.path))


def is_fed(session: LiveSession, imu_timeout: float) -> bool:
    """Return whether samples come, and keep up with the table."""
    imu, joints = session.intakes[Kind.IMU], session.intakes[Kind.JOINTS]
    if imu.newest is None or joints.newest is None:
        return imu.newest is not None
    behind = (joints.newest - imu.newest) * 1e-9
    return not (behind > imu_timeout and time.monotonic() - imu.received_at > imu_timeout)


def _report_imu(
    session: LiveSession, diagnostics: Diagnostics | PartOfDiagnostics, imu_timeout: float
) -> None:
    """Report whether samples are received, and at the time of the table."""
    imu, joints = session.intakes[Kind.IMU], session.intakes.get(Kind.JOINTS)
    figures = {'samples': str(imu.count), 'malformed': str(imu.malformed.count)}
    level, text = _reception(imu)
    behind = math.nan
    if imu.newest is not None and joints is not None and joints.newest is not None:
        behind = (joints.newest - imu.newest) * 1e-9
        figures['behind the table'] = f'{behind:.3f} s'
    if level is Severity.OK and not session.is_over:
        fault = ''
        if joints is None:
            if time.monotonic() - imu.received_at > max(_SILENCE_BY_HAND, imu_timeout):
                fault = f'{imu.topic} is silent.'
        elif not is_fed(session, imu_timeout):
            fault = f'{imu.topic} is silent, but the table is not.'
        elif abs(behind) > _APART:
            side = 'behind' if behind > 0 else 'ahead of'
            fault = (
                f'{imu.topic} is stamped {abs(behind):.0f} s {side} {joints.topic}, by another '
                'clock, and no sample can be used. Synchronise the clocks, or stamp the samples '
                'as they arrive.'
            )
        if fault:
            level, text = Severity.ERROR, fault
    diagnostics.report('stream', level, text, **figures)


def _report_joint_states(
    session: LiveSession, diagnostics: Diagnostics | PartOfDiagnostics
) -> None:
    """Report whether joint states of the table, if there is one, are received."""
    joints = session.intakes.get(Kind.JOINTS)
    if joints is None:
        return
    level, text = _reception(joints)
    figures = {
        'samples': str(joints.count),
        'of other joints': str(joints.ignored),
        'malformed': str(joints.malformed.count),
    }
    if joints.ignored and not joints.count and session.setup.table is not None:
        names = ', '.join(session.setup.table.names)
        text = f'No message on {joints.topic} has all joints of the table ({names}) yet.'
    diagnostics.report('joint states', level, text, **figures)


def _report_skew(session: LiveSession, diagnostics: Diagnostics | PartOfDiagnostics) -> None:
    """Report whether the skewed gyro, if the IMU's file names one, is received."""
    skew = session.intakes.get(Kind.SKEW)
    if skew is None:
        return
    level, text = _reception(skew)
    if session.without_skew and level is not Severity.ERROR:
        level = Severity.WARN
        text = (
            f"There is no message on {skew.topic}, though the IMU's file has a skewed_gyro: the "
            'session goes on without it.'
        )
    diagnostics.report('skewed gyro', level, text, samples=str(skew.count))


def _reception(intake: TopicIntake) -> tuple[Severity, str]:
    """Return whether a topic is received, and can be read."""
    if intake.malformed.count:
        return Severity.ERROR, f'{intake.topic}: {intake.malformed.reason}'
    if not intake.count:
        return Severity.WARN, none_yet(intake.topic)
    return Severity.OK, f'{intake.topic} is received.'


def journal_sentence(path: Path) -> str:
    """Return a sentence on where a session is recorded."""
    return f'The journal is written to {path}.'


def _std_figures(review: Review) -> dict[str, str]:
    """Return the standard deviation of each parameter, for /diagnostics."""
    return {
        f'std of {parameter.name}': _std_text(parameter, value)
        for parameter, value in zip(review.parameters, review.std.tolist(), strict=True)
    }


def _std_text(parameter: Parameter, value: float) -> str:
    """Return a standard deviation, SI, in the unit in which the parameter is shown."""
    if math.isnan(value):
        return 'not determined'
    shown = engineering(parameter)
    return f'{significant(value / shown.scale, 3)} {shown.unit}'.strip()


_ENDS = frozenset({SessionPhase.FINISHED, SessionPhase.FAILED})


def progress_of_all(
    sessions: Sessions, each: Sequence[Any], imu_timeout: float, folder: Path
) -> Any:
    """Return the common progress of the sessions; the node that runs the plan uses it.

    The standard deviation of a parameter is that of the unit with the largest. Steps are repeated
    if any unit whose session continues lacks their data. Excluded units do not count.
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
    reasons = ' '.join(f'{_name(s)}: {beginning(s.failure)}' for s in failed)
    if not sessions.open:
        return phase, 'All units are left out.'
    if phase in _ENDS:
        done = len(sessions.open) - len(failed)
        if sessions.is_over:
            return phase, f'{done} of {len(sessions.open)} units are calibrated. {reasons}'.strip()
        return phase, f'{reasons} Exclude the unit (~/leave_out), or call ~/reset.'
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
    """The topics calibration and calibration/progress of a unit, its file, and its diagnostics."""

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
