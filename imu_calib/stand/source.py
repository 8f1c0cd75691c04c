"""Select the setpoints that a table follows: one source at a time, and none while forbidden.

It has no clock and no middleware: times and sources are arguments.
"""

from __future__ import annotations

import math
from dataclasses import replace

from ..common.stream import Mode, Setpoint


class OneSource:
    """Pass the setpoints of one source; any other setpoint makes the table hold.

    A source controls the table from its first setpoint until its silence exceeds the timeout, after
    which the table has stopped; then another source may take over. Meanwhile a setpoint of another
    source is not followed: which of the two is right is unknown, so the table holds. HOLD is passed
    from all sources, since standing still is always safe. After such a hold nothing moves until the
    timeout has passed without a setpoint other than HOLD, so that a leader that did not notice
    cannot continue where it was.

    Args:
        timeout: Silence after which a source no longer controls the table, s: that of the driver's
            setpoints.

    Attributes:
        reason: Why setpoints are not followed, in sentences; otherwise empty.
    """

    def __init__(self, timeout: float) -> None:
        self._timeout = timeout
        self._source: bytes | None = None
        self._received_at = self._second_at = self._refused_at = -math.inf
        self._forbidden = ''
        self._followed: Setpoint | None = None
        self.reason = ''

    def forbid(self, why: str) -> Setpoint | None:
        """Set whether movement is forbidden.

        Args:
            why: A sentence; empty if allowed.

        Returns:
            The HOLD that stops the motion being followed; None if there is none.
        """
        if self.reason == self._forbidden:
            self.reason = ''
        self._forbidden = why
        if not why:
            return None
        self.reason = why
        followed, self._followed = self._followed, None
        return None if followed is None else replace(followed, mode=Mode.HOLD)

    def checked(self, setpoint: Setpoint, source: bytes, steady: float) -> Setpoint:
        """Return the setpoint for the table: as received, or HOLD in its place.

        Args:
            setpoint: As received from the topic.
            source: Identifies its publisher.
            steady: Monotonic time, s.
        """
        if source != self._source and steady - self._received_at <= self._timeout:
            self._second_at = steady
        else:
            self._source, self._received_at = source, steady
        if setpoint.mode is Mode.HOLD:
            return self._stand(setpoint, steady)
        reason = self._objection(steady)
        if reason:
            self._refused_at, self.reason = steady, reason
            return self._stand(setpoint, steady)
        self._followed, self.reason = setpoint, ''
        return setpoint

    def _objection(self, steady: float) -> str:
        """Return why a movement is not followed; otherwise empty."""
        if self._forbidden:
            return self._forbidden
        if steady - self._second_at <= self._timeout:
            return (
                'Setpoints come from two sources: none is followed, and the table stands. End one '
                'of them.'
            )
        if steady - self._refused_at <= self._timeout:
            return (
                'The table stands: motion is refused, and setpoints still arrive. It follows '
                f'again after {self._timeout:g} s without any but HOLD.'
            )
        return ''

    def _stand(self, setpoint: Setpoint, steady: float) -> Setpoint:
        self._followed = None
        self.reason = self.reason if self._objection(steady) else ''
        return replace(setpoint, mode=Mode.HOLD)
