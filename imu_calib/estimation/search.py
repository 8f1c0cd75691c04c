"""Stepwise selection of sensor terms and of errors of the table.

Scatter and terms compete. A missing term causes apparent positioning errors, drift and outliers,
and scatter that is estimated without the term hides it. So every family is tested under the scatter
that remains with it on, with all moves and no output set aside, and the best significant one is
switched on, until none is. All is then fitted anew, and every one must still be significant. A
family replaces outputs that were set aside only where it explains the session better than they do.

Source: docs/mathematics.md, 'Terms that are missing'; Holm 1979, Scand. J. Statist. 6, 65.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from ..common.budget import ErrorSource, Share
from ..common.errors import NotObservable
from ..common.stream import Floats
from ..model.parameters import PARAMETERS, Parameter, indices_of
from ..model.sensors import parameters_of, terms_of
from ..model.session_terms import Change, Course
from .changing import with_changes, with_shape
from .components import unwhiten
from .equations import Equations
from .estimate import Estimate, estimate
from .evidence import SMALLEST_VARIANCE, Evidence
from .information import Information, determined, nominal_information, useful_limit
from .modulation import interrupted
from .positioning_errors import AttitudeStep
from .score import (
    ATTITUDE_STEP,
    FREE_STEP,
    ISOLATORS,
    Family,
    Pattern,
    Score,
    UndecidedDrifts,
    WhitenedResiduals,
    columns_of,
    families,
    log_bayes_factor,
    most_significant,
    scores_of,
    shapes_of,
    steps_of,
    tries_of,
    undecided,
    values_of,
)
from .solve import NotConverged, fit, linear_step

CHANCE = 1e-3
"""Chance of finding a family in a session without any, all families together. A choice: one session
in a thousand gets one that it has not."""

_APART = 9.0
"""Difference of chi-square below which two families explain a session equally well: a factor of 90
in the likelihood, as `excess_scatter.excess` requires."""

_STEP = Family(Course.STEP.value, course=Course.STEP)

_AT_ONCE = 3
"""Families that are tried before one of them is accepted; the others wait until it is on."""

_HINTED = 0.5
"""Of the logarithm of the chance below which a family is significant: from there on a step is tried
from the beginning. A judgement: the square root of the chance, one in a hundred of families that
are absent."""


WIDER = 0.1
"""Share by which a standard deviation must grow to be named. A judgement: with fifty degrees of
freedom it is known to a tenth."""

_BY_FORCE = 50.0
"""Times by which isolators are likelier than a step: their odds are 1/20, those of a drift. A
judgement: units are put on isolators on purpose."""

_WITHOUT_USE = 10.0
"""Times by which a term may widen one of the 24 parameters. Grades of units are about a factor of
ten apart: beyond it the calibration is that of a lower grade. A warm-up costs K_g 8 times, terms of
two powers of the rate 4.6 times, where a session determines them."""


@dataclass(frozen=True)
class SignificantFamily:
    """A family that is significant in the session."""

    family: Family  #: The family.
    log_p: float  #: Natural logarithm of the probability by chance.
    #: Coefficients of a term that the session does not determine, each with its prior standard
    #: deviation about zero; empty where it is estimated.
    considered: tuple[tuple[Parameter, float], ...] = ()
    size: float = 0.0  #: Standard deviation assigned to an error of the table, rad; 0 for a term.
    seen: float = 0.0  #: Root mean square of the observed part of such an error, rad; 0 for a term.
    #: Its number of coefficients, where it is significant only with no output set aside, and has to
    #: explain the session better; else 0.
    against_outliers: int = 0
    alternatives: tuple[Family, ...] = ()  #: Families that explain the session equally well.
    scale: float = 1.0  #: Factor on the covariance by which their likelihoods are compared.
    #: Of the attitudes: the likeliest step, and those that explain the session equally well.
    steps: tuple[AttitudeStep, ...] = ()

    @classmethod
    def free(cls, family: Family) -> SignificantFamily:
        """Return a family to be fitted in place of another."""
        steps = (AttitudeStep(0, None, FREE_STEP),) if family == ISOLATORS else ()
        return cls(family, 0.0, steps=steps)


@dataclass(frozen=True)
class UnobservableFamily:
    """A significant family without which the parameters are of use, and with which they are not."""

    family: Family  #: The family, which is off.
    log_p: float  #: Natural logarithm of the probability by chance.
    parameter: Parameter  #: Of the 24, the one with the largest ratio.
    ratio: float  #: Its standard deviation with the family over that without.


@dataclass(frozen=True)
class PossibleStep:
    """A step of the attitudes that is not shown, for which standard deviations allow."""

    step: AttitudeStep  #: The likeliest.
    size: float  #: Its size, rad.
    probability: float  #: Of any.
    parameters: tuple[Parameter, ...]  #: Those whose standard deviations it widens.


@dataclass(frozen=True, eq=False)
class SearchResult:
    """An estimate with the families selected, and the scores of the others."""

    estimate: Estimate  #: With all families found.
    found: tuple[SignificantFamily, ...]  #: Families in the order of their selection.
    scores: Mapping[Family, Score]  #: Of families that are off.
    alpha: float  #: Chance at which each of them is tested.
    #: (n, n) covariance of the parameters by alternative families, and by drifts that are not
    #: significant.
    undecided_covariance: Floats
    #: Derivatives of parameters (n,) by each coefficient (k,) of a term that is off, (n, k), SI
    #: units.
    leverage: Mapping[Family, Floats]
    probability: Mapping[Family, float]  #: Of each drift that is off; empty without a search.
    before_search: Estimate  #: The estimate before anything was found.
    by_drifts: Floats  #: (n, n) part of `undecided_covariance` by such drifts.
    #: Whether the search did not end: nothing is on though something may be needed.
    broken_off: bool = False
    unobservable: tuple[UnobservableFamily, ...] = ()  #: Significant, and left out.
    possible_step: PossibleStep | None = None  #: Where one may be that is not found.

    def shares(self) -> dict[ErrorSource, Share]:
        """Return the covariance of the parameters by source, alternatives included."""
        shares = self.estimate.shares()
        known = shares.get(ErrorSource.TERMS)
        if self.undecided_covariance.any() and known is not None:
            shares[ErrorSource.TERMS] = Share(
                known.covariance + self.undecided_covariance, known.freedom
            )
        elif self.undecided_covariance.any():
            shares[ErrorSource.TERMS] = Share.known(self.undecided_covariance)
        return shares


@dataclass(frozen=True, eq=False)
class _Model:
    """The unknowns of a fit."""

    evidence: Evidence  #: The session; errors of the table that are on are in its `table`.
    parameters: tuple[Parameter, ...]  #: Of the sensors, to be estimated.
    #: Coefficients of changes during the session, to be estimated.
    changes: tuple[Change, ...] = ()
    #: Parameters with their standard deviations about zero, as in `Equations`.
    considered: tuple[tuple[Parameter, float], ...] = ()

    def estimate(self) -> Estimate:
        """Fit the session with these unknowns."""
        return estimate(self.evidence, self.parameters, self.changes, self.considered)

    def with_found(self, found: Sequence[SignificantFamily]) -> _Model:
        """Return the model with families on, each as it was found."""
        model = self
        for one in found:
            table = model.evidence.table
            if one.family.course is not None:
                model = replace(model, changes=one.family.changes)
            elif one.steps:
                evidence = replace(model.evidence, attitude_steps=one.steps)
                model = replace(model, evidence=evidence)
            elif one.family.of_table and table is not None:
                errors = replace(table.errors, **{one.family.name: one.size})
                model = replace(model, evidence=model.evidence.with_table_errors(errors))
            elif one.considered:
                model = replace(model, considered=(*model.considered, *one.considered))
            else:
                terms = (*terms_of(model.parameters), *terms_of(one.family.parameters))
                model = replace(model, parameters=parameters_of(terms))
        return model

    def without(self, family: Family) -> _Model:
        """Return the model without one family."""
        if family.course is not None:
            return replace(self, changes=())
        terms = [term for term in terms_of(self.parameters) if term != family.term]
        return replace(self, parameters=parameters_of(terms))

    def on(self, equations: Equations, state: Floats) -> tuple[Equations, Floats]:
        """Return equations of a session with the families on, and their state; new ones are 0."""
        evidence, steps = equations.evidence, self.evidence.attitude_steps
        # A session with nothing changed keeps its cached results.
        if (table := self.evidence.table) and evidence.table != table:
            evidence = evidence.with_table_errors(table.errors)
        if evidence.attitude_steps != steps:
            evidence = replace(evidence, attitude_steps=steps)
        sensors = values_of(self.parameters, equations, state)
        here = replace(
            equations, parameters=self.parameters, considered=self.considered, evidence=evidence
        )
        courses = {change.course for change in self.changes}
        known = dict(zip(equations.changes, state[equations.change_slice], strict=True))
        kept = {c: v for c, v in known.items() if c.course in courses}
        there = np.concatenate([sensors, state[equations.nuisance_slice]])
        if kept or not self.changes:
            here = replace(here, changes=tuple(kept))
            return here, np.concatenate([there, list(kept.values())])
        here, _ = with_changes(replace(here, changes=()), self.changes)
        return with_shape(here, np.concatenate([there, np.zeros(len(here.changes))]))


def search_terms(
    evidence: Evidence,
    parameters: tuple[Parameter, ...] = PARAMETERS,
    changes: tuple[Change, ...] = (),
    *,
    find_terms: bool = True,
) -> SearchResult:
    """Estimate the parameters of a session and the terms that it shows.

    Args:
        evidence: The session.
        parameters: Always estimated.
        changes: Coefficients of their changes during the session, always estimated.
        find_terms: Estimate other families that are significant, too; all others are tested.
    """
    start = _Model(evidence, parameters, changes)
    try:
        search = _searched(start, start.estimate(), find_terms=find_terms)
    except NotConverged:
        stepped = _with_a_step(start) if find_terms else None
        if stepped is None:
            raise
        return stepped
    contradictory = search.broken_off or (
        search.estimate.downweighted_outputs and _may_step(start, search.before_search)
    )
    if find_terms and contradictory and not any(one.family == _STEP for one in search.found):
        stepped = _with_a_step(start)
        if stepped and _akaike_criterion(stepped.estimate) < _akaike_criterion(search.estimate):
            return replace(stepped, before_search=search.before_search)
    return search


def _searched(start: _Model, first: Estimate, *, find_terms: bool) -> SearchResult:
    """Search as `search_terms` does, from the estimate by the model alone."""
    noisy = bool(first.equations.own_variances.max() > SMALLEST_VARIANCE)
    rejected = set[Family]()
    unobservable: list[UnobservableFamily] = []
    broken_off = False
    search: SearchResult | None = None
    rivals: list[_Rival] = []
    while find_terms and noisy and search is None:
        try:
            found = _found_families(start, first, rejected)
        except NotConverged:
            broken_off = True
            break
        if not found:
            break
        try:
            trial = start.with_found(found).estimate()
        except NotObservable:
            rejected.add(found[-1].family)
            continue
        kept = _confirmed(start, first, trial, found)
        rivals += _rival(first, trial, found, kept)
        if len(kept) < len(found):
            rejected |= {one.family for one in found} - {one.family for one in kept}
        elif costly := _without_use(start, trial, kept):
            unobservable.append(costly)
            rejected.add(costly.family)
        else:
            kept, hinted = _with_carried_alternatives(start, trial, kept)
            unobservable += [one for one in hinted if one.family not in rejected]
            search = _search_of(trial, kept, first, weigh_drifts=True)
    if search is None:
        search = _search_of(first, (), first, weigh_drifts=find_terms and noisy)
    if broken_off or unobservable:
        search = replace(search, broken_off=broken_off, unobservable=tuple(unobservable))
    return _with_rivals(search, rivals) if rivals else search


@dataclass(frozen=True, eq=False)
class _Rival:
    """An estimate that explains a session nearly as well as the one that is chosen."""

    estimate: Estimate
    odds: float  #: Its probability over that of the one chosen.
    step: SignificantFamily | None  #: The step of the attitudes that is on in it.


def _rival(
    first: Estimate,
    trial: Estimate,
    found: Sequence[SignificantFamily],
    kept: Sequence[SignificantFamily],
) -> list[_Rival]:
    """Return families that are nearly as likely as the outliers preferred to them, if any."""
    if len(kept) == len(found) or not any(one.against_outliers for one in found):
        return []
    apart = abs(_ahead_of_outliers(first, trial, found))
    if apart >= _APART:
        return []
    step = next((one for one in found if one.steps), None)
    return [_Rival(trial, float(np.exp(-apart / 2)), step)]


def _with_rivals(search: SearchResult, rivals: Sequence[_Rival]) -> SearchResult:
    """Return a search whose covariance allows for its rivals."""
    here = search.estimate
    mine = here.equations.parameters
    every = 1 + sum(rival.odds for rival in rivals)
    undecided_covariance, possible = search.undecided_covariance, search.possible_step
    for rival in (one for one in rivals if one.estimate is not here):
        there, probability = rival.estimate, rival.odds / every
        other = there.equations.parameters
        common = [k for k, p in enumerate(mine) if p in other]
        off = np.zeros(len(mine))
        places = indices_of([mine[k] for k in common], other)
        off[common] = there.state[places] - here.state[common]
        more = probability * np.outer(off, off)
        undecided_covariance = undecided_covariance + more
        if rival.step is not None:
            std = np.sqrt(np.diag(here.covariance)[: len(mine)])
            moved = tuple(p for p, yes in zip(mine, _widened(more, std), strict=True) if yes)
            step, size = rival.step.steps[0], rival.step.seen
            possible = PossibleStep(step, size, probability, moved) if moved else possible
    return replace(search, undecided_covariance=undecided_covariance, possible_step=possible)


def _widened(more: Floats, std: Floats) -> NDArray[np.bool_]:
    """Return which standard deviations (n,) a covariance (n, n) widens by more than `WIDER`."""
    return np.asarray(np.sqrt(1 + np.diag(more) / std**2) > 1 + WIDER)


def _without_use(
    start: _Model, trial: Estimate, found: Sequence[SignificantFamily]
) -> UnobservableFamily | None:
    """Return the least significant family that leaves one of the 24 parameters without use.

    Each is compared with the estimate without it, by the same scatter. Errors of the table are not:
    they rotate the misalignments with its frame, as they truly do.
    """
    with_all = _common_std(trial.equations, trial.state)
    limits = np.array([useful_limit(p) for p in PARAMETERS])
    beyond = with_all > limits
    costly, together = [], []
    for k, one in enumerate(found):
        if one.family.of_table or one.considered:
            continue
        model = start.with_found((*found[:k], *found[k + 1 :]))
        without = _common_std(*model.on(trial.equations, trial.state))
        ratios = with_all / without
        # Beyond the limit by this family, and not by another of those found.
        by_it = beyond & (without <= limits)
        worst = int(np.argmax(np.where(by_it, np.inf, ratios)))
        this = UnobservableFamily(one.family, one.log_p, PARAMETERS[worst], float(ratios[worst]))
        if ratios[worst] > _WITHOUT_USE or by_it[worst]:
            costly.append(this)
        elif beyond.any():
            together.append(this)
    return max(costly or together, key=lambda one: one.log_p, default=None)


def _with_carried_alternatives(
    start: _Model, trial: Estimate, found: Sequence[SignificantFamily]
) -> tuple[tuple[SignificantFamily, ...], list[UnobservableFamily]]:
    """Return families with the alternatives that leave the parameters of use, and the others.

    What such an alternative makes of the parameters is arbitrary where they are not determined.
    """
    carried, unobservable = [], dict[Family, UnobservableFamily]()
    for k, one in enumerate(found):
        model = start.with_found((*found[:k], *found[k + 1 :]))
        without = _common_std(*model.on(trial.equations, trial.state))
        for other in one.alternatives:
            trying = model.with_found([SignificantFamily.free(other)])
            try:
                ratios = _common_std(*trying.on(trial.equations, trial.state)) / without
            except NotObservable:
                continue
            worst = int(np.argmax(ratios))
            if ratios[worst] > _WITHOUT_USE:
                unobservable[other] = UnobservableFamily(
                    other, one.log_p, PARAMETERS[worst], float(ratios[worst])
                )
        alternatives = tuple(f for f in one.alternatives if f not in unobservable)
        carried.append(replace(one, alternatives=alternatives))
    return tuple(carried), list(unobservable.values())


def _common_std(equations: Equations, state: Floats) -> Floats:
    """Return the standard deviations (24,) of the parameters of every unit about a solution."""
    covariance = Information.from_jacobian(equations.whitened(state)[0]).covariance
    return np.asarray(np.sqrt(np.diag(covariance))[indices_of(PARAMETERS, equations.parameters)])


def _may_step(start: _Model, first: Estimate) -> bool:
    """Return whether a step may explain the outputs that an estimate set aside."""
    equations = _restored(start, first)
    if _STEP not in (open_ones := families(equations)):
        return False
    score = _under_own_scatter(equations, first.state, [_STEP])[_STEP]
    return score.log_p <= _HINTED * _log_chance_limit(open_ones)


def _with_a_step(start: _Model) -> SearchResult | None:
    """Search with a step on from the beginning; None where it is not significant.

    Biases that step by hundreds of deviations leave residuals for which nothing converges without
    the step, and a smaller step sets outputs next to it aside, without which it is not seen.
    """
    if _STEP not in families(Equations(start.evidence, start.parameters, start.changes)):
        return None
    step = SignificantFamily(_STEP, 0.0)
    stepping = start.with_found([step])
    try:
        first = stepping.estimate()
        if not _confirmed(start, first, first, [step]):
            return None
        search = _searched(stepping, first, find_terms=True)
    except NotObservable:
        return None
    others = [replace(one, against_outliers=0) for one in search.found]
    kept = _confirmed(start, search.estimate, search.estimate, [step, *others])
    if not kept or kept[0].family != _STEP:
        return None
    if _without_use(start, search.estimate, (kept[0], *search.found)):
        return None
    return _search_of(search.estimate, (kept[0], *search.found), first, weigh_drifts=True)


def _akaike_criterion(current: Estimate, of_table: int = 0) -> float:
    """Return chi-square plus twice the number of coefficients, by the noise known beforehand.

    Each output that is set aside has a coefficient of its own, and a step one for its instant.
    Errors of the table that are on have so many coefficients.

    Source: Akaike 1974, IEEE Trans. Automat. Contr. 19, 716.
    """
    plain = current.without_scatter
    jacobian, residuals = plain.whitened(current.state)
    remains = residuals - jacobian @ linear_step(jacobian, residuals)
    coefficients = len(plain.parameters) + len(plain.changes) + current.downweighted_outputs
    stepping = any(change.course is Course.STEP for change in plain.changes)
    moved = any(not step.by_force for step in plain.evidence.attitude_steps)
    return float(remains @ remains) + 2 * (coefficients + of_table + stepping + moved)


def _ahead_of_outliers(
    first: Estimate, trial: Estimate, found: Sequence[SignificantFamily]
) -> float:
    """Return by how much families lower the criterion, against the first estimate's outliers."""
    of_table = sum(one.against_outliers for one in found if one.family.of_table)
    return _akaike_criterion(first) - _akaike_criterion(trial, of_table)


