"""The least squares of the joint estimate: observability and starting point.

Parameters of the sensors, the table's azimuth, its two tilts and the rate between the clocks are
fitted together to every static dwell and every turn of any plan, each output weighted by the noise
of the session.

Source: docs/mathematics.md, 'Joint estimate'.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..common.errors import NotObservable
from ..common.rotations import FIVE_SIGMA
from ..common.stream import Floats
from ..model.parameters import PARAMETERS
from ..model.sensors import terms_of
from .converge import least_squares, linear_step
from .equations import LEAST_AZIMUTH, Equations
from .excess_scatter import ExcessScatter, excess
from .information import (
    Information,
    determined,
    nominal_information,
    undetermined_in_words,
    unobservable_in_words,
)
from .lacking import advice, undetermined_parameters
from .session_model import Nuisance

_STARTS = 8
"""Headings from which the fit is started where north is unknown: the nearest is at most 22.5 deg
off, an angle that equals its sine to 3 %."""

ITERATIONS = 100
"""Most steps. With very noisy gyros a step reduces the error of the heading by only a fifth."""

_TILTED = 4.0
"""Standard deviations of the levelling beyond which a tilt is significant: exceeded by normal noise
once in 16 000."""


def check_observable(equations: Equations) -> None:
    """Raise if a session does not determine all parameters, or lacks a rate test.

    Raises:
        NotObservable: Names the parameters and what is missing.
    """
    evidence = equations.evidence
    plain = replace(equations, parameters=PARAMETERS)
    open_ones = undetermined_parameters(plain)
    if open_ones.any():
        text = unobservable_in_words(evidence, open_ones)
        # The plan itself states what is missing of it.
        raise NotObservable(text if evidence.plan.is_stated else f'{text} {advice(plain)}')
    if equations.parameters != PARAMETERS:
        _check_terms(equations)


def _check_terms(equations: Equations) -> None:
    """Raise if terms are not determined, though the session determines the 24 parameters."""
    parameters = equations.parameters
    known = determined(nominal_information(equations), parameters)
    missing = [p for p, sure in zip(parameters, known, strict=True) if not sure]
    if not missing:
        return
    terms = terms_of(missing) or terms_of(parameters)
    raise NotObservable(
        ' '.join(undetermined_in_words(equations.evidence, term, missing) for term in terms)
    )


def start(equations: Equations) -> Floats:
    """Solve for the sensors at headings all around, where they are linear; return the best."""
    known = equations.north_known
    angles = [0.0] if known else [k * 2 * np.pi / _STARTS for k in range(_STARTS)]
    best, smallest = equations.nominal(), np.inf
    # Weights hardly depend on the heading.
    factor = equations.factor(best)
    for angle in angles:
        state = equations.nominal()
        state[equations.sensors + Nuisance.AZIMUTH] = angle
        # Nothing is assumed of the table yet; lever arms are bounded only against absurd lengths.
        priors = len(equations.outputs) + np.arange(len(Nuisance))
        rows = np.delete(equations.whitened_by(factor, state), priors, axis=0)
        columns, residuals = rows[:, :-1], rows[:, -1]
        first = equations.sensors
        columns[:, [first + which for which in Nuisance if which or known]] = 0.0
        columns[:, equations.change_slice] = 0.0
        step = linear_step(columns, residuals)
        rest = residuals - columns @ step
        if (square := float(rest @ rest)) < smallest:
            best, smallest = state + step, square
    return best


def fit(equations: Equations, state: Floats) -> Floats:
    """Iterate to the least squares, each output by its covariance.

    Raises:
        NotObservable: The iteration does not converge.
    """
    state = least_squares(state, equations.whitened, np.add, ITERATIONS)
    azimuth = equations.sensors + Nuisance.AZIMUTH
    if abs(state[azimuth]) > np.pi:
        state = state.copy()
        state[azimuth] = (state[azimuth] + np.pi) % (2 * np.pi) - np.pi
    return state


def with_scatter(equations: Equations, scatter: ExcessScatter) -> Equations:
    """Return the equations with the scatter in their covariance."""
    return replace(equations, extra=scatter.extra, positioning=scatter.positioning)


def levelled(equations: Equations, state: Floats) -> Equations:
    """Widen the prior of the levelling to what the session shows.

    Six positions see one tilt but not the other: if the first is many times the assumed levelling,
    the other may be as large.
    """
    first = equations.sensors + Nuisance.TILT_X
    seen = float(np.abs(state[first : first + 2]).max())
    level = equations.evidence.levelling
    return replace(equations, levelled=seen) if seen > _TILTED * level else equations


def headed(equations: Equations, state: Floats) -> Equations:
    """Use the azimuth given unless the gyros contradict it."""
    if not equations.north_known:
        return equations
    free = replace(equations, any_heading=True)
    azimuth = equations.sensors + Nuisance.AZIMUTH
    state = fit(free, state)
    # Drifting biases change the apparent north: for cheap gyros by as much as their noise.
    drifting = with_scatter(free, excess(free, state))
    state = fit(drifting, state)
    covariance = Information.of(drifting.whitened(state)[0]).covariance
    far = max(FIVE_SIGMA * float(np.sqrt(covariance[azimuth, azimuth])), LEAST_AZIMUTH)
    return free if abs(state[azimuth]) > far else equations
