"""mcap storage files: read a few chunks at a time, written chunk by chunk."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from operator import itemgetter
from pathlib import Path

import numpy as np

from .cdr import Bytes, Indices, Messages
from .codec import CodecError, ReadAhead, unpack, unpacked_into
from .mcap_records import (
    LONGEST_HEAD,
    MAGIC,
    MESSAGE_HEAD,
    RECORD_HEAD,
    TOGETHER,
    Chunk,
    ChunkGroup,
    Fields,
    Op,
    RecordError,
    chunk_at,
    grouped,
    record,
    string,
    strings,
    walk,
)
from .mcap_scan import ByteFile, ChannelMessages, ChunkContent, located, log_at, scan, times_at
from .metadata_yaml import custom_data_of
from .order import LogOrder, time_order
from .remote import AnyPath
from .storage import Cache, Losses, Memory, MessageBatch, Topic, first_and_last

_Stored = tuple[ChunkGroup, memoryview, list[dict[int, Indices]]]
_Content = tuple[Bytes, list[ChunkContent]]


@dataclass(frozen=True, eq=False)
class UnpackedChunks:
    """Chunks in memory: their bytes, and the offsets of the messages of each channel."""

    buffer: Bytes
    channels: dict[int, ChannelMessages]

    @property
    def nbytes(self) -> int:
        """Bytes of memory."""
        return int(self.buffer.nbytes + sum(2 * p.size.nbytes for p in self.channels.values()))

    def batch(self, channels: frozenset[int], position: int) -> MessageBatch | None:
        """Return the messages of some channels, in the order of the file; None without any."""
        placed = [p for i, p in self.channels.items() if i in channels]
        if not placed:
            return None
        offset, size = placed[0].offset, placed[0].size
        if len(placed) > 1:
            offset = np.concatenate([p.offset for p in placed])
            size = np.concatenate([p.size for p in placed])
            order = np.argsort(offset)
            offset, size = offset[order], size[order]
        log_ns = min(p.log_ns for p in placed)
        times = partial(times_at, self.buffer, offset)
        messages, log = Messages(self.buffer, offset, size), log_at(self.buffer, offset)
        return MessageBatch(messages, log, log_ns, position, times)


class McapStorage:
    """One mcap file; `losses` receives sentences on unreadable data."""

    def __init__(self, path: AnyPath, losses: Losses) -> None:
        self.path = path
        self.size = path.stat().st_size
        self._losses = losses
        self._memory = Memory()
        found = scan(path, losses)
        self._catalogue = found.catalogue
        self._chunks = found.chunks
        self._learn_channels()
        self.start_ns, self.end_ns = first_and_last(
            [(c.start_ns, c.end_ns) for c in self._chunks if c.counts != {}]
        )

    @property
    def topics(self) -> Mapping[str, Topic]:
        """Topics by name."""
        counts = self._counts()
        topics: dict[str, Topic] = {}
        for channel in self._catalogue.channels.values():
            before = topics.get(channel.topic)
            count = counts.get(channel.id, 0) if counts is not None else None
            topic = Topic(channel.topic, channel.type, count, channel.encoding, channel.described)
            topic = replace(topic, channels=((channel.id, topic),))
            topics[channel.topic] = before.merged(topic) if before else topic
        return topics

    @property
    def metadata(self) -> Sequence[tuple[str, Mapping[str, str]]]:
        """The metadata records: name and content."""
        return self._catalogue.records

    def attachments(self) -> Iterator[bytes]:
        """Read the attachment records, one after the other; a cut one is a loss."""
        for start, length in self._catalogue.attachments_at:
            with self.path.open('rb', buffering=0) as file:
                content = _read(file, start, length)[RECORD_HEAD:]
            if len(content) == length - RECORD_HEAD:
                yield bytes(content)
            else:
                self._losses.add_loss(f'{self.path.name}: an attachment is cut off.')

    @property
    def custom_data(self) -> Mapping[str, str]:
        """Contents of the metadata records, and the custom data in rosbag2's own record."""
        merged: dict[str, str] = {}
        for name, pairs in self._catalogue.metadata.items():
            own = name == 'rosbag2'
            merged.update(custom_data_of(pairs.get('serialized_metadata', '')) if own else pairs)
        return merged

    def cursors(self, topics: frozenset[str], cache: Cache) -> dict[str, Iterator[MessageBatch]]:
        """Start reading: one iterator per topic, all independent of each other."""
        channels = {
            topic: frozenset(c.id for c in self._catalogue.channels.values() if c.topic == topic)
            for topic in topics
        }
        wanted = [ids for ids in channels.values() if ids]
        read = [c for c in self._chunks if any(c.may_hold(ids) for ids in wanted)]
        orders = [_time_order(read, ids) for ids in wanted]
        in_file = any(order is None for order in orders)
        shuffled = not in_file and any((o[1:] < o[:-1]).any() for o in orders if o is not None)
        if shuffled:
            self._losses.add_order(self.path.name)
            read = sorted(read, key=lambda chunk: chunk.start_ns)
        together = grouped(read)
        ahead = ReadAhead(together, self._fetch, self._with_content)

        def batch(
            ids: frozenset[int], group: ChunkGroup, bound: int | None
        ) -> tuple[MessageBatch, int | None] | None:
            users = sum(group.may_hold(others) for others in wanted)
            load = partial(self._located, ahead, group)
            found = cache.get((self.path, group.start), load, users).batch(ids, group.end)
            return None if found is None else (found, bound)

        state = partial(self._losses.add_order, self.path.name)
        batches: dict[str, Iterator[MessageBatch]] = {}
        for topic, ids in channels.items():
            mine = [group for group in together if ids and group.may_hold(ids)]
            found = filter(None, map(partial(batch, ids), mine, _bounds(mine)))
            # Not generators, whose frames would keep a batch, and its memory, until the next one.
            batches[topic] = map(itemgetter(0), found) if in_file else LogOrder(found, state)
        return batches

    def _counts(self) -> dict[int, int] | None:
        if self._catalogue.counts is not None:
            return self._catalogue.counts
        counts: dict[int, int] = {}
        for chunk in self._chunks:
            if chunk.counts is None:
                return None
            for channel, count in chunk.counts.items():
                counts[channel] = counts.get(channel, 0) + count
        return counts

    def _learn_channels(self) -> None:
        """Search for channels in chunks with messages of unknown channels.

        A file without a summary describes its channels within the chunks alone.
        """
        known = self._catalogue.channels
        complete = bool(known) and self._catalogue.counts is not None
        for chunk in self._chunks:
            if complete if chunk.counts is None else known.keys() >= chunk.counts.keys():
                continue
            with self.path.open('rb', buffering=0) as file:
                buffer = self._unpack(chunk, _read(file, chunk.data, chunk.stored))
            if buffer is not None:
                self._add_described(buffer)

    def _add_described(self, buffer: Bytes) -> None:
        offsets, _ = walk(buffer)
        ops = buffer[offsets]
        for offset in offsets[(ops == Op.SCHEMA) | (ops == Op.CHANNEL)].tolist():
            op, length = struct.unpack_from('<BQ', buffer.data, offset)
            start = offset + RECORD_HEAD
            try:
                self._catalogue.add_record(op, buffer[start : start + length].tobytes())
            except RecordError as error:
                self._losses.add_loss(f'{self.path.name}: {error}.')

    def _fetch(self, group: ChunkGroup) -> _Stored:
        """Read the stored bytes of chunks into memory."""
        first, size = group.start, group.reach - group.start
        memory = None if group.compression else self._memory.allocate(size)
        with self.path.open('rb', buffering=0) as file:
            content = _read(file, first, size, memory)
            tables = [_tables(chunk, content, first, file) for chunk in group.chunks]
        chunks = [_with_checksum(chunk, content[chunk.start - first :]) for chunk in group.chunks]
        return ChunkGroup(tuple(chunks)), content, tables

    def _with_content(self, fetched: _Stored) -> _Content:
        """Unpack the bytes of chunks."""
        group, content, tables = fetched
        buffer, size = np.frombuffer(content, np.uint8), group.size
        together = bool(group.compression) and size <= TOGETHER
        if together:
            buffer = self._memory.allocate(size)
        parts: list[ChunkContent] = []
        for chunk, table in zip(group.chunks, tables, strict=True):
            start = chunk.data - group.start
            stored, memory = content[start : start + chunk.stored], None
            if together:
                start = parts[-1].end if parts else 0
                memory = buffer.data[start : start + (chunk.size or 0)]
            unpacked = self._unpack(chunk, stored, memory)
            if unpacked is None:
                continue
            if group.compression and not together:
                buffer, start = unpacked, 0
            parts.append(
                ChunkContent(f'{self.path.name}: {chunk}', start, start + len(unpacked), table)
            )
        return buffer, parts

    def _located(self, ahead: ReadAhead[_Stored, _Content], group: ChunkGroup) -> UnpackedChunks:
        """Find the messages of chunks while the thread continues to unpack."""
        buffer, parts = ahead.load(group)
        return UnpackedChunks(buffer, located(parts, buffer, self._losses.add_loss))

    def _unpack(
        self, chunk: Chunk, stored: memoryview, memory: memoryview | None = None
    ) -> Bytes | None:
        """Return the unpacked bytes of a chunk, in given memory of its stated size if any.

        None, and a stated loss, if they are corrupt.
        """
        if chunk.cut or len(stored) < chunk.stored:
            return self._unpack_cut(chunk, stored)
        try:
            content = _unpacked(chunk, stored, memory)
        except CodecError as error:
            self._lose(chunk, f'does not unpack ({chunk.compression}: {error})')
            return None
        if chunk.size != len(content):
            self._lose(chunk, f'unpacks to {len(content)} bytes instead of {chunk.size}')
            return None
        if chunk.crc is None:
            self._lose(chunk, 'is not where the summary says')
            return None
        if chunk.crc and zlib.crc32(content) != chunk.crc:
            self._lose(chunk, 'is corrupt (its CRC does not match)')
            return None
        return np.frombuffer(content, np.uint8)

    def _unpack_cut(self, chunk: Chunk, stored: memoryview) -> Bytes | None:
        if chunk.compression:
            self._lose(chunk, 'is cut off by the end of the file')
            return None
        buffer = np.frombuffer(stored, np.uint8)
        _, end = walk(buffer)
        self._losses.add_loss(
            f'{self.path.name}: {chunk} is cut off by the end of the file; the first {end} '
            f'of its {chunk.size} bytes are used.'
        )
        return buffer[:end]

    def _lose(self, chunk: Chunk, why: str) -> None:
        topics = {i: c.topic for i, c in self._catalogue.channels.items()}
        counts = chunk.counts or {}
        held = ', '.join(f'{n} of {topics.get(i, f"channel {i}")}' for i, n in counts.items())
        what = f'its messages ({held})' if held else 'its messages'
        self._losses.add_loss(f'{self.path.name}: {chunk} {why}; {what} are left out.')


