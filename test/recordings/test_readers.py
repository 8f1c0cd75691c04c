"""What we record is read by the readers of others, and what they write by us.

docs/interoperability.md says what was seen, with the versions.
"""

import json
import shutil
import subprocess
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_files import IMU, JOINTS, KINDS, SESSION, SETPOINTS, TEMPERATURES, imu_recording, timeline
from loopback import CHECKOUT

import imu_calib
from imu_calib.calibration.calibration import Calibration
from imu_calib.common.errors import InputError
from imu_calib.common.stream import ImuBlock
from imu_calib.model.sensors import SensorModel
from imu_calib.recordings.cdr import Messages, definition
from imu_calib.recordings.cdr_codec import encode_imu
from imu_calib.recordings.rosbag2 import open_recording
from imu_calib.recordings.writer import Journal
from imu_calib.session.imu import load_imu

TYPE = 'sensor_msgs/msg/Imu'
T0 = 1_700_000_000_000_000_000
RAW, COMPENSATED = '/imu/data_raw', '/imu/data_calibrated'
VECTORS = tuple(
    f'{vector}.{axis}' for vector in ('angular_velocity', 'linear_acceleration') for axis in 'xyz'
)
VALUES = np.random.default_rng(2).normal(size=(50, 6))
UNIT = Calibration(load_imu('si'), SensorModel(), np.zeros((24, 24)))
STAMPS = T0 + np.arange(50) * 10_000_000

Read = dict[str, list[tuple[int, Any]]]
"""Log time and message, as a reader gives it, by topic."""


def by_rosbags(file: Path) -> Read:
    reading = pytest.importorskip('rosbags.highlevel')
    found: Read = {}
    with reading.AnyReader([file.parent]) as reader:
        for connection, log, payload in reader.messages():
            message = reader.deserialize(payload, connection.msgtype)
            found.setdefault(connection.topic, []).append((log, message))
    return found


def by_mcap(file: Path) -> Read:
    decoder = pytest.importorskip('mcap_ros2.decoder')
    reading = pytest.importorskip('mcap.reader')
    found: Read = {}
    with file.open('rb') as stream:
        reader = reading.make_reader(stream, decoder_factories=[decoder.DecoderFactory()])
        reader.get_summary()
        for _, channel, message, decoded in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append((message.log_time, decoded))
        counts = reader.get_summary().statistics.channel_message_counts
    assert sum(counts.values()) == sum(map(len, found.values()))
    return found


def by_foxglove(file: Path) -> Read:
    folder = CHECKOUT / 'test' / 'support' / 'readers'
    if not (shutil.which('node') and (folder / 'node_modules').is_dir()):
        pytest.skip('@mcap/core and @foxglove/rosmsg2-serialization are not installed')
    command = ['node', str(folder / 'read_mcap.mjs'), str(file)]
    read = json.loads(subprocess.run(command, capture_output=True, check=True).stdout)
    return {
        topic: [(int(one['log']), one['decoded']) for one in messages]
        for topic, messages in read.items()
    }


READERS = [by_rosbags, by_mcap, by_foxglove]


def part(message: Any, path: str) -> Any:
    """Return a part of a message: readers give dictionaries or objects."""
    return reduce(
        lambda whole, name: whole[name] if isinstance(whole, dict) else getattr(whole, name),
        path.split('.'),
        message,
    )


def column(read: Read, topic: str, *paths: str) -> np.ndarray[Any, Any]:
    return np.array([[part(message, path) for path in paths] for _, message in read[topic]])


@pytest.fixture(scope='module')
def recordings(tmp_path_factory):
    """The files of a journal of four topics, of a converted and of a compensated recording."""
    folder = tmp_path_factory.mktemp('recordings')
    journal = Journal(folder / 'journal', {'imu_calib.plan': 'name: one'}, KINDS)
    for log, topic, payload in timeline(SESSION):
        journal.write(topic, KINDS[topic].type_name, Messages.join([payload]), log)
    journal.close(finished=True)
    lines = [','.join(map(repr, [k / 100, *row])) for k, row in enumerate(VALUES.tolist())]
    (folder / 'log.csv').write_text('\n'.join(['t,gx,gy,gz,ax,ay,az', *lines]))
    given = {'stamp': 't:s', 'gyro': 'gx,gy,gz:rad/s', 'accel': 'ax,ay,az:m/s^2'}
    imu_calib.convert(folder / 'log.csv', folder / 'converted', **given)
    raw = imu_recording(folder / 'raw', {RAW: (STAMPS, VALUES[:, :3], VALUES[:, 3:])})
    imu_calib.compensate(raw, UNIT, folder / 'compensated', keep=True, compression='zstd')
    names = ('journal', 'converted', 'compensated')
    return {name: next((folder / name).glob('*.mcap')) for name in names}


