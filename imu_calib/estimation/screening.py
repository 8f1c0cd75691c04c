"""Screen families of terms by one linearisation, before the scatter beside each is estimated.

The scatter beside a family is estimated anew, since scatter without it absorbs it: most of the work
of a search. Here the scatter without it keeps its pattern, and only its size s is estimated beside
each family, by restricted likelihood. In coordinates where noise and scatter are both diagonal,
covariance 1 + s lambda, that takes a few small matrices per family. In 33 simulated sessions of
eleven conditions it saves no time; without it one of 15 whose stops err by 2 arcsec is said to have
moved in its mount.

Sources: Patterson and Thompson 1971, Biometrika 58, 545; Kang et al. 2008, Genetics 178, 1709, for
the coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..common.stream import Floats
from .components import whiten
from .equations import Equations
from .excess_scatter import excess
from .score import SEEN, Family, Pattern, log_f, tries_of
from .solve import with_scatter

_SIZES = np.append(0.0, 2.0 ** np.arange(-12, 3))
"""Sizes of the scatter on the grid, of that without a family: variances in factors of two."""


@dataclass(frozen=True, eq=False)
class Screen:
    """Residuals of a session about a solution, where noise and scatter are diagonal."""

    equations: Equations  #: Without scatter from the session.
    factor: Floats  #: (m, m) lower root of their covariance.
    project: Floats  #: (m, r) from whitened outputs to the coordinates.
    residuals: Floats  #: (r,).
    scatter: Floats  #: (r,) variances by the scatter without any family.

    @classmethod
    def at(cls, equations: Equations, state: Floats) -> Screen:
        """Estimate the scatter of a session about a solution (n,), and diagonalise it."""
        scattering = with_scatter(equations, excess(equations, state))
        factor, (jacobian, residuals) = equations.factor(state), equations.whitened(state)
        norms = np.linalg.norm(jacobian, axis=0)
        sound = norms > 0
        full = np.linalg.qr(jacobian[:, sound] / norms[sound], mode='complete')[0]
        free = full[:, int(sound.sum()) :]
        more = scattering.covariance(state) - equations.covariance(state)
        project = free[: len(factor)]
        half = whiten(factor, whiten(factor, more).T)
        values, vectors = np.linalg.eigh(project.T @ half @ project)
        return cls(
            equations,
            factor,
            project @ vectors,
            vectors.T @ (free.T @ residuals),
            np.maximum(values, 0.0),
        )

    def log_p(self, family: Family, patterns: tuple[Pattern, ...]) -> float:
        """Return the natural logarithm of the chance of a family, by its `columns_of`."""
        tries = tries_of(family, self.equations) or [len(patterns)] * len(patterns)
        chances = [
            self._log_p(columns) + float(np.log(n))
            for (columns, _), n in zip(patterns, tries, strict=True)
        ]
        return min(0.0, *chances) if chances else 0.0

    def _log_p(self, columns: Floats) -> float:
        """Return the logarithm of the chance of columns (m, k), at their likeliest scatter."""
        entering = self.project.T @ whiten(self.factor, columns)
        left, values, _ = np.linalg.svd(entering, full_matrices=False)
        left = left[:, values > SEEN]
        rank, freedom = left.shape[1], len(self.residuals) - left.shape[1]
        if not rank or freedom < 1:
            return 0.0
        weights = 1 / (1 + np.outer(_SIZES, self.scatter))
        information = np.einsum('rk,sr,rl->skl', left, weights, left)
        pull = (weights * self.residuals) @ left
        taken = (pull * np.linalg.solve(information, pull[..., None])[..., 0]).sum(axis=1)
        rest = weights @ self.residuals**2 - taken
        logs = -np.log(weights).sum(axis=1) + np.linalg.slogdet(information)[1]
        best = int(np.argmin(rest + logs))
        scale = max(1.0, float(rest[best]) / freedom)
        return log_f(float(taken[best]) / rank / scale, rank, freedom)
