"""The mean rate of an accumulating, quantised counter with a random walk.

A counter shows floor(true count). Between two readings the error of a difference is one of two
values, with variance c (1 - c) in pulses squared, c the fraction of the true difference: 1/6 on
average over phases, for any duration (docs/mathematics.md, 'Noise of a mean'). The readings between
both ends hold more information; how much depends on the rate against the noise. Three estimators
are used, each with its own variance; the one with the smallest expected variance is taken.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, reduce
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.stream import Floats
from .allan import HARMONICS

END_POINT_VARIANCE = 1 / 6
"""Variance of the difference of two readings of a counter, pulses squared, the mean of p (1 - p)
over phases."""

READING_VARIANCE = 1 / 12
"""Variance of a reading in whole pulses, pulses squared: uniform over one."""
_PASSAGES_NEEDED = 3  #: Of levels: two ends and one to check them.
_LEVELS_NEEDED = 4.0  #: Levels between the ends: fewer are within the noise of a counter at rest.
_FAR = 5.0  #: Standard deviations of the walk before the first and after the last passage.
_DRIFT_SIGNIFICANCE = 6.0
"""Standard deviations: slower drifts are reversed by the walk and have no passages."""
_ORDERS = np.arange(1, HARMONICS + 1)  #: Of the harmonics.
_POWERS = 1 / (2 * np.pi**2 * _ORDERS**2)  #: Of the harmonics, pulses squared.
_FADED_OUT = 37.0  #: Exponent: e^-37 is the resolution of a double.
_FADED_AWAY = 12.0  #: Exponent: e^-12 is 6e-6 of a weight.
_WIDEST_WINDOW = 256.0  #: Samples at each end: wider windows do not reduce the walk between.


@dataclass(frozen=True)
class MeanRate:
    """A mean rate and its variance: walk_gain N^2 + quantisation_variance."""

    rate: float  #: Per second.
    walk_gain: float  #: Multiplies the squared random-walk coefficient, 1/s.
    quantisation_variance: float  #: Variance left by quantisation, rate squared.

    def variance(self, walk: float) -> float:
        """Return the variance for a random-walk coefficient (per root second)."""
        return walk * walk * self.walk_gain + self.quantisation_variance

    def scaled(self, pulse: float) -> MeanRate:
        """Return a rate in pulses per second in the unit of a pulse."""
        return MeanRate(self.rate * pulse, self.walk_gain, self.quantisation_variance * pulse**2)


def mean_rate(pulses: Floats, period: float, walk: float) -> MeanRate:
    """Estimate the mean rate of a counter from its increments.

    Args:
        pulses: (n,) increments per sample, whole numbers.
        period: Sample interval, s.
        walk: Random-walk coefficient assumed for the choice and the weights, pulses/sqrt(s). A
            wrong one costs efficiency; the stated variance remains that of the weights used.

    Returns:
        The estimate with the smallest expected variance at such a rate, pulses/s.
    """
    return _mean_and_passages(pulses, period, walk)[0]


def _mean_and_passages(
    pulses: Floats, period: float, walk: float
) -> tuple[MeanRate, Passages | None]:
    """Return `mean_rate`, and the first passages if it is estimated from them.

    A whole number of pulses per sample has no information on the fraction: once subtracted, a fast
    counter behaves like a slow one. The passages are those of what remains.
    """
    whole = float(np.rint(pulses.mean()))
    remainder = pulses - whole
    other = _by_all_samples(remainder, period, walk)
    found = passages(remainder, period, walk)
    best = found and best_passages(found.rate(period), remainder, period, walk, other)
    mean = best or other
    return replace(mean, rate=mean.rate + whole / period), found if best else None


def best_passages(
    passed: MeanRate, pulses: Floats, period: float, walk: float, other: MeanRate | None = None
) -> MeanRate | None:
    """Return the estimate from first passages where it is the best at such a rate, else None.

    The choice depends on the rate that passages give and on their mean variance at that rate, not
    on how many passages there were. Their number depends on the phase at the segment's start:
    switching to another estimator where it is small would bias the choice.

    Args:
        passed: The estimate from first passages.
        pulses: (n,) pulses per sample.
        period: Sample interval, s.
        walk: Random walk, pulses/sqrt(s).
        other: The estimate from all samples; computed if not given.
    """
    whole = len(pulses) * period
    levels = abs(passed.rate) * whole
    # Ringing passes levels and counts back. Otherwise the two ends give the passages' rate, but for
    # a pulse and the walk before the first and after the last.
    unseen = max(0.0, whole - 1 / passed.walk_gain)
    astray = abs(levels - abs(float(pulses.sum()))) - 1 > _FAR * walk * math.sqrt(unseen)
    if levels < _LEVELS_NEEDED or astray:
        return None
    # One level is lost: partly before the first passage, partly after the last.
    duration = (1 - 1 / levels) * whole
    timing = 2 * (passed.rate * period) ** 2 * READING_VARIANCE / duration**2
    expected = MeanRate(passed.rate, 1 / duration, timing).variance(walk)
    other = other or _by_all_samples(pulses, period, walk)
    return passed if expected < other.variance(walk) else None


def _by_all_samples(pulses: Floats, period: float, walk: float) -> MeanRate:
    """Return the better of smoothed and plain ends."""
    plain, smoothed = end_points(pulses, period), smoothed_ends(pulses, period, walk)
    if smoothed is None:
        return plain
    return min(plain, smoothed, key=lambda found: found.variance(walk))


def end_points(pulses: Floats, period: float) -> MeanRate:
    """Estimate from the first and the last reading alone: the sum over the duration.

    Args:
        pulses: (n,) pulses per sample.
        period: Sample interval, s.
    """
    duration = len(pulses) * period
    return MeanRate(float(pulses.sum()) / duration, 1 / duration, END_POINT_VARIANCE / duration**2)


@dataclass(frozen=True, eq=False)
class Passages:
    """When a counter first reached new values."""

    index: NDArray[np.intp]  #: Of the samples.
    level: Floats  #: The values, without sign.
    drift: float  #: Pulses per sample.

    def rate(self, period: float, first: int = 0, last: int = -1) -> MeanRate:
        """Estimate the mean rate from one passage to another.

        At a first passage the true count is a whole number, known to the fraction of a pulse that
        one sample adds. Passage times of a drifting Brownian motion have independent increments, so
        levels passed over time elapsed is the maximum-likelihood drift (the inverse Gaussian law:
        Folks and Chhikara 1978, J. R. Statist. Soc. B 40, 263), with the walk's variance alone.
        """
        duration = float(self.index[last] - self.index[first]) * period
        passed = float(self.level[last] - self.level[first])
        timing = 2 * self.drift**2 * READING_VARIANCE / duration**2
        return MeanRate(math.copysign(passed / duration, self.drift), 1 / duration, timing)


def passages(pulses: Floats, period: float, walk: float) -> Passages | None:
    """Find the first passages; None unless the drift clearly exceeds the walk.

    Args:
        pulses: (n,) pulses per sample.
        period: Sample interval, s.
        walk: Random walk, pulses/sqrt(s).
    """
    drift = float(pulses.sum()) / len(pulses)
    if abs(drift) * math.sqrt(len(pulses)) < _DRIFT_SIGNIFICANCE * walk * math.sqrt(period):
        return None
    count = np.cumsum(pulses)
    record = np.maximum.accumulate(count if drift >= 0 else -count)
    index = np.flatnonzero(record[1:] > record[:-1]) + 1
    if record[0] > 0:
        index = np.concatenate([[0], index])
    return Passages(index, record[index], drift) if len(index) >= _PASSAGES_NEEDED else None


def smoothed_ends(pulses: Floats, period: float, walk: float) -> MeanRate | None:
    """Estimate with weights that are optimal against white reading errors of variance 1/12.

    Increments then have a tridiagonal covariance, whose inverse gives weights that are flat in the
    middle and fade out towards both ends over the time in which the walk grows as large as the
    reading error: w_k = 1 - cosh(kappa (k - m)) / cosh(kappa m), m = (n + 1) / 2, 2 cosh(kappa) = 2
    + 12 walk^2 period. The stated variance is that of these weights against the actual reading
    error (`_faded_error`).

    Returns:
        None without a walk.
    """
    growth = walk * walk * period / READING_VARIANCE
    if growth <= 0:
        return None
    kappa = math.acosh(1 + growth / 2)
    n = len(pulses)
    reach = min(n, math.ceil(_FADED_OUT / kappa))
    if 2 * reach < n:
        # Both fades vanish before they meet: the middle has weight one and needs no computation.
        fade, faded, square = _fade(kappa, reach)
        lost = float(fade @ pulses[:reach]) + float(fade @ pulses[: -reach - 1 : -1])
        weighted = float(pulses.sum()) - lost
        total = (n - 2 * faded) * period
        squares = n - 4 * faded + 2 * square
    else:
        k = np.arange(1, n + 1)
        fade = np.exp(-kappa * k) + np.exp(-kappa * (n + 1 - k))
        weights = 1 - fade / (1 + math.exp(-kappa * (n + 1)))
        weighted = float(weights @ pulses)
        total = float(weights.sum()) * period
        squares = float(weights @ weights)
    error = 2 * _faded_error(float(pulses.mean()), math.exp(-kappa), walk * walk * period)
    return MeanRate(weighted / total, period * squares / total**2, error / total**2)


# A session has two random walks as long as they are those stated: gyros and accelerometers.
@lru_cache(maxsize=16)
def _fade(kappa: float, reach: int) -> tuple[Floats, float, float]:
    """Return exp(-kappa k) for k from 1 to `reach`, (reach,), its sum and that of its squares."""
    fade = np.exp(-kappa * np.arange(1, reach + 1))
    return fade, float(fade.sum()), float(fade @ fade)


def _faded_error(step: float, fade: float, growth: float) -> float:
    """Return the variance of a reading error averaged with weights (1 - fade) fade^k.

    The error of a counter of uniform phase is a sawtooth of its true count x, a sum over m of
    sin(2 pi m x) / (pi m). While x advances by `step` and diffuses by `growth` per sample, its
    harmonics keep their phase for a while: covariance at lag j is the sum over m of
    Re(z^j) / (2 pi^2 m^2) with z = exp(2 pi i m step - 2 pi^2 m^2 growth).
    """
    z = np.exp(_phases(step, growth))
    alone = (1 - fade) / (1 + fade)
    together = alone * ((1 + fade * z) / (1 - fade * z)).real
    return float(_POWERS @ together) + (READING_VARIANCE - float(_POWERS.sum())) * alone


def _phases(step: float, growth: float) -> NDArray[np.complex128]:
    """Return log z of the first harmonics of a reading error (see `_faded_error`)."""
    turns = 2j * np.pi * _ORDERS * step - 2 * np.pi**2 * _ORDERS**2 * growth
    return turns.astype(np.complex128)


def rate_between(pulses: Floats, period: float, first: float, last: float, walk: float) -> MeanRate:
    """Estimate the mean rate between two instants that fall within samples.

    The count at either instant is read from the samples around it, with the weights that are
    optimal against walk and white reading errors in a window of `reach` samples to either side:
    sinh(kappa (reach - |k - instant|)), kappa that of `smoothed_ends`. The window is as wide at
    both instants as the samples beyond the nearer end allow, so that one oscillation between the
    two still averages to zero. A window of one sample is linear interpolation. The rate refers to
    the instants on which the weights are centred.

    Args:
        pulses: (n,) increments per sample, whole numbers, at one rate.
        period: Sample interval, s.
        first: Start, in sample intervals after the start of the first sample.
        last: End, likewise.
        walk: Random-walk coefficient, pulses/sqrt(s), for the weights; the stated variance is that
            of the weights used.
    """
    n = len(pulses)
    growth = walk * walk * period
    kappa = math.acosh(1 + growth / READING_VARIANCE / 2)
    step = float(pulses[math.floor(first) : math.ceil(last)].mean())
    read = _both_ends(n, first, last, kappa)
    error = _windows_error(read.windows, step, growth)
    seconds = read.samples * period
    return MeanRate(
        float(read.on_increments @ pulses) / seconds,
        period * float(read.on_increments @ read.on_increments) / seconds**2,
        error / seconds**2,
    )


@dataclass(frozen=True, eq=False)
class _BothEnds:
    """Weights by which counts at two instants are read from the samples around them."""

    windows: tuple[Floats, Floats]  #: The weights around each instant.
    on_increments: Floats  #: (n,) weights of the samples.
    samples: float  #: Sample intervals between the instants on which the weights are centred.


# Channels of a triad follow each other, with the same random walk and cuts.
@lru_cache(maxsize=1)
def _both_ends(n: int, first: float, last: float, kappa: float) -> _BothEnds:
    widest = min(_WIDEST_WINDOW, _FADED_AWAY / kappa) if kappa > 0 else _WIDEST_WINDOW
    reach = max(1.0, min(first, n - last, (last - first) / 4, widest))
    weights, windows = np.zeros(n + 1), []
    for instant, sign in ((first, -1.0), (last, 1.0)):
        k = np.arange(max(0, math.ceil(instant - reach)), min(n, math.floor(instant + reach)) + 1)
        away = np.abs(k - instant)
        # sinh(kappa to_edge) exp(-kappa to_edge), or proportional to it without a walk.
        to_edge = reach - away
        window = np.exp(-kappa * away) * (-np.expm1(-2 * kappa * to_edge) if kappa > 0 else to_edge)
        window /= window.sum()
        weights[k] += sign * window
        windows.append(window)
    on_increments = -np.cumsum(weights)[:-1]
    between = float(weights @ np.arange(n + 1))
    return _BothEnds((windows[0], windows[1]), on_increments, between)


def _windows_error(windows: Sequence[Floats], step: float, growth: float) -> float:
    """Return the sum of the variances of reading errors (`_faded_error`) averaged over windows."""
    turns = _phases(step, growth)
    error, powers = 0.0, 0
    for window in windows:
        alike = np.correlate(window, window, mode='full')[len(window) - 1 :]
        # Powers of z up to n are products of two of sqrt(n) powers each.
        width = math.isqrt(len(alike) - 1) + 1
        if width != powers:
            coarse, fine = (_powers(np.exp(by * turns), width) for by in (width, 1))
            powers = width
        lags = np.zeros(width * width)
        lags[1 : len(alike)] = 2 * alike[1:]
        together = ((coarse @ lags.reshape(width, width)) * fine).sum(axis=1).real
        error += float(_POWERS @ together) + READING_VARIANCE * float(alike[0])
    return error


def _powers(numbers: NDArray[np.complex128], count: int) -> NDArray[np.complex128]:
    """Return the powers 0 to `count` - 1 of (n,) numbers, (n, count)."""
    found = np.ones((len(numbers), count), dtype=complex)
    found[:, 1:] = numbers[:, None]
    return np.asarray(np.cumprod(found, axis=1), dtype=complex)


def mean_and_blocks(
    pulses: Floats, period: float, walk: float, seconds: float
) -> tuple[MeanRate, list[tuple[float, MeanRate]]]:
    """Estimate the mean rate, and those of blocks of at least `seconds`, independent of each other.

    A slow counter is cut where it passes a new value, any other into equal times.

    Args:
        pulses: (n,) pulses per sample.
        period: Sample interval, s.
        walk: Random walk, pulses/sqrt(s).
        seconds: Shortest block, s.

    Returns:
        `mean_rate`, and for each block its middle, s after the first sample began, and its rate.
    """
    mean, found = _mean_and_passages(pulses, period, walk)
    if found is None:
        edges = block_edges(len(pulses), period, seconds)
        rates = [((a + b) / 2 * period, mean_rate(pulses[a:b], period, walk)) for a, b in edges]
        return mean, rates
    whole = float(np.rint(pulses.mean()))
    cuts = [0]
    for k in range(1, len(found.index)):
        if (found.index[k] - found.index[cuts[-1]]) * period >= seconds:
            cuts.append(k)
    parts = [found.rate(period, a, b) for a, b in pairwise(cuts)]
    middles = [(found.index[a] + found.index[b]) / 2 + 1 for a, b in pairwise(cuts)]
    return mean, [
        (m * period, replace(p, rate=p.rate + whole / period))
        for m, p in zip(middles, parts, strict=True)
    ]


def block_edges(samples: int, period: float, seconds: float) -> list[tuple[int, int]]:
    """Cut samples into blocks of equal length and at least `seconds`; half-open index ranges."""
    count = max(1, min(samples, int(samples * period // seconds)))
    return list(pairwise(np.linspace(0, samples, count + 1).astype(int).tolist()))


# Reductions of rows of a few columns: numpy is slow along so short an axis.


def any_in_row(flags: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return `flags.any(axis=1)` of (n, columns) flags, columns at least 1."""
    return reduce(np.logical_or, flags.T)


def all_in_row(flags: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return `flags.all(axis=1)` of (n, columns) flags, columns at least 1."""
    return reduce(np.logical_and, flags.T)


_ABREAST = 64  #: Rows that are reduced side by side, in one long row.


def by_columns(reduction: np.ufunc, rows: NDArray[Any]) -> NDArray[Any]:
    """Return `reduction.reduce(rows, axis=0)` of contiguous (n, columns) rows, n at least 1.

    The reduction has to give the same for any order of the rows: maximum, sum of whole numbers.
    """
    whole = len(rows) // _ABREAST * _ABREAST
    if not whole or not rows.flags.c_contiguous:
        return np.asarray(reduction.reduce(rows, axis=0))
    columns = rows.shape[1]
    abreast = reduction.reduce(rows[:whole].reshape(-1, _ABREAST * columns), axis=0)
    rest = [abreast.reshape(-1, columns), rows[whole:]]
    return np.asarray(reduction.reduce(np.concatenate(rest), axis=0))


def runs_of(flags: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Return where runs of set flags begin and end, (k, 2)."""
    return np.flatnonzero(np.diff(flags.astype(np.int8), prepend=0, append=0)).reshape(-1, 2)
