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

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy

from ..common.budget import ErrorSource, Share, Shares
from ..common.errors import InputError, NotObservable
from ..common.finding import Finding, warning
from ..common.stream import Floats
from ..common.units import DEG, STANDARD_GRAVITY, counted, significant
from ..model.earth import EARTH_RATE
from ..model.parameters import PARAMETERS, Parameter, ParameterKind, indices_of
from ..model.sensors import SensorModel, Triad
from ..model.session_terms import Change, Changes, Course, terms_in_words
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
    drift_words,
    other_latitudes,
    wrong_latitude,
)
from .information import Information
from .modulation import spans
from .outputs import Indices
from .score import Family, Pattern, Score, WhitenedResiduals, scores_of
from .search import SignificantFamily
from .solution import Solution
from .solve import least_squares
from .term_tests import TermTest, chance_in_words, test_of
from .variances import Variance, choose_variances, restricted

NAME = 'free_positions'  #: The method's name in plans.
_NEEDS = (
    'Free positions need every sample between the holds, which segments of a table session do not '
    'have: run them on a recording with the IMU alone.'
)

_KEPT = {('a', 0, 1), ('a', 0, 2), ('a', 1, 2)}
"""Misalignments that are zero by definition of the body axes: triad, row, column."""

FREE = np.array([(p.triad, p.row, p.column) not in _KEPT for p in PARAMETERS])
"""(24,) mask of the 24 that exist in the frame of the accelerometers: 21."""

ESTIMATES = tuple(p for p, found in zip(PARAMETERS, FREE, strict=True) if found)

FEWEST = 9  #: Holds below which gravity does not determine nine parameters of the accelerometers.

_ITERATIONS = 100  #: Most steps of a fit; one that has not converged by then raises.
_ROUNDS = 10
"""Rounds in which scatter is estimated again, after each turn that is left out; a cap."""
_LEAST_GAIN = 3.3
"""Least gain in log likelihood for scatter beyond the noise, half of chi-square: in three sound
sessions of a hundred one of three groups and two drifts gains as much by chance."""
_SAID = 0.9
"""Probability from which on scatter is reported: beside the least gain another 2.2, a chance of
five in ten thousand."""
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

_LEAST_LOG = float(np.log(1e-99))
"""Least probability that is reported, as a logarithm: smaller ones are beyond the
approximations."""

_NONLINEAR = (ACCEL_QUADRATIC, ACCEL_ASYMMETRY, ACCEL_CUBIC)
"""Terms of the accelerometers that are tested, each axis for itself. The cross terms are nine more,
for which holds of a few minutes are too few."""
_FAMILIES = (
    *(Family(term.name, term) for term in (G_SENSITIVITY, *_NONLINEAR)),
    *(Family(name, course=Course.TREND) for name in TRENDS),
)
"""Families that are tested."""
_LARGEST = 0.02
"""Largest of their effects at 1 g, of it: chips are stated to be linear to 0.1 to 2 % of range."""
_LARGEST_G = 1 * DEG / STANDARD_GRAVITY
"""Largest useful g-sensitivity, 1 deg/s per g: ten times that of usual chips."""
_AMOUNT = 1000.0
"""Amount of a coefficient for which its effect is reported, ug/g^2, ppm or ug/g^3: a tenth of a
percent at 1 g, as of a usual chip."""
_APART = 9.0
"""Difference of chi-square below which two terms explain a session equally well: a factor of 90 in
the likelihood (as in `search`)."""
_DEGREES = 3
"""Highest degree of the polynomials of time by which an uneven drift is looked for. A judgement: a
unit that warms up or wanders shows most of its drift in them, and they leave the holds a test."""

_MOST_REMAINING = 5.0
"""Ratio by which a step lessens the wander to be named in its place. A judgement: of one that is
within a hold or a turn little remains, and of an even walk or a warm-up a third or more."""

