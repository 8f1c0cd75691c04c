"""What we write, read field by field as https://mcap.dev/spec says: readers seek by any of it."""

import struct
import zlib
from dataclasses import dataclass, field

import numpy as np
import pytest
from bag_files import ENCODERS, IMU, KINDS, NS, session, stamps, storage_file, write_own

from imu_calib.recordings.cdr import Messages
from imu_calib.recordings.cdr_codec import part
from imu_calib.recordings.codec import unpack
from imu_calib.recordings.writer import RecordingWriter

SESSION = session()
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, INDEX, CHUNK_INDEX = range(1, 9)
STATISTICS, METADATA, METADATA_INDEX, OFFSET, DATA_END = 0x0B, 0x0C, 0x0D, 0x0E, 0x0F


class Fields:
    """Takes the fields of a record one after the other."""

    def __init__(self, content):
        self.content = content

    def take(self, size):
        taken, self.content = self.content[:size], self.content[size:]
        assert len(taken) == size
        return taken

    def numbers(self, kinds):
        return struct.unpack(f'<{kinds}', self.take(struct.calcsize(f'<{kinds}')))

    def text(self):
        return self.take(*self.numbers('I')).decode()

    def block(self):
        return Fields(self.take(*self.numbers('I')))

    def pairs(self, kinds):
        block = self.block()
        return dict(block.numbers(kinds) for _ in iter(lambda: bool(block.content), False))

    def texts(self):
        block = self.block()
        return {block.text(): block.text() for _ in iter(lambda: bool(block.content), False)}


@dataclass
class Written:
    """A chunk: where its record and its messages are, and what it says of itself."""

    start: int
    length: int
    stored: int
    size: int
    times: tuple[int, int]
    messages: dict[int, list[tuple[int, int]]] = field(default_factory=dict)
    payloads: dict[int, list[bytes]] = field(default_factory=dict)
    indexes: dict[int, int] = field(default_factory=dict)
    index_length: int = 0


def records(content, start=0, end=None):
    """Return where records start, their opcodes and fields."""
    found, end = [], len(content) if end is None else end
    while start < end:
        op, length = struct.unpack_from('<BQ', content, start)
        found.append((start, op, content[start + 9 : start + 9 + length]))
        start += 9 + length
    assert start == end
    return found


class File:
    """A file, every field of which is held against the others while it is read."""

    def __init__(self, path):
        self.content = storage_file(path).read_bytes()
        assert self.content[:8] == self.content[-8:] == b'\x89MCAP0\r\n'
        self.schemas, self.channels, self.chunks = {}, {}, []
        self.metadata, self.sequence = {}, {}
        ended = False
        footer = len(self.content) - 8 - 9 - 20
        self.summary, self.offsets, self.crc = struct.unpack_from('<QQI', self.content, footer + 9)
        for start, op, content in records(self.content, 8, self.summary):
            assert not ended
            ended = op == DATA_END
            if op == HEADER:
                fields = Fields(content)
                self.header = fields.text(), fields.text()
            elif op == CHUNK:
                self.chunk(start, content)
            elif op == INDEX:
                self.index(start, content)
            elif op == METADATA:
                fields = Fields(content)
                name = fields.text()
                self.metadata[name] = fields.texts(), start, 9 + len(content)
            else:
                self.description(op, content)
        assert ended
        self.check_summary(footer)

    def description(self, op, content):
        fields = Fields(content)
        if op == SCHEMA:
            (key,) = fields.numbers('H')
            self.schemas[key] = fields.text(), fields.text(), fields.text()
        elif op == CHANNEL:
            key, schema = fields.numbers('HH')
            self.channels[key] = schema, fields.text(), fields.text(), fields.texts()
        else:
            assert op == DATA_END
            return
        assert not fields.content

    def chunk(self, start, content):
        fields = Fields(content)
        first, last, size, crc = fields.numbers('QQQI')
        compression = fields.text()
        (stored,) = fields.numbers('Q')
        plain = unpack(fields.take(stored), compression, size)
        assert not fields.content
        assert (len(plain), zlib.crc32(plain)) == (size, crc)
        chunk = Written(start, 9 + len(content), stored, size, (first, last))
        for place, op, inside in records(plain):
            if op != MESSAGE:
                self.description(op, inside)
                continue
            channel, sequence, log, publish = struct.unpack_from('<HIQQ', inside)
            self.sequence[channel] = self.sequence.get(channel, 0) + 1
            assert sequence == self.sequence[channel]
            assert log == publish
            chunk.messages.setdefault(channel, []).append((log, place))
            chunk.payloads.setdefault(channel, []).append(inside[22:])
        times = [log for some in chunk.messages.values() for log, _ in some]
        assert chunk.times == (min(times), max(times))
        self.chunks.append(chunk)

    def index(self, start, content):
        chunk, fields = self.chunks[-1], Fields(content)
        (channel,) = fields.numbers('H')
        block = fields.block()
        entries = list(struct.iter_unpack('<QQ', block.content))
        assert not fields.content
        assert entries == chunk.messages[channel]
        chunk.indexes[channel] = start
        chunk.index_length += 9 + len(content)

    def check_summary(self, footer):
        assert self.crc == zlib.crc32(self.content[self.summary : footer + 9 + 16])
        inside = records(self.content, self.summary, self.offsets)
        by_op = {}
        for start, op, content in inside:
            by_op.setdefault(op, []).append((start, content))
        # A group is all records of a kind, one after the other; each has its place.
        places = {}
        for _, op, content in records(self.content, self.offsets, footer):
            assert op == OFFSET
            group, start, length = struct.unpack('<BQQ', content)
            assert {op for _, op, _ in records(self.content, start, start + length)} == {group}
            places[group] = len(records(self.content, start, start + length))
        assert places == {op: len(group) for op, group in by_op.items()}
        before = dict(self.schemas), dict(self.channels)
        for op in (SCHEMA, CHANNEL):
            for _, content in by_op.get(op, ()):
                self.description(op, content)
        assert before == (self.schemas, self.channels)
        assert len(by_op.get(SCHEMA, ())) == len(self.schemas)
        assert len(by_op.get(CHANNEL, ())) == len(self.channels)
        for chunk, (_, content) in zip(self.chunks, by_op.get(CHUNK_INDEX, ()), strict=True):
            fields = Fields(content)
            assert fields.numbers('QQQQ') == (*chunk.times, chunk.start, chunk.length)
            assert fields.pairs('HQ') == chunk.indexes
            assert fields.numbers('Q') == (chunk.index_length,)
            fields.text()
            assert fields.numbers('QQ') == (chunk.stored, chunk.size)
            assert not fields.content
        listed = {}
        for _, content in by_op.get(METADATA_INDEX, ()):
            fields = Fields(content)
            start, length = fields.numbers('QQ')
            listed[fields.text()] = start, length
        assert listed == {name: (start, n) for name, (_, start, n) in self.metadata.items()}
        ((_, content),) = by_op[STATISTICS]
        fields = Fields(content)
        counted = self.sequence.values()
        numbers = len(self.schemas), len(self.channels), 0, len(self.metadata), len(self.chunks)
        times = [time for chunk in self.chunks for time in chunk.times] or [0]
        assert fields.numbers('QHIIIIQQ') == (sum(counted), *numbers, min(times), max(times))
        counts = fields.pairs('HQ')
        assert {key: count for key, count in counts.items() if count} == self.sequence
        assert counts.keys() == self.channels.keys()

    def payloads(self, topic):
        (key,) = (key for key, (_, name, *_) in self.channels.items() if name == topic)
        return [one for chunk in self.chunks for one in chunk.payloads.get(key, ())]


