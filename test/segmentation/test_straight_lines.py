"""Plateaus by lines through encoder angles: each figure of a line against sums over its angles."""

from dataclasses import replace
from math import sqrt
from typing import Any

import numpy as np
import pytest

from imu_calib.common.stream import Floats
from imu_calib.common.units import DEG
from imu_calib.segmentation.plateaus import (
    Line,
    Plateau,
    _bends,
    _half_turns,
    _seeds,
    _step,
    _trimmed,
    _variance,
    _whole_turns,
    encoder_step,
    find_plateaus,
    find_turns,
    hidden_by_steps,
    no_turn_reason,
)
from imu_calib.segmentation.table_motion import Motion

LEAST = 1e-3 * DEG
"""Departure that counts at least, rad."""


# A line


def test_a_line_is_the_one_of_least_squares():
    time, angle = np.array([1.0, 2.0, 4.0, 5.0]), np.array([10.0, 13.0, 17.0, 20.0])
    # About 3 s and 15 rad: -2, -1, 1, 2 s and -5, -2, 2, 5 rad; 24 rad s over 10 s^2.
    line = Line.through(time, angle, 0.0)
    assert (line.count, line.time, line.spread, line.angle) == (4, 3.0, 10.0, 15.0)
    assert line.slope == pytest.approx(2.4)
    # It leaves -0.2, 0.4, -0.4, 0.2, of which two degrees of freedom remain.
    assert line.noise == pytest.approx(sqrt(0.4 / 2))
    assert line.slope_std == pytest.approx(sqrt(0.4 / 2 / 10))


def test_two_angles_leave_nothing():
    line = Line.through(np.array([0.0, 2.0]), np.array([1.0, 2.0]), 0.0)
    assert (line.slope, line.noise, line.slope_std, line.smoothed) == (0.5, 0.0, 0.0, 1)


