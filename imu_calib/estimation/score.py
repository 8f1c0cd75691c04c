"""Score tests of terms that are off: terms of the sensors and errors of the table.

The columns by which the coefficients of a family enter the outputs are made orthogonal to all
estimated unknowns, priors as rows, and the residuals are projected on the remaining columns. With a
known covariance the square of that is a chi-square (Rao's score test). The covariance is estimated:
the residuals with the family on show by what factor it is too small and how well it is known, and
the test becomes an F test with their degrees of freedom.

Sources: Rao 1948, Proc. Camb. Phil. Soc. 44, 50; docs/mathematics.md, 'Terms that are missing'.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from ..common.stream import Floats
from ..common.units import ARCMIN, ARCSEC, DEG, MICRO_G
from ..model.parameters import AXES, PARAMETERS, Parameter, ParameterKind, indices_of
from ..model.sensors import motion_parameters, parameters_of, terms_of
from ..model.session_terms import LOOKED_FOR, Change, Course, session_term
from ..model.terms import TERMS, Term
from ..session.table_errors import TableErrors
from .changing import USEFUL_CHANGE
from .components import whiten
from .equations import Equations
from .excess_scatter import ExcessScatter, excess
from .information import Information, useful_limit, with_nominal_attitudes
from .modulation import courses, interrupted, of_constants, shapes, warms
from .positioning_errors import AttitudeStep, possible_steps, step_errors

SEEN = 10.0
"""Standard deviations by which a coefficient of the largest useful size must move the outputs: a
direction of a family with a smaller effect is not tested."""

_LARGEST_TABLE_ERROR = 1 * ARCMIN
"""Largest useful size of an error of a table, rad: ten times that of a decent one."""

_LARGEST_OVER_STATED = 20.0
"""The same for a table whose file states a large one, over the stated standard deviation: with
`SEEN` a direction is tested if one such deviation moves the outputs by half of theirs."""

_FREE_TABLE_ERROR = 300 * ARCSEC
"""Standard deviation of a practically free error of a table: a thousand times what the best
accelerometers and dwells resolve, and small enough for the covariance to be inverted."""

FREE_STEP = 1 * DEG
"""The same of attitudes that step: far more than a unit in its mount moves unseen."""

_LARGEST_STEP = 5 * ARCMIN
"""Largest useful size of such a step, or turn by 1 g: 0.15 mm across a mount of 100 mm. With an arc
minute steps of 100 arcsec of consumer units were not tested where accelerometers see them badly,
but elsewhere: misalignments were off by up to 27 deviations."""

_SHARE = 0.5
"""Largest share of the degrees of freedom of its outputs that a family may take. A judgement: at
least as many remain to show their scatter."""

_NINE_IN_TEN = 1.2816  #: Standard normal quantile of 90 %.

_TINY = -500.0
"""Logarithm below which a probability is computed as a logarithm: 64-bit numbers end at -708."""


@dataclass(frozen=True)
class Family:
    """Coefficients that are switched on together: a term, or errors of the table."""

    name: str  #: Of the term, or of the field of `TableErrors`.
    term: Term | None = None  #: The term of the sensors, or None.
    course: Course | None = None  #: The course of a term of the session, or None.

    @property
    def of_table(self) -> bool:
        """Whether it is an error of the table."""
        return self.term is None and self.course is None

    @property
    def changes(self) -> tuple[Change, ...]:
        """Coefficients of a term of the session; none for others."""
        return () if self.course is None else session_term(self.name)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters of a term of the sensors; none for others."""
        return () if self.term is None else self.term.parameters

    @property
    def of_attitudes(self) -> bool:
        """Whether it is a step of the attitudes against the joints' readings."""
        return self.name == ATTITUDE_STEP

    def freed(self, equations: Equations, size: float, *, alone: bool = False) -> Equations:
        """Return equations whose table has this error with a standard deviation, rad.

        `alone`: all other errors of the table are removed.
        """
        table = equations.evidence.table
        others = TableErrors() if alone or table is None else table.errors
        errors = replace(others, **{self.name: size})
        return replace(equations, evidence=equations.evidence.with_table_errors(errors))

    def scatter(self, equations: Equations, state: Floats, shape: float) -> ExcessScatter:
        """Return the scatter beyond noise that remains with the family on, by a solution without.

        `shape` is one of `shapes_of`.

        Scatter that is estimated without a missing term absorbs the term, and hides it.
        """
        if self.course is not None:
            there = replace(equations, changes=self.changes, shape=shape)
            start = np.concatenate([state, np.zeros(len(self.changes))])
            return excess(there, stepped(there, start))
        if self.of_attitudes:
            step = replace(steps_of(equations)[round(shape)], size=FREE_STEP)
            evidence = replace(equations.evidence, attitude_steps=(step,))
            return excess(replace(equations, evidence=evidence), state)
        if self.term is None:
            return excess(self.freed(equations, _FREE_TABLE_ERROR), state)
        return excess(*with_parameters(equations, state, self.parameters))

    @property
    def held(self) -> frozenset[ParameterKind]:
        """Kinds held at zero in its test; otherwise the covariance allows for them."""
        return frozenset(p.kind for p in motion_parameters(self.parameters))

    def with_scatter(self, equations: Equations, scatter: ExcessScatter) -> Equations:
        """Return the equations with the scatter under which the family is tested.

        For a term of the session, its course replaces random drift, which then seems less than the
        data sheet states, and is counted in full.
        """
        extra = scatter.extra if self.course is None else (*scatter.extra, *scatter.absent_drift)
        return replace(equations, extra=extra, positioning=scatter.positioning, held=self.held)

    def judged(self, equations: Equations) -> NDArray[np.bool_]:
        """Return which outputs (m,) determine how well the covariance is known."""
        of_accels = equations.layout.channels >= len(AXES)
        if self.term is None:
            # Errors of the table and terms of the session enter both triads.
            return np.ones_like(of_accels)
        return of_accels if self.term.triad == 'a' else ~of_accels


