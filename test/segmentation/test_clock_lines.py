"""Offsets of two clocks by motions: lines with jumps, windows, and what gyros saw by cells."""

from collections.abc import Callable
from math import sqrt

import numpy as np
import pytest

from imu_calib.common.rotations import rotation
from imu_calib.common.stream import Floats
from imu_calib.common.units import DEG
from imu_calib.segmentation.clock import (
    ClockSample,
    MeasuredShare,
    _windows,
    clock_sample,
    fit_clock,
    measured_share,
)
from imu_calib.segmentation.statistics import Samples

START = 1_700_000_000_000_000_000


def motions(times: Floats, offsets: Floats) -> list[ClockSample]:
    """One after the other: at s after the start, offsets in s."""
    return [
        ClockSample(START + 1e9 * time, offset) for time, offset in zip(times, offsets, strict=True)
    ]


# A line through the offsets


TIMES = np.array([0.0, 50, 130, 200, 260, 350, 400, 470])
OFF = 1e-3 * np.array([0.3, -0.2, 0.1, 0.4, -0.3, 0.0, 0.2, -0.1])


def test_offsets_lie_on_a_line():
    found = fit_clock(motions(TIMES, 0.02 + 2e-5 * TIMES + OFF))
    # The stamps of today resolve 256 ns as doubles.
    assert found.epoch == pytest.approx(START + 1e9 * TIMES.mean(), abs=300)
    slope, level = np.polyfit(TIMES - TIMES.mean(), 0.02 + 2e-5 * TIMES + OFF, 1)
    residuals = OFF - np.polyval(np.polyfit(TIMES, OFF, 1), TIMES)
    scatter = sqrt(residuals @ residuals / 6)
    assert found.motions == 8
    assert found.offset == pytest.approx(level)
    assert found.offset_std == pytest.approx(scatter / sqrt(8), rel=1e-6)
    assert found.rate == pytest.approx(slope, rel=1e-6)
    spread = ((TIMES - TIMES.mean()) ** 2).sum()
    assert found.rate_std == pytest.approx(scatter / sqrt(spread), rel=1e-6)
    assert (found.jumps, found.least_jumps) == ((), ())


def test_where_offsets_jump_the_pieces_are_parallel():
    piece = np.array([0, 0, 0, 1, 1, 1, 2, 2])
    offsets = 0.02 + 2e-5 * TIMES + OFF + np.array([0.0, 0.5, 0.1])[piece]
    found = fit_clock(motions(TIMES, offsets))
    seconds = TIMES - TIMES.mean()
    design = np.column_stack([*(piece == k for k in range(3)), seconds]).astype(float)
    *levels, rate = np.linalg.solve(design.T @ design, design.T @ offsets)
    residuals = offsets - design @ [*levels, rate]
    scatter = sqrt(residuals @ residuals / (8 - 4))
    assert found.rate == pytest.approx(rate, rel=1e-6)
    assert found.offset == pytest.approx(offsets.mean())
    assert found.offset_std == pytest.approx(scatter / sqrt(8), rel=1e-5)
    covariance = scatter**2 * np.linalg.inv(design.T @ design)
    assert found.rate_std == pytest.approx(sqrt(covariance[3, 3]), rel=1e-5)
    assert found.jumps == pytest.approx(np.diff(levels))
    # Student's law with four degrees of freedom passes 8.610 in one case of a thousand.
    within = [
        8.6103 * sqrt(covariance[k, k] + covariance[k + 1, k + 1] - 2 * covariance[k, k + 1])
        for k in range(2)
    ]
    assert found.least_jumps == pytest.approx(np.abs(np.diff(levels)) - within, rel=1e-4)


def test_a_jump_that_may_be_none_is_zero_at_least():
    # An interruption parts the line where nothing jumps.
    found = fit_clock(motions(TIMES, 0.02 + OFF), [START + 230 * 10**9])
    (jump,) = found.jumps
    assert 0 < abs(jump) < 2e-3
    assert found.least_jumps == (0.0,)
    twice = fit_clock(motions(TIMES, 0.02 + OFF), [START + t * 10**9 for t in (100, 300)])
    assert len(twice.jumps) == 2
    assert fit_clock(motions(TIMES, 0.02 + OFF), [START - 1, START + 471 * 10**9]).jumps == ()


