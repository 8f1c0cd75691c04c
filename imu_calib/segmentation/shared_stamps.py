"""Samples that share a stamp: those of one transfer, and repeated ones."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..common.stream import Floats, Stamps, at
from ..common.units import counted
from .interruptions import INTERRUPTION, steps_since

_STAMPS = 3
"""Last stamps whose samples are counted: an early transfer follows a late one."""

_MORE = 1.25
"""Times as many samples as the time since those stamps has intervals are too many. A judgement,
between one and the four thirds of a single sample too many among three."""


class SharedStamps:
    """Sets samples that share a stamp a nanosecond apart, a bunch (`bunches`); drops repeats.

    A driver that stamps a transfer gives all its samples one stamp. They are samples if no more
    have come than the time since the last stamps has intervals: two devices on one topic bring
    twice as many, and the order of the stamps passes only one of these (`order`). A sample with the
    values of the one before is a repeat, unless values are so coarse that neighbours with separate
    stamps are as often equal. The result does not depend on how the stream was cut.

    Args:
        rate: Samples per second as stated; None to take it from the stream.

    Attributes:
        count: Number of samples set apart.
    """

    def __init__(self, rate: float | None) -> None:
        self.count = 0
        self._interval = 1e9 / rate if rate else 0.0
        self._most = 0
        self._first: int | None = None
        self._last: tuple[Stamps, Floats] | None = None
        self._within = False
        self._place = 0
        self._stamps: list[tuple[int, int]] = []
        """The last ones, ns, and the number of samples with each."""
        self._elapsed = self._passed = 0
        self._same = self._same_alike = 0
        self._next = self._next_alike = 0

    def take(self, stamp: Stamps, values: Floats) -> tuple[Stamps, Floats, Stamps]:
        """Take (n,) stamps, ns, and (n, columns) values; return those kept, and repeats' stamps."""
        apart, kept = self.separate_stamps(stamp, values)
        if kept is None:
            return apart, values, stamp[:0]
        return apart[kept], values[kept], stamp[~kept]

    def separate_stamps(
        self, stamp: Stamps, values: Floats
    ) -> tuple[Stamps, NDArray[np.bool_] | None]:
        """Process (n,) stamps, ns, and (n, columns) values.

        Returns:
            Stamps (n,), ns, set apart; and which samples are not repeats, (n,), None if all.
        """
        if not len(stamp):
            return stamp, None
        last = (stamp[:1] - 1, values[:1]) if self._last is None else self._last
        if len(stamp) == 1 and self._stamps and not self._within and stamp[0] != last[0][0]:
            # Faster for a live stream, with the same result.
            self._last = stamp.copy(), values.copy()
            self._next_alone(int(stamp[0]))
            return stamp, None
        self._last = stamp[-1:].copy(), values[-1:].copy()
        same = steps_since(last[0][0], stamp) == 0
        if not self._within and not same.any():
            self._alone(stamp)
            return stamp, None
        within = np.append(self._within, same[:-1])
        self._within = bool(same[-1])
        rows = np.flatnonzero(same | within)
        before = np.concatenate([last[1], values[:-1]])[rows]
        alike = (values[rows] == before).all(axis=1)
        apart, kept, done = stamp.copy(), np.ones(len(stamp), dtype=bool), 0
        for k, again in zip(rows.tolist(), alike.tolist(), strict=True):
            self._alone(stamp[done:k])
            done = k + 1
            if not same[k]:
                self._next, self._next_alike = self._next + 1, self._next_alike + again
                self._alone(stamp[k:done])
                continue
            self._same, self._same_alike = self._same + 1, self._same_alike + again
            if again and self._repeats:
                kept[k] = False
                continue
            self._add(int(stamp[k]))
            apart[k] += self._place
        self._alone(stamp[done:])
        return apart, kept

    def words(self, of: str = '') -> list[str]:
        """Return a sentence on how many samples were set apart."""
        if self._first is None:
            return []
        return [
            f'{counted(self.count, "sample")}{of} came with the stamp of the one before, up to '
            f'{self._most} with one stamp, the first at {at(self._first)}: they are spread over '
            'the time since the stamp before'
        ]

    @property
    def _repeats(self) -> bool:
        """Whether equal samples with shared stamps are closer to certain than to chance.

        Laplace's estimate of that chance: a half without data.
        """
        chance = (self._next_alike + 1) / (self._next + 2)
        return 2 * self._same_alike >= (1 + chance) * self._same

    def _alone(self, stamp: Stamps) -> None:
        """Add samples with separate stamps."""
        if not len(stamp):
            return
        before = self._stamps[-1][0] if self._stamps else stamp[0]
        steps = steps_since(before, stamp)
        self._elapsed += int(np.minimum(np.maximum(steps, 0), INTERRUPTION).sum())
        self._passed += len(stamp) - (not self._stamps)
        recent = [(one, 1) for one in stamp[-_STAMPS - 1 :].tolist()]
        self._stamps = (self._stamps + recent)[-_STAMPS - 1 :]
        self._place = 0

    def _next_alone(self, stamp: int) -> None:
        """Add a sample with a separate stamp, ns, that is not the first."""
        self._elapsed += min(max(stamp - self._stamps[-1][0], 0), INTERRUPTION)
        self._passed += 1
        self._stamps = [*self._stamps, (stamp, 1)][-_STAMPS - 1 :]
        self._place = 0

    def _add(self, stamp: int) -> None:
        """Add a sample with the stamp of the one before, ns: set apart if it is one."""
        begin, _ = self._stamps[0]
        if len(self._stamps) > 1:
            interval = self._interval or self._elapsed / (self._passed + 1)
            count = 1 + sum(many for _, many in self._stamps[1:])
            if count * interval > _MORE * (stamp - begin):
                return
            self._passed += 1
        self._stamps[-1] = stamp, self._stamps[-1][1] + 1
        self._place += 1
        self.count += 1
        self._most = max(self._most, self._place + 1)
        if self._first is None:
            self._first = stamp
