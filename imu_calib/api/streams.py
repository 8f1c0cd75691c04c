"""The topics of a recording to read, and what contradicts the stamps of their samples."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np

from ..common.config import Section
from ..common.errors import InputError, NotObservable, NotStated
from ..common.files import other_encoding
from ..common.finding import is_warning, warning, without_label
from ..common.stream import Floats, ImuBlock, Units
from ..common.units import DEG, LARGEST, PPM, STANDARD_GRAVITY, Dimension
from ..recordings.cdr_codec import Kind
from ..recordings.rosbag2 import Recording
from ..session.imu import read_imu
from ..session.keywords import Stated
from ..session.metadata import LEFT_OUT, described_imu, serial_key
from ..session.units_file import namespace

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ..recordings.order import RecordedClock
    from ..recordings.storage import Topic

_SKEW = 'imu/skew'
_TEMPERATURE = 'imu/temperature'


@dataclass(frozen=True)
class Streams:
    """Names of the topics to read; None if the recording has none."""

    imu: str
    joints: str | None
    setpoints: str | None
    skew: str | None = None
    temperature: str | None = None

    def kinds(self) -> dict[str, Kind]:
        """Return the content of each topic."""
        named = {
            self.imu: Kind.IMU,
            self.joints: Kind.JOINTS,
            self.setpoints: Kind.SETPOINTS,
            self.skew: Kind.SKEW,
            self.temperature: Kind.TEMPERATURES,
        }
        return {topic: kind for topic, kind in named.items() if topic is not None}


def streams_of(stated: Stated, recording: Recording) -> Streams:
    """Choose the topics: the stated ones, or the only candidate of each type."""
    imu = imu_topic(stated.imu_topic, recording, stated.serial)
    skew = skew_topic(recording, imu)
    temperature = temperature_topic(recording, imu)
    if stated.imu_only:
        return Streams(imu, None, None, skew, temperature)
    joints = _choose(recording, Kind.JOINTS, stated.joint_topic, '`joint_topic`')
    setpoints = _choose(recording, Kind.SETPOINTS, stated.setpoint_topic, '`setpoint_topic`')
    return Streams(imu, joints, setpoints, skew, temperature)


def imu_topic(wanted: str | None, recording: Recording, serial: str | None = None) -> str:
    """Return the topic of the IMU: the stated one, or the only candidate."""
    wanted = wanted or _topic_of_unit(serial, recording)
    imu = _choose(recording, Kind.IMU, wanted, '`imu_topic`')
    if imu is None:
        if other := _in_other_encoding(recording):
            raise InputError(f'{recording.path}: {other_encoding(other.name, other.encoding)}')
        listed = ', '.join(f'{t.name} ({t.type})' for t in recording.topics) or 'none at all'
        raise NotStated(
            f'{recording.path}: no topic of type {Kind.IMU.type_name}; its topics: {listed}.'
        )
    return imu


def _in_other_encoding(recording: Recording) -> Topic | None:
    """Return the first topic with samples of an IMU that are not serialised as ROS 2 does."""
    others = [t for t in recording.topics if t.encoding != 'cdr' and t.count != 0]
    return next((t for t in others if re.search(r'(^|[/.])imu$', t.type.lower())), None)


def _topic_of_unit(serial: str | None, recording: Recording) -> str | None:
    """Return the topic of the unit with a serial number, if the recording states it."""
    kind, data = Kind.IMU.type_name, recording.custom_data
    mine = [
        t.name
        for t in recording.topics
        if t.message_type == kind and serial is not None and data.get(serial_key(t.name)) == serial
    ]
    return mine[0] if len(mine) == 1 else None


def another_topic(recording: Recording, topic: str, made_from: Sequence[str]) -> tuple[str, ...]:
    """Return a warning where the recording has the topics of a calibration, and another is used."""
    kind = Kind.IMU.type_name
    own = [t.name for t in recording.topics if t.message_type == kind and t.name in made_from]
    if topic in own or not own:
        return ()
    text = f'The calibration was made from {own[0]}, and this is {topic}, perhaps of another unit.'
    return (warning(f'{text} Choose the topic with `imu_topic`.'),)


def units_of(recording: Recording) -> tuple[str, ...]:
    """Return the topics whose units the recording states, if there are several.

    Empty for at most one unit. Units that were excluded from the session are not listed.
    """
    kind, data = Kind.IMU.type_name, recording.custom_data
    topics = [
        t.name for t in recording.topics if t.message_type == kind and serial_key(t.name) in data
    ]
    left_out = data.get(LEFT_OUT, '').split(',')
    kept = [topic for topic in topics if namespace(data[serial_key(topic)]) not in left_out]
    return tuple(sorted(kept)) if len(topics) > 1 else ()


def excluded_from(recording: Recording) -> tuple[str, ...]:
    """Return the serial numbers of the units with data that were excluded from the session."""
    data, kept = recording.custom_data, units_of(recording)
    topics = [t.name for t in recording.topics if serial_key(t.name) in data]
    return tuple(sorted(data[serial_key(t)] for t in topics if t not in kept)) if kept else ()


def skew_topic(recording: Recording, imu: str) -> str | None:
    """Return the topic of an IMU's skewed gyro; None without one, or with several."""
    skewed = [
        t.name
        for t in recording.topics
        if t.message_type == Kind.IMU.type_name
        and t.name.endswith(_SKEW)
        and t.name != imu
        and t.count != 0
    ]
    return skewed[0] if len(skewed) == 1 else None


