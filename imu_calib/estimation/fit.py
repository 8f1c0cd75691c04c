"""The least squares behind the joint estimate: where it starts, how it weighs, what it distrusts.

Parameters of the sensors, the table's azimuth, its two tilts and the rate between the clocks are
estimated together from every static dwell and every turn of any plan, each output by the noise
that the session shows. Bias drift and positioning errors widen the covariance (`excess`);
a segment that does not fit the rest counts for less.

Source: docs/mathematics.md, 'Joint estimate'.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import scipy
from numpy.typing import NDArray

from ..budget import Share, Source
from ..errors import NotObservable
from ..model import PARAMETERS, Parameter, terms_of
from ..model.motion import motion_parameters
from ..model.session_terms import Change
from ..observation.equations import Equations
from ..observation.evidence import SMALLEST_VARIANCE, Evidence
from ..observation.information import (
    Information,
    determined,
    nominal_information,
    undetermined_in_words,
    unobservable_in_words,
)
from ..observation.lacking import advice, lacking_parameters
from ..observation.positioning_errors import NO_POSITIONING_ERRORS
from ..observation.session_model import Nuisance
from ..segmentation.segmented import Move
from ..stream import Floats
from ..units import DEG
from .changing import doubt_of_time_constant, with_changes, with_time_constant
from .converge import least_squares
from .excess_scatter import ExcessScatter, excess
from .score import with_parameters

_STARTS = 8
"""Headings from which the fit is started where north is unknown: the nearest is 22.5 deg off at
most, an angle that its sine comes to within 3 %."""

_ITERATIONS = 100
"""Most steps. Gyros of much noise hardly see north: a step then takes a fifth off its error."""
_OUTLYING = 1e-6
"""Chance by which a sound rest or turn counts for less: with fifty of them, one session in 20 000
loses one."""
_SUSPECT = 1e-5
"""Chance below which the worst of them is looked at closely: ten times that by which it then counts
for less, for the first look is under scatter that an outlier itself has widened."""
_UNLIKE = 1e-4
"""Chance by which turns about an axis that agree count for less: of three axes and three channels,
in one session of a thousand."""
_ASTRAY = 1e-9
"""Chance by which a sound move is left out, by noise and what the rest of the session leaves open.
Far smaller than that of an outlier: positioning errors that both share are counted twice."""

_MOST_OUTLIERS = 1 / 3
"""Share of a session's rests, or of the turns about an axis, that may count for less. A judgement:
where more disagree, the data does not say which of them are right."""
_RANK = 1e-6
"""Least eigenvalue, of a matrix with ones on its diagonal, of a direction that an outlier can take:
rounding leaves 1e-16, and one so small is taken up by the state. A judgement between."""
_LEFT_OUT = 1e8
"""Times the variance of an output that is left out: it then weighs as good as nothing, and half the
digits of a 64-bit number are left to the others."""
_TILTED = 4.0
"""Standard deviations of the levelling beyond which a tilt is no chance: normal noise passes them
once in 16 000."""
_CONTRADICTION = 5.0
"""Standard deviations by which gyros must contradict a stated azimuth for it to be dropped: normal
noise passes them once in 1.7 million."""
_LEAST_AZIMUTH = 0.05 * DEG
"""Least contradiction of a stated azimuth, rad: one written to a tenth of a degree is off by so
much through rounding."""


@dataclass(frozen=True, eq=False)
class Outlier:
    """A static dwell or a turn that does not fit the rest.

    Attributes:
        name: Position and kind, for a person.
        rows: Its rows among the equations.
        chi_square: By how much chi-square would fall without it.

    """

    name: str
    rows: NDArray[np.intp]
    chi_square: float


@dataclass(frozen=True)
class RejectedMove:
    """A move that is left out, or its velocity alone.

    Attributes:
        positions: That it leads from and to.
        misclosure: By how much its end by the gyros is off what the encoders show, rad; or how fast
            it is by the accelerometers where it stands, m/s.
        velocity: Whether it is the velocity.

    """

    positions: tuple[str, str]
    misclosure: float
    velocity: bool = False


@dataclass(frozen=True, eq=False)
class Estimate:
    """What the least squares found, before it is held against the world.

    Attributes:
        equations: With the weights that were used.
        state: (n,) parameters of the sensors, then the nuisances.
        covariance: (n, n) of the state.
        condition: Condition number of the system solved, columns scaled to unit length.
        scatter: What scatters beyond the noise.
        outliers: What counts for less.
        gain: (n, m + k) derivatives of the state by outputs and priors in standard deviations.
        turns_scatter: Largest chi-square per degree of freedom by which turns about an axis count
            for less; 1 where they agree.
        rejected_moves: Moves that were left out.
        constant: Coefficients of the session's terms that it cannot tell, left out.
        between: (n, n) what the doubt of a warm-up's time constant adds to the covariance, which
            holds it.

    """

    equations: Equations
    state: Floats
    covariance: Floats
    condition: float
    scatter: ExcessScatter
    outliers: tuple[Outlier, ...]
    gain: Floats
    turns_scatter: float = 1.0
    rejected_moves: tuple[RejectedMove, ...] = ()
    constant: tuple[Change, ...] = ()
    between: Floats | None = None

    def nuisance(self, which: Nuisance) -> tuple[float, float]:
        """Return one of the nuisances and its standard deviation."""
        index = self.equations.sensors + which
        return float(self.state[index]), float(np.sqrt(self.covariance[index, index]))

    @property
    def without_scatter(self) -> Equations:
        """The equations with the noise that is known beforehand: nothing that the session shows."""
        return replace(self.equations, extra=self.scatter.stated, positioning=NO_POSITIONING_ERRORS)

    @property
    def downweighted_outputs(self) -> int:
        """How many outputs count for less, or not at all."""
        inflation = self.equations.inflation
        down = 0 if inflation is None else int(np.count_nonzero(inflation > 1))
        return down + 3 * len(self.rejected_moves)

    def shares(self) -> dict[Source, Share]:
        """Return the covariance of the parameters by source: of the outputs, and of the priors."""
        found = shares(self.equations, self.state, self.gain)
        if self.between is not None:
            found[Source.TIME_CONSTANT] = Share.known(
                self.between[: self.equations.sensors, : self.equations.sensors]
            )
        return found


def shares(equations: Equations, state: Floats, gain: Floats) -> dict[Source, Share]:
    """Return the covariance of the parameters by source: of the outputs, and of the priors.

    Args:
        equations: That were solved.
        state: (n,) where they were.
        gain: (n, m + k) derivatives of the state by outputs and priors in standard deviations.

    """
    n, m = equations.sensors, len(equations.outputs)
    factor = equations.factor(state)
    weights = scipy.linalg.solve_triangular(factor, gain[:n, :m].T, lower=True, trans='T').T
    found = equations.shares(state, weights)
    for source, which, freedom in equations.prior_sources:
        prior = gain[:n, m + np.array(which, dtype=int)]
        parts = [(prior @ prior.T, freedom)]
        # Of lever arms some are in the state, and the others' priors in the outputs' covariance.
        if source in found:
            parts.append((found[source].covariance, np.inf))
        found[source] = Share.of_parts(parts)
    return found


def estimate(
    evidence: Evidence,
    parameters: tuple[Parameter, ...] = PARAMETERS,
    changes: tuple[Change, ...] = (),
    doubts: tuple[tuple[Parameter, float], ...] = (),
) -> Estimate:
    """Fit all of a session at once.

    Args:
        evidence: The session.
        parameters: Of the sensors.
        changes: By which they change during the session.
        doubts: As in `Equations`.

    Raises:
        NotObservable: Names what the session cannot observe.

    """
    equations = Equations(evidence, parameters, doubts=doubts)
    check_observable(equations)
    equations, constant = with_changes(equations, changes)
    # Moves lead from attitude to attitude of a table that is known; they say less of where it is.
    moving = motion_parameters(parameters)
    resting = replace(
        equations,
        parameters=tuple(p for p in parameters if p not in moving),
        evidence=evidence.with_moves(()),
    )
    resting, state = with_time_constant(resting, _start(resting))
    state = fit(resting, state)
    resting = _headed(_levelled(resting, state), state)
    state = fit(resting, state)
    kept, astray = _moves_that_fit(resting, state, evidence.moves)
    equations = replace(resting, evidence=kept)
    if moving:
        equations, state = with_parameters(equations, state, moving)
    observed = Information.of(equations.whitened(state)[0]).observed
    if not (moving or np.delete(observed, np.r_[equations.arms]).all()):
        # See `information.before`. Of lever arms turns show what the 24 need, and not more.
        equations = resting
    found = _without_outliers(equations, state, turns=True)
    if _turns_disagree(evidence, found.outliers):
        equations, scatter = _turns_weighed_down(equations, state)
        found = _without_outliers(equations, state, turns=False)
        found = replace(found, turns_scatter=scatter)
    between = doubt_of_time_constant(found.equations, found.state)
    covariance = found.covariance if between is None else found.covariance + between
    return replace(
        found, covariance=covariance, rejected_moves=astray, constant=constant, between=between
    )


def _moves_that_fit(
    resting: Equations, state: Floats, moves: tuple[Move, ...]
) -> tuple[Evidence, tuple[RejectedMove, ...]]:
    """Choose the moves that rests and turns bear out: return the session with them.

    A gyro beyond its range, one that does not answer in proportion, or a table whose joints are
    not what they are said to be, is off by many times the noise in what takes seconds: such a move
    tells nothing of the parameters.

    Args:
        resting: The session without moves.
        state: (n,) what they say.
        moves: All of it.

    """
    evidence = resting.evidence.with_moves(moves)
    if not len(evidence.links):
        return resting.evidence, ()
    scatter = excess(resting, state)
    kept: tuple[Move, ...] = ()
    while True:
        fitting, astray = _judged(with_scatter(resting, scatter), state, evidence)
        if not astray:
            return evidence, ()
        if _count(fitting) <= _count(kept):
            return evidence.with_moves(fitting), astray
        # Moves show positioning errors that rests hide in their noise: with those, others may.
        kept = fitting
        moved = replace(resting, evidence=evidence.with_moves(kept))
        scatter = replace(scatter, positioning=excess(moved, state).positioning)


def _count(moves: Sequence[Move]) -> int:
    """Return the number of rotations and velocities."""
    return sum(1 if move.velocity_steps is None else 2 for move in moves)


def _judged(
    resting: Equations, state: Floats, evidence: Evidence
) -> tuple[tuple[Move, ...], tuple[RejectedMove, ...]]:
    """Hold each move against rests and turns, which scatter as they are said to."""
    known = Information.of(resting.whitened(state)[0]).covariance
    moving = replace(resting, evidence=evidence, extra=())
    predicted, jacobian = moving.predict(state), np.nan_to_num(moving.jacobian(state))
    covariance, known = moving.covariance(state), np.nan_to_num(known)
    kept, astray = [], []

    def fits(rows: NDArray[np.intp]) -> bool:
        off, slopes = predicted[rows], jacobian[rows]
        spread = covariance[np.ix_(rows, rows)] + slopes @ known @ slopes.T
        return bool(off @ np.linalg.solve(spread, off) <= scipy.special.chdtri(3, _ASTRAY))

    velocities = dict(zip(moving.layout.moves_with_accels, moving.layout.velocity, strict=True))
    for k, (link, rows) in enumerate(zip(evidence.links.links, moving.layout.move, strict=True)):
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


def _without_outliers(equations: Equations, state: Floats, *, turns: bool) -> Estimate:
    """Weigh down what does not fit, one after the other; turns too, if so asked."""
    outliers: list[Outlier] = []
    plain = state = fit(equations, state)
    scatter = excess(equations, plain)
    weighted = with_scatter(equations, scatter)
    for _ in range(int(_MOST_OUTLIERS * len(equations.evidence.segments)) + 1):
        state = fit(weighted, state)
        views = (equations, plain), (weighted, state)
        found = _outlier(views, _candidates(equations.evidence, turns=turns))
        if found is None:
            break
        outliers.append(found)
        equations = _weighed_down(equations, found.rows, 1 + found.chi_square)
        plain = fit(equations, state)
        scatter = excess(equations, plain)
        weighted = with_scatter(equations, scatter)
    if scatter.shown:
        scatter = excess(equations, plain, doubted=True)
        weighted = with_scatter(equations, scatter)
    state = fit(weighted, state)
    information = Information.of(weighted.whitened(state)[0])
    return Estimate(
        weighted,
        state,
        information.covariance,
        information.condition,
        scatter,
        tuple(outliers),
        information.gain,
    )


def _turns_weighed_down(equations: Equations, state: Floats) -> tuple[Equations, float]:
    """Let turns count by how they scatter, each channel about each axis for itself.

    Returns:
        The equations, and the largest chi-square per degree of freedom.

    """
    jacobian, left = equations.whitened(state)
    norms = np.linalg.norm(jacobian, axis=0)
    basis = np.linalg.qr(jacobian[:, norms > 0] / norms[norms > 0])[0]
    free = 1 - (basis**2).sum(axis=1)
    largest = 1.0
    for axes, outputs in _of_turns(equations.evidence):
        for axis, channel in product(range(3), range(3)):
            rows = outputs[axes == axis, channel]
            freedom, square = float(free[rows].sum()), float(left[rows] @ left[rows])
            if freedom >= 1 and scipy.special.chdtrc(freedom, square) < _UNLIKE:
                equations = _weighed_down(equations, rows, square / freedom)
                largest = max(largest, square / freedom)
    return equations, largest


def _of_turns(evidence: Evidence) -> list[tuple[NDArray[np.intp], NDArray[np.intp]]]:
    """Return the axes (k,) of turns with the rows (k, 3) of their gyros; of accelerometers too."""
    axes = np.array([int(np.argmax(np.abs(turn.up))) for turn in evidence.turns], dtype=int)
    rows = evidence.layout
    return [(axes, rows.turn), (axes[list(rows.turns_with_accels)], rows.turn_accels)]


def _turns_disagree(evidence: Evidence, outliers: Sequence[Outlier]) -> bool:
    """Say whether so many turns about an axis fall out that nobody knows which are wrong.

    Rates beyond the range, say: two turns of four agree with each other and not with the rest.
    """
    rows = [o.rows[0] for o in outliers]
    return any(
        ((axes == axis) & np.isin(outputs[:, 0], rows)).sum()
        > _MOST_OUTLIERS * (axes == axis).sum()
        for axes, outputs in _of_turns(evidence)
        for axis in range(3)
    )


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
    """Refuse terms that the session leaves open, though it determines the 24 parameters.

    Raises:
        NotObservable: Names the terms and what would determine them.

    """
    parameters = equations.parameters
    known = determined(nominal_information(equations), parameters)
    missing = [p for p, sure in zip(parameters, known, strict=True) if not sure]
    if not missing:
        return
    terms = terms_of(missing) or terms_of(parameters)
    raise NotObservable(
        ' '.join(undetermined_in_words(equations.evidence, term, missing) for term in terms)
    )


def _start(equations: Equations) -> Floats:
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
        step = _least_squares(columns, left)
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


def _least_squares(jacobian: Floats, left: Floats) -> Floats:
    norms = np.linalg.norm(jacobian, axis=0)
    scale = np.where(norms > 0, norms, 1.0)
    return np.asarray(np.linalg.lstsq(jacobian / scale, left, rcond=None)[0] / scale)


def with_scatter(equations: Equations, scatter: ExcessScatter) -> Equations:
    """Return the equations with what scatters in their covariance."""
    return replace(equations, extra=scatter.extra, positioning=scatter.positioning)


def _levelled(equations: Equations, state: Floats) -> Equations:
    """Trust the levelling no further than the session bears it out.

    Six positions see one tilt and not the other: where the one is many times what was assumed, so
    may the other be.
    """
    first = equations.sensors + Nuisance.TILT_X
    seen = float(np.abs(state[first : first + 2]).max())
    level = equations.evidence.levelling
    return replace(equations, levelled=seen) if seen > _TILTED * level else equations


def _headed(equations: Equations, state: Floats) -> Equations:
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


def _weighed_down(equations: Equations, rows: NDArray[np.intp], factor: float) -> Equations:
    inflation = np.ones(len(equations.outputs))
    if equations.inflation is not None:
        inflation = equations.inflation.copy()
    inflation[rows] *= factor
    return replace(equations, inflation=inflation)


def _candidates(evidence: Evidence, *, turns: bool) -> list[tuple[str, NDArray[np.intp]]]:
    """Name what may be an outlier as a whole: three outputs of one kind at a time."""
    rows = evidence.layout
    found = []
    for segment, mine in zip(evidence.segments, rows.rest, strict=True):
        found.append((f'the gyros at position {segment.position}', mine[:3]))
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
    for link in evidence.links.links:
        ends = [evidence.segments[end].position for end in (link.first, link.second)]
        moved.append(f'the move from position {ends[0]} to {ends[1]}')
    found += zip(moved, rows.move, strict=True)
    found += [
        (f'the velocity of {moved[k]}', mine)
        for k, mine in zip(rows.moves_with_accels, rows.velocity, strict=True)
    ]
    return found


def _outlier(
    views: tuple[tuple[Equations, Floats], tuple[Equations, Floats]],
    candidates: list[tuple[str, NDArray[np.intp]]],
) -> Outlier | None:
    """Find what fits least, and say whether the rest, judged without it, refuses it.

    Looked at are the equations with the solution of each: without what scatters, and with it.

    One outlier among good segments looks like a bias that drifts, and hides behind the scatter
    that it makes: the scatter that it is held against is that of the others alone.
    """
    (plain, _), (_, state) = views
    if plain.own_variances.max() <= SMALLEST_VARIANCE:
        return None
    worst = set()
    for equations, solved in views:
        prepared = _cleaned(equations, solved)
        squares = np.array([_drop(prepared, rows)[0] for _, rows in candidates])
        if squares.max() > scipy.special.chdtri(3, _SUSPECT):
            worst.add(int(np.argmax(squares)))
    best: Outlier | None = None
    for index in worst:
        name, rows = candidates[index]
        without = _weighed_down(plain, rows, _LEFT_OUT)
        others = with_scatter(plain, excess(without, fit(without, state), suspecting=True))
        here = fit(others, state)
        square, freedom = _fall(others, here, rows)
        limit = scipy.special.chdtri(max(freedom, 1), _OUTLYING)
        if freedom and square > limit and (best is None or square > best.chi_square):
            best = Outlier(name, rows, square)
    return best


def _fall(equations: Equations, state: Floats, rows: NDArray[np.intp]) -> tuple[float, int]:
    """Return by how much chi-square falls when some outputs get offsets of their own, and how many.

    The mean-shift test of Cook and Weisberg 1982, section 2.2.2, for correlated outputs.
    """
    return _drop(_cleaned(equations, state), rows)


def _cleaned(equations: Equations, state: Floats) -> tuple[Floats, Floats]:
    """Return C^-1 (outputs less prediction) and C^-1 less what the state takes up."""
    factor, (jacobian, left) = equations.factor(state), equations.whitened(state)
    root = scipy.linalg.solve_triangular(factor, np.eye(len(factor)), lower=True)
    # Next to outputs without noise the others may seem to observe nothing: they take up nothing.
    taken = np.nan_to_num(Information.of(jacobian).covariance)
    weighed = root.T @ jacobian[: len(factor)]
    return root.T @ left[: len(factor)], root.T @ root - weighed @ taken @ weighed.T


def _drop(prepared: tuple[Floats, Floats], rows: NDArray[np.intp]) -> tuple[float, int]:
    pull, information = prepared[0][rows], prepared[1][np.ix_(rows, rows)]
    # Without noise the state takes up all of an output but for rounding, and nothing is left.
    own = np.diag(information)
    least = np.finfo(float).eps * np.abs(information).max(initial=np.finfo(float).tiny)
    scale = np.where(own > least, 1 / np.sqrt(np.maximum(own, least)), 0.0)
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    sound = values > _RANK
    parts = (vectors.T @ (pull * scale))[sound]
    return float(parts**2 @ (1 / values[sound])), int(sound.sum())