def _found_families(
    start: _Model, first: Estimate, rejected: set[Family]
) -> tuple[SignificantFamily, ...]:
    """Return families one after the other, the most significant first, until none is significant.

    First with no output set aside, then with all that the first estimate set aside: a missing
    family causes outliers, and outliers cause an apparent family. Raises `NotConverged` where
    neither converges with the families found.
    """
    as_kept = (first.without_scatter, first.state)
    views = [(_restored(start, first), first.state)]
    if first.downweighted_outputs:
        views.append(as_kept)
    try:
        return _significant(start, views, rejected)
    except NotConverged:
        # Outputs that were set aside match nothing: a move with frozen samples, for example.
        return _significant(start, [as_kept], rejected)


def _significant(
    start: _Model, views: list[tuple[Equations, Floats]], rejected: set[Family]
) -> tuple[SignificantFamily, ...]:
    """Return families one after the other by several views of a session, each with its state."""
    found: list[SignificantFamily] = []
    while True:
        model = start.with_found(found)
        done = rejected | {one.family for one in found}
        open_ones = [f for f in families(views[0][0]) if f not in done]
        limit = _log_chance_limit(open_ones)
        scores = [_under_own_scatter(*view, open_ones) for view in views]
        best = {f: min(one[f].log_p for one in scores) for f in open_ones}
        shown = [f for f in open_ones if best[f] < limit]
        if not shown:
            return tuple(found)
        family = _likeliest(shown, best)
        k = min(range(len(views)), key=lambda k: scores[k][family].log_p)
        score = scores[k][family]
        against_outliers = 0 if scores[-1][family].log_p < limit else score.rank
        found.append(
            SignificantFamily(
                family, score.log_p, *_assigned_sizes(model, family, score), against_outliers
            )
        )
        if family.of_attitudes:
            steps, seen = _likely_steps(*views[k], found[-1], score)
            found[-1] = replace(found[-1], seen=seen, steps=steps)
        model = start.with_found(found)
        try:
            views = [model.on(*view) for view in views]
        except NotObservable:
            # A term of the session that cannot be separated from the others.
            found.pop()
            rejected.add(family)
            continue
        views = [(equations, fit(equations, state)) for equations, state in views]


