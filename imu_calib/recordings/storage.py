"""Common parts of the two storage formats: topics, batches of messages, losses."""

from __future__ import annotations

import threading
import weakref
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..common.errors import InputError
from ..common.stream import Block, SetpointBlock, Stamps
from .cdr import Bytes, Indices, Messages
from .cdr_codec import part
from .remote import AnyPath


class RecordingError(InputError):
    """A recording, or a file of it, cannot be read."""


def refuse_existing(path: Path) -> None:
    """Refuse to write where something is: nobody can make a recording again."""
    if path.exists():
        raise RecordingError(f'{path} exists already; recordings are not overwritten.')


@dataclass(frozen=True)
class Described:
    """A recorder's description of a topic beyond its name and type; empty if not recorded."""

    #: Text of the message definition; bytes that are none are surrogates of Python.
    definition: str = ''
    language: str = ''  #: Of that text: ros2msg or ros2idl, or another recorder's.
    profiles: str = ''  #: Offered QoS as YAML.
    #: All that a channel of mcap states, by its keys; None in other files.
    metadata: tuple[tuple[str, str], ...] | None = field(default=None, compare=False)


@dataclass(frozen=True)
class Times:
    """Log and publish times of messages, (n,) ns each."""

    log: Stamps  #: Of each arrival.
    publish: Stamps  #: Of each publication.
    channel: Stamps | None = None  #: (n,) channel of each message; None where a topic has one.
    #: (n,) numbers that the publishers gave; None where not recorded.
    sequence: Stamps | None = None

    def select(self, rows: Indices | NDArray[np.bool_]) -> Times:
        """Return those of some of the messages."""
        channel, sequence = (None if v is None else v[rows] for v in (self.channel, self.sequence))
        return Times(self.log[rows], self.publish[rows], channel, sequence)


@dataclass(frozen=True)
class Topic:
    """A topic of a recording."""

    name: str  #: Full name.
    type: str  #: Message type, for instance sensor_msgs/msg/Imu.
    count: int | None  #: Messages in the recording; None if known only after reading it.
    encoding: str = 'cdr'  #: How messages are serialised.
    #: The recorder's description of the topic, for copying.
    described: Described = field(default_factory=Described, compare=False)
    #: The same of each channel of a file of mcap, with its id there.
    channels: tuple[tuple[int, Topic], ...] = field(default=(), compare=False)

    @property
    def message_type(self) -> str:
        """Message type by its name in ROS 2; some recorders write CDR under that of ROS 1."""
        package, slash, name = self.type.partition('/')
        short = self.encoding == 'cdr' and slash and '/' not in name
        return f'{package}/msg/{name}' if short else self.type

    def merged(self, other: Topic) -> Topic:
        """Return the union with the same topic of another file or publisher."""
        unknown = self.count is None or other.count is None
        return Topic(
            name=self.name,
            type=' and '.join(sorted({*self.type.split(' and '), other.type})),
            count=None if unknown else (self.count or 0) + (other.count or 0),
            encoding=' and '.join(sorted({*self.encoding.split(' and '), other.encoding})),
            described=self.described if self.described.definition else other.described,
            channels=self.channels + other.channels,
        )


@dataclass(frozen=True, eq=False)
class MessageBatch:
    """Messages of one topic that were loaded together."""

    messages: Messages  #: The serialised messages.
    log: Stamps  #: (n,) their log times, ns.
    log_ns: int  #: Log time of the first message, or of one shortly before.
    position: int  #: Bytes of the storage file before the end of the batch.
    times: Callable[[], Times]  #: Returns log and publish times of the messages.


UNSORTED = 'its messages do not lie in the order of their log times and are sorted'


class Losses:
    """Sentences on unreadable data, each once."""

    def __init__(self) -> None:
        self.sentences: list[str] = []
        self.unfinished = ''  #: That a recorder did not finish; empty if all did.

    def add_loss(self, sentence: str) -> None:
        """State a loss; one that two topics encounter counts once."""
        if sentence not in self.sentences:
            self.sentences.append(sentence)

    def add_order(self, name: str) -> None:
        """State that a file holds messages in another order than that of their log times."""
        self.add_loss(f'{name}: {UNSORTED}.')


