"""Lost samples of counters: their counts, reconstructed from the samples around them.

A counter counts on while a message is lost. Lines of one slope through the counts before and after
give its gain between them, to a fraction of a pulse as long as the rate is constant; and the gain
is a whole number (docs/mathematics.md, 'Stamps and lost samples').
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace
from functools import cache, lru_cache

import numpy as np
from numpy.typing import NDArray

from ..common.stream import NS, Floats, Stamps, Units, at
from ..common.units import DEG, counted
from .counters import READING_VARIANCE, runs_of
from .false_samples import Rows
from .stamps import MISSES_ONE
from .statistics import Samples, gap_free

LONGEST = 0.1
"""Longest gap that is bridged, s. A judgement: at rest and in steady turns the rate is the same
over it; a longer one is a stop of the stream."""

_MOST = 0.1
"""Share of a segment that may be bridged: more is not caused by a line that drops a message."""

LONGEST_HELD, _MOST_HELD = 1.0, 0.25
"""The same of a hold in the hand whose values are not pulses, s. A judgement: what the hand does in
the gap is known by what it does in the rest of the hold, and its mean attitude needs the whole."""

_REACHES: tuple[int, ...] = tuple(1 << k for k in range(14))
"""Samples on either side that a gap may be read from: a counter of one pulse in ten seconds at 100
Hz shows its phase within 5000."""

_PLAIN = 8
"""The same for values that are not pulses: their noise falls with the root, and this adds 3 % to
the cost of a lost sample."""

_UNKNOWN = 0.25
"""Largest variance of a count between two readings of a counter of unknown phase. It is p (1 - p)
of one pulse more or less."""

_PHASE = 0.2
"""Variance of a gap's count where the counter passes one pulse on either side of it; it falls with
the square of their number (simulated: 0.17, 0.04 for two, 0.006 for five)."""

_RESONANT = 1.5
"""By how much readings of a counter at a rational rate may scatter more than independent ones: for
99 in 100 rates p/q, q up to 40, read from 8 to 1024 samples on either side. Near half a pulse a
sample it is up to 3.5 (simulated)."""

_SWEEPS = 4
"""Most times that each gap is read, each time beside others that are filled better. A cap."""

_SETTLED = 0.05
"""Change of a gap's count, pulses, below which reading it again is useless. A judgement: a tenth of
half a pulse, at which it is rounded."""

_LEAST_VARIANCE = 1e-4  #: Pulses squared: less is rounding.
_SURE = 0.01
"""Variance of a gap's count, pulses squared, from which on its whole number is sure: half a pulse
is five standard deviations."""

_WIDE = 2.0
"""Standard deviation of a gap's count, pulses, from which on whole numbers are as good as any:
their sum is then the integral, and the seventeen that are tried would hold only four deviations."""

_NEVER = 1e-9  #: Least weight of any whole number: rates may change.


@dataclass(frozen=True, eq=False)
class Bridged:
    """Samples without short gaps."""

    samples: Samples  #: With rows for those that were lost.
    rows: NDArray[np.intp]  #: (n,) of the samples as they came; -1 for those that were lost.

    @property
    def lost(self) -> int:
        """Number of samples that were lost and are bridged."""
        return int(np.count_nonzero(self.rows < 0))

    def values(self, values: Floats) -> Floats:
        """Return the delivered rows, with rows of NaN for lost samples."""
        lost = (self.rows < 0)[:, None]
        if not lost.any():
            # No sample was lost: return the array without a copy.
            return values
        return np.asarray(np.where(lost, np.nan, values[np.maximum(self.rows, 0)]))


def bridged(
    samples: Samples, walk: Floats, reach: int | None = None, *, held: bool = False
) -> Bridged:
    """Fill short gaps.

    Args:
        samples: Whose stamps lie on a grid.
        walk: (6,) random-walk coefficients to choose the reach by, rad/sqrt(s) and (m/s)/sqrt(s).
        reach: Samples on either side to read from; chosen by the noise, for a steady rate, if not
            given. Use one where the rate changes steadily.
        held: Whether it is a hold in the hand, in which longer gaps are filled, too.
    """
    held &= not samples.pulse.any()
    longest, most = (LONGEST_HELD, _MOST_HELD) if held else (LONGEST, _MOST)
    runs = gap_free(samples.stamp, samples.period)
    starts = [first for first, _ in runs[1:]]
    intervals = np.diff(samples.stamp)[np.array(starts, dtype=int) - 1] * 1e-9 / samples.period
    gaps = (np.rint(intervals).astype(int) - 1).tolist()
    short = [0 < m <= max(1, round(longest / samples.period)) for m in gaps]
    lost = sum(m for m, fits in zip(gaps, short, strict=True) if fits)
    if not lost or lost > most * (len(samples.stamp) + lost):
        return Bridged(samples, np.arange(len(samples.stamp)))
    rows = _with_gaps(runs, gaps, short)
    stamps = samples.stamp[np.maximum(rows, 0)]
    holes = _holes(rows, runs, short)
    for hole in holes:
        before, after = stamps[hole.start - 1], stamps[hole.stop]
        between = float(after - before) / (hole.stop - hole.start + 1)
        steps = np.arange(1, hole.stop - hole.start + 1)
        stamps[hole.start : hole.stop] = before + np.rint(between * steps).astype(np.int64)
    increments = samples.increments[np.maximum(rows, 0)]
    variance = np.zeros(6)
    noise = walk * math.sqrt(samples.period)
    for c, pulse in enumerate(samples.pulse.tolist()):
        if pulse:
            counts = np.rint(increments[:, c] / pulse)
            variance[c] = _count(counts, holes, noise[c] / pulse, reach) * pulse**2
            increments[:, c] = np.where(rows < 0, counts * pulse, increments[:, c])
        else:
            near = reach or _PLAIN
            total = _average(increments[:, c], rows, holes, near) * noise[c] ** 2
            seen = _seen(increments[:, c], rows < 0, holes, near) if held else 0.0
            # A hand trembles, whether the noise is stated or not.
            variance[c] = max(total, seen)
    whole = replace(
        samples, stamp=stamps, increments=increments, filled=rows < 0, bridged=variance / len(holes)
    )
    return Bridged(whole, rows)


def filled_at_steady_rate(samples: Samples, walk: Floats) -> Samples:
    """Fill the gaps of samples at a steady rate anew, from as many around them as help."""
    if samples.filled is None or not samples.filled.any():
        return samples
    return bridged(replace(samples.at(~samples.filled), filled=None), walk).samples


@dataclass(frozen=True)
class _Hole:
    """A run of lost samples, as half-open ranges of rows."""

    start: int  #: The first lost row.
    stop: int  #: The first row after it.
    first: int  #: The first row around it without a long gap between.
    last: int  #: The row after the last of these.


def _with_gaps(runs: list[tuple[int, int]], gaps: list[int], short: list[bool]) -> NDArray[np.intp]:
    """Return the rows of all samples in order, -1 for those of short gaps."""
    pieces = []
    for k, run in enumerate(runs):
        pieces.append(np.arange(*run))
        if k < len(gaps) and short[k]:
            pieces.append(np.full(gaps[k], -1))
    return np.concatenate(pieces)


def _holes(rows: NDArray[np.intp], runs: list[tuple[int, int]], short: list[bool]) -> list[_Hole]:
    """List the rows to be filled, in order."""
    starts, stops = runs_of(rows < 0).T.tolist()
    # Long gaps are where one run ends and the next begins, with nothing between to be filled.
    begins = [run[0] for run, fits in zip(runs[1:], short, strict=True) if not fits]
    walls = [0, *np.flatnonzero(np.isin(rows, begins)).tolist(), len(rows)]
    which = np.searchsorted(walls, starts, side='right')
    return [
        _Hole(a, b, walls[w - 1], walls[w])
        for a, b, w in zip(starts, stops, which.tolist(), strict=True)
    ]


def _average(increments: Floats, rows: NDArray[np.intp], holes: list[_Hole], reach: int) -> float:
    """Fill holes with the mean around them, in place; return the variance in that of a sample."""
    total = 0.0
    came = np.flatnonzero(rows >= 0)
    places = np.searchsorted(came, [hole.start for hole in holes])
    for hole, place in zip(holes, places.tolist(), strict=True):
        near = came[max(0, place - reach) : place + reach]
        near = near[(near >= hole.first) & (near < hole.last)]
        missing = hole.stop - hole.start
        increments[hole.start : hole.stop] = increments[near].mean()
        # The noise of the lost samples is not in the sum, but their neighbours have more weight.
        total += missing + missing**2 / len(near)
    return total


def _seen(increments: Floats, lost: NDArray[np.bool_], holes: list[_Hole], reach: int) -> float:
    """Return the variance of all that was filled in: that of the same where nothing is missing.

    As many samples in a row, anywhere in (n,) increments, are compared with the mean of `reach` on
    either side of them.
    """
    sums, gone = (np.append(0.0, np.cumsum(part)) for part in (increments, lost))
    total = 0.0
    for missing, times in Counter(hole.stop - hole.start for hole in holes).items():
        # Fewer beside it where the whole is short.
        beside = min(reach, (len(increments) - missing) // 4)
        first = np.arange(beside, len(increments) - missing - beside + 1)
        last = first + missing
        whole = gone[last + beside] == gone[first - beside]
        first, last = first[whole], last[whole]
        if not beside or not len(first):
            total += times * missing**2 * float(np.var(increments))
            continue
        around = sums[first] - sums[first - beside] + sums[last + beside] - sums[last]
        errors = sums[last] - sums[first] - missing * around / (2 * beside)
        total += times * float(np.mean(errors**2))
    return total


def _count(counts: Floats, holes: list[_Hole], noise: float, reach: int | None) -> float:
    """Fill holes of (n,) pulses with whole numbers, in place; return the remaining variance.

    The noise is a sample's random walk, pulses; the reach is chosen, at a steady rate, if None.
    """
    empty = np.zeros(len(counts), dtype=bool)
    for hole in holes:
        empty[hole.start : hole.stop] = True
    rate = float(counts[~empty].mean())
    chosen = reach or _best_reach(rate, noise)
    counts[empty] = rate
    means, total = np.full(len(holes), rate), 0.0
    for _ in range(_SWEEPS):
        total, before = 0.0, means.copy()
        for k, hole in enumerate(holes):
            missing = hole.stop - hole.start
            a = counts[max(hole.first, hole.start - chosen) : hole.start]
            b = counts[hole.stop : min(hole.last, hole.stop + chosen)]
            gain = _gain(len(a), len(b), missing)
            pulses = float(gain.before @ -_summed(a[::-1]) + gain.after @ _summed(b))
            variance = 0.0
            if reach is None:
                spread = gain.variance(rate, noise, min(len(a), len(b)))
                pulses, variance = _likely(pulses, spread, rate * missing, missing * noise**2)
            means[k], total = pulses, total + variance
            # Not yet rounded: a wrong whole number would change the neighbouring gaps.
            counts[hole.start : hole.stop] = pulses / missing
        if np.abs(means - before).max() < _SETTLED:
            break
    carried = 0.0
    for hole, mean in zip(holes, means.tolist(), strict=True):
        # If each gap of unknown count were rounded by itself, all would err to the same side.
        edges = np.linspace(0.0, round(mean + carried), hole.stop - hole.start + 1)
        counts[hole.start : hole.stop] = np.diff(np.rint(edges))
        carried += mean - float(counts[hole.start : hole.stop].sum())
    return total


def _summed(pulses: Floats) -> Floats:
    """Return the reading of a counter at the ends of intervals, 0 at first."""
    return np.concatenate([[0.0], np.cumsum(pulses)])


@dataclass(frozen=True, eq=False)
class _Gain:
    """A gap's count from the counts around it: weights, and the remaining variance."""

    before: Floats  #: Weights of the counts from the gap backwards, 0 at the gap.
    after: Floats  #: Of those from the gap onwards.
    read: float  #: Multiplies the variance of one reading of the counter.
    walked: float  #: Multiplies the variance that the random walk adds in one sample.

    def variance(self, rate: float, noise: float, reach: int) -> float:
        """Return the variance, pulses squared, of pulses per sample, their walk, and the reach."""
        # Whole pulses per sample do not determine the phase.
        passed = reach * abs(rate - round(rate))
        phase = min(_UNKNOWN, _PHASE / passed**2 if passed else _UNKNOWN)
        # A walk of a pulse passes one level, too.
        if noise * math.sqrt(reach) > 1:
            phase = 0.0
        return max(phase, _RESONANT * self.read * READING_VARIANCE) + self.walked * noise**2


