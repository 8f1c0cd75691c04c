"""Estimate the noise of channels at rest: random walk, bias instability, quantisation and more."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from ..common.stream import Floats
from ..session.imu import ChannelNoise, Coefficient
from .allan import (
    AllanSums,
    Term,
    cluster_sizes,
    counter_share,
    octaves,
    pooled,
    spread,
    unit_variances,
)
from .segments import CHANNELS, Statistics

_STEPS = 24  #: Most steps of the reweighting, each half way: whole steps may go to and fro.
_MOSTLY = 0.5
"""Share of a variance: with more of it from the counter, a point does not determine the sensor's
noise."""
_SETTLED = 1e-4
"""Relative change of variances at which the reweighting ends: far below what they are known to."""
_TINY = 1e-300  #: Prevents division by zero for values without noise.
_FEWEST_POINTS = 2  #: A slope needs two.
_ALIKE = 0.2  #: Relative: blocks whose lengths differ by more are not compared.
_SMALLEST_EIGENVALUE = 1e-10
"""Of the largest: smaller eigenvalues of a correlation are rounding. A judgement: rounding gives
some 1e-16 times the number of points, and estimated variances considerably more."""


def session_noise(statistics: Sequence[Statistics], walk: Floats) -> dict[str, ChannelNoise]:
    """Estimate the noise of every channel from the static dwells of a session.

    Args:
        statistics: Of the static dwells.
        walk: (6,) random-walk coefficients of the calibration, which determine how fast a
            counter's steps are smeared, rad/sqrt(s) and (m/s)/sqrt(s).

    Returns:
        By name of the channel; without those that the data does not determine.
    """
    with_sums = [s for s in statistics if s.allan is not None and len(s.allan.counts)]
    found = {}
    sums = pooled([s.allan for s in with_sums if s.allan is not None]) if with_sums else None
    for c, name in enumerate(CHANNELS):
        points = None if sums is None else _points(with_sums, sums, c, float(walk[c]))
        if points is not None:
            count = int(points.usable.sum())
            found[name] = fit(points, _distinguishable(count, counter=points.pulse > 0)).noise
    return found


@dataclass(frozen=True, eq=False)
class AllanPoints:
    """Allan variances of one channel, with their contributions."""

    factors: Floats  #: (k,) cluster sizes, in steps of `period`.
    period: float  #: s.
    lengths: tuple[int, ...]  #: Steps of every run.
    variance: Floats  #: (k,) as observed.
    known: Floats  #: (k,) theoretical contribution of quantisation.
    pulse: float  #: Size of a pulse; 0 if quantisation is to be fitted.
    usable: np.ndarray[Any, np.dtype[np.bool_]]  #: (k,) mask of points for the fit.
    timed: bool = False  #: See `ChannelNoise`.


def _points(
    statistics: Sequence[Statistics], sums: AllanSums, channel: int, walk: float
) -> AllanPoints | None:
    variance = sums.variance[:, channel]
    pulse = float(statistics[0].pulse[channel])
    if not variance.any():
        return None
    known = _known_share(statistics, channel, walk, sums) if pulse else np.zeros(len(variance))
    usable = (known < _MOSTLY * variance) & (variance > 0)
    factors = cluster_sizes(len(variance))
    points = AllanPoints(factors, sums.period, sums.lengths, variance, known, pulse, usable)
    if usable.sum() >= _FEWEST_POINTS and usable[-_FEWEST_POINTS:].all():
        return points
    return _timed_points(statistics, channel, pulse, walk) or points


def _known_share(
    statistics: Sequence[Statistics], channel: int, walk: float, sums: AllanSums
) -> Floats:
    """Return the theoretical Allan variance of a counter's steps, (k,)."""
    total = np.zeros(len(sums.counts))
    for s in statistics:
        own = s.allan
        if own is None:
            continue
        pulse, factors = float(s.pulse[channel]), cluster_sizes(len(own.counts))
        rate, growth = float(s.mean[channel]) / pulse, (walk / pulse) ** 2
        share = counter_share(rate * own.period, growth * own.period, factors)
        total[: len(factors)] += own.counts * share * pulse**2
    return np.asarray(total / (2 * sums.counts * sums.taus**2))