def temperature_topic(recording: Recording, imu: str) -> str | None:
    """Return the topic of the unit's thermometer: its own, the only one, or the one with a name."""
    kind = Kind.TEMPERATURES.type_name
    filled = [t.name for t in recording.topics if t.message_type == kind and t.count != 0]
    if serial := recording.custom_data.get(serial_key(imu)):
        # Of several units each has its namespace.
        own = f'/{namespace(serial)}/{_TEMPERATURE}'
        filled = [name for name in filled if name.endswith(own)] or filled
    if len(filled) > 1:
        filled = [name for name in filled if name.endswith(_TEMPERATURE)]
    return filled[0] if len(filled) == 1 else None


def _choose(recording: Recording, kind: Kind, wanted: str | None, option: str) -> str | None:
    candidates = [t for t in recording.topics if t.message_type == kind.type_name]
    if wanted is not None:
        return _named(recording, candidates, wanted, kind)
    filled = [t for t in candidates if t.count != 0 and not t.name.endswith(_SKEW)]
    filled = filled or candidates
    if not filled:
        return None
    if len(filled) > 1:
        listed = ', '.join(t.name for t in filled)
        several = ''
        if kind is Kind.IMU:
            several = (
                ' If they are units on one table, `serial` chooses one by the number in the '
                'recording, and calibrating with `imus` takes all.'
            )
            several = _join_hint(recording, filled) or several
            if units := units_of(recording):
                numbers = [recording.custom_data[serial_key(topic)] for topic in units]
                several = f' They are of the units {", ".join(numbers)}: `serial` chooses one.'
        raise NotStated(
            f'{recording.path}: {len(filled)} topics of type {kind.type_name}, {listed}: '
            f'choose with {option}.{several}'
        )
    return filled[0].name


def _join_hint(recording: Recording, topics: Sequence[Topic]) -> str:
    """Return the way to join topics of which one has rates alone; empty if each has both.

    Only samples in SI are joined.
    """
    rates: list[str] = []
    forces: list[str] = []
    for topic in topics:
        if topic.encoding != 'cdr' or recorded_units(recording, topic.name) is not Units.SI:
            continue
        for _, block in islice(recording.read({topic.name: Kind.IMU}), 1):
            assert isinstance(block, ImuBlock)
            has_rates, has_forces = np.any(np.abs(block.gyro) > 0), np.any(np.abs(block.accel) > 0)
            if has_rates and not has_forces:
                rates.append(topic.name)
            elif has_forces:
                # One with accelerations alone comes first.
                forces.insert(len(forces) if has_rates else 0, topic.name)
    if not rates or not forces:
        return ''
    return (
        f' {rates[0]} has no accelerations: imu-calib convert {recording.path} -o OUT --gyro-topic '
        f'{rates[0]} --accel-topic {forces[0]} joins them.'
    )


def recorded_units(recording: Recording, topic: str) -> Units:
    """Return the units of an IMU's topic by the recording; SI where it does not state them."""
    text = described_imu(recording.custom_data, topic)
    if text is None:
        return Units.SI
    return read_imu(Section.parse(text, f'{recording.path}: its IMU')).units


def _named(recording: Recording, candidates: list[Topic], wanted: str, kind: Kind) -> str:
    name = wanted if wanted.startswith('/') else f'/{wanted}'
    for topic in recording.topics:
        if topic.name in {wanted, name}:
            if topic.encoding != 'cdr':
                raise InputError(f'{recording.path}: {other_encoding(topic.name, topic.encoding)}')
            if topic.message_type != kind.type_name:
                raise InputError(
                    f'{recording.path}: topic {wanted}: found {topic.type}, '
                    f'expected {kind.type_name}.'
                )
            return topic.name
    listed = ', '.join(t.name for t in candidates) or 'none'
    raise InputError(
        f'{recording.path}: topic {wanted}: there is no such topic; '
        f'of type {kind.type_name} there are: {listed}.'
    )


