"""Effect of a temperature change during a session on parameters taken as constant."""

from __future__ import annotations

import numpy as np
import scipy

from ..common.units import PPM, significant
from ..model.parameters import TRIADS, ParameterKind
from ..model.session_terms import Course, change
from .estimate import Estimate
from .modulation import temperatures, warms

_CHEAPEST = 200 * PPM
"""Scale factor per kelvin of the cheapest units (MPU-9150: 0.02 % of the accelerometers). Where
that does not move a parameter by its standard deviation, nothing is reported."""


def temperature_finding(found: Estimate) -> list[str]:
    """Report the change of the temperature, and its effect where no term follows it.

    Returns:
        One finding, or none.
    """
    equations, evidence = found.equations, found.equations.evidence
    if not warms(evidence) or any(c.of_scale_factor for c in equations.changes):
        return []
    seen = temperatures(evidence)
    known, unknown = [], []
    for letter, words in TRIADS.items():
        stated = float(evidence.thermal['ga'.index(letter), 0])
        if stated:
            known.append(f'{significant(stated / PPM, 3)} ppm/K of the {words}s')
        elif (moved := _moved(found, letter))[1] * _CHEAPEST > 1:
            unknown.append(
                f'of {words}s that follow it by {significant(1 / moved[1] / PPM)} ppm/K '
                f'({moved[0]})'
            )
    if not known and not unknown:
        return []
    sentences = [
        f'The temperature moved by {np.ptp(seen):.2g} K during the session (from {seen.min():.1f} '
        f'to {seen.max():.1f} degC), and K and D are estimated as if they did not follow it.'
    ]
    if known:
        sentences.append(
            f'The standard deviations allow for the {" and ".join(known)} that the description of '
            'the IMU states for scale factors.'
        )
    if unknown:
        sentences.append(
            'The description of the IMU states no scale_factor_temperature: scale factors '
            f'{" or ".join(unknown)} are already off by a standard deviation.'
        )
    return [
        ' '.join([*sentences, 'The terms thermal or trend (`terms`) estimate what follows it.'])
    ]


def _moved(found: Estimate, letter: str) -> tuple[str, float]:
    """Return the scale factor that a common coefficient moves most, and by how many deviations.

    Per 1/K of the coefficient.
    """
    equations = found.equations
    names = equations.parameters
    factor = equations.factor(found.state)
    one = equations.columns(
        [change(Course.THERMAL, f'K_{letter}')], equations.jacobian(found.state)
    )
    moved = scipy.linalg.solve_triangular(factor, one[:, 0], lower=True)
    shifts = found.gain[: len(names), : len(moved)] @ moved
    own = [k for k, p in enumerate(names) if p.kind is ParameterKind.SCALE_FACTOR_ERROR]
    far = np.abs(shifts[own]) / np.sqrt(np.diag(found.covariance)[own])
    return names[own[int(np.argmax(far))]].name, float(far.max())
