"""Read and build the records of the mcap format as bytes.

Format: mcap.dev/spec, version 0. A record is an opcode byte, a length of 8 bytes, and content.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from functools import cache

import numpy as np

from .cdr import Bytes, Indices
from .storage import Described, seconds

MAGIC = b'\x89MCAP0\r\n'
RECORD_HEAD = 9  #: Bytes of opcode and length before each record (MCAP specification).
MESSAGE_HEAD = 22  #: Bytes before the data of a Message: channel, sequence, log time, publish time.
FOOTER_SIZE = RECORD_HEAD + 20 + len(MAGIC)
"""Bytes from the Footer to the end of a file: two offsets and a checksum, then the magic."""


class Op(IntEnum):
    """Opcodes."""

    HEADER = 0x01
    FOOTER = 0x02
    SCHEMA = 0x03
    CHANNEL = 0x04
    MESSAGE = 0x05
    CHUNK = 0x06
    MESSAGE_INDEX = 0x07
    CHUNK_INDEX = 0x08
    ATTACHMENT = 0x09
    ATTACHMENT_INDEX = 0x0A
    STATISTICS = 0x0B
    METADATA = 0x0C
    METADATA_INDEX = 0x0D
    SUMMARY_OFFSET = 0x0E
    DATA_END = 0x0F


class RecordError(Exception):
    """A record contradicts the format."""


@dataclass(frozen=True)
class Channel:
    """A channel: one publisher's view of a topic."""

    id: int
    topic: str
    type: str
    encoding: str
    described: Described = field(default_factory=Described)


@dataclass(frozen=True)
class ChunkIndex:
    """The summary's entry on a chunk."""

    times: tuple[int, int]  #: Earliest and latest log time, ns.
    start: int  #: Offset of the chunk record.
    length: int  #: Of the record, its head included.
    index: dict[int, int]  #: Offset of the message index of each channel.
    index_bytes: int  #: Bytes of all message indexes, which follow the chunk.
    compression: str  #: '', 'lz4' or 'zstd'.
    sizes: tuple[int, int]  #: Bytes of the messages, stored and unpacked.


@dataclass
class Catalogue:
    """Records on the file as a whole."""

    #: Message type, language and text of the definition by schema id.
    schemas: dict[int, tuple[str, str, str]] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)  #: Channels by id.
    #: The metadata records: name and content.
    records: list[tuple[str, dict[str, str]]] = field(default_factory=list)
    #: Messages by channel id, from the statistics; None without.
    counts: dict[int, int] | None = None
    chunks: list[ChunkIndex] = field(default_factory=list)  #: Contents of the chunk index.
    #: Offset and length of the metadata records, from their index.
    metadata_at: list[tuple[int, int]] = field(default_factory=list)
    #: Numbers of metadata records and of chunks, from the statistics; None without.
    totals: tuple[int, int] | None = None
    #: Offset and length of the attachments' records.
    attachments_at: list[tuple[int, int]] = field(default_factory=list)
    attachments: int = 0  #: Their number, from the statistics.

    @property
    def metadata(self) -> dict[str, dict[str, str]]:
        """Contents of the metadata records by their names."""
        merged: dict[str, dict[str, str]] = {}
        for name, pairs in self.records:
            merged.setdefault(name, {}).update(pairs)
        return merged

    def add_record(self, op: int, content: bytes) -> None:
        """Store a record, if it is of a relevant kind."""
        try:
            self._add_content(op, Fields(content))
        except (struct.error, ValueError) as error:
            raise RecordError(f'record with opcode {op}: {error}') from None

    def _add_content(self, op: int, fields: Fields) -> None:
        if op == Op.SCHEMA:
            key = fields.number('H')
            name, language, text = fields.string(), fields.string(), fields.block()
            self.schemas[key] = name, language, text.decode(errors='surrogateescape')
        elif op == Op.CHANNEL:
            key, schema = fields.numbers('HH')
            topic, encoding = fields.string(), fields.string()
            pairs = fields.strings()
            profiles = pairs.get('offered_qos_profiles', '')
            name, language, text_ = self.schemas.get(schema, ('', '', ''))
            described = Described(text_, language, profiles, tuple(pairs.items()))
            self.channels[key] = Channel(key, topic, name, encoding, described)
        elif op == Op.METADATA:
            found_ = fields.string(), fields.strings()
            # A walk may begin anew over records that the summary led to.
            if found_ not in self.records:
                self.records.append(found_)
        elif op == Op.CHUNK_INDEX:
            first, last, start, length = fields.numbers('QQQQ')
            index = dict(struct.iter_unpack('<HQ', fields.block()))
            index_bytes, compression = fields.number('Q'), fields.string()
            stored, size = fields.numbers('QQ')
            found = (first, last), start, length, index, index_bytes, compression, (stored, size)
            self.chunks.append(ChunkIndex(*found))
        elif op == Op.METADATA_INDEX:
            start, length = fields.numbers('QQ')
            self.metadata_at.append((start, length))
        elif op == Op.ATTACHMENT_INDEX:
            start, length = fields.numbers('QQ')
            self.attachments_at.append((start, length))
        elif op == Op.STATISTICS:
            fields.skip(14)
            self.attachments, metadata, chunks = fields.numbers('III')
            self.totals = metadata, chunks
            fields.skip(16)
            self.counts = dict(struct.iter_unpack('<HQ', fields.block()))


