"""Motion of a table at its limits: travel times, and courses of piecewise constant acceleration."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..common.stream import Floats

_SAME_INSTANT = 1e-9
"""s: one nanosecond, the resolution of stamps."""


def travel_time(distance: float, rate: float, acceleration: float) -> float:
    """Return the duration of the fastest motion from rest to rest, s.

    Args:
        distance: rad, of either sign.
        rate: Highest rate, rad/s, above zero.
        acceleration: Highest acceleration, rad/s^2, above zero.
    """
    way = abs(distance)
    peak = min(rate, math.sqrt(way * acceleration))
    return way / peak + peak / acceleration if peak else 0.0


def distance_from_rest(time: float, rate: float, acceleration: float) -> float:
    """Return the distance from rest in a time (s) within two limits, rad."""
    ramp = min(time, rate / acceleration)
    return acceleration * ramp**2 / 2 + rate * (time - ramp)


@dataclass(frozen=True, eq=False)
class Course:
    """Joint angles over time with constant acceleration between the knots, at rest at the end.

    The cubic between two neighbouring knots, as in joint_trajectory_controller, is exactly this
    motion.

    Attributes:
        time: (m,) s from the start, increasing from 0.
        angles: (m, k) rad.
        rates: (m, k) rad/s.
    """

    time: Floats
    angles: Floats
    rates: Floats

    @property
    def end(self) -> float:
        """Time of rest, s."""
        return float(self.time[-1])

    def at(self, times: Floats) -> tuple[Floats, Floats]:
        """Return angles (n, k) and rates (n, k) at (n,) times, s."""
        inside = np.clip(times, 0.0, self.end)
        piece = np.clip(np.searchsorted(self.time, inside, side='right') - 1, 0, len(self.time) - 1)
        following = np.minimum(piece + 1, len(self.time) - 1)
        span = (self.time[following] - self.time[piece])[:, None]
        elapsed = (inside - self.time[piece])[:, None]
        share = np.divide(elapsed, span, out=np.zeros_like(elapsed), where=span > 0)
        rates = self.rates[piece] + share * (self.rates[following] - self.rates[piece])
        return self.angles[piece] + (self.rates[piece] + rates) / 2 * elapsed, rates

    def until(self, time: float, accelerations: Sequence[float]) -> Course:
        """Return this course up to a time, then the stop at (k,) accelerations."""
        if time >= self.end:
            return self
        angles, rates = (x[0] for x in self.at(np.array([time])))
        stop = stopping(angles, rates, accelerations)
        kept = self.time < time - _SAME_INSTANT
        return Course(
            np.concatenate([self.time[kept], time + stop.time]),
            np.concatenate([self.angles[kept], stop.angles]),
            np.concatenate([self.rates[kept], stop.rates]),
        )


def moving(
    origin: Sequence[float],
    goal: Sequence[float],
    rates: Sequence[float],
    accelerations: Sequence[float],
) -> Course:
    """Return the course from rest to rest, each joint by itself.

    Args:
        origin: (k,) start angles, rad.
        goal: (k,) end angles, rad.
        rates: (k,) highest rates, rad/s.
        accelerations: (k,) highest accelerations, rad/s^2.
    """
    courses = []
    for start, end, rate, acceleration in zip(origin, goal, rates, accelerations, strict=True):
        way, sign = abs(end - start), math.copysign(1.0, end - start)
        peak = min(rate, math.sqrt(way * acceleration))
        ramp, run_up = peak / acceleration, peak**2 / acceleration / 2
        cruise = way / peak - ramp if peak else 0.0
        time = [0.0, ramp, ramp + max(cruise, 0.0), 2 * ramp + max(cruise, 0.0)]
        angle = [start, start + sign * run_up, end - sign * run_up, end]
        courses.append((time, angle, [0.0, sign * peak, sign * peak, 0.0]))
    return _together(courses)


def stopping(angles: Floats, rates: Floats, accelerations: Sequence[float]) -> Course:
    """Return the stop from (k,) angles and rates, each joint with its own acceleration."""
    courses = []
    for angle, rate, acceleration in zip(angles, rates, accelerations, strict=True):
        time = abs(float(rate)) / acceleration
        end = float(angle) + float(rate) * time / 2
        courses.append(([0.0, time], [float(angle), end], [float(rate), 0.0]))
    return _together(courses)


def _together(courses: Sequence[tuple[list[float], list[float], list[float]]]) -> Course:
    """Combine the joints: with a knot at each knot of any of them."""
    knots = np.unique(np.concatenate([time for time, _, _ in courses]))
    knots = knots[np.concatenate([[True], np.diff(knots) > _SAME_INSTANT])]
    states = []
    for time, angle, rate in courses:
        # A piece of zero length would hide the next one.
        keep = [0, *(i for i in range(1, len(time)) if time[i] - time[i - 1] > _SAME_INSTANT)]
        column = Course(
            np.array(time)[keep], np.array(angle)[keep, None], np.array(rate)[keep, None]
        )
        states.append(column.at(knots))
    return Course(knots, np.hstack([s[0] for s in states]), np.hstack([s[1] for s in states]))