Pattern = tuple[Floats, Floats]
"""Effects of coefficients of the largest useful size on outputs, (m, k), and the sizes, (k,)."""


def columns_of(
    found: Sequence[Family], equations: Equations, state: Floats
) -> dict[Family, tuple[Pattern, ...]]:
    """Return the patterns of families: one, or one for each shape of a course.

    Nominal attitudes are used: information in the last digits of an encoder is ignored.
    """
    ideal = replace(equations, evidence=with_nominal_attitudes(equations.evidence))
    known: dict[Family, tuple[Pattern, ...]] = {}
    parameters = tuple(p for family in found for p in family.parameters)
    slopes = ideal.parameter_derivatives(state, (*parameters, *PARAMETERS))
    for family in found:
        if family.course is not None:
            known[family] = _changing(ideal, family, slopes[:, len(parameters) :])
        elif family.of_attitudes:
            known[family] = _stepping(ideal, state, steps_of(ideal))
        elif family == ISOLATORS:
            known[family] = _stepping(ideal, state, (AttitudeStep(0, None),))
        elif family.term is None:
            table = equations.evidence.table
            stated = 0.0 if table is None else getattr(table.errors, family.name)
            # A zero error cannot be separated from the next axis leaning about the joint's.
            size = (
                _LARGEST_TABLE_ERROR
                if family.name == 'zeros'
                else max(_LARGEST_TABLE_ERROR, _LARGEST_OVER_STATED * stated)
            )
            columns = family.freed(ideal, size, alone=True).table_error_effects(state)
            known[family] = ((columns, np.full(columns.shape[1], size)),)
        else:
            sizes = np.array([useful_limit(p) for p in family.parameters])
            places = indices_of(family.parameters, parameters)
            known[family] = ((slopes[:, places] * sizes, sizes),)
    return known


