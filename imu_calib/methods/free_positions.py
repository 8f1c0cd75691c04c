"""Sensors from holds in unknown attitudes: gravity has one length, and gyros turn it between holds.

The equations are those of every session (`observation/free.py`), with estimated attitudes. All is
one weighted least squares: the uncertainty of a direction by the accelerometers enters the
parameters of the gyros. G-sensitivity of the gyros and nonlinearity of the accelerometers are
estimated too, where the session shows them.

The frame is that of the accelerometers, as in imu_tk: X along the input axis of channel x, the
input axis of channel y in the plane of X and Y, so that E_axy = E_axz = E_ayz = 0.

Sources: Tedaldi, Pretto and Menegatti 2014, ICRA, eqs. (9) to (15), who fit accelerometers and
gyros one after the other; Skog and Haendel 2006, XVII IMEKO, for the norm of gravity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy

from ..budget import Share, Shares
from ..errors import InputError, NotObservable
from ..estimation.converge import least_squares
from ..estimation.estimate import shares
from ..estimation.score import Family, Score, scores_of
from ..estimation.term_tests import TermTest, test_of
from ..model import (
    G_SENSITIVITY,
    PARAMETERS,
    Parameter,
    ParameterKind,
    SensorModel,
    Term,
    Triad,
    indices_of,
    terms_of,
)
from ..model.terms import ACCEL_ASYMMETRY, ACCEL_CUBIC, ACCEL_QUADRATIC
from ..observation.evidence import Evidence
from ..observation.free import FreeEquations, at_headings_by_moves
from ..observation.information import Information
from ..observation.layout import Indices
from ..stream import Floats
from ..units import DEG, STANDARD_GRAVITY, counted, significant
from .checks import check_axes
from .free_checks import check_turns, contradicts_latitude, other_latitudes, wrong_latitude
from .solution import Solution

NAME = 'free_positions'
"""The method's name in plans."""

_KEPT = {('a', 0, 1), ('a', 0, 2), ('a', 1, 2)}
"""Misalignments that are zero by definition of the body axes: triad, row, column."""

FREE = np.array([(p.triad, p.row, p.column) not in _KEPT for p in PARAMETERS])
"""(24,) mask of the 24 that exist in the frame of the accelerometers: 21."""

ESTIMATES = tuple(p for p, found in zip(PARAMETERS, FREE, strict=True) if found)

_RATIOS = np.array([p.kind is not ParameterKind.BIAS for p in ESTIMATES])
"""(21,) mask of those that are not biases."""

FEWEST = 9
"""Holds below which gravity does not determine nine parameters of the accelerometers."""

_ITERATIONS = 100
"""Most steps of a fit; one that has not converged by then raises."""
_ROUNDS = 10
"""Rounds in which contradicting turns are left out and noise is estimated again; a cap."""
_SIGNIFICANT = 1e-3
"""Probability of chance below which the scatter of a group is reported. A choice: in one sound
session of a thousand."""
_WIDENED = 0.01
"""Probability of chance below which a group's noise is enlarged: three sound sessions in a hundred
are widened. Held-out lengths of the Xsens of docs/real_recordings.md were off by up to 3.5 times
the stated deviation with 1e-3, and by up to 2.4 with this."""
_DETERMINED = 0.5
"""Degrees of freedom from which on a group shows its scatter: below, its residuals are rounding of
the fit. A judgement."""
_FLAT = 1e-10
"""Of the largest singular value of an ellipsoid's equations: with a smaller one they determine
none. A judgement: rounding leaves 1e-15, and noise far more."""
_SETTLED = 0.02
"""Relative change at which the noise has settled. A judgement: a session of twenty holds knows it
to some ten percent."""
_OUTLYING = 6.0
"""Times the usual size of a turn's residual: exceeded in 2e-8 (Rayleigh)."""
_UNTESTED = 1e-3
"""Variance of a residual after the fit below which it tests nothing: the unknowns are then
determined by that turn alone, and its residual is that of the iteration."""
_MEDIANS = np.array([np.nan, 0.67448975, 1.17741002, 1.53817225])
"""Median length of a normal vector in 0 to 3 directions, in standard deviations."""
_JUDGING = 1.5
"""Degrees of freedom of the other turns from which on they show the usual size. Simulated turns
with eight times their noise had half a degree of freedom in ten holds, and one session in six would
lose a turn; in twelve holds they had two, and none of 24 sessions lost one."""
_SHOWN = 1e-3
"""Probability of chance below which a term is in the model (docs/mathematics.md, 'Free
positions')."""

