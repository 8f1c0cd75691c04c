"""State of a running stand for the command line."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from ..live import middleware as ros
from ..live.middleware import messages
from ..live.nodes import qos
from ..live.nodes.intake import listen_to_each
from ..live.web.board import Board, UnitsBoard
from .processes import Nodes
from .terminal import NodeReports

_DEEP = 100  #: Queue depth: several nodes publish at once, and no message may be lost.


class Monitor:
    """Subscribes to turntable/state, calibration/progress, calibration and /diagnostics."""

    def __init__(
        self,
        nodes: Nodes,
        reports: NodeReports,
        board: Board | UnitsBoard | None = None,
    ) -> None:
        self._nodes = nodes
        self._node = nodes.join('imu_calib_stand')
        self._reports = reports
        self._board = board
        self._several = isinstance(board, UnitsBoard)
        self._state: Any = None
        self._progress: Any = None
        self._service: Any = None
        self._answer: Any = None
        self._span = (0.0, 0.0)
        self._first: float | None = None
        self._last = 0.0
        #: Whether there is a calibration, with the final message; None while it runs.
        self.outcome: tuple[bool, str] | None = None
        self.stopped = ''  #: Why the table stopped before the end of its plan, else empty.
        subscribe = self._node.create_subscription
        subscribe(messages.TurntableState, 'turntable/state', self._on_state, qos.latched())
        subscribe(
            messages.CalibrationProgress, 'calibration/progress', self._on_progress, qos.latched()
        )
        if isinstance(board, UnitsBoard):
            listen_to_each(self._node, board)
            subscribe(messages.DiagnosticArray, '/diagnostics', self._on_diagnostics, _DEEP)
        else:
            subscribe(messages.ImuCalibration, 'calibration', self._on_calibration, qos.latched())
            subscribe(messages.DiagnosticArray, '/diagnostics', reports.receive, _DEEP)

    def _on_diagnostics(self, message: Any) -> None:
        self._reports.receive(message)
        if isinstance(self._board, UnitsBoard):
            self._board.on_diagnostics(message, time.monotonic())

    def spin(self, seconds: float) -> None:
        """Receive messages for a time, and show the reports of the nodes."""
        self._nodes.spin(self._node, seconds)
        self._reports.show()

    @property
    def is_running(self) -> bool:
        """Whether the table runs its plan."""
        return self._first is not None

    @property
    def duration(self) -> float:
        """Time for which the plan has run, s of the stand's time."""
        return 0.0 if self._first is None else self._last - self._first

    @property
    def text(self) -> str:
        """One line on the present state."""
        if self._state is None:
            return 'no message of turntable_node has come'
        state, progress = self._state, self._progress
        words = [f'step {state.step + 1} of {state.steps}'] if state.steps else ['waiting']
        if state.position_id:
            words.append(f'position {state.position_id}')
        if progress is not None:
            known = sum(value > 0 for value in progress.standard_deviations)
            words.append(f'{known} of {len(progress.parameter_names)} parameters')
        return ', '.join(words)

    @property
    def progress(self) -> Any:
        """The last imu_calib_msgs/CalibrationProgress; None before the first."""
        return self._progress

    @property
    def data_span(self) -> float:
        """Time between the first and the last data in progress reports, s."""
        return self._span[1] - self._span[0]

    def solve(self) -> None:
        """Request the calibrator to end the session with the data received so far."""
        if self._service is None:
            self._service = self._node.create_client(ros.Trigger, 'calibrator_node/solve')
        self._answer = self._service.call_async(ros.Trigger.Request())

    @property
    def refusal(self) -> str:
        """Why the calibrator refused to end the session, else empty."""
        answer = self._answer
        if answer is None or not answer.done() or answer.result() is None:
            return ''
        return '' if answer.result().success else str(answer.result().message)

    def close(self) -> None:
        """Leave the network."""
        self._nodes.leave(self._node)

    def _on_state(self, message: Any) -> None:
        self._state = message
        if self._board is not None:
            self._board.on_state(message, time.monotonic())
        now = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
        stopped = message.phase in {message.PAUSED, message.ABORTED}
        self.stopped = message.reason if stopped else ''
        if message.phase in {message.IDLE, message.DONE}:
            return
        self._first = now if self._first is None else self._first
        self._last = now

    def _on_progress(self, message: Any) -> None:
        self._progress = message
        if self._board is not None:
            self._board.on_progress(message, time.monotonic())
        now = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
        if now > 0:
            self._span = (self._span[0] or now, now)
        if self._several and message.state in {message.FINISHED, message.FAILED}:
            self.outcome = message.state == message.FINISHED, message.text

    def _on_calibration(self, message: Any) -> None:
        if isinstance(self._board, Board):
            self._board.on_calibration(message)
        if message.status in {message.VALID, message.INCOMPLETE}:
            self.outcome = True, message.status_text.replace('\n', ' ')
        elif message.status == message.REFUSED:
            self.outcome = False, message.status_text


@contextmanager
def watching(
    nodes: Nodes, reports: NodeReports, board: Board | UnitsBoard | None = None
) -> Iterator[Monitor]:
    """Join the nodes of a stand with a monitor; leave them at the end of the block."""
    reports.nodes = nodes.names
    monitor = Monitor(nodes, reports, board)
    try:
        yield monitor
    finally:
        monitor.close()
