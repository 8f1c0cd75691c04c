"""Sensors from holds in unknown attitudes: gravity has one length, and gyros turn it between holds.

The equations are those of every session (`FreeEquations`), with estimated attitudes. All is
one weighted least squares: the uncertainty of a direction by the accelerometers enters the
parameters of the gyros. G-sensitivity of the gyros, nonlinearity of the accelerometers and biases
that drift are estimated too, where the session shows them.

The frame is that of the accelerometers, as in imu_tk: X along the input axis of channel x, the
input axis of channel y in the plane of X and Y, so that E_axy = E_axz = E_ayz = 0.

Sources: Tedaldi, Pretto and Menegatti 2014, ICRA, eqs. (9) to (15), who fit accelerometers and
gyros one after the other; Skog and Haendel 2006, XVII IMEKO, for the norm of gravity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import scipy

from ..common.budget import ErrorSource, Share, Shares
from ..common.errors import InputError, NotObservable
from ..common.finding import Finding
from ..common.stream import Floats
from ..common.units import DEG, STANDARD_GRAVITY, counted, significant
from ..model.parameters import PARAMETERS, Parameter, ParameterKind, indices_of
from ..model.sensors import SensorModel, Triad, terms_of
from ..model.session_terms import Change, Changes, Course
from ..model.terms import ACCEL_ASYMMETRY, ACCEL_CUBIC, ACCEL_QUADRATIC, G_SENSITIVITY, Term
from ..session.plan import Plan
from .checks import check_axes
from .components import Component, Factor
from .estimate import shares
from .evidence import Evidence
from .free_dwells import FreeEquations, at_headings_by_moves
from .hand_findings import (
    DRIFT_SHOWN,
    LARGEST_DRIFT,
    TRENDS,
    Drift,
    DriftKind,
    check_turns,
    contradicts_latitude,
    drift_words,
    other_latitudes,
    wrong_latitude,
)
from .information import Information
from .modulation import spans
from .outputs import Indices
from .score import Family, Score, log_f, scores_of
from .solution import Solution
from .solve import least_squares
from .term_tests import TermState, TermTest, test_of

NAME = 'free_positions'
_NEEDS = (
    'Free positions need every sample between the holds, which segments of a table session do not '
    'have: run them on a recording with the IMU alone.'
)
"""The method's name in plans."""

_KEPT = {('a', 0, 1), ('a', 0, 2), ('a', 1, 2)}
"""Misalignments that are zero by definition of the body axes: triad, row, column."""

FREE = np.array([(p.triad, p.row, p.column) not in _KEPT for p in PARAMETERS])
"""(24,) mask of the 24 that exist in the frame of the accelerometers: 21."""

ESTIMATES = tuple(p for p, found in zip(PARAMETERS, FREE, strict=True) if found)

_RATIOS = np.array([p.kind is not ParameterKind.BIAS for p in ESTIMATES])
"""(21,) mask of those that are not biases."""

FEWEST = 9  #: Holds below which gravity does not determine nine parameters of the accelerometers.

_ITERATIONS = 100  #: Most steps of a fit; one that has not converged by then raises.
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
_OUTLYING = 6.0  #: Times the usual size of a turn's residual: exceeded in 2e-8 (Rayleigh).
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

