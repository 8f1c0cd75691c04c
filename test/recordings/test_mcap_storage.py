"""Where the messages of a chunk lie: by the index where it is sound, record by record elsewhere."""

import io
import struct
import tracemalloc
import zlib
from collections.abc import Callable, Hashable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap_bytes import (
    DATA_END,
    HEAD,
    MAGIC,
    MESSAGE,
    Chunked,
    channel,
    chunk,
    message,
    metadata,
    record,
    schema,
    text,
)

from imu_calib.recordings import mcap
from imu_calib.recordings import mcap_records as mcap_chunk
from imu_calib.recordings.cdr import Bytes
from imu_calib.recordings.mcap import McapStorage, UnpackedChunks, _tables, _with_checksum
from imu_calib.recordings.mcap_records import Chunk, chunk_at, grouped
from imu_calib.recordings.mcap_scan import ChannelMessages, ChunkContent, indexed, located
from imu_calib.recordings.storage import Cache, Losses, Memory, MessageBatch

NS = 1_000_000_000
END = record(DATA_END, bytes(4))


class Opened:
    """A file that is open as storage, and what is said of it."""

    def __init__(self, path: Path, content: bytes) -> None:
        path.write_bytes(content)
        self.losses = Losses()
        self.storage = McapStorage(path, self.losses)

    def batches(self, topic: str) -> list[MessageBatch]:
        (cursor,) = self.storage.cursors(frozenset({topic}), Cache(1 << 20)).values()
        return list(cursor)

    def payloads(self, topic: str) -> list[bytes]:
        return [one for batch in self.batches(topic) for one in batch.messages.payloads()]


@pytest.fixture
def opened(tmp_path):
    return lambda content: Opened(tmp_path / 'a.mcap', content)


Open = Callable[[bytes], Opened]
FIRST = (1, 11 * NS, b'x'), (2, 10 * NS, b'yy'), (1, 12 * NS, b'')
SECOND = (2, 14 * NS, b''), (2, 13 * NS, b'z')


def two(compression: str = '') -> Chunked:
    return Chunked(compression=compression).describe().add(*FIRST).add(*SECOND)


def test_messages_of_a_topic_come_chunk_by_chunk(opened, monkeypatch):
    monkeypatch.setattr(mcap_chunk, 'TOGETHER', 0)
    file = two()
    found = opened(file.summed_up())
    (only,) = found.batches('/a')
    assert only.messages.payloads() == [b'x', b'']
    assert only.log_ns == 11 * NS
    assert only.position == file.places[0][1]
    first, second = found.batches('/b')
    assert (first.log_ns, first.position) == (10 * NS, file.places[0][1])
    assert second.messages.payloads() == [b'', b'z']
    # The log time is that of the first in the file, not the earliest.
    assert (second.log_ns, second.position) == (14 * NS, file.places[1][1])
    assert second.times().log.tolist() == [14 * NS, 13 * NS]
    assert found.batches('/c') == []
    assert found.losses.sentences == []


@pytest.mark.parametrize('compression', ['', 'lz4'])
def test_small_chunks_are_loaded_as_one(opened, monkeypatch, compression):
    ranges = reads(monkeypatch)
    file = two(compression)
    found = opened(file.summed_up())
    cursors = found.storage.cursors(frozenset({'/a', '/b'}), Cache(1 << 20))
    ((a,), (b,)) = (list(cursors[topic]) for topic in ('/a', '/b'))
    assert a.messages.payloads() == [b'x', b'']
    assert b.messages.payloads() == [b'yy', b'', b'z']
    assert (a.log_ns, b.log_ns) == (11 * NS, 10 * NS)
    assert b.times().log.tolist() == [10 * NS, 14 * NS, 13 * NS]
    assert a.position == b.position == file.places[1][1]
    assert len(ranges) == 1
    assert found.losses.sentences == []


