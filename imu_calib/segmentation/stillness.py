"""IMU samples alone -> when the unit stood still and when it moved."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from ..stream import Floats, Stamps
from ..units import DEG, STANDARD_GRAVITY
from .motion import Motion, Rest

_WINDOW_SECONDS = 0.1
_WINDOWS_TO_SETTLE = 3
_RATE_TOLERANCE = 0.5 * DEG
_LARGEST_BIAS = 1.0 * DEG
_FORCE_TOLERANCE = 0.02 * STANDARD_GRAVITY
_WINDOWS_TO_OPEN = 20
_NO_JOINTS = np.empty((0, 0))
_NO_STAMPS: Stamps = np.empty(0, dtype=np.int64)


_Window: TypeAlias = tuple[int, int, Floats]
"""First and last stamp, ns, and the (6,) mean."""


class StillnessTracker:
    """Tells rests from motions by the means of short windows of IMU samples.

    Windows are counted from the first sample, so the outcome does not depend on how the stream was
    cut into blocks. A unit counts as still while its windows stay near those that began the rest
    and its rate is below 1 deg/s. A steady turn about the vertical looks like a rest with a large
    bias: only a stream that begins with two quiet seconds shows such a bias, and rates are then
    counted from there.
    """

    def __init__(self, period: float) -> None:
        self._length = max(1, round(_WINDOW_SECONDS / period))
        self._stamp: Stamps = _NO_STAMPS
        self._rates: Floats = np.empty((0, 6))
        self._windows: list[_Window] = []
        self._opening: list[_Window] = []
        self._bias: Floats | None = None
        self._reference: Floats | None = None
        self._start: int | None = None

    @property
    def known_until(self) -> int | None:
        """End of the last window that was judged, ns."""
        return self._windows[-1][1] if self._windows else None

    @property
    def rest_since(self) -> int | None:
        """Start of the rest that goes on, ns; None in motion."""
        return None if self._reference is None else self._start

    def feed(self, stamp: Stamps, rates: Floats) -> list[Rest | Motion]:
        """Take samples in; return what has come to its end.

        Args:
            stamp: (n,) ns.
            rates: (n, 6) rad/s and m/s^2.

        """
        self._stamp = np.concatenate([self._stamp, stamp])
        self._rates = np.vstack([self._rates, rates])
        done: list[Rest | Motion] = []
        while len(self._stamp) >= self._length:
            head, self._stamp = self._stamp[: self._length], self._stamp[self._length :]
            mean, self._rates = (
                self._rates[: self._length].mean(axis=0),
                self._rates[self._length :],
            )
            done += self._open((int(head[0]), int(head[-1]), mean))
        return done

    def finish(self) -> list[Rest | Motion]:
        """End of the stream: return the rest or motion that was going on."""
        done = self._opened() if self._bias is None else []
        end = self.known_until
        if end is None or self._start is None:
            return []
        return [
            *done,
            Rest(self._start, end) if self._reference is not None else self._motion(end),
        ]

    def split_rest(self, end: int) -> Rest | None:
        """Close the rest that goes on at `end` (ns) and go on with another; None in motion."""
        if self._reference is None or self._start is None:
            return None
        rest = Rest(self._start, end)
        self._start = end
        return rest

    def _open(self, window: _Window) -> list[Rest | Motion]:
        """Wait with the first windows until they show the bias."""
        if self._bias is not None:
            return self._judge(*window)
        self._opening.append(window)
        if len(self._opening) < _WINDOWS_TO_OPEN and _steady(self._opening):
            return []
        return self._opened()

    def _opened(self) -> list[Rest | Motion]:
        self._bias = np.zeros(3)
        if len(self._opening) >= _WINDOWS_TO_OPEN and _steady(self._opening):
            level = np.mean([mean[:3] for _, _, mean in self._opening], axis=0)
            if (np.abs(level) >= _LARGEST_BIAS).any():
                self._bias = level
        opening, self._opening = self._opening, []
        return [done for window in opening for done in self._judge(*window)]

    def _judge(self, start: int, end: int, mean: Floats) -> list[Rest | Motion]:
        assert self._bias is not None
        mean = mean - np.append(self._bias, np.zeros(3))
        self._start = start if self._start is None else self._start
        self._windows = [*self._windows, (start, end, mean)][-_WINDOWS_TO_SETTLE:]
        if self._reference is not None:
            if _near(mean, self._reference):
                return []
            # The last window that was near may hold the first of the motion.
            last = max(self._start, self._windows[-2][0] if len(self._windows) > 1 else start)
            rest = Rest(self._start, last)
            self._start, self._reference = last, None
            return [rest]
        recent = np.array([w[2] for w in self._windows])
        centre = recent.mean(axis=0)
        fresh = [w for w in self._windows if w[0] >= self._start]
        if len(fresh) < _WINDOWS_TO_SETTLE or not all(_near(m, centre) for m in recent):
            return []
        # The first window may hold the last of the motion: rest begins with the second.
        motion = self._motion(self._windows[1][0])
        self._start, self._reference = self._windows[1][0], centre
        return [motion] if motion.end > motion.start else []

    def _motion(self, end: int) -> Motion:
        return Motion(self._start or 0, end, _NO_STAMPS, _NO_JOINTS)


def _steady(windows: list[_Window]) -> bool:
    """Say whether windows lie near their mean, whatever that is."""
    means = np.array([mean for _, _, mean in windows])
    off = np.abs(means - means.mean(axis=0))
    return bool((off[:, :3] < _RATE_TOLERANCE).all() and (off[:, 3:] < _FORCE_TOLERANCE).all())


def _near(mean: Floats, reference: Floats) -> bool:
    difference = np.abs(mean - reference)
    return bool(
        np.all(difference[:3] < _RATE_TOLERANCE)
        and np.all(difference[3:] < _FORCE_TOLERANCE)
        and np.all(np.abs(mean[:3]) < _LARGEST_BIAS)
    )