def zigzag(count: int, hz: float, noise: float) -> tuple[Floats, Floats]:
    """Angles that stand, to and fro: their scatter is `noise` to a part in their number."""
    return np.arange(count) / hz, noise * np.tile([1.0, -1.0], count // 2)


@pytest.mark.parametrize(
    ('hz', 'departures', 'step', 'smoothed'),
    [
        # So many that six times the noise of their mean is what counts, within 0.1 s.
        (1000.0, 0.1, 0.0, 1),
        (1000.0, 0.5, 0.0, 9),
        (1000.0, 1.0, 0.0, 36),
        (1000.0, 1.0, 2 * LEAST, 9),
        (1000.0, 1.0, LEAST / 2, 36),
        (1000.0, 3.0, 0.0, 100),
        (100.0, 3.0, 0.0, 10),
        (5.0, 3.0, 0.0, 1),
    ],
)
def test_departures_are_averaged_until_the_noise_is_small(hz, departures, step, smoothed):
    line = Line.through(*zigzag(10_000, hz, 1.0001 * departures * LEAST), step)
    assert line.smoothed == smoothed


def hidden(time: Floats, angle: Floats, step: float) -> float:
    return hidden_by_steps(Line.through(time, angle, step), time, angle)


def test_readings_in_time_with_the_steps_hide_a_slope_of_a_step_over_them():
    """They scatter by nothing, and any line within half a step of them may be the true one."""
    time, step = np.arange(1001) / 100.0, 1e-3
    assert hidden(time, 20 * step * time, step) == pytest.approx(step / 10 / sqrt(6))
    # One step more half way: least squares lie 1.5 steps over all beyond slopes of 0 to 2.
    jumped = 20 * step * time + step * (time > 5)
    assert hidden(time, jumped, step) == pytest.approx(step / 10 * sqrt(0.25 + 4 / 24), rel=0.01)
    # Where readings scatter by more than steps do nothing is hidden, nor without steps.
    assert hidden(*zigzag(1000, 100.0, 0.6 * step), step) == 0.0
    assert hidden(time, time, 0.0) == 0.0


@pytest.mark.parametrize('step', [0.005, 0.05, 360 / 2**12])
def test_the_rate_by_coarse_angles_is_as_far_off_as_is_said(step):
    """At 100 Hz 10, 30 and 60 deg/s are 2, 6 and 12 steps of 0.05 deg, but for 10 ppm."""
    rng = np.random.default_rng(20)
    off = []
    for rate in 10 * [10.0, 30.0, 60.0]:
        true = rate * (1 + 1e-5 * rng.uniform(-1, 1))
        motion = trapezoid(true, 0.4, 40.0)
        at = motion.position / DEG + step * rng.random()
        coarse = replace(motion, position=np.round(at / step) * step * DEG)
        # Where a step comes after long without any the line may end.
        plateau = max(find_plateaus(coarse), key=lambda p: p.turned)
        off.append((plateau.rate / DEG - true) / (plateau.rate_std / DEG))
    # Thirty squares of mean one scatter by a quarter; far less is lost by allowing for all phases.
    assert np.mean(np.square(off)) < 1.8
    assert np.max(np.abs(off)) < 4


LINE = Line(9, 10.0, 50.0, 1.0, 0.5, 0.0, 0.0, 2e-3, 1)


@pytest.mark.parametrize(('step', 'least'), [(0.0, LEAST), (LEAST / 2, LEAST), (1e-3, 1e-3)])
@pytest.mark.parametrize('smoothed', [1, 4])
def test_what_may_lie_off_by_chance_is_six_deviations_and_a_step(step, least, smoothed):
    line = replace(LINE, step=step, smoothed=smoothed)
    found = line.limit(np.array([10.0, 15.0]))
    # Noise of the angles, of the line's level, and of its slope 5 s away.
    here, there = 1 / smoothed + 1 / 9, 1 / smoothed + 1 / 9 + 25 / 50
    assert found == pytest.approx([0.012 * sqrt(part) + least for part in (here, there)])


def test_a_departure_is_counted_in_limits():
    time = np.array([8.0, 10.0, 12.0, 14.0])
    off = np.array([0.03, -0.02, 0.0, 0.08])
    found = LINE.departure(time, 1.0 + 0.5 * (time - 10.0) + off)
    assert found == pytest.approx(np.abs(off) / LINE.limit(time))
    # The mean of three, of two at either end.
    three = replace(LINE, smoothed=3)
    means = np.array([0.01 / 2, 0.01 / 3, 0.06 / 3, 0.08 / 2])
    found = three.departure(time, 1.0 + 0.5 * (time - 10.0) + off)
    assert found == pytest.approx(means / three.limit(time))


def test_angles_whose_blocks_scatter_together_count_by_their_blocks():
    # 16 blocks of 10: to and fro by 1 within, and their means to and fro by `common`.
    def common_residuals(common, count=165):
        return np.resize([1.0, -1.0], count) + common * np.resize([1.0] * 10 + [-1.0] * 10, count)

    # Ten times the mean square of 16 means, over 14 degrees of freedom.
    assert _variance(common_residuals(1.0), 1.0) == pytest.approx(10 * 16 / 14)
    # The chance of chi-square of 14 above 36.12 is a thousandth.
    limit = sqrt(36.12 / 160)
    assert _variance(common_residuals(limit * 1.001), 1.0) == pytest.approx(36.12 / 14, rel=3e-3)
    assert _variance(common_residuals(limit * 0.999), 1.0) == 1.0
    assert _variance(common_residuals(limit * 0.999), 0.9) > 2.5
    # Two in a block at least, and noise at all.
    assert _variance(np.full(31, 3.0), 1.0) == 1.0
    assert _variance(np.full(32, 3.0), 1.0) == pytest.approx(2 * 9 * 16 / 14)
    assert _variance(np.full(32, 3.0), 0.0) == 0.0


# The step of an encoder


@pytest.mark.parametrize(
    ('angles', 'step'),
    [
        # Whole steps of 0.005 deg; six differences are enough, five are not.
        ([0, 1, 2, 4, 7, 8, 10], 1.0),
        ([0, 1, 2, 4, 7, 8], 0.0),
        # The least difference may be two or three steps.
        ([0, 2, 5, 7, 10, 12, 15], 1.0),
        ([0, 3, 7, 10, 14, 17, 21], 1.0),
        ([0, 4, 9, 13, 18, 22, 27], 0.0),
        # Within a tenth of a step.
        ([0, 1, 2, 4.09, 7, 8, 10], 1.0),
        ([0, 1, 2, 4.2, 7, 8, 10], 0.0),
        # Twenty times the least is not held against steps.
        ([0, 1, 2, 4, 7, 8, 10, 31.5], 1.0),
        ([0, 1, 2, 4, 7, 8, 10, 29.25], 0.0),
        # The same reading again.
        ([0, 1, 1 + 1e-5, 2, 4, 7, 8, 10], 1.0),
        ([0, 1, 1 + 1.3e-5, 2, 4, 7, 8, 10], 0.0),
    ],
)
def test_the_step_of_an_encoder_is_what_close_readings_differ_by(angles, step):
    found = _step(0.005 * DEG * np.array(angles)[::-1])
    assert found == pytest.approx(0.005 * DEG * step, rel=2e-5)


def test_angles_that_are_far_apart_or_alike_have_no_step():
    assert _step(0.19 * DEG * np.arange(9)) == pytest.approx(0.19 * DEG)
    assert _step(0.21 * DEG * np.arange(9)) == 0.0
    assert _step(np.zeros(9)) == 0.0
    assert _step(np.zeros(0)) == 0.0


def ramped(
    rate: float, ramps: float, hz: float, phase: float, step: float
) -> tuple[Floats, Floats]:
    """Angles of a turn in steps, deg; none if 0. The table begins so far between two readings."""
    up = rate / ramps
    time = (np.arange(-0.3, 2 * up + 372 / rate + 0.3, 1 / hz)) + phase / hz
    speed = [0.0, rate, rate, 0.0]
    knots = [0.0, up, up + 372 / rate, 2 * up + 372 / rate]
    # The integral of a rate that is linear between its knots.
    fine = np.union1d(time, knots)
    at = np.interp(fine, knots, speed)
    angle = np.append(0.0, np.cumsum(np.diff(fine) * (at[1:] + at[:-1]) / 2))
    angle = angle[np.searchsorted(fine, time)]
    return time, (np.rint(angle / step + 0.3) * step if step else angle) * DEG


@pytest.mark.parametrize('lost', [0, 7])
@pytest.mark.parametrize('phase', [0.0, 0.002, 0.1, 0.5, 0.8, 0.998])
@pytest.mark.parametrize(('rate', 'ramps'), [(60, 100), (60, 200), (60, 50), (20, 20), (80, 200)])
def test_round_ramps_are_no_steps_of_an_encoder(rate, ramps, phase, lost):
    """At 100 Hz ramps of 200 deg/s^2 gain 0.02 deg more each time: 0.01, 0.03, 0.05."""
    time, angle = ramped(rate, ramps, 100.0, phase, 0.0)
    kept = np.ones(len(time), dtype=bool)
    kept[np.linspace(40, len(time) - 40, lost, dtype=int)] = False
    assert encoder_step(time[kept], angle[kept]) == 0.0


def test_readings_of_a_rate_alone_have_no_step():
    """One that sets in between two of them: all differ alike."""
    angle = np.clip(0.05 * DEG * (np.arange(900) - 100), 0, 30 * DEG)
    assert encoder_step(np.arange(900) / 100, angle) == 0.0
    assert _step(angle) == pytest.approx(0.05 * DEG)


def test_round_ramps_look_coarse():
    """So that the test above means something: what close readings differ by is no proof."""
    assert _step(ramped(60, 200, 100.0, 0.998, 0.0)[1]) == pytest.approx(0.01 * DEG, rel=0.01)


@pytest.mark.parametrize('step', [0.01, 0.02, 0.05, 0.1])
@pytest.mark.parametrize('phase', [0.1, 0.33, 0.8])
@pytest.mark.parametrize(
    ('rate', 'ramps', 'hz'),
    [(60, 100, 100), (10, 100, 100), (5, 20, 50), (90, 20, 50), (60, 400, 500)],
)
def test_steps_of_an_encoder_show_where_the_table_speeds_up(rate, ramps, hz, phase, step):
    """At the rate itself readings may be as many whole steps apart, one like the other."""
    time, angle = ramped(rate, ramps, hz, phase, step)
    assert encoder_step(time, angle) == pytest.approx(step * DEG, rel=1e-9)
    # Radians of so many digits as keep a thousandth of a step.
    digits = 6 if step >= 0.05 else 7
    assert encoder_step(time, np.round(angle, digits)) == pytest.approx(step * DEG, rel=0.01)


# Half turns


def test_half_a_turn_is_looked_at_from_150_instants():
    # A degree each: half a turn is 180 of them, from as many places as there are.
    few = _half_turns(np.arange(301.0) * DEG * (1 + 1e-9))
    first = np.unique((np.arange(150) * 300 / 149).astype(int))
    assert few[:, 0].tolist() == [k for k in first if k + 180 <= 300]
    assert (few[:, 1] - few[:, 0]).tolist() == [180] * len(few)
    # The other way round, too.
    assert _half_turns(-np.arange(301.0) * DEG * (1 + 1e-9)).tolist() == few.tolist()


def test_where_angles_come_slowly_it_is_six_of_them():
    found = _half_turns(np.arange(9.0) * 90.0 * DEG)
    assert found.tolist() == [[0, 6], [1, 7], [2, 8], [3, 9]]
    assert _half_turns(np.zeros(50)).shape == (0, 2)
    assert _half_turns(np.arange(50) * DEG).shape == (0, 2)


def legendre(x: Floats) -> Floats:
    return np.column_stack([x**0, x, (3 * x**2 - 1) / 2, (5 * x**3 - 3 * x) / 2])


def test_a_bend_is_what_a_square_and_a_cube_have():
    # Nine angles in as many cells, at times from 5 to 7 s; both parts of a polynomial.
    x = np.linspace(-1.0, 1.0, 9)
    angle = legendre(x) @ [3.0, 1.6, 0.03, 0.04]
    scatter = np.random.default_rng(3).normal(0, 1e-3, 9)
    time = np.concatenate([np.zeros(2), 6 + x])
    ranges = np.array([[2, 11]])
    clean, least = _bends(time, np.append([7.0, 9.0], angle), ranges, 9)
    assert clean == pytest.approx([0.05])
    assert least == pytest.approx([1e-4 * np.pi])
    noisy, limit = _bends(time, np.append([7.0, 9.0], angle + scatter), ranges, 9)
    design = legendre(x)
    found = np.linalg.solve(design.T @ design, design.T @ (angle + scatter))
    residuals = angle + scatter - design @ found
    variances = np.diag(np.linalg.inv(design.T @ design))
    assert noisy == pytest.approx([np.hypot(found[2], found[3])])
    # Nine less four degrees of freedom.
    std = sqrt(residuals @ residuals / 5) * sqrt(variances[2] + variances[3])
    assert limit == pytest.approx([5 * std + 1e-4 * np.pi])


def test_angles_are_averaged_in_cells():
    # 20 angles in 8 cells, which begin at 0, 2, 5, 7, 10, 12, 15 and 17 of them.
    rng = np.random.default_rng(4)
    time, angle = np.arange(30.0) + rng.uniform(0, 0.5, 30), rng.uniform(0, 1, 30)
    edges = [0, 2, 5, 7, 10, 12, 15, 17, 20]
    both = []
    for begin in (3, 10):
        means = [
            np.array([v[begin + a : begin + b].mean() for a, b in zip(edges, edges[1:])])  # noqa: B905, RUF007
            for v in (time, angle)
        ]
        both.append(_bends(*means, np.array([[0, 8]]), 8))
    found = _bends(time, angle, np.array([[3, 23], [10, 30]]), 8)
    assert found[0] == pytest.approx([both[0][0][0], both[1][0][0]])
    assert found[1] == pytest.approx([both[0][1][0], both[1][1][0]])


def test_straight_half_turns_come_first_the_straightest_before_all():
    # A degree at each instant, then slower and slower: the straight ones are listed by their bend.
    time = np.arange(400.0)
    angle = (time - np.where(time > 200, (time - 200) ** 2 / 1e3, 0.0)) * DEG
    found = _seeds(time, angle)
    assert found
    bends = [float(_bends(time, angle, np.array([seed]), 64)[0][0]) for seed in found]
    assert bends == sorted(bends)
    # Of those before the bend all, of those behind it none.
    assert {(k, k + 180) for k in range(20)} & {tuple(r) for r in _half_turns(angle).tolist()} <= {
        *found
    }
    assert all(first < 200 for first, _ in found)


# Plateaus


def trapezoid(rate: float, ramp: float, steady: float, hz: float = 100.0) -> Motion:
    """Two seconds at rest, `ramp` s to `rate` (deg/s), `steady` s at it, and to rest again."""
    time = np.arange(0.0, 4.0 + 2 * ramp + steady, 1 / hz)
    speed = rate * np.interp(
        time, [2, 2 + ramp, 2 + ramp + steady, 2 + 2 * ramp + steady], [0, 1, 1, 0]
    )
    angle = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2 / hz)]) * DEG
    stamp = np.rint(time * 1e9).astype(np.int64) + 10**18
    return Motion(0, 0, stamp, np.column_stack([0.1 * angle, angle]))


