"""What is read of whole turns: each figure against the samples and the angles around their cuts."""

from dataclasses import replace
from math import sqrt
from typing import Any

import numpy as np
import pytest

from imu_calib.common.stream import Floats, Units
from imu_calib.common.units import ARCSEC, DEG
from imu_calib.segmentation.plateaus import find_turns
from imu_calib.segmentation.segmented import FreeMotion, Rejected
from imu_calib.segmentation.segments import Turn
from imu_calib.segmentation.statistics import Samples, Sensor, statistics_between
from imu_calib.segmentation.table_motion import Motion
from imu_calib.segmentation.turns import MotionReadings, _around, read_free_motion, read_turns
from imu_calib.session.imu import ImuSpec, TriadSpec
from imu_calib.session.table import Joint, Table

START = 1_700_000_000 * 10**9
PERIOD = 0.01
TABLE = Table('bench', (Joint('outer', (1.0, 0.0, 0.0)), Joint('inner', (0.0, 0.0, 1.0))))
RATES = Sensor.from_spec(ImuSpec('any', Units.SI, None, TriadSpec(range=8.0), TriadSpec()))
NONE = np.zeros(6)

SECONDS, BEGIN, END, RATE = 26.0, 3.0, 23.0, 40.0
"""At 40 deg/s for 20 s: two turns, in the middle 18 s."""


def speed(time: Floats, rate: float = RATE) -> Floats:
    return rate * DEG * np.interp(time, [BEGIN - 1, BEGIN, END, END + 1], [0, 1, 1, 0])


def turned(outer: float = 0.0, noise: float = 0.0, rate: float = RATE) -> Motion:
    """The inner joint turns; the outer one stands at an angle in degrees, to and fro by noise."""
    time = np.arange(0.0, SECONDS, PERIOD)
    steps = speed(time, rate)
    inner = np.concatenate([[0.0], np.cumsum((steps[1:] + steps[:-1]) / 2) * PERIOD])
    held = outer * DEG + noise * np.resize([1.0, -1.0], len(time))
    stamp = START + np.rint(time * 1e9).astype(np.int64)
    return Motion(int(stamp[0]), int(stamp[-1]), stamp, np.column_stack([held, inner]))


def delivered(ahead: int = 0, sense: float = 1.0) -> Samples:
    """Six channels at random about those of a unit with Z up."""
    time = np.arange(PERIOD, SECONDS, PERIOD)
    values = 1e-3 * np.random.default_rng(4).standard_normal((len(time), 6))
    values[:, 2] += sense * speed(time - PERIOD / 2)
    stamp = START + ahead + np.rint(time * 1e9).astype(np.int64)
    return Samples(stamp, values * PERIOD, NONE, PERIOD, NONE)


def around(samples: Samples, sensor: Sensor = RATES, **more: Any) -> MotionReadings:
    scale = np.where(samples.pulse > 0, samples.pulse, PERIOD)
    return MotionReadings(sensor, samples.increments / scale, samples, **more)


def gained(samples: Samples, begin: float, end: float) -> Floats:
    """Increments from one instant to another, s after the start: a sample is shared in parts."""
    first, last = begin / PERIOD, end / PERIOD
    total = np.zeros(6)
    for k, row in enumerate(samples.increments):
        total = total + row * max(0.0, min(k + 1, last) - max(k, first))
    return total