def shapes_of(family: Family, equations: Equations) -> Floats:
    """Return the shapes that a term of the session may have; the number of a step; 1 for others."""
    if family.of_attitudes:
        return np.arange(len(steps_of(equations)), dtype=float)
    return np.ones(1) if family.course is None else shapes(equations.evidence, family.course)


def steps_of(equations: Equations) -> tuple[AttitudeStep, ...]:
    """Return the steps of the attitudes that are tested."""
    evidence = equations.evidence
    joints = 0 if evidence.table is None else len(evidence.table.joints)
    return possible_steps(len(evidence.parts), joints)


def _stepping(
    ideal: Equations, state: Floats, steps: tuple[AttitudeStep, ...]
) -> tuple[Pattern, ...]:
    """Return the pattern of each of some steps of the attitudes."""
    evidence = ideal.evidence
    assert evidence.table is not None
    errors = step_errors(steps, evidence.segments, evidence.turns, evidence.table)
    columns = ideal.attitude_error_effects(state, *errors) * _LARGEST_STEP
    ends = np.cumsum([step.columns for step in steps])[:-1]
    parts = np.split(columns, ends, axis=1)
    return tuple((part, np.full(part.shape[1], _LARGEST_STEP)) for part in parts)


def _changing(ideal: Equations, family: Family, derivatives: Floats) -> tuple[Pattern, ...]:
    """Return the patterns of a term of the session, by (m, n) derivatives by the 24 parameters.

    Scale factors that cannot be separated from it would depend on the last digits of the others:
    directions that no output shows are left out with them.
    """
    assert family.course is not None
    evidence = ideal.evidence
    largest = np.array([_largest(change) for change in family.changes])
    constant = of_constants(family.changes, derivatives, PARAMETERS) * largest
    result = []
    for shape in shapes(evidence, family.course).tolist():
        course = courses(evidence, family.course, shape)
        whole = np.ptp(course)
        result.append((constant * (course / whole)[ideal.layout.segment, None], largest / whole))
    return tuple(result)


def _largest(change: Change) -> float:
    """Return the largest useful change by a coefficient during a session, SI units."""
    if change.of_scale_factor:
        return USEFUL_CHANGE
    return _LARGEST_DRIFT[change.parameters[0].triad]


_LARGEST_DRIFT = {'g': 0.1 * DEG, 'a': 1e5 * MICRO_G}
"""Of a bias during a session, rad/s and m/s^2: after switch-on a chip may change as much."""


def stepped(equations: Equations, state: Floats) -> Floats:
    """Return a state after one step of the least squares: enough for linear unknowns."""
    jacobian, residuals = equations.whitened(state)
    return np.asarray(state + Information.from_jacobian(jacobian).gain @ residuals)


def families(equations: Equations) -> tuple[Family, ...]:
    """Return all terms that are off and that the session can determine."""
    on = terms_of(equations.parameters)
    found = [Family(term.name, term) for term in TERMS if term not in on]
    if not equations.layout.moves_with_accels:
        found = [family for family in found if not family.held]
    evidence = equations.evidence
    if not equations.changes:
        recorded = (Course.THERMAL,) if warms(evidence) else ()
        courses = [*recorded, *LOOKED_FOR]
        if evidence.plan.by_hand or not len(shapes(evidence, Course.STEP)):
            # In the hand a hold that leans looks like one.
            courses.remove(Course.STEP)
        found += [Family(course.value, course=course) for course in courses]
    if evidence.table is not None and all(part.angles is not None for part in evidence.parts):
        found += [Family(name) for name in TABLE_ERRORS]
        if steps_of(equations) and not (evidence.attitude_steps or evidence.plan.by_hand):
            found.append(Family(ATTITUDE_STEP))
    return tuple(found)


TABLE_ERRORS = ('zeros', 'orthogonality', 'wobble', 'encoder')
"""Fields of `TableErrors`: errors that a table's file may state."""

ATTITUDE_STEP = 'attitude_step'  #: Name of that family.

ISOLATORS = Family('a unit that turns in its mount with the force on it')
"""The step of the attitudes that follows the force, alone: the name says what it is."""


