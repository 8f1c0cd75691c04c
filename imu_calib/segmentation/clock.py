"""Offset and rate between the clocks of table and IMU, from the motions that both have seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..stream import Floats, Stamps

_ITERATIONS = 8
_LEAST_TRAVEL = 0.1
_LARGEST_OFFSET = 2.0
_MOTIONS_FOR_RATE = 3
_SAMPLES_NEEDED = 20
_CELLS = 4000


@dataclass(frozen=True)
class ClockSample:
    """What one motion says: at table time `time` (ns) the IMU's clock is `offset` (s) ahead."""

    time: float
    offset: float


@dataclass(frozen=True)
class ClockFit:
    """IMU clock = table clock + offset + rate * (table clock - epoch).

    Attributes:
        epoch: Table time in the middle of the motions, ns.
        offset: At the epoch, s.
        offset_std: Standard deviation, s; NaN below two motions.
        rate: Dimensionless; 0 where the session cannot tell.
        rate_std: Standard deviation; NaN where the session cannot tell.
        motions: How many motions it rests on.

    """

    epoch: float
    offset: float
    offset_std: float
    rate: float
    rate_std: float
    motions: int


def clock_sample(
    stamp: Stamps, turned: Floats, joint_stamp: Stamps, joint_angle: Floats
) -> ClockSample | None:
    """Compare one motion of one joint as the gyros and as its encoder saw it.

    Least squares of turned = c + s * angle(t - offset) + b * t: the factor s takes the gyros'
    scale factor, b their bias; what is left of the difference in time is the offset.

    Args:
        stamp: (n,) IMU stamps, ns, spanning the motion and some rest around it.
        turned: (n,) angle about the joint's axis by the gyros, rad.
        joint_stamp: (m,) ns.
        joint_angle: (m,) rad.

    Returns:
        None where the motion is too short or the two do not describe the same motion.

    """
    if len(stamp) < _SAMPLES_NEEDED or np.ptp(joint_angle) < _LEAST_TRAVEL:
        return None
    origin = float(joint_stamp[0])
    thin = slice(None, None, max(1, len(stamp) // _CELLS))
    time = (stamp[thin] - origin) * 1e-9
    seen = turned[thin]
    table = (joint_stamp - origin) * 1e-9
    middle = (table + np.append(table[1:], table[-1:])) / 2
    slope = np.gradient(joint_angle, table)
    offset = 0.0
    for _ in range(_ITERATIONS):
        angle = np.interp(time - offset, table, joint_angle)
        rate = np.interp(time - offset, table, slope)
        columns = np.column_stack([np.ones_like(time), angle, time - middle.mean(), -rate])
        solution, _, rank, _ = np.linalg.lstsq(columns, seen, rcond=None)
        if rank < columns.shape[1] or solution[1] == 0:
            return None
        step = float(solution[3] / solution[1])
        offset += float(np.clip(step, -0.25, 0.25))
        if not abs(offset) < _LARGEST_OFFSET:
            return None
        if abs(step) < 1e-9:
            break
    left = seen - columns @ solution
    if float(np.std(left)) > _MISFIT * float(np.std(seen)):
        return None
    return ClockSample(float(table.mean() * 1e9 + origin), offset)


_MISFIT = 0.02


def fit_clock(samples: Sequence[ClockSample]) -> ClockFit:
    """Fit a line through the offsets of all motions, once more without its outliers."""
    if not samples:
        return ClockFit(0.0, 0.0, float('nan'), 0.0, float('nan'), 0)
    time = np.array([s.time for s in samples])
    offset = np.array([s.offset for s in samples])
    keep = np.abs(offset - np.median(offset)) <= _OUTLIER * _scatter(offset) + 1e-3
    time, offset = time[keep], offset[keep]
    epoch = float(time.mean())
    seconds = (time - epoch) * 1e-9
    n = len(time)
    if n < _MOTIONS_FOR_RATE or np.ptp(seconds) == 0:
        std = float(np.std(offset, ddof=1) / np.sqrt(n)) if n > 1 else float('nan')
        return ClockFit(epoch, float(offset.mean()), std, 0.0, float('nan'), n)
    spread = float(seconds @ seconds)
    rate = float(seconds @ offset) / spread
    left = offset - offset.mean() - rate * seconds
    scatter = float(np.sqrt(left @ left / (n - 2)))
    return ClockFit(
        epoch,
        float(offset.mean()),
        scatter / float(np.sqrt(n)),
        rate,
        scatter / float(np.sqrt(spread)),
        n,
    )


_OUTLIER = 10.0


def _scatter(values: Floats) -> float:
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))
