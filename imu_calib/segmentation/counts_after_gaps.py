"""Samples that hold the counts of lost ones: of drivers that difference a counter.

A counter counts on while messages are lost. If the difference to the last message that came is
delivered as the next sample, that sample holds the counts of all lost ones besides its own, and
filling the gap would count them twice. Gravity shows which: no accelerometer triad reads an
integer multiple of the samples around it for one sample alone.

Source: docs/mathematics.md, 'Stamps and lost samples'.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..common.stream import NS, Floats, Stamps, Units, at
from ..common.units import DEG, counted
from .false_samples import Rows
from .gaps import LONGEST
from .stamps import MISSES_ONE

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

    The last `_BESIDE` samples wait for those after them. Values that are rates pass unchanged.

    Args:
        units: Of the values.
        scale: (6,) nominal scale factors of the values, SI.
        of: The sensor in sentences; empty for the IMU.
    """

    def __init__(self, units: Units, scale: Floats, of: str = '') -> None:
        self.found = DifferencedCounts(of=of)  #: What was divided.
        self._units, self._scale = units, scale
        self._rows = Rows(np.empty(0, dtype=np.int64), np.empty((0, 6)))
        self._judged = 0
        """The number of these, the first ones, that are kept for those after them alone."""

    def divide(self, stamp: Stamps, values: Floats) -> Rows:
        """Add (n,) stamps, ns, with (n, 6) values; return the rows that are certain."""
        if not self._units.per_interval:
            return Rows(stamp, values)
        if len(self._rows.stamp):
            stamp = np.concatenate([self._rows.stamp, stamp])
            values = np.concatenate([self._rows.values, values])
        return self._passed(Rows(stamp, values), len(stamp) - _BESIDE)

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
        begin = max(0, end - _BESIDE)
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
        asked = np.arange(max(first, _BESIDE), min(end, len(stamp) - _BESIDE))
        none = np.empty(0, dtype=np.intp)
        if not len(asked):
            return none, none.astype(np.int64)
        steps = np.diff(stamp)
        # A cheap test first: a gap is longer than one of the two steps on either side.
        least = np.minimum(steps[asked - 2], steps[asked])
        least = np.minimum(least, np.minimum(steps[asked - 3], steps[asked + 1]))
        asked = asked[steps[asked - 1] > MISSES_ONE * least]
        beside = np.concatenate([np.arange(-_BESIDE, 0), np.arange(1, _BESIDE + 1)])
        interval = np.median(steps[asked[:, None] + beside[1:] - 1], axis=1)
        spans = np.rint(steps[asked - 1] / np.maximum(interval, 1.0)).astype(np.int64)
        several = spans > 1
        asked, interval, spans = asked[several], interval[several], spans[several]
        if not len(asked):
            return none, none.astype(np.int64)
        around = values[asked[:, None] + beside]
        sides = np.median(around.reshape(len(asked), 2, _BESIDE, 6), axis=2)
        usual = sides.mean(axis=1)
        deviations = (around - np.repeat(sides, _BESIDE, axis=1)) ** 2
        kept = np.sort(deviations, axis=1)[:, :_BESIDE]
        floor = _READINGS
        if not self._units.whole:
            floor = (_LEAST * interval[:, None] / NS / self._scale) ** 2
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
                values.append(np.diff(np.rint(sums) if self._units.whole else sums, axis=0))
        stamps.append(rows.stamp[done:end])
        values.append(rows.values[done:end])
        return Rows(np.concatenate(stamps), np.concatenate(values))
