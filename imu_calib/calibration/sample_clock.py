"""Estimate sample intervals and sampling times from stamps as they come."""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.stream import Floats, ImuBlock, Stamps
from ..segmentation.stamp_faults import JITTER, SharedStamps, late_samples
from ..segmentation.stamps import (
    AHEAD,
    LAG,
    MANY,
    MISSES_ONE,
    SHORT,
    Pattern,
    pattern,
    read_grid,
    sampling_times,
    usual_interval,
)

_LEARNT = 32  #: Intervals that determine the usual one: their median holds with ten of them late.
INTERVAL_KNOWN_AFTER = _LEARNT + 1  #: Samples that show the interval, unless they come in bunches.
_WINDOW = 1024  #: Intervals averaged: the jitter of one stamp is reduced to a thousandth.
_FEW = 4  #: Samples up to which processing one at a time is faster than arrays.
_TYPICAL = 0.5
"""Of the usual interval: after a step longer by more, samples were lost or are late."""
_GAINS = 0.05
"""Of the interval: a step after a long one that is shorter by more shows a queue catching up. A
judgement: with a queue that catches up more slowly, the interval is wrong by less than this."""
LONGEST = 5_000_000_000
"""ns: longer than a line holds samples up (`segmentation/stamps`); samples after such a silence are
timed anew, and may have another rate."""
_FASTEST = 1000.0
"""ns: no IMU samples at a megahertz; samples that share a stamp are separated by less."""
_MOST_HELD = 4096  #: Most samples that wait for the interval: a transfer of a second at 4 kHz.
_SLACK_PACKETS, _SLACK_POLLED = 0.5, 1.5
"""Intervals by which a complete bunch may be off: a polled one has one sample more or less in
alternation (`segmentation/stamps`)."""


class Times(NamedTuple):
    """Timing of samples: intervals, (n,) s, and sampling times, (n,) ns."""

    interval: Floats
    instant: Stamps


_NONE = Times(np.empty(0), np.empty(0, np.int64))


def _joined(*parts: Times) -> Times:
    """Return the timing of consecutive samples."""
    return Times(*(np.concatenate(both) for both in zip(*parts, strict=True)))