_USELESS = 0.05
"""Standard deviation of a ratio from which on it is useless: data sheets are better."""
_LIKELIER = 2 * np.log(1000)
"""Decrease of chi-square at another latitude for that to be meant: odds of a thousand."""
_ACCELS = ('accelerometers', 'gravity')  #: Sensors whose response is checked, and its input.
_GROUPS = ('the accelerometers at rest', 'the gyros at rest', 'the turns')
_RUINED = 30.0
"""Times their noise from which residuals are a warning: those of published recordings of hands are
up to 16 (docs/real_recordings.md, position), those of simulated turns with clipped gyros 600 and
more, at scale factors off by 10 %."""


@dataclass(frozen=True, eq=False)
class Scatter:
    """Scatter of holds and turns beyond their noise."""

    #: (3,) variances of accelerometers at rest, gyros at rest and turns over those of their noise.
    groups: Floats
    wanders: Floats  #: (2,) variances of the biases' change, by `TRENDS`, (rad/s)^2 and (m/s^2)^2.
    probability: Floats  #: (5,) of each.

    def is_as(self, other: Scatter) -> bool:
        """Return whether another is the same to a few percent."""
        pairs = ((1 + self.groups, 1 + other.groups), (self.wanders, other.wanders))
        return all(np.allclose(one, two, rtol=2 * _SETTLED) for one, two in pairs)


_NO_SCATTER = Scatter(np.zeros(3), np.zeros(2), np.zeros(5))


@dataclass(frozen=True, eq=False)
class FreeFit:
    """Estimate from holds and turns."""

    model: SensorModel  #: In the frame of the accelerometers.
    #: The n of the covariance: the 24, and those of terms that the session shows.
    parameters: tuple[Parameter, ...]
    covariance: Floats  #: (n, n); zero for the three that the frame sets to zero.
    residuals: Floats  #: (k, 6) outputs at rest less those predicted by the model.
    condition: float  #: Condition number of the system, columns scaled to unit length.
    scatter: Scatter  #: Beyond the noise.
    rejected_moves: tuple[int, ...]  #: Indices of the holds before turns that were left out.
    shares: Shares  #: The covariance by source.
    drifts: tuple[Drift, ...] = ()  #: Drifts of biases that the session shows.
    changes: Changes | None = None  #: Their coefficients; None without an even one.
    found: tuple[SignificantFamily, ...] = ()  #: Terms that are on, in the order of their finding.
    tests: tuple[TermTest, ...] = ()  #: Of all terms.