@pytest.mark.parametrize('compression', ['', 'lz4'])
@pytest.mark.parametrize('lost', [0, 1])
def test_of_chunks_that_are_loaded_as_one_the_sound_ones_are_used(opened, compression, lost):
    file = two(compression)
    content = bytearray(file.content)
    start, end, _ = file.places[lost]
    # The last stored byte is one of the last message, or of what marks the end of a frame.
    content[end - 1] ^= 0xFF
    found = opened(bytes(content) + END)
    assert found.payloads('/b') == ([b'yy'] if lost else [b'', b'z'])
    assert found.payloads('/a') == ([b'x', b''] if lost else [])
    (losses,) = found.losses.sentences
    assert losses.startswith(f'a.mcap: the chunk at byte {start} ')


def test_when_a_message_was_published_is_beside_when_it_was_logged(opened):
    inside = message(1, 7, b'abc', 5) + message(1, 9, b'', 2**40)
    file = Chunked().describe().add_raw(inside, (7, 9), {1: [(7, 0), (9, HEAD + 3)]})
    times = opened(file.summed_up()).batches('/a')[0].times()
    assert times.log.tolist() == [7, 9]
    assert times.publish.tolist() == [5, 2**40]


def test_publishers_of_one_topic_come_in_the_order_of_the_file(opened):
    file = Chunked(described=schema(1, 'A') + channel(1, 1, '/a') + channel(2, 1, '/a')).describe()
    found = opened(file.add(*FIRST).summed_up())
    (only,) = found.batches('/a')
    assert only.messages.payloads() == [b'x', b'yy', b'']
    assert only.log_ns == 10 * NS
    assert found.storage.topics['/a'].count == 3


def test_topics_are_counted_by_the_summary_or_by_the_indexes(opened):
    file = two()
    counts = {name: one.count for name, one in opened(file.summed_up()).storage.topics.items()}
    assert counts == {'/a': 2, '/b': 3}
    without = opened(file.content + END).storage
    assert {name: one.count for name, one in without.topics.items()} == counts
    assert (without.start_ns, without.end_ns) == (10 * NS, 14 * NS)
    # Without an index nobody has counted.
    bare = Chunked().describe().add_raw(message(1, 5), (5, 5), {})
    assert opened(two().content + bare.content[bare.places[0][0] :] + END).storage.topics[
        '/a'
    ].count is None  # fmt: skip


def test_an_empty_chunk_tells_no_time(opened):
    file = two().add_raw(b'', (0, 0), {})
    index_of_none = record(0x07, struct.pack('<HI', 1, 0))
    found = opened(file.content + index_of_none + END).storage
    assert (found.start_ns, found.end_ns) == (0, 14 * NS)
    found = opened(two().content + END).storage
    assert (found.start_ns, found.end_ns) == (10 * NS, 14 * NS)
    assert opened(MAGIC + END).storage.start_ns is None


def test_metadata_are_custom_data_and_those_of_rosbag2_hold_them(opened):
    own = metadata('rosbag2', serialized_metadata='custom_data: {plan: p, imu: i}')
    found = opened(Chunked().describe().content + metadata('any', a='b') + own + END)
    assert found.storage.custom_data == {'a': 'b', 'plan': 'p', 'imu': 'i'}
    assert opened(MAGIC + metadata('rosbag2', a='b') + END).storage.custom_data == {}


def reads(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int]]:
    """Return what is read of chunks from now on."""
    ranges: list[tuple[int, int]] = []
    read = mcap._read

    def noted(file: Any, position: int, size: int, *memory: Any) -> memoryview:
        ranges.append((position, size))
        return read(file, position, size, *memory)

    monkeypatch.setattr(mcap, '_read', noted)
    return ranges


