"""Topics within one process: messages are handed on in memory, without DDS.

The endpoints have the methods of those in `wire`. A message that is not asked for as bytes is not
serialised: its subscriptions receive the published object, which nobody may change afterwards.
"""

from __future__ import annotations

import itertools
import threading
from collections import deque
from typing import TYPE_CHECKING, Any

from ....common.errors import ImuCalibError
from .message_types import Message, deserialize_message, serialize_message
from .qos import (
    DurabilityPolicy,
    HistoryPolicy,
    QoSIncompatibleInfo,
    QoSPolicyKind,
    QoSProfile,
    ReliabilityPolicy,
    TopicEndpointInfo,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence


class Participant:
    """All topics of the process."""

    def __init__(self) -> None:
        self.readers: dict[str, list[Reader]] = {}
        self.writers: dict[str, list[Writer]] = {}
        self.changes = 0
        self.arrived = threading.Event()
        self._numbers = itertools.count(1)
        self._lock = threading.Lock()
        self._has_left = False

    def ok(self) -> bool:
        """Return whether it has not left."""
        return not self._has_left

    def reader(
        self, topic: str, type_name: str, qos: QoSProfile, user_data: str = '', prefix: str = ''
    ) -> Reader:
        """Create a reader; it receives what latched writers have sent before."""
        reader = Reader(self, topic, f'{type_name} {prefix}', qos, user_data)
        self._enter(reader, self.readers)
        for writer in self.writers.get(topic, ()):
            if reader.is_latched and writer.sends_to(reader):
                reader.receive(writer, writer.sent)
        return reader

    def writer(
        self, topic: str, type_name: str, qos: QoSProfile, user_data: str = '', prefix: str = ''
    ) -> Writer:
        """Create a writer."""
        writer = Writer(self, topic, f'{type_name} {prefix}', qos, user_data)
        self._enter(writer, self.writers)
        return writer

    def wait_set(self, readers: Sequence[Reader]) -> WaitSet:
        """Create what waits for messages of readers."""
        return WaitSet(self, readers)

    def leave(self) -> None:
        """Forget all endpoints."""
        self._has_left = True
        self.readers.clear()
        self.writers.clear()
        self.arrived.set()

    def number(self) -> int:
        """Return a number that no other endpoint has."""
        return next(self._numbers)

    def remove(self, end: Any, among: dict[str, list[Any]]) -> None:
        """Remove an endpoint."""
        with self._lock:
            ends = among.get(end.name, [])
            if end in ends:
                among[end.name] = [one for one in ends if one is not end]
            self.changes += 1

    def _enter(self, end: Any, among: dict[str, list[Any]]) -> None:
        with self._lock:
            # A new list: another thread may be sending to the former one.
            among[end.name] = [*among.get(end.name, ()), end]
            self.changes += 1


class _End:
    """Common part of readers and writers."""

    def __init__(
        self, participant: Participant, topic: str, kind: str, qos: QoSProfile, user_data: str
    ) -> None:
        self.participant = participant
        self.name = topic
        self.kind = kind
        self.qos = qos
        self.user_data = user_data.encode()
        # As on the wire the first twelve bytes are the participant's: there is one.
        self.gid = participant.number().to_bytes(16, 'big')
        self._known: Sequence[Any] = ()
        self._mismatches = 0

    @property
    def is_latched(self) -> bool:
        """Whether earlier messages matter."""
        return self.qos.durability == DurabilityPolicy.TRANSIENT_LOCAL

    def incompatible(self) -> QoSIncompatibleInfo | None:
        """Return mismatches since the last call, None without any."""
        known, self._known = self._known, self._others()
        new = [one for one in self._known if one not in known and one.kind == self.kind]
        policies = [policy for one in new if (policy := self._mismatch(one))]
        if not policies:
            return None
        self._mismatches += len(policies)
        return QoSIncompatibleInfo(self._mismatches, len(policies), int(policies[-1]))

    def _others(self) -> Sequence[Any]:
        raise NotImplementedError

    def _mismatch(self, other: Any) -> QoSPolicyKind | None:
        raise NotImplementedError

    def matched(self) -> int:
        """Return the number of matching ends."""
        return sum(self.kind == one.kind and not self._mismatch(one) for one in self._others())


class Writer(_End):
    """Hands messages to the readers of its topic."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        keeps_all = self.qos.history == HistoryPolicy.KEEP_ALL
        self.sent: deque[Any] = deque(maxlen=None if keeps_all else self.qos.depth)
        self._matched: tuple[int, list[Reader]] = (-1, [])

    def mismatch(self, reader: Reader) -> QoSPolicyKind | None:
        """Return the policy of which a reader requests more than is offered; None if none."""
        best_effort = self.qos.reliability == ReliabilityPolicy.BEST_EFFORT
        if best_effort and reader.qos.reliability == ReliabilityPolicy.RELIABLE:
            return QoSPolicyKind.RELIABILITY
        return QoSPolicyKind.DURABILITY if reader.is_latched and not self.is_latched else None

    def sends_to(self, reader: Reader) -> bool:
        """Return whether a reader of the topic receives what is written."""
        return self.kind == reader.kind and not self.mismatch(reader)

    def write(self, payload: bytes) -> None:
        """Hand on one serialised message."""
        self._hand_on([payload])

    def write_all(self, payloads: Iterable[bytes]) -> None:
        """Hand on serialised messages."""
        self._hand_on(list(payloads))

    def write_message(self, message: Message) -> None:
        """Hand on a message as it is.

        Raises:
            TypeError: A list in it holds an element of another type.
        """
        if reason := message.invalid_field():
            raise TypeError(reason)
        self._hand_on([message])

    def acknowledged(self, timeout_ns: int) -> bool:  # noqa: ARG002 (as of wire)
        """Return True: what is sent has arrived."""
        return True

    def user_data_of_readers(self) -> list[bytes]:
        """Return the user data of all matching readers."""
        return [reader.user_data for reader in self._readers()]

    def delete(self) -> None:
        """Leave the topic."""
        self.participant.remove(self, self.participant.writers)

    def _hand_on(self, messages: list[Any]) -> None:
        if not self.participant.ok():
            raise ImuCalibError(f'{self.name}: nothing can be sent: the context is shut down.')
        if self.is_latched:
            self.sent.extend(messages)
        readers = self._readers()
        for reader in readers:
            reader.receive(self, messages)
        if readers:
            self.participant.arrived.set()

    def _readers(self) -> list[Reader]:
        changes = self.participant.changes
        if self._matched[0] != changes:
            self._matched = changes, [one for one in self._others() if self.sends_to(one)]
        return self._matched[1]

    def _others(self) -> list[Reader]:
        return self.participant.readers.get(self.name, [])

    def _mismatch(self, other: Reader) -> QoSPolicyKind | None:
        return self.mismatch(other)


class Reader(_End):
    """Holds what has been sent until it is taken."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        keeps_all = self.qos.history == HistoryPolicy.KEEP_ALL
        self.waiting: deque[tuple[Writer, Any]] = deque(
            maxlen=None if keeps_all else self.qos.depth
        )

    def receive(self, writer: Writer, messages: Iterable[Any]) -> None:
        """Take messages from a writer."""
        self.waiting.extend([(writer, message) for message in messages])

    def drain(self, most: int | None = None) -> list[bytes]:
        """Return all arrived messages, serialised, or at most `most` of the oldest."""
        return [_bytes(message) for _, message in self._pop_messages(most)]

    def read(self, most: int, message_type: type[Message]) -> Iterator[Message]:
        """Yield at most `most` of the oldest messages."""
        for _, message in self._pop_messages(most):
            bare = not isinstance(message, Message)
            yield deserialize_message(message, message_type) if bare else message

    def drain_sources(self, most: int | None = None) -> list[tuple[bytes, bytes]]:
        """Return the oldest arrived messages, serialised, each with the number of its writer."""
        return [(_bytes(message), writer.gid) for writer, message in self._pop_messages(most)]

    def user_data_of(self, source: bytes) -> bytes | None:
        """Return the user data of a writer, None if it has left; see `drain_sources`."""
        found = [one for one in self._others() if one.gid == source]
        return found[0].user_data if found else None

    def delete(self) -> None:
        """Leave the topic."""
        self.participant.remove(self, self.participant.readers)

    def _pop_messages(self, most: int | None) -> list[tuple[Writer, Any]]:
        waiting = self.waiting
        count = len(waiting) if most is None else min(most, len(waiting))
        return [waiting.popleft() for _ in range(count)]

    def _others(self) -> list[Writer]:
        return self.participant.writers.get(self.name, [])

    def _mismatch(self, other: Writer) -> QoSPolicyKind | None:
        return other.mismatch(self)


def _bytes(message: Any) -> bytes:
    return serialize_message(message) if isinstance(message, Message) else message


class WaitSet:
    """Waits until any of some readers has messages, and returns which."""

    def __init__(self, participant: Participant, readers: Sequence[Reader]) -> None:
        self._arrived = participant.arrived
        self._readers = readers

    def wait(self, nanoseconds: int) -> list[int]:
        """Return which readers have messages, as ascending indices."""
        found = self._found()
        if not found and nanoseconds > 0:
            self._arrived.clear()
            # What came before it was cleared is here already.
            found = self._found()
            if not found and self._arrived.wait(nanoseconds * 1e-9):
                found = self._found()
        return found

    def delete(self) -> None:
        """Wait no more."""

    def _found(self) -> list[int]:
        return [k for k, reader in enumerate(self._readers) if reader.waiting]


class Graph:
    """The ROS graph within the process: with the methods of `context.Graph`."""

    def __init__(self, participant: Participant) -> None:
        self._participant = participant
        self._nodes: list[Any] = []
        self._listed: dict[str, list[TopicEndpointInfo]] = {}
        self._listed_at = -1

    def announce(self, own: Iterable[Any]) -> None:
        """Note the nodes."""
        self._nodes = list(own)
        self._listed_at = -1

    def nodes(self) -> list[tuple[str, str]]:
        """Return (name, namespace) of every node."""
        return [(node.get_name(), node.get_namespace()) for node in self._nodes]

    def writers(self, topic: str) -> list[TopicEndpointInfo]:
        """Return the writers of a topic."""
        if self._participant.changes != self._listed_at:
            self._listed_at = self._participant.changes
            self._listed.clear()
        if topic not in self._listed:
            self._listed[topic] = [
                TopicEndpointInfo(
                    node.get_name(),
                    node.get_namespace(),
                    writer.kind.partition(' ')[0],
                    list(writer.gid),
                    writer.qos,
                )
                for node in self._nodes
                for writer in node.writers()
                if writer.name == topic
            ]
        return list(self._listed[topic])

    def count_writers(self, topic: str) -> int:
        """Return the number of writers of a topic."""
        return len(self._participant.writers.get(topic, ()))

    def count_readers(self, topic: str) -> int:
        """Return the number of readers of a topic."""
        return len(self._participant.readers.get(topic, ()))

    def close(self) -> None:
        """Forget the nodes."""
        self._nodes = []
