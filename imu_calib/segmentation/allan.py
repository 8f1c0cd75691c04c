"""Overlapping Allan variance of static dwells, pooled, with its covariance.

The Allan variance of a rate at averaging time tau is the mean square of second differences of its
integral, d = x(t + 2 tau) - 2 x(t + tau) + x(t), over 2 tau^2 (Allan 1966; IEEE Std 952-1997,
annex C). Sums over static dwells add up, so that a dwell is reduced to a few dozen numbers and its
samples can be dropped.

Noise is described by four coefficients, the squares of IEEE Std 952's: quantisation Q (slope -1),
random walk N (-1/2), bias instability B (flat, at 0.664 B) and rate random walk K (+1/2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..common.stream import Floats

_OVERLAP = 16  #: Clusters overlap by 15 of 16 parts.
_LEAST_CLUSTERS = 3  #: A second difference takes three.
_FAR_TIME = 4  #: Octaves: the covariance of variances further apart is negligible.
_REACH = 4  #: Cluster lengths: the covariance of second differences further apart is negligible.
HARMONICS = 64  #: Harmonics of a counter's sawtooth: the others hold one percent of its variance.


class Term(IntEnum):
    """A kind of noise, in the order of every array of coefficients."""

    QUANTISATION = 0
    RANDOM_WALK = 1
    BIAS_INSTABILITY = 2
    RATE_RANDOM_WALK = 3


@dataclass(frozen=True, eq=False)
class AllanSums:
    """Sums of squared second differences of the integrals of some channels."""

    period: float  #: Sample interval, s.
    lengths: tuple[int, ...]  #: Samples of every gap-free run, in order.
    squares: Floats  #: (k, c) sums at 1, 2, 4, ... samples, in (rad)^2 or (m/s)^2.
    counts: NDArray[np.int64]  #: (k,) number of second differences in each sum.

    @property
    def taus(self) -> Floats:
        """Averaging times, (k,) s."""
        return self.period * cluster_sizes(len(self.counts))

    @property
    def variance(self) -> Floats:
        """Allan variances, (k, c), rate squared."""
        return np.asarray(self.squares / (2 * self.counts * self.taus**2)[:, None])


def second_differences(phase: Floats, clusters: int) -> tuple[float, int]:
    """Return the sum of squared second differences over `clusters` samples, and their number.

    Args:
        phase: (n + 1,) integral at the ends of n samples.
        clusters: Samples per cluster.
    """
    first = phase[clusters:] - phase[:-clusters]
    second = first[clusters:] - first[:-clusters]
    return float(np.einsum('i,i->', second, second)), len(second)


def cluster_sizes(rows: int) -> Floats:
    """Return 1, 2, 4, ... samples."""
    return np.asarray(np.exp2(np.arange(rows)), dtype=np.float64)


def stride(clusters: int) -> int:
    """Return the step between second differences: below 1/16, overlap adds no information."""
    return max(1, clusters // _OVERLAP)


def octaves(samples: int) -> int:
    """Return how many of 1, 2, 4, ... fit three times into a run."""
    return max(0, (samples // _LEAST_CLUSTERS).bit_length())


def allan_sums(runs: Sequence[Floats], period: float) -> AllanSums:
    """Sum second differences of runs without gaps.

    Args:
        runs: (n, c) increments each, rad or m/s.
        period: Sample interval, s.
    """
    channels = runs[0].shape[1]
    rows = max(octaves(len(run)) for run in runs)
    squares, counts = np.zeros((rows, channels)), np.zeros(rows, dtype=np.int64)
    for run in runs:
        for c in range(channels):
            column = run[:, c]
            # Second differences do not depend on the mean, but it would cost digits.
            phase = np.concatenate([[0.0], np.cumsum(column - column.mean())])
            for k in range(octaves(len(run))):
                if stride(1 << k) > 1:
                    phase = phase[::2].copy()
                total, count = second_differences(phase, (1 << k) // stride(1 << k))
                squares[k, c] += total
                counts[k] += count if c == 0 else 0
    return AllanSums(period, tuple(len(run) for run in runs), squares, counts)


def pooled(parts: Sequence[AllanSums]) -> AllanSums:
    """Add up the sums of several static dwells; the period is their mean."""
    rows = max(len(p.counts) for p in parts)
    squares = np.zeros((rows, parts[0].squares.shape[1]))
    counts = np.zeros(rows, dtype=np.int64)
    for part in parts:
        squares[: len(part.counts)] += part.squares
        counts[: len(part.counts)] += part.counts
    lengths = tuple(n for p in parts for n in p.lengths)
    weights = np.array([float(sum(p.lengths)) for p in parts])
    period = float(weights @ [p.period for p in parts] / weights.sum())
    return AllanSums(period, lengths, squares, counts)


def unit_variances(factors: Floats, period: float) -> Floats:
    """Return the Allan variances (k, 4) for squared coefficients of 1.

    Args:
        factors: (k,) cluster sizes, samples.
        period: s.
    """
    each = _covariances(factors, factors, np.zeros(1), period)[:, :, 0]
    return np.asarray(each.T / (2 * (factors * period) ** 2)[:, None])


def spread(rows: int, lengths: tuple[int, ...], period: float, squares: Floats) -> Floats:
    """Return the covariance (k, k) of pooled Allan variances for noise of given coefficients.

    The second differences are Gaussian, so the covariance of two sums of squares is twice the sum
    of the squared covariances of their terms (Greenhall and Riley 2003, "Uncertainty of stability
    variances based on finite differences", from the generalised autocovariance of each kind of
    noise). For clusters that differ by more than a factor of 16 it is negligible.

    Args:
        rows: Number k of cluster sizes: 1, 2, 4, ... samples.
        lengths: Samples of every run.
        period: s.
        squares: (4,) squared coefficients.
    """
    return np.asarray(np.einsum('i,j,ijkl->kl', squares, squares, _forms(rows, lengths, period)))


@lru_cache(maxsize=4)
def _forms(rows: int, lengths: tuple[int, ...], period: float) -> Floats:
    """Return the covariances as quadratic forms (4, 4, k, k) of the squared coefficients."""
    runs = np.array(lengths, dtype=float)
    forms = np.zeros((len(Term), len(Term), rows, rows))
    for a in range(rows):
        for b in range(a, min(rows, a + _FAR_TIME + 1)):
            forms[:, :, a, b] = forms[:, :, b, a] = _shared(1 << a, 1 << b, runs, period)
    return forms


def _shared(small: int, large: int, runs: Floats, period: float) -> Floats:
    """Return the covariance of the Allan variances at two cluster sizes as a form (4, 4)."""
    step, coarse = stride(small), stride(large)
    reach = _REACH * (small + large)
    # The lag is from the start of a small second difference to the start of a large one.
    lag = np.arange(-reach, reach + 1, step, dtype=float)
    terms = _covariances(np.array([small]), np.array([large]), lag, period)[:, 0]
    starts_small, starts_large = runs[runs >= 2 * small], runs[runs >= 2 * large]
    pairs = np.zeros(len(lag))
    for length, times in zip(*np.unique(starts_large, return_counts=True), strict=True):
        first = np.maximum(0.0, -lag)
        last = np.minimum(length - 2 * large, length - 2 * small - lag)
        pairs += times * np.where(last >= first, (last - first) // coarse + 1, 0.0)
    counts = np.sum((starts_small - 2 * small) // step + 1) * np.sum(
        (starts_large - 2 * large) // coarse + 1
    )
    scale = 4.0 * (small * period) ** 2 * (large * period) ** 2 * counts
    return np.asarray(2 * (terms * pairs) @ terms.T / scale)


def _covariances(small: Floats, large: Floats, lag: Floats, period: float) -> Floats:
    """Return the covariances (4, k, l) of second differences at k sizes and l lags."""
    weights = (1.0, -2.0, 1.0)
    total = np.zeros((len(Term), len(small), len(lag)))
    for a, left in enumerate(weights):
        for b, right in enumerate(weights):
            apart = np.abs(lag + (b * large - a * small)[:, None])
            total += left * right * _autocovariances(apart, period)
    return total


def _autocovariances(apart: Floats, period: float) -> Floats:
    """Return the generalised autocovariances of the integral, for coefficients of 1.

    Up to polynomials, which second differences cancel: those of white phase, of Brownian motion, of
    flicker rate with S(f) = B^2 / (2 pi f), and of integrated Brownian motion.
    """
    logarithm = np.log(np.where(apart > 0, apart, 1.0))
    return np.array(
        [
            apart == 0,
            -period * apart / 2,
            period**2 * apart**2 * logarithm / (2 * np.pi),
            period**3 * apart**3 / 12,
        ]
    )


def counter_share(pulses: float, growth: float, factors: Floats) -> Floats:
    """Return the mean square second difference (k,) from the steps of a counter, pulses^2.

    The error of a counter of unknown phase is a sawtooth of its true count, a sum of harmonics that
    keep their phase until the walk has smeared it. It is uncorrelated with the walk itself: for any
    path, its mean over all phases is zero. (`counters._faded_error`, has the same series.)

    Args:
        pulses: Mean count per sample.
        growth: Variance that the walk adds per sample, pulses^2.
        factors: (k,) cluster sizes, samples.
    """
    h = np.arange(1, HARMONICS + 1)[:, None]

    def covariance(apart: Floats) -> Floats:
        phase = np.cos(2 * np.pi * h * np.mod(pulses * apart, 1.0))
        kept = np.exp(-2 * np.pi**2 * growth * h**2 * apart)
        return np.asarray((phase * kept / (2 * np.pi**2 * h**2)).sum(axis=0))

    # Counts per sample that are whole up to rounding would lose their fraction's sign.
    return np.asarray(6 / 12 - 8 * covariance(factors) + 2 * covariance(2 * factors))
