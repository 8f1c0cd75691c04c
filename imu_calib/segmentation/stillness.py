"""IMU samples alone -> when the unit stood still and when it moved."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from ..common.gaussian import MAD_TO_STD
from ..common.stream import Floats, Stamps
from ..common.units import DEG, STANDARD_GRAVITY
from ..model.earth import EARTH_RATE
from .stamps import RowBuffer
from .table_motion import Motion, Rest

_CHUNK_WINDOWS = 5
"""Windows of a tenth of a second that are averaged: a hand trembles at 8 to 12 Hz (Stiles 1976, J.
Appl. Physiol. 40), which half a second averages out."""

_STEADY_RATE = 1.0 * DEG  #: rad/s, with `_STEADY_FORCE`.
_STEADY_FORCE = 0.05 * STANDARD_GRAVITY
"""Agreement of the means of two half seconds in a hand that holds still: 0.6 deg/s and 0.02 g in
published sessions of five MPU-9150 (mikoff/imu-calib), with a margin for shakier hands."""

_OTHER_WAY_UP = np.cos(np.radians(20))
"""Attitudes count as different where up differs by more. A judgement: a hand that holds still leans
by some degrees, and turns are tens of degrees."""

_MOST_LEVELS = 32
"""Steady rates that are stored, to bound memory; the least supported is dropped. A judgement: a
turn by hand is steady for less than a second, so that few are ever found."""

_MEMORY = 20
"""Additions over which a rate is averaged, half a second each: a bias that warms up is followed
within ten seconds at rest."""

ASSUMED_SPREAD = 0.3 * DEG
"""Largest change of a gyro's output at rest when it is turned over, where the session does not show
it yet, rad/s: MEMS gyros read 0.1 deg/s per g (published sessions: up to 0.16)."""

_ATTITUDES = 5
"""Attitudes from which on the median of the output's change with attitude is used. A judgement: two
slow turns about the vertical among them do not move it."""

_USUAL_TO_MOST = 3 * MAD_TO_STD
"""Ratio of three standard deviations of normal scatter to the median of its absolute value."""


@dataclass(eq=False)
class _Attitude:
    """An attitude in which a steady rate was read: the mean of the rates."""

    up: Floats
    rate: Floats
    count: int = 1


@dataclass(eq=False)
class _Level:
    """A steady rate: its value in each attitude, the latest last.

    The rate is the median over the latest attitudes. A slow turn counts as one attitude, however
    long it takes; a bias that warms up is followed within three attitudes.
    """

    ups: list[_Attitude]
    times: int = 1  #: How often it was read, half a second each.
    rate: Floats = field(init=False)
    support: tuple[int, bool] = field(init=False)

    def __post_init__(self) -> None:
        self._settle()

    def _settle(self) -> None:
        """Compute the rate from the attitudes: it is read ten times as often as one is added."""
        rates = np.sort([one.rate for one in self.ups[-_ATTITUDES:]], axis=0)
        self.rate = (rates[(len(rates) - 1) // 2] + rates[len(rates) // 2]) / 2
        self.support = len(self.ups), bool((np.abs(self.rate) < _STEADY_RATE).all())

    def holds(self, rate: Floats) -> bool:
        return bool((np.abs(rate - self.rate) < _STEADY_RATE).all())

    def add_rest(self, rate: Floats, up: Floats) -> None:
        self.times += 1
        found = next((one for one in self.ups if up @ one.up >= _OTHER_WAY_UP), None)
        if found is None:
            self.ups.append(_Attitude(up, rate))
            self._settle()
            return
        found.count = min(found.count + 1, _MEMORY)
        found.rate = found.rate + (rate - found.rate) / found.count
        self.ups = [*(one for one in self.ups if one is not found), found]
        self._settle()

    @property
    def spread(self) -> float:
        """Largest difference between attitudes, rad/s."""
        if len(self.ups) < _ATTITUDES:
            return ASSUMED_SPREAD
        off = np.abs(np.array([one.rate for one in self.ups]) - self.rate).max(axis=1)
        return max(_USUAL_TO_MOST * float(np.median(off)), 2 * EARTH_RATE)


class GyroOffset:
    """Estimate the gyros' offset from the steady rates of a session.

    At rest the gyros read the same rate in each attitude; a turn about the vertical is just as
    steady, but its rate changes with the attitude. The steady rate read in the most attitudes is
    therefore the offset. Of equally supported rates the one below 1 deg/s is chosen, or else the
    earliest: recordings do not begin within an even turn.

    The result depends only on the windows and their order; memory is bounded.
    """

    def __init__(self) -> None:
        self._levels: list[_Level] = []
        self._level: _Level | None = None
        self._sum = np.zeros(6)
        self._windows = 0
        self._last: Floats | None = None

    @property
    def value(self) -> Floats:
        """The offset (3,), rad/s; zeros until a rate was steady."""
        level = self._level
        return np.zeros(3) if level is None else level.rate

    @property
    def spread(self) -> float:
        """Largest difference of a dwell's rate from the offset, by the attitudes so far, rad/s."""
        level = self._level
        return ASSUMED_SPREAD if level is None else level.spread

    @property
    def others(self) -> list[tuple[Floats, int]]:
        """Further rates (3,) at which the gyros stood, rad/s, each with its number of attitudes.

        A rate counts if it was steady in half as many attitudes as the offset, and in enough of
        them: motions that are slow by chance are not alike so often.
        """
        if self._level is None:
            return []
        enough = max(_ATTITUDES, len(self._level.ups) / 2)
        found = [one for one in self._levels if len(one.ups) >= enough]
        return [(one.rate, len(one.ups)) for one in found if one is not self._level]

    @property
    def turning(self) -> float:
        """The offset, rad/s, if it is that of an even turn as likely as that of a rest; else 0.

        The gyros then stood at another rate in as many attitudes, a few, and for half as long, as
        on a floor at the crests of curves to the left and to the right.
        """
        level, fast = self._level, float(np.linalg.norm(self.value))
        if level is None or fast < _TURN_RATE or len(level.ups) >= _ATTITUDES:
            return 0.0
        as_likely = any(
            len(one.ups) >= len(level.ups)
            and 2 * one.times >= level.times
            and np.abs(one.rate - level.rate).max() > _TURN_RATE
            for one in self._levels
        )
        return fast if as_likely else 0.0

    def add_window(self, mean: Floats) -> None:
        """Add the mean (6,) of a window of a tenth of a second, rad/s and m/s^2."""
        self._sum += mean
        self._windows += 1
        if self._windows < _CHUNK_WINDOWS:
            return
        now, before = self._sum / _CHUNK_WINDOWS, self._last
        self._sum, self._windows, self._last = np.zeros(6), 0, now
        if before is None:
            return
        apart = np.abs(now - before)
        if (apart[:3] < _STEADY_RATE).all() and (apart[3:] < _STEADY_FORCE).all():
            second = (now + before) / 2
            self._add(second[:3], second[3:] / (np.linalg.norm(second[3:]) or 1.0))
            # The first of the best: levels are in order of time.
            self._level = max(self._levels, key=lambda level: level.support)

    def _add(self, rate: Floats, up: Floats) -> None:
        for level in self._levels:
            if level.holds(rate):
                level.add_rest(rate, up)
                return
        if len(self._levels) == _MOST_LEVELS:
            self._levels.remove(min(self._levels, key=lambda level: level.support))
        self._levels.append(_Level([_Attitude(up, rate)]))


