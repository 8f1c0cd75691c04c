"""What walking over an mcap file finds, byte by byte, and what it says of what it cannot read."""

from __future__ import annotations

import os
import struct
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap_bytes import (
    CHUNK,
    DATA_END,
    INDEX,
    MAGIC,
    MESSAGE,
    METADATA_INDEX,
    SCHEMA,
    STATISTICS,
    Chunked,
    block,
    channel,
    chunk,
    footer,
    index,
    message,
    metadata,
    record,
    schema,
    text,
)

from imu_calib.recordings import mcap_scan
from imu_calib.recordings.mcap_records import Chunk
from imu_calib.recordings.mcap_scan import Scan, scan
from imu_calib.recordings.storage import Losses, RecordingError

NS = 1_000_000_000


@pytest.fixture
def scanned(tmp_path):
    def of(content: bytes) -> tuple[Scan, list[str]]:
        (tmp_path / 'a.mcap').write_bytes(content)
        losses = Losses()
        return scan(tmp_path / 'a.mcap', losses), losses.sentences

    return of


def two() -> Chunked:
    first = (1, 11 * NS, b'x'), (2, 10 * NS, b'yy'), (1, 12 * NS, b'')
    return Chunked().describe().add(*first).add((2, 13 * NS, b''), (2, 14 * NS, b'z'))


def found_in(file: Chunked) -> list[Chunk]:
    """The two chunks, as they are to be found."""
    (a, a_end, _), (b, b_end, _) = file.places[:2]
    ends = [(a, a_end, 10 * NS, 12 * NS), (b, b_end, 13 * NS, 14 * NS)]
    indexes = [{1: (a_end + 15, 2), 2: (a_end + 15 + 32 + 15, 1)}, {2: (b_end + 15, 2)}]
    return [
        Chunk(
            start=start,
            data=start + 49,
            stored=end - start - 49,
            size=end - start - 49,
            compression='',
            crc=zlib.crc32(file.content[start + 49 : end]),
            start_ns=since,
            end_ns=until,
            index=held,
            counts={key: count for key, (_, count) in held.items()},
        )
        for (start, end, since, until), held in zip(ends, indexes, strict=True)
    ]


def without_index(one: Chunk) -> Chunk:
    return replace(one, index=None, counts=None)


def test_a_whole_file_is_known_to_the_last_byte(scanned):
    file = two()
    found, losses = scanned(file.summed_up())
    assert found.chunks == found_in(file)
    assert {key: one.topic for key, one in found.catalogue.channels.items()} == {1: '/a', 2: '/b'}
    assert found.catalogue.counts == {1: 2, 2: 3}
    assert losses == []


def test_a_file_that_ends_anywhere_gives_what_is_whole_of_it(scanned):
    file = two()
    content, chunks = file.content, found_in(file)
    starts, start = [], len(MAGIC)
    while start < len(content):
        starts.append(start)
        start += 9 + struct.unpack_from('<Q', content, start + 1)[0]
    places = {start: k for k, (start, _, _) in enumerate(file.places)}
    for size in range(len(MAGIC), len(content) + 1):
        found, losses = scanned(content[:size])
        whole = [k for k, (_, end, _) in enumerate(file.places) if end <= size]
        expected = [chunks[k] for k in whole]
        last = max((start for start in starts if start < size), default=None)
        ends_within = last is not None and size not in {*starts, len(content)}
        if ends_within and last in places and size - last >= 49:
            # All of its fields are there.
            one = without_index(chunks[places[last]])
            expected.append(replace(one, stored=size - one.data, cut=True))
        assert [without_index(one) for one in found.chunks] == [
            without_index(one) for one in expected
        ]
        # The last index may be cut off, which is no topic without messages.
        kept = [one.index for one in found.chunks if not one.cut]
        sure = max(len(expected) - 1, 0)
        assert kept[:sure] == [one.index for one in chunks[:sure]]
        assert kept[sure:] == [None] * (len(whole) - sure)
        where = f'is cut off at byte {last} of {size}' if ends_within else 'has no footer'
        known = (
            f'; the data up to log time {10 + 2 * len(whole)}.000 s is complete' if whole else ''
        )
        assert losses == [f'a.mcap {where}: its recorder did not finish{known}.']


