"""Estimate tolerances for detecting dwells: the deviations while a unit is held still."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..common.stream import Floats
from ..common.units import DEG, STANDARD_GRAVITY
from .gyro_offset import ASSUMED_SPREAD

_BESIDE = 5
"""Windows before and after each window: a second in all."""

_USUAL = 0.9
"""Share of the quiet windows that count as still: the rest may be shocks, or turns too slow to be
detected beforehand. A judgement."""

_MARGIN = 3.0
"""Three times the limit of nine windows in ten is over six standard deviations of normal noise: a
window of a unit at rest exceeds it once in many hours."""

_LEAN = 1.0 * DEG * STANDARD_GRAVITY
"""A hand leans by a degree within a hold, m/s^2; more is another attitude."""

_TURN_RATE = 5.0 * DEG
"""Mean over a second from which on it is a turn, rad/s: five degrees exceed the lean of any hold,
with tremor. Published sessions by hand exceed it within 0.2 s of the beginning of turns."""

_MOST_RATE = 20.0 * DEG
"""rad/s: a stronger tremor is not a hold."""
_MOST_FORCE = 0.3 * STANDARD_GRAVITY
"""A larger swing is not a hold: two degrees in a tenth of a second, of which the mean no longer
resolves a tenth."""


@dataclass(frozen=True)
class RestTolerance:
    """Largest deviation of the mean of a tenth of a second at rest, in each axis.

    Attributes:
        rate: From the gyros' output at rest, rad/s.
        force: From the accelerometers' output at the start of the rest, m/s^2.
        usual: Deviation of rates in nine windows of ten from the second around, rad/s.
    """

    rate: float = ASSUMED_SPREAD
    force: float = _LEAN
    usual: float = 0.0

    @classmethod
    def of(
        cls,
        means: Floats,
        offset: Floats,
        spread: float = ASSUMED_SPREAD,
        step: Floats | None = None,
    ) -> RestTolerance:
        """Estimate it from the quiet seconds among windows that follow each other.

        It is based on deviations of rates from the second around them, and of forces from one
        window to the next: for a turn at an even rate these are as small as for a dwell, however
        slow it is.

        Args:
            means: (n, 6) means of windows of a tenth of a second, rad/s and m/s^2.
            offset: (3,) gyros' output at rest, rad/s.
            spread: Its largest difference between attitudes, rad/s.
            step: (2,) the size of a count of gyros and accelerometers, rad/s and m/s^2.
        """
        width = 2 * _BESIDE + 1
        least = np.zeros(2) if step is None else step
        plain = cls(spread + float(least[0]), _LEAN + float(least[1]), float(least[0]))
        if len(means) < width:
            return plain
        around = np.lib.stride_tricks.sliding_window_view(means[:, :3], width, axis=0).mean(axis=2)
        turned = (np.abs(around - offset) > _TURN_RATE).any(axis=1)
        # A turn that begins soon is within the neighbouring seconds.
        quiet = np.convolve(turned, np.ones(width))[_BESIDE:-_BESIDE] == 0
        if np.count_nonzero(quiet) < width:
            return plain
        inner = slice(_BESIDE, len(means) - _BESIDE)
        shaken = np.abs(means[inner, :3] - around)[quiet]
        # Difference of two windows with independent noise.
        pushed = np.abs(means[inner, 3:] - means[_BESIDE - 1 : -_BESIDE - 1, 3:])[quiet] / np.sqrt(
            2
        )
        noise = np.maximum(
            [_MARGIN * float(np.quantile(part.max(axis=1), _USUAL)) for part in (shaken, pushed)],
            least,
        )
        return cls(
            min(spread + float(noise[0]), _MOST_RATE),
            min(_LEAN + float(noise[1]), _MOST_FORCE),
            float(noise[0]) / _MARGIN,
        )
