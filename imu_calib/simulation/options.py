"""Imperfections of the simulated hardware, and settings of a simulated session."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np

from ..common.config import Section
from ..common.errors import InputError
from ..common.stream import Floats
from ..common.units import ARCSEC, Dimension
from ..session.table import TURN, Table
from .true_table import TableSizes, TrueTable

Channels: TypeAlias = float | tuple[float, float, float]
"""One value for three channels, or one for each."""


@dataclass(frozen=True, kw_only=True)
class TableOptions:
    """Deviations of the simulated table from an ideal one; errors are drawn anew at each stop."""

    #: True heading of the table's zero against north about up, rad; None: the table's own, or north
    #: if not stated.
    azimuth: float | None = None
    tilt: tuple[float, float] = (0.0, 0.0)  #: Rotation of the base about east and about north, rad.
    encoder_resolution: float = TURN / 2**22  #: Step of the angles read, rad; 0 for none.
    #: Difference of a stopped joint from its encoder reading, uniform within this, rad.
    positioning_error: float = 2 * ARCSEC
    #: Difference of the encoder reading from the goal at rest, uniform within this, rad.
    servo_error: float = 0.0
    #: Relative error of a RATE step's rate, uniform within this, constant per step.
    rate_error: float = 1e-5
    setpoint_timeout: float = 0.5  #: Time without a setpoint after which the table stops, s.
    #: Largest difference of a setpoint's stamp from now, s; others are refused.
    setpoint_age: float = 0.5
    wrapped: bool = False  #: Angles are read within -180 to 180 deg instead of continuously.
    true: TrueTable | None = None  #: True axes, zeros, wobble and encoders; None: as described.
    encoder_noise: float = 0.0  #: Standard deviation of one reading, rad.
    #: Standard deviation of a stopped joint from its encoder reading until it moves again, whole
    #: turns included, rad.
    stop_error: float = 0.0
    #: Standard deviation of the tilt of the whole table about east and about north, drawn anew
    #: after every motion, rad.
    stop_tilt: float = 0.0
    stop_heading: float = 0.0  #: The same about up, rad.
    acceleration: float = math.inf  #: Of all joints, if it is below their limits, rad/s^2.


@dataclass(frozen=True)
class Warming:
    """Temperature: reference + offset + ramp * t + rise * (1 - exp(-t / time_constant))."""

    reference: float = 25.0  #: Temperature at which the sensor model holds, degrees Celsius.
    offset: float = 0.0  #: At the start above the reference, K.
    rise: float = 0.0  #: In the long run above the start, K.
    time_constant: float = 600.0  #: s.
    ramp: float = 0.0  #: K/s.

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

    gyro_bias: Channels = 0.0  #: (rad/s)/K.
    gyro_scale: Channels = 0.0  #: Relative, 1/K.
    accel_bias: Channels = 0.0  #: (m/s^2)/K.
    accel_scale: Channels = 0.0  #: Relative, 1/K.


@dataclass(frozen=True)
class WarmUp:
    """Biases that decay as bias * exp(-t / time_constant), independent of the temperature."""

    gyro_bias: Channels = 0.0  #: At the start, of all channels alike or of each, rad/s.
    accel_bias: Channels = 0.0  #: At the start, m/s^2.
    time_constant: float = 600.0  #: s.


@dataclass(frozen=True)
class BiasStep:
    """Biases that change at one instant, as those of a unit that is switched off and on do."""

    time: float = math.inf  #: s since the start; infinite for none.
    gyro_bias: Channels = 0.0  #: Added from then on, to all channels alike or to each, rad/s.
    accel_bias: Channels = 0.0  #: The same, m/s^2.


@dataclass(frozen=True, kw_only=True)
class Delivery:
    """Delivery of samples from the sensors to the recorder."""

    #: Number of samples that are sent and stamped together, when the last one is made.
    bunch: int = 1
    late: float = 0.0  #: Share of the samples that are late, and delay those queued behind them.
    delay: float = 0.0  #: Mean delay of such a sample, exponentially distributed, s.
    lost: float = 0.0  #: Share of the samples that never arrive, each independently.
    twice: float = 0.0  #: Share of the samples that arrive twice, with the same stamp.
    frozen_every: float = math.inf  #: Mean time from one freeze to the next, s; infinite for none.
    #: Time for which the device repeats its last sample, with new stamps, s.
    frozen_for: float = 0.0


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
    warming: Warming = field(default_factory=Warming)  #: Temperature over the run.
    #: Effect of temperature on the channels.
    thermal_drift: ThermalDrift = field(default_factory=ThermalDrift)
    #: From the centre of rotation to the accelerometers, body axes, m.
    lever: tuple[float, float, float] = (0.0, 0.0, 0.0)
    clock_offset: float = 0.0  #: Device clock minus host clock at the start, s.
    #: Relative rate error of the device clock (50e-6 is 50 ppm fast).
    clock_rate_error: float = 0.0
    imu_stamp_jitter: float = 0.0  #: Standard deviation of the stamps, s; at most 0.45 of a sample.
    warm_up: WarmUp = field(default_factory=WarmUp)  #: Decaying biases.
    bias_step: BiasStep = field(default_factory=BiasStep)  #: Biases from an instant on.
    delivery: Delivery = field(default_factory=Delivery)  #: Delivery of the samples.
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

    rate: float = 0.0  #: Initial amplitude of the angular rate, rad/s.
    force: float = 0.0  #: Initial amplitude of the specific force, m/s^2.
    frequency: float = 20.0  #: Hz.
    decay: float = 0.2  #: Time constant, s.


@dataclass(frozen=True)
class Shake:
    """Permanent vibration of the floor: tones of random phase within a band."""

    rate: float = 0.0  #: Root mean square of the angular rate about each axis, rad/s.
    force: float = 0.0  #: Root mean square of the specific force along each axis, m/s^2.
    lowest: float = 5.0  #: Hz.
    highest: float = 40.0  #: Hz.


@dataclass(frozen=True, kw_only=True)
class StandOptions(TableOptions, ImuOptions):
    """All options of a simulated stand besides plan, table, IMU, model and site."""

    start_time: int = 1_700_000_000_000_000_000  #: Host stamp of the start, ns.
    lead: float = 1.0  #: Time at rest before the first setpoint and after the last, s.
    settle: float = 1.0  #: From the end of a step's motion to the start of its dwell, s.
    setpoint_rate: float = 10.0  #: Repetition rate of setpoints, Hz.
    joint_state_rate: float = 100.0  #: Hz.
    #: Standard deviation of the joint states' stamps, s; at most 0.45 of their spacing.
    joint_stamp_jitter: float = 0.0
    temperature_rate: float = 1.0  #: Hz.
    block_length: float = 10.0  #: Longest duration of a block, s.
    vibration: Vibration = field(default_factory=Vibration)  #: After each stop.
    shake: Shake = field(default_factory=Shake)  #: Of the floor.
    shock: Shock | None = None  #: One shock, or None.


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
    """Read imperfections on top of options; omitted ones stay unchanged.

    Args:
        section: Their YAML mapping.
        options: Of the stand without them.
        table: Its description; None for a unit held by hand.
        seed: Of the table's constant errors: the same seed gives the same table.

    Raises:
        InputError: File, key, what was found and what was expected.
    """
    readers: dict[str, Callable[[Section, StandOptions], StandOptions]] = {
        'table': lambda part, o: _table(part, o, table, seed),
        'joint_states': _joint_states,
        'stamps': _stamps,
        'samples': _samples,
        'mounting': _mounting,
        'temperature': _temperature,
        'bias_step': _bias_step,
    }
    for key, read in readers.items():
        if not section.has(key):
            continue
        if table is None and key in {'table', 'joint_states', 'mounting'}:
            raise InputError(
                f'{section.key(key)}: found an imperfection of a table, '
                'expected none: the unit is held by hand.'
            )
        part = section.section(key)
        options = read(part, options)
        part.refuse_unknown_keys()
    section.refuse_unknown_keys()
    return options


def _table(part: Section, options: StandOptions, table: Table | None, seed: int) -> StandOptions:
    sizes = TableSizes(
        zeros=_size(part, 'zeros'),
        orthogonality=_size(part, 'orthogonality'),
        wobble=_harmonics(part, 'wobble'),
        encoder=_harmonics(part, 'encoder'),
    )
    options = replace(
        options,
        servo_error=_size(part, 'servo', options.servo_error),
        rate_error=_size(part, 'rate', options.rate_error, Dimension.RATIO),
        acceleration=part.quantity(
            'acceleration', Dimension.ANGULAR_ACCELERATION, options.acceleration, above=0
        ),
    )
    if part.has('tilt'):
        tilt = part.section('tilt')
        both = (
            tilt.quantity('east', Dimension.ANGLE, 0.0),
            tilt.quantity('north', Dimension.ANGLE, 0.0),
        )
        tilt.refuse_unknown_keys()
        options = replace(options, tilt=both)
    # Files of version 0.1.0 call them arrivals.
    key = 'positioning' if part.has('positioning') else 'arrivals'
    if part.has(key):
        positioning = part.section(key)
        options = replace(
            options,
            # The file replaces the positioning error of the table's description.
            positioning_error=0.0,
            stop_error=_size(positioning, 'joints'),
            stop_tilt=_size(positioning, 'tilt'),
            stop_heading=_size(positioning, 'heading'),
        )
        positioning.refuse_unknown_keys()
    if table is None or sizes == TableSizes():
        return options
    return replace(options, true=TrueTable.drawn(table, sizes, seed))


def _joint_states(part: Section, options: StandOptions) -> StandOptions:
    return replace(
        options,
        encoder_noise=_size(part, 'noise'),
        encoder_resolution=_size(part, 'resolution', options.encoder_resolution),
        joint_stamp_jitter=_size(part, 'jitter', 0.0, Dimension.TIME),
        joint_state_rate=part.quantity(
            'rate', Dimension.FREQUENCY, options.joint_state_rate, above=0
        ),
    )


def _stamps(part: Section, options: StandOptions) -> StandOptions:
    delivery = replace(
        options.delivery,
        bunch=part.whole('bunch', 1, default=1),
        late=_share(part, 'late'),
        delay=_size(part, 'delay', 0.0, Dimension.TIME),
    )
    return replace(
        options,
        imu_stamp_jitter=_size(part, 'jitter', 0.0, Dimension.TIME),
        clock_rate_error=part.quantity('clock_rate', Dimension.RATIO, options.clock_rate_error),
        clock_offset=part.quantity('clock_offset', Dimension.TIME, options.clock_offset),
        delivery=delivery,
    )


def _samples(part: Section, options: StandOptions) -> StandOptions:
    delivery = replace(options.delivery, lost=_share(part, 'lost'), twice=_share(part, 'twice'))
    if part.has('frozen'):
        frozen = part.section('frozen')
        delivery = replace(
            delivery,
            frozen_every=frozen.quantity('every', Dimension.TIME, above=0),
            frozen_for=_size(frozen, 'for', None, Dimension.TIME),
        )
        frozen.refuse_unknown_keys()
    return replace(options, delivery=delivery)


def _mounting(part: Section, options: StandOptions) -> StandOptions:
    if part.has('ringing'):
        s, usual = part.section('ringing'), Vibration()
        ringing = Vibration(
            _size(s, 'rate', 0.0, Dimension.RATE),
            _size(s, 'force', 0.0, Dimension.ACCELERATION),
            s.quantity('frequency', Dimension.FREQUENCY, usual.frequency, above=0),
            s.quantity('decay', Dimension.TIME, usual.decay, above=0),
        )
        s.refuse_unknown_keys()
        options = replace(options, vibration=ringing)
    if part.has('floor'):
        s, still = part.section('floor'), Shake()
        shake = Shake(
            _size(s, 'rate', 0.0, Dimension.RATE),
            _size(s, 'force', 0.0, Dimension.ACCELERATION),
            _size(s, 'lowest', still.lowest, Dimension.FREQUENCY),
            _size(s, 'highest', still.highest, Dimension.FREQUENCY),
        )
        if shake.lowest > shake.highest:
            raise InputError(
                f'{s.where}: found lowest {shake.lowest:g} Hz above highest {shake.highest:g} Hz.'
            )
        s.refuse_unknown_keys()
        options = replace(options, shake=shake)
    return options


def _temperature(part: Section, options: StandOptions) -> StandOptions:
    usual = options.warming
    warming = Warming(
        usual.reference,
        part.quantity('offset', Dimension.TEMPERATURE, usual.offset),
        part.quantity('rise', Dimension.TEMPERATURE, usual.rise),
        part.quantity('time_constant', Dimension.TIME, usual.time_constant, above=0),
        part.quantity('ramp', Dimension.TEMPERATURE_RATE, usual.ramp),
    )
    drift, fading = options.thermal_drift, options.warm_up
    if part.has('gyro') or part.has('accelerometer'):
        gyro, accel = (
            part.section(key) if part.has(key) else Section({}, part.key(key))
            for key in ('gyro', 'accelerometer')
        )
        drift = ThermalDrift(
            _channels(gyro, 'bias', Dimension.RATE_PER_KELVIN),
            _channels(gyro, 'scale_factor', Dimension.RATIO_PER_KELVIN),
            _channels(accel, 'bias', Dimension.ACCELERATION_PER_KELVIN),
            _channels(accel, 'scale_factor', Dimension.RATIO_PER_KELVIN),
        )
        gyro.refuse_unknown_keys()
        accel.refuse_unknown_keys()
    if part.has('warm_up'):
        s = part.section('warm_up')
        fading = WarmUp(
            _channels(s, 'gyro', Dimension.RATE),
            _channels(s, 'accelerometer', Dimension.ACCELERATION),
            s.quantity('time_constant', Dimension.TIME, fading.time_constant, above=0),
        )
        s.refuse_unknown_keys()
    return replace(options, warming=warming, thermal_drift=drift, warm_up=fading)


def _bias_step(part: Section, options: StandOptions) -> StandOptions:
    step = BiasStep(
        part.quantity('time', Dimension.TIME, least=0),
        _channels(part, 'gyro', Dimension.RATE),
        _channels(part, 'accelerometer', Dimension.ACCELERATION),
    )
    return replace(options, bias_step=step)


def _size(
    part: Section,
    key: str,
    default: float | None = 0.0,
    dimension: Dimension = Dimension.ANGLE,
) -> float:
    """Return a quantity that cannot be negative."""
    return part.quantity(key, dimension, default, least=0)


def _share(part: Section, key: str) -> float:
    share = _size(part, key, 0.0, Dimension.RATIO)
    if share > 1:
        raise InputError(f'{part.key(key)}: found {part.raw(key)}, expected 100 % or less.')
    return share


def _harmonics(part: Section, key: str) -> tuple[float, float]:
    if not part.has(key):
        return 0.0, 0.0
    s = part.section(key)
    pair = _size(s, 'once'), _size(s, 'twice')
    s.refuse_unknown_keys()
    return pair


def _channels(part: Section, key: str, dimension: Dimension) -> Channels:
    """Return one figure for all channels, or a list of three."""
    if not part.has(key) or not isinstance(part.raw(key), list):
        return part.quantity(key, dimension, 0.0)
    values = part.items(key)
    if len(values) != 3:
        raise InputError(f'{part.key(key)}: found {len(values)} figures, expected 3 or one.')
    three = [
        Section({'value': v}, f'{part.key(key)}[{i}]').quantity('value', dimension)
        for i, v in enumerate(values)
    ]
    return three[0], three[1], three[2]