def scores_of(
    patterns: Mapping[Family, Sequence[Pattern]], equations: Equations, state: Floats
) -> dict[Family, Score]:
    """Test families about a solution, each with its coefficients held at zero."""
    held = dict.fromkeys(family.held for family in patterns)
    residuals = {one: WhitenedResiduals.at(replace(equations, held=one), state) for one in held}
    return {f: residuals[f.held].score(f, columns) for f, columns in patterns.items()}


def with_parameters(
    equations: Equations, state: Floats, parameters: Sequence[Parameter]
) -> tuple[Equations, Floats]:
    """Return the equations with the terms of parameters on, and the state with zeros for them."""
    terms = (*terms_of(equations.parameters), *terms_of(parameters))
    on = replace(equations, parameters=parameters_of(terms))
    sensors = values_of(on.parameters, equations, state)
    return on, np.concatenate([sensors, state[equations.sensors :]])


def values_of(parameters: Sequence[Parameter], equations: Equations, state: Floats) -> Floats:
    """Return the values (p,) of parameters at a state (n,) of equations; 0 for those not in it."""
    values = dict(zip(equations.parameters, state.tolist(), strict=False))
    return np.array([values.get(parameter, 0.0) for parameter in parameters])


@dataclass(frozen=True, eq=False)
class Score:
    """Result of the test of a family."""

    statistic: float  #: Chi-square, in the assumed covariance.
    rank: int  #: Its dimensions: coefficients that the session separates from all others.
    scale: float  #: Factor on that covariance by the residuals with the family on; 1 at least.
    freedom: float  #: Degrees of freedom of that.
    #: (k,) coefficients by one step from zero, SI units; 0 along unobserved directions.
    estimate: Floats
    deviation: Floats  #: (k,) their standard deviations; infinite where unobserved.
    #: (k, k) of the coefficients along observed directions, in the assumed covariance.
    covariance: Floats
    #: Number of patterns of which it is the most significant, any of which may be so by chance.
    tries: int = 1
    chosen: int = 0  #: Index of the chosen one.

    @property
    def tested(self) -> bool:
        """Whether the session can test the family: it is observed, and enough outputs remain."""
        return 0 < self.rank <= _SHARE * (self.freedom + self.rank)

    @property
    def square(self) -> tuple[float, int]:
        """Chi-square, in the covariance as the residuals show it, and its dimensions."""
        return self.statistic / self.scale, self.rank

    @property
    def log_p(self) -> float:
        """Natural logarithm of the probability of such a statistic by chance; 0 if not tested."""
        if not self.tested:
            return 0.0
        one = log_f(self.statistic / self.rank / self.scale, self.rank, self.freedom)
        # Bonferroni: an upper bound, for any correlation of the patterns.
        return min(0.0, one + float(np.log(self.tries)))

    @property
    def largest_turn(self) -> float:
        """Size of a step of the attitudes; by force, a matrix, the largest by any direction."""
        by_force = len(self.estimate) > len(AXES)
        turned = self.estimate.reshape(3, 3) if by_force else self.estimate
        return float(np.linalg.norm(turned, 2))

    def log_evidence(self, size: float) -> float:
        """Return the log of the likelihood ratio with and without coefficients of such a size each.

        They are normal about zero with this standard deviation, SI units.
        """
        variances, directions = np.linalg.eigh(self.scale * self.covariance)
        sound = variances > _ROUNDED * variances.max(initial=0.0)
        variances, along = variances[sound], directions.T[sound] @ self.estimate
        gained = size**2 / variances
        logs = along**2 / variances * gained / (1 + gained) - np.log1p(gained)
        return 0.5 * float(logs.sum())

    def smallest(self, chance: float) -> Floats:
        """Return the coefficients (k,) that are detected nine times in ten, each alone, SI units.

        Along its own direction the statistic is the square of a normal deviate about the
        coefficient in deviations; it is detected where that is beyond the limit.
        """
        if not self.tested:
            return np.full(len(self.deviation), np.inf)
        limit = self.rank * float(
            scipy.special.fdtri(self.rank, self.freedom, 1 - chance / self.tries)
        )
        return np.asarray(self.deviation * np.sqrt(self.scale) * (np.sqrt(limit) + _NINE_IN_TEN))