def _time_order(chunks: Sequence[Chunk], channels: frozenset[int]) -> Indices | None:
    """Return the order of the chunks that may hold messages of some channels, as `time_order`."""
    times = [(c.start_ns, c.end_ns) for c in chunks if c.may_hold(channels)]
    starts, ends = np.array(times, np.int64).reshape(-1, 2).T
    return time_order(starts, ends)


def _bounds(groups: Sequence[ChunkGroup]) -> list[int | None]:
    """Return the least log time in the groups after each; None after the last."""
    bounds: list[int | None] = [None]
    for group in groups[:0:-1]:
        first = min(chunk.start_ns for chunk in group.chunks)
        bounds.append(first if bounds[-1] is None else min(bounds[-1], first))
    return bounds[::-1]


def _unpacked(chunk: Chunk, stored: memoryview, memory: memoryview | None) -> bytes | memoryview:
    """Unpack a chunk, into memory if its size fits."""
    if not chunk.compression:
        return stored
    if memory is not None and unpacked_into(memory, stored, chunk.compression):
        return memory
    content = unpack(stored, chunk.compression, chunk.size or 0)
    if memory is None or len(memory) != len(content):
        return content
    memory[:] = content
    return memory


def _read(file: ByteFile, position: int, size: int, memory: Bytes | None = None) -> memoryview:
    """Read bytes of a file, fewer at its end; into (size,) bytes of memory if given."""
    file.seek(position)
    if memory is None:
        return memoryview(file.read(size))
    content = memory.data
    return content[: file.readinto(content)]


