"""Numbers that are neither whole nor SI: g, deg/s, and angles and velocities per sample."""

from pathlib import Path

import numpy as np
import pytest
from hand_sessions import recorded_in_si
from numpy.typing import NDArray

import imu_calib
from imu_calib.calibration.calibration import Calibration
from imu_calib.common.errors import InputError
from imu_calib.common.files import named_file
from imu_calib.common.stream import Floats, ImuBlock, Units
from imu_calib.common.units import DEG, STANDARD_GRAVITY
from imu_calib.recordings.cdr_codec import encode_imu
from imu_calib.recordings.writer import RecordingWriter
from imu_calib.segmentation.statistics import to_samples
from imu_calib.session.imu import check_live, load_imu

LATITUDE = 34.65
TRUTH = Calibration.load(named_file('truths', 'mems_counts'))
SHORT = {
    'counts': 'id: x\nunits: counts\n'
    'gyro: {scale_factor: 1 rad/s/count}\naccelerometer: {scale_factor: 1 g/count}\n',
    'pulses': 'id: x\nunits: pulses\n'
    'gyro: {scale_factor: 1 rad/pulse}\naccelerometer: {scale_factor: 1 (m/s)/pulse}\n',
    'rates': 'id: x\nunits: rates\n'
    'gyro: {scale_factor: 1 deg/s}\naccelerometer: {scale_factor: 1 g}\n',
    'increments': 'id: x\nunits: increments\n'
    'gyro: {scale_factor: 1 rad}\naccelerometer: {scale_factor: 1 m/s}\n',
}
PER_NUMBER = {
    'counts': (1.0, STANDARD_GRAVITY),
    'pulses': (100.0, 100.0),
    'rates': (DEG, STANDARD_GRAVITY),
    'increments': (100.0, 100.0),
}
"""rad/s and m/s^2 that a number is; increments are of samples of 100 Hz."""


@pytest.fixture(scope='module')
def hand(tmp_path_factory):
    """A session in the hand, SI."""
    return recorded_in_si(tmp_path_factory.mktemp('hand') / 'bag')


@pytest.fixture(scope='module')
def expected(hand, tmp_path_factory):
    """What the session gives in SI."""
    bag = tmp_path_factory.mktemp('si') / 'bag'
    with RecordingWriter(bag) as writer:
        writer.write('/imu', 'sensor_msgs/msg/Imu', encode_imu(ImuBlock(*hand)), hand[0])
    return imu_calib.calibrate(bag, latitude=LATITUDE).calibration


def calibrated(hand: tuple[NDArray[np.int64], Floats, Floats], units: str, folder: Path):
    stamp, gyro, accel = hand
    per_rate, per_force = PER_NUMBER[units]
    with RecordingWriter(folder / units, {'imu_calib.imu': SHORT[units]}) as writer:
        block = ImuBlock(stamp, gyro / per_rate, accel / per_force)
        writer.write('/imu', 'sensor_msgs/msg/Imu', encode_imu(block), stamp)
    return imu_calib.calibrate(folder / units, latitude=LATITUDE).calibration


@pytest.mark.parametrize('units', ['counts', 'pulses', 'rates', 'increments'])
def test_numbers_that_are_not_whole_give_what_si_gives(hand, expected, units, tmp_path):
    found = calibrated(hand, units, tmp_path)
    assert found.std == pytest.approx(expected.std, rel=0.02)
    free = expected.std > 0
    off = (found.values - expected.values)[free] / expected.std[free]
    assert np.abs(off).max() < 0.2
    stated = {'counts': 'rates', 'pulses': 'increments'}.get(units)
    told = [text for text in found.findings if 'no whole numbers' in text]
    assert len(told) == (stated is not None)
    assert all(f'state `units: {stated}`' in text for text in told)


