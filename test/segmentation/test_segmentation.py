"""The pieces of segmentation on hand-made arrays."""

import re
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sessions import SITE, fed, gathered, paper_imu, quick_plan, session

from imu_calib.common.stream import Floats, ImuBlock, Stamps
from imu_calib.common.units import DEG
from imu_calib.estimation.setup import Setup
from imu_calib.segmentation.clock import ClockSample, fit_clock
from imu_calib.segmentation.dwells import find_step, read_dwell, sound_samples
from imu_calib.segmentation.intake import StampOrder
from imu_calib.segmentation.plateaus import find_turns
from imu_calib.segmentation.segmented import Rejected
from imu_calib.segmentation.segments import Statistics
from imu_calib.segmentation.statistics import (
    Samples,
    Sensor,
    gap_free,
    pooled_walk,
    sample_period,
    statistics_at_rest,
)
from imu_calib.segmentation.table_motion import JointTracker, Motion, Rest
from imu_calib.session.imu import load_imu
from imu_calib.session.table import load_table

NS = 1_000_000_000
PULSE = 1e-3
NO_WALK = np.zeros(6)


def seconds(times: Any) -> Stamps:
    return np.rint(np.asarray(times) * 1e9).astype(np.int64)


def samples(increments: Floats, period: float, quantum: float = 0.0, grid: float = 0.0) -> Samples:
    """Gap-free samples from 0 on, one column for all six channels or six columns."""
    columns = increments if increments.ndim == 2 else np.tile(increments[:, None], 6)
    stamp = seconds((np.arange(len(columns)) + 1) * period)
    return Samples(stamp, columns, np.full(6, quantum), period, np.full(6, grid))


# Stamps.


def test_the_period_is_that_of_the_line_through_the_longest_run():
    # The end points of the long run err by +-0.2 s; a line by a fraction: 0.4 * 6 / 100 / 100.
    stamp = np.arange(100.0)
    stamp[0], stamp[-1] = -0.2, 99.2
    stamp = np.concatenate([stamp, 200 + 1.5 * np.arange(20)])
    assert sample_period(seconds(stamp)) == pytest.approx(1.0, abs=0.4 * 6 / 100**2)
    assert sample_period(seconds([5.0, 7.0])) == 2.0


@given(st.lists(st.floats(0, 3), min_size=12, max_size=40))
def test_samples_that_are_a_few_places_late_are_sorted(late):
    # One sample is dropped before it is known that they come out of order.
    places = np.argsort(np.arange(len(late)) + late, kind='stable')
    order = StampOrder(1, 8)
    parts = [order.drop_disordered(places, places[:, None].astype(float)), order.finish()]
    kept = [stamp for part in parts for stamp in part.stamp.tolist()]
    assert kept == [value for part in parts for value in part.values[:, 0].tolist()]
    assert kept == sorted(kept)
    lost = [stamp for part in parts for stamp in part.lost.tolist()]
    assert sorted([*kept, *lost]) == list(range(len(late)))
    assert len([k for k in lost if k < len(late) - 8]) <= 1


def test_wild_stamps_among_samples_out_of_order_are_dropped():
    order = StampOrder(1, 8)
    stamps = np.array([0, 2, 1, *range(3, 20), 900, 901, -900, *range(20, 40)])
    parts = [order.drop_disordered(stamps, stamps[:, None].astype(float)), order.finish()]
    assert [part.lost.tolist() for part in parts] == [[2, 900, 901, -900], []]
    assert [k for part in parts for k in part.stamp.tolist()] == [0, 1, *range(3, 40)]


@pytest.mark.parametrize('places', [1, 8])
@given(st.lists(st.integers(0, 30), max_size=20), st.lists(st.integers(0, 20), max_size=3))
def test_the_order_of_stamps_does_not_depend_on_block_boundaries(places, stamps, cuts):
    def kept(edges):
        order, result = StampOrder(1, places), []
        for a, b in pairwise(edges):
            part = np.array(stamps[a:b], dtype=np.int64)
            result += order.drop_disordered(part, part[:, None].astype(float)).stamp.tolist()
        return [*result, *order.finish().stamp.tolist()]

    whole = kept([0, len(stamps)])
    assert kept([0, *sorted(min(c, len(stamps)) for c in cuts), len(stamps)]) == whole
    assert all(b > a for a, b in pairwise(whole))


