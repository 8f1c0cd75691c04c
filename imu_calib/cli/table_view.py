"""The terminal of a session on a table: present step, remaining time, and results so far."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from itertools import zip_longest

from rich.console import Group, JustifyMethod, RenderableType
from rich.progress_bar import ProgressBar
from rich.table import Table as Rows
from rich.text import Text

from ..reports.timeline import Converging
from ..stand.devices.health import Severity
from ..stand.web.board import Snapshot, UnitRow
from ..stand.web.drawing import headline, time_left

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