@pytest.mark.parametrize(
    ('content', 'what'),
    [
        (b'', 'is empty'),
        (b'\x89MCAP', 'begins with the bytes 89 4d 43 41 50'),
        (b'SQLite format 3\0', "begins with the text 'SQLite f'"),
        (MAGIC[:-1] + b'!', 'begins with the bytes 89 4d 43 41 50 30 0d 21'),
        (b'\x00\x01\x02\x03', 'begins with the bytes 00 01 02 03'),
    ],
)
def test_what_is_no_mcap_says_what_it_starts_with(scanned, content, what):
    with pytest.raises(RecordingError) as refused:
        scanned(content)
    way = ' imu-calib convert reads tables of numbers.' if 'text' in what else ''
    assert str(refused.value) == (
        f'a.mcap is not a recording of rosbag2 (mcap or sqlite3): it {what}.{way}'
    )


def damaged(content: bytes, place: int, other: bytes) -> bytes:
    return content[:place] + other + content[place + len(other) :]


BEYOND = struct.pack('<Q', 2**40)


@pytest.mark.parametrize('other', [b'\0', b'\x80', bytes([CHUNK]) + BEYOND, b'\x05' + BEYOND])
def test_a_damaged_head_costs_what_lies_up_to_the_next_chunk(scanned, other):
    file = two()
    first, second = found_in(file)
    found, losses = scanned(damaged(file.summed_up(), first.start, other))
    assert found.chunks == [second]
    assert losses == [
        f'a.mcap holds no valid record at byte {first.start}: {second.start - first.start} bytes '
        'cannot be read.'
    ]
    found, losses = scanned(damaged(file.summed_up(), second.start, other))
    assert found.chunks == [without_index(first)]
    assert losses == [
        f'a.mcap holds no valid record at byte {second.start}: the rest cannot be read.'
    ]


def test_a_damaged_index_is_looked_at_no_further(scanned):
    file = two()
    first, second = found_in(file)
    end = first.end
    found, losses = scanned(damaged(file.summed_up(), end, b'\0'))
    assert found.chunks == [without_index(first), second]
    assert losses == [
        f'a.mcap holds no valid record at byte {end}: {second.start - end} bytes cannot be read.'
    ]


def test_the_index_before_damage_is_not_trusted_and_others_are(scanned):
    file = two().add((1, 15 * NS, b'c'))
    first, second = found_in(file)
    found, _ = scanned(damaged(file.summed_up(), file.places[2][0], b'\0'))
    assert found.chunks == [first, without_index(second)]


def test_of_a_long_chunk_that_was_cut_all_is_kept_that_is_there(scanned):
    file = Chunked().describe().add((1, 15 * NS, bytes(5000)))
    found, _ = scanned(file.content[:4000])
    assert [one.end for one in found.chunks] == [4000]


def test_without_a_summary_nobody_knows_where_to_go_on(scanned):
    file = two()
    first, second = found_in(file)
    found, losses = scanned(damaged(file.content, second.start, b'\x80' + BEYOND))
    assert found.chunks == [without_index(first)]
    assert losses == [
        f'a.mcap holds no valid record at byte {second.start}: the rest cannot be read.',
        'a.mcap has no footer: its recorder did not finish; the data up to log time 12.000 s is '
        'complete.',
    ]


@pytest.mark.parametrize(('more', 'sound'), [(-1, True), (0, True), (1, False)])
def test_a_chunk_holds_no_more_than_its_record(scanned, more, sound):
    file = two()
    first, second = found_in(file)
    stored = struct.pack('<Q', first.stored + more)
    found, losses = scanned(damaged(file.summed_up(), first.data - 8, stored))
    assert found.chunks == ([replace(first, stored=first.stored + more)] if sound else []) + [
        second
    ]
    assert (losses == []) is sound


def test_a_compression_that_is_no_text_is_no_chunk(scanned):
    file = two()
    first, second = found_in(file)
    name = struct.pack('<I', 1) + b'\xff'
    found, losses = scanned(damaged(file.summed_up(), first.start + 9 + 28, name))
    assert found.chunks == [second]
    assert len(losses) == 1


