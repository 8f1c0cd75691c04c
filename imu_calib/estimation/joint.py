"""The joint estimate: one weighted nonlinear least squares over all of a session, of any plan.

The result of `fit` is checked: axes, latitude, residuals; and outputs with less weight are named.

Source: docs/mathematics.md, 'Joint estimate'.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from ..common.budget import ErrorSource
from ..common.errors import Contradiction, NotObservable
from ..common.finding import Finding, warning
from ..common.stream import Floats
from ..common.units import ARCSEC, DEG, DEG_H, MICRO_G, significant
from ..model.parameters import Parameter, ParameterKind, indices_of
from ..model.sensors import parameters_of
from ..model.session_terms import Change, Changes, Course, names_of
from ..model.terms import Term
from .checks import (
    WrongLatitude,
    check_axes,
    check_latitude,
    clock_finding,
    encoder_finding,
    far_scales,
    turns_scatter_finding,
)
from .components import whiten
from .conclusion import LeastSquares
from .equations import Equations
from .estimate import Estimate, estimate
from .evidence import Evidence
from .exact_table import SHOWN, contradicted, exactness_findings, with_least_errors
from .excess_scatter import ExcessScatter, excess
from .modulation import instant_of, seconds_of
from .outliers import Outlier, RejectedMove
from .search import SearchResult, search_terms
from .session_model import Nuisance
from .solution import Residual, Solution
from .solve import NotConverged, fit
from .term_tests import confounded_errors, findings, temperature_finding, tested

_SIGNIFICANT = 0.1
"""Of the stated values: positioning errors below it change no deviation by more than half a
percent, biases that drift by so much more by no more than a tenth."""
_SAID = 0.9
"""Probability from which on scatter is reported: beside the least gain another 2.2. One of seven
kinds gains as much by chance in three to eleven of ten thousand sound sessions (20 000 draws of
noise, three grades), and the least in one of a hundred: the deviations allow for it then."""
_LIKELY = 0.5
"""Probability from which on drifts and scatter of motions are reported: below, the deviations allow
for something that more likely is not there."""
_OF_ATTITUDE = {'gyros': 'g_sensitivity', 'accelerometers': 'accel_cross'}
"""The largest of the terms that change with the attitude, for each triad."""
_NAMED = 3  #: Moves named in a sentence; users inspect the first ones.


def estimate_findings(found: Estimate, confounded: Sequence[str]) -> list[str]:
    """Return the findings on an estimate, in sentences.

    `confounded` names errors of the table that positioning errors may be in fact.
    """
    notes: list[str] = []
    if found.outliers:
        names = ', '.join(
            f'{o.name} ({np.sqrt(o.chi_square):.0f} sigma{_tilt_explanation(found, o)})'
            for o in found.outliers
        )
        plural = 's' * (len(found.outliers) > 1)
        far = float(np.sqrt(max(o.chi_square for o in found.outliers)))
        notes.append(warning(f'Outlier{plural}, given less weight: {names}.', effect=far))
    notes += _rejected_moves_finding(found)
    if found.turns_scatter > 1:
        notes.append(turns_scatter_finding(found.turns_scatter))
    if found.equations.any_heading:
        azimuth, std = found.nuisance(Nuisance.AZIMUTH)
        notes.append(
            warning(
                f'The gyros see north {azimuth / DEG:.1f} +- {std / DEG:.1f} deg off the stated '
                'azimuth: the stated one is not used.',
                effect=abs(azimuth) / std,
            )
        )
    if found.equations.levelled is not None:
        tilts = [found.nuisance(which)[0] for which in (Nuisance.TILT_X, Nuisance.TILT_Y)]
        tilt, level = float(np.linalg.norm(tilts)), found.equations.evidence.levelling
        notes.append(
            warning(
                f'The table is tilted by {tilt / ARCSEC:.0f} arcsec, more than the '
                f'{significant(level / ARCSEC, 3)} arcsec that are assumed.',
                effect=tilt / level if level else math.inf,
            )
        )
    notes += [_constant_finding(found)] if found.constant else []
    return [*notes, *temperature_finding(found), *_scatter_findings(found, confounded)]


def _tilt_explanation(found: Estimate, outlier: Outlier) -> str:
    """Return the attitude error of the table that explains this; empty where it explains little.

    The residual along gravity is then as by noise: below two deviations, a third of the 5.5 from
    which a dwell gets less weight.
    """
    equations = found.equations
    if not any(np.array_equal(rows, outlier.rows) for rows in equations.layout.dwell[:, 3:]):
        return ''
    force = equations.predict(found.state)[outlier.rows]
    # Channels lie along their axes to milliradians, and so do their errors.
    off = (equations.outputs[outlier.rows] - force) / np.linalg.norm(force)
    along = float(off @ force) / float(np.linalg.norm(force))
    lean = float(np.linalg.norm(np.cross(off, force))) / float(np.linalg.norm(force))
    return (
        f', as an attitude error of the table of {significant(lean / ARCSEC)} arcsec makes it'
        if abs(along) < lean / 3
        else ''
    )


def _constant_finding(found: Estimate) -> str:
    names = ', '.join(c.name for c in found.constant)
    return (
        f'The session does not show how {names} change '
        f'({" and ".join(names_of(found.constant))}): they are taken as constant. To show it, '
        'record turns about each axis, and dwells with each axis up and down, at the beginning and '
        'at the end.'
    )


def _rejected_moves_finding(found: Estimate) -> list[str]:
    """Report the moves or velocities that were left out, their errors and possible causes."""
    notes: list[str] = []
    turned = [move for move in found.rejected_moves if not move.velocity]
    pushed = [move for move in found.rejected_moves if move.velocity]
    used = found.equations.evidence.used_moves
    if turned:
        off = max(move.misclosure for move in turned)
        unit, words = (DEG, 'deg') if off >= DEG else (ARCSEC, 'arcsec')
        angle = f'{significant(off / unit, 3)} {words}'
        notes.append(
            f'Gyros and encoders disagree on the end of {len(turned)} of {len(turned) + len(used)} '
            f'moves ({_names_of_moves(turned)}; {angle} at most): these are left out. '
            'Possible causes: rates beyond the range of the gyros, nonlinear gyros, samples that '
            'freeze on the way, and a table whose axes are not where its description says.'
        )
    if pushed:
        speed = max(move.misclosure for move in pushed)
        notes.append(
            f'By the accelerometers {len(pushed)} of {len(pushed) + len(used.with_accels)} moves '
            f'do not end at rest ({_names_of_moves(pushed)}; {speed:.3g} m/s at most): their '
            'velocities are left out. Possible causes: nonlinear accelerometers, samples that '
            'freeze on the way, and a unit that vibrates in its mount.'
        )
    return notes


def _names_of_moves(moves: Sequence[RejectedMove]) -> str:
    names = ', '.join(' to '.join(move.positions) for move in moves[:_NAMED])
    more = '' if len(moves) <= _NAMED else f' and {len(moves) - _NAMED} more'
    return f'from position {names}{more}'


def _scatter_findings(found: Estimate, confounded: Sequence[str] = ()) -> list[str]:
    """Report scatter beyond the noise and beyond the files of table and IMU."""
    if found.scatter.probability < _SAID:
        return []
    return [
        *_positioning_findings(found, confounded),
        *_drift_findings(found),
        *_motion_findings(found.scatter),
    ]


def _positioning_findings(found: Estimate, confounded: Sequence[str]) -> list[str]:
    evidence, scatter = found.equations.evidence, found.scatter
    notes: list[Finding] = []
    small = evidence.positioning / ARCSEC
    stated = f'{significant(small, 3)} arcsec' if small else 'none'
    known = f"the table's description states {stated}"
    if evidence.table is not None and 'positioning' in evidence.table.not_stated:
        known = f'{stated} are assumed of the table'
    joints, stops = scatter.positioning.joints, scatter.positioning.stops
    if scatter.positioning_probability < SHOWN:
        # The deviations allow for it by its probability; it is not what happened.
        joints = stops = 0.0
    if evidence.plan.by_hand and (lean := float(np.hypot(joints, stops))):
        notes.append(
            Finding(
                f'The holds lean by {lean / DEG:.2g} deg against the plan: the standard deviations '
                'allow for it, and for as much in the turns. Hold the unit, or a box around it, '
                'against something level; free positions need no level holds.',
                ErrorSource.POSITIONING_FOUND,
                ErrorSource.STOPS,
            )
        )
    elif joints > _SIGNIFICANT * evidence.positioning:
        step, hidden = evidence.encoder_step, ''
        if joints <= step:
            degrees = f'{step / DEG:.2g} deg'
            hidden = f', with angles in steps of {degrees},'
        notes.append(
            Finding(
                f'The residuals scatter by positioning errors of {significant(joints / ARCSEC)} '
                f'arcsec that the encoders{hidden} do not show ({known}): the standard deviations '
                'allow for them.',
                ErrorSource.POSITIONING_FOUND,
            )
        )
    if stops > _SIGNIFICANT * max(joints, evidence.positioning) and not evidence.plan.by_hand:
        notes.append(
            Finding(
                'The residuals show that the whole table stops with attitude errors of '
                f'{significant(stops / ARCSEC)} arcsec, different at each stop: the standard '
                'deviations allow for them.',
                ErrorSource.STOPS,
            )
        )
    if notes and confounded:
        notes[-1] = notes[-1].followed_by(
            f'With so few positions they cannot be told from {" and ".join(confounded)}: run the '
            'same positions again; residuals that repeat come from the axes and encoders of the '
            'table, others from how it stops.'
        )
    return [*notes]


def _drift_findings(found: Estimate) -> list[str]:
    """Report bias drift and fast scatter beyond the bias instability that the IMU's file states."""
    evidence, scatter = found.equations.evidence, found.scatter
    notes: list[str] = []
    for name, first, unit, symbol in (
        ('gyros', 0, DEG_H, 'deg/h'),
        ('accelerometers', 3, MICRO_G, 'ug'),
    ):
        drift, stated_of = scatter.bias_drift[first], evidence.instability[first]
        likely = scatter.drift_probability[first // 3] > _LIKELY
        if likely and drift > (1 + _SIGNIFICANT) * stated_of:
            stated = f'{significant(stated_of / unit, 3)} {symbol}' if stated_of else 'none'
            if scatter.fast_drift[first // 3]:
                notes.append(
                    Finding(
                        f'The {name} scatter from dwell to dwell by {significant(drift / unit)} '
                        f'{symbol}, more than their noise and the drift of their biases (stated: '
                        f'{stated}): the standard deviations allow for it. Possible causes: a '
                        'floor that shakes, and small errors that depend on the attitude '
                        f'({_OF_ATTITUDE[name]}).',
                        ErrorSource.BIAS_FOUND,
                    )
                )
                continue
            notes.append(
                Finding(
                    f'The biases of the {name} drift by {significant(drift / unit)} {symbol} (the '
                    f'description of the IMU states {stated}): the standard deviations allow for '
                    'it.',
                    ErrorSource.BIAS_FOUND,
                )
            )
    return notes


def _motion_findings(scatter: ExcessScatter) -> list[str]:
    """Report angles and velocities that scatter at the ends of motions, and not at rest."""
    *turned, pushed = scatter.in_motion
    sizes = (
        *(
            f'the angle of gyro {axis} scatters by {significant(size / ARCSEC)} arcsec'
            for axis, size in zip('xyz', turned, strict=True)
        ),
        f'the velocities of the accelerometers scatter by {significant(pushed)} m/s',
    )
    shown = [s for s, p in zip(sizes, scatter.motion_probability, strict=True) if p >= _LIKELY]
    if not shown:
        return []
    return [
        f'At the ends of motions {" and ".join(shown)} more than the noise at rest: the standard '
        'deviations allow for it. Possible causes: motors or bearings that shake the unit, and '
        'sensors that are nonlinear in motion or beyond their range.'
    ]


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
        evidence = with_least_errors(evidence)
        search = search_terms(evidence, parameters_of(terms), changes, find_terms=find_terms)
    return concluded(search, terms, changes)


def concluded(
    search: SearchResult, terms: tuple[Term, ...], changes: tuple[Change, ...]
) -> Solution:
    """Check the result, and report the terms that were requested."""
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
    """Solve a session in progress as `solve` does, without testing terms that are off."""
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
            *clock_finding(evidence, _best_scale_factor(found)),
            *encoder_finding(evidence),
        ),
        found.scatter.bias_drift,
        equations.parameters,
        changes=_changes(found),
    )


