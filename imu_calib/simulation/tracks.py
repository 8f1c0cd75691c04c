"""Motion of piecewise constant acceleration: trapezoids, braking, rest."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..common.stream import Floats


@dataclass(frozen=True, eq=False)
class Track:
    """Columns that move together in time, each a quadratic within a piece.

    The first piece is extended into the past, the last one without end.

    Attributes:
        start: (m,) start of each piece, s, never decreasing.
        value: (m, c) values at the start of each piece, rad.
        rate: (m, c) their rates there, rad/s.
        acceleration: (m, c) constant through the piece, rad/s^2.
    """

    start: Floats
    value: Floats
    rate: Floats
    acceleration: Floats

    @classmethod
    def standing(cls, time: float, value: Floats) -> Track:
        """Return a track at rest at (c,) values from a time on."""
        still = np.zeros((1, len(value)))
        return cls(np.array([time]), np.array(value, dtype=float)[None], still, still)

    @property
    def end(self) -> float:
        """Start of the last piece, s: for a motion that ends at rest, the time of rest."""
        return float(self.start[-1])

    def piece(self, times: Floats) -> NDArray[np.intp]:
        """Return the (n,) index of the piece of each of (n,) times."""
        return np.maximum(np.searchsorted(self.start, times, side='right') - 1, 0)

    def at(self, times: Floats) -> tuple[Floats, Floats]:
        """Return values (n, c) and rates (n, c) at (n,) times."""
        index = self.piece(times)
        elapsed = (times - self.start[index])[:, None]
        rate = self.rate[index]
        change = self.acceleration[index] * elapsed
        return self.value[index] + (rate + change / 2) * elapsed, rate + change

    def stopping(self, offset: float, target: float) -> Track:
        """Return the same track at an offset until it brakes; then it stops at another value.

        Requires one column, and braking in the last piece but one.
        """
        value, rate, acceleration = self.value + offset, self.rate.copy(), self.acceleration.copy()
        way = float(value[-1, 0] - value[-2, 0])
        longer = (target - float(value[-2, 0])) / way
        rate[-2] *= longer
        acceleration[-2] *= longer
        value[-1] = target
        return Track(self.start, value, rate, acceleration)

    def mapped(self, origin: float, target: float) -> Track:
        """Return a track of the same times between other values.

        Requires one column whose last value differs from its first.
        """
        ratio = (target - origin) / float(self.value[-1, 0] - self.value[0, 0])
        value = origin + (self.value - self.value[0]) * ratio
        value[-1] = target
        return Track(self.start, value, self.rate * ratio, self.acceleration * ratio)

    def followed_by(self, later: Track) -> Track:
        """Return this track up to the start of another, and that one from there on."""
        keep = self.start < later.start[0]
        return Track(
            np.concatenate([self.start[keep], later.start]),
            np.concatenate([self.value[keep], later.value]),
            np.concatenate([self.rate[keep], later.rate]),
            np.concatenate([self.acceleration[keep], later.acceleration]),
        )

    def since(self, time: float) -> Track:
        """Return the track without the pieces that end before a time."""
        first = int(self.piece(np.array([time]))[0])
        if not first:
            return self
        return Track(
            self.start[first:], self.value[first:], self.rate[first:], self.acceleration[first:]
        )

    def columns(self, which: slice) -> Track:
        """Return some of the columns."""
        return Track(
            self.start, self.value[:, which], self.rate[:, which], self.acceleration[:, which]
        )


def side_by_side(tracks: Sequence[Track]) -> Track:
    """Return one track with the columns of several; its pieces end where any of theirs do."""
    start = np.unique(np.concatenate([track.start for track in tracks]))
    states = [track.at(start) for track in tracks]
    return Track(
        start,
        np.hstack([value for value, _ in states]),
        np.hstack([rate for _, rate in states]),
        np.hstack([track.acceleration[track.piece(start)] for track in tracks]),
    )


def trapezoid(
    time: float, origin: float, target: float, max_rate: float, max_acceleration: float
) -> Track:
    """Return the fastest motion from rest to rest within two limits, as a track of one column.

    A distance too short to reach `max_rate` gives a triangle.

    Args:
        time: Start, s.
        origin: Start value, rad.
        target: End value, rad.
        max_rate: rad/s, above zero.
        max_acceleration: rad/s^2, above zero.
    """
    distance = abs(target - origin)
    if distance == 0:
        return Track.standing(time, np.array([target]))
    sign = math.copysign(1.0, target - origin)
    peak = min(max_rate, math.sqrt(distance * max_acceleration))
    ramp = peak / max_acceleration
    cruise = max(distance / peak - ramp, 0.0)
    run_up = sign * peak * ramp / 2
    return Track(
        time + np.array([0.0, ramp, ramp + cruise, 2 * ramp + cruise]),
        np.array([origin, origin + run_up, target - run_up, target])[:, None],
        sign * np.array([0.0, peak, peak, 0.0])[:, None],
        sign * np.array([max_acceleration, 0.0, -max_acceleration, 0.0])[:, None],
    )


def braking(time: float, value: Floats, rate: Floats, max_acceleration: float) -> Track:
    """Return the stop of columns that come to rest together, the first one at the limit.

    Args:
        time: Start, s.
        value: (c,) start values, rad.
        rate: (c,) their rates, rad/s.
        max_acceleration: rad/s^2, above zero.
    """
    duration = abs(float(rate[0])) / max_acceleration
    if duration == 0:
        return Track.standing(time, value)
    still = np.zeros(len(value))
    return Track(
        np.array([time, time + duration]),
        np.array([value, value + rate * duration / 2]),
        np.array([rate, still]),
        np.array([-rate / duration, still]),
    )