@dataclass(frozen=True, eq=False)
class WhitenedResiduals:
    """Whitened residuals of a session about a solution, orthogonal to the state."""

    equations: Equations  #: With the assumed covariance.
    basis: Floats  #: (m + 4, n) orthonormal, of the space explained by the state.
    whitened: Floats  #: (m + 4,) residuals less the part explained by the state.
    factor: Floats  #: (m, m) lower triangle of the covariance of the outputs.

    @classmethod
    def at(cls, equations: Equations, state: Floats) -> WhitenedResiduals:
        """Whiten the equations of a session at a solution."""
        jacobian, residuals = equations.whitened(state)
        norms = np.linalg.norm(jacobian, axis=0)
        basis = np.linalg.qr(jacobian[:, norms > 0] / norms[norms > 0])[0]
        factor = equations.factor(state)
        return cls(
            equations, np.asarray(basis), _orthogonal_to(residuals, basis), np.asarray(factor)
        )

    def score(self, family: Family, patterns: Sequence[Pattern]) -> Score:
        """Test a family by its `columns_of`: the most significant, as one of so many."""
        return most_significant(self.scores(family, patterns), tries_of(family, self.equations))

    def scores(self, family: Family, patterns: Sequence[Pattern]) -> list[Score]:
        """Test a family by each of its `columns_of`."""
        every = np.hstack([columns for columns, _ in patterns])
        white = np.zeros((len(self.whitened), every.shape[1]))
        white[: len(every)] = whiten(self.factor, every)
        white = _orthogonal_to(white, self.basis)
        judged = np.append(
            family.judged(self.equations), np.zeros(len(white) - len(every), dtype=bool)
        )
        freedom = float(judged.sum() - (self.basis[judged] ** 2).sum())
        widths = np.array([len(sizes) for _, sizes in patterns])
        parts = np.split(white, np.cumsum(widths)[:-1], axis=1)
        found: dict[int, Score] = {}
        for width in np.unique(widths):
            mine = np.flatnonzero(widths == width).tolist()
            stacked = np.array([parts[k] for k in mine])
            sizes = np.array([patterns[k][1] for k in mine])
            found |= zip(mine, self._scores(stacked, sizes, judged, freedom), strict=True)
        return [found[k] for k in range(len(patterns))]

    def _scores(
        self, white: Floats, sizes: Floats, judged: NDArray[np.bool_], freedom: float
    ) -> list[Score]:
        """Test a family by p patterns: whitened (p, m + 4, k) columns for coefficients of (p, k).

        The outputs that are `judged` have the given degrees of freedom without the family.
        """
        directions, values, axes = np.linalg.svd(white, full_matrices=False)
        sound = values > SEEN
        directions, axes = directions * sound[:, None], axes * sound[..., None]
        inverse = np.where(sound, 1 / np.maximum(values, SEEN), 0.0)
        along = self.whitened @ directions
        rest = (self.whitened - (directions @ along[..., None])[..., 0])[:, judged]
        left = freedom - (directions[:, judged] ** 2).sum(axis=(1, 2))
        scale = np.where(left >= 1, (rest**2).sum(axis=1) / np.maximum(left, 1.0), 1.0)
        root = sizes[..., None] * np.swapaxes(axes, 1, 2) * inverse[:, None]
        seen = (axes**2).sum(axis=1) > 1 - _WHOLE
        return [
            Score(*each)
            for each in zip(
                (along**2).sum(axis=1).tolist(),
                sound.sum(axis=1).tolist(),
                np.maximum(1.0, scale).tolist(),
                np.maximum(0.0, left).tolist(),
                (root @ along[..., None])[..., 0],
                np.where(seen, np.sqrt((root**2).sum(axis=2)), np.inf),
                root @ np.swapaxes(root, 1, 2),
                strict=True,
            )
        ]


