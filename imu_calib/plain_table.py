"""Tables on a terminal: no lines, headings in bold."""

from __future__ import annotations

from collections.abc import Sequence

from rich.table import Table


def plain_table(headings: Sequence[str], sides: str, *, no_wrap: bool = False) -> Table:
    """Begin a table; rows are added to what is returned.

    Args:
        headings: Of the columns.
        sides: For every column 'r' where it is aligned at the right, else 'l'.
        no_wrap: Whether no cell goes on in the next line.
    """
    table = Table(box=None, pad_edge=False, header_style='bold')
    for heading, side in zip(headings, sides, strict=True):
        table.add_column(heading, justify='right' if side == 'r' else 'left', no_wrap=no_wrap)
    return table
