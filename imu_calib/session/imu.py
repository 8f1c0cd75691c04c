"""Description of an IMU by its YAML: meaning of its numbers, noise by the data sheet; its clock."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np

from ..common.arguments import checked
from ..common.config import Section, dump
from ..common.errors import InputError
from ..common.keys import REQUIRED, key, read_record
from ..common.stream import Floats, Units
from ..common.units import DEG, DEG_H, HOUR, MICRO_G, PPM, Dimension
from ..model.parameters import TRIADS, Parameter, ParameterKind

# Limits of a unit's parameters by its specification, and the verdict on a value.


GENERIC = 'si'  #: Id of the supplied description of any unit that publishes SI units.
UNNAMED = (GENERIC, 'rates')  #: Ids of those of any unit that publishes rates and forces.
COVERAGE = 2.0
"""Standard deviations on both sides of a value within which the truth is assumed to lie (95 %)."""


class Verdict(Enum):
    """Conformity of a value with its uncertainty to a limit (ISO 14253-1)."""

    PASS = 'pass'
    """Within the limit, including the uncertainty."""
    MARGINAL = 'marginal'
    """The limit is within the uncertainty: neither is proven."""
    FAIL = 'fail'
    """Beyond the limit, including the uncertainty."""


def judge(value: float, std: float, limit: float) -> Verdict:
    """Return the verdict on an estimate for a limit on both sides of zero."""
    uncertainty = COVERAGE * std
    if abs(value) + uncertainty <= limit:
        return Verdict.PASS
    return Verdict.FAIL if abs(value) - uncertainty > limit else Verdict.MARGINAL


@dataclass(frozen=True)
class Specification:
    """The limits of a unit."""

    #: Largest amounts, SI units, by kind of parameter and triad ('g' or 'a'); none for others.
    limits: Mapping[tuple[ParameterKind, str], float] = field(default_factory=dict)

    def limit(self, parameter: Parameter) -> float | None:
        """Return the largest amount of a parameter, SI; None if not specified.

        A skewed gyro's bias has the gyros' limit; its response depends on its mounting.
        """
        return self.limits.get((parameter.kind, parameter.triad))


def read_specification(parent: Section, name: str) -> Specification:
    """Read the limits of an IMU's parameters."""
    section = parent.section(name)
    limits: dict[tuple[ParameterKind, str], float] = {}
    for triad, sensors in TRIADS.items():
        if not section.has(sensors):
            continue
        mine = section.section(sensors)
        for kind in ParameterKind:
            row = kind.value
            if triad not in row.units or kind is ParameterKind.RESPONSE or not mine.has(row.key):
                continue
            limits[kind, triad] = mine.quantity(row.key, row.units[triad].dimension, above=0)
        mine.refuse_unknown_keys()
    section.refuse_unknown_keys()
    return Specification(limits)


_NEEDED = 'must be given; optional with si'

FULL_SCALES = (32767.0, 32768.0, 8388607.0, 8388608.0, 2147483647.0, 2147483648.0)
"""Largest counts of 16, 24 and 32 bits, of either sign."""
_LEAST_RANGES = (10 * DEG, 9.0)
"""rad/s and m/s^2, of gyros and accelerometers: below it a full scale is no end of a range. Rate
tests turn at 10 deg/s or faster, and an accelerometer without 9 m/s^2 does not show gravity."""
_LEAST_SHARE = 0.1
"""Of a stated range, likewise: a description of a unit that is set to less is rarely off by more. A
judgement."""
SCALE_LIMIT = 1.9
"""Ratio: larger differences are other units; sensors differ by percents. Twice the rate of the
samples, and the next range of a converter, are a factor of 2, less 3 % of the cheapest units."""
GRAVITY_FACTOR = 3.0
"""Ratio to gravity, or its inverse, beyond which accelerations are in other units: more than the
error of the worst accelerometer with the motion of a fast table or a vehicle, less than the ratio
of units that are confused: g and m/s^2 (9.8), g and mg (1000)."""
COLDEST, HOTTEST = -100.0, 200.0
"""degC, beyond the range of any unit (automotive parts: -40 to 125)."""
NEARLY = 0.999
"""Share of the range above which a reading counts as saturated: ranges are stated to three digits,
and ADCs clip slightly early. A judgement."""


