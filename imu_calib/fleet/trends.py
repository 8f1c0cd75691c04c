"""Lines of units through their sessions: slopes with intervals.

Source: weighted least squares with an estimated scale (Hartung & Knapp 2001, Sidik & Jonkman 2002),
moderated (Smyth 2004); slopes of a type by Paule & Mandel 1982; docs/history.md, 'Trend'.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from ..common.stream import Floats
from .control_charts import Block, StepPlaces, step_design
from .results import Rules
from .scatter import FEWEST_UNITS, Prior, fit, line_design

_HALVINGS = 60
"""Bisections of the bracket of the slopes' variance: down to rounding (2^-60 of it)."""
_TINY = np.finfo(float).tiny


@dataclass(frozen=True, eq=False)
class Lines:
    """Lines of u units with their steps, (u, 24) each."""

    coefficients: Floats  #: (u, 24, 2) level at the newest session, slope per month.
    covariance: Floats  #: (u, 24, 2, 2) of these; NaN if undetermined.
    scale: Floats  #: Factor of the variances of sessions.
    freedom: Floats  #: Degrees of freedom of that.
    known: NDArray[np.bool_]  #: Whether both are determined.
    #: (size, standard deviation) by (unit, parameter), one for each place.
    steps: dict[tuple[int, int], tuple[Floats, Floats]]


@dataclass(frozen=True, eq=False)
class Slopes:
    """Slopes of the units of a type, (24,) each."""

    mean: Floats  #: Per month; NaN if too few units determine it.
    variance: Floats  #: Of the units' true slopes.
    mean_variance: Floats  #: Variance of the mean.


def fit_lines(
    block: Block, weights: Floats, places: StepPlaces, prior: Prior, slopes: Slopes | None = None
) -> Lines:
    """Fit the lines of units.

    Args:
        block: u units.
        weights: (u, 24, n) of the sessions.
        places: Their steps.
        prior: Typical scatter of their type.
        slopes: Those of their type, used as one more observation of each unit's slope; None uses
            only the unit's own sessions.
    """
    design = np.broadcast_to(line_design(block.months)[:, None], (*weights.shape, 2))
    own = fit(design, weights, block.values)
    scale, freedom = prior.moderated(own.square, own.freedom.astype(float))
    plain = own
    if slopes is not None:
        plain = fit(*_with_slope(design, weights, block.values, scale, slopes))
    coefficients = plain.coefficients.copy()
    covariance = scale[..., None, None] * plain.inverse
    known = plain.known.copy()
    steps = {}
    for (u, p), found in places.by_parameter.items():
        columns = step_design(block.months[u], found)
        alone = fit(columns, weights[u, p], block.values[u, p])
        one = Prior(prior.between[p], prior.scale[p], prior.freedom[p])
        scale[u, p], freedom[u, p] = one.moderated(
            alone.square, np.asarray(alone.freedom, dtype=float)
        )
        if slopes is not None:
            of_type = Slopes(slopes.mean[p], slopes.variance[p], slopes.mean_variance[p])
            rows = _with_slope(columns, weights[u, p], block.values[u, p], scale[u, p], of_type)
            alone = fit(*rows)
        whole = scale[u, p] * alone.inverse
        coefficients[u, p], covariance[u, p] = alone.coefficients[:2], whole[:2, :2]
        known[u, p] = alone.known
        steps[u, p] = alone.coefficients[2:], np.sqrt(np.diag(whole)[2:])
    unknown = ~known | ~(freedom > 0)
    covariance[unknown] = np.nan
    return Lines(coefficients, covariance, scale, freedom, known, steps)


def _with_slope(
    design: Floats, weights: Floats, values: Floats, scale: Floats, slopes: Slopes
) -> tuple[Floats, Floats, Floats]:
    """Return design, weights and values with the type's slope as one more observation."""
    row = np.zeros((*design.shape[:-2], 1, design.shape[-1]))
    row[..., 1] = 1.0
    variance = slopes.variance + slopes.mean_variance
    determined = np.isfinite(slopes.mean) & np.isfinite(scale)
    weight = np.where(determined, scale / np.maximum(variance, _TINY), 0.0)
    mean = np.broadcast_to(np.where(determined, slopes.mean, 0.0), weight.shape)
    return (
        np.concatenate([design, row], axis=-2),
        np.concatenate([weights, weight[..., None]], axis=-1),
        np.concatenate([values, mean[..., None]], axis=-1),
    )


def slopes_of(slope: Floats, variance: Floats) -> Slopes:
    """Return the slopes of a type, from those of its units (u, 24) and their variances.

    The variance t of true slopes makes the sum of (slope - mean)^2 / (variance + t) equal to its
    degrees of freedom (Paule & Mandel 1982).
    """
    determined = np.isfinite(slope) & np.isfinite(variance) & (variance > 0)
    count = determined.sum(axis=0)
    enough = count >= FEWEST_UNITS
    values = np.where(determined, slope, 0.0)

    def mean_at(extra: Floats) -> tuple[Floats, Floats, Floats]:
        weights = np.divide(1.0, variance + extra, out=np.zeros_like(slope), where=determined)
        whole = np.maximum(weights.sum(axis=0), _TINY)
        mean = np.sum(weights * values, axis=0) / whole
        return mean, 1 / whole, np.sum(weights * (values - mean) ** 2, axis=0)

    low = np.zeros(slope.shape[1])
    high = np.maximum(
        np.sum(np.where(determined, (values - mean_at(low)[0]) ** 2, 0.0), axis=0), _TINY
    )
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        above = mean_at(middle)[2] > count - 1
        low, high = np.where(above, middle, low), np.where(above, high, middle)
    none = mean_at(np.zeros_like(high))[2] <= count - 1
    extra = np.where(none, 0.0, high)
    mean, mean_variance, _ = mean_at(extra)
    unknown = np.where(enough, 0.0, np.nan)
    return Slopes(mean + unknown, extra + unknown, mean_variance + unknown)