def _likeliest(shown: Sequence[Family], chances: Mapping[Family, float]) -> Family:
    """Return the most significant; the first of those that the session cannot separate.

    A term that follows a recorded temperature is preferred to a drift with time that explains the
    session equally well: it holds in other sessions, too. Chances are natural logarithms.
    """
    family = min(shown, key=lambda f: round(chances[f]))
    if family.course is not None:
        for other in shown:
            near = chances[other] < chances[family] + _APART / 2
            if other.course is Course.THERMAL and near:
                return other
    return family


def _log_chance_limit(open_ones: Sequence[Family]) -> float:
    """Return the log of the chance below which the best of several is significant."""
    return float(np.log(CHANCE / max(1, len(open_ones))))


def _restored(start: _Model, first: Estimate) -> Equations:
    """Return the equations with all moves, nothing set aside, and the stated noise."""
    evidence = first.equations.evidence
    if evidence.moves != start.evidence.moves:
        evidence = replace(evidence, moves=start.evidence.moves)
    return replace(first.without_scatter, evidence=evidence, inflation=None)


def _under_own_scatter(
    equations: Equations, state: Floats, open_ones: Sequence[Family]
) -> dict[Family, Score]:
    """Test families under the scatter that remains with each on, until some are significant.

    Without any scatter the test has most power: a family that is insignificant there is so with
    scatter, and the most significant there is tried first.
    """
    columns = columns_of(open_ones, equations, state)
    scores = scores_of(columns, equations, state)
    suspect = [
        family
        for family, score in scores.items()
        if score.tested and scipy.special.chdtrc(score.rank, score.statistic) < CHANCE
    ]
    suspect.sort(key=lambda family: -scores[family].statistic)
    for k, family in enumerate(suspect):
        if k % _AT_ONCE == 0 and any(
            scores[f].log_p < _log_chance_limit(open_ones) for f in suspect[:k]
        ):
            return scores | {f: replace(scores[f], statistic=0.0) for f in suspect[k:]}
        shape = float(shapes_of(family, equations)[scores[family].chosen])
        scattering = family.with_scatter(equations, family.scatter(equations, state, shape))
        scores[family] = WhitenedResiduals.at(scattering, state).score(family, columns[family])
    return scores


