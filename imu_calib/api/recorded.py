"""Recordings as functions take them: paths, text files, data frames, arrays."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, Union

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..calibration.thermal import AnyCalibration, first_of
from ..common.errors import InputError
from ..common.files import TEXT_FILES, first_bytes
from ..common.stream import LAST_SECOND, NS, Floats, Stamps
from ..recordings.cdr_codec import Kind
from ..recordings.remote import AnyPath, RemotePath, located
from ..recordings.rosbag2 import Recording, is_storage, open_recording
from ..recordings.text import CONTROLS, OtherNumbers, Text, table_of_frame
from ..session.keywords import InColumns, Named, Stated
from .in_memory import Samples, SamplesInMemory
from .tables import (
    BACKWARDS,
    FASTEST,
    RATES_OF_IMUS,
    SLOWEST,
    from_columns,
    from_text,
    rows_per_second,
    suggested,
)

if TYPE_CHECKING:
    import pandas

Recorded: TypeAlias = Union['Named', 'pandas.DataFrame', 'NDArray[Any]', 'Sequence[NDArray[Any]]']
"""A recording: its path, a data frame, or arrays.

A path is a folder of rosbag2, one .mcap or .db3 file, a text file with columns that are stated, or
a URL of one that fsspec reads. A data frame has columns that are stated, or those that
`imu_calib.read` names, `angular_velocity.x` to `linear_acceleration.z`, and may have `temperature`
and `position.` and `velocity.` of joints; its index is the time, dates, durations or seconds.
Arrays are gyro and accelerometer, (n, 3) each, or both as (n, 6), at `rate` samples per second.
"""

NAMES = [f'{name}.{axis}' for name in ('angular_velocity', 'linear_acceleration') for axis in 'xyz']
_TOPICS = {
    Kind.IMU: '/imu/data_raw',
    Kind.JOINTS: '/joint_states',
    Kind.TEMPERATURES: '/imu/temperature',
}
_JOINT = re.compile(r'(position|velocity)\.(.+)')
_UNITS = {'ms': 1e3, 'us': 1e6, 'ns': 1e9}  #: Per second.


def recording_at(
    bag: Recorded | AnyPath, stated: Stated | None = None, *, sha256: str | None = None
) -> Recording:
    """Open a recording that is a path, a text file, a data frame or arrays.

    Args:
        bag: As `Recorded`.
        stated: Its columns and their rate; what pulses or counts in columns mean.
        sha256: Of the storage files, if known already.
    """
    stated = Stated() if stated is None else stated
    rate = rows_per_second(stated.rate)
    if isinstance(bag, np.ndarray | list | tuple):
        refuse_columns(stated)
        return SamplesInMemory(Path('arrays'), _samples_of_arrays(bag, rate))
    if not isinstance(bag, str | Path | RemotePath):
        if stated.gyro is not None or stated.accel is not None:
            return from_columns(*_table_of_frame(bag, stated.columns), stated.imu)
        refuse_columns(stated)
        return SamplesInMemory(Path('data frame'), _samples_of_frame(bag, rate))
    if bag == '':
        raise InputError("found '', expected the path of a recording.")
    if is_text(bag):
        return from_text(located(bag), stated.columns, stated.imu)
    refuse_columns(stated)
    if rate is not None:
        raise InputError(
            '`rate` is that of arrays and text files: a recording states when each sample was '
            'taken.'
        )
    return open_recording(bag, sha256)


def recording_for(
    bag: Recorded | AnyPath, stated: Stated, calibration: AnyCalibration, name: str
) -> Recording:
    """Open a recording; columns are read as the calibration means them if no IMU is stated."""
    if stated.imu is not None:
        return recording_at(bag, stated)
    try:
        return recording_at(bag, replace(stated, imu=first_of(calibration).imu))
    except OtherNumbers as error:
        raise InputError(
            f'{name}: {error.contradiction} A calibration applies to the numbers it was made of.'
        ) from None


def is_text(bag: Named | AnyPath) -> bool:
    """Return whether a path is that of a text file, by its ending; .mat is also one of MATLAB."""
    path = located(bag)
    ending = path.suffix.lower()
    if ending not in {*TEXT_FILES, '.mat'} or not path.is_file() or is_storage(path):
        return False
    return ending != '.mat' or CONTROLS.search(first_bytes(path)) is None


def refuse_columns(stated: Stated) -> None:
    """Refuse columns that are stated of a recording which has none."""
    given = [name for name in stated.columns if name != 'rate']
    if given:
        raise InputError(
            f'`{given[0]}` names columns of a text file or a data frame, and this is none.'
        )


def _samples_of_arrays(
    given: NDArray[Any] | Sequence[ArrayLike], rate: float | None
) -> dict[str, Samples]:
    """Return arrays as samples that follow each other at a rate."""
    if rate is None:
        raise InputError('`rate` is missing: give the samples per second of the arrays.')
    parts = [given] if isinstance(given, np.ndarray) else list(given)
    try:
        # What a mask hides is missing.
        found = [np.ma.filled(np.ma.asarray(part, dtype=np.float64), np.nan) for part in parts]
    except (TypeError, ValueError):
        raise InputError('An array holds values that are not numbers.') from None
    shapes = [array.shape for array in found]
    count = shapes[0][0] if shapes and shapes[0] else 0
    if shapes not in ([(count, len(NAMES))], [(count, 3), (count, 3)]):
        listed = ' and '.join(map(str, shapes)) or 'none'
        raise InputError(
            f'Found arrays of shape {listed}, expected gyro and accelerometer, (n, 3) each, or one '
            'array (n, 6) of both.'
        )
    columns = [array[:, k] for array in found for k in range(array.shape[1])]
    return {_TOPICS[Kind.IMU]: Samples(Kind.IMU, _at_rate(count, rate), columns)}


def _at_rate(count: int, rate: float) -> Stamps:
    """Return stamps of samples at a rate: the first sample ends an interval that begins at 0."""
    return np.asarray(np.rint(np.arange(1, count + 1) * (NS / rate)), dtype=np.int64)


def _samples_of_frame(frame: Any, rate: float | None) -> dict[str, Samples]:
    """Return a data frame as samples of an IMU, and of joints and temperatures if it has any.

    Where it has several of these, a row whose values of one are all missing has no sample of it, as
    in a frame that was joined of several.
    """
    names = [str(name) for name in frame.columns]
    missing = [name for name in NAMES if name not in names]
    if missing:
        raise InputError(
            f'The data frame has no column {missing[0]}; it has: {", ".join(names) or "none"}. '
            f'Expected {NAMES[0]} to {NAMES[-1]}, as `imu_calib.read` names them, or the names of '
            f'its columns with their units: {_as_keywords(frame)}.'
        )
    joints = tuple(
        dict.fromkeys(found[2] for found in map(_JOINT.fullmatch, names) if found is not None)
    )
    wanted = {Kind.IMU: NAMES}
    if joints:
        wanted[Kind.JOINTS] = [f'{of}.{j}' for of in ('position', 'velocity') for j in joints]
    if 'temperature' in names:
        wanted[Kind.TEMPERATURES] = ['temperature']
    stamp = _stamps_of(frame, rate)
    found = {}
    for kind, of in wanted.items():
        columns = [_column(frame, name, names) for name in of]
        own = stamp
        if len(wanted) > 1:
            there = ~np.all([np.isnan(column) for column in columns], axis=0)
            if not there.all():
                own, columns = stamp[there], [column[there] for column in columns]
        found[_TOPICS[kind]] = Samples(kind, own, columns, joints if kind is Kind.JOINTS else ())
    _refuse_index(found[_TOPICS[Kind.IMU]].stamp, frame.index.dtype.kind)
    return found


def _refuse_index(stamp: Stamps, kind: str) -> None:
    """Refuse an index, ns, of a dtype's kind, that is not sorted or not at the rate of an IMU."""
    intervals = np.diff(stamp)
    if np.sum(intervals < 0) > BACKWARDS * len(intervals):
        raise InputError('The index is not sorted: give `frame.sort_index()`.')
    typical = float(np.median(intervals)) if len(intervals) else 0.0
    # Equal stamps have an answer of their own.
    if typical <= 0 or kind in 'mM' or SLOWEST <= NS / typical <= FASTEST:
        return
    hertz = NS / typical
    others = '; '.join(
        f'in {unit} it would be {hertz * per:.4g} Hz: divide it by {per:.0f}'
        for unit, per in _UNITS.items()
        if SLOWEST <= hertz * per <= FASTEST
    )
    raise InputError(
        f'The index counts {hertz:.4g} samples per second; '
        f'{others or f"expected seconds, and {RATES_OF_IMUS}"}.'
    )


