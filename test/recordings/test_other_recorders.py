"""Recordings of other recorders: encodings, names of types, bags of ROS 1 by their first bytes."""

import re
from pathlib import Path

import numpy as np
import pytest
from bag_files import bag_of_ros_1
from bag_files import imu_recording as recorded

import imu_calib
from imu_calib.cli.main import main
from imu_calib.common.errors import InputError
from imu_calib.common.files import named_file, read_text
from imu_calib.common.stream import ImuBlock
from imu_calib.recordings.cdr import Messages
from imu_calib.recordings.cdr_codec import encode_imu, encode_rates
from imu_calib.recordings.mcap import McapWriter
from imu_calib.recordings.writer import RecordingWriter

T0 = 1_700_000_000_000_000_000


def mcap(path: Path, type_name: str, encoding: str, messages: Messages) -> Path:
    stamps = T0 + np.arange(len(messages)) * 10_000_000
    writer = McapWriter(path, '', bytes, 1 << 20, 10**9)
    channel = writer.add_channel('/imu', type_name, '', '', encoding=encoding)
    writer.write(channel, messages, stamps)
    writer.flush()
    writer.close()
    return path


def samples(count: int = 50) -> Messages:
    stamps = T0 + np.arange(count) * 10_000_000
    force = np.tile([0.0, 0.0, 9.8], (count, 1))
    zeros = np.zeros((count, 9))
    return encode_rates(ImuBlock(stamps, np.full((count, 3), 0.1), force, 'imu'), zeros, zeros)


@pytest.mark.parametrize(
    ('type_name', 'encoding', 'said'),
    [
        ('sensor_msgs/Imu', 'ros1', 'are of ROS 1: imu-calib convert reads the .bag'),
        ('sensor_msgs/Imu', 'json', 'are in JSON, expected CDR of ROS 2; .* text file'),
        ('sensor_msgs/msg/Imu', 'json', 'are in JSON'),
        ('foxglove.Imu', 'protobuf', 'are in Protobuf'),
        ('some.Imu', 'flatbuffer', "serialised as 'flatbuffer'"),
    ],
)
def test_another_encoding_is_named_with_the_way(type_name, encoding, said, tmp_path):
    bag = mcap(tmp_path / 'run.mcap', type_name, encoding, Messages.join([b'{"x": 1}'] * 9))
    for topic in (None, '/imu'):
        with pytest.raises(InputError, match=f'messages of /imu (are )?{said}'):
            imu_calib.calibrate(bag, imu_topic=topic)


def test_cdr_is_read_under_the_name_that_ros_1_has_for_it(tmp_path):
    bag = mcap(tmp_path / 'run.mcap', 'sensor_msgs/Imu', 'cdr', samples())
    columns = imu_calib.read(bag, '/imu')
    assert columns['angular_velocity.x'].tolist() == [0.1] * 50
    (topic,) = imu_calib.inspect(bag).topics
    assert topic.type == 'sensor_msgs/Imu'
    with pytest.raises(InputError, match='latitude'):
        imu_calib.calibrate(bag)


def test_a_bag_of_ros_1_is_known_by_its_first_bytes(tmp_path):
    bag_of_ros_1(tmp_path / 'old.bag')
    active = (tmp_path / 'old.bag').rename(tmp_path / 'old.bag.active')
    with pytest.raises(InputError, match=r'is a bag of ROS 1: imu-calib convert .*active -o OUT'):
        imu_calib.calibrate(active)
    done = imu_calib.convert(active, tmp_path / 'new')
    assert done.counts == {'/imu/data': 5}
    data = bytearray(active.read_bytes())
    place = data.index(b'index_pos=') + len(b'index_pos=')
    data[place : place + 8] = bytes(8)
    active.write_bytes(data)
    with pytest.raises(InputError, match=r'not indexed.*rosbag reindex completes'):
        imu_calib.convert(active, tmp_path / 'other')


def test_a_topic_without_accelerations_names_the_way_to_join_two(tmp_path, capsys):
    stamp = T0 + np.arange(100) * 5_000_000
    rates, forces, zeros = np.full((100, 3), 0.1), np.full((100, 3), 5.0), np.zeros((100, 3))
    topics = {'/g': (stamp, rates, zeros), '/a': (stamp, zeros, forces)}
    bag = recorded(tmp_path / 'bag', topics)
    assert main(['calibrate', str(bag)]) == 2
    told = re.sub(r'\s+', ' ', capsys.readouterr().err)
    assert '--gyro-topic /g --accel-topic /a joins them' in told
    raw = tmp_path / 'raw'
    described = {'imu_calib.imu': read_text(named_file('imus', 'rates'))}
    with RecordingWriter(raw, described) as writer:
        for name, columns in topics.items():
            block = ImuBlock(*columns)
            writer.write(name, 'sensor_msgs/msg/Imu', encode_imu(block), block.stamp)
    with pytest.raises(InputError, match='2 topics of type') as refused:
        imu_calib.calibrate(raw)
    assert 'gyro-topic' not in str(refused.value)
    both = recorded(tmp_path / 'both', {'/b': (stamp, rates, forces), '/c': (stamp, rates, forces)})
    with pytest.raises(InputError) as said:
        imu_calib.calibrate(both)
    assert 'gyro-topic' not in str(said.value)
