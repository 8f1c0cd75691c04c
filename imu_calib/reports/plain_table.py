"""Tables on a terminal: without lines, with headings in bold."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from rich.table import Table


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
