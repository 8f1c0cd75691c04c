"""Chunks of an mcap file: their offsets, from their own heads or from the summary."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from .mcap_records import RECORD_HEAD, Catalogue, ChunkIndex, Fields
from .storage import seconds

if TYPE_CHECKING:
    from collections.abc import Sequence

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
    """A range of messages in the file: a chunk record, or messages without chunks.

    Attributes:
        start: Offset of the record.
        data: Offset of the stored bytes.
        stored: Number of stored bytes that the file holds.
        size: Bytes after unpacking; None if the file does not state it.
        compression: '', 'lz4' or 'zstd'.
        crc: CRC-32 of the unpacked bytes; 0 without one, None if only the summary was read, which
            does not contain it.
        start_ns: Earliest log time.
        end_ns: Latest log time.
        index: Offset in the file and number of the message index entries of each channel; None
            without index.
        counts: Messages of each channel; None if known only after unpacking.
        cut: Whether the file ends within this chunk.
    """

    start: int
    data: int
    stored: int
    size: int | None
    compression: str
    crc: int | None
    start_ns: int
    end_ns: int
    index: dict[int, tuple[int, int]] | None = None
    counts: dict[int, int] | None = None
    cut: bool = False

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
    """Read a chunk's fields.

    Args:
        position: Offset of its record in the file.
        head: Bytes of the record behind opcode and length, at least `LONGEST_HEAD` of them.

    Returns:
        The chunk, and the least length of its record.

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
    """Return the chunks of a file by its summary alone; None if that is incomplete.

    Args:
        catalogue: Of the summary.
        end: Offset of the summary.
    """
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
    chunks = [_of_summary(entry) for entry in entries]
    counts: dict[int, int] = {}
    for chunk in chunks:
        for channel, count in (chunk.counts or {}).items():
            counts[channel] = counts.get(channel, 0) + count
    stated = {channel: count for channel, count in (catalogue.counts or {}).items() if count}
    # Messages outside chunks, or without an index, are in the statistics alone.
    return chunks if counts == stated and stated.keys() <= catalogue.channels.keys() else None


def _of_summary(entry: ChunkIndex) -> Chunk:
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
    """Group chunks that are loaded as one.

    Args:
        chunks: In the order of the file.
    """
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
