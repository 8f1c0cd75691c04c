"""Weighted lines through the sessions of many units at once, with and without steps.

Arrays have any leading shape; n are sessions, of which those without weight do not count, and p
columns of a design. Source: docs/history.md, 'Lines'.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..common.stream import Floats

_RANK = 1e-10
"""Ratio of an eigenvalue of a normal matrix to the largest, below which columns are dependent:
times in months have some ten digits, and their squares half of those."""


@dataclass(frozen=True, eq=False)
class Fit:
    """A weighted least-squares fit.

    Attributes:
        coefficients: (..., p).
        inverse: (..., p, p) pseudo-inverse of the normal matrix: their covariance per unit of
            scale.
        residuals: (..., n) zero without weight.
        square: (...) weighted sum of squares of the residuals.
        freedom: (...) degrees of freedom of that.
        known: (...) whether all columns are determined.
    """

    coefficients: Floats
    inverse: Floats
    residuals: Floats
    square: Floats
    freedom: NDArray[np.int64]
    known: NDArray[np.bool_]


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