def _likely_steps(
    equations: Equations, state: Floats, found: SignificantFamily, score: Score
) -> tuple[tuple[AttitudeStep, ...], float]:
    """Return the likeliest step of the attitudes, with others as likely, and its size."""
    family, steps = found.family, steps_of(equations)
    scatter = family.scatter(equations, state, score.chosen)
    residuals = WhitenedResiduals.at(family.with_scatter(equations, scatter), state)
    scores = residuals.scores(family, columns_of([family], equations, state)[family])
    # Of steps with one and with three coefficients: a reading that slips turns the unit about an
    # axis, and in its mount it turns about any.
    evidence = [other.log_evidence(found.seen) for other in scores]
    order = sorted(range(len(steps)), key=lambda k: -evidence[k])
    likely = [k for k in order if evidence[order[0]] - evidence[k] < _APART / 2]
    sized = tuple(replace(steps[k], size=found.size) for k in likely)
    return sized, scores[order[0]].largest_turn


def _confirmed(
    start: _Model, first: Estimate, trial: Estimate, found: Sequence[SignificantFamily]
) -> tuple[SignificantFamily, ...]:
    """Return those that remain significant once all are fitted, with their alternatives.

    Those that are insignificant with the first estimate's outliers set aside must explain the
    session better than these do.
    """
    kept = []
    competing = any(one.against_outliers for one in found)
    better = competing and _ahead_of_outliers(first, trial, found) > 0
    for k, one in enumerate(found):
        if one.against_outliers and not better:
            continue
        model = start.with_found((*found[:k], *found[k + 1 :]))
        without, state = model.on(trial.equations, trial.state)
        # An erroneous table has as many patterns as outputs: only terms are alternatives, and
        # isolators, which turn into a quadratic term where gyros do not see them.
        possible = families(without)
        others = [f for f in possible if not f.of_table or f == one.family]
        if not one.family.of_table and Family(ATTITUDE_STEP) in possible:
            others.append(ISOLATORS)
        columns = columns_of(others, without, state)
        scattering = one.family.with_scatter(without, trial.scatter)
        residuals = WhitenedResiduals.at(scattering, state)
        scores = {f: residuals.score(f, columns[f]) for f in others}
        here, limit = scores[one.family], _log_chance_limit(possible)
        if here.log_p >= limit:
            continue
        alternatives, scale = _alternatives(one.family, scores, limit), here.scale
        if trial.downweighted_outputs:
            # What no family fits is set aside, and may show that none is the true one.
            residuals = WhitenedResiduals.at(replace(scattering, inflation=None), state)
            scores = {f: residuals.score(f, columns[f]) for f in others}
            if more := _alternatives(one.family, scores, limit):
                alternatives = tuple(dict.fromkeys((*alternatives, *more)))
                scale = max(scale, scores[one.family].scale)
        kept.append(replace(one, log_p=here.log_p, alternatives=alternatives, scale=scale))
    return tuple(kept)


