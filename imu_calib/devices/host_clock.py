"""The host's clock against the monotonic clock: by how much it has been set."""

from __future__ import annotations

import numpy as np

from ..stream import Stamps

_LEAST_STEP = 10_000_000
"""A smaller difference, ns, can come of a reading that was interrupted between the two clocks."""


class HostClock:
    """Finds where the host's clock was set, from readings of it and of a steady clock.

    A clock that is slewed (adjtime, NTP's corrections of rate) takes the steady one with it on
    Linux: both run at the corrected rate, and nothing is set. What is left between them is steps.
    """

    def __init__(self) -> None:
        self._first: int | None = None
        self._ahead = 0

    @property
    def first(self) -> int:
        """How far the host's clock was ahead of the steady one at the first reading, ns."""
        return self._first or 0

    def feed(self, host: Stamps, steady: Stamps) -> tuple[Stamps, list[tuple[int, int]]]:
        """Take (n,) readings of both clocks, ns, one at least.

        Returns:
            (n,) by how much the host's clock has been set since the first reading, ns, and the
            steps among these readings: index and ns, in order.

        """
        ahead = host - steady
        if self._first is None:
            self._first = self._ahead = int(ahead[0])
        since = np.full(len(ahead), self._ahead - self._first, np.int64)
        steps = []
        begin = 0
        while (off := abs(ahead[begin:] - self._ahead) > _LEAST_STEP).any():
            begin += int(off.argmax())
            steps.append((begin, int(ahead[begin]) - self._ahead))
            self._ahead = int(ahead[begin])
            since[begin:] = self._ahead - self._first
        return since, steps