_LEAST_CHANCE = 1e-99
"""Least probability that is reported: smaller ones are beyond the approximations."""

_NONLINEAR = (ACCEL_QUADRATIC, ACCEL_ASYMMETRY, ACCEL_CUBIC)
"""Terms of the accelerometers that are tested, each axis for itself. The cross terms are nine more,
for which holds of a few minutes are too few."""
_LARGEST = 0.02
"""Largest of their effects at 1 g, of it: chips are stated to be linear to 0.1 to 2 % of range."""
_AMOUNT = 1000.0
"""Amount of a coefficient for which its effect is reported, ug/g^2, ppm or ug/g^3: a tenth of a
percent at 1 g, as of a usual chip."""
_APART = 9.0
"""Difference of chi-square below which two terms explain a session equally well: a factor of 90 in
the likelihood (as in `estimation.search`)."""

_USELESS = 0.05
"""Standard deviation of a ratio from which on it is useless: data sheets are better."""
_CLEAR = 10.0
"""Factor: margin of a session from all limits to be accepted by its first step alone. A judgement:
the further steps change standard deviations and residuals by percents."""
_STRAIGHT = 0.1
"""Largest first step, of ratios and rotations (rad), for which the equations are nearly linear: the
error is of the order of its square, 1 %."""
_LIKELIER = 2 * np.log(1000)
"""Decrease of chi-square at another latitude for that to be meant: odds of a thousand."""
_ACCELS = ('accelerometers', 'gravity')
"""Sensors whose response is checked, and its input."""
_GROUPS = ('the accelerometers at rest', 'the gyros at rest', 'the turns')


@dataclass(frozen=True, eq=False)
class FreeFit:
    """Estimate from holds and turns.

    Attributes:
        model: In the frame of the accelerometers.
        parameters: The n of the covariance: the 24, and those of terms that the session shows.
        covariance: (n, n); zero for the three that the frame sets to zero.
        residuals: (k, 6) outputs at rest less those predicted by the model.
        condition: Condition number of the system, columns scaled to unit length.
        scatter: (3,) factor on the noise of accelerometers at rest, gyros at rest and turns by
            their scatter, as standard deviations.
        scatter_chances: (3,) probabilities of such scatter by chance.
        rejected_moves: Indices of the holds before turns that were left out.
        shares: The covariance by source.
        chance: Probability of so significant a g-sensitivity by chance; 1 without it.
        nonlinear: Terms of the accelerometers that are on, in the order in which they were found.
        tests: Of the terms of the accelerometers.
    """

    model: SensorModel
    parameters: tuple[Parameter, ...]
    covariance: Floats
    residuals: Floats
    condition: float
    scatter: Floats
    scatter_chances: Floats
    rejected_moves: tuple[int, ...]
    shares: Shares
    chance: float = 1.0
    nonlinear: tuple[Nonlinearity, ...] = ()
    tests: tuple[TermTest, ...] = ()


@dataclass(frozen=True)
class Nonlinearity:
    """A term of the accelerometers that a session shows.

    Attributes:
        term: The term.
        log_p: Natural logarithm of the probability by chance.
        alternatives: Terms that explain the session as well.
    """

    term: Term
    log_p: float
    alternatives: tuple[Term, ...] = ()