def test_a_plateau_is_cut_where_a_ramp_would_not_show():
    motion = trapezoid(30.0, 1.5, 20.0)
    (found,) = find_plateaus(motion)
    assert found.rate == pytest.approx(30.0 * DEG, rel=1e-7)
    # A ramp of 20 deg/s^2 is off by 10 t^2 deg: by 0.001 deg after 0.01 s, by eight times as much
    # after 0.028 s; as far back as from one to the other it is sure.
    assert found.start == pytest.approx(3.5, abs=0.04)
    assert found.end == pytest.approx(23.5, abs=0.04)
    assert LEAST <= found.unseen < 1.3 * LEAST
    assert 0 <= found.before <= 0.04
    assert 0 <= found.after <= 0.04
    assert found.turned == pytest.approx(
        found.rate * (found.end - found.start + found.before + found.after)
    )


def test_what_leaves_a_line_is_cut_back_as_far_as_from_there_to_eight_limits():
    # Off a line of rate 1 by more than one limit up to 4 s, and by more than eight up to 3 s;
    # likewise from 16 s on and from 18 s on.
    time = np.arange(0.0, 20.25, 0.5)
    off = np.select([time <= 3, time <= 4, time < 16, time < 18], [9.5, 2.0, 0.0, 2.0], 9.5)
    line = replace(LINE, count=1000, time=10.0, spread=1e9, angle=10.0, slope=1.0, noise=0.0)
    angle = time + off * LEAST
    first, last = int(np.searchsorted(time, 4.5)), int(np.searchsorted(time, 16.0))
    found = _trimmed(line, time, angle, first, last)
    # From 4.5 s 1.5 s back to 3 s, from 15.5 s 2.5 s on to 18 s.
    assert (found.before, found.after) == (1.5, 2.5)
    assert (found.start, found.end) == (6.0, 13.0)
    assert found.rate == pytest.approx(1.0)
    assert found.unseen == pytest.approx(LEAST)
    # No more than a quarter of it, where nothing near is so far off.
    near = _trimmed(line, time, time, first, last)
    assert (near.before, near.after) == (11 / 4, 11 / 4)
    # Six angles at least are left of it.
    for count, told in ((10, False), (11, False), (12, True)):
        assert (_trimmed(line, time, time, 8, 8 + count) is not None) is told