class Sized(Protocol):
    """An object with a known size in memory."""

    @property
    def nbytes(self) -> int:
        """Bytes of memory."""


Content = TypeVar('Content', bound=Sized)


class Cache:
    """Chunks that some topics still have to read, within a limit of memory.

    The cursors of all topics share it, so that a normally interleaved file is read and decompressed
    once. Chunks are released when all have read them: the next one uses the same memory.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._held: OrderedDict[Hashable, tuple[Sized, int]] = OrderedDict()
        self._bytes = 0

    def get(self, key: Hashable, load: Callable[[], Content], users: int) -> Content:
        """Return the content of a key, expected to be requested by `users`; load it if not held."""
        if key in self._held:
            content, remaining = self._held.pop(key)
            self._bytes -= content.nbytes
        else:
            content, remaining = load(), users
        if remaining > 1:
            self._held[key] = content, remaining - 1
            self._bytes += content.nbytes
        while self._bytes > self._limit and len(self._held) > 1:
            _, (old, _) = self._held.popitem(last=False)
            self._bytes -= old.nbytes
        return content  # type: ignore[return-value]


class Memory:
    """Lend blocks of memory, and reuse them when no reference to their content is left.

    The system clears every page of a new block, which takes longer than reading a file into it.
    """

    def __init__(self) -> None:
        self._free: list[Bytes] = []
        self._lock = threading.Lock()

    def allocate(self, size: int) -> Bytes:
        """Return (size,) bytes of undefined content."""
        with self._lock:
            while self._free and len(self._free[-1]) < size:
                self._free.pop()
            block = self._free.pop() if self._free else None
        if block is None:
            # Parts of a file differ a little in length.
            block = np.empty(size + size // 8, np.uint8)
        # A slice of it refers to it, and it refers to the block.
        lent = np.frombuffer(block.data[:size], np.uint8)
        weakref.finalize(lent, self._free.append, block)
        return lent


class Storage(Protocol):
    """One storage file of a recording."""

    @property
    def path(self) -> AnyPath:
        """The file."""

    size: int
    start_ns: int | None
    end_ns: int | None

    @property
    def custom_data(self) -> Mapping[str, str]:
        """The recorder's entries in the file."""

    @property
    def topics(self) -> Mapping[str, Topic]:
        """Topics by name."""

    @property
    def metadata(self) -> Sequence[tuple[str, Mapping[str, str]]]:
        """The metadata records of mcap: name and content."""

    def attachments(self) -> Iterator[bytes]:
        """Read the attachment records of mcap, one after the other."""

    def cursors(self, topics: frozenset[str], cache: Cache, /) -> dict[str, Iterator[MessageBatch]]:
        """Start reading: one iterator per topic, all independent of each other."""


def seconds(start_ns: int, end_ns: int) -> str:
    """Format a range of log time for a message."""
    return f'log time {start_ns / 1e9:.3f} s to {end_ns / 1e9:.3f} s'


def first_and_last(times: list[tuple[int, int]]) -> tuple[int | None, int | None]:
    """Return the earliest start and the latest end of time ranges."""
    if not times:
        return None, None
    return min(t[0] for t in times), max(t[1] for t in times)


# Merge blocks of several topics in step, independent of their order in the file.
#
# Within a topic the order of the file is kept. No topic is ahead of the others by more than a
# bounded time, so that a reader that pairs them needs little memory.


SPAN_NS = 5_000_000_000
"""ns by which a topic may be out of order against another and is still put in order."""


@dataclass(frozen=True, eq=False)
class Piece:
    """A block to be merged."""

    block: Block  #: The samples.
    log_ns: int  #: Log time of the message that the block starts with, or of one shortly before.
    position: int  #: Bytes of the recording before the end of the piece.


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

    def split_head(self, limit: int | None) -> Block:
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
    """Merge the non-empty pieces of several topics, each topic in its own order.

    Yield topic, block, and the number of bytes of the recording done.
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
        yield queues[0].topic, queues[0].split_head(limit), done
        if not queues[0].advance():
            del queues[0]


def _stamps(block: Block) -> Stamps:
    if isinstance(block, SetpointBlock):
        return np.fromiter((s.stamp for s in block.setpoints), np.int64, len(block))
    return block.stamp
