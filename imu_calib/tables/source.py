"""Whose setpoints a table follows: those of one source at a time, and none while that is forbidden.

It knows no clock and no middleware: times and sources come with the calls.
"""

from __future__ import annotations

import math
from dataclasses import replace

from ..stream import Mode, Setpoint


class OneSource:
    """Lets through the setpoints of one source; whatever else comes makes the table stand.

    A source has the table from its first setpoint until it has been silent for so long that the
    table has stopped for want of setpoints; then another may have it. While one has it, a setpoint
    of another is not followed: it is unknown which of the two is right, so the table stands.
    HOLD is let through from everybody, for standing still is never wrong. After a stand nothing
    moves before that long has passed without a setpoint but HOLD: a leader that has not
    noticed does not go on where it was.

    Args:
        timeout: Silence after which a source has the table no more, s: that of the driver's
            setpoints.

    Attributes:
        words: Why setpoints are not followed, in sentences; empty where they are.

    """

    def __init__(self, timeout: float) -> None:
        self._timeout = timeout
        self._source: bytes | None = None
        self._heard_at = self._second_at = self._refused_at = -math.inf
        self._forbidden = ''
        self._followed: Setpoint | None = None
        self.words = ''

    def forbid(self, why: str) -> Setpoint | None:
        """Take whether something forbids every movement.

        Args:
            why: A sentence; empty where nothing does.

        Returns:
            The HOLD that stops what is being followed; None where nothing is.

        """
        if self.words == self._forbidden:
            self.words = ''
        self._forbidden = why
        if not why:
            return None
        self.words = why
        followed, self._followed = self._followed, None
        return None if followed is None else replace(followed, mode=Mode.HOLD)

    def admit(self, setpoint: Setpoint, source: bytes, steady: float) -> Setpoint:
        """Return what the table is to follow: the setpoint as it came, or HOLD in its place.

        Args:
            setpoint: As it came off the topic.
            source: Tells its publisher from others.
            steady: Monotonic time, s.

        """
        if source != self._source and steady - self._heard_at <= self._timeout:
            self._second_at = steady
        else:
            self._source, self._heard_at = source, steady
        if setpoint.mode is Mode.HOLD:
            return self._stand(setpoint, steady)
        words = self._objection(steady)
        if words:
            self._refused_at, self.words = steady, words
            return self._stand(setpoint, steady)
        self._followed, self.words = setpoint, ''
        return setpoint

    def _objection(self, steady: float) -> str:
        """Return why a movement is not followed; empty where it is."""
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
        self.words = self.words if self._objection(steady) else ''
        return replace(setpoint, mode=Mode.HOLD)
