"""Guide a user with the unit in hand: what to do next, and the gain of each further hold.

The gain is that of D-optimal design (Fedorov 1972, section 2.5): half the increase of the logarithm
of the determinant of the information on the 21 parameters. On average over the parameters, a gain
of 21 ln(2) halves every standard deviation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from itertools import product

import numpy as np

from ..common.stream import Floats
from ..common.units import ARCMIN, DEG, PPM
from ..estimation.evidence import Evidence
from ..estimation.free_dwells import FreeEquations
from ..estimation.hand import ESTIMATES, FEWEST, FREE, initial_equations
from ..estimation.information import Information, log_determinant
from ..estimation.predict import ideal_move_by_hand, next_hold
from ..model.parameters import AXES, PARAMETERS, ParameterKind
from ..segmentation.segments import Segment

_SCALE_WIDTH = 0.1
"""Prior standard deviation of ratios for an unknown unit. A choice: three times the scale factor
error of the cheapest (MPU-9150: 3 %). With the next two it orders candidates; no result depends on
it."""
_GYRO_BIAS_WIDTH = 1.0 * DEG
"""rad/s, likewise. A choice, between good MEMS gyros and the cheapest."""
_ACCEL_BIAS_WIDTH = 0.5
"""m/s^2, likewise. A choice: 50 mg, a third of what the cheapest state (MPU-9150: 150 mg)."""
_DETERMINED = 0.5
"""Ratio of std to prior std below which a session has determined a parameter. A choice: it then
holds three times the information of the prior."""

CHECKED = 2 * FEWEST
"""Fewest holds that are enough: twice the number that determines the parameters, so that a false
hold or excess noise is detected."""

HOLD_SECONDS = 3.0
"""Duration of a hold, s. A choice: a second more than the shortest hold accepted (`stillness`)."""

_SCALE_TARGET, _ANGLE_TARGET = 300 * PPM, 1 * ARCMIN
"""Standard deviations of scale factors and of misalignments, rad, that are enough: a choice."""


class Stage(Enum):
    """What to do now."""

    HOLD = 'hold still'
    TURN = 'turn to the next attitude'
    ENOUGH = 'enough'


@dataclass(frozen=True, eq=False)
class Candidate:
    """A possible next attitude: in words, up in body axes, its gain (nats)."""

    words: str
    up: Floats
    gain: float


@dataclass(frozen=True, eq=False)
class Guidance:
    """Guidance for the user.

    Attributes:
        stage: What to do now.
        text: The same in a sentence.
        holds: Holds that count so far.
        std: (24,) standard deviations reached, SI units; NaN where not determined yet.
        candidates: Attitudes to hold next, the best first.
    """

    stage: Stage
    text: str
    holds: int
    std: Floats
    candidates: tuple[Candidate, ...]


def guide(
    evidence: Evidence,
    *,
    holding: float | None = None,
    reached: Floats | None = None,
) -> Guidance:
    """Return what to do next.

    Args:
        evidence: The completed holds, and the turns between them.
        holding: Time at rest so far, s; None while it moves.
        reached: (21,) standard deviations of a solution, if there is one: these include excess
            scatter.
    """
    holds, std = len(evidence.segments), np.full(len(PARAMETERS), np.nan)
    if not holds:
        candidates = tuple(Candidate(w, u, 0.0) for w, u in _directions())
        return _guidance(holding, 0, std, candidates, enough=False)
    equations, values = initial_equations(evidence)
    base = equations.whitened(values)[0]
    base = np.vstack([np.eye(len(ESTIMATES), base.shape[1]) / _widths()[:, None], base])
    std[FREE] = _deviations(base) if reached is None else reached
    directions = _directions()
    gains = _gains(base, equations, values, [up for _, up in directions])
    found = [Candidate(*one, gain) for one, gain in zip(directions, gains, strict=True)]
    found.sort(key=lambda c: -c.gain)
    scale = np.array([p.kind is ParameterKind.SCALE_FACTOR_ERROR for p in PARAMETERS])
    angle = np.array([p.kind is ParameterKind.MISALIGNMENT for p in PARAMETERS])
    with np.errstate(invalid='ignore'):
        good = std <= np.where(scale, _SCALE_TARGET, np.where(angle, _ANGLE_TARGET, np.inf))
    enough = holds >= CHECKED and bool(good[FREE & (scale | angle)].all())
    return _guidance(holding, holds, std, tuple(found), enough=enough)


def _guidance(
    holding: float | None,
    holds: int,
    std: Floats,
    candidates: tuple[Candidate, ...],
    *,
    enough: bool,
) -> Guidance:
    best = candidates[0].words
    if holding is not None and holding < HOLD_SECONDS:
        stage, text = Stage.HOLD, f'Hold still: {HOLD_SECONDS - holding:.0f} s more.'
    elif enough:
        stage, text = Stage.ENOUGH, f'Enough: {holds} holds. Further ones still gain: {best}.'
    else:
        stage, text = Stage.TURN, f'{holds} holds so far. Turn to {best}, and hold still.'
    return Guidance(stage, text, holds, std, candidates)


def direction(words: str) -> Floats | None:
    """Return up (3,) in body axes for a candidate's words; None for other words."""
    return dict(_directions()).get(words)