def test_chunks_are_looked_into_for_channels_that_nobody_has_described(opened, monkeypatch):
    ranges = reads(monkeypatch)
    opened(two().summed_up())
    opened(two().content + END)
    assert ranges == []
    described = two().described
    file = Chunked().add(*FIRST, before=described).add(*SECOND)
    found = opened(file.content + END)
    (start, end, _), _ = file.places
    # The second one holds a channel that the first describes.
    assert ranges == [(start + 49, end - start - 49)]
    assert found.payloads('/b') == [b'yy', b'', b'z']
    assert found.storage.topics['/b'].type == 'a_msgs/msg/A'
    assert found.losses.sentences == []


@pytest.mark.parametrize('known', [True, False])
def test_a_chunk_without_an_index_is_looked_into_unless_all_is_known(opened, monkeypatch, known):
    file = Chunked().describe().add_raw(message(1, 5, b'q'), (5, 5), {})
    file.counts = {1: 1}
    ranges = reads(monkeypatch)
    found = opened(file.summed_up() if known else file.content + END)
    assert len(ranges) == (0 if known else 1)
    assert found.payloads('/a') == [b'q']


def test_a_broken_description_in_a_chunk_is_a_stated_loss(opened):
    file = Chunked().add(*FIRST, before=two().described + record(0x03, b'\x01'))
    losses = opened(file.content + END).losses.sentences
    assert len(losses) == 1
    assert losses[0].startswith('a.mcap: record with opcode 3: ')


class Asked(Cache):
    """Notes what it is asked for, and by how many."""

    def __init__(self) -> None:
        super().__init__(1 << 20)
        self.keys: list[tuple[int, int]] = []

    def get(self, key: Hashable, load: Any, users: int) -> Any:
        self.keys.append((key[1], users))
        return super().get(key, load, users)


def test_a_chunk_is_asked_for_by_those_whose_messages_it_holds(opened, monkeypatch):
    monkeypatch.setattr(mcap_chunk, 'TOGETHER', 0)
    file, cache = two(), Asked()
    storage = opened(file.summed_up()).storage
    for cursor in storage.cursors(frozenset({'/a', '/b', '/c'}), cache).values():
        assert list(cursor) or True
    (first, _, _), (second, _, _) = file.places
    assert sorted(cache.keys) == [(first, 2), (first, 2), (second, 1)]


# A description, then messages of two channels and of 0 to 3 bytes.
HEADED = schema(1, 'A')
INSIDE = HEADED + b''.join(message(1 + k % 2, 50 + k, bytes(k)) for k in range(4))
PLACES = [len(HEADED) + HEAD * k + sum(range(k)) for k in range(4)]
BUFFER = np.frombuffer(INSIDE, np.uint8)


def tables(*rows: tuple[int, int, int]) -> dict[int, np.ndarray]:
    """Index entries of channel, log time and offset."""
    keys = dict.fromkeys(key for key, _, _ in rows)
    return {k: np.array([row[1:] for row in rows if row[0] == k], np.int64) for k in keys}


def indexed_alone(index: dict[int, np.ndarray], buffer: Bytes) -> dict[int, ChannelMessages] | None:
    """Find the messages of a chunk that has the buffer for itself."""
    return indexed([ChunkContent('a chunk', 0, len(buffer), index)], buffer)


SOUND = [(1, 50, PLACES[0]), (2, 51, PLACES[1]), (1, 52, PLACES[2]), (2, 53, PLACES[3])]


@pytest.mark.parametrize('order', [[0, 1, 2, 3], [2, 1, 0, 3], [3, 2, 1, 0]])
def test_an_index_in_any_order_gives_messages_in_that_of_the_file(order):
    found = indexed_alone(tables(*(SOUND[k] for k in order)), BUFFER)
    assert found is not None
    for key, k in ((1, 0), (2, 1)):
        assert found[key].offset.tolist() == [PLACES[k] + HEAD, PLACES[k + 2] + HEAD]
        assert found[key].size.tolist() == [k, k + 2]
        assert found[key].log_ns == 50 + k


