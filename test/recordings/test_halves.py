"""Gyros and accelerometers in rows or messages of their own, and rows out of their order."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import imu_calib
from imu_calib.cli.main import main
from imu_calib.common.errors import InputError
from imu_calib.common.stream import ImuBlock
from imu_calib.recordings.cdr import Messages
from imu_calib.recordings.cdr_codec import encode_imu
from imu_calib.recordings.order import HELD, StampSorter, places_by_stamp
from imu_calib.recordings.rosbag2 import open_recording
from imu_calib.recordings.storage import Times
from imu_calib.recordings.text import read_sensors
from imu_calib.recordings.writer import RecordingWriter
from imu_calib.segmentation.stream_facts import halves

T0 = 1_700_000_000_000_000_000
AT = np.arange(400)
STAMP = T0 + AT * 5_000_000
RATE = np.column_stack([0.1 + 0.001 * AT, -0.2 + 0 * AT, 0.3 + 0 * AT])
FORCE = np.column_stack([0.2 + 0.002 * AT, 0.1 + 0 * AT, 9.8 + 0 * AT])
"""Lines in time: interpolated exactly, whatever the stamps."""


def apart(nothing: float) -> tuple[np.ndarray, np.ndarray]:
    """Every second row of the gyros alone, the others of the accelerometers."""
    gyro, accel = RATE.copy(), FORCE.copy()
    gyro[1::2], accel[::2] = nothing, nothing
    return gyro, accel


@pytest.mark.parametrize('nothing', [0.0, np.nan])
def test_rows_of_one_sensor_are_told_from_those_of_both(nothing):
    found = halves(*apart(nothing))
    assert (
        found[0].tolist() == (AT % 2 == 0).tolist() and found[1].tolist() == (AT % 2 == 1).tolist()
    )
    assert halves(RATE, FORCE) is None
    # Gyros with a dead band read 0 at rest; accelerometers in free fall never do.
    still = RATE.copy()
    still[:390] = 0.0
    assert halves(still, FORCE) is None
    assert halves(RATE[:0], FORCE[:0]) is None


def columns(bag: Path) -> tuple[np.ndarray, np.ndarray]:
    seen = imu_calib.read(bag, '/imu/data_raw')
    at = (seen.stamp - T0) / 5e6
    return at, np.column_stack(
        [
            *(seen[f'angular_velocity.{a}'] for a in 'xyz'),
            *(seen[f'linear_acceleration.{a}'] for a in 'xyz'),
        ]
    )


def holds_the_lines(bag: Path) -> bool:
    at, found = columns(bag)
    expected = np.column_stack([0.1 + 0.001 * at, 0.2 + 0.002 * at])
    return len(at) == 199 and found[:, [0, 3]] == pytest.approx(expected, abs=1e-7)


CAMERA = 'sensor_msgs/msg/CompressedImage'


def interleaved(path: Path, nothing: float = 0.0) -> Path:
    with RecordingWriter(path) as writer:
        block = ImuBlock(STAMP, *apart(nothing))
        writer.write('/imu', 'sensor_msgs/msg/Imu', encode_imu(block), STAMP)
    return path


@pytest.mark.parametrize('nothing', [0.0, np.nan])
def test_messages_of_one_topic_are_joined(nothing, tmp_path):
    bag = interleaved(tmp_path / 'bag', nothing)
    words = ['--gyro-topic', '/imu', '--accel-topic', '/imu']
    assert main(['convert', str(bag), '-o', str(tmp_path / 'out'), *words]) == 0
    assert holds_the_lines(tmp_path / 'out')


@pytest.mark.parametrize('nothing', [0.0, np.nan])
def test_calibrate_names_the_way_to_join_them(nothing, tmp_path):
    bag = interleaved(tmp_path / 'bag', nothing)
    with pytest.raises(InputError, match='in messages of their own') as refused:
        imu_calib.calibrate(bag, latitude=34.65)
    assert 'convert --gyro-topic /imu --accel-topic /imu' in str(refused.value)
    with pytest.raises(InputError, match='in messages of their own'):
        imu_calib.calibrate(bag, latitude=34.65, imu='si', plan='free_positions')


@pytest.mark.parametrize('units', ['rates', 'increments', 'mems_counts', 'fog_medium'])
def test_where_they_cannot_be_joined_no_command_is_named(units, tmp_path):
    bag = interleaved(tmp_path / 'bag')
    with pytest.raises(InputError, match='in messages of their own') as refused:
        imu_calib.calibrate(bag, latitude=34.65, imu=units, plan='free_positions')
    assert 'convert' not in str(refused.value)
    assert 'let the driver put both into each message' in str(refused.value)


def test_topics_of_other_types_are_copied(tmp_path):
    bag = tmp_path / 'bag'
    with RecordingWriter(tmp_path / 'camera') as writer:
        writer.write('/camera', 'std_msgs/msg/String', Messages.join([b'\0\1\0\0abcd']), STAMP[:1])
    with open_recording(tmp_path / 'camera') as recording:
        (topic,) = recording.topics
    with RecordingWriter(bag) as writer:
        one = Messages.join([b'\0\1\0\0abcd'])
        writer.copy(replace(topic, type=CAMERA, channels=()), one, Times(STAMP[:1], STAMP[:1]))
        zeros = np.zeros_like(RATE)
        for name, block in (
            ('/g', ImuBlock(STAMP, RATE, zeros)),
            ('/a', ImuBlock(STAMP, zeros, FORCE)),
        ):
            writer.write(name, 'sensor_msgs/msg/Imu', encode_imu(block), STAMP)
    imu_calib.convert(bag, tmp_path / 'out', gyro_topic='/g', accel_topic='/a')
    with open_recording(tmp_path / 'out') as recording:
        types = {topic.name: topic.type for topic in recording.topics}
        assert types == {'/camera': CAMERA, '/imu/data_raw': 'sensor_msgs/msg/Imu'}
        copied = [m.payload(0) for t, m, _ in recording.messages() if t.name == '/camera']
    assert copied == [b'\0\1\0\0abcd']


WORDS = {'stamp': 't:s', 'gyro': 'gx,gy,gz:rad/s', 'accel': 'ax,ay,az:m/s^2'}


@pytest.mark.parametrize('nothing', [0.0, np.nan])
def test_rows_of_a_table_are_joined(nothing, tmp_path):
    table = np.column_stack([(STAMP - T0) * 1e-9 + T0 * 1e-9, *apart(nothing)])
    table[:, 0] = AT * 0.005
    np.savetxt(tmp_path / 'log.csv', table, delimiter=',', header='t,gx,gy,gz,ax,ay,az')
    done = imu_calib.convert(tmp_path / 'log.csv', tmp_path / 'out', **WORDS)
    assert 'joined by time, as two sensors' in done.findings[0]
    seen = imu_calib.read(tmp_path / 'out', '/imu/data_raw')
    at = seen.stamp / 5e6
    assert len(at) == 199
    assert seen['linear_acceleration.x'] == pytest.approx(0.2 + 0.002 * at)
    assert seen['angular_velocity.x'] == pytest.approx(0.1 + 0.001 * at)


@pytest.mark.parametrize(
    ('gyr', 'acc', 'between'),
    [('GYR', 'ACC', ','), ('gyroscope', 'ACCE', ' '), ('Gyro', 'acc', ';')],
)
def test_rows_that_name_their_sensor_are_joined(gyr, acc, between, tmp_path):
    lines = ['# a log of a phone', between.join(['sensor', 't', 'x', 'y', 'z'])]
    for k in AT.tolist():
        values = RATE[k] if k % 2 == 0 else FORCE[k]
        fields = [gyr if k % 2 == 0 else acc, f'{0.005 * k:.4f}', *(f'{v:.9f}' for v in values)]
        lines += [between.join(fields), between.join(['MAG', f'{0.005 * k:.4f}', '1', '2', '3'])]
    (tmp_path / 'log.txt').write_text('\n'.join(lines), encoding='utf-8')
    words = {'stamp': 't:s', 'gyro': 'x,y,z:rad/s', 'accel': '3,4,5:m/s^2'}
    done = imu_calib.convert(tmp_path / 'log.txt', tmp_path / 'out', **words)
    assert done.counts['/imu/data_raw'] == 199
    seen = imu_calib.read(tmp_path / 'out', '/imu/data_raw')
    at = seen.stamp / 5e6
    assert seen['linear_acceleration.x'] == pytest.approx(0.2 + 0.002 * at)
    assert seen['angular_velocity.x'] == pytest.approx(0.1 + 0.001 * at)
    with pytest.raises(InputError, match='give `stamp` in place of `rate`'):
        imu_calib.convert(
            tmp_path / 'log.txt', tmp_path / 'no', **{**words, 'stamp': None}, rate='9'
        )


def test_a_heading_with_names_of_sensors_is_no_label(tmp_path):
    text = 't,gyr x,gyr y,acc x\n' + '0.1,1,2,3\n' * 30
    (tmp_path / 'log.csv').write_text(text, encoding='utf-8')
    table, other = read_sensors(tmp_path / 'log.csv')
    assert other is None and table.names == ('t', 'gyr x', 'gyr y', 'acc x')


def shuffled(count: int, reach: int, seed: int) -> np.ndarray:
    """Places of samples of which many come late by up to so many places."""
    rng = np.random.default_rng(seed)
    return np.argsort(np.arange(count) + rng.uniform(0, reach, count) * (rng.random(count) < 0.3))


def test_samples_out_of_order_are_sorted_however_the_stream_is_cut():
    count = 3 * HELD
    stamp = T0 + np.arange(count) * 1_000_000
    values = np.column_stack([np.arange(count)] * 3).astype(float)
    places = shuffled(count, 20, 1)
    for size in (7, 1000, count):
        order, done = StampSorter(), []
        for k in range(0, count, size):
            part = places[k : k + size]
            done += order.sort_block(ImuBlock(stamp[part], values[part], -values[part]))
        done += order.finish()
        assert np.concatenate([b.stamp for b in done]).tolist() == stamp.tolist()
        assert np.concatenate([b.accel for b in done])[:, 2].tolist() == (-values[:, 2]).tolist()
        assert order.moved == np.count_nonzero(places < np.maximum.accumulate(places))
        assert f'{order.moved} IMU samples came out of order' in order.sentences[0]


def test_a_clock_that_is_set_back_is_not_sorted():
    stamp = np.concatenate([np.arange(3000), np.arange(2500, 6000)]) * 1_000_000
    assert places_by_stamp(stamp) is None
    far = shuffled(4 * HELD, 3 * HELD, 2)
    assert places_by_stamp(far * 1_000_000) is None
    order = StampSorter()
    zeros = np.zeros((len(stamp), 3))
    done = [*order.sort_block(ImuBlock(stamp, zeros, zeros)), *order.finish()]
    assert np.concatenate([b.stamp for b in done]).tolist() == stamp.tolist()
    assert order.sentences == ()


def test_rows_of_a_table_out_of_order_are_sorted(tmp_path):
    places = shuffled(400, 5, 3)
    table = np.column_stack([AT * 0.005, RATE, FORCE])[places]
    np.savetxt(tmp_path / 'log.csv', table, delimiter=',', header='t,gx,gy,gz,ax,ay,az')
    done = imu_calib.convert(tmp_path / 'log.csv', tmp_path / 'out', **WORDS)
    assert 'came out of order' in done.findings[0]
    seen = imu_calib.read(tmp_path / 'out', '/imu/data_raw')
    assert seen.stamp.tolist() == (AT * 5_000_000).tolist()
    assert seen['angular_velocity.x'] == pytest.approx(RATE[:, 0])


@pytest.mark.parametrize('place', [0, 1000])
def test_a_row_without_a_time_does_not_hide_that_others_are_late(place, tmp_path):
    seconds = np.arange(2000) / 100
    seconds = seconds.reshape(-1, 10)[:, ::-1].ravel()
    lines = ['t,wx,wy,wz,ax,ay,az', *(f'{t:.2f},1,2,3,0.1,0.2,0.9' for t in seconds)]
    lines[1 + place] = lines[1 + place].replace(f'{seconds[place]:.2f}', 'x', 1)
    (tmp_path / 'a.csv').write_text('\n'.join(lines), encoding='utf-8')
    words = {'stamp': 't:s', 'gyro': 'wx,wy,wz:deg/s', 'accel': 'ax,ay,az:g'}
    done = imu_calib.convert(tmp_path / 'a.csv', tmp_path / 'bag', **words)
    assert 'came out of order' in done.findings[0]
    stamp = imu_calib.read(tmp_path / 'bag', '/imu/data_raw').stamp
    assert len(stamp) == 1999 and (np.diff(stamp) > 0).all()
