"""Files of mcap built byte by byte, as https://mcap.dev/spec says, and where their parts lie."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass, field

from imu_calib.recordings.codec import compressor

MAGIC = b'\x89MCAP0\r\n'
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, INDEX, CHUNK_INDEX = range(1, 9)
STATISTICS, METADATA, METADATA_INDEX, OFFSET, DATA_END = 0x0B, 0x0C, 0x0D, 0x0E, 0x0F
HEAD = 31
"""Bytes of a message record before its data."""


def record(op: int, content: bytes = b'') -> bytes:
    return struct.pack('<BQ', op, len(content)) + content


def block(content: bytes) -> bytes:
    return struct.pack('<I', len(content)) + content


def text(words: str) -> bytes:
    return block(words.encode())


def texts(**pairs: str) -> bytes:
    return block(b''.join(text(key) + text(value) for key, value in pairs.items()))


def schema(key: int, name: str, definition: str = '') -> bytes:
    return record(SCHEMA, struct.pack('<H', key) + text(name) + text('ros2msg') + text(definition))


def channel(key: int, schema: int, topic: str, **metadata: str) -> bytes:
    content = struct.pack('<HH', key, schema) + text(topic) + text('cdr') + texts(**metadata)
    return record(CHANNEL, content)


def message(key: int, log: int, data: bytes = b'', publish: int | None = None) -> bytes:
    times = log, log if publish is None else publish
    return record(MESSAGE, struct.pack('<HIQQ', key, 0, *times) + data)


def metadata(name: str, **pairs: str) -> bytes:
    return record(METADATA, text(name) + texts(**pairs))


def index(key: int, entries: list[tuple[int, int]]) -> bytes:
    content = b''.join(struct.pack('<QQ', *entry) for entry in entries)
    return record(INDEX, struct.pack('<H', key) + block(content))


def chunk(
    content: bytes,
    times: tuple[int, int] = (0, 0),
    size: int | None = None,
    crc: int | None = None,
    compression: str = '',
) -> bytes:
    """Build a chunk; its size and checksum as told, else the true ones."""
    crc = zlib.crc32(content) if crc is None else crc
    head = struct.pack('<QQQI', *times, len(content) if size is None else size, crc)
    stored = compressor(compression)(content)
    return record(CHUNK, head + text(compression) + struct.pack('<Q', len(stored)) + stored)


@dataclass
class Chunked:
    """A file of one schema, two channels and chunks, with or without a summary.

    Attributes:
        content: Bytes so far, the magic first.
        places: Where each chunk record starts and ends, and where its index ends.
    """

    content: bytes = MAGIC + record(HEADER, text('') + text(''))
    places: list[tuple[int, int, int]] = field(default_factory=list)
    entries: list[bytes] = field(default_factory=list)
    counts: dict[int, int] = field(default_factory=dict)
    described: bytes = schema(1, 'a_msgs/msg/A') + channel(1, 1, '/a') + channel(2, 1, '/b')
    compression: str = ''

    def describe(self) -> Chunked:
        self.content += self.described
        return self

    def add(self, *messages: tuple[int, int, bytes], before: bytes = b'') -> Chunked:
        """Add a chunk of messages by channel, time and data, and their index."""
        inside = before
        listed: dict[int, list[tuple[int, int]]] = {}
        for key, log, data in messages:
            listed.setdefault(key, []).append((log, len(inside)))
            inside += message(key, log, data)
        times = [log for _, log, _ in messages]
        return self.add_raw(inside, (min(times), max(times)), listed)

    def add_raw(
        self, inside: bytes, times: tuple[int, int], listed: dict[int, list[tuple[int, int]]]
    ) -> Chunked:
        whole = chunk(inside, times, compression=self.compression)
        start, stored = len(self.content), len(whole) - len(chunk(b'')) - len(self.compression)
        offsets, indexes = b'', b''
        for key, some in listed.items():
            offsets += struct.pack('<HQ', key, start + len(whole) + len(indexes))
            indexes += index(key, some)
            self.counts[key] = self.counts.get(key, 0) + len(some)
        place = struct.pack('<QQQQ', *times, start, len(whole)) + block(offsets)
        place += struct.pack('<Q', len(indexes)) + text(self.compression)
        self.entries.append(record(CHUNK_INDEX, place + struct.pack('<QQ', stored, len(inside))))
        self.content += whole + indexes
        self.places.append((start, start + len(whole), len(self.content)))
        return self

    def summed_up(self, more: bytes = b'') -> bytes:
        """Return the file with a summary, the statistics in it, and a footer."""
        counts = b''.join(struct.pack('<HQ', *pair) for pair in self.counts.items())
        numbers = sum(self.counts.values()), 1, 2, 0, 0, len(self.places), 0, 0
        statistics = record(STATISTICS, struct.pack('<QHIIIIQQ', *numbers) + block(counts))
        data = self.content + record(DATA_END, bytes(4))
        summary = self.described + b''.join(self.entries) + more + statistics
        return data + summary + footer(len(data))


def footer(summary: int) -> bytes:
    return record(FOOTER, struct.pack('<QQI', summary, 0, 0)) + MAGIC