@pytest.mark.parametrize('reader', READERS)
def test_a_journal_reads_the_same_everywhere(recordings, reader):
    read = reader(recordings['journal'])
    imu, setpoints = SESSION[IMU], SESSION[SETPOINTS].setpoints
    expected = np.hstack([imu.gyro, imu.accel])
    np.testing.assert_array_equal(column(read, IMU, *VECTORS), expected)
    position = column(read, JOINTS, 'position')[:, 0]
    np.testing.assert_array_equal(position, SESSION[JOINTS].position)
    temperature = column(read, TEMPERATURES, 'temperature')[:, 0]
    np.testing.assert_array_equal(temperature, SESSION[TEMPERATURES].celsius)
    steps = column(read, SETPOINTS, 'step', 'mode', 'turns', 'dwell')
    assert steps.tolist() == [[s.step, s.mode, s.turns, s.dwell] for s in setpoints]
    assert column(read, SETPOINTS, 'plan', 'position_id').tolist() == [
        [s.plan, s.position] for s in setpoints
    ]
    assert {t: len(m) for t, m in read.items()} == {t: len(b) for t, b in SESSION.items()}


@pytest.mark.parametrize('reader', READERS)
@pytest.mark.parametrize(
    ('name', 'topic'), [('converted', RAW), ('compensated', RAW), ('compensated', COMPENSATED)]
)
def test_a_converted_and_a_compensated_recording_read_the_same_everywhere(
    recordings, reader, name, topic
):
    read = reader(recordings[name])
    np.testing.assert_allclose(column(read, topic, *VECTORS), VALUES, rtol=1e-15)
    log = np.array([at for at, _ in read[topic]])
    assert np.diff(log).tolist() == [10_000_000] * 49


def by_rerun(file: Path, column: str) -> dict[str, list[Any]]:
    """Return a column of rerun's importer, by its entities."""
    chunk = pytest.importorskip('rerun.chunk')
    found: dict[str, list[Any]] = {}
    for one in chunk.McapReader(file).stream():
        batch = one.to_record_batch()
        if column in batch.schema.names:
            found.setdefault(one.entity_path, []).extend(batch[column].to_pylist())
    return found


def test_rerun_imports_a_journal(recordings):
    imu, joints = SESSION[IMU], SESSION[JOINTS]
    scalars = by_rerun(recordings['journal'], 'Scalars:scalars')
    np.testing.assert_array_equal(scalars[IMU], np.hstack([imu.gyro, imu.accel]))
    np.testing.assert_array_equal(scalars[f'{JOINTS}/position'], joints.position)
    celsius = by_rerun(recordings['journal'], 'Measurements:values')[TEMPERATURES]
    np.testing.assert_array_equal(np.ravel(celsius), SESSION[TEMPERATURES].celsius)
    # A type that it has never heard of is decoded by the definition in the file.
    setpoints = by_rerun(recordings['journal'], 'imu_calib_msgs.msg.TurntableSetpoint:message')
    read = [(one['step'], one['position_id']) for (one,) in setpoints[SETPOINTS]]
    assert read == [(s.step, s.position) for s in SESSION[SETPOINTS].setpoints]


def test_rerun_imports_converted_and_compensated_recordings(recordings):
    for name, topics in (('converted', [RAW]), ('compensated', [RAW, COMPENSATED])):
        scalars = by_rerun(recordings[name], 'Scalars:scalars')
        assert sorted(scalars) == sorted(topics)
        for values in scalars.values():
            np.testing.assert_allclose(values, VALUES, rtol=1e-15)


def ours(path: Path, topic: str) -> np.ndarray[Any, Any]:
    read = imu_calib.read(path, topic)
    return np.column_stack([read[name] for name in VECTORS])


@pytest.mark.parametrize('name', [TYPE, 'sensor_msgs/Imu'])
def test_a_recording_by_mcap_ros2_support_is_read(tmp_path, name):
    writing = pytest.importorskip('mcap_ros2.writer')
    path = tmp_path / 'theirs.mcap'
    with path.open('wb') as stream:
        writer = writing.Writer(stream)
        schema = writer.register_msgdef(name, definition(TYPE))
        for at, row in zip(STAMPS.tolist(), VALUES, strict=True):
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
    np.testing.assert_array_equal(ours(path, '/imu'), VALUES)
    assert imu_calib.read(path, '/imu').stamp.tolist() == STAMPS.tolist()