_BESIDE = 5  #: Windows before and after each window: a second in all.

_USUAL = 0.9
"""Share of the quiet windows that count as still: the rest may be shocks, or turns too slow to be
detected beforehand. A judgement."""

_MARGIN = 3.0
"""Three times the limit of nine windows in ten is over six standard deviations of normal noise: a
window of a unit at rest exceeds it once in many hours."""

_LEAN = 1.0 * DEG * STANDARD_GRAVITY
"""A hand leans by a degree within a hold, m/s^2; more is another attitude."""

_TURN_RATE = 5.0 * DEG
"""Mean over a second from which on it is a turn, rad/s: five degrees exceed the lean of any hold,
with tremor. Published sessions by hand exceed it within 0.2 s of the beginning of turns."""

_MOST_RATE = 20.0 * DEG  #: rad/s: a stronger tremor is not a hold.
_MOST_FORCE = 0.3 * STANDARD_GRAVITY
"""A larger swing is not a hold: two degrees in a tenth of a second, of which the mean no longer
resolves a tenth."""


@dataclass(frozen=True)
class RestTolerance:
    """Largest deviation of the mean of a tenth of a second at rest, in each axis."""

    rate: float = ASSUMED_SPREAD  #: From the gyros' output at rest, rad/s.
    force: float = _LEAN  #: From the accelerometers' output at the start of the rest, m/s^2.
    usual: float = 0.0  #: Deviation of rates in nine windows of ten from the second around, rad/s.

    @classmethod
    def estimate(
        cls,
        means: Floats,
        offset: Floats,
        spread: float = ASSUMED_SPREAD,
        step: Floats | None = None,
    ) -> RestTolerance:
        """Estimate it from the quiet seconds among windows that follow each other.

        It is based on deviations of rates from the second around them, and of forces from one
        window to the next: for a turn at an even rate these are as small as for a dwell, however
        slow it is.

        Args:
            means: (n, 6) means of windows of a tenth of a second, rad/s and m/s^2.
            offset: (3,) gyros' output at rest, rad/s.
            spread: Its largest difference between attitudes, rad/s.
            step: (2,) the size of a count of gyros and accelerometers, rad/s and m/s^2.
        """
        width = 2 * _BESIDE + 1
        least = np.zeros(2) if step is None else step
        plain = cls(spread + float(least[0]), _LEAN + float(least[1]), float(least[0]))
        if len(means) < width:
            return plain
        around = np.lib.stride_tricks.sliding_window_view(means[:, :3], width, axis=0).mean(axis=2)
        turned = (np.abs(around - offset) > _TURN_RATE).any(axis=1)
        # A turn that begins soon is within the neighbouring seconds.
        quiet = np.convolve(turned, np.ones(width))[_BESIDE:-_BESIDE] == 0
        if np.count_nonzero(quiet) < width:
            return plain
        inner = slice(_BESIDE, len(means) - _BESIDE)
        shaken = np.abs(means[inner, :3] - around)[quiet]
        # Difference of two windows with independent noise.
        pushed = np.abs(means[inner, 3:] - means[_BESIDE - 1 : -_BESIDE - 1, 3:])[quiet] / np.sqrt(
            2
        )
        noise = np.maximum(
            [_MARGIN * float(np.quantile(part.max(axis=1), _USUAL)) for part in (shaken, pushed)],
            least,
        )
        return cls(
            min(spread + float(noise[0]), _MOST_RATE),
            min(_LEAN + float(noise[1]), _MOST_FORCE),
            float(noise[0]) / _MARGIN,
        )


