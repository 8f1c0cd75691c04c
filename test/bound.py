"""The Cramer-Rao bound of a session, by nothing that the estimators are made of.

The stream of a channel is taken whole, sample by sample: its increments are the true ones plus a
random walk plus the difference of two reading errors, white with a twelfth of a pulse squared.
Their covariance is tridiagonal, and the information on a constant rate is 1' S^-1 1. What the
channels read comes from the sensor model and rotations written out; derivatives are differences.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.linalg import solveh_banded

from imu_calib.earth import Site
from imu_calib.imu import ImuSpec
from imu_calib.model import SensorModel
from imu_calib.plan import Plan
from imu_calib.stream import Floats
from imu_calib.turntable import TURN
from imu_calib.units import ARCSEC

_LEVELLED = 20 * ARCSEC
_BEYOND = 1.0


def bound(
    plan: Plan,
    spec: ImuSpec,
    model: SensorModel,
    site: Site,
    azimuth: float,
    at_rest: dict[str, float],
) -> Floats:
    """Standard deviations (24,) that no unbiased estimator falls below.

    Args:
        plan: Its positions and whole turns.
        spec: Random walk, pulses and sample rate.
        model: The truth.
        site: Gravity and Earth rate.
        azimuth: Of the table, unknown to the estimator like the two tilts.
        at_rest: How long the unit stood at each position, s.

    """
    state = np.concatenate([model.vector(), [azimuth, 0.0, 0.0]])
    steps = np.concatenate([np.full(24, 1e-3), np.full(3, 1e-4)])
    jacobian = np.array(
        [
            (read(plan, site, state + step) - read(plan, site, state - step)) / (2 * step.max())
            for step in np.diag(steps)
        ]
    ).T
    jacobian /= np.sqrt(variances(plan, spec, at_rest))[:, None]
    information = jacobian.T @ jacobian
    information[25:, 25:] += np.eye(2) / _LEVELLED**2
    scale = 1 / np.sqrt(np.diag(information))
    covariance = np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)
    return np.asarray(np.sqrt(np.diag(covariance))[:24])


def read(plan: Plan, site: Site, state: Floats) -> Floats:
    """What all stretches (six each) and turns (three each) read."""
    model = SensorModel.from_vector(state[:24])
    azimuth, east, north = state[24:]
    base = about('z', azimuth) @ about('x', east) @ about('y', north)
    values = []
    for position in plan.positions:
        body = (base @ position.attitude).T
        values += [*model.predict(body @ site.earth_rate, body @ site.specific_force)]
        up = position.attitude[2]
        axis = base[:, 2]
        for rate in position.rate_test.rates if position.rate_test else ():
            spin = up * (rate + axis @ site.earth_rate)
            values.append(model.predict(spin, np.zeros(3))[0])
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
            values += 3 * [variance_between(TURN / abs(rate), _BEYOND, *gyro)]
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