@dataclass(frozen=True, eq=False)
class _State:
    """A step of the iteration."""

    equations: FreeEquations  #: Linearised at the present attitudes.
    values: Floats  #: (n,) the state.
    scatter: Scatter = _NO_SCATTER  #: In the covariance.
    rejected_moves: tuple[int, ...] = ()  #: As in `FreeFit`.

    @property
    def groups(self) -> tuple[Indices, ...]:
        """Groups of outputs with common scatter: see `Scatter`."""
        rows = self.equations.layout
        return rows.dwell[:, 3:].ravel(), rows.dwell[:, :3].ravel(), rows.move.ravel()

    def whitened(self) -> tuple[Floats, Floats]:
        """Return derivatives and residuals in standard deviations."""
        return self.equations.whitened(self.values)

    @cached_property
    def information(self) -> Information:
        """The information of the equations."""
        return Information.from_jacobian(self.whitened()[0])

    @property
    def wild(self) -> int | None:
        """The turn that the others contradict most, if any."""
        jacobian, residuals = self.whitened()
        return _outlying_turn(self, np.asarray(np.linalg.qr(jacobian)[0]), residuals)

    @property
    def chi_square(self) -> float:
        """Sum of squares of the residuals in standard deviations."""
        return self.equations.chi_square(self.values)

    def moved(self, step: Floats) -> _State:
        """Return the state after a step (n,), in attitudes turned by it."""
        equations, values = self.equations.moved(self.values, step)
        return replace(self, equations=equations, values=values)

    def settled(self) -> _State:
        """Return the least squares."""
        return least_squares(self, _State.whitened, _State.moved, _ITERATIONS)

    def weighted(self, *, outliers: bool = True) -> _State:
        """Return the least squares with scatter estimated, and without outlying turns if wanted."""
        state, rounds = self, 0
        while rounds < _ROUNDS:
            state, rounds = state.settled(), rounds + 1
            scatter = state.likely_scatter()
            if not scatter.is_as(state.scatter):
                state = state.scattering(scatter)
            elif outliers and (wild := state.wild) is not None:
                # Beside biases that wander: these make outliers of turns.
                state, rounds = state.without_turn(wild), 0
            else:
                break
        return state

    def likely_scatter(self, columns: Floats | None = None) -> Scatter:
        """Estimate the scatter; some columns (m, k) of further unknowns explain residuals, too."""
        equations = replace(self.equations, inflation=None, extra=())
        slopes = equations.jacobian(self.values)
        prior = equations.prior_rows(self.values)
        if columns is not None:
            slopes = np.hstack([slopes, columns])
            prior = np.insert(prior, [-1] * columns.shape[1], 0.0, axis=1)
        seen = slopes.any(axis=0)
        project, left = restricted(
            slopes[:, seen],
            equations.outputs - equations.predict(self.values),
            equations.covariance(self.values),
            prior[:, np.append(seen, True)],
        )
        own = equations.own_variances
        entering = [np.sqrt(own[rows]) * project[rows].T for rows in self.groups]
        units = [float(np.median(own[self.groups[k]])) for k in (1, 0)]
        for name, unit in zip(TRENDS, units, strict=True):
            entering.append(project.T @ self.wandering(name) * np.sqrt(unit))
        chosen = choose_variances(
            [(left, np.eye(len(left)))], (), [[Variance((e @ e.T,))] for e in entering], _LEAST_GAIN
        )
        sizes = np.concatenate(chosen.means)
        probability = np.array([chosen.probability(k) for k in range(len(sizes))]) * chosen.needed
        return Scatter(sizes[:3], sizes[3:] * units, probability)

    def scattering(self, scatter: Scatter) -> _State:
        """Return the state with this scatter in its covariance."""
        inflation = np.ones(len(self.equations.layout))
        for rows, variance in zip(self.groups, scatter.groups, strict=True):
            inflation[rows] += variance
        extra = tuple(
            Component(ErrorSource.BIAS_FOUND, Factor(self.wandering(name) * size))
            for name, size in zip(TRENDS, np.sqrt(scatter.wanders), strict=True)
            if size
        )
        equations = replace(self.equations, inflation=inflation, extra=extra)
        return replace(self, equations=equations, scatter=scatter)

    def with_families(self, families: Sequence[Family]) -> _State:
        """Return the state with terms on, initially zero."""
        equations, values = self.equations, self.values
        for family in families:
            start, more = equations.sensors, family.parameters
            if family.term is None:
                start = equations.change_slice.stop
            values = np.insert(values, start, np.zeros(len(more) + len(family.changes)))
            equations = replace(
                equations,
                parameters=(*equations.parameters, *more),
                changes=(*equations.changes, *family.changes),
            )
        return replace(self, equations=equations, values=values)

    def without(self, family: Family) -> _State:
        """Return the state with a term off, all else as it is."""
        equations = self.equations
        places = self.places(family)
        parameters = tuple(p for p in equations.parameters if p not in family.parameters)
        changes = tuple(c for c in equations.changes if c not in family.changes)
        equations = replace(equations, parameters=parameters, changes=changes)
        return replace(self, equations=equations, values=np.delete(self.values, places))

    def places(self, family: Family) -> Indices:
        """Return where the coefficients of a term that is on are in the state."""
        equations = self.equations
        if family.term is not None:
            return np.array(indices_of(family.parameters, equations.parameters))
        start = equations.change_slice.start
        return np.array([start + equations.changes.index(c) for c in family.changes])

    def wandering(self, name: str) -> Floats:
        """Return the effect on the outputs of biases of a triad that wander, (m, k).

        For a random walk about its mean with a variance of one over the session, by its
        Karhunen-Loeve expansion.
        """
        evidence = self.equations.evidence
        starts, ends = spans(evidence)
        time = (starts + ends) / (2 * ends.max())
        order = np.pi * np.arange(1, len(evidence.segments))
        return self.drifting(name, np.sqrt(2) * np.cos(order * time[:, None]) / order)

    def drifting(self, name: str, courses: Floats) -> Floats:
        """Return the effect on the outputs of biases that drift by courses (s + t, k), (m, 3 k)."""
        equations = self.equations
        biases = [equations.parameters.index(c.parameters[0]) for c in TRENDS[name]]
        slopes = equations.jacobian(self.values)[:, biases]
        own = courses[equations.layout.segment]
        return np.asarray((slopes[:, :, None] * own[:, None]).reshape(len(own), -1))

    def without_turn(self, wild: int) -> _State:
        """Return the state without a turn: it splits a run in two, and north is estimated anew."""
        evidence = self.equations.evidence
        link = evidence.used_moves.linked[wild]
        moves = tuple(move for move in evidence.moves if move is not link.move)
        evidence = replace(evidence, moves=moves)
        equations = replace(self.equations, evidence=evidence, inflation=None, extra=())
        values = equations.nominal()
        known = equations.change_slice.stop
        values[:known] = self.values[:known]
        dropped = tuple(sorted((*self.rejected_moves, link.first)))
        return _State(equations, values, rejected_moves=dropped)


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
    start = _State(*initial_equations(evidence))
    model = start.equations.model(start.values)
    check_axes(model.accel.response, *_ACCELS)
    check_turns(start.equations.evidence, model)
    _check_observable(start)
    state, found = _with_terms(start)
    if any(one.family.term is G_SENSITIVITY for one in found):
        others = [one.family for one in found if one.family.term is not G_SENSITIVITY]
        _check_latitude(start.with_families(others).weighted())
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
    by_source = shares(equations, values, information.gain)
    return FreeFit(
        equations.model(values),
        parameters,
        of_all(information.covariance[sensors, sensors], 0.0),
        (equations.outputs - equations.predict(values))[equations.layout.dwell],
        information.condition,
        state.scatter,
        state.rejected_moves,
        {
            source: Share(of_all(share.covariance, 0.0), of_all(share.freedom, np.inf))
            for source, share in by_source.items()
        },
        tuple(
            replace(one, std=_bias_std(one.name, equations, information))
            for one in (*_even(state, found), *_wanders(state), *_uneven(state))
        ),
        _changes(state, information, len(parameters), own),
        found,
        _tests(state, found, information),
    )