WINDOW_SECONDS = 0.1  #: s: shorter than any hold, and about one period of a tremor.
_WINDOWS_TO_SETTLE = 3
"""Windows in a row that begin a dwell: the first may hold the end of the motion, and a single one
between two swings of a hand may agree by chance."""
_WINDOWS_AHEAD = 300
"""Half a minute: holds of some seconds with turns between show offset and noise in several
attitudes, and the samples of this time are stored."""

_WINDOWS_TO_LEARN = 50
"""Five seconds between two updates of the tolerance. A judgement: it uses up to two minutes, which
change little in five seconds."""

_NO_JOINTS = np.empty((0, 0))  #: Angles of a unit without a table.
_NO_STAMPS: Stamps = np.empty(0, dtype=np.int64)  #: Their stamps.
_WINDOWS_OF_SPAN = 20  #: Two seconds, the shortest hold accepted. A choice.

_Window: TypeAlias = tuple[int, int, list[float]]
"""First and last stamp, ns, and the mean of each channel: for so few, lists are faster than
arrays."""


@dataclass(frozen=True)
class Quietest:
    """The two seconds of least deviation: largest deviation of a tenth of one from their mean."""

    rate: float  #: Of the gyros, the largest of three axes, rad/s.
    force: float  #: Of the accelerometers, m/s^2.
    #: Mean length of the specific forces of tenths of a second, m/s^2: a unit that turns reads
    #: gravity too.
    length: float
    tolerance: RestTolerance  #: Tolerance of a dwell by the session's last minutes.


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
        self._to_come = 0  #: The number of these, the last ones, that are not judged yet.
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
    def turning(self) -> float:
        """Rate of the rests, rad/s, if they are as likely even turns; else 0."""
        return self._offset.turning

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

    def track(self, stamp: Stamps, rates: Floats) -> list[Rest | Motion]:
        """Add samples (n,), ns, and (n, 6), SI; return the rests and motions that have ended."""
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
            self._offset.add_window(mean)
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
            self._tolerance = RestTolerance.estimate(
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
