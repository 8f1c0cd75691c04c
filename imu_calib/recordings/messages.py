"""Serialised messages in one buffer, and the count of malformed ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..common.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

Bytes: TypeAlias = NDArray[np.uint8]
Indices: TypeAlias = NDArray[np.int64]


class CdrError(InputError):
    """A serialised message contradicts its type."""


@dataclass(frozen=True, eq=False)
class Messages:
    """Serialised messages of one topic at any offsets in one buffer.

    Attributes:
        buffer: (bytes,) memory that holds the messages, and possibly more.
        offset: (n,) start of each message, at its 4-byte encapsulation header.
        size: (n,) bytes of each message, encapsulation header included.
    """

    buffer: Bytes
    offset: Indices
    size: Indices

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
        """Copy messages that are scattered in memory into one buffer.

        Returns:
            The messages, in the same order.
        """
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
        """Gather the first bytes of every message.

        Args:
            size: Bytes to take; no message may be shorter.

        Returns:
            (n, size) bytes, contiguous; the buffer's own if the messages adjoin.
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
        """Copy the same bytes of every message; no message may be shorter.

        Args:
            start: First byte, counted from the start of a message.
            size: Bytes to take.

        Returns:
            (n, size) bytes in new memory.
        """
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
    """Count of the messages that a decoder skipped, and what was wrong with the first.

    Attributes:
        count: Messages skipped so far.
        reason: What was wrong with the first of them.
    """

    count: int = 0
    reason: str = ''

    def add(self, reason: str) -> None:
        """Count one more message."""
        self.count += 1
        self.reason = self.reason or reason
