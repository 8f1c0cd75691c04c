"""The closed forms as linear maps from mean outputs to parameters.

Per channel i the unknowns are its three responses delta_ij + M_ij and its bias. Each equation of a
method reads `coefficients . unknowns = weights . outputs`, so that the estimate follows from one
small matrix, and its covariance from that of the outputs (`gains`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ...common.errors import NotObservable
from ...common.stream import Floats
from ...model.sensors import Triad

UNKNOWNS = 4
"""Of a channel: three responses and a bias."""
BIAS = 3
"""Its index among them."""


@dataclass(eq=False)
class ChannelSystem:
    """Equations of one channel: four of them determine it.

    Attributes:
        size: Number of outputs that the weights refer to.
        coefficients: (4,) of responses and bias in each equation.
        weights: (size,) of the outputs in each equation.
    """

    size: int
    coefficients: list[Floats] = field(default_factory=list)
    weights: list[Floats] = field(default_factory=list)

    def add(self, coefficients: Floats, weights: Floats) -> None:
        """Add an equation: (4,) coefficients of responses and bias, (size,) weights of outputs."""
        self.coefficients.append(coefficients)
        self.weights.append(weights)

    def solve(self) -> tuple[Floats, float]:
        """Return the weights (4, size) of outputs for the unknowns, and the condition number.

        Raises:
            NotObservable: The equations do not determine the channel.
        """
        matrix, weights = np.array(self.coefficients), np.array(self.weights)
        if matrix.shape != (UNKNOWNS, UNKNOWNS):
            raise NotObservable(
                f'{len(matrix)} equations for the {UNKNOWNS} unknowns of a channel.'
            )
        scaled = matrix / np.linalg.norm(matrix, axis=0)
        return np.asarray(np.linalg.solve(matrix, weights)), float(np.linalg.cond(scaled))


@dataclass(frozen=True, eq=False)
class SolvedTriad:
    """Three channels by the weights on their outputs.

    Attributes:
        triad: The parameters.
        gain: (3, 4, size) weights of each channel's outputs for responses and bias.
        condition: The worst condition number.
    """

    triad: Triad
    gain: Floats
    condition: float


def solve_triad(systems: Sequence[ChannelSystem], outputs: Floats) -> SolvedTriad:
    """Solve three channels.

    Args:
        systems: The equations of channels x, y, z.
        outputs: (size, 3) mean outputs.

    Raises:
        NotObservable: The equations do not determine a channel.
    """
    solved = [system.solve() for system in systems]
    gain = np.array([weights for weights, _ in solved])
    unknowns = np.einsum('ium,mi->iu', gain, outputs)
    triad = Triad(unknowns[:, :BIAS] - np.eye(3), unknowns[:, BIAS])
    return SolvedTriad(triad, gain, max(condition for _, condition in solved))