@pytest.mark.parametrize('ahead', [0, 7_300_000])
def test_a_turn_is_what_was_gained_between_its_cuts(ahead):
    motion, samples = turned(), delivered(ahead)
    (cuts,) = find_turns(motion)
    (turn,) = read_turns(around(samples), motion, TABLE, ahead)
    assert isinstance(turn, Turn)
    # 720 deg at 40 deg/s in the middle of what turns steadily.
    begin = (cuts.start - START) * 1e-9
    assert begin == pytest.approx(4.0, abs=0.02)
    assert turn.start == int(cuts.start + ahead)
    assert turn.end == pytest.approx(turn.start + cuts.seconds * 1e9, abs=300)
    assert turn.seconds == cuts.seconds == pytest.approx(18.0)
    assert turn.angle == pytest.approx(4 * np.pi)
    assert turn.statistics.mean * 18 == pytest.approx(
        gained(samples, begin, begin + cuts.seconds), rel=1e-6, abs=1e-7
    )
    assert turn.statistics.duration == pytest.approx(18.0)
    assert turn.each is not None
    middle = begin + cuts.seconds / 2
    for mean, (a, b) in zip(
        turn.each, [(begin, middle), (middle, middle + cuts.seconds / 2)], strict=True
    ):
        assert mean == pytest.approx(gained(samples, a, b)[:3] / 9, rel=1e-6, abs=1e-7)
    assert (turn.rate_error, turn.joint, turn.position) == (cuts.rate_error, 1, None)
    assert turn.skewed is None


def test_one_turn_has_no_single_ones():
    (turn,) = read_turns(around(delivered()), turned(rate=20.0), TABLE, 0)
    assert isinstance(turn, Turn)
    assert (turn.angle, turn.each) == (pytest.approx(2 * np.pi), None)


@pytest.mark.parametrize(('outer', 'up', 'sense'), [(0.0, 1.0, 1), (180.0, -1.0, -1)])
@pytest.mark.parametrize('noise', [0.0, 2e-5])
def test_the_angle_is_about_up(outer, up, sense, noise):
    motion = turned(outer, noise)
    (turn,) = read_turns(around(delivered()), motion, TABLE, 0)
    assert isinstance(turn, Turn)
    assert turn.angle == pytest.approx(sense * 4 * np.pi)
    assert turn.up == pytest.approx([0.0, 0.0, up], abs=1e-9)
    (cuts,) = find_turns(motion)
    within = (motion.stamp >= cuts.start) & (motion.stamp < cuts.start + cuts.seconds * 1e9)
    angles = motion.position[within]
    assert turn.angles == pytest.approx(angles.mean(axis=0))
    # One joint is held: its mean is uncertain by its scatter over the root of their number.
    wanted = np.std(angles[:, 0], ddof=1) / sqrt(np.count_nonzero(within))
    assert turn.up_error == pytest.approx(wanted)


def test_of_a_single_joint_none_is_held():
    motion = turned()
    alone = replace(motion, position=motion.position[:, 1:])
    (turn,) = read_turns(around(delivered()), alone, replace(TABLE, joints=TABLE.joints[1:]), 0)
    assert isinstance(turn, Turn)
    assert turn.up_error == 0.0


@pytest.mark.parametrize(('lean', 'counts'), [(0.80, True), (0.82, False), (179.18, False)])
def test_an_axis_leans_by_less_than_0_81_degrees(lean, counts):
    (found,) = read_turns(around(delivered()), turned(lean), TABLE, 5_000_000)
    if counts:
        assert isinstance(found, Turn)
        return
    assert isinstance(found, Rejected)
    assert found.reason == (
        'by the file of the table its axis is 0.82 deg off the vertical; turns about the vertical '
        'are used'
    )
    (cuts,) = find_turns(turned(lean))
    assert (found.start, found.turn) == (int(cuts.start + 5_000_000), True)
    assert found.end == pytest.approx(found.start + 18e9, abs=1e3)


def without(samples: Samples, *times: tuple[float, float]) -> Samples:
    time = (samples.stamp - START) * 1e-9
    gone = np.zeros(len(time), bool)
    for a, b in times:
        gone |= (time > a) & (time < b)
    return samples.at(~gone)


def reason(samples: Samples, sensor: Sensor = RATES) -> str:
    (found,) = read_turns(around(samples, sensor), turned(), TABLE, 0)
    return found.reason if isinstance(found, Rejected) else ''


