"""Contents of a session's streams: the values returned by segmentation."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from ..common.stream import Floats, Setpoint
from .clock import ClockFit
from .false_samples import NONE_FALSE, FalseSamples
from .segmentation_stream_facts import StreamFacts
from .segments import Segment, Statistics, Turn
from .thermometer import Temperature


@dataclass(frozen=True, eq=False)
class Rejected:
    """A dwell, turn or move that was not used.

    Attributes:
        start: Its first instant, ns, IMU clock.
        end: Its last instant, ns, IMU clock.
        reason: Why it was not used, as part of a sentence.
        position: Id of the plan's position; None where unknown.
        turn: Whether it is a turn or a move; else a dwell.
    """

    start: int
    end: int
    reason: str
    position: str | None = None
    turn: bool = False


@dataclass(frozen=True)
class MountShift:
    """At `instant` (ns, IMU clock) a shock turned the unit in its mount by `angle` (rad)."""

    instant: int
    angle: float


@dataclass(frozen=True, eq=False)
class FreeMotion:
    """A motion between two dwells as seen by the gyros alone.

    Attributes:
        start: First instant, ns, IMU clock.
        end: Last instant, ns, IMU clock.
        statistics: Of its samples.
        turned: (3,) integral of the rates, rad.
        mean_phase: Mean over the motion of exp(i angle), the angle turned since its start.
    """

    start: int
    end: int
    statistics: Statistics
    turned: Floats
    mean_phase: complex

    @property
    def level(self) -> complex:
        """`mean_phase`, by its former name."""
        return self.mean_phase


@dataclass(frozen=True, eq=False)
class VelocitySteps:
    """Velocities gained by the accelerometers on a move, step by step.

    Attributes:
        velocity: (n, 3) integral of the specific force of each step, in the body axes in the mean
            of its rotation over its time, m/s.
        mean: (n, 3) that mean less half of the rotation, rad: the effect of a changing rate.
        pulse: (3,) size of one pulse of their counters, m/s; 0 where there are none.
        filled: Variance along any axis due to lost samples that are interpolated, (m/s)^2.
        predicted: Whether the counts are predicted: before a session they are not known to a pulse.
    """

    velocity: Floats
    mean: Floats
    pulse: Floats
    filled: float = 0.0
    predicted: bool = False


@dataclass(frozen=True, eq=False)
class Move:
    """A motion from one segment at rest to the next, without a gap.

    Attributes:
        start: End of the segment before, ns, IMU clock.
        end: Start of the segment after, ns, IMU clock.
        turned: (n, 3) rotation vector of each step, rad.
        seconds: (n,) duration of each step, s.
        pulse: (3,) size of one pulse of the gyros' counters, rad; 0 where there are none.
        filled: Variance of its angle about any axis due to lost samples that are interpolated,
            rad^2.
        velocity_steps: Velocities gained by the accelerometers; None where not requested.
    """

    start: int
    end: int
    turned: Floats
    seconds: Floats
    pulse: Floats
    filled: float = 0.0
    velocity_steps: VelocitySteps | None = None

    @property
    def duration(self) -> float:
        """Its duration, s."""
        return float(self.seconds.sum())

    @property
    def fastest(self) -> float:
        """Highest rate about any body axis, rad/s."""
        return float(np.max(np.abs(self.turned) / self.seconds[:, None], initial=0.0))

    def scaled(self, factors: Floats) -> Move:
        """Return angles, velocities and their pulses multiplied by (6,) factors, one a triad."""
        gyro, accel = factors[:3], factors[3:]
        gained = self.velocity_steps
        if gained is not None:
            velocity, pulse = gained.velocity * accel, gained.pulse * accel
            gained = replace(gained, velocity=velocity, mean=gained.mean * gyro, pulse=pulse)
        turned, pulse = self.turned * gyro, self.pulse * gyro
        return replace(self, turned=turned, pulse=pulse, velocity_steps=gained)


@dataclass(frozen=True, eq=False)
class Segmented:
    """All that a session's streams contain.

    Attributes:
        segments: Static dwells, in order.
        turns: Whole turns measured by an encoder, in order.
        motions: Larger motions without an encoder, in order.
        moves: Motions seen by the gyros between one segment and the next, in order.
        rejected: Static dwells that were not used.
        mount_shifts: Shocks that shifted the unit in its mount, in order.
        losses: Data lost on input, in sentences.
        setpoints: The first of every run of equal setpoints, in order.
        clock: Table against IMU.
        samples: Number of IMU samples received.
        duration: From the first to the last IMU stamp, s.
        start: First IMU stamp, ns; None without samples.
        temperature: Of the unit's thermometer; None without one.
        foreign_joints: Sentence on joint states if none were the table's; else empty.
        lost_moves: Motions from one segment to the next that are not used, with the reason.
        interruptions: Last stamp before and first after each interruption of the IMU's stream, ns.
        facts: Of the IMU's stream, as it came in.
        false_samples: Samples of the IMU that are false, and count as missing.
    """

    segments: tuple[Segment, ...]
    turns: tuple[Turn, ...]
    motions: tuple[FreeMotion, ...]
    moves: tuple[Move, ...]
    rejected: tuple[Rejected, ...]
    mount_shifts: tuple[MountShift, ...]
    losses: tuple[str, ...]
    setpoints: tuple[Setpoint, ...]
    clock: ClockFit
    samples: int
    duration: float
    start: int | None = None
    temperature: Temperature | None = None
    foreign_joints: str = ''
    lost_moves: tuple[Rejected, ...] = ()
    interruptions: tuple[tuple[int, int], ...] = ()
    facts: StreamFacts = field(default_factory=StreamFacts)
    false_samples: FalseSamples = NONE_FALSE
