"""Messages of the DDS runtime against those of ROS: bytes, type hashes, definitions."""

import json
import struct
import sys

import numpy as np
import pytest
from loopback import CHECKOUT, completed
from rosbags.typesys import Stores, get_typestore

from imu_calib.common.errors import ImuCalibError, InputError
from imu_calib.recordings.cdr import message_text

try:
    from interop_peer import filled, ros

    if ros.RUNTIME != 'dds':
        pytest.skip('of the dds runtime', allow_module_level=True)
    from imu_calib.live.middleware.dds import messages
    from imu_calib.live.middleware.dds.message_types import (
        deserialize_message,
        interface,
        message_class,
        serialize_message,
        type_hash,
    )
    from imu_calib.live.middleware.shared import MESSAGES
except ImuCalibError as error:
    pytest.skip(str(error), allow_module_level=True)

# `python3 test/support/interop_peer.py record`, with rclpy.
ROS = json.loads((CHECKOUT / 'test' / 'data' / 'messages_of_ros.json').read_text())
WRITTEN = [name for name, known in ROS.items() if 'bytes' in known]


def test_every_message_that_nodes_exchange_was_recorded():
    assert {*MESSAGES.values()} <= {*WRITTEN}


@pytest.mark.parametrize('name', ROS)
def test_type_hashes_are_those_of_ros(name):
    assert type_hash(name) == ROS[name]['hash']


@pytest.mark.parametrize('name', WRITTEN)
def test_bytes_are_those_of_ros_both_ways(name):
    kind, payload = message_class(name), bytes.fromhex(ROS[name]['bytes'])
    message = filled(kind)
    # Cyclone DDS moves words of four bytes.
    assert serialize_message(message) == payload + bytes(-len(payload) % 4)
    read = deserialize_message(payload, kind)
    assert read == message
    assert repr(read) == repr(message)


@pytest.mark.parametrize('name', sorted(MESSAGES.values()))
def test_definitions_are_those_that_rosbags_has_of_jazzy(name):
    if name.startswith('imu_calib_msgs/'):
        file = CHECKOUT / 'msg_defs' / 'msg' / f'{name.rpartition("/")[2]}.msg'
        assert message_text(name) == file.read_text()
    else:
        constants, fields = get_typestore(Stores.ROS2_JAZZY).fielddefs[name]
        assert interface(name).constants == constants
        assert interface(name).fields == fields


def test_a_message_begins_with_zeros_and_with_the_defaults_of_its_definition():
    assert messages.Quaternion() == messages.Quaternion(x=0.0, y=0.0, z=0.0, w=1.0)
    assert messages.Imu().orientation.w == 1.0
    assert messages.DiagnosticStatus().level == messages.DiagnosticStatus.OK == b'\x00'
    assert messages.DiagnosticStatus.STALE == b'\x03'


def test_numbers_are_kept_as_rclpy_keeps_them():
    message = deserialize_message(serialize_message(filled(messages.Imu)), messages.Imu)
    message.orientation_covariance[3] = 7.0
    assert serialize_message(message) != serialize_message(filled(messages.Imu))
    joints = messages.JointState(position=np.arange(6.0)[::2])
    joints.position.append(9.0)
    read = deserialize_message(serialize_message(joints), messages.JointState)
    assert read.position.tolist() == [0.0, 2.0, 4.0, 9.0]
    assert repr(read.position) == "array('d', [0.0, 2.0, 4.0, 9.0])"


@pytest.mark.parametrize('level', [0, 3, 127, 128, 255])
def test_a_byte_has_all_its_values(level):
    sent = messages.DiagnosticStatus(level=bytes([level]))
    read = deserialize_message(serialize_message(sent), messages.DiagnosticStatus)
    assert read.level == bytes([level])


def test_a_bounded_string_and_a_fixed_array_keep_to_their_lengths():
    info = message_class('rmw_dds_common/msg/NodeEntitiesInfo')()
    info.node_name = 'n' * 256
    with pytest.raises(AssertionError, match='node_name'):
        info.node_name = 'n' * 257
    for size in (8, 10):
        with pytest.raises(AssertionError, match=f'skew_response.*3 elements, not {size}'):
            messages.ImuCalibration(skew_response=[0.0] * size)


def test_a_wrong_element_is_named_with_the_message_that_holds_it():
    sent = messages.DiagnosticArray(status=[messages.DiagnosticStatus()])
    sent.status[0].values.append('key')
    with pytest.raises(TypeError, match='DiagnosticStatus: values is'):
        serialize_message(sent)


def test_the_other_byte_order_is_read():
    text = 'Größe'.encode() + b'\x00'
    payload = b'\x00\x00\x00\x00' + struct.pack('>iIi', -5, 6, len(text)) + text
    header = deserialize_message(payload, messages.Header)
    assert (header.stamp.sec, header.stamp.nanosec, header.frame_id) == (-5, 6, 'Größe')


def test_damaged_bytes_are_refused_or_read_but_nothing_else():
    random = np.random.default_rng(24)
    refused = 0
    for kind in (messages.JointState, messages.DiagnosticArray, messages.ImuCalibration):
        whole = serialize_message(filled(kind))
        for _ in range(300):
            damaged = bytearray(whole[: random.integers(len(whole) + 1)])
            for at in random.integers(len(damaged), size=2) if damaged else ():
                damaged[at] = random.choice([0, 1, 255])
            try:
                deserialize_message(bytes(damaged), kind)
            except InputError as error:
                refused += 1
                assert kind.TYPE_NAME in str(error)
    assert refused > 600  # a message cut short ends within a field or lacks one


LOADED = """
import json, sys
from imu_calib.live.middleware.dds import messages
messages.Imu()
print(json.dumps(sorted(sys.modules)))
"""


def test_the_runtime_loads_neither_recordings_nor_the_definitions_of_all_of_ros():
    done = completed([sys.executable, '-c', LOADED], cwd=CHECKOUT, check=True)
    modules = json.loads(done.stdout)
    assert 'rosbags.serde.cdr' in modules
    assert not [
        m
        for m in modules
        if m.startswith(('rosbags.typesys.stores.ros', 'imu_calib.recordings.rosbag2'))
    ]
