"""Stamps far from when samples were made: queues, clocks seconds apart; samples that freeze."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from extent import ALL, again
from sessions import Named, at_one_rate, calibrate, paper_imu, quick_plan, recut, session, stand

from imu_calib.common.stream import Floats, ImuBlock, JointBlock, Stamps
from imu_calib.common.units import DEG
from imu_calib.segmentation.clock import offset_by_pattern
from imu_calib.segmentation.segmenter import Segmenter
from imu_calib.segmentation.stamp_faults import Interruptions, Lateness
from imu_calib.segmentation.stamps import clock_steps, sampling_times
from imu_calib.segmentation.table_motion import Motion
from imu_calib.session.plan import Plan
from imu_calib.session.table import Joint, Table, load_table
from imu_calib.simulation.options import Delivery

START = 1_700_000_000 * 10**9
TABLE = Table('bench', (Joint('a', (1.0, 0.0, 0.0)), Joint('b', (0.0, 0.0, 1.0))))
INTERVAL = 0.01

# Queues


def queue(seed: int, late: float, delay: float, jitter: float = 0.0) -> tuple[Stamps, Floats]:
    """Stamps of 40 s at 100 Hz of which a share is held up, and when samples were made, s."""
    rng = np.random.default_rng(seed)
    made = INTERVAL * np.arange(1, 4001)
    held = rng.exponential(delay, len(made)) * (rng.random(len(made)) < late)
    behind = 20e-6 * np.arange(len(made))
    came = np.maximum.accumulate(made + held + jitter * rng.standard_normal(len(made)) - behind)
    return START + np.rint((came + behind) * 1e9).astype(np.int64), made


@pytest.mark.parametrize('seed', range(5))
@pytest.mark.parametrize(('late', 'delay'), [(0.05, 0.1), (0.05, 0.05), (0.02, 0.2)])
def test_a_queue_goes_back_to_when_its_samples_were_made(late, delay, seed):
    stamp, made = queue(seed, late, delay)
    off = (sampling_times(stamp)[0] - START) * 1e-9 - made
    assert ((stamp - START) * 1e-9 - made).max() > 20 * INTERVAL
    # But for the last, of which nothing that follows tells; 20 us are what a queue is read out by.
    assert np.abs(off[:-512]).max() < 1e-4


def test_what_is_missing_is_no_queue():
    stamp, made = queue(1, 0.05, 0.1)
    kept = np.delete(np.arange(4000), np.r_[700:703, 2000:2020])
    off = (sampling_times(stamp[kept])[0] - START) * 1e-9 - made[kept]
    assert np.abs(off[:-512]).max() < 1e-4


@pytest.mark.parametrize('seed', range(5))
def test_of_a_queue_that_goes_on_beyond_what_is_looked_at_no_sample_is_missing(seed):
    """Those in it come late, be it by no whole number of intervals."""
    stamp, made = queue(seed, 0.05, 0.1)
    late = (stamp - START) * 1e-9 - made
    inside = np.flatnonzero(late > 0.5 * INTERVAL)
    for end in inside[inside > 3000][::20].tolist():
        off = (sampling_times(stamp[:end])[0] - START) * 1e-9 - made[:end]
        assert np.abs(off).max() < 1e-4
        assert clock_steps(sampling_times(stamp[:end])[0]) == []


def silences(*, missing: int, held: int, jitter: float = 0.0, rate: int = 100) -> list[float]:
    """How long a stream is interrupted where samples are missing and others are held up, s."""
    rng = np.random.default_rng(1)
    made = np.arange(4000) / rate + jitter * rng.standard_normal(4000)
    made[2000:] += missing / rate
    came = made.copy()
    came[2000 : 2000 + held] = made[2000 + held] + 20e-6 * (np.arange(held) - held)
    stamp = START + np.rint(came * 1e9).astype(np.int64)
    found = []
    for cut in (4000, 37, 1):
        stream = Interruptions()
        for k in range(0, 4000, cut):
            stream.add_stamps(stamp[k : k + cut])
        found.append(stream.found)
    assert found[0] == found[1] == found[2]
    return [(begins - last) * 1e-9 for last, begins in found[0]]


@pytest.mark.parametrize('jitter', [0.0, 1e-3, 2e-3])
def test_what_comes_late_is_no_interruption(jitter):
    for held in (90, 110, 150, 500):
        assert silences(missing=0, held=held, jitter=jitter) == []
    assert silences(missing=0, held=1500, rate=1000) == []
    near = pytest.approx(2.01, abs=0.02)
    assert silences(missing=200, held=0, jitter=jitter) == [near]
    # Of a stop of 3.5 s the samples of 1.5 s were held up.
    assert silences(missing=200, held=150, jitter=jitter) == [near]


@pytest.mark.parametrize('jitter', [1.5e-3, 2e-3, 3e-3, 5e-3])
@pytest.mark.parametrize('late', [0.0, 0.05])
def test_jittering_stamps_stay(late, jitter):
    """Their interval is known too badly to say what was made when."""
    for seed in range(20):
        jittery, _ = queue(seed, late, 0.1, jitter)
        assert sampling_times(jittery)[0] is jittery


@pytest.mark.parametrize('share', [0.005, 0.05])
def test_what_is_late_is_said_and_nothing_else(share):
    """By how much, and that it counts when it was made; no clock was set, nothing is missing."""
    late = Delivery(late=share, delay=0.1)
    for seed in (2, 3):
        reader = Segmenter(paper_imu(), load_table('three_axis'))
        for _, block in session(plan(), stand(delivery=late), seed=seed):
            reader.add_block(block)
        (losses,) = reader.finish().losses
        found = re.match(
            r'(\d+) IMU samples \((.*) %\) are stamped late, by up to (.*?), the', losses
        )
        assert found, losses
        # A queue behind each: of Poisson's process 1 - exp(-rate delay) of the time.
        assert float(found[2]) == pytest.approx(100 * (1 - np.exp(-share * 10)), rel=0.25)


def test_a_few_late_samples_are_not_worth_a_sentence():
    few = Lateness()
    stamp = START + 10**7 * np.arange(2000)
    few.count_late(stamp, np.where(np.arange(2000) == 7, 2 * 10**7, 0), INTERVAL)
    assert (few.count, few.words(2000), len(few.words(900))) == (1, [], 1)
    few.count_late(stamp, np.where(np.arange(2000) == 7, 12 * 10**8, 0), INTERVAL)
    assert few.words(20_000) == [
        '2 IMU samples (0.01 %) are stamped late, by up to 1.2 s, the first at 2023-11-14 '
        '22:13:20.070 UTC: they were delayed on their way, and their times follow from '
        'those that came in time'
    ]
    jitter = Lateness()
    jitter.count_late(stamp, np.resize([-2, 2, 1, 0], 2000) * 10**7, INTERVAL)
    assert jitter.count == 0


# Clocks apart


def motion(start: float, rate: float, seconds: float) -> Motion:
    """Joint b turns at a rate, deg/s, for so long, with half a second of ramp at both ends."""
    time = np.arange(start - 1, start + seconds + 1, INTERVAL)
    knots = [start, start + 0.5, start + seconds - 0.5, start + seconds]
    speed = rate * DEG * np.interp(time, knots, [0, 1, 1, 0])
    stamp = START + np.rint(time * 1e9).astype(np.int64)
    angle = np.cumsum(speed) * INTERVAL
    return Motion(
        int(stamp[0]), int(stamp[-1]), stamp, np.column_stack([np.zeros_like(angle), angle])
    )


def by_gyros(motions: list[Motion], ahead: float, factor: float = 1.0) -> tuple[Stamps, Floats]:
    """The angle that gyros turned, whose clock is ahead, with a bias and a misalignment."""
    time = np.arange(-80.0, 250.0, INTERVAL)
    table = np.zeros(len(time))
    for one in motions:
        table += np.interp(time, (one.stamp - START) * 1e-9, one.position[:, 1])
    turned = factor * table[:, None] * [0.002, 0.0, 1.0] + time[:, None] * [1e-4, 0.0, -2e-4]
    return START + np.rint((time + ahead) * 1e9).astype(np.int64), turned


DIFFERENT = [motion(70, 30, 4), motion(90, 20, 12), motion(120, 60, 7), motion(131, 10, 9)]


@pytest.mark.parametrize('ahead', [-57.3, -20.0, 0.0, 2.0, 20.0, 57.3])
@pytest.mark.parametrize('factor', [1.0, 1.01])
def test_motions_tell_how_far_clocks_are_apart(ahead, factor):
    found = offset_by_pattern(DIFFERENT, TABLE, START, *by_gyros(DIFFERENT, ahead, factor))
    assert found == pytest.approx(ahead, abs=0.1)


def test_nothing_tells_where_no_offset_or_more_than_one_makes_motions_alike():
    # Beyond a minute, of gyros that answer half, of other motions.
    for ahead, factor in ((75.0, 1.0), (2.0, 0.5)):
        gyros = by_gyros(DIFFERENT, ahead, factor)
        assert offset_by_pattern(DIFFERENT, TABLE, START, *gyros) is None
    others = by_gyros([motion(65, 40, 15)], 2.0)
    assert offset_by_pattern(DIFFERENT, TABLE, START, *others) is None
    # The same motion every twenty seconds: one of them, whose joint states begin with it, is seen
    # at four offsets. All of them, or one before which the table stood for long, at one.
    alike = [motion(start, 30, 4) for start in (70, 90, 110, 130)]
    gyros = by_gyros(alike, 2.0)
    assert offset_by_pattern(alike[1:2], TABLE, alike[1].start, *gyros) is None
    assert offset_by_pattern(alike, TABLE, START, *gyros) == pytest.approx(2.0, abs=0.1)


# Sessions


@cache
def plan() -> Plan:
    return at_one_rate(quick_plan('twelve_position', 8.0))


def held_up() -> list[Named]:
    late = Delivery(late=0.05, delay=0.1)
    return list(session(plan(), stand(delivery=late), seed=1))


def apart() -> list[Named]:
    return list(session(plan(), stand(clock_offset=20.0), seed=1))


def bunched() -> list[Named]:
    return list(session(plan(), stand(delivery=Delivery(bunch=20)), seed=1))


@pytest.mark.parametrize('of', [held_up, apart, again(bunched)])
def test_cuts_and_interleaving_do_not_change_a_bit(of):
    assert callable(of)
    blocks = of()
    whole = calibrate(blocks, plan()).calibration.to_yaml()
    for seed in (1, 2) if ALL else (1,):
        assert calibrate(recut(blocks, seed), plan()).calibration.to_yaml() == whole


@pytest.mark.parametrize('name', ['optimised_twelve', 'full_model'])
@pytest.mark.parametrize('ahead', [-1.7, 20.0])
def test_sessions_that_begin_with_turns_of_minutes_tell_how_far_clocks_are_apart(name, ahead):
    """Turns are as alike seconds apart, and their rate was taken for the gyros' offset."""
    whole = quick_plan(name, 8.0)
    first = replace(whole, positions=whole.positions[:3])
    reader = Segmenter(paper_imu(), load_table('three_axis'))
    for _, block in session(first, stand(clock_offset=ahead), seed=1):
        reader.add_block(block)
    found = reader.finish()
    assert len(found.segments) == 3
    assert found.clock.offset == pytest.approx(ahead, abs=0.01)


