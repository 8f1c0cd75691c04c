"""Description of an IMU by its YAML: meaning of its numbers, and noise by the data sheet."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..common.config import Section, checked, dump
from ..common.errors import InputError
from ..common.stream import Floats, Units
from ..common.units import DEG, PPM, Dimension
from .specification import Specification, read_specification

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


@dataclass(frozen=True)
class TriadSpec:
    """Three channels of one kind.

    Attributes:
        scale_factor: Nominal: rad or m/s per pulse or increment, rad/s or m/s^2 per count or rate,
            1 for SI.
        random_walk: rad/sqrt(s) or (m/s)/sqrt(s); 0 when not stated.
        bias_instability: rad/s or m/s^2; 0 when not stated.
        range: Largest rate or specific force, rad/s or m/s^2; inf when not stated.
        pulse: For SI values computed from a counter: its pulse, rad or m/s, whose remainder carries
            over to the next sample; 0 otherwise.
        scale_factor_temperature: Standard deviation of the temperature coefficient of scale
            factors, 1/K; 0 when not stated.
        bias_temperature: The same of biases, (rad/s)/K or (m/s^2)/K.
    """

    scale_factor: float = 1.0
    random_walk: float = 0.0
    bias_instability: float = 0.0
    range: float = math.inf
    pulse: float = 0.0
    scale_factor_temperature: float = 0.0
    bias_temperature: float = 0.0


@dataclass(frozen=True)
class ImuSpec:
    """One type of IMU.

    Attributes:
        id: Name of the unit or of its type.
        units: Units of the numbers of its Imu messages.
        sample_rate: Nominal, Hz; None when not stated.
        gyro: The gyro triad.
        accel: The accelerometer triad.
        skewed: A further gyro skewed to the three, None without one.
        specification: Limits of its parameters; None when not stated.
    """

    id: str
    units: Units
    sample_rate: float | None
    gyro: TriadSpec
    accel: TriadSpec
    skewed: TriadSpec | None = None
    specification: Specification | None = None

    def __repr__(self) -> str:
        """Return one line."""
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
    """Read an IMU's YAML file, shipped (by name) or the user's (by path).

    Raises:
        InputError: File, key, what was found and what was expected.
    """
    return read_imu(Section.named('imus', name))


def compensated_imu(spec: ImuSpec, gyro_gain: float, accel_gain: float) -> ImuSpec:
    """Return the description of an IMU after compensation: SI, with its noise.

    A skewed gyro is merged into the three others; limits of the specification are of the raw unit.

    Args:
        spec: Description of the raw numbers.
        gyro_gain: Amplification of a gyro's noise by compensation.
        accel_gain: The same of an accelerometer.
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
    """Read an IMU from its YAML mapping.

    Raises:
        InputError: File, key, what was found and what was expected.
    """
    units = section.choice('units', {u.value: u for u in Units})
    rate = None
    if section.has('sample_rate'):
        rate = section.quantity('sample_rate', Dimension.FREQUENCY, above=0)
    gyro = _read_triad(section, 'gyro', _OF_GYROS, units)
    accel = _read_triad(section, 'accelerometer', _OF_ACCELS, units)
    skewed, limits = None, None
    if section.has('skewed_gyro'):
        skewed = _read_triad(section, 'skewed_gyro', _OF_GYROS, units)
    if section.has('specification'):
        limits = read_specification(section.section('specification'))
    spec = ImuSpec(section.text('id'), units, rate, gyro, accel, skewed, limits)
    section.finish()
    return spec


@dataclass(frozen=True)
class _Kind:
    """Key of a triad's random walk, and the dimensions of its values; `scale` by units."""

    walk_key: str
    walk: Dimension
    value: Dimension
    per_kelvin: Dimension
    per_pulse: Dimension
    scale: Mapping[Units, Dimension]


_OF_GYROS = _Kind(
    'angle_random_walk',
    Dimension.ANGLE_RANDOM_WALK,
    Dimension.RATE,
    Dimension.RATE_PER_KELVIN,
    Dimension.ANGLE_PER_PULSE,
    {
        Units.PULSES: Dimension.ANGLE_PER_PULSE,
        Units.COUNTS: Dimension.RATE_PER_COUNT,
        Units.INCREMENTS: Dimension.ANGLE,
        Units.RATES: Dimension.RATE,
    },
)
_OF_ACCELS = _Kind(
    'velocity_random_walk',
    Dimension.VELOCITY_RANDOM_WALK,
    Dimension.ACCELERATION,
    Dimension.ACCELERATION_PER_KELVIN,
    Dimension.VELOCITY_PER_PULSE,
    {
        Units.PULSES: Dimension.VELOCITY_PER_PULSE,
        Units.COUNTS: Dimension.ACCELERATION_PER_COUNT,
        Units.INCREMENTS: Dimension.VELOCITY,
        Units.RATES: Dimension.ACCELERATION,
    },
)


def _read_triad(parent: Section, name: str, kind: _Kind, units: Units) -> TriadSpec:
    si = units is Units.SI
    if si and not parent.has(name):
        return TriadSpec()
    section = parent.section(name)
    spec = TriadSpec(
        1.0 if si else section.quantity('scale_factor', kind.scale[units], above=0),
        section.quantity(kind.walk_key, kind.walk, 0.0, least=0),
        section.quantity('bias_instability', kind.value, 0.0, least=0),
        section.quantity('range', kind.value, math.inf, above=0),
        section.quantity('pulse', kind.per_pulse, 0.0, least=0) if si else 0.0,
        section.quantity('scale_factor_temperature', Dimension.RATIO_PER_KELVIN, 0.0, least=0),
        section.quantity('bias_temperature', kind.per_kelvin, 0.0, least=0),
    )
    section.finish()
    return spec


def check_live(spec: ImuSpec) -> None:
    """Refuse a unit that cannot be simulated live: the simulated device sends whole numbers.

    Raises:
        InputError: Its samples are no whole numbers.
    """
    if not spec.units.whole:
        raise InputError(
            f'IMU {spec.id}: units: found {spec.units.value}, expected pulses or counts: a '
            'simulated device sends whole numbers. Simulate another one, for example mems_counts '
            'or fog_medium; imu-calib simulate makes a recording of this one.'
        )
