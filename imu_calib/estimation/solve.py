"""The least squares of the joint estimate: observability and starting point.

Parameters of the sensors, the table's azimuth, its two tilts and the rate between the clocks are
fitted together to every static dwell and every turn of any plan, each output weighted by the noise
of the session.

Source: docs/mathematics.md, 'Joint estimate'.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import numpy as np

from ..common.errors import NotObservable
from ..common.gaussian import FIVE_SIGMA
from ..common.stream import Floats
from ..model.parameters import PARAMETERS
from ..model.sensors import terms_of
from .equations import LEAST_AZIMUTH, Equations
from .excess_scatter import ExcessScatter, excess
from .information import (
    Information,
    advice,
    determined,
    nominal_information,
    undetermined_in_words,
    undetermined_parameters,
    unobservable_in_words,
)
from .session_model import Nuisance

# Gauss-Newton least squares, with Marquardt's damping where a step leads uphill.
# Source: Marquardt 1963, J. SIAM 11, 431; More 1978, Lecture Notes in Mathematics 630, 105, for the
# scaling by the columns' norms.

_CONVERGED = 1e-9
"""Standard deviations, root mean square, of a negligible last step of the prediction. A judgement:
far below any effect, and above rounding."""

_SETTLED = 0.02
"""Standard deviations by which steps may go on moving the prediction, all outputs together, where
they do not become smaller any more or no rounds are left: each would lower chi-square by less than
a thousandth. Causes are rounding in a system of a large condition number, and a heading that the
session does not show: its prior has no pull but shortens every step."""

_SLIGHT = 0.1
"""Standard deviations, all outputs together, of a negligible full step: it would lower chi-square
by a hundredth. Where chi-square instead grows by more than one, its resolution is reached (sessions
without noise): the state is as good as it can be determined."""

_UPHILL = 1e-3
"""Relative growth of chi-square that does not count as uphill: weights follow the state, and change
it. A judgement; growth by one is also allowed, which is less than its noise."""

_ROUNDING = 4 * float(np.finfo(float).eps)
"""Of the longest column: remainder of a step when parameters of size one are rounded. A judgement:
four units in the last place."""

_NO_NEARER = 0.9
"""Of the step before: a step of this length or longer that gains nothing, a thousandth of what the
derivatives promise, oscillates about the minimum. A judgement: steps that shrink by a tenth
converge."""

_DAMPING = 1e-3
"""The first damping, and the least: with columns of norm one it reduces a well-determined step by a
thousandth (Marquardt's lambda)."""

_NOTHING = 1e-4
"""Gain in chi-square of the least damped step below which the iteration ends after a full step
uphill: well-determined parameters have converged, and the others are more curved than their
derivatives show. A hundredth of what `_SLIGHT` allows."""

_STRONGER, _WEAKER = 10.0, 0.1
"""Factors of the damping after a step uphill and after an accepted one (Marquardt's nu = 10)."""

_ARRIVED = 1e-4
"""Standard deviations, all outputs together, of the last of half steps: the remaining distance is a
few of them, a hundredth of what `_SETTLED` allows."""

_STRONGEST = 1e12
"""The damping beyond which a step, by columns of norm one, has no effect: 1e-12 of the gradient."""

State = TypeVar('State')


class NotConverged(NotObservable):
    """The steps of a least squares do not converge."""


def least_squares(
    state: State,
    system: Callable[[State], tuple[Floats, Floats]],
    moved: Callable[[State, Floats], State],
    rounds: int,
) -> State:
    """Minimise the sum of squares of residuals in standard deviations.

    Each round is a full Gauss-Newton step, damped if it leads uphill. A step leads uphill if
    chi-square, with the weights at its end, grows by more than one and a thousandth: more than
    weights that follow the state cause. Where residuals, and with them their
    curvature, are large, steps overshoot the minimum, and may oscillate about it without chi-square
    growing by so much: from then on they are halved. The iteration ends where a step would move the
    prediction by less than a billionth of its standard deviation, or than its rounding, where small
    steps do not become smaller or lead uphill, or where a full step leads uphill and the least
    damped one gains nothing. At the last round, halved steps have converged if a full one would
    hardly move the prediction.

    Where weights follow the state as much as the prediction does, as with axes of a table that lean
    by minutes of arc, chi-square grows towards the point where steps vanish. If the iteration does
    not converge, it is repeated with half steps, judged by their lengths alone.

    Args:
        state: Start of the iteration.
        system: (m, n) derivatives of the prediction at a state and (m,) outputs less it, both in
            standard deviations.
        moved: Function that returns the state moved by an (n,) step.
        rounds: Most steps.
    """
    begin = state
    jacobian, residuals = system(state)
    damping, share, before = 0.0, 1.0, np.inf
    for _ in range(rounds):
        step = linear_step(jacobian, residuals, damping)
        change = float(np.linalg.norm(jacobian @ step))
        tried = moved(state, share * step)
        rounding = _ROUNDING * float(np.linalg.norm(jacobian, axis=0).max())
        if not damping and change < _CONVERGED * np.sqrt(len(residuals)):
            # Not the end of the step, which is as good: here the derivatives are known.
            return state
        if not damping and (_settled(change, before, share) or change < rounding):
            return tried
        no_nearer, before = change > before * _NO_NEARER, change
        # A step may lead beyond all numbers: it is then taken back, as one that leads uphill.
        with np.errstate(over='ignore', invalid='ignore'):
            ahead = system(tried)
        gained = _square(residuals) - _square(ahead[1])
        if damping == _DAMPING and abs(gained) < _NOTHING:
            return tried if gained > 0 else state
        if _square(ahead[1]) <= _square(residuals) * (1 + _UPHILL) + 1:
            state, (jacobian, residuals) = tried, ahead
            damping = damping * _WEAKER if damping * _WEAKER >= _DAMPING else 0.0
            if no_nearer and gained < _UPHILL * change**2:
                damping, share = 0.0, share / 2
        elif not damping and change < _SLIGHT:
            return state
        else:
            damping = max(_DAMPING, damping * _STRONGER)
            if damping > _STRONGEST:
                break
    if not damping and _settled(change):
        return state
    return _by_half_steps(begin, system, moved, rounds)


def _settled(change: float, before: float = 0.0, share: float = 1.0) -> bool:
    """Return whether a full step hardly matters, and is hardly shorter than the one before.

    `share` is the part of each step that was taken. Without an earlier step only the first counts.
    """
    return before * (1 - share / 2) < change < _SETTLED


def _by_half_steps(
    state: State,
    system: Callable[[State], tuple[Floats, Floats]],
    moved: Callable[[State, Floats], State],
    rounds: int,
) -> State:
    """Go on by half steps, judged by their lengths alone, as `least_squares`."""
    change = before = np.inf
    for _ in range(rounds):
        with np.errstate(over='ignore', invalid='ignore'):
            jacobian, residuals = system(state)
        if not np.isfinite(jacobian.sum() + residuals.sum()):
            # Steps that nothing holds back have led beyond all numbers.
            break
        step = linear_step(jacobian, residuals)
        # Beyond half of the exponents a square is infinite: the loop ends with the next step.
        with np.errstate(over='ignore', invalid='ignore'):
            change, before = float(np.linalg.norm(jacobian @ step)), change
        if change < _ARRIVED or _settled(change, before, 0.5):
            return state
        state = moved(state, step / 2)
    else:
        if _settled(change):
            return state
    raise NotConverged(
        f'The least squares did not converge in {rounds} steps (the last would still move the '
        f'outputs by {change / np.sqrt(len(residuals)):.2g} of their standard deviations): no '
        'parameter can be stated. The data contradicts the model, or starts too far from it: '
        "check scale factors and units of the IMU's description, the attitudes of the plan and the "
        'axes, and where the plan has a closed form look at the residuals of a calibration by it.'
    )


def linear_step(jacobian: Floats, residuals: Floats, damping: float = 0.0) -> Floats:
    """Return the least-squares step (n,), the shortest by columns of norm one."""
    norms = np.linalg.norm(jacobian, axis=0)
    scale = np.where(norms > 0, norms, 1.0)
    columns = jacobian / scale
    if damping:
        n = len(scale)
        columns = np.vstack([columns, np.sqrt(damping) * np.eye(n)])
        residuals = np.concatenate([residuals, np.zeros(n)])
    return np.asarray(np.linalg.lstsq(columns, residuals, rcond=None)[0] / scale)


def _square(residuals: Floats) -> float:
    return float(residuals @ residuals) if np.isfinite(residuals).all() else np.inf


STARTS = 8
"""Headings from which the fit is started where north is unknown: the nearest is at most 22.5 deg
off, an angle that equals its sine to 3 %."""

ITERATIONS = 100
"""Most steps. With very noisy gyros a step reduces the error of the heading by only a fifth."""

_TILTED = 4.0
"""Standard deviations of the levelling beyond which a tilt is significant: exceeded by normal noise
once in 16 000."""


def check_observable(equations: Equations) -> None:
    """Raise if a session does not determine all parameters, or lacks a rate test."""
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
    angles = [0.0] if known else [k * 2 * np.pi / STARTS for k in range(STARTS)]
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
    """Iterate to the least squares, each output by its covariance."""
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
    covariance = Information.from_jacobian(drifting.whitened(state)[0]).covariance
    far = max(FIVE_SIGMA * float(np.sqrt(covariance[azimuth, azimuth])), LEAST_AZIMUTH)
    return free if abs(state[azimuth]) > far else equations
