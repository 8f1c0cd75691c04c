"""A simulated stand: a table that runs a plan with an IMU on it, as blocks of its topics."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import count

import numpy as np

from ..common.errors import InputError
from ..common.stream import (
    Block,
    Floats,
    JointBlock,
    Setpoint,
    SetpointBlock,
    Stamps,
    TemperatureBlock,
)
from ..model.earth import Site
from ..model.sensors import SensorModel
from ..session.imu import ImuSpec
from ..session.plan import Plan, Step
from ..session.table import Table
from .imu import SimulatedImu
from .motion import Motion, Ringing, Shaking, Track, side_by_side, trapezoid
from .options import Shake, Shock, StandOptions, Vibration
from .table import SimulatedTable

SETPOINT_TOPIC = 'turntable/setpoint'
JOINT_TOPIC = 'turntable/joint_states'
IMU_TOPIC = 'imu/pulses'
TEMPERATURE_TOPIC = 'imu/temperature'
SKEW_TOPIC = 'imu/skew'

_TONES = 12
"""Tones of the floor's vibration: their sum is Gaussian to a few percent (central limit)."""


@dataclass(frozen=True, eq=False)
class Visit:
    """Times of a step."""

    step: Step  #: The step.
    begin: float  #: Its first setpoint, s since the start.
    rest: float  #: Arrival of the table at rest, s.
    end: float  #: Start of the next step, s.


class SimulatedStand:
    """Table, IMU and sequencer running a plan, in simulated time.

    The table's motion is computed at once, the samples block by block. The same arguments and the
    same seed give the same bits.

    Attributes:
        visits: Times of each step.
        motion: The true motion of the unit.
        duration: Length of the session, s.
    """

    def __init__(
        self,
        plan: Plan,
        table: Table,
        imu_spec: ImuSpec,
        model: SensorModel,
        site: Site,
        options: StandOptions | None = None,
        seed: int = 0,
    ) -> None:
        """Set up the stand and run the table through the plan.

        Raises:
            InputError: The table cannot run the plan, or an option is out of range.
        """
        self.plan = plan
        self.options = options or StandOptions()
        self._check_options()
        table_rng, imu_rng, joint_rng, ring_rng = np.random.default_rng(seed).spawn(4)
        epoch = self.options.start_time
        self._table = SimulatedTable(table, self.options, table_rng, epoch=epoch)
        self._imu = SimulatedImu(imu_spec, model, site, self.options, imu_rng, epoch=epoch)
        self.visits = self._run(plan.steps(table))
        last = self.visits[-1].end if self.visits else self.options.lead
        self.duration = last + self.options.lead
        self.motion = self._true_motion(ring_rng)
        self._joint_jitter, joint_phase = joint_rng.spawn(2)
        self._joint_phase = float(joint_phase.uniform())

    def blocks(self) -> Iterator[tuple[str, Block]]:
        """Yield (topic, block) in order of time; can be iterated once.

        Topics are turntable/setpoint, turntable/joint_states, imu/pulses and imu/temperature,
        and imu/skew where the unit has a skewed gyro.
        """
        length = self.options.block_length
        for k in range(math.ceil(self.duration / length)):
            begin, end = k * length, min((k + 1) * length, self.duration)
            named: list[tuple[str, Block]] = [
                (SETPOINT_TOPIC, self._setpoints(begin, end)),
                (JOINT_TOPIC, self._joint_states(begin, end)),
                *self._sampled(end),
                (TEMPERATURE_TOPIC, self._temperatures(begin, end)),
            ]
            yield from ((topic, block) for topic, block in named if len(block))

    def _sampled(self, end: float) -> Iterator[tuple[str, Block]]:
        """Yield the samples of the unit since the last call, up to a time."""
        yield IMU_TOPIC, self._imu.advance(self.motion, end)
        if self._imu.skewed is not None:
            yield SKEW_TOPIC, self._imu.skewed

    def _check_options(self) -> None:
        o = self.options
        positive = {
            'setpoint_rate': o.setpoint_rate,
            'joint_state_rate': o.joint_state_rate,
            'temperature_rate': o.temperature_rate,
            'block_length': o.block_length,
        }
        for name, value in positive.items():
            if not value > 0:
                raise InputError(f'{name}: found {value:g}, expected above 0.')
        if o.setpoint_rate * o.setpoint_timeout <= 1:
            raise InputError(
                f'setpoint_rate: at {o.setpoint_rate:g} Hz the table would stop between setpoints '
                f'(setpoint_timeout is {o.setpoint_timeout:g} s).'
            )

    def _run(self, steps: tuple[Step, ...]) -> tuple[Visit, ...]:
        """Send each step until the table is at rest, then wait; at rest setpoints do nothing."""
        visits: list[Visit] = []
        begin = self.options.lead
        for step in steps:
            self._table.command(self._setpoint(step, self._stamp(begin)), begin)
            ticks = (begin + tick / self.options.setpoint_rate for tick in count())
            now = next(time for time in ticks if self._table.rest_time <= time)
            self._table.sent_until(now)
            end = now + self.options.settle + step.dwell
            visits.append(Visit(step, begin, self._table.rest_time, end))
            begin = end
        return tuple(visits)

    def _true_motion(self, rng: np.random.Generator) -> Motion:
        motion = self._table.motion(self.duration)
        vibration = self.options.vibration
        rings = tuple(ringing(vibration, visit.rest, rng) for visit in self.visits)
        if vibration.rate or vibration.force:
            motion = replace(motion, ringing=rings)
        motion = replace(motion, shaking=shaking(self.options.shake, rng))
        return motion if self.options.shock is None else _shocked(motion, self.options.shock)

    def _setpoint(self, step: Step, stamp: int) -> Setpoint:
        return step.setpoint(self.plan.name, self._table.table.names, stamp)

    def _setpoints(self, begin: float, end: float) -> SetpointBlock:
        setpoints: list[Setpoint] = []
        period = 1 / self.options.setpoint_rate
        for visit in self.visits:
            if visit.begin >= end or visit.end <= begin:
                continue
            times = visit.begin + period * np.arange(
                math.ceil((visit.end - visit.begin) / period), dtype=np.float64
            )
            times = times[(times >= begin) & (times < min(end, visit.end))]
            setpoints += [
                self._setpoint(visit.step, stamp) for stamp in self._stamps(times).tolist()
            ]
        return SetpointBlock(tuple(setpoints))

    def _joint_states(self, begin: float, end: float) -> JointBlock:
        rate = self.options.joint_state_rate
        times = instants(begin, end, rate, self._joint_phase)
        angles, rates = self._table.read(times)
        stamped = jittered(times, self.options.joint_stamp_jitter, rate, self._joint_jitter)
        return JointBlock(self._stamps(stamped), self._table.table.names, angles, rates)

    def _temperatures(self, begin: float, end: float) -> TemperatureBlock:
        times = instants(begin, end, self.options.temperature_rate, 0.0)
        celsius = self.options.warming.celsius(times)
        return TemperatureBlock(self._imu.device_stamps(times), celsius)

    def _stamp(self, time: float) -> int:
        return self.options.start_time + round(time * 1e9)

    def _stamps(self, times: Floats) -> Stamps:
        return self.options.start_time + np.rint(times * 1e9).astype(np.int64)


