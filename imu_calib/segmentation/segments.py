"""Segments, the parts of a session in use: static dwells, `Segment`, and whole turns, `Turn`."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from ..common.stream import Floats
from .allan import AllanSums
from .pace import Pace, Timing

CHANNELS = ('gx', 'gy', 'gz', 'ax', 'ay', 'az')
"""Order of every array over channels: three gyros, then three accelerometers."""


@dataclass(frozen=True, eq=False)
class Statistics:
    """Statistics of the samples of one segment, in SI after the nominal scale factor.

    The variance of `mean` is walk_gain * N^2 + quantisation_variance, with N the channel's
    random-walk coefficient, estimated from the blocks of all segments together.
    """

    samples: int  #: Number of samples used.
    missing: int  #: Number of samples lost in gaps within the segment.
    duration: float  #: Time that the samples cover, s, by the device's clock.
    mean: Floats  #: (6,) best estimate of the mean output, rad/s and m/s^2.
    walk_gain: Floats  #: (6,) 1/s.
    quantisation_variance: Floats  #: (6,) variance by quantisation, (rad/s)^2 and (m/s^2)^2.
    end_points: Floats  #: (6,) sum over duration, the mean in the documents' formulae.
    #: Per channel (b, 4): mean, walk gain, quantisation variance of blocks of 10 s or more, and the
    #: middle of each, s after the segment began.
    blocks: tuple[Floats, ...]
    drift: Floats  #: (6,) slope of the block means, rad/s^2 and m/s^3.
    #: (6,) its standard deviation by the scatter of the blocks; NaN below 4 blocks.
    drift_std: Floats
    #: (6,) size of one pulse, rad and m/s; 0 where the values are not whole pulses.
    pulse: Floats = field(default_factory=lambda: np.zeros(6))
    allan: AllanSums | None = None  #: Sums for the Allan variance; None where not computed.
    timing: Timing | None = None  #: How the samples were timed; None where not requested.
    time_error: float = 0.0  #: Standard deviation of the sample interval, relative.
    #: (6,) of single samples about their neighbours, which slow motion such as a trembling hand
    #: does not raise, (rad/s)^2 and (m/s^2)^2; NaN where too few follow each other.
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
    """A segment at rest: a static dwell."""

    start: int  #: First instant used, ns, IMU clock.
    end: int  #: Last instant used, ns, IMU clock.
    statistics: Statistics  #: Of its samples.
    #: (3, 3) R_nb in east, north, up of the table's azimuth; None where neither joint angles nor a
    #: plan give it.
    attitude: Floats | None = None
    position: str | None = None  #: Id of the plan's position; None where unknown.
    angles: Floats | None = None  #: (k,) mean joint angles, rad; None without joint states.
    notes: tuple[str, ...] = ()  #: What was cut away and why, in sentences.
    #: Standard deviation of the attitude about any axis by the encoders' noise, rad.
    attitude_error: float = 0.0
    #: (3, 3) covariance of the accelerometers' mean beyond their usual noise, (m/s^2)^2; None
    #: without.
    excess_covariance: Floats | None = None
    #: Rate at which the unit leans more and more, rad/s; its gyros show that, too.
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
    """A turn as a part of the whole motion from rest to rest."""

    #: Angle about up between the cuts, rad, signed, from the share seen by the gyros.
    turned: float
    way: float  #: Angle from rest to rest, whole turns, rad, without sign.
    #: Standard deviation of the rate, relative, for a random walk of one about up, with the
    #: uncertainty of the gyros' output at rest.
    by_noise: float
    by_pulses: float  #: The same by quantisation.


@dataclass(frozen=True, eq=False)
class Turn:
    """Whole turns about the vertical."""

    start: int  #: First instant used, ns, IMU clock.
    end: int  #: Last instant used, ns, IMU clock.
    statistics: Statistics  #: Of its samples; `blocks` are empty.
    angle: float  #: Angle turned about up, rad, signed.
    seconds: float | None  #: Its time by the table's clock; None without a table.
    up: Floats  #: (3,) up in body axes.
    #: Id of the plan's position at which it was made; None where unknown.
    position: str | None = None
    #: Standard deviation of the encoder's rate, relative; 0 without an encoder.
    rate_error: float = 0.0
    #: Standard deviation of `up` about either level axis by the encoders' noise, rad.
    up_error: float = 0.0
    #: Statistics of a skewed gyro, as first channel; None without one.
    skewed: Statistics | None = None
    #: (n, 3) gyro means of the single turns, (n, 4) with a skewed one; None for one turn.
    each: Floats | None = None
    #: Share of a level rate that does not average out: for whole turns at a constant rate the error
    #: of cuts within samples, for turns from rest to rest the effect of the slow parts.
    level_share: float = 0.0
    angles: Floats | None = None  #: (k,) mean joint angles, rad; None without joint states.
    joint: int | None = None  #: Index of the joint that turns.
    step: float = 0.0  #: Of its encoder, rad, by its angles; 0 where they show none.
    #: The turn by the gyros as a part of the whole motion; None where the encoder's line is more
    #: accurate.
    whole_way: RestToRest | None = None

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
