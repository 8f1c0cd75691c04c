"""Parameters that a session does not determine, and the dwells and turns that would do so.

Observability depends on the attitudes and axes of a session, not on the plan's description of
positions: one more dwell or turn of each kind is tried in the equations of the session itself.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..common.rotations import rotation
from ..common.stream import Floats
from ..model.parameters import PARAMETERS
from ..segmentation.labelling import attitude_words, up_words
from ..segmentation.segments import Segment, Turn
from ..session.table import TURN
from .equations import Equations
from .evidence import UP, Evidence
from .information import ALONG, determined, nominal_information

_RATE = TURN / 36
"""Rate of a tried turn, rad/s: ten degrees a second, as rate tests begin with."""

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

    Args:
        equations: The session.
        scale: (n,) scale of each parameter, to remove the units.
    """
    jacobian = equations.whitened(equations.nominal())[0]
    sensors, others = np.split(jacobian, [equations.sensors], axis=1)
    norms = np.linalg.norm(others, axis=0)
    others = others[:, norms > 0] / norms[norms > 0]
    alone = sensors - others @ np.linalg.lstsq(others, sensors, rcond=None)[0]
    values = np.linalg.svd(alone / scale, compute_uv=False)
    return float(np.log(values + _UNSEEN).sum())
