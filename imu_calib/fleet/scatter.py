"""Common properties of the units of a type: scatter of sessions, and how it differs by unit.

A session's variance is f (v + t): v as stated, t the typical variance between sessions of the type,
and f a factor of the unit, near one. Over the units of a type f has a scaled inverse chi-square
distribution: other units add degrees of freedom to a unit with few sessions. Source: Smyth 2004
(moderated t), estimated robustly; docs/history.md, 'Units borrow from each other'.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from ..common.stream import Floats
from .lines import fit

FEWEST_UNITS = 10
"""Smallest number of units with their own scatter for a distribution over the units of a type:
fewer determine it no better than the scatter of one."""
_SAMPLE = 400
"""Most units used for it: more change it by less than a tenth of its width."""
_HALVINGS = 50
"""Bisections of a bracket of twelve decades on a logarithmic scale: down to rounding."""
_MIDDLE, _QUARTER = 0.5, 0.25
"""Median of a uniform number, and its mean distance from it."""
_QUARTER_STD = 0.144
"""Standard deviation of the distance of a uniform number from a half: the square root of 1 / 48."""
_ERRORS = 2.0
"""Standard errors by which the similarity of units is taken below its best estimate (see
`_law`)."""
_D0_HALVINGS = 20
"""Steps of a logarithmic bracket of d0: to 1e-5 of it, far below its own uncertainty."""
_EFFICIENCY = 0.5
"""Efficiency of a median of variances relative to their mean: 0.53 with three degrees of freedom
each."""
_RANGE = 1e6
"""Range of the search for variances between sessions, relative to those of all: below it, they are
zero."""


@dataclass(frozen=True, eq=False)
class Prior:
    """Prior of a type, (24,) each.

    Attributes:
        between: Variance between sessions, t.
        scale: Typical f.
        freedom: Degrees of freedom of the prior; 0 with too few units.
    """

    between: Floats
    scale: Floats
    freedom: Floats

    def moderated(self, square: Floats, freedom: Floats) -> tuple[Floats, Floats]:
        """Return f (..., 24) of units, and its degrees of freedom.

        Args:
            square: (..., 24) sums of squares, weighted by 1 / (v + t).
            freedom: (..., 24) degrees of freedom of these.
        """
        whole = self.freedom + freedom
        square = self.freedom * self.scale + square
        return np.divide(square, whole, out=np.full(square.shape, np.nan), where=whole > 0), whole


def sampled(count: int) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Return the indices of units used for the distribution, evenly spaced among `count`."""
    return np.unique(np.linspace(0, count - 1, min(count, _SAMPLE)).astype(np.int64))


def prior_of(design: Floats, stated: Floats, values: Floats) -> Prior:
    """Return the common properties of the units of a type.

    Args:
        design: (u, 24, n, p) of units' lines.
        stated: (u, 24, n) variances; infinite for sessions that do not count.
        values: (u, 24, n).
    """
    between = _typical(design, stated, values)
    weights = 1 / np.maximum(stated + between[:, None], np.finfo(float).tiny)
    weights = np.where(np.isfinite(stated), weights, 0.0)
    at = fit(design, weights, values)
    return Prior(between, *_law(at.square, at.freedom.astype(float)))


def _typical(design: Floats, stated: Floats, values: Floats) -> Floats:
    """Return the variance between sessions (24,), by the median of units.

    At it half of the units' chi-squares are above their median. A unit with a step counts as one
    that is above, whatever the size of the step.
    """
    plain = fit(design, np.isfinite(stated).astype(float), values)
    own = plain.freedom > 0
    freedom = np.maximum(plain.freedom, 1).astype(float)
    each = np.where(own, plain.square / freedom, np.nan)
    some = own.any(axis=0)
    high = np.where(some, np.nanmax(np.where(some, each, 1.0), axis=0, initial=0.0), 0.0)
    low = high / _RANGE**2

    def above(at: Floats) -> Floats:
        weights = np.where(np.isfinite(stated), 1 / (stated + at[:, None]), 0.0)
        chance = scipy.special.chdtr(freedom, fit(design, weights, values).square)
        return np.asarray(np.sum(np.where(own, chance - _MIDDLE, 0.0), axis=0))

    high, low = np.maximum(high, np.finfo(float).tiny), np.maximum(low, np.finfo(float).tiny)
    for _ in range(_HALVINGS):
        middle = np.sqrt(high) * np.sqrt(low)
        too_small = above(middle) > 0
        low, high = np.where(too_small, middle, low), np.where(too_small, high, middle)
    least = np.nanmedian(np.where(some, each, 1.0), axis=0) / _RANGE
    return np.where(some & (high > least), high, 0.0)


def _law(square: Floats, freedom: Floats) -> tuple[Floats, Floats]:
    """Return scale and degrees of freedom (24,) of the distribution over units, by quantiles.

    f / scale has an F distribution with (d, d0) degrees of freedom. One d0 is estimated for all
    parameters, from the distances of the values from their median: on average a quarter in
    probability. It is set two standard errors below its best estimate, because an underestimated
    similarity of units reduces power, and an overestimated one causes false alarms. It is at most
    half the degrees of freedom of all units together: the scale is known no better.

    Args:
        square: (u, 24) weighted sums of squares.
        freedom: (u, 24) their degrees of freedom.
    """
    own = (freedom > 0) & (square > 0)
    judged = np.flatnonzero(own.sum(axis=0) >= FEWEST_UNITS)
    scale, worth = np.ones(own.shape[1]), np.zeros(own.shape[1])
    if not len(judged):
        return scale, worth
    each = [(square[own[:, k], k] / freedom[own[:, k], k], freedom[own[:, k], k]) for k in judged]
    count = sum(len(d) for _, d in each)
    allowed = _QUARTER - _ERRORS * _QUARTER_STD / np.sqrt(count)

    def wider(d0: float) -> bool:
        away = [np.abs(scipy.special.fdtr(d, d0, f / _scale(f, d, d0)) - _MIDDLE) for f, d in each]
        return bool(np.mean(np.concatenate(away)) > allowed)

    most = [max(1.0, _EFFICIENCY * float(np.sum(d))) for _, d in each]
    low, high = 1.0, max(most)
    if wider(high):
        for _ in range(_D0_HALVINGS):
            middle = np.sqrt(low * high)
            low, high = (low, middle) if wider(middle) else (middle, high)
    worth[judged] = np.minimum(high, most)
    scale[judged] = [_scale(f, d, w) for (f, d), w in zip(each, worth[judged], strict=True)]
    return scale, worth


def _scale(each: Floats, freedom: Floats, d0: float) -> float:
    """Return the scale at which half of the values are above the median."""
    return float(np.median(each / scipy.special.fdtri(freedom, d0, _MIDDLE)))