@lru_cache(maxsize=64)
def _gain(before: int, after: int, missing: int) -> _Gain:
    """Return the weights of two lines of one slope, by least squares."""
    x, y = -np.arange(before + 1.0), missing + np.arange(after + 1.0)
    apart = float(y.mean() - x.mean())
    x, y = x - x.mean(), y - y.mean()
    slope = apart / float(x @ x + y @ y)
    a, b = slope * x + 1 / (before + 1), slope * y - 1 / (after + 1)
    # A sample moves all counts beyond it, seen from the gap.
    moved = np.concatenate([np.cumsum(a[::-1])[:-1], np.cumsum(b[::-1])[:-1]])
    return _Gain(a, b, float(a @ a + b @ b), float(moved @ moved) + missing)


def _best_reach(rate: float, noise: float) -> int:
    """Return the number of samples on either side that reads a gap best."""
    variances = [_gain(k, k, 1).variance(rate, noise, k) for k in _REACHES]
    sure = [k for k, variance in zip(_REACHES, variances, strict=True) if variance <= _SURE]
    # No further than needed: other gaps may lie there.
    return sure[0] if sure else _REACHES[variances.index(min(variances))]


def _likely(pulses: float, variance: float, expected: float, walked: float) -> tuple[float, float]:
    """Combine the counts around a gap with the mean rate: return mean and variance, pulses.

    The variance is that of `pulses`; `walked` is the variance that the walk adds to `expected`.
    """
    variance = max(variance, _LEAST_VARIANCE)
    if variance + walked > _WIDE**2:
        own, other = 1 / variance, 1 / (walked + 2 * READING_VARIANCE)
        return (own * pulses + other * expected) / (own + other), 1 / (own + other)
    whole = round(expected) + np.arange(-8.0, 9.0)
    standard, weights = _quadrature()
    nodes = expected + math.sqrt(walked) * standard
    # For a counter of uniform phase, x pulses are n with a probability of 1 - |x - n|.
    likely = np.maximum(0.0, 1 - np.abs(whole[:, None] - nodes)) @ weights
    likely += _NEVER
    if variance < _UNKNOWN:
        # Where the counter passes no pulse its phase is unknown: the line is given no weight.
        likely *= np.exp(-((whole - pulses) ** 2 - ((whole - pulses) ** 2).min()) / (2 * variance))
    likely /= likely.sum()
    mean = float(likely @ whole)
    return mean, float(likely @ (whole - mean) ** 2)


