"""The Cramer-Rao bound of a session, by nothing that the estimators are made of.

The stream of a channel is taken whole, sample by sample: its increments are the true ones plus a
random walk plus the difference of two reading errors, white with a twelfth of a pulse squared.
Their covariance is tridiagonal, and the information on a constant rate is 1' S^-1 1. What the
channels read comes from the sensor model and rotations written out; derivatives are differences.
Of a move between two rests the gyros' increments are carried to its end and summed: a random walk
over its time, and two reading errors. Where the unit turns whole turns it is somewhere within a
metre of the axis, elsewhere at each position.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import pairwise

import numpy as np
from scipy.linalg import solveh_banded

from imu_calib.earth import Site
from imu_calib.imu import ImuSpec
from imu_calib.model import SensorModel
from imu_calib.plan import Plan
from imu_calib.stream import Floats
from imu_calib.turntable import TURN, Table
from imu_calib.units import ARCSEC

_LEVELLED = 20 * ARCSEC
_WITHIN = 1.0
_BEYOND = 1.0
_PARTS = 201
_SEEN_BESIDE = 0.5
"""What the joint states leave open at the ends of a rest, s: it goes to the moves."""


def bound(
    plan: Plan,
    spec: ImuSpec,
    model: SensorModel,
    site: Site,
    azimuth: float,
    at_rest: dict[str, float],
    table: Table | None,
) -> Floats:
    """Standard deviations (24,) that no unbiased estimator falls below.

    Args:
        plan: Its positions and whole turns.
        spec: Random walk, pulses and sample rate.
        model: The truth.
        site: Gravity and Earth rate.
        azimuth: Of the table, unknown to the estimator like the two tilts.
        at_rest: How long the unit stood at each position, s.
        table: What moves it from one to the next; None where nobody looks at the moves.

    """
    ways = moves(plan, table) if table is not None else []
    arms = 3 * sum(position.rate_test is not None for position in plan.positions)
    state = np.concatenate([model.vector(), [azimuth, 0.0, 0.0], np.zeros(arms)])
    steps = np.concatenate([np.full(24, 1e-3), np.full(3, 1e-4), np.full(arms, 1e-3)])
    jacobian = np.array(
        [
            (read(plan, site, state + step, ways) - read(plan, site, state - step, ways))
            / (2 * step.max())
            for step in np.diag(steps)
        ]
    ).T
    moved = [spec.gyro.random_walk**2 * way.seconds for way in ways]
    moved = np.repeat(np.array(moved) + spec.gyro.scale_factor**2 / 6, 3)
    jacobian /= np.sqrt(np.append(variances(plan, spec, at_rest), moved))[:, None]
    information = jacobian.T @ jacobian
    information += np.diag([*[0.0] * 25, *[_LEVELLED**-2] * 2, *[_WITHIN**-2] * arms])
    scale = 1 / np.sqrt(np.diag(information))
    covariance = np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)
    return np.asarray(np.sqrt(np.diag(covariance))[:24])


@dataclass(frozen=True)
class Way:
    """A move: attitudes (n, 3, 3) at the ends of equal intervals, and how long it is seen, s."""

    attitudes: Floats
    moving: float
    seconds: float

    @property
    def step(self) -> float:
        """Length of an interval, s."""
        return self.moving / (len(self.attitudes) - 1)

    @cached_property
    def spins(self) -> Floats:
        """What the table turns it by in each interval, body axes, (n - 1, 3) rad/s."""
        turned = self.attitudes[:-1].transpose(0, 2, 1) @ self.attitudes[1:]
        return np.stack([turned[:, 2, 1], turned[:, 0, 2], turned[:, 1, 0]], axis=1) / self.step

    @cached_property
    def carried(self) -> Floats:
        """What carries each interval to the end of the move, (n - 1, 3, 3).

        Seen from the middle of the interval: to second order in what it turns by.
        """
        middle = (self.attitudes[:-1] + self.attitudes[1:]) / 2
        return np.asarray(self.attitudes[-1].T @ middle)


def moves(plan: Plan, table: Table) -> list[Way]:
    """Those from one dwell to the next in which nothing turns whole turns."""
    ways = []
    for before, after in pairwise(plan.steps(table)):
        if not (before.dwell and after.dwell) or np.array_equal(before.angles, after.angles):
            continue
        seconds, course = travel(before.angles, after.angles, table)
        attitudes = table.attitude(np.array([course(t) for t in np.linspace(0, seconds, _PARTS)]))
        ways.append(Way(attitudes, seconds, seconds + _SEEN_BESIDE))
    return ways


def travel(
    origin: Floats, goal: Floats, table: Table
) -> tuple[float, Callable[[float], list[float]]]:
    """How long joints take at their limits, and where they are after so many seconds."""
    legs = []
    for a, b, joint in zip(origin, goal, table.joints, strict=True):
        way, top, rise = abs(b - a), joint.max_rate, joint.max_acceleration
        ramp = min(top / rise, np.sqrt(way / rise))
        legs.append((a, b, ramp, way / (ramp * rise) + ramp if ramp else 0.0))

    def course(time: float) -> list[float]:
        angles = []
        for (a, b, ramp, whole), joint in zip(legs, table.joints, strict=True):
            t, rise = min(time, whole), joint.max_acceleration
            rising, falling = min(t, ramp), max(0.0, t - whole + ramp)
            gone = rise * (rising**2 / 2 + ramp * max(0.0, t - ramp) - falling**2 / 2)
            angles.append(a + np.sign(b - a) * gone)
        return angles

    return max(leg[3] for leg in legs), course


def read(plan: Plan, site: Site, state: Floats, ways: list[Way]) -> Floats:
    """What all stretches and turns (six each) read, and moves (three each) sum to."""
    model = SensorModel.from_vector(state[:24])
    azimuth, east, north = state[24:27]
    arms = iter(state[27:].reshape(-1, 3))
    base = about('z', azimuth) @ about('x', east) @ about('y', north)
    values = []
    for position in plan.positions:
        body = (base @ position.attitude).T
        values += [*model.predict(body @ site.earth_rate, body @ site.specific_force)]
        up = position.attitude[2]
        axis = base[:, 2]
        if position.rate_test is None:
            continue
        arm, along = next(arms), up * (axis @ site.specific_force)
        for rate in position.rate_test.rates:
            spin = up * (rate + axis @ site.earth_rate)
            values += [*model.predict(spin, along + np.cross(spin, np.cross(spin, arm)))]
    for way in ways:
        # (base @ attitude)' earth, of every interval.
        rates = way.spins + way.attitudes[1:].transpose(0, 2, 1) @ (base.T @ site.earth_rate)
        total = np.einsum('nij,nj->i', way.carried, model.predict(rates, np.zeros(3))[0]) * way.step
        # Where it stands before and after.
        beside = (way.seconds - way.moving) * model.gyro.bias
        values.append(total + (way.attitudes[-1].T @ way.attitudes[0] + np.eye(3)) @ beside / 2)
    return np.concatenate(values)


def about(axis: str, angle: float) -> Floats:
    c, s = np.cos(angle), np.sin(angle)
    matrix = {
        'x': [[1, 0, 0], [0, c, -s], [0, s, c]],
        'y': [[c, 0, s], [0, 1, 0], [-s, 0, c]],
        'z': [[c, -s, 0], [s, c, 0], [0, 0, 1]],
    }
    return np.array(matrix[axis])


def variances(plan: Plan, spec: ImuSpec, at_rest: dict[str, float]) -> Floats:
    """Bounds of the mean rates, in the order of `read`."""
    assert spec.sample_rate is not None
    gyro = (spec.gyro.random_walk, spec.gyro.scale_factor, 1 / spec.sample_rate)
    accel = (spec.accel.random_walk, spec.accel.scale_factor, 1 / spec.sample_rate)
    values = []
    for position in plan.positions:
        seconds = at_rest[position.id]
        values += 3 * [variance(seconds, *gyro)] + 3 * [variance(seconds, *accel)]
        for rate in position.rate_test.rates if position.rate_test else ():
            for triad in (gyro, accel):
                values += 3 * [variance_between(TURN / abs(rate), _BEYOND, *triad)]
    return np.array(values)


@cache
def variance(seconds: float, walk: float, pulse: float, period: float) -> float:
    """Bound of the variance of a mean rate over a stream of so many seconds."""
    n = round(seconds / period)
    band = np.zeros((2, n))
    band[0, 1:] = -(pulse**2) / 12
    band[1] = walk**2 * period + pulse**2 / 6
    return float(1 / (period**2 * solveh_banded(band, np.ones(n)).sum()))


@cache
def variance_between(
    seconds: float, beyond: float, walk: float, pulse: float, period: float
) -> float:
    """Bound of the variance of a mean rate from a stream that goes on `beyond` s at either end.

    There the rate may be any other, constant one: what lies beyond tells where the counter stood
    at the cuts, and no more. Who takes the rate to be the same close to the cuts gets 1.5 % less.
    """
    n, spare = round(seconds / period), round(beyond / period)
    band = np.zeros((2, n + 2 * spare))
    band[0, 1:] = -(pulse**2) / 12
    band[1] = walk**2 * period + pulse**2 / 6
    parts = np.repeat(np.eye(3), [spare, n, spare], axis=0) * period
    information = parts.T @ solveh_banded(band, parts)
    return float(np.linalg.inv(information)[1, 1])
