"""What we record is read by the readers of others, and what they write by us."""

from pathlib import Path

import numpy as np
import pytest
from bag_files import imu_recording

import imu_calib

pytest.importorskip('mcap_ros2')
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer

from imu_calib.recordings.definitions import definition

IMU = 'sensor_msgs/msg/Imu'
T0 = 1_700_000_000_000_000_000


def columns(path: Path, topic: str):
    """Return rates and forces of a topic, (n, 6), by mcap-ros2-support."""
    (file,) = path.glob('*.mcap')
    with file.open('rb') as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        read = [m for _, c, _, m in reader.iter_decoded_messages([topic]) if c.topic == topic]
    return np.array(
        [[getattr(v, x) for v in (m.angular_velocity, m.linear_acceleration) for x in 'xyz']
         for m in read]
    )  # fmt: skip


def ours(path: Path, topic: str):
    read = imu_calib.read(path, topic)
    names = [f'{v}.{x}' for v in ('angular_velocity', 'linear_acceleration') for x in 'xyz']
    return np.column_stack([read[name] for name in names])


def test_what_is_recorded_and_converted_reads_the_same_there(tmp_path):
    values = np.random.default_rng(2).normal(size=(50, 6))
    stamps = T0 + np.arange(50) * 10_000_000
    raw = imu_recording(tmp_path / 'raw', {'/imu': (stamps, values[:, :3], values[:, 3:])})
    np.testing.assert_array_equal(columns(raw, '/imu'), values)
    lines = [','.join(map(repr, [k / 100, *row])) for k, row in enumerate(values.tolist())]
    (tmp_path / 'log.csv').write_text('\n'.join(['t,gx,gy,gz,ax,ay,az', *lines]))
    given = {'stamp': 't:s', 'gyro': 'gx,gy,gz:rad/s', 'accel': 'ax,ay,az:m/s^2'}
    imu_calib.convert(tmp_path / 'log.csv', tmp_path / 'converted', **given)
    read = columns(tmp_path / 'converted', '/imu/data_raw')
    np.testing.assert_allclose(read, values, rtol=1e-15)


def test_a_recording_by_mcap_ros2_support_is_read(tmp_path):
    values = np.random.default_rng(1).normal(size=(50, 6))
    path = tmp_path / 'theirs.mcap'
    with path.open('wb') as stream:
        writer = Writer(stream)
        schema = writer.register_msgdef(IMU, definition(IMU))
        for k, row in enumerate(values):
            at = T0 + k * 10_000_000
            message = {
                'header': {'stamp': {'sec': at // 10**9, 'nanosec': at % 10**9}, 'frame_id': 'imu'},
                'orientation': {'x': 0.0, 'y': 0.0, 'z': 0.0, 'w': 1.0},
                'orientation_covariance': [0.0] * 9,
                'angular_velocity': dict(zip('xyz', row[:3], strict=True)),
                'angular_velocity_covariance': [0.0] * 9,
                'linear_acceleration': dict(zip('xyz', row[3:], strict=True)),
                'linear_acceleration_covariance': [0.0] * 9,
            }
            writer.write_message('/imu', schema, message, log_time=at, publish_time=at)
        writer.finish()
    read = imu_calib.read(path, '/imu')
    np.testing.assert_array_equal(ours(path, '/imu'), values)
    assert np.diff(read.stamp).tolist() == [10_000_000] * 49