def _alternatives(
    family: Family, scores: Mapping[Family, Score], limit: float
) -> tuple[Family, ...]:
    """Return families that explain a session as well as one that is significant.

    Nearly significant ones too: isolators have twice the coefficients of a quadratic term.
    """
    here = scores[family]
    least = here.statistic - _APART * here.scale
    near = limit + _APART / 2
    return tuple(
        f
        for f, other in scores.items()
        if f != family and here.log_p < limit and other.log_p < near and other.statistic > least
    )


def _assigned_sizes(
    model: _Model, family: Family, score: Score
) -> tuple[tuple[tuple[Parameter, float], ...], float, float]:
    """Return `considered`, `size` and `seen` of `SignificantFamily` for a family.

    The unobserved part is assumed as large as the observed part, by Student's t for as many
    directions as are observed.
    """
    if family.course is not None:
        return (), 0.0, 0.0
    if family.term is not None:
        terms = (*terms_of(model.parameters), family.term)
        trial = Equations(model.evidence, parameters_of(terms), considered=model.considered)
        if determined(nominal_information(trial), trial.parameters).all():
            return (), 0.0, 0.0
    two = float(scipy.special.ndtr(2.0))
    wider = float(scipy.special.stdtrit(score.rank, two)) / 2
    seen = float(np.sqrt(score.estimate @ score.estimate / score.rank))
    considered = tuple((p, wider * seen) for p in family.parameters)
    return considered, *((wider * seen, seen) if family.of_table else (0.0, 0.0))