class SampleClock:
    """Time samples as they come; the result does not depend on how the stream is cut into blocks.

    A unit samples at equal intervals of its own clock, by which it was also calibrated: the
    interval is the mean of the last 1024, by the stamps. A single difference of stamps would pass
    their jitter and rounding to every sample (1 ms of 10 ms is 1 m/s^2 of gravity); the nominal
    rate refers to another clock. A sample after a gap holds the pulses of its own interval, as
    any other: steps that are no sample interval (gaps, jumps back) are skipped. The first 32
    intervals determine the usual one, and the samples wait until then; 32 odd ones in a row do so
    again, as after a change of the rate.

    After a long step, samples that come faster than at equal intervals were held up, as long as
    their number does not exceed that of the elapsed time: their steps do not change the interval.
    Once the silence is made up for, all of them together count as whole intervals.

    Samples that come in bunches wait until three whole bunches have shown the interval. From then
    on each sampling time is an interval after the one before, counted from the bunch before: the
    size of a bunch is not known when its first sample is returned. Samples of an occasional queue
    keep their stamps: whether the first of them is late or samples before it were lost is not
    known, and it does not wait for the next.

    Source: docs/mathematics.md, 'Stamps and lost samples'.

    Args:
        rate: Samples per second as stated; None if not stated. Samples that come twice as fast
            wait for others: they may belong to one packet.
    """

    def __init__(self, rate: float | None = None) -> None:
        self.lost = 0  #: Samples that could not be timed.
        self.untimed = 0  #: Samples that could not be timed and were returned all the same.
        #: Whether samples have to be timed. Those that could not be have the stated interval,
        #: infinite if there is none, and keep their stamps.
        self.required = True
        self.irregular_steps = 0  #: Steps skipped so far.
        self._stated = 1 / rate if rate else math.inf
        self._least = SHORT * 1e9 / rate if rate else _FASTEST
        self._held: Stamps = np.empty(0, np.int64)
        self._looked = 0
        self._last = 0
        self._typical = 0.0
        self._tolerance = 0.0
        self._gains = 0.0
        self._slack = _SLACK_PACKETS
        self._interval = 0.0
        self._run = 0
        self._recent: deque[int] = deque(maxlen=_WINDOW)
        self._sums: Stamps = np.zeros((2 * _WINDOW, 2), np.int64)
        self._known = 1
        self._behind = 0  #: Samples that were held up in a silence, if they make up for it.
        self._passed = 0  #: ns from the sample before them to the last of them.
        self._bunch: _Bunch | None = None

    @property
    def waiting(self) -> int:
        """Number of samples that wait for the interval to be known."""
        return len(self._held)

    @property
    def typical(self) -> float:
        """Sample interval, s; 0 before it is known."""
        return self._typical * 1e-9

    def time_samples(self, stamp: Stamps) -> Times:
        """Add stamps (n,), ns; return the timing of the oldest untimed samples, as far as known.

        `lost` counts the samples skipped before them.
        """
        if self._typical:
            return self._follow(stamp)
        self._held = np.concatenate([self._held, stamp])
        return self._infer_first_interval()

    def finish(self) -> Times:
        """End the stream: return the timing of waiting samples; one alone has no interval."""
        held, self._held = self._held, self._held[:0]
        if self._typical or len(held) < 2 or not self._infer_interval(held, last=True):
            return self._without_interval(held)
        return self._first_times(held)

    def _without_interval(self, stamp: Stamps) -> Times:
        """Return the timing of samples (n,), ns, that show no interval: lost if it is required."""
        if self.required:
            self.lost += len(stamp)
            return _NONE
        self.untimed += len(stamp)
        return Times(np.full(len(stamp), self._stated), stamp)

    def _infer_first_interval(self) -> Times:
        """Infer the interval from the first samples whose stamps show one."""
        before = _NONE
        while len(self._held) - self._looked > _LEARNT:
            self._looked += _LEARNT + 1
            first = self._held[: self._looked]
            if self._infer_interval(first):
                rest, self._held = self._held[self._looked :], self._held[:0]
                return _joined(before, self._first_times(first), self._follow(rest))
            if self._looked > _MOST_HELD:
                before = _joined(before, self._without_interval(self._held[: _LEARNT + 1]))
                self._looked -= _LEARNT + 1
                self._held = self._held[_LEARNT + 1 :]
        return before

    def _infer_interval(self, stamp: Stamps, *, last: bool = False) -> bool:
        """Infer the interval from stamps (n,), ns; return whether they show one."""
        steps = np.diff(stamp)
        interval, short = usual_interval(stamp)
        least = _FASTEST if last or len(stamp) > LAG else self._least
        if short < MANY and np.median(steps) > least:
            self._set_typical(steps)
            return True
        bunches = pattern(stamp) if steps.min() >= 0 else None
        if bunches is not None:
            self._set_bunches(bunches)
        elif interval > _FASTEST and (last or len(stamp) >= _WINDOW):
            # As in a queue, whose steps are short.
            self._set_pace(min(interval, float(steps.mean())), 0.0)
        else:
            return False
        self._last = int(stamp[0])
        for one in stamp[1:].tolist():
            self._follow_one(one)
        return True

    def _first_times(self, first: Stamps) -> Times:
        """Return the timing of the samples (n,), ns, that showed the interval."""
        self._last = int(first[-1])
        instants = sampling_times(first)[0] if np.diff(first).min() > 0 else first
        if self._bunch is not None:
            self._bunch.follow(int(instants[-1]))
        return Times(np.full(len(first), self._interval), instants)

    def _set_pace(self, typical: float, jitter: float) -> None:
        """Set the usual interval and the jitter of stamps, ns, and begin the mean anew."""
        self._typical, self._tolerance = typical, _TYPICAL * typical + JITTER * jitter
        # Jitter must not look like a queue catching up.
        self._gains = typical - min(_TYPICAL * typical, max(_GAINS * typical, JITTER * jitter))
        self._slack = _SLACK_PACKETS
        self._bunch, self._behind, self._run = None, 0, 0
        self._recent.clear()
        self._sums[0], self._known = 0, 1
        self._interval = typical * 1e-9

    def _set_bunches(self, found: Pattern) -> None:
        """Time the coming samples as bunches of a pattern."""
        self._set_pace(found.interval, 0.0)
        self._slack = _SLACK_POLLED if found.size is None else _SLACK_PACKETS
        self._bunch = _Bunch(found.size or 0)

    def _set_typical(self, steps: Stamps) -> None:
        """Set the usual interval from steps."""
        middle = float(np.median(steps))
        self._set_pace(middle, float(np.median(np.abs(steps - middle))))
        regular = self._is_regular(steps)
        self.irregular_steps += int((~regular).sum())
        sums = np.stack([np.cumsum(np.where(regular, steps, 0)), np.cumsum(regular)], axis=1)
        self._interval = float(sums[-1, 0]) / float(sums[-1, 1]) * 1e-9
        latest = np.vstack([self._sums[:1], sums])[-_WINDOW - 1 :]
        self._sums[: len(latest)], self._known = latest, len(latest)

    def _is_regular(self, steps: Stamps) -> NDArray[np.bool_]:
        """Return which steps (n,), ns, are one sample interval."""
        return np.asarray(np.abs(steps - self._typical) <= self._tolerance)

    def _follow(self, stamp: Stamps) -> Times:
        """Time samples of (n,) stamps, ns, once the interval is known."""
        intervals, instants = np.empty(len(stamp)), stamp.copy()
        done = 0
        while done < len(stamp):
            # After one irregular step others often follow, and are timed by more than the last one.
            one_by_one = self._behind or self._run or self._bunch is not None
            count = len(stamp) if len(stamp) <= _FEW or one_by_one else 0
            part = stamp[done : done + min(count, _LEARNT)].tolist()
            for k, one in enumerate(part, start=done):
                instants[k] = self._follow_one(one)
                intervals[k] = self._interval
            done += len(part)
            if not count:
                part = stamp[done : done + _WINDOW]
                steps = np.diff(part, prepend=self._last)
                irregular_steps = np.flatnonzero(~self._is_regular(steps))
                plain = int(irregular_steps[0]) if len(irregular_steps) else len(part)
                if plain:
                    intervals[done : done + plain] = self._follow_plain(part[:plain], steps[:plain])
                done += plain
                if plain < len(part):
                    instants[done] = self._follow_one(int(part[plain]))
                    intervals[done] = self._interval
                    done += 1
        return Times(intervals, instants)

    def _follow_one(self, stamp: int) -> int:
        """Time one sample, in plain Python numbers for live streams, with the same result."""
        step, before, self._last = stamp - self._last, self._last, stamp
        elapsed, count = self._caught_up(step)
        if not self._behind:
            if abs(step - self._typical) <= self._tolerance:
                self._run = 0
                self._recent.clear()
                elapsed, count = elapsed + step, count + 1
            else:
                self._recent.append(step)
                self._run += 1
                self.irregular_steps += 1
                if self._typical < step <= LONGEST:
                    self._behind, self._passed = 1, step
        self._add(elapsed, count)
        instant = stamp
        if self._bunch is not None:
            short = step < SHORT * self._typical
            instant = self._bunch.place(stamp, before, self._typical, within=short)
        if self._run == _LEARNT:
            self._learn_anew()
        return instant

    def _caught_up(self, step: int) -> tuple[int, int]:
        """Follow held-up samples by a step; return time, ns, and number of the regular steps.

        More samples than elapsed intervals, or equal intervals again, end the queue.
        """
        if not self._behind:
            return 0, 0
        if 0 <= step < self._gains:
            passed, behind = self._passed + step, self._behind + 1
            if passed / self._typical - behind >= -self._slack:
                self._passed, self._behind = passed, behind
                self._recent.append(step)
                return 0, 0
        passed, behind, self._behind = self._passed, self._behind, 0
        if behind == 1 or passed / self._typical - behind > self._slack:
            return 0, 0
        self._run = 0
        self._recent.clear()
        self.irregular_steps -= 1
        return passed, behind

    def _add(self, elapsed: int, count: int) -> None:
        """Add a sample's regular steps to the window of the interval."""
        place = self._make_room(1)
        sums = self._sums
        elapsed, count = sums.item(place - 1, 0) + elapsed, sums.item(place - 1, 1) + count
        sums[place, 0], sums[place, 1] = elapsed, count
        self._known += 1
        first = max(place - _WINDOW, 0)
        known = count - sums.item(first, 1)
        if known:
            # All below 2^53: the same quotient as with arrays.
            self._interval = (elapsed - sums.item(first, 0)) / known * 1e-9

    def _learn_anew(self) -> None:
        """Infer a new interval from the irregular steps, if these are alike."""
        self._run, recent = 0, np.array(self._recent)
        latest = recent[-_LEARNT:]
        interval = self._interval
        _, short = usual_interval(np.cumsum(latest))
        if short < MANY and np.median(latest) > _FASTEST:
            self._set_typical(latest)
        elif recent.min() >= 0 and (found := pattern(np.cumsum(recent))) is not None:
            self._set_bunches(found)
        self._interval = interval if self._known > 1 else self._interval

    def _make_room(self, count: int) -> int:
        """Return the index of the next sums, with the last window kept before it."""
        if self._known + count > len(self._sums):
            kept = self._sums[self._known - _WINDOW : self._known].copy()
            self._sums[:_WINDOW], self._known = kept, _WINDOW
        return self._known

    def _follow_plain(self, stamp: Stamps, steps: Stamps) -> Floats:
        """Return the intervals, (n,) s, of samples whose steps are all regular."""
        count = len(stamp)
        self._last = int(stamp[-1])
        place = self._make_room(count)
        self._sums[place : place + count, 0] = self._sums[place - 1, 0] + np.cumsum(steps)
        self._sums[place : place + count, 1] = self._sums[place - 1, 1] + np.arange(1, count + 1)
        self._known += count
        bases = np.maximum(np.arange(place, place + count) - _WINDOW, 0)
        spans = self._sums[place : place + count] - self._sums[bases]
        intervals = np.asarray(spans[:, 0] / spans[:, 1] * 1e-9)
        self._interval = float(intervals[-1])
        return intervals


