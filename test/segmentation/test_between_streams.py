"""What a session makes of motions, clocks and lost samples, one decision at a time."""

import numpy as np
import pytest
from ideal import mean_of

from imu_calib.common.stream import Floats, Units
from imu_calib.segmentation.clock import NO_CLOCK, ClockFit, MeasuredShare
from imu_calib.segmentation.gaps import Bridged
from imu_calib.segmentation.intake import StreamBuffer
from imu_calib.segmentation.reading import IntervalReader, SeenMotion
from imu_calib.segmentation.segmented import MountShift
from imu_calib.segmentation.segmenter import Segmenter, clock_jumps, reject_hidden
from imu_calib.segmentation.segments import Segment
from imu_calib.segmentation.stamp_faults import interruption
from imu_calib.segmentation.statistics import Samples, Sensor
from imu_calib.segmentation.stream_facts import Repetition
from imu_calib.segmentation.table_motion import Motion
from imu_calib.session.imu import ImuSpec, TriadSpec
from imu_calib.session.table import Joint, Table

START = 1_700_000_000 * 10**9  # 2023-11-14 22:13:20
NS = 10**9
SPEC = ImuSpec('any', Units.SI, None, TriadSpec(), TriadSpec())
TABLE = Table('bench', (Joint('a', (1.0, 0.0, 0.0)), Joint('b', (0.0, 0.0, 1.0))))
NONE = np.zeros(6)


def reader() -> IntervalReader:
    return IntervalReader(Sensor.from_spec(SPEC), TABLE, StreamBuffer(TABLE, skewed=False))


def seen(middle: float, share: MeasuredShare, repetition: Repetition) -> SeenMotion:
    return SeenMotion(middle * NS, share, repetition)


# Sentences


def test_a_jump_is_said_that_is_a_tenth_of_a_millisecond_at_least():
    jumps, least = (0.0502, -0.3, 0.002, 0.001), (0.99e-4, 1.01e-4, 0.0, 2e-4)
    fit = ClockFit(0.0, 0.0, 0.0, 0.0, 0.0, 9, jumps, least)
    assert clock_jumps(fit) == [
        'The clocks of IMU and table jump by -0.3000 s against each other',
        'The clocks of IMU and table jump by +0.0010 s against each other',
    ]
    assert clock_jumps(NO_CLOCK) == []


def test_an_interruption_is_told_by_its_length_and_its_beginning():
    assert interruption(START + 5 * NS, START + 7 * NS + 340_000_000) == (
        'The IMU stream was interrupted: 2.3 s are missing, from 2023-11-14 22:13:25.000 UTC'
    )


def test_lost_samples_are_told_by_their_share():
    held = Segmenter(SPEC, TABLE)
    held._intake.facts.samples, held._reader.bridged = 17, 3
    held._reader.off_grid = {START + 9 * NS, START + 2 * NS}
    held._intake.interruptions.add_stamps(np.array([START, START + 2 * NS]))
    assert held._loss_sentences() == (
        '3 IMU samples are missing (15 %), a few at a time: their values are interpolated from '
        'those around them',
        'The stamps of the IMU are offset from the sampling grid 2 times, first at 2023-11-14 '
        '22:13:22.000 UTC: its clock was set, or it restarted sampling; the data before and after '
        'are used separately',
        'The IMU stream was interrupted: 2.0 s are missing, from 2023-11-14 22:13:20.000 UTC',
        'There are no joint states of table bench',
    )


def test_what_is_lost_counts_after_the_beginning_and_up_to_the_end():
    stamp = np.arange(1, 9) * 100
    samples = Samples(stamp, np.zeros((8, 6)), NONE, 1e-7, NONE)
    whole = Bridged(samples, np.array([-1, 0, -1, -1, 1, 2, -1, -1]))
    for start, end, lost in ((0, 900, 5), (100, 900, 4), (99, 700, 4), (100, 699, 2)):
        held = reader()
        held._note_lost(whole, start, end)
        held._note_lost(whole, start, end)
        assert held.bridged == 2 * lost


# Motions that the gyros did not see


