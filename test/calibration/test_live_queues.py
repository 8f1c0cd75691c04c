"""When samples go out, and at which temperature: the compensator's queues sample by sample."""

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from calibrations import BRICK, brick_at, known, with_skew

from imu_calib.calibration import compensator as module
from imu_calib.calibration.compensate import Compensation, Mark
from imu_calib.calibration.compensator import Compensator
from imu_calib.calibration.sample_clock import SampleClock
from imu_calib.calibration.thermal import combine
from imu_calib.common.errors import NotObservable
from imu_calib.common.stream import ImuBlock, SkewBlock, TemperatureBlock, Units
from imu_calib.model.sensors import SensorModel, Triad

MS = 1_000_000
START = 1_700_000_000_000 * MS


def at(*milliseconds: float) -> Any:
    return START + np.rint(np.array(milliseconds) * MS).astype(np.int64)


def samples(first: int, stop: int, value: float = 0.0) -> ImuBlock:
    """Samples of a kilohertz, all of them the same."""
    stamp = at(*range(first, stop))
    return ImuBlock(stamp, np.full((len(stamp), 3), value), np.zeros((len(stamp), 3)), 'imu')


def temperature(milliseconds: float, celsius: float) -> TemperatureBlock:
    return TemperatureBlock(at(milliseconds), np.array([celsius]))


def rates(readings: list[Any]) -> list[float]:
    """The rates about x of all that went out."""
    return [float(v) for r in readings for v in r.values.rate[:, 0]]


def test_a_temperature_counts_for_samples_half_a_second_after_it():
    # The bias is the temperature; the unit stands still.
    compensator = Compensator(combine([brick_at(0.0, 0.0), brick_at(100.0, 100.0)], ['a', 'b']))
    assert compensator.waits_for_temperature
    assert compensator.compensate_block(samples(0, 40)) == []
    assert (compensator.waiting, compensator.dropped) == (40, 0)
    # The first counts for all before it.
    first = compensator.compensate_block(temperature(100, 10.0))
    assert rates(first) == pytest.approx([-10.0] * 40)
    assert (compensator.waiting, compensator.waits_for_temperature) == (0, False)
    assert compensator.compensate_block(temperature(120, 20.0)) == []
    assert compensator.celsius == 20.0
    then = compensator.compensate_block(samples(40, 800))
    assert rates(then) == pytest.approx([-10.0] * (620 - 40) + [-20.0] * (800 - 620))
    assert [r.frame_id for r in then] == ['imu', 'imu']
    assert compensator.period == pytest.approx(1e-3)
    assert not compensator.counts
    # What is no number is none.
    assert compensator.compensate_block(temperature(300, np.nan)) == []
    assert compensator.celsius == 20.0


def test_a_temperature_that_hardly_moves_is_the_one_before():
    compensator = Compensator(combine([brick_at(0.0, 0.0), brick_at(100.0, 100.0)], ['a', 'b']))
    compensator.compensate_block(temperature(0, 10.0))
    # From 10 to 10.0099 nothing is prepared anew; 10.0101 is a hundredth more.
    compensator.compensate_block(temperature(50, 10.0099))
    compensator.compensate_block(temperature(100, 10.0101))
    found = rates(compensator.compensate_block(samples(0, 700)))
    assert found == pytest.approx([-10.0] * 600 + [-10.0101] * 100, abs=1e-9)


def test_beyond_what_was_seen_samples_are_marked_until_the_temperature_is_back():
    # Seen from 19 to 22 degC, and taken to count five kelvin further.
    compensator = Compensator(brick_at(20.0, 3.0))
    for k, celsius in enumerate((27.0, 27.1, 13.9, 14.0)):
        compensator.compensate_block(temperature(100.0 * k, celsius))
    readings = compensator.compensate_block(samples(0, 1000))
    marks = np.concatenate([r.values.marks for r in readings]).tolist()
    hot = int(Mark.TEMPERATURE)
    assert marks == [0] * 600 + [hot] * 200 + [0] * 200
    assert compensator.counts[Mark.TEMPERATURE] == 200
    assert rates(readings) == pytest.approx([-3.0] * 1000)


def test_while_no_temperature_comes_the_oldest_make_room(monkeypatch):
    monkeypatch.setattr(module, '_MOST_WAITING', 50)
    compensator = Compensator(combine([brick_at(0.0), brick_at(100.0)], ['a', 'b']))
    for first in (0, 40, 50, 51):
        assert compensator.compensate_block(samples(first, first + (40 if not first else 10))) == []
    # Blocks of 40, 10, 10 and 10: at 60 the first is too much.
    assert (compensator.dropped, compensator.waiting) == (40, 30)
    assert compensator.finish() == []
    assert (compensator.dropped, compensator.waiting) == (70, 0)


