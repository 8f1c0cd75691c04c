"""Joint states -> when the table stood still, when it moved, and its whole turns at rate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..stream import Floats, Stamps
from ..units import DEG

_WINDOW_NS = 250_000_000
_STILL_RATE = 0.05 * DEG
_SLOWEST_TURN = 0.5 * DEG
_STEADY = 0.03
_STEADY_AT_MOST = 0.2
_UNUSUAL = 8.0
_TURN = 2 * np.pi
_SAMPLES_FOR_ANGLES = 256
_SAMPLES_FOR_TURN = 5
_SURE = 0.8
_CLOCKS_APART = 0.05


@dataclass(frozen=True, eq=False)
class Rest:
    """The table stood still from `start` to `end` (ns) at `angles` ((k,) rad; None: unknown)."""

    start: int
    end: int
    angles: Floats | None = None


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
        self._angles: Floats | None = None

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
        if self._start is None or not len(self._stamp):
            return []
        end = int(self._stamp[-1])
        return [self._motion(end) if self._moving else self._rest(self._start, end)]

    def split_rest(self, end: int) -> Rest | None:
        """Close the rest that goes on at `end` (ns) and go on with another; None in motion."""
        if self._moving or self._start is None:
            return None
        rest = self._rest(self._start, end)
        self._start, self._angles = end, rest.angles
        return rest

    def _judge(self) -> list[Rest | Motion]:
        """Go through new samples: a sample moves if the window before it shows a rate."""
        before = np.searchsorted(self._stamp, self._stamp - _WINDOW_NS, side='right') - 1
        before = np.clip(np.minimum(before, np.arange(len(before)) - 1), 0, None)
        elapsed = np.maximum(self._stamp - self._stamp[before], 1) * 1e-9
        rate = np.abs(self._position - self._position[before]).max(axis=1) / elapsed
        moving = rate > _STILL_RATE
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

    def _rest(self, start: int, end: int) -> Rest:
        """Close a rest; its angles are those of its first samples, however it is split."""
        if self._angles is not None:
            return Rest(start, end, self._angles)
        inside = (self._stamp >= start) & (self._stamp <= end)
        return Rest(start, end, self._position[inside][:_SAMPLES_FOR_ANGLES].mean(axis=0))

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
        first = min(int(np.searchsorted(self._stamp, self._start)), recent)
        if not self._moving and recent - first > _SAMPLES_FOR_ANGLES:
            # The first samples of a rest give its angles, the last ones the next decision.
            kept = np.r_[first : first + _SAMPLES_FOR_ANGLES, recent : len(self._stamp)]
        else:
            kept = np.arange(first, len(self._stamp))
        self._stamp, self._position = self._stamp[kept], self._position[kept]
        self._judged = len(self._stamp)


@dataclass(frozen=True, eq=False)
class WholeTurns:
    """Whole turns at constant rate of one joint, by a line through its encoder angles.

    Attributes:
        joint: Index of the joint.
        start: Instant at which the turns begin on the line, ns (float: between samples).
        seconds: Time that they take on the line, s, by the table's clock.
        angle: Angle turned, rad: a whole number of turns, signed.
        rate_error: Standard deviation of the line's slope, relative.
        spare: How long before and after the turns the rate is surely the same, s: less than the
            line shows, for the onset of ramps and for clocks that are yet to be compared.

    """

    joint: int
    start: float
    seconds: float
    angle: float
    rate_error: float
    spare: float


def find_turns(motion: Motion) -> list[WholeTurns]:
    """Find the stretches at constant rate that hold at least one whole turn.

    A line through all encoder angles of the stretch places the cuts: with 0.5 ms of stamp jitter
    single crossings would cost 52 ppm, the line 8 (methods.md, section 2).
    """
    if motion.position.shape[0] < _SAMPLES_FOR_TURN:
        return []
    joint = int(np.argmax(np.ptp(motion.position, axis=0)))
    time = (motion.stamp - motion.stamp[0]) * 1e-9
    angle = motion.position[:, joint]
    turns = []
    for first, last in _steady_runs(time, angle):
        fitted = _line(time[first:last], angle[first:last])
        if fitted is None:
            continue
        start, end, rate, rate_std = fitted
        whole = np.floor(abs(rate) * (end - start) / _TURN)
        if whole < 1:
            continue
        seconds = whole * _TURN / abs(rate)
        begin = start + (end - start - seconds) / 2
        turns.append(
            WholeTurns(
                joint,
                float(motion.stamp[0]) + begin * 1e9,
                seconds,
                float(np.copysign(whole * _TURN, rate)),
                rate_std / abs(rate),
                max(0.0, _SURE * (end - start - seconds) / 2 - _CLOCKS_APART),
            )
        )
    return turns


def _steady_runs(time: Floats, angle: Floats) -> list[tuple[int, int]]:
    """List index ranges over which the rate neither grows nor falls."""
    back = np.maximum(np.searchsorted(time, time - _WINDOW_NS * 1e-9, side='right') - 1, 0)
    back = np.minimum(back, np.maximum(np.arange(len(time)) - 1, 0))
    elapsed = np.maximum(time - time[back], 1e-9)
    rate = (angle - angle[back]) / elapsed
    turning = np.abs(rate) > _SLOWEST_TURN
    change = np.abs(rate - rate[back]) / np.maximum(np.abs(rate), _SLOWEST_TURN)
    # Jitter of the stamps makes a constant rate look unsteady throughout, a ramp does so briefly.
    usual = float(np.median(change[turning])) if turning.any() else 0.0
    steady = turning & (change <= np.clip(_UNUSUAL * usual, _STEADY, _STEADY_AT_MOST))
    edges = np.flatnonzero(np.diff(steady.astype(np.int8), prepend=0, append=0))
    runs = zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
    return [(a, b) for a, b in runs if b - a >= _SAMPLES_FOR_TURN - 2]


def _line(time: Floats, angle: Floats) -> tuple[float, float, float, float] | None:
    """Fit a line by the middle half, drop the ends that leave it, fit again.

    Returns:
        Start, end, slope and its standard deviation; None where too little is left.

    """
    inside = slice(len(time) // 4, max(len(time) // 4 + 2, len(time) - len(time) // 4))
    slope, offset = np.polyfit(time[inside], angle[inside], 1)
    left = angle - (slope * time + offset)
    noise = float(np.sqrt(np.mean(left[inside] ** 2)))
    # Far from the middle half the line itself is less sure: allow for its own error.
    near = np.abs(left) <= 6 * noise + 1e-3 * DEG
    bad = np.flatnonzero(~near)
    centre = len(time) // 2
    first = int(bad[bad < centre].max()) + 1 if np.any(bad < centre) else 0
    last = int(bad[bad >= centre].min()) if np.any(bad >= centre) else len(time)
    if last - first < _SAMPLES_FOR_TURN - 2:
        return None
    time, angle = time[first:last], angle[first:last]
    slope, offset = np.polyfit(time, angle, 1)
    square = float(np.mean((angle - slope * time - offset) ** 2))
    slope_std = float(np.sqrt(square / ((time - time.mean()) ** 2).sum()))
    return float(time[0]), float(time[-1]), float(slope), slope_std
