"""The Cramer-Rao bound of a session, by nothing that the estimators are made of.

The stream of a channel is taken whole, sample by sample: its increments are the true ones plus a
random walk plus the difference of two reading errors, white with a twelfth of a pulse squared.
Their covariance is tridiagonal, and the information on a constant rate is 1' S^-1 1. What the
channels read comes from the sensor model and rotations written out; derivatives are differences.
Of a move between two rests the gyros' increments are carried to its end and summed, and those of
the accelerometers likewise, in axes that err as the gyros do: a random walk over its time, and two
reading errors. Where the unit turns whole turns it is somewhere within a metre of the axis,
elsewhere at each position; each accelerometer is somewhere within centimetres of the others, and
all answer some milliseconds late.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import pairwise

import numpy as np
from scipy.linalg import block_diag, solveh_banded

from imu_calib.common.stream import Floats
from imu_calib.common.units import ARCSEC
from imu_calib.model.earth import Site
from imu_calib.model.sensors import SensorModel
from imu_calib.session.imu import ImuSpec
from imu_calib.session.plan import Plan
from imu_calib.session.table import TURN, Table

_LEVELLED = 20 * ARCSEC
_WITHIN = 1.0
_APART = 0.03
_LATE = 0.01
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
    *,
    velocities: bool = True,
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
        velocities: Whether anybody looks at what the accelerometers gain on them.
    """
    ways = moves(plan, table) if table is not None else []
    arms = 3 * sum(position.rate_test is not None for position in plan.positions)
    # Where the unit and each accelerometer are, and how late they answer.
    apart = ways if velocities else []
    unknown = arms + (13 if apart else 0)
    state = np.concatenate([model.vector(), [azimuth, 0.0, 0.0], np.zeros(unknown)])
    steps = np.concatenate([np.full(24, 1e-3), np.full(3, 1e-4), np.full(unknown, 1e-3)])
    jacobian = np.array(
        [
            (read(plan, site, state + step, ways) - read(plan, site, state - step, ways))
            / (2 * step.max())
            for step in np.diag(steps)
        ]
    ).T
    each = [noise_of(way, spec, site) for way in ways]
    each = each if apart else [noise[:3, :3] for noise in each]
    noise = block_diag(np.diag(variances(plan, spec, at_rest)), *each)
    information = jacobian.T @ np.linalg.solve(noise, jacobian)
    priors = [_WITHIN] * arms + ([_WITHIN] * 3 + [_APART] * 9 + [_LATE] if apart else [])
    information += np.diag([*[0.0] * 25, *np.array([_LEVELLED] * 2 + priors) ** -2.0])
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
    def at(self) -> Floats:
        """Attitudes before it, in the middle of each interval and after it, (n + 1, 3, 3)."""
        ends = self.attitudes
        return np.concatenate([ends[:1], (ends[:-1] + ends[1:]) / 2, ends[-1:]])

    @cached_property
    def lasting(self) -> Floats:
        """How long each of them lasts, (n + 1,) s."""
        beside = (self.seconds - self.moving) / 2
        return np.array([beside, *[self.step] * (len(self.attitudes) - 1), beside])

    @cached_property
    def spins(self) -> Floats:
        """What the table turns it by in each of them, body axes, (n + 1, 3) rad/s."""
        turned = self.attitudes[:-1].transpose(0, 2, 1) @ self.attitudes[1:]
        rates = np.stack([turned[:, 2, 1], turned[:, 0, 2], turned[:, 1, 0]], axis=1) / self.step
        return np.vstack([np.zeros(3), rates, np.zeros(3)])

    @cached_property
    def faster(self) -> Floats:
        """How fast that changes, (n + 1, 3) rad/s^2."""
        inner = (self.spins[2:] - self.spins[:-2]) / (2 * self.step)
        return np.vstack([np.zeros(3), inner, np.zeros(3)])


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
    """What all stretches and turns (six each) read, and moves sum to.

    These are six each where the state goes on with what velocities need: where the unit and each
    accelerometer are, and how late they answer; else the three of the gyros.
    """
    model = SensorModel.from_vector(state[:24])
    azimuth, east, north = state[24:27]
    turned = sum(position.rate_test is not None for position in plan.positions)
    arms, besides = iter(state[27 : 27 + 3 * turned].reshape(-1, 3)), state[27 + 3 * turned :]
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
        values += [summed(way, model, site, base, besides)]
    return np.concatenate(values)


def summed(way: Way, model: SensorModel, site: Site, base: Floats, besides: Floats) -> Floats:
    """What gyros and accelerometers sum to over a move, along the body axes at its end.

    The axes of the accelerometers' sum are those of the attitudes, turned by what the gyros read
    beyond the truth. Where the unit is enters by the Coriolis force alone, but what the places of
    the accelerometers differ by in full.
    """
    first, last, gravity = way.attitudes[0], way.attitudes[-1], base.T @ site.specific_force
    # (base @ attitude)' earth, and the attitude's transpose by gravity.
    rates = way.spins + way.at.transpose(0, 2, 1) @ (base.T @ site.earth_rate)
    gyro, accel = model.predict(rates, way.at.transpose(0, 2, 1) @ gravity)
    to_end = last.T @ way.at * way.lasting[:, None, None]
    read = np.einsum('nij,nj->ni', to_end, gyro)
    if not len(besides):
        return np.asarray(read.sum(axis=0))
    unit, places, late = besides[:3], besides[3:12].reshape(3, 3), besides[12]
    for c, place in enumerate(places):
        felt = np.cross(way.faster, place) + np.cross(way.spins, np.cross(way.spins, place))
        accel[:, c] += felt @ model.accel.response[c]
    changing = np.diff(way.attitudes.transpose(0, 2, 1) @ gravity, axis=0) / way.step
    accel[1:-1] -= late * changing @ model.accel.response.T
    gained = np.einsum('nij,nj->ni', to_end, accel)
    # What is read here turns what was gained before, and half of what is gained meanwhile.
    so_far = np.cumsum(way.lasting) - way.lasting / 2
    before = np.outer(so_far, last.T @ site.specific_force)
    velocity = (gained - np.cross(before, read)).sum(axis=0)
    coriolis = 2 * np.cross(site.earth_rate, base @ (last - first) @ unit)
    return np.append(read.sum(axis=0), velocity + (base @ last).T @ coriolis)


def noise_of(way: Way, spec: ImuSpec, site: Site) -> Floats:
    """The covariance (6, 6) of what `summed` sums, by random walk and readings at both ends."""
    x, y, z = way.attitudes[-1].T @ site.specific_force
    turning = -np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    found = np.zeros((6, 6))
    count = 200
    for k in range(count):
        by_gyro = np.vstack([np.eye(3), turning * (k + 0.5) / count * way.seconds])
        found += spec.gyro.random_walk**2 * way.seconds / count * by_gyro @ by_gyro.T
    for at in (0.0, 1.0):
        by_gyro = np.vstack([np.eye(3), turning * at * way.seconds])
        found += spec.gyro.scale_factor**2 / 12 * by_gyro @ by_gyro.T
    own = spec.accel.random_walk**2 * way.seconds + spec.accel.scale_factor**2 / 6
    found[3:, 3:] += own * np.eye(3)
    return found


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