def _with_terms(start: _State) -> tuple[_State, tuple[SignificantFamily, ...]]:
    """Add the most significant term until none is; all must remain significant together.

    With all turns first: a term that is missing makes turns outliers, without which it may hide.
    """
    found: tuple[SignificantFamily, ...] = ()
    rejected = set[Family]()
    state = start.weighted()
    while True:
        on = {one.family for one in found}
        views = [state]
        if state.rejected_moves:
            views.insert(0, start.with_families([*on]).weighted(outliers=False))
        best = None
        for view in views:
            scores = _scores(view, [f for f in _FAMILIES if f not in on | rejected])
            best = best or _most_significant(scores, on)
        if best is None:
            return state, found
        wanted = [one.family for one in (*found, best)]
        try:
            trial = start.with_families(wanted).weighted()
            _check_observable(trial)
        except NotObservable:
            rejected.add(best.family)
            continue
        kept = tuple(
            replace(one, log_p=log_p)
            for one in (*found, best)
            if (log_p := _score(trial.without(one.family), one.family).log_p)
            < _log_limit(one.family, wanted)
        )
        lost = set(wanted) - {one.family for one in kept}
        rejected |= lost
        if best.family not in lost:
            found = kept
            state = start.with_families([one.family for one in kept]).weighted() if lost else trial