def test_samples_must_be_sound_between_the_cuts_alone():
    assert reason(without(delivered(), (12.0, 12.5))) == 'IMU samples are missing within it'
    for beside in ((3.4, 3.6), (22.4, 22.6)):
        assert reason(without(delivered(), beside)) == ''
    assert reason(without(delivered(), (0.0, 4.1))) == 'the IMU stream does not span it'
    assert reason(without(delivered(), (21.9, 99.0))) == 'the IMU stream does not span it'
    assert reason(without(delivered(), (0.0, 99.0))) == 'the IMU stream does not span it'

    def change(a, b, value):
        samples = delivered()
        time = (samples.stamp - START) * 1e-9
        rows = samples.increments.copy()
        rows[(time > a) & (time < b)] = value * PERIOD
        return replace(samples, increments=rows)

    assert reason(change(12.0, 12.015, 8.0)) == 'the sensor is saturated during it'
    assert reason(change(3.4, 3.415, 8.0)) == ''
    frozen = 'the samples are frozen within it, repeating one'
    assert reason(change(12.0, 12.5, 0.1)) == frozen
    assert reason(change(3.3, 3.8, 0.1)) == ''
    fast = delivered()
    rows = fast.increments.copy()
    rows[-1000:, 2] *= 1.2
    unsteady = 'the gyros show no steady rate while the joint states do'
    assert reason(replace(fast, increments=rows)) == unsteady


def test_counts_at_the_cuts_are_read_from_all_that_turns_as_fast():
    spec = ImuSpec('any', Units.PULSES, None, TriadSpec(1e-4, random_walk=1e-3), TriadSpec(1e-4))
    sensor = Sensor.from_spec(spec)
    plain = delivered()
    counts = np.diff(np.floor(np.cumsum(plain.increments, axis=0) / 1e-4), axis=0, prepend=0.0)
    samples = replace(plain, increments=counts * 1e-4, pulse=np.full(6, 1e-4))
    (cuts,) = find_turns(turned())
    assert cuts.spare == pytest.approx(0.75, abs=0.05)

    def between(begin, end, gap=None):
        """Read from the samples whose stamps lie between two instants."""
        part = without(samples, (0.0, begin), (end, 99.0))
        first = (cuts.start - part.stamp[0]) * 1e-9 / PERIOD + 1
        wanted = statistics_between(part, first, first + cuts.seconds / PERIOD, sensor.walk)
        neighbours = around(without(samples, gap) if gap else samples, sensor)
        (turn,) = read_turns(neighbours, turned(), TABLE, 0)
        assert isinstance(turn, Turn)
        assert turn.statistics.mean == pytest.approx(wanted.mean, rel=1e-6, abs=1e-10)
        assert turn.statistics.walk_gain == pytest.approx(wanted.walk_gain, rel=1e-6)

    begin = (cuts.start - START) * 1e-9
    end = begin + cuts.seconds
    between(begin - cuts.spare, end + cuts.spare)
    # Where that is not sound, from two intervals before to three behind.
    between(begin - 0.02, end + 0.03, (end + 0.3, end + 0.5))


@pytest.mark.parametrize(
    ('spare', 'first', 'last'), [(0.0, 97, 202), (0.025, 97, 202), (0.5, 49, 249)]
)
def test_samples_around_two_instants_are_two_and_three_or_more(spare, first, last):
    # Stamps at 10 ms and on: from 1.0 to 2.0 s less 1 ms.
    stamp = START + 10_000_000 * np.arange(1, 400)
    samples = Samples(stamp, np.zeros((399, 6)), NONE, PERIOD, NONE)
    found = _around(samples, START + 1e9 - 1e6, START + 2e9 - 1e6, spare)
    wanted = [0.999 - max(spare, 0.02), 1.999 + max(spare, 0.03)]
    inside = [k for k in range(399) if wanted[0] <= (k + 1) / 100 < wanted[1]]
    assert (found.start, found.stop) == (inside[0], inside[-1] + 1) == (first, last)