# Sentences on header stamps that contradict the recorder's clock, and what contains the error.

_DIFFERENT = 1000 * PPM
"""From which two clocks differ by more than clocks do: quartz is off by 20 to 100 ppm, and a daemon
of NTP slews a clock by 500 ppm at most (RFC 5905, appendix A.5.5.6)."""
_QUARTZ = 200 * PPM  #: From which two clocks differ by more than two sound quartzes do.
_SURELY = 3.0  #: Standard deviations beyond that.
_ANOTHER_PACE = 0.1
"""From which two clocks are not of one kind: simulated time, or a recording that was played at
another rate. IMUs with oscillators of their own are off by some per cent."""
_UNIT = 0.2
"""Relative difference from a power of a thousand at which the unit is wrong. A judgement."""
_POWERS = {1: 'a thousand', 2: 'a million', 3: 'a billion'}


@contextmanager
def refused_by_stamps(recording: Recording, streams: Streams) -> Iterator[None]:
    """Refuse stamps without a unit or a value where the session is refused for anything else.

    Only there: time that is simulated may pass a thousand times as fast as the recorder's.
    """
    try:
        yield
    except (InputError, NotObservable):
        for topic in (streams.imu, streams.joints):
            if topic is not None and (sentence := contradiction(recording, topic)):
                raise InputError(f'{recording.path}: {topic}: {sentence}') from None
        raise


def contradiction(recording: Recording, topic: str) -> str:
    """Return why the stamps of a topic cannot be times; empty if they can."""
    clock = recording.clocks.get(topic)
    if clock is None or clock.stamps is None or clock.log is None or clock.stamps.count < 2:
        return ''
    stamps, log = clock.stamps, clock.log
    if stamps.first == stamps.last:
        value = '0' if stamps.first == 0 else f'{stamps.first * 1e-9:.9f} s'
        return (
            f'all {stamps.count} header stamps are {value}: when the samples were taken '
            'is not recorded. Let the driver stamp each message, and record again.'
        )
    ratio = clock.ratio()
    power = 0 if ratio is None else round(math.log10(ratio.value) / 3)
    if ratio is None or abs(power) not in _POWERS or abs(ratio.value / 1e3**power - 1) > _UNIT:
        return ''
    times = f'{_POWERS[abs(power)]} times too {"long" if power > 0 else "short"}'
    return (
        f'the header stamps last {stamps.seconds:.4g} s where the recorder counted '
        f'{log.seconds:.4g} s, {times}: the driver confuses units of time (s, ms, us, ns). Correct '
        'it, and record again.'
    )


def clock_findings(recording: Recording, streams: Streams, units: Units) -> list[str]:
    """Return what is said of the clock by which a calibration counts seconds, if it is off.

    A warning if no clock of a computer is off by so much, else a note.

    Args:
        recording: Read.
        streams: Its topics: seconds are those of joint states, without these those of the IMU.
        units: Of the IMU.
    """
    topic = streams.imu if streams.joints is None else streams.joints
    # docs/mathematics.md, 'Uncertainty budget': pulses per angle do not depend on a clock.
    containing = 'every K_a' if units.per_interval else 'every K_g'
    if found := _differing(recording, topic, containing):
        return [warning(sentence) for sentence in found]
    return _differing(recording, topic, containing, _QUARTZ)


def sample_findings(recording: Recording, topic: str, units: Units) -> list[str]:
    """Return a sentence on stamps of samples that are compensated, if these cannot be right."""
    if sentence := contradiction(recording, topic):
        return [f'{topic}: {sentence}']
    # Increments become rates by the interval of the stamps.
    rates = 'every rate and force'
    containing = rates if units.per_interval else 'what is integrated over the stamps'
    return _differing(recording, topic, containing)


def average_findings(recording: Recording, topic: str) -> list[str]:
    """Return a sentence on the clock by which averaging times are counted, if it is off."""
    return _differing(recording, topic, 'every averaging time')


def _differing(
    recording: Recording, topic: str, containing: str, usual: float = _DIFFERENT
) -> list[str]:
    """Return a sentence on stamps that run fast or slow, and on what contains that."""
    clock = recording.clocks.get(topic)
    if clock is None or not (said := difference(clock, usual)):
        return []
    return [
        f'The header stamps of {topic} run {said}, more than two clocks differ '
        f"({usual / PPM:g} ppm): {containing} is wrong by as much, unless the recorder's clock is. "
        'Let the driver stamp by a clock, not by the nominal interval, and record again.'
    ]