@dataclass(frozen=True, eq=False)
class _State:
    """A step of the iteration.

    Attributes:
        equations: Linearised at the present attitudes.
        values: (n,) the state.
        scatter: (3,) factors on the noise, as in `FreeFit`.
        rejected_moves: Likewise.
        scatter_chances: Likewise.
    """

    equations: FreeEquations
    values: Floats
    scatter: Floats
    rejected_moves: tuple[int, ...] = ()
    scatter_chances: Floats = field(default_factory=lambda: np.ones(3))

    @property
    def groups(self) -> tuple[Indices, ...]:
        """Groups of outputs with common scatter: see `FreeFit.scatter`."""
        rows = self.equations.layout
        return rows.dwell[:, 3:].ravel(), rows.dwell[:, :3].ravel(), rows.move.ravel()

    def whitened(self) -> tuple[Floats, Floats]:
        """Return derivatives and residuals in standard deviations."""
        return self.equations.whitened(self.values)

    def moved(self, step: Floats) -> _State:
        """Return the state after a step (n,), in attitudes turned by it."""
        equations, values = self.equations.moved(self.values, step)
        return replace(self, equations=equations, values=values)

    def settled(self) -> _State:
        """Return the least squares."""
        return least_squares(self, _State.whitened, _State.moved, _ITERATIONS)

    def scattering(self, scatter: Floats) -> _State:
        """Return the state with the noise of each group (3,) times as large."""
        inflation = np.ones(len(self.equations.layout))
        for rows, factor in zip(self.groups, scatter, strict=True):
            inflation[rows] = factor**2
        return replace(
            self, equations=replace(self.equations, inflation=inflation), scatter=scatter
        )

    def with_terms(self, terms: tuple[Term, ...]) -> _State:
        """Return the state with the parameters of terms, initially zero."""
        more = tuple(p for term in terms for p in term.parameters)
        equations = replace(self.equations, parameters=(*self.equations.parameters, *more))
        values = np.insert(self.values, len(self.equations.parameters), np.zeros(len(more)))
        return replace(self, equations=equations, values=values)

    def without(self, wild: int) -> _State:
        """Return the state without a move: it splits a run in two, and north is estimated anew."""
        evidence = self.equations.evidence
        link = evidence.used_moves.linked[wild]
        moves = tuple(move for move in evidence.moves if move is not link.move)
        equations = replace(self.equations, evidence=replace(evidence, moves=moves), inflation=None)
        values = equations.nominal()
        values[: equations.sensors] = self.values[: equations.sensors]
        dropped = tuple(sorted((*self.rejected_moves, link.first)))
        return _State(equations, values, np.ones(3), dropped)


