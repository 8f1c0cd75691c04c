"""Detect repeated samples: a device that sends on without measuring."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..common.stream import Floats, Stamps, at
from ..common.units import DEG
from .counters import all_in_row, any_in_row, runs_of

_FEWEST = 8
"""Fewest repeated samples in a row that count as frozen: a judgement, fewer cost nothing."""
_ENOUGH = 100
"""Other samples that show the chance of a repetition, however long that is: a table that settles
for a second is at rest for most of them. A judgement."""
_CHANCE = 1e-9  #: Probability of so long a repetition anywhere in a segment of sound samples.
_AROUND = 32  #: Samples before and after a repetition that show whether codes are noisy.
_SAME = 1e-3
"""Relative difference of a dwell's mean from one sample: a choice, far above that of two estimates
of the sample interval. A channel that repeats zero has a mean of zero."""
_NOISY = 4
"""Different codes among them by which a channel is noisy: one at the edge between two codes shows
two without noise, and three where it drifts to the next edge."""
_TURNS = 10 * DEG
"""rad/s: a judgement. More than the bias of gyros on a turntable; cheap ones have a few deg/s."""


def repeating_samples(values: Floats, *, counted: bool) -> NDArray[np.bool_]:
    """Find the samples (n,) that repeat the one before more often than by chance.

    The chance that two samples in a row are equal is estimated from the rest of the segment: codes
    of low noise often are. If nearly all of the segment repeats itself, the chance is unknown.

    Args:
        values: (n, 6) as delivered.
        counted: Whether they are increments of a counter, which also change at a steady rate. Codes
            of a rate change by noise alone.
    """
    n = len(values)
    found = np.zeros(n, dtype=bool)
    if n < 2 * _FEWEST:
        return found
    same = all_in_row(values[1:] == values[:-1])
    first, last = runs_of(same).T
    others, alike = n - 1, int(same.sum())
    for k in np.argsort(first - last, kind='stable').tolist():
        length = int(last[k] - first[k])
        others, alike = others - length, alike - length
        chance = (alike + 1) / (others + 2)
        few = others < min(length, _ENOUGH)
        if length < _FEWEST or few or n * chance**length > _CHANCE:
            break
        if not counted and not _noisy(values, int(first[k]), int(last[k]) + 1):
            continue
        found[first[k] + 1 : last[k] + 1] = True
    return found


class LastRun:
    """The run of equal samples at the end of a stream, however it was cut into blocks."""

    def __init__(self) -> None:
        self.since: int | None = None  #: Stamp of its first sample, ns; None before any.
        self.sample: Floats = np.full(6, np.nan)  #: (6,) as delivered.

    def add(self, stamp: Stamps, values: Floats) -> None:
        """Add (n,) stamps, ns, with (n, 6) values."""
        if not len(stamp):
            return
        others = np.flatnonzero(any_in_row(values != values[-1]))
        if len(others):
            self.since = int(stamp[others[-1] + 1])
        elif not np.array_equal(values[-1], self.sample):
            self.since = int(stamp[0])
        self.sample = values[-1].copy()


def frozen_sentence(since: int, seconds: float) -> str:
    """Return that a device repeats one sample from an instant, ns, to the end, without a full stop.

    Args:
        since: Its first stamp.
        seconds: From there to the end of the stream.
    """
    return (
        f'The IMU repeats one sample from {at(since)} to the end of its stream ({seconds:.0f} s), '
        'while the table turns and stops: it froze, and all from there on counts as missing. '
        'Switch it on again, look at its bus and its driver, and record again what is missing'
    )


@dataclass(frozen=True)
class Repetition:
    """How samples of a motion repeat themselves."""

    samples: int  #: Number of samples.
    share: float  #: Share of samples that repeat the one before.
    longest: int  #: Most of these in a row.
    #: (6,) the one repeated so, rad/s and m/s^2; NaN for none.
    sample: Floats = field(default_factory=lambda: np.full(6, np.nan))

    @classmethod
    def count_in(cls, values: Floats, rates: Floats) -> Repetition:
        """Count the repetitions in (n, 6) values as delivered; at least 2.

        Args:
            values: As delivered.
            rates: (n, 6) the same, rad/s and m/s^2.
        """
        same = all_in_row(values[1:] == values[:-1])
        runs = runs_of(same)
        if not len(runs):
            return cls(len(values), 0.0, 0)
        lengths = runs[:, 1] - runs[:, 0]
        most = int(lengths.argmax())
        # A copy: a view would keep all samples of the motion.
        repeated = rates[runs[most, 0]].copy()
        return cls(len(values), float(same.mean()), int(lengths[most]), repeated)

    def continues_in(self, mean: Floats) -> bool:
        """Return whether a dwell with a mean output (6,), rad/s and m/s^2, repeats the sample."""
        return bool((np.abs(mean - self.sample) <= _SAME * np.abs(self.sample)).all())

    def is_significant(self, share: float) -> bool:
        """Return whether the longest repetition exceeds chance, `share` for each."""
        return self.longest >= _FEWEST and self.samples * share**self.longest < _CHANCE


def repeating_a_turn(values: Floats, angles: Floats, period: float) -> NDArray[np.bool_]:
    """Find the samples (n,) of a dwell that repeat one of a turn.

    If a device froze before the table came to rest, the dwell need not hold any other sample to
    compare with; but a table at rest cannot show the rate of a turn.

    Args:
        values: (n, 6) as delivered.
        angles: (n, 3) turned in each sample, rad.
        period: Sample interval, s.
    """
    found = np.zeros(len(values), dtype=bool)
    same = all_in_row(values[1:] == values[:-1])
    found[1:] |= same
    found[:-1] |= same
    found[found] = np.linalg.norm(angles[found] / period, axis=1) > _TURNS
    return found


def _noisy(values: Floats, start: int, stop: int) -> bool:
    """Return whether a channel has noise around the samples start to stop."""
    around = np.vstack([values[max(0, start - _AROUND) : start], values[stop : stop + _AROUND]])
    return any(len(np.unique(channel)) >= _NOISY for channel in around.T)
