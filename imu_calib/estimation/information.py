"""Information of a session, whole or partial, on the parameters, before the estimate.

The Fisher information of the equations (docs/mathematics.md, 'Joint estimate') and its null space:
the singular vectors of the column-scaled system show which parameters cannot be separated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from ..common.rotations import rotation
from ..common.stream import Floats
from ..common.units import counted
from ..model.parameters import AXES, PARAMETERS, Parameter, ParameterKind
from ..model.terms import Term
from ..segmentation.labelling import attitude_words, up_words
from ..segmentation.segments import Segment, Turn
from ..session.table import TURN
from .equations import Equations
from .evidence import UP, Evidence

_SINGULAR = 1e-10
"""Of the largest singular value, columns of norm one: 64-bit numbers leave 1e-14 where it is zero,
and a session without noise that depends on the levelling of the table has 3e-10."""

_MIXED = 1e-4
"""Length of the part of a parameter, a column of norm one, in undetermined directions: rounding of
1e-14 turns those just above the limit (`_SINGULAR`) by as much."""
_MEANINGLESS = {ParameterKind.SCALE_FACTOR_ERROR: 0.01, ParameterKind.MISALIGNMENT: 0.01}
"""Standard deviations, of ratios and in rad, from which on a parameter without a largest plausible
value is not useful. A judgement: data sheets know them better."""

_USEFUL = 0.02  #: Share of the largest plausible coefficient of a term: for ratios it leaves 0.1 %.

ALONG = 0.5
"""Component of a unit vector from which on it is along an axis: below 1 / sqrt(3) = 0.577, so that
any direction is along at least one."""
_SMALL_COMPONENT = 1e-3
"""Component of a unit vector below which it counts as zero: 3.4 arcmin, above the errors of
encoders and axes, far below any angle of a plan."""


@dataclass(frozen=True, eq=False)
class Information:
    """The information in the equations of a session."""

    covariance: Floats  #: (n, n) of the whole state; rows of unobserved entries are NaN.
    observed: NDArray[np.bool_]  #: (n,) whether an entry of the state is observed.
    condition: float  #: Largest over smallest singular value of the column-scaled system.
    #: (n, m) derivatives of the solution by the equations; its square is the covariance.
    gain: Floats

    @property
    def std(self) -> Floats:
        """(n,) standard deviations of the state; NaN where unobserved."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @classmethod
    def from_jacobian(cls, jacobian: Floats) -> Information:
        """Invert the information of whitened equations on its observable subspace.

        Args:
            jacobian: (m, n) derivatives in standard deviations, priors included.
        """
        norms = np.linalg.norm(jacobian, axis=0)
        seen = norms > 0
        scale = np.where(seen, norms, 1.0)
        rows = jacobian / scale
        # Rows of zeros let the SVD return the null space of too few equations.
        rows = np.vstack([rows, np.zeros((max(0, len(norms) - len(rows)), len(norms)))])
        unnamed, values, vectors = np.linalg.svd(rows, full_matrices=False)
        sound = values > _SINGULAR * values[0]
        mixed = np.linalg.norm(vectors[~sound], axis=0) > _MIXED
        observed = seen & ~mixed
        kept = vectors[sound] / values[sound, None]
        covariance = (kept.T @ kept) / np.outer(scale, scale)
        gain = (kept.T @ unnamed[: len(jacobian), sound].T) / scale[:, None]
        covariance[~observed, :] = np.nan
        covariance[:, ~observed] = np.nan
        smallest = float(values.min())
        condition = float(values[0]) / smallest if smallest > 0 else float('inf')
        return cls(covariance, observed, condition, gain)


