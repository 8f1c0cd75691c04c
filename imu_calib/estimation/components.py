"""Covariance of a session's outputs as a sum over sources, and of parameters by source."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from ..common.budget import ErrorSource, Share
from ..common.stream import Floats

# Covariances (m, m) of outputs, stored in factors. `through` is that in parameters which are (n, m)
# times the outputs: (k, n, n) terms that are independent of each other.


@dataclass(frozen=True, eq=False)
class Diagonal:
    """Independent errors of every output, whose size is one common estimate."""

    variances: Floats  #: (m,).

    def add_to(self, matrix: Floats) -> None:
        """Add it to an (m, m) matrix."""
        matrix[np.diag_indices(len(matrix))] += self.variances

    def through(self, gain: Floats) -> Floats:
        """Return its covariance in parameters, (1, n, n)."""
        return np.asarray((gain * self.variances) @ gain.T)[None]


@dataclass(frozen=True, eq=False)
class Factor:
    """Errors that enter several outputs at once."""

    columns: Floats  #: (m, e) changes of the outputs by one standard deviation of each error.

    def add_to(self, matrix: Floats) -> None:
        """Add it to an (m, m) matrix."""
        matrix += self.columns @ self.columns.T

    def through(self, gain: Floats) -> Floats:
        """Return its covariance in parameters, (1, n, n)."""
        moved = gain @ self.columns
        return np.asarray(moved @ moved.T)[None]


@dataclass(frozen=True, eq=False)
class Blocks:
    """Errors that some outputs share, independent between k such groups of g."""

    rows: NDArray[np.intp]  #: (k, g) which outputs.
    matrices: Floats  #: (k, g, g) their covariances.

    def add_to(self, matrix: Floats) -> None:
        """Add it to an (m, m) matrix."""
        matrix[self.rows[:, :, None], self.rows[:, None, :]] += self.matrices

    def through(self, gain: Floats) -> Floats:
        """Return its covariance in parameters, (k, n, n)."""
        weights = np.transpose(gain[:, self.rows], (1, 0, 2))
        return np.asarray(weights @ self.matrices @ np.transpose(weights, (0, 2, 1)))


@dataclass(frozen=True, eq=False)
class Component:
    """A part of the covariance of the outputs, and its source."""

    source: ErrorSource  #: Its source.
    part: Diagonal | Factor | Blocks  #: The covariance.
    freedom: float = np.inf  #: Degrees of freedom of its size; infinite where that is known.


def whiten(root: NDArray[np.floating[Any]], columns: Floats) -> Floats:
    """Return outputs (m,) or (m, k) in standard deviations, by the lower root of a covariance."""
    return np.asarray(scipy.linalg.solve_triangular(root, columns, lower=True, check_finite=False))


def unwhiten(root: Floats, gain: Floats) -> Floats:
    """Return a gain (n, m) on outputs whitened by a lower root as one on the outputs."""
    return np.asarray(scipy.linalg.solve_triangular(root, gain.T, lower=True, trans='T').T)


def add_all(components: Iterable[Component], matrix: Floats) -> None:
    """Add components to a covariance (m, m): errors that enter several outputs at once."""
    columns = []
    for component in components:
        if isinstance(component.part, Factor):
            columns.append(component.part.columns)
        else:
            component.part.add_to(matrix)
    if columns:
        Factor(np.hstack(columns)).add_to(matrix)


def parts(
    components: Iterable[Component], gain: Floats
) -> defaultdict[ErrorSource, list[tuple[Floats, float]]]:
    """Return independent covariances of parameters that are (n, m) times the outputs, by source.

    Each (n, n), with its degrees of freedom.
    """
    found: defaultdict[ErrorSource, list[tuple[Floats, float]]] = defaultdict(list)
    for component in components:
        terms = component.part.through(gain)
        found[component.source] += [(term, component.freedom) for term in terms]
    return found


def shares(components: Iterable[Component], gain: Floats) -> dict[ErrorSource, Share]:
    """Return the covariance of parameters that are (n, m) times the outputs, by source.

    Source: docs/mathematics.md, 'Uncertainty budget'.
    """
    return {source: Share.from_parts(of) for source, of in parts(components, gain).items() if of}
