"""Tables on a terminal: without lines, with headings in bold."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import chain, zip_longest

from rich.table import Table

_ROWS = 24  #: With these a table and what stands below it fit a screen of 40 lines.


def plain_table(
    headings: Sequence[str],
    sides: str,
    rows: Iterable[Sequence[str]] = (),
    *,
    no_wrap: bool = False,
) -> Table:
    """Return a table, to which further rows may be added.

    Args:
        headings: Of the columns.
        sides: 'r' for each right-aligned column, else 'l'.
        rows: Its first rows.
        no_wrap: Whether cells stay on one line.
    """
    table = Table(box=None, pad_edge=False, header_style='bold')
    for heading, side in zip(headings, sides, strict=True):
        table.add_column(heading, justify='right' if side == 'r' else 'left', no_wrap=no_wrap)
    for row in rows:
        table.add_row(*row)
    return table


def folded(table: Table) -> Table:
    """Return a plain table with its rows after the 24th to the right of the others."""
    rows = [list(map(str, row)) for row in zip(*(c.cells for c in table.columns), strict=True)]
    parts = [rows[k : k + _ROWS] for k in range(0, len(rows), _ROWS)]
    if len(parts) < 2:
        return table
    beside = zip_longest(*parts, fillvalue=[''] * len(table.columns))
    headings = [str(column.header) for column in table.columns] * len(parts)
    sides = ''.join(column.justify[0] for column in table.columns) * len(parts)
    return plain_table(headings, sides, (list(chain.from_iterable(row)) for row in beside))
