"""What a person with the unit in hand should do next, and what each further hold would gain.

The gain is that of D-optimal design (Fedorov 1972, section 2.5): by how much the logarithm of the
determinant of the information on the 21 parameters grows, halved. In the mean over the parameters
a gain of 21 ln(2) halves every standard deviation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum
from itertools import product

import numpy as np

from ..methods.free_positions import ESTIMATES, FEWEST, FREE, initial_equations
from ..model import AXES, PARAMETERS, ParameterKind
from ..observation.evidence import Evidence
from ..observation.free import FreeEquations
from ..observation.ideal_moves import ideal_move_by_hand, next_hold
from ..observation.information import Information, log_determinant
from ..stream import Floats
from ..units import ARCMIN, DEG, PPM

_SCALE_WIDTH = 0.1
"""Of ratios, before anything is known of a unit."""
_GYRO_BIAS_WIDTH = 1.0 * DEG
"""rad/s, likewise."""
_ACCEL_BIAS_WIDTH = 0.5
"""m/s^2, likewise."""
_TOLD = 0.5
"""Share of what was known beforehand below which a session has determined it."""

CHECKED = 2 * FEWEST
"""Fewest holds that are enough: as many again as gravity has to tell, so that one that was no
hold, or noise that is more than it should be, shows."""

HOLD_SECONDS = 3.0
"""How long a hold is to last, s."""


class Stage(Enum):
    """What to do now."""

    HOLD = 'hold still'
    TURN = 'turn to the next attitude'
    ENOUGH = 'enough'


@dataclass(frozen=True)
class Wanted:
    """When it is enough: standard deviations of scale factors and of misalignments (rad)."""

    scale_factor: float = 300 * PPM
    angle: float = 1 * ARCMIN


@dataclass(frozen=True, eq=False)
class Candidate:
    """An attitude that may be held next: in words, up in body axes, what it gains (nats)."""

    words: str
    up: Floats
    gain: float


@dataclass(frozen=True, eq=False)
class Guidance:
    """What to tell the person.

    Attributes:
        stage: What to do now.
        text: The same in a sentence.
        holds: Holds that count so far.
        std: (24,) standard deviations reached, SI units; NaN where nothing tells yet.
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
    hold_seconds: float = HOLD_SECONDS,
    reached: Floats | None = None,
    wanted: Wanted | None = None,
) -> Guidance:
    """Say what to do next.

    Args:
        evidence: The holds that have come to their end, and the turns between them.
        holding: How long the unit has been still, s; None while it moves.
        hold_seconds: How long a hold is to last, s.
        reached: (21,) standard deviations that a solution states, where there is one: what
            scatters more than its noise counts then.
        wanted: When it is enough.
    """
    wanted = wanted or Wanted()
    holds, std = len(evidence.segments), np.full(len(PARAMETERS), np.nan)
    if not holds:
        candidates = tuple(Candidate(w, u, 0.0) for w, u in _directions())
        return _guidance(holding, hold_seconds, 0, std, candidates, enough=False)
    equations, values = initial_equations(evidence)
    base = equations.whitened(values)[0]
    base = np.vstack([np.eye(len(ESTIMATES), base.shape[1]) / _widths()[:, None], base])
    now = log_determinant(base.T @ base, len(ESTIMATES))
    std[FREE] = _deviations(base) if reached is None else reached
    found = []
    for words, up in _directions():
        further = _further(equations, values, up, hold_seconds)
        grown = np.vstack([np.pad(base, ((0, 0), (0, 3))), further])
        gain = (log_determinant(grown.T @ grown, len(ESTIMATES)) - now) / 2
        found.append(Candidate(words, up, gain))
    found.sort(key=lambda c: -c.gain)
    scale = np.array([p.kind is ParameterKind.SCALE_FACTOR_ERROR for p in PARAMETERS])
    angle = np.array([p.kind is ParameterKind.MISALIGNMENT for p in PARAMETERS])
    with np.errstate(invalid='ignore'):
        good = std <= np.where(scale, wanted.scale_factor, np.where(angle, wanted.angle, np.inf))
    enough = holds >= CHECKED and bool(good[FREE & (scale | angle)].all())
    return _guidance(holding, hold_seconds, holds, std, tuple(found), enough=enough)


def _guidance(
    holding: float | None,
    hold_seconds: float,
    holds: int,
    std: Floats,
    candidates: tuple[Candidate, ...],
    *,
    enough: bool,
) -> Guidance:
    best = candidates[0].words
    if holding is not None and holding < hold_seconds:
        stage, text = Stage.HOLD, f'Hold still: {hold_seconds - holding:.0f} s more.'
    elif enough:
        stage, text = Stage.ENOUGH, f'Enough: {holds} holds. Further ones still gain: {best}.'
    else:
        stage, text = Stage.TURN, f'{holds} holds so far. Turn to {best}, and hold still.'
    return Guidance(stage, text, holds, std, candidates)


def direction(words: str) -> Floats | None:
    """Return up (3,) in body axes that a candidate's words stand for; None for other words."""
    return dict(_directions()).get(words)


def _directions() -> list[tuple[str, Floats]]:
    """List faces, edges and corners of a cube: what a person finds without an instrument."""
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


def _further(equations: FreeEquations, values: Floats, up: Floats, seconds: float) -> Floats:
    """Return the rows that a further hold with (3,) `up` would add, and the turn to it.

    (9, n + 3) in standard deviations; the rotations of the further hold come last. North is taken
    for known by then, and the heading of the last hold with it.
    """
    evidence = equations.evidence
    last = evidence.segments[-1]
    further = next_hold(last, up, seconds)
    move = ideal_move_by_hand(last, further, equations.model(values), evidence.site)
    pair = replace(evidence, segments=(last, further), moves=(move,))
    two = replace(equations, evidence=pair)
    state = two.nominal()
    state[: two.sensors] = values[: two.sensors]
    rows = two.whitened(state)[0][6:15]
    result = np.zeros((len(rows), equations.size + 3))
    result[:, : two.sensors] = rows[:, : two.sensors]
    result[:, equations.leaning_last] = rows[:, -5:-3]
    result[:, -3:] = rows[:, -3:]
    return result


def _widths() -> Floats:
    """Return how far off a unit may be before anything is known of it, (21,)."""
    biases = {'g': _GYRO_BIAS_WIDTH, 'a': _ACCEL_BIAS_WIDTH}
    return np.array(
        [biases[p.triad] if p.kind is ParameterKind.BIAS else _SCALE_WIDTH for p in ESTIMATES]
    )


def _deviations(rows: Floats) -> Floats:
    std = np.sqrt(np.diag(Information.of(rows).covariance)[: len(ESTIMATES)])
    return np.where(std < _TOLD * _widths(), std, np.nan)
