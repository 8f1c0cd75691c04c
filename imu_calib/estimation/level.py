"""Effect of a table's tilt on a closed form, which assumes a level table.

The accelerometers at rest show the tilt. Its effect on a solver is the difference of the solver's
results for the outputs that its own solution predicts on the tilted table and on a level one: for
twelve positions 1 - cos tilt in K_a, for others more (docs/mathematics.md, 'Twelve positions').
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ..common.rotations import FIVE_SIGMA, shortest
from ..common.stream import Floats
from ..common.units import ARCSEC
from ..model.parameters import PARAMETERS
from ..model.sensors import Triad
from .evidence import UP, Evidence

Accelerometers = Callable[[Evidence], Triad]
"""A closed form for the accelerometers of a session."""

_SIGNIFICANT = 0.5
"""An error of so many standard deviations gets a sentence and widens them, by 12 %; smaller ones
are negligible against them."""


@dataclass(frozen=True, eq=False)
class Tilt:
    """The plumb line by the accelerometers at rest.

    Attributes:
        up: (3,) unit vector in the frame of the attitudes.
        std: Standard deviation of its direction about either level axis, rad.
    """

    up: Floats
    std: float

    @property
    def size(self) -> float:
        """Angle to the vertical of the attitudes, rad."""
        return float(np.hypot(self.up[0], self.up[1]))

    @property
    def is_significant(self) -> bool:
        """Whether it is more than the noise of two axes explains: not so once in 270 000."""
        return self.size > FIVE_SIGMA * self.std

    def levelled(self, vector: Floats, covariance: Floats) -> tuple[Floats, Floats]:
        """Return a (3,) vector of the frame of the attitudes against the plumb line.

        Args:
            vector: (3,).
            covariance: (3, 3) its covariance, without that of the tilt.
        """
        turned = shortest(self.up, UP)
        leaning = np.cross(np.eye(3)[:2], vector) * self.std
        return turned @ vector, turned @ covariance @ turned.T + leaning.T @ leaning


def tilt_bias(evidence: Evidence, accel: Triad, solver: Accelerometers, tilt: Tilt) -> Floats:
    """Return the errors of a closed form by a tilt, (12,) in the order of the parameters."""

    def solved(up: Floats) -> Floats:
        forces = evidence.site.gravity * np.einsum('skj,k->sj', evidence.attitudes(), up)
        outputs = forces @ accel.response.T + accel.bias
        segments = tuple(
            replace(s, statistics=replace(s.statistics, mean=np.append(s.statistics.mean[:3], y)))
            for s, y in zip(evidence.segments, outputs, strict=True)
        )
        return solver(replace(evidence, segments=segments)).vector()

    return solved(tilt.up) - solved(UP)


def widened_for_tilt(
    evidence: Evidence, accel: Triad, covariance: Floats, solver: Accelerometers, tilt: Tilt
) -> tuple[Floats, list[str]]:
    """Add the effect of a significant tilt to the accelerometers' covariance, and report it.

    It is not corrected: six positions show the tilt about one axis but not about the other, and a
    partly corrected result would not be that of the published formula.

    Args:
        evidence: The session.
        accel: Result of the closed form.
        covariance: (n, n) of all parameters.
        solver: The closed form.
        tilt: Of the table.

    Returns:
        The covariance, and a sentence or none.
    """
    if not tilt.is_significant:
        return covariance, []
    own = slice(12, 24)
    bias = tilt_bias(evidence, accel, solver, tilt)
    std = np.sqrt(np.diag(covariance)[own])
    ratio = np.divide(np.abs(bias), std, out=np.zeros(12), where=std > 0)
    worst = int(np.argmax(ratio))
    if ratio[worst] < _SIGNIFICANT:
        return covariance, []
    widened = covariance.copy()
    widened[own, own] += np.outer(bias, bias)
    return widened, [
        f'The table is tilted by {tilt.size / ARCSEC:.0f} arcsec, which this closed form takes to '
        f'be horizontal: {PARAMETERS[12 + worst].name} is biased by {ratio[worst]:.1f} standard '
        'deviations, and the standard deviations of the accelerometers are widened by that. Level '
        'the table, or take the joint estimate, which estimates the tilt.'
    ]