@pytest.mark.parametrize('sense', [1, -1])
def test_turns_lie_in_the_middle_of_what_is_sure(sense):
    plateau = Plateau(4.0, 25.0, sense * 40 * DEG, 1e-6 * DEG, 0.5, 0.25, 1e-5)
    found = _whole_turns(plateau, 2, 7e9)
    # 21 s at 40 deg/s are 840 deg: two turns of 9 s each, 1.5 s after it begins.
    assert found.joint == 2
    assert found.start == pytest.approx(12.5e9, abs=1.0)
    assert found.seconds == pytest.approx(18.0)
    assert found.angle == pytest.approx(sense * 4 * np.pi)
    assert found.rate_error == pytest.approx(1e-6 / 40)
    # Four fifths of the time beside them, less what clocks may be apart by.
    assert found.spare == pytest.approx(0.8 * 1.5 - 0.05)


def test_a_turn_that_fits_only_with_what_may_be_hidden_counts_by_it():
    plateau = Plateau(4.0, 12.4, 40 * DEG, 3e-6 * DEG, 0.6, 0.4, 1e-4)
    found = _whole_turns(plateau, 0, 0.0)
    # 8.4 of the 9 s: 0.6 of the second beside it, which is hidden by the square of that.
    assert found.seconds == pytest.approx(9.0)
    assert found.start == pytest.approx((4.0 - 0.6 * 0.6) * 1e9)
    hidden = 2 * 1e-4 * 0.6**2 / (2 * np.pi)
    assert found.rate_error == pytest.approx(np.hypot(3e-6 / 40, hidden))
    assert found.spare == 0.0
    # Beyond all that shows no departure there is none.
    assert _whole_turns(replace(plateau, end=11.9), 0, 0.0) is None


