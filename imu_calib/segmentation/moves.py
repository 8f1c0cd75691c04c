"""Motions between dwells: outputs of gyros and accelerometers, in steps of about a degree.

A step joins samples. Its rotation vector is the sum of their angles and the coning term, to the
second order. Its velocity is the sum of theirs in the body axes in the mean of its rotation over
its time (sculling), to the third order. An error model of a percent changes the second-order terms
by a percent of them, and nothing of the first order about the mean: steps can be used in place of
the samples for any error model.

Sources: Savage 1998, J. Guidance 21, 19, eqs. (45) and (48), and 208 for sculling;
docs/mathematics.md, 'Moves' and 'Velocities of moves'.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from ..common.rotations import cross
from ..common.stream import Floats
from ..common.units import DEG
from .counters import runs_of
from .segmented import HeldAngles, MountShift, Move, Rejected, VelocitySteps
from .segments import Segment
from .statistics import Samples, Sensor, gap_free

STEP_ANGLE = 1 * DEG
"""Angle of a step, rad: the second order leaves out a twelfth of its cube at most, 0.1 arcsec."""

STEP_SECONDS = 0.1  #: Length of a step at low rates, s: the Earth turns by 1.5 arcsec in it.

SATURATED = 'a sensor is at the end of its range'
COARSE = 'it turns too far from one sample to the next'
MISSING = 'samples are missing'
JERK = 'a jerk, too short to be read'  #: Reason why a motion does not become a move.
_SHORTEST = 4  #: Steps: a shorter motion is a jerk.
_BESIDE = 5
"""Samples next to a gap whose second differences show the curvature of the rate: three of them."""

_GYROS, _ACCELEROMETERS = slice(3), slice(3, 6)  #: Their columns among the six channels.

COARSEST = 5 * DEG
"""Largest angle of one sample on a table, rad: a direction that changes by a tenth of it between
samples leaves an arcsecond."""

COARSEST_BY_HAND = 20 * DEG
"""The same in a hand, where an arcminute is negligible: 1000 deg/s at 50 Hz."""


_Edges: TypeAlias = tuple[HeldAngles, HeldAngles]


class MoveReader:
    """Joins the motion between one segment at rest and the next to a move.

    Add motions and dwells in order. A gap, a sample at the end of its range, a shock, or a step of
    the stamps ends a move without a result.

    Args:
        sensor: The IMU.
        by_hand: Whether a hand moves the unit: samples may be coarser, and the accelerometers,
            which the hand accelerates, are not used.
    """

    def __init__(self, sensor: Sensor, *, by_hand: bool = False) -> None:
        self._sensor = sensor
        self._by_hand = by_hand
        self._coarsest = COARSEST_BY_HAND if by_hand else COARSEST
        self._open: list[_Steps] | None = None
        self._seen = 0
        self._begin = 0
        self._moves: list[tuple[int, int, _Steps, _Edges | None]] = []
        self._hold: HeldAngles | None = None
        self._reason = ''
        self._lost: list[Rejected] = []

    @property
    def lost(self) -> tuple[Rejected, ...]:
        """Motions between two segments at rest that gave no move, and why."""
        return tuple(self._lost)

    def motion(self, samples: Samples, delivered: Floats) -> None:
        """Add the samples of a motion; those already used in a dwell are skipped.

        Args:
            samples: n of them.
            delivered: (n, 6) as the sensor gave them.
        """
        self._add(samples, delivered, len(samples.stamp))

    def leave_out(self, since: int, until: int) -> None:
        """Leave out what reaches into a time between two instants, ns."""
        self._moves = [one for one in self._moves if one[1] <= since or one[0] > until]
        self._lost = [one for one in self._lost if one.end <= since or one.start > until]

    def lose(self, reason: str) -> None:
        """Drop the motion since the last segment, for a reason."""
        self._open, self._reason = None, self._reason or reason

    def dwell(
        self, samples: Samples, delivered: Floats, found: Sequence[Segment | Rejected | MountShift]
    ) -> None:
        """Add the samples of a dwell, and the segments found in it, in order."""
        if any(isinstance(one, MountShift) for one in found):
            self._open, self._reason = None, ''
        for segment in (one for one in found if isinstance(one, Segment)):
            self._add(samples, delivered, int(np.searchsorted(samples.stamp, segment.start)))
            hold = _held_angles(samples, segment) if self._by_hand else None
            self._close(segment, hold)
            self._hold = hold
            self._open, self._begin, self._seen, self._reason = [], segment.end, segment.end, ''
        self.motion(samples, delivered)

    def timed_moves(self, interval_at: Callable[[float], float]) -> tuple[Move, ...]:
        """Return the moves in order.

        Args:
            interval_at: Sample interval by the whole session, s, at an instant, ns: where stamps
                jitter, that of a few seconds would make the angles of rates a percent off.
        """
        return tuple(
            self._move(start, end, steps, edges, interval_at((start + end) / 2))
            for start, end, steps, edges in self._moves
        )

    def _move(
        self,
        start: int,
        end: int,
        steps: _Steps,
        edges: _Edges | None,
        period: float,
    ) -> Move:
        """Return the steps from one instant to another, ns, as a move, timed by the interval, s."""
        # Rates become angles and velocities by the interval of the session.
        longer = np.ones(1) if self._sensor.counted else period / steps.period
        gained = VelocitySteps(
            steps.velocity * longer[:, None],
            steps.mean * longer[:, None],
            steps.pulse[3:],
            float(steps.filled[1]),
        )
        return Move(
            start,
            end,
            steps.turned * longer[:, None],
            steps.counts * period,
            steps.pulse[:3],
            float(steps.filled[0]),
            None if self._by_hand else gained,
            edges
            and (edges[0].times(longer[0], longer[0]), edges[1].times(longer[-1], longer[-1])),
        )

    def _close(self, segment: Segment, hold: HeldAngles | None) -> None:
        """End the open move where a segment begins."""
        if self._open and sum(len(p.counts) for p in self._open) >= _SHORTEST:
            edges = None if self._hold is None or hold is None else (self._hold, hold)
            self._moves.append((self._begin, segment.start, _concatenated(self._open), edges))
        elif self._reason or self._open is not None:
            reason = self._reason or JERK
            self._lost.append(Rejected(self._begin, segment.start, reason, turn=True))

    def _add(self, samples: Samples, delivered: Floats, stop: int) -> None:
        """Join samples before `stop` to steps; drop the move if they are not sound."""
        # The same sample may have another stamp on the line of another segment.
        beyond = self._seen + round(samples.period * 5e8)
        fresh = slice(int(np.searchsorted(samples.stamp, beyond, side='right')), stop)
        part = samples.at(fresh)
        # A lost move is followed to its end: its reason does not depend on how blocks were cut.
        if (self._open is None and not self._reason) or not len(part.stamp):
            return
        around = np.concatenate([[self._seen], part.stamp])
        self._seen = int(part.stamp[-1])
        if self._sensor.saturated(delivered[fresh], part).any():
            self._reason = SATURATED
        elif np.abs(part.increments[:, :3]).max() > self._coarsest:
            self._reason = self._reason if self._reason == SATURATED else COARSE
        elif len(gap_free(around, part.period)) > 1:
            self._reason = self._reason or MISSING
        if self._reason:
            self._open = None
            return
        assert self._open is not None
        self._open.append(joined(part))


@dataclass(frozen=True, eq=False)
class _Steps:
    """Steps of a motion."""

    turned: Floats  #: (n, 3) rotation vectors by the assumed sample interval, rad.
    velocity: Floats  #: (n, 3) velocities in the axes in the mean of the rotation, likewise, m/s.
    mean: Floats  #: (n, 3) that mean less half of the rotation, likewise, rad.
    counts: Floats  #: (n,) samples in each.
    period: Floats  #: (n,) the sample interval assumed, s.
    pulse: Floats  #: (6,) size of a pulse, rad and m/s.
    filled: Floats  #: (2,) variances due to filled gaps, rad^2 and (m/s)^2.


def _held_angles(samples: Samples, segment: Segment) -> HeldAngles | None:
    """Return the angles within a hold; None where samples are missing.

    Of small angles the mean is that of their sums up to each sample: each counts by the share of
    the hold after it, or before.
    """
    part = samples.at(slice(*np.searchsorted(samples.stamp, [segment.start, segment.end + 1])))
    if len(gap_free(part.stamp, part.period)) > 1:
        return None
    angle = part.increments[:, :3]
    over = (np.arange(len(angle)) + 0.5) / len(angle)
    filled = (0.0, 0.0)
    if part.filled is not None:
        places = over[[(a + b) // 2 for a, b in runs_of(part.filled).tolist()]]
        each = float(part.bridged[:3].mean())
        filled = each * float(((1 - places) ** 2).sum()), each * float((places**2).sum())
    return HeldAngles((1 - over) @ angle, over @ angle, len(angle) * part.period, filled)


def _concatenated(parts: Sequence[_Steps]) -> _Steps:
    names = ('turned', 'velocity', 'mean', 'counts', 'period')
    columns = {name: np.concatenate([getattr(p, name) for p in parts]) for name in names}
    return _Steps(**columns, pulse=parts[0].pulse, filled=np.sum([p.filled for p in parts], axis=0))


def joined(samples: Samples) -> _Steps:
    """Join samples to steps of `STEP_ANGLE` or `STEP_SECONDS`, whichever is reached first."""
    angle = samples.increments[:, :3]
    x, y, z = angle.T
    length = np.sqrt(x * x + y * y + z * z)
    size = np.maximum(length / STEP_ANGLE, samples.period / STEP_SECONDS)
    # By the middle of each sample: a sample as long as a step is a step.
    number = np.floor(np.cumsum(size) - size / 2)
    first = np.flatnonzero(np.diff(number, prepend=-1.0))
    counts = np.diff(first, append=len(angle))
    total = np.cumsum(angle, axis=0) - angle
    so_far = total - np.repeat(total[first], counts, axis=0)
    before = np.vstack([np.zeros(3), angle[:-1]])
    turned = np.add.reduceat(angle + cross(so_far / 2 + before / 12, angle), first)
    half_way = so_far + angle / 2
    mean = np.add.reduceat(half_way, first) / counts[:, None]
    beyond = half_way - np.repeat(mean, counts, axis=0)
    gained = _half_way(angle, samples.increments[:, 3:])
    gained = gained + cross(beyond, gained + cross(beyond, gained) / 2)
    pulse = np.where(samples.pulse > 0, samples.pulse, samples.carried)
    return _Steps(
        turned,
        np.add.reduceat(gained, first),
        mean - turned / 2,
        counts.astype(float),
        np.full(len(first), samples.period),
        np.append(samples.pulse[:3], pulse[3:]),
        np.array([_filling_variance(samples, triad) for triad in (_GYROS, _ACCELEROMETERS)]),
    )


def _half_way(angle: Floats, velocity: Floats) -> Floats:
    """Return the velocity gained in the body axes up to the middle of each sample, (n, 3) m/s.

    Rates and forces change linearly between neighbours; velocities are in axes that turn with the
    body.
    """
    bent, steeper = (
        np.vstack([part[1:], part[-1:]]) - np.vstack([part[:1], part[:-1]])
        for part in (angle, velocity)
    )
    third = cross(angle, steeper + cross(angle, velocity)) - cross(bent, velocity)
    return np.asarray(velocity + third / 24)


def _filling_variance(samples: Samples, triad: slice) -> float:
    """Return the variance of a sum due to gaps filled by a line from side to side, SI^2.

    Of the angle or the velocity of a triad. Over h intervals the error of the trapezium is f'' h^3
    / 12 (Davis and Rabinowitz 1984, section 2.1); the curvature of the rate is estimated by the
    second differences of the samples next to the gap. A joint that starts or stops within it makes
    a corner in the rate, which neighbouring samples do not show: slopes that differ by s give the
    error s c (h - c) / 2 for a corner at c, in the mean square s^2 h^4 / 120. The force off its
    axis jumps: by j beyond the change that the slopes next to the gap explain, with the error j (c
    - h / 2), in the mean square j^2 h^2 / 12.
    """
    if samples.filled is None or not samples.filled.any():
        return 0.0
    sums, lost = samples.increments[:, triad], samples.filled
    total = 0.0
    for start, stop in runs_of(lost).tolist():
        neighbours = [
            sums[a:b] for a, b in ((start - _BESIDE, start), (stop, stop + _BESIDE)) if a >= 0
        ]
        bends = np.vstack([np.diff(part, n=2, axis=0) for part in neighbours] or [np.zeros((0, 3))])
        square = float((bends**2).sum(axis=1).max(initial=0.0))
        h = stop - start + 1
        variance = square * (h**3 / 12) ** 2
        if start >= 2 and stop + 2 <= len(sums):
            before, after = sums[start - 1] - sums[start - 2], sums[stop + 1] - sums[stop]
            if triad == _GYROS:
                apart, share = after - before, h**4 / 120
            else:
                apart = sums[stop] - sums[start - 1] - h * (before + after) / 2
                share = h**2 / 12
            variance = max(variance, float(apart @ apart) * share)
        total += variance
    return total