PAYLOADS = encode_imu(ImuBlock(STAMPS, VALUES[:, :3], VALUES[:, 3:], 'imu')).payloads()


@pytest.fixture
def by_foxglove_sdk(tmp_path):
    """CDR of an IMU, and beside it Protobuf, and JSON with and without a schema."""
    foxglove = pytest.importorskip('foxglove')
    messages = pytest.importorskip('foxglove.messages')
    channels = pytest.importorskip('foxglove.channels')
    path = tmp_path / 'theirs.mcap'
    context = foxglove.Context()
    schema = foxglove.Schema(name=TYPE, encoding='ros2msg', data=definition(TYPE).encode())
    with foxglove.open_mcap(path, context=context):
        imu = foxglove.Channel('/imu', schema=schema, message_encoding='cdr', context=context)
        words = foxglove.Channel('/words', context=context)
        pose = foxglove.Channel('/pose', schema={'type': 'object'}, context=context)
        vector = channels.Vector3Channel('/vector', context=context)
        for at, payload in zip(STAMPS.tolist(), PAYLOADS, strict=True):
            imu.log(payload, log_time=at)
            words.log({'said': 'still'}, log_time=at)
            pose.log({'x': 1.0}, log_time=at)
            vector.log(messages.Vector3(x=1.0, y=2.0, z=3.0), log_time=at)
    return path


def test_a_recording_by_foxglove_sdk_is_read_and_its_other_encodings_are_named(by_foxglove_sdk):
    assert imu_calib.read(by_foxglove_sdk, '/imu').stamp.tolist() == STAMPS.tolist()
    np.testing.assert_array_equal(ours(by_foxglove_sdk, '/imu'), VALUES)
    with open_recording(by_foxglove_sdk) as recording:
        held = {t.name: (t.type, t.encoding, t.count) for t in recording.topics}
    assert held['/imu'] == (TYPE, 'cdr', 50)
    assert held['/vector'] == ('foxglove.Vector3', 'protobuf', 50)
    # It gives schemas without a name one of its own.
    assert {held[topic][1:] for topic in ('/pose', '/words')} == {('json', 50)}
    for topic, said in (('/vector', 'are in Protobuf'), ('/words', 'are in JSON')):
        with pytest.raises(InputError, match=f'messages of {topic} {said}'):
            imu_calib.calibrate(by_foxglove_sdk, imu_topic=topic)


def test_what_foxglove_sdk_recorded_beside_comes_out_of_compensate_as_it_was(
    by_foxglove_sdk, tmp_path
):
    reading = pytest.importorskip('mcap.reader')

    def others(file):
        with file.open('rb') as stream:
            return [
                (
                    c.topic,
                    c.message_encoding,
                    s and (s.name, s.encoding, s.data),
                    m.log_time,
                    m.data,
                )
                for s, c, m in reading.make_reader(stream).iter_messages()
                if not c.topic.startswith('/imu')
            ]

    imu_calib.compensate(by_foxglove_sdk, UNIT, tmp_path / 'out')
    (file,) = (tmp_path / 'out').glob('*.mcap')
    assert len(others(file)) == 150
    assert sorted(others(file), key=str) == sorted(others(by_foxglove_sdk), key=str)


@pytest.mark.parametrize('kind', [0x06, 0x07, 0x09, 0x0B, 0x11, 0x15])
def test_messages_of_xcdr2_are_refused_by_name(tmp_path, kind):
    writing = pytest.importorskip('mcap.writer')
    path = tmp_path / 'theirs.mcap'
    with path.open('wb') as stream:
        writer = writing.Writer(stream)
        writer.start()
        schema = writer.register_schema(TYPE, 'ros2msg', definition(TYPE).encode())
        channel = writer.register_channel('/imu', 'cdr', schema)
        for at, payload in zip(STAMPS.tolist(), PAYLOADS, strict=True):
            writer.add_message(channel, at, bytes([0, kind]) + payload[2:], at)
        writer.finish()
    said = f'50 malformed messages of /imu.*header 00 {kind:02x} 00 00 of XCDR2, expected 00 00 or'
    with pytest.raises(InputError, match=said):
        imu_calib.read(path, '/imu')