def solve(evidence: Evidence) -> FreeFit:
    """Estimate 21 parameters, and terms that the session shows, from holds and turns between.

    Args:
        evidence: Dwells in at least nine unknown attitudes, and the moves between them.

    Raises:
        InputError: The outputs are not in the units that the IMU's description states.
        NotObservable: Too few holds, or attitudes that do not determine all parameters; names them.
            Or the data contradicts itself, or the latitude.
    """
    if len(evidence.segments) < FEWEST:
        raise NotObservable(
            f'{counted(len(evidence.segments), "hold was", "holds were")} found; gravity needs '
            f'{FEWEST} or more in different attitudes to determine the accelerometers, 20 or more '
            'for a good result.'
        )
    start = _State(*initial_equations(evidence), np.ones(3))
    model = start.equations.model(start.values)
    check_axes(model.accel.response, *_ACCELS)
    check_turns(start.equations.evidence, model)
    _check_observable(start)
    state = _with_estimated_noise(start)
    chance = _chance(state, G_SENSITIVITY)
    if chance < _SHOWN:
        _check_latitude(state)
        state = _with_estimated_noise(start.with_terms((G_SENSITIVITY,)))
    state, nonlinear = _with_nonlinearity(state)
    if nonlinear:
        # Without it the directions of gravity were off, and the turns contradicted them.
        linear = start.with_terms(tuple(one.term for one in nonlinear))
        chance = _chance(_with_estimated_noise(linear), G_SENSITIVITY)
        state = _with_estimated_noise(
            linear if chance >= _SHOWN else linear.with_terms((G_SENSITIVITY,))
        )
    _check_observable(state)
    equations, values = state.equations, state.values
    check_axes(equations.model(values).gyro.response, 'gyros', 'the turns between holds')
    information = Information.of(state.whitened()[0])
    parameters = tuple(dict.fromkeys((*PARAMETERS, *equations.parameters)))
    own = [parameters.index(p) for p in equations.parameters]

    def of_all(found: Floats, kept: float) -> Floats:
        result = np.full((len(parameters),) * found.ndim, kept)
        result[np.ix_(*[own] * found.ndim)] = found
        return result

    sensors = slice(0, equations.sensors)
    found = shares(equations, values, information.gain)
    return FreeFit(
        equations.model(values),
        parameters,
        of_all(information.covariance[sensors, sensors], 0.0),
        (equations.outputs - equations.predict(values))[equations.layout.dwell],
        information.condition,
        state.scatter,
        state.scatter_chances,
        state.rejected_moves,
        {
            source: Share(of_all(share.covariance, 0.0), of_all(share.freedom, np.inf))
            for source, share in found.items()
        },
        chance if chance < _SHOWN else 1.0,
        nonlinear,
        _tests(state, chance, nonlinear, information),
    )


def _with_nonlinearity(state: _State) -> tuple[_State, tuple[Nonlinearity, ...]]:
    """Add terms of the accelerometers until none is significant; return them, in their order."""
    found: tuple[Nonlinearity, ...] = ()
    while len(found) < len(_NONLINEAR):
        scores = _scores(state)
        shown = [f for f in scores if scores[f].log_p < np.log(_SHOWN / len(_NONLINEAR))]
        if not shown:
            break
        most = max(shown, key=lambda family: scores[family].statistic / scores[family].scale)
        least = scores[most].statistic - _APART * scores[most].scale
        # Of terms that explain the session equally well the first is that of IEEE Std 1293.
        best, *others = [f for f in scores if f is most or scores[f].statistic > least]
        assert best.term is not None
        try:
            trial = _with_estimated_noise(state.with_terms((best.term,)))
            _check_observable(trial)
        except NotObservable:
            break
        alternatives = tuple(other.term for other in others if other.term is not None)
        found = (*found, Nonlinearity(best.term, scores[best].log_p, alternatives))
        state = trial
    return state, found


def _scores(state: _State) -> dict[Family, Score]:
    """Test the terms of the accelerometers that are off.

    Under the noise that is known beforehand: scatter that is estimated without a term hides it. The
    test allows for the scatter that remains with it.
    """
    equations = state.scattering(np.array([1.0, *state.scatter[1:]])).equations
    on = terms_of(equations.parameters)
    patterns = {}
    for term in (term for term in _NONLINEAR if term not in on):
        # The largest size in SI units: of f, of f^2 or of f^3.
        degrees = [len(one.factors) + len(one.absolute) for _, one in term.products]
        sizes = _LARGEST * STANDARD_GRAVITY ** (1.0 - np.array(degrees))
        columns = equations.parameter_derivatives(state.values, term.parameters) * sizes
        patterns[Family(term.name, term)] = ((columns, sizes),)
    return scores_of(patterns, equations, state.values)


