"""Segments, turns and moves as values: variances, scale and time, worked out channel by channel."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from ideal import mean_of

from imu_calib.common.rotations import rotation
from imu_calib.common.stream import Floats
from imu_calib.segmentation.segmented import Move, VelocitySteps
from imu_calib.segmentation.segments import Segment, Statistics, Timing, Turn

WALK = np.arange(1.0, 7.0)
MEAN = np.array([0.1, -0.2, 0.3, 1.0, -2.0, 9.0])
LEANING = rotation(np.array([0.6, 0.0, 0.8]), 0.7)


def statistics(**more: Any) -> Statistics:
    return replace(
        mean_of(MEAN, 20.0),
        quantisation_variance=np.arange(1.0, 7.0),
        end_points=2 * MEAN,
        blocks=tuple(np.array([[c, 0.5, 0.25, 5.0]]) for c in range(1, 7)),
        **more,
    )


def pace(period: float, std: float) -> Any:
    return SimpleNamespace(combined=lambda _: (period, std))


def own(walk: Floats = WALK, time_error: float = 0.0) -> list[float]:
    """Of each channel: noise over 20 s, rounding, and the clock."""
    return [walk[c] ** 2 / 20.0 + (c + 1) + (time_error * MEAN[c]) ** 2 for c in range(6)]


# Statistics


def test_a_variance_is_noise_rounding_and_the_clock():
    assert statistics().variance(WALK) == pytest.approx(own())
    assert statistics(time_error=0.01).variance(WALK) == pytest.approx(own(time_error=0.01))


def test_a_scale_goes_on_the_mean_and_on_what_rounding_leaves():
    factors = np.array([2.0, 1.0, 3.0, 0.5, 1.0, -1.0])
    found = statistics().scaled(factors)
    assert found.mean == pytest.approx([factors[c] * MEAN[c] for c in range(6)])
    wanted = [factors[c] ** 2 * (c + 1) for c in range(6)]
    assert found.quantisation_variance == pytest.approx(wanted)
    assert found.walk_gain.tolist() == [1 / 20] * 6
    assert found.duration == 20.0


def test_another_interval_makes_rates_larger_and_times_shorter():
    timed = statistics(timing=Timing(0.01, 0.011, 1e-6))
    found = timed.retimed(pace(0.008, 4e-6))
    assert found.duration == pytest.approx(20.0 * 0.8)
    assert found.mean == pytest.approx(MEAN / 0.8)
    assert found.end_points == pytest.approx(2 * MEAN / 0.8)
    for c, block in enumerate(found.blocks):
        assert block.tolist() == [[pytest.approx((c + 1) / 0.8), 0.5, 0.25, 5.0]]
    assert found.time_error == pytest.approx(4e-6 / 0.008)
    assert found.timing == Timing(0.008, 0.011, 1e-6)
    # Nothing tells the interval, or nobody asked.
    assert timed.retimed(pace(0.008, float('inf'))) is timed
    assert statistics().retimed(pace(0.008, 4e-6)).duration == 20.0


# Rests


def test_what_encoders_do_not_tell_leans_the_force():
    rest = Segment(0, 1, statistics(), LEANING, attitude_error=0.1)
    wanted = [(9.8 * 0.1) ** 2 * (1 - LEANING[2, axis] ** 2) for axis in range(3)]
    assert rest.encoder_variance(9.8) == pytest.approx([0.0, 0.0, 0.0, *wanted])
    total = [a + b for a, b in zip(own(), [0.0, 0.0, 0.0, *wanted], strict=True)]
    assert rest.variance(WALK, 9.8) == pytest.approx(total)
    for other in (replace(rest, attitude=None), replace(rest, attitude_error=0.0)):
        assert other.encoder_variance(9.8).tolist() == [0.0] * 6
        assert other.variance(WALK, 9.8) == pytest.approx(own())


# Turns

UP = np.array([0.48, -0.6, 0.64])


def turn(**more: Any) -> Turn:
    return Turn(0, 1, statistics(), -12.0, 4.0, UP, level_share=0.5, up_error=0.1, **more)


def test_what_lies_across_the_axis_of_a_turn_counts():
    assert turn().rate() == -3.0
    wanted = [(0.1 * 3.0) ** 2 * (1 - u * u) for u in UP]
    assert turn().encoder_variance() == pytest.approx(wanted)


def test_a_leaning_axis_shows_in_the_force():
    wanted = [(0.1 * 9.8) ** 2 * (1 - u * u) for u in UP]
    assert turn().lean_variance(9.8) == pytest.approx(wanted)


def test_without_a_table_the_clock_of_the_unit_counts():
    assert replace(turn(), seconds=None).rate() == pytest.approx(-12.0 / 20.0)


def test_a_turn_is_retimed_in_all_its_parts():
    timed = statistics(timing=Timing(0.01, 0.01, 1e-6))
    whole = replace(turn(), statistics=timed, skewed=timed, each=np.ones((2, 4)))
    found = whole.retimed(pace(0.008, 4e-6))
    assert found.statistics.duration == pytest.approx(16.0)
    assert found.skewed.duration == pytest.approx(16.0)
    assert found.each is not None
    assert found.each == pytest.approx(np.full((2, 4), 1.25))
    alone = replace(turn(), statistics=timed).retimed(pace(0.008, 4e-6))
    assert (alone.skewed, alone.each) == (None, None)
    assert alone.seconds == 4.0


# Moves


def move(**more: Any) -> Move:
    turned = np.array([[0.1, -0.4, 0.0], [0.2, 0.3, -0.1]])
    return Move(0, 1, turned, np.array([0.5, 0.25]), np.array([1e-5, 2e-5, 3e-5]), 1e-9, **more)


def test_a_move_is_as_long_as_its_steps_and_as_fast_as_the_fastest():
    assert move().duration == 0.75
    assert move().fastest == pytest.approx(0.3 / 0.25)
    empty = replace(move(), turned=np.empty((0, 3)), seconds=np.empty(0))
    assert (empty.duration, empty.fastest) == (0.0, 0.0)


def test_a_scale_goes_on_each_triad_of_a_move():
    gained = VelocitySteps(np.full((2, 3), 2.0), np.full((2, 3), 0.1), np.full(3, 1e-3), 1e-8)
    factors = np.array([2.0, 3.0, 4.0, 5.0, 6.0, 7.0])
    found = move(velocity_steps=gained).scaled(factors)
    assert found.turned.tolist() == [
        [0.2, pytest.approx(-1.2), 0.0],
        [0.4, pytest.approx(0.9), -0.4],
    ]
    assert found.pulse == pytest.approx([2e-5, 6e-5, 12e-5])
    assert found.seconds.tolist() == [0.5, 0.25]
    steps = found.velocity_steps
    assert steps.velocity.tolist() == [[10.0, 12.0, 14.0]] * 2
    assert steps.mean == pytest.approx(np.array([[0.2, 0.3, 0.4]] * 2))
    assert steps.pulse == pytest.approx([5e-3, 6e-3, 7e-3])
    assert steps.filled == 1e-8
    assert move().scaled(factors).velocity_steps is None
