"""What a person with the unit in hand should do next, and what each further hold would gain.

The gain is that of D-optimal design (Fedorov 1972, section 2.5): by how much the logarithm of the
determinant of the information on the 21 parameters grows, halved. In the mean over the parameters
a gain of 21 ln(2) halves every standard deviation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import product

import numpy as np

from ...earth import Site
from ...errors import NotObservable
from ...imu import ImuSpec
from ...model import AXES, PARAMETERS, ParameterKind, SensorModel, Triad
from ...stream import Floats
from ...units import ARCMIN, DEG, PPM
from .fit import FEWEST, ellipsoid
from .holds import Hold, Swing
from .system import FREE, System

_SCALE_WIDTH = 0.1
_GYRO_BIAS_WIDTH = 1.0 * DEG
_ACCEL_BIAS_WIDTH = 0.5
_TOLD = 0.5
"""Share of what was known beforehand below which a session has told something."""

_CHECKED = 2 * FEWEST
"""Fewest holds that are enough: as many again as gravity has to tell, so that one that was no
hold, or noise that is more than it should be, shows."""

_STEPS = 40
_PARALLEL = 1e-6
HOLD_SECONDS = 3.0
"""How long a hold is to last, s."""

TURN_SECONDS = 2.0
"""How long a turn from hold to hold is taken to last, s."""


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
    holds: Sequence[Hold],
    swings: Sequence[Swing],
    imu: ImuSpec,
    site: Site,
    *,
    holding: float | None = None,
    hold_seconds: float = HOLD_SECONDS,
    reached: Floats | None = None,
    wanted: Wanted | None = None,
) -> Guidance:
    """Say what to do next.

    Args:
        holds: Those that have come to their end.
        swings: The turns between them.
        imu: Noise figures, for what a further hold would know.
        site: Gravity.
        holding: How long the unit has been still, s; None while it moves.
        hold_seconds: How long a hold is to last, s.
        reached: (21,) standard deviations that a solution states, where there is one: what
            scatters more than its noise counts then.
        wanted: When it is enough.

    """
    wanted = wanted or Wanted()
    if not holds:
        std = np.full(len(PARAMETERS), np.nan)
        candidates = tuple(Candidate(w, u, 0.0) for w, u in _directions())
        return _told(holding, hold_seconds, 0, std, candidates, enough=False)
    model, ups = _nominal(holds, site)
    system = System(tuple(holds), tuple(swings), site, np.ones(3))
    base = system.rows(model, ups)[0]
    now = _log_information(base)
    std = _deviations(base)
    if reached is not None:
        std[FREE] = reached
    found = []
    for words, up in _directions():
        block = _further(holds[-1], ups[-1], up, model, imu, site, hold_seconds)
        size = base.shape[1]
        rows = np.zeros((len(block), size + 2))
        rows[:, :24], rows[:, size - 2 :] = block[:, :24], block[:, 24:]
        grown = np.vstack([np.pad(base, ((0, 0), (0, 2))), rows])
        found.append(Candidate(words, up, (_log_information(grown) - now) / 2))
    found.sort(key=lambda c: -c.gain)
    scale = np.array([p.kind is ParameterKind.SCALE_FACTOR_ERROR for p in PARAMETERS])
    angle = np.array([p.kind is ParameterKind.MISALIGNMENT for p in PARAMETERS])
    with np.errstate(invalid='ignore'):
        good = std <= np.where(scale, wanted.scale_factor, np.where(angle, wanted.angle, np.inf))
    enough = len(holds) >= _CHECKED and bool(good[FREE & (scale | angle)].all())
    return _told(holding, hold_seconds, len(holds), std, tuple(found), enough=enough)


def _told(
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


def _nominal(holds: Sequence[Hold], site: Site) -> tuple[SensorModel, Floats]:
    """Return the sensors as far as they are known, and up at every hold."""
    accel = Triad()
    outputs = np.array([h.accel for h in holds])
    if len(holds) > FEWEST:
        try:
            accel = ellipsoid(outputs, site.gravity)
        except NotObservable:
            accel = Triad()
    forces = np.linalg.solve(accel.response, (outputs - accel.bias).T).T
    ups = forces / np.linalg.norm(forces, axis=1)[:, None]
    bias = np.mean([h.gyro for h in holds], axis=0)
    return SensorModel(Triad(bias=bias), accel), np.asarray(ups)


def _further(
    last: Hold,
    up: Floats,
    target: Floats,
    model: SensorModel,
    imu: ImuSpec,
    site: Site,
    seconds: float,
) -> Floats:
    """Return the rows that a further hold would add: columns of 24, the last up, the next up."""
    noise = np.array([imu.gyro.random_walk, imu.accel.random_walk])
    variances = noise**2 / seconds
    if not (noise > 0).all():
        variances = np.array([last.gyro_variance.mean(), last.accel_variance.mean()])
        noise = np.sqrt(variances * seconds)
    further = planned_hold(target, model, variances, site)
    swing = planned_swing(0, up, target, model, float(noise[0] ** 2 * TURN_SECONDS))
    two = System((last, further), (swing,), site, np.ones(3))
    rows, _, _ = two.rows(model, np.array([up, target]))
    # North is taken for known by then: its columns, and what was known of it, stay out.
    north = np.arange(len(PARAMETERS), two.size[0])
    return np.asarray(np.delete(rows, north, axis=1)[6 : -len(north)])


def planned_hold(up: Floats, model: SensorModel, variances: Floats, site: Site) -> Hold:
    """Return what a hold would read.

    Args:
        up: (3,) in body axes, unit vector.
        model: The sensors.
        variances: (2,) of gyros and accelerometers, (rad/s)^2 and (m/s^2)^2.
        site: Gravity and Earth rate; of the latter the vertical part alone is read.

    """
    gyro, accel = model.predict(up * site.up_rate, up * site.gravity)
    return Hold(0, 0, gyro, accel, np.full(3, variances[0]), np.full(3, variances[1]))


def planned_swing(
    first: int, up: Floats, target: Floats, model: SensorModel, variance: float
) -> Swing:
    """Return the short way from one direction of up to another, at an even pace.

    Args:
        first: Index of the hold that it leaves.
        up: (3,) in body axes there, unit vector.
        target: (3,) the next one.
        model: The sensors.
        variance: Of the angle that the gyros' noise adds up to, rad^2.

    """
    axis = np.cross(target, up)
    sine, cosine = float(np.linalg.norm(axis)), float(target @ up)
    if sine < _PARALLEL:
        # Half a turn goes about any level axis.
        axis = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    angle = np.arctan2(sine, cosine) * axis / np.linalg.norm(axis)
    period = TURN_SECONDS / _STEPS
    step = model.gyro.response @ angle / _STEPS + model.gyro.bias * period
    return Swing(first, np.tile(step, (_STEPS, 1)), np.full(_STEPS, period), variance)


def _prior() -> Floats:
    """Return how far off a unit may be before anything is known of it, (24,)."""
    return np.array(
        [
            _SCALE_WIDTH
            if p.kind is not ParameterKind.BIAS
            else (_GYRO_BIAS_WIDTH if p.triad == 'g' else _ACCEL_BIAS_WIDTH)
            for p in PARAMETERS
        ]
    )


def _information(rows: Floats) -> Floats:
    """Return the information on the 21 parameters, directions taken out, a wide prior put in."""
    widths = _prior()
    whole = rows.T @ rows
    n = len(PARAMETERS)
    directions = whole[n:, n:]
    cross = whole[n:, :n]
    own = whole[:n, :n] - cross.T @ np.linalg.solve(directions, cross)
    return np.asarray((own + np.diag(1 / widths**2))[np.ix_(FREE, FREE)])


def _log_information(rows: Floats) -> float:
    return float(np.linalg.slogdet(_information(rows))[1])


def _deviations(rows: Floats) -> Floats:
    std = np.full(len(PARAMETERS), np.nan)
    std[FREE] = np.sqrt(np.diag(np.linalg.inv(_information(rows))))
    with np.errstate(invalid='ignore'):
        return np.where(std < _TOLD * _prior(), std, np.nan)
