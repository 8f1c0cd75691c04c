"""Convert text files, bags of ROS 1 and separate topics to recordings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from ..common.arguments import checked
from ..common.errors import InputError
from ..common.files import BAG_OF_ROS_1, refuse_device, require, user_path
from ..common.progress import Progress, silent
from ..common.stream import (
    LAST_SECOND,
    Floats,
    ImuBlock,
    JointBlock,
    Stamps,
    TemperatureBlock,
    Units,
)
from ..common.units import Dimension, counted, parse
from ..recordings.cdr import Messages
from ..recordings.cdr_codec import Kind, encode_joints, encode_temperatures
from ..recordings.order import places_by_stamp
from ..recordings.remote import AnyPath, local, located
from ..recordings.rosbag2 import is_storage, open_recording
from ..recordings.storage import RecordingError, refuse_existing
from ..recordings.text import Text, read_sensors, read_text
from ..recordings.writer import RecordingWriter
from ..segmentation.stream_facts import SEPARATE_ROWS, gravity_removed, halves, quiet_means
from ..session.imu import COLDEST, HOTTEST
from ..session.keywords import Named
from ..session.metadata import interpolation_description
from .converted import (
    JOINTS,
    RAW,
    RAW_UNITS,
    SI,
    TEMPERATURE,
    Converted,
    described,
    joined,
    rate_of,
    read_at,
    resampling,
    write_imu,
)
from .files import BACKWARDS, FASTEST, RATES_OF_IMUS, SLOWEST, removed_on_failure
from .opening import against_si, units_in_doubt

_GYRO = {**Dimension.RATE.value, **Dimension.ANGLE.value, **RAW_UNITS}
_ACCEL = {**Dimension.ACCELERATION.value, **Dimension.VELOCITY.value, **RAW_UNITS}
_ANGLE: Mapping[str, float] = Dimension.ANGLE.value
_STAMP = {'s': 1e9, 'ms': 1e6, 'us': 1e3, 'ns': 1.0}  #: ns per unit of a time.
_CELSIUS = {'degC': 1.0, 'mdegC': 1e-3}  #: Degrees Celsius per unit of a temperature.
_COUNTERS = {2**32 * 1e3: 'microseconds', 2**32 * 1e6: 'milliseconds'}
"""ns until a counter of 32 bits begins anew, and what it counts: micros() and millis()."""
_LONGEST_LOSS = 10e9
"""ns of rows that may be missing where a counter begins anew. A judgement: a clock that is set back
by a period of 72 minutes or 50 days does not meet it within seconds by chance."""


def from_text(
    text: Text,
    target: Path,
    stamp: str | None,
    rate: str | None,
    gyro: str,
    accel: str,
    joints: str | None,
    temperature: str | None,
    imu: Named | None,
    accel_text: Text | None = None,
    accel_stamp: str | None = None,
) -> Converted:
    """Convert the columns of a text file to a recording; arguments as of `convert`.

    Accelerometers in a separate file, `accel_text`, are interpolated at the stamps of the gyros.
    """
    sentences: list[str] = []
    text, stamps = _in_time(text, stamp, rate, sentences)
    forces_at = stamps
    if accel_text is not None:
        accel_text, forces_at = _in_time(accel_text, accel_stamp or stamp, None, sentences)
    stamps, forces_at = _from_zero(stamps, forces_at, sentences)
    rates, gyro_unit = _columns(text, gyro, '`gyro`', _GYRO, 3)
    forces, accel_unit = _columns(accel_text or text, accel, '`accel`', _ACCEL, 3)
    numbers = _units_of(gyro_unit, accel_unit)
    data, spec = described(imu, numbers)
    topic = SI if spec.units is Units.SI else RAW
    if accel_text is None and (apart := halves(rates, forces)) is not None:
        of_gyro, of_accel = apart
        sentences.append(SEPARATE_ROWS)
        gyros = _sensor_rows(text, stamps[of_gyro], rates[of_gyro], sentences)
        accels = _sensor_rows(None, stamps[of_accel], forces[of_accel], sentences)
    elif accel_text is not None:
        gyros = _sensor_rows(text, stamps, rates, sentences)
        accels = _sensor_rows(accel_text, forces_at, forces, sentences)
    else:
        times, (rates, forces) = _sound(stamps, rates, forces)
        sentences += _left_out(text, len(stamps) - len(times))
        gyros, accels = (times, rates), (times, forces)
    if not len(gyros[0]):
        raise InputError(f'{text.path}: no row holds a number in each of the columns named.')
    if accels[0] is not gyros[0]:
        before = len(sentences)
        known = accels[0]
        exactly = numbers is not Units.SI
        times, rates, forces = _interpolated_forces(*gyros, *accels, sentences, exactly=exactly)
        if len(sentences) > before:
            data |= interpolation_description(topic, rate_of(known))
    if numbers is Units.SI and (removed := gravity_removed(quiet_means(forces))):
        sentences.append(removed)
    elif numbers is Units.SI and (seen := against_si(forces, rates)):
        sentences.append(f'{units_in_doubt(seen)} Check the columns of `gyro` and `accel`.')
    if not spec.units.whole:
        # Whole numbers are not converted: the file says what one is.
        rates, forces = rates / spec.gyro.scale_factor, forces / spec.accel.scale_factor
    block = ImuBlock(times, rates, forces, 'imu_link')
    # Read all columns before writing: a wrong name must not leave a partial recording.
    others = _other_topics(text, stamps, joints, temperature)
    counts = {topic: len(block)}
    with removed_on_failure(target), RecordingWriter(target, data) as writer:
        write_imu(writer, block, raw=topic == RAW)
        for name, kind, messages, at in others:
            writer.write(name, kind.type_name, messages, at)
            counts[name] = len(at)
    return Converted(target, counts, tuple(sentences))


def _other_topics(
    text: Text, stamps: Floats, joints: str | None, temperature: str | None
) -> list[tuple[str, Kind, Messages, Stamps]]:
    """Return the messages of joints and temperatures, with topic, kind and stamps."""
    others: list[tuple[str, Kind, Messages, Stamps]] = []
    if joints is not None:
        names = tuple(_parted(joints)[0])
        angles, _ = _columns(text, joints, '`joints`', _ANGLE, len(names))
        at, (angles,) = _sound(stamps, angles)
        encoded = encode_joints(JointBlock(at, names, angles, np.full_like(angles, np.nan)))
        others.append((JOINTS, Kind.JOINTS, encoded, at))
    if temperature is not None:
        celsius, _ = _columns(text, temperature, '`temperature`', _CELSIUS, 1)
        at, (celsius,) = _sound(stamps, celsius)
        _refuse_no_celsius(celsius, temperature)
        encoded = encode_temperatures(TemperatureBlock(at, celsius[:, 0]))
        others.append((TEMPERATURE, Kind.TEMPERATURES, encoded, at))
    return others


def _in_time(
    text: Text, stamp: str | None, rate: str | None, sentences: list[str]
) -> tuple[Text, Floats]:
    """Return a table with its rows in the order of their times, and these, ns.

    What was found on the way is added to `sentences`.
    """
    stamps = _stamps(text, stamp, rate, sentences)
    if rate is None:
        # Rows without a time stay in their places.
        known = np.flatnonzero(np.isfinite(stamps))
        order = places_by_stamp(stamps[known])
        if order is not None:
            places = np.arange(len(stamps))
            places[known] = known[order]
            late = int(np.count_nonzero(stamps < np.fmax.accumulate(stamps)))
            sentences.append(
                f'{late} rows of {text.path.name} came out of order; they are sorted by time.'
            )
            text, stamps = replace(text, values=text.values[places]), stamps[places]
        _refuse_what_is_no_time(stamps[np.isfinite(stamps)], f'{text.path}: `stamp` {stamp}')
    return text, stamps


def _from_zero(stamps: Floats, others: Floats, sentences: list[str]) -> tuple[Floats, Floats]:
    """Return times, ns, later by the earliest one if it is negative: log times cannot be."""
    earliest = min(float(np.nanmin(times, initial=0.0)) for times in (stamps, others))
    if earliest == 0:
        return stamps, others
    sentences.append(
        f'The time begins at {earliest * 1e-9:.6g} s, and recordings hold none before 0: all times '
        f'are shifted by {-earliest * 1e-9:.6g} s.'
    )
    return stamps - earliest, others - earliest


def _sensor_rows(
    text: Text | None, stamps: Floats, values: Floats, sentences: list[str]
) -> tuple[Stamps, Floats]:
    """Return the sound rows of one sensor; what a file lacks is added to `sentences`."""
    times, (sound,) = _sound(stamps, values)
    if text is not None:
        sentences += _left_out(text, len(stamps) - len(times))
    return times, sound


def _units_of(gyro_unit: str, accel_unit: str) -> Units:
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


def _sound(stamps: Floats, *columns: Floats) -> tuple[Stamps, list[Floats]]:
    """Return the rows in which the stamp and all columns (n, k) are numbers."""
    known = np.isfinite(np.column_stack([stamps, *columns])).all(axis=1)
    return stamps[known].astype(np.int64), [values[known] for values in columns]


def _interpolated_forces(
    stamps: Stamps,
    rates: Floats,
    known: Stamps,
    forces: Floats,
    sentences: list[str],
    *,
    exactly: bool,
) -> tuple[Stamps, Floats, Floats]:
    """Return rates and forces of two files at the stamps of the rates; add to `sentences`."""
    shared = np.isin(stamps, known)
    if exactly and not shared.all():
        raise InputError(
            f'{int((~shared).sum())} of {len(stamps)} rows of the gyros have no row of the '
            'accelerometers at their time, and pulses, counts and increments cannot be '
            'interpolated. Give columns in SI units, or rows with common times.'
        )
    order = np.argsort(known, kind='stable')
    known, forces = known[order], forces[order]
    if len(known) < 2 or len(stamps) < 2 or known[-1] < stamps.min() or stamps.max() < known[0]:
        raise InputError(
            'The times of the gyros and those of the accelerometers do not overlap: check the '
            'columns and units of `stamp` and `accel_stamp`.'
        )
    times, read, within = read_at(known, forces, stamps)
    if not shared.all():
        sentences.append(resampling(stamps, known, within))
    return times, rates[within], read


def _left_out(text: Text, rows: int) -> list[str]:
    sentences = []
    if text.broken:
        lines = counted(text.broken, 'line')
        verb = 'is no row' if text.broken == 1 else 'are not rows'
        sentences.append(f'{lines} of {text.path.name} {verb} of numbers; left out.')
    if rows:
        verb = 'holds' if rows == 1 else 'hold'
        sentences.append(
            f'{counted(rows, "row")} {verb} no number in a column that is needed; left out.'
        )
    return sentences


def _refuse_no_celsius(celsius: Floats, stated: str) -> None:
    middle = float(np.median(celsius)) if len(celsius) else 0.0
    if COLDEST <= middle <= HOTTEST:
        return
    milli = stated.endswith(':degC') and COLDEST <= middle / 1000 <= HOTTEST
    other = f' Thousandths of a degree ({middle / 1000:.1f} degC): mdegC.' if milli else ''
    raise InputError(
        f'`temperature` {stated}: the median is {middle:.6g} degrees Celsius, expected '
        f'{COLDEST:g} to {HOTTEST:g}.{other}'
    )


def _stamps(text: Text, stamp: str | None, rate: str | None, sentences: list[str]) -> Floats:
    """Return the time of each row, ns; add to `sentences` that a counter began anew."""
    if rate is not None:
        # A number alone is in Hz, as in `sample_rate`.
        hertz = parse(f'{rate} Hz' if _is_bare(rate) else rate, Dimension.FREQUENCY, '`rate`')
        if not SLOWEST <= hertz <= FASTEST:
            raise InputError(f'`rate` {rate}: expected {RATES_OF_IMUS}.')
        return np.asarray(np.rint(np.arange(len(text.values)) * (1e9 / hertz)))
    assert stamp is not None
    times = sum(_columns(text, part, '`stamp`', _STAMP, 1)[0] for part in _parts_of_time(stamp))
    assert isinstance(times, np.ndarray)
    latest = float(np.nanmax(np.abs(times), initial=0.0)) * 1e-9
    if latest > LAST_SECOND:
        raise InputError(
            f'`stamp` {stamp}: a row is {latest:.3g} s from 1970, more than a message can hold. '
            f'Check its unit ({", ".join(_STAMP)}).'
        )
    stamps = np.asarray(np.rint(times[:, 0]))
    sentences += _unwrap(stamps, f'{text.path.name}: `stamp` {stamp}')
    return stamps


def _parts_of_time(stamp: str) -> list[str]:
    """Split 'sec:s,nanosec:ns', a time in two columns, into these."""
    parts = stamp.split(',')
    return parts if all(':' in part for part in parts) else [stamp]


def _unwrap(stamps: Floats, column: str) -> list[str]:
    """Continue stamps, ns, where a counter of 32 bits begins anew; return a sentence on it."""
    known = np.flatnonzero(np.isfinite(stamps))
    change = np.diff(stamps[known])
    for period, unit in _COUNTERS.items():
        anew = (change + period > 0) & (change + period < _LONGEST_LOSS)
        if anew.any():
            stamps[known[1:]] += period * np.cumsum(anew)
            times = 'once' if anew.sum() == 1 else f'{anew.sum()} times'
            return [
                f'{column} wraps {times}, as a 32-bit counter of {unit} does: the time is '
                'continued.'
            ]
    return []


def _is_bare(rate: str) -> bool:
    try:
        float(rate)
    except ValueError:
        return False
    return True


def _refuse_what_is_no_time(stamps: Floats, column: str) -> None:
    """Refuse stamps, ns, that do not increase, or not at the rate of an IMU."""
    intervals = np.diff(stamps)
    if not len(intervals):
        return
    wrong = np.flatnonzero(intervals <= 0)
    if len(wrong) > BACKWARDS * len(intervals):
        first = int(wrong[0])
        raise InputError(
            f'{column}: the time does not increase in {len(wrong)} of {len(intervals)} intervals, '
            f'first from {stamps[first] * 1e-9:.6f} to {stamps[first + 1] * 1e-9:.6f} s. Name the '
            'column of the time, with all its digits (two columns: sec:s,nanosec:ns), or give '
            '`rate` instead.'
        )
    hertz = 1e9 / float(np.median(intervals))
    if not SLOWEST <= hertz <= FASTEST:
        unit = column.rpartition(':')[2]
        units = ((u, hertz * _STAMP[unit] / _STAMP[u]) for u in _STAMP)
        others = [f'{u} would be {h:.4g} Hz' for u, h in units if SLOWEST <= h <= FASTEST]
        known = f'In another unit, {", ".join(others)}'
        advice = known if others else 'Name the column of the time'
        raise InputError(
            f'{column}: found {hertz:.4g} Hz by the median interval, expected {RATES_OF_IMUS}. '
            f'{advice}.'
        )


def _columns(
    text: Text, stated: str, option: str, units: Mapping[str, float], count: int
) -> tuple[Floats, str]:
    """Return columns in SI (pulses and counts unchanged), (n, count), and their unit."""
    parts, unit = _parted(stated)
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


def _parted(stated: str) -> tuple[list[str], str]:
    """Split 'NAME,NAME:UNIT' into names and unit."""
    names, _, unit = stated.rpartition(':')
    return [name.strip() for name in names.split(',')], unit.strip().replace('°', 'deg')


# Convert recordings of other software to recordings that every command reads.


@checked
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
    accel_file: Named | None = None,
    accel_stamp: str | None = None,
    imu: Named | None = None,
    progress: Progress = silent,
) -> Converted:
    """Convert a recording of other software to rosbag2 (mcap).

    State the columns of a text file: 'NAME,NAME,NAME:UNIT', each NAME as in its heading or a place
    counted from 1. A bag of ROS 1 needs no such options. Gyros and accelerometers on separate
    topics (`gyro_topic`, `accel_topic`) or in separate text files (`accel_file`) are joined: the
    accelerometers are interpolated linearly at the stamps of the gyros. So are those in rows or
    messages of their own: name one topic twice.

    Args:
        source: Text file, bag of ROS 1, recording of rosbag2, or a URL of one that fsspec reads.
        output: Folder to create.
        stamp: Column of each row's time, for instance 't:s' (s, ms, us, ns).
        rate: Of the rows, if there is no column of time: '200 Hz'; a number alone is in Hz.
        gyro: Three columns, for instance 'wx,wy,wz:deg/s'; units of rate or angle, pulse, or count.
        accel: Three columns, for instance '5,6,7:g'; units of acceleration or velocity, pulse,
            or count.
        joints: Columns with the names of the table's joints, for instance 'outer,inner:deg'.
        temperature: One column, 'NAME:degC'.
        delimiter: Between fields; None detects it.
        gyro_topic: sensor_msgs/Imu whose angular velocity is used.
        accel_topic: sensor_msgs/Imu whose linear acceleration is used.
        accel_file: Text file of the accelerometers, if `source` holds only the gyros.
        accel_stamp: Column of the time in `accel_file`; None: as `stamp`.
        imu: Meaning of pulses or counts, written into the recording.
        progress: Shows the progress; nothing by default.

    Raises:
        InputError: Unreadable, the options do not match the file, or the output exists.
    """
    target = user_path(output)
    refuse_existing(target)
    path = located(source)
    refuse_device(path)
    columns = {'stamp': stamp, 'gyro': gyro, 'accel': accel, 'joints': joints}
    columns |= {'temperature': temperature, 'rate': rate, 'accel_stamp': accel_stamp}
    columns |= {'accel_file': None if accel_file is None else str(accel_file)}
    of_ros_1 = path.suffix.lower() == '.bag' or _is_bag_of_ros_1(path)
    if of_ros_1 or path.is_dir() or is_storage(path):
        refuse_columns(columns)
        if of_ros_1:
            return _from_ros1(path, target)
        if path.is_dir() and not any(is_storage(file) for file in path.iterdir()):
            raise InputError(f'{path} is a folder without a recording; name a file to convert.')
        if gyro_topic is None or accel_topic is None:
            raise InputError(
                f'{path} is a recording of rosbag2 already. To join gyros and accelerometers of '
                'two topics, give `gyro_topic` and `accel_topic`.'
            )
        return joined(path, target, gyro_topic, accel_topic, imu, progress)
    text, own = read_sensors(path, delimiter)
    needed = {'`gyro` NAME,NAME,NAME:UNIT': gyro, '`accel` NAME,NAME,NAME:UNIT': accel}
    needed |= {'`stamp` NAME:UNIT or `rate` HZ': stamp or rate}
    lacking = [name for name, value in needed.items() if value is None]
    if gyro is None or accel is None or lacking:
        other = '' if accel_file else ' (accelerometers in a file of their own: `accel_file`)'
        raise InputError(
            f'{path}: its columns are {", ".join(text.names)}. State {", ".join(lacking)}{other}.'
        )
    if stamp is not None and rate is not None:
        raise InputError(
            f'`stamp` {stamp} and `rate` {rate} both give the times of the rows: leave one out.'
        )
    if accel_file is None and own is None:
        if accel_stamp is not None:
            raise InputError('`accel_stamp` is the time in `accel_file`, which is not given.')
        return from_text(text, target, stamp, rate, gyro, accel, joints, temperature, imu)
    if stamp is None:
        raise InputError(
            'Gyros and accelerometers in rows of their own are joined by their times: give `stamp` '
            'in place of `rate`.'
        )
    forces = own if accel_file is None else read_text(located(accel_file), delimiter)
    others = (joints, temperature, imu, forces, accel_stamp)
    return from_text(text, target, stamp, None, gyro, accel, *others)


def refuse_columns(columns: Mapping[str, object]) -> None:
    """Refuse columns of a text file, by option, that are stated of a recording."""
    given = [name for name, value in columns.items() if value is not None]
    if given:
        raise InputError(f'`{given[0]}` names columns of a text file, and this is none.')


def _is_bag_of_ros_1(path: AnyPath) -> bool:
    try:
        with path.open('rb') as file:
            return file.read(len(BAG_OF_ROS_1)) == BAG_OF_ROS_1
    except OSError:
        return False


def _from_ros1(path: AnyPath, target: Path) -> Converted:
    """Convert a bag of ROS 1, with the messages that calibration uses."""
    require('rosbags', f'{path}: a bag of ROS 1', 'ros1')
    from rosbags.convert import ConverterError
    from rosbags.convert import convert as rewritten
    from rosbags.typesys import Stores, get_typestore

    stores = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_JAZZY)
    types = [k.type_name for k in (Kind.IMU, Kind.JOINTS, Kind.TEMPERATURES)]
    bag = Path()
    try:
        with removed_on_failure(target), TemporaryDirectory() as folder:
            # rosbags goes by the ending.
            bag = Path(folder, 'bag.bag')
            bag.symlink_to(local(path).resolve())
            rewritten([bag], target, 'mcap', 9, None, 'none', *stores, [], [], [], types)
            with open_recording(target) as recording:
                counts = {topic.name: topic.count or 0 for topic in recording.topics}
    except (ConverterError, RecordingError) as error:
        reason = str(error).replace(str(bag), str(path))
        raise InputError(
            f'{path}: cannot be converted: {reason} Expected a bag of ROS 1 with one of '
            f'{", ".join(types)}; rosbag reindex completes one whose recorder did not finish.'
        ) from None
    return Converted(target, counts, ())
