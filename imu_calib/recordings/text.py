"""Tables of numbers in text files: columns by the names of a heading or by their places."""

from __future__ import annotations

import codecs
import csv
import re
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..common.errors import InputError
from ..common.files import CONVERTIBLE, other_format, read_bytes
from ..common.stream import Floats, Units
from ..common.units import Dimension, counted
from ..session.imu import ImuSpec
from .remote import AnyPath

_COMMENTS = ('#', '%', '//')
_DELIMITERS = (';', '\t', ',')
_UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
CONTROLS = re.compile(rb'[\x00-\x08\x0e-\x1f]')
"""Bytes that no text has, in any code page of one byte per character."""
_LABEL = re.compile(r'(?:(?<=[\s,;])|^)([^\W\d][\w.]*)\s*[:=]\s*(?=[-+.\d])')
"""Name before a number in its field, as 'ax: 0.1' and 'ax=0.1' for a plotter of serial lines."""
_LABELLED = 0.9  #: Least share of lines with the same labels: others are broken lines. A judgement.
_SENSOR = re.compile(r'(?:^|[,;\s])"?((?:gyr|acc)[a-z]*)"?(?=[,;\s]+"?[-+.\d])', re.IGNORECASE)
"""Name of a sensor as a field of a row, before a number."""
_OF_SENSOR = 0.05
"""Share of the lines that name each sensor. A judgement: a log of a phone has ten of them."""
_NOVATEL = ('%RAWIMU', '#RAWIMU')
"""Beginnings of raw samples in ASCII (OEM7 Commands and Logs Reference Manual, Message Formats)."""
_TO_COMMAS = str.maketrans(';*', ',,')  #: What ends its header, and its values.
_LOOKED_AT = 100
"""Number of lines, spread over the file, that determine how many fields a row has: lines above a
table and broken lines are few in comparison."""


@dataclass(frozen=True, eq=False)
class Text:
    """A table of numbers in a file."""

    path: AnyPath  #: The file.
    #: Of the columns, as in the heading; without a heading their places from '1' on.
    names: tuple[str, ...]
    values: Floats  #: (n, k); NaN if a field is not a number.
    broken: int  #: Number of lines with too few fields or no number; they are skipped.

    def column(self, name: str, option: str) -> Floats:
        """Return a column by its name in the heading, or by its place from 1 on; negated by -."""
        if name in self.names:
            return self.values[:, self.names.index(name)]
        if name.startswith('-'):
            return -self.column(name[1:], option)
        if name.isdigit() and 0 < int(name) <= len(self.names):
            return self.values[:, int(name) - 1]
        raise InputError(
            f'{option}: {self.path} has no column {name!r}; it has: {", ".join(self.names)}.'
        )


def read_text(path: AnyPath, delimiter: str | None = None) -> Text:
    """Read a table of numbers: CSV, or columns separated by tabs, semicolons or blanks.

    Empty lines, lines that begin with #, % or //, and a logger's text above the table are skipped.
    The last line above the rows is the heading, also behind a #, if it has a name for each column.
    If commas do not separate fields, a comma is a decimal point. Without a delimiter it is
    detected.
    """
    return _table(path, _written(path), delimiter)


def read_sensors(path: AnyPath, delimiter: str | None = None) -> tuple[Text, Text | None]:
    """Read a table of numbers as `read_text`, or two whose rows alternate and name their sensor.

    A label begins with gyr or acc (GYR, gyroscope; ACC, ACCE, accelerometer), in any letters. With
    labels the first table is that of the gyros, the second that of the accelerometers, else None.
    """
    written = _written(path)
    found = _by_label(written)
    if found is None:
        return _table(path, written, delimiter), None
    gyros, accels = (_table(path, rows, delimiter) for rows in found)
    return gyros, accels