def most_significant(scores: Sequence[Score], tries: Sequence[int] = ()) -> Score:
    """Return the most significant of the tests of a family, as one of so many.

    `tries` is that of each (`tries_of`); the number of all by default.
    """
    each = [
        replace(score, tries=n) for score, n in zip(scores, tries or [1] * len(scores), strict=True)
    ]
    best = min(range(len(each)), key=lambda k: each[k].log_p)
    return replace(each[best], tries=tries[best] if tries else len(scores), chosen=best)


def tries_of(family: Family, equations: Equations) -> list[int]:
    """Return among how many patterns each of a family is one; empty for the number of all.

    Of a step, where the stream was interrupted, half of the chance of a false detection is that of
    the instants within interruptions, and half that of all others (weighted Bonferroni: Genovese et
    al. 2006, Biometrika 93, 509).
    """
    if family.course is not Course.STEP:
        return []
    within = interrupted(equations.evidence)
    if not within.any() or within.all():
        return []
    inside, outside = int(within.sum()), int((~within).sum())
    return [2 * inside if yes else 2 * outside for yes in within]


_ROUNDED = 1e-12
"""Share of the largest variance below which one is zero, along a direction that is not observed."""

_WHOLE = 1e-3
"""Share of a coefficient that may lie along unobserved directions. A judgement: the coefficient is
then found to half a part in a thousand."""


def _orthogonal_to(columns: Floats, basis: Floats) -> Floats:
    """Make columns (m, k) or a vector (m,) orthogonal to a basis; twice, against rounding."""
    for _ in range(2):
        columns = columns - basis @ (basis.T @ columns)
    return columns


def log_f(value: float, first: float, second: float) -> float:
    """Return the log of the chance that F exceeds a value; exact far into its tail.

    The first degrees of freedom are the numerator's, the second the denominator's.

    Source: DLMF 8.17.1 and 8.17.8, the incomplete beta function by the hypergeometric series.
    """
    special = scipy.special
    direct = float(special.fdtrc(first, second, value))
    if direct > np.exp(_TINY):
        return float(np.log(direct))
    a, b = second / 2, first / 2
    x = second / (second + first * value)
    series = np.log(special.hyp2f1(a + b, 1, a + 1, x))
    return float(a * np.log(x) + b * np.log1p(-x) - np.log(a) - special.betaln(a, b) + series)


# A drift of the scale factors with the session's time, or a step of the biases, that is too small
# to be detected still moves parameters by several standard deviations. So every course has prior
# odds, the session's evidence raises or lowers them, and the effect of the course on the parameters
# enters their covariance with the resulting probability (Bayesian model averaging). Of five
# simulated navigation-grade units in a temperature ramp that was not recorded errors are 0.9 of the
# standard deviations (root mean square), up to 3.3; without the probabilities 1.7, up to 6.8.
# Sources: Liang et al. 2008, J. Am. Statist. Assoc. 103, 410 (the prior of the coefficients);
# Hoeting et al. 1999, Statist. Sci. 14, 382; docs/mathematics.md, 'Terms that are missing'.

_ODDS = 1 / 20
"""Prior odds of each of two drifts against none: ten to one for none, a judgement: one session in
eleven drifts."""

_ODDS_OF_A_STEP = 1 / 1000
"""The same of a step, a judgement: hardly ever is a unit switched off and on, or struck, without
notice, or moves in its mount. Where scale factors are known by pairs of dwells alone a step that is
not seen could move them by tens of standard deviations: with odds of 1/20 it widens those of a
sound session 2.4 times, with these by 5 %."""

_ODDS_IF_INTERRUPTED = 1 / 2
"""The same of a step in one of a session's interruptions, a judgement: of three interruptions of a
second or more two are of the line or of the program that reads it, and one is of the unit's
power."""

_LEAST = 1e-9
"""Chi-square below which the integrals are evaluated at this value: they are smooth there."""


