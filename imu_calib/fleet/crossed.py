"""The crossed model of units and stands: the effect of a stand on every unit.

A session is unit + stand + trend of the type + scatter. Units are fixed effects: only differences
of a unit between stands determine the effects of stands, however much units differ. Source: Huber
1981, 7.6 and 7.7 (robust regression, its covariance and scale); docs/history.md, 'Unit or stand?'.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from ..common.stream import Floats

_TUNING = 2.0
"""Standard deviations beyond which the weight of a session is limited: 99 % efficient for normal
residuals, and robust to a repaired unit."""
_NORMAL = float(
    scipy.special.chdtr(3, _TUNING**2) + _TUNING**2 * scipy.special.chdtrc(1, _TUNING**2)
)
"""Mean square of normal residuals limited at that (Huber 1964, proposal 2). The scale comes
from it and uses all degrees of freedom: the median deviation of a dozen sessions is so uncertain
that t exceeded the limit of Student's t ten times too often."""
_ROUNDS = 100
"""Largest number of reweighting iterations; they end when no weight changes."""
_SETTLED = 1e-4
"""Change of a weight below which iterations end."""
_CROSSED_RANK = 1e-9
"""Singular values, of columns scaled to one, that count as zero: far above rounding (1e-14 with
some hundred sessions), far below any design that separates stands (1 / sessions)."""
_STEPS = 100
"""Largest number of scoring steps; they end when the variance changes by less than 1e-9 of
itself."""


@dataclass(frozen=True, eq=False)
class Effects:
    """Effects of s stands on one parameter.

    Attributes:
        effect: (s,) of a stand minus the mean of all.
        covariance: (s, s) of these, of rank s - 1.
        freedom: Degrees of freedom.
        residuals: (n,) of the sessions over their standard deviations, outliers clipped; NaN if a
            session does not count.
        comparable: Whether all stands can be compared.
    """

    effect: Floats
    covariance: Floats
    freedom: int
    residuals: Floats
    comparable: bool


def crossed(
    units: NDArray[np.int64],
    stands: NDArray[np.int64],
    trends: Floats,
    values: Floats,
    variance: Floats,
) -> Effects:
    """Return the effects of stands on one parameter.

    Args:
        units: (n,) index of each session's unit.
        stands: (n,) index of its stand, from 0 without gaps.
        trends: (n, k) further columns.
        values: (n,) NaN if a session does not count.
        variance: (n,) of sessions, up to a common factor.
    """
    count = int(stands.max()) + 1
    there = np.isfinite(values) & np.isfinite(variance)
    own = np.unique(units[there], return_inverse=True)[1]
    size = np.bincount(own)
    weight = 1 / np.maximum(variance[there], np.finfo(float).tiny)
    columns = np.column_stack([np.eye(count)[stands[there]], trends[there], values[there]])
    plain = _less_units(columns, own, weight)
    rank = _rank(plain[:, :-1], weight)
    rest = int(there.sum()) - len(size) - rank
    comparable = rank == columns.shape[1] - 2
    if rest < 1 or rank == 0:
        unknown = np.full(count, np.nan)
        empty = np.full(len(values), np.nan)
        return Effects(unknown, np.full((count, count), np.nan), max(rest, 0), empty, False)
    # The mean of a unit reduces each of its residuals.
    share = np.sqrt(np.maximum(1 - 1 / size[own], 0.0))
    trust = np.ones(len(own))
    for _ in range(_ROUNDS):
        less = _less_units(columns, own, weight * trust)
        coefficients, _ = _solved(less[:, :-1], weight * trust, less[:, -1])
        deviations = (less[:, -1] - less[:, :-1] @ coefficients) * np.sqrt(weight)
        z = np.divide(deviations, share, out=np.zeros_like(deviations), where=share > 0)
        scale = float(np.sqrt(np.sum((deviations * trust) ** 2) / rest / _NORMAL))
        bound = np.maximum(_TUNING * scale, np.finfo(float).tiny)
        before = trust
        trust = bound / np.maximum(np.abs(z), bound)
        if np.max(np.abs(trust - before)) < _SETTLED:
            break
    bounded = deviations * trust
    whole = float(np.mean(trust[share > 0] == 1.0))
    parameters = len(size) + rank
    kappa = 1 + parameters / len(own) * (1 - whole) / whole
    factor = kappa**2 * float(np.sum(bounded**2)) / rest / whole**2
    _, inverse = _solved(plain[:, :-1], weight, plain[:, -1])
    residuals = np.full(len(values), np.nan)
    residuals[there] = bounded
    return Effects(
        coefficients[:count],
        factor * inverse[:count, :count],
        rest,
        residuals,
        comparable,
    )


def reproducibility(effects: Effects) -> float:
    """Return the standard deviation between stands, by restricted maximum likelihood.

    Along the eigenvectors of the contrasts' covariance each has the variance t + lambda.
    """
    count = len(effects.effect)
    if not effects.comparable or count < 2:
        return float('nan')
    centred = np.linalg.svd(np.eye(count) - 1 / count)[0][:, : count - 1]
    own, vectors = np.linalg.eigh(centred.T @ effects.covariance @ centred)
    square = (vectors.T @ centred.T @ effects.effect) ** 2
    own = np.maximum(own, 0.0)
    found = float(np.mean(square))
    for _ in range(_STEPS):
        weights = 1 / np.maximum(own + found, np.finfo(float).tiny)
        step = np.sum(weights**2 * (square - own - found)) / np.sum(weights**2)
        after = max(found + float(step), 0.0)
        if abs(after - found) <= 1e-9 * max(after, found):
            break
        found = after
    return float(np.sqrt(found))


def _less_units(columns: Floats, units: NDArray[np.int64], weight: Floats) -> Floats:
    """Return columns (n, p) minus their weighted mean over the sessions of each unit."""
    total = np.bincount(units, weight)
    means = np.column_stack([np.bincount(units, weight * one) / total for one in columns.T])
    return np.asarray(columns - means[units])


def _rank(columns: Floats, weight: Floats) -> int:
    matrix = columns.T @ (weight[:, None] * columns)
    scale = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    scale = np.where(scale > 0, scale, 1.0)
    return int(
        np.linalg.matrix_rank(matrix / np.outer(scale, scale), tol=_CROSSED_RANK, hermitian=True)
    )


def _solved(columns: Floats, weight: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Return the coefficients of least norm, and the pseudo-inverse of the normal matrix.

    With least norm the effects of stands have the sum zero.
    """
    matrix = columns.T @ (weight[:, None] * columns)
    inverse = np.linalg.pinv(matrix, rcond=_CROSSED_RANK, hermitian=True)
    return np.asarray(inverse @ (columns.T @ (weight * values))), np.asarray(inverse)