def test_as_many_motions_as_a_line_and_its_jumps_have_leave_no_rate():
    two = fit_clock(motions(TIMES[:2], np.array([0.01, 0.03])), [START + 20 * 10**9])
    assert (two.motions, two.rate) == (2, 0.0)
    assert np.isnan(two.rate_std)
    assert two.offset == pytest.approx(0.02)
    assert two.offset_std == pytest.approx(0.02 / sqrt(2) / sqrt(2))
    # The third stands alone behind an interruption: two are left.
    at = [START + 90 * 10**9]
    three = fit_clock(motions(TIMES[:3], np.array([0.01, 0.03, 0.05])), at)
    assert (three.motions, three.rate) == (2, 0.0)
    # Two pieces of two are three coefficients.
    assert fit_clock(motions(TIMES[:4], np.array([0.01, 0.03, 0.05, 0.06])), at).rate != 0.0
    assert fit_clock(motions(TIMES[:3], np.array([0.01, 0.011, 0.01]))).rate != 0.0
    assert fit_clock([]).motions == 0


@pytest.mark.parametrize(
    ('offsets', 'jump', 'jumps'),
    [
        # Five milliseconds, where nothing scatters.
        ([0.0] * 8, 0.0049, 0),
        ([0.0] * 8, 0.0051, 1),
        ([0.0] * 8, -0.0051, 1),
        # To and fro by 1 ms: 12 * 1.4826 of it more.
        ([0, 1, 0, -1, -1, 0, -1, 0, -1], 0.0227, 0),
        ([0, 1, 0, -1, -1, 0, -1, 0, -1], 0.0229, 1),
    ],
)
def test_a_jump_is_twelve_deviations_and_five_milliseconds(offsets, jump, jumps):
    times = 100.0 * np.arange(len(offsets))
    behind = np.where(np.arange(len(offsets)) >= 4, jump, 0.0)
    found = fit_clock(motions(times, 1e-3 * np.array(offsets) + behind))
    assert len(found.jumps) == jumps


def test_the_rate_between_motions_is_that_of_far_ones():
    # A rate of 1e-4 goes on by 10 ms in 100 s; of motions a second apart scatter makes what it may.
    times = np.array([0.0, 100, 101, 200, 201, 300, 301, 400])
    offsets = 1e-4 * times
    offsets[[2, 4, 6]] += 2e-3
    assert fit_clock(motions(times, offsets)).jumps == ()
    offsets[4:] += 0.08
    assert len(fit_clock(motions(times, offsets)).jumps) == 1


# Which samples of a motion tell the offset


def test_of_a_long_motion_two_seconds_at_either_end_are_used():
    time = np.arange(-3000, 13_000) / 1000

    def used(duration):
        return [(time[index[0]], time[index[-1]]) for index in _windows(time, duration)]

    assert used(5.599) == [(-0.8, 6.399)]
    assert used(5.7) == [(-0.8, 2.0), (3.7, 6.5)]
    assert used(8.0) == [(-0.8, 2.0), (6.0, 8.8)]
    # Four thousand are enough; two of an end are none.
    (whole,) = _windows(time, 2.5)
    assert np.diff(whole).tolist() == [1] * 4100
    (half,) = _windows(np.arange(-3000, 13_000) / 2000, 2.5)
    assert set(np.diff(half)) == {2}
    assert len(_windows(np.arange(-3, 3) * 0.8, 8.0)) == 1
    assert len(_windows(np.arange(-3, 11) * 0.8, 8.0)) == 2
    assert len(_windows(np.arange(-3, 10) * 0.8, 8.0)) == 1


def test_gyros_may_leave_a_fiftieth_of_a_motion():
    time = np.arange(-1.0, 3.0, 0.01)
    stamp = START + np.rint(time * 1e9).astype(np.int64)
    joint = np.arange(0.0, 2.001, 0.02)
    joint_stamp = START + np.rint(joint * 1e9).astype(np.int64)

    def smooth(t):
        part = np.clip(t / 2, 0, 1)
        return np.asarray(part - np.sin(2 * np.pi * part) / (2 * np.pi))

    # To and fro from one sample to the next, which no motion is.
    own = smooth(time[(time >= -0.8) & (time <= 2.8)])
    for share, told in ((0.0195, True), (0.0205, False)):
        noise = share * np.std(own) * np.resize([1.0, -1.0], len(time))
        found = clock_sample(stamp, smooth(time) + noise, joint_stamp, smooth(joint))
        assert (found is not None) is told


