"""Joint states -> when the table stood still and when it moved."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..common.gaussian import MAD_TO_STD
from ..common.stream import Floats, Stamps
from ..common.units import DEG
from ..session.table import TURN
from .counters import any_in_row
from .stamps import RowBuffer

_WINDOW_NS = 250_000_000  #: ns over which a rate is taken: encoders' noise has little effect in it.
_STILL_RATE = 0.05 * DEG
"""rad/s: 0.0125 degrees in the window, more than encoder noise and less than any motion."""
_LONGEST_LOOK = 1.0
"""Time over which a table at rest may drift at `_STILL_RATE`, s. A judgement: a joint that is 0.05
deg off after a silence of the joint states has moved, for any length of it."""

_SAMPLES_FOR_ANGLES = 4096
"""Readings of a dwell that are averaged, at most: at 100 Hz they leave 0.1 arcsec of noise of 7."""

_ANGLES_NS = 40_000_000_000
"""Time within which they lie, ns: a dwell is not split earlier, whenever its readings come."""

_RECENT = 32
"""Readings before one that show the encoders' noise by their second differences, which are zero at
a constant rate."""

_NOISE = 10.0 * np.sqrt(2)
"""Standard deviations of a reading by which two may differ at rest: from 32 readings the scatter is
known to a fifth, and six are then exceeded once in 10^9."""

_SECOND_DIFFERENCE = MAD_TO_STD / np.sqrt(6)
"""Standard deviation of readings over the median size of their second differences."""


@dataclass(frozen=True, eq=False)
class Rest:
    """A time in which the table, or a unit without one, stood still."""

    start: int  #: Its beginning, ns.
    end: int  #: Its end, ns.
    angles: Floats | None = None  #: (k,) joint angles, rad; None without joint states.
    #: Standard deviation of such an angle by the noise of its encoder, rad.
    angle_error: float = 0.0


@dataclass(frozen=True, eq=False)
class Motion:
    """The table moved from `start` to `end` (ns)."""

    start: int  #: Last instant of the rest before, ns.
    end: int  #: First instant of the rest after, ns.
    stamp: Stamps  #: (n,) joint states of the motion and of the rest around it, ns.
    position: Floats  #: (n, k) rad; empty without joint states.

    @cached_property
    def travel(self) -> Floats:
        """Angle by which each joint moved, (k,) rad; needs joint states."""
        # Joint by joint: numpy is ten times slower along so short an axis.
        return np.array([np.ptp(angle) for angle in self.position.T])


class JointTracker:
    """Detects dwells and motions from the joint states of a table.

    The result depends on the samples alone, not on how they were cut into blocks.
    """

    def __init__(self) -> None:
        self._rows = RowBuffer(0)
        self._delivered: Floats = np.empty(0)
        self._turns: Floats = np.empty(0)
        self._judged = 0
        self._seen_from = 0
        self._start: int | None = None
        self._moving = False
        self._angles: tuple[Floats, float] | None = None

    @property
    def known_until(self) -> int | None:
        """Stamp up to which the table's motion is known, ns."""
        return int(self._rows.stamp[-1]) if len(self._rows) else None

    @property
    def silent(self) -> bool:
        """Whether no joint state has come yet."""
        return not len(self._rows)

    @property
    def rest_since(self) -> int | None:
        """Start of the current rest, ns; None in motion."""
        return None if self._moving else self._start

    def track(self, stamp: Stamps, position: Floats) -> list[Rest | Motion]:
        """Add joint states (n,), ns, (n, k), rad; return the rests and motions that have ended."""
        if self.silent:
            self._delivered, self._turns = position[0], np.zeros(position.shape[1])
            self._rows = RowBuffer(position.shape[1])
        self._rows.append(stamp, self._unwrapped(position))
        return self._judge()

    def _unwrapped(self, position: Floats) -> Floats:
        """Add whole turns: counted, as each cut of the stream rounds the sums of `np.unwrap`."""
        steps = np.empty_like(position)
        steps[0] = position[0] - self._delivered
        np.subtract(position[1:], position[:-1], out=steps[1:])
        turns = self._turns - np.cumsum(np.rint(steps / TURN), axis=0)
        self._delivered, self._turns = position[-1], turns[-1]
        return np.asarray(position + TURN * turns)

    def finish(self) -> list[Rest | Motion]:
        """End the stream: return the current rest or motion."""
        if self.silent:
            return []
        done = self._judge(ended=True)
        end, start = int(self._rows.stamp[-1]), self._start or 0
        return [*done, self._motion(end) if self._moving else self._rest(start, end)]

    def split_rest(self, end: int) -> Rest | None:
        """Close the current rest at `end` (ns) and begin another.

        None in motion, and while readings for the mean of its angles may still come.
        """
        if self._moving or self._start is None or self._angles is None:
            return None
        rest = self._rest(self._start, end)
        self._start = end
        return rest

    def _judge(self, *, ended: bool = False) -> list[Rest | Motion]:
        """Judge new samples: a sample moves if the window before it shows a rate.

        The first ones wait until their noise is known.
        """
        stamp, position = self._rows.stamp, self._rows.values
        if self._start is None:
            if len(stamp) < _RECENT + 2 and not ended:
                return []
            self._start = int(stamp[0])
        first_new = self._judged
        if first_new == len(stamp):
            return []
        fresh = stamp[first_new:]
        before = np.searchsorted(stamp, fresh - _WINDOW_NS, side='right') - 1
        before = np.maximum(np.minimum(before, np.arange(first_new - 1, len(stamp) - 1)), 0)
        elapsed = np.asarray((fresh - stamp[before]) * 1e-9)
        moving = self._moved(position, first_new, before, elapsed)
        done: list[Rest | Motion] = []
        changes = moving != self._moving
        changes[1:] = moving[1:] != moving[:-1]
        for k in np.flatnonzero(changes).tolist():
            # A still window may hold the end of a move, or the beginning of the next: a dwell
            # begins at the end of its first still window and ends where its last one began.
            if moving[k]:
                last = max(self._seen_from if k == 0 else int(stamp[before[k - 1]]), self._start)
                done.append(self._rest(self._start, last))
                self._start, self._moving, self._angles = last, True, None
            else:
                first = int(fresh[k])
                done.append(self._motion(first))
                self._start, self._moving = first, False
        self._judged, self._seen_from = len(stamp), int(stamp[before[-1]])
        self._forget()
        return done

    def _moved(
        self, position: Floats, new: int, before: NDArray[np.intp], elapsed: Floats
    ) -> NDArray[np.bool_]:
        """Return for readings (m, k) from `new` on whether a joint differs from those before.

        Each of the n new ones is compared with one `before`, `elapsed` seconds ago; (n,).
        """
        apart = np.abs(position[new:] - position[before])
        # A table at rest stays at rest during a silence: only joint states show a motion.
        far = apart > (_STILL_RATE * np.minimum(elapsed, _LONGEST_LOOK))[:, None]
        first = max(new, _RECENT + 1)
        if not far.any() or first >= len(position):
            return any_in_row(far)
        # For the first readings only those after them are available.
        sizes = np.abs(np.diff(position[first - _RECENT - 1 :], n=2, axis=0))
        limits = (_NOISE * _SECOND_DIFFERENCE) * sizes
        # The noise is the median absolute second difference of those before.
        unsure = np.flatnonzero(any_in_row(far & (apart <= limits.max(axis=0))))
        if len(unsure):
            windows = np.lib.stride_tricks.sliding_window_view(limits, _RECENT, axis=0)
            far[unsure] &= apart[unsure] > np.median(
                windows[np.maximum(new + unsure - first, 0)], axis=2
            )
        return any_in_row(far)

    def _rest(self, start: int, end: int) -> Rest:
        """Close a dwell; its angles are those of its first samples, for any split."""
        if self._angles is None:
            self._angles = self._mean(start, min(end, start + _ANGLES_NS))
        return Rest(start, end, *self._angles)

    def _mean(self, start: int, end: int) -> tuple[Floats, float]:
        """Return the mean angles from one instant to another, ns, and their std by noise."""
        return averaged(self._rows.between(start - 1, end)[1][:_SAMPLES_FOR_ANGLES])

    def _motion(self, end: int) -> Motion:
        start = self._start or 0
        return Motion(start, end, *self._rows.between(start - 1, end))

    def _forget(self) -> None:
        """Drop data that later decisions do not need, so that memory is bounded."""
        start, stamp = self._start or 0, self._rows.stamp
        if not self._moving and self._angles is None and self._seen_from >= start + _ANGLES_NS:
            # The rest lasted until there at least.
            self._angles = self._mean(start, start + _ANGLES_NS)
        recent = int(np.searchsorted(stamp, stamp[-1] - 2 * _WINDOW_NS))
        unread = recent if self._angles is not None else int(np.searchsorted(stamp, start))
        self._judged -= self._rows.remove_first(min(unread, recent, len(stamp) - _RECENT - 2))


def averaged(readings: Floats) -> tuple[Floats, float]:
    """Return the mean of (n, k) angles of joints at rest, and its standard deviation by noise.

    The latter is that of one joint, the mean over all: a level axis leans with one joint.
    """
    n = len(readings)
    noise = readings.var(axis=0, ddof=1) / n if n > 1 else np.zeros(1)
    return readings.mean(axis=0), float(np.sqrt(noise.mean()))