def _figure(
    meaning: str,
    gyro: Dimension | Mapping[Units, Dimension],
    accel: Dimension | Mapping[Units, Dimension],
    names: tuple[str, str] = ('', ''),
    value: float = 0.0,
    **rest: Any,
) -> Any:
    """Return a field with a key for each triad and for the units of the samples.

    Dimensions are those for all units, or by units; a file's default is 0, and the least value,
    where `rest` says nothing else. {} in the meaning is what the triad measures.
    """
    bounds = {} if 'above' in rest else {'least': 0}
    keys = {}
    quantities = ('rate', 'specific force')
    for triad, name, quantity, by_units in zip(
        TRIADS.values(), names, quantities, (gyro, accel), strict=True
    ):
        each = dict.fromkeys(Units, by_units) if isinstance(by_units, Dimension) else by_units
        for units, dimension in each.items():
            told = {'default': f'0 {next(iter(dimension.value))}', **bounds, **rest}
            said = meaning.format(quantity)
            declared = key(said, dimension, value=value, name=name, **told)
            keys[triad, units] = declared.metadata['key']
    return field(default=value, metadata=keys)


@dataclass(frozen=True)
class TriadSpec:
    """Three channels of one kind: its keys are those of a triad and of the units of its samples."""

    #: rad or m/s per pulse or increment, rad/s or m/s^2 per count or rate; 1 for SI.
    scale_factor: float = _figure(
        'nominal size of one pulse or count, or of the number 1',
        {
            Units.PULSES: Dimension.ANGLE_PER_PULSE,
            Units.COUNTS: Dimension.RATE_PER_COUNT,
            Units.INCREMENTS: Dimension.ANGLE,
            Units.RATES: Dimension.RATE,
        },
        {
            Units.PULSES: Dimension.VELOCITY_PER_PULSE,
            Units.COUNTS: Dimension.ACCELERATION_PER_COUNT,
            Units.INCREMENTS: Dimension.VELOCITY,
            Units.RATES: Dimension.ACCELERATION,
        },
        value=1.0,
        default=REQUIRED,
        above=0,
    )
    #: rad/sqrt(s) or (m/s)/sqrt(s); 0 when not stated.
    random_walk: float = _figure(
        'white noise of the channels',
        Dimension.ANGLE_RANDOM_WALK,
        Dimension.VELOCITY_RANDOM_WALK,
        ('angle_random_walk', 'velocity_random_walk'),
    )
    #: rad/s or m/s^2; 0 when not stated.
    bias_instability: float = _figure(
        'drift of a bias within a session; included in every standard deviation, unless the data '
        'clearly shows less',
        Dimension.RATE,
        Dimension.ACCELERATION,
    )
    #: rad/s or m/s^2; inf when not stated.
    range: float = _figure(
        'largest measurable {}',
        Dimension.RATE,
        Dimension.ACCELERATION,
        value=math.inf,
        default=None,
        otherwise='not limited',
        above=0,
    )
    #: 1/K; 0 when not stated.
    scale_factor_temperature: float = _figure(
        'change of the scale factors with temperature, one standard deviation',
        Dimension.RATIO_PER_KELVIN,
        Dimension.RATIO_PER_KELVIN,
    )
    #: (rad/s)/K or (m/s^2)/K; 0 when not stated.
    bias_temperature: float = _figure(
        'the same for the biases', Dimension.RATE_PER_KELVIN, Dimension.ACCELERATION_PER_KELVIN
    )
    #: rad or m/s, whose remainder carries over to the next sample; 0 otherwise.
    pulse: float = _figure(
        'with `units: si` only: the pulse of the counter that the values were computed from '
        '([why](../devices.md#questions-that-come-up))',
        {Units.SI: Dimension.ANGLE_PER_PULSE},
        {Units.SI: Dimension.VELOCITY_PER_PULSE},
    )


