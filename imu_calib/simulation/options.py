"""What is wrong with the simulated hardware, and how a simulated session runs."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

from ..stream import Floats
from ..turntable import TURN
from ..units import ARCSEC
from .true_table import TrueTable

Channels: TypeAlias = float | tuple[float, float, float]
"""One figure for three channels, or one for each."""


@dataclass(frozen=True, kw_only=True)
class TableOptions:
    """How the simulated table differs from an ideal one; errors are drawn anew for each arrival.

    Attributes:
        azimuth: True heading of the table's zero against north about up, rad; None: the table's
            own, or north if it does not know.
        tilt: Rotation of the base about east and about north, rad.
        encoder_resolution: Step of the angles read, rad; 0 for none.
        positioning_error: Where the encoder says that the joint has arrived, it is off by a
            uniform error within this, rad: the encoder does not see it.
        servo_error: How far off the goal the joint comes to rest, uniform within this, rad: the
            encoder sees it.
        rate_error: Relative error of a RATE step's rate, uniform within this, constant per step.
        setpoint_timeout: The table stops when no setpoint has come for so long, s.
        setpoint_age: A setpoint is refused whose stamp is further than this from now, s.
        wrapped: Angles are read within -180 to 180 deg instead of continuously.
        true: Axes, zeros, wobble and encoders as they truly are; None: as described.
        encoder_noise: Standard deviation of one reading, rad.
        stop_error: Standard deviation by which a joint stops wrong, unseen by its encoder until it
            moves again, whole turns included, rad.
        stop_tilt: Standard deviation by which the whole table leans about east and about north,
            anew after every motion, rad.
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
        reference: At which the sensor model holds, degrees Celsius.
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
    """Biases that fade as bias * exp(-t / time_constant), whatever a thermometer shows.

    Attributes:
        gyro_bias: At the start, of all channels alike or of each, rad/s.
        accel_bias: At the start, m/s^2.
        time_constant: s.

    """

    gyro_bias: Channels = 0.0
    accel_bias: Channels = 0.0
    time_constant: float = 600.0


@dataclass(frozen=True, kw_only=True)
class Delivery:
    """What happens to samples on their way from the sensors to the recorder.

    Attributes:
        bunch: So many samples are sent and stamped together, when the last of them is there.
        late: Share of the samples that are held up, and with them those that queue behind.
        delay: Mean time for which such a sample is held up, exponentially distributed, s.
        lost: Share of the samples that never arrive, each by itself.
        twice: Share of the samples that arrive twice, stamp and all.
        frozen_every: Mean time from one freeze to the next, s; infinite for none.
        frozen_for: For so long the device repeats its last sample, with new stamps, s.

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
    """What the simulated IMU does beyond its data sheet and its sensor model.

    Attributes:
        sample_rate: Hz, in the device's own clock; None: the data sheet's, or 100 Hz.
        noise: Whether there is random walk by the data sheet.
        bias_instability: Whether the biases drift by the data sheet.
        bias_time_constant: Correlation time of the drift, s.
        turn_on_gyro: Standard deviation of a bias drawn once per run, rad/s.
        turn_on_accel: The same of the accelerometers, m/s^2.
        quantise: Whether pulses and counts are whole numbers.
        warming: Temperature over the run.
        thermal_drift: What temperature does to the channels.
        lever: From the centre of rotation to the accelerometers, body axes, m.
        clock_offset: Device clock minus host clock at the start, s.
        clock_rate_error: How much faster the device clock runs, relative (50e-6 is 50 ppm).
        imu_stamp_jitter: Standard deviation of the stamps, s; at most 0.45 of a sample.
        warm_up: Biases that fade.
        delivery: What happens to samples on their way.
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
    delivery: Delivery = field(default_factory=Delivery)
    frame_id: str = 'imu_link'


@dataclass(frozen=True)
class Shock:
    """The unit is shocked and stays rotated in its mounting.

    Attributes:
        time: s since the start.
        axis: About which body axis; any length.
        angle: By how much, rad.
        duration: How long the shock takes, s.

    """

    time: float
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    angle: float = 0.0
    duration: float = 0.05


@dataclass(frozen=True)
class Vibration:
    """How the mounting rings after each arrival, about and along a random direction.

    Attributes:
        rate: Amplitude of the angular rate at first, rad/s.
        force: Amplitude of the specific force at first, m/s^2.
        frequency: Hz.
        decay: Time constant, s.

    """

    rate: float = 0.0
    force: float = 0.0
    frequency: float = 20.0
    decay: float = 0.2


@dataclass(frozen=True)
class Shake:
    """How the floor shakes all the time: tones of random phase within a band.

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
    """Everything about a simulated stand besides plan, table, IMU, model and site.

    Attributes:
        start_time: Host stamp of the start, ns.
        lead: Standing still before the first setpoint and after the last, s.
        settle: From the arrival at a step's end to the start of its dwell, s.
        setpoint_rate: How often a setpoint is repeated, Hz.
        joint_state_rate: Hz.
        joint_stamp_jitter: Standard deviation of the joint states' stamps, s; at most 0.45 of
            their spacing.
        temperature_rate: Hz.
        block_length: No block holds more than so long, s.
        vibration: After each arrival.
        shake: Of the floor.
        shock: None, or one shock.

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

    Switched on again it is the same unit, but its noise is not that of the first time again.

    Args:
        seed: As a person gives it.
        start: s since the epoch.

    """
    return (seed, round(start * 1e3)) if start else seed
