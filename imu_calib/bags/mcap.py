"""Reads mcap storage files chunk by chunk."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from imu_calib.cdr import Messages

from .codec import CodecError, decompressor
from .mcap_records import MESSAGE_HEAD, RECORD_HEAD, Op, RecordError, walk
from .mcap_scan import Chunk, scan
from .metadata import custom_data_of
from .storage import (
    Cache,
    Losses,
    Stretch,
    Topic,
    first_and_last,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path
    from typing import BinaryIO

    from imu_calib.cdr.messages import Bytes, Indices

_HEAD = RECORD_HEAD + MESSAGE_HEAD


@dataclass(frozen=True, eq=False)
class Unpacked:
    """A chunk in memory, with its messages in the order of the file.

    Attributes:
        buffer: Unpacked bytes.
        channel: (n,) channel id of each message.
        offset: (n,) where each serialised message starts in the buffer.
        size: (n,) bytes of each.
        log_time: (n,) when each was recorded, ns.

    """

    buffer: Bytes
    channel: Indices
    offset: Indices
    size: Indices
    log_time: Indices

    @property
    def nbytes(self) -> int:
        """Bytes of memory."""
        return int(self.buffer.nbytes + 4 * self.offset.nbytes)

    def messages(self, channels: frozenset[int]) -> tuple[Messages, Indices]:
        """Return the messages of some channels, and their log times."""
        mine = (
            np.isin(self.channel, list(channels))
            if len(channels) != 1
            else (self.channel == next(iter(channels)))
        )
        if mine.all():
            return Messages(self.buffer, self.offset, self.size), self.log_time
        return Messages(self.buffer, self.offset[mine], self.size[mine]), self.log_time[mine]


class McapStorage:
    """One mcap file.

    Args:
        path: The file.
        losses: Takes sentences about what cannot be read.

    Raises:
        RecordingError: This is no mcap file.
        OSError: The file cannot be read.

    """

    def __init__(self, path: Path, losses: Losses) -> None:
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
            topic = Topic(channel.topic, channel.type, count, channel.encoding)
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

    def cursors(self, topics: frozenset[str], cache: Cache) -> dict[str, Iterator[Stretch]]:
        """Start reading: one iterator per topic, all independent of each other."""
        return {topic: self._read(topic, cache) for topic in topics}

    def _read(self, topic: str, cache: Cache) -> Iterator[Stretch]:
        channels = frozenset(c.id for c in self._catalogue.channels.values() if c.topic == topic)
        if not channels:
            return
        for chunk in self._chunks:
            if chunk.counts is not None and channels.isdisjoint(chunk.counts):
                continue
            unpacked = cache.get((self.path, chunk.start), partial(self._load, chunk))
            messages, log_time = unpacked.messages(channels)
            if len(messages):
                yield Stretch(messages, log_time, chunk.end)

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
        """Look for channels in the chunks that hold messages of channels nobody has described.

        A file without summary describes its channels within the chunks alone.
        """
        known = self._catalogue.channels
        complete = bool(known) and self._catalogue.counts is not None
        for chunk in self._chunks:
            if complete if chunk.counts is None else known.keys() >= chunk.counts.keys():
                continue
            with self.path.open('rb') as file:
                buffer = self._unpack(chunk, file)
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

    def _load(self, chunk: Chunk) -> Unpacked:
        """Bring a chunk into memory and find its messages."""
        with self.path.open('rb') as file:
            buffer = self._unpack(chunk, file)
            if buffer is None:
                return _messages(np.empty(0, np.uint8), np.empty(0, np.int64))
            unpacked = self._indexed(chunk, buffer, file)
        if unpacked is not None:
            return unpacked
        offsets, end = walk(buffer)
        if end < len(buffer) and not chunk.cut:
            self._losses.add(
                f'{self.path.name}: {chunk} holds no valid record at its byte {end}; '
                f'its other {len(buffer) - end} bytes are left out.'
            )
        offsets = offsets[buffer[offsets] == Op.MESSAGE]
        unpacked = _messages(buffer, offsets)
        if len(unpacked.offset) < len(offsets):
            bad = len(offsets) - len(unpacked.offset)
            self._losses.add(f'{self.path.name}: {chunk} holds {bad} messages too short to be any.')
        return unpacked

    def _unpack(self, chunk: Chunk, file: BinaryIO) -> Bytes | None:
        """Return the bytes of a chunk; None, and a stated loss, where they are not sound."""
        file.seek(chunk.data)
        stored = file.read(chunk.stored)
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
        if chunk.crc and zlib.crc32(content) != chunk.crc:
            self._lose(chunk, 'is corrupt (its CRC does not match)')
            return None
        return np.frombuffer(content, np.uint8)

    def _unpack_cut(self, chunk: Chunk, stored: bytes) -> Bytes | None:
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

    def _indexed(self, chunk: Chunk, buffer: Bytes, file: BinaryIO) -> Unpacked | None:
        """Find the messages by the message index; None where it is missing or wrong."""
        if not chunk.index:
            return None
        entries = []
        for position, count in chunk.index.values():
            file.seek(position)
            entries.append(np.frombuffer(file.read(16 * count), '<u8').reshape(-1, 2))
        channels = np.repeat(list(chunk.index), [len(e) for e in entries])
        table = np.concatenate(entries).astype(np.int64)
        offsets = table[:, 1]
        if len(entries) > 1 or (np.diff(offsets) <= 0).any():
            order = np.argsort(offsets, kind='stable')
            offsets, channels = offsets[order], channels[order]
        if len(offsets) == 0 or offsets[0] < 0 or offsets[-1] + _HEAD > len(buffer):
            return None
        unpacked = _messages(buffer, offsets)
        sound = (
            (buffer[offsets] == Op.MESSAGE).all()
            and (unpacked.channel == channels).all()
            and self._complete(buffer, offsets, unpacked)
        )
        return unpacked if sound else None

    def _complete(self, buffer: Bytes, offsets: Indices, unpacked: Unpacked) -> bool:
        """Tell whether only records that are no messages lie between the indexed ones."""
        starts = np.append(offsets, len(buffer))
        ends = np.concatenate([[0], unpacked.offset + unpacked.size])
        if len(offsets) != len(unpacked.offset):
            return False
        for gap in np.flatnonzero(starts != ends).tolist():
            between = buffer[int(ends[gap]) : int(starts[gap])]
            records, end = walk(between)
            if end != len(between) or (between[records] == Op.MESSAGE).any():
                return False
        return True


def _messages(buffer: Bytes, offsets: Indices) -> Unpacked:
    """Read the heads of message records; those that contradict the format are left out."""
    head = np.dtype(
        {
            'names': ['length', 'channel', 'log_time'],
            'formats': ['<u8', '<u2', '<u8'],
            'offsets': [1, RECORD_HEAD, RECORD_HEAD + 6],
            'itemsize': _HEAD,
        }
    )
    if len(offsets) == 0:
        none = np.empty(0, np.int64)
        return Unpacked(buffer, none, none, none, none)
    offsets = offsets[offsets + _HEAD <= len(buffer)]
    anywhere = np.ndarray((len(buffer) - _HEAD + 1,), f'V{_HEAD}', buffer, 0, (1,))
    heads = anywhere[offsets].view(head)
    size = heads['length'].astype(np.int64) - MESSAGE_HEAD
    sound = (size >= 0) & (size <= len(buffer) - _HEAD - offsets)
    if not sound.all():
        offsets, size, heads = offsets[sound], size[sound], heads[sound]
    return Unpacked(
        buffer=buffer,
        channel=heads['channel'].astype(np.int64),
        offset=offsets + _HEAD,
        size=size,
        log_time=heads['log_time'].astype(np.int64),
    )
