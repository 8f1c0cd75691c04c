"""Stamps of samples that come in bunches -> when each sample of a bunch was made.

A driver that reads packets stamps all samples of one as it arrives. All samples made since the
packet before are then cut from a dwell or a turn together, and spans of a few samples do not show
the interval. Bunches are found by the pattern of short and long steps, before the interval is known
(docs/mathematics.md, 'Stamps and lost samples').
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from ..common.stream import Floats, Stamps

LAG = 240
"""Most samples over which the mean step is taken: several bunches, and short enough that half of
such spans are without a long gap."""

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
"""Of the interval: largest error of stamps after `_AHEAD` samples due to the interval's error. It
is a tenth of what distinguishes one sample from the next."""

_NEARLY = 0.2
"""Of the mean step: the interval is within this of it, unless samples come in bunches or one in six
is missing."""

_AHEAD = 512
"""Samples of which the earliest is taken: longer than a line is usually held up, five seconds at
100 Hz, and so few that an interval known to a ten-thousandth errs by a twentieth of one over them.
Of 40 simulated streams of 75 s, one sample in twenty late by 100 ms, three were late for longer
than 128."""

_LARGEST = 0.9
"""Quantile of the sizes that is the size of whole packets: a few are two that came together."""


@dataclass(frozen=True)
class Pattern:
    """How samples come in bunches.

    Attributes:
        interval: Sample interval, ns.
        size: Samples of a whole packet; None where a reader takes all that has arrived.
    """

    interval: float
    size: int | None


def pattern(stamp: Stamps) -> Pattern | None:
    """Return how samples come in bunches; None where they do not, or too few show it.

    Args:
        stamp: (n,) ns, increasing.
    """
    starts = _bunches(stamp)
    return None if starts is None else _pattern(stamp, starts)


def usual_interval(stamp: Stamps) -> tuple[float, float]:
    """Return the sample interval within a percent or so, ns, and the share of short steps.

    The interval is the median of the steps that are not short; a queue has few of these.

    Args:
        stamp: (n,) ns, at least 2.
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
    where samples come one by one.

    Args:
        stamp: (n,) ns, increasing.

    Returns:
        (n,) and (n,) ns.
    """
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
    earliest = scipy.ndimage.minimum_filter1d(late, _AHEAD, mode='nearest', origin=-(_AHEAD // 2))
    # In a longer queue samples gain on the clock until its end.
    falls = np.flatnonzero(late[: 1 - _AHEAD] - late[_AHEAD - 1 :] > _AHEAD / 2 * interval)
    for k in falls[::-1].tolist():
        earliest[k] = min(earliest[k], earliest[k + _AHEAD - 1])
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
    known = abs(interval - mean) <= _NEARLY * mean and error * _AHEAD <= _DRIFT * interval
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