def _tests(
    state: _State, chance: float, found: Sequence[Nonlinearity], information: Information
) -> tuple[TermTest, ...]:
    """Return the terms that are on, and what the session shows of those of the accelerometers."""
    equations, values = state.equations, state.values
    sensors, outputs = slice(0, equations.sensors), slice(0, len(equations.outputs))
    std = np.sqrt(np.diag(information.covariance)[sensors])
    root = np.linalg.cholesky(equations.covariance(values))
    tests = [TermTest.found(one.term, one.log_p) for one in found]
    if chance < _SHOWN:
        tests.insert(0, TermTest.found(G_SENSITIVITY, float(np.log(max(chance, _LEAST_CHANCE)))))
    for family, score in _scores(state).items():
        white = np.linalg.solve(root, equations.parameter_derivatives(values, family.parameters))
        slopes = information.gain[sensors, outputs] @ white
        limit = _SHOWN / len(_NONLINEAR)
        tests.append(test_of(family, score, slopes, limit, equations.parameters, std, _AMOUNT))
    return tuple(tests)


def _check_latitude(state: _State) -> None:
    """Raise if another latitude explains the session in place of a term."""
    evidence = state.equations.evidence
    misfit = _square(state)
    for latitude in other_latitudes(evidence):
        site = replace(evidence.site, latitude=latitude)
        equations = replace(state.equations, evidence=replace(evidence, site=site))
        elsewhere = replace(state, equations=equations).settled()
        if misfit - _square(elsewhere) > _LIKELIER and _chance(elsewhere, G_SENSITIVITY) >= _SHOWN:
            raise wrong_latitude(evidence, latitude)


def _square(state: _State) -> float:
    """Return the chi-square of the residuals."""
    residuals = state.whitened()[1]
    return float(residuals @ residuals)


def is_clear(evidence: Evidence) -> bool:
    """Return whether one linear step shows that `solve` will accept the session; False in doubt.

    The equations are nearly linear over the step, no turn is an outlier, and the standard
    deviations that `solve` may widen by scatter remain far from useless: factors up to s on the
    noise of groups inflate the covariance by s^2 at most.

    Source: docs/mathematics.md, 'Free positions'.

    Args:
        evidence: As for `solve`.
    """
    if len(evidence.segments) < FEWEST:
        return False
    try:
        state = _State(*initial_equations(evidence), np.ones(3))
        equations, values = state.equations, state.values
        check_axes(equations.model(values).accel.response, *_ACCELS)
    except (InputError, NotObservable):
        return False
    jacobian, residuals = equations.jacobian(values), equations.outputs - equations.predict(values)
    # Not `whitened`: loading its triangular solver takes longer than this computation.
    root = np.linalg.cholesky(equations.covariance(values))
    rows = np.linalg.solve(root, np.column_stack([jacobian, residuals]))
    rows = np.vstack([rows, equations.prior_rows(values)])
    information = Information.of(rows[:, :-1])
    if not information.observed.all():
        return False
    step = information.gain @ rows[:, -1]
    rest = rows[:, -1] - rows[:, :-1] @ step
    if _largest(step, equations) > _STRAIGHT or contradicts_latitude(equations.evidence):
        return False
    if _outstanding_turn(state, np.linalg.qr(rows[:, :-1])[0], rest, _OUTLYING) is not None:
        return False
    taken = (information.gain * rows[:, :-1].T).sum(axis=0)
    scatter = max(
        float(rest[of] @ rest[of]) / max(1.0, float(len(of) - taken[of].sum()) - 2)
        for of in state.groups
    )
    std = np.sqrt(np.diag(information.covariance)[: len(ESTIMATES)] * max(1.0, scatter))
    return bool((std[_RATIOS] * _CLEAR < _USELESS).all())


def _largest(step: Floats, equations: FreeEquations) -> float:
    """Return the largest of a step's changes of ratios and rotations."""
    ratios, turned = step[: len(ESTIMATES)][_RATIOS], step[equations.north_slice.stop :]
    return float(np.abs(np.concatenate([ratios, turned])).max())