def _column(frame: Any, name: str, names: list[str]) -> Floats:
    """Return a column as numbers; NaN throughout for one that the frame does not have."""
    if name not in names:
        return np.full(len(frame), np.nan)
    if names.count(name) > 1:
        raise InputError(f'The data frame has several columns {name}, expected one.')
    try:
        return np.asarray(frame[name].to_numpy(dtype=np.float64, na_value=np.nan))
    except (TypeError, ValueError):
        raise InputError(f'Column {name} of the data frame: expected numbers.') from None


_INDEX = 'index of the frame'


def _table_of_frame(frame: Any, columns: InColumns) -> tuple[Text, InColumns]:
    """Return a data frame as a table, its index as a column if the rows have no other time."""
    text = table_of_frame(frame)
    if not {'stamp', 'rate'} & columns.keys():
        index = _stamps_of(frame, None).astype(np.float64)
        values = np.column_stack([text.values, index])
        text = replace(text, names=(*text.names, _INDEX), values=values)
        columns = {**columns, 'stamp': f'{_INDEX}:ns'}
    return text, columns


def _as_keywords(frame: Any) -> str:
    """Return what to state of a frame's columns, as keywords."""
    text, _ = _table_of_frame(frame, {'rate': 1.0})
    found = {
        'stamp': 'NAME:UNIT',
        'gyro': 'NAME,NAME,NAME:UNIT',
        'accel': 'NAME,NAME,NAME:UNIT',
        **suggested(text),
    }
    wanted = ('stamp', 'gyro', 'accel') if _counts_rows(frame.index) else ('gyro', 'accel')
    return ', '.join(f'{name}={found[name]!r}' for name in wanted)


