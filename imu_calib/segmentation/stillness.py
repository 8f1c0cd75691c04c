"""IMU samples alone -> when the unit stood still and when it moved."""

from __future__ import annotations

import numpy as np

from ..stream import Floats, Stamps
from ..units import DEG, STANDARD_GRAVITY
from .motion import Motion, Rest

_WINDOW_SECONDS = 0.1
_WINDOWS_TO_SETTLE = 3
_RATE_TOLERANCE = 0.5 * DEG
_LARGEST_BIAS = 1.0 * DEG
_FORCE_TOLERANCE = 0.02 * STANDARD_GRAVITY
_NO_JOINTS = np.empty((0, 0))
_NO_STAMPS: Stamps = np.empty(0, dtype=np.int64)


class StillnessTracker:
    """Tells rests from motions by the means of short windows of IMU samples.

    Windows are counted from the first sample, so the outcome does not depend on how the stream was
    cut into blocks. A unit counts as still while its windows stay near those that began the rest
    and its rate is below 1 deg/s; a gyro bias above that needs joint states.
    """

    def __init__(self, period: float) -> None:
        self._length = max(1, round(_WINDOW_SECONDS / period))
        self._stamp: Stamps = _NO_STAMPS
        self._rates: Floats = np.empty((0, 6))
        self._windows: list[tuple[int, int, Floats]] = []
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
            done += self._judge(int(head[0]), int(head[-1]), mean)
        return done

    def finish(self) -> list[Rest | Motion]:
        """End of the stream: return the rest or motion that was going on."""
        end = self.known_until
        if end is None or self._start is None:
            return []
        return [Rest(self._start, end) if self._reference is not None else self._motion(end)]

    def split_rest(self, end: int) -> Rest | None:
        """Close the rest that goes on at `end` (ns) and go on with another; None in motion."""
        if self._reference is None or self._start is None:
            return None
        rest = Rest(self._start, end)
        self._start = end
        return rest

    def _judge(self, start: int, end: int, mean: Floats) -> list[Rest | Motion]:
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


def _near(mean: Floats, reference: Floats) -> bool:
    difference = np.abs(mean - reference)
    return bool(
        np.all(difference[:3] < _RATE_TOLERANCE)
        and np.all(difference[3:] < _FORCE_TOLERANCE)
        and np.all(np.abs(mean[:3]) < _LARGEST_BIAS)
    )