def test_what_comes_again_and_again_is_dropped_and_the_rest_goes_on():
    compensator = Compensator(brick_at(20.0))
    still = replace(samples(0, 33), stamp=np.full(33, START))
    assert compensator.compensate_block(still) == []
    assert (compensator.repeats, compensator.dropped, compensator.waiting) == (32, 0, 1)
    # The first of these is the one of before.
    assert compensator.compensate_block(samples(0, 20)) == []
    assert (compensator.repeats, compensator.waiting) == (33, 20)
    assert [len(out) for out in compensator.compensate_block(samples(20, 60))] == [1, 19, 40]
    assert (compensator.irregular_steps, compensator.dropped) == (0, 0)


def test_stamps_that_stand_still_wait_for_a_second_at_most():
    # No repeats: the values go on.
    compensator = Compensator(brick_at(20.0))
    values = np.arange(5000.0)[:, None] * np.ones(3)
    taken = compensator.compensate_block(ImuBlock(np.full(5000, START), values, values, 'imu'))
    assert compensator.repeats == 0
    # Those that waited for so long need no time between samples: they are in SI units.
    assert (compensator.dropped, sum(map(len, taken)) + compensator.waiting) == (0, 5000)
    assert 4000 < compensator.waiting < 4200


def skewed(*milliseconds: float) -> SkewBlock:
    return SkewBlock(at(*milliseconds), np.full(len(milliseconds), 1.0))


def test_a_sample_waits_fifty_milliseconds_for_its_skewed_gyro():
    calibration = known(model=with_skew())
    # Samples that come ten times as fast as stated would wait for others.
    calibration = replace(calibration, imu=replace(calibration.imu, sample_rate=1000.0))
    compensator = Compensator(calibration)
    assert compensator.compensate_block(samples(0, 40)) == []
    # What came says that those before it have none.
    (out,) = compensator.compensate_block(skewed(3.0, 5.0, 6.0))
    assert len(out) == 7
    assert (compensator.alone, compensator.waiting) == (4, 33)
    assert out.values.parity is None
    # At 57 ms a sample of 7 ms has waited for fifty.
    (out,) = compensator.compensate_block(samples(40, 58))
    assert out.stamp.tolist() == at(7.0).tolist()
    assert (compensator.alone, compensator.waiting) == (5, 50)
    ended = compensator.finish()
    assert sum(map(len, ended)) == 50
    assert (compensator.alone, compensator.waiting) == (55, 0)


def test_values_of_the_same_stamp_belong_together():
    # Four gyros of ideal axes: the fourth sees (x + y + z) / sqrt(3).
    model = SensorModel(skewed=with_skew().skewed)
    compensator = Compensator(known(BRICK, model))
    stamps = [*range(33), 40.5]
    compensator.compensate_block(SkewBlock(at(*stamps), np.full(34, 3**0.5)))
    (out,) = compensator.compensate_block(samples(0, 33, 1.0))
    assert compensator.alone == 0
    assert out.values.parity is not None
    assert np.abs(out.values.parity).max() < 2e-5
    assert out.values.rate == pytest.approx(np.full((33, 3), 1e-3), abs=1e-5)


def test_a_calibration_that_cannot_be_applied_leaves_the_one_before():
    compensator = Compensator(brick_at(20.0, 3.0))
    flat = known(BRICK, SensorModel(Triad(np.diag([0.0, 0.0, -1.0]), np.zeros(3))))
    with pytest.raises(NotObservable):
        compensator.replace(flat)
    assert rates(compensator.compensate_block(samples(0, 40))) == pytest.approx([-3.0] * 40)
    compensator.replace(brick_at(20.0, 4.0))
    assert rates(compensator.compensate_block(samples(40, 42))) == pytest.approx([-4.0] * 2)
    # The temperature in use is that of the other, too.
    compensator.compensate_block(temperature(0, 30.0))
    compensator.compensate_block(samples(600, 601))
    compensator.replace(combine([brick_at(0.0, 0.0), brick_at(100.0, 100.0)], ['a', 'b']))
    assert not compensator.waits_for_temperature
    assert rates(compensator.compensate_block(samples(601, 602))) == pytest.approx([-30.0])


@pytest.mark.parametrize('interval', [0.0, -0.001])
def test_a_sample_without_an_interval_is_alone_as_it_is_among_many(interval):
    spec = replace(BRICK, units=Units.PULSES)
    compensation = Compensation(known(spec, SensorModel(), random_walk=[1e-3] * 6))
    gyro, accel, tau = np.ones((2, 3)), np.ones((2, 3)), np.full(2, interval)
    with np.errstate(divide='ignore', invalid='ignore'):
        alone = compensation.apply(gyro[:1], accel[:1], tau[:1])
        whole = compensation.apply(gyro, accel, tau)
    for name in ('rate', 'force', 'rate_covariance', 'force_covariance', 'marks'):
        assert np.array_equal(getattr(alone, name), getattr(whole, name)[:1], equal_nan=True)
    assert bool(alone.marks & Mark.NO_NUMBER) is (interval == 0)


