"""Remaining time of a session by the wall clock, and what it waits for, as texts."""

from __future__ import annotations

import math
from collections import deque
from datetime import datetime, timedelta

READING = 'The journal is read: '
"""Beginning of the report while the session before an interruption is read."""
_SPAN = 20.0
"""s of the wall clock over which the stand's time is compared with it: longer than the motion of a
table between positions, during which simulated time advances unevenly."""
_LEAST = 2.0
"""s before the comparison is used."""
_REAL = 0.1
"""Relative difference up to which the stand's time and the wall clock count as equal: stamps come
twice a second."""


class Pace:
    """Compares the stand's time with the wall clock, while a plan runs.

    During a pause simulated time is no faster than the wall clock, however fast it is else.
    """

    def __init__(self) -> None:
        self._last: tuple[float, float] | None = None
        self._run = deque([(0.0, 0.0)])

    def note(self, stamp: float, now: float) -> None:
        """Add a stamp of the stand, received at a time of the steady clock, both s."""
        last, self._last = self._last, (stamp, now)
        if last is None:
            return
        if stamp < last[0] or now < last[1]:
            self._run = deque([(0.0, 0.0)])
            return
        stand, wall = self._run[-1]
        self._run.append((stand + stamp - last[0], wall + now - last[1]))
        while self._run[-1][1] - self._run[0][1] > _SPAN:
            self._run.popleft()

    def pause(self) -> None:
        """Leave out the time until the next stamp."""
        self._last = None

    @property
    def speed(self) -> float:
        """Seconds of the stand per second of the wall clock; 1 until it is known."""
        (stamp, begun), (last, now) = self._run[0], self._run[-1]
        if now - begun < _LEAST or last <= stamp:
            return 1.0
        speed = (last - stamp) / (now - begun)
        return 1.0 if abs(speed - 1) < _REAL else speed


def reading_sentence(share: float) -> str:
    """Return a sentence on how much of the journal of a resumed session is read, 0 to 1."""
    return f'{READING}{100 * share:.0f} %.'


def in_words(seconds: float) -> str:
    """Return a duration in at most two units.

    Examples:
        >>> in_words(42.0), in_words(754.0), in_words(7260.0)
        ('42 s', '12 min 34 s', '2 h 1 min')
    """
    if math.isnan(seconds):
        return 'not known'
    whole = max(0, round(seconds))
    hours, minutes, rest = whole // 3600, whole // 60 % 60, whole % 60
    if hours:
        return f'{hours} h {minutes} min'
    return f'{minutes} min {rest} s' if minutes else f'{rest} s'


def ends_at(seconds: float, now: datetime) -> str:
    """Return the time of day of the end, with the date if that is another day."""
    end = now + timedelta(seconds=seconds)
    return f'{end:%H:%M}' if end.date() == now.date() else f'{end:%Y-%m-%d %H:%M}'