def _search_of(
    current: Estimate, found: tuple[SignificantFamily, ...], plain: Estimate, *, weigh_drifts: bool
) -> SearchResult:
    """Score the families that are off under the final weights, those of the current estimate.

    Drifts that are not shown widen the covariance if requested.
    """
    equations, state = current.equations, current.state
    named = [one.family for one in found]
    off = [f for f in families(equations) if f not in named]
    columns = columns_of(off, equations, state)
    residuals = WhitenedResiduals.at(equations, state)
    of_session = [f for f in off if f.course is not None]
    with_drift = residuals
    if of_session and current.scatter.absent_drift:
        with_drift = WhitenedResiduals.at(
            of_session[0].with_scatter(equations, current.scatter), state
        )
    drifting = {f: with_drift.scores(f, columns[f]) for f in of_session}
    others = {f: columns[f] for f in off if f not in of_session}
    scores = scores_of(others, equations, state)
    scores |= {f: most_significant(its, tries_of(f, equations)) for f, its in drifting.items()}
    scores = {f: scores[f] for f in off}
    m, n = len(equations.outputs), equations.sensors
    gain = unwhiten(residuals.factor, current.gain[:n, :m])

    def slopes(pattern: Pattern) -> Floats:
        moved, sizes = pattern
        return np.asarray(gain @ (moved / sizes))

    leverage = {f: slopes(columns[f][scores[f].chosen]) for f in off if not f.of_table}
    alpha = CHANCE / max(1, len(off))
    undecided_covariance = np.zeros((n, n))
    for one in found:
        undecided_covariance += _by_alternatives(current, one)
    drifts = UndecidedDrifts({}, np.zeros((n, n)))
    if weigh_drifts:
        every = {f: list(zip(drifting[f], map(slopes, columns[f]), strict=True)) for f in drifting}
        drifts = undecided(every, n, interrupted(equations.evidence))
    by_step, possible = np.zeros((n, n)), None
    stepping = next((f for f in off if weigh_drifts and f.of_attitudes), None)
    if stepping is not None:
        tried = columns[stepping]
        by_step, possible = _possible_step(current, residuals, tried, list(map(slopes, tried)))
    return SearchResult(
        current,
        found,
        scores,
        alpha,
        undecided_covariance + drifts.covariance + by_step,
        leverage,
        drifts.probability,
        plain,
        drifts.covariance,
        possible_step=possible,
    )