@cache
def _quadrature() -> tuple[Floats, Floats]:
    """Return nodes and weights over the normal law: exact for polynomials up to degree 13."""
    # Few recordings need it, and numpy loads its polynomials on first use.
    return np.polynomial.hermite_e.hermegauss(7)


_BESIDE = 8
"""Samples on either side of one that show what is usual: enough that others after gaps, which
stand out as well, can be left out, and few enough that a joint hardly changes its rate."""
_TRIMMED = 9.2
"""The variance of Gaussian samples over the mean square of the smaller half of sixteen deviations,
simulated: the others may be those of other gaps."""
_READINGS = 1 / 6  #: Variance of a count, pulses squared: of two readings of uniform phase.
_DIFFERS = 45.0
"""Chi-square of six channels from which on a sample differs from those around: gravity, twice at
once, makes it 140 for a counter of five pulses a sample, and far more for others."""
_FITS = 0.1
"""Share of it that is left for a multiple of them. A judgement: a multiple leaves some six, of
which the variance, of few samples, may make hundreds where gravity alone makes 10^5; a knock leaves
as much of one direction as of another."""
_LEAST = np.repeat([0.1 * DEG, 0.01], 3)
"""rad/s and m/s^2: least deviation of values that are no whole numbers, as of `false_samples`."""


