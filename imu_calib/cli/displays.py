"""The terminal during a session: its start, a session on a table, one in the hand."""

from __future__ import annotations

import select
import sys
import time
from collections.abc import Sequence
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
from ..common.units import DEG, counted, significant
from ..live.rules import Severity
from ..live.web.board import Snapshot, UnitRow
from ..live.web.sentences import headline, time_left
from ..reports.convergence import READING, Converging
from ..reports.plain_table import plain_table
from .processes import START, Nodes, SessionEnd
from .terminal import ERRORS, OUTPUT, NodeReports

_STYLES = {Severity.OK: 'bold', Severity.WARN: 'bold yellow', Severity.ERROR: 'bold red'}
_BAR = 30  #: Characters of the bar. A choice; layout.
_COLUMNS = ('', 'std now', 'plan', 'limit', 'unit')
_UNIT_COLUMNS: tuple[tuple[str, JustifyMethod], ...] = (
    ('unit', 'left'),
    ('state', 'left'),
    ('rate', 'right'),
    ('lost', 'right'),
    ('known', 'right'),
    ('furthest from the plan', 'left'),
)
_WIDE = 78  #: Characters for two triads side by side; 12 rows then fit a small terminal.


def view_table(shown: Snapshot, now: datetime, width: int, units: Sequence[UnitRow] = ()) -> Group:
    """Lay out a running session: each of several units has a line in place of the parameters."""
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
    """Follows the start of a session; `patience`: longest wait without progress, s."""

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
        """Raise an error if the wait is too long: `otherwise`, if no journal is read."""
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

_SHOWN = 6  #: Attitudes shown at once: as many as fit above the bars of a small terminal.
_HAND_BAR = 24  #: Characters of the longest bar. A choice; layout.
_EVERYTHING = 'Enter ends the session with what is here, Ctrl-C without a result.'


def follow(processes: Nodes, reports: NodeReports) -> SessionEnd:
    """Guide a person until the session ends."""
    from .monitor import watching

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
    """Lay out imu_calib_msgs/CalibrationProgress for a person with the unit in hand."""
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
    words = [counted(progress.step, 'hold')]
    for letter, what, unit, scale in (
        ('K', 'scale factors', '%', 0.01),
        ('E', 'misalignments', 'deg', DEG),
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