def initial_equations(evidence: Evidence) -> tuple[FreeEquations, Floats]:
    """Return the equations in attitudes by gravity and gyros, and the starting state.

    Raises:
        NotObservable: The outputs of nine holds or more lie on no ellipsoid.
    """
    outputs = evidence.outputs()
    gyro, accel = Triad(bias=outputs[:, :3].mean(axis=0)), Triad()
    if len(outputs) >= FEWEST:
        accel = ellipsoid(outputs[:, 3:], evidence.site.gravity)
    model = SensorModel(gyro, accel)
    forces = model.compensate(outputs[:, :3], outputs[:, 3:])[1]
    ups = forces / np.linalg.norm(forces, axis=1)[:, None]
    equations = FreeEquations(at_headings_by_moves(evidence, ups, model), ESTIMATES)
    values = equations.nominal()
    values[: len(ESTIMATES)] = model.values(ESTIMATES)
    return equations, values


def _with_estimated_noise(state: _State) -> _State:
    """Return the least squares with noise enlarged by its scatter, and without outlying turns."""
    for _ in range(_ROUNDS):
        state = state.settled()
        wild = _wild_turn(state)
        if wild is not None:
            state = state.without(wild)
            continue
        scatter, freedom, chances = _scatter(state)
        state = replace(state, scatter_chances=chances)
        if np.allclose(scatter, state.scatter, rtol=_SETTLED):
            if (doubt := _scatter_limit(freedom)).max() > 1:
                state = state.scattering(scatter * doubt).settled()
            break
        state = state.scattering(scatter)
    return state


def _chance(state: _State, term: Term) -> float:
    """Return the probability that a term explains as much of the residuals by chance.

    The F test of nested least squares, under the scatter without the term: residuals of a trembling
    hand are not evidence of it (docs/mathematics.md, 'Free positions').
    """
    try:
        found = state.with_terms((term,)).settled()
        _check_observable(found)
    except NotObservable:
        return 1.0
    jacobian, residuals = found.whitened()
    before, after = _square(state), float(residuals @ residuals)
    count, freedom = len(term.parameters), len(residuals) - jacobian.shape[1]
    if freedom < 1 or after >= before:
        return 1.0
    ratio = (before - after) / count / (after / freedom)
    return float(scipy.special.fdtrc(count, freedom, ratio))


def _check_observable(state: _State) -> None:
    """Raise if attitudes and turns do not determine all parameters."""
    parameters, evidence = state.equations.parameters, state.equations.evidence
    covariance = Information.of(state.whitened()[0]).covariance
    std = np.sqrt(np.diag(covariance)[: len(parameters)])
    ratio = np.array([p.kind is not ParameterKind.BIAS for p in parameters])
    lost = ~np.isfinite(std) | (ratio & (std > _USELESS))
    if lost.any():
        names = [p.name for p, gone in zip(parameters, lost, strict=True) if gone]
        words = []
        if any(name[2] == 'a' for name in names):
            words.append('hold the unit in more different attitudes, each axis up and down')
        if any(name[2] == 'g' for name in names):
            words.append('turn it by a quarter turn or more about different axes between holds')
        raise NotObservable(
            f'{counted(len(evidence.segments), "hold")} and '
            f'{counted(len(evidence.used_moves), "turn")} do not determine '
            f'{", ".join(names)}: {"; ".join(words)}.'
        )


def refuse(_: Evidence) -> Solution:
    """Raise with the needs of this method beyond static dwells and whole turns.

    Raises:
        NotObservable: Always.
    """
    raise NotObservable(
        'Free positions need every sample between the holds, which segments of a table session '
        'do not have: run them on a recording with the IMU alone.'
    )


def scatter_words(fit: FreeFit) -> list[str]:
    """Report groups that scatter significantly more than their noise."""
    return [
        f'The residuals of {name} are {factor:.1f} times the noise (a hand that trembles, bias '
        'drift): the standard deviations are widened.'
        for name, factor, chance in zip(_GROUPS, fit.scatter, fit.scatter_chances, strict=True)
        if chance < _SIGNIFICANT
    ]


