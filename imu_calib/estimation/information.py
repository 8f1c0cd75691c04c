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

from ..common.stream import Floats
from ..common.units import counted
from ..model.parameters import AXES, PARAMETERS, Parameter, ParameterKind
from ..model.terms import Term
from .equations import Equations
from .evidence import Evidence

_SINGULAR = 1e-10
"""Of the largest singular value, columns of norm one: 64-bit numbers leave 1e-14 where it is zero,
and a session without noise that depends on the levelling of the table has 3e-10."""

_MIXED = 1e-4
"""Length of the part of a parameter, a column of norm one, in undetermined directions: rounding of
1e-14 turns those just above the limit (`_SINGULAR`) by as much."""
_MEANINGLESS = {ParameterKind.SCALE_FACTOR_ERROR: 0.01, ParameterKind.MISALIGNMENT: 0.01}
"""Standard deviations, of ratios and in rad, from which on a parameter without a largest plausible
value is not useful. A judgement: data sheets know them better."""

_USEFUL = 0.02
"""Share of the largest plausible coefficient of a term: for ratios it leaves 0.1 %."""

ALONG = 0.5
"""Component of a unit vector from which on it is along an axis: below 1 / sqrt(3) = 0.577, so that
any direction is along at least one."""
_SMALL_COMPONENT = 1e-3
"""Component of a unit vector below which it counts as zero: 3.4 arcmin, above the errors of
encoders and axes, far below any angle of a plan."""


@dataclass(frozen=True, eq=False)
class Information:
    """The information in the equations of a session.

    Attributes:
        covariance: (n, n) of the whole state; rows of unobserved entries are NaN.
        observed: (n,) whether an entry of the state is observed.
        condition: Largest over smallest singular value of the column-scaled system.
        gain: (n, m) derivatives of the solution by the equations; its square is the covariance.
    """

    covariance: Floats
    observed: NDArray[np.bool_]
    condition: float
    gain: Floats

    @classmethod
    def of(cls, jacobian: Floats) -> Information:
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

    Args:
        information: (n, n) of the whole state.
        first: Number of entries wanted.
    """
    scale = 1 / np.sqrt(np.maximum(np.diag(information), np.finfo(float).tiny))
    scaled = information * np.outer(scale, scale)
    whole, others = np.linalg.slogdet(scaled), np.linalg.slogdet(scaled[first:, first:])
    if whole[0] <= 0 or others[0] <= 0:
        return -np.inf
    return float(whole[1] - others[1] - 2 * np.log(scale[:first]).sum())


def attainable_std(evidence: Evidence, parameters: tuple[Parameter, ...] = PARAMETERS) -> Floats:
    """Return the standard deviations that a session gives so far.

    Args:
        evidence: Any subset of a session's static dwells and turns, or none.
        parameters: The parameters to be estimated.

    Returns:
        (n,) SI units; NaN where a parameter is not observed, or not determined (`determined`).
    """
    try:
        information = nominal_information(Equations(evidence, parameters))
    except np.linalg.LinAlgError:
        return np.full(len(parameters), np.nan)
    deviations = _standard_deviations(information, parameters)
    return np.where(determined(information, parameters), deviations, np.nan)


def nominal_information(equations: Equations) -> Information:
    """Return the information of a session on ideal sensors, at its nominal attitudes.

    The last digits of an encoder tilt a level axis without separating any parameters: these would
    seem observed, with absurd deviations, and affect others.
    """
    ideal = replace(equations, evidence=with_nominal_attitudes(equations.evidence))
    found = Information.of(ideal.whitened(ideal.nominal())[0])
    if found.observed.all() or not len(ideal.evidence.used_moves):
        return found
    # Without noise moves are a million times as accurate as the levelling of the table: parameters
    # that depend on that are lost to rounding, though more evidence has no less information.
    ideal = replace(ideal, evidence=replace(ideal.evidence, moves=()))
    resting = Information.of(ideal.whitened(ideal.nominal())[0])
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
    deviations = _standard_deviations(information, parameters)
    limits = np.array([useful_limit(p) for p in parameters])
    with np.errstate(invalid='ignore'):
        return np.asarray(np.isfinite(deviations) & ~(deviations > limits))


def useful_limit(parameter: Parameter) -> float:
    """Return the largest standard deviation, SI, of a parameter that counts as determined."""
    if parameter.kind is ParameterKind.BIAS:
        return np.inf
    limit = parameter.unit.limit
    return _MEANINGLESS[parameter.kind] if limit is None else _USEFUL * limit


def _standard_deviations(information: Information, parameters: tuple[Parameter, ...]) -> Floats:
    """Return the standard deviations of the first entries of a state, (n,); NaN if unobserved."""
    return np.asarray(np.sqrt(np.diag(information.covariance)[: len(parameters)]))


def undetermined_in_words(evidence: Evidence, term: Term, lost: Sequence[Parameter]) -> str:
    """Return a sentence that a session does not determine a term, and what would.

    Args:
        evidence: The session, which determines the 24 parameters without the term.
        term: The term.
        lost: All parameters that it does not determine with the term.
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
    """Return a sentence on the parameters a session cannot observe, and what is missing.

    Args:
        evidence: The session.
        lost: (24,) mask of these parameters.
    """
    words = []
    unnamed = {p.name for p, gone in zip(PARAMETERS, lost, strict=True) if gone}
    turned = [np.abs(turn.up) for turn in evidence.turns]
    stood = [np.abs(attitude[2]) for attitude in evidence.attitudes()]
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
