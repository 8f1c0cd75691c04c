"""Properties of samples from an IMU's description: noise, and the ends of the range."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..common.stream import Floats, Stamps, Units
from ..session.imu import FULL_SCALES, NEARLY, ImuSpec, TriadSpec
from .pace import Pace
from .statistics import Samples, to_samples, whole_channels

_WALK_GUESS = 0.05
"""Pulses per root of a sample: first weights; the walk is then estimated from the session."""
_FEW_PULSES = 10.0
"""Pulses at the end of a range: with fewer one reading does not resolve it to a tenth."""
_ENOUGH_PULSES = 100.0
"""Pulses by which it is resolved to a hundredth. A judgement."""


@dataclass(frozen=True, eq=False)
class Sensor:
    """An IMU whose samples are read.

    Attributes:
        spec: Meaning of their numbers.
        walk: (6,) random walk to choose weights by, rad/sqrt(s) and (m/s)/sqrt(s).
    """

    spec: ImuSpec
    walk: Floats

    @classmethod
    def of(cls, spec: ImuSpec) -> Sensor:
        """Take the data sheet's random walk, or a fraction of a pulse.

        Values that are not pulses need no weights, and outliers are found by their own scatter.
        """
        guess = _WALK_GUESS if spec.units is Units.PULSES else 0.0
        walks = [
            t.random_walk if t.random_walk > 0 else guess * t.scale_factor
            for t in (spec.gyro, spec.accel)
        ]
        return cls(spec, np.repeat(walks, 3))

    @property
    def counted(self) -> bool:
        """Whether values are increments over the sample interval."""
        return self.spec.units.per_interval

    def step(self, seconds: float, values: Floats) -> Floats:
        """Return the resolution of means over so many seconds by one count or pulse, (2,).

        Of gyros and of accelerometers, rad/s and m/s^2; zeros for values that are no whole numbers.

        Args:
            seconds: Duration of the mean.
            values: (n, 6) first samples as delivered.
        """
        triads = (self.spec.gyro, self.spec.accel)
        if not (self.spec.units.whole and whole_channels(values).all()):
            return np.array([t.pulse / seconds for t in triads])
        return np.array([t.scale_factor / (seconds if self.counted else 1.0) for t in triads])

    @property
    def skewed(self) -> Sensor | None:
        """The skewed gyro as an IMU whose first channel it is; None without one."""
        if self.spec.skewed is None:
            return None
        return Sensor.of(replace(self.spec, gyro=self.spec.skewed, accel=TriadSpec()))

    def samples(self, stamp: Stamps, values: Floats, pace: Pace | None = None) -> Samples:
        """Return values as increments in SI units, at the instants of a line through their stamps.

        Args:
            stamp: (n,) ns, at least 2.
            values: (n, 6) as delivered.
            pace: Sample interval of the session so far; by the stamps alone if not given.
        """
        grid, timing = (pace or Pace()).read(stamp)
        samples = to_samples(grid.stamps(stamp), values, self.spec, timing.used)
        # Values delivered as rates need no interval to become rates.
        return replace(samples, timing=timing) if self.counted else samples

    def saturated(self, values: Floats, samples: Samples) -> NDArray[np.bool_]:
        """Return for every sample, (n,), whether a channel is at the end of its range.

        Args:
            values: (n, 6) as the sensor gives them.
            samples: The same in SI units.
        """
        limits = np.repeat([self.spec.gyro.range, self.spec.accel.range], 3) * samples.period
        ends = np.repeat(self.spec.least_ends, 3) * samples.period
        clipped = np.zeros(len(values), dtype=bool)
        # Channel by channel: the absolute values of a million samples of all six are 48 MB.
        for c, limit in enumerate((NEARLY * limits).tolist()):
            clipped |= _at_its_end(samples.increments[:, c], limit, float(samples.pulse[c]))
            if self.spec.units.whole:
                sizes = np.abs(values[:, c])
                # NaN, of lost samples, compares false.
                if not sizes.max(initial=0.0) < FULL_SCALES[0]:
                    full = np.isin(sizes, FULL_SCALES)
                    clipped |= full & (np.abs(samples.increments[:, c]) >= ends[c])
        return clipped


def _at_its_end(increments: Floats, limit: float, pulse: float) -> NDArray[np.bool_]:
    """Return for every increment, (n,), whether its channel is at the end of its range.

    There the increment is the limit, infinite if not stated. If that is a few pulses, one reading
    does not resolve it: it is a whole number, up to a pulse more than the true increment. Then as
    many are added as make a hundred pulses.
    """
    if not limit < _FEW_PULSES * pulse:
        return np.asarray(np.abs(increments) >= limit)
    found = np.zeros(len(increments), dtype=bool)
    many = math.ceil(_ENOUGH_PULSES * pulse / limit)
    if len(increments) < many:
        return found
    total = np.concatenate([[0.0], np.cumsum(increments)])
    # The counter's remainder: so many intervals show up to a pulse less than their true sum.
    for first in np.flatnonzero(np.abs(total[many:] - total[:-many]) >= many * limit - pulse):
        found[first : first + many] = True
    return found
