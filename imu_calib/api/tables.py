"""Text files, and data frames with columns of any names, as recordings in memory."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ..common.errors import InputError
from ..common.files import refuse_device
from ..common.stream import LAST_SECOND, Floats, Stamps, Units
from ..common.units import STANDARD_GRAVITY, Dimension, counted, parse
from ..recordings.cdr_codec import Kind
from ..recordings.order import places_by_stamp
from ..recordings.remote import AnyPath, located
from ..recordings.text import (
    ACCEL,
    GYRO,
    Text,
    as_outputs,
    columns_of,
    numbers_of,
    parted,
    read_sensors,
    read_text,
)
from ..segmentation.stream_facts import SEPARATE_ROWS, gravity_removed, halves, quiet_means
from ..session.imu import COLDEST, HOTTEST, ImuSpec
from ..session.keywords import InColumns, Named
from ..session.metadata import interpolation_description
from .converted import (
    JOINTS,
    RAW,
    SI,
    TEMPERATURE,
    described,
    imu_samples,
    rate_of,
    read_at,
    resampling,
)
from .in_memory import Samples, SamplesInMemory
from .streams import against_si, is_near_gravity, units_in_doubt

BACKWARDS = 0.01
"""Largest share of intervals between rows that may be zero or negative: a logger may write a row
twice or set its clock; a column that is not a time, or has lost digits, shows this throughout."""
SLOWEST, FASTEST = 2.0, 40e3
"""Rates of rows that an IMU may have, Hz. The fastest MEMS units have 32 kHz, phones and loggers of
vehicles 10 to 500 Hz. A unit of time that is a thousand times too small turns 50 Hz into 50 kHz,
one that is a thousand times too large 1 kHz into 1 Hz."""
RATES_OF_IMUS = f'{SLOWEST:g} Hz to {FASTEST / 1e3:g} kHz, the rates of IMUs'
_ANGLE: Mapping[str, float] = Dimension.ANGLE.value
_STAMP = {'s': 1e9, 'ms': 1e6, 'us': 1e3, 'ns': 1.0}  #: ns per unit of a time.
_CELSIUS = {'degC': 1.0, 'mdegC': 1e-3}  #: Degrees Celsius per unit of a temperature.
_COUNTERS = {2**32 * 1e3: 'microseconds', 2**32 * 1e6: 'milliseconds'}
"""ns until a counter of 32 bits begins anew, and what it counts: micros() and millis()."""
_FORMS = {
    'stamp': 'NAME:UNIT or `rate` HZ',
    'gyro': 'NAME,NAME,NAME:UNIT',
    'accel': 'NAME,NAME,NAME:UNIT',
}
_USUAL = {
    'stamp': re.compile(
        r'(t|time|zeit|stamp|timestamp|seconds|secs?|millis|micros|[mun]?s)(?![^\W_])'
    ),
    'gyro': re.compile(
        r'(g|gyr\w*|w|omega|ang\w*|rate|rot\w*)[ _.]*(x|y|z)(?![^\W_])|gyr\w*\[[012]\]'
    ),
    'accel': re.compile(r'(a|acc\w*|f|force|lin\w*)[ _.]*(x|y|z)(?![^\W_])|acc\w*\[[012]\]'),
}
"""Usual names of columns, in small letters."""
_IN_HEADING = re.compile(
    r'[\[(]([^\[(\])]+)[\])]$'
)  #: A unit behind a name: 'Time (s)', 'x[mdps]'.
_TYPED = re.compile(r'[\w.]+')  #: A name that no shell takes for more.
_LONGEST_LOSS = 10e9
"""ns of rows that may be missing where a counter begins anew. A judgement: a clock that is set back
by a period of 72 minutes or 50 days does not meet it within seconds by chance."""


def from_text(path: AnyPath, columns: InColumns, imu: ImuSpec | Named | None) -> SamplesInMemory:
    """Read the columns of a text file, and of that of the accelerometers if they have their own."""
    refuse_device(path)
    delimiter, accel_file = columns.get('delimiter'), columns.get('accel_file')
    text, own = read_sensors(path, delimiter)
    if accel_file is None:
        return from_columns(text, columns, imu, own, (path,))
    file = located(accel_file)
    return from_columns(text, columns, imu, read_text(file, delimiter), (path, file))


def from_columns(
    text: Text,
    columns: InColumns,
    imu: ImuSpec | Named | None,
    accel_text: Text | None = None,
    files: tuple[AnyPath, ...] = (),
) -> SamplesInMemory:
    """Return the stated columns of a table as a recording.

    Accelerometers in a separate table, `accel_text`, are interpolated at the stamps of the gyros.
    """
    stamp, rate = columns.get('stamp'), columns.get('rate')
    gyro, accel = columns.get('gyro'), columns.get('accel')
    _refuse_lacking(text, columns, apart=accel_text is not None)
    assert gyro is not None and accel is not None
    sentences: list[str] = []
    text, stamps = _in_time(text, stamp, rate, sentences)
    forces_at = stamps
    if accel_text is not None:
        accel_stamp = columns.get('accel_stamp', stamp)
        accel_text, forces_at = _in_time(accel_text, accel_stamp, None, sentences)
    stamps, forces_at = _from_zero(stamps, forces_at, sentences)
    rates, gyro_unit = columns_of(text, gyro, '`gyro`', GYRO, 3)
    forces, accel_unit = columns_of(accel_text or text, accel, '`accel`', ACCEL, 3)
    numbers = numbers_of(gyro_unit, accel_unit)
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
        others = _rows_of_others(text, stamps, columns, np.hstack([rates, forces]))
        times, (rates, forces) = _sound(stamps, rates, forces)
        sentences += _left_out(text, len(stamps) - len(times) - others)
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
    if numbers is Units.SI and (
        removed := gravity_removed(quiet_means(forces), quiet_means(rates))
    ):
        sentences.append(removed)
    elif numbers is Units.SI and (seen := against_si(forces, rates, gyro_unit, accel_unit)):
        sentences.append(f'{units_in_doubt(seen)} Check the columns of `gyro` and `accel`.')
    rates, forces = as_outputs(rates, forces, spec)
    topics = {topic: imu_samples(topic, times, np.hstack([rates, forces]))}
    topics |= _other_topics(text, stamps, columns.get('joints'), columns.get('temperature'))
    return SamplesInMemory(text.path, topics, files, data, sentences)


def _refuse_lacking(text: Text, columns: InColumns, *, apart: bool) -> None:
    """Refuse columns without which there is no recording, or that contradict each other."""
    stamp, rate = columns.get('stamp'), columns.get('rate')
    given = {'stamp': stamp or rate, 'gyro': columns.get('gyro'), 'accel': columns.get('accel')}
    if lacking := [name for name, value in given.items() if value is None]:
        found = suggested(text)
        words = ' '.join(f'`{name}` {found.get(name, _FORMS[name])}' for name in lacking)
        guessed = ', if these are the units' if set(lacking) & found.keys() else ''
        other = '' if apart else ' (accelerometers in a file of their own: `accel_file`)'
        raise InputError(
            f'{text.path}: its columns are {", ".join(text.names)}. State {words}{guessed}{other}.'
        )
    if stamp is not None and rate is not None:
        raise InputError(
            f'`stamp` {stamp} and `rate` {rate} both give the times of the rows: leave one out.'
        )
    if not apart and 'accel_stamp' in columns:
        raise InputError('`accel_stamp` is the time in `accel_file`, which is not given.')
    if apart and stamp is None:
        raise InputError(
            'Gyros and accelerometers in rows of their own are joined by their times: give `stamp` '
            'in place of `rate`.'
        )


def suggested(text: Text) -> dict[str, str]:
    """Return what may be meant by `stamp`, `gyro` and `accel`, by the names of columns.

    The units are those of the heading, else those that the numbers allow, or UNIT: they are to be
    read and corrected. A name that a command line takes only in quotes is given by its place.
    """
    found = {}
    for option, pattern in _USUAL.items():
        names = [name for name in text.names if pattern.match(name.lower())]
        if option == 'stamp' and len(names) > 1:
            # Of several times, the first that is one; a `T` may be a temperature.
            units = (_likely_unit(option, text.column(n, option)[:, None]) for n in names)
            names = [n for n, unit in zip(names, units, strict=True) if unit != 'UNIT'][:1]
        if len(names) != (1 if option == 'stamp' else 3):
            continue
        values = np.column_stack([text.column(name, option) for name in names])
        unit = _stated_unit(option, names) or _likely_unit(option, values)
        if not all(_TYPED.fullmatch(name) for name in names):
            names = [str(text.names.index(name) + 1) for name in names]
        found[option] = f'{",".join(names)}:{unit}'
    return found


def _stated_unit(option: str, names: Sequence[str]) -> str:
    """Return the unit that all names of a heading end with; empty without one that is known."""
    stated = {match[1].replace('°', 'deg') for n in names if (match := _IN_HEADING.search(n))}
    known = {'stamp': _STAMP, 'gyro': GYRO, 'accel': ACCEL}[option]
    return stated.pop() if len(stated) == 1 and stated <= known.keys() else ''


def _likely_unit(option: str, values: Floats) -> str:
    known = values[np.isfinite(values).all(axis=1)]
    if len(known) < 2:
        return 'UNIT'
    whole = not (known % 1).any()
    if option == 'gyro':
        # Slow turns may be in any unit.
        if not against_si(np.array([[0.0, 0.0, STANDARD_GRAVITY]]), known):
            return 'UNIT'
        return 'count' if whole else 'deg/s'
    if option == 'accel':
        length = float(np.median(np.linalg.norm(known, axis=1))) / STANDARD_GRAVITY
        units = {'m/s^2': 1.0, 'g': STANDARD_GRAVITY, 'mg': STANDARD_GRAVITY / 1000}
        other = 'count' if whole else 'UNIT'
        return next((u for u, one in units.items() if is_near_gravity(length * one)), other)
    interval = float(np.median(np.diff(known[:, 0])))
    rates = {u: 1e9 / (interval * ns) for u, ns in _STAMP.items() if interval > 0}
    return next((u for u, rate in rates.items() if SLOWEST <= rate <= FASTEST), 'UNIT')


def _other_topics(
    text: Text, stamps: Floats, joints: str | None, temperature: str | None
) -> dict[str, Samples]:
    """Return the samples of joints and temperatures, by topic."""
    others: dict[str, Samples] = {}
    if joints is not None:
        names = tuple(parted(joints)[0])
        angles, _ = columns_of(text, joints, '`joints`', _ANGLE, len(names))
        at, (angles,) = _sound(stamps, angles)
        speeds = np.full_like(angles, np.nan)
        others[JOINTS] = Samples(Kind.JOINTS, at, [*angles.T, *speeds.T], names)
    if temperature is not None:
        celsius, _ = columns_of(text, temperature, '`temperature`', _CELSIUS, 1)
        at, (celsius,) = _sound(stamps, celsius)
        _refuse_no_celsius(celsius, temperature)
        others[TEMPERATURE] = Samples(Kind.TEMPERATURES, at, [celsius[:, 0]])
    return others


def _rows_of_others(text: Text, stamps: Floats, columns: InColumns, values: Floats) -> int:
    """Return how many rows have no value of the IMU, and those of joints or a temperature."""
    used = np.zeros(len(stamps), dtype=bool)
    if (joints := columns.get('joints')) is not None:
        angles, _ = columns_of(text, joints, '`joints`', _ANGLE, len(parted(joints)[0]))
        used |= np.isfinite(angles).all(axis=1)
    if (temperature := columns.get('temperature')) is not None:
        celsius, _ = columns_of(text, temperature, '`temperature`', _CELSIUS, 1)
        used |= np.isfinite(celsius[:, 0])
    return int(np.count_nonzero(used & np.isfinite(stamps) & np.isnan(values).all(axis=1)))


def _in_time(
    text: Text, stamp: str | None, rate: float | str | None, sentences: list[str]
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


def rows_per_second(rate: float | str | None) -> float | None:
    """Return the rate of rows, Hz; a number alone is in Hz, as in `sample_rate`."""
    if rate is None:
        return None
    text = str(rate)
    found = parse(f'{text} Hz' if _is_bare(text) else text, Dimension.FREQUENCY, '`rate`')
    if not SLOWEST <= found <= FASTEST:
        raise InputError(f'`rate`: found {found:g}, expected samples per second: {RATES_OF_IMUS}.')
    return found


def _stamps(
    text: Text, stamp: str | None, rate: float | str | None, sentences: list[str]
) -> Floats:
    """Return the time of each row, ns; add to `sentences` that a counter began anew."""
    if (per_second := rows_per_second(rate)) is not None:
        return np.asarray(np.rint(np.arange(len(text.values)) * (1e9 / per_second)))
    assert stamp is not None
    times = sum(columns_of(text, part, '`stamp`', _STAMP, 1)[0] for part in _parts_of_time(stamp))
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