def kept_middles(angles: list[float], times: list[float]) -> list[float]:
    """Rests, each with a shock, around motions at 10, 20 and 30 s: the middles that are kept."""
    held = reader()
    held.seen_motions = [
        seen(10.0 * (k + 1), MeasuredShare(*share), Repetition(100, 0.0, 0))
        for k, share in enumerate(zip(angles, times, strict=True))
    ]
    # The middle is what counts: each ends within a motion.
    middles = [5, 15, 25, 35]
    held.found.segments = [Segment((m - 6) * NS, (m + 6) * NS, mean_of(NONE)) for m in middles]
    held.found.mount_shifts = [MountShift(m * NS, 0.1) for m in middles]
    assert reject_hidden(held) == (0, 0)
    kept = [(s.start + s.end) / 2 / NS for s in held.found.segments]
    assert [shift.instant / NS for shift in held.found.mount_shifts] == kept
    gone = [(r.start // NS, r.end // NS) for r in held.found.rejected]
    assert gone == [(m - 6, m + 6) for m in middles if m not in kept]
    reason = (
        'the gyros do not show the motion next to it that the joint states show (clocks that jump, '
        'or are about a second apart)'
    )
    assert {r.reason for r in held.found.rejected} <= {reason}
    return kept


def test_a_dwell_that_repeats_the_sample_of_a_frozen_motion_is_frozen_itself():
    """Of the last of four motions one sample is all there is; so it is of the dwell before it."""
    values = np.zeros((60, 6))
    values[:, 3] = 9.0
    sound = np.random.default_rng(0).normal(size=(60, 6))
    held = reader()
    whole, frozen = Repetition.count_in(sound, sound), Repetition.count_in(values, values)
    held.seen_motions = [seen(10.0 * k, MeasuredShare(1.0, 1.0), whole) for k in (1, 2, 3)]
    held.seen_motions.append(seen(40.0, MeasuredShare(0.1, 0.1), frozen))
    assert np.array_equal(frozen.sample, values[0])
    # The mean of samples that are alike, by an interval that is a little off; others; and the same
    # far from the frozen motion.
    means = [values[0], values[0], 1.0001 * values[0], values[0] + [0, 1e-4, 0, 0, 0, 0]]
    middles = [5, 15, 35, 45]
    held.found.segments = [
        Segment((m - 3) * NS, (m + 3) * NS, mean_of(mean))
        for m, mean in zip(middles, means, strict=True)
    ]
    assert reject_hidden(held) == (1, 40 * NS)
    assert [s.start // NS + 3 for s in held.found.segments] == [5, 15, 45]
    (gone,) = held.found.rejected
    assert gone.start == 32 * NS
    assert gone.reason == 'its samples are frozen, repeating the one of the motion next to it'


@pytest.mark.parametrize(
    ('angles', 'times', 'kept'),
    [
        ([1.2, 0.74, 1.2], [0.0, 0.74, 0.0], [5, 35]),
        ([0.1, 1.2, 1.2], [0.0, 0.0, 0.0], [25, 35]),
        ([1.2, 1.2, 0.1], [0.0, 0.0, 0.0], [5, 15]),
        # Three quarters of the angle or of the time are seen.
        ([1.2, 0.76, 1.2], [0.0, 0.0, 0.0], [5, 15, 25, 35]),
        ([1.2, 0.1, 1.2], [0.0, 0.76, 0.0], [5, 15, 25, 35]),
        # Where all are alike within a half, it is the scale factor.
        ([1.0, 0.67, 1.0], [0.0, 0.0, 0.0], [5, 15, 25, 35]),
        ([1.0, 0.66, 1.0], [0.0, 0.0, 0.0], [5, 35]),
        ([0.1, 0.1, 0.1], [0.0, 0.0, 0.0], [5, 15, 25, 35]),
        ([], [], [5, 15, 25, 35]),
    ],
)
def test_rests_beside_a_motion_that_was_not_seen_do_not_count(angles, times, kept):
    assert kept_middles(angles, times) == kept


# A motion during which the clock was set


def left_out(period_ms: int, at: int, count: int = 100) -> list[int]:
    """Rows that are left out where stamps go on 0.4 intervals late."""
    late = np.where(np.arange(count) >= at, 0.4, 0.0)
    stamp = START + np.rint((np.arange(count) + late) * period_ms * 1e6).astype(np.int64)
    held = reader()
    rows = np.arange(6.0 * count).reshape(count, 6)
    kept, values, late = held._without_clock_steps(stamp, rows, np.arange(count))
    assert late.tolist() == (values[:, 0] / 6).tolist()
    gone = np.flatnonzero(~np.isin(stamp, kept)).tolist()
    assert values[:, 0].tolist() == [6.0 * k for k in range(count) if k not in gone]
    assert held.off_grid == ({int(stamp[at])} if gone else set())
    return gone


def test_around_a_step_of_the_clock_more_is_left_out_than_gaps_that_are_filled():
    # Gaps of a tenth of a second are filled: half of it and one on either side.
    assert left_out(10, 50) == list(range(44, 56))
    assert left_out(20, 50) == list(range(47, 53))
    assert left_out(10, 4) == list(range(10))
    assert left_out(10, 100) == []


# The clocks of table and IMU


def compared(other: float, joint: int) -> IntervalReader:
    """A joint that turns by 1 rad within 2 s, and another one that turns by `other`."""
    states = np.arange(0.0, 2.001, 0.02)
    time = np.arange(-1.0, 3.0, 0.01)

    def smooth(t: Floats) -> Floats:
        part = np.clip(t / 2, 0, 1)
        return np.asarray(part - np.sin(2 * np.pi * part) / (2 * np.pi))

    position = np.zeros((len(states), 2))
    position[:, joint], position[:, 1 - joint] = smooth(states), other * smooth(states)
    stamp = START + np.rint(states * 1e9).astype(np.int64)
    # The IMU's clock is 3 ms ahead.
    imu = START + np.rint((time + 0.003) * 1e9).astype(np.int64)
    rows = np.zeros((len(time), 6))
    rows[:, 2 * joint] = np.diff(smooth(time), prepend=0.0)
    held = reader()
    motion = Motion(int(stamp[0]), int(stamp[-1]), stamp, position)
    held._compare_clocks(motion, Samples(imu, rows, NONE, 0.01, NONE), TABLE)
    return held


@pytest.mark.parametrize('joint', [0, 1])
def test_motions_of_one_joint_tell_how_far_clocks_are_apart(joint):
    held = compared(0.0, joint)
    (found,) = held.clock
    assert found.offset == pytest.approx(0.003, abs=1e-5)
    assert held.offset_ns == round(found.offset * 1e9)
    # Of the others a hundredth of its travel.
    assert len(compared(0.0099, joint).clock) == 1
    assert compared(0.0101, joint).clock == []
    assert compared(0.0101, joint).offset_ns == 0