@pytest.mark.parametrize('compression', ['', 'lz4', 'zstd'])
def test_every_field_agrees_with_what_it_speaks_of(tmp_path, compression):
    file = File(write_own(tmp_path / 'own', compression=compression, chunk_bytes=1 << 15))
    assert file.header == ('ros2', 'imu_calib')
    assert len(file.chunks) > 10
    for topic, block in SESSION.items():
        assert file.payloads(topic) == ENCODERS[topic](block).payloads()
    for schema, topic, encoding, _ in file.channels.values():
        name, language, definition = file.schemas[schema]
        assert (name, language, encoding) == (KINDS[topic].type_name, 'ros2msg', 'cdr')
        assert definition


def test_a_file_without_messages_is_whole(tmp_path):
    with RecordingWriter(tmp_path / 'own') as writer:
        writer.add_topic(IMU, KINDS[IMU].type_name)
    file = File(tmp_path / 'own')
    assert file.chunks == []
    assert [topic for _, topic, *_ in file.channels.values()] == [IMU]


@pytest.mark.parametrize('sizes', [(0, 8, 8), (8, 0, 0), (0, 4, 8), (8, 8, 8)])
def test_messages_of_any_sizes_come_out_as_they_went_in(tmp_path, sizes):
    payloads = [bytes([1 + k]) * (60 + more) for k, more in enumerate(sizes)]
    with RecordingWriter(tmp_path / 'own') as writer:
        writer.write(IMU, KINDS[IMU].type_name, Messages.join(payloads), np.arange(3) + NS)
    assert File(tmp_path / 'own').payloads(IMU) == payloads


def test_what_is_interrupted_leaves_a_file_of_what_was_written(tmp_path, monkeypatch):
    """Ctrl-C within the first message of a topic left an index of nothing, and another error."""
    payloads, stack = [bytes([k]) * 64 for k in range(3)], np.stack
    with pytest.raises(KeyboardInterrupt), RecordingWriter(tmp_path / 'own') as writer:
        writer.write(IMU, KINDS[IMU].type_name, Messages.join(payloads), np.arange(3) + NS)

        def interrupted(*_):
            monkeypatch.setattr(np, 'stack', stack)
            raise KeyboardInterrupt

        monkeypatch.setattr(np, 'stack', interrupted)
        writer.write('other', KINDS[IMU].type_name, Messages.join(payloads), np.arange(3) + NS)
    assert File(tmp_path / 'own').payloads(IMU) == payloads


def test_a_chunk_ends_where_it_is_full(tmp_path):
    block, limit = SESSION[IMU], 1 << 14
    with RecordingWriter(tmp_path / 'own', chunk_bytes=limit) as writer:
        writer.write(IMU, KINDS[IMU].type_name, ENCODERS[IMU](block), stamps(block))
    sizes = [chunk.size for chunk in File(tmp_path / 'own').chunks]
    message = 31 + int(ENCODERS[IMU](block).size[0])
    assert all(limit - message < size <= limit for size in sizes[1:-1])
    assert sizes[0] <= limit


@pytest.mark.parametrize(('seconds', 'chunks'), [(2, 1), (5, 2), (6, 2)])
def test_a_chunk_ends_after_five_seconds_however_little_it_holds(tmp_path, seconds, chunks):
    """A stand that is killed loses what waits for its chunk."""
    with RecordingWriter(tmp_path / 'own') as writer:
        for k in range(3):
            one = ENCODERS[IMU](part(SESSION[IMU], k, k + 1))
            writer.write(IMU, KINDS[IMU].type_name, one, np.array([k * seconds * NS]))
    assert len(File(tmp_path / 'own').chunks) == chunks
