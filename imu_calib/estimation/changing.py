"""Which changes a session determines, time constants of warm-ups and instants of steps.

Without terms of a session 12 simulated navigation-grade units that drift, warm up or step have
errors of 1.2 standard deviations (root mean square), up to 6.8, and other terms or outliers are
blamed in a third of them; with these terms of 0.8, up to 3.3.

Source: docs/mathematics.md, 'Terms of a session'.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..common.errors import NotObservable
from ..common.stream import Floats
from ..model.session_terms import Change, Course, names_of
from .components import whiten
from .equations import Equations
from .evidence import Evidence
from .information import (
    Information,
    determined,
    nominal_information,
    segments_in_words,
)
from .modulation import check_temperature, courses, outermost, shapes
from .solve import least_squares

USEFUL_CHANGE = 1e-3
"""Largest useful standard deviation of the change of a scale factor over a session: that of terms,
see `information`."""
_QUARTER = 0.25
"""Time constant or instant for which a plan is evaluated, as a fraction of the session. A choice: a
course that is over within the session."""
_FINE = 17
"""Instants that are tried between the neighbours of the best: eight times as dense as before. It is
repeated while that lowers chi-square by more than one, what its noise is."""
_STEPS = 100  #: Most steps of each fit; one that has not converged by then raises.


def with_changes(
    equations: Equations, changes: Sequence[Change]
) -> tuple[Equations, tuple[Change, ...]]:
    """Let parameters change by the coefficients that a session determines.

    Return the coefficients left out, too.

    Undetermined coefficients of scale factors are left out unless they were requested by name.

    Raises:
        NotObservable: Names what the session does not determine, and what would.
    """
    if not changes:
        return equations, ()
    if any(c.course is Course.THERMAL for c in changes):
        check_temperature(equations.evidence)
    if any(c.course is Course.STEP for c in changes) and not len(
        shapes(equations.evidence, Course.STEP)
    ):
        raise NotObservable(
            f'{segments_in_words(equations.evidence)} do not determine step: not observable. It '
            'takes two static dwells or turns before it and two after; or leave it out (`terms`).'
        )
    changing = replace(equations, changes=tuple(changes), shape=_QUARTER)
    known, parameters = _determined(changing)
    if known.all() and parameters.all():
        return changing, ()
    of_choice = np.array([c.of_scale_factor and not c.by_name for c in changes])
    gone = of_choice & (~known if parameters.all() else True)
    changing = replace(
        changing, changes=tuple(c for c, out in zip(changes, gone, strict=True) if not out)
    )
    known, parameters = _determined(changing)
    if known.all() and parameters.all():
        return changing, tuple(c for c, out in zip(changes, gone, strict=True) if out)
    raise NotObservable(_refusal(changing, known, parameters))


def _determined(equations: Equations) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which coefficients (k,) and parameters (n,) the session determines."""
    found = nominal_information(equations)
    parameters = determined(found, equations.parameters)
    std = found.std[equations.change_slice]
    moves = [change_of(equations, c) for c in equations.changes]
    limits = [USEFUL_CHANGE if c.of_scale_factor else np.inf for c in equations.changes]
    with np.errstate(invalid='ignore'):
        known = np.isfinite(std) & ~(std * moves > limits)
    return known, parameters


def change_of(equations: Equations, change: Change) -> float:
    """Return the change of the parameters by a coefficient of one during the session."""
    return float(np.ptp(courses(equations.evidence, change.course, equations.shape)))


def _refusal(equations: Equations, known: NDArray[np.bool_], parameters: NDArray[np.bool_]) -> str:
    mine = [c.name for c, sure in zip(equations.changes, known, strict=True) if not sure]
    others = [p.name for p, sure in zip(equations.parameters, parameters, strict=True) if not sure]
    apart = f' apart from {", ".join(others)}' if others else ''
    named = f' ({", ".join(mine)})' if mine else ''
    evidence: Evidence = equations.evidence
    return (
        f'{segments_in_words(evidence)} do not determine '
        f'{" and ".join(names_of(equations.changes))}{named}{apart}: not observable. To determine '
        'it takes static dwells with each axis up, down and horizontal at the beginning and at the '
        'end, and turns about each axis there for what changes scale factors of gyros; or leave '
        'it out (`terms`).'
    )


