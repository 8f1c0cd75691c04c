"""The latitude at a glance: gyros at rest in several attitudes, with errors worked out apart."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_calib.common.stream import Floats
from imu_calib.estimation.checks import contradicts, measured_latitude, vertical_earth_rate

RATE = 7.292115e-5
LATITUDE = np.radians(40.0)
EARTH = RATE * np.array([0.0, np.cos(LATITUDE), np.sin(LATITUDE)])
BIAS = np.array([3e-5, -2e-5, 1e-5])


def rests(attitudes: Floats, noise: Floats | float = 0.0) -> list[Any]:
    """Attitudes take body axes to east, north and up."""
    read = np.einsum('kij,i->kj', attitudes, EARTH) + BIAS + noise
    return [
        SimpleNamespace(
            attitude=attitude, statistics=SimpleNamespace(mean=np.append(mean, [0] * 3))
        )
        for attitude, mean in zip(attitudes, read, strict=True)
    ]


def attitudes(count: int) -> Floats:
    return np.asarray(Rotation.random(count, random_state=1).as_matrix())


def test_three_rests_show_the_rate_about_up() -> None:
    found = vertical_earth_rate(rests(attitudes(3)))
    assert found is not None
    up, std = found
    assert up == pytest.approx(EARTH[2], rel=1e-9)
    # Without noise it is the scale factors that are in doubt, by 3 %.
    assert std == pytest.approx(0.03 * EARTH[2], rel=1e-6)


def test_two_rests_or_one_attitude_show_nothing() -> None:
    assert vertical_earth_rate(rests(attitudes(2))) is None
    assert vertical_earth_rate(rests(np.repeat(attitudes(1), 5, axis=0))) is None
    unknown = rests(attitudes(3))
    unknown[1].attitude = None
    assert vertical_earth_rate(unknown) is None
    assert vertical_earth_rate([*unknown, *rests(attitudes(4)[3:])]) is not None


def test_its_deviation_is_that_of_the_readings_scatter() -> None:
    turned = attitudes(12)
    ratios = []
    for seed in range(300):
        noise = 1e-5 * np.random.default_rng(seed).standard_normal((12, 3))
        found = vertical_earth_rate(rests(turned, noise))
        assert found is not None
        own = np.sqrt(found[1] ** 2 - (0.03 * found[0]) ** 2)
        ratios.append((found[0] - EARTH[2]) / own)
    # 36 readings less six unknowns: the square of a Student's t of 30 has a mean of 30 / 28.
    assert np.mean(np.square(ratios)) == pytest.approx(30 / 28, abs=6 * np.sqrt(2.3 / 300))


def test_a_latitude_is_told_where_it_is_known_to_ten_degrees() -> None:
    std = RATE * np.radians(1.0)
    up = RATE * np.sin(np.radians(60.0))
    latitude, found = measured_latitude(up, std) or (np.nan, np.nan)
    assert np.degrees(latitude) == pytest.approx(60.0)
    assert np.degrees(found) == pytest.approx(2.0)
    assert measured_latitude(up, 4.99 * std) is not None
    assert measured_latitude(up, 5.01 * std) is None
    # Near a pole the sine hardly tells the angle: as much as ten degrees from it.
    pole, there = measured_latitude(1.2 * RATE, std) or (np.nan, np.nan)
    assert np.degrees(pole) == pytest.approx(90.0)
    assert np.degrees(there) == pytest.approx(1.0 / np.sin(np.radians(10.0)))
    south, _ = measured_latitude(-up, std) or (np.nan, np.nan)
    assert np.degrees(south) == pytest.approx(-60.0)


def test_five_deviations_contradict_a_latitude() -> None:
    std = 1e-7
    up = RATE * np.sin(LATITUDE)
    for sign in (1.0, -1.0):
        assert not contradicts(up + sign * 4.99 * std, std, LATITUDE)
        assert contradicts(up + sign * 5.01 * std, std, LATITUDE)