# Rests and motions of the table.


def ramp(rate: float, before: float, turning: float, after: float, step: float) -> Motion:
    """A joint that stands, turns at a constant rate from one instant to the next, and stands."""
    time = np.arange(0.0, before + turning + after + step / 2, step)
    angle = rate * np.clip(time - before, 0.0, turning)
    return Motion(0, int(time[-1] * NS), seconds(time), angle[:, None])


@pytest.mark.parametrize(('silence', 'turned'), [(10.0, 90.0), (10_000.0, 180.0), (100.0, 0.1)])
def test_a_table_that_stands_elsewhere_after_a_silence_has_moved(silence, turned):
    standing = np.arange(0.0, 3.0, 0.05)
    stamp = seconds(np.concatenate([standing, standing + 3.0 + silence]))
    position = np.repeat([0.0, turned * DEG], len(standing))[:, None]
    tracker = JointTracker()
    first, between, last = [*tracker.track(stamp, position), *tracker.finish()]
    assert isinstance(first, Rest)
    assert first.angles == pytest.approx([0.0])
    assert first.end < 3.0 * NS
    assert isinstance(between, Motion)
    assert isinstance(last, Rest)
    assert last.start > (3.0 + silence) * NS
    assert last.angles == pytest.approx([turned * DEG])


def test_whole_turns_lie_in_the_middle_of_the_constant_rate():
    # 40 deg/s from 2 s to 22 s is 800 deg: two turns of 9 s each, 1 s to spare at either end.
    (turns,) = find_turns(ramp(40 * DEG, 2.0, 20.0, 2.0, 0.01))
    assert turns.angle == pytest.approx(4 * np.pi)
    assert turns.seconds == pytest.approx(18.0, rel=1e-9)
    # The encoder is read every 10 ms and the rate is known after a window of 0.25 s.
    assert turns.start * 1e-9 == pytest.approx(3.0, abs=0.3)
    assert turns.start * 1e-9 + turns.seconds < 22.0
    (back,) = find_turns(ramp(-40 * DEG, 2.0, 20.0, 2.0, 0.01))
    assert back.angle == pytest.approx(-4 * np.pi)


@pytest.mark.parametrize('jitter', [0.0005, 0.002, 0.004])
def test_turns_are_found_under_jitter_of_the_stamps(jitter):
    exact = ramp(30 * DEG, 2.0, 23.0, 2.0, 0.01)
    noise = np.random.default_rng(1).normal(0, jitter, len(exact.stamp)).clip(-0.0045, 0.0045)
    (turns,) = find_turns(replace(exact, stamp=exact.stamp + seconds(noise)))
    # A line through the n angles of 22.5 s or so: jitter * sqrt(12 / n) / T of the rate.
    deviation = min(jitter, 0.0032) * np.sqrt(12 / 2250) / 22.5
    assert turns.seconds == pytest.approx(12.0, rel=5 * deviation)
    assert turns.rate_error == pytest.approx(deviation, rel=0.3)


def test_a_turn_is_not_read_from_samples_that_froze_just_before_it():
    # A repeated sample beside the cut is no count: 2 s of it end a tenth of a second before.
    plan = quick_plan('twelve_position', 20.0)
    plan = replace(plan, positions=plan.positions[:1])
    setup = Setup(paper_imu(), plan, load_table('three_axis'), SITE)
    blocks = list(session(plan))
    sound = gathered(fed(blocks, setup)).turns[0]
    end = sound.start - 10**8
    held: list[ImuBlock] = []

    def frozen(block):
        if not isinstance(block, ImuBlock):
            return block
        inside = (block.stamp > end - 2 * 10**9) & (block.stamp < end)
        if not inside.any():
            return block
        held.append(block)
        first = int(np.argmax(held[0].stamp > end - 2 * 10**9))
        gyro, accel = block.gyro.copy(), block.accel.copy()
        gyro[inside], accel[inside] = held[0].gyro[first], held[0].accel[first]
        return replace(block, gyro=gyro, accel=accel)

    found = gathered(fed([(topic, frozen(block)) for topic, block in blocks], setup)).turns[0]
    assert held
    assert found.start == sound.start
    read = found.statistics
    spread = np.sqrt(read.quantisation_variance + read.walk_gain * stated_walk(setup) ** 2)
    assert (np.abs(read.mean - sound.statistics.mean) < 5 * spread).all()