class _Bunch:
    """Spread the samples of a bunch over the time since the bunch before.

    `size` is that of a whole packet; 0 for a reader that takes all waiting samples.
    """

    def __init__(self, size: int) -> None:
        self._size = size
        self._begins = self._came = self._instant = 0
        self._number = 0

    def place(self, stamp: int, before: int, interval: float, *, within: bool) -> int:
        """Return the sampling time, ns; `within` means in the same bunch as the last sample."""
        if within:
            self._number += 1
        else:
            self._begins = self._came or before
            self._came, self._number = stamp, 1
        passed, size = self._came - self._begins, self._size
        if not 0 < passed <= LONGEST:
            made = self._came - (max(size, self._number) - self._number) * interval
            self._instant = self._instant if within else round(made) - 1
        else:
            # Samples missing from lost packets are before this one (`segmentation/stamps`).
            slots = round(passed / interval)
            slots = size * max(1, round(slots / size)) if size else max(1, slots)
            number = max(slots - size, 0) + self._number if size else self._number
            made = self._begins + number * passed / slots
        self._instant = max(min(round(made), self._came), self._instant + 1)
        return self._instant

    def follow(self, instant: int) -> None:
        """Continue after a sample made at an instant, ns."""
        self._instant = max(self._instant, instant)


class WholeStream:
    """Collect the stamps of a recording's samples without repeats; 8 bytes each."""

    def __init__(self, rate: float | None) -> None:
        self._shared = SharedStamps(rate)
        self._stamps: list[Stamps] = []

    def add_stamps(self, block: ImuBlock) -> None:
        """Collect the stamps of samples."""
        values = np.concatenate([block.gyro, block.accel], axis=1)
        stamp, kept = self._shared.separate_stamps(block.stamp, values)
        self._stamps.append(stamp.copy() if kept is None else stamp[kept])

    def instants(self) -> Stamps:
        """Return the sampling times, (n,) ns."""
        if not self._stamps:
            return np.empty(0, np.int64)
        return made_at(np.concatenate(self._stamps))

    def words(self) -> list[str]:
        """Return a sentence on samples that shared a stamp."""
        return self._shared.words()