def _timed_points(
    statistics: Sequence[Statistics], channel: int, pulse: float, walk: float
) -> AllanPoints | None:
    """Use the blocks, whose means use the times of the pulses, in place of the samples.

    Only static dwells are pooled whose blocks have a typical length, and whose pulses are timed to
    less than the walk.
    """
    rows = [s.blocks[channel] for s in statistics if len(s.blocks[channel]) > 2]
    rows = [b for b in rows if b[:, 2].mean() < walk**2 * b[:, 1].mean()]
    if not rows:
        return None
    steps = np.array([float(np.median(np.diff(b[:, 3]))) for b in rows])
    # An existing length: midway between two lengths there may be no similar one.
    period = float(np.sort(steps)[len(steps) // 2])
    rows = [b for b, step in zip(rows, steps, strict=True) if abs(step / period - 1) < _ALIKE]
    most = max(len(b) for b in rows)
    factors = cluster_sizes(octaves(most))
    squares, known, counts = (np.zeros(len(factors)) for _ in range(3))
    for block in rows:
        phase = np.concatenate([[0.0], np.cumsum(block[:, 0] * period)])
        reading = float(block[:, 2].mean()) * period**2
        for k, m in enumerate(factors[factors <= len(block) // 3].astype(int)):
            d = phase[2 * m :] - 2 * phase[m:-m] + phase[: -2 * m]
            squares[k] += d @ d
            # Each block has independent reading errors.
            known[k] += len(d) * 2 * m * reading
            counts[k] += len(d)
    scale = 2 * counts * (factors * period) ** 2
    variance, share = squares / scale, known / scale
    usable = (share < _MOSTLY * variance) & (variance > 0)
    lengths = tuple(len(b) for b in rows)
    return AllanPoints(factors, period, lengths, variance, share, pulse, usable, timed=True)


class Fitted(NamedTuple):
    """Coefficients of a channel, and how well they describe its curve."""

    noise: ChannelNoise
    squares: Floats  #: (5,) squared coefficients that describe it best; 0 for those not seen.
    misfit: float  #: Sum of squared residuals in standard deviations, correlations included.
    freedom: int  #: Points less coefficients.


def fit(points: AllanPoints, terms: Sequence[Term], doubtful: Sequence[Term] = ()) -> Fitted:
    """Fit non-negative squared coefficients by generalised least squares.

    The covariance of the points depends on the coefficients, so both are found in alternation.

    Args:
        points: Of one channel.
        terms: To be fitted.
        doubtful: Terms whose uncertainty is in that of the others also where the fit is best
            without them.
    """
    units = unit_variances(points.factors, points.period)
    rows = points.usable
    sizes = points.factors.astype(int).tolist()
    own = np.zeros(len(Term))
    if points.pulse and not points.timed:
        own[Term.QUANTISATION] = points.pulse**2 / 12
    unexplained = np.maximum(points.variance - points.known, 0.0)
    squares, variances, misfit = np.zeros(len(Term)), np.full(len(Term), np.inf), 0.0
    # To begin with, as accurate as white noise would be: the longest times are known least.
    white = np.eye(len(Term))[Term.RANDOM_WALK]
    ratio = (points.variance + _TINY) / units[:, Term.RANDOM_WALK]
    spread_all = spread(sizes, points.lengths, points.period, white) * np.outer(ratio, ratio)
    basis: Floats | None = None
    for _ in range(_STEPS if rows.any() else 0):
        inside = np.ix_(rows, rows)
        squares, variances, misfit = _non_negative(
            units[rows], unexplained[rows], spread_all[inside], terms, doubtful
        )
        before, basis = basis, squares if basis is None else (basis + squares) / 2
        if not (basis + own)[: Term.RAMP].any():
            break
        spread_all = spread(sizes, points.lengths, points.period, basis + own)
        if before is not None and np.allclose(basis, before, rtol=_SETTLED, atol=0.0):
            break
    found = {t: Coefficient.from_square(float(squares[t]), math.sqrt(variances[t])) for t in Term}
    if points.pulse:
        size = points.pulse / math.sqrt(12)
        found[Term.QUANTISATION] = Coefficient(size, 0.0, size)
    deviation = np.sqrt(points.variance)
    noise = ChannelNoise(
        points.factors * points.period,
        deviation,
        np.sqrt(np.diag(spread_all)) / (2 * np.maximum(deviation, _TINY)),
        found[Term.RANDOM_WALK],
        found[Term.BIAS_INSTABILITY],
        found[Term.QUANTISATION],
        found[Term.RATE_RANDOM_WALK],
        points.timed,
        found[Term.RAMP],
    )
    return Fitted(noise, squares + own, misfit, int(rows.sum() - np.count_nonzero(squares)))


def _distinguishable(points: int, *, counter: bool) -> list[Term]:
    """Return the terms that so many points can separate, the commonest first."""
    order = [Term.RANDOM_WALK, Term.BIAS_INSTABILITY, Term.QUANTISATION, Term.RATE_RANDOM_WALK]
    if counter:
        order.remove(Term.QUANTISATION)
    return order[: max(1, points - 1)]


def _non_negative(
    units: Floats,
    variance: Floats,
    covariance: Floats,
    terms: Sequence[Term],
    doubtful: Sequence[Term] = (),
) -> tuple[Floats, Floats, float]:
    """Return the best-fitting non-negative squared coefficients (5,), their variances, the misfit.

    With a handful of terms there are few subsets: all are solved at once, and the best without a
    negative number is taken. Terms outside it are zero, with the variance that they would have in
    it.
    """
    whiten = _whitening(covariance)
    design, observed = whiten @ units, whiten @ variance
    size = np.linalg.norm(design, axis=0)
    design = design / size
    subsets = _subsets(tuple(terms))
    turned, triangle = np.linalg.qr(design)
    rounding = max(design.shape) * np.finfo(float).eps
    inverses = np.linalg.pinv(triangle * subsets[:, None, :], rcond=rounding)
    solved = (inverses @ (turned.T @ observed)) * subsets
    misfits = ((observed - solved @ design.T) ** 2).sum(axis=1)
    best = int(np.argmin(np.where((solved >= 0).all(axis=1), misfits, np.inf)))
    among = np.maximum(np.eye(len(Term))[terms], subsets[best])
    among[:, list(doubtful)] = 1.0
    information = design.T @ design * among[:, :, None] * among[:, None, :]
    variances = np.full(len(Term), np.inf)
    each = np.linalg.pinv(information)[np.arange(len(terms)), terms, terms]
    variances[terms] = each / size[terms] ** 2
    return solved[best] / size, variances, float(misfits[best])


@lru_cache(maxsize=8)
def _subsets(terms: tuple[Term, ...]) -> Floats:
    """Return which terms are in each subset, (n, 5) of zeros and ones, the smallest first."""
    counts = range(len(terms) + 1)
    subsets = [s for count in counts for s in itertools.combinations(terms, count)]
    return np.array([[float(term in subset) for term in Term] for subset in subsets])


def _whitening(covariance: Floats) -> Floats:
    """Return the (k, k) matrix that whitens points of a covariance.

    For noise that averages out faster than white (rounding, a trembling hand), clusters of a few
    samples are almost fully correlated: eigenvalues at the level of rounding carry no information.
    """
    deviation = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(deviation, deviation))
    floor = _SMALLEST_EIGENVALUE * values[-1]
    return np.asarray((vectors / np.sqrt(np.maximum(values, floor))).T / deviation)
