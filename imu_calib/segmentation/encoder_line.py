"""Angles of an encoder at constant rate: a line through them, and the size of their steps.

Source: docs/mathematics.md, 'Rate test'.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from ..common.stream import Floats
from ..common.units import DEG

FEWEST = 6
"""Fewest angles of a line: four coefficients are fitted to a seed, and two degrees of freedom
remain for the scatter."""
_LEAVES = 6.0
"""Standard deviations off the line at which the plateau ends: exceeded twice in 10^9 by normal
noise, which rarely ends a plateau too early (docs/mathematics.md, 'Rate test')."""
_ENCODER = 1e-3 * DEG
"""Least significant departure, rad. A judgement: 3.6 arcsec for an encoder's error within the turn,
which the encoder does not state."""
_COARSEST = 0.2 * DEG
"""Largest step taken for that of an encoder, rad: 11 bits a turn, coarser than any in
calibration."""
_CORNERS = 20
"""Readings at which the gain of a smooth motion changes, at most: three at each corner of the rate,
of which a motion of three ramps has six."""
_SHORT_RAMPS = 32
"""Readings on ramps up to which steps may show at corners alone. A judgement: of so many coarse
readings on ramps, two in three change the gain."""
_EXACTLY = 2e-3
"""Of a step: deviation from whole steps by which readings of a coarse encoder may differ. A
judgement: radians of six digits are rounded by a thousandth of 0.05 deg, and the step itself is
estimated with the same error."""
_LOST = 1.5
"""Of the interval of joint states: a longer one lacks some, and its differences are not used."""
_FINELY = 1e-6
"""Resolution of the search for a slope, of its interval: sufficient for a standard deviation."""
_BLOCKS = 16
"""Blocks of the angles of a line, whose means show correlated errors (docs/mathematics.md, 'Rate
test')."""
_SIGNIFICANT = 1e-3
"""Chance that means of blocks of white noise scatter by more: for one line in a thousand the stated
uncertainty is too large."""
_SAME_READING = 1e-9
"""Readings that are closer are the same one, rad: numbers near 100 turns are rounded to 1e-13, and
an encoder of 32 bits steps by 1.5e-9."""
_NEAR = 20.0
"""Differences up to so many times the least are compared with whole steps: half a percent of error
of the least difference makes a tenth of a step of it there, which is `_WHOLE`."""
_SHARES = (1, 2, 3)
"""The smallest difference seen may be so many steps."""
_WHOLE = 0.1
"""Of a step: tolerance for a difference to be a whole number of them. Six differences are so by
chance with a probability of 0.2^6 = 6e-5."""
_SMOOTHED_SECONDS = 0.1
"""Longest time over which departures are averaged, s: longer hides the onset of fast ramps. A
judgement: a ramp of 20 deg/s^2 departs by 0.1 deg in it."""


@dataclass(frozen=True)
class Line:
    """A line by least squares.

    Attributes:
        count: Number of angles.
        time: Their mean, s.
        spread: Sum of the squares of their distances from it, s^2.
        angle: At that time, rad.
        slope: rad/s.
        slope_std: Its standard deviation, rad/s.
        step: Of the encoder, rad, as far as it is known.
        noise: Scatter of the angles about it, rad.
        smoothed: Number of angles over which a departure is averaged: as many as make the noise
            small.
    """

    count: int
    time: float
    spread: float
    angle: float
    slope: float
    slope_std: float
    step: float
    noise: float
    smoothed: int

    @classmethod
    def through(cls, time: Floats, angle: Floats, step: float) -> Line:
        """Fit (n,) angles, rad, at (n,) times, s.

        Errors that are correlated for a while (an encoder's error that repeats with the turn) do
        not average like noise: the means of blocks scatter by more, and their scatter gives the
        uncertainty of the slope.
        """
        n, middle, mean = len(time), float(time.mean()), float(angle.mean())
        centred = time - middle
        spread = float(centred @ centred)
        slope = float(centred @ (angle - mean)) / spread
        residuals = angle - mean - slope * centred
        noise = float(np.sqrt(residuals @ residuals / max(1, n - 2)))
        within = _SMOOTHED_SECONDS * (n - 1) / float(time[-1] - time[0])
        departure = max(step, _ENCODER)
        smoothed = int(np.clip((_LEAVES * noise / departure) ** 2, 1, max(1.0, within)))
        slope_std = float(np.sqrt(_variance(residuals, noise**2) / spread))
        return cls(n, middle, spread, mean, slope, slope_std, step, noise, smoothed)

    def limit(self, time: Floats) -> Floats:
        """Return the largest departure of a mean of some angles by chance, (n,) rad."""
        own = 1 / self.smoothed + 1 / self.count + (time - self.time) ** 2 / self.spread
        return np.asarray(_LEAVES * self.noise * np.sqrt(own) + max(self.step, _ENCODER))

    def departure(self, time: Floats, angle: Floats) -> Floats:
        """Return the departure of (n,) angles from the line, in units of `limit`."""
        residuals = angle - self.angle - self.slope * (time - self.time)
        if self.smoothed > 1:
            window = np.ones(self.smoothed)
            around = np.convolve(np.ones(len(residuals)), window, mode='same')
            residuals = np.convolve(residuals, window, mode='same') / around
        return np.asarray(np.abs(residuals) / self.limit(time))


def _variance(residuals: Floats, white: float) -> float:
    """Return the variance of angles: that of noise, unless their blocks show more."""
    length = len(residuals) // _BLOCKS
    if length < 2 or not white:
        return white
    means = residuals[: length * _BLOCKS].reshape(_BLOCKS, length).mean(axis=1)
    freedom = _BLOCKS - 2
    ratio = length * float(means @ means) / freedom / white
    return white * ratio if scipy.special.chdtrc(freedom, freedom * ratio) < _SIGNIFICANT else white


def encoder_step(time: Floats, angle: Floats) -> float:
    """Return the step of the encoder, rad, where its readings show one; else 0.

    Angles may differ by whole numbers of a step because ramp rates are round: one of 200 deg/s^2
    read at 100 Hz gains 0.02 deg more each time. Steps make gains go up and down while the table
    accelerates; a smooth motion does not, even if its angles look coarse. Ramps of a few readings
    do not show that: there readings must differ by whole steps exactly.

    Source: docs/mathematics.md, 'Rate test'.
    """
    step = _step(angle)
    if not step:
        return 0.0
    apart = np.diff(time)
    four = np.lib.stride_tricks.sliding_window_view(apart < _LOST * np.median(apart), 3).all(axis=1)
    gains = np.diff(angle, 2)
    changes = np.count_nonzero(np.abs(np.diff(gains))[four] > step / 2)
    if changes > _CORNERS:
        return step
    ramps = np.count_nonzero(np.abs(gains[1:])[four] > step / 2)
    if ramps > _SHORT_RAMPS or changes < FEWEST:
        return 0.0
    steps = np.abs(np.diff(angle)) / step
    steps = steps[steps < _NEAR]
    # The error of the step is as large, and is multiplied so many times.
    exact = np.abs(steps - np.rint(steps)) < _EXACTLY * np.maximum(steps, 1.0)
    return step if exact.all() else 0.0


def _step(angle: Floats) -> float:
    """Return the step, rad, of which differences of close angles are multiples; 0 if none."""
    apart = np.diff(np.sort(angle))
    apart = apart[apart > _SAME_READING]
    least = float(apart.min(initial=_COARSEST))
    near = apart[apart < _NEAR * least]
    if least >= _COARSEST or len(near) < FEWEST:
        return 0.0
    for share in _SHARES:
        steps = near * share / least
        if np.all(np.abs(steps - np.rint(steps)) < _WHOLE):
            return least / share
    return 0.0


def hidden_by_steps(line: Line, time: Floats, angle: Floats) -> float:
    """Return the standard deviation of a line's slope by the encoder's steps alone, rad/s.

    Where samples are nearly synchronous with the steps, all readings have the same error for long:
    the scatter does not show it. The slope is known only to the extent that some line of it comes
    within half a step of all readings; all such offsets are equally likely. 0 where readings
    scatter by more than steps do: the scatter then shows it.

    Source: docs/mathematics.md, 'Rate test'.
    """
    # Readings within one step scatter by half of it at most.
    if line.noise > line.step:
        return 0.0
    apart = time - line.time
    residuals = angle - line.angle - line.slope * apart

    def spread(slope: float) -> float:
        return float(np.ptp(residuals - slope * apart))

    # Convex in the slope: find its minimum, then the points one step higher on either side.
    reach = 2 * line.step / float(np.ptp(time))
    best = scipy.optimize.minimize_scalar(
        spread, bounds=(-reach, reach), method='bounded', options={'xatol': _FINELY * reach}
    ).x
    if spread(best) > line.step:
        return 0.0
    ends = [
        scipy.optimize.brentq(lambda slope: spread(slope) - line.step, best, best + outside)
        for outside in (-2 * reach, 2 * reach)
    ]
    # Standard deviation over an interval with one offset at its ends and most in its middle.
    return float(np.hypot(np.mean(ends), (ends[1] - ends[0]) / np.sqrt(24)))
