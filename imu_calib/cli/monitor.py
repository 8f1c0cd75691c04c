"""State of a running stand for the command line."""

from __future__ import annotations

import select
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from itertools import zip_longest
from typing import Any

import numpy as np
from rich.console import Group, JustifyMethod, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table as Rows
from rich.text import Text

from ..common.errors import InputError
from ..common.units import ARCMIN, PPM, significant
from ..reports.tables import plain_table
from ..reports.timeline import READING, Converging
from ..stand import middleware as ros
from ..stand.devices.health import Severity
from ..stand.middleware import messages
from ..stand.nodes import topics as qos
from ..stand.nodes.topics import listen_to_each
from ..stand.web.board import Board, Snapshot, UnitRow, UnitsBoard
from ..stand.web.drawing import headline, time_left
from .processes import START, Nodes, SessionEnd
from .terminal import ERRORS, OUTPUT, NodeReports

_DEEP = 100
"""Queue depth: several nodes publish at once, and no message may be lost."""


class Monitor:
    """Subscribes to turntable/state, calibration/progress, calibration and /diagnostics.

    Args:
        nodes: Of the stand.
        reports: Shows the reports of the nodes.
        board: Receives the messages for display, or None. A board of several units lists them.

    Attributes:
        outcome: Whether there is a calibration, with the final message; None while it runs.
        stopped: Why the table stopped before the end of its plan, else empty.
    """

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
        self.outcome: tuple[bool, str] | None = None
        self.stopped = ''
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
            self._board.take_diagnostics(message, time.monotonic())

    def spin(self, seconds: float) -> None:
        """Receive messages for a time, and show the reports of the nodes.

        Raises:
            InputError: The IMU cannot deliver data.
        """
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
    def remaining(self) -> float:
        """Time that the plan still needs, s of the stand's time."""
        return 0.0 if self._state is None else float(self._state.seconds_left)

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
            self._board.take_state(message, time.monotonic())
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
            self._board.take_progress(message, time.monotonic())
        now = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
        if now > 0:
            self._span = (self._span[0] or now, now)
        if self._several and message.state in {message.FINISHED, message.FAILED}:
            self.outcome = message.state == message.FINISHED, message.text

    def _on_calibration(self, message: Any) -> None:
        if isinstance(self._board, Board):
            self._board.take_calibration(message)
        if message.status in {message.VALID, message.INCOMPLETE}:
            self.outcome = True, message.status_text
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


# The terminal of a session on a table: present step, remaining time, and results so far.

_STYLES = {Severity.OK: 'bold', Severity.WARN: 'bold yellow', Severity.ERROR: 'bold red'}
_BAR = 30
"""Characters of the bar. A choice; layout."""
_COLUMNS = ('', 'std now', 'plan', 'limit', 'unit')
_UNIT_COLUMNS: tuple[tuple[str, JustifyMethod], ...] = (
    ('unit', 'left'),
    ('state', 'left'),
    ('rate', 'right'),
    ('lost', 'right'),
    ('known', 'right'),
    ('furthest from the plan', 'left'),
)
_WIDE = 78
"""Characters for two triads side by side; 12 rows then fit a small terminal."""


def view_table(shown: Snapshot, now: datetime, width: int, units: Sequence[UnitRow] = ()) -> Group:
    """Lay out a running session.

    Args:
        shown: Its state.
        now: Of the wall clock.
        width: Of the terminal, characters.
        units: Several units: each has a line in place of the parameters.
    """
    first = headline(shown)
    parts: list[RenderableType] = [Text(first.now, style=_STYLES[first.level])]
    if first.detail:
        parts.append(Text(first.detail))
    parts.append(_course(shown, now))
    if units:
        parts.append(unit_lines(units))
        return Group(*parts)
    known = sum(row.determined for row in shown.rows)
    parts.append(Text(f'{known} of {len(shown.rows)} parameters are determined'))
    if known:
        parts.append(_parameters(shown.rows, width))
    return Group(*parts)


def _course(shown: Snapshot, now: datetime) -> Rows:
    """Return the bar, the step and the remaining time, or that these are not known yet."""
    remaining, rests_on = time_left(shown, now)
    table = shown.table
    step = 'waiting'
    if table is not None and table.steps:
        step = f'step {min(table.step + 1, table.steps)} of {table.steps}'
    words = [f'{remaining} left' if remaining[0].isdigit() else remaining, rests_on]
    line = Rows.grid(padding=(0, 1))
    line.add_row(
        step,
        ProgressBar(total=1.0, completed=shown.share, width=_BAR),
        f'{100 * shown.share:.0f} %',
        ', '.join(filter(None, words)),
    )
    return line


def _parameters(rows: Sequence[Converging], width: int) -> Rows:
    """Return the deviations with the plan's prediction and the limits."""
    triads = [[row for row in rows if row.parameter.triad == triad] for triad in 'ga']
    wide = width >= _WIDE
    if not wide:
        triads = [[*triads[0], *triads[1]]]
    table = Rows(box=None, pad_edge=False, header_style='bold', padding=(0, 1, 0, 0))
    for _ in triads:
        for heading in _COLUMNS:
            words = heading in {'', 'unit'}
            table.add_column(heading, justify='left' if words else 'right', no_wrap=True)
    for row in zip_longest(*triads):
        table.add_row(*(cell for one in row for cell in _cells(one)))
    return table


def _cells(row: Converging | None) -> list[RenderableType]:
    if row is None:
        return [''] * len(_COLUMNS)
    limit = '' if row.limit is None else f'\u00b1{row.shown(row.limit)}'
    style = 'dim' if not row.determined else 'green' if row.is_reached else ''
    now = row.shown(row.std) if row.determined else '\u2013'
    return [row.parameter.name, Text(now, style=style), row.shown(row.predicted), limit, row.unit]