def with_shape(equations: Equations, state: Floats) -> tuple[Equations, Floats]:
    """Choose the likeliest time constant of a warm-up or instant of a step, and solve with it."""
    course = _shaped(equations)
    if course is None:
        return equations, state
    tried = shapes(equations.evidence, course)
    there = replace(equations, shape=float(tried[len(tried) // 2]))
    found = least_squares(state, there.whitened, np.add, _STEPS)
    tried, _, squares = _by_shape(equations, found, course)
    best = replace(equations, shape=float(tried[np.argmin(squares)]))
    return best, least_squares(found, best.whitened, np.add, _STEPS)


def shape_covariance(equations: Equations, state: Floats) -> Floats | None:
    """Return the scatter of the state over likely time constants or instants, (n, n).

    Each is weighted by its likelihood, and an instant by the part of the session that it stands
    for. None without a warm-up or a step. Of 12 simulated sessions with either, of three grades,
    errors are 0.7 of the standard deviations (root mean square), up to 2.8; without this 0.9, up to
    4.4.
    """
    course = _shaped(equations)
    if course is None:
        return None
    tried, states, squares = _by_shape(equations, state, course)
    weights = np.exp(-0.5 * (squares - squares.min()))
    if course is Course.STEP:
        weights *= np.gradient(tried)
    weights /= weights.sum()
    off = states - state
    return np.asarray(np.einsum('k,ki,kj->ij', weights, off, off))


def _shaped(equations: Equations) -> Course | None:
    """Return the course of the equations that has a shape to be found."""
    courses = {change.course for change in equations.changes}
    return next((c for c in (Course.WARM_UP, Course.STEP) if c in courses), None)


def _by_shape(equations: Equations, state: Floats, course: Course) -> tuple[Floats, Floats, Floats]:
    """Return shapes (k,), the states (k, n) with each, and chi-square (k,) there.

    The outputs are linear in the coefficients, so that one step leads to each, and without them
    they are the same for every shape. An instant is searched for ever closer about the best.
    """
    start = state.copy()
    start[equations.change_slice] = 0.0
    jacobian, residuals = equations.whitened(start)
    jacobian = jacobian.copy()
    factor, derivatives = equations.factor(start), equations.jacobian(start)

    def stepped(shape: float) -> tuple[Floats, float]:
        there = replace(equations, shape=shape)
        moved = there.columns(equations.changes, derivatives)
        jacobian[: len(moved), equations.change_slice] = whiten(factor, moved)
        step = Information.from_jacobian(jacobian).gain @ residuals
        remains = residuals - jacobian @ step
        return start + step, float(remains @ remains)

    tried = shapes(equations.evidence, course)
    if course is Course.STEP:
        tried = np.union1d(tried, outermost(equations.evidence))
    found = [stepped(shape) for shape in tried.tolist()]
    states = np.array([state for state, _ in found])
    squares = np.array([square for _, square in found])
    gain = np.inf if course is Course.STEP else 0.0
    while gain > 1.0:
        k = int(np.argmin(squares))
        around = np.linspace(tried[max(0, k - 1)], tried[min(k + 1, len(tried) - 1)], _FINE)
        found = [stepped(shape) for shape in around.tolist()]
        tried = np.concatenate([tried, around])
        order = np.argsort(tried, kind='stable')
        states = np.concatenate([states, [state for state, _ in found]])[order]
        before, squares = squares[k], np.append(squares, [square for _, square in found])[order]
        tried, gain = tried[order], before - squares.min()
    return tried, states, squares