def _stamps_of(frame: Any, rate: float | None) -> Stamps:
    """Return the stamps (n,) of a data frame, ns: its index, or by the rate."""
    index = frame.index
    kind = index.dtype.kind
    is_time = kind in 'mMfiu' and not _counts_rows(index)
    if rate is not None:
        if is_time:
            raise InputError(
                '`rate`: the index of the data frame is a time already; leave `rate` out, or call '
                '`reset_index(drop=True)`.'
            )
        return _at_rate(len(frame), rate)
    if not is_time:
        raise InputError(
            'The index of the data frame counts its rows or is no time: set a DatetimeIndex, '
            'a TimedeltaIndex or seconds, or give `rate`, or the column of the time with `stamp`.'
        )
    if index.hasnans:
        raise InputError('The index of the data frame has missing values, expected a time in each.')
    if kind in 'mM':
        unit = 'datetime64[ns]' if kind == 'M' else 'timedelta64[ns]'
        return np.asarray(index.to_numpy(dtype=unit)).astype(np.int64)
    seconds = index.to_numpy(dtype=np.float64)
    if not (np.abs(seconds) <= LAST_SECOND).all():
        raise InputError(
            f'The index of the data frame reaches {np.abs(seconds).max():.4g}, beyond all dates in '
            'seconds: convert it, as by `pandas.to_datetime(frame.index)` from ns.'
        )
    return np.asarray(np.rint(seconds * NS), dtype=np.int64)


def _counts_rows(index: Any) -> bool:
    """Return whether an index counts rows, as in a frame without one of its own, or in a part."""
    is_range = type(index).__name__ == 'RangeIndex' and index.step == 1
    whole = index.dtype.kind in 'iu'
    return whole and (is_range or np.array_equal(index, np.arange(len(index))))
