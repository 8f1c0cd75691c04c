"""How long each sample interval was, by the stamps of the samples."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..stream import Floats, Stamps

_LEARNT = 32
"""Intervals that tell the pace: their median stands with ten of them late."""
_WINDOW = 1024
"""Intervals over which the pace is averaged: the jitter of one stamp counts a thousandth."""
_FEW = 4
"""Samples up to which one at a time is faster than arrays."""
_TYPICAL = 0.5
"""Of the usual interval: a step that is longer by more has lost samples."""
_JITTER = 6 * 1.4826
"""Times the median absolute deviation: six standard deviations of a Gaussian one (1.4826)."""


class SampleClock:
    """Times samples as they come; the outcome depends on their stamps, not on how they are cut.

    A unit samples at equal intervals of its own clock, in which it was calibrated too: the
    interval is the mean of the last 1024, by the stamps. A single difference of stamps would hand
    their jitter and rounding on to every sample (1 ms of 10 ms is 1 m/s^2 of gravity); the nominal
    rate would be another clock's. A sample after a gap holds the pulses of its own interval, as
    long as any other: steps that are no sample interval (gaps, jumps back) are passed over. The
    first 32 intervals teach what one is, and the samples wait until then; so do 32 odd ones in a
    row, as after a change of the rate.

    Attributes:
        odd: Steps that were passed over so far.
        lost: Samples that could not be timed.

    """

    def __init__(self) -> None:
        self.odd = 0
        self.lost = 0
        self._held: Stamps = np.empty(0, np.int64)
        self._last = 0
        self._typical = 0.0
        self._tolerance = 0.0
        self._run = 0
        self._recent: Stamps = np.empty(0, np.int64)
        self._sums: Stamps = np.zeros((2 * _WINDOW, 2), np.int64)
        self._known = 1

    @property
    def waiting(self) -> int:
        """Samples that wait for others to tell the interval."""
        return len(self._held)

    @property
    def typical(self) -> float:
        """Sample interval, s; 0 before it is known."""
        return self._typical * 1e-9

    def take(self, stamp: Stamps) -> Floats:
        """Take (n,) stamps in, ns; return the intervals in s of those that are timed now.

        These are the oldest that were not timed before; `lost` counts those passed over at the
        front of them.
        """
        if self._typical:
            return self._follow(stamp)
        self._held = np.concatenate([self._held, stamp])
        return self._learn()

    def finish(self) -> Floats:
        """End of the stream: intervals (n,) in s of what waits; a single sample tells none."""
        held, self._held = self._held, self._held[:0]
        if self._typical or len(held) < 2 or not np.median(np.diff(held)) > 0:
            self.lost += len(held)
            return np.empty(0)
        return self._begin(held)

    def _learn(self) -> Floats:
        """Learn from the first samples whose stamps do not stand still."""
        held = self._held
        while len(held) > _LEARNT:
            first, held = held[: _LEARNT + 1], held[_LEARNT + 1 :]
            if np.median(np.diff(first)) > 0:
                self._held = held[:0]
                return np.concatenate([self._begin(first), self._follow(held)])
            self.lost += len(first)
        self._held = held.copy()
        return np.empty(0)

    def _begin(self, first: Stamps) -> Floats:
        mean = self._set_typical(np.diff(first))
        self._last = int(first[-1])
        return np.full(len(first), mean)

    def _set_typical(self, steps: Stamps) -> float:
        """Take steps for what is usual; return their mean, s."""
        middle = float(np.median(steps))
        jitter = float(np.median(np.abs(steps - middle)))
        self._typical, self._tolerance = middle, _TYPICAL * middle + _JITTER * jitter
        regular = self._is_regular(steps)
        self.odd += int((~regular).sum())
        sums = _sums(steps, regular)
        self._sums[1 : len(sums) + 1], self._sums[0], self._known = sums, 0, len(sums) + 1
        self._run, self._recent = 0, self._recent[:0]
        return float(sums[-1, 0]) / float(sums[-1, 1]) * 1e-9

    def _is_regular(self, steps: Stamps) -> NDArray[np.bool_]:
        return np.asarray(np.abs(steps - self._typical) <= self._tolerance)

    def _follow(self, stamp: Stamps) -> Floats:
        if len(stamp) <= _FEW:
            return np.array([self._follow_one(one) for one in stamp.tolist()], dtype=float)
        parts = []
        while len(stamp):
            done, intervals = self._follow_part(stamp[:_WINDOW])
            parts.append(intervals)
            stamp = stamp[done:]
        return np.concatenate(parts)

    def _follow_one(self, stamp: int) -> float:
        """Time one sample: the way of a live stream, in plain numbers, with the same outcome."""
        step, self._last = stamp - self._last, stamp
        regular = abs(step - self._typical) <= self._tolerance
        if regular:
            self._run = 0
        else:
            self._recent = np.append(self._recent[len(self._recent) - self._run :], step)
            self._run += 1
            self.odd += 1
        place = self._make_room(1)
        sums = self._sums
        elapsed, count = sums.item(place - 1, 0), sums.item(place - 1, 1)
        if regular:
            elapsed, count = elapsed + step, count + 1
        sums[place, 0], sums[place, 1] = elapsed, count
        self._known += 1
        first = max(place - _WINDOW, 0)
        before, known = sums.item(first, 0), sums.item(first, 1)
        # All below 2^53: the same quotient as that of arrays.
        interval = (elapsed - before) / (count - known) * 1e-9
        if self._run == _LEARNT:
            self._learn_anew()
        return float(interval)

    def _learn_anew(self) -> None:
        """Take the odd steps for the new interval, if they are any."""
        recent, self._run, self._recent = self._recent, 0, self._recent[:0]
        if np.median(recent) > 0:
            self._set_typical(recent)

    def _make_room(self, count: int) -> int:
        """Return where the next sums go, the last window of them before that."""
        if self._known + count > len(self._sums):
            kept = self._sums[self._known - _WINDOW : self._known].copy()
            self._sums[:_WINDOW], self._known = kept, _WINDOW
        return self._known

    def _follow_part(self, stamp: Stamps) -> tuple[int, Floats]:
        """Time samples up to where the interval is to be learnt anew, or all."""
        steps = np.diff(stamp, prepend=self._last)
        regular = self._is_regular(steps)
        done = len(stamp)
        anew = False
        if not regular.all() or self._run:
            runs = self._runs(regular)
            full = np.flatnonzero(runs == _LEARNT)
            if len(full):
                done, anew = int(full[0]) + 1, True
                steps, regular = steps[:done], regular[:done]
            self._run = int(runs[done - 1])
            recent = np.concatenate([self._recent, steps])
            self._recent = recent[len(recent) - self._run :]
            self.odd += int((~regular).sum())
        self._last = int(stamp[done - 1])
        place = self._make_room(done)
        self._sums[place : place + done] = self._sums[place - 1] + _sums(steps, regular)
        self._known += done
        bases = np.maximum(np.arange(place, place + done) - _WINDOW, 0)
        spans = self._sums[place : place + done] - self._sums[bases]
        if anew:
            self._learn_anew()
        return done, spans[:, 0] / spans[:, 1] * 1e-9

    def _runs(self, regular: NDArray[np.bool_]) -> Stamps:
        """Return how many odd steps in a row there have been at each."""
        place = np.arange(1, len(regular) + 1)
        last = np.maximum.accumulate(np.where(regular, place, 0))
        return np.asarray(np.where(last > 0, place - last, place + self._run))


def _sums(steps: Stamps, regular: NDArray[np.bool_]) -> Stamps:
    """Return (n, 2): time elapsed in regular steps, ns, and their number."""
    return np.stack([np.cumsum(np.where(regular, steps, 0)), np.cumsum(regular)], axis=1)
