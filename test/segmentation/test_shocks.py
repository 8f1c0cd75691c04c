"""What a shock left: turns that go one way, tilts that accelerometers see, by sums over windows."""

from __future__ import annotations

from math import sqrt

import numpy as np
import pytest

from imu_calib.common.stream import Floats
from imu_calib.segmentation.dwells import ShiftingDisturbance, _Means, _one_way

NONE = np.zeros(3)


# To and fro, or one way


def shaken(count: int, size: float, turned: float, drift: float = 0.0) -> tuple[Floats, Floats]:
    """Samples to and fro by a size about a turn and a drift, gyro by gyro alike; their sum."""
    rows = np.resize([size, -size], count) + (turned + drift) / count
    return np.tile(rows[:, None], 3), np.full(3, rows.sum())


@pytest.mark.parametrize('drift', [0.0, 0.7])
def test_a_turn_stands_out_of_the_root_of_squares_by_five(drift: float) -> None:
    # A hundred samples of 0.01 and of a hundredth of the turn: the squares are 0.01 + t^2 / 100.
    limit = sqrt(25 * 0.01 / (1 - 25 / 100))
    for factor, one_way in ((0.99, False), (1.01, True), (-0.99, False), (-1.01, True)):
        samples, total = shaken(100, 0.01, factor * limit, drift)
        turned = np.full(3, factor * limit)
        assert _one_way(samples, total, turned, NONE).tolist() == [one_way] * 3


def test_gyros_are_judged_each_by_itself() -> None:
    samples, total = shaken(100, 0.01, 0.4)
    samples[:, 1] = 0.004
    total[1] = 0.4
    assert _one_way(samples, total, np.full(3, 0.4), NONE).tolist() == [False, True, False]


@pytest.mark.parametrize(('count', 'told'), [(24, True), (26, False)])
def test_fewer_than_25_samples_of_one_size_tell_nothing(count: int, told: bool) -> None:
    samples, total = shaken(count, 0.01, 0.0)
    assert _one_way(samples, total, NONE, NONE).all() == told


def test_a_counter_may_flip_by_half_a_pulse_about_its_mean() -> None:
    # 100 samples of 0.01 beyond the flips of 0.02, of which a quarter of a square is each one's.
    samples, total = shaken(100, sqrt(0.01**2 + 0.02**2), 0.0)
    pulses = np.array([0.04, 0.0, 0.08])
    limit = 5 * sqrt(100) * 0.01
    for factor, first in ((0.98, False), (1.02, True)):
        # What turned is not in the samples: only its size counts.
        turned = np.full(3, factor * limit)
        found = _one_way(samples, total + turned, turned, pulses)
        assert found.tolist() == [first, False, True]


# Tilts


def windows(before: Floats, after: Floats, count: int = 12) -> Floats:
    """Sums of windows, as many with one force as with another; no gyro sees anything."""
    sums = np.zeros((2 * count, 6))
    sums[:count, 3:], sums[count:, 3:] = before, after
    return sums


def means(sums: Floats, scatter: Floats | None = None) -> _Means:
    scatter = np.full(6, 1e-3) if scatter is None else scatter
    return _Means(sums, sums - sums.mean(axis=0), scatter, np.zeros(6))


FORCE = np.array([3.0, 0.0, 4.0])
TURNED = np.array([0.01, 0.02, -0.01])


def tilted(share: float, scatter: Floats | None = None, count: int = 12) -> bool | None:
    """A turn that takes f to f - a x f, of which accelerometers see a share."""
    change = -np.array([0.02 * 4.0, -0.01 * 3.0 - 0.01 * 4.0, -0.02 * 3.0])
    sums = windows(FORCE, FORCE + share * change, count)
    # What is not sound has no say.
    bad = np.zeros(len(sums), bool)
    bad[[2, count + 3]] = True
    sums[bad, 3:] = 99.0
    before, after = slice(1, count), slice(count, 2 * count)
    return means(sums, scatter)._tilted(TURNED, bad, before, after)


def test_half_of_a_tilt_is_seen_at_least() -> None:
    shares = [0.49, 0.51, 1.0, 0.0, -1.0]
    assert [tilted(share) for share in shares] == [False, True, True, False, False]