def log_determinant(information: Floats, first: int) -> float:
    """Return the log determinant of the information on the first entries of a state.

    The other entries are nuisance parameters, which are eliminated. Columns are scaled to length
    one first: rad/s and m/s^2 differ by orders of magnitude.
    """
    scale = 1 / np.sqrt(np.maximum(np.diag(information), np.finfo(float).tiny))
    scaled = information * np.outer(scale, scale)
    whole, others = np.linalg.slogdet(scaled), np.linalg.slogdet(scaled[first:, first:])
    if whole[0] <= 0 or others[0] <= 0:
        return -np.inf
    return float(whole[1] - others[1] - 2 * np.log(scale[:first]).sum())


def attainable_std(evidence: Evidence, parameters: tuple[Parameter, ...] = PARAMETERS) -> Floats:
    """Return the standard deviations (n,) that a session, whole or partial, gives so far.

    NaN where a parameter is not observed, or not determined (`determined`).
    """
    try:
        information = nominal_information(Equations(evidence, parameters))
    except np.linalg.LinAlgError:
        return np.full(len(parameters), np.nan)
    known = determined(information, parameters)
    return np.where(known, information.std[: len(parameters)], np.nan)


def nominal_information(equations: Equations) -> Information:
    """Return the information of a session on ideal sensors, at its nominal attitudes.

    An encoder's last digits tilt level axes and separate nothing: parameters would seem observed,
    with absurd deviations, and affect others.
    """
    ideal = replace(equations, evidence=with_nominal_attitudes(equations.evidence))
    found = Information.from_jacobian(ideal.whitened(ideal.nominal())[0])
    if found.observed.all() or not len(ideal.evidence.used_moves):
        return found
    # Without noise moves are a million times as accurate as the levelling of the table: parameters
    # that depend on that are lost to rounding, though more evidence has no less information.
    ideal = replace(ideal, evidence=replace(ideal.evidence, moves=()))
    resting = Information.from_jacobian(ideal.whitened(ideal.nominal())[0])
    return resting if resting.observed.sum() > found.observed.sum() else found


def with_nominal_attitudes(evidence: Evidence) -> Evidence:
    """Return the evidence at nominal attitudes: without an encoder's last digits.

    It is created once, with its cached results.
    """
    if 'nominal' not in evidence.cache:
        segments = tuple(
            s if s.attitude is None else replace(s, attitude=_without_small_components(s.attitude))
            for s in evidence.segments
        )
        turns = tuple(replace(t, up=_without_small_components(t.up)) for t in evidence.turns)
        evidence.cache['nominal'] = replace(evidence, segments=segments, turns=turns)
    return cast(Evidence, evidence.cache['nominal'])


def _without_small_components(directions: Floats) -> Floats:
    """Return unit vectors with components below `_SMALL_COMPONENT` set to zero."""
    return np.where(np.abs(directions) < _SMALL_COMPONENT, 0.0, directions)


def determined(
    information: Information, parameters: tuple[Parameter, ...] = PARAMETERS
) -> NDArray[np.bool_]:
    """Return the mask of parameters whose standard deviation is below the useful limit.

    The limit is a tenth for scale factors and misalignments, and a fiftieth of the largest
    plausible value for the coefficients of terms.
    """
    deviations = information.std[: len(parameters)]
    limits = np.array([useful_limit(p) for p in parameters])
    with np.errstate(invalid='ignore'):
        return np.asarray(np.isfinite(deviations) & ~(deviations > limits))


def useful_limit(parameter: Parameter) -> float:
    """Return the largest standard deviation, SI, of a parameter that counts as determined."""
    if parameter.kind is ParameterKind.BIAS:
        return np.inf
    limit = parameter.unit.limit
    return _MEANINGLESS[parameter.kind] if limit is None else _USEFUL * limit


def undetermined_in_words(evidence: Evidence, term: Term, lost: Sequence[Parameter]) -> str:
    """Return a sentence that a session does not determine a term, and what would.

    `lost` are the parameters that only the term makes undetermined.
    """
    mine = [p.name for p in lost if p in term.parameters]
    others = [p.name for p in lost if p not in term.parameters]
    apart = f' apart from {", ".join(others)}' if others else ''
    return (
        f'{segments_in_words(evidence)} do not determine {term.name} ({", ".join(mine)}){apart}: '
        f'not observable. To determine it takes {term.needs}; or leave it out (`terms`).'
    )


