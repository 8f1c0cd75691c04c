"""Find where the IMU's stream begins anew: silences that no later samples make up for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..common.stream import NS, Stamps, at
from .stamps import LAG, SHORT

INTERRUPTION = NS
"""A stream that is silent for so long, ns, may come from a program that was started again. A
judgement: nodes take longer to start, and a line rarely fails for longer."""
_LAST = 1024
"""Stamps before a silence that give the sample interval, half of which are late at most."""
_OVER = 32
"""Samples without gain on the clock after which a queue is over: a reader with other work returns
to the queue within a few. A judgement."""
_GAINS = 0.5  #: Of an interval: less is jitter.
_LISTED = 3  #: Interruptions with a sentence each; more are only counted.


class Interruptions:
    """Finds interruptions of a stream; the result does not depend on how it was cut into blocks.

    Delayed samples arrive in quick succession until all that were made in the meantime have
    arrived. The time that they gain on the clock is the part of the silence without loss.
    """

    def __init__(self) -> None:
        self._last: Stamps = np.empty(0, dtype=np.int64)
        self._silences: list[tuple[int, int]] = []
        self._begins = 0
        self._interval = 0.0
        self._count = 0
        self._gained, self._gained_at = 0.0, 0
        self._queues = False

    @property
    def found(self) -> list[tuple[int, int]]:
        """From the last stamp to the instant of the next sample, ns, in order."""
        return [(last, next_) for last, next_ in self._silences if next_ - last > INTERRUPTION]

    def add_stamps(self, stamp: Stamps) -> None:
        """Add (n,) stamps of the IMU, ns, as they come."""
        if not len(stamp):
            return
        before = self._last[-1] if len(self._last) else stamp[0]
        silent = steps_since(before, stamp) > INTERRUPTION
        for part in np.split(stamp, np.flatnonzero(silent)) if silent.any() else [stamp]:
            if len(part):
                self._follow(part)
                self._last = np.concatenate([self._last, part[-_LAST:]])[-_LAST:]

    def _follow(self, stamp: Stamps) -> None:
        """Add stamps of which only the first may come after a silence."""
        first = int(stamp[0])
        if len(self._last) and first - int(self._last[-1]) > INTERRUPTION:
            self._interval = sample_interval(self._last)
            self._silences.append((int(self._last[-1]), first))
            self._begins, self._count, self._gained, self._gained_at = first, 0, 0.0, 0
            self._queues, stamp = self._interval > 0, stamp[1:]
        for now in stamp.tolist() if self._queues else ():
            self._count += 1
            gained = self._count * self._interval - (now - self._begins)
            if gained > self._gained + _GAINS * self._interval:
                self._gained, self._gained_at = gained, self._count
                last, _ = self._silences[-1]
                self._silences[-1] = last, max(last, self._begins - round(gained))
            elif self._count - self._gained_at > _OVER:
                self._queues = False
                break


def steps_since(before: int | np.int64, stamp: Stamps) -> Stamps:
    """Return the steps from one stamp to the next, (n,) ns, the first one from another stamp.

    The same as `np.diff(stamp, prepend=before)`, faster for a live stream's blocks of a few
    samples.
    """
    steps = np.empty_like(stamp)
    np.subtract(stamp[:1], before, out=steps[:1])
    np.subtract(stamp[1:], stamp[:-1], out=steps[1:])
    return steps


def sample_interval(stamp: Stamps) -> float:
    """Return the sample interval by (n,) stamps, ns; 0 where they do not show it."""
    steps = np.diff(stamp)
    if not len(steps):
        return 0.0
    # In bunches the median single step is not the interval; where some are lost, spans are used.
    lag = min(LAG, -(-len(steps) // 2))
    apart = steps[steps >= SHORT * float(steps.mean())]
    return min(float(np.median(apart)), float(np.median(stamp[lag:] - stamp[:-lag])) / lag)


def interruption(last: int, begins: int) -> str:
    """Return a sentence on an interruption of the IMU's stream: last stamp to next, ns."""
    gap = (begins - last) * 1e-9
    return f'The IMU stream was interrupted: {gap:.1f} s are missing, from {at(last)}'


def interruptions(found: Sequence[tuple[int, int]]) -> list[str]:
    """Return sentences on the losses by interruptions, each from its last stamp to the next, ns."""
    if len(found) <= _LISTED:
        return [interruption(last, begins) for last, begins in found]
    seconds = sum(begins - last for last, begins in found) * 1e-9
    return [
        f'The IMU stream has {len(found)} interruptions, {seconds:.1f} s in all, the first at '
        f'{at(found[0][0])}'
    ]