def _with_checksum(chunk: Chunk, record: memoryview) -> Chunk:
    """Add the CRC in a chunk's own record; none if that is not the head of this chunk."""
    if chunk.crc is not None:
        return chunk
    try:
        found, _ = chunk_at(chunk.start, bytes(record[RECORD_HEAD : RECORD_HEAD + LONGEST_HEAD]))
    except (struct.error, UnicodeDecodeError):
        return chunk
    same = replace(chunk, index=None, counts=None, crc=found.crc) == found
    return replace(chunk, crc=found.crc) if same else chunk


def _tables(chunk: Chunk, content: memoryview, first: int, file: ByteFile) -> dict[int, Indices]:
    """Return the message index of a chunk, (n, 2) log times and offsets by channel.

    The content is that of the file from byte `first` on; other parts are read.
    """
    tables = {}
    for channel, (position, count) in (chunk.index or {}).items():
        start, size = position - first, 16 * count
        inside = position + size <= chunk.reach
        stored = content[start : start + size] if inside else _read(file, position, size)
        table = np.frombuffer(stored[: len(stored) // 16 * 16], '<i8').reshape(-1, 2)
        if len(table):
            tables[channel] = table
    return tables


_HEAD = RECORD_HEAD + MESSAGE_HEAD


@dataclass
class _OpenChunk:
    """The chunk being filled."""

    parts: list[bytes] = field(default_factory=list)
    size: int = 0
    index: dict[int, list[np.ndarray[tuple[int, int], np.dtype[np.uint64]]]] = field(
        default_factory=dict
    )
    start_ns: int = 2**63 - 1
    end_ns: int = 0

    def append(self, content: bytes) -> None:
        self.parts.append(content)
        self.size += len(content)


class McapWriter:
    """One mcap file being written.

    Closed chunks survive a kill of the program: the records are self-contained, and summary and
    footer only make them faster to find. A chunk is closed at `chunk_bytes`, or at a span of log
    time of `chunk_ns`, and compressed by `pack`, the function of its compression.
    """

    def __init__(
        self,
        path: Path,
        compression: str,
        pack: Callable[[bytes], bytes],
        chunk_bytes: int,
        chunk_ns: int,
    ) -> None:
        self._pack = pack
        self._compression = compression
        self._chunk_bytes = chunk_bytes
        self._chunk_ns = chunk_ns
        # Unbuffered: an error of a full disk appears at once, and the data is written again later.
        self._file = path.open('xb', buffering=0)
        self._chunk = _OpenChunk()
        self._schemas: dict[tuple[str, str, str], bytes] = {}
        self._channels: list[bytes] = []
        self._chunk_index: list[bytes] = []
        self._metadata_index: list[bytes] = []
        self._attachment_index: list[bytes] = []
        self._write_whole(MAGIC + record(Op.HEADER, string('ros2') + string('imu_calib')))
        self.counts: dict[int, int] = {}
        self.start_ns = 2**63 - 1
        self.end_ns = 0

    def add_channel(
        self,
        topic: str,
        type_name: str,
        definition: str,
        qos: str,
        *,
        language: str = 'ros2msg',
        encoding: str = 'cdr',
        metadata: Mapping[str, str] | None = None,
    ) -> int:
        """Describe a topic; return the id of its channel.

        Without a message type the channel has no schema. Bytes of a definition that are no text are
        surrogates of Python; profiles are YAML. The channel's metadata are the profiles by default,
        as rosbag2 writes them.
        """
        schema, key = 0, (type_name, language, definition)
        if type_name or definition:
            if key not in self._schemas:
                text = definition.encode(errors='surrogateescape')
                content = struct.pack('<H', len(self._schemas) + 1)
                content += string(type_name) + string(language)
                content += struct.pack('<I', len(text)) + text
                self._schemas[key] = record(Op.SCHEMA, content)
                self._chunk.append(self._schemas[key])
            schema = list(self._schemas).index(key) + 1
        channel = len(self._channels) + 1
        pairs = {'offered_qos_profiles': qos, 'topic_type_hash': ''}
        stated = strings(pairs if metadata is None else dict(metadata))
        content = struct.pack('<HH', channel, schema) + string(topic) + string(encoding) + stated
        self._channels.append(record(Op.CHANNEL, content))
        self._chunk.append(self._channels[-1])
        self.counts[channel] = 0
        return channel

    def add_metadata(self, name: str, pairs: dict[str, str]) -> None:
        """Write a metadata record at once."""
        content = record(Op.METADATA, string(name) + strings(pairs))
        place = struct.pack('<QQ', self._file.tell(), len(content)) + string(name)
        self._write_whole(content)
        self._metadata_index.append(record(Op.METADATA_INDEX, place))

    def add_attachment(self, content: bytes) -> None:
        """Write the content of an attachment record at once."""
        fields = Fields(content)
        times, names = fields.numbers('QQ'), string(fields.string()) + string(fields.string())
        whole = record(Op.ATTACHMENT, content)
        place = self._file.tell(), len(whole), *times, fields.number('Q')
        self._write_whole(whole)
        index = struct.pack('<5Q', *place) + names
        self._attachment_index.append(record(Op.ATTACHMENT_INDEX, index))

    def write(
        self,
        channel: int,
        messages: Messages,
        log_time: Indices,
        publish_time: Indices | None = None,
        sequence: Indices | None = None,
    ) -> None:
        """Append messages, closing full chunks.

        Publish times default to log times, sequence numbers to a count.

        Raises:
            OSError: The disk is full; the messages are held, and `flush` tries again.
        """
        start = 0
        trouble: OSError | None = None
        published = log_time if publish_time is None else publish_time
        ends = np.cumsum(messages.size + _HEAD)
        while start < len(messages):
            done = int(ends[start - 1]) if start else 0
            room = max(self._chunk_bytes - self._chunk.size, 1)
            stop = max(int(np.searchsorted(ends, done + room, 'right')), start + 1)
            if trouble is not None:
                stop = len(messages)
            some = slice(start, stop)
            times = log_time[some], published[some]
            number = None if sequence is None else sequence[some]
            self._append(channel, messages.select(some), *times, number)
            if trouble is None and (stop < len(messages) or self._is_full()):
                try:
                    self.flush()
                except OSError as error:
                    trouble = error
            start = stop
        if trouble is not None:
            raise trouble

    def _is_full(self) -> bool:
        span = self._chunk.end_ns - self._chunk.start_ns
        return self._chunk.size >= self._chunk_bytes or span >= self._chunk_ns

    def _append(
        self,
        channel: int,
        messages: Messages,
        log_time: Indices,
        publish_time: Indices,
        sequence: Indices | None,
    ) -> None:
        chunk = self._chunk
        if sequence is None:
            sequence = self.counts[channel] + 1 + np.arange(len(messages))
        content = _records(channel, sequence, messages, log_time, publish_time)
        ends = np.cumsum(messages.size + _HEAD)
        offsets = chunk.size + ends - messages.size - _HEAD
        rows = np.stack([log_time, offsets], 1).astype('<u8')
        # Together, after all that may be interrupted: an index names messages that are there.
        chunk.append(content)
        if channel in chunk.index:
            chunk.index[channel].append(rows)
        else:
            chunk.index[channel] = [rows]
        chunk.start_ns = min(chunk.start_ns, int(log_time.min()))
        chunk.end_ns = max(chunk.end_ns, int(log_time.max()))
        self.counts[channel] += len(messages)

    def flush(self) -> None:
        """Close the chunk, if it holds messages, and pass it to the operating system."""
        chunk = self._chunk
        if not chunk.index:
            return
        content = b''.join(chunk.parts)
        packed = self._pack(content)
        times = struct.pack('<QQ', chunk.start_ns, chunk.end_ns)
        head = times + struct.pack('<QI', len(content), zlib.crc32(content))
        body = head + string(self._compression) + struct.pack('<Q', len(packed)) + packed
        start, chunk_record = self._file.tell(), record(Op.CHUNK, body)
        position = start + len(chunk_record)
        offsets, indexes = b'', b''
        for channel, entries in chunk.index.items():
            offsets += struct.pack('<HQ', channel, position + len(indexes))
            table = np.concatenate(entries).tobytes()
            indexes += record(Op.MESSAGE_INDEX, struct.pack('<HI', channel, len(table)) + table)
        place = times + struct.pack('<QQI', start, len(chunk_record), len(offsets)) + offsets
        place += struct.pack('<Q', len(indexes)) + string(self._compression)
        place += struct.pack('<QQ', len(packed), len(content))
        self._write_whole(chunk_record + indexes)
        self._chunk_index.append(record(Op.CHUNK_INDEX, place))
        self.start_ns = min(self.start_ns, chunk.start_ns)
        self.end_ns = max(self.end_ns, chunk.end_ns)
        self._chunk = _OpenChunk()

    def close(self) -> None:
        """Write the summary and the footer, and close the file."""
        self.flush()
        self._write_whole(b''.join(self._chunk.parts))
        self._write_whole(record(Op.DATA_END, struct.pack('<I', 0)))
        summary = self._summary(self._file.tell())
        crc = zlib.crc32(summary[:-12])
        self._write_whole(summary[:-12] + struct.pack('<I', crc) + MAGIC)
        self._file.close()

    @property
    def held(self) -> int:
        """Bytes in the open chunk."""
        return self._chunk.size

    def _write_whole(self, content: bytes) -> None:
        """Write all of it or none of it."""
        start = self._file.tell()
        remaining = memoryview(content)
        try:
            while remaining:
                remaining = remaining[self._file.write(remaining) or 0 :]
        except OSError:
            os.ftruncate(self._file.fileno(), start)
            self._file.seek(start)
            raise

    def _summary(self, start: int) -> bytes:
        """Build all from the summary section to the end of the file, with the CRC still zero."""
        span = (self.start_ns, self.end_ns) if self._chunk_index else (0, 0)
        counts = b''.join(struct.pack('<HQ', c, n) for c, n in self.counts.items())
        attached = len(self._attachment_index)
        numbers = len(self._schemas), len(self._channels), attached, len(self._metadata_index)
        statistics = struct.pack(
            '<QHIIII', sum(self.counts.values()), *numbers, len(self._chunk_index)
        )
        statistics += struct.pack('<QQI', *span, len(counts)) + counts
        groups = {
            Op.SCHEMA: list(self._schemas.values()),
            Op.CHANNEL: self._channels,
            Op.CHUNK_INDEX: self._chunk_index,
            Op.ATTACHMENT_INDEX: self._attachment_index,
            Op.METADATA_INDEX: self._metadata_index,
            Op.STATISTICS: [record(Op.STATISTICS, statistics)],
        }
        content, offsets = b'', b''
        for op, records in groups.items():
            group = b''.join(records)
            if group:
                place = struct.pack('<BQQ', op, start + len(content), len(group))
                offsets += record(Op.SUMMARY_OFFSET, place)
            content += group
        footer = struct.pack('<QQI', start, start + len(content), 0)
        return content + offsets + record(Op.FOOTER, footer) + MAGIC


def _records(
    channel: int, sequence: Indices, messages: Messages, log_time: Indices, publish_time: Indices
) -> bytes:
    """Build message records; those of equal size are filled column by column."""
    size = int(messages.size[0])
    if not (messages.size == size).all():
        return b''.join(
            _records(channel, sequence[one], messages.select(one), log_time[one], publish_time[one])
            for one in (slice(i, i + 1) for i in range(len(messages)))
        )
    kind = np.dtype(
        [
            ('op', 'u1'),
            ('length', '<u8'),
            ('channel', '<u2'),
            ('sequence', '<u4'),
            ('log_time', '<u8'),
            ('publish_time', '<u8'),
            ('data', f'V{size}'),
        ]
    )
    table = np.empty(len(messages), kind)
    table['op'] = Op.MESSAGE
    table['length'] = MESSAGE_HEAD + size
    table['channel'] = channel
    table['sequence'] = sequence % 2**32
    table['log_time'], table['publish_time'] = log_time, publish_time
    # An empty message is one of protobuf with all defaults.
    if size:
        table['data'] = messages.leading_bytes(size).view(f'V{size}')[:, 0]
    return table.tobytes()