_UNITS = {units.value: units for units in Units}


def read_triad(section: Section, name: str, triad: str) -> TriadSpec:
    """Read the figures of a triad in the units of the IMU's file."""
    units = section.choice('units', _UNITS)
    return read_record(section.section(name), TriadSpec, (triad, units))


@dataclass(frozen=True)
class ImuSpec:
    """One type of IMU."""

    id: str = key('name of the unit, or of its type', Section.text)
    units: Units = key(
        'meaning of the numbers in the Imu messages: whole increments per sample, codes '
        'proportional to rate and specific force, increments that are no whole numbers (rad, m/s), '
        'rates in other units than SI (deg/s, g), or rad/s and m/s^2',
        Section.choice,
        _UNITS,
    )
    #: Hz; None when not stated.
    sample_rate: float | None = key(
        'nominal; the true one follows from the stamps', Dimension.FREQUENCY, above=0, default=None
    )
    gyro: TriadSpec = key(
        'the three gyros', read_triad, 'gyro', value=TriadSpec(), otherwise=_NEEDED
    )
    accel: TriadSpec = key(
        'the three accelerometers',
        read_triad,
        'accelerometer',
        value=TriadSpec(),
        name='accelerometer',
        otherwise=_NEEDED,
    )
    skewed: TriadSpec | None = key(
        'a further gyro, skewed to the three; the keys of `gyro`',
        read_triad,
        'gyro',
        default=None,
        name='skewed_gyro',
    )
    #: None when not stated.
    specification: Specification | None = key(
        'limits of the parameters, for the verdicts of [reports](../report.md)',
        read_specification,
        default=None,
    )

    def __repr__(self) -> str:
        return f'<ImuSpec {self.id}: {self.units.value}>'

    @property
    def scale(self) -> Floats:
        """Nominal scale factors (6,), SI per number as delivered."""
        return np.repeat([self.gyro.scale_factor, self.accel.scale_factor], 3)

    @property
    def least_ends(self) -> tuple[float, float]:
        """Rate and specific force below which a full scale is no end of a range, rad/s and m/s^2.

        A word of 32 bits passes the largest counts of 16 and 24 bits in the middle of its range.
        """
        ends = [
            max(least, _LEAST_SHARE * triad.range if math.isfinite(triad.range) else 0.0)
            for least, triad in zip(_LEAST_RANGES, (self.gyro, self.accel), strict=True)
        ]
        return ends[0], ends[1]


@checked
def load_imu(name: str | Path) -> ImuSpec:
    """Read an IMU's YAML file, shipped (by name) or the user's (by path)."""
    return read_imu(Section.named('imus', name))


def compensated_imu(spec: ImuSpec, gyro_gain: float, accel_gain: float) -> ImuSpec:
    """Return the description of an IMU after compensation: SI, its noise amplified by two gains.

    A skewed gyro is merged into the three others; limits of the specification are of the raw unit.
    """
    return replace(
        spec,
        units=Units.SI,
        gyro=_compensated_triad(spec.gyro, spec.units, gyro_gain),
        accel=_compensated_triad(spec.accel, spec.units, accel_gain),
        skewed=None,
        specification=None,
    )


def _compensated_triad(triad: TriadSpec, units: Units, gain: float) -> TriadSpec:
    return replace(
        triad,
        scale_factor=1.0,
        random_walk=triad.random_walk * gain,
        bias_instability=triad.bias_instability * gain,
        pulse=gain * (triad.scale_factor if units is Units.PULSES else triad.pulse),
        bias_temperature=triad.bias_temperature * gain,
    )