def _directions() -> list[tuple[str, Floats]]:
    """List faces, edges and corners of a cube: a person finds these without an instrument."""
    found = []
    for signs in product((1, 0, -1), repeat=3):
        if any(signs):
            parts = [
                f'{axis.upper()} {"up" if s > 0 else "down"}'
                for axis, s in zip(AXES, signs, strict=True)
                if s
            ]
            words = parts[0] if len(parts) == 1 else 'half ' + ', half '.join(parts)
            found.append((words, np.array(signs) / np.linalg.norm(signs)))
    return sorted(found, key=lambda f: len(f[0]))


def _gains(
    base: Floats, equations: FreeEquations, values: Floats, ups: Sequence[Floats]
) -> list[float]:
    """Return the gain by a further hold with each of k (3,) `ups`, and the turn to it, (k,).

    Args:
        base: (m, n) rows of the session in standard deviations, priors included.
        equations: Of the session.
        values: (n,) its state.
        ups: In body axes, unit vectors.
    """
    # A further hold adds to the sensors and to the tilt of the last hold: the rest is eliminated.
    state = np.arange(equations.size)
    kept = np.append(state[: equations.sensors], state[equations.last_tilt_slice])
    others = np.setdiff1d(state, kept)
    triangle = np.asarray(np.linalg.qr(base[:, np.append(others, kept)], mode='r'))
    root = triangle[len(others) :, len(others) :]
    now = log_determinant(root.T @ root, equations.sensors)
    root = np.pad(root, ((0, 0), (0, 3)))
    extended = (np.vstack([root, rows]) for rows in _further(equations, values, ups))
    return [(log_determinant(rows.T @ rows, equations.sensors) - now) / 2 for rows in extended]


def _further(equations: FreeEquations, values: Floats, ups: Sequence[Floats]) -> Floats:
    """Return the rows that a further hold with each of k (3,) `ups` and the turn to it would add.

    (k, 9, p + 5) in standard deviations: derivatives by the sensors, by the tilt of the last hold
    and by the rotations of the further one. North is taken as known by then, and so is the heading
    of the last hold.
    """
    evidence, model = equations.evidence, equations.model(values)
    last = evidence.segments[-1]
    holds: list[Segment] = []
    moves = []
    for up in ups:
        further = next_hold(last, up, HOLD_SECONDS)
        moves.append(ideal_move_by_hand(last, further, model, evidence.site))
        holds += [last, further]
        # Stamps tell which holds a move links: one pair follows the other.
        later = further.end - last.start
        last = replace(last, start=last.start + later, end=last.end + later)
    evidence = replace(evidence, segments=tuple(holds), moves=tuple(moves))
    pairs = replace(equations, evidence=evidence)
    state = pairs.nominal()
    state[: pairs.sensors] = values[: pairs.sensors]
    rows = np.hstack([pairs.layout.dwell.reshape(len(ups), -1), pairs.layout.move])
    # Each pair has two tilts and three rotations: the heading of its first hold is a choice.
    rotations = np.arange(pairs.north_slice.stop, pairs.size).reshape(len(ups), -1)
    sensors = np.tile(np.arange(pairs.sensors), (len(ups), 1))
    columns = np.hstack([sensors, rotations])
    jacobian = pairs.jacobian(state)[rows[:, :, None], columns[:, None]]
    root = np.linalg.cholesky(pairs.covariance(state)[rows[:, :, None], rows[:, None]])
    return np.asarray(np.linalg.solve(root, jacobian)[:, 6:])


def _widths() -> Floats:
    """Return prior standard deviations for an unknown unit, (21,)."""
    biases = {'g': _GYRO_BIAS_WIDTH, 'a': _ACCEL_BIAS_WIDTH}
    return np.array(
        [biases[p.triad] if p.kind is ParameterKind.BIAS else _SCALE_WIDTH for p in ESTIMATES]
    )


def _deviations(rows: Floats) -> Floats:
    std = np.sqrt(np.diag(Information.of(rows).covariance)[: len(ESTIMATES)])
    return np.where(std < _DETERMINED * _widths(), std, np.nan)