# How much of a motion the gyros saw


def share_of_motion(
    ways: list[float], by_gyros: list[float], late: float = 0.0
) -> MeasuredShare | None:
    """What is seen of a motion of these degrees in each tenth of a second, and by the gyros."""
    joint = np.arange(2 * len(ways) + 1) * 0.05
    angle = np.interp(joint, 0.1 * np.arange(len(ways) + 1), np.cumsum([0, *ways]))
    attitudes = np.array([rotation(np.array([0.0, 1.0, 0.0]), a * DEG) for a in angle])
    # Samples of 10 ms from 3 s before to 3 s after it.
    increments = np.zeros((600 + 10 * len(ways), 6))
    first = 300 + round(100 * late)
    increments[first : first + 10 * len(ways), 2] = np.repeat(by_gyros, 10) * DEG / 10
    time = 0.01 * np.arange(1, len(increments) + 1) - 3.0
    stamp = START + np.rint(time * 1e9).astype(np.int64)
    samples = Samples(stamp, increments, np.zeros(6), 0.01, np.zeros(6))
    joint_stamp = START + np.rint(joint * 1e9).astype(np.int64)
    return measured_share(samples, joint_stamp, attitudes)


def test_shares_are_by_angle_and_by_cells():
    found = share_of_motion([1.0] * 20, [1.0] * 5 + [0.0] * 5 + [1.0] * 10)
    # Gyros are read at the ends of cells that begin with their first sample.
    assert found.angle == pytest.approx(0.75, abs=0.01)
    assert found.time == pytest.approx(0.75, abs=0.051)


@pytest.mark.parametrize(
    ('way', 'seen_of_it', 'moving'),
    [
        # A quarter of the way or a degree per second, whichever is less.
        (1.0, 0.08, False),
        (1.0, 0.12, True),
        (0.3, 0.070, False),
        (0.3, 0.080, True),
    ],
)
def test_gyros_see_a_cell_where_they_turn(way, seen_of_it, moving):
    found = share_of_motion([way] * 40, [seen_of_it] * 40)
    assert found.angle == pytest.approx(seen_of_it / way, abs=0.01)
    # Where cells begin with the first sample, one lies at the end.
    assert found.time == (pytest.approx(1.0, abs=0.051) if moving else 0.0)


@pytest.mark.parametrize(('slow', 'share'), [(0.23, 1.0), (0.27, 0.5)])
def test_cells_with_a_quarter_of_the_largest_way_count(slow, share):
    found = share_of_motion([1.0] * 10 + [slow] * 10, [1.0] * 10 + [0.0] * 10)
    assert found.time == pytest.approx(share, abs=0.06)


@pytest.mark.parametrize(('late', 'share'), [(1.0, 1.0), (-1.0, 1.0), (1.6, 0.7), (-1.6, 0.7)])
def test_clocks_may_be_a_second_apart(late, share):
    found = share_of_motion([1.0] * 20, [1.0] * 20, late)
    assert found.angle == pytest.approx(share, abs=0.01)


def test_a_motion_of_a_tenth_of_a_radian_is_the_least():
    assert share_of_motion([0.57] * 10, [0.57] * 10) is None
    assert share_of_motion([0.58] * 10, [0.58] * 10) is not None


# One motion of a table as gyros and encoder saw it: their clocks, and how much was seen


PERIOD, STATES = 0.01, 0.02
BEFORE = 3.0


def quarter(time: Floats, *, seconds: float = 2.0, angle: float = np.pi / 2) -> Floats:
    """Speed up and slow down from 0 s on, a raised cosine: rad."""
    part = np.clip(np.asarray(time) / seconds, 0.0, 1.0)
    return angle * (part - np.sin(2 * np.pi * part) / (2 * np.pi))


