"""The clock of a topic's header stamps against that of the recorder's log times.

A message is logged after its stamp, often late and many at a time: of neighbours the one that came
soonest counts. The ratio of the two clocks is that of Moon, Skelly and Towsley (Estimation and
Removal of Clock Skew from Network Delay Measurements, INFOCOM 1999), a line below the delays, here
by the medians of Theil and Sen, which stamps or log times that step do not change either.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ..common.gaussian import MAD_TO_STD
from ..common.stream import Floats, Stamps

Numbers = TypeVar('Numbers', NDArray[np.int64], NDArray[np.float64])
_HELD = 4096
"""Pairs held: a choice between memory and the time that bursts may last."""
_PARTS = 4
"""Of a recording, each with a rate of its own: a clock that is set spoils one of them."""
_PAIRS = 48
"""Pairs of a part that are compared, each with each: more would not resolve more."""
_FEWEST = 8
"""Pairs of a part: fewer do not show its scatter. A judgement."""
_PLACES = 256
"""Pairs between which log times may step: their distance is the resolution."""
_BESIDE = 5
"""Pairs on either side of a step, of which the medians count. A judgement."""
_STEP = 0.5
"""s: smaller steps of log times are also those of messages that come late. A judgement."""
_SHORTEST = 10.0
"""s by the log: in a quarter of less, delays of milliseconds are more than a clock is off."""


@dataclass(frozen=True)
class Extent:
    """First and last of times, ns, and their number."""

    first: int
    last: int
    count: int

    @property
    def seconds(self) -> float:
        """Duration."""
        return (self.last - self.first) * 1e-9

    @property
    def rate(self) -> float | None:
        """Mean rate, 1/s; None without a duration."""
        return (self.count - 1) / self.seconds if self.last > self.first else None


@dataclass(frozen=True)
class ClockRatio:
    """Seconds of header stamps per second of log times, and the standard deviation of that."""

    value: float
    std: float


class RecordedClock:
    """Pairs of header stamps and log times of a topic, in bounded memory."""

    def __init__(self) -> None:
        self._pairs = np.empty((0, 2), np.int64)
        self._width = 1
        self._stamps: Extent | None = None
        self._log: Extent | None = None

    @property
    def stamps(self) -> Extent | None:
        """Least and largest header stamp; None without messages."""
        return self._stamps

    @property
    def log(self) -> Extent | None:
        """Earliest and latest log time; None without messages."""
        return self._log

    def add_messages(self, stamp: Stamps, log: Stamps) -> None:
        """Add messages with header stamps (n,) and log times (n,), ns."""
        if not len(stamp):
            return
        self._stamps, self._log = _extended(self._stamps, stamp), _extended(self._log, log)
        soonest = _soonest(log - stamp, self._width)
        pairs = np.column_stack([stamp[soonest], log[soonest]])
        self._pairs = np.concatenate([self._pairs, pairs])
        while len(self._pairs) > _HELD:
            self._pairs = _thinned(self._pairs, 2)
            self._width *= 2

    def ratio(self) -> ClockRatio | None:
        """Return the ratio of the clocks; None where the recording does not show it."""
        log = self._log
        if log is None or log.seconds < _SHORTEST or len(self._pairs) < _PARTS * _FEWEST:
            return None
        seconds = (self._pairs - self._pairs[0]) * 1e-9
        found = [_slope(part) for part in np.array_split(seconds, _PARTS)]
        slopes = np.array([slope for slope in found if slope is not None])
        if len(slopes) < _PARTS:
            return None
        middle = float(np.median(slopes))
        return ClockRatio(middle, MAD_TO_STD * float(np.median(np.abs(slopes - middle))))

    def log_steps(self) -> list[tuple[int, float]]:
        """Return where log times step against stamps: log time, ns, and size, s, of each."""
        ratio = self.ratio()
        if ratio is None:
            return []
        pairs = _thinned(self._pairs, max(len(self._pairs) // _PLACES, 1))
        seconds = (pairs - pairs[0]) * 1e-9
        delay = seconds[:, 1] - seconds[:, 0] / ratio.value
        medians = np.median(np.lib.stride_tricks.sliding_window_view(delay, _BESIDE), axis=1)
        change = medians[_BESIDE:] - medians[:-_BESIDE]
        # A message of a slow topic may be logged anywhere before the next one.
        assert self._stamps is not None
        least = max(_STEP, 1.0 / (self._stamps.rate or np.inf))
        steps = []
        while len(change) and abs(change[k := int(np.abs(change).argmax())]) > least:
            steps.append((int(pairs[k + _BESIDE, 1]), float(change[k])))
            change[max(k - _BESIDE, 0) : k + _BESIDE + 1] = 0.0
        return sorted(steps)


def _extended(extent: Extent | None, times: Stamps) -> Extent:
    first, last = int(times.min()), int(times.max())
    if extent is None:
        return Extent(first, last, len(times))
    return Extent(min(extent.first, first), max(extent.last, last), extent.count + len(times))


def _thinned(pairs: Numbers, width: int) -> Numbers:
    """Return of every `width` pairs (n, 2) the one that was logged soonest after its stamp."""
    thinned: Numbers = pairs[_soonest(pairs[:, 1] - pairs[:, 0], width)]
    return thinned


def _soonest(delay: NDArray[np.int64] | Floats, width: int) -> Stamps:
    """Return the place of the least of every `width` delays, and of those that remain."""
    whole = len(delay) // width * width
    groups = delay[:whole].reshape(-1, width)
    places = np.arange(0, whole, width) + groups.argmin(axis=1)
    return places if whole == len(delay) else np.append(places, whole + delay[whole:].argmin())


def _slope(seconds: Floats) -> float | None:
    """Return the slope of stamps by log times, (n, 2) s; None if either stands still."""
    stamp, log = _thinned(seconds, max(len(seconds) // _PAIRS, 1)).T
    first, last = np.triu_indices(len(stamp), len(stamp) // 2)
    by_log, by_stamp = log[last] - log[first], stamp[last] - stamp[first]
    known: NDArray[np.bool_] = (by_log > 0) & (by_stamp > 0)
    if not known.any():
        return None
    return float(np.median(by_stamp[known] / by_log[known]))