_LOG_SHOWN = float(np.log(_SHOWN))

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
the likelihood (as in `search`)."""

_WANDERS = 2.0 ** np.arange(1, 11)
"""Grid of the size of a wander, of the noise of a hold: the likelihood is flat within a factor of
two."""
_DEGREES = 3
"""Highest degree of the polynomials of time by which an uneven drift is looked for. A judgement: a
unit that warms up or wanders shows most of its drift in them, and they leave the holds a test."""

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
_ACCELS = ('accelerometers', 'gravity')  #: Sensors whose response is checked, and its input.
_GROUPS = ('the accelerometers at rest', 'the gyros at rest', 'the turns')


@dataclass(frozen=True, eq=False)
class FreeFit:
    """Estimate from holds and turns."""

    model: SensorModel  #: In the frame of the accelerometers.
    #: The n of the covariance: the 24, and those of terms that the session shows.
    parameters: tuple[Parameter, ...]
    covariance: Floats  #: (n, n); zero for the three that the frame sets to zero.
    residuals: Floats  #: (k, 6) outputs at rest less those predicted by the model.
    condition: float  #: Condition number of the system, columns scaled to unit length.
    #: (3,) factor on the noise of accelerometers at rest, gyros at rest and turns by their scatter,
    #: as standard deviations.
    scatter: Floats
    scatter_chances: Floats  #: (3,) probabilities of such scatter by chance.
    rejected_moves: tuple[int, ...]  #: Indices of the holds before turns that were left out.
    shares: Shares  #: The covariance by source.
    chance: float = 1.0  #: Probability of so significant a g-sensitivity by chance; 1 without it.
    drifts: tuple[Drift, ...] = ()  #: Drifts of biases that the session shows.
    changes: Changes | None = None  #: Their coefficients; None without an even one.
    #: Terms of the accelerometers that are on, in the order in which they were found.
    nonlinear: tuple[Nonlinearity, ...] = ()
    tests: tuple[TermTest, ...] = ()  #: Of the terms of the accelerometers.


@dataclass(frozen=True)
class Nonlinearity:
    """A term of the accelerometers that a session shows."""

    term: Term  #: The term.
    log_p: float  #: Natural logarithm of the probability by chance.
    alternatives: tuple[Term, ...] = ()  #: Terms that explain the session as well.


@dataclass(frozen=True, eq=False)
class _State:
    """A step of the iteration."""

    equations: FreeEquations  #: Linearised at the present attitudes.
    values: Floats  #: (n,) the state.
    scatter: Floats  #: (3,) factors on the noise, as in `FreeFit`.
    rejected_moves: tuple[int, ...] = ()  #: Likewise.
    scatter_chances: Floats = field(default_factory=lambda: np.ones(3))  #: Likewise.
    #: Biases that wander, by the name of their drift, and by how much: in the covariance.
    wanders: tuple[tuple[str, float], ...] = ()

    @property
    def groups(self) -> tuple[Indices, ...]:
        """Groups of outputs with common scatter: see `FreeFit.scatter`."""
        rows = self.equations.layout
        return rows.dwell[:, 3:].ravel(), rows.dwell[:, :3].ravel(), rows.move.ravel()

    def whitened(self) -> tuple[Floats, Floats]:
        """Return derivatives and residuals in standard deviations."""
        return self.equations.whitened(self.values)

    @cached_property
    def information(self) -> Information:
        """The information of the equations."""
        return Information.from_jacobian(self.whitened()[0])

    @cached_property
    def basis(self) -> Floats:
        """Orthonormal columns (m, n) that span the derivatives in standard deviations."""
        return np.asarray(np.linalg.qr(self.whitened()[0])[0])

    @property
    def chi_square(self) -> float:
        """Sum of squares of the residuals in standard deviations."""
        residuals = self.whitened()[1]
        return float(residuals @ residuals)

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

    def with_changes(self, changes: tuple[Change, ...]) -> _State:
        """Return the state with coefficients of a session's terms, initially zero."""
        equations = replace(self.equations, changes=(*self.equations.changes, *changes))
        values = np.insert(self.values, self.equations.change_slice.stop, np.zeros(len(changes)))
        return replace(self, equations=equations, values=values)

    def wandering(self, name: str, size: float) -> _State:
        """Return the state with biases of a triad that wander, by so much during the session.

        The covariance is that of a random walk about its mean, by its Karhunen-Loeve expansion.
        """
        equations = self.equations
        starts, ends = spans(equations.evidence)
        time = (starts + ends) / (2 * ends.max())
        order = np.pi * np.arange(1, len(equations.evidence.segments))
        columns = self.drifting(name, np.sqrt(2) * np.cos(order * time[:, None]) / order) * size
        extra = (*equations.extra, Component(ErrorSource.BIAS_FOUND, Factor(columns)))
        return replace(
            self,
            equations=replace(equations, extra=extra),
            wanders=(*self.wanders, (name, size)),
        )

    def drifting(self, name: str, courses: Floats) -> Floats:
        """Return the effect on the outputs of biases that drift by courses (s + t, k), (m, 3 k)."""
        equations = self.equations
        biases = [equations.parameters.index(c.parameters[0]) for c in TRENDS[name]]
        slopes = equations.jacobian(self.values)[:, biases]
        own = courses[equations.layout.segment]
        return np.asarray((slopes[:, :, None] * own[:, None]).reshape(len(own), -1))

    def without(self, wild: int) -> _State:
        """Return the state without a move: it splits a run in two, and north is estimated anew."""
        evidence = self.equations.evidence
        link = evidence.used_moves.linked[wild]
        moves = tuple(move for move in evidence.moves if move is not link.move)
        evidence = replace(evidence, moves=moves)
        equations = replace(self.equations, evidence=evidence, inflation=None, extra=())
        values = equations.nominal()
        values[: equations.sensors] = self.values[: equations.sensors]
        dropped = tuple(sorted((*self.rejected_moves, link.first)))
        state = _State(equations, values, np.ones(3), dropped)
        for name, size in self.wanders:
            state = state.wandering(name, size)
        return state