# Motions that no encoder saw


def free(degrees: float, *gaps: tuple[float, float]) -> list[FreeMotion | Rejected]:
    """About an axis, from 1 s to 2 s."""
    samples = delivered()
    rows = np.zeros_like(samples.increments)
    rows[100:200, :3] = np.array([0.0, 0.6, 0.8]) * degrees * DEG / 100
    rows[:, 3:] = np.arange(1.0, 4.0) * PERIOD
    motion = Motion(START + 10**9, START + 2 * 10**9, np.empty(0), np.empty((0, 0)))
    neighbours = around(without(replace(samples, increments=rows), *gaps))
    return read_free_motion(neighbours, motion)


def test_a_motion_is_what_the_gyros_gained():
    (found,) = free(90.0)
    assert isinstance(found, FreeMotion)
    assert (found.start, found.end) == (START + 10**9, START + 2 * 10**9)
    assert found.turned == pytest.approx(np.array([0.0, 0.6, 0.8]) * np.pi / 2)
    assert found.statistics.duration == pytest.approx(1.0)
    assert found.statistics.mean == pytest.approx([0, 0.3 * np.pi, 0.4 * np.pi, 1, 2, 3])
    # The mean of exp(i a) from 0 to pi / 2.
    assert found.mean_phase == pytest.approx((1 + 1j) * 2 / np.pi, rel=1e-4)
    assert [len(free(degrees)) for degrees in (4.9, 5.1)] == [0, 1]


def test_a_motion_that_is_not_sound_is_left_out():
    # 8 rad/s about an axis of which one gyro sees eight tenths.
    for degrees, gaps, reason in (
        (90.0, ((1.3, 1.5),), 'IMU samples are missing within it'),
        (8.01 / 0.8 / DEG, (), 'the sensor is saturated during it'),
    ):
        (found,) = free(degrees, *gaps)
        assert isinstance(found, Rejected)
        assert (found.start, found.end) == (START + 10**9, START + 2 * 10**9)
        assert (found.reason, found.turn) == (reason, True)
    assert isinstance(free(7.98 / 0.8 / DEG)[0], FreeMotion)
    # Two samples are the least.
    assert free(900.0, (1.0, 1.995)) == []
    assert len(free(900.0, (1.0, 1.985))) == 1


def test_gyros_beyond_their_range_that_the_table_does_not_turn_by_are_in_other_units():
    def times(factor):
        samples = delivered()
        rows = samples.increments.copy()
        rows[:, :3] *= factor
        # The range of `RATES` is 8 rad/s.
        middle = len(rows) // 2
        rows[middle, 0] = 8.0 * PERIOD
        return reason(replace(samples, increments=rows))

    # Sensors clip: of the rate of the table they state less than all.
    assert times(1.8) == 'the sensor is saturated during it'
    assert times(20.0) == (
        'the gyros read 20 times the rate of the table, beyond the range that the '
        "IMU's description states: check its units, scale factor and range"
    )


PULSE = 0.5 * ARCSEC
COUNTERS = Sensor.from_spec(
    ImuSpec('any', Units.PULSES, None, TriadSpec(PULSE, range=8.0), TriadSpec(1e-5))
)


