"""Tables of numbers in text files: their columns, by the names of a heading or by their places."""

from __future__ import annotations

import csv
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..bags import AnyPath
from ..errors import InputError
from ..stream import Floats

_COMMENTS = ('#', '%', '//')
_DELIMITERS = (';', '\t', ',')


@dataclass(frozen=True, eq=False)
class Text:
    """A table of numbers as a file has it.

    Attributes:
        path: The file.
        names: Of the columns, as its heading has them; their places from '1' on without a heading.
        values: (n, k); NaN where a field holds no number.
        broken: Lines that have too few fields, or none that is a number; they are left out.

    """

    path: AnyPath
    names: tuple[str, ...]
    values: Floats
    broken: int

    def column(self, name: str, option: str) -> Floats:
        """Return a column by its name in the heading, or by its place, counted from 1.

        Raises:
            InputError: There is none; the option that asks for it is named, and what is there.

        """
        if name in self.names:
            return self.values[:, self.names.index(name)]
        if name.isdigit() and 0 < int(name) <= len(self.names):
            return self.values[:, int(name) - 1]
        raise InputError(
            f'{option}: {self.path} has no column {name!r}; it has: {", ".join(self.names)}.'
        )


def read_text(path: AnyPath, delimiter: str | None = None) -> Text:
    """Read a table of numbers: CSV, or columns with tabs, semicolons or blanks between.

    Lines that begin with #, % or // and empty ones are passed over. A first line that is no row of
    numbers is the heading. Where semicolons part the fields, a comma is a decimal point.

    Args:
        path: The file.
        delimiter: Between fields; None finds it by the first line.

    Raises:
        InputError: It cannot be read, or holds no numbers.

    """
    try:
        text = path.read_text(encoding='utf-8-sig')
    except OSError as error:
        raise InputError(f'{path}: cannot be read ({error.strerror}).') from None
    except UnicodeDecodeError:
        raise InputError(f'{path}: is not a text file, expected a table of numbers.') from None
    lines = [row for row in text.splitlines() if row.strip() and not row.startswith(_COMMENTS)]
    if not lines:
        raise InputError(f'{path}: holds no lines, expected a table of numbers.')
    if delimiter is not None and len(delimiter) != 1:
        raise InputError(f'`delimiter`: found {delimiter!r}, expected one character.')
    between = _delimiter(lines[0]) if delimiter is None else delimiter
    heading = _fields(lines[0], between)
    names = [str(k + 1) for k in range(len(heading))]
    if not any(_is_number(field, between) for field in heading):
        names, lines = heading, lines[1:]
    if len(set(names)) < len(names):
        twice = sorted({n for n in names if names.count(n) > 1})
        raise InputError(f'{path}: its heading has {", ".join(twice)} more than once.')
    if between == ';':
        lines = [row.replace(',', '.') for row in lines]
    values, broken = _numbers(lines, between, len(names))
    if not len(values):
        raise InputError(f'{path}: no row of numbers found.')
    return Text(path, tuple(names), values, broken)


def _delimiter(line: str) -> str | None:
    """Return what parts the fields of a line; None for blanks."""
    return next((d for d in _DELIMITERS if d in line), None)


def _fields(line: str, delimiter: str | None) -> list[str]:
    if delimiter is None:
        return line.split()
    return [field.strip() for field in next(csv.reader([line], delimiter=delimiter))]


def _is_number(field: str, delimiter: str | None) -> bool:
    try:
        float(field.replace(',', '.') if delimiter == ';' else field)
    except ValueError:
        return False
    return True


def _numbers(lines: Sequence[str], delimiter: str | None, count: int) -> tuple[Floats, int]:
    """Return the rows, and how many lines are none.

    Sound tables are read at once; in others each field is looked at.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter('error')
            values = np.loadtxt(lines, delimiter=delimiter, ndmin=2, comments=None)
    except (ValueError, UserWarning):
        values = np.empty((0, 0))
    if values.shape[1:] == (count,):
        return values, 0
    rows, broken = [], 0
    for line in lines:
        fields = _fields(line, delimiter)
        row = [_number(field) for field in fields[:count]]
        if len(row) < count or np.isnan(row).all():
            broken += 1
        else:
            rows.append(row)
    return np.array(rows, dtype=np.float64).reshape(-1, count), broken


def _number(field: str) -> float:
    try:
        return float(field)
    except ValueError:
        return float('nan')
