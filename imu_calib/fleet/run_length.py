"""Mean run length of an EWMA chart of standard normal scores, and the limit for a given one.

Source: the integral equation of Crowder 1987; Lucas & Saccucci 1990 tabulate its solutions;
docs/history.md, 'Control charts'.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from numpy.polynomial.legendre import leggauss

_NODES = 64
"""Nodes of the quadrature: run lengths to five digits for smoothings from 0.05 on."""
_WIDEST = 8.0
"""Largest limit in standard deviations: a false alarm in 1e15 sessions."""
_HALVINGS = 50
"""Bisections of the bracket from zero to _WIDEST: down to rounding (8 / 2^50)."""


def ewma_std(smoothing: float) -> float:
    """Return the standard deviation of an EWMA of many standard normal scores."""
    return math.sqrt(smoothing / (2 - smoothing))


def mean_run_length(smoothing: float, limit: float, shift: float = 0.0) -> float:
    """Return the mean number of sessions until an EWMA that starts at zero leaves its limits.

    L(u) = 1 + integral of L(y) phi((y - (1 - s) u) / s - shift) / s over the limits, at u = 0.

    Args:
        smoothing: Weight s of the newest score.
        limit: On both sides, in standard deviations of the EWMA.
        shift: Mean of the scores; zero in control.
    """
    half = limit * ewma_std(smoothing)
    nodes, weights = leggauss(_NODES)
    y = half * nodes

    def kernel(u: np.ndarray) -> np.ndarray:
        z = (y - (1 - smoothing) * u[:, None]) / smoothing - shift
        density = np.exp(-(z**2) / 2) / (math.sqrt(2 * math.pi) * smoothing)
        return np.asarray(half * weights * density)

    runs = np.linalg.solve(np.eye(_NODES) - kernel(y), np.ones(_NODES))
    return float(1 + (kernel(np.zeros(1)) @ runs)[0])


@cache
def ewma_limit(smoothing: float, run: float) -> float:
    """Return the limit, in standard deviations of the EWMA, with a mean run length in control."""
    low, high = 0.0, _WIDEST
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        if mean_run_length(smoothing, middle) < run:
            low = middle
        else:
            high = middle
    return (low + high) / 2
