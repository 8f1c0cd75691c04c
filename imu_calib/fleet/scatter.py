"""Variance between sessions beyond the stated ones: restricted maximum likelihood, interval.

Session i of a unit has the variance v_i + t, with v_i as stated and t between sessions. Sources:
Patterson & Thompson 1971 (REML), Viechtbauer 2007 (Q-profile interval); docs/history.md, 'Turn-on
repeatability'.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from ..common.gaussian import MAD_TO_STD
from ..common.stream import Floats

# Weighted lines through the sessions of many units at once, with and without steps.
#
# Arrays have any leading shape; n are sessions, of which those without weight do not count, and p
# columns of a design. Source: docs/history.md, 'Lines'.


_RANK = 1e-10
"""Ratio of an eigenvalue of a normal matrix to the largest, below which columns are dependent:
times in months have some ten digits, and their squares half of those."""


@dataclass(frozen=True, eq=False)
class Fit:
    """A weighted least-squares fit."""

    coefficients: Floats  #: (..., p).
    #: (..., p, p) pseudo-inverse of the normal matrix: their covariance per unit of scale.
    inverse: Floats
    residuals: Floats  #: (..., n) zero without weight.
    square: Floats  #: (...) weighted sum of squares of the residuals.
    freedom: NDArray[np.int64]  #: (...) degrees of freedom of that.
    known: NDArray[np.bool_]  #: (...) whether all columns are determined.


def fit(design: Floats, weights: Floats, values: Floats) -> Fit:
    """Fit values (..., n) by a design (..., n, p).

    Weights (..., n) are zero for missing values, which may be NaN.
    """
    there = weights > 0
    y = np.where(there, values, 0.0)
    weighted = weights[..., None] * design
    inverse, rank = _inverse(np.swapaxes(weighted, -1, -2) @ design)
    right = np.swapaxes(weighted, -1, -2) @ y[..., None]
    coefficients = (inverse @ right)[..., 0]
    residuals = np.where(there, y - (design @ coefficients[..., None])[..., 0], 0.0)
    return Fit(
        coefficients,
        inverse,
        residuals,
        np.sum(weights * residuals**2, axis=-1),
        np.maximum(there.sum(axis=-1) - rank, 0),
        rank == design.shape[-1],
    )


def _inverse(normal: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """Return pseudo-inverses of normal matrices (..., p, p), and their ranks (...)."""
    scale = np.sqrt(np.diagonal(normal, axis1=-2, axis2=-1))
    scale = np.where(scale > 0, scale, 1.0)
    both = scale[..., :, None] * scale[..., None, :]
    scaled = normal / both
    if normal.shape[-1] == 1:
        found, rank = scaled, (scaled[..., 0, 0] > 0).astype(np.int64)
    else:
        values, vectors = np.linalg.eigh(scaled)
        good = values > _RANK * np.maximum(values[..., -1:], _RANK)
        kept = np.divide(1.0, values, out=np.zeros_like(values), where=good)
        found = (vectors * kept[..., None, :]) @ np.swapaxes(vectors, -1, -2)
        rank = good.sum(axis=-1)
    return np.asarray(found / both), rank


def line_design(months: Floats) -> Floats:
    """Return the columns of a line, (..., n, 2): its level at month 0, and its slope per month."""
    return np.stack([np.ones_like(months), months], axis=-1)


_STEPS = 50
"""Largest number of steps of Fisher scoring or of Newton, which usually converge in ten."""
_SETTLED = 1e-9
"""Change of a variance, relative to the largest that the data allow, at which they end."""
_LEAST = 1e-9  #: Variance of a session that states none, relative to the variance of all.


def between(design: Floats, stated: Floats, values: Floats) -> Floats:
    """Return the variance between sessions (...), by restricted maximum likelihood.

    With P = W - W X (X' W X)^-1 X' W and W = diag(1 / (v + t)), the score is
    (y' P P y - tr P) / 2 and the information tr(P P) / 2.

    Args:
        design: (..., n, p) columns estimated at the same time.
        stated: (..., n) variances; infinite for sessions that do not count.
        values: (..., n).

    Returns:
        NaN without a degree of freedom.
    """
    shape, size = values.shape[:-1], values.shape[-1]
    flat_design = np.broadcast_to(design, (*values.shape, design.shape[-1])).reshape(
        -1, size, design.shape[-1]
    )
    flat_stated = np.broadcast_to(stated, values.shape).reshape(-1, size)
    flat_values = values.reshape(-1, size)
    plain = fit(flat_design, np.isfinite(flat_stated).astype(float), flat_values)
    total = plain.square / np.maximum(plain.freedom, 1)
    found = total.copy()
    active = np.flatnonzero(plain.freedom > 0)
    for _ in range(_STEPS):
        these = (flat_design[active], flat_stated[active], flat_values[active])
        step = _step(*these, found[active], _LEAST * total[active])
        after = np.maximum(found[active] + step, 0.0)
        moving = np.abs(after - found[active]) > _SETTLED * total[active]
        found[active] = after
        active = active[moving]
        if not len(active):
            break
    return np.where(plain.freedom > 0, found, np.nan).reshape(shape)


def _step(design: Floats, stated: Floats, values: Floats, extra: Floats, least: Floats) -> Floats:
    """Return a step of Fisher scoring from a variance between sessions."""
    weights = _weights(stated, extra, least)
    at = fit(design, weights, values)
    square = at.inverse @ _moment(design, weights, 2)
    cube = at.inverse @ _moment(design, weights, 3)
    once = np.sum(weights, axis=-1) - _trace(square)
    twice = np.sum(weights**2, axis=-1) - 2 * _trace(cube) + _trace(square @ square)
    score = np.sum((weights * at.residuals) ** 2, axis=-1) - once
    return np.asarray(np.divide(score, twice, out=np.zeros_like(score), where=twice > 0))


def interval(
    design: Floats, stated: Floats, values: Floats, confidence: float
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Return the interval (...) of the variance between sessions, and where std is overstated.

    Q(t), the weighted sum of squares about the fit, has a chi-square distribution at the true t,
    and decreases with t: the interval is where it lies between two quantiles. If even Q(0) is below
    both, the scatter is smaller than stated (third return value); the upper end is then that of all
    scatter.
    """
    tail = (1 - confidence) / 2
    plain = fit(design, np.isfinite(stated).astype(float), values)
    least = _LEAST * plain.square / np.maximum(plain.freedom, 1)
    freedom = np.maximum(plain.freedom, 1).astype(float)
    few, many = (scipy.special.chdtri(freedom, p) for p in (1 - tail, tail))
    zero = np.zeros_like(least)
    overstated = fit(design, _weights(stated, zero, least), values).square < few
    low = _where_q_is(many, design, stated, values, least)
    high = _where_q_is(few, design, stated, values, least)
    high = np.where(overstated, plain.square / few, high)
    unknown = plain.freedom == 0
    low, high = (np.where(unknown, np.nan, one) for one in (low, high))
    return low, high, overstated & ~unknown


def _where_q_is(
    wanted: Floats, design: Floats, stated: Floats, values: Floats, least: Floats
) -> Floats:
    """Return the variance at which Q has a given value; zero if it is smaller everywhere.

    1 / Q increases and is concave, and linear if all variances are equal: Newton's steps from zero
    stay below the root.
    """
    found = np.zeros_like(least)
    for _ in range(_STEPS):
        weights = _weights(stated, found, least)
        at = fit(design, weights, values)
        slope = np.sum((weights * at.residuals) ** 2, axis=-1)
        step = (at.square / wanted - 1) * np.divide(
            at.square, slope, out=np.zeros_like(slope), where=slope > 0
        )
        after = np.maximum(found + step, 0.0)
        settled = bool(np.all(np.abs(after - found) <= _SETTLED * (after + least)))
        found = after
        if settled:
            break
    return found


def _weights(stated: Floats, extra: Floats, least: Floats) -> Floats:
    variance = stated + np.maximum(extra, least)[..., None]
    return np.divide(1.0, variance, out=np.zeros_like(variance), where=variance > 0)


def _moment(design: Floats, weights: Floats, power: int) -> Floats:
    return np.asarray(np.swapaxes((weights**power)[..., None] * design, -1, -2) @ design)


def _trace(matrix: Floats) -> Floats:
    return np.asarray(np.trace(matrix, axis1=-2, axis2=-1))


# Common properties of the units of a type: scatter of sessions, and how it differs by unit.
#
# A session's variance is f (v + t): v as stated, t the typical variance between sessions of the
# type, and f a factor of the unit, near one. Over the units of a type f has a scaled inverse
# chi-square distribution: other units add degrees of freedom to a unit with few sessions. Source:
# Smyth 2004 (moderated t), estimated robustly; docs/history.md, 'Units borrow from each other'.


FEWEST_UNITS = 10
"""Smallest number of units with their own scatter for a distribution over the units of a type:
fewer determine it no better than the scatter of one."""
_SAMPLE = 400  #: Most units used for it: more change it by less than a tenth of its width.
_HALVINGS = 50
"""Bisections of a bracket of twelve decades on a logarithmic scale: down to rounding."""
_MIDDLE, _QUARTER = 0.5, 0.25  #: Median of a uniform number, and its mean distance from it.
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
    """Prior of a type, (24,) each."""

    between: Floats  #: Variance between sessions, t.
    scale: Floats  #: Typical f.
    freedom: Floats  #: Degrees of freedom of the prior; 0 with too few units.

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


# Sources: Rosner 1983 (generalised extreme Studentized deviate); t test of a lot against the rest
# with the scatter within lots, Bonferroni; docs/history.md, 'The population'.

FEWEST = 15
"""Smallest number of units for the outlier test: with fewer the levels of Rosner's test do not hold
(Rosner 1983, simulations)."""
_SHARE, _MOST = 10, 100  #: At most one unit in ten, and at most a hundred, may be outliers.
_OF_A_LOT = 2  #: Smallest number of units in a lot, and of all others, for a test of the lot.


def robust(values: Floats) -> tuple[Floats, Floats]:
    """Return median and robust standard deviation of the columns of (u, p) values, NaN excluded."""
    some = np.isfinite(values).any(axis=0)
    safe = np.where(some, values, 0.0)
    median = np.nanmedian(safe, axis=0)
    deviation = MAD_TO_STD * np.nanmedian(np.abs(safe - median), axis=0)
    return np.where(some, median, np.nan), np.where(some, deviation, np.nan)


def outliers(values: Floats, false_alarm: float) -> NDArray[np.int64]:
    """Return the indices of outliers among (u,) values, none NaN, the farthest first.

    The value farthest from the mean is removed repeatedly; the last one whose deviation, over the
    standard deviation before its removal, exceeds its critical value is an outlier, with all before
    it.

    Args:
        values: Normally distributed except for outliers.
        false_alarm: Probability of finding an outlier if there is none.
    """
    count = len(values)
    if count < FEWEST:
        return np.zeros(0, dtype=np.int64)
    kept = np.ones(count, dtype=bool)
    taken: list[int] = []
    last = 0
    for i in range(1, min(count // _SHARE, _MOST) + 1):
        inside = values[kept]
        away = np.where(kept, np.abs(values - inside.mean()), -1.0)
        farthest = int(np.argmax(away))
        spread = inside.std(ddof=1)
        if not spread > 0:
            break
        taken.append(farthest)
        if away[farthest] / spread > critical_deviate(count, i, false_alarm):
            last = i
        kept[farthest] = False
    return np.array(taken[:last], dtype=np.int64)


def critical_deviate(count: int, i: int, false_alarm: float) -> float:
    """Return the critical value for the i-th deviate of `count` values (Rosner 1983, eq. 2.5)."""
    rest = count - i
    t = scipy.special.stdtrit(rest - 1, 1 - false_alarm / (2 * (rest + 1)))
    return float(rest * t / np.sqrt((rest - 1 + t**2) * (rest + 1)))


def lot_shifts(values: Floats, lots: Sequence[str]) -> list[tuple[str, int, float, float, float]]:
    """Return name, units, shift, its standard deviation and p-value of lots in one parameter.

    Args:
        values: (u,) without NaN.
        lots: Lot of each; empty if unknown.
    """
    names = sorted({lot for lot in lots if lot})
    lot_of = np.array(lots)
    known = lot_of != ''
    counts = {name: int(np.sum(lot_of == name)) for name in names}
    freedom = int(known.sum()) - len(names)
    judged = [n for n in names if _OF_A_LOT <= counts[n] <= known.sum() - _OF_A_LOT]
    if len(names) < 2 or freedom < 1 or not judged:
        return []
    each = [values[lot_of == name] for name in names]
    within = sum(np.sum((one - one.mean()) ** 2) for one in each) / freedom
    found = []
    for name in judged:
        own, rest = values[lot_of == name], values[known & (lot_of != name)]
        shift = float(own.mean() - rest.mean())
        std = float(np.sqrt(within * (1 / len(own) + 1 / len(rest))))
        chance = 2 * float(scipy.special.stdtr(freedom, -abs(shift) / std)) if std > 0 else 1.0
        found.append((name, len(own), shift, std, chance))
    return found