def segments_in_words(evidence: Evidence) -> str:
    """Return the numbers of static dwells and turns in words."""
    dwells = counted(len(evidence.segments), 'static dwell')
    return f'{dwells} and {counted(len(evidence.turns), "turn")}'


def unobservable_in_words(evidence: Evidence, lost: NDArray[np.bool_]) -> str:
    """Return a sentence on parameters (24,) that a session cannot observe, and why."""
    words = []
    unnamed = {p.name for p, gone in zip(PARAMETERS, lost, strict=True) if gone}
    turned = [np.abs(turn.up) for turn in evidence.turns]
    stood = [np.abs(attitude[2]) for attitude in evidence.dwell_attitudes]
    place = 'position' if evidence.plan.is_stated else 'static dwell'
    about = 'no position turns {}' if evidence.plan.is_stated else 'no turn is about {}'
    reasons = (('g', turned, about), ('a', stood, f'no {place} has {{}} vertical'))
    for triad, seen, reason in reasons:
        for column, axis in enumerate(AXES):
            names = [
                p.name
                for p in PARAMETERS
                if p.triad == triad and p.column == column and p.name in unnamed
            ]
            if names and not any(up[column] > ALONG for up in seen):
                words.append(f'{reason.format(axis.upper())}: {", ".join(names)} not observable')
                unnamed -= set(names)
    rest = [p.name for p in PARAMETERS if p.name in unnamed]
    if rest:
        words.append(
            f'{segments_in_words(evidence)} do not determine {", ".join(rest)}: not observable'
        )
    missing = evidence.missing_positions()
    tail = f' (missing: position {", ".join(missing)})' if missing else ''
    text = '; '.join(words)
    return f'{text[:1].upper()}{text[1:]}{tail}.'


# Observability depends on the attitudes and axes of a session, not on the plan's description of
# positions: one more dwell or turn of each kind is tried in the equations of the session itself.

_RATE = TURN / 36  #: Rate of a tried turn, rad/s: ten degrees a second, as rate tests begin with.

_MOST = 9
"""Most dwells and turns that are proposed: six attitudes, up and down, and a turn about each axis
determine the 24 parameters of any unit."""

_UNSEEN = 1e-6
"""Information of an unobserved direction, where directions are compared by logarithms. A judgement:
a finite number for none."""

Addition = tuple[str, Segment | Turn]


def undetermined_parameters(equations: Equations) -> NDArray[np.bool_]:
    """Return which of the 24 parameters, those of the equations, a session does not determine."""
    return ~determined(nominal_information(equations)) | without_turns(equations.evidence)


def without_turns(evidence: Evidence) -> NDArray[np.bool_]:
    """Return which of the 24 parameters are responses of gyros without a rate test.

    The Earth's rate alone determines them to a percent, which a rate test is meant to improve. A
    plan states its axes; without a plan all three responses are required. Directions with nearly no
    turns are the eigenvectors of the sum of u u^T over all turns, u their axes in the body.
    """
    axes = np.array([turn.up for turn in evidence.turns]).reshape(-1, 3)
    if evidence.plan.is_stated:
        tests = [np.abs(p.up) for p in evidence.plan.positions if p.rate_test is not None]
        wanted = np.any(np.array(tests).reshape(-1, 3) > ALONG, axis=0)
        open_axes = wanted & ~np.any(np.abs(axes) > ALONG, axis=0)
    else:
        squares, directions = np.linalg.eigh(axes.T @ axes)
        unturned = directions[:, squares < ALONG**2]
        open_axes = np.linalg.norm(unturned, axis=1) > ALONG
    return np.array(
        [p.triad == 'g' and p.column is not None and open_axes[p.column] for p in PARAMETERS]
    )


