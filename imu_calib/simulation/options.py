"""Imperfections of the simulated hardware, and settings of a simulated session; SI units, rad."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from ..common.config import Section
from ..common.errors import InputError
from ..common.keys import key, part, read_onto, read_part, record
from ..common.stream import NS, Floats
from ..common.units import ARCSEC, Dimension
from ..model.sensors import SensorModel, Triad
from ..session.table import TURN, Table
from .true_table import TableSizes, TrueTable

Channels: TypeAlias = float | tuple[float, float, float]
"""One value for three channels, or one for each."""


def read_channels(section: Section, name: str, dimension: Dimension) -> Channels:
    """Read one figure for all channels, or a list of three.

    Raises:
        InputError: File, key, what was found and what was expected.
    """
    if not isinstance(section.raw(name), list):
        return section.quantity(name, dimension)
    values = section.items(name)
    if len(values) != 3:
        raise InputError(f'{section.key(name)}: found {len(values)} figures, expected 3 or one.')
    x, y, z = (
        Section({'value': v}, f'{section.key(name)}[{i}]').quantity('value', dimension)
        for i, v in enumerate(values)
    )
    return x, y, z


def read_share(section: Section, name: str) -> float:
    """Read a share of samples.

    Raises:
        InputError: File, key, what was found and what was expected.
    """
    share = section.quantity(name, Dimension.RATIO, least=0)
    if share > 1:
        raise InputError(f'{section.key(name)}: found {section.raw(name)}, expected 100 % or less.')
    return share


@dataclass(frozen=True)
class Tilt:
    """Rotation of a table, rad."""

    east: float = key('about east', Dimension.ANGLE, default='0 arcsec')
    north: float = key('about north', Dimension.ANGLE, default='0 arcsec')


def read_tilt(section: Section, name: str) -> tuple[float, float]:
    """Read the rotation of a table about east and about north, rad."""
    tilt = record(section, name, Tilt)
    return tilt.east, tilt.north


def _size(
    variant: str, meaning: str, name: str = '', dimension: Dimension = Dimension.ANGLE
) -> Any:
    """Return a field for a size; 0 where its key is left out."""
    zero = '0 arcsec' if dimension is Dimension.ANGLE else '0 s'
    return key(meaning, dimension, default=zero, name=name, least=0, variants=(variant,))


def _biases(triad: str, meaning: str) -> Any:
    """Return a field for biases of a triad."""
    dimension, zero = Dimension.RATE, '0 deg/h'
    if triad == 'accelerometer':
        dimension, zero = Dimension.ACCELERATION, '0 ug'
    return key(meaning, read_channels, dimension, default=zero, name=triad)


def _per_kelvin(triad: str, dimension: Dimension, zero: str) -> Any:
    """Return a field for an effect of temperature on the channels of a triad."""
    name, meaning = 'bias', 'change of the biases per kelvin'
    if dimension is Dimension.RATIO_PER_KELVIN:
        name, meaning = 'scale_factor', 'of the scale factors'
    return key(meaning, read_channels, dimension, default=zero, name=name, variants=(triad,))


@dataclass(frozen=True, kw_only=True)
class TableOptions:
    """Deviations of the simulated table from an ideal one; errors are drawn anew at each stop."""

    #: True heading of the table's zero against north about up, rad; None: the table's own, or north
    #: if not stated.
    azimuth: float | None = None
    tilt: tuple[float, float] = key(
        'rotation of the whole table about east and about north, as stated',
        read_tilt,
        value=(0.0, 0.0),
        otherwise='level',
        variants=('table',),
    )
    encoder_noise: float = _size('joint_states', 'standard deviation of one reading', 'noise')
    #: 0 for none.
    encoder_resolution: float = key(
        'step of the angles',
        Dimension.ANGLE,
        name='resolution',
        value=TURN / 2**22,
        otherwise=f'{TURN / 2**22 / ARCSEC:.3g} arcsec (22 bits)',
        least=0,
        variants=('joint_states',),
    )
    #: Difference of a stopped joint from its encoder reading, uniform within this, rad.
    positioning_error: float = 2 * ARCSEC
    #: Uniform within this.
    servo_error: float = _size(
        'table',
        'largest difference of a stopped joint from its goal, shown by its encoder',
        'servo',
    )
    #: Uniform within this, constant per step.
    rate_error: float = key(
        'largest error of a steady rate',
        Dimension.RATIO,
        name='rate',
        value=1e-5,
        otherwise='`10 ppm`',
        least=0,
        variants=('table',),
    )
    setpoint_timeout: float = 0.5  #: Time without a setpoint after which the table stops, s.
    #: Largest difference of a setpoint's stamp from now, s; others are refused.
    setpoint_age: float = 0.5
    wrapped: bool = False  #: Angles are read within -180 to 180 deg instead of continuously.
    true: TrueTable | None = None  #: True axes, zeros, wobble and encoders; None: as described.
    #: Standard deviation, whole turns included.
    stop_error: float = _size(
        'positioning',
        'positioning error of a joint, not shown by its encoder, until it moves again',
        'joints',
    )
    stop_tilt: float = _size(
        'positioning',
        'lean of the whole table about either horizontal axis, new at every stop',
        'tilt',
    )
    stop_heading: float = _size(
        'positioning', 'rotation of it about the vertical, new at every stop', 'heading'
    )
    acceleration: float = key(
        'of all joints, where their limits allow more: long ramps',
        Dimension.ANGULAR_ACCELERATION,
        value=math.inf,
        otherwise='their limits',
        above=0,
        variants=('table',),
    )


@dataclass(frozen=True)
class Warming:
    """Temperature: reference + offset + ramp * t + rise * (1 - exp(-t / time_constant))."""

    reference: float = 25.0  #: Temperature at which the sensor model holds, degrees Celsius.
    offset: float = key(
        'at the start, above 25 degrees Celsius',
        Dimension.TEMPERATURE,
        default='0 K',
        variants=('temperature',),
    )
    rise: float = key(
        'final value, reached with `time_constant`',
        Dimension.TEMPERATURE,
        default='0 K',
        variants=('temperature',),
    )
    time_constant: float = key(
        'of the rise', Dimension.TIME, default='600 s', above=0, variants=('temperature',)
    )
    ramp: float = key(
        'steady change', Dimension.TEMPERATURE_RATE, default='0 K/h', variants=('temperature',)
    )

    def celsius(self, times: Floats) -> Floats:
        """Return the (n,) temperature at (n,) times, degrees Celsius."""
        return self.reference + self.excess(times)

    def excess(self, times: Floats) -> Floats:
        """Return the (n,) temperature above the reference at (n,) times, K."""
        risen = self.offset - self.rise * np.expm1(-times / self.time_constant)
        return np.asarray(risen + self.ramp * times if self.ramp else risen)


@dataclass(frozen=True)
class ThermalDrift:
    """Linear coefficients per kelvin above the reference, of all channels alike or of each."""

    gyro_bias: Channels = _per_kelvin('gyro', Dimension.RATE_PER_KELVIN, '0 (deg/h)/K')
    gyro_scale: Channels = _per_kelvin('gyro', Dimension.RATIO_PER_KELVIN, '0 ppm/K')
    accel_bias: Channels = _per_kelvin('accelerometer', Dimension.ACCELERATION_PER_KELVIN, '0 ug/K')
    accel_scale: Channels = _per_kelvin('accelerometer', Dimension.RATIO_PER_KELVIN, '0 ppm/K')

    def on(self, model: SensorModel, excess: float) -> SensorModel:
        """Return a model that holds at the reference as it is so much above it, K."""
        gyro = _warmed(model.gyro, excess, self.gyro_scale, self.gyro_bias)
        accel = _warmed(model.accel, excess, self.accel_scale, self.accel_bias)
        return replace(model, gyro=gyro, accel=accel)


def _warmed(triad: Triad, excess: float, scale: Channels, bias: Channels) -> Triad:
    gain = 1 + excess * np.broadcast_to(scale, 3)[:, None]
    return Triad(gain * triad.response - np.eye(3), triad.bias + excess * np.broadcast_to(bias, 3))


@dataclass(frozen=True)
class WarmUp:
    """Biases that decay as bias * exp(-t / time_constant), independent of the temperature."""

    gyro_bias: Channels = _biases('gyro', 'biases at the start')
    accel_bias: Channels = _biases('accelerometer', 'biases at the start')
    time_constant: float = key('of their decay', Dimension.TIME, default='600 s', above=0)


@dataclass(frozen=True)
class BiasStep:
    """Biases that change at one instant, as those of a unit that is switched off and on do."""

    #: Infinite for none.
    time: float = key(
        'from the start of the session to it', Dimension.TIME, value=math.inf, least=0
    )
    gyro_bias: Channels = _biases('gyro', 'added to the biases from then on')
    accel_bias: Channels = _biases('accelerometer', 'added to the biases from then on')


@dataclass(frozen=True, kw_only=True)
class Delivery:
    """Delivery of samples from the sensors to the recorder."""

    late: float = key('share of delayed samples', read_share, default='0 %', variants=('stamps',))
    delay: float = _size(
        'stamps',
        'their mean delay (exponential); samples behind them queue',
        dimension=Dimension.TIME,
    )
    bunch: int = key(
        'number of samples that come and are stamped together, when the last one is made',
        Section.whole,
        1,
        default=1,
        variants=('stamps',),
    )
    lost: float = key(
        'share of lost samples, independent of each other',
        read_share,
        default='0 %',
        variants=('samples',),
    )
    twice: float = key(
        'share of samples sent twice, with the same stamp',
        read_share,
        default='0 %',
        variants=('samples',),
    )
    #: Infinite for none.
    frozen_every: float = key(
        'mean time between',
        Dimension.TIME,
        name='every',
        value=math.inf,
        above=0,
        variants=('frozen',),
    )
    #: Meanwhile the device repeats its last sample, with new stamps.
    frozen_for: float = key(
        'how long', Dimension.TIME, name='for', value=0.0, least=0, variants=('frozen',)
    )


@dataclass(frozen=True, kw_only=True)
class ImuOptions:
    """Properties of the simulated IMU beyond its data sheet and its sensor model."""

    #: Hz, by the device's own clock; None: the data sheet's, or 100 Hz.
    sample_rate: float | None = None
    noise: bool = True  #: Whether there is random walk as in the data sheet.
    bias_instability: bool = True  #: Whether the biases drift as in the data sheet.
    bias_time_constant: float = 1000.0  #: Correlation time of the drift, s.
    turn_on_gyro: float = 0.0  #: Standard deviation of a bias drawn once per run, rad/s.
    turn_on_accel: float = 0.0  #: The same of the accelerometers, m/s^2.
    quantise: bool = True  #: Whether pulses and counts are whole numbers.
    warming: Warming = part(Warming)  #: Temperature over the run.
    #: Effect of temperature on the channels.
    thermal_drift: ThermalDrift = ThermalDrift()
    #: From the centre of rotation to the accelerometers, body axes, m.
    lever: tuple[float, float, float] = (0.0, 0.0, 0.0)
    imu_stamp_jitter: float = _size(
        'stamps', 'standard deviation; up to 0.45 of a sample', 'jitter', Dimension.TIME
    )
    delivery: Delivery = part(Delivery)  #: Delivery of the samples.
    clock_rate_error: float = key(
        "how much faster the unit's clock runs than the table's",
        Dimension.RATIO,
        name='clock_rate',
        value=0.0,
        otherwise='`0 ppm`, or `clock_drift` of stand_node',
        variants=('stamps',),
    )
    #: Device clock minus host clock.
    clock_offset: float = key(
        'its offset at the start',
        Dimension.TIME,
        value=0.0,
        otherwise='`0 s`, or `clock_offset` of stand_node',
        variants=('stamps',),
    )
    warm_up: WarmUp = key(
        'biases that decay, independent of the thermometer',
        record,
        WarmUp,
        default=None,
        value=WarmUp(),
        variants=('temperature',),
    )
    bias_step: BiasStep = BiasStep()  #: Biases from an instant on.
    frame_id: str = 'imu_link'  #: Of the samples.


@dataclass(frozen=True)
class Shock:
    """A shock that leaves the unit rotated in its mount."""

    time: float  #: s since the start.
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)  #: Body axis of the rotation; any length.
    angle: float = 0.0  #: Its angle, rad.
    duration: float = 0.05  #: Its duration, s.


@dataclass(frozen=True)
class Vibration:
    """Ringing of the mounting after each stop, about and along a random direction."""

    rate: float = key('amplitude at first', Dimension.RATE, default='0 deg/s', least=0)
    force: float = key('amplitude at first', Dimension.ACCELERATION, default='0 mg', least=0)
    frequency: float = key('of the ringing', Dimension.FREQUENCY, default='20 Hz', above=0)
    decay: float = key('time constant', Dimension.TIME, default='0.2 s', above=0)


@dataclass(frozen=True)
class Shake:
    """Permanent vibration of the floor: tones of random phase within a band."""

    rate: float = key(
        'root mean square about each axis', Dimension.RATE, default='0 deg/s', least=0
    )
    force: float = key(
        'root mean square along each axis', Dimension.ACCELERATION, default='0 mg', least=0
    )
    lowest: float = key('lower end of its tones', Dimension.FREQUENCY, default='5 Hz', least=0)
    highest: float = key('upper end', Dimension.FREQUENCY, default='40 Hz', least=0)


def read_shake(section: Section, name: str) -> Shake:
    """Read the vibration of the floor.

    Raises:
        InputError: File, key, what was found and what was expected.
    """
    shake = record(section, name, Shake)
    if shake.lowest > shake.highest:
        raise InputError(
            f'{section.key(name)}: found lowest {shake.lowest:g} Hz above highest '
            f'{shake.highest:g} Hz.'
        )
    return shake


@dataclass(frozen=True, kw_only=True)
class StandOptions(TableOptions, ImuOptions):
    """All options of a simulated stand besides plan, table, IMU, model and site."""

    start_time: int = 1_700_000_000_000_000_000  #: Host stamp of the start, ns.
    lead: float = 1.0  #: Time at rest before the first setpoint and after the last, s.
    settle: float = 1.0  #: From the end of a step's motion to the start of its dwell, s.
    setpoint_rate: float = 10.0  #: Repetition rate of setpoints, Hz.
    joint_stamp_jitter: float = _size(
        'joint_states',
        'standard deviation of the stamps; up to 0.45 of their spacing',
        'jitter',
        Dimension.TIME,
    )
    joint_state_rate: float = key(
        'their rate',
        Dimension.FREQUENCY,
        name='rate',
        value=100.0,
        otherwise='`100 Hz`, or `joint_state_rate` of stand_node',
        above=0,
        variants=('joint_states',),
    )
    temperature_rate: float = 1.0  #: Hz.
    block_length: float = 10.0  #: Longest duration of a block, s.
    vibration: Vibration = key(
        'of the mounting after each stop, in random directions',
        record,
        Vibration,
        default=None,
        name='ringing',
        value=Vibration(),
        variants=('mounting',),
    )
    shake: Shake = key(
        'constant vibration of the floor',
        read_shake,
        default=None,
        name='floor',
        value=Shake(),
        variants=('mounting',),
    )
    shock: Shock | None = None  #: One shock, or None.


DAY = 86400 * NS  #: ns.
_DAYS = 10_000  #: After which seeds begin at the same dates again: 27 years, as dates have an end.


def begin_of(seed: int) -> int:
    """Return the host stamp at which the session of a seed begins by default, ns.

    Seeds begin days apart: a unit has one session at a time.
    """
    return StandOptions.start_time + seed % _DAYS * DAY


def switched_on(seed: int, start: float) -> int | tuple[int, int]:
    """Return the seed of hardware that is switched on at a time.

    Switched on again it is the same unit with different noise.

    Args:
        seed: The user's seed.
        start: s since the epoch.
    """
    return (seed, round(start * 1e3)) if start else seed


# Read the file of a stand's imperfections: table, stamps, samples, vibration, biases.


def load_imperfections(
    name: str | Path, options: StandOptions, table: Table | None, seed: int
) -> StandOptions:
    """Read a file of imperfections, shipped (by name) or the user's (by path).

    Args and errors as for `read_imperfections`.
    """
    section = Section.named('imperfections', name)
    return read_imperfections(section, options, table, seed)


def read_imperfections(
    section: Section, options: StandOptions, table: Table | None, seed: int
) -> StandOptions:
    """Read imperfections on top of options; a section that is left out changes nothing.

    Args:
        section: Their YAML mapping.
        options: Of the stand without them.
        table: Its description; None for a unit held by hand.
        seed: Of the table's constant errors: the same seed gives the same table.

    Raises:
        InputError: File, key, what was found and what was expected.
    """
    for name in ('table', 'joint_states', 'stamps', 'samples', 'mounting', 'temperature'):
        if not section.has(name):
            continue
        if table is None and name in {'table', 'joint_states', 'mounting'}:
            raise InputError(
                f'{section.key(name)}: found an imperfection of a table, '
                'expected none: the unit is held by hand.'
            )
        within = section.section(name)
        if name == 'table':
            options = _table(within, options, table, seed)
        elif name == 'samples' and within.has('frozen'):
            frozen = read_onto(within.section('frozen'), options.delivery, 'frozen')
            options = replace(options, delivery=frozen)
        elif name == 'temperature':
            drift = options.thermal_drift
            for triad in ('gyro', 'accelerometer'):
                if within.has(triad):
                    drift = read_onto(within.section(triad), drift, triad)
            options = replace(options, thermal_drift=drift)
        options = read_onto(within, options, name)
    if section.has('bias_step'):
        options = replace(options, bias_step=record(section, 'bias_step', BiasStep))
    section.refuse_unknown_keys()
    return options


def _table(section: Section, options: StandOptions, table: Table | None, seed: int) -> StandOptions:
    """Read what the keys on the fields of the options do not say."""
    # Files of version 0.1.0 call them arrivals.
    name = 'positioning' if section.has('positioning') else 'arrivals'
    if section.has(name):
        # The file replaces the positioning error of the table's description.
        options = replace(options, positioning_error=0.0)
        options = read_onto(section.section(name), options, 'positioning')
    sizes = read_part(section, TableSizes)
    if table is None or sizes == TableSizes():
        return options
    return replace(options, true=TrueTable.drawn(table, sizes, seed))
