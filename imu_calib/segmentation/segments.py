"""Segments, the parts of a session in use: static dwells, `Segment`, and whole turns, `Turn`."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from ..common.stream import Floats
from .counters import AllanSums
from .stamp_faults import Pace, Timing

CHANNELS = ('gx', 'gy', 'gz', 'ax', 'ay', 'az')
"""Order of every array over channels: three gyros, then three accelerometers."""


@dataclass(frozen=True, eq=False)
class Statistics:
    """Statistics of the samples of one segment, in SI after the nominal scale factor.

    The variance of `mean` is walk_gain * N^2 + quantisation_variance, with N the channel's
    random-walk coefficient, estimated from the blocks of all segments together.

    Attributes:
        samples: Number of samples used.
        missing: Number of samples lost in gaps within the segment.
        duration: Time that the samples cover, s, by the device's clock.
        mean: (6,) best estimate of the mean output, rad/s and m/s^2.
        walk_gain: (6,) 1/s.
        quantisation_variance: (6,) variance by quantisation, (rad/s)^2 and (m/s^2)^2.
        end_points: (6,) sum over duration, the mean in the documents' formulae.
        blocks: Per channel (b, 4): mean, walk gain, quantisation variance of blocks of 10 s or
            more, and the middle of each, s after the segment began.
        drift: (6,) slope of the block means, rad/s^2 and m/s^3.
        drift_std: (6,) its standard deviation by the scatter of the blocks; NaN below 4 blocks.
        pulse: (6,) size of one pulse, rad and m/s; 0 where the values are not whole pulses.
        allan: Sums for the Allan variance; None where not computed.
        timing: How the samples were timed; None where not requested.
        time_error: Standard deviation of the sample interval, relative.
        sample_variance: (6,) of single samples about their neighbours, which slow motion such as a
            trembling hand does not raise, (rad/s)^2 and (m/s^2)^2; NaN where too few follow each
            other.
    """

    samples: int
    missing: int
    duration: float
    mean: Floats
    walk_gain: Floats
    quantisation_variance: Floats
    end_points: Floats
    blocks: tuple[Floats, ...]
    drift: Floats
    drift_std: Floats
    pulse: Floats = field(default_factory=lambda: np.zeros(6))
    allan: AllanSums | None = None
    timing: Timing | None = None
    time_error: float = 0.0
    sample_variance: Floats = field(default_factory=lambda: np.full(6, np.nan))

    def variance(self, walk: Floats) -> Floats:
        """Return the variance of `mean` for (6,) random-walk coefficients."""
        timed = (self.time_error * self.mean) ** 2
        return np.asarray(walk**2 * self.walk_gain + self.quantisation_variance + timed)

    def scaled(self, factors: Floats) -> Statistics:
        """Return mean and quantisation multiplied by (6,) factors; the rest stays as it is."""
        return replace(
            self,
            mean=self.mean * factors,
            quantisation_variance=self.quantisation_variance * factors**2,
        )

    def retimed(self, pace: Pace) -> Statistics:
        """Return the same with the sample interval of the whole session."""
        if self.timing is None:
            return self
        period, std = pace.combined(self.timing)
        if not math.isfinite(std):
            return self
        slower = self.timing.used / period
        blocks = tuple(b * np.array([slower, 1.0, 1.0, 1.0]) for b in self.blocks)
        return replace(
            self,
            duration=self.duration / slower,
            mean=self.mean * slower,
            end_points=self.end_points * slower,
            blocks=blocks,
            timing=replace(self.timing, used=period),
            time_error=std / period,
        )


@dataclass(frozen=True, eq=False)
class Segment:
    """A segment at rest: a static dwell.

    Attributes:
        start: First instant used, ns, IMU clock.
        end: Last instant used, ns, IMU clock.
        statistics: Of its samples.
        attitude: (3, 3) R_nb in east, north, up of the table's azimuth; None where neither joint
            angles nor a plan give it.
        position: Id of the plan's position; None where unknown.
        angles: (k,) mean joint angles, rad; None without joint states.
        notes: What was cut away and why, in sentences.
        attitude_error: Standard deviation of the attitude about any axis by the encoders' noise,
            rad.
        excess_covariance: (3, 3) covariance of the accelerometers' mean beyond their usual noise,
            (m/s^2)^2; None without.
        sliding: Rate at which the unit leans more and more, rad/s; its gyros show that, too.
    """

    start: int
    end: int
    statistics: Statistics
    attitude: Floats | None = None
    position: str | None = None
    angles: Floats | None = None
    notes: tuple[str, ...] = ()
    attitude_error: float = 0.0
    excess_covariance: Floats | None = None
    sliding: float = 0.0

    def variance(self, walk: Floats, gravity: float) -> Floats:
        """Return the variances of the mean outputs, (6,), SI: noise, and gravity by the lean.

        Args:
            walk: (6,) random-walk coefficients.
            gravity: m/s^2; the Earth rate by the lean is below all noise.
        """
        found = self.statistics.variance(walk) + self.encoder_variance(gravity)
        if self.excess_covariance is not None:
            found[3:] += np.diag(self.excess_covariance)
        found[:3] += self.sliding**2
        return found

    def encoder_variance(self, gravity: float) -> Floats:
        """Return the variances of the mean outputs by the encoders' noise, (6,)."""
        if self.attitude is None or not self.attitude_error:
            return np.zeros(6)
        across = (gravity * self.attitude_error) ** 2 * (1 - self.attitude[2] ** 2)
        return np.append(np.zeros(3), across)