def solve(evidence: Evidence) -> FreeFit:
    """Estimate 21 parameters, and terms that the session shows, from holds and turns between.

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
    choice = _chosen(start)
    if choice.chance < _SHOWN:
        _check_latitude(_with_estimated_noise(start.with_changes(choice.state.equations.changes)))
    state, nonlinear = _with_nonlinearity(choice.state)
    if nonlinear:
        # Without it the directions of gravity were off, and the turns contradicted them.
        choice = _chosen(start.with_terms(tuple(one.term for one in nonlinear)))
        state = choice.state
    chance = choice.chance
    _check_observable(state)
    equations, values = state.equations, state.values
    check_axes(equations.model(values).gyro.response, 'gyros', 'the turns between holds')
    information = state.information
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
        (*choice.drifts, *_uneven(state)),
        _changes(state, information, len(parameters), own),
        nonlinear,
        _tests(state, choice, nonlinear, information),
    )


@dataclass(frozen=True)
class _Choice:
    """A fit with g-sensitivity and even drifts on or off."""

    state: _State  #: The least squares.
    #: Probability of so significant a g-sensitivity by chance, where that was tested.
    chance: float
    drifts: tuple[Drift, ...] = ()  #: The drifts that are on: even ones, and wanders.


def _chosen(start: _State) -> _Choice:
    """Add g-sensitivity of the gyros and drifts of biases, where the session shows them.

    In a few holds either may explain the other: the likelier one is taken.
    """
    plain = _with_estimated_noise(start)
    chance = _chance(plain, G_SENSITIVITY)
    sensitive = start.with_terms((G_SENSITIVITY,))
    found = [_Choice(plain if chance >= _SHOWN else _with_estimated_noise(sensitive), chance)]
    if chance < _SHOWN or _may_drift(plain):
        drifting = _with_trends(start)
        if drifting.drifts:
            found.append(drifting)
        if chance < _SHOWN or _chance(drifting.state, G_SENSITIVITY) < _SHOWN:
            both = _with_trends(sensitive)
            if both.drifts and both.chance < _SHOWN:
                found.append(both)
    return _with_wander(min(found, key=lambda choice: _misfit(choice.state)))


def _may_drift(state: _State) -> bool:
    """Return whether outputs scatter, or one step from a fit shows drifts."""
    if (state.scatter_chances < _WIDENED).any():
        return True
    trial = state.with_changes(tuple(c for changes in TRENDS.values() for c in changes))
    information = trial.information
    with np.errstate(invalid='ignore'):
        trial = replace(trial, values=trial.values + information.gain @ trial.whitened()[1])
    return min(_log_chances(trial, information).values()) < _LOG_SHOWN


def _with_trends(start: _State) -> _Choice:
    """Let biases drift evenly; drifts that are not significant are taken out again, worst first."""
    names = list(TRENDS)
    while names:
        try:
            state = _with_estimated_noise(
                start.with_changes(tuple(c for n in names for c in TRENDS[n]))
            )
            _check_observable(state)
        except NotObservable:
            # A few holds may determine no drift of the accelerometers.
            names.pop()
            continue
        information = state.information
        logs = _log_chances(state, information)
        # Where the gyros drift the accelerometers are likely to.
        likely = logs.get('trend:D_g', 0.0) < _LOG_SHOWN
        beyond = {n: logs[n] - np.log(_SHOWN if likely else DRIFT_SHOWN[n]) for n in names}
        worst = max(names, key=lambda name: beyond[name])
        if beyond[worst] < 0:
            known = state.equations.parameters
            chance = 1.0
            if G_SENSITIVITY in terms_of(known):
                places = np.array(indices_of(G_SENSITIVITY.parameters, known))
                chance = float(np.exp(_log_chance(state, information, places, 'g')))
            drifts = tuple(Drift(n, logs[n], _drifted(state, TRENDS[n])) for n in names)
            return _Choice(state, chance, drifts)
        names.remove(worst)
    return _Choice(_with_estimated_noise(start), 1.0)


def _log_chances(state: _State, information: Information) -> dict[str, float]:
    """Return the logarithms of the probabilities by chance of the drifts that are on."""
    start, changes = state.equations.change_slice.start, state.equations.changes
    found = {}
    for name, mine in TRENDS.items():
        if mine[0] in changes:
            places = np.array([start + changes.index(c) for c in mine])
            triad = mine[0].parameters[0].triad
            found[name] = _log_chance(state, information, places, triad)
    return found


def _log_chance(state: _State, information: Information, places: Indices, triad: str) -> float:
    """Return the logarithm of the probability by chance of unknowns of a triad that are on.

    The F test under the scatter with them (`places` in the state), which is known by the degrees of
    freedom of the groups that show them: at rest, and the turns.
    """
    covariance = information.covariance[np.ix_(places, places)]
    groups = (0, 2) if triad == 'a' else (1, 2)
    freedom = sum(_square_and_freedom(state, k)[1] for k in groups)
    if not np.isfinite(covariance).all() or freedom < _DETERMINED:
        return 0.0
    values = state.values[places]
    square = float(values @ np.linalg.solve(covariance, values))
    return min(0.0, log_f(square / len(places), len(places), freedom))


def _misfit(state: _State) -> float:
    """Return minus twice the log of the likelihood, with the penalty of Schwarz for unknowns.

    A turn that is left out counts as one of the least size for that.

    Source: Schwarz 1978, Annals of Statistics 6, 461.
    """
    equations, out = state.equations, len(state.rejected_moves)
    spread = 0.0 if equations.inflation is None else float(np.log(equations.inflation).sum())
    unknowns = equations.sensors + len(equations.changes)
    penalty = unknowns * float(np.log(len(equations.layout)))
    return state.chi_square + spread + penalty + out * _OUTLYING**2


def _drifted(state: _State, changes: Sequence[Change]) -> float:
    """Return the largest change of a bias during the session, rad/s or m/s^2."""
    equations = state.equations
    start = equations.change_slice.start
    rates = [state.values[start + equations.changes.index(c)] for c in changes]
    return float(np.abs(rates).max() * spans(equations.evidence)[1].max())


def _changes(
    state: _State, information: Information, count: int, places: list[int]
) -> Changes | None:
    """Return the coefficients of drifts, and how they vary with `count` parameters.

    Those of the state have `places` among these.
    """
    equations = state.equations
    if not equations.changes:
        return None
    own = equations.change_slice
    cross = np.zeros((count, len(equations.changes)))
    cross[places] = information.covariance[: equations.sensors, own]
    return Changes(
        equations.changes,
        state.values[own],
        information.covariance[own, own],
        cross,
    )


def _with_wander(choice: _Choice) -> _Choice:
    """Let biases wander where that explains scatter better than holds and turns of their own."""
    state, drifts = choice.state, choice.drifts
    # Turns compare directions of gravity by the accelerometers.
    for name, at_rest, groups in (('trend:D_g', 1, [1]), ('trend:D_a', 0, [0, 2])):
        if (state.scatter[groups] == 1).all():
            continue
        quiet = state.scattering(np.where(np.isin(np.arange(3), groups), 1.0, state.scatter))
        variances = np.diag(quiet.equations.covariance(state.values))[state.groups[at_rest]]
        sizes = np.sqrt(np.median(variances)) * _WANDERS
        tried = [quiet.wandering(name, size) for size in sizes.tolist()]
        least = [_restricted(one) for one in tried]
        best = int(np.argmin(least))
        gained = _restricted(state) - least[best]
        # A drift is seldom even, and where one triad drifts the other is likely to.
        if gained > (0.0 if drifts else _LIKELIER):
            state = _with_estimated_noise(tried[best])
            drifts = (*drifts, Drift(name, -gained / 2, float(sizes[best]), DriftKind.WANDER))
    return replace(choice, state=state, drifts=drifts)


def _restricted(state: _State) -> float:
    """Return minus twice the logarithm of the restricted likelihood of a covariance.

    Source: Patterson and Thompson 1971, Biometrika 58, 545.
    """
    jacobian, residuals = state.whitened()
    norms = np.linalg.norm(jacobian, axis=0)
    jacobian, norms = jacobian[:, norms > 0], norms[norms > 0]
    basis, upper = np.linalg.qr(jacobian / norms)
    left = residuals - basis @ (basis.T @ residuals)
    roots = np.diag(state.equations.factor(state.values))
    logs = np.log(norms).sum() + np.log(np.abs(np.diag(upper))).sum() + np.log(roots).sum()
    return float(left @ left + 2 * logs)


def _uneven(state: _State) -> tuple[Drift, ...]:
    """Return uneven drifts of biases: polynomials of time found in the remaining residuals.

    The covariance includes wandering biases. A trembling hand scatters from hold to hold; a
    drifting bias is similar in neighbouring holds. Drifts are tested, not estimated: the scatter
    that they cause is already included.
    """
    equations, values = state.equations, state.values
    starts, ends = spans(equations.evidence)
    time = (starts + ends) / ends.max() - 1
    courses = np.asarray(np.polynomial.legendre.legvander(time, _DEGREES)[:, 1:], dtype=float)
    patterns = {}
    for name in (name for name in TRENDS if name not in dict(state.wanders)):
        size = LARGEST_DRIFT[name] * max(1.0, state.scatter.max())
        columns = state.drifting(name, courses) * size
        family = Family(name, course=Course.TREND)
        patterns[family] = ((columns, np.full(columns.shape[1], size)),)
    found = []
    for family, score in scores_of(patterns, equations, values).items():
        if score.log_p < _LOG_SHOWN:
            drift = courses @ score.estimate.reshape(-1, _DEGREES).T
            largest = float(np.ptp(drift, axis=0).max())
            found.append(Drift(family.name, score.log_p, largest, DriftKind.UNEVEN))
    return tuple(found)


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
    state: _State, choice: _Choice, found: Sequence[Nonlinearity], information: Information
) -> tuple[TermTest, ...]:
    """Return the terms that are on, and what the session shows of those of the accelerometers."""
    equations, values = state.equations, state.values
    sensors, outputs = slice(0, equations.sensors), slice(0, len(equations.outputs))
    std = information.std[sensors]
    root = np.linalg.cholesky(equations.covariance(values))
    tests = [TermTest.found(one.term, one.log_p) for one in found]
    for one in (drift for drift in choice.drifts if drift.kind is DriftKind.EVEN):
        log10_p = one.log_p / float(np.log(10))
        tests.append(TermTest(one.name, TermState.FOUND, log10_p, changes=TRENDS[one.name]))
    if choice.chance < _SHOWN:
        log_p = float(np.log(max(choice.chance, _LEAST_CHANCE)))
        tests.insert(0, TermTest.found(G_SENSITIVITY, log_p))
    for family, score in {**_scores(state), **_trend_scores(state)}.items():
        if family.term is None:
            columns = equations.columns(family.changes, equations.jacobian(values))
        else:
            columns = equations.parameter_derivatives(values, family.parameters)
        slopes = information.gain[sensors, outputs] @ np.linalg.solve(root, columns)
        limit = DRIFT_SHOWN[family.name] if family.term is None else _SHOWN / len(_NONLINEAR)
        tests.append(test_of(family, score, slopes, limit, equations.parameters, std, _AMOUNT))
    return tuple(tests)


def _trend_scores(state: _State) -> dict[Family, Score]:
    """Test the even drifts that are off, under the scatter."""
    equations, values = state.equations, state.values
    whole = float(spans(equations.evidence)[1].max())
    patterns = {}
    for name, changes in TRENDS.items():
        if changes[0] not in equations.changes:
            sizes = np.full(len(changes), LARGEST_DRIFT[name] / whole)
            columns = equations.columns(changes, equations.jacobian(values)) * sizes
            patterns[Family(name, course=Course.TREND)] = ((columns, sizes),)
    return scores_of(patterns, equations, values)


def _check_latitude(state: _State) -> None:
    """Raise if another latitude explains the session in place of a term."""
    evidence = state.equations.evidence
    misfit = state.chi_square
    for latitude in other_latitudes(evidence):
        site = replace(evidence.site, latitude=latitude)
        equations = replace(state.equations, evidence=replace(evidence, site=site))
        elsewhere = replace(state, equations=equations).settled()
        if (
            misfit - elsewhere.chi_square > _LIKELIER
            and _chance(elsewhere, G_SENSITIVITY) >= _SHOWN
        ):
            raise wrong_latitude(evidence, latitude)


def is_clear(evidence: Evidence) -> bool:
    """Return whether one linear step shows that `solve` will accept the session; False in doubt.

    The equations are nearly linear over the step, no turn is an outlier, and the standard
    deviations that `solve` may widen by scatter remain far from useless: factors up to s on the
    noise of groups inflate the covariance by s^2 at most.

    Source: docs/mathematics.md, 'Free positions'.
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
    information = Information.from_jacobian(rows[:, :-1])
    if not information.observed.all():
        return False
    step = information.gain @ rows[:, -1]
    rest = rows[:, -1] - rows[:, :-1] @ step
    if _largest(step, equations) > _STRAIGHT or contradicts_latitude(equations.evidence):
        return False
    if _outlying_turn(state, np.linalg.qr(rows[:, :-1])[0], rest) is not None:
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
    """Return the equations in attitudes by gravity and gyros, and the starting state."""
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
        wild = _outlying_turn(state, state.basis, state.whitened()[1])
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
    before, after = state.chi_square, float(residuals @ residuals)
    count, freedom = len(term.parameters), len(residuals) - jacobian.shape[1]
    if freedom < 1 or after >= before:
        return 1.0
    ratio = (before - after) / count / (after / freedom)
    return float(scipy.special.fdtrc(count, freedom, ratio))