def test_a_calibration_keeps_its_units(hand, tmp_path):
    made = calibrated(hand, 'rates', tmp_path)
    made.save(tmp_path / 'made.yaml')
    again = Calibration.load(tmp_path / 'made.yaml')
    assert again.imu.units is Units.RATES
    assert again.imu.accel.scale_factor == pytest.approx(STANDARD_GRAVITY)
    imu_calib.compensate(tmp_path / 'rates', again, tmp_path / 'compensated')
    seen = imu_calib.read(tmp_path / 'compensated', '/imu/data_raw')
    force = np.column_stack([seen[f'linear_acceleration.{a}'] for a in 'xyz'])
    assert np.median(np.linalg.norm(force, axis=1)) == pytest.approx(9.797, abs=0.02)


@pytest.mark.parametrize(('name', 'scale'), [('rates', DEG), ('increments', 1.0)])
def test_shipped_files_of_numbers_with_units(name, scale):
    spec = load_imu(name)
    assert spec.units.value == name and spec.gyro.scale_factor == scale
    with pytest.raises(InputError, match='expected pulses or counts'):
        check_live(spec)


def test_a_channel_that_reads_zero_is_no_counter():
    spec = load_imu('mems_counts')
    values = np.random.default_rng(1).normal(size=(100, 6))
    values[:, 2] = 0.0
    stamp = np.arange(100) * 10_000_000
    pulses = to_samples(stamp, values, load_imu('fog_medium'), 0.01)
    assert (pulses.pulse == 0).all()
    whole = to_samples(stamp, np.rint(100 * values), load_imu('fog_medium'), 0.01)
    assert (whole.pulse > 0).all()
    assert spec.units.whole and not Units.RATES.whole and Units.INCREMENTS.per_interval


def rows(tmp_path: Path, stamp, gyro: Floats, accel: Floats) -> Path:
    file = tmp_path / 'log.csv'
    table = np.column_stack([(stamp - stamp[0]) * 1e-9, gyro, accel])
    np.savetxt(file, table, delimiter=',', header='t,gx,gy,gz,ax,ay,az')
    return file


def test_text_of_angles_and_velocities_is_converted(hand, tmp_path):
    stamp, gyro, accel = hand
    file = rows(tmp_path, stamp, gyro / DEG / 100, accel / 100)
    done = imu_calib.convert(
        file, tmp_path / 'out', stamp='t:s', gyro='gx,gy,gz:deg', accel='ax,ay,az:m/s'
    )
    assert dict(done.counts) == {'/imu/pulses': len(stamp)}
    seen = imu_calib.read(tmp_path / 'out', '/imu/pulses')
    assert seen['angular_velocity.x'] == pytest.approx(gyro[:, 0] / 100)
    found = imu_calib.calibrate(tmp_path / 'out', latitude=LATITUDE).calibration
    assert found.imu.units is Units.INCREMENTS
    assert np.abs((found.values - TRUTH.values)[:3] / found.std[:3]).max() < 4
    with pytest.raises(InputError, match='found deg and g, expected a rate and an acceleration'):
        imu_calib.convert(
            file, tmp_path / 'no', stamp='t:s', gyro='gx,gy,gz:deg', accel='ax,ay,az:g'
        )


def test_text_is_written_in_the_units_that_the_imus_file_states(hand, tmp_path):
    stamp, gyro, accel = hand
    file = rows(tmp_path, stamp, gyro, accel)
    words = {'stamp': 't:s', 'gyro': 'gx,gy,gz:rad/s', 'accel': 'ax,ay,az:m/s^2'}
    imu_calib.convert(file, tmp_path / 'out', imu='rates', **words)
    seen = imu_calib.read(tmp_path / 'out', '/imu/pulses')
    assert seen['linear_acceleration.z'] == pytest.approx(accel[:, 2] / STANDARD_GRAVITY)
    with pytest.raises(InputError, match='found increments, but the numbers are rates'):
        imu_calib.convert(file, tmp_path / 'no', imu='increments', **words)
