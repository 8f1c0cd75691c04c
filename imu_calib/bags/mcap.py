"""Reads mcap storage files chunk by chunk."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from ..cdr import Messages
from .ahead import ReadAhead
from .codec import CodecError, decompressor
from .mcap_chunk import LONGEST_HEAD, Chunk, chunk_at
from .mcap_records import MESSAGE_HEAD, RECORD_HEAD, Op, RecordError, walk
from .mcap_scan import scan
from .metadata import custom_data_of
from .storage import (
    Cache,
    Losses,
    MessageBatch,
    Times,
    Topic,
    first_and_last,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from ..cdr.messages import Bytes, Indices

    _Stored = tuple[Chunk, memoryview, dict[int, Indices]]
    _Content = tuple[Bytes | None, dict[int, Indices]]
    from .mcap_scan import ByteFile
    from .remote import AnyPath

_HEAD = RECORD_HEAD + MESSAGE_HEAD
_LONGEST_INDEX = 1 << 20
"""Bytes between a chunk and the end of its message index that are read with it at once: more than
indices take, and little beside a chunk."""
_HEAD_KIND = np.dtype([('op', 'u1'), ('length', '<u8'), ('channel', '<u2')])


@dataclass(frozen=True, eq=False)
class Placed:
    """Messages of one channel within a chunk.

    Attributes:
        offset: (n,) where each serialised message starts in the unpacked chunk.
        size: (n,) bytes of each.
        log_ns: Log time of the first.

    """

    offset: Indices
    size: Indices
    log_ns: int


@dataclass(frozen=True, eq=False)
class Unpacked:
    """A chunk in memory: its bytes, and where the messages of each channel lie."""

    buffer: Bytes
    channels: dict[int, Placed]

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
        times = partial(_times, self.buffer, offset)
        return MessageBatch(Messages(self.buffer, offset, size), log_ns, position, times)


class McapStorage:
    """One mcap file.

    Args:
        path: The file.
        losses: Takes sentences about what cannot be read.

    Raises:
        RecordingError: This is no mcap file.
        OSError: The file cannot be read.

    """

    def __init__(self, path: AnyPath, losses: Losses) -> None:
        self.path = path
        self.size = path.stat().st_size
        self._losses = losses
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
            topics[channel.topic] = before.merged(topic) if before else topic
        return topics

    @property
    def custom_data(self) -> dict[str, str]:
        """Contents of the metadata records; rosbag2's own record counts with its custom data."""
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
        read = [c for c in self._chunks if any(_may_hold(c, ids) for ids in wanted)]
        ahead = ReadAhead(read, self._fetch, self._with_content)
        return {topic: self._read(ids, wanted, cache, ahead) for topic, ids in channels.items()}

    def _read(
        self,
        channels: frozenset[int],
        wanted: list[frozenset[int]],
        cache: Cache,
        ahead: ReadAhead[_Stored, _Content],
    ) -> Iterator[MessageBatch]:
        for chunk in self._chunks if channels else ():
            if not _may_hold(chunk, channels):
                continue
            users = sum(_may_hold(chunk, others) for others in wanted)
            located = partial(self._located, ahead, chunk)
            unpacked = cache.get((self.path, chunk.start), located, users)
            stretch = unpacked.batch(channels, chunk.end)
            if stretch is not None:
                yield stretch

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
        """Look for channels in the chunks that hold messages of unknown channels.

        A file without summary describes its channels within the chunks alone.
        """
        known = self._catalogue.channels
        complete = bool(known) and self._catalogue.counts is not None
        for chunk in self._chunks:
            if complete if chunk.counts is None else known.keys() >= chunk.counts.keys():
                continue
            with self.path.open('rb', buffering=0) as file:
                buffer = self._unpack(chunk, _read(file, chunk.data, chunk.stored))
            if buffer is not None:
                self._learn(buffer)

    def _learn(self, buffer: Bytes) -> None:
        offsets, _ = walk(buffer)
        ops = buffer[offsets]
        for offset in offsets[(ops == Op.SCHEMA) | (ops == Op.CHANNEL)].tolist():
            op, length = struct.unpack_from('<BQ', buffer.data, offset)
            start = offset + RECORD_HEAD
            try:
                self._catalogue.add(op, buffer[start : start + length].tobytes())
            except RecordError as error:
                self._losses.add(f'{self.path.name}: {error}.')

    def _fetch(self, chunk: Chunk) -> _Stored:
        """Bring a chunk into memory as it is stored."""
        with self.path.open('rb', buffering=0) as file:
            stored, tables = _read_with_index(chunk, file)
            if chunk.crc is None:
                chunk = _with_checksum(chunk, file)
        return chunk, stored, tables

    def _with_content(self, fetched: _Stored) -> _Content:
        """Unpack a chunk that was fetched."""
        chunk, stored, tables = fetched
        return self._unpack(chunk, stored), tables

    def _located(self, ahead: ReadAhead[_Stored, _Content], chunk: Chunk) -> Unpacked:
        """Find the messages of a chunk; the thread that unpacks goes on meanwhile."""
        buffer, tables = ahead.load(chunk)
        if buffer is None:
            return Unpacked(np.empty(0, np.uint8), {})
        placed = _indexed(tables, buffer)
        return Unpacked(buffer, self._walked(chunk, buffer) if placed is None else placed)

    def _walked(self, chunk: Chunk, buffer: Bytes) -> dict[int, Placed]:
        """Find the messages by walking over the records."""
        offsets, end = walk(buffer)
        if end < len(buffer):
            self._losses.add(
                f'{self.path.name}: {chunk} holds no valid record at its byte {end}; '
                f'its other {len(buffer) - end} bytes are left out.'
            )
        marked = offsets[buffer[offsets] == Op.MESSAGE]
        # The head of a message reaches further than that of a record, perhaps beyond the chunk.
        offsets = marked[marked <= len(buffer) - _HEAD]
        heads = _heads(buffer, offsets)
        sound = heads['length'] >= MESSAGE_HEAD
        offsets, heads = offsets[sound], heads[sound]
        if bad := len(marked) - len(offsets):
            self._losses.add(f'{self.path.name}: {chunk} holds {bad} messages too short to be any.')
        placed = {}
        for channel in np.unique(heads['channel']).tolist():
            mine = heads['channel'] == channel
            first = _log_time(buffer, int(offsets[mine.argmax()]))
            placed[channel] = _placed(offsets[mine], heads[mine], first)
        return placed

    def _unpack(self, chunk: Chunk, stored: memoryview) -> Bytes | None:
        """Return the bytes of a chunk; None, and a stated loss, where they are not sound."""
        if chunk.cut or len(stored) < chunk.stored:
            return self._unpack_cut(chunk, stored)
        try:
            content = decompressor(chunk.compression)(stored) if chunk.compression else stored
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
        self._losses.add(
            f'{self.path.name}: {chunk} is cut off by the end of the file; of its {chunk.size} '
            f'bytes the first {end} are used.'
        )
        return buffer[:end]

    def _lose(self, chunk: Chunk, why: str) -> None:
        topics = {i: c.topic for i, c in self._catalogue.channels.items()}
        counts = chunk.counts or {}
        held = ', '.join(f'{n} of {topics.get(i, f"channel {i}")}' for i, n in counts.items())
        what = f'its messages ({held})' if held else 'its messages'
        self._losses.add(f'{self.path.name}: {chunk} {why}; {what} are left out.')


