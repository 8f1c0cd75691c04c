"""Write one mcap file, chunk by chunk."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from .cdr import Indices, Messages
from .mcap_records import MAGIC, MESSAGE_HEAD, RECORD_HEAD, Fields, Op, record, string, strings

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
