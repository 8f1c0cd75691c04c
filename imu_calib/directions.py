"""Directions at right angles to a given one."""

from __future__ import annotations

import numpy as np

from .stream import Floats


def across(direction: Floats) -> tuple[Floats, Floats]:
    """Return two unit vectors (..., 3) at right angles to (..., 3) unit vectors and to each other.

    With the direction as the third they are right-handed.
    """
    other = np.eye(3)[np.abs(direction).argmin(axis=-1)]
    first = np.cross(direction, other)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return first, np.cross(direction, first)
