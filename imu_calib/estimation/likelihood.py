"""Log likelihoods of residuals whose covariance is a sum, for many sizes of one part at once.

For a covariance 1 + r K and residuals z, a reflection takes z to the first axis and K is made
tridiagonal by rotations that leave this axis unchanged: for each r one factorisation of a
tridiagonal matrix from its far end gives the determinant, and its last pivot the quadratic form.
That is a third of the work of eigenvectors, and the covariance of each further size costs almost
nothing.

Sources: Golub and Van Loan 2013, Matrix Computations, 5.1.2, 8.3.1 and 4.3.6; for noise of unknown
size docs/mathematics.md, 'Joint estimate'.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy

from ..common.stream import Floats
from .components import whiten

_BLOCK = 32  #: Columns that are reduced at once; see LAPACK's ILAENV.
_LARGEST = float(np.log(8.0))
"""Logarithm of the largest factor on a variance of noise: with a single degree of freedom it is
exceeded once in four times, and the residuals of channels that are eight times off are not
noise."""


def log_likelihood(covariance: Floats, residuals: Floats) -> float:
    """Return the log likelihood of residuals (r,), with a covariance (r, r)."""
    _, z, size = _rooted(covariance, residuals)
    return -0.5 * float(z @ z) - size


def gain_by_noise(
    covariance: Floats, residuals: Floats, parts: Sequence[tuple[Floats, float]]
) -> float:
    """Return the gain in log likelihood where noise is known only by its estimate.

    `parts` are columns (r, m) whose product with their transpose is a part of the noise, and the
    degrees of freedom of its estimate.

    The factor f on the variance of each part maximises the joint likelihood of the residuals and
    the blocks from which the part was estimated: these have -freedom / 2 (log f + 1 / f - 1),
    largest at f = 1.

    Source: docs/mathematics.md, 'Joint estimate'.
    """
    known = [(columns, columns @ columns.T, nu) for columns, nu in parts if np.isfinite(nu)]
    if not known:
        return 0.0

    def off(logs: Floats) -> tuple[float, Floats]:
        factors = np.exp(logs)
        total = covariance + sum((f - 1) * k for f, (_, k, _) in zip(factors, known, strict=True))
        root, z, size = _rooted(total, residuals)
        value, slopes = 0.5 * float(z @ z) + size, np.empty(len(known))
        for c, (f, (columns, _, nu)) in enumerate(zip(factors, known, strict=True)):
            white = whiten(root, columns)
            value += 0.5 * nu * float(logs[c] + 1 / f - 1)
            slopes[c] = 0.5 * f * ((white**2).sum() - ((z @ white) ** 2).sum())
            slopes[c] += 0.5 * nu * (1 - 1 / f)
        return value, slopes

    bounds = [(-_LARGEST, _LARGEST)] * len(known)
    start = np.zeros(len(known))
    found = scipy.optimize.minimize(off, start, jac=True, method='L-BFGS-B', bounds=bounds)
    return max(0.0, off(start)[0] - float(found.fun))


def log_likelihoods_by_ratio(
    base: Floats, kernels: Sequence[Floats], residuals: Floats, ratios: Floats
) -> Floats:
    """Return the log likelihoods (n, k) of residuals with covariances base + ratio kernel.

    The base is (r, r), the n kernels likewise, and the k ratios are at least 0.
    """
    root, z, size = _rooted(base, residuals)
    reduced = [scipy.linalg.lapack.dsygst(k, root, itype=1, lower=1)[0] for k in kernels]
    return np.array([_along(kernel, z, ratios) for kernel in reduced]) - size


def log_likelihoods_by_columns(
    base: Floats,
    columns: Sequence[Floats],
    factors: Sequence[Floats],
    residuals: Floats,
    ratios: Floats,
) -> Floats:
    """Return the log likelihoods (n, k) for kernels X X', X several columns side by side.

    X are p blocks (r, e), each times one of the (p,) factors of one of n kernels.

    The component orthogonal to all of them is common to all kernels, and no kernel has a higher
    rank than the number of columns.
    """
    root, z, size = _rooted(base, residuals)
    basis, triangle = np.linalg.qr(whiten(root, np.hstack(columns)))
    within = basis.T @ z
    rest = z - basis @ within
    size += 0.5 * float(rest @ rest)
    widths = [one.shape[1] for one in columns]
    found = []
    for factor in factors:
        scaled = triangle * np.repeat(factor, widths)
        found.append(_along(scaled @ scaled.T, within, ratios) - size)
    return np.array(found)


def _rooted(covariance: Floats, residuals: Floats) -> tuple[Floats, Floats, float]:
    """Return the lower root of a covariance, whitened residuals, the sum of its logarithms."""
    root = np.asarray(np.linalg.cholesky(covariance), dtype=float)
    return root, whiten(root, residuals), float(np.log(np.diag(root)).sum())


def _along(kernel: Floats, z: Floats, ratios: Floats) -> Floats:
    """Return the log likelihoods of z (r,) with the covariances 1 + ratio kernel, (k,).

    Of the kernel (r, r) the lower triangle is read.
    """
    square = float(z @ z)
    if not kernel.any():
        return np.full(len(ratios), -0.5 * square)
    if len(z) < 2:
        return _by_eigenvectors(kernel, z, ratios)
    diagonal, off_diagonal = _tridiagonal(kernel, z)
    # Uncoupled matrices form one tridiagonal matrix.
    parted = np.append(off_diagonal, 0.0)
    pivots, _, failed = scipy.linalg.lapack.dpttrf(
        1 + np.outer(ratios, diagonal).ravel(), np.outer(ratios, parted).ravel()[:-1]
    )
    if failed:
        return _by_eigenvectors(kernel, z, ratios)
    pivots = pivots.reshape(len(ratios), len(z))
    return np.asarray(-0.5 * (np.log(pivots).sum(axis=1) + square / pivots[:, -1]))


def _tridiagonal(kernel: Floats, z: Floats) -> tuple[Floats, Floats]:
    """Return the diagonal (r,) and the off-diagonal, from the far end to the axis of z."""
    across = z.copy()
    across[0] += np.copysign(np.linalg.norm(z), z[0])
    if (square := float(across @ across)) > 0:
        by = scipy.linalg.blas.dsymv(2 / square, kernel, across, lower=1)
        by -= across * (float(across @ by) / square)
        kernel = scipy.linalg.blas.dsyr2(-1.0, across, by, a=kernel, lower=1)
    _, diagonal, off_diagonal, _, _ = scipy.linalg.lapack.dsytrd(
        kernel, lower=1, lwork=_BLOCK * len(kernel)
    )
    return diagonal[::-1], off_diagonal[::-1]


def _by_eigenvectors(kernel: Floats, z: Floats, ratios: Floats) -> Floats:
    """Return `_along` for a kernel that rounding makes negative at large ratios."""
    values, vectors = np.linalg.eigh(kernel)
    scaled = 1 + np.outer(ratios, np.maximum(values, 0.0))
    square = (vectors.T @ z) ** 2
    return np.asarray(-0.5 * (np.log(scaled) + square / scaled).sum(axis=1))