def _by_label(written: Sequence[str]) -> tuple[list[str], list[str]] | None:
    """Return the lines of gyros and those of accelerometers, each with the lines above the table.

    The label becomes a field that is no number.
    """
    labels = [_SENSOR.search(row) for row in written]
    usual = [
        Counter(match[1] for match in labels if match and match[1].lower().startswith(kind))
        for kind in ('gyr', 'acc')
    ]
    if any(sum(count.values()) <= _OF_SENSOR * len(written) for count in usual):
        return None
    head = written[: next(k for k, match in enumerate(labels) if match)]
    names = [count.most_common(1)[0][0] for count in usual]
    gyros, accels = (
        [
            f'{row[: match.start(1)]}nan{row[match.end(1) :]}'
            for row, match in zip(written, labels, strict=True)
            if match and match[1] == name
        ]
        for name in names
    )
    return [*head, *gyros], [*head, *accels]


def _written(path: AnyPath) -> list[str]:
    """Return the lines of a file that are not empty; of a log of NovAtel its raw samples."""
    rows = [row for row in _decoded(path).splitlines() if row.strip()]
    return [row[1:].translate(_TO_COMMAS) for row in rows if row.startswith(_NOVATEL)] or rows


def _table(path: AnyPath, written: Sequence[str], delimiter: str | None) -> Text:
    """Read a table from the lines of a file; as `read_text`."""
    lines = [row for row in written if not row.startswith(_COMMENTS)]
    if not lines:
        comments = f' but comments, {" ".join(_COMMENTS)} first' if written else ''
        raise _no_table(path, f'holds no lines{comments}: expected a table of numbers.')
    if delimiter is not None and len(delimiter) != 1:
        raise InputError(f'`delimiter`: found {delimiter!r}, expected one character.')
    whole = lines
    labels, lines = _without_labels(whole)
    sample = lines[len(lines) // 2]
    between = _delimiter(sample) if delimiter is None else delimiter
    count = _usual_count(lines, between)
    first = next((k for k, row in enumerate(lines) if _is_row(row, between, count)), None)
    if first is None:
        raise _no_table(
            path,
            f'no row of numbers found; a line of it is {sample[:60]!r}. Expected numbers '
            'with commas, semicolons, tabs or blanks between them, or what `delimiter` names.',
        )
    names, above = _heading(lines[:first], between), first
    if len(labels) == count:
        names = labels
    elif names:
        above -= 1
    elif comment := _heading(written[: written.index(whole[first])], between):
        # Text behind a # is a heading only if it has a distinct name for each column.
        names = comment if len(comment) == len(set(comment)) == count else []
    if len(set(names)) < len(names):
        twice = sorted({n for n in names if names.count(n) > 1})
        raise InputError(f'{path}: its heading has {", ".join(twice)} more than once.')
    # Lines with other labels than the rows are empty by now.
    rows = [row for row in lines[first:] if row]
    above += len(lines) - first - len(rows)
    if between != ',':
        rows = [row.replace(',', '.') for row in rows]
    values, broken = _numbers(rows, between, len(names) or count)
    if not len(values) or 0 < len(names) < count:
        raise InputError(
            f'{path}: its heading has {counted(len(names), "name")}, its rows have '
            f'{counted(count, "field")}: which name belongs to which field is not known. Give each '
            'column a name; where commas separate the fields, write decimal points.'
        )
    return Text(path, tuple(names or map(str, range(1, count + 1))), values, above + broken)


def _without_labels(lines: list[str]) -> tuple[list[str], list[str]]:
    """Return the labels that stand before the numbers of every row, and the lines without them.

    Rows with other labels hold other values: they are not of one table.
    """
    some = lines[:: max(1, len(lines) // _LOOKED_AT)]
    labels, rows = Counter(tuple(_LABEL.findall(row)) for row in some).most_common(1)[0]
    if not labels or rows < _LABELLED * len(some):
        return [], lines
    return list(labels), [
        _LABEL.sub('', row) if tuple(_LABEL.findall(row)) == labels else '' for row in lines
    ]


def _decoded(path: AnyPath) -> str:
    """Return the text of a file."""
    data = read_bytes(path)
    try:
        return data.decode('utf-16' if data.startswith(_UTF_16) else 'utf-8-sig')
    except UnicodeDecodeError:
        if CONTROLS.search(data):
            raise _no_table(path, 'is not a text file, expected a table of numbers.') from None
        # A heading with degrees or micro of a Windows program in western Europe; of another
        # code page names alone are misread, and the numbers are those of ASCII.
        return data.decode('cp1252', 'replace')


def _no_table(path: AnyPath, sentence: str) -> InputError:
    """Return the error of a file without a table: by its ending what it is, else a sentence."""
    known = None if path.suffix.lower() in CONVERTIBLE else other_format(path)
    return InputError(known or f'{path}: {sentence}')


def _heading(above: Sequence[str], delimiter: str | None) -> list[str]:
    """Return the names in the last line above the rows; empty if it is not a heading."""
    names = _fields(above[-1].lstrip('#%/ '), delimiter) if above else []
    while names and not names[-1]:
        names.pop()
    if len(names) < 2 or any(_is_number(field, delimiter) for field in names):
        return []
    return names


def _delimiter(line: str) -> str | None:
    """Return the delimiter of the fields in a line; None for blanks."""
    present = [d for d in _DELIMITERS if d in line]
    for found in (*present, None):
        if all(_is_number(field, found) for field in _fields(line, found) if field):
            return found
    return present[0] if present else None


def _usual_count(lines: Sequence[str], delimiter: str | None) -> int:
    """Return the usual number of fields in lines, without an empty last one."""
    some = lines[:: max(1, len(lines) // _LOOKED_AT)]
    counts = Counter(len(_fields(line.rstrip().rstrip(delimiter), delimiter)) for line in some)
    return counts.most_common(1)[0][0]


def _is_row(line: str, delimiter: str | None, count: int) -> bool:
    fields = _fields(line, delimiter)
    return len(fields) >= count and any(_is_number(field, delimiter) for field in fields)


def _fields(line: str, delimiter: str | None) -> list[str]:
    if delimiter is None:
        return line.split()
    try:
        return [field.strip() for field in next(csv.reader([line], delimiter=delimiter), [])]
    except csv.Error:
        # A field of more than 128 KiB, which is no number and no name.
        return []


def _is_number(field: str, delimiter: str | None) -> bool:
    try:
        float(field if delimiter == ',' else field.replace(',', '.'))
    except ValueError:
        return False
    return True


def _numbers(lines: Sequence[str], delimiter: str | None, count: int) -> tuple[Floats, int]:
    """Return the rows, and the number of other lines.

    Intact tables are converted at once; in others each field is checked.
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


# Columns that a person names, with their units.

RAW_UNITS = {'pulse': 1.0, 'count': 1.0}
GYRO: Mapping[str, float] = {**Dimension.RATE.value, **Dimension.ANGLE.value, **RAW_UNITS}
ACCEL: Mapping[str, float] = {
    **Dimension.ACCELERATION.value,
    **Dimension.VELOCITY.value,
    **RAW_UNITS,
}
_FITTING = {
    Units.SI: (Units.SI, Units.RATES),
    Units.INCREMENTS: (Units.INCREMENTS,),
    Units.PULSES: (Units.PULSES, Units.COUNTS),
    Units.COUNTS: (Units.PULSES, Units.COUNTS),
}
"""Units that a file may state for columns: of whole numbers, a pulse is what the file says."""
_NUMBERS = {
    Units.SI: 'rates and accelerations',
    Units.INCREMENTS: 'angles and velocities per sample',
    Units.PULSES: 'pulses',
    Units.COUNTS: 'counts',
}


class OtherNumbers(InputError):
    """What is stated of an IMU does not fit the columns; `contradiction` says so without names."""

    def __init__(self, name: str, contradiction: str) -> None:
        super().__init__(f'{name}: {contradiction}')
        self.contradiction = contradiction


def fits(spec: ImuSpec, numbers: Units) -> bool:
    """Return whether what is stated of an IMU may be that of columns of these numbers."""
    return spec.units in _FITTING[numbers]


def fitting(spec: ImuSpec, name: str, numbers: Units) -> ImuSpec:
    """Return what is stated of an IMU if it fits columns of these numbers."""
    if not fits(spec, numbers):
        raise OtherNumbers(
            f'`imu` {name}',
            f'units: found {spec.units.value}, but the numbers are {_NUMBERS[numbers]}.',
        )
    return spec


def numbers_of(gyro_unit: str, accel_unit: str) -> Units:
    """Return the kind of numbers in columns of these units."""
    kinds = [
        {'pulse': Units.PULSES, 'count': Units.COUNTS}.get(
            unit, Units.INCREMENTS if unit in increments else Units.SI
        )
        for unit, increments in (
            (gyro_unit, Dimension.ANGLE.value),
            (accel_unit, Dimension.VELOCITY.value),
        )
    ]
    if kinds[0] is not kinds[1]:
        raise InputError(
            f'`gyro` and `accel`: found {gyro_unit} and {accel_unit}, expected a rate and an '
            'acceleration, or an angle and a velocity per sample, or both in pulses, or both in '
            'counts.'
        )
    return kinds[0]


def columns_of(
    text: Text, stated: str, option: str, units: Mapping[str, float], count: int
) -> tuple[Floats, str]:
    """Return columns in SI (pulses and counts unchanged), (n, count), and their unit."""
    parts, unit = parted(stated)
    if unit not in units or len(parts) != count or not all(parts):
        form = ','.join(['NAME'] * count)
        raise InputError(
            f'{option}: found {stated!r}, expected {form}:UNIT, with the unit one of '
            f'{", ".join(units)}.'
        )
    if twice := [name for name in parts if parts.count(name) > 1]:
        raise InputError(f'{option}: found {stated!r}, which names column {twice[0]} twice.')
    values = np.column_stack([text.column(name, option) for name in parts])
    empty = [name for name, column in zip(parts, values.T, strict=True) if np.isnan(column).all()]
    if empty:
        raise InputError(
            f'{option} {stated}: column {empty[0]} of {text.path} holds no number. Dates and times '
            'of day are not read: write seconds, or give `rate` in place of `stamp`.'
        )
    return values * units[unit], unit


def parted(stated: str) -> tuple[list[str], str]:
    """Split 'NAME,NAME:UNIT' into names and unit."""
    names, _, unit = stated.rpartition(':')
    return [name.strip() for name in names.split(',')], unit.strip().replace('°', 'deg')


def table_of_frame(frame: Any) -> Text:
    """Return the columns of a data frame."""
    values = {str(name): _as_numbers(column) for name, column in frame.items()}
    table = np.column_stack([np.empty((len(frame), 0)), *values.values()])
    return Text(Path('data frame'), tuple(values), table, 0)


def _as_numbers(column: Any) -> Floats:
    """Return a column as numbers: dates and durations in ns, NaN for what is no number."""
    import pandas as pd

    if column.dtype.kind in 'mM':
        unit = 'datetime64[ns]' if column.dtype.kind == 'M' else 'timedelta64[ns]'
        return np.asarray(column.to_numpy(dtype=unit).astype(np.int64), np.float64)
    numbers = pd.to_numeric(column, errors='coerce')
    return np.asarray(numbers.to_numpy(dtype=np.float64, na_value=np.nan))


def outputs_of_frame(frame: Any, gyro: str, accel: str, imu: ImuSpec) -> tuple[Floats, Floats]:
    """Return columns of a data frame as outputs of an IMU, (n, 3) each."""
    text = table_of_frame(frame)
    rates, gyro_unit = columns_of(text, gyro, '`gyro`', GYRO, 3)
    forces, accel_unit = columns_of(text, accel, '`accel`', ACCEL, 3)
    try:
        fitting(imu, imu.id, numbers_of(gyro_unit, accel_unit))
    except OtherNumbers as error:
        raise InputError(f'calibration of {imu.id}: {error.contradiction}') from None
    return as_outputs(rates, forces, imu)


def as_outputs(rates: Floats, forces: Floats, imu: ImuSpec) -> tuple[Floats, Floats]:
    """Return SI values as outputs of an IMU; whole numbers are so: its file says what one is."""
    if imu.units.whole:
        return rates, forces
    return rates / imu.gyro.scale_factor, forces / imu.accel.scale_factor
