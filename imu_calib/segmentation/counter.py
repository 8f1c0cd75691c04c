"""The mean rate of an accumulating, quantised counter that rides on a random walk.

A counter shows floor(true count). Between two readings the error of a difference is one of two
values, with variance c (1 - c) in pulses squared, c the fraction of the true difference: 1/6 on
average over phases, however long one waits (methods.md, section 11). A counter tells more than its
two end readings, and what more depends on how fast it runs against its own noise. Three estimators
share the work; each states the variance that it leaves.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..stream import Floats

END_POINT_VARIANCE = 1 / 6
"""Variance of the difference of two readings of a counter, pulses squared, mean over phases."""

_READING_VARIANCE = 1 / 12
_PASSAGES_NEEDED = 5
_DRIFT_SIGNIFICANCE = 6.0
_CYCLES_FOR_WHITE = 2.0


@dataclass(frozen=True)
class MeanRate:
    """A mean rate and what its variance is made of: walk_gain N^2 + quantum.

    Attributes:
        rate: Per second.
        walk_gain: Multiplies the squared random-walk coefficient, 1/s.
        quantum: Variance left by quantisation, rate squared.

    """

    rate: float
    walk_gain: float
    quantum: float

    def variance(self, walk: float) -> float:
        """Return the variance for a random-walk coefficient (per root second)."""
        return walk * walk * self.walk_gain + self.quantum


def mean_rate(pulses: Floats, period: float, walk: float) -> MeanRate:
    """Estimate the mean rate of a counter from its increments.

    Args:
        pulses: (n,) increments per sample, whole numbers.
        period: Sample interval, s.
        walk: Random-walk coefficient assumed for the choice and the weights, pulses/sqrt(s). A
            wrong one costs efficiency; the stated variance stays true to the weights used.

    Returns:
        The estimate with the smallest variance among those that are valid here, pulses/s.

    """
    # A whole number of pulses per sample carries no information on the fraction: without it, a
    # fast counter looks like the slow one that its readings drift against.
    whole = float(np.rint(pulses.mean()))
    remainder = pulses - whole
    options = [
        end_points(remainder, period),
        first_passages(remainder, period, walk),
        smoothed_ends(remainder, period, walk),
    ]
    best = min((o for o in options if o is not None), key=lambda o: o.variance(walk))
    return MeanRate(best.rate + whole / period, best.walk_gain, best.quantum)


def end_points(pulses: Floats, period: float) -> MeanRate:
    """Estimate from the first and the last reading alone: the plain sum over the duration."""
    duration = len(pulses) * period
    return MeanRate(float(pulses.sum()) / duration, 1 / duration, END_POINT_VARIANCE / duration**2)


def first_passages(pulses: Floats, period: float, walk: float) -> MeanRate | None:
    """Estimate from the moments when the counter first reached a new value.

    At a first passage the true count is a whole number, known to the fraction of a pulse that
    one sample adds. Passage times of a drifting Brownian motion have independent increments, so
    levels passed over time elapsed is the maximum-likelihood drift (the inverse Gaussian law:
    Folks and Chhikara 1978, J. R. Statist. Soc. B 40, 263), with the walk's variance alone.

    Returns:
        None where the drift does not clearly lead the walk, or passes too few levels.

    """
    count = np.cumsum(pulses)
    drift = float(count[-1]) / len(pulses)
    if abs(drift) * math.sqrt(len(pulses)) < _DRIFT_SIGNIFICANCE * walk * math.sqrt(period):
        return None
    record = np.maximum.accumulate(count * math.copysign(1.0, drift))
    passed = np.flatnonzero(np.diff(record, prepend=0.0) > 0)
    if len(passed) <= _PASSAGES_NEEDED:
        return None
    first, last = int(passed[0]), int(passed[-1])
    duration = (last - first) * period
    rate = math.copysign(float(record[last] - record[first]) / duration, drift)
    return MeanRate(rate, 1 / duration, 2 * drift**2 * _READING_VARIANCE / duration**2)


def smoothed_ends(pulses: Floats, period: float, walk: float) -> MeanRate | None:
    """Estimate by generalised least squares with white reading errors of variance 1/12.

    Increments then have a tridiagonal covariance, whose inverse gives weights that are flat in
    the middle and fade out towards both ends over the time in which the walk grows as large as
    the reading error: w_k = 1 - cosh(kappa (k - m)) / cosh(kappa m), m = (n + 1) / 2,
    2 cosh(kappa) = 2 + 12 walk^2 period.

    Returns:
        None where the reading errors are not white over that time: too few pulses pass in it.

    """
    growth = walk * walk * period / _READING_VARIANCE
    if growth <= 0:
        return None
    kappa = math.acosh(1 + growth / 2)
    if abs(float(pulses.mean())) < _CYCLES_FOR_WHITE * kappa:
        return None
    n = len(pulses)
    k = np.arange(1, n + 1)
    fade = (np.exp(-kappa * k) + np.exp(-kappa * (n + 1 - k))) / (1 + math.exp(-kappa * (n + 1)))
    weights = 1 - fade
    total = float(weights.sum()) * period
    steps = np.diff(weights, prepend=0.0, append=0.0)
    return MeanRate(
        float(weights @ pulses) / total,
        period * float(weights @ weights) / total**2,
        _READING_VARIANCE * float(steps @ steps) / total**2,
    )