@dataclass(frozen=True, eq=False)
class UndecidedDrifts:
    """Possible effects of drifts that are not shown."""

    probability: Mapping[Family, float]  #: Of each course, all of its time constants together.
    covariance: Floats  #: (n, n) covariance of their effect on the parameters.


Possible = tuple[Score, Floats]
"""The test of a course with one time constant, and how parameters (n,) follow its coefficients
(k,), (n, k) in SI units."""


def undecided(
    courses: Mapping[Family, Sequence[Possible]],
    count: int,
    interrupted: NDArray[np.bool_] | None = None,
    steps: Floats | None = None,
) -> UndecidedDrifts:
    """Weight courses against each other and against none, for `count` parameters.

    The time constants of a course are equally likely beforehand; a step is likelier in an
    interruption. `steps` are the prior shares of steps of the attitudes, if they are not alike.
    """
    logs: dict[Family, float] = {}
    covariances: dict[Family, Floats] = {}
    for family, every in courses.items():
        tested = [(score, slopes) for score, slopes in every if score.tested]
        if not tested:
            continue
        alike = np.full(len(every), 1 / len(every))
        prior = steps if family.of_attitudes and steps is not None else alike
        each = np.array([log_bayes_factor(*score.square) for score, _ in tested])
        each += np.log(prior[[score.tested for score, _ in every]])
        odds = _ODDS_OF_A_STEP if family.of_attitudes else _ODDS
        if family.course is Course.STEP:
            odds = _ODDS_OF_A_STEP
            each += np.log(_times(interrupted, [score.tested for score, _ in every]))
        total = float(np.logaddexp.reduce(each))
        logs[family] = math.log(odds) + total
        covariances[family] = sum(
            (
                np.exp(one - total) * _drift_covariance(*it)
                for one, it in zip(each, tested, strict=True)
            ),
            np.zeros((count, count)),
        )
    whole = float(np.logaddexp.reduce([0.0, *logs.values()]))
    probability = {family: float(np.exp(log - whole)) for family, log in logs.items()}
    covariance = np.zeros((count, count))
    for family, share in probability.items():
        covariance += share * covariances[family]
    return UndecidedDrifts(probability, covariance)


def _times(interrupted: NDArray[np.bool_] | None, tested: Sequence[bool]) -> Floats:
    """Return how many times likelier than without interruptions a step is at each instant."""
    times = np.ones(len(tested))
    if interrupted is not None and interrupted.any():
        within = _ODDS_IF_INTERRUPTED / interrupted.sum()
        times[interrupted] = within / (_ODDS_OF_A_STEP / len(tested))
    return np.asarray(times[np.array(tested, dtype=bool)])


def log_bayes_factor(square: float, rank: int) -> float:
    """Return the logarithm of the likelihood ratio with and without coefficients.

    By the chi-square of their score test and its rank.

    They are normal with g times the covariance of their estimate, and g has the density (1 +
    g)^-1.5 / 2.
    """
    z, b = max(square, _LEAST) / 2, (rank + 1) / 2
    below = float(scipy.special.gammainc(b, z))
    gamma = float(scipy.special.gammaln(b))
    return z + gamma - b * math.log(z) + math.log(below) - math.log(2)


def shrinkage(square: float, rank: int) -> tuple[float, float]:
    """Return the posterior means of g / (1 + g) and of its square."""
    z, b = max(square, _LEAST) / 2, (rank + 1) / 2
    first, second, third = (float(scipy.special.gammainc(b + k, z)) for k in range(3))
    lost = b / z * second / first
    return 1 - lost, 1 - 2 * lost + b * (b + 1) / z**2 * third / first


def _drift_covariance(score: Score, slopes: Floats) -> Floats:
    """Return the mean squared effect of a course on the parameters, (n, n)."""
    mean, mean_square = shrinkage(*score.square)
    moved = slopes @ score.estimate
    spread = slopes @ (score.scale * score.covariance) @ slopes.T
    return np.asarray(mean * spread + mean_square * np.outer(moved, moved))
