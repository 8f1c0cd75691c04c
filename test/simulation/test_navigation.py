"""The navigator of benchmarks/navigation.py against what is known of inertial navigation."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / 'benchmarks'))

from flight import HEIGHT, LATITUDE, Flight, earth_rates, radii
from navigation import flown, off
from strapdown import STEP, Start, navigate

from imu_calib.common.stream import Floats, Units
from imu_calib.common.units import DEG_H, MICRO_G
from imu_calib.model.earth import EARTH_RATE, normal_gravity
from imu_calib.model.sensors import SensorModel
from imu_calib.session.imu import load_imu

# A benchmark there has the name of a package that another test asks for.
sys.path.pop(0)

INTERVAL = 0.1
GRAVITY = normal_gravity(LATITUDE, HEIGHT)
SCHULER = 2 * np.pi * np.sqrt((float(radii(np.array(LATITUDE))[1]) + HEIGHT) / GRAVITY)
"""Its period by the radius across the meridian, some 84.5 min."""


def at_rest(rate: Floats, force: Floats, seconds: float) -> Floats:
    """East and north displacement, m, of a unit at rest, X east, whose sensors err so: (s, 2)."""
    count = round(seconds / INTERVAL / STEP) * STEP
    still = EARTH_RATE * np.array([0.0, np.cos(LATITUDE), np.sin(LATITUDE)])
    angles = np.broadcast_to((still + rate) * INTERVAL, (1, count, 3))
    gained = np.broadcast_to((np.array([0.0, 0.0, GRAVITY]) + force) * INTERVAL, (1, count, 3))
    start = Start(LATITUDE, 0.0, np.zeros(2), np.eye(3))
    course = navigate(start, angles, gained, INTERVAL)[0] - [LATITUDE, 0.0]
    along, across = radii(np.array(LATITUDE))
    return np.stack(
        [course[:, 1] * (across + HEIGHT) * np.cos(LATITUDE), course[:, 0] * (along + HEIGHT)], -1
    )


def test_at_rest_it_stays_where_it_is():
    assert np.abs(at_rest(np.zeros(3), np.zeros(3), 3600.0)).max() < 0.01


def test_an_accelerometer_bias_swings_with_schuler_and_foucault():
    # Britting 1971, section 8: z'' + 2 i W z' + w^2 z = b with W the vertical Earth rate.
    bias, w, vertical = 100 * MICRO_G, 2 * np.pi / SCHULER, EARTH_RATE * np.sin(LATITUDE)
    course = at_rest(np.zeros(3), np.array([bias, 0.0, 0.0]), 3600.0)
    t = np.arange(len(course)) * INTERVAL * STEP
    swing = np.exp(-1j * vertical * t) * (np.cos(w * t) + 1j * vertical / w * np.sin(w * t))
    expected = bias / w**2 * (1 - swing)
    # The radii along and across the meridian differ by half a percent.
    tolerance = 0.01 * np.abs(expected).max()
    assert course[:, 0] == pytest.approx(expected.real, abs=tolerance)
    assert course[:, 1] == pytest.approx(expected.imag, abs=tolerance)
    assert np.abs(expected).max() > 1200.0


def test_a_gyro_bias_runs_away_as_schuler_says():
    # Titterton and Weston 2004, section 12.3: R e (t - sin(w t) / w), by a drift about north.
    drift, w = 0.01 * DEG_H, 2 * np.pi / SCHULER
    course = at_rest(np.array([0.0, drift, 0.0]), np.zeros(3), 2400.0)
    t = np.arange(len(course)) * INTERVAL * STEP
    radius = float(radii(np.array(LATITUDE))[1]) + HEIGHT
    expected = radius * drift * (t - np.sin(w * t) / w)
    assert expected[-1] > 500.0
    # The Earth turns the tilt by W t about the vertical and about north: 1 - W^2 t^2 / 2 of it.
    assert course[:, 0] == pytest.approx(expected, abs=(EARTH_RATE * 2400.0) ** 2 * expected[-1])


FLIGHT = Flight(seconds=480.0, straight=30.0, swinging=60.0)


def test_from_sensors_without_error_it_comes_out_where_the_flight_did():
    imu = replace(load_imu('fog_navigation'), units=Units.SI)
    block = flown(FLIGHT, imu, SensorModel(), 0, noise=False, bias_instability=False)
    errors = off(FLIGHT, block, [(block.gyro, block.accel)])[1]
    # A metre in an hour.
    assert errors.max() < 480.0 / 3600.0
    # Without the Earth's rotation, or without coning and the like, it would be hundreds of it.
    wrong = off(FLIGHT, block, [(block.gyro * (1 + 1e-5), block.accel)])[1]
    assert wrong.max() > 1.0


def test_rates_and_forces_of_the_flight_are_those_of_its_course():
    t, h = np.array([20.0, 75.0, 100.0, 234.5, 350.0, 420.0]), 1e-3
    rate, force = FLIGHT.inputs(t)
    before, now, after = (FLIGHT.attitude(t + d) for d in (-h, 0.0, h))
    body = np.swapaxes(now, 1, 2)
    skew = body @ (after - before) / (2 * h)
    east, north = FLIGHT.velocity(t)
    latitude = FLIGHT.latitude(t)
    earth, transport = earth_rates(latitude, east, north)
    turning = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], -1)
    carried = (body @ (earth + transport)[..., None])[..., 0]
    assert rate == pytest.approx(turning + carried, abs=1e-6)
    ahead, behind = (np.array(FLIGHT.velocity(t + d)) for d in (h, -h))
    zero = np.zeros_like(t)
    gained = np.stack([*(ahead - behind) / (2 * h), zero], -1)
    coriolis = np.cross(2 * earth + transport, np.stack([east, north, zero], -1))
    gravity = np.stack([zero, zero, [normal_gravity(float(x), HEIGHT) for x in latitude]], -1)
    wanted = (body @ (gained + coriolis + gravity)[..., None])[..., 0]
    assert force == pytest.approx(wanted, abs=1e-5)
    # And it goes where its velocity leads.
    slope = (FLIGHT.latitude(t + 0.05) - FLIGHT.latitude(t - 0.05)) / 0.1
    assert slope * (radii(latitude)[0] + HEIGHT) == pytest.approx(north, abs=1e-2)
