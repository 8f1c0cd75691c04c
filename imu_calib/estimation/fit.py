"""The least squares behind the joint estimate: what they can observe, and where they start.

Parameters of the sensors, the table's azimuth, its two tilts and the rate between the clocks are
fitted together to every static dwell and every turn of any plan, each output by the noise that the
session shows.

Source: docs/mathematics.md, 'Joint estimate'.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..errors import NotObservable
from ..model import PARAMETERS, terms_of
from ..observation.equations import Equations
from ..observation.information import (
    Information,
    determined,
    nominal_information,
    undetermined_in_words,
    unobservable_in_words,
)
from ..observation.lacking import advice, lacking_parameters
from ..observation.session_model import Nuisance
from ..stream import Floats
from ..units import DEG
from .converge import least_squares, linear_step
from .excess_scatter import ExcessScatter, excess

_STARTS = 8
"""Headings from which the fit is started where north is unknown: the nearest is 22.5 deg off at
most, an angle that its sine comes to within 3 %."""

_ITERATIONS = 100
"""Most steps. Gyros of much noise hardly see north: a step then takes a fifth off its error."""

_TILTED = 4.0
"""Standard deviations of the levelling beyond which a tilt is no chance: normal noise passes them
once in 16 000."""

_CONTRADICTION = 5.0
"""Standard deviations by which gyros must contradict a stated azimuth for it to be dropped: normal
noise passes them once in 1.7 million."""

_LEAST_AZIMUTH = 0.05 * DEG
"""Least contradiction of a stated azimuth, rad: one written to a tenth of a degree is off by so
much through rounding."""


def check_observable(equations: Equations) -> None:
    """Refuse a session that leaves parameters open, or lacks a rate test.

    Raises:
        NotObservable: Names the parameters and what is missing.
    """
    evidence = equations.evidence
    plain = replace(equations, parameters=PARAMETERS)
    open_ones = lacking_parameters(plain)
    if open_ones.any():
        text = unobservable_in_words(evidence, open_ones)
        # A plan says itself what is missing of it.
        raise NotObservable(text if evidence.plan.is_stated else f'{text} {advice(plain)}')
    if equations.parameters != PARAMETERS:
        _check_terms(equations)


def _check_terms(equations: Equations) -> None:
    """Refuse terms that the session leaves open, though it determines the 24 parameters."""
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
    """Solve for the sensors at headings all around, where they are linear; take the best."""
    known = equations.north_known
    angles = [0.0] if known else [k * 2 * np.pi / _STARTS for k in range(_STARTS)]
    best, smallest = equations.nominal(), np.inf
    # Weights hardly depend on the heading.
    factor = equations.factor(best)
    for angle in angles:
        state = equations.nominal()
        state[equations.sensors + Nuisance.AZIMUTH] = angle
        # Of the table nothing is taken as known yet, of lever arms that they are no kilometres.
        priors = len(equations.outputs) + np.arange(len(Nuisance))
        rows = np.delete(equations.whitened_by(factor, state), priors, axis=0)
        columns, left = rows[:, :-1], rows[:, -1]
        first = equations.sensors
        columns[:, [first + which for which in Nuisance if which or known]] = 0.0
        columns[:, equations.changing] = 0.0
        step = linear_step(columns, left)
        rest = left - columns @ step
        if (square := float(rest @ rest)) < smallest:
            best, smallest = state + step, square
    return best


def fit(equations: Equations, state: Floats) -> Floats:
    """Iterate to the least squares, each output by its covariance.

    Raises:
        NotObservable: The iteration does not converge.
    """
    state = least_squares(state, equations.whitened, np.add, _ITERATIONS)
    azimuth = equations.sensors + Nuisance.AZIMUTH
    if abs(state[azimuth]) > np.pi:
        state = state.copy()
        state[azimuth] = (state[azimuth] + np.pi) % (2 * np.pi) - np.pi
    return state


def with_scatter(equations: Equations, scatter: ExcessScatter) -> Equations:
    """Return the equations with what scatters in their covariance."""
    return replace(equations, extra=scatter.extra, positioning=scatter.positioning)


def levelled(equations: Equations, state: Floats) -> Equations:
    """Trust the levelling no further than the session bears it out.

    Six positions see one tilt and not the other: where the one is many times what was assumed, so
    may the other be.
    """
    first = equations.sensors + Nuisance.TILT_X
    seen = float(np.abs(state[first : first + 2]).max())
    level = equations.evidence.levelling
    return replace(equations, levelled=seen) if seen > _TILTED * level else equations


def headed(equations: Equations, state: Floats) -> Equations:
    """Trust the azimuth given unless the gyros contradict it."""
    if not equations.north_known:
        return equations
    free = replace(equations, any_heading=True)
    azimuth = equations.sensors + Nuisance.AZIMUTH
    state = fit(free, state)
    # Biases that drift see north elsewhere: of cheap gyros by as much as their noise.
    drifting = with_scatter(free, excess(free, state))
    state = fit(drifting, state)
    covariance = Information.of(drifting.whitened(state)[0]).covariance
    far = max(_CONTRADICTION * float(np.sqrt(covariance[azimuth, azimuth])), _LEAST_AZIMUTH)
    return free if abs(state[azimuth]) > far else equations