@pytest.mark.parametrize(
    ('one', 'held'),
    [
        (record(INDEX, struct.pack('<HI', 7, 0)), {7: 0}),
        (index(7, [(1, 2)]), {7: 1}),
        (index(7, [(1, 2)] * 30), {7: 30}),
        # Entries of another length than the record, and of a broken one.
        (record(INDEX, struct.pack('<HI', 7, 16) + bytes(15)), None),
        (record(INDEX, struct.pack('<HI', 7, 16) + bytes(17)), None),
        (record(INDEX, struct.pack('<HI', 7, 8) + bytes(8)), None),
    ],
)
def test_an_index_counts_if_its_entries_fill_it(scanned, one, held):
    whole = chunk(message(7, 1)) + one + record(DATA_END, bytes(4))
    # One before any chunk is of none.
    found, losses = scanned(MAGIC + one + whole)
    assert losses == []
    assert found.chunks[0].counts == held
    place = len(MAGIC + one + chunk(message(7, 1))) + 15
    assert found.chunks[0].index == (held and {7: (place, held[7])})


def test_an_index_shorter_than_its_head_is_no_record(scanned):
    content = MAGIC + chunk(message(7, 1)) + record(INDEX, bytes(5)) + record(DATA_END, bytes(4))
    found, losses = scanned(content)
    assert len(found.chunks) == 1
    assert losses[0].endswith('the rest cannot be read.')


@pytest.mark.parametrize('last', [record(DATA_END, bytes(4)), footer(0)[:-8]])
def test_nothing_behind_the_end_of_the_data_is_of_the_data(scanned, last):
    found, losses = scanned(MAGIC + schema(1, 'A') + last + schema(2, 'B'))
    assert list(found.catalogue.schemas) == [1]
    assert losses == []


def test_records_of_other_kinds_are_passed_over(scanned):
    other = b''.join(record(op, bytes(50)) for op in (0x80, STATISTICS, METADATA_INDEX, 0x09, 0x0E))
    content = MAGIC + other + schema(1, 'A') + metadata('n', a='b') + record(DATA_END, bytes(4))
    found, losses = scanned(content)
    assert losses == []
    assert found.chunks == []
    assert list(found.catalogue.schemas) == [1]
    assert found.catalogue.metadata == {'n': {'a': 'b'}}
    assert found.catalogue.counts is None


def test_a_description_that_is_broken_is_no_record(scanned):
    content = MAGIC + schema(1, 'A') + record(SCHEMA, b'\x01') + record(DATA_END, bytes(4))
    found, losses = scanned(content)
    place = len(MAGIC + schema(1, 'A'))
    assert losses[0] == f'a.mcap holds no valid record at byte {place}: the rest cannot be read.'
    assert list(found.catalogue.schemas) == [1]


def with_summary(content: bytes, summary: bytes, start: int) -> bytes:
    return content + record(DATA_END, bytes(4)) + summary + footer(start)


def test_the_summary_counts_if_it_lies_in_the_file(scanned):
    content = MAGIC + schema(1, 'A')
    end = len(content) + 13
    for start, taken in [
        (0, False),
        (len(MAGIC) - 1, False),
        (end, True),
        (end + len(schema(2, 'B')), True),
        (end + len(schema(2, 'B')) + 1, False),
        (2**63, False),
    ]:
        found, losses = scanned(with_summary(content, schema(2, 'B'), start))
        assert losses == []
        assert sorted(found.catalogue.schemas) == ([1, 2] if taken and start == end else [1])
        assert found.chunks == []
    # A file of nothing but a summary.
    found, _ = scanned(MAGIC + schema(2, 'B') + footer(len(MAGIC)))
    assert list(found.catalogue.schemas) == [2]


def test_of_a_broken_summary_nothing_is_taken(scanned):
    file = two()
    data = file.content + record(DATA_END, bytes(4))
    broken = schema(5, 'B') + b''.join(file.entries) + record(SCHEMA, b'\x01')
    found, losses = scanned(data + broken + footer(len(data)))
    assert found.chunks == found_in(file)
    assert sorted(found.catalogue.schemas) == [1]
    assert losses == []


def test_a_record_of_a_summary_ends_where_it_says(scanned):
    # Behind the schema, which has no definition, 128 bytes look like one.
    cut_short = record(SCHEMA, schema(2, 'B')[9:-4])
    broken = cut_short + record(0x80) + record(0x80, bytes(150))
    data = MAGIC + schema(1, 'A') + record(DATA_END, bytes(4))
    found, losses = scanned(data + broken + footer(len(data)))
    assert list(found.catalogue.schemas) == [1]
    assert losses == []