@dataclass(frozen=True)
class DifferencedCounts:
    """Samples that held the counts of lost ones."""

    count: int = 0  #: Number of those samples.
    lost: int = 0  #: Number of samples whose counts they held.
    dropped: int = 0  #: Of the former, those after gaps too long to divide their counts.
    first: int = 0  #: Stamp of the first, ns; 0 without one.
    of: str = ''  #: The sensor in sentences; empty for the IMU.

    @property
    def sentences(self) -> list[str]:
        """A sentence on them, without a full stop; empty without any."""
        if not self.count:
            return []
        after = (
            f'{counted(self.count, "sample")}{self.of}, the first at {at(self.first)}, '
            f'{"holds" if self.count == 1 else "hold"} the counts of {self.lost} lost before, too: '
            'the driver differences a counter over lost messages. Their counts are divided among '
            'all of them'
        )
        if self.dropped:
            after += f'; {self.dropped} after gaps of more than {LONGEST:g} s are left out'
        return [after]


class CountsAfterGaps:
    """Divides counts over lost samples; the result does not depend on how the stream is cut.

    The last `_BESIDE` samples wait for those after them. Rates are counts over the interval that
    the driver assumes.

    Args:
        units: Of the values.
        scale: (6,) nominal scale factors of the values, SI.
        of: The sensor in sentences; empty for the IMU.
    """

    def __init__(self, units: Units, scale: Floats, of: str = '') -> None:
        self.found = DifferencedCounts(of=of)  #: What was divided.
        self.parts: set[int] = set()  #: Stamps of what came of it, ns: these samples are alike.
        self._units, self._scale = units, scale
        self._rows = Rows(np.empty(0, dtype=np.int64), np.empty((0, 6)))
        self._judged = 0
        """The number of these, the first ones, that are kept for those after them alone."""

    def divide(self, stamp: Stamps, values: Floats) -> Rows:
        """Add (n,) stamps, ns, with (n, 6) values; return the rows that are certain."""
        if len(self._rows.stamp):
            stamp = np.concatenate([self._rows.stamp, stamp])
            values = np.concatenate([self._rows.values, values])
        # The first ones are judged by as many.
        end = len(stamp) - _BESIDE if len(stamp) > 2 * _BESIDE else 0
        return self._passed(Rows(stamp, values), end)

    def finish(self) -> Rows:
        """End the stream: return the rows that wait."""
        return self._passed(self._rows, len(self._rows.stamp))

    def _passed(self, rows: Rows, end: int) -> Rows:
        """Return the rows up to `end` that have not been judged yet, divided."""
        first = self._judged
        if end <= first:
            self._rows = rows
            return Rows(rows.stamp[:0], rows.values[:0])
        where, missing = self._holding_more(rows, first, end)
        begin = max(0, end - 2 * _BESIDE)
        # Copies: views would keep the whole block.
        self._rows = Rows(rows.stamp[begin:].copy(), rows.values[begin:].copy())
        self._judged = end - begin
        if not len(where):
            return Rows(rows.stamp[first:end], rows.values[first:end])
        return self._divided(rows, first, end, where, missing)

    def _holding_more(
        self, rows: Rows, first: int, end: int
    ) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
        """Return which rows of a range hold the counts of lost ones, and of how many, (k,)."""
        stamp, values = rows
        asked = np.arange(max(first, 1), end)
        none = np.empty(0, dtype=np.intp)
        if not len(asked) or len(stamp) <= 2 * _BESIDE:
            return none, none.astype(np.int64)
        steps = np.diff(stamp)
        # A cheap test first: a gap is longer than one of the two steps on either side.
        near = np.clip(asked + np.array([[-3], [-2], [0], [1]]), 0, len(steps) - 1)
        asked = asked[steps[asked - 1] > MISSES_ONE * steps[near].min(axis=0)]
        # At the ends of the stream more of them are on one side.
        begin = np.clip(asked - _BESIDE, 0, len(stamp) - 2 * _BESIDE - 1)[:, None]
        beside = begin + np.arange(2 * _BESIDE)
        interval = np.median(steps[beside], axis=1)
        spans = np.rint(steps[asked - 1] / np.maximum(interval, 1.0)).astype(np.int64)
        several = spans > 1
        asked, beside, interval, spans = (x[several] for x in (asked, beside, interval, spans))
        if not len(asked):
            return none, none.astype(np.int64)
        around = values[beside + (beside >= asked[:, None])]
        sides = np.median(around.reshape(len(asked), 2, _BESIDE, 6), axis=2)
        usual = sides.mean(axis=1)
        deviations = (around - np.repeat(sides, _BESIDE, axis=1)) ** 2
        kept = np.sort(deviations, axis=1)[:, :_BESIDE]
        floor: float | Floats = _READINGS
        if not self._units.whole:
            gained = interval[:, None] / NS if self._units.per_interval else 1.0
            floor = (_LEAST * gained / self._scale) ** 2
        variance = np.maximum(_TRIMMED * kept.mean(axis=1), floor)
        # The rate between both sides is unknown by half of their difference.
        variance += (np.diff(sides, axis=1)[:, 0] / 2) ** 2
        many = spans[:, None].astype(float)
        own = values[asked]
        single = ((own - usual) ** 2 / variance).sum(axis=1)
        multiple = ((own - many * usual) ** 2 / (many**2 * variance)).sum(axis=1)
        holds = (single > _DIFFERS) & (multiple < _FITS * single)
        return asked[holds], spans[holds] - 1

    def _divided(
        self,
        rows: Rows,
        first: int,
        end: int,
        where: NDArray[np.intp],
        missing: NDArray[np.int64],
    ) -> Rows:
        """Return the rows of a range with the counts of some divided evenly over lost ones."""
        gaps = rows.stamp[where] - rows.stamp[where - 1]
        short = gaps <= (LONGEST + gaps / (missing + 1) / NS) * NS
        found = self.found
        self.found = replace(
            found,
            count=found.count + len(where),
            lost=found.lost + int(missing.sum()),
            dropped=found.dropped + int(np.count_nonzero(~short)),
            first=found.first or int(rows.stamp[where[0]]),
        )
        stamps, values, done = [], [], first
        for k, lost, fits in zip(where.tolist(), missing.tolist(), short.tolist(), strict=True):
            stamps.append(rows.stamp[done:k])
            values.append(rows.values[done:k])
            done = k + 1
            if fits:
                shares = np.linspace(0.0, 1.0, lost + 2)
                before = int(rows.stamp[k - 1])
                reached = np.rint(shares[1:] * (int(rows.stamp[k]) - before)).astype(np.int64)
                sums = shares[:, None] * rows.values[k]
                stamps.append(before + reached)
                self.parts.update(stamps[-1].tolist())
                values.append(np.diff(np.rint(sums) if self._units.whole else sums, axis=0))
        stamps.append(rows.stamp[done:end])
        values.append(rows.values[done:end])
        return Rows(np.concatenate(stamps), np.concatenate(values))