def _may_hold(chunk: Chunk, channels: frozenset[int]) -> bool:
    return chunk.counts is None or not channels.isdisjoint(chunk.counts)


def _read(file: ByteFile, position: int, size: int) -> memoryview:
    """Read bytes of a file, fewer where it ends."""
    file.seek(position)
    return memoryview(file.read(size))


def _with_checksum(chunk: Chunk, file: ByteFile) -> Chunk:
    """Add the CRC that a chunk's own head states; none where that is no head of this chunk."""
    head = bytes(_read(file, chunk.start + RECORD_HEAD, LONGEST_HEAD))
    try:
        found, _ = chunk_at(chunk.start, head)
    except (struct.error, UnicodeDecodeError):
        return chunk
    same = replace(chunk, index=None, counts=None, crc=found.crc) == found
    return replace(chunk, crc=found.crc) if same else chunk


def _read_with_index(chunk: Chunk, file: ByteFile) -> tuple[memoryview, dict[int, Indices]]:
    """Read a chunk and the message index behind it: (n, 2) log times and offsets by channel."""
    index = chunk.index or {}
    end = max([chunk.end, *(position + 16 * count for position, count in index.values())])
    if end - chunk.end > _LONGEST_INDEX:
        end = chunk.end
    content = _read(file, chunk.data, end - chunk.data)
    tables = {}
    for channel, (position, count) in index.items():
        size = 16 * count
        start = position - chunk.data
        inside = position + size <= end
        stored = content[start : start + size] if inside else _read(file, position, size)
        table = np.frombuffer(stored[: len(stored) // 16 * 16], '<i8').reshape(-1, 2)
        if len(table):
            tables[channel] = table
    return content[: chunk.stored], tables


def _indexed(tables: dict[int, Indices], buffer: Bytes) -> dict[int, Placed] | None:
    """Find messages by the index; None where it contradicts the chunk or leaves messages out."""
    placed = {}
    for channel, entries in tables.items():
        # No order of the entries is prescribed; messages count in the order of the file.
        table = entries
        if (table[1:, 1] <= table[:-1, 1]).any():
            table = entries[np.argsort(entries[:, 1])]
            if (table[1:, 1] == table[:-1, 1]).any():
                return None
        offsets = np.ascontiguousarray(table[:, 1])
        if offsets[0] < 0 or offsets[-1] > len(buffer) - _HEAD:
            return None
        heads = _heads(buffer, offsets)
        if (heads['op'] != Op.MESSAGE).any() or (heads['channel'] != channel).any():
            return None
        placed[channel] = _placed(offsets, heads, int(table[0, 0]))
    return placed if placed and _is_complete(placed, buffer) else None


def _is_complete(placed: dict[int, Placed], buffer: Bytes) -> bool:
    """Tell whether messages and records of other kinds fill the chunk, without overlap."""
    if any((p.size < 0).any() for p in placed.values()):
        return False
    if sum(int(p.size.sum()) + _HEAD * len(p.size) for p in placed.values()) == len(buffer):
        return True
    starts = np.sort(np.concatenate([p.offset for p in placed.values()])) - _HEAD
    ends = np.sort(np.concatenate([p.offset + p.size for p in placed.values()]))
    starts, ends = np.append(starts, len(buffer)), np.concatenate([[0], ends])
    for gap in np.flatnonzero(starts != ends).tolist():
        between = buffer[int(ends[gap]) : int(starts[gap])]
        records, end = walk(between)
        if end != len(between) or len(records) == 0 or (between[records] == Op.MESSAGE).any():
            return False
    return True


def _heads(buffer: Bytes, offsets: Indices) -> np.ndarray[Any, Any]:
    """Gather opcode, length and channel of records."""
    if len(buffer) < _HEAD_KIND.itemsize:
        return np.empty(0, _HEAD_KIND)
    last = len(buffer) - _HEAD_KIND.itemsize + 1
    anywhere = np.ndarray((last,), f'V{_HEAD_KIND.itemsize}', buffer, 0, (1,))
    return anywhere[offsets].view(_HEAD_KIND)


def _placed(offsets: Indices, heads: np.ndarray[Any, Any], log_ns: int) -> Placed:
    size = heads['length'].astype(np.int64) - MESSAGE_HEAD
    return Placed(offsets + _HEAD, size, log_ns)


def _times(buffer: Bytes, offset: Indices) -> Times:
    """Read log and publish times, the last two fields of a message's head."""
    anywhere = np.ndarray((len(buffer) - 15,), 'V16', buffer, 0, (1,))
    pairs = anywhere[offset - 16].view('<i8').reshape(-1, 2)
    return Times(pairs[:, 0].astype(np.int64), pairs[:, 1].astype(np.int64))


def _log_time(buffer: Bytes, offset: int) -> int:
    return int(struct.unpack_from('<Q', buffer.data, offset + RECORD_HEAD + 6)[0])