def test_a_file_that_ends_with_the_magic_alone_was_not_finished(scanned):
    found, losses = scanned(MAGIC + schema(1, 'A') + record(0x80, bytes(12)) + MAGIC)
    assert list(found.catalogue.schemas) == [1]
    assert 'its recorder did not finish' in losses[-1]
    assert len(losses) == 1


def ranges_read(
    path: Path, content: bytes, monkeypatch: pytest.MonkeyPatch
) -> tuple[Scan, list[tuple[int, int]], list[str]]:
    read: list[tuple[int, int]] = []

    class File:
        name = path.name

        def stat(self) -> os.stat_result:
            return path.stat()

        def open(self, mode: str, buffering: int) -> File:
            assert (mode, buffering) == ('rb', 0)
            return self

        def __enter__(self) -> File:
            return self

        def __exit__(self, *_: object) -> None: ...

        def seek(self, place: int) -> None:
            self.place = place

        def read(self, size: int) -> bytes:
            read.append((self.place, size))
            return content[self.place : self.place + size]

    path.write_bytes(content)
    monkeypatch.setattr(mcap_scan, 'RemotePath', File)
    losses = Losses()
    return scan(File(), losses), read, losses.sentences


def test_of_a_file_elsewhere_the_summary_alone_is_read(tmp_path, monkeypatch):
    file = two()
    content = file.summed_up()
    found, read, losses = ranges_read(tmp_path / 'a.mcap', content, monkeypatch)
    summary, size = len(file.content) + 13, len(content)
    assert read == [(0, 8), (size - 37, 37), (summary, size - 37 - summary)]
    assert found.chunks == [replace(one, crc=None) for one in found_in(file)]
    assert losses == []


def test_metadata_elsewhere_are_read_from_where_they_are(tmp_path, monkeypatch):
    file, own = two(), metadata('n', a='b')
    place = len(file.content)
    file.content += own
    for moved in (0, 1):
        where = struct.pack('<QQ', place + moved, len(own)) + text('n')
        content = file.summed_up(record(METADATA_INDEX, where))
        # The statistics know of one metadata record.
        numbers = struct.pack('<QHIIII', 5, 1, 2, 0, 0, 2)
        content = content.replace(numbers, struct.pack('<QHIIII', 5, 1, 2, 0, 1, 2))
        found, read, losses = ranges_read(tmp_path / 'a.mcap', content, monkeypatch)
        assert found.catalogue.metadata == {'n': {'a': 'b'}}
        assert losses == []
        assert read[3] == (place + moved + 9, len(own) - 9)
        # Where they are not, all of the file is walked over.
        assert (len(read) > 4) is bool(moved)
        assert (found.chunks == found_in(file)) is bool(moved)


def test_a_summary_that_leaves_a_chunk_out_is_walked_past(tmp_path, monkeypatch):
    file = two()
    file.entries.pop()
    found, read, losses = ranges_read(tmp_path / 'a.mcap', file.summed_up(), monkeypatch)
    assert found.chunks == found_in(file)
    # A record's head, and as much as tells what a chunk holds.
    assert read[3] == (len(MAGIC), 9 + 56)
    assert losses == []


def test_a_chunk_that_the_summary_sees_behind_itself_is_none(scanned):
    file = two()
    _, second = found_in(file)
    far = Chunked(bytes(10**6)).add((1, 5, b''))
    content = file.summed_up(far.entries[0])
    _, losses = scanned(damaged(content, second.start, b'\0'))
    assert losses[0].endswith('the rest cannot be read.')


def test_a_chunk_too_short_for_its_fields_is_no_record(scanned):
    for content in (MAGIC + record(CHUNK, bytes(10)), MAGIC + record(CHUNK, bytes(10)) + MAGIC):
        _, losses = scanned(content)
        assert losses[0] == 'a.mcap holds no valid record at byte 8: the rest cannot be read.'


MESSAGES = [(1, 13, b'abc'), (2, 12, b''), (1, 14, bytes(40)), (1, 11, b'x'), (2, 15, b'yy')]


