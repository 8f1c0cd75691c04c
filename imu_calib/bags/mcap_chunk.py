"""Chunks of an mcap file: where one lies, by its own head or by what the summary says of it."""

from __future__ import annotations

from dataclasses import dataclass

from .mcap_records import RECORD_HEAD, Catalogue, ChunkIndex, Fields
from .storage import seconds

CHUNK_FIELDS = 40
"""Bytes of a chunk's fields before its records: start, end, size, CRC, compression, length
(mcap.dev/spec)."""
LONGEST_HEAD = CHUNK_FIELDS + 16
"""Bytes of a record that tell what it holds: a chunk's fields, with the longest name of a
compression."""
INDEX_HEAD = 6
"""Bytes of a message index before its entries: channel, bytes of entries (mcap.dev/spec)."""


@dataclass(frozen=True)
class Chunk:
    """Where messages lie in the file: a chunk record, or a stretch of a file without chunks.

    Attributes:
        start: Offset of the record.
        data: Offset of the stored bytes.
        stored: Number of stored bytes that the file holds.
        size: Number of bytes that they unpack to; None where the file does not say.
        compression: '', 'lz4' or 'zstd'.
        crc: CRC-32 of the unpacked bytes; 0 where there is none, None where the summary alone was
            read, which does not say.
        start_ns: Earliest log time.
        end_ns: Latest log time.
        index: Offset in the file and number of the message index entries of each channel; None
            without index.
        counts: Messages of each channel; None where only unpacking would tell.
        cut: The file ends within this chunk.

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

    def __str__(self) -> str:
        return f'the chunk at byte {self.start} ({seconds(self.start_ns, self.end_ns)})'


def chunk_at(position: int, head: bytes) -> tuple[Chunk, int]:
    """Read a chunk's fields.

    Args:
        position: Offset of its record in the file.
        head: Bytes of the record behind opcode and length, `LONGEST_HEAD` of them or more.

    Returns:
        The chunk, and the least length of its record.

    Raises:
        struct.error: There are too few bytes.
        UnicodeDecodeError: This is no chunk.

    """
    fields = Fields(head)
    start_ns, end_ns, size = (fields.number('Q') for _ in range(3))
    crc, compression, stored = fields.number('I'), fields.string(), fields.number('Q')
    data = position + RECORD_HEAD + fields.position
    chunk = Chunk(position, data, stored, size, compression, crc, start_ns, end_ns)
    return chunk, fields.position + stored


def chunks_of(catalogue: Catalogue, end: int) -> list[Chunk] | None:
    """Return the chunks of a file by its summary alone; None where that does not say all of them.

    Args:
        catalogue: Of the summary.
        end: Offset of the summary.

    """
    entries = sorted(catalogue.chunks, key=lambda entry: entry.start)
    starts = [*(entry.start for entry in entries), end]
    apart = all(
        entry.start + entry.length + entry.behind <= following
        for entry, following in zip(entries, starts[1:], strict=True)
    )
    if not apart or catalogue.totals != (len(catalogue.metadata_at), len(entries)):
        return None
    chunks = [_of_summary(entry) for entry in entries]
    counts: dict[int, int] = {}
    for chunk in chunks:
        for channel, count in (chunk.counts or {}).items():
            counts[channel] = counts.get(channel, 0) + count
    stated = {channel: count for channel, count in (catalogue.counts or {}).items() if count}
    # Messages without a chunk around them, or without an index, are in the statistics alone.
    return chunks if counts == stated and stated.keys() <= catalogue.channels.keys() else None


def _of_summary(entry: ChunkIndex) -> Chunk:
    stored, size = entry.sizes
    data = entry.start + entry.length - stored
    # One message index follows another, the last one ends where all of them do.
    inside = sorted((offset, channel) for channel, offset in entry.index.items())
    ends = [*(offset for offset, _ in inside[1:]), data + stored + entry.behind]
    index = {}
    for (offset, channel), after in zip(inside, ends, strict=True):
        entries = offset + RECORD_HEAD + INDEX_HEAD
        index[channel] = entries, max(after - entries, 0) // 16
    counts = {channel: count for channel, (_, count) in index.items()}
    first, last = entry.times
    return Chunk(
        entry.start, data, stored, size, entry.compression, None, first, last, index, counts
    )
