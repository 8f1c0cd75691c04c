"""What of a stretch at rest is sound: settling, knocks and steps are cut by what the data shows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..stream import Floats
from .segment import CHANNELS, Statistics
from .statistics import Samples

_WINDOW_SECONDS = 0.5
_OUTLIER = 7.0
_PULSES = 2.5
_SPREAD_RATIO = 3.0
_FLIPPING = 0.5
_STEP_SIGNIFICANCE = 8.0
_FEWEST_WINDOWS = 4
_FEWEST_BLOCKS = 5
_WITHOUT_LARGEST = 0.7
_TINY = 1e-15
_FAR_BETTER = 0.25


@dataclass(frozen=True, eq=False)
class Sound:
    """Which samples of a stretch are sound, and in words what the others were."""

    mask: NDArray[np.bool_]
    notes: tuple[str, ...]


def sound_part(samples: Samples, walk: Floats) -> Sound:
    """Cut the settling at both ends and the disturbances within a stretch at rest.

    Windows of half a second whose mean or spread leaves the others' are not sound. A drift of the
    whole stretch is no disturbance: windows are judged about a robust line.

    Args:
        samples: A stretch during which the table stood still.
        walk: (6,) random-walk coefficients expected, rad/sqrt(s) and (m/s)/sqrt(s).

    """
    length = max(1, round(_WINDOW_SECONDS / samples.period))
    count = len(samples.stamp) // length
    everything = np.ones(len(samples.stamp), dtype=bool)
    if count < _FEWEST_WINDOWS:
        return Sound(everything, ())
    used = samples.increments[: count * length].reshape(count, length, 6)
    bad = _outlying_means(used.sum(axis=1), samples, walk, length * samples.period)
    bad |= _outlying_spreads(used, samples.quantum)
    if not bad.any():
        return Sound(everything, ())
    good = np.flatnonzero(~bad)
    if not len(good):
        return Sound(~everything, ('no half second of it was quiet',))
    first, last = int(good[0]), int(good[-1]) + 1
    mask = np.repeat(~bad, length)
    mask = np.concatenate([mask, np.full(len(everything) - len(mask), last == count)])
    inner = int(bad[first:last].sum())
    if not inner:
        return Sound(mask, ())
    at = float(np.flatnonzero(bad[first:last])[0] + first) * _WINDOW_SECONDS
    note = f'disturbed {at:.1f} s after it came to rest; {inner * _WINDOW_SECONDS:.1f} s left out'
    return Sound(mask, (note,))


def _outlying_means(
    sums: Floats, samples: Samples, walk: Floats, seconds: float
) -> NDArray[np.bool_]:
    left = sums - _robust_line(sums)
    scatter = 1.4826 * np.median(np.abs(left), axis=0)
    expected = walk * np.sqrt(seconds)
    floor = _PULSES * samples.quantum
    limit = _OUTLIER * np.maximum(scatter, expected) + floor
    # Values that are no pulses and carry no noise at all still deserve a tolerance.
    limit = np.maximum(limit, 1e-9 * np.abs(sums).max(axis=0) + 1e-15)
    return np.asarray((np.abs(left) > limit).any(axis=1))


def _robust_line(sums: Floats) -> Floats:
    """Return the line through the medians of the first and the last third."""
    n = len(sums)
    third = max(1, n // 3)
    start, end = np.median(sums[:third], axis=0), np.median(sums[-third:], axis=0)
    centre_start, centre_end = (third - 1) / 2, n - 1 - (third - 1) / 2
    slope = (end - start) / (centre_end - centre_start)
    return np.asarray(start + slope * (np.arange(n)[:, None] - centre_start))


def _outlying_spreads(windows: Floats, quantum: Floats) -> NDArray[np.bool_]:
    spread = windows.std(axis=1)
    typical = np.median(spread, axis=0)
    # A counter that rests on the edge between two values flips by one pulse at every sample.
    limit = _SPREAD_RATIO * np.maximum(typical, _FLIPPING * quantum)
    return np.asarray((spread > limit + 1e-15).any(axis=1))


def find_step(statistics: Statistics, walk: Floats) -> tuple[float, str] | None:
    """Find a step of the mean within a stretch: somebody moved the unit and left it so.

    Args:
        statistics: Of the whole stretch.
        walk: (6,) random-walk coefficients expected, rad/sqrt(s) and (m/s)/sqrt(s).

    Returns:
        Which share of it lies before the step, and the step in words; None without a step. A
        step must be plain against the scatter of neighbouring blocks and explain the stretch
        far better than a drift does.

    """
    best: tuple[float, float, int] | None = None
    for channel, blocks in enumerate(statistics.blocks):
        found = _largest_step(blocks, float(walk[channel]))
        if found is not None and (best is None or found[0] > best[0]):
            best = (*found, channel)
    if best is None or best[0] < _STEP_SIGNIFICANCE:
        return None
    _, cut, channel = best
    row = statistics.blocks[channel][:, 0]
    count, at = len(row), round(cut * len(row))
    as_step = np.concatenate([row[:at] - row[:at].mean(), row[at:] - row[at:].mean()])
    index = np.arange(count) - (count - 1) / 2
    as_drift = row - row.mean() - index * (index @ row) / (index @ index)
    if as_step @ as_step > _FAR_BETTER * (as_drift @ as_drift):
        return None
    return cut, f'the mean of {CHANNELS[channel]} steps by {_amount(row, at, channel)}'


def _largest_step(blocks: Floats, walk: float) -> tuple[float, float] | None:
    """Return the significance of the largest step, and where it is as a share of the stretch."""
    row = blocks[:, 0]
    count = len(row)
    if count < _FEWEST_BLOCKS:
        return None
    # The largest difference is left out, since it may be the step itself.
    squares = np.sort(np.diff(row) ** 2)[:-1]
    noise = squares.mean() / (2 * _WITHOUT_LARGEST)
    noise = max(noise, float(np.median(blocks[:, 1])) * walk**2 + float(np.median(blocks[:, 2])))
    cuts = np.arange(1, count)
    difference = np.array([row[k:].mean() - row[:k].mean() for k in cuts])
    score = np.abs(difference) / (np.sqrt(noise * (1 / cuts + 1 / (count - cuts))) + _TINY)
    best = int(np.argmax(score))
    return float(score[best]), float(cuts[best] / count)


def _amount(row: Floats, cut: int, channel: int) -> str:
    step = float(row[cut:].mean() - row[:cut].mean())
    if channel < 3:
        return f'{np.degrees(step) * 3600:.3g} deg/h'
    return f'{step / 9.80665e-6:.3g} ug'
