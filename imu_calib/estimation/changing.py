"""Which changes a session determines, and the time constant of a warm-up.

Source: docs/mathematics.md, 'Terms of a session'.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..errors import NotObservable
from ..model.session_terms import Change, Course, names_of
from ..observation.equations import Equations
from ..observation.evidence import Evidence
from ..observation.information import (
    Information,
    determined,
    nominal_information,
    segments_in_words,
)
from ..observation.modulation import TIME_CONSTANTS, check_temperature, courses
from ..stream import Floats
from .converge import least_squares

USEFUL_CHANGE = 1e-3
"""Largest useful standard deviation of the change of a scale factor over a session: that of terms,
see `information`."""

_QUARTER = 0.25
"""The time constant for which a plan is evaluated, as a fraction of the session."""

_STEPS = 100
"""Most steps of each fit; one that has not converged by then raises."""


def with_changes(
    equations: Equations, changes: Sequence[Change]
) -> tuple[Equations, tuple[Change, ...]]:
    """Let parameters change by the coefficients that a session determines.

    Undetermined coefficients of scale factors are left out unless they were requested by name.

    Returns:
        The equations, and the coefficients left out.

    Raises:
        NotObservable: Names what the session does not determine, and what would.
    """
    if not changes:
        return equations, ()
    if any(c.course is Course.THERMAL for c in changes):
        check_temperature(equations.evidence)
    changing = replace(equations, changes=tuple(changes), time_constant=_QUARTER)
    known, parameters = _determined(changing)
    if known.all() and parameters.all():
        return changing, ()
    of_choice = np.array([c.of_scale_factor and not c.asked for c in changes])
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
    std = np.sqrt(np.diag(found.covariance)[equations.changing])
    moves = [change_of(equations, c) for c in equations.changes]
    limits = [USEFUL_CHANGE if c.of_scale_factor else np.inf for c in equations.changes]
    with np.errstate(invalid='ignore'):
        known = np.isfinite(std) & ~(std * moves > limits)
    return known, parameters


def change_of(equations: Equations, change: Change) -> float:
    """Return the change of the parameters by a coefficient of one during the session."""
    return float(np.ptp(courses(equations.evidence, change.course, equations.time_constant)))


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


def with_time_constant(equations: Equations, state: Floats) -> tuple[Equations, Floats]:
    """Choose the likeliest time constant of a warm-up, and solve with it.

    Args:
        equations: With or without a warm-up.
        state: (n,) to start from.
    """
    if not _warming(equations):
        return equations, state
    best: tuple[float, Equations, Floats] | None = None
    for fraction in TIME_CONSTANTS.tolist():
        there = replace(equations, time_constant=fraction)
        found = least_squares(state, there.whitened, np.add, _STEPS)
        left = there.whitened(found)[1]
        if best is None or float(left @ left) < best[0]:
            best = float(left @ left), there, found
    assert best is not None
    return best[1], best[2]


def doubt_of_time_constant(equations: Equations, state: Floats) -> Floats | None:
    """Return the scatter of the state over likely time constants, (n, n); None without a warm-up.

    Each is weighted by its likelihood; the outputs are linear in the coefficients, so that one step
    leads to each.
    """
    if not _warming(equations):
        return None
    steps, squares = [], []
    for fraction in TIME_CONSTANTS.tolist():
        there = replace(equations, time_constant=fraction)
        start = state.copy()
        start[equations.changing] = 0.0
        jacobian, left = there.whitened(start)
        step = Information.of(jacobian).gain @ left
        remains = left - jacobian @ step
        steps.append(start + step - state)
        squares.append(float(remains @ remains))
    weights = np.exp(-0.5 * (np.array(squares) - min(squares)))
    weights /= weights.sum()
    off = np.array(steps)
    return np.asarray(np.einsum('k,ki,kj->ij', weights, off, off))


def _warming(equations: Equations) -> bool:
    return any(c.course is Course.WARM_UP for c in equations.changes)