@pytest.mark.parametrize('sound', [0, 40])
def test_a_dwell_that_repeats_a_sample_of_the_turn_before_is_none(sound):
    # The device froze in a turn of 57 deg/s and came back, if at all, as the dwell ended.
    spec = load_imu('fog_medium')
    sensor = Sensor.from_spec(spec)
    count, rng = 370, np.random.default_rng(5)
    stamp = np.arange(1, count + 1) * 10**7
    frozen = np.rint([0.01 / spec.gyro.scale_factor, 3.0, -2.0, 10.0, 1.0, 0.0])
    values = np.tile(frozen, (count, 1))
    values[count - sound :] = np.rint(rng.normal([0.0, 0, 0, 10, 0, 0], 0.7, (sound, 6)))
    read = [sensor, sensor.samples(stamp, values), values]
    (found,) = read_dwell(*read, np.zeros(3), np.eye(3))
    assert isinstance(found, Rejected)
    assert re.search(rf'frozen for 3\.[{7 - sound // 10}] s, repeating one$', found.reason)
    # Held by hand it may turn as evenly.
    assert not any('frozen' in str(one) for one in read_dwell(*read, None, None))


def stated_walk(setup: Setup) -> Floats:
    return np.repeat([setup.imu.gyro.random_walk, setup.imu.accel.random_walk], 3)


# What of a rest is sound.


def still(count: int, rng: np.random.Generator, noise: float = 0.1) -> Floats:
    return rng.normal(0.0, noise, (count, 6)) * PULSE


def test_settling_is_cut_as_long_as_the_data_shows_it():
    rng = np.random.default_rng(0)
    time = np.arange(2000) * 0.01
    for decay in (0.3, 1.0):
        rows = still(2000, rng)
        rows[:, 1] += 50 * PULSE * np.exp(-time / decay) * np.cos(2 * np.pi * 3 * time)
        sound = sound_samples(samples(rows, 0.01), NO_WALK)
        first = int(np.argmax(sound.mask))
        # From 50 it falls below the noise of 0.1 after ln(500) = 6.2 time constants.
        assert 3 * decay < time[first] < 7 * decay + 0.5
        assert sound.mask[first:].all()
        assert sound.mount_shift is None
        assert sound.notes == ()


@pytest.mark.parametrize('rate', [1.0, 3.0])
def test_somebody_who_walks_by_is_no_mount_shift(rate):
    """Two footfalls a second for eight seconds, each sampled as noise that dies away in 0.1 s."""
    period, count, steps = 0.01, 6000, slice(2000, 2800)
    walk = np.repeat([0.3 * DEG / 60, 0.1 / 60], 3)
    for seed in range(20):
        rng = np.random.default_rng(seed)
        rows = rng.standard_normal((count, 6)) * walk * np.sqrt(period)
        rows[:, 5] += 9.8 * period
        fading = np.exp(-(np.arange(800) * period % 0.5) / 0.1)[:, None]
        shaken = rng.standard_normal((800, 6)) * np.repeat([rate * DEG, 0.3], 3) * period
        rows[steps] += fading * shaken
        sound = sound_samples(samples(rows, period), walk)
        assert sound.mount_shift is None
        assert not sound.mask[2000:2100].all()


def test_a_mount_shift_among_footfalls_is_found():
    """About a level axis, by ten times what the footfalls leave in the sum of the gyros."""
    period, rate, angle = 0.01, 0.2 * DEG, 0.2 * DEG
    walk = np.repeat([0.3 * DEG / 60, 0.1 / 60], 3)
    rng = np.random.default_rng(1)
    rows = rng.standard_normal((6000, 6)) * walk * np.sqrt(period)
    rows[:, 5] += 9.8 * period
    fading = np.exp(-(np.arange(800) * period % 0.5) / 0.1)[:, None]
    rows[2000:2800] += fading * rng.standard_normal((800, 6)) * rate * period
    rows[2400:2410, 0] += angle / 10
    # From f to f - a x f.
    rows[2410:, 4] += angle * 9.8 * period
    found = sound_samples(samples(rows, period), walk).mount_shift
    # The mean of fading^2 is a tenth.
    assert found.angle == pytest.approx(angle, abs=4 * np.sqrt(3 * 80) * rate * period)


