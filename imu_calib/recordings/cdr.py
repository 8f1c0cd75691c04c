"""Serialised messages in one buffer, their malformed ones, and offsets of their fields."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..common.errors import InputError
from ..common.stream import NS, Floats, Stamps

Bytes: TypeAlias = NDArray[np.uint8]
Indices: TypeAlias = NDArray[np.int64]


class CdrError(InputError):
    """A serialised message contradicts its type."""


@dataclass(frozen=True, eq=False)
class Messages:
    """Serialised messages of one topic at any offsets in one buffer."""

    buffer: Bytes  #: (bytes,) memory that holds the messages, and possibly more.
    offset: Indices  #: (n,) start of each message, at its 4-byte encapsulation header.
    size: Indices  #: (n,) bytes of each message, encapsulation header included.

    def __post_init__(self) -> None:
        """Refuse messages outside the buffer: the decoders read without further checks."""
        if len(self.offset) == 1:
            start, size = self.offset.item(), self.size.item()
            beyond = start < 0 or size < 0 or start + size > len(self.buffer)
        else:
            beyond = self._any_beyond()
        if beyond:
            raise ValueError(f'Messages reach beyond their buffer of {len(self.buffer)} bytes.')

    def _any_beyond(self) -> bool:
        return len(self.offset) > 0 and bool(
            self.offset.min() < 0
            or self.size.min() < 0
            or (self.offset + self.size).max() > len(self.buffer)
        )

    @classmethod
    def join(cls, payloads: Sequence[bytes]) -> Messages:
        """Copy messages that are scattered in memory into one buffer."""
        size = np.fromiter(map(len, payloads), np.int64, len(payloads))
        buffer = np.frombuffer(b''.join(payloads), np.uint8)
        return cls(buffer, np.cumsum(size) - size, size)

    def __len__(self) -> int:
        return len(self.offset)

    def select(self, index: slice | Indices | NDArray[np.bool_]) -> Messages:
        """Return some of the messages; the buffer is shared."""
        return Messages(self.buffer, self.offset[index], self.size[index])

    def payload(self, index: int) -> bytes:
        """Return a copy of one message's bytes."""
        start = int(self.offset[index])
        return self.buffer[start : start + int(self.size[index])].tobytes()

    def payloads(self) -> list[bytes]:
        """Return a copy of every message's bytes."""
        whole = np.ascontiguousarray(self.buffer).data
        ends = (self.offset + self.size).tolist()
        return [bytes(whole[a:b]) for a, b in zip(self.offset.tolist(), ends, strict=True)]

    def leading_bytes(self, size: int) -> Bytes:
        """Gather the first bytes, (n, size), of every message; none may be shorter.

        They are contiguous, and the buffer's own if the messages adjoin.
        """
        if self._is_matrix(size):
            start = int(self.offset[0])
            return self.buffer[start : start + len(self) * size].reshape(-1, size)
        return self.gather(0, size)

    def _is_matrix(self, size: int) -> bool:
        """Return whether messages of a size adjoin, as `join` places them."""
        if len(self) == 0 or int(self.offset[-1] - self.offset[0]) != (len(self) - 1) * size:
            return False
        return bool((self.offset[1:] - self.offset[:-1] == size).all())

    def gather(self, start: int, size: int) -> Bytes:
        """Copy (n, size) bytes from the same place in every message; none may end before."""
        if len(self) == 0:
            return np.empty((0, size), np.uint8)
        # Every possible position is one element of this overlapping view, so that one indexed copy
        # gathers them all from any positions.
        last = len(self.buffer) - size + 1
        anywhere = np.ndarray((last,), f'V{size}', buffer=self.buffer, strides=(1,))
        gathered: Bytes = anywhere[self.offset + start].view(np.uint8).reshape(-1, size)
        return gathered


@dataclass
class Malformed:
    """Count of the messages that a decoder skipped, and what was wrong with the first."""

    count: int = 0  #: Messages skipped so far.
    reason: str = ''  #: What was wrong with the first of them.

    def count_skipped(self, reason: str) -> None:
        """Count one more message."""
        self.count += 1
        self.reason = self.reason or reason


