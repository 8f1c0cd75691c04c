"""The joint estimate: one weighted nonlinear least squares over all of a session, of any plan.

The result of `fit` is checked: axes, latitude, residuals; and outputs with less weight are named.

Source: docs/mathematics.md, 'Joint estimate'.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy

from ..common.errors import Contradiction, NotObservable
from ..common.stream import Floats
from ..model.sensors import parameters_of
from ..model.session_terms import Change, Changes, Course
from ..model.terms import Term
from .checks import (
    WrongLatitude,
    check_axes,
    check_latitude,
    clock_finding,
    encoder_finding,
    far_scales,
)
from .conclusion import LeastSquares
from .converge import NotConverged
from .equations import Equations
from .estimate import Estimate, estimate
from .evidence import Evidence
from .exact_table import as_the_best, contradicted, exactness_findings
from .excess_scatter import excess
from .fit import fit
from .joint_findings import estimate_findings
from .modulation import instant_of, seconds_of
from .search import Search, search_terms
from .session_model import Nuisance
from .solution import Residual, Solution
from .term_tests import confounded_errors, findings, tested

_ANYWHERE = math.radians(30)
"""Standard deviation of an unknown latitude, rad: no higher or lower one is far off."""
_NEAR = 2.0
"""Standard deviations within which the rate seen by the gyros at rest has the Earth's size: 19 of
20 sessions at a wrong latitude."""


def solve(
    evidence: Evidence,
    terms: tuple[Term, ...] = (),
    changes: tuple[Change, ...] = (),
    *,
    find_terms: bool = False,
) -> Solution:
    """Estimate the 24 parameters, and those of terms, from a session of any plan.

    Args:
        evidence: The session.
        terms: Of the sensors, always estimated.
        changes: Coefficients of changes during the session, always estimated.
        find_terms: Estimate other terms that are significant, too.

    Raises:
        NotObservable: Names the parameters that the session does not determine, or the
            contradiction.
        InputError: The outputs are not in the units that the IMU's description states.
    """
    try:
        search = search_terms(evidence, parameters_of(terms), changes, find_terms=find_terms)
    except NotConverged:
        if not evidence.plan.by_hand:
            _check_that_no_latitude_converges(evidence)
        raise
    if search.found and not evidence.plan.by_hand:
        _check_that_no_latitude_explains(search.before_search)
    if contradicted(search):
        evidence = as_the_best(evidence)
        search = search_terms(evidence, parameters_of(terms), changes, find_terms=find_terms)
    return concluded(search, terms, changes)


def concluded(search: Search, terms: tuple[Term, ...], changes: tuple[Change, ...]) -> Solution:
    """Check the result, and report the terms that were requested.

    Raises:
        NotObservable: The data contradicts itself.
    """
    found = _checked_solution(search.estimate, confounded_errors(search))
    return replace(
        found,
        covariance=found.covariance + search.undecided_covariance,
        findings=(
            *findings(search),
            *found.findings,
            *exactness_findings(search.estimate),
        ),
        shares=search.shares(),
        tests=tested(search, terms, changes),
        search=search,
    )


def provisional(
    evidence: Evidence, terms: tuple[Term, ...] = (), changes: tuple[Change, ...] = ()
) -> Solution:
    """Solve a session in progress as `solve` does, without testing or selecting terms that are off.

    Args:
        evidence: The session so far.
        terms: As in `solve`.
        changes: Likewise.

    Raises:
        NotObservable: As `solve`.
        InputError: Likewise.
    """
    found = estimate(evidence, parameters_of(terms), changes)
    return replace(_checked_solution(found), shares=found.shares())


def _check_that_no_latitude_explains(plain: Estimate) -> None:
    """Raise if another latitude alone explains the terms found, by an estimate without any."""
    equations, evidence = plain.equations, plain.equations.evidence
    try:
        check_latitude(evidence, *observed_earth_rate(plain))
    except WrongLatitude as error:
        if error.misfit > _NEAR:
            return
        there = replace(evidence, site=replace(evidence.site, latitude=error.seen))
        if not search_terms(there, equations.parameters, equations.changes).found:
            raise
    except Contradiction:
        return


def _check_that_no_latitude_converges(evidence: Evidence) -> None:
    """Raise if nothing converges at this latitude but does at the one seen by the gyros.

    At a wrong latitude the gyros leave residuals of hundreds of deviations, for which the least
    squares need not converge.
    """
    equations = Equations(evidence)
    rate, _ = _free_earth(equations, equations.nominal())
    latitude = float(np.arctan2(rate[2], np.hypot(rate[0], rate[1])))
    try:
        there = estimate(replace(evidence, site=replace(evidence.site, latitude=latitude)))
        check_latitude(evidence, *observed_earth_rate(there))
    except WrongLatitude:
        raise
    except NotObservable:
        return


def _checked_solution(found: Estimate, confounded: Sequence[str] = ()) -> Solution:
    """Check an estimate: axes, latitude, residuals.

    `confounded` names errors of the table that positioning errors may be in fact.
    """
    equations, evidence = found.equations, found.equations.evidence
    model = equations.model(found.state)
    check_axes(model.gyro.response, 'gyros', 'the turns and the Earth')
    check_axes(model.accel.response, 'accelerometers', 'gravity')
    earth, earth_covariance = observed_earth_rate(found)
    if not evidence.plan.by_hand:
        try:
            check_latitude(evidence, earth, earth_covariance)
        except Contradiction:
            earth, earth_covariance = _free_earth(_with_scatter_at_any_latitude(found), found.state)
            check_latitude(evidence, earth, earth_covariance)
    # By hand each hold has a separate heading.
    azimuth, azimuth_std = float('nan'), float('inf')
    if not evidence.plan.by_hand:
        azimuth, azimuth_std = found.nuisance(Nuisance.AZIMUTH)
    return Solution(
        model,
        found.covariance[: equations.sensors, : equations.sensors],
        _residuals(found),
        azimuth + (evidence.azimuth or 0.0),
        azimuth_std,
        float(earth[2]),
        float(np.sqrt(earth_covariance[2, 2])),
        found.condition,
        (
            *estimate_findings(found, confounded),
            *far_scales(model),
            *clock_finding(evidence),
            *encoder_finding(evidence),
        ),
        found.scatter.bias_drift,
        equations.parameters,
        changes=_changes(found),
    )


def _changes(found: Estimate) -> Changes | None:
    equations = found.equations
    if not equations.changes:
        return None
    own, sensors = equations.change_slice, slice(0, equations.sensors)
    courses = {c.course for c in equations.changes}
    shaped = equations.evidence, equations.shape
    return Changes(
        equations.changes,
        found.state[own],
        found.covariance[own, own],
        found.covariance[sensors, own],
        seconds_of(*shaped) if Course.WARM_UP in courses else math.nan,
        instant_of(*shaped) * 1e-9 if Course.STEP in courses else math.nan,
    )


def _residuals(found: Estimate) -> tuple[Residual, ...]:
    equations, evidence = found.equations, found.equations.evidence
    rest = equations.layout.dwell
    residuals = (equations.outputs - equations.predict(found.state))[rest]
    std = np.linalg.norm(equations.factor(found.state), axis=1)[rest]
    return tuple(
        Residual(str(segment.position), segment.start, value, deviation)
        for segment, value, deviation in zip(evidence.segments, residuals, std, strict=True)
    )


def observed_earth_rate(found: Estimate) -> tuple[Floats, Floats]:
    """Return the Earth rate by the gyros, free in size and direction, and its covariance.

    The tilts found in the session are removed from it; its covariance includes their uncertainty.
    Only the noise is used, or the residuals it leaves if larger: scatter by a wrong latitude must
    not hide it.

    Returns:
        (3,) rad/s, level but at the heading of the attitudes, and (3, 3).
    """
    return _free_earth(found.without_scatter, found.state)


def _with_scatter_at_any_latitude(found: Estimate) -> Equations:
    """Return the equations with the scatter that no latitude explains.

    Biases that drift by as much as the Earth turns, as those of cheap gyros whose description
    states no drift, contradict every latitude by the noise alone. At an unknown one the session
    shows how much they drift, and a wrong one does not seem to be drift.
    """
    evidence = found.equations.evidence
    anywhere = replace(evidence.site, latitude_std=_ANYWHERE)
    equations = replace(found.without_scatter, evidence=replace(evidence, site=anywhere))
    scatter = excess(equations, fit(equations, found.state))
    return replace(found.without_scatter, extra=scatter.extra)


def _free_earth(plain: Equations, state: Floats) -> tuple[Floats, Floats]:
    """Return `observed_earth_rate` about a state (n,), by the covariance of `plain`."""
    sensors = plain.sensors
    by_rate = plain.world_derivatives(state)[:, :3]
    free = scipy.linalg.solve_triangular(plain.factor(state), by_rate, lower=True)
    jacobian, residuals = plain.whitened(state)
    # The heading is one of the three components that are now free.
    jacobian = np.delete(jacobian, sensors + Nuisance.AZIMUTH, axis=1)
    columns = np.hstack([jacobian, np.vstack([free, np.zeros((plain.nuisances, 3))])])
    seen = LeastSquares.of(columns, residuals, float(np.finfo(float).eps))
    covariance = seen.covariance[-3:, -3:] * max(1.0, seen.square / max(1, seen.freedom))
    around = plain.surroundings(state)
    # The tilts' own columns turn the rate along with gravity: the free rate is added.
    return around.level @ (around.rate + seen.step[-3:]), around.level @ covariance @ around.level.T
