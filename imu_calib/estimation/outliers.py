"""Outliers of a session: dwells, turns and moves that get less weight, or none.

Source: docs/mathematics.md, 'Joint estimate'.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import scipy
from numpy.typing import NDArray

from ..common.budget import ErrorSource, effective_freedom
from ..common.stream import Floats
from ..common.units import DEG
from ..model.parameters import RESPONSES
from ..segmentation.segmented import Move
from .components import Component, whiten
from .equations import Equations
from .evidence import SMALLEST_VARIANCE, Evidence
from .excess_scatter import excess, scatter_of_motions
from .information import Information
from .solve import ITERATIONS, fit, least_squares, linear_step, with_scatter

_OUTLYING = 1e-6
"""Chance by which a sound dwell or turn gets less weight: with fifty of them, one session in 20 000
loses one. Noise is known by the blocks of the session alone, thirty-odd degrees of freedom for
twelve positions of 40 s: the chance is that of F, 60 times that of chi-square."""

_EXACT = 1e6
"""Degrees of freedom that represent infinity: F is then that of a known variance, to three parts in
10^4 at that chance."""

_SUSPECT = 1e-5
"""Chance below which the worst of them is tested closely: ten times the final chance, since the
first test is under scatter that an outlier itself has widened."""

_UNLIKE = 1e-4
"""Chance by which consistent turns about an axis get less weight: of three axes and three channels,
in one session of a thousand."""

_ASTRAY = 1e-9
"""Chance by which a sound move is left out, by noise and the uncertainty of the rest. Far smaller
than that of an outlier: positioning errors common to both are counted twice."""

_LOOSE = 0.1
"""Standard deviation, a ratio, beyond which dwells and turns do not determine the response of the
gyros: that of the cheapest units is 3 % off the nominal one."""

MOST_OUTLIERS = 1 / 3
"""Share of a session's dwells, or of the turns about an axis, that may get less weight. A
judgement: where more disagree, the data does not show which of them are right."""

_RANK = 1e-6
"""Least eigenvalue, of a matrix with ones on its diagonal, of a direction that an outlier can have:
rounding leaves 1e-16, and a direction with a smaller one is absorbed by the state. A judgement
between."""

_LEFT_OUT = 1e8
"""Factor on the variance of an output that is left out: its weight is then practically zero, and
half the digits of a 64-bit number remain for the others."""


@dataclass(frozen=True, eq=False)
class Outlier:
    """A static dwell or a turn that contradicts the rest."""

    name: str  #: Position and kind, for messages.
    rows: NDArray[np.intp]  #: Its rows among the equations.
    chi_square: float  #: Decrease of chi-square without it.


@dataclass(frozen=True)
class RejectedMove:
    """A move that is left out, or its velocity alone."""

    positions: tuple[str, str]  #: Its two ends.
    #: Difference of its end by the gyros from the encoders, rad; or velocity by the accelerometers
    #: at its end, where the unit is at rest, m/s.
    misclosure: float
    velocity: bool = False  #: Whether only the velocity is left out.


def moves_that_fit(
    resting: Equations, state: Floats, moves: tuple[Move, ...]
) -> tuple[Evidence, tuple[RejectedMove, ...]]:
    """Choose the moves that agree with dwells and turns: return the session with them.

    `resting` is the session without moves, `state` its solution.

    A gyro beyond its range or nonlinear, or a table whose joints differ from its description, makes
    errors of many times the noise within seconds: such a move must not affect the parameters.
    """
    evidence = replace(resting.evidence, moves=moves)
    if not len(evidence.used_moves):
        return resting.evidence, ()
    scatter = excess(resting, state)
    kept: tuple[Move, ...] = ()
    while True:
        shaken = scatter_of_motions(evidence, scatter.in_motion)
        fitting, astray = _judged(with_scatter(resting, scatter), state, evidence, extra=shaken)
        if not astray:
            return evidence, ()
        if _count(fitting) <= _count(kept):
            return replace(evidence, moves=fitting), astray
        # Moves show positioning errors hidden in the noise of dwells, and how much motors shake the
        # unit: with those, others may agree.
        kept = fitting
        found = excess(replace(resting, evidence=replace(evidence, moves=kept)), state)
        scatter = replace(scatter, positioning=found.positioning, in_motion=found.in_motion)


def start_from_moves(resting: Equations, state: Floats, moves: tuple[Move, ...]) -> Floats:
    """Return a state to start from where only moves determine the response of the gyros.

    By the Earth's rotation alone that of cheap gyros is off by more than itself, too far for moves,
    whose rotations are not linear in it. It is then taken to be near the nominal one, and
    determined by the rotations that agree with that.
    """
    parameters = resting.parameters
    own = np.array([k for k, p in enumerate(parameters) if p.triad == 'g' and p in RESPONSES])
    turned = tuple(replace(move, velocity_steps=None) for move in moves)
    evidence = replace(resting.evidence, moves=turned)
    variances = np.diag(Information.from_jacobian(resting.whitened(state)[0]).covariance)[own]
    if not len(evidence.used_moves) or (variances < _LOOSE**2).all():
        return state
    rows = np.zeros((len(own), len(state)))
    rows[np.arange(len(own)), own] = 1 / _LOOSE

    def near_nominal(at: Floats) -> tuple[Floats, Floats]:
        jacobian, residuals = resting.whitened(at)
        return np.vstack([jacobian, rows]), np.append(residuals, -at[own] / _LOOSE)

    begin = state.copy()
    begin[own] = 0.0
    state = least_squares(begin, near_nominal, np.add, ITERATIONS)
    known = Information.from_jacobian(near_nominal(state)[0]).covariance
    fitting, _ = _judged(resting, state, evidence, known)
    return fit(replace(resting, evidence=replace(evidence, moves=fitting)), state)


def _count(moves: Sequence[Move]) -> int:
    return sum(1 if move.velocity_steps is None else 2 for move in moves)


def _judged(
    resting: Equations,
    state: Floats,
    evidence: Evidence,
    known: Floats | None = None,
    extra: tuple[Component, ...] = (),
) -> tuple[tuple[Move, ...], tuple[RejectedMove, ...]]:
    """Compare each move with dwells and turns, with their stated scatter.

    `known` is the covariance (n, n) of the state, by dwells and turns if not given; `extra` is
    scatter of the moves.
    """
    if known is None:
        known = Information.from_jacobian(resting.whitened(state)[0]).covariance
    moving = replace(resting, evidence=evidence, extra=extra)
    predicted, jacobian = moving.predict(state), np.nan_to_num(moving.jacobian(state))
    covariance, known = moving.covariance(state), np.nan_to_num(known)
    kept, astray = [], []

    def fits(rows: NDArray[np.intp]) -> bool:
        off, slopes = predicted[rows], jacobian[rows]
        spread = covariance[np.ix_(rows, rows)] + slopes @ known @ slopes.T
        return bool(off @ np.linalg.solve(spread, off) <= scipy.special.chdtri(3, _ASTRAY))

    velocities = dict(zip(moving.layout.moves_with_accels, moving.layout.velocity, strict=True))
    for k, (link, rows) in enumerate(
        zip(evidence.used_moves.linked, moving.layout.move, strict=True)
    ):
        ends = [str(evidence.segments[end].position) for end in (link.first, link.second)]
        if not fits(rows):
            off = float(np.linalg.norm(predicted[rows]))
            astray.append(RejectedMove((ends[0], ends[1]), off))
        elif k in velocities and not fits(velocities[k]):
            off = float(np.linalg.norm(predicted[velocities[k]]))
            astray.append(RejectedMove((ends[0], ends[1]), off, velocity=True))
            kept.append(replace(link.move, velocity_steps=None))
        else:
            kept.append(link.move)
    return tuple(kept), tuple(astray)


def turns_downweighted(equations: Equations, state: Floats) -> tuple[Equations, float]:
    """Weight turns by their scatter, each channel about each axis separately.

    Return the largest chi-square per degree of freedom, too.
    """
    jacobian, residuals = equations.whitened(state)
    norms = np.linalg.norm(jacobian, axis=0)
    basis = np.linalg.qr(jacobian[:, norms > 0] / norms[norms > 0])[0]
    free = 1 - (basis**2).sum(axis=1)
    largest = 1.0
    for axes, outputs in _turn_axes(equations.evidence):
        for axis, channel in product(range(3), range(3)):
            rows = outputs[axes == axis, channel]
            freedom, square = float(free[rows].sum()), float(residuals[rows] @ residuals[rows])
            if freedom >= 1 and scipy.special.chdtrc(freedom, square) < _UNLIKE:
                equations = downweighted(equations, rows, square / freedom)
                largest = max(largest, square / freedom)
    return equations, largest


def _turn_axes(evidence: Evidence) -> list[tuple[NDArray[np.intp], NDArray[np.intp]]]:
    """Return the axes (k,) of turns with the rows (k, 3) of their gyros; of accelerometers too."""
    axes = np.array([int(np.argmax(np.abs(turn.up))) for turn in evidence.turns], dtype=int)
    rows = evidence.layout
    return [(axes, rows.turn), (axes[list(rows.turns_with_accels)], rows.turn_accels)]


def turns_disagree(evidence: Evidence, outliers: Sequence[Outlier]) -> bool:
    """Return whether too many turns about an axis are outliers to know which are wrong.

    For example rates beyond the range: two turns of four agree with each other but not with the
    rest.
    """
    rows = [o.rows[0] for o in outliers]
    return any(
        ((axes == axis) & np.isin(outputs[:, 0], rows)).sum() > MOST_OUTLIERS * (axes == axis).sum()
        for axes, outputs in _turn_axes(evidence)
        for axis in range(3)
    )


def downweighted(equations: Equations, rows: NDArray[np.intp], factor: float) -> Equations:
    """Return the equations with the variances of some outputs, (k,) of them, times a factor."""
    inflation = np.ones(len(equations.outputs))
    if equations.inflation is not None:
        inflation = equations.inflation.copy()
    inflation[rows] *= factor
    return replace(equations, inflation=inflation)


def candidates(evidence: Evidence, *, turns: bool) -> list[tuple[str, NDArray[np.intp]]]:
    """List possible outliers: three outputs of one kind at a time.

    Accelerometers of holds by hand are not listed: a tilt in one is as likely as the opposite one
    in the hold the other way up, and the choice between them would be random. It widens the
    parameters that depend on both (`excess`).
    """
    rows = evidence.layout
    found = []
    for segment, mine in zip(evidence.segments, rows.dwell, strict=True):
        found.append((f'the gyros at position {segment.position}', mine[:3]))
        if not evidence.plan.by_hand:
            found.append((f'the accelerometers at position {segment.position}', mine[3:]))
    turned = [
        f'a turn at {t.rate() / DEG:.3g} deg/s at position {t.position}' for t in evidence.turns
    ]
    if turns:
        found += zip(turned, rows.turn, strict=True)
        found += [
            (f'the accelerometers in {turned[k]}', mine)
            for k, mine in zip(rows.turns_with_accels, rows.turn_accels, strict=True)
        ]
    moved = []
    for link in evidence.used_moves.linked:
        ends = [evidence.segments[end].position for end in (link.first, link.second)]
        moved.append(f'the move from position {ends[0]} to {ends[1]}')
    found += zip(moved, rows.move, strict=True)
    found += [
        (f'the velocity of {moved[k]}', mine)
        for k, mine in zip(rows.moves_with_accels, rows.velocity, strict=True)
    ]
    return found


def find_outlier(
    views: tuple[tuple[Equations, Floats], tuple[Equations, Floats]],
    candidates: list[tuple[str, NDArray[np.intp]]],
) -> Outlier | None:
    """Return the worst outlier if it contradicts the others, judged without it; else None.

    The equations are tested with the solution of each: without excess scatter, and with it.

    One outlier among good segments looks like bias drift, and is hidden by the scatter that it
    causes: it is therefore compared with the scatter of the others alone.
    """
    (plain, _), (_, state) = views
    if plain.own_variances.max() <= SMALLEST_VARIANCE:
        return None
    worst = set()
    for equations, solved in views:
        prepared = _cleaned(equations, solved)
        squares, _ = _chi_square_decrease(prepared, np.array([rows for _, rows in candidates]))
        if squares.max() > scipy.special.chdtri(3, _SUSPECT):
            worst.add(int(np.argmax(squares)))
    best: Outlier | None = None
    for index in worst:
        name, rows = candidates[index]
        without = downweighted(plain, rows, _LEFT_OUT)
        others = with_scatter(plain, excess(without, _near(without, state), suspecting=True))
        here = _near(others, state)
        square, rank, freedom = _mean_shift_test(others, here, rows)
        by_chance = rank == 0 or scipy.special.fdtrc(rank, freedom, square / rank) > _OUTLYING
        if not by_chance and (best is None or square > best.chi_square):
            best = Outlier(name, rows, square)
    return best


def _near(equations: Equations, state: Floats) -> Floats:
    """Return a state after one step, as near to the solution as scatter and tests need."""
    return np.asarray(state + linear_step(*equations.whitened(state)))


def _mean_shift_test(
    equations: Equations, state: Floats, rows: NDArray[np.intp]
) -> tuple[float, int, float]:
    """Return the decrease of chi-square with separate offsets of some outputs, and their number.

    And the degrees of freedom of the variances of these outputs' residuals, the fewest of them; an
    earlier factor on an outlier is not knowledge of noise. The mean-shift test of Cook and Weisberg
    1982, section 2.2.2, for correlated outputs; docs/mathematics.md, 'Positioning errors'.
    """
    prepared = _cleaned(equations, state)
    found = equations.shares(state, prepared[1][rows])
    shares = [share for source, share in found.items() if source is not ErrorSource.SCATTER]
    variances = np.array([np.diag(share.covariance) for share in shares])
    freedom = effective_freedom(variances, np.array([share.freedom for share in shares]))
    square, rank = _chi_square_decrease(prepared, rows)
    return float(square), int(rank), float(freedom.min(initial=_EXACT))


def _cleaned(equations: Equations, state: Floats) -> tuple[Floats, Floats]:
    """Return C^-1 (outputs less prediction) and C^-1 less the part absorbed by the state."""
    factor, (jacobian, residuals) = equations.factor(state), equations.whitened(state)
    root = whiten(factor, np.eye(len(factor)))
    # Beside noise-free outputs the others may seem to observe nothing: they then absorb nothing.
    taken = np.nan_to_num(Information.from_jacobian(jacobian).covariance)
    weighted = root.T @ jacobian[: len(factor)]
    return root.T @ residuals[: len(factor)], root.T @ root - weighted @ taken @ weighted.T


def _chi_square_decrease(
    prepared: tuple[Floats, Floats], rows: NDArray[np.intp]
) -> tuple[Floats, NDArray[np.intp]]:
    """Return the decrease of chi-square without outputs (..., k), and the number of directions."""
    pull, information = prepared[0][rows], prepared[1][rows[..., None], rows[..., None, :]]
    # Without noise the state absorbs all of an output but rounding.
    own = np.diagonal(information, axis1=-2, axis2=-1)
    largest = np.abs(information).max(axis=(-2, -1), initial=np.finfo(float).tiny)
    least = np.finfo(float).eps * largest[..., None]
    scale = np.where(own > least, 1 / np.sqrt(np.maximum(own, least)), 0.0)
    values, vectors = np.linalg.eigh(information * (scale[..., None] * scale[..., None, :]))
    sound = values > _RANK
    parts = np.einsum('...ij,...i->...j', vectors, pull * scale) ** 2
    return (parts / np.where(sound, values, np.inf)).sum(axis=-1), sound.sum(axis=-1)