def test_a_tilt_is_told_from_five_deviations_on() -> None:
    # -a x f, of size (0.08^2 + 0.07^2 + 0.06^2)^(1/2).
    change = np.array([-0.08, 0.07, 0.06])
    size = sqrt(change @ change)
    # Ten windows before and eleven after; of each channel what lies along the tilt.
    of_one = np.array([1.0, 2.0, 0.5])
    along = sqrt(((change / size * of_one) ** 2).sum()) * sqrt(1 / 10 + 1 / 11)
    for factor, told in ((0.99, True), (1.01, None)):
        scatter = np.append(np.full(3, 9.0), factor * size / (5 * along) * of_one)
        assert tilted(1.0, scatter) is told


@pytest.mark.parametrize(('count', 'told'), [(5, None), (6, True)])
def test_four_sound_windows_on_either_side_tell_a_tilt(count: int, told: bool | None) -> None:
    assert tilted(1.0, None, count) is told


def test_what_no_accelerometer_sees_is_about_up() -> None:
    sums = windows(FORCE, FORCE)
    sums[3, 3:] = -99.0
    # Up is (0.6, 0, 0.8): of the turn 0.6 * 0.01 - 0.8 * 0.01.
    found = means(sums)._about_up(TURNED)
    assert found == pytest.approx(-0.002 * np.array([0.6, 0.0, 0.8]))


# Which run of windows


def shift(
    turns: dict[int, Floats], tilt: float = 0.0, floor: float = 0.0, scatter: float = 1e-4
) -> ShiftingDisturbance | None:
    """Of 40 windows of 10 samples those that turn are not sound; accelerometers see 1 m/s^2 up."""
    sums = np.zeros((40, 6))
    sums[:, 5] = 1.0
    last = max(turns)
    sums[last + 1 :, 3] += tilt
    for window, turned in turns.items():
        sums[window, :3] = turned
    bad = np.isin(np.arange(40), list(turns))
    left = sums.copy()
    left[:, 3:] = 0.0
    samples = np.repeat(sums[:, None, :] / 10, 10, axis=1)
    held = _Means(sums, left, np.full(6, scatter), np.zeros(6))
    return held.mount_shift(bad, 1, 38, np.full(6, floor), samples, np.zeros(6))


ABOUT_UP = np.array([0.0, 0.0, 0.01])


def test_the_first_run_that_turned_the_unit_is_it() -> None:
    assert shift({10: ABOUT_UP, 11: ABOUT_UP}) == ShiftingDisturbance(100, 120, 0.02)
    # One sound window between is of the run, two are not.
    assert shift({10: ABOUT_UP, 12: ABOUT_UP}) == ShiftingDisturbance(100, 130, 0.02)
    assert shift({10: ABOUT_UP, 13: ABOUT_UP}) == ShiftingDisturbance(100, 110, 0.01)
    # There and back again is none, and the next one is asked.
    back = {10: ABOUT_UP, 11: -ABOUT_UP, 20: -ABOUT_UP}
    assert shift(back) == ShiftingDisturbance(200, 210, 0.01)
    # Of what is cut at the ends nothing is asked.
    assert shift({0: ABOUT_UP, 38: ABOUT_UP, 20: 0.0 * ABOUT_UP}) is None
    assert shift({1: ABOUT_UP}) == ShiftingDisturbance(10, 20, 0.01)
    assert shift({37: ABOUT_UP}) == ShiftingDisturbance(370, 380, 0.01)


def test_of_a_turn_without_its_tilt_what_is_about_up_counts() -> None:
    both = np.array([0.0, 0.04, 0.03])
    # a x f is (0.04, 0, 0): the force tilts by -0.04 along x.
    whole = shift({20: both}, -0.04)
    assert whole is not None
    assert whole.angle == pytest.approx(0.05)
    part = shift({20: both}, 0.0)
    assert part is not None
    assert part.angle == pytest.approx(0.03)


def test_a_shift_passes_five_deviations_of_its_windows_and_the_floor() -> None:
    # Two windows of 0.01: 5 * sqrt(2) of the scatter, and what rounding may do.
    for floor in (0.0, 0.004):
        limit = (0.02 - floor) / (5 * sqrt(2))
        two = {20: ABOUT_UP, 21: ABOUT_UP}
        assert shift(two, floor=floor, scatter=0.99 * limit) is not None
        assert shift(two, floor=floor, scatter=1.01 * limit) is None