def long_turn(time: Floats) -> Floats:
    """Ten turns at 30 deg/s that start and stop within a second each."""
    rate, ramp, steady = np.radians(30.0), 1.0, 119.0
    t = np.clip(np.asarray(time), 0.0, steady + 2 * ramp)
    up = np.minimum(t, ramp)
    down = np.maximum(t - steady - ramp, 0.0)
    return rate * (up**2 / (2 * ramp) + np.clip(t - ramp, 0.0, steady) + down - down**2 / 2)


def both(
    motion: Callable[[Floats], Floats] = quarter,
    *,
    lasts: float = 2.0,
    ahead: float = 0.0,
    factor: float = 1.0,
    bias: float = 0.0,
    wander: Floats | None = None,
) -> tuple[Floats, Floats, Floats, Floats]:
    """Stamps and angle by the gyros, stamps and angle by the encoder: ns and rad."""
    time = np.arange(-BEFORE, lasts + BEFORE, PERIOD)
    turned = 0.3 + factor * motion(time) + bias * time
    if wander is not None:
        turned = turned + wander[: len(time)]
    joint = np.arange(0.0, lasts + STATES / 2, STATES)
    stamps = [
        START + np.round((t + shift) * 1e9).astype(np.int64)
        for t, shift in ((time, ahead), (joint, 0.0))
    ]
    return stamps[0], turned, stamps[1], motion(joint)


@pytest.mark.parametrize('ahead', [0.0, 0.0137, -0.2, 0.75])
@pytest.mark.parametrize(('factor', 'bias'), [(1.0, 0.0), (0.97, 2e-3), (-1.02, -1e-3)])
def test_the_offset_is_found_whatever_scale_factor_and_bias(ahead, factor, bias):
    # A gyro may look down the axis: its factor is negative.
    found = clock_sample(*both(ahead=ahead, factor=factor, bias=bias))
    # Encoder angles between states are read off lines: 2 deg in 20 ms leave some 10 microseconds.
    assert found.offset == pytest.approx(ahead, abs=3e-5)
    assert found.time == pytest.approx(START + 1e9, abs=1e3)


def test_of_a_long_turn_its_ends_tell_and_not_what_lies_between():
    """An angle that random walk takes elsewhere half way would pass for seconds in between."""
    wander = np.where(np.arange(20000) * PERIOD < 60.0, 0.0, 2e-3)
    found = clock_sample(*both(long_turn, lasts=121.0, ahead=0.05, wander=wander))
    assert found.offset == pytest.approx(0.05, abs=1e-4)


def test_what_tells_nothing_gives_nothing():
    imu, turned, joint, angle = both()
    assert clock_sample(imu, turned, joint[:3], angle[:3]) is None
    assert clock_sample(*both(lambda t: quarter(t, angle=0.09))) is None
    assert clock_sample(*both(lambda t: quarter(t, angle=0.11))) is not None
    # Gyros that saw nothing, and gyros that saw another motion.
    assert clock_sample(imu, np.zeros(len(imu)), joint, angle) is None
    assert clock_sample(imu, quarter((imu - START) * 1e-9 / 2.0), joint, angle) is None
    # Clocks further apart than the rest that is looked at beside a motion.
    assert clock_sample(*both(ahead=0.9)) is None
    assert clock_sample(*both(ahead=1.3)) is None
    few = slice(None, None, 25)
    assert clock_sample(imu[few], turned[few], joint, angle) is None


def test_states_must_tell_the_shape_of_the_motion():
    imu, turned, joint, angle = both(ahead=0.01)
    for count, told in ((3, False), (4, False), (6, True), (11, True)):
        few = np.linspace(0, len(joint) - 1, count).astype(int)
        found = clock_sample(imu, turned, joint[few], angle[few])
        # Lines between four states leave more of a raised cosine than gyros may.
        assert (found is not None) is told
        if found is not None:
            assert found.offset == pytest.approx(0.01, abs=2e-4)


def test_a_motion_that_stands_alone_between_two_jumps_is_an_outlier():
    offsets = [0.01, 0.01, 0.01, 0.3, 0.01, 0.01, 0.01, 0.01]
    found = fit_clock([ClockSample(1e10 * k, offset) for k, offset in enumerate(offsets)])
    assert found.motions == 7
    assert found.offset == pytest.approx(0.01)
    assert found.jumps == pytest.approx((0.0,), abs=1e-12)


