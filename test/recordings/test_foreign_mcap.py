"""What other recorders put into an mcap comes out of `compensate` as it went in."""

import struct
import zlib
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from mcap_bytes import (
    CHANNEL,
    MAGIC,
    METADATA,
    SCHEMA,
    block,
    footer,
    message,
    metadata,
    record,
    text,
    texts,
)
from shaky import shaky

from imu_calib.api.compensate import compensate
from imu_calib.calibration.calibration import Calibration
from imu_calib.model.sensors import SensorModel
from imu_calib.recordings.cdr import definition
from imu_calib.recordings.cdr_codec import encode_imu
from imu_calib.recordings.rosbag2 import open_recording
from imu_calib.session.imu import load_imu

ATTACHMENT, ATTACHMENT_INDEX, MESSAGE, CHUNK, STATISTICS = 0x09, 0x0A, 0x05, 0x06, 0x0B
IMU_TYPE = 'sensor_msgs/msg/Imu'
# A FileDescriptorSet of protobuf: bytes that are no text, zeros among them.
BINARY = bytes([0x0A, 0xFF, 0xFE, 0x00, 0x80, 0xC3, 0x28]) + bytes(range(256))
ZSTD = b'\x28\xb5\x2f\xfd'
LOG = 1_700_000_000 * 10**9

SCHEMAS = {
    1: (IMU_TYPE, 'ros2msg', definition(IMU_TYPE).encode()),
    2: ('foxglove.Image', 'protobuf', BINARY),
    3: ('foxglove.Image', 'protobuf', BINARY[::-1]),
    4: ('Pose', 'jsonschema', b'{"type": "object"}'),
}
# Schema, topic, encoding and metadata. Channel 6 has no schema; 3 and 4 are of one topic.
CHANNELS = {
    1: (1, '/imu/data_raw', 'cdr', {'offered_qos_profiles': ''}),
    2: (2, '/image', 'protobuf', {'lens': 'wide'}),
    3: (3, '/both', 'protobuf', {'side': 'left'}),
    4: (2, '/both', 'protobuf', {'side': 'right'}),
    5: (4, '/pose', 'json', {}),
    6: (0, '/words', 'json', {}),
    7: (3, '/silent', 'protobuf', {}),
}
NOTES = [('calibration', {'by': 'A'}), ('calibration', {'by': 'B'}), ('notes', {'weather': 'rain'})]


def attachment(name: str, data: bytes) -> bytes:
    content = struct.pack('<QQ', LOG, LOG - 5) + text(name) + text('application/octet-stream')
    content += struct.pack('<Q', len(data)) + data
    return content + struct.pack('<I', zlib.crc32(content))


ATTACHED = [attachment('map.bin', BINARY * 3), attachment('empty', b'')]


def sent() -> list[tuple[int, int, int, bytes]]:
    """Channel, log time, sequence and data of all messages but those of the IMU."""
    found = []
    for k in range(200):
        found += [
            # Data of an image may begin like a frame of zstd.
            (2, LOG + k * 10**7, 7 * k, (ZSTD if k == 0 else b'') + BINARY[: k % 9]),
            (3 + k % 2, LOG + k * 10**7 + 1, 3 * k, bytes([k])),
            (5, LOG + k * 10**7 + 2, 0, b'{"x": %d}' % k),
            (6, LOG + k * 10**7 + 3, k, b''),
        ]
    return found


@pytest.fixture
def foreign(tmp_path):
    samples = shaky(SensorModel(), rate=100, holds=3, noise=(1e-3, 0.01)).block
    content = MAGIC + record(0x01, text('') + text('another recorder'))
    for key, (name, language, data) in SCHEMAS.items():
        content += record(
            SCHEMA, struct.pack('<H', key) + text(name) + text(language) + block(data)
        )
    for key, (schema, topic, encoding, pairs) in CHANNELS.items():
        names = text(topic) + text(encoding) + texts(**pairs)
        content += record(CHANNEL, struct.pack('<HH', key, schema) + names)
    content += b''.join(metadata(name, **pairs) for name, pairs in NOTES)
    content += record(ATTACHMENT, ATTACHED[0])
    for key, log, sequence, data in sent():
        head = struct.pack('<HIQQ', key, sequence, log, log - 9)
        content += record(MESSAGE, head + data)
    for k, payload in enumerate(encode_imu(samples).payloads()):
        content += message(1, LOG + k * 10**7, payload)
    content += record(ATTACHMENT, ATTACHED[1]) + record(0x0F, bytes(4))
    path = tmp_path / 'foreign.mcap'
    path.write_bytes(content + footer(0))
    return path