# Offsets of the fields in a message: found by reading one message, then checked for all others.
#
# CDR (OMG formal/02-06-51) aligns a number to its own size, counted from the byte after the 4-byte
# encapsulation header. Two messages of a type whose strings and sequence lengths agree therefore
# have every field at the same offset, and a run of them is a matrix of bytes.


ENCAPSULATION = 4  #: Bytes of the header that states the byte order (RTPS 2.5, section 10.2).
ORDERS = {b'\x00\x00': '>', b'\x00\x01': '<'}
#: Headers of XCDR2: RTPS 2.5, table 10.3, and the numbers of DDS-XTypes 1.2, section 7.4.3.4.
_XCDR2 = {bytes([0, k]) for k in (*range(0x06, 0x0C), *range(0x10, 0x16))}


@dataclass(frozen=True)
class Layout:
    """Offsets of the fields in messages of one shape."""

    order: str  #: '<' or '>', the byte order.
    size: int  #: Bytes of the whole message.
    #: Offsets and contents of the bytes that define the shape.
    fixed: tuple[tuple[int, bytes], ...]
    stamp: int  #: Offset of the header's stamp.
    columns: dict[str, tuple[int, int]]  #: Offset and number of the float64 of each column.
    names: tuple[str, ...]  #: The strings of the message, in order.

    @cached_property
    def head(self) -> int:
        """Bytes up to the end of the last fixed one or of the stamp."""
        return max(self.stamp + 8, *(start + len(content) for start, content in self.fixed))

    def fits(self, payload: bytes) -> bool:
        """Return whether one message has this layout."""
        return len(payload) == self.size and all(
            payload.startswith(content, start) for start, content in self.fixed
        )

    def holds(self, rows: Bytes) -> np.ndarray[Any, np.dtype[np.bool_]]:
        """Return which messages, (n,), have this layout, by their first bytes, (n, head).

        They must have the right size.
        """
        same = np.ones(len(rows), np.bool_)
        for start, kind, value in self._words:
            same &= np.ndarray((len(rows),), kind, rows, start, (self.head,)) == value
        return same

    @cached_property
    def _words(self) -> list[tuple[int, str, np.unsignedinteger[Any]]]:
        """The fixed bytes as integers, which compare far faster than bytes."""
        words = []
        for start, content in self.fixed:
            width = next(w for w in (8, 4, 2, 1) if w <= len(content))
            # The last word may overlap the one before.
            for at in {*range(0, len(content) - width, width), len(content) - width}:
                kind = f'<u{width}'
                words.append((start + at, kind, np.frombuffer(content, kind, 1, at)[0]))
        return words

    def stamps(self, rows: Bytes) -> Stamps:
        """Return the (n,) header stamps in ns, of the same bytes as `holds`."""
        shape, strides = (len(rows),), (self.head,)
        sec = np.ndarray(shape, f'{self.order}i4', rows, self.stamp, strides)
        nanosec = np.ndarray(shape, f'{self.order}u4', rows, self.stamp + 4, strides)
        stamp: Stamps = sec.astype(np.int64) * NS + nanosec
        return stamp

    def stamp_of(self, payload: bytes) -> Stamps:
        """Return the header stamp of one message, (1,) ns."""
        sec, nanosec = struct.unpack_from(f'{self.order}iI', payload, self.stamp)
        return np.array([sec * NS + nanosec], np.int64)

    def row_of(self, payload: bytes, name: str) -> Floats:
        """Return the numbers of a column of one message, (1, k)."""
        offset, width = self.columns[name]
        return np.array([struct.unpack_from(f'{self.order}{width}d', payload, offset)])

    def column(self, messages: Messages, name: str) -> Floats:
        """Return the (n, k) numbers of a column, in new memory."""
        offset, width = self.columns[name]
        stored = messages.gather(offset, 8 * width).view(f'{self.order}f8')
        return stored.astype(np.float64, copy=False)