def _best_scale_factor(found: Estimate) -> float:
    """Return the least standard deviation of the scale factors of the gyros."""
    own = [
        k
        for k, one in enumerate(found.equations.parameters)
        if one.triad == 'g' and one.kind is ParameterKind.SCALE_FACTOR_ERROR
    ]
    return float(np.sqrt(np.diag(found.covariance)[own]).min(initial=math.inf))


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
    equations, rest = found.equations, found.equations.layout.dwell
    residuals = (equations.outputs - equations.predict(found.state))[rest]
    std = np.linalg.norm(equations.factor(found.state), axis=1)[rest]
    return Residual.of_each(equations.evidence, residuals, std)


def observed_earth_rate(found: Estimate) -> tuple[Floats, Floats]:
    """Return the Earth rate (3,) by the gyros, free in size and direction, and its covariance.

    It is level, but at the heading of the attitudes, rad/s: the tilts found are removed, and the
    covariance includes their uncertainty. Only the noise is used, or the residuals it leaves if
    larger: scatter by a wrong latitude must not hide it.
    """
    return _free_earth(found.without_scatter, found.state)


def _with_scatter_at_any_latitude(found: Estimate) -> Equations:
    """Return the equations with the scatter that no latitude explains.

    Cheap gyros of no stated drift may drift by as much as the Earth rate: by noise alone they
    contradict every latitude. With a free latitude the session shows their drift, and a wrong
    latitude is not mistaken for drift.
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
    free = whiten(plain.factor(state), by_rate)
    jacobian, residuals = plain.whitened(state)
    # The heading is one of the three components that are now free.
    jacobian = np.delete(jacobian, sensors + Nuisance.AZIMUTH, axis=1)
    columns = np.hstack([jacobian, np.vstack([free, np.zeros((plain.nuisances, 3))])])
    seen = LeastSquares.solve(columns, residuals, float(np.finfo(float).eps))
    covariance = seen.covariance[-3:, -3:] * max(1.0, seen.square / max(1, seen.freedom))
    around = plain.surroundings(state)
    # The tilts' own columns turn the rate along with gravity: the free rate is added.
    return around.level @ (around.rate + seen.step[-3:]), around.level @ covariance @ around.level.T


_ONE_IN = 1e-3  #: Share of sessions in which the two contradict each other by chance. A choice.


@dataclass(frozen=True, eq=False)
class Comparison:
    """Result of the closed form for the parameters of the joint estimate."""

    method: str  #: Name of the closed form.
    parameters: tuple[Parameter, ...]  #: Estimated by both.
    #: (n,) closed form less joint, in units of the larger of the two standard deviations. The
    #: difference of an estimate from the best one has a smaller deviation than the estimate itself
    #: (Hausman 1978, Econometrica 46, 1251).
    difference: Floats
    ratio: Floats  #: (n,) standard deviation of the joint estimate over that of the closed form.
    refusal: str = ''  #: Why the closed form has no result, else empty; nothing is compared then.

    @classmethod
    def between(cls, joint: Solution, closed: Solution, method: str) -> Comparison:
        """Compare the parameters estimated by both."""
        parameters = tuple(p for p in joint.parameters if p in closed.parameters)
        values = [s.model.values(parameters) for s in (joint, closed)]
        deviations = [s.std[indices_of(parameters, s.parameters)] for s in (joint, closed)]
        larger = np.maximum(deviations[0], deviations[1])
        off = values[1] - values[0]
        # Without noise both deviations are zero, and the difference is rounding.
        difference = np.divide(off, larger, out=np.zeros_like(off), where=larger > 0)
        ratio = np.divide(
            deviations[0], deviations[1], out=np.ones_like(off), where=deviations[1] > 0
        )
        return cls(method, parameters, difference, ratio)

    @classmethod
    def refused(cls, method: str, refusal: str) -> Comparison:
        """Note that the closed form has no result."""
        return cls(method, (), np.empty(0), np.empty(0), refusal)

    @property
    def furthest(self) -> tuple[str, float]:
        """Return the parameter that differs most, and by how many standard deviations."""
        k = int(np.argmax(np.abs(self.difference)))
        return self.parameters[k].name, float(np.abs(self.difference[k]))

    @property
    def tighter(self) -> float:
        """Share by which the joint estimate's deviations are smaller, in the geometric mean."""
        return 1 - float(np.exp(np.mean(np.log(self.ratio))))

    @property
    def disagrees(self) -> bool:
        """Whether any parameter differs by more than by chance in one of a thousand sessions."""
        return not self.refusal and self.furthest[1] > self._limit

    @property
    def _limit(self) -> float:
        """Standard deviations by which one of the parameters differs by chance in `_ONE_IN`."""
        return float(-scipy.special.ndtri(_ONE_IN / 2 / len(self.parameters)))

    def finding(self) -> list[str]:
        """Report a contradiction between the two, if any."""
        if not self.disagrees:
            return []
        names = ', '.join(
            f'{p.name} ({off:+.1f})'
            for p, off in zip(self.parameters, self.difference, strict=True)
            if abs(off) > self._limit
        )
        return [
            Finding(
                f'The closed form {self.method} differs from the joint estimate by more than their '
                f'standard deviations allow: {names}. The closed form ignores tilts, errors of the '
                'table and outliers, and gives short and long segments the same weight.',
                effect=self.furthest[1],
            )
        ]

    def document(self) -> dict[str, object]:
        """Return its entries in calibration.yaml."""
        if self.refusal:
            return {'method': self.method, 'refusal': self.refusal}
        pairs = zip(self.parameters, self.difference, strict=True)
        return {
            'method': self.method,
            'joint_std_over_closed_form': 1 - self.tighter,
            'difference_in_std': {p.name: round(float(off), 3) for p, off in pairs},
        }
