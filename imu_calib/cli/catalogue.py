"""imu-calib catalogue: the contents of a catalogue, as a table, a file or the result of SQL."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from datetime import datetime
from typing import TYPE_CHECKING, Any

from rich.table import Table
from rich.text import Text

from ..common.errors import InputError
from ..fleet.catalogue import Catalogue, rows_of, schema
from .outcome import row_file, write_rows
from .terminal import OUTPUT

if TYPE_CHECKING:
    import pyarrow as pa

_SHOWN = ('date', 'imu', 'serial', 'stand', 'status', 'verdict', 'recording', 'error')


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument('catalogue', metavar='CATALOGUE', help='the folder')
    parser.add_argument(
        '--where', metavar='SQL', help='select rows by a condition: "serial = \'A1\' and K_gx > 0"'
    )
    parser.add_argument(
        '--columns',
        metavar='NAME,NAME',
        help='columns in their order, * for all in a file, or for their names on the screen '
        f'(default: {",".join(_SHOWN)})',
    )
    parser.add_argument(
        '--sql', metavar='QUERY', help='an SQL query of your own; the table is called rows'
    )
    parser.add_argument(
        '-o',
        '--output',
        metavar='FILE',
        help='.csv or .json file to write, with all columns unless --columns is given',
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Print or write the result."""
    path = row_file(arguments.output)
    if arguments.sql is not None and (arguments.where or arguments.columns):
        raise InputError('--sql is a whole query: leave --where and --columns out.')
    catalogue = Catalogue(arguments.catalogue)
    default = '*' if path is not None else ', '.join(_SHOWN)
    columns = _quoted(default if arguments.columns is None else arguments.columns)
    where = f' where {arguments.where}' if arguments.where else ''
    found = catalogue.query(
        arguments.sql or f'select {columns} from rows{where} order by date, recording'
    )
    if path is None and found.num_columns == len(schema().names):
        _list(found)
    elif path is None:
        # What a query of one's own computes under a column's name may have another unit.
        _show(found, {} if arguments.sql else _units())
    else:
        rows = [{name: _plain(one) for name, one in row.items()} for row in rows_of(found)]
        write_rows(path, found.column_names, rows, rows)
        OUTPUT.print(f'{_rows(found)} written to {path}', markup=False)


def _rows(found: pa.Table) -> str:
    return f'{found.num_rows} row{"" if found.num_rows == 1 else "s"}'


def _quoted(columns: str) -> str:
    """Put names of columns in quotes: `at` and `values` are words of SQL."""
    names = set(schema().names)
    parts = columns.split(',')
    return ','.join(f'"{part.strip()}"' if part.strip() in names else part for part in parts)


def _units() -> dict[str, str]:
    """Return the units of the columns that have one: DuckDB hands on no metadata."""
    units = {one.name: (one.metadata or {}).get(b'unit', b'').decode() for one in schema()}
    return {name: unit for name, unit in units.items() if unit}


def _list(found: pa.Table) -> None:
    """Print the names of all columns: no screen has room for their contents."""
    units = _units()
    names = [f'{name} [{units[name]}]' if name in units else name for name in found.column_names]
    OUTPUT.print(f'{_rows(found)} of {len(names)} columns: {", ".join(names)}.', markup=False)
    OUTPUT.print(
        '\nA table shows some (--columns serial,K_gx), a file all of them (-o rows.csv).',
        markup=False,
    )


def _show(found: pa.Table, units: Mapping[str, str]) -> None:
    table = Table(box=None, pad_edge=False)
    for name in found.column_names:
        # As text: a unit in brackets is taken for a style otherwise.
        table.add_column(Text(f'{name} [{units[name]}]' if name in units else name))
    for row in rows_of(found):
        table.add_row(*(_text(value) for value in row.values()))
    OUTPUT.print(table, markup=False)
    OUTPUT.print(f'\n{_rows(found)}')


def _text(value: Any) -> str:
    if value is None:
        return ''
    if isinstance(value, float):
        return f'{value:.6g}'
    return (
        value.isoformat(sep=' ', timespec='seconds') if hasattr(value, 'isoformat') else str(value)
    )


def _plain(value: Any) -> Any:
    return value.isoformat() if isinstance(value, datetime) else value
