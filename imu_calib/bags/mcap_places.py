"""Where messages lie in unpacked chunks: by their indexes where these are sound, else by a walk."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from .mcap_records import MESSAGE_HEAD, RECORD_HEAD, Op, walk
from .storage import Times

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from ..cdr.messages import Bytes, Indices

HEAD = RECORD_HEAD + MESSAGE_HEAD
_MESSAGE = int(Op.MESSAGE)
_HEAD_KIND = np.dtype([('op', 'u1'), ('length', '<u8'), ('channel', '<u2')])


@dataclass(frozen=True, eq=False)
class Part:
    """The content of one chunk in a buffer that may hold others beside it.

    Attributes:
        name: What to call the chunk.
        start: Where its records begin.
        end: Where they end.
        tables: Message index: (n, 2) log times and offsets from the start, by channel.

    """

    name: str
    start: int
    end: int
    tables: dict[int, Indices] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Placed:
    """Messages of one channel within a buffer.

    Attributes:
        offset: (n,) where each serialised message starts.
        size: (n,) bytes of each.
        log_ns: Log time of the first.

    """

    offset: Indices
    size: Indices
    log_ns: int


def located(parts: Sequence[Part], buffer: Bytes, lose: Callable[[str], None]) -> dict[int, Placed]:
    """Find the messages of chunks.

    Args:
        parts: The chunks, in the order of the buffer.
        buffer: Holds their records.
        lose: Takes sentences about what is no message.

    Returns:
        Messages by channel, in the order of the buffer.

    """
    placed = indexed(parts, buffer)
    if placed is not None:
        return placed
    if len(parts) != 1:
        return _joined([located([part], buffer, lose) for part in parts])
    return _walked(parts[0], buffer, lose)


def indexed(parts: Sequence[Part], buffer: Bytes) -> dict[int, Placed] | None:
    """Find messages by the indexes alone; arguments as of `located`.

    Returns:
        Messages by channel; None where an index contradicts its chunk or leaves messages out, and
        for several chunks also where each has to be looked at by itself.

    """
    placed = {}
    filled = np.zeros(len(parts), np.int64)
    for channel in dict.fromkeys(channel for part in parts for channel in part.tables):
        holding = [k for k, part in enumerate(parts) if channel in part.tables]
        tables = [parts[k].tables[channel] for k in holding]
        counts = np.array([len(table) for table in tables])
        offsets = np.concatenate(
            [table[:, 1] + parts[k].start for k, table in zip(holding, tables, strict=True)]
        )
        first = 0
        if (offsets[1:] <= offsets[:-1]).any():
            # No order of the entries is prescribed; messages count in the order of the file.
            order = np.argsort(offsets)
            offsets, first = offsets[order], int(order[0])
            if len(parts) > 1 or (offsets[1:] == offsets[:-1]).any():
                return None
        ends = np.cumsum(counts)
        begins = ends - counts
        edges = np.array([(parts[k].start, parts[k].end - HEAD) for k in holding])
        if (offsets[begins] < edges[:, 0]).any() or (offsets[ends - 1] > edges[:, 1]).any():
            return None
        heads = _heads(buffer, offsets)
        if (heads['op'] != _MESSAGE).any() or (heads['channel'] != channel).any():
            return None
        one = _placed(offsets, heads, int(tables[0][first, 0]))
        if (one.size < 0).any():
            return None
        placed[channel] = one
        filled[holding] += np.add.reduceat(one.size, begins) + HEAD * counts
    if (filled == [part.end - part.start for part in parts]).all():
        return placed or None
    return placed if len(parts) == 1 and _is_complete(placed, buffer, parts[0]) else None


def _is_complete(placed: dict[int, Placed], buffer: Bytes, part: Part) -> bool:
    """Tell whether messages and records of other kinds fill a chunk, without overlap."""
    if not placed:
        return False
    starts = np.sort(np.concatenate([p.offset for p in placed.values()])) - HEAD
    ends = np.sort(np.concatenate([p.offset + p.size for p in placed.values()]))
    starts, ends = np.append(starts, part.end), np.concatenate([[part.start], ends])
    for gap in np.flatnonzero(starts != ends).tolist():
        between = buffer[int(ends[gap]) : int(starts[gap])]
        records, end = walk(between)
        if end != len(between) or len(records) == 0 or (between[records] == _MESSAGE).any():
            return False
    return True


def _walked(part: Part, buffer: Bytes, lose: Callable[[str], None]) -> dict[int, Placed]:
    """Find the messages of one chunk by walking over its records."""
    records = buffer[part.start : part.end]
    offsets, end = walk(records)
    if end < len(records):
        lose(
            f'{part.name} holds no valid record at its byte {end}; its other {len(records) - end} '
            'bytes are left out.'
        )
    marked = offsets[records[offsets] == _MESSAGE]
    # The head of a message reaches further than that of a record, perhaps beyond the chunk.
    offsets = marked[marked <= len(records) - HEAD]
    heads = _heads(records, offsets)
    sound = heads['length'] >= MESSAGE_HEAD
    offsets, heads = offsets[sound] + part.start, heads[sound]
    if bad := len(marked) - len(offsets):
        lose(f'{part.name} holds {bad} messages too short to be any.')
    placed = {}
    for channel in np.unique(heads['channel']).tolist():
        mine = heads['channel'] == channel
        (first,) = struct.unpack_from('<Q', buffer.data, int(offsets[mine.argmax()]) + HEAD - 16)
        placed[channel] = _placed(offsets[mine], heads[mine], int(first))
    return placed


def _joined(several: Sequence[dict[int, Placed]]) -> dict[int, Placed]:
    """Put the messages of chunks one after another."""
    joined = {}
    for channel in dict.fromkeys(channel for placed in several for channel in placed):
        mine = [placed[channel] for placed in several if channel in placed]
        offset = np.concatenate([one.offset for one in mine])
        size = np.concatenate([one.size for one in mine])
        joined[channel] = Placed(offset, size, mine[0].log_ns)
    return joined


def _heads(buffer: Bytes, offsets: Indices) -> np.ndarray[Any, Any]:
    """Gather opcode, length and channel of records."""
    if len(buffer) < _HEAD_KIND.itemsize:
        return np.empty(0, _HEAD_KIND)
    last = len(buffer) - _HEAD_KIND.itemsize + 1
    anywhere = np.ndarray((last,), f'V{_HEAD_KIND.itemsize}', buffer, 0, (1,))
    return anywhere[offsets].view(_HEAD_KIND)


def _placed(offsets: Indices, heads: np.ndarray[Any, Any], log_ns: int) -> Placed:
    size = heads['length'].astype(np.int64) - MESSAGE_HEAD
    return Placed(offsets + HEAD, size, log_ns)


def times_at(buffer: Bytes, offset: Indices) -> Times:
    """Read log and publish times, the last two fields before each message."""
    anywhere = np.ndarray((len(buffer) - 15,), 'V16', buffer, 0, (1,))
    pairs = anywhere[offset - 16].view('<i8').reshape(-1, 2)
    return Times(pairs[:, 0].astype(np.int64), pairs[:, 1].astype(np.int64))