class LayoutReader:
    """Read one message from its first byte to its last and record the offsets.

    Raises:
        CdrError: From every method, if the message is too short or contradicts its type.
    """

    def __init__(self, payload: bytes) -> None:
        order = ORDERS.get(payload[:2])
        if len(payload) < ENCAPSULATION or order is None:
            header = payload[:ENCAPSULATION].hex(' ') or 'missing'
            named = ' of XCDR2' if payload[:2] in _XCDR2 else ''
            raise CdrError(
                f'encapsulation header {header}{named}, expected 00 00 or 00 01 (plain CDR)'
            )
        self.order = order
        self._payload = payload
        self._position = ENCAPSULATION
        self._fixed: list[tuple[int, int]] = [(0, 2)]
        self._stamp = 0
        self._columns: dict[str, tuple[int, int]] = {}
        self._names: list[str] = []

    def _advance(self, alignment: int, size: int) -> int:
        start = self._position + (ENCAPSULATION - self._position) % alignment
        if start + size > len(self._payload):
            raise CdrError(
                f'{len(self._payload)} bytes, but a field of {size} bytes starts at {start}'
            )
        self._position = start + size
        return start

    def _keep(self, start: int, end: int) -> None:
        if self._fixed and self._fixed[-1][1] == start:
            start = self._fixed.pop()[0]
        self._fixed.append((start, end))

    def number(self, code: str) -> Any:
        """Read one number that may differ between messages."""
        size = struct.calcsize(code)
        return struct.unpack_from(self.order + code, self._payload, self._advance(size, size))[0]

    def stamp(self) -> int:
        """Read a builtin_interfaces/Time, in ns."""
        self._stamp = self._position
        return int(self.number('i')) * NS + int(self.number('I'))

    def count(self) -> int:
        """Read the length of a sequence; it belongs to the layout."""
        start = self._advance(4, 4)
        self._keep(start, self._position)
        return int(struct.unpack_from(f'{self.order}I', self._payload, start)[0])

    def string(self) -> str:
        """Read a string; it belongs to the layout."""
        length = self.count()
        start = self._advance(1, length)
        self._keep(start, self._position)
        content = self._payload[start : self._position]
        if length and content[-1]:
            raise CdrError('a string does not end with a zero byte')
        try:
            text = content[:-1].decode()
        except UnicodeDecodeError:
            raise CdrError(f'a string is not UTF-8: {content[:40]!r}') from None
        self._names.append(text)
        return text

    def strings(self) -> tuple[str, ...]:
        """Read a sequence of strings; it belongs to the layout."""
        return tuple(self.string() for _ in range(self.count()))

    def column(self, name: str, width: int) -> None:
        """Skip float64 numbers that form the column `name`."""
        start = self._advance(8, 8 * width) if width else self._position
        self._columns[name] = (start, width)

    def sequence(self, name: str) -> int:
        """Skip a float64 sequence that forms the column `name`; return its length."""
        width = self.count()
        self.column(name, width)
        return width

    def floats(self) -> tuple[float, ...]:
        """Read a float64 sequence."""
        width = self.count()
        start = self._advance(8, 8 * width) if width else self._position
        values: tuple[float, ...] = struct.unpack_from(
            f'{self.order}{width}d', self._payload, start
        )
        return values

    def end_layout(self) -> Layout:
        """Return the layout; the message must end here, except for padding.

        Middlewares pad a message up to 4 or 8 bytes; more than that is another type.
        """
        rest = len(self._payload) - self._position
        if rest >= 8:
            raise CdrError(f'{len(self._payload)} bytes, {rest} more than the fields take')
        return self.layout()

    def layout(self) -> Layout:
        """Return the layout of the part read so far."""
        return Layout(
            order=self.order,
            size=len(self._payload),
            fixed=tuple((a, self._payload[a:b]) for a, b in self._fixed),
            stamp=self._stamp,
            columns=self._columns,
            names=tuple(self._names),
        )
