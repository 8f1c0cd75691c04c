"""Imperfections of the simulated hardware, and settings of a simulated session."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

from ..common.stream import Floats
from ..common.units import ARCSEC
from ..session.table import TURN
from .true_table import TrueTable

Channels: TypeAlias = float | tuple[float, float, float]
"""One value for three channels, or one for each."""


@dataclass(frozen=True, kw_only=True)
class TableOptions:
    """Deviations of the simulated table from an ideal one; errors are drawn anew at each stop.

    Attributes:
        azimuth: True heading of the table's zero against north about up, rad; None: the table's
            own, or north if not stated.
        tilt: Rotation of the base about east and about north, rad.
        encoder_resolution: Step of the angles read, rad; 0 for none.
        positioning_error: Difference of a stopped joint from its encoder reading, uniform within
            this, rad.
        servo_error: Difference of the encoder reading from the goal at rest, uniform within this,
            rad.
        rate_error: Relative error of a RATE step's rate, uniform within this, constant per step.
        setpoint_timeout: Time without a setpoint after which the table stops, s.
        setpoint_age: Largest difference of a setpoint's stamp from now, s; others are refused.
        wrapped: Angles are read within -180 to 180 deg instead of continuously.
        true: True axes, zeros, wobble and encoders; None: as described.
        encoder_noise: Standard deviation of one reading, rad.
        stop_error: Standard deviation of a stopped joint from its encoder reading until it moves
            again, whole turns included, rad.
        stop_tilt: Standard deviation of the tilt of the whole table about east and about north,
            drawn anew after every motion, rad.
        stop_heading: The same about up, rad.
        acceleration: Of all joints, if it is below their limits, rad/s^2.
    """

    azimuth: float | None = None
    tilt: tuple[float, float] = (0.0, 0.0)
    encoder_resolution: float = TURN / 2**22
    positioning_error: float = 2 * ARCSEC
    servo_error: float = 0.0
    rate_error: float = 1e-5
    setpoint_timeout: float = 0.5
    setpoint_age: float = 0.5
    wrapped: bool = False
    true: TrueTable | None = None
    encoder_noise: float = 0.0
    stop_error: float = 0.0
    stop_tilt: float = 0.0
    stop_heading: float = 0.0
    acceleration: float = math.inf


@dataclass(frozen=True)
class Warming:
    """Temperature: reference + offset + ramp * t + rise * (1 - exp(-t / time_constant)).

    Attributes:
        reference: Temperature at which the sensor model holds, degrees Celsius.
        offset: At the start above the reference, K.
        rise: In the long run above the start, K.
        time_constant: s.
        ramp: K/s.
    """

    reference: float = 25.0
    offset: float = 0.0
    rise: float = 0.0
    time_constant: float = 600.0
    ramp: float = 0.0

    def celsius(self, times: Floats) -> Floats:
        """Return the (n,) temperature at (n,) times, degrees Celsius."""
        return self.reference + self.excess(times)

    def excess(self, times: Floats) -> Floats:
        """Return the (n,) temperature above the reference at (n,) times, K."""
        risen = self.offset - self.rise * np.expm1(-times / self.time_constant)
        return np.asarray(risen + self.ramp * times if self.ramp else risen)


@dataclass(frozen=True)
class ThermalDrift:
    """Linear coefficients per kelvin above the reference, of all channels alike or of each.

    Attributes:
        gyro_bias: (rad/s)/K.
        gyro_scale: Relative, 1/K.
        accel_bias: (m/s^2)/K.
        accel_scale: Relative, 1/K.
    """

    gyro_bias: Channels = 0.0
    gyro_scale: Channels = 0.0
    accel_bias: Channels = 0.0
    accel_scale: Channels = 0.0


@dataclass(frozen=True)
class WarmUp:
    """Biases that decay as bias * exp(-t / time_constant), independent of the temperature.

    Attributes:
        gyro_bias: At the start, of all channels alike or of each, rad/s.
        accel_bias: At the start, m/s^2.
        time_constant: s.
    """

    gyro_bias: Channels = 0.0
    accel_bias: Channels = 0.0
    time_constant: float = 600.0


@dataclass(frozen=True)
class BiasStep:
    """Biases that change at one instant, as those of a unit that is switched off and on do.

    Attributes:
        time: s since the start; infinite for none.
        gyro_bias: Added from then on, to all channels alike or to each, rad/s.
        accel_bias: The same, m/s^2.
    """

    time: float = math.inf
    gyro_bias: Channels = 0.0
    accel_bias: Channels = 0.0


@dataclass(frozen=True, kw_only=True)
class Delivery:
    """Delivery of samples from the sensors to the recorder.

    Attributes:
        bunch: Number of samples that are sent and stamped together, when the last one is made.
        late: Share of the samples that are late, and delay those queued behind them.
        delay: Mean delay of such a sample, exponentially distributed, s.
        lost: Share of the samples that never arrive, each independently.
        twice: Share of the samples that arrive twice, with the same stamp.
        frozen_every: Mean time from one freeze to the next, s; infinite for none.
        frozen_for: Time for which the device repeats its last sample, with new stamps, s.
    """

    bunch: int = 1
    late: float = 0.0
    delay: float = 0.0
    lost: float = 0.0
    twice: float = 0.0
    frozen_every: float = math.inf
    frozen_for: float = 0.0


@dataclass(frozen=True, kw_only=True)
class ImuOptions:
    """Properties of the simulated IMU beyond its data sheet and its sensor model.

    Attributes:
        sample_rate: Hz, by the device's own clock; None: the data sheet's, or 100 Hz.
        noise: Whether there is random walk as in the data sheet.
        bias_instability: Whether the biases drift as in the data sheet.
        bias_time_constant: Correlation time of the drift, s.
        turn_on_gyro: Standard deviation of a bias drawn once per run, rad/s.
        turn_on_accel: The same of the accelerometers, m/s^2.
        quantise: Whether pulses and counts are whole numbers.
        warming: Temperature over the run.
        thermal_drift: Effect of temperature on the channels.
        lever: From the centre of rotation to the accelerometers, body axes, m.
        clock_offset: Device clock minus host clock at the start, s.
        clock_rate_error: Relative rate error of the device clock (50e-6 is 50 ppm fast).
        imu_stamp_jitter: Standard deviation of the stamps, s; at most 0.45 of a sample.
        warm_up: Decaying biases.
        bias_step: Biases from an instant on.
        delivery: Delivery of the samples.
        frame_id: Of the samples.
    """

    sample_rate: float | None = None
    noise: bool = True
    bias_instability: bool = True
    bias_time_constant: float = 1000.0
    turn_on_gyro: float = 0.0
    turn_on_accel: float = 0.0
    quantise: bool = True
    warming: Warming = field(default_factory=Warming)
    thermal_drift: ThermalDrift = field(default_factory=ThermalDrift)
    lever: tuple[float, float, float] = (0.0, 0.0, 0.0)
    clock_offset: float = 0.0
    clock_rate_error: float = 0.0
    imu_stamp_jitter: float = 0.0
    warm_up: WarmUp = field(default_factory=WarmUp)
    bias_step: BiasStep = field(default_factory=BiasStep)
    delivery: Delivery = field(default_factory=Delivery)
    frame_id: str = 'imu_link'


@dataclass(frozen=True)
class Shock:
    """A shock that leaves the unit rotated in its mount.

    Attributes:
        time: s since the start.
        axis: Body axis of the rotation; any length.
        angle: Its angle, rad.
        duration: Its duration, s.
    """

    time: float
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    angle: float = 0.0
    duration: float = 0.05


@dataclass(frozen=True)
class Vibration:
    """Ringing of the mounting after each stop, about and along a random direction.

    Attributes:
        rate: Initial amplitude of the angular rate, rad/s.
        force: Initial amplitude of the specific force, m/s^2.
        frequency: Hz.
        decay: Time constant, s.
    """

    rate: float = 0.0
    force: float = 0.0
    frequency: float = 20.0
    decay: float = 0.2


@dataclass(frozen=True)
class Shake:
    """Permanent vibration of the floor: tones of random phase within a band.

    Attributes:
        rate: Root mean square of the angular rate about each axis, rad/s.
        force: Root mean square of the specific force along each axis, m/s^2.
        lowest: Hz.
        highest: Hz.
    """

    rate: float = 0.0
    force: float = 0.0
    lowest: float = 5.0
    highest: float = 40.0


@dataclass(frozen=True, kw_only=True)
class StandOptions(TableOptions, ImuOptions):
    """All options of a simulated stand besides plan, table, IMU, model and site.

    Attributes:
        start_time: Host stamp of the start, ns.
        lead: Time at rest before the first setpoint and after the last, s.
        settle: From the end of a step's motion to the start of its dwell, s.
        setpoint_rate: Repetition rate of setpoints, Hz.
        joint_state_rate: Hz.
        joint_stamp_jitter: Standard deviation of the joint states' stamps, s; at most 0.45 of
            their spacing.
        temperature_rate: Hz.
        block_length: Longest duration of a block, s.
        vibration: After each stop.
        shake: Of the floor.
        shock: One shock, or None.
    """

    start_time: int = 1_700_000_000_000_000_000
    lead: float = 1.0
    settle: float = 1.0
    setpoint_rate: float = 10.0
    joint_state_rate: float = 100.0
    joint_stamp_jitter: float = 0.0
    temperature_rate: float = 1.0
    block_length: float = 10.0
    vibration: Vibration = field(default_factory=Vibration)
    shake: Shake = field(default_factory=Shake)
    shock: Shock | None = None


def switched_on(seed: int, start: float) -> int | tuple[int, int]:
    """Return the seed of hardware that is switched on at a time.

    Switched on again it is the same unit with different noise.

    Args:
        seed: The user's seed.
        start: s since the epoch.
    """
    return (seed, round(start * 1e3)) if start else seed