def plainly(stamps: Any) -> tuple[list[float], int, int]:
    """Intervals by the rules alone: what is learnt, what is regular, the mean of 1024 at most."""
    out: list[float] = []
    lost = odd = 0
    rest = [int(s) for s in stamps]
    until = 33

    def many_at_a_time() -> bool:
        """A quarter of the steps below half of what they are over half of the samples."""
        steps, half = np.diff(rest[:until]), -(-(until - 1) // 2)
        over = np.array(rest[half:until]) - np.array(rest[: until - half])
        short = np.mean(steps < 0.5 * np.median(over) / half)
        return bool(short >= 0.25 or np.median(steps) <= 0)

    while many_at_a_time():
        until += 33

    def learn(steps: list[int]) -> tuple[float, float, list[tuple[int, bool]]]:
        middle = float(np.median(steps))
        wide = 0.5 * middle + 6 * 1.4826 * float(np.median(np.abs(np.array(steps) - middle)))
        return middle, wide, [(s, abs(s - middle) <= wide) for s in steps]

    first = [b - a for a, b in pairwise(rest[:until])]
    middle, wide, known_ones = learn(first)
    odd += sum(not good for _, good in known_ones)
    run: list[int] = []

    def mean() -> float:
        good = [s for s, regular in known_ones[-1024:] if regular]
        return sum(good) / len(good) * 1e-9

    out += [mean()] * until
    for before, now in pairwise(rest[until - 1 :]):
        step = now - before
        regular = abs(step - middle) <= wide
        run = [] if regular else [*run, step]
        odd += not regular
        known_ones.append((step, regular))
        out.append(mean())
        if len(run) == 32:
            if np.median(run) > 0:
                middle, wide, known_ones = learn(run)
                odd += sum(not good for _, good in known_ones)
            run = []
    return out, odd, lost


def awkward() -> Any:
    """Jitter, gaps, jumps back, 33 stamps that stand still, and a rate that changes."""
    rng = np.random.default_rng(3)
    steps = 5 * MS + rng.integers(-400_000, 400_000, 2600)
    steps[:33] = 0
    steps[[40, 300, 301]] = 30 * MS
    steps[500:531] = 30 * MS
    steps[900] = -(10**10)
    steps[1200:1240] = -MS
    steps[1700:] = 2 * MS + rng.integers(-100_000, 100_000, 900)
    return START + np.cumsum(steps)


@pytest.mark.parametrize('size', [1, 3, 700, 10**6])
def test_intervals_are_those_of_the_rules(size):
    stamps = awkward()
    if size == 1:
        stamps = stamps[:1300]
    clock = SampleClock()
    parts = [clock.time_samples(stamps[k : k + size]).interval for k in range(0, len(stamps), size)]
    found = np.concatenate([*parts, clock.finish().interval])
    wanted, odd, lost = plainly(stamps)
    assert found == pytest.approx(np.array(wanted), rel=1e-12)
    assert (clock.irregular_steps, clock.lost) == (odd, lost)
    assert clock.waiting == 0


@pytest.mark.parametrize(('late', 'odd'), [(0.49, 0), (0.51, 1)])
def test_a_step_is_odd_that_is_half_an_interval_longer(late, odd):
    clock = SampleClock()
    clock.time_samples(at(*range(40)))
    clock.time_samples(at(40 + late))
    assert clock.irregular_steps == odd
    assert clock.typical == pytest.approx(1e-3)


def test_few_samples_are_timed_at_the_end_by_all_of_their_steps():
    clock = SampleClock()
    assert len(clock.time_samples(at(0.0, 1.0, 2.1)).interval) == 0
    assert clock.waiting == 3
    # Steps of 1.0 and 1.1 ms; of two stamps alike, or of one, nothing is told.
    assert clock.finish().interval == pytest.approx([1.05e-3] * 3)
    for stamps in ((0.0,), (1.0, 1.0), (2.0, 1.0)):
        clock = SampleClock()
        clock.time_samples(at(*stamps))
        assert len(clock.finish().interval) == 0
        assert clock.lost == len(stamps)
    # Thirty-three are enough, and thirty-two are not.
    clock = SampleClock()
    assert len(clock.time_samples(at(*range(32))).interval) == 0
    assert len(clock.time_samples(at(32.0)).interval) == 33
