"""Merge blocks of several topics in step, independent of their order in the file.

Within a topic the order of the file is kept. No topic is ahead of the others by more than a bounded
time, so that a reader that pairs them needs little memory.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..common.stream import SetpointBlock
from .decode import part

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from ..common.stream import Block, Stamps

SPAN_NS = 5_000_000_000
"""ns by which a topic may be out of order against another and is still put in order."""


@dataclass(frozen=True, eq=False)
class Piece:
    """A block to be merged.

    Attributes:
        block: The samples.
        log_ns: Log time of the message that the block starts with, or of one shortly before.
        position: Bytes of the recording before the end of the piece.
    """

    block: Block
    log_ns: int
    position: int


@dataclass
class _Queue:
    """The next piece of one topic."""

    topic: str
    rest: Iterator[Piece]
    head: Piece
    stamps: Stamps

    def first(self, by_stamp: bool) -> tuple[int, int]:
        """Return the start time of the head; ties are broken by the position in the file."""
        return int(self.stamps[0]) if by_stamp else self.head.log_ns, self.head.position

    def take(self, limit: int | None) -> Block:
        """Remove samples from the head up to the first one after a limit, at least one."""
        count = len(self.stamps)
        beyond = self.stamps > limit if limit is not None else np.zeros(1, np.bool_)
        if beyond.any():
            count = max(int(beyond.argmax()), 1)
        block = self.head.block
        taken = part(block, 0, count)
        if count < len(self.stamps):
            self.head = Piece(
                part(block, count, len(self.stamps)), self.head.log_ns, self.head.position
            )
            self.stamps = self.stamps[count:]
        else:
            self.stamps = self.stamps[:0]
        return taken

    def advance(self) -> bool:
        """Fetch the next piece if the head is used up; return whether there is one."""
        if len(self.stamps):
            return True
        following = next(self.rest, None)
        if following is None:
            return False
        self.head, self.stamps = following, _stamps(following.block)
        return True


def merge(topics: Iterable[tuple[str, Iterator[Piece]]]) -> Iterator[tuple[str, Block, int]]:
    """Merge the pieces of several topics.

    Args:
        topics: Names and non-empty pieces, each topic in its own order.

    Yields:
        Topic, block, and the number of bytes of the recording done.
    """
    queues = []
    for topic, pieces in topics:
        head = next(pieces, None)
        if head is not None:
            queues.append(_Queue(topic, pieces, head, _stamps(head.block)))
    # Otherwise a stream with stamps of zero would be read to its end first.
    by_stamp = all(int(queue.stamps[0]) != 0 for queue in queues)
    while queues:
        queues.sort(key=lambda queue: queue.first(by_stamp))
        limit = None
        if by_stamp and len(queues) > 1:
            limit = queues[1].first(by_stamp)[0] + SPAN_NS
        done = min(queue.head.position for queue in queues)
        yield queues[0].topic, queues[0].take(limit), done
        if not queues[0].advance():
            del queues[0]


def _stamps(block: Block) -> Stamps:
    if isinstance(block, SetpointBlock):
        return np.fromiter((s.stamp for s in block.setpoints), np.int64, len(block))
    return block.stamp