def _most_significant(
    scores: Mapping[Family, Score], on: Collection[Family]
) -> SignificantFamily | None:
    """Return the most significant of terms that are off, if any is."""
    beyond = {f: score.log_p - _log_limit(f, on) for f, score in scores.items()}
    family = min(beyond, key=lambda f: beyond[f], default=None)
    if family is None or beyond[family] >= 0:
        return None
    alike = [
        f
        for f in scores
        if f.term in _NONLINEAR and scores[f].log_p < scores[family].log_p + _APART / 2
    ]
    if family.term not in _NONLINEAR:
        return SignificantFamily(family, scores[family].log_p)
    # Of terms that explain the session equally well the first is that of IEEE Std 1293.
    return SignificantFamily(alike[0], scores[alike[0]].log_p, alternatives=tuple(alike[1:]))


def _log_limit(family: Family, on: Collection[Family]) -> float:
    """Return the logarithm of the chance below which a term is significant beside others."""
    if family.term in _NONLINEAR:
        return _LOG_SHOWN - float(np.log(len(_NONLINEAR)))
    # Where one triad drifts the other is likely to.
    drifting = any(f.course is not None for f in on if f != family)
    alone = DRIFT_SHOWN.get(family.name, _SHOWN)
    return _LOG_SHOWN if drifting else float(np.log(alone))


def _pattern(state: _State, family: Family) -> Pattern:
    """Return the effects on the outputs of a term's coefficients of the largest useful size."""
    equations, values = state.equations, state.values
    if family.term is None:
        whole = float(spans(equations.evidence)[1].max())
        columns = equations.columns(family.changes, equations.jacobian(values))
        sizes = np.full(len(family.changes), LARGEST_DRIFT[family.name] / whole)
        return columns * sizes, sizes
    # The largest size in SI units: of f, of f^2 or of f^3.
    degrees = [len(one.factors) + len(one.absolute) for _, one in family.term.products]
    sizes = _LARGEST * STANDARD_GRAVITY ** (1.0 - np.array(degrees))
    if family.term is G_SENSITIVITY:
        sizes = np.full(len(family.parameters), _LARGEST_G)
    return equations.parameter_derivatives(values, family.parameters) * sizes, sizes


def _scores(state: _State, families: Sequence[Family]) -> dict[Family, Score]:
    """Test terms that are off, each under the scatter that remains with it on.

    Under the noise alone the tests have most power: what is not significant there is so with
    scatter.
    """
    patterns = {family: (_pattern(state, family),) for family in families}
    scores = scores_of(patterns, state.scattering(_NO_SCATTER).equations, state.values)
    return {
        family: _score(state, family)
        if score.tested and scipy.special.chdtrc(score.rank, score.statistic) < _SHOWN
        else replace(score, statistic=0.0)
        for family, score in scores.items()
    }


def _score(state: _State, family: Family) -> Score:
    """Test a term that is off, under the scatter that remains with it on."""
    pattern = _pattern(state, family)
    there = state.scattering(state.likely_scatter(pattern[0]))
    residuals = WhitenedResiduals.at(there.equations, state.values)
    score = residuals.score(family, [pattern])
    if family.term is not None:
        return score
    # Gyros at rest know nothing of how much accelerometers scatter, nor these of gyros.
    at_rest = 0 if family.name == 'trend:D_a' else 1
    rows = np.concatenate([state.groups[at_rest], state.groups[2]])
    taken = (residuals.basis[rows] ** 2).sum() + score.rank
    return replace(score, freedom=max(0.0, float(len(rows) - taken)))


