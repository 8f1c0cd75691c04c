"""From dwell to dwell: what gyros and accelerometers gave on the way, in steps of about a degree.

A step joins samples. Its rotation vector is the sum of their angles and what the change of their
direction adds (coning), to the second order. Its velocity is the sum of theirs in the body axes in
the mean of its rotation over its time (sculling), to the third order. An error model of a percent
changes what the second order adds by a percent of it, and nothing of the first about the mean:
steps stand for the samples however often the model changes.

Sources: Savage 1998, J. Guidance 21, 19, eqs. (45) and (48), and 208 for sculling;
docs/mathematics.md, 'Moves' and 'Velocities of moves'.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..directions import cross
from ..stream import Floats
from ..units import DEG
from .segment import Segment
from .segmented import MountShift, Move, Rejected, VelocitySteps
from .sensor import Sensor
from .statistics import Samples, gap_free

STEP_ANGLE = 1 * DEG
"""Angle of a step, rad: what the second order leaves out is a twelfth of its cube at most, 0.1
arcsec."""

STEP_SECONDS = 0.1
"""Length of a step where little turns, s: the Earth turns by 1.5 arcsec in it."""

SATURATED = 'a sensor is at the end of its range'
COARSE = 'it turns too far from one sample to the next'
MISSING = 'samples are missing'
JERK = 'a jerk, too short to be read'
"""Why a motion is no move."""

_SHORTEST = 4
"""Steps: a shorter motion is a jerk."""
_BESIDE = 5
"""Samples beside a gap whose second differences tell how the rate bends: three of them."""

_GYROS, _ACCELEROMETERS = slice(3), slice(3, 6)
"""Their columns among the six channels."""

COARSEST = 5 * DEG
"""Largest angle of one sample on a table, rad: a direction that changes from one to the next by a
tenth of it leaves an arcsecond."""

COARSEST_BY_HAND = 20 * DEG
"""The same in a hand, where an arcminute is nothing: 1000 deg/s at 50 Hz."""


class MoveReader:
    """Joins what lies between one segment at rest and the next to a move.

    Feed motions and dwells in order. A gap, a sample at the end of its range, a shock, or a step of
    the stamps ends a move without a result.

    Args:
        sensor: The IMU.
        by_hand: Whether a hand moves the unit: samples may be coarser, and of the accelerometers,
            which it pushes, nothing is asked.
    """

    def __init__(self, sensor: Sensor, *, by_hand: bool = False) -> None:
        self._sensor = sensor
        self._by_hand = by_hand
        self._coarsest = COARSEST_BY_HAND if by_hand else COARSEST
        self._open: list[_Steps] | None = None
        self._seen = 0
        self._begin = 0
        self._moves: list[tuple[int, int, _Steps]] = []
        self._reason = ''
        self._lost: list[Rejected] = []

    @property
    def lost(self) -> tuple[Rejected, ...]:
        """What lies between two segments at rest and became no move, and why."""
        return tuple(self._lost)

    def motion(self, samples: Samples, delivered: Floats) -> None:
        """Take the samples of a motion; those that a dwell before has had are passed over.

        Args:
            samples: n of them.
            delivered: (n, 6) as the sensor gave them.
        """
        self._add(samples, delivered, len(samples.stamp))

    def dwell(
        self, samples: Samples, delivered: Floats, found: Sequence[Segment | Rejected | MountShift]
    ) -> None:
        """Take the samples of a dwell, and what was found in it, in order."""
        if any(isinstance(thing, MountShift) for thing in found):
            self._open, self._reason = None, ''
        for segment in (thing for thing in found if isinstance(thing, Segment)):
            self._add(samples, delivered, int(np.searchsorted(samples.stamp, segment.start)))
            self._close(segment)
            self._open, self._begin, self._seen, self._reason = [], segment.end, segment.end, ''
        self.motion(samples, delivered)

    def finish(self, period: float) -> tuple[Move, ...]:
        """Return the moves in order.

        Args:
            period: Sample interval by the whole session, s: what the stamps of a few seconds say
                would make rates into angles a percent off, where they jitter.
        """
        return tuple(self._move(*one, period) for one in self._moves)

    def _move(self, start: int, end: int, steps: _Steps, period: float) -> Move:
        # Rates become angles and velocities by the interval that is right.
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
        )

    def _close(self, segment: Segment) -> None:
        """End the move that is open where a segment begins."""
        if self._open and sum(len(p.counts) for p in self._open) >= _SHORTEST:
            self._moves.append((self._begin, segment.start, _together(self._open)))
        elif self._reason or self._open is not None:
            reason = self._reason or JERK
            self._lost.append(Rejected(self._begin, segment.start, reason, turn=True))

    def _add(self, samples: Samples, delivered: Floats, stop: int) -> None:
        """Join samples before `stop` to steps; forget the move where they are not sound."""
        # The same sample may lie a little otherwise on the line of another segment.
        beyond = self._seen + round(samples.period * 5e8)
        fresh = slice(int(np.searchsorted(samples.stamp, beyond, side='right')), stop)
        part = samples.at(fresh)
        # What is lost is followed to its end: its reason does not depend on where blocks are cut.
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
    """Steps of a motion.

    Attributes:
        turned: (n, 3) rotation vectors by the sample interval that was assumed, rad.
        velocity: (n, 3) velocities in the axes in the mean of the rotation, likewise, m/s.
        mean: (n, 3) that mean less half of the rotation, likewise, rad.
        counts: (n,) samples in each.
        period: (n,) the sample interval assumed, s.
        pulse: (6,) size of a pulse, rad and m/s.
        filled: (2,) variances that filled gaps leave, rad^2 and (m/s)^2.
    """

    turned: Floats
    velocity: Floats
    mean: Floats
    counts: Floats
    period: Floats
    pulse: Floats
    filled: Floats


def _together(parts: Sequence[_Steps]) -> _Steps:
    return _Steps(
        np.vstack([p.turned for p in parts]),
        np.vstack([p.velocity for p in parts]),
        np.vstack([p.mean for p in parts]),
        np.concatenate([p.counts for p in parts]),
        np.concatenate([p.period for p in parts]),
        parts[0].pulse,
        np.sum([p.filled for p in parts], axis=0),
    )


def joined(samples: Samples) -> _Steps:
    """Join samples to steps of `STEP_ANGLE` or `STEP_SECONDS`, whichever is reached first."""
    angle = samples.increments[:, :3]
    x, y, z = angle.T
    length = np.sqrt(x * x + y * y + z * z)
    size = np.maximum(length / STEP_ANGLE, samples.period / STEP_SECONDS)
    # By the middle of each sample: one that is as long as a step is a step.
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
        np.array([_left_by_filling(samples, triad) for triad in (_GYROS, _ACCELEROMETERS)]),
    )


def _half_way(angle: Floats, velocity: Floats) -> Floats:
    """Return what samples gained in the body axes half way through each one's angle, (n, 3) m/s.

    Rates and forces change as their neighbours say; velocities are in axes that turn with the body.
    """
    bent, steeper = (
        np.vstack([part[1:], part[-1:]]) - np.vstack([part[:1], part[:-1]])
        for part in (angle, velocity)
    )
    third = cross(angle, steeper + cross(angle, velocity)) - cross(bent, velocity)
    return np.asarray(velocity + third / 24)


def _left_by_filling(samples: Samples, triad: slice) -> float:
    """Return the variance of a sum by gaps that a line from one side to the other fills, SI^2.

    Of the angle or the velocity of a triad. Over h intervals the trapezium leaves f'' h^3 / 12
    (Davis and Rabinowitz 1984, section 2.1); the curvature of the rate is estimated by the second
    differences of the samples beside the gap. A joint that starts or stops within it bends a rate
    at once, which no sample beside shows: slopes that differ by s leave s c (h - c) / 2 of a corner
    at c, in the mean square s^2 h^4 / 120. The force off its axis jumps: by j beyond what the
    slopes beside the gap explain, which leaves j (c - h / 2), in the mean square j^2 h^2 / 12.
    """
    if samples.filled is None or not samples.filled.any():
        return 0.0
    sums, lost = samples.increments[:, triad], samples.filled
    edges = np.flatnonzero(np.diff(lost.astype(np.int8), prepend=0, append=0)).reshape(-1, 2)
    total = 0.0
    for start, stop in edges.tolist():
        beside = [
            sums[a:b] for a, b in ((start - _BESIDE, start), (stop, stop + _BESIDE)) if a >= 0
        ]
        bends = np.vstack([np.diff(part, n=2, axis=0) for part in beside] or [np.zeros((0, 3))])
        square = float((bends**2).sum(axis=1).max(initial=0.0))
        h = stop - start + 1
        left = square * (h**3 / 12) ** 2
        if start >= 2 and stop + 2 <= len(sums):
            before, after = sums[start - 1] - sums[start - 2], sums[stop + 1] - sums[stop]
            if triad == _GYROS:
                apart, share = after - before, h**4 / 120
            else:
                apart = sums[stop] - sums[start - 1] - h * (before + after) / 2
                share = h**2 / 12
            left = max(left, float(apart @ apart) * share)
        total += left
    return total