def blocks(means: list[float], middles: list[float], gain: float = 0.1) -> Statistics:
    """Statistics whose blocks of all channels have these means."""
    row = np.array([[m, gain, 0.0, t] for m, t in zip(means, middles, strict=True)])
    zeros = np.zeros(6)
    return Statistics(1, 0, 1.0, zeros, zeros, zeros, zeros, (row,) * 6, zeros)


@pytest.mark.parametrize('count', [2, 3, 12])
def test_the_walk_of_short_rests_is_no_smaller_than_it_is(count):
    # Two blocks scatter about the mean of both by half of their variance.
    rng = np.random.default_rng(7)
    gain, walk, rests = 0.1, 3.0, 400
    draws = rng.normal(5.0, walk * np.sqrt(gain), (rests, count))
    found = pooled_walk([blocks(row.tolist(), list(range(count)), gain) for row in draws])
    relative = np.sqrt(2 / (rests * (count - 1)))
    assert found.deviation / found.square == pytest.approx(np.full(6, relative))
    assert found.square / walk**2 == pytest.approx(np.ones(6), abs=3 * relative)


def test_short_blocks_after_a_gap_are_no_step():
    # A block's mean of a counter errs by up to a pulse over its length: 0.5 s against 10 s.
    rng = np.random.default_rng(4)
    rows = np.diff(np.floor(np.cumsum(np.full(2000, 9.7) + rng.normal(0, 0.02, 2000))), prepend=0)
    whole = samples(np.maximum(rows, 0.0) * PULSE, 0.01, quantum=PULSE)
    kept = np.ones(2000, dtype=bool)
    kept[120:300] = kept[301:310] = False
    walk = np.full(6, 0.2 * PULSE)
    statistics = statistics_at_rest(whole.at(kept), walk)
    assert statistics.missing == 2000 - kept.sum()
    assert statistics.samples == kept.sum()
    assert find_step(statistics, walk) is None
    # The run of a single sample has no block of its own.
    assert all(len(b) and np.isfinite(b).all() for b in statistics.blocks)
    # Over 1.2 s and 16.9 s a pulse is 0.83 and 0.06 per second.
    assert statistics.mean / PULSE == pytest.approx(np.full(6, 970.0), abs=0.1)


# Clocks.


def offsets(values: list[float]) -> list[ClockSample]:
    return [ClockSample(k * 50e9, v) for k, v in enumerate(values)]


def test_an_interruption_parts_the_line_however_little_it_jumps():
    line = [0.01 + 50e-6 * 50 * k for k in range(8)]
    jumped = offsets([*line[:4], *(v + 0.001 for v in line[4:])])
    assert fit_clock(jumped, [175_000_000_000]).rate == pytest.approx(50e-6)
    assert fit_clock(jumped, [175_000_000_000]).jumps == pytest.approx((0.001,))
    # Unknown it would pass for a rate, and for scale factors that are off by as much.
    assert abs(fit_clock(jumped).rate - 50e-6) > 1e-6


def test_a_gap_beside_few_samples_is_one():
    # Half of two steps is the gap: it is no jitter.
    stamps = np.array([0, 14_310_000_000, 14_320_000_000])
    assert gap_free(stamps, 0.01) == [(0, 1), (1, 3)]


def test_a_snapshot_holds_what_was_found_and_goes_on_by_itself():
    setup = Setup(paper_imu(), quick_plan('six_position', 20.0), load_table('three_axis'), SITE)
    blocks = list(session(setup.plan))
    half = len(blocks) // 2
    going = fed(blocks[:half], setup)
    snapshot = going.snapshot()
    found = going._segmenter.segments
    assert found
    assert all(a is b for a, b in zip(found, snapshot._segmenter.segments, strict=True))
    for one in (going, snapshot):
        for _, block in blocks[half:]:
            one.add_block(block)
    one, other = (c._segmenter.finish() for c in (going, snapshot))
    pairs = zip(one.segments, other.segments, strict=True)
    assert all(np.array_equal(a.statistics.mean, b.statistics.mean) for a, b in pairs)