def unit_lines(units: Sequence[UnitRow]) -> Rows:
    """Return a line for each unit: its samples, and the parameter with the largest deviation."""
    table = Rows(box=None, pad_edge=False, header_style='bold', padding=(0, 1, 0, 0))
    for heading, justify in _UNIT_COLUMNS:
        table.add_column(heading, justify=justify, no_wrap=heading != 'state')
    for unit in units:
        table.add_row(
            unit.serial_number,
            Text(unit.words, style=_STYLES[unit.level].replace('bold', '').strip()),
            unit.rate or '\u2013',
            unit.lost or '\u2013',
            f'{unit.determined}/{unit.parameters}',
            least_known(unit),
        )
    return table


def least_known(unit: UnitRow) -> str:
    """Return the parameter furthest from the plan's prediction, with both deviations."""
    worst = unit.worst
    if worst is None:
        return '\u2013'
    now, plan = worst.shown(worst.std), worst.shown(worst.predicted)
    return f'{worst.parameter.name} \u00b1{now} (plan {plan}) {worst.unit}'.rstrip()


# The wait for a session to begin, which lasts as long as an old journal is read.

_JOURNAL = 'calibrator_node: journal'


class Start:
    """Follows the start of a session.

    Args:
        reports: Of the nodes.
        patience: Longest wait without progress in reading the journal, s.
    """

    def __init__(self, reports: NodeReports, patience: float) -> None:
        self._reports = reports
        self._patience = patience
        self._report = ''
        self._since = time.monotonic()

    @property
    def words(self) -> str:
        """What is waited for while the journal is read; else empty."""
        report = self._reports.text(_JOURNAL)
        if not report.startswith(READING):
            return ''
        return f'calibrator_node reads its journal: {report.removeprefix(READING)}'

    def check(self, otherwise: str) -> None:
        """Check that the wait is not too long.

        Args:
            otherwise: Why, if it is too long and no journal is read.

        Raises:
            InputError: It is.
        """
        now, report = time.monotonic(), self._reports.text(_JOURNAL)
        if report != self._report:
            if READING in report + self._report:
                self._since = now
            self._report = report
        if now - self._since > self._patience:
            words = self.words
            stuck = f'{words} This has not changed for {self._patience:.0f} s.' if words else ''
            raise InputError(stuck or otherwise)


# The display of a session in the hand: the next action, and the gain of each next attitude.

_SHOWN = 6
"""Attitudes shown at once: as many as fit above the bars of a small terminal."""
_HAND_BAR = 24
"""Characters of the longest bar. A choice; layout."""
_EVERYTHING = 'Enter ends the session with what is here, Ctrl-C without a result.'


def follow(processes: Nodes, reports: NodeReports) -> SessionEnd:
    """Guide a person until the session ends.

    Raises:
        InputError: A node has ended, or the IMU sends nothing.
    """
    with (
        watching(processes, reports) as monitor,
        Live(console=ERRORS, refresh_per_second=8, transient=True) as display,
    ):
        start = Start(reports, START)
        shown = ''
        while monitor.outcome is None:
            monitor.spin(0.1)
            processes.check()
            progress = monitor.progress
            if progress is not None and progress.state != progress.WAITING:
                display.update(view_hand(progress, monitor.refusal))
                shown = _print_changed(progress.text, shown)
            else:
                if start.words:
                    display.update(Text(start.words))
                start.check('The session does not start: the IMU sends nothing.')
            if _entered():
                monitor.solve()
        finished, text = monitor.outcome
        return SessionEnd(finished, text, monitor.data_span)


def view_hand(progress: Any, refusal: str = '') -> Group:
    """Lay out imu_calib_msgs/CalibrationProgress for a person with the unit in hand.

    Args:
        progress: The message.
        refusal: Why a request to end the session was refused, else empty.
    """
    best = max(progress.next_gains, default=0.0)
    rows = plain_table(('next', 'gain', ''), 'lrl')
    pairs = list(zip(progress.next_attitudes, progress.next_gains, strict=True))
    for words, gain in pairs[:_SHOWN]:
        bar = '#' * round(_HAND_BAR * gain / best) if best > 0 else ''
        rows.add_row(words, f'{gain:.2f}', bar)
    parts: list[Any] = [Text(progress.text, style='bold'), Text(reached(progress))]
    if pairs:
        parts.append(rows)
    if refusal:
        parts.append(Text(f'Not yet: {refusal}', style='yellow'))
    return Group(*parts, Text(_EVERYTHING, style='dim'))


def reached(progress: Any) -> str:
    """Return the number of holds, and the deviations of scale factors and angles so far."""
    std = np.array(progress.standard_deviations)
    kinds = np.array([name[0] for name in progress.parameter_names])
    words = [f'{progress.step} holds']
    for letter, what, unit, scale in (
        ('K', 'scale factors', 'ppm', PPM),
        ('E', 'misalignments', 'arcmin', ARCMIN),
    ):
        mine = std[kinds == letter]
        known = len(mine) > 0 and np.isfinite(mine).all()
        words.append(
            f'{what} to {significant(mine.max() / scale, 3)} {unit}' if known else f'{what} open'
        )
    return ', '.join(words)


def _print_changed(text: str, shown: str) -> str:
    """Print new text if the output is not a terminal; countdowns are omitted."""
    if not ERRORS.is_terminal and text != shown and not text.startswith('Hold still'):
        OUTPUT.print(text, markup=False)
    return text


def _entered() -> bool:
    """Return whether Enter was pressed."""
    if not sys.stdin.isatty() or not select.select([sys.stdin], [], [], 0)[0]:
        return False
    return bool(sys.stdin.readline())
