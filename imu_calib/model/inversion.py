"""Invert a nonlinear sensor model: inputs from outputs."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..common.stream import Floats

_ROUNDS = 30
"""Newton's steps double the digits: five suffice for terms of a percent. Where terms exceed the
linear part, the iteration does not converge."""

_CONVERGED = 1e-12
"""Relative to one SI unit and to the input itself: after a smaller step only rounding remains."""


class Nonlinear(Protocol):
    """Addition of a model to its linear part, as a function of (..., 6) inputs."""

    def extra(self, inputs: Floats) -> Floats:
        """Return the addition to the outputs, (..., 6)."""

    def extra_slopes(self, inputs: Floats) -> Floats:
        """Return its derivatives by the inputs, (..., 6, 6)."""


def inverted(model: Nonlinear, linear: Floats, gain: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the inputs x = linear - gain extra(x), by Newton's method.

    A sample gives the same bits alone as among others.

    Args:
        model: The addition to the outputs.
        linear: (n, 6) inputs by the linear model alone.
        gain: (6, 6) inputs of the linear model by its six outputs.

    Returns:
        (n, 6) inputs, NaN where the steps do not converge, and (n,) whether they did.

    Source: docs/mathematics.md, 'Terms'.
    """
    found = linear.copy()
    # NaN and infinite inputs are kept and not solved for.
    going: NDArray[np.bool_] = np.asarray(np.isfinite(linear).all(axis=1))
    done = ~going
    for _ in range(_ROUNDS):
        at = np.flatnonzero(going)
        if not len(at):
            break
        inputs = found[at]
        residuals = inputs - linear[at] + times_transpose(model.extra(inputs), gain)
        step = _solved_inputs(np.eye(6) + gain @ model.extra_slopes(inputs), residuals)
        found[at] = inputs - step
        small = np.abs(step).max(axis=1) <= _CONVERGED * (1 + np.abs(inputs).max(axis=1))
        done[at[small]] = True
        going[at] = ~small & np.isfinite(step).all(axis=1)
    found[~done] = np.nan
    return found, done


def times_transpose(columns: Floats, matrix: Floats) -> Floats:
    """Return (n, k) columns times the transpose of an (m, k) matrix, summed column by column.

    A BLAS product of many rows may round differently from that of one.
    """
    first, *others = np.ascontiguousarray(columns.T)
    found = matrix[:, :1] * first
    for k, column in enumerate(others, start=1):
        found += matrix[:, k, None] * column
    return np.ascontiguousarray(found.T)


def _solved_inputs(matrices: Floats, right: Floats) -> Floats:
    """Return the solutions (n, 6) of (n, 6, 6) systems; NaN for a singular one."""
    try:
        return np.asarray(np.linalg.solve(matrices, right[..., None])[..., 0])
    except np.linalg.LinAlgError:
        if len(matrices) == 1:
            return np.full_like(right, np.nan)
        return np.vstack(
            [_solved_inputs(m[None], r[None]) for m, r in zip(matrices, right, strict=True)]
        )