def test_entries_of_several_chunks_may_come_in_any_order():
    messages = INSIDE[len(HEADED) :]
    rows = [(key, time, place - len(HEADED)) for key, time, place in reversed(SOUND)]
    size, buffer = len(messages), np.frombuffer(messages * 2, np.uint8)
    parts = [ChunkContent('a chunk', start, start + size, tables(*rows)) for start in (0, size)]
    found = indexed(parts, buffer)
    places = [place - len(HEADED) + HEAD for place in PLACES]
    assert found[1].offset.tolist() == [at + start for start in (0, size) for at in places[::2]]
    assert found[2].size.tolist() == [1, 3, 1, 3]
    assert (found[1].log_ns, found[2].log_ns) == (50, 51)


def test_an_index_is_complete_with_or_without_records_of_other_kinds():
    for before, between, after in (
        (b'', b'', b''),
        (HEADED, HEADED * 2, HEADED),
        (b'', b'', HEADED),
    ):
        one, other = message(1, 5, b'abc'), message(1, 6)
        content = before + one + between + other + after
        rows = (1, 5, len(before)), (1, 6, len(before + one + between))
        found = indexed_alone(tables(*rows), np.frombuffer(content, np.uint8))
        assert found[1].size.tolist() == [3, 0]


@pytest.mark.parametrize(
    'rows',
    [
        [],
        SOUND[:3],
        SOUND[1:],
        [SOUND[0], SOUND[0], *SOUND[1:]],
        [*SOUND[:3], (2, 53, PLACES[3] + 1)],
        [*SOUND[:3], (2, 53, len(INSIDE))],
        [*SOUND[:3], (2, 53, 2**62)],
        [(1, 50, -1), *SOUND[1:]],
        [(1, 50, 0), *SOUND[1:]],
        [(2, 50, PLACES[0]), *SOUND[1:]],
    ],
)
def test_an_index_that_contradicts_the_chunk_is_not_used(rows):
    assert indexed_alone(tables(*rows), BUFFER) is None


def with_length(content: bytes, place: int, length: int) -> Bytes:
    changed = content[: place + 1] + struct.pack('<Q', length) + content[place + 9 :]
    return np.frombuffer(changed, np.uint8)


def test_messages_that_overlap_or_are_too_short_are_none():
    assert indexed_alone(tables(*SOUND), with_length(INSIDE, PLACES[1], 21)) is None
    assert indexed_alone(tables(*SOUND), with_length(INSIDE, PLACES[1], 24)) is None
    assert indexed_alone(tables(*SOUND), with_length(INSIDE, PLACES[3], 26)) is None
    # Too short by as much as another is too long.
    both = with_length(with_length(INSIDE, PLACES[0], 21).tobytes(), PLACES[1], 24)
    assert indexed_alone(tables(*SOUND), both) is None


def test_what_lies_between_messages_is_whole_records():
    one, other = message(1, 5), message(1, 6)
    for between, sound in [
        (record(0x80, b'abc'), True),
        (record(0x80, b'abc') + b'\x80', False),
        (b'\x80' * 5, False),
        (record(0x80, b'abc') + message(2, 9), False),
    ]:
        content = one + between + other
        rows = (1, 5, 0), (1, 6, len(one + between))
        assert (indexed_alone(tables(*rows), np.frombuffer(content, np.uint8)) is not None) is sound


def walked(opened: Open, inside: bytes) -> Opened:
    """A file of one chunk without an index."""
    return opened(Chunked().describe().add_raw(inside, (5, 5), {}).content + END)


def place_of_chunk() -> int:
    return len(Chunked().describe().content)


def test_without_an_index_messages_are_found_record_by_record(opened):
    inside = HEADED + message(2, 70, b'ab') + message(1, 60, b'c') + message(2, 61)
    found = walked(opened, inside)
    (a,), (b,) = found.batches('/a'), found.batches('/b')
    assert (a.messages.payloads(), a.log_ns) == ([b'c'], 60)
    assert (b.messages.payloads(), b.log_ns) == ([b'ab', b''], 70)
    assert b.times().log.tolist() == [70, 61]
    assert found.losses.sentences == []


