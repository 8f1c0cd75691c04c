"""Stamps -> the instants at which a device sampled: equal intervals, some of them missing.

A device samples at equal intervals of its own clock. Its stamps also hold delays of the driver, the
line and the packets. The sampling instants are a line through the stamps; deviations from it are
errors of the stamps, not of the samples (docs/mathematics.md, 'Stamps and lost samples').
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from ..common.gaussian import MAD_TO_STD, MEDIAN_ERROR
from ..common.stream import Floats, Stamps

# Stamps of samples that come in bunches -> when each sample of a bunch was made.
#
# A driver that reads packets stamps all samples of one as it arrives. All samples made since the
# packet before are then cut from a dwell or a turn together, and spans of a few samples do not show
# the interval. Bunches are found by the pattern of short and long steps, before the interval is
# known (docs/mathematics.md, 'Stamps and lost samples').


LAG = 240
"""Most samples over which the mean step is taken: several bunches, and short enough that half of
such spans are without a long gap, and some without any."""

SHORT = 0.5
"""Of the mean step: shorter ones are within a bunch. A judgement: jitter of a fifth of an interval
makes one step in ten so short, and packets nearly all."""

_BY_MEDIANS = 1.86
"""Standard deviation of a median times the root of the number of values, over their median
deviation: 1.2533 times 1.4826 (`gaussian`)."""

MANY = 0.25
"""Share of steps that are short where samples come in bunches: half of them do in pairs."""

_FEWEST_BUNCHES = 3
"""Fewest whole bunches that show a pattern; fewest samples in time before which none is missing."""

_ALIKE = 0.75
"""Share of bunches that are of one size, give or take a sample: a reader that polls gets one more
or less, and queues of delayed samples have all sizes. A judgement."""

_QUEUED_BUNCH = 0.05
"""Share of short steps from which on samples queue; single late ones are detected as such. A
judgement."""

_IN_ROW = 0.5
"""Share of the short steps that follow another: in a queue all but the first one. Jitter makes two
in a row where a stamp is a whole interval nearer to the last but one, which is rare."""

_DRIFT = 0.1
"""Of the interval: largest error of stamps after `AHEAD` samples due to the interval's error. It
is a tenth of what distinguishes one sample from the next."""

_NEARLY = 0.2
"""Of the mean step: the interval is within this of it, unless samples come in bunches or one in six
is missing."""

AHEAD = 512
"""Samples of which the earliest is taken: longer than a line is usually held up, five seconds at
100 Hz, and so few that an interval known to a ten-thousandth errs by a twentieth of one over them.
Of 40 simulated streams of 75 s, one sample in twenty late by 100 ms, three were late for longer
than 128."""

_LARGEST = 0.9
"""Quantile of the sizes that is the size of whole packets: a few are two that came together."""


@dataclass(frozen=True)
class Pattern:
    """How samples come in bunches."""

    interval: float  #: Sample interval, ns.
    size: int | None  #: Samples of a whole packet; None where a reader takes all that has arrived.


def pattern(stamp: Stamps) -> Pattern | None:
    """Return how samples come in bunches; None where they do not, or too few show it.

    Args:
        stamp: (n,) ns, increasing.
    """
    starts = _bunches(stamp)
    return None if starts is None else _pattern(stamp, starts)


def usual_interval(stamp: Stamps) -> tuple[float, float]:
    """Return the interval of stamps (n,), ns, to a percent or so, and the share of short steps.

    The interval is the median of the steps that are not short; a queue has few of these.
    """
    steps = np.diff(stamp)
    lag = min(LAG, -(-len(steps) // 2))
    short = steps < SHORT * float(np.median(stamp[lag:] - stamp[:-lag])) / lag
    apart = steps[~short]
    return (float(np.median(apart)) if len(apart) else 0.0), float(short.mean())


def sampling_times(stamp: Stamps) -> tuple[Stamps, Stamps]:
    """Return when samples were made, and how much later each was stamped by chance.

    Samples of a bunch are spread evenly over the time since the bunch before; their lateness is 0.
    Samples that queue behind a delayed one go back to when they were made. Stamps are unchanged
    where samples come one by one, and where they are ticks, through which `read_grid` fits a line.

    Args:
        stamp: (n,) ns, increasing.

    Returns:
        (n,) and (n,) ns.
    """
    if _grid_of_ticks(stamp) is not None:
        return stamp, np.zeros_like(stamp)
    starts = _bunches(stamp)
    if starts is None:
        instants = _out_of_queue(stamp)
        return instants, stamp - instants
    return _out_of_bunches(stamp, starts), np.zeros_like(stamp)


def _out_of_bunches(stamp: Stamps, starts: NDArray[np.intp]) -> Stamps:
    """Return when the samples of bunches were made, (n,) ns; `starts` are their first samples."""
    found = _pattern(stamp, starts)
    interval, size = found.interval, found.size
    counts = np.diff(starts, append=len(stamp))
    came = (stamp[starts] - stamp[0]).astype(float)
    whole, passed = counts[1:-1], np.diff(came)[:-1]
    slots = counts.copy()
    # The end of the segment cuts the last bunch: its other samples lie beyond, and are not missing.
    slots[-1] = max(int(slots[-1]), round(float(np.median(whole))) if size is None else size)
    if size is not None:
        packets = np.maximum(np.rint(passed / (size * interval)), 1).astype(int)
        slots[1:-1] = np.maximum(size * packets, whole)
    begins = np.append(came[0] - slots[0] * interval, came[:-1])
    number = _places(counts, slots)
    each = np.repeat((came - begins) / slots, counts)
    instants = np.rint(np.repeat(begins, counts) + number * each).astype(np.int64)
    return np.asarray(stamp[0] + instants)


def _pattern(stamp: Stamps, starts: NDArray[np.intp]) -> Pattern:
    """Return the interval and the size of bunches that begin with the samples `starts`."""
    whole = np.diff(starts)[1:]
    passed = np.diff(stamp[starts])[:-1].astype(float)
    size = int(np.quantile(whole, _LARGEST, method='nearest'))
    if not _are_packets(whole, size):
        return Pattern(float(np.median(passed / whole)), None)
    return Pattern(float(np.median(passed[whole == size] / size)), size)


def _out_of_queue(stamp: Stamps) -> Stamps:
    """Return when samples were made that queue behind late ones, (n,) ns.

    A sample is stamped after it is made, and made an interval after the one before, or more where
    some are missing: it was made at the earliest of the next stamps, less the intervals to it.
    """
    interval = _interval_in_queue(np.diff(stamp))
    if interval is None:
        return stamp
    line = np.arange(len(stamp)) * interval
    late = (stamp - stamp[0]) - line
    earliest = scipy.ndimage.minimum_filter1d(late, AHEAD, mode='nearest', origin=-(AHEAD // 2))
    # In a longer queue samples gain on the clock until its end.
    falls = np.flatnonzero(late[: 1 - AHEAD] - late[AHEAD - 1 :] > AHEAD / 2 * interval)
    for k in falls[::-1].tolist():
        earliest[k] = min(earliest[k], earliest[k + AHEAD - 1])
    # Where a queue ends beyond the samples looked at, the instants follow from the samples before.
    in_time = np.flatnonzero(late - earliest <= _DRIFT * interval)
    level = late[in_time]
    sure = np.flatnonzero(
        np.abs(level[_FEWEST_BUNCHES - 1 :] - level[: 1 - _FEWEST_BUNCHES]) <= _DRIFT * interval
    )
    if len(sure):
        last = int(in_time[sure[-1] + _FEWEST_BUNCHES - 1])
        earliest[last:] = np.minimum(earliest[last:], late[last])
    return np.asarray(stamp[0] + np.rint(line + earliest).astype(np.int64))


def _interval_in_queue(steps: Stamps) -> float | None:
    """Return the interval of samples that queue, ns, by their steps; None if unknown."""
    if not len(steps):
        return None
    mean = float(steps.mean())
    short = steps < SHORT * mean
    in_row = np.count_nonzero(short[1:] & short[:-1])
    if short.mean() < _QUEUED_BUNCH or in_row < _IN_ROW * np.count_nonzero(short):
        return None
    apart = steps[~short]
    interval = float(np.median(apart))
    error = _BY_MEDIANS * float(np.median(np.abs(apart - interval))) / len(apart) ** 0.5
    known = abs(interval - mean) <= _NEARLY * mean and error * AHEAD <= _DRIFT * interval
    return interval if known else None


def _bunches(stamp: Stamps) -> NDArray[np.intp] | None:
    """Return the first sample of each bunch, in order, the first at 0; None without a pattern."""
    steps = np.diff(stamp)
    lag = min(LAG, len(steps) // 2)
    if not lag:
        return None
    spans = stamp[lag:] - stamp[:-lag]
    # A cheap test first: the median step is at most the longest.
    if np.count_nonzero(steps < SHORT * float(spans.max()) / lag) < MANY * len(steps):
        return None
    short = steps < SHORT * float(np.median(spans)) / lag
    if short.mean() < MANY:
        return None
    starts = np.concatenate([[0], np.flatnonzero(~short) + 1])
    counts = np.diff(starts)[1:]
    if len(counts) < _FEWEST_BUNCHES:
        return None
    usual = float(np.median(counts))
    if usual <= 1:
        return None
    # Of one size, or as many as were made since the bunch before, if the reader was kept waiting.
    waited = np.diff(stamp[starts])[:-1]
    expected = usual, waited / np.median(waited / counts)
    alike = max(float(np.mean(np.abs(counts - size) <= 1)) for size in expected)
    return starts if alike >= _ALIKE else None


def _are_packets(counts: NDArray[np.intp], size: int) -> bool:
    """Return whether bunches are packets of one size: what a smaller one lacks was then lost.

    A reader that polls alternately gets one more or less: the smaller bunches then follow each
    other at equal distances, which losses do not.
    """
    if float(np.mean(counts == size)) < _ALIKE:
        return False
    between = np.diff(np.flatnonzero(counts < size))
    return len(between) < _FEWEST_BUNCHES or int(np.ptp(between)) > 1


def _places(counts: NDArray[np.intp], slots: NDArray[np.intp]) -> Floats:
    """Return the place of each sample within its bunch, from 1.

    Samples missing from one packet are placed in its middle, as their place is unknown; if more
    than a packet is missing, the packets before are. In the last bunch the missing ones are at the
    end.
    """
    place = np.arange(1, counts.sum() + 1) - np.repeat(np.cumsum(counts) - counts, counts)
    lacking = slots - counts
    size = int(slots[-1])
    before = np.where(slots > size, 0, counts // 2)
    before[-1] = counts[-1]
    return np.asarray(place + np.repeat(lacking, counts) * (place > np.repeat(before, counts)))


MISSES_ONE = 1.5
"""Sample intervals between two stamps from which on a sample between them may be missing: half way
between none and one."""

_OFF_GRID = 0.03
"""Of an interval: smaller steps are not set clocks, or have no effect: missing samples shift the
stamps by whole intervals. A judgement: three times the error of sixteen intervals that are a
thousandth off."""

_ALONGSIDE = 16
"""Samples on either side of a step by which it is tested: few, as their interval is not known."""

_SINGLE = 0.4
"""Of the interval: steps within this of it are of samples in a row. A judgement: nearer to one than
to two, and to none."""
_NEARLY_ALL = 0.9  #: Share of the steps that are such where a change of the rate is looked for.
LARGEST_SLEW = 1e-3
"""Relative: twice what kernels slew a clock by. Intervals further apart are of other sample rates,
or of segments in which jitter hides how many samples are missing."""
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
"""Ticks of an interval from which on its stamps are as those that jitter. A judgement: milliseconds
at 250 Hz and less."""

_ON_TICK = 0.05  #: Of a tick: tolerance of a stamp about a whole number of them.
_ON_TICKS = 0.9
"""Share of the steps that are whole ticks: of 20 steps so many are by chance once in 10^16."""

_UNEVEN = 16
"""Steps of another number of ticks than most that show a clock of ticks: so many lost samples would
lead away from a line by more than a tick in all but one of 10^5 segments (a random walk)."""
_CUT = 0.05
"""Least share of the steps that are another number of ticks, for ticks shorter than an interval:
where fewer are, samples may be missing, or the interval is nearly a whole number of ticks
(`skip`)."""
_SEVERAL = 2  #: Ticks of an interval from which on a step shows whether a sample is missing.
_COUNTED = 3
"""Ticks of an interval from which on its stamps advance by one tick more or less now and then. Of
two, a clock that was set by half an interval looks the same."""
_ONE_TICK = 0.1  #: Quantile of the steps that are not short: one tick, some being rounded.
_NEAR_TICK = 0.1  #: Of a tick: tolerance of a step; 15.6 ms may be written in whole ms.
_WITHIN_TICKS = 1.25
"""Ticks within which stamps lie about the line of their samples: one, and the error of the line
through some tens of them."""

_SHARED = 0.05
"""Share of the bunches a tick after the one before that hold several samples: with ticks of 1.1
intervals and a fifth of the samples missing 6 %. In a queue they come after a long step."""

_WITHIN_INTERVALS = 2.0
"""Intervals within which the last samples of bunches lie about their line: one, and its error."""

_COARSE = 0.5
"""Mean steps from which on ticks that put several samples on one stamp hide how many are missing:
with ticks of 1.56 intervals (15.6 ms at 100 Hz) where up to two thirds are. A judgement."""

_LIKE = 0.2
"""Of an interval: largest difference of two estimates of it. A judgement: more than missing samples
change their mean."""

_FEW = 8
"""Samples over which the interval is taken: few enough that most such spans have no gap while one
sample in twelve is missing, and enough for jitter to be small against it."""

_CLOSE = 0.05
"""Of an interval: where eight differ by more from eight single ones, most spans hold gaps."""


_QUEUED = 0.5
"""Share of short steps up to the end from which on they belong to a queue. A judgement: more than
are short by jitter."""

_LAGS = 4  #: Fewest lags of a segment: their lower quantile is then within it.
_WITHOUT_GAP = 0.1  #: Share of the lags without a gap: the interval is taken from the lowest ones.

_WINDOW = 128
"""Samples on either side of a step that show whether stamps stay late: more than a line is held up,
a tenth of a second at 1 kHz; and so few that their interval need not be known to a thousandth."""

_NARROW = 16  #: The same in the first round of bunches, whose interval is known to a percent.
_LAYINGS = 3  #: Most rounds of fitting a line and counting the missing samples by it. A cap.

_TAIL = 32
"""Samples at the end of a segment in bunches: the last bunch is cut off, and late samples cannot be
distinguished there from missing ones."""

_FEWEST = 3  #: Fewest stamps of a line whose scatter is known.

_OUTLYING = 4.0
"""Robust standard deviations off the line beyond which a stamp gets zero weight. Normal ones exceed
them once in 16 000."""

_ROUNDS = 5  #: A cap.
_BLOCKS = 16
"""Blocks of a segment of stamps, whose means show correlated errors: a queue, a coarse clock."""

_CLEAN = 1e-3  #: Of an interval: stamps nearer than this to their line are left as they are.
_ROUNDING = 1e-9  #: Resolution of a stamp, s.


@dataclass(frozen=True, eq=False)
class SampleGrid:
    """Equal intervals fitted to the stamps of a segment."""

    #: (n,) which interval each sample ends, from 0; omitted numbers are missing.
    index: NDArray[np.int64]
    origin: float  #: Stamp of sample 0 on the line, s after the first stamp.
    period: float  #: Sample interval by these stamps alone, s.
    period_std: float  #: Its standard deviation, s; infinite where the stamps are too few.
    scatter: float  #: Of a stamp about the line, s.
    kept: NDArray[np.bool_]  #: (n,) stamps used in the fit of the line.
    tick: float = 0.0  #: Of stamps in ticks about as long as an interval, or longer, s; else 0.
    is_counted: bool = True  #: Whether the stamps show how many samples are missing.
    is_by_rows: bool = False  #: Whether `index` is that of the rows, as none is missing.

    def stamps(self, stamp: Stamps) -> Stamps:
        """Return the instants of the samples, ns; the stamps themselves where they are clean."""
        line = self.origin + self.index * self.period
        off = np.abs((stamp - stamp[0]) * 1e-9 - line)
        if float(off.max(initial=0.0)) <= _CLEAN * self.period:
            return stamp
        return np.asarray(stamp[0] + np.rint(line * 1e9).astype(np.int64))


def read_grid(
    stamp: Stamps,
    hint: float | None = None,
    number: NDArray[np.int64] | None = None,
    tick: float = 0.0,
) -> SampleGrid:
    """Fit equal intervals to increasing stamps (n,), ns.

    Args:
        stamp: (n,) ns.
        hint: About so long, s; None where it is not known.
        number: (n,) of the rows as they came in, where some were taken out; None if none was.
        tick: Of other segments whose stamps come in ticks, s; else 0.
    """
    if (ticks := _grid_of_ticks(stamp, number, tick)) is not None:
        return ticks
    time = (sampling_times(stamp)[0] - stamp[0]) * 1e-9
    cut = cut_to(stamp)
    period, bunched = _first_period(time, cut)
    if hint is not None and abs(hint - period) < _LIKE * period:
        period = hint
    index = np.arange(len(time))
    grid = _laid(time, index, period, cut)
    window = _NARROW if bunched and hint is None else _WINDOW
    for _ in range(_LAYINGS):
        counted = index + _missing_before(time, period, window, bunched=bunched)
        if window == _WINDOW and np.array_equal(counted, grid.index):
            break
        grid = _laid(time, counted, period, cut)
        period, window = grid.period, _WINDOW
    return grid


_FEW_SKIPS = 0.05
"""Of the steps: with more the scatter about a line shows what rounding does to its slope."""


def skip(stamp: Stamps) -> float:
    """Return by how much equal steps of stamps (n,), ns, skip now and then to one side, s; else 0.

    Stamps with few decimals, as of a text file, do so every time that the interval's further
    decimals add up to one of theirs.
    """
    steps = np.diff(stamp)
    off = steps - int(np.median(steps))
    some = off[off != 0]
    if not 0 < len(some) <= _FEW_SKIPS * len(steps) or abs(some.sum()) < np.abs(some).sum() / 2:
        return 0.0
    return float(np.median(np.abs(some))) * 1e-9


def cut_to(stamp: Stamps) -> float:
    """Return the tick to which stamps (n,), ns, are cut, half of their interval or less, s; else 0.

    Of an interval that is no whole number of ticks, as 416 Hz in milliseconds, steps have one of
    two numbers of ticks, and neither is the interval: the mean is.
    """
    steps = np.diff(stamp) * 1e-9
    mean = float(steps.sum()) / max(len(steps), 1)
    if len(steps) < 2 * _UNEVEN or float(np.ptp(steps)) <= _OFF_GRID * mean:
        return 0.0
    off = np.abs(steps - float(np.quantile(steps, 0.5, method='lower')))
    uneven = off > _OFF_GRID * mean
    rare = np.count_nonzero(uneven)
    # The rarer number of ticks stands alone: where it follows itself, the rate has changed.
    if rare < _CUT * len(steps) or 2 * np.count_nonzero(uneven[1:] & uneven[:-1]) > rare:
        return 0.0
    tick = float(np.median(off[uneven]))
    counts = np.rint(steps / tick)
    usual = float(np.median(counts))
    cut = np.abs(steps - counts * tick) < _NEAR_TICK * tick
    cut &= np.abs(counts - usual) <= 1
    return tick if usual >= _SEVERAL and np.mean(cut) >= _ON_TICKS else 0.0


def uncut_interval(stamp: Stamps) -> float:
    """Return the interval of stamps (n,), ns, that are cut to a tick (`cut_to`), ns; else 0."""
    tick = cut_to(stamp)
    return _first_period((stamp - stamp[0]) * 1e-9, tick)[0] * 1e9 if tick else 0.0


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


def rate_changes(stamp: Stamps) -> list[int]:
    """Return where the sample rate changes for good within stamps (n,), ns.

    Returns:
        The first sample whose interval is another, if there is one; of several changes the largest.
    """
    steps = np.diff(stamp) * 1e-9
    if len(steps) < 2 * _ALONGSIDE:
        return []
    off = steps / float(np.median(steps)) - 1
    single = np.flatnonzero(np.abs(off) < _SINGLE)
    off, n = off[single], len(single)
    if n < _NEARLY_ALL * len(steps) or n < 2 * _ALONGSIDE or float(np.ptp(off)) < LARGEST_SLEW:
        return []
    count = np.arange(_ALONGSIDE, n - _ALONGSIDE + 1)
    sums = np.cumsum(off)[count - 1]
    apart = np.abs(sums / count - (off.sum() - sums) / (n - count))
    k = int(count[np.argmax(apart * np.sqrt(count * (n - count)))])
    # One late stamp moves a mean, but no median.
    levels = np.median(off[:k]), np.median(off[k:])
    scatter = math.hypot(*(float(np.std(one)) / math.sqrt(len(one)) for one in (off[:k], off[k:])))
    if abs(levels[1] - levels[0]) <= max(LARGEST_SLEW, _SURELY * MEDIAN_ERROR * scatter):
        return []
    return [int(single[k]) + 1]


def _is_tick(step: float, stamp: Stamps, period: float) -> bool:
    """Return whether a step, s, is one tick of the stamps."""
    if not 0 < step * _COUNTED <= period * (1 + _ON_TICK):
        return False
    ticks = np.diff(stamp) * 1e-9 / step
    return bool(np.mean(np.abs(ticks - np.rint(ticks)) < _ON_TICK) >= _ON_TICKS)


def _hasty(steps: Floats, interval: float) -> bool:
    """Return whether a quarter of the steps, s, is far shorter than an interval, s."""
    limit = SHORT * interval
    return float(steps.min()) < limit and float(np.quantile(steps, 0.25)) < limit


def _grid_of_ticks(
    stamp: Stamps, number: NDArray[np.int64] | None = None, known: float = 0.0
) -> SampleGrid | None:
    """Fit equal intervals to stamps in ticks about as long as an interval, or longer; else None.

    Fewer steps of another number of ticks show the tick, s, that is known of other segments.

    Ticks of a clock, or of a reader that polls, put each stamp within a tick of the line on which
    the samples lie, if none is missing. Missing ones lead away from that line; where several
    samples share a tick, nothing shows how many.
    """
    steps = np.diff(stamp) * 1e-9
    mean = float(steps.sum()) / max(len(steps), 1)
    if len(steps) < 2 * _UNEVEN or float(np.ptp(steps)) <= _OFF_GRID * mean:
        return None
    advances, cut = steps > SHORT * mean, cut_to(stamp)
    # Of finer ticks the steps of a coarse clock may be written in.
    cut = cut if cut * _TICKS >= mean else 0.0
    tick = cut or float(np.quantile(steps[advances], _ONE_TICK))
    counts = np.rint(steps / tick)
    on_tick = np.abs(steps - counts * tick) < _NEAR_TICK * tick
    least = 1 if abs(tick - known) < _NEAR_TICK * known else _UNEVEN
    if tick * _TICKS < mean or _uneven(counts) < least or np.mean(on_tick) < _ON_TICKS:
        return None
    starts = _bunches(stamp)
    if starts is not None and _pattern(stamp, starts).size is not None:
        return None
    time = (stamp - stamp[0]) * 1e-9
    index = np.arange(len(stamp)) if number is None else number - number[0]
    grid = _laid(time, index, mean, cut)
    if float(np.ptp(time - index * grid.period)) <= _WITHIN_TICKS * tick:
        # Between ticks shorter than an interval a missing sample is seen: they need no note.
        return replace(grid, tick=0.0 if cut else tick, is_by_rows=True)
    is_coarse = tick >= _COARSE * mean and np.mean(on_tick[advances]) >= _ON_TICKS
    if cut or not is_coarse or not _shares_ticks(np.flatnonzero(advances), counts):
        return None
    all_came = _all_came(time, mean)
    return replace(grid, tick=tick, is_counted=all_came, is_by_rows=all_came)


def _uneven(counts: Floats) -> int:
    """Return how many steps (n,), in ticks, have another number of ticks than most."""
    uneven = counts - np.median(counts)
    if counts.min() == 1 == np.median(counts) and np.count_nonzero(uneven) < _CUT * len(counts):
        # One tick but for a few longer ones: an interval, and samples are missing.
        return 0
    # A stamp that is late by itself makes two steps that cancel: jitter, and no tick.
    late = np.append(uneven[:-1] + uneven[1:] == 0, False)
    uneven[late | np.append(False, late[:-1])] = 0
    return int(np.count_nonzero(uneven))


def _shares_ticks(advances: NDArray[np.intp], counts: Floats) -> bool:
    """Return whether samples share a stamp a tick after the one before: no queue does that."""
    after_one = np.diff(advances)[counts[advances[:-1]] == 1]
    shared = np.count_nonzero(after_one > 1)
    return bool(shared >= max(_UNEVEN, _SHARED * len(after_one)))


def _all_came(time: Floats, interval: float) -> bool:
    """Return whether the last samples of bunches lie on a line: a reader that was kept waiting.

    It takes all that were made since it came before, however long ago that is; missing samples
    lead away from the line.
    """
    last = np.flatnonzero(np.diff(time) > SHORT * interval)
    grid = _laid(time[last], last, interval)
    return float(np.ptp(time[last] - last * grid.period)) <= _WITHIN_INTERVALS * interval


def _first_period(time: Floats, tick: float = 0.0) -> tuple[float, bool]:
    """Return the sample interval within a percent or so, s, and whether samples come in bunches.

    Stamps that are cut to a tick, s, show it over longer spans.
    """
    steps = np.diff(time)
    few = min(_FEW, len(steps))
    typical, single = float(np.median(time[few:] - time[:-few])) / few, float(np.median(steps))
    if tick:
        return _uncut_period(time, typical, tick), False
    if not _hasty(steps, typical):
        return typical if abs(typical - single) < _CLOSE * single else single, False
    waits = np.flatnonzero(steps > SHORT * typical)
    bunch = max(1, int(np.median(np.diff(waits)))) if len(waits) > 1 else 1
    lag = max(bunch, min(LAG, len(steps) // _LAGS) // bunch * bunch)
    return float(np.quantile(time[lag:] - time[:-lag], _WITHOUT_GAP)) / lag, True


def _uncut_period(time: Floats, period: float, tick: float) -> float:
    """Return the interval of stamps cut to a tick, s: the mean over longer and longer spans.

    Those without a gap are off by a tick at most.
    """
    lag = _FEW
    while lag <= min(_WINDOW, len(time) // 2):
        spans = time[lag:] - time[:-lag]
        near = np.abs(spans - lag * period) <= max(tick, period / 2)
        period = float(spans[near].mean()) / lag if near.any() else period
        lag *= 2
    return period


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
    for k in (np.flatnonzero(np.diff(time) > MISSES_ONE * period) + 1).tolist():
        first = max(0, k - window)
        if bunched and len(time) - k < _TAIL:
            break
        after = late[k : k + window]
        behind = np.diff(time[k:]) < SHORT * period
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


def _laid(time: Floats, index: NDArray[np.int64], period: float, tick: float = 0.0) -> SampleGrid:
    """Fit a robust line time = origin + period index to stamps that are cut to a tick, s."""
    n = len(time)
    if n < _FEWEST:
        step = float(time[-1]) / max(1, int(index[-1]))
        everything = np.ones(n, dtype=bool)
        return SampleGrid(index, 0.0, step, float('inf'), 0.0, everything)
    kept = _near(time - index * period, tick)
    for _ in range(_ROUNDS):
        some, instants = (index, time) if kept.all() else (index[kept], time[kept])
        middle, mean = float(some.mean()), float(instants.mean())
        centred = some - middle
        slope = float(centred @ instants / (centred @ centred))
        residuals = time - mean - slope * (index - middle)
        near = _near(residuals, tick)
        if np.array_equal(near, kept):
            break
        kept = near
    spread = float(centred @ centred)
    variance = _in_common(residuals[kept]) + _ROUNDING**2 / 12
    scatter = float(np.sqrt(np.mean(residuals[kept] ** 2)))
    return SampleGrid(
        index, mean - slope * middle, slope, float(np.sqrt(variance / spread)), scatter, kept
    )


def _near(residuals: Floats, tick: float = 0.0) -> NDArray[np.bool_]:
    """Return which residuals (n,), s, are not outliers; always more than half of them.

    Cut to a tick, s, they may have two values, and the median deviation be 0.
    """
    if float(np.ptp(residuals)) <= 2 * _ROUNDING:
        return np.ones(len(residuals), dtype=bool)
    off = np.abs(residuals - np.median(residuals))
    return np.asarray(off <= _OUTLYING * MAD_TO_STD * float(np.median(off)) + 2 * _ROUNDING + tick)


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


_FIRST_CAPACITY = 1024  #: Rows. A choice: it doubles when it is full.


class RowBuffer:
    """Rows (stamp, values) in order of their stamps; appending is amortised constant.

    It holds at most three times the bytes of its largest content since the last reallocation: twice
    that for new rows, and the former memory while rows are copied. Rows in the buffer are never
    overwritten: views stay valid.
    """

    def __init__(self, columns: int) -> None:
        self._stamp: Stamps = np.empty(_FIRST_CAPACITY, dtype=np.int64)
        self._values: Floats = np.empty((_FIRST_CAPACITY, columns))
        self._first = 0
        self._last = 0
        self.removed = 0  #: Number of rows that were removed, the first ones.

    def __len__(self) -> int:
        return self._last - self._first

    def __deepcopy__(self, _: object) -> RowBuffer:
        """Return a separate buffer with the same rows and no spare capacity."""
        other = RowBuffer(self._values.shape[1])
        other.removed = self.removed
        other._allot(len(self) + _FIRST_CAPACITY, self)
        return other

    @property
    def stamp(self) -> Stamps:
        """Stamps (n,) of the rows, ns, a view."""
        return self._stamp[self._first : self._last]

    @property
    def values(self) -> Floats:
        """Values (n, columns) of the rows, a view."""
        return self._values[self._first : self._last]

    def append(self, stamp: Stamps, values: Floats) -> None:
        """Append (n,) stamps and (n, columns) values."""
        needed = len(self) + len(stamp)
        if self._last + len(stamp) > len(self._stamp):
            self._allot(max(_FIRST_CAPACITY, 2 * needed), self)
        end = self._last + len(stamp)
        self._stamp[self._last : end], self._values[self._last : end] = stamp, values
        self._last = end

    def _allot(self, capacity: int, rows: RowBuffer) -> None:
        """Copy the rows of a buffer, which may be this one, into a memory for so many."""
        stamp = np.empty(capacity, dtype=np.int64)
        values = np.empty((capacity, rows._values.shape[1]))
        stamp[: len(rows)], values[: len(rows)] = rows.stamp, rows.values
        self._first, self._last = 0, len(rows)
        self._stamp, self._values = stamp, values

    def between(self, start: int, end: int) -> tuple[Stamps, Floats]:
        """Return the rows with start < stamp <= end: stamps (n,), values (n, columns).

        They are read-only views: a dwell of a million samples is not copied.
        """
        a, b = np.searchsorted(self.stamp, [start, end], side='right')
        stamp, values = self.stamp[a:b], self.values[a:b]
        stamp.flags.writeable = values.flags.writeable = False
        return stamp, values

    def remove_until(self, stamp: int) -> None:
        """Remove the rows with stamps up to `stamp`."""
        self.remove_first(int(np.searchsorted(self.stamp, stamp, side='right')))

    def remove_first(self, count: int) -> int:
        """Remove so many of the first rows, none if below zero; return how many."""
        removed = max(0, count)
        self._first += removed
        self.removed += removed
        return removed
