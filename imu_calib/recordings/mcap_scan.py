"""Find the chunks of an mcap file by walking over its records, with or without a footer."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from io import BufferedIOBase, FileIO
from itertools import accumulate
from typing import Any, TypeAlias

import numpy as np

from ..common.files import beginning
from ..common.stream import Stamps
from .cdr import Bytes, Indices
from .mcap_records import (
    FOOTER_SIZE,
    INDEX_HEAD,
    LONGEST_HEAD,
    MAGIC,
    MESSAGE_HEAD,
    RECORD_HEAD,
    Catalogue,
    Chunk,
    Op,
    RecordError,
    chunk_at,
    chunks_of,
    walk,
)
from .remote import AnyPath, RemotePath
from .storage import Losses, RecordingError, Times

ByteFile: TypeAlias = FileIO | BufferedIOBase

_WINDOW = 1 << 22  #: Bytes read at once of messages outside chunks.
_FEWEST_ZEROS = 32
"""Bytes: fewer at the end of a chunk may be its own, of compressed data or of the last message."""
_SMALL = frozenset({Op.SCHEMA, Op.CHANNEL, Op.METADATA})


@dataclass
class Scan:
    """Result of walking over the records of a file."""

    chunks: list[Chunk] = field(default_factory=list)
    catalogue: Catalogue = field(default_factory=Catalogue)


def scan(path: AnyPath, losses: Losses) -> Scan:
    """Find the chunks, channels and metadata of a file; `losses` receives what is damaged."""
    # Records are far apart: a buffer would be filled for each.
    with path.open('rb', buffering=0) as file:
        return _Scanner(path, file, losses).scan()


class _Scanner:
    """One walk over one open file."""

    def __init__(self, path: AnyPath, file: ByteFile, losses: Losses) -> None:
        self.name = path.name
        self.elsewhere = isinstance(path, RemotePath)
        self.file = file
        self.losses = losses
        self.size = self.end = path.stat().st_size
        self.finished = False
        self.cut_at = 0
        self.zeros = False
        self.chunk_starts: frozenset[int] = frozenset()
        self.found = Scan()

    def scan(self) -> Scan:
        self._check_magic()
        self._read_summary()
        # In a remote file, walking the records would fetch a part of every chunk.
        if self.elsewhere and self._is_summed_up():
            return self.found
        position = len(MAGIC)
        while position < self.end:
            following = self._record(position)
            position = self._resume(position) if following is None else following
        if not self.finished:
            self._state_unfinished(position)
        return self.found

    def _check_magic(self) -> None:
        magic = self._read(0, len(MAGIC))
        if magic != MAGIC:
            what = beginning(magic)
            if what.startswith('begins with the text'):
                what += '. imu-calib convert reads tables of numbers'
            raise RecordingError(
                f'{self.name} is not a recording of rosbag2 (mcap or sqlite3): it {what}.'
            )

    def _read(self, position: int, size: int) -> bytes:
        if not self.elsewhere and hasattr(os, 'pread'):
            # One system call instead of two for each record; Windows has none.
            return os.pread(self.file.fileno(), size, position)
        self.file.seek(position)
        return self.file.read(size)

    def _read_summary(self) -> None:
        """Read the summary section, if there is one."""
        footer = self._read(max(self.size - FOOTER_SIZE, 0), FOOTER_SIZE)
        if not footer.endswith(MAGIC) or footer[:RECORD_HEAD] != struct.pack('<BQ', Op.FOOTER, 20):
            return
        self.finished = True
        self.end = self.size - FOOTER_SIZE
        (start,) = struct.unpack_from('<Q', footer, RECORD_HEAD)
        if not len(MAGIC) <= start <= self.end:
            return
        summary = self._read(start, self.end - start)
        offsets, _ = walk(np.frombuffer(summary, np.uint8))
        catalogue = Catalogue()
        try:
            for offset in offsets.tolist():
                op, length = struct.unpack_from('<BQ', summary, offset)
                content = offset + RECORD_HEAD
                catalogue.add_record(op, summary[content : content + length])
        except RecordError:
            # The data section repeats it.
            return
        self.found.catalogue = catalogue
        self.chunk_starts = frozenset(entry.start for entry in catalogue.chunks)
        self.end = int(start)

    def _is_summed_up(self) -> bool:
        """Take the chunks from the summary; return whether it is complete."""
        chunks = chunks_of(self.found.catalogue, self.end)
        if chunks is None:
            return False
        for position, length in self.found.catalogue.metadata_at:
            if self._small(Op.METADATA, position, length - RECORD_HEAD, 0) is None:
                return False
        self.found.chunks = chunks
        return True

    def _record(self, position: int) -> int | None:
        """Process the record at a position; return the next, or None if it is invalid."""
        beginning = self._read(position, RECORD_HEAD + LONGEST_HEAD)
        if len(beginning) < RECORD_HEAD:
            return self._overrun(position)
        op, length = struct.unpack_from('<BQ', beginning)
        following: int = position + RECORD_HEAD + length
        head = beginning[RECORD_HEAD:]
        if op == Op.CHUNK:
            return self._chunk(position, length, following, head)
        if position in self.chunk_starts:
            return None
        if op == 0 or following > self.end:
            return self._overrun(position) if op in set(Op) else None
        return self._whole_record(op, position, length, head)

    def _whole_record(self, op: int, position: int, length: int, head: bytes) -> int | None:
        following = position + RECORD_HEAD + length
        if op == Op.MESSAGE_INDEX:
            return self._index(position, length, following, head)
        if op == Op.MESSAGE:
            return self._unchunked(position)
        if op in _SMALL:
            return self._small(op, position, length, following)
        if op == Op.ATTACHMENT:
            place, known = (position, RECORD_HEAD + length), self.found.catalogue.attachments_at
            if place not in known:
                known.append(place)
        if op in {Op.DATA_END, Op.FOOTER}:
            self.finished = True
            return self.end
        return following

    def _overrun(self, position: int) -> int | None:
        """Handle a record that extends beyond the data: a cut file, or a wrong length."""
        if self.finished:
            return None
        self.cut_at = position
        return self.size

    def _state_unfinished(self, position: int) -> None:
        """State that the recording was not completed."""
        chunks = self.found.chunks
        if chunks and not chunks[-1].cut:
            # Its message index may be cut off as well, which would hide topics without one.
            chunks[-1].index = chunks[-1].counts = None
        until = max((chunk.end_ns for chunk in chunks if not chunk.cut), default=None)
        known = f'; the data up to log time {until / 1e9:.3f} s is complete' if until else ''
        where = (
            f'is cut off at byte {self.cut_at} of {position}' if self.cut_at else 'has no footer'
        )
        where += ' (zeros follow)' if self.zeros else ''
        self.losses.unfinished = f'{self.name} {where}: its recorder did not finish{known}.'
        self.losses.add_loss(self.losses.unfinished)

    def _small(self, op: int, position: int, length: int, following: int) -> int | None:
        try:
            self.found.catalogue.add_record(op, self._read(position + RECORD_HEAD, length))
        except RecordError:
            return None
        return following

    def _resume(self, position: int) -> int:
        """State a damaged range, and continue at the next chunk in the summary."""
        if not self.chunk_starts and (zeros := self._zeros_before(position)) is not None:
            self.cut_at, self.zeros = zeros, True
            return self.size
        starts = [s for s in self.chunk_starts if position < s < self.end]
        following = min(starts, default=self.end)
        what = 'the rest' if following == self.end else f'{following - position} bytes'
        self.losses.add_loss(
            f'{self.name} holds no valid record at byte {position}: {what} cannot be read.'
        )
        if self.found.chunks:
            self.found.chunks[-1].index = self.found.chunks[-1].counts = None
        return following

    def _zeros_before(self, position: int) -> int | None:
        """Return where zeros that fill the rest of a file begin; None if it has another content.

        A disk that lost its power leaves them. The last chunk is cut where they begin within it.
        """
        for start in range(position, self.size, _WINDOW):
            if any(self._read(start, min(_WINDOW, self.size - start))):
                return None
        chunk = self.found.chunks[-1] if self.found.chunks else None
        if chunk is None or chunk.counts is not None:
            # A message index follows it: it is whole.
            return position
        stored = self._read(chunk.data, chunk.stored)
        filled = len(stored.rstrip(b'\0'))
        whole = zlib.crc32(stored) == chunk.crc if chunk.crc and not chunk.compression else False
        if whole or chunk.stored - filled < _FEWEST_ZEROS:
            return position
        chunk.stored, chunk.cut = filled, True
        chunk.index = chunk.counts = None
        return chunk.data + filled

    def _chunk(self, position: int, length: int, following: int, head: bytes) -> int | None:
        try:
            chunk, least = chunk_at(position, head)
        except (struct.error, UnicodeDecodeError):
            return self._overrun(position) if following > self.end else None
        if least > length:
            return None
        if following > self.end:
            if self._overrun(position) is None:
                return None
            chunk.stored, chunk.cut = self.size - chunk.data, True
            following = self.size
        self.found.chunks.append(chunk)
        return following

    def _index(self, position: int, length: int, following: int, head: bytes) -> int | None:
        """Store a message index record: it belongs to the chunk before it."""
        if length < INDEX_HEAD:
            return None
        channel, size = struct.unpack_from('<HI', head)
        if self.found.chunks and size == length - INDEX_HEAD and size % 16 == 0:
            chunk = self.found.chunks[-1]
            if chunk.index is None or chunk.counts is None:
                chunk.index, chunk.counts = {}, {}
            chunk.index[channel] = position + RECORD_HEAD + INDEX_HEAD, size // 16
            chunk.counts[channel] = size // 16
        return following

    def _unchunked(self, position: int) -> int | None:
        """Process messages outside chunks."""
        (length,) = struct.unpack('<Q', self._read(position + 1, 8))
        if length < MESSAGE_HEAD:
            return None
        window = max(_WINDOW, RECORD_HEAD + length)
        buffer = np.frombuffer(self._read(position, min(window, self.end - position)), np.uint8)
        offsets, _ = walk(buffer)
        ops = buffer[offsets]
        foreign = np.flatnonzero(
            ~np.isin(ops, [Op.MESSAGE, Op.SCHEMA, Op.CHANNEL, Op.MESSAGE_INDEX])
        )
        if len(foreign):
            offsets, ops = offsets[: foreign[0]], ops[: foreign[0]]
        for offset in offsets[(ops == Op.SCHEMA) | (ops == Op.CHANNEL)].tolist():
            op, size = struct.unpack_from('<BQ', buffer.data, offset)
            if self._small(op, position + offset, size, 0) is None:
                return None
        last = int(offsets[-1])
        (length,) = struct.unpack_from('<Q', buffer.data, last + 1)
        stop = last + RECORD_HEAD + length
        self.found.chunks.append(_chunk_of(buffer, offsets[ops == Op.MESSAGE], position, stop))
        return int(position + stop)


def _chunk_of(buffer: Bytes, offsets: Indices, position: int, size: int) -> Chunk:
    """Describe messages outside chunks as an uncompressed chunk."""
    view = [('channel', '<u2'), ('sequence', '<u4'), ('log_time', '<u8')]
    heads = np.ndarray((max(len(buffer) - 22, 0),), view, buffer, RECORD_HEAD, (1,))
    heads = heads[offsets[offsets + 31 <= len(buffer)]]
    channels, counts = np.unique(heads['channel'], return_counts=True)
    times = heads['log_time']
    return Chunk(
        start=position,
        data=position,
        stored=size,
        size=size,
        compression='',
        crc=0,
        start_ns=int(times.min()),
        end_ns=int(times.max()),
        counts=dict(zip(channels.tolist(), counts.tolist(), strict=True)),
    )


HEAD = RECORD_HEAD + MESSAGE_HEAD
_MESSAGE = int(Op.MESSAGE)


@dataclass(frozen=True, eq=False)
class ChunkContent:
    """The content of one chunk in a buffer that may hold more."""

    name: str  #: Name of the chunk for messages.
    start: int  #: Start of its records.
    end: int  #: End of its records.
    #: Message index: (n, 2) log times and offsets from the start, by channel.
    tables: dict[int, Indices] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class ChannelMessages:
    """Messages of one channel within a buffer."""

    offset: Indices  #: (n,) start of each serialised message.
    size: Indices  #: (n,) bytes of each.
    log_ns: int  #: Log time of the first.


def located(
    parts: Sequence[ChunkContent], buffer: Bytes, lose: Callable[[str], None]
) -> dict[int, ChannelMessages]:
    """Find the messages of chunks by their indexes, or by walking the records if these are wrong.

    The parts are in that order too; `lose` receives sentences on invalid records.
    """
    placed = indexed(parts, buffer)
    if placed is not None:
        return placed
    if len(parts) != 1:
        return _joined([located([part], buffer, lose) for part in parts])
    return _walked(parts[0], buffer, lose)


def indexed(parts: Sequence[ChunkContent], buffer: Bytes) -> dict[int, ChannelMessages] | None:
    """Find messages as `located`, by the indexes alone.

    None if an index contradicts its chunk or is incomplete, or if several chunks must be examined
    one by one.
    """
    # The tables of a channel are joined, in the order of the buffer.
    channels = dict.fromkeys(channel for part in parts for channel in part.tables)
    held = [(one, k) for one in channels for k, part in enumerate(parts) if one in part.tables]
    if not held:
        return None
    tables = [parts[k].tables[channel] for channel, k in held]
    counts = [len(table) for table in tables]
    ends = list(accumulate(counts))
    begins = [end - count for end, count in zip(ends, counts, strict=True)]
    offsets = np.concatenate([table[:, 1] for table in tables])
    offsets += np.repeat([parts[k].start for _, k in held], counts)
    rising = _are_rising(offsets, begins)
    if not rising:
        # The order of entries is not prescribed; messages are taken in the order of the file.
        offsets = offsets[np.lexsort((offsets, np.repeat(begins, counts)))]
        rising = _are_rising(offsets, begins)
    inside = all(
        parts[k].start <= offsets.item(begin) and offsets.item(end - 1) <= parts[k].end - HEAD
        for (_, k), begin, end in zip(held, begins, ends, strict=True)
    )
    if not rising or not inside:
        return None
    op, size, channel_of = _heads(buffer, offsets)
    if (op != _MESSAGE).any() or (size < 0).any():
        return None
    offsets += HEAD
    placed = {}
    for channel in channels:
        mine = [i for i, (one, _) in enumerate(held) if one == channel]
        these = slice(begins[mine[0]], ends[mine[-1]])
        if (channel_of[these] != channel).any():
            return None
        placed[channel] = _placed(buffer, offsets[these], size[these])
    filled = [0] * len(parts)
    for (_, k), count, total in zip(held, counts, np.add.reduceat(size, begins), strict=True):
        filled[k] += HEAD * count + int(total)
    if filled == [part.end - part.start for part in parts]:
        return placed
    return placed if len(parts) == 1 and _is_complete(placed, buffer, parts[0]) else None


def _are_rising(offsets: Indices, begins: list[int]) -> bool:
    """Return whether offsets increase within each table; tables begin at `begins`."""
    rising = offsets[1:] > offsets[:-1]
    rising[[begin - 1 for begin in begins[1:]]] = True
    return bool(rising.all())


def _is_complete(placed: dict[int, ChannelMessages], buffer: Bytes, part: ChunkContent) -> bool:
    """Return whether messages and other records fill a chunk without overlap."""
    starts = np.sort(np.concatenate([p.offset for p in placed.values()])) - HEAD
    ends = np.sort(np.concatenate([p.offset + p.size for p in placed.values()]))
    starts, ends = np.append(starts, part.end), np.concatenate([[part.start], ends])
    for gap in np.flatnonzero(starts != ends).tolist():
        between = buffer[int(ends[gap]) : int(starts[gap])]
        records, end = walk(between)
        if end != len(between) or len(records) == 0 or (between[records] == _MESSAGE).any():
            return False
    return True


def _walked(
    part: ChunkContent, buffer: Bytes, lose: Callable[[str], None]
) -> dict[int, ChannelMessages]:
    """Find the messages of one chunk by walking over its records."""
    records = buffer[part.start : part.end]
    offsets, end = walk(records)
    if end < len(records):
        lose(
            f'{part.name} holds no valid record at its byte {end}; its other {len(records) - end} '
            'bytes are left out.'
        )
    marked = offsets[records[offsets] == _MESSAGE]
    # The head of a message is longer than that of a record, and may exceed the chunk.
    offsets = marked[marked <= len(records) - HEAD]
    _, size, channel_of = _heads(records, offsets)
    sound = size >= 0
    if bad := len(marked) - int(np.count_nonzero(sound)):
        lose(f'{part.name} holds {bad} records that are too short for a message.')
    offsets += part.start + HEAD
    placed = {}
    for channel in np.unique(channel_of[sound]).tolist():
        mine = sound & (channel_of == channel)
        placed[channel] = _placed(buffer, offsets[mine], size[mine])
    return placed


def _joined(several: Sequence[dict[int, ChannelMessages]]) -> dict[int, ChannelMessages]:
    """Concatenate the messages of chunks."""
    joined = {}
    for channel in dict.fromkeys(channel for placed in several for channel in placed):
        mine = [placed[channel] for placed in several if channel in placed]
        offset = np.concatenate([one.offset for one in mine])
        size = np.concatenate([one.size for one in mine])
        joined[channel] = ChannelMessages(offset, size, mine[0].log_ns)
    return joined


def _heads(buffer: Bytes, offsets: Indices) -> tuple[Bytes, Indices, np.ndarray[Any, Any]]:
    """Return opcodes of records, sizes of their messages, and channels, (n,) each.

    A size is negative if a record is too short for a message.
    """
    width = RECORD_HEAD + 2
    if len(offsets) == 0:
        return np.empty(0, np.uint8), np.empty(0, np.int64), np.empty(0, np.uint16)
    anywhere = np.ndarray((len(buffer) - width + 1,), f'V{width}', buffer, 0, (1,))
    # Plain views: structured ones cost more interpreter time than the fields are worth.
    gathered, shape, step = anywhere[offsets], (len(offsets),), (width,)
    length = np.ndarray(shape, '<i8', gathered, 1, step)
    channel = np.ndarray(shape, '<u2', gathered, RECORD_HEAD, step)
    return np.ndarray(shape, np.uint8, gathered, 0, step), length - MESSAGE_HEAD, channel


def _placed(buffer: Bytes, offset: Indices, size: Indices) -> ChannelMessages:
    (first,) = struct.unpack_from('<Q', buffer.data, int(offset[0]) - 16)
    return ChannelMessages(offset, size, int(first))


def log_at(buffer: Bytes, offset: Indices) -> Stamps:
    """Read log times, the eight bytes before the last eight before each message."""
    anywhere: np.ndarray[Any, np.dtype[np.int64]] = np.ndarray(
        (len(buffer) - 7,), '<i8', buffer, 0, (1,)
    )
    return anywhere[offset - 16].astype(np.int64)


def times_at(buffer: Bytes, offset: Indices) -> Times:
    """Read channel, sequence, log and publish times, the fields before each message."""
    kind = [('channel', '<u2'), ('sequence', '<u4'), ('log', '<i8'), ('publish', '<i8')]
    anywhere = np.ndarray((len(buffer) - MESSAGE_HEAD + 1,), kind, buffer, 0, (1,))
    heads = anywhere[offset - MESSAGE_HEAD]
    return Times(
        *(heads[name].astype(np.int64) for name in ('log', 'publish', 'channel', 'sequence'))
    )