def made_at(stamp: Stamps) -> Stamps:
    """Return the sampling times of stamps as received, (n,) ns."""
    steps = np.diff(stamp)
    pieces = np.split(stamp, np.flatnonzero((steps <= 0) | (steps > LONGEST)) + 1)
    return np.concatenate([_made(piece) for piece in pieces])


def _made(stamp: Stamps) -> Stamps:
    """Return sampling times for increasing stamps without a long silence, (n,) ns."""
    steps = np.diff(stamp)
    if len(stamp) < INTERVAL_KNOWN_AFTER:
        return stamp
    middle = float(np.median(steps))
    irregular = np.flatnonzero((steps < SHORT * middle) | (steps > MISSES_ONE * middle))
    if not len(irregular):
        return stamp
    made = stamp.copy()
    for part in np.split(irregular, np.flatnonzero(np.diff(irregular) > AHEAD) + 1):
        first, end = max(0, int(part[0]) - AHEAD), int(part[-1]) + 2 + AHEAD
        last = len(stamp) if end >= len(stamp) else int(part[-1]) + 2
        own = slice(int(part[0]) + 1 if first else 0, last)
        made[own] = _around(stamp[first:end])[own.start - first : own.stop - first]
    # Jitter of samples that keep their stamps must not reverse the order.
    numbers = np.arange(len(made))
    return np.asarray(np.maximum.accumulate(made - numbers) + numbers)


def _around(stamp: Stamps) -> Stamps:
    """Return sampling times of samples of which some did not come one by one, (n,) ns."""
    made, _ = sampling_times(stamp)
    if not np.array_equal(made, stamp):
        return made
    grid = read_grid(stamp)
    line = grid.stamps(stamp)
    return np.asarray(np.where(late_samples(stamp - line, grid.period), line, stamp))