@cache
def _form(codes: str) -> struct.Struct:
    return struct.Struct(f'<{codes}')


class Fields:
    """Read the fields of one record in sequence."""

    def __init__(self, content: bytes, position: int = 0) -> None:
        self._content = content
        self.position = position

    def numbers(self, codes: str) -> tuple[int, ...]:
        """Read little-endian numbers."""
        form = _form(codes)
        found = form.unpack_from(self._content, self.position)
        self.position += form.size
        return found

    def number(self, code: str) -> int:
        """Read one little-endian number."""
        return self.numbers(code)[0]

    def skip(self, size: int) -> None:
        """Skip bytes."""
        self.position += size

    def block(self) -> bytes:
        """Read bytes after their 4-byte length."""
        size = self.number('I')
        if self.position + size > len(self._content):
            raise struct.error(f'a field of {size} bytes reaches beyond the record')
        self.position += size
        return self._content[self.position - size : self.position]

    def string(self) -> str:
        """Read a string."""
        return self.block().decode()

    def strings(self) -> dict[str, str]:
        """Read a map of strings."""
        inner = Fields(self.block())
        pairs = {}
        while inner.position < len(inner._content):
            key = inner.string()
            pairs[key] = inner.string()
        return pairs


def record(op: Op, content: bytes) -> bytes:
    """Build a record."""
    return struct.pack('<BQ', op, len(content)) + content


def string(text: str) -> bytes:
    """Build a string field."""
    encoded = text.encode()
    return struct.pack('<I', len(encoded)) + encoded


def strings(pairs: dict[str, str]) -> bytes:
    """Build a map of strings."""
    content = b''.join(string(key) + string(value) for key, value in pairs.items())
    return struct.pack('<I', len(content)) + content


def walk(buffer: Bytes, start: int = 0) -> tuple[Indices, int]:
    """Find consecutive records in a buffer, the first at `start`.

    Return the offsets (n,) of the whole records, and that where the last of them ends.
    """
    whole = buffer.data
    end = len(buffer)
    parts: list[Indices] = []
    single: list[int] = []
    position, previous, streak = start, -1, 0
    while position + RECORD_HEAD <= end:
        op, length = struct.unpack_from('<BQ', whole, position)
        if op == 0 or length > end - position - RECORD_HEAD:
            break
        streak = streak + 1 if length == previous else 0
        previous = length
        if streak < 8:
            single.append(position)
            position += RECORD_HEAD + length
            continue
        run = _run(buffer, position, length)
        parts += [np.array(single, np.int64), run]
        single = []
        position = int(run[-1]) + RECORD_HEAD + length
    parts.append(np.array(single, np.int64))
    return np.concatenate(parts), position


def _run(buffer: Bytes, position: int, length: int) -> Indices:
    """Return the offsets of the records of equal length from a position on; at least one."""
    stride = RECORD_HEAD + length
    possible = (len(buffer) - position) // stride
    lengths = np.ndarray((possible,), '<u8', buffer, position + 1, (stride,))
    ops = np.ndarray((possible,), np.uint8, buffer, position, (stride,))
    other = np.flatnonzero((lengths != length) | (ops == 0))
    count = int(other[0]) if len(other) else possible
    return position + stride * np.arange(count)


CHUNK_FIELDS = 40
"""Bytes of a chunk's fields before its records: start, end, size, CRC, compression, length
(mcap.dev/spec)."""
LONGEST_HEAD = CHUNK_FIELDS + 16
"""Bytes of a record that describe its content: a chunk's fields, with the longest name of a
compression."""
INDEX_HEAD = 6
"""Bytes of a message index before its entries: channel, bytes of entries (mcap.dev/spec)."""
_LONGEST_INDEX = 1 << 20
"""Bytes between a chunk and the end of its message index up to which both are read at once: more
than indices take, and little beside a chunk."""
TOGETHER = 9 << 19
"""Bytes of the chunks loaded as one: enough to make the interpreter's time per load negligible, and
few enough to stay in the processor's cache. Recorders close a chunk at 1 MiB or 0.75 MiB: four or
five are loaded as one, which took less processor time than three or six."""


