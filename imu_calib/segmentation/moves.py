"""From rest to rest: how the gyros saw a unit turn on the way, in steps of about a degree.

A step joins samples. Its rotation vector is the sum of their angles and what the change of their
direction adds (coning), to the second order. An error model of a percent changes what the second
order adds by a percent of it: steps stand for the samples however often the model changes.

Source: Savage 1998, J. Guidance 21, 19, eqs. (45) and (48).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..stream import Floats
from ..units import DEG
from .segment import Segment
from .segmented import Move, Rejected, Slip
from .sensor import Sensor
from .statistics import Samples, gap_free

STEP_ANGLE = 1 * DEG
"""Angle of a step, rad: what the second order leaves out is a twelfth of its cube at most, 0.1
arcsec."""

STEP_SECONDS = 0.1
"""Length of a step where little turns, s: the Earth turns by 1.5 arcsec in it."""

_SHORTEST = 4
"""Steps: a shorter motion is a jerk."""
_BESIDE = 5
"""Samples beside a gap whose second differences tell how the rate bends: three of them."""

COARSEST = 5 * DEG
"""Largest angle of one sample on a table, rad: a direction that changes from one to the next by a
tenth of it leaves an arcsecond."""

COARSEST_BY_HAND = 20 * DEG
"""The same in a hand, where an arcminute is nothing: 1000 deg/s at 50 Hz."""


class MoveReader:
    """Joins what lies between one segment at rest and the next to a move.

    Feed motions and rests in order. A gap, a sample at the end of its range, a knock, or a step of
    the stamps ends a move without a result.

    Args:
        sensor: The IMU.
        coarsest: Largest angle of one sample, rad.

    """

    def __init__(self, sensor: Sensor, coarsest: float = COARSEST) -> None:
        self._sensor = sensor
        self._coarsest = coarsest
        self._open: list[_Steps] | None = None
        self._seen = 0
        self._begin = 0
        self._moves: list[tuple[int, int, _Steps]] = []

    def motion(self, samples: Samples, delivered: Floats) -> None:
        """Take the samples of a motion; those that a rest before has had are passed over.

        Args:
            samples: n of them.
            delivered: (n, 6) as the sensor gave them.

        """
        if self._open is not None:
            self._add(samples, delivered, len(samples.stamp))

    def rest(
        self, samples: Samples, delivered: Floats, found: Sequence[Segment | Rejected | Slip]
    ) -> None:
        """Take the samples of a rest, and what was found in it, in order."""
        if any(isinstance(thing, Slip) for thing in found):
            self._open = None
        for segment in (thing for thing in found if isinstance(thing, Segment)):
            if self._open is not None:
                self._add(samples, delivered, int(np.searchsorted(samples.stamp, segment.start)))
            self._close(segment)
            self._open, self._begin, self._seen = [], segment.end, segment.end
        self.motion(samples, delivered)

    def finish(self, period: float) -> tuple[Move, ...]:
        """Return the moves in order.

        Args:
            period: Sample interval by the whole session, s: what the stamps of a few seconds say
                would make rates into angles a percent off, where they jitter.

        """
        pulses = self._sensor.counted
        return tuple(
            Move(
                start,
                end,
                steps.turned if pulses else steps.turned * (period / steps.period)[:, None],
                steps.counts * period,
                steps.quantum,
                steps.filled,
            )
            for start, end, steps in self._moves
        )

    def _close(self, segment: Segment) -> None:
        """End the move that is open where a segment begins."""
        if self._open and sum(len(p.counts) for p in self._open) >= _SHORTEST:
            self._moves.append((self._begin, segment.start, _together(self._open)))

    def _add(self, samples: Samples, delivered: Floats, stop: int) -> None:
        """Join samples before `stop` to steps; forget the move where they are not sound."""
        # The same sample may lie a little otherwise on the line of another stretch.
        beyond = self._seen + round(samples.period * 5e8)
        fresh = slice(int(np.searchsorted(samples.stamp, beyond, side='right')), stop)
        part = samples.at(fresh)
        if self._open is None or not len(part.stamp):
            return
        around = np.concatenate([[self._seen], part.stamp])
        self._seen = int(part.stamp[-1])
        gaps = len(gap_free(around, part.period)) > 1
        coarse = np.abs(part.increments[:, :3]).max() > self._coarsest
        if gaps or coarse or self._sensor.saturated(delivered[fresh], part).any():
            self._open = None
            return
        self._open.append(joined(part))


@dataclass(frozen=True, eq=False)
class _Steps:
    """Steps of a motion.

    Attributes:
        turned: (n, 3) rotation vectors by the sample interval that was assumed, rad.
        counts: (n,) samples in each.
        period: (n,) the sample interval assumed, s.
        quantum: (3,) size of a pulse, rad.
        filled: Variance that filled gaps leave, rad^2.

    """

    turned: Floats
    counts: Floats
    period: Floats
    quantum: Floats
    filled: float = 0.0


def _together(parts: Sequence[_Steps]) -> _Steps:
    return _Steps(
        np.vstack([p.turned for p in parts]),
        np.concatenate([p.counts for p in parts]),
        np.concatenate([p.period for p in parts]),
        parts[0].quantum,
        sum(p.filled for p in parts),
    )


def joined(samples: Samples) -> _Steps:
    """Join samples to steps of `STEP_ANGLE` or `STEP_SECONDS`, whichever is reached first."""
    angle = samples.increments[:, :3]
    size = np.maximum(np.linalg.norm(angle, axis=1) / STEP_ANGLE, samples.period / STEP_SECONDS)
    # By the middle of each sample: one that is as long as a step is a step.
    number = np.floor(np.cumsum(size) - size / 2)
    first = np.flatnonzero(np.diff(number, prepend=-1.0))
    counts = np.diff(first, append=len(angle))
    total = np.cumsum(angle, axis=0) - angle
    so_far = total - np.repeat(total[first], counts, axis=0)
    before = np.vstack([np.zeros(3), angle[:-1]])
    turned = np.add.reduceat(angle + np.cross(so_far / 2 + before / 12, angle), first)
    return _Steps(
        turned,
        counts.astype(float),
        np.full(len(first), samples.period),
        samples.quantum[:3],
        _left_by_filling(samples),
    )


def _left_by_filling(samples: Samples) -> float:
    """Return the variance of an angle by gaps that a line from one side to the other fills, rad^2.

    Over h intervals the trapezium leaves f'' h^3 / 12 (Davis and Rabinowitz 1984, section 2.1); how
    the rate bends is told by the second differences of the samples beside the gap. A joint that
    starts or stops within it bends it at once, which no sample beside shows: slopes that differ by
    s leave s c (h - c) / 2 of a corner at c, in the mean square s^2 h^4 / 120.
    """
    if samples.filled is None or not samples.filled.any():
        return 0.0
    angle, lost = samples.increments[:, :3], samples.filled
    edges = np.flatnonzero(np.diff(lost.astype(np.int8), prepend=0, append=0)).reshape(-1, 2)
    total = 0.0
    for start, stop in edges.tolist():
        beside = [
            angle[a:b] for a, b in ((start - _BESIDE, start), (stop, stop + _BESIDE)) if a >= 0
        ]
        bends = np.vstack([np.diff(part, n=2, axis=0) for part in beside] or [np.zeros((0, 3))])
        square = float((bends**2).sum(axis=1).max(initial=0.0))
        h = stop - start + 1
        left = square * (h**3 / 12) ** 2
        if start >= 2 and stop + 2 <= len(angle):
            turn = angle[stop + 1] - angle[stop] - angle[start - 1] + angle[start - 2]
            left = max(left, float(turn @ turn) * h**4 / 120)
        total += left
    return total
