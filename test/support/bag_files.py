"""Recordings for tests, written by rosbags, and small tools to damage them."""

from __future__ import annotations

from itertools import chain
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from imu_calib.common.stream import (
    ImuBlock,
    JointBlock,
    Mode,
    Setpoint,
    SetpointBlock,
    TemperatureBlock,
)
from imu_calib.recordings.cdr_codec import (
    encode_imu,
    encode_joints,
    encode_setpoints,
    encode_temperatures,
    part,
)
from imu_calib.recordings.definitions import definition
from imu_calib.recordings.rosbag2 import Kind, open_recording

NS = 1_000_000_000
START = 1_700_000_000 * NS
IMU, JOINTS = '/stand/imu/pulses', '/stand/turntable/joint_states'
SETPOINTS, TEMPERATURES = '/stand/turntable/setpoint', '/stand/imu/temperature'
KINDS = {
    IMU: Kind.IMU,
    JOINTS: Kind.JOINTS,
    SETPOINTS: Kind.SETPOINTS,
    TEMPERATURES: Kind.TEMPERATURES,
}
ENCODERS = {
    IMU: encode_imu,
    JOINTS: encode_joints,
    SETPOINTS: encode_setpoints,
    TEMPERATURES: encode_temperatures,
}
STORE = get_typestore(Stores.ROS2_JAZZY)
STORE.register(get_types_from_msg(definition(Kind.SETPOINTS.type_name), Kind.SETPOINTS.type_name))


def session(seconds=20, rate=200):
    """A session of all four topics; the numbers depend on nothing but the arguments."""
    rng = np.random.default_rng(7)
    stamp = START + np.arange(seconds * rate) * (NS // rate)
    pulses = np.rint(rng.normal(0, 99, (len(stamp), 6)))
    slow, second = stamp[::4], stamp[::rate]
    angles = np.cumsum(rng.normal(size=(len(slow), 3)), axis=0)
    steps = [
        Setpoint(int(t), 'p', i // 5, str(i // 5), Mode.POSITION, ('a',), (1.0 * i,), (), 0.0, 9.0)
        for i, t in enumerate(stamp[:: rate // 10].tolist())
    ]
    return {
        IMU: ImuBlock(stamp, pulses[:, :3], pulses[:, 3:], 'imu_link'),
        JOINTS: JointBlock(slow, ('outer', 'middle', 'inner'), angles, 0.5 * angles),
        SETPOINTS: SetpointBlock(tuple(steps)),
        TEMPERATURES: TemperatureBlock(second, rng.normal(20.0, 1.0, len(second))),
    }


def stamps(block):
    if isinstance(block, SetpointBlock):
        return np.array([s.stamp for s in block.setpoints], np.int64)
    return block.stamp


def timeline(blocks):
    """(stamp, topic, payload) of all messages in the order of arrival."""
    rows = [
        zip(stamps(b).tolist(), [t] * len(b), ENCODERS[t](b).payloads(), strict=True)
        for t, b in blocks.items()
    ]
    return sorted(chain(*rows), key=lambda row: row[0])


def write_with_rosbags(
    path, rows, plugin=StoragePlugin.MCAP, compression=CompressionMode.NONE, custom=None
):
    writer = Writer(path, version=9, storage_plugin=plugin)
    writer.set_compression(compression, CompressionFormat.ZSTD)
    for key, value in (custom or {}).items():
        writer.set_custom_data(key, value)
    with writer:
        connections = {}
        for stamp, topic, payload in rows:
            if topic not in connections:
                kind = KINDS[topic].type_name
                connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(connections[topic], stamp, payload)
    return Path(path)


def read(path, topics=KINDS, **options):
    """Blocks by topic, in order, and the losses."""
    with open_recording(path) as recording:
        blocks = list(recording.read({t: KINDS[t] for t in topics}, **options))
        return {t: [b for name, b in blocks if name == t] for t in topics}, recording.losses


def assert_same(blocks, expected):
    for topic, wanted in expected.items():
        got = blocks[topic]
        if isinstance(wanted, SetpointBlock):
            assert tuple(s for b in got for s in b.setpoints) == wanted.setpoints
            continue
        for name in vars(wanted):
            if name in {'names', 'frame_id'}:
                assert {getattr(b, name) for b in got} == {getattr(wanted, name)}
            else:
                joined = np.concatenate([getattr(b, name) for b in got])
                np.testing.assert_array_equal(joined, getattr(wanted, name))


def first_messages(blocks, topic, count):
    """The session's own first messages of one topic."""
    return {topic: part(blocks[topic], 0, count)}


def storage_file(path):
    return next(p for p in sorted(Path(path).iterdir()) if p.name != 'metadata.yaml')
