"""Joint states -> when the table stood still and when it moved."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..stream import Floats, Stamps
from ..units import DEG

_WINDOW_NS = 250_000_000
"""ns over which a rate is looked at: encoders' noise counts little in it."""
_STILL_RATE = 0.05 * DEG
"""rad/s: 0.0125 degrees in the window, more than encoders scatter and less than any motion."""
_LONGEST_LOOK = 1.0
"""Time over which a table at rest may drift at `_STILL_RATE`, s. A judgement: what is 0.05 deg off
after a silence of the joint states has moved, however long that was."""

_TURN = 2 * np.pi
_SAMPLES_FOR_ANGLES = 4096
"""Readings of a rest that are averaged, at most: at 100 Hz they leave 0.1 arcsec of noise of 7."""

_ANGLES_NS = 40_000_000_000
"""Within which they lie, ns: a rest is not split before, whenever its readings come."""

_RECENT = 32
"""Readings before one that show the encoders' noise, by their second differences: what turns at one
rate has none."""

_NOISE = 10.0 * np.sqrt(2)
"""Standard deviations of a reading that two of them may differ by at rest: of 32 the scatter is
known to a fifth, and six are then passed once in 10^9."""

_SECOND_DIFFERENCE = 1.4826 / np.sqrt(6)
"""Standard deviation of readings over the median size of their second differences."""


@dataclass(frozen=True, eq=False)
class Rest:
    """The table stood still from `start` to `end` (ns) at `angles` ((k,) rad; None: unknown).

    `angle_error` is the standard deviation of such an angle by the noise of its encoder, rad.
    """

    start: int
    end: int
    angles: Floats | None = None
    angle_error: float = 0.0


@dataclass(frozen=True, eq=False)
class Motion:
    """The table moved from `start` to `end` (ns).

    Attributes:
        start: Last instant of the rest before, ns.
        end: First instant of the rest after, ns.
        stamp: (n,) joint states of the motion and of the rest around it, ns.
        position: (n, k) rad; empty without joint states.

    """

    start: int
    end: int
    stamp: Stamps
    position: Floats