def _possible_step(
    current: Estimate,
    residuals: WhitenedResiduals,
    patterns: tuple[Pattern, ...],
    slopes: Sequence[Floats],
) -> tuple[Floats, PossibleStep | None]:
    """Return the covariance (n, n) by a step of the attitudes that is not shown, and the likeliest.

    Scatter absorbs a step: that is there, by its probability, or a step may be in its place.
    """
    family, equations = Family(ATTITUDE_STEP), current.equations
    likely = current.scatter.probability if current.scatter.shown else 1.0
    views = [(residuals, likely)]
    if likely < 1:
        plain = WhitenedResiduals.at(current.without_scatter, current.state)
        views.append((plain, 1 - likely))
    tried = [one for view, _ in views for one in view.scores(family, patterns)]
    steps = steps_of(equations)
    once = [_BY_FORCE if step.by_force else 1 / len(steps) for step in steps]
    prior = np.concatenate([share * np.array(once) for _, share in views])
    every = list(zip(tried, [*slopes] * len(views), strict=True))
    found = undecided({family: every}, equations.sensors, steps=prior)
    std = np.sqrt(np.diag(current.covariance)[: equations.sensors])
    wider = _widened(found.covariance, std)
    if not wider.any():
        return found.covariance, None
    best = max(
        (k for k, score in enumerate(tried) if score.tested),
        key=lambda k: log_bayes_factor(*tried[k].square) + np.log(prior[k]),
    )
    return found.covariance, PossibleStep(
        steps[best % len(steps)],
        tried[best].largest_turn,
        found.probability[family],
        tuple(p for p, yes in zip(equations.parameters, wider, strict=False) if yes),
    )


