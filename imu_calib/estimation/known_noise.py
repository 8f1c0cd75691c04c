"""Noise of the sensors: from a session's blocks, and from the data sheet where those are few."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy
from numpy.typing import NDArray

from ..common.errors import NotObservable
from ..common.rotations import cross
from ..common.stream import Floats, Units
from ..segmentation.segments import Segment, Statistics
from ..segmentation.statistics import pooled_walk
from ..session.imu import ImuSpec

_SMALLEST = 1e-24
"""Variance below which the noise is not determined, (m/s^2)^2: rounding of 64-bit numbers."""
_STATED_FREEDOM = 10.0
"""Degrees of freedom assigned to a data sheet's random walk: with ten a standard deviation is known
to 1 / sqrt(20) = 22 %. A judgement of how far units of a type differ."""
_BY_CHANCE = 1e-3
"""Probability that by chance any static dwell of a session gets its own noise. A judgement, as of
groups that scatter (`hand`)."""
_STEADILY = 0.9
"""Share of the squares of the blocks about their mean that a line explains in a dwell that slides:
of four blocks of noise it explains as much in one direction once in twenty times, in both once in
a hundred."""
_AGREES = 0.5
"""Of the rate by the accelerometers: that by the gyros may differ by so much. A judgement: what
slides more slowly than gyros resolve spoils no turn."""
_ENOUGH_FREEDOM = 20.0
"""Degrees of freedom from which on a random walk needs no allowance for its uncertainty, where no
data sheet states it: it is then known to 1 / sqrt(40) = 16 %."""


def stated_walk(spec: ImuSpec) -> Floats:
    """Return the random-walk coefficients of the data sheet, (6,)."""
    return np.repeat([spec.gyro.random_walk, spec.accel.random_walk], 3)


def known_noise(segments: tuple[Segment, ...], spec: ImuSpec) -> tuple[Floats, Floats]:
    """Return the random-walk coefficients shown by the data, (6,), and degrees of freedom, (6,).

    Short dwells show little: their scatter may be small by chance, and standard deviations based on
    it would be far too small. The data sheet's figure is then averaged in like additional blocks,
    fewer with more data; without one, a standard deviation is added to the estimate.

    Raises:
        NotObservable: Neither the data nor the IMU's description gives the noise.
    """
    found = pooled_walk([s.statistics for s in segments])
    stated = stated_walk(spec)
    known = np.isfinite(found.deviation)
    if not (known | (stated > 0)).all():
        raise NotObservable('The noise of the sensors is unknown: no static dwell is long enough.')
    square = np.where(known, found.square, 0.0)
    freedom = found.freedom
    weight = _STATED_FREEDOM**2 / (_STATED_FREEDOM + freedom)
    blended = (freedom * square + weight * stated**2) / (freedom + weight)
    doubt = np.where(known & (freedom < _ENOUGH_FREEDOM), found.deviation, 0.0)
    walk = np.sqrt(np.where(stated > 0, blended, square + doubt))
    freedom = freedom + np.where(stated > 0, weight, 0.0)
    return np.asarray(walk), np.asarray(np.maximum(freedom, 1.0))


def walk_of_sensors(segments: tuple[Segment, ...], spec: ImuSpec) -> Floats:
    """Return the random walk of the sensors without a hand's, (6,), rad/sqrt(s), (m/s)/sqrt(s).

    From the data sheet, else from differences of neighbouring samples at rest, less the rounding
    of counts. NaN where neither gives it: pulses of a counter hide it.
    """
    stated = stated_walk(spec)
    found = np.full(6, np.nan)
    variances = np.array([s.statistics.sample_variance for s in segments]).reshape(-1, 6)
    variances = variances[np.isfinite(variances).all(axis=1)]
    if len(variances) and not any(s.statistics.pulse.any() for s in segments):
        rounding = spec.scale**2 / 12 if spec.units is Units.COUNTS else np.zeros(6)
        period = np.median([s.statistics.duration / s.statistics.samples for s in segments])
        # The median: one hold may have been knocked.
        found = np.sqrt(period * np.maximum(np.median(variances, axis=0) - rounding, 0.0))
    return np.asarray(np.where(stated > 0, stated, found))


def with_own_noise(segments: tuple[Segment, ...]) -> tuple[Segment, ...]:
    """Give dwells whose accelerometers are noisier than by chance their own noise.

    A unit that sways turns gravity without changing its length: noise along gravity and across it
    is separated. Each is compared with that of the other dwells by the F test, the largest first; a
    significantly larger one is removed from theirs before the next is tested.

    Source: docs/mathematics.md, 'Free positions'.

    Returns:
        The same; those found have an `excess_covariance`, no blocks of their accelerometers, and
            the rate at which they slide, if they do.
    """
    statistics = [s.statistics for s in segments]
    counts = np.array([[len(b) for b in s.blocks[3:]] for s in statistics]).reshape(-1, 3)
    uniform = (counts.min(axis=1) == counts.max(axis=1)) & (counts[:, 0] > 1)
    where = np.flatnonzero(uniform)
    if len(where) < 3:
        return segments
    ups = np.array([statistics[k].mean[3:] for k in where])
    ups /= np.linalg.norm(ups, axis=1)[:, None]
    squares = np.array([_squares(statistics[k], u) for k, u in zip(where, ups, strict=True)])
    freedom = (counts[where, :1] - 1) * np.array([1.0, 2.0])
    usual = np.ones(squares.shape, dtype=bool)
    pool = np.zeros(2)
    for k in (0, 1):
        usual[:, k] = _alike(squares[:, k], freedom[:, k], _BY_CHANCE / squares.size)
        share = freedom[:, k] * usual[:, k]
        pool[k] = share @ squares[:, k] / share.sum()
    found = list(segments)
    bias = np.median([s.mean[:3] for s in statistics], axis=0)
    for k in np.flatnonzero(~usual.all(axis=1)).tolist():
        along, across = np.where(usual[k], 0.0, squares[k] - pool)
        up = np.outer(ups[k], ups[k])
        old = statistics[where[k]]
        gain = float(old.walk_gain[3:].mean())
        blocks = (*old.blocks[:3], *(b[:0] for b in old.blocks[3:]))
        found[where[k]] = replace(
            segments[where[k]],
            statistics=replace(old, blocks=blocks),
            excess_covariance=gain * (along * up + across * (np.eye(3) - up)),
            sliding=0.0 if usual[k, 1] else _sliding(old, up, bias),
        )
    return tuple(found)


def _sliding(statistics: Statistics, up: Floats, bias: Floats) -> float:
    """Return the rate, rad/s, at which gravity turns in a dwell, if it does so steadily; else 0.

    `up` (3, 3) projects on the direction of gravity; `bias` (3,) is the output of the gyros in the
    other dwells, rad/s.

    The gyros must show it, too: f' = -w x f.
    """
    blocks = np.array(statistics.blocks[3:])
    across = (np.eye(3) - up) @ (blocks[:, :, 0] - blocks[:, :, 0].mean(axis=1)[:, None])
    time = blocks[0, :, 3] - blocks[0, :, 3].mean()
    slope = across @ time / (time @ time)
    if slope @ slope * (time @ time) < _STEADILY * (across**2).sum():
        return 0.0
    apart = slope + cross(statistics.mean[:3] - bias, statistics.mean[3:])
    if np.linalg.norm(apart) > _AGREES * np.linalg.norm(slope):
        return 0.0
    return float(np.linalg.norm(slope) / np.linalg.norm(statistics.mean[3:]))


def _squares(statistics: Statistics, up: Floats) -> Floats:
    """Return the squared random walks (2,) of accelerometers along gravity and across it.

    Quantisation is included.
    """
    blocks = np.array(statistics.blocks[3:])
    seen = np.cov(blocks[:, :, 0])
    along = float(up @ seen @ up)
    both = np.array([along, (np.trace(seen) - along) / 2])
    # Quantisation without noise does not distinguish dwells.
    least = max(_SMALLEST, float(blocks[:, :, 2].mean()))
    return np.asarray(np.maximum(both, least) / blocks[:, :, 1].mean())


def _alike(squares: Floats, freedom: Floats, chance: float) -> NDArray[np.bool_]:
    """Return which of variances (n,) are alike; at most half of them are not."""
    alike = np.ones(len(squares), dtype=bool)
    for _ in range(len(squares) // 2):
        sums = np.where(alike, freedom * squares, 0.0)
        others = (sums.sum() - sums) / (np.where(alike, freedom, 0.0).sum() - freedom)
        odds = scipy.special.fdtrc(freedom, (alike @ freedom) - freedom, squares / others)
        worst = int(np.argmin(np.where(alike, odds, 1.0)))
        if not odds[worst] < chance:
            break
        alike[worst] = False
    return alike
