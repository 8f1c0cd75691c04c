"""Recordings that others made to recordings that every command reads."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..bags import (
    AnyPath,
    Recording,
    RecordingError,
    RecordingWriter,
    local,
    located,
    open_recording,
)
from ..cdr import (
    Kind,
    Messages,
    encode_imu,
    encode_joints,
    encode_rates,
    encode_temperatures,
)
from ..errors import InputError
from ..extras import require
from ..imu import load_imu
from ..paths import user_path
from ..share import named_file
from ..stream import Floats, ImuBlock, JointBlock, Stamps, TemperatureBlock, Units
from ..units import Dimension, parse
from .columns import read
from .named import Named
from .progress import Progress, silent
from .text import Text, read_text

_RAW, _SI, _JOINTS, _TEMPERATURE = (
    '/imu/pulses',
    '/imu/data_raw',
    '/turntable/joint_states',
    '/imu/temperature',
)
_RAW_UNITS = {'pulse': 1.0, 'count': 1.0}
_GYRO = {**Dimension.RATE.value, **_RAW_UNITS}
_ACCEL = {**Dimension.ACCELERATION.value, **_RAW_UNITS}
_ANGLE: Mapping[str, float] = Dimension.ANGLE.value
_STAMP = {'s': 1e9, 'ms': 1e6, 'us': 1e3, 'ns': 1.0}
_CELSIUS = {'degC': 1.0}
_BLOCK = 1 << 16
"""Samples that are written at once; a choice between memory and calls."""
_LAST_SECOND = 2**31 - 1
"""That builtin_interfaces/Time counts to."""
_BACKWARDS = 0.01
"""Share of intervals between rows that may be zero or negative: a logger writes a row twice or sets
its clock now and then; a column that is no time, or has lost digits, does so all along."""
_SLOWEST, _FASTEST = 2.0, 40e3
"""Rates of rows that an IMU may have, Hz. The fastest MEMS units give 32 kHz, phones and loggers of
vehicles 10 to 500 Hz. A unit of time that is a thousand times too small makes 50 kHz of 50 Hz, one
that is a thousand times too large 1 Hz of 1 kHz."""
_RATES = f'{_SLOWEST:g} Hz to {_FASTEST / 1e3:g} kHz, the rates of IMUs'

_SILENT = 2.5
"""Sample intervals between two samples of the accelerometers over which none is read from a line: a
lost sample makes two, and jitter of the stamps less than a half."""


@dataclass(frozen=True)
class Converted:
    """What was written.

    Attributes:
        path: The recording.
        counts: Messages by topic.
        findings: What a person should know, in sentences.

    """

    path: Path
    counts: Mapping[str, int]
    findings: tuple[str, ...]


def convert(
    source: Named,
    output: Named,
    *,
    stamp: str | None = None,
    rate: str | None = None,
    gyro: str | None = None,
    accel: str | None = None,
    joints: str | None = None,
    temperature: str | None = None,
    delimiter: str | None = None,
    gyro_topic: str | None = None,
    accel_topic: str | None = None,
    imu: Named | None = None,
    progress: Progress = silent,
) -> Converted:
    """Write a recording of rosbag2 (mcap) from what others recorded.

    The columns of a text file must be stated: 'NAME,NAME,NAME:UNIT', each NAME as in its
    heading or a place counted from 1. A bag of ROS 1 needs nothing. Gyros and accelerometers that
    come on topics of their own (`gyro_topic`, `accel_topic`) become one: the accelerometers are
    read at the stamps of the gyros, by straight lines between their samples.

    Args:
        source: Text file, bag of ROS 1, recording of rosbag2, or a URL of one that fsspec reads.
        output: Folder to create.
        stamp: Column of the time of each row, for instance 't:s' (s, ms, us, ns).
        rate: Of the rows, where none holds their time: '200 Hz'.
        gyro: Three columns, for instance 'wx,wy,wz:deg/s'; units of rate, pulse, or count.
        accel: Three columns, for instance '5,6,7:g'; units of acceleration, pulse, or count.
        joints: Columns named as the table's joints, for instance 'outer,inner:deg'.
        temperature: One column, 'NAME:degC'.
        delimiter: Between fields; None finds it.
        gyro_topic: sensor_msgs/Imu of which the angular velocity counts.
        accel_topic: sensor_msgs/Imu of which the linear acceleration counts.
        imu: What pulses or counts mean, written into the recording.
        progress: Shows how far it is; nothing by default.

    Raises:
        InputError: Unreadable, the options do not fit the file, or the output exists.

    """
    target = user_path(output)
    if target.exists():
        raise InputError(f'{target}: exists already; name a folder that does not.')
    path = located(source)
    columns = {'stamp': stamp, 'gyro': gyro, 'accel': accel, 'joints': joints}
    columns |= {'temperature': temperature, 'rate': rate}
    if path.suffix == '.bag' or path.is_dir() or path.suffix in {'.mcap', '.db3'}:
        given = [name for name, value in columns.items() if value is not None]
        if given:
            raise InputError(f'`{given[0]}` names columns of a text file; {path} is a recording.')
        if path.suffix == '.bag':
            return _from_ros1(path, target)
        if gyro_topic is None or accel_topic is None:
            raise InputError(
                f'{path} is a recording of rosbag2 already. Where gyros and accelerometers are on '
                'topics of their own, give `gyro_topic` and `accel_topic`.'
            )
        return _joined(path, target, gyro_topic, accel_topic, imu, progress)
    text = read_text(path, delimiter)
    if gyro is None or accel is None or (stamp is None) == (rate is None):
        raise InputError(
            f'{path}: its columns are {", ".join(text.names)}. Say which are which: `gyro` '
            'NAME,NAME,NAME:UNIT, `accel` NAME,NAME,NAME:UNIT, and `stamp` NAME:UNIT or `rate` HZ.'
        )
    return _from_text(text, target, stamp, rate, gyro, accel, joints, temperature, imu)


def _from_text(
    text: Text,
    target: Path,
    stamp: str | None,
    rate: str | None,
    gyro: str,
    accel: str,
    joints: str | None,
    temperature: str | None,
    imu: Named | None,
) -> Converted:
    stamps = _stamps(text, stamp, rate)
    rates, gyro_unit = _columns(text, gyro, '`gyro`', _GYRO, 3)
    forces, accel_unit = _columns(text, accel, '`accel`', _ACCEL, 3)
    raw = {gyro_unit, accel_unit} & set(_RAW_UNITS)
    if raw and gyro_unit != accel_unit:
        raise InputError(
            f'`gyro` and `accel`: found {gyro_unit} and {accel_unit}, expected both in SI units, '
            'or both in pulses, or both in counts.'
        )
    data = _described(imu, raw)
    times, (rates, forces) = _sound(stamps, rates, forces)
    block = ImuBlock(times, rates, forces, 'imu_link')
    counts = {(_RAW if raw else _SI): len(block)}
    # All columns are read before anything is written: a wrong name leaves no half of a recording.
    others: list[tuple[str, Kind, Messages, Stamps]] = []
    if joints is not None:
        names = tuple(_parted(joints)[0])
        angles, _ = _columns(text, joints, '`joints`', _ANGLE, len(names))
        at, (angles,) = _sound(stamps, angles)
        encoded = encode_joints(JointBlock(at, names, angles, np.full_like(angles, np.nan)))
        others.append((_JOINTS, Kind.JOINTS, encoded, at))
    if temperature is not None:
        celsius, _ = _columns(text, temperature, '`temperature`', _CELSIUS, 1)
        at, (celsius,) = _sound(stamps, celsius)
        encoded = encode_temperatures(TemperatureBlock(at, celsius[:, 0]))
        others.append((_TEMPERATURE, Kind.TEMPERATURES, encoded, at))
    with RecordingWriter(target, data) as writer:
        _write_imu(writer, block, raw=bool(raw))
        for topic, kind, messages, at in others:
            writer.write(topic, kind.type_name, messages, at)
            counts[topic] = len(at)
    return Converted(target, counts, _left_out(text, len(stamps) - len(block)))


def _sound(stamps: Floats, *columns: Floats) -> tuple[Stamps, list[Floats]]:
    """Return the rows in which the stamp and all columns (n, k) are numbers."""
    known = np.isfinite(np.column_stack([stamps, *columns])).all(axis=1)
    return stamps[known].astype(np.int64), [values[known] for values in columns]


def _left_out(text: Text, rows: int) -> tuple[str, ...]:
    said = []
    if text.broken:
        said.append(f'{text.broken} lines of {text.path.name} are no row of numbers; left out.')
    if rows:
        said.append(f'{rows} rows hold no number in a column that is needed; left out.')
    return tuple(said)


def _described(imu: Named | None, raw: set[str]) -> dict[str, str]:
    """Return what the recording is to say of the IMU.

    Raises:
        InputError: What pulses or counts mean is not stated, or other units are.

    """
    if imu is None and raw:
        raise InputError(
            f'`gyro` and `accel` are in {raw.pop()}s: give `imu`, a file that says what one is '
            '(config/imus has examples).'
        )
    file = named_file('imus', 'si' if imu is None else imu)
    units = load_imu(file).units
    if (units is Units.SI) == bool(raw):
        found = f'{raw.pop()}s' if raw else 'rates and accelerations'
        raise InputError(f'`imu` {imu}: units: found {units.value}, but the numbers are {found}.')
    return {'imu_calib.imu': file.read_text(encoding='utf-8')}


def _stamps(text: Text, stamp: str | None, rate: str | None) -> Floats:
    """Return the time of each row, ns.

    Raises:
        InputError: No such column or unit, no rate, or times that no IMU has.

    """
    if rate is not None:
        hertz = parse(rate, Dimension.FREQUENCY, '`rate`')
        if not _SLOWEST <= hertz <= _FASTEST:
            raise InputError(f'`rate` {rate}: expected {_RATES}.')
        return np.asarray(np.rint(np.arange(len(text.values)) * (1e9 / hertz)))
    assert stamp is not None
    times, _ = _columns(text, stamp, '`stamp`', _STAMP, 1)
    latest = float(np.nanmax(np.abs(times), initial=0.0)) * 1e-9
    if latest > _LAST_SECOND:
        raise InputError(
            f'`stamp` {stamp}: a row is {latest:.3g} s from 1970, more than a message can say: '
            f'another unit of {", ".join(_STAMP)}?'
        )
    stamps = np.asarray(np.rint(times[:, 0]))
    _refuse_what_is_no_time(stamps[np.isfinite(stamps)], f'{text.path}: `stamp` {stamp}')
    return stamps


def _refuse_what_is_no_time(stamps: Floats, column: str) -> None:
    """Refuse stamps, ns, that do not grow, or not at the rate of an IMU.

    Raises:
        InputError: They are such; the file and the column are named.

    """
    intervals = np.diff(stamps)
    if not len(intervals):
        return
    wrong = np.flatnonzero(intervals <= 0)
    if len(wrong) > _BACKWARDS * len(intervals):
        first = int(wrong[0])
        raise InputError(
            f'{column}: the time does not grow in {len(wrong)} of {len(intervals)} intervals '
            f'between rows, first from {stamps[first] * 1e-9:.6f} s to '
            f'{stamps[first + 1] * 1e-9:.6f} s; at most {_BACKWARDS:.0%} may be so. Name the '
            'column of the time, written with all its digits and in its order, or give `rate` '
            'instead.'
        )
    hertz = 1e9 / float(np.median(intervals))
    if not _SLOWEST <= hertz <= _FASTEST:
        unit = column.rpartition(':')[2]
        units = ((u, hertz * _STAMP[unit] / _STAMP[u]) for u in _STAMP)
        others = [f'{u} would be {h:.4g} Hz' for u, h in units if _SLOWEST <= h <= _FASTEST]
        known = f'In another unit, {", ".join(others)}'
        advice = known if others else 'Name the column of the time'
        raise InputError(
            f'{column}: found {hertz:.4g} Hz, by the median of {len(intervals)} intervals between '
            f'rows; expected {_RATES}. {advice}.'
        )


def _columns(
    text: Text, stated: str, option: str, units: Mapping[str, float], count: int
) -> tuple[Floats, str]:
    """Return columns in SI (pulses and counts as they are), (n, count), and their unit.

    Raises:
        InputError: Not so many names with a unit, or no such column.

    """
    parts, unit = _parted(stated)
    if unit not in units or len(parts) != count or not all(parts):
        form = ','.join(['NAME'] * count)
        raise InputError(
            f'{option}: found {stated!r}, expected {form}:UNIT, with the unit one of '
            f'{", ".join(units)}.'
        )
    values = np.column_stack([text.column(name, option) for name in parts])
    return values * units[unit], unit


def _parted(stated: str) -> tuple[list[str], str]:
    """Part 'NAME,NAME:UNIT' into names and unit."""
    names, _, unit = stated.rpartition(':')
    return [name.strip() for name in names.split(',')], unit.strip()


def _write_imu(writer: RecordingWriter, block: ImuBlock, *, raw: bool) -> None:
    unknown = np.zeros((_BLOCK, 9))
    for first in range(0, len(block), _BLOCK):
        part = slice(first, first + _BLOCK)
        piece = ImuBlock(block.stamp[part], block.gyro[part], block.accel[part], block.frame_id)
        covariance = unknown[: len(piece)]
        encoded: Messages = (
            encode_imu(piece) if raw else encode_rates(piece, covariance, covariance)
        )
        writer.write(_RAW if raw else _SI, Kind.IMU.type_name, encoded, piece.stamp)


def _joined(
    path: AnyPath,
    target: Path,
    gyro_topic: str,
    accel_topic: str,
    imu: Named | None,
    progress: Progress,
) -> Converted:
    """Join two topics to one; the other topics are copied as they are."""
    described = _described(imu, set())
    rates, forces = read(path, gyro_topic), read(path, accel_topic)
    for columns in (rates, forces):
        if (unit := next(iter(columns.units.values()))) in _RAW_UNITS:
            raise InputError(
                f'{path}: {columns.topic} holds {unit}s, which lie on no line between two samples: '
                'expected rad/s and m/s^2.'
            )
    if len(rates) < 2 or len(forces) < 2:
        raise InputError(
            f'{path}: {gyro_topic} and {accel_topic} hold {len(rates)} and '
            f'{len(forces)} samples: expected two or more of each.'
        )
    gyro = np.column_stack([rates[f'angular_velocity.{a}'] for a in 'xyz'])
    accel = np.column_stack([forces[f'linear_acceleration.{a}'] for a in 'xyz'])
    order = np.argsort(forces.stamp, kind='stable')
    stamps, read_at, within = _read_at(forces.stamp[order], accel[order], rates.stamp)
    block = ImuBlock(stamps, gyro[within], read_at, 'imu_link')
    taken = {rates.topic, forces.topic}
    counts = {_SI: len(block)}
    with open_recording(path) as recording:
        _refuse_taken(recording, taken)
        data = {**recording.custom_data, **described}
        with RecordingWriter(target, data) as writer, progress('converting') as show:
            _write_imu(writer, block, raw=False)
            for one, messages, times in recording.messages(show):
                if one.name not in taken:
                    writer.write(one.name, one.type, messages, times.log, times.publish)
                    counts[one.name] = counts.get(one.name, 0) + len(messages)
        losses = recording.losses
    return Converted(target, counts, (_resampling(rates.stamp, forces.stamp, within), *losses))


def _refuse_taken(recording: Recording, taken: set[str]) -> None:
    if any(topic.name == _SI for topic in recording.topics) and _SI not in taken:
        raise InputError(f'{recording.path} has a topic {_SI} already.')


def _read_at(known: Stamps, values: Floats, wanted_at: Stamps) -> tuple[Stamps, Floats, Stamps]:
    """Read values (n, 3) at other stamps, on straight lines between their own.

    Returns:
        Stamps that lie between two samples, the values there, and the indices of those stamps.

    """
    after = np.searchsorted(known, wanted_at, side='left')
    exact = (after < len(known)) & (known[np.minimum(after, len(known) - 1)] == wanted_at)
    before = np.clip(after - 1, 0, len(known) - 2)
    apart = known[before + 1] - known[before]
    usual = float(np.median(np.diff(known)))
    between = (after > 0) & (after < len(known)) & (apart <= _SILENT * usual)
    within = np.flatnonzero(exact | between)
    at = wanted_at[within]
    # Stamps since 1970 are exact as integers alone.
    since = (at - known[0]).astype(float), (known - known[0]).astype(float)
    read_at = np.column_stack([np.interp(*since, v) for v in values.T])
    return at, read_at, within


def _resampling(gyro: Stamps, accel: Stamps, within: Stamps) -> str:
    """Say from which rate to which the accelerometers were read."""
    rates = [1e9 / float(np.median(np.diff(np.sort(s)))) for s in (gyro, accel)]
    lost = len(gyro) - len(within)
    left = f'; {lost} samples of the gyros have no such line and are left out' if lost else ''
    return (
        f'The accelerometers come with {rates[1]:.4g} Hz and are read at the stamps of the gyros, '
        f'{rates[0]:.4g} Hz, on straight lines between their samples, which smooths their noise'
        f'{left}.'
    )


def _from_ros1(path: AnyPath, target: Path) -> Converted:
    """Write a bag of ROS 1 anew, with the messages that a calibration can use."""
    require('rosbags', f'{path}: a bag of ROS 1', 'ros1')
    from rosbags.convert import ConverterError
    from rosbags.convert import convert as rewritten
    from rosbags.typesys import Stores, get_typestore

    stores = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_JAZZY)
    types = [k.type_name for k in (Kind.IMU, Kind.JOINTS, Kind.TEMPERATURES)]
    try:
        rewritten([local(path)], target, 'mcap', 9, None, 'none', *stores, [], [], [], types)
        with open_recording(target) as recording:
            counts = {topic.name: topic.count or 0 for topic in recording.topics}
    except (ConverterError, RecordingError) as error:
        shutil.rmtree(target, ignore_errors=True)
        raise InputError(
            f'{path}: cannot be converted: {error} Expected a bag of ROS 1 with one of '
            f'{", ".join(types)}.'
        ) from None
    return Converted(target, counts, ())
