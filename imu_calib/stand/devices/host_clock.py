"""Compare the host's clock with the monotonic clock: find its steps."""

from __future__ import annotations

import numpy as np

from ...common.stream import Stamps

_LEAST_STEP = 10_000_000
"""A smaller difference, ns, can result from an interruption between the readings of both clocks. A
judgement."""


class HostClock:
    """Find steps of the host's clock, from readings of it and of a steady clock.

    On Linux a slewed clock (adjtime, NTP's corrections of rate) slews the steady one alike: both
    run at the corrected rate. Their difference then consists of steps.
    """

    def __init__(self) -> None:
        self._first: int | None = None
        self._ahead = 0

    @property
    def first(self) -> int:
        """By how much the host's clock was ahead of the steady one at the first reading, ns."""
        return self._first or 0

    def feed(self, host: Stamps, steady: Stamps) -> tuple[Stamps, list[tuple[int, int]]]:
        """Take (n,) readings of both clocks, ns, at least one.

        Returns:
            (n,) sum of the steps of the host's clock since the first reading, ns, and the steps
            among these readings: index and ns, in order.
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
