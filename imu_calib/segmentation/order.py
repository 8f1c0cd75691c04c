"""Stamps in order: drop samples whose stamps jump."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..common.stream import Floats, Stamps


@dataclass(frozen=True, eq=False)
class Ordered:
    """Rows whose stamps increase, and the stamps (ns) of those that were dropped."""

    stamp: Stamps
    values: Floats
    lost: Stamps


class StampOrder:
    """Passes rows whose stamps increase; the result does not depend on block boundaries.

    A row is dropped if it does not come after all before it, or if the next one comes after all
    before but not after this row: one wild stamp must not make all later ones look late. The last
    row waits for its successor.
    """

    def __init__(self, columns: int) -> None:
        self._last = int(np.iinfo(np.int64).min)
        self._stamp: Stamps = np.empty(0, dtype=np.int64)
        self._values: Floats = np.empty((0, columns))

    def take(self, stamp: Stamps, values: Floats) -> Ordered:
        """Take (n,) stamps with (n, columns) values; return the rows that are certain by now."""
        stamp = np.concatenate([self._stamp, stamp])
        values = np.concatenate([self._values, values])
        self._stamp, self._values = stamp[-1:], values[-1:]
        return self._sorted_out(stamp[:-1], values[:-1], stamp[1:])

    def finish(self) -> Ordered:
        """End the stream: return the row that waits."""
        stamp, self._stamp = self._stamp, self._stamp[:0]
        values, self._values = self._values, self._values[:0]
        return self._sorted_out(stamp, values, np.full(len(stamp), np.iinfo(np.int64).max))

    def _sorted_out(self, stamp: Stamps, values: Floats, following: Stamps) -> Ordered:
        if not len(stamp):
            return Ordered(stamp, values, stamp)
        if stamp[0] > self._last and np.all(following > stamp):
            self._last = int(stamp[-1])
            return Ordered(stamp, values, stamp[:0])
        keep = np.zeros(len(stamp), dtype=bool)
        for k, (now, after) in enumerate(zip(stamp.tolist(), following.tolist(), strict=True)):
            if now > self._last and not self._last < after <= now:
                keep[k] = True
                self._last = now
        return Ordered(stamp[keep], values[keep], stamp[~keep])