def records(content: bytes) -> list[tuple[int, bytes]]:
    """Opcode and content of all records, those in chunks too."""
    found, place = [], 0
    while place < len(content):
        op, size = struct.unpack_from('<BQ', content, place)
        inside = content[place + 9 : place + 9 + size]
        found.append((op, inside))
        if op == CHUNK:
            (packed,) = struct.unpack_from('<I', inside, 28)
            assert packed == 0
            found += records(inside[40:])
        place += 9 + size
    return found


def described(content: bytes) -> tuple[dict, dict, list]:
    """Schemas, channels and messages without ids; the order of messages is that of log times."""
    schemas, channels, messages = {0: None}, {}, []
    for op, inside in records(content):
        if op == SCHEMA:
            schemas[struct.unpack_from('<H', inside)[0]] = inside[2:]
        elif op == CHANNEL:
            key, schema = struct.unpack_from('<HH', inside)
            channels[key] = schemas[schema], inside[4:]
        elif op == MESSAGE:
            key, sequence, log, publish = struct.unpack_from('<HIQQ', inside)
            messages.append((log, publish, channels[key], sequence, inside[22:]))
    return schemas, channels, messages


def data_section(path: Path) -> bytes:
    content = path.read_bytes()
    start = struct.unpack_from('<Q', content, len(content) - 28)[0]
    return content[len(MAGIC) : start or len(content) - 37]


def summary(path: Path) -> list[tuple[int, bytes]]:
    content = path.read_bytes()
    start = struct.unpack_from('<Q', content, len(content) - 28)[0]
    return records(content[start : len(content) - len(MAGIC)])


@pytest.mark.parametrize('keep', [True, False])
def test_all_else_in_a_foreign_mcap_comes_out_as_it_went_in(foreign, tmp_path, keep):
    square = np.zeros((24, 24))
    unit = Calibration(load_imu('si'), SensorModel(), square)
    compensate(foreign, unit, tmp_path / 'out', keep=keep)
    (file,) = (tmp_path / 'out').glob('*.mcap')
    _, channels, messages = described(data_section(foreign))
    _, channels_after, messages_after = described(data_section(file))
    kept = [one for one in channels.values() if keep or b'/imu/data_raw' not in one[1]]
    added = [one for one in channels_after.values() if b'/imu/data_calibrated' in one[1]]
    assert len(added) == 1
    # One without profiles of its own gets an empty list, which ROS can read.
    profiles = text('offered_qos_profiles') + text('')
    kept = [
        (schema, inside.replace(block(profiles), texts(offered_qos_profiles='[]\n')))
        for schema, inside in kept
    ]
    assert Counter(kept) == Counter(one for one in channels_after.values() if one not in added)
    others = [one for one in messages if b'/imu/data_raw' not in one[2][1]]
    others_after = [one for one in messages_after if b'/imu/' not in one[2][1]]
    assert len(others) == len(sent())
    assert sorted(others_after) == sorted(others)
    after = records(data_section(file))
    pairs = [inside for op, inside in after if op == METADATA]
    assert all(text(name) + texts(**one) in pairs for name, one in NOTES)
    assert [inside for op, inside in after if op == ATTACHMENT] == ATTACHED
    content = file.read_bytes()
    listed = [inside for op, inside in summary(file) if op == ATTACHMENT_INDEX]
    for inside, attached in zip(listed, ATTACHED, strict=True):
        start, length, log, created, size = struct.unpack_from('<5Q', inside)
        assert content[start : start + length] == record(ATTACHMENT, attached)
        assert (log, created) == (LOG, LOG - 5)
        assert inside[40:] == attached[16:][: len(inside) - 40]
        assert struct.unpack_from('<Q', attached, 16 + len(inside) - 40)[0] == size
    (statistics,) = [inside for op, inside in summary(file) if op == STATISTICS]
    schemas, count, attachments = struct.unpack_from('<HII', statistics, 8)
    assert (schemas, count, attachments) == (4, len(channels_after), 2)


def test_a_second_time_it_comes_through_by_the_summary_too(foreign, tmp_path):
    unit = Calibration(load_imu('si'), SensorModel(), np.zeros((24, 24)))
    compensate(foreign, unit, tmp_path / 'one', keep=True)
    compensate(
        tmp_path / 'one', unit, tmp_path / 'two', imu_topic='/imu/data_raw', output_topic='/again'
    )
    (file,) = (tmp_path / 'two').glob('*.mcap')
    _, _, messages = described(data_section(foreign))
    _, _, after = described(data_section(file))
    others = [one for one in messages if b'/imu/' not in one[2][1]]
    assert sorted(
        one for one in after if b'/imu/' not in one[2][1] and b'/again' not in one[2][1]
    ) == sorted(others)
    with open_recording(tmp_path / 'two') as recording:
        assert list(recording.attachments()) == ATTACHED
        assert [one for one in recording.metadata if one[0] in ('calibration', 'notes')] == NOTES
