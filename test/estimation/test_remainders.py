"""What counters hold back on a move, against counters that count, one phase after another."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_calib.common.stream import Floats
from imu_calib.estimation.remainders import ApproximateSensors, _line, remainder_covariance
from imu_calib.model.sensors import SensorModel, Triad

PERIOD, PULSE = 0.02, 0.01
PHASES = 4000
SPREAD = 6 * np.sqrt(2 / PHASES)
"""Six deviations of a variance of so many draws that are nearly normal."""


def about_x(angle: float) -> Floats:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def half_a_turn() -> Floats:
    """Half a turn about x in a hundred steps that speed up and slow down: (100, 3, 3)."""
    time = (np.arange(100) + 0.5) / 100
    return np.array([about_x(np.pi * (t - np.sin(2 * np.pi * t) / (2 * np.pi))) for t in time])


def counted(directions: Floats, outputs: Floats) -> Floats:
    """What counters make of a velocity beyond what it was, for many phases: (PHASES, 3) m/s."""
    charge = np.random.default_rng(3).uniform(0.0, 1.0, (PHASES, 3))
    error = np.zeros((PHASES, 3))
    for direction, output in zip(directions, outputs, strict=True):
        gained = output * PERIOD
        charge += gained / PULSE
        given = np.floor(charge)
        charge -= given
        error += (given * PULSE - gained) @ direction.T
    return error


@pytest.mark.parametrize('level', [0.0, 0.5, 1.0, 2.0, 7.3], ids=lambda pulses: f'{pulses} pulses')
def test_the_covariance_is_that_of_counters_of_any_phase(level: float) -> None:
    """About the vertical: channel x counts gravity, the level ones a few pulses in all."""
    turned = half_a_turn()
    outputs = np.tile([9.803, level * PULSE / 2.0, -level * PULSE / 2.0], (100, 1))
    found = remainder_covariance(
        turned, np.full(100, PERIOD), outputs, np.zeros(3), np.full(3, PULSE)
    )
    seen = np.cov(counted(turned, outputs).T)
    # The harmonics that count as independent: 7 % of both ends of both channels.
    np.testing.assert_allclose(found, seen, rtol=SPREAD, atol=0.07 * PULSE**2 / 3)
    if level == 1.0:
        assert np.trace(found) > 3 * PULSE**2 / 3


def test_of_gravity_that_turns_the_ends_count_alone() -> None:
    """About a level axis two channels count fast: what they hold back has no memory."""
    turned = half_a_turn() @ np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    gravity = np.einsum('nij,i->nj', turned, [0.0, 0.0, 9.81])
    found = remainder_covariance(
        turned, np.full(100, PERIOD), gravity + 0.013, np.zeros(3), np.full(3, PULSE)
    )
    seen = np.cov(counted(turned, gravity + 0.013).T)
    np.testing.assert_allclose(found, seen, rtol=SPREAD, atol=0.07 * PULSE**2 / 6)
    assert np.trace(found) < 1.6 * 3 * PULSE**2 / 6


@pytest.mark.parametrize('pulses', [0.5, 3.0])
def test_a_rate_that_is_in_doubt_counts_with_all_that_it_may_be(pulses: float) -> None:
    turned, doubt = half_a_turn(), pulses * PULSE / 2.0
    outputs = np.tile([9.803, PULSE / 2.0, 0.0], (100, 1))
    found = remainder_covariance(
        turned, np.full(100, PERIOD), outputs, np.array([0.0, doubt, 0.0]), np.full(3, PULSE)
    )
    rng = np.random.default_rng(5)
    each = []
    for faster in rng.normal(0.0, doubt, 400):
        off = outputs + np.array([0.0, faster, 0.0])
        each.append(
            remainder_covariance(turned, np.full(100, PERIOD), off, np.zeros(3), np.full(3, PULSE))
        )
    np.testing.assert_allclose(found, np.mean(each, axis=0), rtol=0.12, atol=PULSE**2 / 100)


def test_what_is_no_counter_holds_nothing_back() -> None:
    turned = half_a_turn()
    outputs = np.tile([9.81, 0.0, 0.0], (100, 1))
    pulses = np.array([PULSE, 0.0, 0.0])
    found = remainder_covariance(turned, np.full(100, PERIOD), outputs, np.zeros(3), pulses)
    assert found[0, 0] > 0
    assert not found[1:].any()


MODEL = SensorModel(
    Triad(np.array([[0.01, 0.02, 0.0], [0.0, -0.03, 0.01], [0.005, 0.0, 0.02]]), np.full(3, 3e-3)),
    Triad(np.array([[0.02, 0.0, 0.01], [-0.01, 0.01, 0.0], [0.0, 0.03, -0.02]]), np.full(3, 0.2)),
)
OWN = np.array([1e-6, 4e-6, 9e-6])


def roughly(ups: Floats, axes: list[int]) -> ApproximateSensors:
    """What rests with these ups and turns about these axes tell, without noise."""
    forces = 9.8 * ups
    segments: list[Any] = [
        SimpleNamespace(
            statistics=SimpleNamespace(
                mean=np.concatenate(MODEL.predict(np.zeros(3), force)),
                variance=lambda walk: np.append(walk[:3], OWN),
            )
        )
        for force in forces
    ]
    turns: list[Any] = []
    for axis in axes:
        for rate in (0.5, -0.5):
            up = np.eye(3)[axis]
            mean = np.concatenate(MODEL.predict(rate * up, 9.8 * up))
            statistics = SimpleNamespace(mean=mean)
            turns.append(SimpleNamespace(up=up, rate=lambda rate=rate: rate, statistics=statistics))
    return ApproximateSensors.fitted(segments, turns, forces, np.zeros(6))


def test_rests_and_turns_all_around_tell_what_the_sensors_answer() -> None:
    ups = Rotation.random(8, random_state=1).as_matrix()[:, 2]
    found = roughly(ups, [0, 1, 2])
    np.testing.assert_allclose(found.model.vector(), MODEL.vector(), atol=1e-12)
    # Four unknowns of eight rests: half of the variance of one.
    assert found.accel_std == pytest.approx(np.sqrt(OWN * 4 / 8))


def test_where_no_turn_shows_the_gyros_their_misalignment_is_in_doubt() -> None:
    ups = np.vstack([np.eye(3), -np.eye(3)])
    found = roughly(ups, [0])
    np.testing.assert_allclose(found.model.accel.vector(), MODEL.accel.vector(), atol=1e-12)
    # Of the gyros the bias and what turned: what did not is taken for ideal.
    response = np.eye(3)
    response[:, 0] = MODEL.gyro.response[:, 0]
    np.testing.assert_allclose(found.model.gyro.response, response, atol=1e-12)
    np.testing.assert_allclose(found.model.gyro.bias, MODEL.gyro.bias, atol=1e-12)
    # A milliradian of gravity.
    assert found.accel_std == pytest.approx(np.sqrt(OWN * 4 / 6 + (1e-3 * 9.8) ** 2))


@pytest.mark.parametrize(('small', 'seen'), [(1.6e-3, 3), (1.9e-3, 4)])
def test_a_direction_that_hardly_turned_is_left_out(small: float, seen: int) -> None:
    # Singular values: the root of six for the bias, and of two for a direction of length one.
    inputs = np.vstack([np.diag([1.0, 1.0, small]), -np.diag([1.0, 1.0, small])])
    outputs = inputs @ MODEL.gyro.response.T + MODEL.gyro.bias
    found, known = _line(inputs, outputs)
    assert known == seen
    assert found.response[2, 2] == pytest.approx(1.02 if seen == 4 else 1.0)
    assert found.bias == pytest.approx(MODEL.gyro.bias)
