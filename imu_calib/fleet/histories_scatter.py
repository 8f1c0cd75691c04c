"""Variance between sessions beyond the stated ones: restricted maximum likelihood, interval.

Session i of a unit has the variance v_i + t, with v_i as stated and t between sessions. Sources:
Patterson & Thompson 1971 (REML), Viechtbauer 2007 (Q-profile interval); docs/history.md, 'Turn-on
repeatability'.
"""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from ..common.stream import Floats
from .lines import fit

_STEPS = 50
"""Largest number of steps of Fisher scoring or of Newton, which usually converge in ten."""
_SETTLED = 1e-9
"""Change of a variance, relative to the largest that the data allow, at which they end."""
_LEAST = 1e-9
"""Variance of a session that states none, relative to the variance of all."""


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