class JointTracker:
    """Follows the joint states of a table and tells rests from motions.

    The outcome depends on the samples alone, not on how they were cut into blocks.
    """

    def __init__(self) -> None:
        self._stamp: Stamps = np.empty(0, dtype=np.int64)
        self._position: Floats = np.empty((0, 0))
        self._delivered: Floats = np.empty(0)
        self._turns: Floats = np.empty(0)
        self._judged = 0
        self._start: int | None = None
        self._moving = False
        self._angles: tuple[Floats, float] | None = None

    @property
    def known_until(self) -> int | None:
        """Stamp up to which the table's doing is known, ns."""
        return int(self._stamp[-1]) if len(self._stamp) else None

    @property
    def silent(self) -> bool:
        """Whether no joint state has come yet."""
        return not len(self._stamp)

    @property
    def rest_since(self) -> int | None:
        """Start of the rest that goes on, ns; None in motion."""
        return None if self._moving else self._start

    def feed(self, stamp: Stamps, position: Floats) -> list[Rest | Motion]:
        """Take joint states in; return what has come to its end.

        Args:
            stamp: (n,) ns, increasing.
            position: (n, k) rad.

        """
        if self.silent:
            self._delivered, self._turns = position[0], np.zeros(position.shape[1])
            self._position = self._position.reshape(0, position.shape[1])
        self._position = np.vstack([self._position, self._unwrapped(position)])
        self._stamp = np.concatenate([self._stamp, stamp])
        return self._judge()

    def _unwrapped(self, position: Floats) -> Floats:
        """Add whole turns: counted, where `np.unwrap` sums what each cut of the stream rounds."""
        steps = np.diff(np.vstack([self._delivered, position]), axis=0)
        turns = self._turns - np.cumsum(np.rint(steps / _TURN), axis=0)
        self._delivered, self._turns = position[-1], turns[-1]
        return np.asarray(position + _TURN * turns)

    def finish(self) -> list[Rest | Motion]:
        """End of the stream: return the rest or motion that was going on."""
        if not len(self._stamp):
            return []
        done = self._judge(ended=True)
        end, start = int(self._stamp[-1]), self._start or 0
        return [*done, self._motion(end) if self._moving else self._rest(start, end)]

    def split_rest(self, end: int) -> Rest | None:
        """Close the rest that goes on at `end` (ns) and go on with another.

        None in motion, and while readings that its angles are the mean of may still come.
        """
        if self._moving or self._start is None:
            return None
        if self._angles is None:
            if self._stamp[-1] < self._start + _ANGLES_NS:
                return None
            self._angles = self._mean(self._start, self._start + _ANGLES_NS)
        rest = self._rest(self._start, end)
        self._start = end
        return rest

    def _judge(self, *, ended: bool = False) -> list[Rest | Motion]:
        """Go through new samples: a sample moves if the window before it shows a rate.

        The first ones wait until they show how noisy they are.
        """
        if self._start is None and len(self._stamp) < _RECENT + 2 and not ended:
            return []
        before = np.searchsorted(self._stamp, self._stamp - _WINDOW_NS, side='right') - 1
        before = np.clip(np.minimum(before, np.arange(len(before)) - 1), 0, None)
        elapsed = np.maximum(self._stamp - self._stamp[before], 1) * 1e-9
        apart = np.abs(self._position - self._position[before])
        # What stands still does so however long nobody looks: silence is no leave to turn.
        drift = _STILL_RATE * np.minimum(elapsed, _LONGEST_LOOK)
        limit = np.maximum(drift[:, None], _NOISE * self._noise())
        moving = (apart > limit).any(axis=1)
        done: list[Rest | Motion] = []
        if self._start is None:
            self._start = int(self._stamp[0])
            self._judged = 1
        new = np.arange(self._judged, len(moving))
        changes = new[np.diff(moving[new].astype(np.int8), prepend=np.int8(self._moving)) != 0]
        for k in changes:
            # A window that counts as still may hold the last of a move, or the first of the next:
            # rest begins at the end of its first still window and ends where its last one began.
            if moving[k]:
                last = max(int(self._stamp[before[k - 1]]), self._start)
                done.append(self._rest(self._start, last))
                self._start, self._moving, self._angles = last, True, None
            else:
                first = int(self._stamp[k])
                done.append(self._motion(first))
                self._start, self._moving = first, False
        self._judged = len(moving)
        self._forget()
        return done

    def _noise(self) -> Floats:
        """Return the standard deviation of each reading, (n, k) rad, by those before it.

        Of readings that were judged already it is not asked: zero.
        """
        noise = np.zeros_like(self._position)
        first = max(self._judged, _RECENT + 1)
        if first < len(noise):
            # The first readings have those after them alone.
            around = self._position[first - _RECENT - 1 :]
            sizes = np.abs(np.diff(around, n=2, axis=0))
            windows = np.lib.stride_tricks.sliding_window_view(sizes, _RECENT, axis=0)
            noise[first:] = _SECOND_DIFFERENCE * np.median(windows, axis=2)
            if self._start is None:
                noise[:first] = noise[first]
        return noise

    def _rest(self, start: int, end: int) -> Rest:
        """Close a rest; its angles are those of its first samples, however it is split."""
        if self._angles is None:
            self._angles = self._mean(start, min(end, start + _ANGLES_NS))
        return Rest(start, end, *self._angles)

    def _mean(self, start: int, end: int) -> tuple[Floats, float]:
        """Return the mean angles from one instant to another, ns, and their deviation by noise."""
        inside = (self._stamp >= start) & (self._stamp <= end)
        return averaged(self._position[inside][:_SAMPLES_FOR_ANGLES])

    def _motion(self, end: int) -> Motion:
        first = int(np.searchsorted(self._stamp, self._start or 0, side='left'))
        inside = slice(first, int(np.searchsorted(self._stamp, end, side='right')))
        return Motion(
            self._start or 0, end, self._stamp[inside].copy(), self._position[inside].copy()
        )

    def _forget(self) -> None:
        """Drop what no later decision needs, so that memory does not grow with the session."""
        if self._start is None:
            return
        recent = int(np.searchsorted(self._stamp, self._stamp[-1] - 2 * _WINDOW_NS))
        recent = max(0, min(recent, len(self._stamp) - _RECENT - 2))
        first = min(int(np.searchsorted(self._stamp, self._start)), recent)
        if not self._moving and recent - first > _SAMPLES_FOR_ANGLES:
            # The first samples of a rest give its angles, the last ones the next decision.
            kept = np.r_[first : first + _SAMPLES_FOR_ANGLES, recent : len(self._stamp)]
        else:
            kept = np.arange(first, len(self._stamp))
        self._stamp, self._position = self._stamp[kept], self._position[kept]
        self._judged = len(self._stamp)


def averaged(readings: Floats) -> tuple[Floats, float]:
    """Return the mean of (n, k) angles of joints that stand, and its standard deviation by noise.

    The latter is that of one joint, the mean over all: a level axis leans with one of them.
    """
    n = len(readings)
    noise = readings.var(axis=0, ddof=1) / n if n > 1 else np.zeros(1)
    return readings.mean(axis=0), float(np.sqrt(noise.mean()))
