"""Samples that share a stamp, queue or come late, compensated: none is lost, and all in time.

When each was made is what the second simulator says; lines and readers are plain loops.
"""

import random
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from calibrations import known
from other_world import Damage, Recording, Stop, Unit, World, damaged, joints_of, record

from imu_calib.api.compensate import compensate
from imu_calib.calibration.compensator import Compensator
from imu_calib.calibration.sample_clock import WholeStream
from imu_calib.common.stream import ImuBlock, Units
from imu_calib.model.sensors import SensorModel
from imu_calib.recordings.cdr_codec import Kind, encode_imu
from imu_calib.recordings.rosbag2 import open_recording
from imu_calib.recordings.writer import RecordingWriter
from imu_calib.segmentation.stamps import sampling_times
from imu_calib.session.imu import ImuSpec, TriadSpec

START = 1_700_000_000 * 10**9
UNIT = Unit()
RATE = 100.0
SPEC = ImuSpec(
    'second',
    Units.PULSES,
    None,
    TriadSpec(UNIT.gyro_pulse, np.inf),
    TriadSpec(UNIT.accel_pulse, np.inf),
)


@pytest.fixture(scope='module')
def session():
    """Half a minute of turns and rests; its stamps are when the samples were made."""
    program = Stop(joints_of('ENU')), Stop(joints_of('NUE'))
    return record(World(dwell=10.0, program=program), UNIT, 4)


def block_of(recording: Recording, came: list[float]) -> ImuBlock:
    stamp = START + np.rint(np.array(came) * 1e9).astype(np.int64)
    return ImuBlock(stamp, np.array(recording.gyro), np.array(recording.accel), 'imu')


def calibration() -> Any:
    return known(SPEC, SensorModel(), random_walk=[1e-4] * 6)


def out_of(block: ImuBlock, size: int, instants: Any = None) -> tuple[Any, Any, Compensator]:
    """What comes out, in blocks of so many: when, and forces (n, 3)."""
    compensator = Compensator(calibration(), instants)
    readings = []
    for a, b in pairwise([*range(0, len(block), size), len(block)]):
        rows = slice(a, b)
        readings += compensator.compensate_block(
            ImuBlock(block.stamp[rows], block.gyro[rows], block.accel[rows], 'imu')
        )
    readings += compensator.finish()
    stamps = np.concatenate([r.stamp for r in readings])
    return stamps, np.concatenate([r.values.force for r in readings]), compensator


def in_whole(block: ImuBlock) -> Any:
    whole = WholeStream(None)
    whole.add_stamps(block)
    return whole.instants()