def term_words(fit: FreeFit) -> list[str]:
    """Report the terms that the session showed, and their significance."""
    words = [_nonlinear_words(one, fit) for one in fit.nonlinear]
    if not set(G_SENSITIVITY.parameters) & set(fit.parameters):
        return words
    largest = np.abs(fit.model.g_sensitivity).max() * STANDARD_GRAVITY / DEG
    return [
        f'The gyros respond to specific force, by up to {largest:.2g} deg/s per g: '
        f'{G_SENSITIVITY.name} is estimated besides (without it the residuals of holds and turns '
        f'are larger than chance explains: probability {max(fit.chance, _LEAST_CHANCE):.0e}).',
        *words,
    ]


def _nonlinear_words(found: Nonlinearity, fit: FreeFit) -> str:
    term = found.term
    places = indices_of(term.parameters, fit.parameters)
    unit = term.parameters[0].unit
    largest = np.abs(fit.model.values(fit.parameters)[places]).max() / unit.scale
    text = (
        f'The session shows {term.kind.value.words} ({term.name}, by up to '
        f'{significant(largest)} {unit.shown}, by chance once in '
        f'10^{max(3, round(-found.log_p / np.log(10)))} sessions): it is estimated.'
    )
    if found.alternatives:
        names = ' or '.join(other.name for other in found.alternatives)
        text += f' {names} would explain it as well. To tell them apart takes {term.needs}.'
    return text


def in_frame_of_accelerometers(model: SensorModel) -> SensorModel:
    """Return the same sensors in the frame of their accelerometers.

    The rotation Q of (I + M_a) = L Q, L lower triangular, transforms any body axes to that frame.
    The coefficients of terms are unchanged: a rotation by misalignments changes them to second
    order.
    """
    orthogonal, upper = np.linalg.qr(model.accel.response.T)
    signs = np.sign(np.diag(upper))
    lower, rotation = (upper * signs[:, None]).T, (orthogonal * signs).T
    return SensorModel(
        Triad(model.gyro.response @ rotation.T - np.eye(3), model.gyro.bias),
        Triad(lower - np.eye(3), model.accel.bias),
        model.g_sensitivity @ rotation.T,
        terms=model.terms,
    )


def ellipsoid(outputs: Floats, gravity: float) -> Triad:
    """Return the accelerometers on whose ellipsoid (k, 3) outputs lie, by linear least squares.

    |(I + M_a)^-1 (n - d)| = g is a quadric in n: a start for the weighted fit.

    Raises:
        NotObservable: The outputs lie on no ellipsoid.
    """
    x, y, z = (outputs / gravity).T
    columns = [x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z, x, y, z]
    q, _, rank, _ = np.linalg.lstsq(np.column_stack(columns), np.ones(len(x)), rcond=_FLAT)
    quadric = np.array([[q[0], q[3], q[4]], [q[3], q[1], q[5]], [q[4], q[5], q[2]]])
    if rank == len(columns) and np.linalg.eigvalsh(quadric).min() > 0:
        centre = -np.linalg.solve(quadric, q[6:]) / 2
        square = 1 + centre @ quadric @ centre
        # (n - c)' Q (n - c) = s and Q / s = (L L')^-1.
        lower = np.linalg.cholesky(np.linalg.inv(quadric / square))
        return Triad(lower - np.eye(3), centre * gravity)
    raise NotObservable(
        'The accelerometers at rest do not see one and the same gravity in enough attitudes: '
        'K_ax, K_ay, K_az cannot be separated from the biases. Hold each axis up and down, and '
        'slanted.'
    )


def _scatter(state: _State) -> tuple[Floats, Floats, Floats]:
    """Return the scatter of each group over its noise, 1 where not significant.

    The square of a factor is that of the state times the group's chi-square per degree of freedom
    in its standard deviations (Foerstner 1979, for components of variance). The significance is
    tested with the group's noise as known beforehand: wrong weights of another group must not
    affect it. Returns the factors (3,), as standard deviations, their degrees of freedom, and the
    probabilities by chance.
    """
    factors, freedom, chances = np.ones(3), np.full(3, np.inf), np.ones(3)
    for k in range(3):
        as_known = np.where(np.arange(3) == k, 1.0, state.scatter)
        square, free = _square_and_freedom(state.scattering(as_known), k)
        if free > _DETERMINED:
            chances[k] = scipy.special.chdtrc(free, square)
        if chances[k] < _WIDENED:
            square, freedom[k] = _square_and_freedom(state, k)
            factors[k] = max(1.0, float(state.scatter[k] * np.sqrt(square / freedom[k])))
    return factors, freedom, chances


