"""Samples that are rounded more coarsely than their noise: their means stay off.

The error of rounding is a sawtooth of the value; averaged over Gaussian noise the first term of its
Fourier series is left, step / pi * exp(-2 pi^2 (std / step)^2), however long the mean is taken (the
theory: Widrow and Kollar, Quantization Noise, 2008).
"""

from __future__ import annotations

import math

import numpy as np

from ..imu import ImuSpec
from ..stream import Floats, Units

_SAMPLES = 1000
"""Of a static dwell that are looked at."""
_FEWEST = 100
"""Samples that show the noise."""
_VALUES = 2
"""Values of which a channel takes no more at rest if its noise is below some 0.15 to 0.3 steps,
since 1000 samples lie within 3.3 deviations of their mean. With 0.2 steps the mean is off by up to
14 % of a step, without noise by up to a half."""
_NOWHERE: Floats = np.empty(0)


class Rounding:
    """Finds channels in SI units that take few values in static dwells.

    Pulses and counts are not looked at: what one of them resolves is part of their noise.

    Args:
        spec: The IMU.
    """

    def __init__(self, spec: ImuSpec) -> None:
        is_si = spec.units is Units.SI
        triads = (spec.gyro, spec.accel)
        self._channels = [k for k in range(6) if is_si and triads[k // 3].pulse == 0]
        self._values = [_NOWHERE] * 6
        self._steps = [math.inf] * 6

    def take(self, values: Floats) -> None:
        """Add the samples of a static dwell.

        Args:
            values: (n, 6) as delivered, rad/s and m/s^2; NaN where samples were lost.
        """
        if not self._channels:
            return
        looked_at = values[:_SAMPLES]
        looked_at = looked_at[~np.isnan(looked_at).any(axis=1)]
        if len(looked_at) < _FEWEST:
            return
        for channel in self._channels:
            column = looked_at[:, channel]
            # Most channels show more values at once.
            if len(np.unique(column[:_FEWEST])) > _VALUES:
                continue
            distinct = np.unique(column)
            if len(distinct) > _VALUES:
                continue
            self._values[channel] = np.union1d(self._values[channel], distinct)
            if len(distinct) > 1:
                step = float(distinct[1] - distinct[0])
                self._steps[channel] = min(self._steps[channel], step)

    @property
    def sentences(self) -> list[str]:
        """What was seen, without a full stop; of a channel that never changes, nothing."""
        found = []
        for first, triad, unit in ((0, 'gyro', 'rad/s'), (3, 'accelerometer', 'm/s^2')):
            coarse = [k for k in range(first, first + 3) if len(self._values[k]) > 1]
            if not coarse:
                continue
            step = min(self._steps[k] for k in coarse)
            apart = f', {step:.2g} {unit} apart' if math.isfinite(step) else ''
            axes = ', '.join('xyz'[k - first] for k in coarse)
            channels = f'{triad}s {axes} read' if len(coarse) > 1 else f'{triad} {axes} reads'
            found.append(
                f'The {channels} one value, or two, in a static dwell{apart}: the samples are '
                'rounded more coarsely than their noise, and their means may be off by up to half '
                'a step, which the standard deviations do not contain. Record more digits'
            )
        return found
