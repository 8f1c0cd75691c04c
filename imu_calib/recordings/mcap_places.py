"""Find the messages in unpacked chunks: by valid indexes, otherwise by walking the records."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from itertools import accumulate
from typing import TYPE_CHECKING, Any

import numpy as np

from .mcap_records import MESSAGE_HEAD, RECORD_HEAD, Op, walk
from .storage import Times

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from ..common.stream import Stamps
    from .messages import Bytes, Indices

HEAD = RECORD_HEAD + MESSAGE_HEAD
_MESSAGE = int(Op.MESSAGE)


@dataclass(frozen=True, eq=False)
class Part:
    """The content of one chunk in a buffer that may hold more.

    Attributes:
        name: Name of the chunk for messages.
        start: Start of its records.
        end: End of its records.
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
        offset: (n,) start of each serialised message.
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
        lose: Receives sentences on invalid records.

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
        Messages by channel; None if an index contradicts its chunk or is incomplete, or if
            several chunks must be examined one by one.
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


def _is_complete(placed: dict[int, Placed], buffer: Bytes, part: Part) -> bool:
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


def _joined(several: Sequence[dict[int, Placed]]) -> dict[int, Placed]:
    """Concatenate the messages of chunks."""
    joined = {}
    for channel in dict.fromkeys(channel for placed in several for channel in placed):
        mine = [placed[channel] for placed in several if channel in placed]
        offset = np.concatenate([one.offset for one in mine])
        size = np.concatenate([one.size for one in mine])
        joined[channel] = Placed(offset, size, mine[0].log_ns)
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


def _placed(buffer: Bytes, offset: Indices, size: Indices) -> Placed:
    (first,) = struct.unpack_from('<Q', buffer.data, int(offset[0]) - 16)
    return Placed(offset, size, int(first))


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
