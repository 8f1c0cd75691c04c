"""What an IMU's description says of its samples: how noisy, and where they end."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..imu import FULL_SCALES, NEARLY, ImuSpec, TriadSpec
from ..stream import Floats, Stamps, Units
from .pace import Pace
from .statistics import Samples, to_samples

_WALK_GUESS = 0.05
"""Pulses per root of a sample: weights of the first look; the walk follows from the session."""
_FEW_PULSES = 10.0
"""Pulses at the end of a range: with fewer one reading does not resolve it to a tenth."""
_ENOUGH_PULSES = 100.0
"""Pulses by which it is resolved to a hundredth. A judgement."""


@dataclass(frozen=True, eq=False)
class Sensor:
    """An IMU whose samples are read.

    Attributes:
        spec: What their numbers mean.
        walk: (6,) random walk to choose weights by, rad/sqrt(s) and (m/s)/sqrt(s).
    """

    spec: ImuSpec
    walk: Floats

    @classmethod
    def of(cls, spec: ImuSpec) -> Sensor:
        """Take the data sheet's random walk, or a fraction of a pulse.

        Values that are no pulses need no weights, and their own scatter shows what is an outlier.
        """
        guess = _WALK_GUESS if spec.units is Units.PULSES else 0.0
        walks = [
            t.random_walk if t.random_walk > 0 else guess * t.scale_factor
            for t in (spec.gyro, spec.accel)
        ]
        return cls(spec, np.repeat(walks, 3))

    @property
    def counted(self) -> bool:
        """Whether values are increments of a counter."""
        return self.spec.units is Units.PULSES

    def step(self, seconds: float) -> Floats:
        """Return by how much means over so many seconds go on with one count or pulse, (2,).

        Of gyros and of accelerometers, rad/s and m/s^2; zeros for values in SI.
        """
        triads = (self.spec.gyro, self.spec.accel)
        if self.spec.units is Units.SI:
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
            pace: What the session tells of the sample interval so far; nothing if not given.
        """
        grid, timing = (pace or Pace()).read(stamp)
        samples = to_samples(grid.stamps(stamp), values, self.spec, timing.used)
        # What comes as a rate needs no interval to be one.
        return replace(samples, timing=timing) if self.counted else samples

    def saturated(self, values: Floats, samples: Samples) -> NDArray[np.bool_]:
        """Say of every sample, (n,), whether a channel stands at the end of its range.

        Args:
            values: (n, 6) as the sensor gives them.
            samples: The same in SI units.
        """
        limits = np.repeat([self.spec.gyro.range, self.spec.accel.range], 3) * samples.period
        clipped = np.zeros(len(values), dtype=bool)
        # Channel by channel: of a million samples the sizes of all six are 48 MB.
        for c, limit in enumerate((NEARLY * limits).tolist()):
            clipped |= _at_its_end(samples.increments[:, c], limit, float(samples.pulse[c]))
            if self.spec.units is not Units.SI:
                sizes = np.abs(values[:, c])
                # NaN, of lost samples, is below nothing.
                if not sizes.max(initial=0.0) < FULL_SCALES[0]:
                    clipped |= np.isin(sizes, FULL_SCALES)
        return clipped


def _at_its_end(increments: Floats, limit: float, pulse: float) -> NDArray[np.bool_]:
    """Say of every increment, (n,), whether its channel stands at the end of its range.

    There an interval gains the limit, which is infinite where none is stated. Where that is a few
    pulses one reading tells too little: it is a whole number, up to a pulse more than what was
    gained. Then as many are added up as make a hundred pulses.
    """
    if not limit < _FEW_PULSES * pulse:
        return np.asarray(np.abs(increments) >= limit)
    found = np.zeros(len(increments), dtype=bool)
    many = math.ceil(_ENOUGH_PULSES * pulse / limit)
    if len(increments) < many:
        return found
    total = np.concatenate([[0.0], np.cumsum(increments)])
    # The counter's remainder: so many intervals show up to a pulse less than they gain.
    for first in np.flatnonzero(np.abs(total[many:] - total[:-many]) >= many * limit - pulse):
        found[first : first + many] = True
    return found