@dataclass
class Chunk:
    """A range of messages in the file: a chunk record, or messages without chunks."""

    start: int  #: Offset of the record.
    data: int  #: Offset of the stored bytes.
    stored: int  #: Number of stored bytes that the file holds.
    size: int | None  #: Bytes after unpacking; None if the file does not state it.
    compression: str  #: '', 'lz4' or 'zstd'.
    #: CRC-32 of the unpacked bytes; 0 without one, None if only the summary was read, which does
    #: not contain it.
    crc: int | None
    start_ns: int  #: Earliest log time.
    end_ns: int  #: Latest log time.
    #: Offset in the file and number of the message index entries of each channel; None without
    #: index.
    index: dict[int, tuple[int, int]] | None = None
    #: Messages of each channel; None if known only after unpacking.
    counts: dict[int, int] | None = None
    cut: bool = False  #: Whether the file ends within this chunk.

    @property
    def end(self) -> int:
        """Offset of the byte after the stored ones."""
        return self.data + self.stored

    @property
    def reach(self) -> int:
        """Offset of the byte after the message index, if that is near, else as `end`."""
        index = self.index or {}
        reach = max([self.end, *(position + 16 * count for position, count in index.values())])
        return reach if reach - self.end <= _LONGEST_INDEX else self.end

    @property
    def most(self) -> int:
        """Bytes stored or after unpacking, whichever is more."""
        return max(self.stored, self.size or 0)

    def may_hold(self, channels: frozenset[int]) -> bool:
        """Return whether there may be messages of some channels."""
        return self.counts is None or not channels.isdisjoint(self.counts)

    def __str__(self) -> str:
        return f'the chunk at byte {self.start} ({seconds(self.start_ns, self.end_ns)})'


@dataclass(frozen=True)
class ChunkGroup:
    """Adjoining chunks of one compression that are loaded as one."""

    chunks: tuple[Chunk, ...]

    @property
    def start(self) -> int:
        """Offset of the first record."""
        return self.chunks[0].start

    @property
    def end(self) -> int:
        """Offset of the byte after the last one stored."""
        return self.chunks[-1].end

    @property
    def reach(self) -> int:
        """Offset of the byte after the range to be read."""
        return max(chunk.reach for chunk in self.chunks)

    @property
    def compression(self) -> str:
        """Compression of every chunk."""
        return self.chunks[0].compression

    @property
    def size(self) -> int:
        """Most bytes of memory for the chunks."""
        return sum(chunk.most for chunk in self.chunks)

    def may_hold(self, channels: frozenset[int]) -> bool:
        """Return whether there may be messages of some channels."""
        return any(chunk.may_hold(channels) for chunk in self.chunks)


def chunk_at(position: int, head: bytes) -> tuple[Chunk, int]:
    """Read the fields of a chunk at a position: return it, and the least length of its record.

    The head is the bytes of the record behind opcode and length, `LONGEST_HEAD` or more.

    Raises:
        struct.error: There are too few bytes.
        UnicodeDecodeError: This is not a chunk.
    """
    fields = Fields(head)
    start_ns, end_ns, size, crc = fields.numbers('QQQI')
    compression, stored = fields.string(), fields.number('Q')
    data = position + RECORD_HEAD + fields.position
    chunk = Chunk(position, data, stored, size, compression, crc, start_ns, end_ns)
    return chunk, fields.position + stored


def chunks_of(catalogue: Catalogue, end: int) -> list[Chunk] | None:
    """Return the chunks of a file by its summary, which begins at `end`; None if incomplete."""
    entries = sorted(catalogue.chunks, key=lambda entry: entry.start)
    starts = [*(entry.start for entry in entries), end]
    apart = all(
        entry.start + entry.length + entry.index_bytes <= following
        for entry, following in zip(entries, starts[1:], strict=True)
    )
    if not apart or catalogue.totals != (len(catalogue.metadata_at), len(entries)):
        return None
    if catalogue.attachments != len(catalogue.attachments_at):
        return None
    chunks = [_chunk_of_index(entry) for entry in entries]
    counts: dict[int, int] = {}
    for chunk in chunks:
        for channel, count in (chunk.counts or {}).items():
            counts[channel] = counts.get(channel, 0) + count
    stated = {channel: count for channel, count in (catalogue.counts or {}).items() if count}
    # Messages outside chunks, or without an index, are in the statistics alone.
    return chunks if counts == stated and stated.keys() <= catalogue.channels.keys() else None


def _chunk_of_index(entry: ChunkIndex) -> Chunk:
    stored, size = entry.sizes
    data = entry.start + entry.length - stored
    # The message indexes adjoin; the last one ends where all of them do.
    inside = sorted((offset, channel) for channel, offset in entry.index.items())
    ends = [*(offset for offset, _ in inside[1:]), data + stored + entry.index_bytes]
    index = {}
    for (offset, channel), after in zip(inside, ends, strict=True):
        entries = offset + RECORD_HEAD + INDEX_HEAD
        index[channel] = entries, max(after - entries, 0) // 16
    counts = {channel: count for channel, (_, count) in index.items()}
    first, last = entry.times
    return Chunk(
        entry.start, data, stored, size, entry.compression, None, first, last, index, counts
    )


def grouped(chunks: Sequence[Chunk]) -> list[ChunkGroup]:
    """Group chunks, in the order of the file, that are loaded as one."""
    together: list[list[Chunk]] = []
    size = 0
    for chunk in chunks:
        before = together[-1][-1] if together else None
        size += chunk.most
        if (
            before is None
            or size > TOGETHER
            or chunk.compression != before.compression
            or not before.end <= chunk.start <= before.end + _LONGEST_INDEX
        ):
            together.append([])
            size = chunk.most
        together[-1].append(chunk)
    return [ChunkGroup(tuple(several)) for several in together]
