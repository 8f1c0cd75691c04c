"""IMU samples alone -> when the unit stood still and when it moved."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from ..common.stream import Floats, Stamps
from .buffer import RowBuffer
from .gyro_offset import GyroOffset
from .rest_tolerance import RestTolerance
from .table_motion import Motion, Rest

WINDOW_SECONDS = 0.1
"""s: shorter than any hold, and about one period of a tremor."""
_WINDOWS_TO_SETTLE = 3
"""Windows in a row that begin a dwell: the first may hold the end of the motion, and a single one
between two swings of a hand may agree by chance."""
_WINDOWS_AHEAD = 300
"""Half a minute: holds of some seconds with turns between show offset and noise in several
attitudes, and the samples of this time are stored."""

_WINDOWS_TO_LEARN = 50
"""Five seconds between two updates of the tolerance. A judgement: it uses up to two minutes, which
change little in five seconds."""

_NO_JOINTS = np.empty((0, 0))
"""Angles of a unit without a table."""
_NO_STAMPS: Stamps = np.empty(0, dtype=np.int64)
"""Their stamps."""

_WINDOWS_OF_SPAN = 20
"""Two seconds, the shortest hold accepted. A choice."""

_Window: TypeAlias = tuple[int, int, list[float]]
"""First and last stamp, ns, and the mean of each channel: for so few, lists are faster than
arrays."""


@dataclass(frozen=True)
class Quietest:
    """The two seconds of least deviation: largest deviation of a tenth of one from their mean.

    Attributes:
        rate: Of the gyros, the largest of three axes, rad/s.
        force: Of the accelerometers, m/s^2.
        length: Mean length of the specific forces of tenths of a second, m/s^2: a unit that turns
            reads gravity too.
        tolerance: Tolerance of a dwell by the session's last minutes.
    """

    rate: float
    force: float
    length: float
    tolerance: RestTolerance


class StillnessTracker:
    """Detects dwells and motions by the means of short windows of IMU samples.

    A unit is still while the gyros stay near their output at rest and the accelerometers near
    theirs at the start of the rest. The output at rest and the tolerances are estimated from the
    session (`GyroOffset`, `RestTolerance`). A window is therefore judged half a minute after it
    came in, by all data before and the half minute after, or at the end.

    Windows are counted from the first sample, and the decision follows that count: the result does
    not depend on how the stream was cut into blocks.

    Args:
        period: Sample interval, s.
        step: (2,) resolution of a window's mean by one count of gyros and accelerometers, rad/s and
            m/s^2.
    """

    def __init__(self, period: float, step: Floats | None = None) -> None:
        self._length = max(1, round(WINDOW_SECONDS / period))
        self._step = step
        self._stamp: Stamps = _NO_STAMPS
        self._rates: Floats = np.empty((0, 6))
        self._offset = GyroOffset()
        self._tolerance = RestTolerance()
        self._means = RowBuffer(6)
        self._to_come = 0
        """The number of these, the last ones, that are not judged yet."""
        self._ahead: deque[_Window] = deque()
        self._count = 0
        self._learnt_at = -1
        self._recent: list[_Window] = []
        self._reference: list[float] | None = None
        self._start: int | None = None
        self._span: Floats = np.empty((0, 6))
        self._least: tuple[float, float, float] | None = None

    @property
    def other_offsets(self) -> list[tuple[Floats, int]]:
        """By how much the gyros stood elsewhere too, (3,) rad/s, and in how many attitudes."""
        value = self._offset.value
        return [(rate - value, attitudes) for rate, attitudes in self._offset.others]

    @property
    def quietest(self) -> Quietest | None:
        """The two seconds of least deviation so far; None before two seconds have come in."""
        return None if self._least is None else Quietest(*self._least, self._tolerance)

    @property
    def known_until(self) -> int | None:
        """End of the last window that was judged, ns."""
        return self._recent[-1][1] if self._recent else None

    @property
    def rest_since(self) -> int | None:
        """Start of the current rest, ns; None in motion."""
        return None if self._reference is None else self._start

    def feed(self, stamp: Stamps, rates: Floats) -> list[Rest | Motion]:
        """Add samples; return the rests and motions that have ended.

        Args:
            stamp: (n,) ns.
            rates: (n, 6) rad/s and m/s^2.
        """
        stamp = np.concatenate([self._stamp, stamp])
        rates = np.vstack([self._rates, rates])
        whole = len(stamp) - len(stamp) % self._length
        self._stamp, self._rates = stamp[whole:], rates[whole:]
        windows = stamp[:whole].reshape(-1, self._length)
        means = rates[:whole].reshape(-1, self._length, 6).mean(axis=1)
        self._note_quiet(means)
        done: list[Rest | Motion] = []
        self._means.append(windows[:, -1], means)
        self._to_come = len(means)
        ends = zip(windows[:, 0].tolist(), windows[:, -1].tolist(), means.tolist(), strict=True)
        for mean, window in zip(means, ends, strict=True):
            self._offset.feed(mean)
            self._ahead.append(window)
            self._to_come -= 1
            self._count += 1
            if len(self._ahead) > _WINDOWS_AHEAD:
                done += self._judge_next()
        self._means.remove_first(len(self._means) - 4 * _WINDOWS_AHEAD)
        return done

    def finish(self) -> list[Rest | Motion]:
        """End the stream: return the remaining rests and motions."""
        done: list[Rest | Motion] = []
        while self._ahead:
            done += self._judge_next()
        end = self.known_until
        if end is None or self._start is None:
            return []
        return [*done, Rest(self._start, end) if self._reference is not None else self._motion(end)]

    def split_rest(self, end: int) -> Rest | None:
        """Close the current rest at `end` (ns) and begin another; None in motion."""
        if self._reference is None or self._start is None:
            return None
        rest = Rest(self._start, end)
        self._start = end
        return rest

    def _note_quiet(self, means: Floats) -> None:
        """Store the two seconds of least deviation, of windows of means (n, 6)."""
        means = np.vstack([self._span, means])
        self._span = means[max(0, len(means) - _WINDOWS_OF_SPAN + 1) :]
        if len(means) < _WINDOWS_OF_SPAN:
            return
        spans = sliding_window_view(means, _WINDOWS_OF_SPAN, axis=0)
        strayed = np.abs(spans - spans.mean(axis=2, keepdims=True)).max(axis=2)
        rates, forces = strayed[:, :3].max(axis=1).tolist(), strayed[:, 3:].max(axis=1).tolist()
        lengths = np.linalg.norm(spans[:, 3:], axis=1).mean(axis=1).tolist()
        found = min(zip(rates, forces, lengths, strict=True))
        self._least = min(found, self._least or found)

    def _judge_next(self) -> list[Rest | Motion]:
        """Judge the oldest window that waits."""
        if self._count // _WINDOWS_TO_LEARN != self._learnt_at:
            self._learnt_at = self._count // _WINDOWS_TO_LEARN
            came = len(self._means) - self._to_come
            self._tolerance = RestTolerance.of(
                self._means.values[max(0, came - 4 * _WINDOWS_AHEAD) : came],
                self._offset.value,
                self._offset.spread,
                self._step,
            )
        return self._judge(self._ahead.popleft())

    def _judge(self, window: _Window) -> list[Rest | Motion]:
        """Return the rest that a window ends, or the motion that it ends as a dwell begins."""
        start, _, mean = window
        self._start = start if self._start is None else self._start
        self._recent = [*self._recent, window][-_WINDOWS_TO_SETTLE:]
        if self._reference is not None:
            if self._still(mean, self._reference):
                return []
            last = max(self._start, self._last_quiet())
            rest = Rest(self._start, last)
            self._start, self._reference = last, None
            return [rest]
        fresh = [mean for first, _, mean in self._recent if first >= self._start]
        if len(fresh) < _WINDOWS_TO_SETTLE:
            return []
        centre = [sum(channel) / len(fresh) for channel in zip(*fresh, strict=True)]
        if not all(self._still(mean, centre) for mean in fresh):
            return []
        # The first window may hold the end of the motion: the dwell begins with the second.
        motion = self._motion(self._recent[1][0])
        self._start, self._reference = self._recent[1][0], centre
        return [motion] if motion.end > motion.start else []

    def _last_quiet(self) -> int:
        """Return the last stamp of a dwell that ends before the window judged, ns.

        The window before may hold the beginning of the motion: it does if it deviates from the one
        before it by more than nine of ten do. A sample covers the time up to its stamp: the first
        of the window judged belongs to the motion.
        """
        before, last, _ = self._recent
        usual = math.sqrt(2) * self._tolerance.usual
        quiet = _farthest(last[2][:3], before[2][:3]) <= usual
        return last[1] if quiet else before[1]

    def _still(self, mean: list[float], reference: list[float]) -> bool:
        """Return whether a window's mean is that of a rest that began with a reference."""
        return (
            _farthest(mean[:3], self._offset.value.tolist()) < self._tolerance.rate
            and _farthest(mean[3:], reference[3:]) < self._tolerance.force
        )

    def _motion(self, end: int) -> Motion:
        return Motion(self._start or 0, end, _NO_STAMPS, _NO_JOINTS)


def _farthest(one: Sequence[float], other: Sequence[float]) -> float:
    """Return the largest difference in any axis."""
    return max(abs(a - b) for a, b in zip(one, other, strict=True))