def quantile(freedom: Floats, confidence: float) -> Floats:
    """Return the two-sided quantile of Student's t; NaN without freedom."""
    some = freedom > 0
    found = scipy.special.stdtrit(np.where(some, freedom, 1.0), (1 + confidence) / 2)
    return np.where(some, found, np.nan)


# Source: Boole's inequality over the parameters of a unit; docs/history.md, 'When it is due'.

_GRID = np.array([0, 0.02, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0])
"""Shares of the horizon that bound the search for the first date."""
_FORECAST_HALVINGS = 14  #: Bisections of such a part: less than a day of ten years.


@dataclass(frozen=True, eq=False)
class Due:
    """Due dates of u units, in months after the newest session; infinite: after the horizon."""

    leaves: Floats  #: (u, 24) when the line crosses the limit; NaN without a line or limit.
    earliest: Floats  #: (u, 24) when the parameter may be outside.
    unit: Floats  #: (u,) when any parameter may be outside.
    #: (u,) the parameter that is most likely outside then.
    worst: np.ndarray[tuple[int], np.dtype[np.int64]]


def forecast(block: Block, lines: Lines, prior: Prior, limit: Floats, rules: Rules) -> Due:
    """Return when units leave their specification.

    The prediction is for the parameter in a future session: on the line, with the scatter between
    sessions. If the stated deviations exceed the scatter, the excess is an uncertainty common
    to all sessions. Limits (24,) are in SI units, NaN without one.
    """
    horizon = 12 * rules.horizon
    stated = block.mean_stated
    between = np.abs(lines.scale * (stated + prior.between) - stated)
    determined = np.isfinite(lines.covariance[..., 0, 0]) & np.isfinite(limit)

    def chance(months: Floats) -> Floats:
        """Return the probability (u, 24) of being outside after months (u, 1) or (u, 24)."""
        middle = lines.coefficients[..., 0] + months * lines.coefficients[..., 1]
        covariance = lines.covariance
        variance = covariance[..., 0, 0] + months**2 * covariance[..., 1, 1]
        variance = variance + 2 * months * covariance[..., 0, 1] + between
        std = np.sqrt(np.maximum(np.where(determined, variance, 1.0), np.finfo(float).tiny))
        freedom = np.where(determined, lines.freedom, 1.0)
        beyond = scipy.special.stdtr(freedom, -(limit - middle) / std)
        below = scipy.special.stdtr(freedom, -(limit + middle) / std)
        return np.where(determined, beyond + below, 0.0)

    allowed = 1 - rules.inside
    shape = block.values.shape[:2]
    each = [chance(np.full((shape[0], 1), one * horizon)) for one in _GRID]
    earliest = _first(chance, np.stack(each), allowed, horizon)
    whole = np.stack([one.sum(axis=1, keepdims=True) for one in each])
    unit = _first(lambda m: chance(m).sum(axis=1, keepdims=True), whole, allowed, horizon)
    then = np.where(np.isfinite(unit), unit, horizon)
    return Due(
        np.where(determined, _crossing(lines, limit, horizon), np.nan),
        np.where(determined, earliest, np.nan),
        unit[:, 0],
        np.argmax(chance(then), axis=1),
    )


def _first(
    chance: Callable[[Floats], Floats], at_grid: Floats, allowed: float, horizon: float
) -> Floats:
    """Return the first month with a probability above the allowed one; infinite: none."""
    above = at_grid > allowed
    ever = above.any(axis=0)
    place = np.argmax(above, axis=0)
    high = _GRID[place] * horizon
    low = _GRID[np.maximum(place - 1, 0)] * horizon
    for _ in range(_FORECAST_HALVINGS):
        middle = (low + high) / 2
        over = chance(middle) > allowed
        low, high = np.where(over, low, middle), np.where(over, middle, high)
    # A probability above it at once is due at once.
    high = np.where(place == 0, 0.0, low)
    return np.where(ever, high, np.inf)


def _crossing(lines: Lines, limit: Floats, horizon: float) -> Floats:
    """Return the month (u, 24) at which the line leaves the limits; infinite: after the horizon."""
    level, slope = lines.coefficients[..., 0], lines.coefficients[..., 1]
    way = limit - np.sign(slope) * level
    months = np.divide(way, np.abs(slope), out=np.full(level.shape, np.inf), where=slope != 0)
    months = np.where(np.abs(level) >= limit, 0.0, months)
    return np.where(months <= horizon, months, np.inf)