def simulate(
    plan: Plan,
    table: Table,
    imu_spec: ImuSpec,
    model: SensorModel,
    site: Site,
    options: StandOptions | None = None,
    seed: int = 0,
) -> Iterator[tuple[str, Block]]:
    """Run a plan on a simulated stand and yield (topic, block) in order of time.

    Args:
        plan: What to run.
        table: Its description; its true errors are in the options.
        imu_spec: Units, scale factors and noise of the IMU.
        model: The true model, to be found by a calibration.
        site: Site of the stand.
        options: Errors, clocks and rates; the defaults if not given.
        seed: Of all randomness: the same seed gives the same bits.

    Raises:
        InputError: The table cannot run the plan, or an option is out of range.
    """
    return SimulatedStand(plan, table, imu_spec, model, site, options, seed).blocks()


def instants(begin: float, end: float, rate: float, phase: float) -> Floats:
    """Return the times (k + phase) / rate within [begin, end)."""
    first = max(math.floor(begin * rate - phase), 0)
    ticks = np.arange(first, math.ceil(end * rate - phase) + 1, dtype=np.float64)
    times = (ticks + phase) / rate
    return times[(times >= begin) & (times < end)]


def jittered(times: Floats, std: float, rate: float, rng: np.random.Generator) -> Floats:
    """Return the times of stamps that scatter by `std` s, up to 0.45 of their spacing."""
    if not std:
        return times
    return times + np.clip(std * rng.standard_normal(len(times)), -0.45 / rate, 0.45 / rate)


def ringing(vibration: Vibration, time: float, rng: np.random.Generator) -> Ringing:
    """Draw the directions of the ringing after a stop at a time, s."""
    swing = 2 * math.pi * vibration.frequency
    angle, velocity = rng.standard_normal((2, 3))
    angle *= vibration.rate / swing / np.linalg.norm(angle)
    velocity *= vibration.force / swing / np.linalg.norm(velocity)
    return Ringing(time, angle, velocity, vibration.frequency, vibration.decay)