def test_what_follows_a_broken_record_of_a_chunk_is_left_out(opened):
    sound = message(1, 60, b'c')
    found = walked(opened, sound + bytes(17))
    assert found.payloads('/a') == [b'c']
    assert found.losses.sentences == [
        f'a.mcap: the chunk at byte {place_of_chunk()} (log time 0.000 s to 0.000 s) holds no '
        f'valid record at its byte {len(sound)}; its other 17 bytes are left out.'
    ]


def test_messages_too_short_to_be_any_are_counted(opened):
    short = record(MESSAGE, struct.pack('<HIQI', 1, 0, 7, 0) + b'abc')
    found = walked(opened, short + message(1, 60, b'c') + record(MESSAGE, bytes(3)))
    assert found.payloads('/a') == [b'c']
    assert found.losses.sentences == [
        f'a.mcap: the chunk at byte {place_of_chunk()} (log time 0.000 s to 0.000 s) holds 2 '
        'records that are too short for a message.'
    ]
    tiny = walked(opened, record(MESSAGE))
    assert tiny.payloads('/a') == []


def lost(opened: Open, changed: bytes) -> str:
    """What is said of a first chunk that was changed; the second is sound."""
    file = two()
    start, end, _ = file.places[0]
    found = opened(file.content[:start] + changed + file.content[end:] + END)
    assert found.payloads('/b') == [b'', b'z']
    assert found.payloads('/a') == []
    (losses,) = found.losses.sentences
    where = f'a.mcap: the chunk at byte {start} (log time 10.000 s to 12.000 s) '
    end_of_it = '; its messages (2 of /a, 1 of /b) are left out.'
    assert losses.startswith(where)
    assert losses.endswith(end_of_it)
    return losses.removeprefix(where).removesuffix(end_of_it)


def test_a_chunk_that_is_not_sound_is_left_out_and_says_why(opened):
    inside = b''.join(message(*one) for one in FIRST)
    times = 10 * NS, 12 * NS
    size = len(inside)
    assert lost(opened, chunk(inside, times, crc=1)) == 'is corrupt (its CRC does not match)'
    for other in (size + 1, size - 1):
        said = lost(opened, chunk(inside, times, size=other))
        assert said == f'unpacks to {size} bytes instead of {other}'
    packed = struct.pack('<QQQI', *times, size, 0) + text('lz4') + struct.pack('<Q', 3) + b'abc'
    assert lost(opened, record(0x06, packed)).startswith('does not unpack (lz4: ')


@pytest.mark.parametrize('compression', ['zstd', 'lz4'])
def test_a_chunk_is_not_unpacked_beyond_its_stated_size(opened, compression):
    bomb = chunk(bytes(64 << 20), (10 * NS, 12 * NS), size=100_000, compression=compression)
    assert len(bomb) < 1 << 20
    tracemalloc.start()
    try:
        said = lost(opened, bomb)
        assert tracemalloc.get_traced_memory()[1] < 8 << 20
    finally:
        tracemalloc.stop()
    assert said == f'does not unpack ({compression}: it unpacks to more than 100000 bytes)'


def test_a_chunk_without_a_checksum_is_taken_as_it_is(opened):
    file = two()
    start, end, _ = file.places[0]
    inside = b''.join(message(*one) for one in FIRST)
    other = chunk(inside, (10 * NS, 12 * NS), crc=0)
    found = opened(file.content[:start] + other + file.content[end:] + END)
    assert found.payloads('/a') == [b'x', b'']
    assert found.losses.sentences == []


def test_a_chunk_of_which_nobody_counted_the_messages_says_so(opened):
    start = place_of_chunk()
    content = Chunked().describe().content + chunk(message(1, 5), (5, 5), crc=1) + END
    found = opened(content)
    assert found.losses.sentences == [
        f'a.mcap: the chunk at byte {start} (log time 0.000 s to 0.000 s) is corrupt (its CRC does '
        'not match); its messages are left out.'
    ]