def _by_alternatives(current: Estimate, found: SignificantFamily) -> Floats:
    """Return the additional covariance if an alternative may be true in place of a family.

    Each explanation is weighted by its likelihood; the mean square of an alternative's effect on
    the common parameters is added (Hoeting et al. 1999, Statist. Sci. 14, 382).
    """
    equations = current.equations
    n = equations.sensors
    undecided_covariance = np.zeros((n, n))
    mine = set(found.family.parameters)
    common = [k for k, p in enumerate(equations.parameters) if p not in mine]
    own = [k for k, p in enumerate(equations.parameters) if p in mine]
    chi_square = equations.chi_square(current.state)
    model = _Model(
        equations.evidence, equations.parameters, equations.changes, equations.considered
    ).without(found.family)
    for alternative in found.alternatives:
        try:
            other, start = model.with_found([SignificantFamily.free(alternative)]).on(
                equations, current.state
            )
            state = fit(other, start)
        except NotObservable:
            continue
        kept = indices_of([equations.parameters[k] for k in common], other.parameters)
        apart = (other.chi_square(state) - chi_square) / found.scale
        weight = 1 / (1 + np.exp(min(50.0, apart / 2)))
        off = np.zeros(n)
        off[common] = state[kept] - current.state[common]
        off[own] = -current.state[own]
        undecided_covariance += weight * np.outer(off, off)
    return undecided_covariance
