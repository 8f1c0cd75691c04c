"""When a setpoint is due; independent of the middleware."""

from __future__ import annotations

import math

from ...common.stream import NS


class Pacing:
    """Keeps a rate by the stamps of joint states, and by the steady clock without them.

    Args:
        rate: Of setpoints, Hz.

    Attributes:
        seconds: Between two setpoints.
    """

    def __init__(self, rate: float) -> None:
        self._period = round(NS / rate)
        self.seconds = self._period * 1e-9
        self._revision = -1
        self._due_stamp = 0
        self._due = -math.inf

    def is_due(self, table_time: int | None, now: float, revision: int) -> bool:
        """Return whether a setpoint is due.

        Args:
            table_time: Stamp of the last joint state, ns; None before the first.
            now: Of the steady clock, s.
            revision: Of the setpoint: a new one is due at once.
        """
        if table_time is not None and self._due_stamp > table_time + 2 * self._period:
            # The table's time restarted.
            self._due_stamp = table_time
        by_table = table_time is not None and table_time >= self._due_stamp
        return by_table or now >= self._due or revision != self._revision

    def sent(self, table_time: int | None, now: float, revision: int) -> None:
        """Record that a setpoint was sent; arguments as of `is_due`."""
        if table_time is not None and table_time >= self._due_stamp:
            # Count from the due time: a delay by one joint state each time would lower the mean
            # rate.
            late = table_time - self._due_stamp
            self._due_stamp = table_time + self._period - (late if late < self._period else 0)
        self._due = now + self.seconds
        self._revision = revision
