"""A dwell that is read: how long it is, what is left out of it, and why it is none."""

import numpy as np
import pytest

from imu_calib.common.stream import Floats, Units
from imu_calib.common.units import DEG
from imu_calib.segmentation.dwells import read_dwell
from imu_calib.segmentation.segmented import MountShift, Rejected
from imu_calib.segmentation.segments import Segment
from imu_calib.segmentation.statistics import Samples, Sensor
from imu_calib.session.imu import ImuSpec, TriadSpec

SPEC = ImuSpec('any', Units.SI, None, TriadSpec(1.0, 1e-4, range=1.0), TriadSpec(1.0, 1e-3))
SENSOR = Sensor.from_spec(SPEC)
ANGLES, ATTITUDE = np.array([0.3]), np.eye(3)
FORCE = np.array([0.0, 0.0, 9.8])


def rates(count: int, seed: int = 0) -> Floats:
    """At rest with Z up, noise of the data sheet."""
    noise = np.repeat([1e-4, 1e-3], 3) / np.sqrt(0.01)
    rows = noise * np.random.default_rng(seed).standard_normal((count, 6))
    rows[:, 3:] += FORCE
    return rows


def read(
    rows: Floats, kept: Floats | None = None, *, by_table: bool = True
) -> list[Segment | Rejected | MountShift]:
    kept = np.arange(len(rows)) if kept is None else kept
    stamp = (np.asarray(kept) + 1) * 10_000_000
    samples = Samples(stamp, rows * 0.01, np.zeros(6), 0.01, np.zeros(6))
    if by_table:
        return read_dwell(SENSOR, samples, rows, ANGLES, ATTITUDE, 1e-5)
    return read_dwell(SENSOR, samples, rows, None, None)


def segment(found: list[Segment | Rejected | MountShift]) -> Segment:
    (one,) = found
    assert isinstance(one, Segment)
    return one


def rejected(found: list[Segment | Rejected | MountShift]) -> Rejected:
    (one,) = found
    assert isinstance(one, Rejected)
    return one


def test_a_dwell_is_a_segment():
    rows = rates(1000)
    found = segment(read(rows))
    assert (found.start, found.end) == (10_000_000, 10_000_000_000)
    assert found.statistics.mean == pytest.approx(rows.mean(axis=0))
    assert found.attitude is ATTITUDE
    assert found.angles is ANGLES
    assert found.attitude_error == 1e-5
    assert found.notes == ()
    alone = segment(read(rows, by_table=False))
    assert (alone.attitude, alone.angles, alone.attitude_error) == (None, None, 0.0)


@pytest.mark.parametrize(('count', 'counts'), [(1, False), (100, False), (101, True)])
def test_less_than_a_second_tells_nothing(count, counts):
    assert bool(read(rates(count))) is counts


def test_what_is_saturated_for_most_of_its_time_is_none():
    rows = rates(1000)
    rows[:501, 1] = 1.0
    gone = rejected(read(rows))
    assert (gone.start, gone.end, gone.reason) == (
        10_000_000,
        10_000_000_000,
        'the sensor is saturated',
    )
    assert not gone.turn
    rows = rates(1000)
    rows[:500, 1] = 1.0
    found = segment(read(rows))
    assert found.notes == ('500 samples are saturated',)
    assert found.statistics.samples == 500
    assert found.start == 5_010_000_000


def test_too_little_that_is_sound_is_said():
    rows = rates(400)
    rows[::50, 0] = 1.0
    assert rejected(read(rows)).reason == 'no half second of it was quiet; 8 samples are saturated'
    few = rates(140)
    few[:60, 0] = 1.0
    assert rejected(read(few)).reason == '60 samples are saturated'


def test_gaps_are_counted():
    kept = np.array([k for k in range(2000) if not (300 <= k < 307 or k == 1500)])
    found = segment(read(rates(2000)[kept], kept))
    assert found.notes == ('8 samples missing in 2 gaps',)
    assert found.statistics.missing == 8


