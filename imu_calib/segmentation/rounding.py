"""Samples that are rounded more coarsely than their noise: their means stay off.

The error of rounding is a sawtooth of the value; averaged over Gaussian noise the first term of its
Fourier series is left, step / pi * exp(-2 pi^2 (std / step)^2), however long the mean is taken (the
theory: Widrow and Kollar, Quantization Noise, 2008).
"""

from __future__ import annotations

import math

import numpy as np

from ..common.stream import Floats, Units
from ..common.units import DEG, STANDARD_GRAVITY
from ..session.imu import ImuSpec
from .statistics import whole_channels

_SAMPLES = 1000
"""Of a static dwell that are looked at."""
_FEWEST = 100
"""Samples that show the noise."""
_VALUES = 2
"""Values of which a channel takes no more at rest if its noise is below some 0.15 to 0.3 steps,
since 1000 samples lie within 3.3 deviations of their mean. With 0.2 steps the mean is off by up to
14 % of a step, without noise by up to a half."""
_SMALLEST = np.repeat([1e-3 * DEG / 3600, 1e-6 * STANDARD_GRAVITY], 3)
"""Steps, rad/s and m/s^2, that matter: biases of navigation grade repeat to more, and samples
without noise, of a simulation, differ by the rounding of double precision."""


class Rounding:
    """Finds channels of rates that take few values in static dwells.

    The resolution of pulses and counts is part of their noise: those are only tested for values
    that are no whole numbers.

    Args:
        spec: The IMU.
    """

    def __init__(self, spec: ImuSpec) -> None:
        triads = (spec.gyro, spec.accel)
        are_rates = spec.units in (Units.SI, Units.RATES)
        self._channels = [k for k in range(6) if are_rates and triads[k // 3].pulse == 0]
        self._scale = [triads[k // 3].scale_factor for k in range(6)]
        self._steps = [math.inf] * 6
        self._units = spec.units
        self._has_fractions = False

    def take(self, values: Floats) -> None:
        """Add the samples of a static dwell.

        Args:
            values: (n, 6) as delivered; NaN where samples were lost.
        """
        looked_at = values[:_SAMPLES]
        looked_at = looked_at[~np.isnan(looked_at).any(axis=1)]
        if self._units.whole:
            self._has_fractions |= not whole_channels(looked_at).all()
        if len(looked_at) < _FEWEST:
            return
        for channel in self._channels:
            column = looked_at[:, channel]
            # Most channels show more values at once.
            if len(np.unique(column[:_FEWEST])) > _VALUES:
                continue
            distinct = np.unique(column)
            if len(distinct) != _VALUES:
                continue
            step = float(distinct[1] - distinct[0]) * self._scale[channel]
            if step > _SMALLEST[channel]:
                self._steps[channel] = min(self._steps[channel], step)

    @property
    def sentences(self) -> list[str]:
        """What was seen, without a full stop: of one value alone the step is not known."""
        found = []
        if self._has_fractions:
            kind = Units.INCREMENTS if self._units.per_interval else Units.RATES
            found.append(
                "The values are no whole numbers, but the IMU's file states "
                f'{self._units.value}: state `units: {kind.value}`, or compensated samples have '
                'the covariance of values rounded to whole numbers'
            )
        for first, triad, unit in ((0, 'gyro', 'rad/s'), (3, 'accelerometer', 'm/s^2')):
            coarse = [k for k in range(first, first + 3) if math.isfinite(self._steps[k])]
            if not coarse:
                continue
            step = min(self._steps[k] for k in coarse)
            axes = ', '.join('xyz'[k - first] for k in coarse)
            channels = f'{triad}s {axes} read' if len(coarse) > 1 else f'{triad} {axes} reads'
            found.append(
                f'The {channels} two values in a static dwell, {step:.2g} {unit} apart: they are '
                'rounded more coarsely than their noise, and their means may be off by up to half '
                'a step, which the standard deviations do not contain. Record more digits'
            )
        return found