def difference(clock: RecordedClock, usual: float = _DIFFERENT) -> str:
    """Return by how much stamps run fast or slow, in words; empty if that is usual or unknown."""
    ratio = clock.ratio()
    if ratio is None:
        return ''
    faster = abs(ratio.value - 1)
    if not usual + _SURELY * ratio.std < faster < _ANOTHER_PACE:
        return ''
    return (
        f'{faster * 100:.3g} % ({faster / PPM:.0f} +- {max(ratio.std / PPM, 1):.0f} ppm) too '
        f"{'fast' if ratio.value > 1 else 'slow'} against the recorder's log times"
    )


# Numbers that are not in SI units.

_NEAR_GRAVITY = 0.25
"""Relative: an accelerometer in the hand with 3 % of scale factor error and 0.15 g of bias, beyond
the data sheets of the cheapest (MPU-9150). The median length is nearer to gravity than that; g (1),
mg (1000) and counts are not."""
_FASTEST = 35.0
"""rad/s: 2000 deg/s, the widest range of MEMS gyros in use (MPU-9250, BMI088, ICM-20948)."""
_MOST_FALSE = 0.01
"""Share of samples that may be false, as failed reads and spikes are. A judgement: in the hand a
unit turns for a fifth of the time or more, on a table at rates for longer."""


_SLOWEST_TURN = 1 * DEG
"""rad/s: the fastest turn of a session is faster, by hand or on a table. A judgement."""
_RATES = ('deg/s', 'deg/h', 'mdps')  #: Units of rates in logs besides rad/s.
_ACCELERATIONS = ('m/s^2', 'g', 'mg')  #: Units of accelerations in logs.


def against_si(
    force: Floats, rate: Floats, gyro_unit: str = 'rad/s', accel_unit: str = 'm/s^2'
) -> str:
    """Return which of (n, 3) forces and rates are not in SI units; else empty.

    Args:
        force: As converted from `accel_unit`, in which they were stated to be.
        rate: Likewise from `gyro_unit`.
        gyro_unit: Named in the text, with those that are possible.
        accel_unit: Likewise.
    """
    lengths = np.linalg.norm(force[(np.abs(force) <= LARGEST).all(axis=1)], axis=1)
    length = float(np.median(lengths)) if len(lengths) else float('nan')
    accelerations, rates = Dimension.ACCELERATION.value, Dimension.RATE.value
    if not is_near_gravity(length / STANDARD_GRAVITY):
        one = accelerations[accel_unit]
        read, expected = length / one, STANDARD_GRAVITY / one
        ratios = {u: read * accelerations[u] / STANDARD_GRAVITY for u in _ACCELERATIONS}
        fitting = [unit for unit, ratio in ratios.items() if is_near_gravity(ratio)]
        text = f'the median length of the acceleration is {read:.4g}, not'
        if accel_unit == 'm/s^2':
            return f'{text} 9.8; 1 would be g' if 'g' in fitting else f'{text} 9.8'
        return f'{text} {expected:.4g} {accel_unit}{_possible(fitting)}'
    fast = np.abs(rate[np.isfinite(rate).all(axis=1)]).max(axis=1)
    # The fastest motion, not false samples: these are fewer.
    fastest = float(np.quantile(fast, 1 - _MOST_FALSE)) if len(fast) else 0.0
    if fastest > _FASTEST:
        read = fastest / rates[gyro_unit]
        fitting = [u for u in _RATES if _SLOWEST_TURN < read * rates[u] <= _FASTEST]
        return (
            f'the gyros read up to {read:.4g}, faster than any IMU turns in {gyro_unit}'
            f'{_possible(fitting)}'
        )
    return ''


def _possible(units: Sequence[str]) -> str:
    """Return the end of a clause that names units that fit; empty without any."""
    return f'; {" or ".join(units)} is possible' if units else ''


def units_in_doubt(seen: str) -> str:
    """Return a warning of the stated units, given what `against_si` returned."""
    return warning(f'The stated units may be wrong: {seen}.')


def refuse_doubtful_units(recording: Recording) -> None:
    """Refuse columns whose numbers contradict their stated units."""
    if doubts := list(filter(is_warning, recording.losses)):
        raise InputError(f'{recording.path}: {without_label(doubts[0])}')


def is_near_gravity(ratio: float) -> bool:
    """Return whether an accelerometer at rest may read this share of gravity."""
    return abs(ratio - 1) < _NEAR_GRAVITY