def imu_text(spec: ImuSpec) -> str:
    """Return the YAML text of an IMU in SI units, as `read_imu` reads it.

    Raises:
        ValueError: Its numbers are not SI, or it has a skewed gyro.
    """
    if spec.units is not Units.SI or spec.skewed is not None:
        raise ValueError(f'IMU {spec.id}: expected SI units and no skewed gyro.')
    document: dict[str, Any] = {'id': spec.id, 'units': spec.units.value}
    if spec.sample_rate is not None:
        document['sample_rate'] = f'{spec.sample_rate!r} Hz'
    for name, triad, walk_key, walk, unit, pulse in (
        ('gyro', spec.gyro, 'angle_random_walk', 'rad/sqrt(s)', 'rad/s', 'rad'),
        ('accelerometer', spec.accel, 'velocity_random_walk', '(m/s)/sqrt(s)', 'm/s^2', 'm/s'),
    ):
        document[name] = {
            walk_key: f'{triad.random_walk!r} {walk}',
            'bias_instability': f'{triad.bias_instability!r} {unit}',
        }
        if math.isfinite(triad.range):
            document[name]['range'] = f'{triad.range!r} {unit}'
        if triad.pulse:
            document[name]['pulse'] = f'{triad.pulse!r} {pulse}/pulse'
        if triad.scale_factor_temperature:
            document[name]['scale_factor_temperature'] = (
                f'{triad.scale_factor_temperature / PPM!r} ppm/K'
            )
        if triad.bias_temperature:
            document[name]['bias_temperature'] = f'{triad.bias_temperature!r} ({unit})/K'
    return dump(document, width=200)


def read_imu(section: Section) -> ImuSpec:
    """Read an IMU from its YAML mapping."""
    if section.choice('units', _UNITS) is not Units.SI:
        section.raw('gyro')
        section.raw('accelerometer')
    return read_record(section, ImuSpec)


def check_live(spec: ImuSpec) -> None:
    """Refuse a unit that cannot be simulated live: the simulated device sends whole numbers."""
    if not spec.units.whole:
        raise InputError(
            f'IMU {spec.id}: units: found {spec.units.value}, expected pulses or counts: a '
            'simulated device sends whole numbers. Simulate another one, for example mems_counts '
            'or fog_medium; imu-calib simulate makes a recording of this one.'
        )


# The noise of a channel as a value and in files, and its units in data sheets.

_SIGNIFICANT = 2.0  #: Standard deviations above which a coefficient is stated; below, a limit is.
_NINETY_FIVE = 1.645  #: One-sided standard deviations of 95 percent.


@dataclass(frozen=True)
class Coefficient:
    """A coefficient of noise: its value if significant, else its upper limit (95 %)."""

    value: float | None
    std: float | None
    below: float

    @classmethod
    def from_square(cls, square: float, deviation: float) -> Coefficient:
        """Make one from a squared coefficient and its standard deviation."""
        below = math.sqrt(max(square, 0.0) + _NINETY_FIVE * deviation)
        if square < _SIGNIFICANT * deviation or square <= 0:
            return cls(None, None, below)
        value = math.sqrt(square)
        return cls(value, deviation / (2 * value), below)


NOT_ESTIMATED = Coefficient(None, None, math.inf)


@dataclass(frozen=True, eq=False)
class ChannelNoise:
    """The noise of one channel at rest, in SI units."""

    tau: Floats  #: (k,) averaging times, s.
    deviation: Floats  #: (k,) Allan deviation, rad/s or m/s^2.
    std: Floats  #: (k,) its standard deviation.
    random_walk: Coefficient  #: rad/sqrt(s) or (m/s)/sqrt(s).
    bias_instability: Coefficient  #: rad/s or m/s^2; the curve is flat at 0.664 of it.
    #: rad or m/s, by slope -1; of a counter the known pulse over sqrt(12).
    quantisation: Coefficient
    rate_random_walk: Coefficient  #: (rad/s)/sqrt(s) or (m/s^2)/sqrt(s).
    #: Whether `tau` refers to clusters with timed pulses, since single readings of the counter hide
    #: the noise below its steps.
    timed: bool
    #: (rad/s)/s or (m/s^2)/s; a calibration does not estimate it.
    rate_ramp: Coefficient = NOT_ESTIMATED

    def document(self) -> dict[str, Any]:
        """Return it as plain numbers, for a file."""
        found: dict[str, Any] = {}
        for name in COEFFICIENTS:
            coefficient: Coefficient = getattr(self, name)
            if coefficient.value is not None:
                found[name] = float(coefficient.value)
                found[f'{name}_std'] = float(coefficient.std or 0.0)
            elif math.isfinite(coefficient.below):
                found[f'{name}_below'] = float(coefficient.below)
        for name in CURVE:
            found[name] = [float(v) for v in getattr(self, name)]
        return {**found, 'timed': self.timed}

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> ChannelNoise:
        """Make it from a result of `document`."""
        coefficients = {
            name: Coefficient(
                document.get(name),
                document.get(f'{name}_std'),
                document.get(f'{name}_below', math.inf),
            )
            for name in COEFFICIENTS
        }
        tau, deviation, std = (np.array(document[n], dtype=float) for n in CURVE)
        return cls(tau, deviation, std, **coefficients, timed=bool(document['timed']))