def whole_way(seed: int, walk: float, bias: float, sense: float = 1.0, outer: float = 0.0) -> Turn:
    """Whole turns at 20 deg/s between ramps of 9 s, two from rest to rest, by steps of 0.05 deg.

    The gyro about Z is scaled by 1.001, has a bias, and a random walk in rad/s^0.5. The inner
    joint turns in a sense, 1 or -1; the outer one stands at an angle in degrees.
    """
    rng = np.random.default_rng(seed)
    edges = np.arange(0.0, 64.0, PERIOD)
    rate = sense * 20 * DEG * np.interp(edges, [5.0, 14.0, 41.0, 50.0], [0, 1, 1, 0])
    angle = np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) / 2) * PERIOD])
    steps = np.rint((angle + rng.uniform() * DEG) / (0.05 * DEG)) * 0.05 * DEG
    moving = slice(490, 5010)
    stamp = START + np.rint(edges * 1e9).astype(np.int64)
    motion = Motion(
        int(stamp[490]),
        int(stamp[5009]),
        stamp[moving],
        np.column_stack([np.full(len(edges), outer * DEG), steps])[moving],
    )
    seen = np.diff(angle) * 1.001 + bias * PERIOD
    seen += walk * sqrt(PERIOD) * rng.standard_normal(len(seen))
    counted = np.floor(np.cumsum(seen) / PULSE + rng.uniform())
    increments = np.zeros((len(seen), 6))
    increments[:, 2] = np.diff(counted, prepend=0.0) * PULSE
    increments[:, [0, 1]] = PULSE * (np.arange(len(seen)) % 2)[:, None]
    pulses = np.array([PULSE] * 3 + [1e-5] * 3)
    increments[:, 3:] = 1e-5 * (np.arange(len(seen)) % 2)[:, None]
    samples = Samples(stamp[1:], increments, pulses, PERIOD, pulses)
    (turn,) = read_turns(around(samples, COUNTERS), motion, TABLE, 0)
    assert isinstance(turn, Turn)
    return turn


@pytest.mark.parametrize('outer', [0.0, 180.0])
@pytest.mark.parametrize('sense', [1.0, -1.0])
def test_a_whole_way_has_the_sense_of_its_turn_about_up(sense, outer):
    turn = whole_way(1, 0.0, 0.02 * DEG, sense, outer)
    assert turn.whole_way is not None
    # Z is up or down. Of 20 deg/s the gyro shows a thousandth more, and its bias.
    up = 1.0 if outer == 0.0 else -1.0
    assert turn.rate() == pytest.approx(sense * up * 20 * DEG, rel=2e-4)
    assert turn.statistics.mean[2] - 0.02 * DEG == pytest.approx(1.001 * turn.rate() * up, rel=2e-5)


@pytest.mark.parametrize('walk', [0.0, 3 * ARCSEC])
def test_the_rate_of_a_whole_way_is_as_sure_as_what_the_gyros_read_at_rest(walk):
    # Of many a size, so that pulses fall anywhere.
    biases = np.random.default_rng(5).uniform(0.01, 0.03, 60) * DEG
    turns = [whole_way(seed, walk, bias) for seed, bias in enumerate(biases)]
    assert all(turn.whole_way is not None for turn in turns)
    # What the outputs say of the scale factor: their noise and that of the rate are one.
    means = np.array([t.statistics.mean[2] for t in turns])
    scales = (means - biases) / np.array([t.rate() for t in turns])
    noises = np.zeros(6)
    noises[2] = walk
    (turn, *_) = turns
    own = walk**2 * turn.statistics.walk_gain[2] + turn.statistics.quantisation_variance[2]
    rate = turn.rate_std(noises)
    stated = sqrt(own / turn.rate() ** 2 + rate**2)
    off = scales / 1.001 - 1
    # Of 60 draws the scatter is known to 9 %, and chance passes 4 of these once in 10^4.
    assert 0.5 * stated < off.std() < 1.37 * stated
    assert abs(off.mean()) < 4 * stated / sqrt(60)
    # Without it the stated deviation would be too small.
    assert off.std() > 1.1 * sqrt(own) / turn.rate()
    # It is the line that is surer where gyros are noisy: 0.05 deg of 360 are 140 ppm at most.
    assert turn.by_more_accurate_rate(noises).whole_way is turn.whole_way
    assert turn.by_more_accurate_rate(np.full(6, 300 * ARCSEC)).whole_way is None