def test_of_a_chunk_that_is_cut_the_whole_messages_are_used(opened):
    file = Chunked().describe().add(*FIRST)
    start, end, _ = file.places[0]
    size, kept = end - start - 49, HEAD + 1 + HEAD + 2
    found = opened(file.content[: end - 1])
    assert found.payloads('/a') == [b'x']
    assert found.payloads('/b') == [b'yy']
    assert found.losses.sentences[1] == (
        f'a.mcap: the chunk at byte {start} (log time 10.000 s to 12.000 s) is cut off by the end '
        f'of the file; the first {kept} of its {size} bytes are used.'
    )
    assert len(found.losses.sentences) == 2


class Noted(io.BytesIO):
    """A file that notes what is read of it."""

    def __init__(self, content: bytes) -> None:
        super().__init__(content)
        self.ranges: list[tuple[int, int]] = []

    def read(self, size: int | None = -1) -> bytes:
        self.ranges.append((self.tell(), size or 0))
        return super().read(size)


def entries(*rows: tuple[int, int]) -> bytes:
    return b''.join(struct.pack('<qq', *row) for row in rows)


def tables_of(given: Chunk, file: Noted) -> dict[int, list[list[int]]]:
    """Read a chunk with what is near of its message index; return that."""
    file.seek(given.start)
    content = memoryview(file.read(given.reach - given.start))
    found = _tables(given, content, given.start, file)
    return {key: table.tolist() for key, table in found.items()}


def test_a_chunk_and_the_index_behind_it_are_read_at_once():
    one, other = entries((1, 2), (3, 4)), entries((5, 6))
    content = b'..' + b'stored' + b'heads' + one + b'head' + other + b'rest'
    file = Noted(content)
    place = 2 + 6 + 5
    index = {7: (place, 2), 8: (place + 32 + 4, 1), 9: (place, 0)}
    assert tables_of(Chunk(2, 2, 6, 6, '', 0, 0, 0, index), file) == {
        7: [[1, 2], [3, 4]],
        8: [[5, 6]],
    }
    assert file.ranges == [(2, len(content) - 4 - 2)]


def test_an_index_that_was_cut_is_read_up_to_its_last_whole_entry():
    content = b'stored' + entries((1, 2), (3, 4))[:-1]
    given = Chunk(0, 0, 6, 6, '', 0, 0, 0, {7: (6, 3)})
    assert tables_of(given, Noted(content)) == {7: [[1, 2]]}


@pytest.mark.parametrize(('far', 'reads'), [(0, 1), (1, 2)])
def test_an_index_far_behind_its_chunk_is_read_by_itself(far, reads):
    between = (1 << 20) - 16 + far
    file = Noted(b'stored' + bytes(between) + entries((1, 2)) + b'rest')
    given = Chunk(0, 0, 6, 6, '', 0, 0, 0, {7: (6 + between, 1)})
    assert tables_of(given, file) == {7: [[1, 2]]}
    assert file.ranges[0] == (0, 6 if far else 6 + between + 16)
    assert file.ranges[1:] == [(6 + between, 16)] * (reads - 1)


def test_the_checksum_of_a_chunk_is_in_its_head():
    content = b'before' + chunk(b'inside', (1, 2))
    whole, _ = chunk_at(6, content[6 + 9 :])
    index = {1: (100, 2)}
    known = replace(whole, crc=None, index=index, counts={1: 2})
    inside = memoryview(content)[6:]
    assert _with_checksum(known, inside) == replace(known, crc=zlib.crc32(b'inside'))
    # Another chunk's head, and none at all, tell nothing.
    for other in (replace(known, end_ns=3), replace(known, start=7), replace(known, start=99)):
        assert _with_checksum(other, memoryview(content)[other.start :]).crc is None


