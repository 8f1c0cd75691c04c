"""Reductions of rows of a few columns, column by column: numpy is slow along so short an axis."""

from __future__ import annotations

from functools import reduce

import numpy as np
from numpy.typing import NDArray


def any_in_row(flags: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return `flags.any(axis=1)` of (n, columns) flags, columns at least 1."""
    return reduce(np.logical_or, flags.T)


def all_in_row(flags: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return `flags.all(axis=1)` of (n, columns) flags, columns at least 1."""
    return reduce(np.logical_and, flags.T)