def test_counts_that_freeze_within_a_motion_leave_it_out_and_are_named():
    blocks = list(session(plan(), seed=1))
    joints = [b for _, b in blocks if isinstance(b, JointBlock)]
    stamp = np.concatenate([b.stamp for b in joints])
    moving = np.any(np.diff(np.concatenate([b.position for b in joints]), axis=0) != 0, axis=1)
    # The first motion between two dwells, from before it begins until after it ends.
    edges = np.flatnonzero(np.diff(moving.astype(int)))
    begin, end = stamp[edges[:2]] + np.array([-(10**8), 3 * 10**8])
    last: tuple[Floats, Floats] | None = None
    frozen: list[Named] = []
    for name, block in blocks:
        if isinstance(block, ImuBlock):
            gyro, accel = block.gyro.copy(), block.accel.copy()
            for k in np.flatnonzero((block.stamp >= begin) & (block.stamp <= end)).tolist():
                if last is None:
                    last = gyro[k].copy(), accel[k].copy()
                gyro[k], accel[k] = last
            frozen.append((name, replace(block, gyro=gyro, accel=accel)))
        else:
            frozen.append((name, block))
    found = calibrate(frozen, plan()).calibration
    findings = [f for f in found.findings if 'are frozen' in f]
    assert len(findings) == 1, found.findings
    assert findings[0].startswith(
        'Warning: The samples are frozen (one is repeated) in 1 motion of the table'
    )
    assert not [f for f in found.findings if 'clocks that jump' in f]
