"""Recordings as functions take them (paths, data frames, arrays), and the files they write."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, Union

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..common.errors import InputError
from ..common.files import user_path
from ..common.stream import LAST_SECOND, NS, Floats, ImuBlock, JointBlock, Stamps, TemperatureBlock
from ..recordings.cdr import Messages, definition
from ..recordings.cdr_codec import RATES, Kind, encode_imu, encode_joints, encode_temperatures
from ..recordings.metadata_yaml import NAME, Metadata
from ..recordings.remote import AnyPath, RemotePath
from ..recordings.rosbag2 import Recording, Scratch, StorageFiles, is_storage, open_recording
from ..recordings.storage import (
    Cache,
    Described,
    Losses,
    MessageBatch,
    Times,
    Topic,
    first_and_last,
    refuse_existing,
)
from ..session.keywords import Named

if TYPE_CHECKING:
    import pandas


Recorded: TypeAlias = Union['Named', 'pandas.DataFrame', 'NDArray[Any]', 'Sequence[NDArray[Any]]']
"""A recording: its path, a data frame, or arrays.

A path is a folder of rosbag2, one .mcap or .db3 file, or a URL of one that fsspec reads. A data
frame has the columns that `imu_calib.read` names, `angular_velocity.x` to `linear_acceleration.z`,
and may have `temperature` and `position.` and `velocity.` of joints; its index is the time, dates,
durations or seconds. Arrays are gyro and accelerometer, (n, 3) each, or both as (n, 6), at `rate`
samples per second.
"""

_IMU = [f'{name}.{axis}' for name in ('angular_velocity', 'linear_acceleration') for axis in 'xyz']
_TOPICS = {
    Kind.IMU: '/imu/data_raw',
    Kind.JOINTS: '/joint_states',
    Kind.TEMPERATURES: '/imu/temperature',
}
_JOINT = re.compile(r'(position|velocity)\.(.+)')
BACKWARDS = 0.01
"""Largest share of intervals between rows that may be zero or negative: a logger may write a row
twice or set its clock; a column that is not a time, or has lost digits, shows this throughout."""
SLOWEST, FASTEST = 2.0, 40e3
"""Rates of rows that an IMU may have, Hz. The fastest MEMS units have 32 kHz, phones and loggers of
vehicles 10 to 500 Hz. A unit of time that is a thousand times too small turns 50 Hz into 50 kHz,
one that is a thousand times too large 1 kHz into 1 Hz."""
RATES_OF_IMUS = f'{SLOWEST:g} Hz to {FASTEST / 1e3:g} kHz, the rates of IMUs'
_UNITS = {'ms': 1e3, 'us': 1e6, 'ns': 1e9}  #: Per second.


def recording_at(
    bag: Recorded | AnyPath, rate: float | None = None, *, sha256: str | None = None
) -> Recording:
    """Open a recording that is a path, a data frame or arrays.

    Args:
        bag: As `Recorded`.
        rate: Samples per second of arrays, or of a frame whose index is no time.
        sha256: Of the storage files, if known already.
    """
    if rate is not None and not SLOWEST <= rate <= FASTEST:
        raise InputError(f'`rate`: found {rate:g}, expected samples per second: {RATES_OF_IMUS}.')
    if isinstance(bag, np.ndarray | list | tuple):
        return SamplesInMemory('arrays', _samples_of_arrays(bag, rate))
    if not isinstance(bag, str | Path | RemotePath):
        return SamplesInMemory('data frame', _samples_of_frame(bag, rate))
    if rate is not None:
        raise InputError('`rate` is that of arrays: a recording states when each sample was taken.')
    if bag == '':
        raise InputError("found '', expected the path of a recording.")
    return open_recording(bag, sha256)


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
    if shapes not in ([(count, len(_IMU))], [(count, 3), (count, 3)]):
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
    missing = [name for name in _IMU if name not in names]
    if missing:
        raise InputError(
            f'The data frame has no column {missing[0]}; it has: {", ".join(names) or "none"}. '
            f'Expected {_IMU[0]} to {_IMU[-1]}, as `imu_calib.read` names them.'
        )
    joints = tuple(
        dict.fromkeys(found[2] for found in map(_JOINT.fullmatch, names) if found is not None)
    )
    wanted = {Kind.IMU: _IMU}
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


def _stamps_of(frame: Any, rate: float | None) -> Stamps:
    """Return the stamps (n,) of a data frame, ns: its index, or by the rate."""
    index = frame.index
    kind = index.dtype.kind
    # A frame without an index of its own, or a part of one, counts its rows.
    is_range = type(index).__name__ == 'RangeIndex' and index.step == 1
    counted = kind in 'iu' and (is_range or np.array_equal(index, np.arange(len(index))))
    is_time = kind in 'mMfiu' and not counted
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
            'a TimedeltaIndex or seconds, or give `rate`.'
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


# Samples in memory as a storage file: what reads recordings reads them too.

_AT_ONCE = 1 << 14  #: Samples encoded at once: 5 MB as messages, and no copy of all.


@dataclass(frozen=True, eq=False)
class Samples:
    """Samples of one topic, column by column."""

    kind: Kind  #: IMU, JOINTS or TEMPERATURES.
    stamp: Stamps  #: (n,) ns.
    #: (n,) each: gyro x, y, z and accelerometer x, y, z; positions and velocities of the joints;
    #: or degrees Celsius.
    columns: Sequence[Floats]
    joints: tuple[str, ...] = ()  #: Their names.

    def messages(self, start: int, stop: int) -> Messages:
        """Encode some of the samples."""
        stamp = self.stamp[start:stop]
        values = np.column_stack([column[start:stop] for column in self.columns])
        if self.kind is Kind.IMU:
            return encode_imu(ImuBlock(stamp, values[:, :3], values[:, 3:]), RATES)
        if self.kind is Kind.JOINTS:
            count = len(self.joints)
            return encode_joints(
                JointBlock(stamp, self.joints, values[:, :count], values[:, count:])
            )
        return encode_temperatures(TemperatureBlock(stamp, values[:, 0]))


class _Storage:
    """The topics as the storage file of a recording."""

    def __init__(self, name: str, topics: Mapping[str, Samples]) -> None:
        self.path = Path(name)
        self._samples = topics
        self.topics: Mapping[str, Topic] = {
            topic: Topic(
                topic,
                of.kind.type_name,
                len(of.stamp),
                described=Described(definition(of.kind.type_name), 'ros2msg'),
            )
            for topic, of in topics.items()
        }
        self.size = sum(column.nbytes for of in topics.values() for column in of.columns)
        self.start_ns, self.end_ns = first_and_last(
            [(int(of.stamp.min()), int(of.stamp.max())) for of in topics.values() if len(of.stamp)]
        )
        self.custom_data: Mapping[str, str] = {}
        self.metadata: Sequence[tuple[str, Mapping[str, str]]] = ()

    def attachments(self) -> Iterator[bytes]:
        """Return none."""
        return iter(())

    def cursors(self, topics: frozenset[str], _: Cache, /) -> dict[str, Iterator[MessageBatch]]:
        """Start reading: one iterator for each topic."""
        return {topic: self._batches(topic) for topic in topics & set(self._samples)}

    def _batches(self, topic: str) -> Iterator[MessageBatch]:
        samples = self._samples[topic]
        count = len(samples.stamp)
        for start in range(0, count, _AT_ONCE):
            stop = min(start + _AT_ONCE, count)
            log = samples.stamp[start:stop]
            times = Times(log, log)
            yield MessageBatch(
                samples.messages(start, stop),
                log,
                int(log[0]),
                self.size * stop // count,
                lambda times=times: times,  # type: ignore[misc]
            )


class SamplesInMemory(Recording):
    """A recording of samples that lie in memory: its log times are their stamps.

    Args:
        name: Of it, for messages and for the provenance of a calibration.
        topics: Samples by topic.
    """

    def __init__(self, name: str, topics: Mapping[str, Samples]) -> None:
        storage = _Storage(name, topics)
        self._samples = topics
        super().__init__(storage.path, StorageFiles((), Metadata()), [storage], Losses(), Scratch())

    def sha256(self) -> str:
        """Return the SHA-256 of the samples: of each topic its name, stamps and columns."""
        import hashlib

        digest = hashlib.sha256()
        for topic, samples in sorted(self._samples.items()):
            digest.update(topic.encode())
            for column in (samples.stamp, *samples.columns):
                digest.update(np.ascontiguousarray(column).data)
        return digest.hexdigest()


# Outputs of commands: in existing folders, complete or not at all.


def output_path(output: Named) -> Path:
    """Return the path of a file to be written.

    Raises:
        InputError: Its folder does not exist, it is a folder itself, or a recording, which nobody
            can make again.
    """
    path = _below_a_folder(output)
    if path.is_dir():
        raise InputError(f'{path}: is a folder, expected the name of a file.')
    if path.is_file() and _is_of_a_recording(path.resolve()):
        refuse_existing(path)
    return path


def _is_of_a_recording(path: Path) -> bool:
    return is_storage(path) or (path.name == NAME and any(map(is_storage, path.parent.iterdir())))


def new_folder(output: Named) -> Path:
    """Return the path of a folder to create."""
    path = _below_a_folder(output)
    refuse_existing(path)
    return path


def page_path(output: Named) -> Path:
    """Return the path of an HTML file to be written."""
    path = output_path(output)
    if path.suffix.lower() == '.pdf':
        raise InputError(
            f'{path}: the page is HTML, expected a name that ends in .html; a browser prints it.'
        )
    return path


def output_or_default(output: str | None, default: str) -> str:
    """Return the path of -o, or the default if that does not exist yet.

    Raises:
        InputError: No path is given and the default exists: it may be the only copy of another
            session's result.
    """
    if output is None and user_path(default).exists():
        raise InputError(
            f'{default} exists already: name another with -o, or give -o {default} to overwrite it.'
        )
    return default if output is None else output


def _below_a_folder(output: Named) -> Path:
    if output == '-':
        raise InputError(
            '-: expected a name. /dev/stdout is the standard output, ./- a file of that name.'
        )
    path = user_path(output)
    if not path.parent.is_dir():
        raise InputError(f'{path}: the folder {path.parent} does not exist.')
    return path


@contextmanager
def removed_on_failure(folder: Path) -> Iterator[None]:
    """Remove a new folder if its writing ends early, by Ctrl-C too."""
    try:
        yield
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