def _check_observable(state: _State) -> None:
    """Raise if attitudes and turns do not determine all parameters."""
    parameters, evidence = state.equations.parameters, state.equations.evidence
    std = state.information.std[: len(parameters)]
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


def check(plan: Plan) -> None:
    """Raise if a plan is not one of holds in the hand alone."""
    if not plan.by_hand:
        raise NotObservable(_NEEDS)
    if any(position.rate_test for position in plan.positions):
        raise NotObservable(
            f'Free positions are holds alone, and plan {plan.name} has turns: choose another '
            'method, or the plan free_positions.'
        )


def refuse(_: Evidence) -> Solution:
    """Raise, naming what this method needs beyond static dwells and whole turns."""
    raise NotObservable(_NEEDS)


def scatter_words(fit: FreeFit) -> list[str]:
    """Report groups that scatter significantly more than their noise."""
    return [
        Finding(
            f'The residuals of {name} are {factor:.1f} times their noise: the standard deviations '
            'are widened. Possible causes: a hand that trembled, and bias drift.',
            effect=factor - 1,
        )
        for name, factor, chance in zip(_GROUPS, fit.scatter, fit.scatter_chances, strict=True)
        if chance < _SIGNIFICANT
    ]


def term_words(fit: FreeFit) -> list[str]:
    """Report the terms that the session showed, and their significance."""
    words = [_nonlinear_words(one, fit) for one in fit.nonlinear]
    words += drift_words(fit.drifts)
    if not set(G_SENSITIVITY.parameters) & set(fit.parameters):
        return words
    largest = np.abs(fit.model.g_sensitivity).max() * STANDARD_GRAVITY / DEG
    chance = max(fit.chance, _LEAST_CHANCE)
    return [
        Finding(
            f'The gyros respond to specific force, by up to {largest:.2g} deg/s per g '
            f'(probability of chance {chance:.0e}): {G_SENSITIVITY.name} is estimated, too.',
            effect=float(np.sqrt(-2 * np.log(chance))),
        ),
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
    return Finding(text, effect=float(np.sqrt(-2 * found.log_p)))


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
        'Too few attitudes: K_ax, K_ay, K_az cannot be separated from the biases of the '
        'accelerometers. Hold the unit with each axis up, down and slanted.'
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
        alike = np.array_equal(as_known, state.scatter)
        known = state if alike else state.scattering(as_known)
        square, free = _square_and_freedom(known, k)
        if free > _DETERMINED:
            chances[k] = scipy.special.chdtrc(free, square)
        if chances[k] < _WIDENED:
            square, freedom[k] = _square_and_freedom(state, k)
            factors[k] = max(1.0, float(state.scatter[k] * np.sqrt(square / freedom[k])))
    return factors, freedom, chances


def _square_and_freedom(state: _State, group: int) -> tuple[float, float]:
    """Return the sum of squared residuals of a group, and its degrees of freedom."""
    basis, residuals, rows = state.basis, state.whitened()[1], state.groups[group]
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


def _outlying_turn(state: _State, basis: Floats, residuals: Floats) -> int | None:
    """Find the turn that the others contradict most, if by `_OUTLYING` times the usual.

    One outlying turn bends the fit towards itself and enlarges the residuals of the others: each is
    judged by the fit without the worst one, by residuals in their own standard deviations (deletion
    formulae of linear least squares: Cook and Weisberg 1982, sections 2.2 and 3.5). The basis (m,
    n) spans the derivatives; `residuals` (m,) are in deviations.
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
    return worst if sizes[worst] > _OUTLYING * max(1 / float(state.scatter[2]), usual) else None


def _studentised(kept: Floats, residuals: Floats) -> tuple[Floats, Indices]:
    """Return the sizes (k,) of residuals (k, 3) of covariances (k, 3, 3), and their dimensions.

    About the vertical the residual of a turn is zero, as headings are estimated. The dimensions are
    the numbers of directions in which there may be a residual.
    """
    variances, axes = np.linalg.eigh(kept)
    along = np.einsum('kij,ki->kj', axes, residuals)
    shown = variances > _UNTESTED
    squares = np.where(shown, along**2, 0.0) / np.where(shown, variances, 1.0)
    return np.sqrt(squares.sum(axis=1)), shown.sum(axis=1)
