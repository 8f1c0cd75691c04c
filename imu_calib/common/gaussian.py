"""Constants of the Gaussian distribution that several thresholds share; what a covariance is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

MAD_TO_STD = 1.4826
"""Standard deviation over the median absolute deviation: 1 / 0.6745, its quartile."""
MEDIAN_ERROR = 1.25
"""Standard deviation of a median of n values times the root of n, over theirs: sqrt(pi / 2)."""
FIVE_SIGMA = 5.0
"""Standard deviations; noise exceeds them to either side once in 1.7 million. That a file, a table
or a unit contradicts the data is not to be reported by chance in a laboratory's lifetime."""
_ROUNDING = 1e-9
"""Largest negative eigenvalue of a correlation matrix due to rounding; double precision gives some
1e-14 for 40 parameters, a file with nine digits 1e-9."""


def is_covariance(matrix: NDArray[np.float64]) -> bool:
    """Return whether a matrix (n, n) of finite numbers is symmetric and positive semidefinite."""
    variances = np.diag(matrix)
    if (variances < 0).any():
        return False
    std = np.sqrt(variances)
    scale = np.where(std > 0, std, 1.0)
    correlation = matrix / np.outer(scale, scale)
    lopsided = np.abs(correlation - correlation.T).max(initial=0.0)
    lowest = np.linalg.eigvalsh((correlation + correlation.T) / 2).min(initial=0.0)
    return bool(lopsided <= _ROUNDING and lowest >= -_ROUNDING)
