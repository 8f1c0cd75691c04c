"""Estimate the sampling times of a whole recording, from earlier and later stamps.

A live sample is timed by the stamps received so far (`sample_clock`). In a recording all stamps are
known: samples that came in bunches, late or in a queue are moved to their sampling times, by the
rules of the segmentation (docs/mathematics.md, 'Stamps and lost samples'). Others keep their
stamps.
"""

from __future__ import annotations

import numpy as np

from ..common.stream import ImuBlock, Stamps
from ..segmentation.stamp_faults import SharedStamps, late_samples
from ..segmentation.stamps import SHORT, read_grid, sampling_times
from .sample_clock import LONGEST

_LONG = 1.5
"""Of the median step: a longer one is followed by a late sample, or samples were lost."""
_AROUND = 512
"""Samples on either side of irregular steps that determine the interval (`bunches`, `_AHEAD`)."""
_FEWEST = 32
"""Samples that determine an interval (`sample_clock`)."""


class WholeStream:
    """Collect the stamps of a recording's samples without repeats; 8 bytes each.

    Args:
        rate: Samples per second as stated; None if not stated.
    """

    def __init__(self, rate: float | None) -> None:
        self._shared = SharedStamps(rate)
        self._stamps: list[Stamps] = []

    def take(self, block: ImuBlock) -> None:
        """Take the stamps of samples."""
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
    if len(steps) < _FEWEST:
        return stamp
    middle = float(np.median(steps))
    irregular = np.flatnonzero((steps < SHORT * middle) | (steps > _LONG * middle))
    if not len(irregular):
        return stamp
    made = stamp.copy()
    for part in np.split(irregular, np.flatnonzero(np.diff(irregular) > _AROUND) + 1):
        first, end = max(0, int(part[0]) - _AROUND), int(part[-1]) + 2 + _AROUND
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
