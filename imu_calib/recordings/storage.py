"""Common parts of the two storage formats: topics, batches of messages, losses."""

from __future__ import annotations

import threading
import weakref
from collections import OrderedDict
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol, TypeVar

import numpy as np

from ..common.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from ..common.stream import Stamps
    from .messages import Bytes, Indices, Messages
    from .remote import AnyPath


class RecordingError(InputError):
    """A recording, or a file of it, cannot be read."""


@dataclass(frozen=True)
class Described:
    """A recorder's description of a topic beyond its name and type; empty if not recorded.

    Attributes:
        definition: Text of the message definition; bytes that are none are surrogates of Python.
        language: Of that text: ros2msg or ros2idl, or another recorder's.
        profiles: Offered QoS as YAML.
        metadata: All that a channel of mcap states, by its keys; None in other files.
    """

    definition: str = ''
    language: str = ''
    profiles: str = ''
    metadata: tuple[tuple[str, str], ...] | None = field(default=None, compare=False)


@dataclass(frozen=True)
class Times:
    """Log and publish times of messages, (n,) ns each.

    Attributes:
        log: Of each arrival.
        publish: Of each publication.
        channel: (n,) channel of each message; None where a topic has one.
        sequence: (n,) numbers that the publishers gave; None where not recorded.
    """

    log: Stamps
    publish: Stamps
    channel: Stamps | None = None
    sequence: Stamps | None = None

    def select(self, rows: Indices | NDArray[np.bool_]) -> Times:
        """Return those of some of the messages."""
        channel, sequence = (None if v is None else v[rows] for v in (self.channel, self.sequence))
        return Times(self.log[rows], self.publish[rows], channel, sequence)


@dataclass(frozen=True)
class Topic:
    """A topic of a recording.

    Attributes:
        name: Full name.
        type: Message type, for instance sensor_msgs/msg/Imu.
        count: Messages in the recording; None if known only after reading it.
        encoding: How messages are serialised.
        described: The recorder's description of the topic, for copying.
        channels: The same of each channel of a file of mcap, with its id there.
    """

    name: str
    type: str
    count: int | None
    encoding: str = 'cdr'
    described: Described = field(default_factory=Described, compare=False)
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
    """Messages of one topic that were loaded together.

    Attributes:
        messages: The serialised messages.
        log: (n,) their log times, ns.
        log_ns: Log time of the first message, or of one shortly before.
        position: Bytes of the storage file before the end of the batch.
        times: Returns log and publish times of the messages.
    """

    messages: Messages
    log: Stamps
    log_ns: int
    position: int
    times: Callable[[], Times]


class Losses:
    """Sentences on unreadable data, each once."""

    def __init__(self) -> None:
        self.sentences: list[str] = []

    def add(self, sentence: str) -> None:
        """State a loss; one that two topics encounter counts once."""
        if sentence not in self.sentences:
            self.sentences.append(sentence)

    def add_order(self, name: str) -> None:
        """State that a file holds messages in another order than that of their log times."""
        self.add(
            f'{name}: its messages do not lie in the order of their log times, and are read in '
            'that order.'
        )


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
        """Return the content of a key; load it if it is not held.

        Args:
            key: Name of the content.
            load: Loads it.
            users: Expected total number of requests for it.
        """
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

    def cursors(self, topics: frozenset[str], cache: Cache) -> dict[str, Iterator[MessageBatch]]:
        """Start reading: one iterator per topic, all independent of each other."""


def seconds(start_ns: int, end_ns: int) -> str:
    """Format a range of log time for a message."""
    return f'log time {start_ns / 1e9:.3f} s to {end_ns / 1e9:.3f} s'


def first_and_last(times: list[tuple[int, int]]) -> tuple[int | None, int | None]:
    """Return the earliest start and the latest end of time ranges."""
    if not times:
        return None, None
    return min(t[0] for t in times), max(t[1] for t in times)