def advice(equations: Equations) -> str:
    """Return which dwells and turns would determine the missing parameters; empty if none.

    The next one is always that which leaves the fewest parameters undetermined and, among those,
    gives most information on all others. Those that help only in combination are reported together.
    """
    if not equations.evidence.segments:
        return ''
    additions = _additions(equations.evidence)
    everything = equations
    for _, segment in additions:
        everything = _extended(everything, segment)
    columns = everything.whitened(everything.nominal())[0][:, : equations.sensors]
    scale = np.linalg.norm(columns, axis=0)
    scale[scale == 0] = 1.0
    pending: list[str] = []
    requirements: list[str] = []
    open_now = undetermined_parameters(equations)
    for _ in range(_MOST):
        tried = [(_extended(equations, segment), words) for words, segment in additions]
        scores = [
            (int(undetermined_parameters(t).sum()), -_log_information(t, scale)) for t, _ in tried
        ]
        best = min(range(len(scores)), key=lambda k: scores[k])
        equations, words = tried[best]
        pending.append(words)
        still_open = undetermined_parameters(equations)
        determined = [
            p.name
            for p, was, is_open in zip(PARAMETERS, open_now, still_open, strict=True)
            if was and not is_open
        ]
        if determined:
            requirements.append(f'{" and ".join(pending)} ({", ".join(determined)})')
            pending, open_now = [], still_open
        if not open_now.any():
            break
    return f'It would take {"; ".join(requirements)}.' if requirements else ''


def _additions(evidence: Evidence) -> list[Addition]:
    """List dwells with each axis up and down at four headings, and turns about each axis.

    They last as long as the session's own dwells.
    """
    durations = [s.statistics.duration for s in evidence.segments]
    like = evidence.segments[int(np.argsort(durations)[len(durations) // 2])]
    found: list[Addition] = []
    for up in (*np.eye(3), *-np.eye(3)):
        for quarter in range(4):
            attitude = _upright(up, quarter)
            rest = replace(like, attitude=attitude, attitude_error=0.0)
            found.append((f'a static dwell with {attitude_words(attitude)}', rest))
    seconds = like.statistics.duration
    for axis in np.eye(3):
        # Tables do not need it: static dwells measure gravity better than turns do.
        turn = Turn(like.start, like.end, like.statistics, _RATE * seconds, None, axis)
        found.append((f'whole turns at a steady rate with {up_words(axis)}', turn))
    return found


def _upright(up: Floats, quarter: int) -> Floats:
    """Return an attitude (3, 3) with a body axis up, turned by quarters about the vertical."""
    side = np.roll(np.abs(up), 1)
    body = np.array([side, np.cross(up, side), up])
    return np.asarray(rotation(UP, quarter * TURN / 4) @ body)


def _extended(equations: Equations, segment: Segment | Turn) -> Equations:
    """Return the equations of a session with one more dwell or turn."""
    evidence = equations.evidence
    if isinstance(segment, Segment):
        more = replace(evidence, segments=(*evidence.segments, segment))
    else:
        more = replace(evidence, turns=(*evidence.turns, segment))
    return replace(equations, evidence=more)


def _log_information(equations: Equations, scale: Floats) -> float:
    """Return the logarithm of a session's information on the sensors' parameters.

    The scale (n,) of each parameter removes the units.
    """
    jacobian = equations.whitened(equations.nominal())[0]
    sensors, others = np.split(jacobian, [equations.sensors], axis=1)
    norms = np.linalg.norm(others, axis=0)
    others = others[:, norms > 0] / norms[norms > 0]
    alone = sensors - others @ np.linalg.lstsq(others, sensors, rcond=None)[0]
    values = np.linalg.svd(alone / scale, compute_uv=False)
    return float(np.log(values + _UNSEEN).sum())
