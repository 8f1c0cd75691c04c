"""What a calibrator publishes and writes for one unit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ...calibration.calibration import Calibration
from ...common.errors import InputError
from ...estimation.methods import Setup
from .. import middleware as ros
from ..middleware import messages
from . import qos
from .convert import calibration_message, final_status, refusal_message
from .diagnostics import Diagnostics, Level, PartOfDiagnostics
from .live import LiveSession, SessionPhase
from .session_reports import progress_message, report_session, session_sentence


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

    def report_part(self, part: str, level: Level, text: str) -> None:
        """Report on a part of the unit on /diagnostics."""
        self._diagnostics.report(part, level, text)

    def save(self, session: LiveSession) -> str:
        """Write the result; return why that failed, else empty."""
        if session.calibration is None:
            return f'Nothing is written: there is no result yet. {session_sentence(session)}'
        try:
            session.calibration.save(self.output)
        except InputError as error:
            self._diagnostics.report('file', Level.ERROR, str(error))
            return str(error)
        self._diagnostics.report('file', Level.OK, f'{self.output} is written.')
        return ''
