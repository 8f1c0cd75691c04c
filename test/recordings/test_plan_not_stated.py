"""A recording that does not state its plan: what a refusal names, and what a report takes."""

from pathlib import Path

import numpy as np
import pytest

import imu_calib
from imu_calib.common.errors import ImuCalibError, NotStated
from imu_calib.common.files import named_file
from imu_calib.common.stream import ImuBlock
from imu_calib.recordings.cdr_codec import RATES, encode_imu
from imu_calib.recordings.writer import RecordingWriter

LATITUDE = 34.65
FERRARIS = 'six_position_by_hand'


def without_metadata(plan: str, folder: Path, seconds: float = np.inf) -> Path:
    """Simulate a session in SI units; write its samples alone, of the first seconds."""
    imu_calib.simulate(plan, folder / 'whole', imu='si', truth='mems_counts', seed=1)
    seen = imu_calib.read(folder / 'whole', '/imu/pulses')
    gyro = np.column_stack([seen[f'angular_velocity.{a}'] for a in 'xyz'])
    accel = np.column_stack([seen[f'linear_acceleration.{a}'] for a in 'xyz'])
    kept = slice(0, int(np.searchsorted(seen.stamp, seen.stamp[0] + seconds * 1e9)))
    with RecordingWriter(folder / 'bag') as writer:
        messages = encode_imu(ImuBlock(seen.stamp[kept], gyro[kept], accel[kept]), RATES)
        writer.write('/imu', 'sensor_msgs/msg/Imu', messages, seen.stamp[kept])
    return folder / 'bag'


def test_holds_and_turns_without_a_plan_are_refused_with_its_name(tmp_path):
    bag = without_metadata(FERRARIS, tmp_path)
    with pytest.raises(NotStated, match=f'give `plan` {FERRARIS}'):
        imu_calib.calibrate(bag, latitude=LATITUDE)
    found = imu_calib.calibrate(bag, latitude=LATITUDE, plan=FERRARIS).calibration
    assert found.provenance['plan'] == FERRARIS


def test_few_holds_in_free_positions_are_not_taken_for_that_plan(tmp_path):
    bag = without_metadata('free_positions', tmp_path, 35.0)
    with pytest.raises(ImuCalibError) as refused:
        imu_calib.calibrate(bag, latitude=LATITUDE)
    assert FERRARIS not in str(refused.value)


def test_free_positions_under_a_plan_of_turns_by_hand_are_told_to_leave_it_out(tmp_path):
    bag = without_metadata('free_positions', tmp_path)
    with pytest.raises(ImuCalibError, match=r'did not follow .*, leave `plan` out'):
        imu_calib.calibrate(bag, latitude=LATITUDE, plan=FERRARIS)


def test_a_report_takes_the_plan_of_the_calibration(tmp_path):
    bag = without_metadata(FERRARIS, tmp_path)
    found = imu_calib.calibrate(bag, latitude=LATITUDE, plan=FERRARIS).calibration
    found.save(tmp_path / 'made.yaml')
    page = imu_calib.report(tmp_path / 'made.yaml', tmp_path / 'report.html', bag=bag)
    assert FERRARIS in page.read_text(encoding='utf-8')


def test_a_report_asks_for_the_file_of_a_plan_of_ones_own(tmp_path):
    bag = without_metadata(FERRARIS, tmp_path)
    text = named_file('plans', FERRARIS).read_text(encoding='utf-8')
    own = tmp_path / 'own.yaml'
    own.write_text(text.replace(f'name: {FERRARIS}', 'name: my_holds'), encoding='utf-8')
    found = imu_calib.calibrate(bag, latitude=LATITUDE, plan=own).calibration
    with pytest.raises(NotStated, match='made with plan my_holds, which is not shipped'):
        imu_calib.report(found, tmp_path / 'report.html', bag=bag)
