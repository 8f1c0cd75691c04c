"""What a temperature that moves during a session means for parameters taken as constant."""

from __future__ import annotations

import numpy as np
import scipy

from ..model import TRIADS, ParameterKind
from ..model.session_terms import Course, change
from ..units import PPM
from .fit import Estimate
from .modulation import LEAST_RISE, temperatures

_CHEAPEST = 200 * PPM
"""Scale factor per kelvin of the cheapest units (MPU-9150: 0.02 % of the accelerometers). Where
that does not move a parameter by its standard deviation there is nothing to say."""


def moved_temperature(found: Estimate) -> list[str]:
    """Say by how much the temperature moved, and what that means where no term follows it.

    Returns:
        One sentence, or none.

    """
    equations, evidence = found.equations, found.equations.evidence
    if evidence.temperature is None or any(c.of_scale_factor for c in equations.changes):
        return []
    seen = temperatures(evidence)
    if np.ptp(seen) < LEAST_RISE:
        return []
    words = [text for letter in TRIADS if (text := _words(found, letter))]
    if not words:
        return []
    return [
        f'The temperature moved by {np.ptp(seen):.2g} K during the session (from {seen.min():.1f} '
        f'to {seen.max():.1f} degC), and K and D are estimated as if they had not: '
        f'{"; ".join(words)}. --terms thermal, or trend, estimates what follows it.'
    ]


def _words(found: Estimate, letter: str) -> str:
    """Say which scale factor per kelvin moves a parameter by its deviation, and what is stated."""
    equations = found.equations
    names = equations.parameters
    factor = np.linalg.cholesky(equations.covariance(found.state))
    one = equations.columns(
        [change(Course.THERMAL, f'K_{letter}')], equations.jacobian(found.state)
    )
    moved = scipy.linalg.solve_triangular(factor, one[:, 0], lower=True)
    shifts = found.gain[: len(names), : len(moved)] @ moved
    own = [k for k, p in enumerate(names) if p.kind is ParameterKind.SCALE_FACTOR_ERROR]
    far = np.abs(shifts[own]) / np.sqrt(np.diag(found.covariance)[own])
    worst, most = own[int(np.argmax(far))], float(far.max())
    known = float(equations.evidence.thermal['ga'.index(letter), 0])
    if known:
        return (
            f'the description of the IMU states {known / PPM:.3g} ppm/K for the scale factors of '
            f'the {TRIADS[letter]}s, which is in the standard deviations'
        )
    if most * _CHEAPEST < 1:
        return ''
    return (
        f'scale factors of the {TRIADS[letter]}s that follow it by {1 / most / PPM:.2g} ppm/K move '
        f'{names[worst].name} by its standard deviation, and the description of the IMU states '
        'none (scale_factor_temperature)'
    )