def by_transfers(made: list[float], size: int) -> list[float]:
    """All samples of a transfer have the stamp of its last."""
    return [made[min(k // size * size + size, len(made)) - 1] for k in range(len(made))]


def polled(made: list[float], period: float) -> list[float]:
    """A reader takes what has come and gives it the time at which it did."""
    return [(int(one / period) + 1) * period for one in made]


def held_up(made: list[float], stalls: list[tuple[float, float]], each: float) -> list[float]:
    """A line that stalls from an instant on for so long, and then sends each in such a time."""
    free, came = 0.0, []
    for one in made:
        ready = one
        for begin, duration in stalls:
            if begin <= one < begin + duration:
                ready = begin + duration
        free = max(ready, free + each)
        came.append(free)
    return came


def seconds(stamps: Any) -> Any:
    return (stamps - START) * 1e-9


def forces(recording: Recording) -> Any:
    """What pulses over the interval at which they were counted are."""
    return np.array(recording.accel) * UNIT.accel_pulse * RATE


@pytest.mark.parametrize('size', [2, 5, 20, 50])
def test_samples_of_one_transfer_all_come_out_when_they_were_made(session, size):
    made = session.imu_stamps
    block = block_of(session, by_transfers(made, size))
    whole, force, compensator = out_of(block, len(block))
    assert len(whole) == len(made)
    assert (compensator.repeats, compensator.dropped) == (0, 0)
    # The last transfer is not full.
    full = len(made) // size * size
    assert np.abs(seconds(whole)[:full] - np.array(made)[:full]).max() < 1e-6
    assert force == pytest.approx(forces(session), rel=1e-6)
    assert compensator.period == pytest.approx(1 / RATE, rel=1e-6)
    for cut in (1, 7, 333):
        stamps, again, _ = out_of(block, cut)
        assert np.array_equal(stamps, whole)
        assert np.array_equal(again, force)


def test_of_a_reader_that_polls_every_sample_comes_out_within_its_period(session):
    made, period = np.array(session.imu_stamps), 0.033
    block = block_of(session, polled(session.imu_stamps, period))
    stamps, force, compensator = out_of(block, 1)
    assert (len(stamps), compensator.dropped) == (len(made), 0)
    assert np.diff(stamps).min() > 0
    # One is put where the other of two that were taken together was, and never after it came.
    assert np.abs(seconds(stamps) - made).max() < period
    # A window of 1024 samples begins and ends within a period of where its samples were made.
    level = np.abs(forces(session)).max()
    late = slice(1200, None)
    assert np.abs(force - forces(session))[late].max() < 2 * period / 10.24 * level


@pytest.mark.parametrize(('stall', 'each'), [(0.4, 5e-5), (3.0, 5e-5), (2.0, 4e-3), (4.0, 6e-3)])
def test_a_queue_is_no_other_rate(session, stall, each):
    made = session.imu_stamps
    block = block_of(session, held_up(made, [(6.0, stall), (20.0, stall / 2)], each))
    stamps, force, compensator = out_of(block, 1)
    assert (len(stamps), compensator.dropped) == (len(made), 0)
    assert force == pytest.approx(forces(session), rel=1e-6)
    assert compensator.irregular_steps == 0


@pytest.mark.parametrize(('stall', 'within'), [(0.4, 1.0), (3.0, 0.1), (4.9, 0.1)])
def test_of_a_recording_a_queue_goes_back_to_when_it_was_made(session, stall, within):
    """One that is short leaves those as they came that are late by less than an interval."""
    made = session.imu_stamps
    block = block_of(session, held_up(made, [(6.0, stall), (20.0, stall / 2)], 5e-5))
    instants = in_whole(block)
    assert np.abs(seconds(instants) - np.array(made)).max() < within / RATE
    stamps, force, _ = out_of(block, 100, instants)
    assert np.array_equal(stamps, instants)
    # The interval is that between two stamps, of which 600 samples are before the first queue.
    assert force == pytest.approx(forces(session), rel=within / 600)


def test_of_a_recording_jitter_is_left_and_what_is_lost_stays_lost(session):
    draw = random.Random(5)
    made = session.imu_stamps
    jittered = [one + draw.gauss(0, 0.3e-3) for one in made]
    kept = [k for k in range(len(made)) if draw.random() > 0.01]
    one_late = [jittered[k] for k in kept]
    block = ImuBlock(
        START + np.rint(np.array(one_late) * 1e9).astype(np.int64),
        np.array(session.gyro)[kept],
        np.array(session.accel)[kept],
        'imu',
    )
    assert np.array_equal(in_whole(block), block.stamp)


def test_what_a_bad_line_brings_is_in_the_recording_once_and_in_time(session, tmp_path):
    sent = damaged(session, Damage(twice=0.01, bunch=10), random.Random(6))
    block = block_of(sent, sent.imu_stamps)
    with RecordingWriter(tmp_path / 'bag') as writer:
        writer.write('/imu/pulses', Kind.IMU.type_name, encode_imu(block), block.stamp)
    done = compensate(tmp_path / 'bag', calibration(), tmp_path / 'out', imu=SPEC)
    count = len(session.imu_stamps)
    assert len(block) > count
    assert (done.samples_in, done.samples_out) == (len(block), count)
    assert f'{len(block) - count} samples came twice and are written once.' in done.findings
    with open_recording(tmp_path / 'out') as recording:
        found = [b for _, b in recording.read({'/imu/data_raw': Kind.IMU})]
    stamps = np.concatenate([b.stamp for b in found])
    full = count // 10 * 10
    # A line takes 50 us for each of ten.
    assert np.abs(seconds(stamps)[:full] - np.array(session.imu_stamps)[:full]).max() < 1e-3


def test_a_queue_of_thousands_goes_back_to_when_it_was_made():
    """At 1 kHz, longer than what is looked at at once."""
    made = [k / 1000 for k in range(1, 12001)]
    for stall in (0.7, 2.5, 4.0):
        came = held_up(made, [(5.0, stall)], 2e-5)
        stamp = START + np.rint(np.array(came) * 1e9).astype(np.int64)
        found = sampling_times(stamp[3000:])[0]
        assert np.abs(seconds(found) - np.array(made)[3000:]).max() < 0.1e-3