def test_frozen_samples_are_left_out():
    rows = rates(2000)
    rows[500:1000] = rows[499]
    found = segment(read(rows))
    # They came, and are not missing.
    assert found.notes == ('its samples are frozen for 5.0 s, repeating one; left out',)
    assert found.statistics.samples == 1500
    kept = np.array([k for k in range(2000) if not (800 <= k < 1050 or 1700 <= k < 1707)])
    both = segment(read(rows[kept], kept))
    assert both.notes == (
        'its samples are frozen for 3.0 s, repeating one; left out',
        '257 samples missing in 2 gaps',
    )
    brief = rates(180)
    brief[100:] = brief[99]
    gone = rejected(read(brief))
    assert (gone.start, gone.end) == (10_000_000, 1_800_000_000)
    assert gone.reason == 'its samples are frozen for 0.8 s, repeating one'
    # What is left may be none for another reason.
    rows = rates(2000)
    rows[500:1000] = rows[499]
    rows[:450:50, 0] = 1.0
    rows[1000::50, 0] = 1.0
    assert rejected(read(rows)).reason.startswith(
        'its samples are frozen for 5.0 s, repeating one; left out; '
    )


def test_the_end_of_a_range_repeats_itself():
    rows = rates(2000)
    rows[500:700] = 1.0
    notes = segment(read(rows, by_table=False)).notes
    assert notes[-1] == '200 samples are saturated'
    assert not any('frozen' in note for note in notes)


@pytest.mark.parametrize('first', [2000, 6000])
def test_a_step_leaves_the_longer_part(first):
    rows = rates(8000)
    rows[first:, 0] += 0.01
    found = segment(read(rows))
    (note,) = found.notes
    assert note == (
        'the mean of gx steps by 2060 deg/h: the unit was moved; only the longer part is used'
    )
    # Either block of ten seconds beside the step may hold it; they begin with the first stamp.
    used = slice(first + 1001, 8000) if first < 4000 else slice(0, first - 999)
    assert found.start == (used.start + 1) * 10_000_000
    assert found.end == used.stop * 10_000_000
    assert found.statistics.mean == pytest.approx(rows[used].mean(axis=0))


@pytest.mark.parametrize(('burst', 'enough'), [(19, False), (20, True)])
def test_a_second_is_left_beside_a_step(burst, enough):
    # Eight bursts, a quarter of a second apart: five lie before those beside the step.
    kept = np.concatenate([k * (burst + 25) + np.arange(burst) for k in range(8)])
    rows = rates(8 * burst)
    rows[6 * burst :, 0] += 0.1
    (found,) = read(rows, kept)
    if enough:
        assert isinstance(found, Segment)
        assert found.statistics.samples == 5 * burst
    else:
        assert isinstance(found, Rejected)
        assert found.reason.startswith('the unit was moved: the mean of gx steps by ')


def test_a_shift_in_the_mount_parts_a_dwell():
    rows = rates(4000)
    rows[2000:2010, 2] += 0.5 * DEG / 0.1
    first, shift, second = read(rows)
    assert isinstance(first, Segment)
    assert isinstance(shift, MountShift)
    assert isinstance(second, Segment)
    # Half seconds: the one from 20 s on.
    assert (first.start, first.end) == (10_000_000, 20_000_000_000)
    assert shift.instant == 20_010_000_000
    assert shift.angle == pytest.approx(0.5 * DEG, rel=0.05)
    assert (second.start, second.end) == (20_510_000_000, 40_000_000_000)
    for one in (first, second):
        assert one.attitude is ATTITUDE
        assert one.angles is ANGLES
        assert one.attitude_error == 1e-5
    # Without a table the sound part alone is used.
    alone = segment(read(rows, by_table=False))
    assert alone.notes[0] == 'disturbed 20.0 s after it came to rest; 0.5 s left out'
    assert alone.statistics.samples == 3950
