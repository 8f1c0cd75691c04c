"""How far a session strays while its unit is held still: tolerances for telling rests by."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..stream import Floats
from ..units import DEG, STANDARD_GRAVITY

_BESIDE = 5
"""Windows before and after the one that is looked at: a second in all."""

_USUAL = 0.9
"""Share of the quiet windows that are taken for still: the rest may be shocks, or turns too slow to
be told beforehand. A judgement."""

_MARGIN = 3.0
"""Three times what nine windows of ten keep to is over six standard deviations of normal noise:
once in many hours a window of a unit at rest lies beyond."""

_LEAST_RATE = 0.5 * DEG
_LEAST_FORCE = 0.02 * STANDARD_GRAVITY
"""A hand leans by a degree within a hold: 0.017 g."""

_MOST_RATE = 5.0 * DEG
_MOST_FORCE = 0.1 * STANDARD_GRAVITY
"""What moves faster is turned: five published sessions of MPU-9150 by hand stray by up to 2.4 deg/s
in holds, and pass 5 deg/s within 0.2 s of their turns' beginning."""


@dataclass(frozen=True)
class Tolerance:
    """How far the mean of a tenth of a second may stray at rest: rad/s and m/s^2, in each axis."""

    rate: float = _LEAST_RATE
    force: float = _LEAST_FORCE

    @classmethod
    def of(cls, means: Floats, offset: Floats) -> Tolerance:
        """Learn it from the quiet seconds among windows that follow each other.

        What counts is how rates stray from the second around them, and forces from one window to
        the next: a turn at an even rate strays no more than a rest, however slow it is.

        Args:
            means: (n, 6) means of windows of a tenth of a second, rad/s and m/s^2.
            offset: (3,) what the gyros read at rest, rad/s.

        """
        width = 2 * _BESIDE + 1
        if len(means) < width:
            return cls()
        fast = (np.abs(means[:, :3] - offset) > _MOST_RATE).any(axis=1)
        quiet = np.convolve(fast, np.ones(width), 'valid') == 0
        if np.count_nonzero(quiet) < width:
            return cls()
        inner = slice(_BESIDE, len(means) - _BESIDE)
        around = np.lib.stride_tricks.sliding_window_view(means[:, :3], width, axis=0).mean(axis=2)
        shaken = np.abs(means[inner, :3] - around)[quiet]
        # Of two windows with noise of their own.
        pushed = np.abs(means[inner, 3:] - means[_BESIDE - 1 : -_BESIDE - 1, 3:])[quiet] / np.sqrt(
            2
        )
        rate, force = (
            _MARGIN * float(np.quantile(part.max(axis=1), _USUAL)) for part in (shaken, pushed)
        )
        return cls(
            float(np.clip(rate, _LEAST_RATE, _MOST_RATE)),
            float(np.clip(force, _LEAST_FORCE, _MOST_FORCE)),
        )