@pytest.mark.parametrize('motions', [1, 2])
def test_few_motions_tell_an_offset_and_no_rate(motions):
    found = fit_clock([ClockSample(1e10 * k, 0.01 + 0.002 * k) for k in range(motions)])
    assert (found.rate, found.motions) == (0.0, motions)
    assert np.isnan(found.rate_std)
    if motions == 1:
        assert found.offset == 0.01
        assert np.isnan(found.offset_std)
    else:
        assert found.offset == pytest.approx(0.011)
        assert found.offset_std == pytest.approx(0.001)


def samples(turned: Floats) -> Samples:
    """A unit whose gyro x sees these angles, from three seconds before the motion on."""
    increments = np.zeros((len(turned) - 1, 6))
    increments[:, 0] = np.diff(turned)
    stamp = START + np.round((np.arange(1, len(turned)) * PERIOD - BEFORE) * 1e9).astype(np.int64)
    return Samples(stamp, increments, np.zeros(6), PERIOD, np.zeros(6))


def attitudes(angle: Floats) -> Floats:
    return np.array([rotation(np.array([1.0, 0.0, 0.0]), a) for a in angle])


def seen_share(factor: Callable[[Floats], Floats], *, late: float = 0.0) -> tuple[float, float]:
    time = np.arange(-BEFORE, 2.0 + BEFORE, PERIOD)
    rate = np.gradient(quarter(time - late), PERIOD) * factor(time)
    joint = np.arange(0.0, 2.0 + STATES / 2, STATES)
    stamp = START + np.round(joint * 1e9).astype(np.int64)
    found = measured_share(samples(np.cumsum(rate) * PERIOD), stamp, attitudes(quarter(joint)))
    return found.angle, found.time


@pytest.mark.parametrize('late', [0.0, 0.4, -0.7])
def test_what_gyros_see_of_a_motion_is_all_of_it(late):
    """Whatever the clocks, within a second."""
    angle, time = seen_share(lambda t: np.ones(len(t)), late=late)
    assert angle == pytest.approx(1.0, abs=0.02)
    assert time == 1.0


def test_what_gyros_do_not_see_is_missing_by_angle_and_by_time():
    assert seen_share(lambda t: np.zeros(len(t))) == (0.0, 0.0)
    # Half of the rate is half of the angle, at every moment.
    angle, time = seen_share(lambda t: np.full(len(t), 0.5))
    assert angle == pytest.approx(0.5, abs=0.01)
    assert time == 1.0
    # Frozen from half way on is half of the angle; of the time, half at the true shift and more at
    # one that lays what was seen over the slow end.
    angle, time = seen_share(lambda t: np.where(t < 1.0, 1.0, 0.0))
    assert angle == pytest.approx(0.5, abs=0.06)
    assert 0.45 < time < 0.85


def test_a_motion_that_cannot_be_compared_is_not():
    time = np.arange(-BEFORE, 2.0 + BEFORE, PERIOD)
    joint = np.arange(0.0, 2.0 + STATES / 2, STATES)
    stamp = START + np.round(joint * 1e9).astype(np.int64)
    whole, ways = samples(quarter(time)), attitudes(quarter(joint))
    assert measured_share(whole, stamp, ways) is not None
    assert measured_share(whole, stamp[:1], ways[:1]) is None
    # The way is what counts, not how long it took.
    assert measured_share(whole, stamp, attitudes(0.09 * quarter(joint) / (np.pi / 2))) is None
    # Samples that begin after the motion does, end before it, or lack some of it.
    kept = np.ones(len(whole.stamp), dtype=bool)
    late, early, gap = kept.copy(), kept.copy(), kept.copy()
    late[: int((BEFORE + 0.5) / PERIOD)] = False
    early[int((BEFORE + 1.5) / PERIOD) :] = False
    gap[int((BEFORE + 1.0) / PERIOD) :][:20] = False
    for some in (late, early, gap):
        assert measured_share(whole.at(some), stamp, ways) is None