CURVE = ('tau', 'deviation', 'std')
COEFFICIENTS = ('random_walk', 'bias_instability', 'quantisation', 'rate_random_walk')


def read_noise(document: Mapping[str, Any]) -> dict[str, ChannelNoise]:
    """Return the noise by channel from a calibration's provenance."""
    return {name: ChannelNoise.from_document(entry) for name, entry in document.items()}


@dataclass(frozen=True)
class TriadUnits:
    """Units of the noise of a triad."""

    name: str  #: gyro or accelerometer.
    channels: tuple[str, ...]  #: Names of its channels.
    walk: str  #: Unit of the random walk in words.
    walk_scale: float  #: Its SI value.
    rate: str  #: Unit of the bias instability and of the Allan deviation in words.
    rate_scale: float  #: Its SI value.


_ROOT_HOUR = HOUR**0.5  #: sqrt(s).
TRIAD_NAMES = (
    TriadUnits('gyro', ('gx', 'gy', 'gz'), 'deg/sqrt(h)', DEG / _ROOT_HOUR, 'deg/h', DEG_H),
    TriadUnits('accelerometer', ('ax', 'ay', 'az'), '(m/s)/sqrt(h)', 1 / _ROOT_HOUR, 'ug', MICRO_G),
)


KEY = 'clock'  #: Section in calibration.yaml.
_LARGEST = 0.1  #: Largest plausible rate error of a clock; the simulator has the same limit.
_NOTICED = 0.05 * PPM
"""Smallest rate error that an interval is corrected for by hand: it rounds to 0.1 ppm, a tenth of
what the scale factors of the best gyros are known to."""


@dataclass(frozen=True)
class StampingClock:
    """Relative rate of the stamping clock."""

    name: str  #: The clock.
    against: str  #: The clock that it is compared with.
    faster: float  #: Ratio of its rate to that of the other clock, less one.
    std: float  #: Its standard deviation.

    @property
    def is_noticed(self) -> bool:
        """Whether intervals between its stamps are to be corrected."""
        return abs(self.faster) >= _NOTICED

    def pace(self, digits: int) -> str:
        """Return its relative rate in words, in ppm to some decimal digits."""
        return f'{abs(self.faster) / PPM:.{digits}f} ppm {"fast" if self.faster > 0 else "slow"}'

    def document(self) -> dict[str, Any]:
        """Return its section of a file."""
        return {
            'name': self.name,
            'against': self.against,
            'faster': self.faster,
            'faster_std': self.std,
        }


def read_clock(section: Section) -> StampingClock:
    """Read a file's section."""
    clock = StampingClock(
        section.text('name'),
        section.text('against'),
        section.number('faster'),
        section.number('faster_std'),
    )
    section.refuse_unknown_keys()
    check_clock(clock, section.where)
    return clock


def check_clock(clock: StampingClock, where: str) -> None:
    """Refuse numbers that are impossible for a clock."""
    if not abs(clock.faster) < _LARGEST:
        raise InputError(
            f'{where}: faster: found {clock.faster:g}, expected a ratio below {_LARGEST:g}.'
        )
    if not clock.std >= 0:
        raise InputError(f'{where}: faster_std: found {clock.std:g}, expected 0 or more.')