def shaking(shake: Shake, parent: np.random.Generator) -> Shaking | None:
    """Draw the tones of a vibration, enough of them to resemble noise within the band."""
    if not (shake.rate or shake.force):
        return None
    rng = parent.spawn(1)[0]
    frequency = rng.uniform(shake.lowest, shake.highest, _TONES)
    swing = 2 * math.pi * frequency[:, None]
    # The directions are random, the root mean square about each axis is as stated.
    sizes = rng.standard_normal((2, _TONES, 3))
    sizes /= np.sqrt((sizes**2).sum(axis=1, keepdims=True) / 2)
    angle, velocity = shake.rate * sizes[0] / swing, shake.force * sizes[1] / swing
    return Shaking(frequency, angle, velocity, rng.uniform(0, 2 * math.pi, _TONES))


def _shocked(motion: Motion, shock: Shock) -> Motion:
    """Add the shock as one more joint, between the last one and the unit."""
    axis = np.array(shock.axis) / np.linalg.norm(shock.axis)
    before = Track.standing(motion.track.start[0], np.zeros(1))
    rate, acceleration = 2 * abs(shock.angle) / shock.duration, 4 * abs(shock.angle)
    turn = trapezoid(shock.time, 0.0, shock.angle, rate, acceleration / shock.duration**2)
    return replace(
        motion,
        axes=np.vstack([motion.axes, motion.mount @ axis]),
        zeros=np.append(motion.zeros, 0.0),
        track=side_by_side([motion.track, before.followed_by(turn)]),
    )


# A simulated stand with several units: one table, one motion, and an IMU for each.


@dataclass(frozen=True, eq=False)
class SimulatedUnit:
    """A unit on the table."""

    topic: str  #: Of its samples.
    spec: ImuSpec  #: Units, scale factors and noise.
    model: SensorModel  #: The true model, to be found by a calibration.
    mount: Floats  #: (3, 3) columns are its body axes in those that the table mounts.
    #: From the centre of rotation to its accelerometers, in its body axes, m.
    lever: tuple[float, float, float]
    #: Of its noise: the same seed gives the same bits, independent of other units. None: for a unit
    #: that is alone, derived from the stand's.
    seed: int | None

    def moved(self, motion: Motion) -> Motion:
        """Return the motion of the table in this unit's axes."""
        if np.array_equal(self.mount, np.eye(3)):
            return motion
        inward, shaking = self.mount.T, motion.shaking
        if shaking is not None:
            own = (shaking.angle @ self.mount, shaking.velocity @ self.mount)
            shaking = replace(shaking, angle=own[0], velocity=own[1])
        ringing = tuple(
            replace(ring, angle=inward @ ring.angle, velocity=inward @ ring.velocity)
            for ring in motion.ringing
        )
        return replace(motion, mount=motion.mount @ self.mount, ringing=ringing, shaking=shaking)


class SeveralOnTable(SimulatedStand):
    """A `SimulatedStand` with several units, to which the errors of the table are common.

    The options of an IMU (clock, delivery, thermal drift) apply to each, except the lever arm.

    Args:
        plan: The plan that is run.
        table: Its description.
        units: At least one.
        site: Site of the stand.
        options: Of the stand; the defaults if not given.
        seed: Of the table's randomness.

    Raises:
        InputError: The table cannot run the plan, or an option is out of range.
    """

    def __init__(
        self,
        plan: Plan,
        table: Table,
        units: Sequence[SimulatedUnit],
        site: Site,
        options: StandOptions | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__(plan, table, units[0].spec, units[0].model, site, options, seed)
        self._units = []
        for unit in units:
            own = replace(self.options, lever=unit.lever)
            rng = np.random.default_rng([unit.seed or 0, 1])
            imu = SimulatedImu(unit.spec, unit.model, site, own, rng, epoch=self.options.start_time)
            self._units.append((unit.topic, imu, unit.moved(self.motion)))

    def _sampled(self, end: float) -> Iterator[tuple[str, Block]]:
        for topic, imu, motion in self._units:
            yield topic, imu.advance(motion, end)
            if imu.skewed is not None:
                yield sibling_topic(topic, SKEW_TOPIC), imu.skewed


def sibling_topic(topic: str, other: str) -> str:
    """Return the topic of the same unit, named like the last part of another topic.

    >>> sibling_topic('/left/imu/pulses', 'imu/skew')
    '/left/imu/skew'
    """
    return f'{topic.rpartition("/")[0]}/{other.rpartition("/")[2]}'
