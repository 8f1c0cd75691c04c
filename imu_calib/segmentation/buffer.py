"""A first-in first-out buffer of rows, cheap to append to and to drop from."""

from __future__ import annotations

import numpy as np

from ..stream import Floats, Stamps

_FIRST_CAPACITY = 1024
"""Rows."""


class RowBuffer:
    """Rows (stamp, values) in order of their stamps; appending is amortised constant.

    Args:
        columns: Length of a row of values.

    """

    def __init__(self, columns: int) -> None:
        self._stamp: Stamps = np.empty(_FIRST_CAPACITY, dtype=np.int64)
        self._values: Floats = np.empty((_FIRST_CAPACITY, columns))
        self._first = 0
        self._last = 0

    def __len__(self) -> int:
        return self._last - self._first

    @property
    def stamp(self) -> Stamps:
        """Stamps (n,) of the rows, ns, a view."""
        return self._stamp[self._first : self._last]

    @property
    def values(self) -> Floats:
        """Values (n, columns) of the rows, a view."""
        return self._values[self._first : self._last]

    def append(self, stamp: Stamps, values: Floats) -> None:
        """Add (n,) stamps and (n, columns) values behind the last."""
        needed = len(self) + len(stamp)
        if self._last + len(stamp) > len(self._stamp):
            capacity = max(len(self._stamp), 2 * needed)
            grown_stamp = np.empty(capacity, dtype=np.int64)
            grown_values = np.empty((capacity, self._values.shape[1]))
            grown_stamp[: len(self)], grown_values[: len(self)] = self.stamp, self.values
            self._first, self._last = 0, len(self)
            self._stamp, self._values = grown_stamp, grown_values
        end = self._last + len(stamp)
        self._stamp[self._last : end], self._values[self._last : end] = stamp, values
        self._last = end

    def between(self, start: int, end: int) -> tuple[Stamps, Floats]:
        """Return copies of the rows with start < stamp <= end: stamps (n,), values (n, columns)."""
        a, b = np.searchsorted(self.stamp, [start, end], side='right')
        return self.stamp[a:b].copy(), self.values[a:b].copy()

    def drop_until(self, stamp: int) -> None:
        """Forget the rows with stamps up to `stamp`."""
        self.drop(int(np.searchsorted(self.stamp, stamp, side='right')))

    def drop(self, count: int) -> int:
        """Forget so many of the first rows, none where it is below zero; return how many."""
        dropped = max(0, count)
        self._first += dropped
        return dropped