def _even(state: _State, found: Sequence[SignificantFamily]) -> tuple[Drift, ...]:
    """Return the even drifts that are on: by how much biases change during the session at most."""
    whole = float(spans(state.equations.evidence)[1].max())
    return tuple(
        Drift(
            one.family.name,
            one.log_p,
            float(np.abs(state.values[state.places(one.family)]).max()) * whole,
        )
        for one in found
        if one.family.term is None
    )


def _bias_std(name: str, equations: FreeEquations, information: Information) -> float:
    """Return the largest standard deviation of the biases of a drift's triad."""
    return max(
        float(information.std[equations.parameters.index(c.parameters[0])]) for c in TRENDS[name]
    )


def _wanders(state: _State) -> tuple[Drift, ...]:
    """Return the wanders that are likely; the covariance allows for those less likely, too."""
    likely, sizes = state.scatter.probability[3:], np.sqrt(state.scatter.wanders)
    found = tuple(
        Drift(name, 0.0, float(size), DriftKind.WANDER)
        for name, size, probability in zip(TRENDS, sizes, likely, strict=True)
        if probability > _SAID
    )
    return _as_step(state, found) or found


def _as_step(state: _State, wanders: Sequence[Drift]) -> tuple[Drift, ...]:
    """Return wanders as one step of the biases, if hardly any wander remains beside it."""
    if not wanders:
        return ()
    calm = state.scattering(replace(state.scatter, wanders=np.zeros(2)))
    starts, ends = spans(state.equations.evidence)
    holds = len(state.equations.evidence.segments)
    middles, family = (starts + ends) / 2, Family(wanders[0].name, course=Course.TREND)

    def columns(instant: float) -> Floats:
        after = np.clip((ends - instant) / (ends - starts), 0.0, 1.0)[:, None]
        return np.hstack([state.drifting(one.name, after) for one in wanders])

    tried = {}
    for instant in np.sort(np.concatenate([starts[1:holds], middles[1 : holds - 1]])).tolist():
        pattern = {family: ((columns(instant), np.ones(3 * len(wanders))),)}
        tried[instant] = scores_of(pattern, calm.equations, state.values)[family]
    best = max(tried, key=lambda instant: tried[instant].statistic)
    remains = np.sqrt(state.likely_scatter(columns(best)).wanders)
    before = np.sqrt(state.scatter.wanders)
    if (remains > before / _MOST_REMAINING).any():
        return ()
    sizes = np.abs(tried[best].estimate.reshape(len(wanders), 3)).max(axis=1).tolist()
    return tuple(
        replace(one, largest=size, kind=DriftKind.STEP, instant=best)
        for one, size in zip(wanders, sizes, strict=True)
    )


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
    for name in (n for n, v in zip(TRENDS, state.scatter.wanders, strict=True) if not v):
        size = LARGEST_DRIFT[name] * np.sqrt(1 + state.scatter.groups.max())
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


def _tests(
    state: _State, found: Sequence[SignificantFamily], information: Information
) -> tuple[TermTest, ...]:
    """Return the terms that are on, and what the session shows of the others."""
    equations, values = state.equations, state.values
    sensors, outputs = slice(0, equations.sensors), slice(0, len(equations.outputs))
    std = information.std[sensors]
    root = np.linalg.cholesky(equations.covariance(values))
    on = {one.family for one in found}
    tests = [TermTest.found(replace(one, log_p=max(one.log_p, _LEAST_LOG))) for one in found]
    off = [f for f in _FAMILIES if f not in on and f.term is not G_SENSITIVITY]
    patterns = {family: (_pattern(state, family),) for family in off}
    for family, score in scores_of(patterns, equations, values).items():
        ((columns, sizes),) = patterns[family]
        slopes = information.gain[sensors, outputs] @ np.linalg.solve(root, columns / sizes)
        limit = float(np.exp(_log_limit(family, ())))
        tests.append(test_of(family, score, slopes, limit, equations.parameters, std, _AMOUNT))
    return tuple(tests)


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
            and _score(elsewhere, _FAMILIES[0]).log_p >= _LOG_SHOWN
        ):
            raise wrong_latitude(evidence, latitude)


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