def flat(*more: bytes) -> tuple[bytes, bytes]:
    head = MAGIC + schema(1, 'A') + channel(1, 1, '/a')
    return head, b''.join(message(*one) for one in MESSAGES) + b''.join(more)


def test_messages_without_a_chunk_are_as_one_of_their_own(scanned):
    head, messages = flat()
    among = index(1, [(1, 2)]) + channel(2, 1, '/b') + message(2, 9)
    end = record(DATA_END, bytes(4))
    inside = chunk(message(1, 20), (20, 20))
    found, losses = scanned(head + messages + among + inside + messages + end)
    size = len(messages + among)
    first = Chunk(
        start=len(head),
        data=len(head),
        stored=size,
        size=size,
        compression='',
        crc=0,
        start_ns=9,
        end_ns=15,
        counts={1: 3, 2: 3},
    )
    assert found.chunks[0] == first
    start = len(head) + size + len(inside)
    last = replace(first, start=start, data=start, stored=len(messages), size=len(messages))
    assert found.chunks[2] == replace(last, start_ns=11, counts={1: 3, 2: 2})
    assert len(found.chunks) == 3
    assert {key: one.topic for key, one in found.catalogue.channels.items()} == {1: '/a', 2: '/b'}
    assert losses == []


def test_messages_end_where_the_summary_begins(scanned):
    head, messages = flat()
    found, losses = scanned(head + messages + schema(2, 'B') + footer(len(head + messages)))
    assert [(one.start, one.end) for one in found.chunks] == [(len(head), len(head + messages))]
    assert losses == []


def test_messages_without_a_chunk_are_read_once(tmp_path, monkeypatch):
    messages = flat()[1]
    content = MAGIC + messages + record(DATA_END, bytes(4)) + footer(0)
    _, read, _ = ranges_read(tmp_path / 'a.mcap', content, monkeypatch)
    end = 8 + len(messages)
    assert read[2:] == [(8, 65), (9, 8), (8, len(messages) + 13), (end, 65)]


@pytest.mark.parametrize('window', [1, 40, 66, 67, 68, 110, 300])
def test_as_many_messages_are_taken_at_once_as_a_window_holds(scanned, monkeypatch, window):
    monkeypatch.setattr(mcap_scan, '_WINDOW', window)
    head, messages = flat()
    found, losses = scanned(head + messages + record(DATA_END, bytes(4)))
    ends = np.cumsum([31 + len(data) for *_, data in MESSAGES])
    start, stretches = 0, []
    while start < len(messages):
        first = int(ends[ends > start][0])
        stop = max([first, *ends[ends - start <= window].tolist()])
        stretches.append((len(head) + start, len(head) + stop))
        start = stop
    assert [(one.start, one.end) for one in found.chunks] == stretches
    assert losses == []


def test_messages_of_a_file_that_was_cut_are_whole_ones(scanned):
    head, messages = flat()
    ends = np.cumsum([31 + len(data) for *_, data in MESSAGES]).tolist()
    for size in range(ends[0], len(messages) + 1):
        found, losses = scanned(head + messages[:size])
        whole = max(end for end in ends if end <= size)
        (one,) = found.chunks
        assert (one.start, one.end, one.counts) == (len(head), len(head) + whole, None)
        where = 'has no footer'
        if size != whole:
            where = f'is cut off at byte {len(head) + whole} of {len(head) + size}'
        (sentences,) = losses
        assert sentences.startswith(f'a.mcap {where}: its recorder did not finish')


def test_a_broken_description_among_messages_is_no_record(scanned):
    head, messages = flat(record(SCHEMA, b'\x01'))
    found, losses = scanned(head + messages + record(DATA_END, bytes(4)))
    assert found.chunks == []
    assert (
        losses[0] == f'a.mcap holds no valid record at byte {len(head)}: the rest cannot be read.'
    )


@pytest.mark.parametrize('length', [0, 3, 13, 21])
def test_a_message_too_short_to_be_one_tells_nothing(scanned, length):
    head, messages = flat()
    short = record(MESSAGE, block(bytes(length))[:length])
    found, _ = scanned(head + messages + short)
    assert [one.start for one in found.chunks] == [len(head)]
    assert (found.chunks[0].start_ns, found.chunks[0].end_ns) == (11, 15)
    alone, losses = scanned(head + short)
    assert alone.chunks == []
    assert losses