@dataclass(frozen=True)
class RestToRest:
    """A turn as a part of the whole motion from rest to rest.

    Attributes:
        turned: Angle about up between the cuts, rad, signed, from the share seen by the gyros.
        way: Angle from rest to rest, whole turns, rad, without sign.
        by_noise: Standard deviation of the rate, relative, for a random walk of one about up, with
            the uncertainty of the gyros' output at rest.
        by_pulses: The same by quantisation.
    """

    turned: float
    way: float
    by_noise: float
    by_pulses: float


@dataclass(frozen=True, eq=False)
class Turn:
    """Whole turns about the vertical.

    Attributes:
        start: First instant used, ns, IMU clock.
        end: Last instant used, ns, IMU clock.
        statistics: Of its samples; `blocks` are empty.
        angle: Angle turned about up, rad, signed.
        seconds: Its time by the table's clock; None without a table.
        up: (3,) up in body axes.
        position: Id of the plan's position at which it was made; None where unknown.
        rate_error: Standard deviation of the encoder's rate, relative; 0 without an encoder.
        up_error: Standard deviation of `up` about either level axis by the encoders' noise, rad.
        skewed: Statistics of a skewed gyro, as first channel; None without one.
        each: (n, 3) gyro means of the single turns, (n, 4) with a skewed one; None for one turn.
        level_share: Share of a level rate that does not average out: for whole turns at a constant
            rate the error of cuts within samples, for turns from rest to rest the effect of the
            slow parts.
        angles: (k,) mean joint angles, rad; None without joint states.
        joint: Index of the joint that turns.
        step: Of its encoder, rad, by its angles; 0 where they show none.
        whole_way: The turn by the gyros as a part of the whole motion; None where the encoder's
            line is more accurate.
    """

    start: int
    end: int
    statistics: Statistics
    angle: float
    seconds: float | None
    up: Floats
    position: str | None = None
    rate_error: float = 0.0
    up_error: float = 0.0
    skewed: Statistics | None = None
    each: Floats | None = None
    level_share: float = 0.0
    angles: Floats | None = None
    joint: int | None = None
    step: float = 0.0
    whole_way: RestToRest | None = None

    @property
    def level(self) -> float:
        """`level_share`, by its former name."""
        return self.level_share

    def encoder_variance(self) -> Floats:
        """Return the variances of the gyros' means by the encoders' noise, (3,)."""
        return np.asarray((self.up_error * self.rate()) ** 2 * (1 - self.up**2))

    def lean_variance(self, gravity: float) -> Floats:
        """Return the variances of the accelerometers' means by the encoders' noise, (3,)."""
        return np.asarray((self.up_error * gravity) ** 2 * (1 - self.up**2))

    def retimed(self, pace: Pace) -> Turn:
        """Return the same with the sample interval of the whole session."""
        statistics = self.statistics.retimed(pace)
        slower = self.statistics.duration / statistics.duration
        return replace(
            self,
            statistics=statistics,
            skewed=None if self.skewed is None else self.skewed.retimed(pace),
            each=None if self.each is None else self.each * slower,
        )

    def rate_std(self, walk: Floats) -> float:
        """Return the relative standard deviation of the rate: by the line, or by the whole motion.

        Args:
            walk: (6,) random-walk coefficients, SI.
        """
        if self.whole_way is None:
            return self.rate_error
        about_up = float(np.linalg.norm(walk[:3] * self.up))
        return math.hypot(self.whole_way.by_noise * about_up, self.whole_way.by_pulses)

    def by_more_accurate_rate(self, walk: Floats) -> Turn:
        """Return the turn by the encoder's line where that gives the more accurate rate.

        For a short turn with long ramps, gyros with a random walk (6,) at rest on either side may
        be less accurate than coarse readings.
        """
        surer = self.rate_std(walk) < self.rate_error
        return self if surer or self.whole_way is None else replace(self, whole_way=None)

    def rate(self) -> float:
        """Return the rate about up, rad/s, by the table's clock; by the IMU's without a table."""
        if self.whole_way is not None:
            return self.whole_way.turned / self.statistics.duration
        return self.angle / (self.statistics.duration if self.seconds is None else self.seconds)