# Motions


def test_turns_are_those_of_the_joint_that_turns_most():
    motion = trapezoid(40.0, 1.0, 20.0)
    (found,) = find_turns(motion)
    assert (found.joint, found.angle) == (1, pytest.approx(4 * np.pi))
    assert found.start == pytest.approx(1e18 + 4e9, abs=5e7)
    swapped = replace(motion, position=-motion.position[:, ::-1])
    (other,) = find_turns(swapped)
    assert (other.joint, other.angle) == (0, pytest.approx(-4 * np.pi))
    assert find_turns(replace(motion, stamp=motion.stamp[:0], position=motion.position[:0])) == []


def test_a_plateau_may_fill_the_motion():
    whole = trapezoid(40.0, 1.0, 20.0)
    within = slice(310, 2290)
    found = find_plateaus(
        replace(whole, stamp=whole.stamp[within], position=whole.position[within])
    )
    assert [plateau.rate for plateau in found] == pytest.approx([40.0 * DEG])
    # Nothing is off the line: nothing is cut away from it.
    (plateau,) = found
    assert (plateau.start, plateau.end) == (0.0, pytest.approx(19.79))
    assert (plateau.before, plateau.after) == (0.0, 0.0)


def joined(*motions: Motion) -> Motion:
    """One after the other, each from where the one before has ended."""
    stamp: list[Any] = [motions[0].stamp]
    position: list[Any] = [motions[0].position]
    for motion in motions[1:]:
        stamp.append(motion.stamp - motion.stamp[0] + stamp[-1][-1] + 10_000_000)
        position.append(motion.position + position[-1][-1])
    return Motion(0, 0, np.concatenate(stamp), np.vstack(position))


def test_plateaus_are_listed_as_they_follow_each_other():
    both = joined(trapezoid(20.0, 1.0, 20.0), trapezoid(-60.0, 1.0, 8.0))
    rates = [plateau.rate / DEG for plateau in find_plateaus(both)]
    assert rates == pytest.approx([20.0, -60.0], rel=1e-6)


def test_a_motion_without_a_turn_says_what_it_shows():
    assert no_turn_reason(trapezoid(40.0, 5.0, 0.0)) == 'the joint states show no constant rate'
    # Of two plateaus the one that turned further, however short it was: 250 deg and what of its
    # ramps cannot be told from it.
    two = joined(trapezoid(-50.0, 0.5, 5.0), trapezoid(20.0, 0.5, 10.0))
    longest = max(plateau.turned for plateau in find_plateaus(two)) / DEG
    assert longest == pytest.approx(250.0, abs=4.0)
    assert no_turn_reason(two) == (
        f'the joint states show 50 deg/s for {longest:.0f} deg, less than a whole turn: the '
        'rest is ramps (run more turns, a slower rate or faster ramps)'
    )
