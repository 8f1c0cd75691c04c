"""Recordings for tests, written by rosbags, and small tools to damage them."""

from itertools import chain
from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from imu_calib.common.stream import (
    Floats,
    ImuBlock,
    JointBlock,
    Mode,
    Setpoint,
    SetpointBlock,
    Stamps,
    TemperatureBlock,
)
from imu_calib.recordings.cdr import definition
from imu_calib.recordings.cdr_codec import (
    Kind,
    encode_imu,
    encode_joints,
    encode_rates,
    encode_setpoints,
    encode_temperatures,
    part,
)
from imu_calib.recordings.rosbag2 import open_recording
from imu_calib.recordings.writer import RecordingWriter

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


def storage_file(path):
    return next(p for p in sorted(Path(path).iterdir()) if p.name != 'metadata.yaml')


T0 = 1_700_000_000_000_000_000


def imu_recording(folder: Path, topics: dict[str, tuple[Stamps, Floats, Floats]]) -> Path:
    with RecordingWriter(folder) as writer:
        for topic, (stamp, gyro, accel) in topics.items():
            none = np.zeros((len(stamp), 9))
            encoded = encode_rates(ImuBlock(stamp, gyro, accel), none, none)
            writer.write(topic, Kind.IMU.type_name, encoded, stamp)
    return folder


def bag_of_ros_1(path: Path) -> None:
    """Write five samples of an IMU, and a topic beside it that no calibration uses."""
    store = get_typestore(Stores.ROS1_NOETIC)
    kinds = store.types
    imu = 'sensor_msgs/msg/Imu'
    with Ros1Writer(path) as writer:
        at = writer.add_connection('/imu/data', imu, typestore=store)
        other = writer.add_connection('/chatter', 'std_msgs/msg/String', typestore=store)
        for k in range(5):
            stamp = T0 + k * 10_000_000
            time = kinds['builtin_interfaces/msg/Time'](stamp // 10**9, stamp % 10**9)
            header = kinds['std_msgs/msg/Header'](k, time, 'imu_link')
            vector = kinds['geometry_msgs/msg/Vector3']
            still = kinds['geometry_msgs/msg/Quaternion'](0.0, 0.0, 0.0, 1.0)
            none = np.zeros(9)
            message = kinds[imu](
                header, still, none, vector(0.1, 0.2, 0.3), none, vector(1.0, 2.0, 9.8), none
            )
            writer.write(at, stamp, store.serialize_ros1(message, imu))
            text = kinds['std_msgs/msg/String']('x')
            writer.write(other, stamp, store.serialize_ros1(text, 'std_msgs/msg/String'))


SESSION = session()
ROWS = timeline(SESSION)


def write_own(path, blocks=SESSION, step=2 * NS, **options):
    """Write a session with our own writer, topic by topic in steps of time."""
    with RecordingWriter(path, **options) as writer:
        for start in range(START, START + 60 * NS, step):
            for topic, block in blocks.items():
                a, b = np.searchsorted(stamps(block), [start, start + step])
                if a < b:
                    some = part(block, int(a), int(b))
                    messages = ENCODERS[topic](some)
                    writer.write(topic, KINDS[topic].type_name, messages, stamps(some))
    return path
