"""When units leave their specification: line, its uncertainty, and scatter of the next session.

Source: Boole's inequality over the parameters of a unit; docs/history.md, 'When it is due'.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy

from ..common.stream import Floats
from .blocks import Block
from .results import Rules
from .scatter import Prior
from .trends import Lines

_GRID = np.array([0, 0.02, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0])
"""Shares of the horizon that bound the search for the first date."""
_FORECAST_HALVINGS = 14
"""Bisections of such a part: less than a day of ten years."""


@dataclass(frozen=True, eq=False)
class Due:
    """Due dates of u units, in months after the newest session; infinite: after the horizon.

    Attributes:
        leaves: (u, 24) when the line crosses the limit; NaN without a line or limit.
        earliest: (u, 24) when the parameter may be outside.
        unit: (u,) when any parameter may be outside.
        worst: (u,) the parameter that is most likely outside then.
    """

    leaves: Floats
    earliest: Floats
    unit: Floats
    worst: np.ndarray[tuple[int], np.dtype[np.int64]]


def forecast(block: Block, lines: Lines, prior: Prior, limit: Floats, rules: Rules) -> Due:
    """Return when units leave their specification.

    The prediction is for the parameter in a future session: on the line, with the scatter between
    sessions. If the stated deviations exceed the scatter, the excess is an uncertainty common
    to all sessions.

    Args:
        block: u units.
        lines: Of the units.
        prior: Of their type.
        limit: (24,) SI units; NaN without one.
        rules: Horizon and probability.
    """
    horizon = 12 * rules.horizon
    stated = _mean_stated(block)
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


def _mean_stated(block: Block) -> Floats:
    there = np.isfinite(block.stated)
    total = np.sum(np.where(there, block.stated, 0.0), axis=-1)
    return np.asarray(total / np.maximum(there.sum(axis=-1), 1))