@pytest.mark.parametrize(
    ('apart', 'other', 'expected'),
    [
        (0, '', [[0, 1], [2]]),
        # A chunk of another compression, and one far behind what nobody wants.
        (0, 'lz4', [[0], [1], [2]]),
        (1 << 20, '', [[0, 1], [2]]),
        ((1 << 20) + 1, '', [[0], [1], [2]]),
        # Not one behind the other.
        (-1, '', [[0], [1], [2]]),
    ],
)
def test_chunks_that_lie_together_are_loaded_as_one(monkeypatch, apart, other, expected):
    monkeypatch.setattr(mcap_chunk, 'TOGETHER', 20)
    # The second one unpacks to less than is stored of it, the third is one byte too many.
    chunks = [
        Chunk(0, 5, 10, 10, '', 0, 0, 0),
        Chunk(15 + apart, 20 + apart, 10, 1, other, 0, 0, 0),
        Chunk(30 + apart, 35 + apart, 11, None, other, 0, 0, 0),
    ]
    found = [[chunks.index(chunk) for chunk in one.chunks] for one in grouped(chunks)]
    assert found == expected


def test_memory_is_lent_again_when_nobody_holds_anything_of_it():
    memory = Memory()
    lent = memory.allocate(100)
    place = lent.ctypes.data
    held = np.frombuffer(lent.data[20:], np.uint8)[::2]
    del lent
    other = memory.allocate(100)
    assert other.ctypes.data != place
    held[:] = 1
    del held
    again = memory.allocate(104)
    assert (len(again), again.ctypes.data) == (104, place)
    # A block that is too small is given up for one that is not.
    del again, other
    assert len(memory.allocate(1000)) == 1000


def test_chunks_without_a_sound_index_are_walked_over_and_the_others_are_not():
    one, other = message(1, 5, b'ab') + message(2, 6), message(1, 7, b'c')
    buffer = np.frombuffer(b'..' + one + other + bytes(17) + one, np.uint8)
    ends = np.cumsum([2, len(one), len(other) + 17, len(one)]).tolist()
    of_one = tables((1, 5, 0), (2, 6, HEAD + 2))
    parts = [
        ChunkContent('first', ends[0], ends[1], of_one),
        ChunkContent('second', ends[1], ends[2]),
        ChunkContent('third', ends[2], ends[3], of_one),
    ]
    messages: list[str] = []
    found = located(parts, buffer, messages.append)
    assert found[1].offset.tolist() == [end + HEAD for end in ends[:3]]
    assert found[1].size.tolist() == [2, 1, 2]
    assert found[2].offset.tolist() == [end + 2 * HEAD + 2 for end in (ends[0], ends[2])]
    assert (found[1].log_ns, found[2].log_ns) == (5, 6)
    assert messages == [
        f'second holds no valid record at its byte {len(other)}; its other 17 bytes are left out.'
    ]
    # Entries of one chunk that lie in another are none, though messages are there.
    astray = tables((1, 5, 0), (2, 6, HEAD + 2), (1, 7, len(one)))
    two_of_them = [
        ChunkContent('first', 2, ends[1], astray),
        ChunkContent('second', ends[1], ends[2] - 17),
    ]
    assert indexed(two_of_them, buffer) is None
    sound = [
        ChunkContent('first', 2, ends[1], of_one),
        ChunkContent('second', ends[1], ends[2] - 17, tables((1, 7, 0))),
    ]
    both = indexed(sound, buffer)
    assert both[1].size.tolist() == [2, 1]


def test_a_chunk_in_memory_knows_what_it_takes():
    buffer = np.zeros(100, np.uint8)
    some = np.arange(3, dtype=np.int64)
    unpacked = UnpackedChunks(
        buffer, {1: ChannelMessages(some, some, 0), 2: ChannelMessages(some[:1], some[:1], 0)}
    )
    assert unpacked.nbytes == 100 + 2 * 8 * (3 + 1)
    assert unpacked.batch(frozenset({3}), 0) is None
