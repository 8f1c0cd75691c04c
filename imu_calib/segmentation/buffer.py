"""A first-in first-out buffer of rows, cheap to append to and to drop from."""

from __future__ import annotations

import numpy as np

from ..common.stream import Floats, Stamps

_FIRST_CAPACITY = 1024
"""Rows. A choice: it doubles when it is full."""


class RowBuffer:
    """Rows (stamp, values) in order of their stamps; appending is amortised constant.

    It holds at most three times the bytes of its largest content since the last reallocation: twice
    that for new rows, and the former memory while rows are copied. Rows in the buffer are never
    overwritten: views stay valid.
    """

    def __init__(self, columns: int) -> None:
        self._stamp: Stamps = np.empty(_FIRST_CAPACITY, dtype=np.int64)
        self._values: Floats = np.empty((_FIRST_CAPACITY, columns))
        self._first = 0
        self._last = 0

    def __len__(self) -> int:
        return self._last - self._first

    def __deepcopy__(self, _: object) -> RowBuffer:
        """Return a separate buffer with the same rows and no spare capacity."""
        other = RowBuffer(self._values.shape[1])
        other._allot(len(self) + _FIRST_CAPACITY, self)
        return other

    @property
    def stamp(self) -> Stamps:
        """Stamps (n,) of the rows, ns, a view."""
        return self._stamp[self._first : self._last]

    @property
    def values(self) -> Floats:
        """Values (n, columns) of the rows, a view."""
        return self._values[self._first : self._last]

    def append(self, stamp: Stamps, values: Floats) -> None:
        """Append (n,) stamps and (n, columns) values."""
        needed = len(self) + len(stamp)
        if self._last + len(stamp) > len(self._stamp):
            self._allot(max(_FIRST_CAPACITY, 2 * needed), self)
        end = self._last + len(stamp)
        self._stamp[self._last : end], self._values[self._last : end] = stamp, values
        self._last = end

    def _allot(self, capacity: int, rows: RowBuffer) -> None:
        """Copy the rows of a buffer, which may be this one, into a memory for so many."""
        stamp = np.empty(capacity, dtype=np.int64)
        values = np.empty((capacity, rows._values.shape[1]))
        stamp[: len(rows)], values[: len(rows)] = rows.stamp, rows.values
        self._first, self._last = 0, len(rows)
        self._stamp, self._values = stamp, values

    def between(self, start: int, end: int) -> tuple[Stamps, Floats]:
        """Return the rows with start < stamp <= end: stamps (n,), values (n, columns).

        They are read-only views: a dwell of a million samples is not copied.
        """
        a, b = np.searchsorted(self.stamp, [start, end], side='right')
        stamp, values = self.stamp[a:b], self.values[a:b]
        stamp.flags.writeable = values.flags.writeable = False
        return stamp, values

    def remove_until(self, stamp: int) -> None:
        """Remove the rows with stamps up to `stamp`."""
        self.remove_first(int(np.searchsorted(self.stamp, stamp, side='right')))

    def remove_first(self, count: int) -> int:
        """Remove so many of the first rows, none if below zero; return how many."""
        removed = max(0, count)
        self._first += removed
        return removed