def _check_observable(state: _State) -> None:
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


def check_terms(terms: Sequence[Term], changes: Sequence[Change]) -> None:
    """Raise if a requested term is none of those that every session in the hand tests."""
    own = {family.term for family in _FAMILIES}
    others = [term.name for term in terms if term not in own]
    if not set(changes) <= {change for family in _FAMILIES for change in family.changes}:
        others += terms_in_words(changes)
    if others:
        names = [family.name for family in _FAMILIES]
        raise InputError(
            f'A session in the hand cannot estimate {" and ".join(others)}. It tests '
            f'{", ".join(names[:-1])} and {names[-1]}, and estimates those that it shows: leave '
            '`terms` out.'
        )


def refuse(_: Evidence) -> Solution:
    """Raise, naming what this method needs beyond static dwells and whole turns."""
    raise NotObservable(_NEEDS)


def scatter_words(fit: FreeFit) -> list[str]:
    """Report groups that scatter significantly more than their noise."""
    factors = np.sqrt(1 + fit.scatter.groups)
    return [
        _scatter_finding(f'The residuals of {name} are {factor:.1f} times their noise', factor)
        for name, factor, likely in zip(_GROUPS, factors, fit.scatter.probability, strict=False)
        if likely > _SAID
    ]


def _scatter_finding(said: str, factor: float) -> Finding:
    if factor < _RUINED:
        return Finding(
            f'{said}: the standard deviations are widened. Possible causes: a hand that trembled, '
            'and bias drift.',
            effect=factor - 1,
        )
    return warning(
        f'{said}, more than a hand explains: errors may exceed the widened standard deviations. '
        'Possible causes: readings clipped at the end of a range, and false holds.',
        effect=factor - 1,
    )


def term_words(fit: FreeFit) -> list[str]:
    """Report the terms that the session showed, and their significance."""
    terms = [one for one in fit.found if one.family.term is not None]
    return [*(_one_term(one, fit) for one in terms), *drift_words(fit.drifts)]


def _one_term(found: SignificantFamily, fit: FreeFit) -> str:
    term = found.family.term
    assert term is not None
    log_p = max(found.log_p, _LEAST_LOG)
    effect = float(np.sqrt(-2 * log_p))
    if term is G_SENSITIVITY:
        at_1_g = fit.model.g_sensitivity * STANDARD_GRAVITY
        largest = np.abs(at_1_g).max() / DEG
        # A vertical Earth rate that is wrong by at most twice its length turns with gravity: it is
        # along the force, and alike for all gyros.
        along = np.trace(at_1_g) / 3
        alike = np.linalg.norm(at_1_g - along * np.eye(3)) < abs(along) < 2 * EARTH_RATE
        latitude = ' A wrong latitude looks the same.' if alike else ''
        return Finding(
            f'The gyros respond to specific force, by up to {largest:.2g} deg/s per g '
            f'(probability of chance {np.exp(log_p):.0e}): {term.name} is estimated, too.'
            f'{latitude}',
            effect=effect,
        )
    places = indices_of(term.parameters, fit.parameters)
    unit = term.parameters[0].unit.engineering(by_hand=True)
    largest = np.abs(fit.model.values(fit.parameters)[places]).max() / unit.scale
    text = (
        f'The session shows {term.kind.value.words} ({term.name}, by up to '
        f'{significant(largest)} {unit.unit}, {chance_in_words(found.log_p)}): it is estimated'
    )
    if found.alternatives:
        names = ' or '.join(other.name for other in found.alternatives)
        text += f'; {names} would explain it as well. To tell them apart takes {term.needs}'
    return Finding(f'{text}.', effect=effect)


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
    least = max(1 / float(np.sqrt(1 + state.scatter.groups[2])), usual)
    return worst if sizes[worst] > _OUTLYING * least else None


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
