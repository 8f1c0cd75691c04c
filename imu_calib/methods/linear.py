"""The closed forms as what they are: linear maps from mean outputs to parameters.

Per channel i the unknowns are its three responses delta_ij + M_ij and its bias. Each equation of a
method reads `coefficients . unknowns = weights . outputs`, so that estimate and covariance both
follow from one small matrix, and the covariance is that of the very weights used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ..errors import NotObservable
from ..model import Triad
from ..stream import Floats

UNKNOWNS = 4
BIAS = 3


@dataclass(eq=False)
class ChannelSystem:
    """Equations of one channel: four of them determine it.

    Attributes:
        size: Number of outputs that the weights refer to.

    """

    size: int
    coefficients: list[Floats] = field(default_factory=list)
    weights: list[Floats] = field(default_factory=list)

    def add(self, coefficients: Floats, weights: Floats) -> None:
        """Add an equation: (4,) coefficients of responses and bias, (size,) weights of outputs."""
        self.coefficients.append(coefficients)
        self.weights.append(weights)

    def solve(self, outputs: Floats, variances: Floats) -> tuple[Floats, Floats, float]:
        """Return unknowns (4,), their covariance (4, 4) and the condition number.

        Args:
            outputs: (size,) mean outputs.
            variances: (size,) their variances.

        Raises:
            NotObservable: The equations do not determine the channel.

        """
        matrix, weights = np.array(self.coefficients), np.array(self.weights)
        if matrix.shape != (UNKNOWNS, UNKNOWNS):
            raise NotObservable(
                f'{len(matrix)} equations for the {UNKNOWNS} unknowns of a channel.'
            )
        scaled = matrix / np.linalg.norm(matrix, axis=0)
        condition = float(np.linalg.cond(scaled))
        gain = np.linalg.solve(matrix, weights)
        return gain @ outputs, (gain * variances) @ gain.T, condition


def solve_triad(
    systems: Sequence[ChannelSystem], outputs: Floats, variances: Floats
) -> tuple[Triad, Floats, float]:
    """Return the triad of three channels, its (12, 12) covariance and the worst condition number.

    Args:
        systems: The equations of channels x, y, z.
        outputs: (size, 3) mean outputs.
        variances: (size, 3) their variances.

    Raises:
        NotObservable: The equations do not determine a channel.

    """
    solved = [s.solve(outputs[:, i], variances[:, i]) for i, s in enumerate(systems)]
    triad = Triad(*_parameters_of(np.array([unknowns for unknowns, _, _ in solved])))
    covariance = _triad_covariance([square for _, square, _ in solved])
    return triad, covariance, max(condition for _, _, condition in solved)


def _parameters_of(unknowns: Floats) -> tuple[Floats, Floats]:
    """Split (3, 4) unknowns of three channels into error matrix (3, 3) and bias (3,)."""
    return unknowns[:, :BIAS] - np.eye(3), unknowns[:, BIAS]


def _triad_covariance(covariances: list[Floats]) -> Floats:
    """Arrange the (4, 4) covariances of three channels in the order of `Triad.vector`."""
    order = [(i, i) for i in range(3)]
    order += [(i, j) for i in range(3) for j in range(3) if i != j]
    order += [(i, BIAS) for i in range(3)]
    result = np.zeros((12, 12))
    for a, (row_a, column_a) in enumerate(order):
        for b, (row_b, column_b) in enumerate(order):
            if row_a == row_b:
                result[a, b] = covariances[row_a][column_a, column_b]
    return result
