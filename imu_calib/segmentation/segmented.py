"""Contents of a session's streams: the values returned by segmentation."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from ..common.stream import Floats, Setpoint
from .clock import ClockFit
from .course import Temperature
from .false_samples import NONE_FALSE, FalseSamples
from .segments import Segment, Statistics, Turn
from .stream_facts import StreamFacts


@dataclass(frozen=True, eq=False)
class Rejected:
    """A dwell, turn or move that was not used."""

    start: int  #: Its first instant, ns, IMU clock.
    end: int  #: Its last instant, ns, IMU clock.
    reason: str  #: Why it was not used, as part of a sentence.
    position: str | None = None  #: Id of the plan's position; None where unknown.
    turn: bool = False  #: Whether it is a turn or a move; else a dwell.


@dataclass(frozen=True)
class MountShift:
    """At `instant` (ns, IMU clock) a shock turned the unit in its mount by `angle` (rad)."""

    instant: int
    angle: float


@dataclass(frozen=True, eq=False)
class FreeMotion:
    """A motion between two dwells as seen by the gyros alone."""

    start: int  #: First instant, ns, IMU clock.
    end: int  #: Last instant, ns, IMU clock.
    statistics: Statistics  #: Of its samples.
    turned: Floats  #: (3,) integral of the rates, rad.
    mean_phase: complex  #: Mean over the motion of exp(i angle), the angle turned since its start.


@dataclass(frozen=True, eq=False)
class VelocitySteps:
    """Velocities gained by the accelerometers on a move, step by step."""

    #: (n, 3) integral of the specific force of each step, in the body axes in the mean of its
    #: rotation over its time, m/s.
    velocity: Floats
    mean: Floats  #: (n, 3) that mean less half of the rotation, rad: the effect of a changing rate.
    pulse: Floats  #: (3,) size of one pulse of their counters, m/s; 0 where there are none.
    #: Variance along any axis due to lost samples that are interpolated, (m/s)^2.
    filled: float = 0.0
    #: Whether the counts are predicted: before a session they are not known to a pulse.
    predicted: bool = False


@dataclass(frozen=True, eq=False)
class HeldAngles:
    """Angles (3,) by the gyros within a hold in the hand, rad."""

    to_mean: Floats  #: From its start to its mean attitude.
    from_mean: Floats  #: From there to its end.
    seconds: float  #: Its duration, s.
    #: (2,) variances of both about any axis due to lost samples that are interpolated, rad^2.
    filled: tuple[float, float] = (0.0, 0.0)

    def times(self, factors: Floats | float, longer: float = 1.0) -> HeldAngles:
        """Return angles multiplied by (3,) factors or one, and the duration by another."""
        return replace(
            self,
            to_mean=self.to_mean * factors,
            from_mean=self.from_mean * factors,
            seconds=self.seconds * longer,
        )


@dataclass(frozen=True, eq=False)
class Move:
    """A motion from one segment at rest to the next, without a gap."""

    start: int  #: End of the segment before, ns, IMU clock.
    end: int  #: Start of the segment after, ns, IMU clock.
    turned: Floats  #: (n, 3) rotation vector of each step, rad.
    seconds: Floats  #: (n,) duration of each step, s.
    pulse: Floats  #: (3,) size of one pulse of the gyros' counters, rad; 0 where there are none.
    #: Variance of its angle about any axis due to lost samples that are interpolated, rad^2.
    filled: float = 0.0
    #: Velocities gained by the accelerometers; None where not requested.
    velocity_steps: VelocitySteps | None = None
    #: Of a unit in the hand, of the holds before and after; None where not known.
    edges: tuple[HeldAngles, HeldAngles] | None = None
    #: s by which the time of its noise is shorter than it: of edges a part counts.
    quiet: float = 0.0
    later: float = 0.0  #: s by which the middle of its seconds is later than that of its instants.

    @property
    def duration(self) -> float:
        """Its duration, s."""
        return float(self.seconds.sum())

    @property
    def span(self) -> tuple[int, int]:
        """Instants of its duration about its middle, ns; its own where it has no edges."""
        if not self.quiet:
            return self.start, self.end
        middle = (self.start + self.end) / 2 + self.later * 1e9
        half = self.duration * 5e8
        return round(middle - half), round(middle + half)

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
        edges = self.edges and (self.edges[0].times(gyro), self.edges[1].times(gyro))
        return replace(self, turned=turned, pulse=pulse, velocity_steps=gained, edges=edges)


@dataclass(frozen=True, eq=False)
class Segmented:
    """All that a session's streams contain."""

    segments: tuple[Segment, ...]  #: Static dwells, in order.
    turns: tuple[Turn, ...]  #: Whole turns measured by an encoder, in order.
    motions: tuple[FreeMotion, ...]  #: Larger motions without an encoder, in order.
    #: Motions seen by the gyros between one segment and the next, in order.
    moves: tuple[Move, ...]
    rejected: tuple[Rejected, ...]  #: Static dwells that were not used.
    mount_shifts: tuple[MountShift, ...]  #: Shocks that shifted the unit in its mount, in order.
    losses: tuple[str, ...]  #: Data lost on input, in sentences.
    setpoints: tuple[Setpoint, ...]  #: The first of every run of equal setpoints, in order.
    clock: ClockFit  #: Table against IMU.
    samples: int  #: Number of IMU samples received.
    duration: float  #: From the first to the last IMU stamp, s.
    start: int | None = None  #: First IMU stamp, ns; None without samples.
    temperature: Temperature | None = None  #: Of the unit's thermometer; None without one.
    foreign_joints: str = ''  #: Sentence on joint states if none were the table's; else empty.
    #: Motions from one segment to the next that are not used, with the reason.
    lost_moves: tuple[Rejected, ...] = ()
    #: Last stamp before and first after each interruption of the IMU's stream, ns.
    interruptions: tuple[tuple[int, int], ...] = ()
    facts: StreamFacts = field(default_factory=StreamFacts)  #: Of the IMU's stream, as it came in.
    #: Samples of the IMU that are false, and count as missing.
    false_samples: FalseSamples = NONE_FALSE
    #: That the IMU froze while the table moved, as one of `losses`; empty if it did not.
    frozen: str = ''
    #: That many dwells and turns are left out for their stamps; empty if not.
    mistimed: str = ''
    #: That the unit turned evenly where it seemed at rest; empty if it did not.
    turning: str = ''
    interval_std: float = 0.0  #: Relative standard deviation of the sample interval by the stamps.
