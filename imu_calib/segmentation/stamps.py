"""Stamps -> the instants at which a device sampled: equal intervals, some of them missing.

A device samples at equal intervals of its own clock. Its stamps also hold delays of the driver, the
line and the packets. The sampling instants are a line through the stamps; deviations from it are
errors of the stamps, not of the samples (docs/mathematics.md, 'Stamps and lost samples').
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..common.rotations import MAD_TO_STD, MEDIAN_ERROR
from ..common.stream import Floats, Stamps
from .bunches import sampling_times

_LATE = 1.5
"""Intervals between two stamps from which on a sample between them may be missing. Half way between
none and one."""

_OFF_GRID = 0.03
"""Of an interval: smaller steps are not set clocks, or have no effect: missing samples shift the
stamps by whole intervals. A judgement: three times the error of sixteen intervals that are a
thousandth off."""

_ALONGSIDE = 16
"""Samples on either side of a step by which it is tested: few, as their interval is not known."""

_SURELY = 6.0
"""Standard deviations of stamps about their grid beyond which a step is off it: exceeded once in
10^9 by chance."""

_SURE = 0.5
"""Of an interval: with a smaller error a span is rounded to the right number of intervals."""

_ACROSS = 8
"""Least spans for each one with a step in it: these then move a median by a fifth of its
scatter."""

_SELDOM = 500
"""Least samples for each step off the grid: with more steps than that the stamps have no grid."""

_TICKS = 4
"""Ticks of an interval from which on its clock is coarse: its stamps advance by one tick more or
less now and then. A judgement: milliseconds at 250 Hz and less."""

_ON_TICK = 0.05
"""Of a tick: tolerance of a stamp about a whole number of them."""
_ON_TICKS = 0.9
"""Share of the steps that are whole ticks: of 20 steps so many are by chance once in 10^16."""

_LIKE = 0.2
"""Of an interval: largest difference of two estimates of it. A judgement: more than missing samples
change their mean."""

_FEW = 8
"""Samples over which the interval is taken: few enough that most such spans have no gap while one
sample in twelve is missing, and enough for jitter to be small against it."""

_CLOSE = 0.05
"""Of an interval: where eight differ by more from eight single ones, most spans hold gaps."""

_HASTE = 0.5
"""Of the interval: where a quarter of the steps are shorter, samples come in bunches."""

_QUEUED = 0.5
"""Share of short steps up to the end from which on they belong to a queue. A judgement: more than
are short by jitter."""

_LAG = 240
"""Most samples over which the interval is then taken, in whole bunches: short enough that some of
these spans have no gap."""

_LAGS = 4
"""Fewest lags of a segment: their lower quantile is then within it."""

_WITHOUT_GAP = 0.1
"""Share of the lags without a gap: the interval is taken from the lowest ones."""

_WINDOW = 128
"""Samples on either side of a step that show whether stamps stay late: more than a line is held up,
a tenth of a second at 1 kHz; and so few that their interval need not be known to a thousandth."""

_NARROW = 16
"""The same in the first round of bunches, whose interval is known to a percent."""

_LAYINGS = 3
"""Most rounds of fitting a line and counting the missing samples by it. A cap."""

_TAIL = 32
"""Samples at the end of a segment in bunches: the last bunch is cut off, and late samples cannot be
distinguished there from missing ones."""

_FEWEST = 3
"""Fewest stamps of a line whose scatter is known."""

_OUTLYING = 4.0
"""Robust standard deviations off the line beyond which a stamp gets zero weight. Normal ones exceed
them once in 16 000."""

_ROUNDS = 5
"""A cap."""
_BLOCKS = 16
"""Blocks of a segment of stamps, whose means show correlated errors: a queue, a coarse clock."""

_CLEAN = 1e-3
"""Of an interval: stamps nearer than this to their line are left as they are."""

_ROUNDING = 1e-9
"""Resolution of a stamp, s."""


@dataclass(frozen=True, eq=False)
class SampleGrid:
    """Equal intervals fitted to the stamps of a segment.

    Attributes:
        index: (n,) which interval each sample ends, from 0; omitted numbers are missing.
        origin: Stamp of sample 0 on the line, s after the first stamp.
        period: Sample interval by these stamps alone, s.
        period_std: Its standard deviation, s; infinite where the stamps are too few.
        scatter: Of a stamp about the line, s.
        kept: (n,) stamps used in the fit of the line.
    """

    index: NDArray[np.int64]
    origin: float
    period: float
    period_std: float
    scatter: float
    kept: NDArray[np.bool_]

    def stamps(self, stamp: Stamps) -> Stamps:
        """Return the instants of the samples, ns; the stamps themselves where they are clean."""
        line = self.origin + self.index * self.period
        off = np.abs((stamp - stamp[0]) * 1e-9 - line)
        if float(off.max(initial=0.0)) <= _CLEAN * self.period:
            return stamp
        return np.asarray(stamp[0] + np.rint(line * 1e9).astype(np.int64))


def read_grid(stamp: Stamps, hint: float | None = None) -> SampleGrid:
    """Fit equal intervals to stamps.

    Args:
        stamp: (n,) ns, increasing, at least 2.
        hint: Sample interval as far as it is known, s.
    """
    time = (sampling_times(stamp)[0] - stamp[0]) * 1e-9
    period, bunched = _first_period(time)
    if hint is not None and abs(hint - period) < _LIKE * period:
        period = hint
    index = np.arange(len(time))
    grid = _laid(time, index, period)
    window = _NARROW if bunched and hint is None else _WINDOW
    for _ in range(_LAYINGS):
        counted = index + _missing_before(time, period, window, bunched=bunched)
        if window == _WINDOW and np.array_equal(counted, grid.index):
            break
        grid = _laid(time, counted, period)
        period, window = grid.period, _WINDOW
    return grid


def clock_steps(stamp: Stamps, hint: float = 0.0) -> list[int]:
    """Return where stamps leave the grid of those before: their clock was set.

    Missing samples shift stamps by whole intervals, and the counts of lost samples are filled in.
    Where a clock was set nothing was lost, and filled-in counts would be wrong by half a pulse.

    Args:
        stamp: (n,) ns, increasing.
        hint: Sample interval as far as it is known, s; 0 if it is not.

    Returns:
        The first samples after each step; none where samples come in bunches, or where the stamps'
        ticks are so coarse that they advance by one more or less now and then.

    Source: docs/mathematics.md, 'Stamps and lost samples'.
    """
    if len(stamp) < 2 * _ALONGSIDE:
        return []
    steps = np.diff(stamp) * 1e-9
    period = float(np.median(steps))
    if _hasty(steps, max(period, hint)):
        return []
    off = np.abs(steps / period - 1)
    if float(off.max()) <= _OFF_GRID:
        return []
    scatter = MAD_TO_STD * float(np.median(off))
    regular = np.append(True, off <= max(_OFF_GRID, _SURELY * scatter))
    if regular.all():
        return []
    # The error of a median of n. Where the number of intervals between stamps is certain, the error
    # of the interval is so many times smaller.
    unknown = MEDIAN_ERROR * scatter / math.sqrt(len(steps))
    lag = int(min(len(steps) / _ACROSS, _SURE / (_SURELY * unknown))) if unknown else 0
    if lag > 1:
        spans = (stamp[lag:] - stamp[:-lag]) * 1e-9 / period
        period *= float(np.median(spans / np.maximum(np.rint(spans), 1.0)))
        unknown = MEDIAN_ERROR * scatter / (math.sqrt(len(spans)) * lag)
    phase = np.exp(2j * np.pi * (stamp - stamp[0]) * 1e-9 / period)
    on_grid, found = np.flatnonzero(regular), []
    # Where stamps in a row are off (a queue is read out), use the first regular one.
    places = np.unique(np.searchsorted(on_grid, np.flatnonzero(~regular)))
    places = places[(places >= _FEWEST) & (places <= len(on_grid) - _FEWEST)]
    across = (stamp[on_grid[places]] - stamp[on_grid[places - 1]]) * 1e-9 / period
    came = on_grid[places] - on_grid[places - 1]
    for place, step, count in zip(places.tolist(), across.tolist(), came.tolist(), strict=True):
        before = phase[on_grid[max(0, place - _ALONGSIDE) : place]]
        after = phase[on_grid[place : place + _ALONGSIDE]]
        # Circular statistics: the angle of a mean, and by its length the deviation about it.
        first, second = before.mean(), after.mean()
        apart = abs(float(np.angle(second * first.conjugate()))) / (2 * np.pi)
        length = float(np.clip(min(abs(first), abs(second)), 1e-300, 1.0))
        deviation = math.sqrt(-4 * math.log(length) / min(len(before), len(after))) / (2 * np.pi)
        # An error of the interval grows with the time between the middles of both sides.
        between = step - 1 + (len(before) + len(after)) / 2
        if apart <= max(_OFF_GRID, _SURELY * math.hypot(deviation, between * unknown)):
            continue
        if not _is_tick(abs(step - count) * period, stamp, period):
            found.append(int(on_grid[place - 1]) + 1)
    return found if len(found) * _SELDOM <= max(len(stamp), 2 * _SELDOM) else []


def _is_tick(step: float, stamp: Stamps, period: float) -> bool:
    """Return whether a step, s, is one tick of the stamps."""
    if not 0 < step * _TICKS <= period * (1 + _ON_TICK):
        return False
    ticks = np.diff(stamp) * 1e-9 / step
    return bool(np.mean(np.abs(ticks - np.rint(ticks)) < _ON_TICK) >= _ON_TICKS)


def _hasty(steps: Floats, interval: float) -> bool:
    """Return whether a quarter of the steps, s, is far shorter than an interval, s."""
    limit = _HASTE * interval
    return float(steps.min()) < limit and float(np.quantile(steps, 0.25)) < limit


def _first_period(time: Floats) -> tuple[float, bool]:
    """Return the sample interval within a percent or so, s, and whether samples come in bunches."""
    steps = np.diff(time)
    few = min(_FEW, len(steps))
    typical, single = float(np.median(time[few:] - time[:-few])) / few, float(np.median(steps))
    if not _hasty(steps, typical):
        return typical if abs(typical - single) < _CLOSE * single else single, False
    waits = np.flatnonzero(steps > _HASTE * typical)
    bunch = max(1, int(np.median(np.diff(waits)))) if len(waits) > 1 else 1
    lag = max(bunch, min(_LAG, len(steps) // _LAGS) // bunch * bunch)
    return float(np.quantile(time[lag:] - time[:-lag], _WITHOUT_GAP)) / lag, True


def _missing_before(
    time: Floats, period: float, window: int, *, bunched: bool
) -> NDArray[np.int64]:
    """Return the number of samples missing before each, (n,).

    A missing sample makes all later stamps late by an interval; after a late stamp others are not.
    Comparing the earliest of the next stamps with the earliest of those before distinguishes the
    two.
    """
    late = time - np.arange(len(time)) * period
    found = np.zeros(len(time), dtype=np.int64)
    missing = 0
    for k in (np.flatnonzero(np.diff(time) > _LATE * period) + 1).tolist():
        first = max(0, k - window)
        if bunched and len(time) - k < _TAIL:
            break
        after = late[k : k + window]
        behind = np.diff(time[k:]) < _HASTE * period
        if k + int(after.argmin()) == len(time) - 1 and len(behind) and behind.mean() > _QUEUED:
            # A queue that lasts beyond the end: the lateness of its samples is unknown.
            break
        before = float((late[first:k] - found[first:k] * period).min())
        shift = (float(after.min()) - before) / period - missing
        count = round(shift)
        if count > 0:
            missing += count
            found[k:] += count
    return found


def _laid(time: Floats, index: NDArray[np.int64], period: float) -> SampleGrid:
    """Fit a robust line time = origin + period index."""
    n = len(time)
    if n < _FEWEST:
        step = float(time[-1]) / max(1, int(index[-1]))
        everything = np.ones(n, dtype=bool)
        return SampleGrid(index, 0.0, step, float('inf'), 0.0, everything)
    kept = _near(time - index * period)
    for _ in range(_ROUNDS):
        some, instants = (index, time) if kept.all() else (index[kept], time[kept])
        middle, mean = float(some.mean()), float(instants.mean())
        centred = some - middle
        slope = float(centred @ instants / (centred @ centred))
        residuals = time - mean - slope * (index - middle)
        near = _near(residuals)
        if np.array_equal(near, kept):
            break
        kept = near
    spread = float(centred @ centred)
    variance = _in_common(residuals[kept]) + _ROUNDING**2 / 12
    scatter = float(np.sqrt(np.mean(residuals[kept] ** 2)))
    return SampleGrid(
        index, mean - slope * middle, slope, float(np.sqrt(variance / spread)), scatter, kept
    )


def _near(residuals: Floats) -> NDArray[np.bool_]:
    """Return which residuals (n,), s, are not outliers; always more than half of them."""
    if float(np.ptp(residuals)) <= 2 * _ROUNDING:
        return np.ones(len(residuals), dtype=bool)
    off = np.abs(residuals - np.median(residuals))
    return np.asarray(off <= _OUTLYING * MAD_TO_STD * float(np.median(off)) + 2 * _ROUNDING)


def _in_common(residuals: Floats) -> float:
    """Return the variance of residuals by their sums: larger than their own if correlated.

    Means of blocks of white residuals have their variance over the block's length; common delays,
    and the steps of a coarse clock, increase it.
    """
    own = float(np.mean(residuals**2))
    length = len(residuals) // _BLOCKS
    if length < 2:
        return own
    means = residuals[: length * _BLOCKS].reshape(_BLOCKS, length).mean(axis=1)
    return max(own, length * float(np.mean(means**2)))