def _square_and_freedom(state: _State, group: int) -> tuple[float, float]:
    """Return the sum of squared residuals of a group, and its degrees of freedom."""
    jacobian, residuals = state.whitened()
    basis = np.linalg.qr(jacobian)[0]
    rows = state.groups[group]
    own = residuals[rows] - basis[rows] @ (basis.T @ residuals)
    return float(own @ own), float(len(rows) - (basis[rows] ** 2).sum())


def _scatter_limit(freedom: Floats) -> Floats:
    """Return the factor by which scatter (n,) may exceed its estimate, by degrees of freedom.

    The posterior mean of a variance estimated as X / v with v degrees of freedom is X / (v - 2),
    for v of at least three (Gelman et al., Bayesian Data Analysis, 3rd ed., section 3.2: the prior
    is 1 / variance).
    """
    known = np.isfinite(freedom)
    few = np.where(known, freedom, 3.0)
    return np.where(known, np.sqrt(np.maximum(1.0, few / np.maximum(1.0, few - 2))), 1.0)


def _wild_turn(state: _State) -> int | None:
    """Find the turn that is an outlier, if any."""
    jacobian, residuals = state.whitened()
    return _outstanding_turn(state, np.linalg.qr(jacobian)[0], residuals, _OUTLYING)


def _outstanding_turn(state: _State, basis: Floats, residuals: Floats, limit: float) -> int | None:
    """Find the turn that the others contradict most, if by more than a limit, times the usual.

    One outlying turn bends the fit towards itself and enlarges the residuals of the others: each is
    judged by the fit without the worst one, by residuals in their own standard deviations (deletion
    formulae of linear least squares: Cook and Weisberg 1982, sections 2.2 and 3.5). The basis (m,
    n) spans the derivatives; `residuals` (m,) and the limit are in deviations.
    """
    moves = state.equations.layout.move
    if not len(moves):
        return None
    own, residuals = basis[moves], residuals[moves]
    kept = np.eye(3) - own @ own.transpose(0, 2, 1)
    sizes, freedom = _studentised(kept, residuals)
    worst = int(np.argmax(sizes))
    weight = np.linalg.pinv(kept[worst], rcond=_UNTESTED, hermitian=True)
    seen = own @ own[worst].T
    others, free = _studentised(
        kept - seen @ weight @ seen.transpose(0, 2, 1), residuals + seen @ weight @ residuals[worst]
    )
    usable = (free > 0) & (np.arange(len(moves)) != worst)
    if freedom[worst] == 0 or np.einsum('kii->', kept) - freedom[worst] < _JUDGING:
        return None
    usual = float(np.median(others[usable] / _MEDIANS[free[usable]]))
    return worst if sizes[worst] > limit * max(1 / float(state.scatter[2]), usual) else None


def _studentised(kept: Floats, residuals: Floats) -> tuple[Floats, Floats]:
    """Return the sizes (k,) of residuals (k, 3) of covariances (k, 3, 3), and their dimensions.

    About the vertical the residual of a turn is zero, as headings are estimated. The dimensions are
    the numbers of directions in which there may be a residual.
    """
    variances, axes = np.linalg.eigh(kept)
    along = np.einsum('kij,ki->kj', axes, residuals)
    shown = variances > _UNTESTED
    squares = np.where(shown, along**2, 0.0) / np.where(shown, variances, 1.0)
    return np.sqrt(squares.sum(axis=1)), shown.sum(axis=1)
