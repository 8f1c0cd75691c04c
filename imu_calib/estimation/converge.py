"""Gauss-Newton to the least squares, with Marquardt's damping where a step leads uphill.

Source: Marquardt 1963, J. SIAM 11, 431; More 1978, Lecture Notes in Mathematics 630, 105, for the
scaling by the columns' norms.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from ..errors import NotObservable
from ..stream import Floats

_CONVERGED = 1e-9
"""Standard deviations, root mean square, by which a last step may move the prediction: far below
all that counts."""

_SETTLED = 0.02
"""Standard deviations by which steps may go on moving the prediction, all outputs together, where
they do not become smaller any more: each would lower chi-square by less than a thousandth. Rounding
in a system of a large condition number does so, and a heading that the session does not show: its
prior, which pulls nowhere, holds every step back."""

_SLIGHT = 0.1
"""Standard deviations, all outputs together, of a full step that does not matter: it would lower
chi-square by a hundredth. Where chi-square grows by more than one instead, it is not resolved any
finer (sessions without noise): the state is as good as it can be determined."""

_UPHILL = 1e-3
"""Relative growth of chi-square that is no way uphill: weights follow the state, and change it. A
judgement; by one it may grow besides, which is less than noise makes of it."""

_ROUNDING = 4 * float(np.finfo(float).eps)
"""Of the longest column: what remains of a step when parameters of the size of one are rounded."""

_NO_NEARER = 0.9
"""Of the step before: one as long that gains nothing, a thousandth of what the derivatives promise,
goes round the minimum. A judgement: what shrinks by a tenth arrives."""

_DAMPING = 1e-3
"""The first damping, and the least: next to columns of norm one it takes a thousandth off a step
that is well determined (Marquardt's lambda)."""

_NOTHING = 1e-4
"""Of chi-square, that the least damped step gains where the full one before led uphill: what is
well determined has arrived, and what is not is more curved than its derivatives say. A hundredth
of what `_SLIGHT` lets pass."""

_STRONGER, _WEAKER = 10.0, 0.1
"""Factors of the damping after a step uphill and one that was taken (Marquardt's nu = 10)."""

_ARRIVED = 1e-4
"""Standard deviations, all outputs together, of the last of half steps: what is left of the way is
a few of them, a hundredth of what `_SETTLED` lets pass."""

_STRONGEST = 1e12
"""Beyond, a step is the gradient (by columns of norm one) over the damping, and moves nothing."""

State = TypeVar('State')


class NotConverged(NotObservable):
    """The steps of a least squares do not come to an end."""


def least_squares(
    state: State,
    system: Callable[[State], tuple[Floats, Floats]],
    moved: Callable[[State, Floats], State],
    rounds: int,
) -> State:
    """Minimise the sum of squares of residuals in standard deviations.

    Each round is a full Gauss-Newton step unless it leads uphill: chi-square, weighed anew at its
    end, would grow by more than one and a thousandth, which weights that follow the state do not
    make of it. Then it is damped until it does not. Where residuals are large, and their curvature
    with them, steps go beyond the minimum, and may go round it without chi-square growing by so
    much: from then on they are halved. It ends where a step would move the prediction
    by less than a billionth of its standard deviation, or than its rounding, or where small steps
    do not become smaller or lead uphill, or where a full step leads uphill and the least damped one
    gains nothing. Where rounds end, halved steps have arrived if a full one would hardly move.

    Where weights follow the state as much as the prediction does, as beside axes of a table that
    lean by minutes of arc, chi-square grows on the way to where steps vanish. What does not arrive
    by it begins anew with half steps, whose lengths alone are looked at.

    Args:
        state: Where to start.
        system: (m, n) derivatives of the prediction at a state and (m,) outputs less it, both in
            standard deviations.
        moved: The state moved by an (n,) step.
        rounds: Most steps.

    Raises:
        NotConverged: The steps do not come to an end.
    """
    begin = state
    jacobian, left = system(state)
    damping, share, before = 0.0, 1.0, np.inf
    for _ in range(rounds):
        step = linear_step(jacobian, left, damping)
        change = float(np.linalg.norm(jacobian @ step))
        tried = moved(state, share * step)
        rounding = _ROUNDING * float(np.linalg.norm(jacobian, axis=0).max())
        settled = before * (1 - share / 2) < change < _SETTLED
        if not damping and change < _CONVERGED * np.sqrt(len(left)):
            # Not where the step leads, which is as good: here the derivatives are known.
            return state
        if not damping and (settled or change < rounding):
            return tried
        no_nearer, before = change > before * _NO_NEARER, change
        ahead = system(tried)
        gained = _square(left) - _square(ahead[1])
        if damping == _DAMPING and abs(gained) < _NOTHING:
            return tried if gained > 0 else state
        if _square(ahead[1]) <= _square(left) * (1 + _UPHILL) + 1:
            state, (jacobian, left) = tried, ahead
            damping = damping * _WEAKER if damping * _WEAKER >= _DAMPING else 0.0
            if no_nearer and gained < _UPHILL * change**2:
                damping, share = 0.0, share / 2
        elif not damping and change < _SLIGHT:
            return state
        else:
            damping = max(_DAMPING, damping * _STRONGER)
            if damping > _STRONGEST:
                break
    if not damping and change < _SETTLED:
        return state
    state = begin
    for _ in range(rounds):
        jacobian, left = system(state)
        step = linear_step(jacobian, left)
        change = float(np.linalg.norm(jacobian @ step))
        if change < _ARRIVED:
            return state
        state = moved(state, step / 2)
    raise NotConverged(
        f'The least squares did not converge in {rounds} steps (the last would still move the '
        f'outputs by {change / np.sqrt(len(left)):.2g} of their standard deviations): no '
        'parameter can be stated. The data contradicts the model, or starts too far from it: '
        "check scale factors and units of the IMU's description, the attitudes of the plan and the "
        'axes, and where the plan has a closed form look at the residuals of a calibration by it.'
    )


def linear_step(jacobian: Floats, left: Floats, damping: float = 0.0) -> Floats:
    """Return the step (n,) that least squares take, the shortest by columns of norm one."""
    norms = np.linalg.norm(jacobian, axis=0)
    scale = np.where(norms > 0, norms, 1.0)
    columns = jacobian / scale
    if damping:
        n = len(scale)
        columns = np.vstack([columns, np.sqrt(damping) * np.eye(n)])
        left = np.concatenate([left, np.zeros(n)])
    return np.asarray(np.linalg.lstsq(columns, left, rcond=None)[0] / scale)


def _square(left: Floats) -> float:
    return float(left @ left) if np.isfinite(left).all() else np.inf
