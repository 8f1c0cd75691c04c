"""How far a session strays while its unit is held still: tolerances for telling dwells by."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..stream import Floats
from ..units import DEG, STANDARD_GRAVITY
from .gyro_offset import FELT

_BESIDE = 5
"""Windows before and after the one that is looked at: a second in all."""

_USUAL = 0.9
"""Share of the quiet windows that are taken for still: the rest may be shocks, or turns too slow to
be told beforehand. A judgement."""

_MARGIN = 3.0
"""Three times what nine windows of ten keep to is over six standard deviations of normal noise:
once in many hours a window of a unit at rest lies beyond."""

_LEAN = 1.0 * DEG * STANDARD_GRAVITY
"""A hand leans by a degree within a hold, m/s^2; more is another attitude."""

_TURN_RATE = 5.0 * DEG
"""Mean over a second from which on it is a turn, rad/s: five degrees are more than any hold leans,
however it trembles. Published sessions by hand pass it within 0.2 s of their turns' beginning."""

_MOST_RATE = 20.0 * DEG
"""rad/s: what trembles more is not held still."""
_MOST_FORCE = 0.3 * STANDARD_GRAVITY
"""What swings by more is not held: two degrees in a tenth of a second, of which its mean does not
tell a tenth any more."""


@dataclass(frozen=True)
class RestTolerance:
    """How far the mean of a tenth of a second may stray at rest, in each axis.

    Attributes:
        rate: From what the gyros read at rest, rad/s.
        force: From what the accelerometers read as the rest began, m/s^2.
        usual: By how much rates of nine windows of ten stray from the second around, rad/s.
    """

    rate: float = FELT
    force: float = _LEAN
    usual: float = 0.0

    @classmethod
    def of(
        cls, means: Floats, offset: Floats, spread: float = FELT, step: Floats | None = None
    ) -> RestTolerance:
        """Learn it from the quiet seconds among windows that follow each other.

        What counts is how rates stray from the second around them, and forces from one window to
        the next: a turn at an even rate strays no more than a dwell, however slow it is.

        Args:
            means: (n, 6) means of windows of a tenth of a second, rad/s and m/s^2.
            offset: (3,) what the gyros read at rest, rad/s.
            spread: By how much that differs from one attitude to another, rad/s.
            step: (2,) the size of a count of gyros and accelerometers, rad/s and m/s^2.
        """
        width = 2 * _BESIDE + 1
        least = np.zeros(2) if step is None else step
        plain = cls(spread + float(least[0]), _LEAN + float(least[1]), float(least[0]))
        if len(means) < width:
            return plain
        around = np.lib.stride_tricks.sliding_window_view(means[:, :3], width, axis=0).mean(axis=2)
        turned = (np.abs(around - offset) > _TURN_RATE).any(axis=1)
        # A turn that begins soon is within the seconds beside.
        quiet = np.convolve(turned, np.ones(width))[_BESIDE:-_BESIDE] == 0
        if np.count_nonzero(quiet) < width:
            return plain
        inner = slice(_BESIDE, len(means) - _BESIDE)
        shaken = np.abs(means[inner, :3] - around)[quiet]
        # Of two windows with noise of their own.
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
