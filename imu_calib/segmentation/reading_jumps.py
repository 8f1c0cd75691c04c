"""Readings of joints that are off: single late or false ones, and an encoder that was homed anew.

A reading that came late repeats an earlier angle, and those that follow are right: it is left out.
If the readings do not come back, the encoder was homed anew, or slipped by degrees, while the table
went on as before: later readings are taken less the jump, so that attitudes and clocks are those of
one frame. What remains of it is small, and may be found by the sensors
(`estimation/positioning_errors`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ..common.finding import warning
from ..common.stream import Floats, Stamps, at
from ..common.units import DEG, counted
from ..session.table import TURN, Table
from .stamp_faults import steps_since

_LEAST = 1.0 * DEG
"""rad: less is noise of an encoder, or is found by the sensors. A judgement."""
_BEYOND_LIMIT = 60.0
"""Times the acceleration of a joint that no table reaches: joint states in degrees seem 57 times as
fast, and are another mistake."""
_BEYOND_ANY = 20_000 * DEG
"""rad/s^2: the same for a joint of unknown acceleration, 100 times that of common tables."""
_TIMES = 2.0  #: Of the step before: stamps may bunch, with steps as large as before. A judgement.
_LATE_BY = 8
"""Readings by which one may be late, and so many in a row: 80 ms at 100 Hz. A judgement: longer
silences are gaps, and a reader of serial lines waits for less."""
_LEAST_LATE = 0.02 * DEG
"""rad: a reading that is less off is as good as its noise. A judgement: late by 1 ms at 20 deg/s,
and beyond the steps of encoders that calibrate."""
_STANDS_OUT = 10.0
"""Times the largest deviation from even steps of the readings before: those of ramps and of stamps
that jitter are alike from reading to reading. A judgement."""
_BACK = 0.5  #: Of its deviation: readings that come closer to the old course are back on it.
_AT_ONCE = 512  #: Readings that are compared at once: after one that is off the rest is done anew.


@dataclass(frozen=True)
class _Reading:
    """An accepted reading, and how the joints came there."""

    stamp: int  #: ns.
    position: Floats  #: (k,) as it came, rad.
    step: Floats  #: (k,) from the one before, without a jump, rad.
    pace: float  #: Time of that step, s; 0 for the first one.

    def off_course(self, stamp: Stamps, position: Floats, first: int = 1) -> Floats:
        """Return by how much the `first` one after it and the following are off even steps."""
        gone = position - self.position
        gone = np.asarray(gone - TURN * np.rint(gone / TURN))
        count = np.arange(first, first + len(stamp), dtype=np.float64)
        elapsed = np.asarray((stamp - self.stamp) * 1e-9)
        expected = _expected(gone, count[:, None] * self.step, elapsed, count * self.pace)
        return np.asarray(gone - expected)


class ReadingJumps:
    """Takes jumps and single readings that are off out of those of joints.

    The result does not depend on how the stream was cut into blocks.

    Args:
        table: Whose joints are read.
    """

    def __init__(self, table: Table) -> None:
        self._names = table.names
        limits = [_BEYOND_LIMIT * joint.max_acceleration for joint in table.joints]
        self._limit = np.array([one if math.isfinite(one) else _BEYOND_ANY for one in limits])
        count = len(limits)
        #: Readings that wait for those after them, as they came.
        self._held: tuple[Stamps, Floats] = np.empty(0, np.int64), np.empty((0, count))
        self._last: _Reading | None = None
        self._last_but_one: _Reading | None = None
        #: Deviations of the last readings from even steps, without sign, rad.
        self._recent = np.zeros((_LATE_BY, count))
        self._jumped = np.zeros(count)
        self._jumps: list[tuple[int, int, float]] = []  #: Stamp, ns, joint and size, rad.
        self._off: list[tuple[int, int, float]] = []  #: Likewise of readings that are left out.

    def take_out(
        self, stamp: Stamps, position: Floats, *, last: bool = False
    ) -> tuple[Stamps, Floats]:
        """Return readings without jumps, and without those that are off.

        Args:
            stamp: (n,) increasing, ns.
            position: (n, k) rad.
            last: Whether none follow: the readings held back are returned, too.
        """
        stamp = np.concatenate([self._held[0], stamp])
        position = np.concatenate([self._held[1], position])
        kept: list[tuple[Stamps, Floats]] = []
        begin = 0
        while begin < len(stamp):
            part = slice(begin, begin + _AT_ONCE)
            even = self._accept_even(stamp[part], position[part])
            if even:
                taken = slice(begin, begin + even)
                kept.append((stamp[taken], position[taken] - self._jumped))
                begin += even
                continue
            left_out = self._back_after(stamp[begin:], position[begin:])
            if not left_out and len(stamp) - begin <= _LATE_BY and not last:
                break
            if not left_out:
                self._accept(stamp[begin:], position[begin:])
                one = slice(begin, begin + 1)
                kept.append((stamp[one], position[one] - self._jumped))
            begin += left_out or 1
        self._held = stamp[begin:], position[begin:]
        if len(kept) == 1:
            return kept[0]
        return (
            np.concatenate([self._held[0][:0], *(one for one, _ in kept)]),
            np.concatenate([self._held[1][:0], *(one for _, one in kept)]),
        )

    def _accept_even(self, stamp: Stamps, position: Floats) -> int:
        """Accept the readings before the first that stands out; return their number."""
        last = self._last or _Reading(int(stamp[0]), position[0], np.zeros(len(self._limit)), 0.0)
        elapsed = np.asarray(steps_since(last.stamp, stamp) * 1e-9)
        steps = np.diff(position, axis=0, prepend=last.position[None])
        steps -= TURN * np.rint(steps / TURN)
        lasts = np.vstack([last.step, steps[:-1]])
        paces = np.append(last.pace, elapsed[:-1])
        expected = _expected(steps, lasts, elapsed, paces)
        beyond = np.abs(steps - expected)
        large = (beyond > _LEAST_LATE) & (beyond > _STANDS_OUT * self._most_before(beyond))
        late = large & (beyond <= _LATE_BY * np.abs(expected))
        possible = self._limit * (elapsed * np.maximum(elapsed, paces))[:, None]
        jump = (beyond > np.maximum(_LEAST, possible)) & (np.abs(steps) > _TIMES * np.abs(lasts))
        # Of the first step nothing is known: the table may turn already.
        stands_out = np.flatnonzero((late | jump).any(axis=1) & (paces > 0))
        count = int(stands_out[0]) if len(stands_out) else len(stamp)
        readings = [last] if self._last is None else [self._last_but_one, last]
        for k in range(max(0, count - 2), count):
            now = _Reading(int(stamp[k]), position[k].copy(), steps[k].copy(), float(elapsed[k]))
            readings.append(now)
        if count:
            self._last_but_one, self._last = readings[-2], readings[-1]
            self._recent = np.vstack([self._recent, beyond[:count]])[-_LATE_BY:]
        return count

    def _most_before(self, beyond: Floats) -> Floats:
        """Return the largest of the deviations before each of (n, k)."""
        rows = np.vstack([self._recent, beyond])[:-1]
        windows = np.lib.stride_tricks.sliding_window_view(rows, _LATE_BY, axis=0)
        return np.asarray(windows.max(axis=2))

    def _back_after(self, stamp: Stamps, position: Floats) -> int:
        """Return after how many readings they are back on the course before; 0 if they are not.

        The first of them stands out. Its deviation is noted if they are back.
        """
        assert self._last is not None
        off = np.abs(self._last.off_course(stamp[: _LATE_BY + 1], position[: _LATE_BY + 1]))
        worst = int(off[0].argmax())
        back = off[:, worst] <= _BACK * off[0, worst]
        if not back.any():
            return 0
        self._off.append((int(stamp[0]), worst, float(off[0, worst])))
        return int(back.argmax())

    def _accept(self, stamp: Stamps, position: Floats) -> None:
        """Accept the first of some readings, which stands out: it may be a jump of the encoder."""
        last, before = self._last, self._last_but_one
        assert last is not None
        beyond = last.off_course(stamp[:1], position[:1])[0]
        elapsed = float(stamp[0] - last.stamp) * 1e-9
        step = position[0] - last.position
        step -= TURN * np.rint(step / TURN)
        possible = self._limit * elapsed * max(elapsed, last.pace)
        jumps = (np.abs(step) > _TIMES * np.abs(last.step)) & (
            np.abs(beyond) > np.maximum(_LEAST, possible)
        )
        if before is not None and jumps.any():
            # Or the one before was off, by less than stood out.
            off = before.off_course(stamp[:1], position[:1], first=2)[0]
            late = jumps & (np.abs(off) <= _BACK * np.abs(beyond))
            self._off += [(last.stamp, j, -float(beyond[j])) for j in np.flatnonzero(late).tolist()]
            jumps &= ~late
        now = _Reading(int(stamp[0]), position[0].copy(), step, elapsed)
        if jumps.any() and len(stamp) > 1:
            # After a jump the joint goes on as before it; after a step of its motion, with that.
            goes_on = replace(now, step=step - beyond)
            as_before, with_it = (
                np.abs(one.off_course(stamp[1:2], position[1:2])[0]) for one in (goes_on, now)
            )
            jumps &= as_before < with_it
        size = np.where(jumps, beyond, 0.0)
        self._jumps += [(now.stamp, j, float(size[j])) for j in np.flatnonzero(jumps).tolist()]
        self._jumped = self._jumped + size
        self._last_but_one, self._last = last, replace(now, step=step - size)
        self._recent = np.vstack([self._recent[1:], np.abs(beyond - size)])

    @property
    def sentences(self) -> list[str]:
        """Sentences for each joint whose readings jump, or are off for a moment."""
        found: list[str] = []
        for j, name in enumerate(self._names):
            jumps = [one for one in self._jumps if one[1] == j]
            if jumps:
                instant, _, size = jumps[0]
                times = counted(len(jumps) - 1, 'more time')
                more = f', and {times}' if len(jumps) > 1 else ''
                found.append(
                    warning(
                        f'The readings of joint {name} jump by {size / DEG:.3g} deg at '
                        f'{at(instant)}{more}: it was homed anew, or its encoder slipped. Later '
                        'readings are taken less the jump, so that misalignments are those before '
                        'it'
                    )
                )
            off = [one for one in self._off if one[1] == j]
            if off:
                instant, _, size = max(off, key=lambda one: abs(one[2]))
                found.append(
                    f'{counted(len(off), "reading")} of joint {name} came late or false, off by up '
                    f'to {abs(size) / DEG:.2g} deg at {at(instant)}, and those that follow are '
                    'right: left out'
                )
        return found


def _expected(steps: Floats, lasts: Floats, elapsed: Floats, paces: Floats) -> Floats:
    """Return the step (n, k) that goes on evenly: at the same rate, or by as much as the last.

    The latter where stamps bunch: what is closer to the step itself.

    Args:
        steps: (n, k) the steps themselves, rad.
        lasts: (n, k) the steps before, rad.
        elapsed: (n,) their time, s.
        paces: (n,) the time of the steps before, s; 0 where there were none.
    """
    share = np.divide(elapsed, paces, out=np.ones_like(elapsed), where=paces > 0)
    evenly = lasts * share[:, None]
    closer = np.abs(steps - evenly) < np.abs(steps - lasts)
    return np.where(closer, evenly, lasts)
