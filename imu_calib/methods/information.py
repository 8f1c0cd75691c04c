"""What a session, whole or partial, tells about the parameters before anything is solved.

The Fisher information of the equations (methods.md, section 11) and its null space: what the
singular vectors of the column-scaled system say cannot be told apart.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..model import AXES, PARAMETER_NAMES, PARAMETERS, ParameterKind
from ..stream import Floats
from .equations import SENSORS, Equations
from .evidence import Evidence

_SINGULAR = 1e-7
_MIXED = 1e-4
_MEANINGLESS = 0.1
ALONG = 0.5
_STRAY = 1e-3


@dataclass(frozen=True, eq=False)
class Information:
    """What the equations of a session determine.

    Attributes:
        covariance: (n, n) of the whole state; rows of what is not observed are NaN.
        observed: (n,) whether an entry of the state is observed.
        condition: Largest over smallest singular value of the column-scaled system.

    """

    covariance: Floats
    observed: NDArray[np.bool_]
    condition: float

    @classmethod
    def of(cls, jacobian: Floats) -> Information:
        """Invert the information of whitened equations where it can be inverted.

        Args:
            jacobian: (m, n) derivatives in standard deviations, priors included.

        """
        norms = np.linalg.norm(jacobian, axis=0)
        seen = norms > 0
        scale = np.where(seen, norms, 1.0)
        rows = jacobian / scale
        # Rows of zeros make the null space of too few equations come out as vectors of its own.
        rows = np.vstack([rows, np.zeros((max(0, len(norms) - len(rows)), len(norms)))])
        _, values, vectors = np.linalg.svd(rows, full_matrices=False)
        sound = values > _SINGULAR * values[0]
        mixed = np.linalg.norm(vectors[~sound], axis=0) > _MIXED
        observed = seen & ~mixed
        kept = vectors[sound] / values[sound, None]
        covariance = (kept.T @ kept) / np.outer(scale, scale)
        covariance[~observed, :] = np.nan
        covariance[:, ~observed] = np.nan
        smallest = float(values.min())
        condition = float(values[0]) / smallest if smallest > 0 else float('inf')
        return cls(covariance, observed, condition)


def reached(evidence: Evidence) -> Floats:
    """Return the standard deviations that a session allows so far.

    Args:
        evidence: Any subset of a session's stretches and turns, none at all included.

    Returns:
        (24,) in the order of `model.PARAMETERS`, SI units; NaN where nothing determines a
        parameter, or where it is known no better than to a tenth (dimensionless ones).

    """
    try:
        information = before(Equations(evidence))
    except np.linalg.LinAlgError:
        return np.full(SENSORS, np.nan)
    return np.where(told(information), _deviations(information), np.nan)


def before(equations: Equations) -> Information:
    """Return what a session tells of ideal sensors, its attitudes taken as they are meant.

    What the last digits of an encoder add to an axis that stands level separates no parameters:
    they would seem observed, with deviations beyond all sense, and spoil others.
    """
    evidence = equations.evidence
    segments = tuple(
        s if s.attitude is None else replace(s, attitude=_without_strays(s.attitude))
        for s in evidence.segments
    )
    turns = tuple(replace(t, up=_without_strays(t.up)) for t in evidence.turns)
    meant = replace(equations, evidence=replace(evidence, segments=segments, turns=turns))
    return Information.of(meant.whitened(meant.nominal())[0])


def _without_strays(directions: Floats) -> Floats:
    return np.where(np.abs(directions) < _STRAY, 0.0, directions)


def told(information: Information) -> NDArray[np.bool_]:
    """Say of the 24 parameters whether they are observed to any use."""
    deviations = _deviations(information)
    ratio = np.array([p.kind is not ParameterKind.BIAS for p in PARAMETERS])
    with np.errstate(invalid='ignore'):
        return np.asarray(np.isfinite(deviations) & ~(ratio & (deviations > _MEANINGLESS)))


def _deviations(information: Information) -> Floats:
    return np.asarray(np.sqrt(np.diag(information.covariance)[:SENSORS]))


def unobserved(evidence: Evidence, lost: NDArray[np.bool_]) -> str:
    """Say in words what a session cannot observe, and for want of what.

    Args:
        evidence: The session.
        lost: (24,) which parameters.

    """
    words = []
    left = {name for name, gone in zip(PARAMETER_NAMES, lost, strict=True) if gone}
    turned = [np.abs(turn.up) for turn in evidence.turns]
    stood = [np.abs(attitude[2]) for attitude in evidence.attitudes()]
    reasons = (('g', turned, 'no position turns {}'), ('a', stood, 'no position has {} vertical'))
    for triad, seen, reason in reasons:
        for column, axis in enumerate(AXES):
            names = [
                p.name
                for p in PARAMETERS
                if p.triad == triad and p.column == column and p.name in left
            ]
            if names and not any(up[column] > ALONG for up in seen):
                words.append(f'{reason.format(axis.upper())}: {", ".join(names)} not observable')
                left -= set(names)
    rest = [name for name in PARAMETER_NAMES if name in left]
    if rest:
        found = f'{len(evidence.segments)} stretches at rest and {len(evidence.turns)} turns'
        words.append(f'{found} cannot tell {", ".join(rest)}: not observable')
    missing = evidence.missing()
    tail = f' (missing: position {", ".join(missing)})' if missing else ''
    text = '; '.join(words)
    return f'{text[:1].upper()}{text[1:]}{tail}.'
