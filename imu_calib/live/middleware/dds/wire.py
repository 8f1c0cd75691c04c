"""Topics, readers and writers of the cyclonedds wheel on ROS 2's wire, for serialised messages."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from ctypes import CFUNCTYPE, c_bool, c_int32, c_int64, c_size_t, c_ssize_t, c_void_p
from functools import cache
from hashlib import sha256
from importlib.util import cache_from_source
from pathlib import Path
from typing import Any

from rosbags.interfaces import Nodetype

from ....common.errors import ImuCalibError
from ...network import configuration
from .message_types import Message, deserialize_message, interface, serialize_message, type_hash
from .qos import QoSIncompatibleInfo, QoSProfile, to_dds

# The wheel's descriptions of topic types (XTypes), kept beside the bytecode.
#
# The wheel builds them in Python at every start of a process, which takes a sixth of the time of a
# node's start. They depend on the definition and on the wheel alone.


_LENGTH = 4
"""Bytes of the length of the first of the two parts."""


def describe(idl: Any, name: str) -> None:
    """Give a type its description: the kept one, or that of the wheel, which is then kept.

    The name distinguishes it from every other type, and from every other definition of it.
    """
    made = idl.__idl__
    path = _folder() / f'{sha256(f"{_wheel()} {name}".encode()).hexdigest()}.xtypes'
    kept = _read(path)
    if kept is None or not hasattr(made, '_xt_bytedata'):
        made.fill_type_data()
        _write(path, getattr(made, '_xt_bytedata', ()))
        return
    # What is not None is not built again.
    made._xt_data, made._xt_bytedata = kept, kept


def _folder() -> Path:
    return Path(cache_from_source(__file__)).parent


@cache
def _wheel() -> str:
    """Return what changes with the wheel, as of the source of bytecode: size and date."""
    import cyclonedds

    builder = Path(cyclonedds.__path__[0], 'idl', '_xt_builder.py')
    with suppress(OSError):
        found = builder.stat()
        return f'{found.st_size} {found.st_mtime_ns}'
    return ''


def _read(path: Path) -> tuple[bytes, bytes] | None:
    """Return both parts of a kept description; None if it is missing or damaged."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    digest, parts = content[:32], content[32:]
    if sha256(parts).digest() != digest:
        return None
    end = _LENGTH + int.from_bytes(parts[:_LENGTH], 'little')
    return parts[_LENGTH:end], parts[end:]


def _write(path: Path, parts: tuple[bytes, ...]) -> None:
    """Keep a description, as Python keeps bytecode: not if that is not wanted or possible."""
    if sys.dont_write_bytecode or len(parts) != 2:
        return
    content = len(parts[0]).to_bytes(_LENGTH, 'little') + b''.join(parts)
    own = path.with_suffix(f'.{os.getpid()}')
    with suppress(OSError):
        path.parent.mkdir(exist_ok=True)
        own.write_bytes(sha256(content).digest() + content)
        # Whole or not at all: other nodes read it meanwhile.
        own.replace(path)


class TransportError(Exception):
    """Endpoints were deleted, or the participant has left, while waiting for messages."""


def delete(entity: Any) -> None:
    """Delete an entity of the wheel now, without waiting for its last reference to end."""
    entity.__del__()


class WireParticipant:
    """One process in a domain."""

    def __init__(self, number: int) -> None:
        from cyclonedds.core import DDSException
        from cyclonedds.domain import Domain, DomainParticipant
        from cyclonedds.qos import Policy, Qos

        self._topics: dict[str, Any] = {}
        self._has_left = False
        domain: Any = None
        try:
            domain = Domain(number, configuration())
            self.entity: Any = DomainParticipant(number, Qos(Policy.Userdata(b'enclave=/;')))
        except DDSException as error:
            if domain is not None:
                delete(domain)
            raise ImuCalibError(
                f'Cyclone DDS cannot join domain {number}: {error}. ROS_AUTOMATIC_DISCOVERY_RANGE '
                'and CYCLONEDDS_URI say which network interfaces it may use.'
            ) from error
        self._domain = domain

    def ok(self) -> bool:
        """Return whether it is still in the domain."""
        return not self._has_left

    def topic(self, name: str, idl: Any) -> Any:
        """Return the DDS topic of a name; it is created once."""
        from cyclonedds.core import DDSException
        from cyclonedds.topic import Topic

        if name not in self._topics:
            try:
                self._topics[name] = Topic(self.entity, name, idl)
            except DDSException as error:
                raise ImuCalibError(f'The topic {name} cannot be made: {error}') from error
        known = self._topics[name].data_type
        if known is not idl:
            raise ImuCalibError(
                f'The topic {name} has the type {known.__idl_typename__}, '
                f'not {idl.__idl_typename__}.'
            )
        return self._topics[name]

    def reader(
        self, topic: str, type_name: str, qos: QoSProfile, user_data: str = '', prefix: str = ''
    ) -> Reader:
        """Create a reader of a DDS topic."""
        return Reader(self, topic, type_name, qos, user_data, prefix)

    def writer(
        self, topic: str, type_name: str, qos: QoSProfile, user_data: str = '', prefix: str = ''
    ) -> Writer:
        """Create a writer of a DDS topic."""
        return Writer(self, topic, type_name, qos, user_data, prefix)

    def wait_set(self, readers: Sequence[Reader]) -> WaitSet:
        """Create what waits for messages of readers.

        Raises:
            TransportError: A reader was deleted.
        """
        from cyclonedds.core import DDSException

        try:
            return WaitSet(self, readers)
        except DDSException as error:
            raise TransportError(str(error)) from error

    def leave(self) -> None:
        """Delete all entities."""
        self._has_left = True
        for entity in (*self._topics.values(), self.entity, self._domain):
            delete(entity)


_ANY = 3 | 12 | 112
"""State mask: samples read or not, of new or known writers, alive or not."""

# DDS numbers of the policies in profiles, and rclpy's numbers for them.
_POLICIES = {2: 2, 11: 16, 13: 32}
_BULK = 4096
"""Messages taken per call."""


@cache
def idl_type(name: str, prefix: str = '') -> Any:
    """Return the wheel's type of a message, with ROS 2's name on the wire.

    The prefix 'service' puts the id of a request in front.
    """
    from cyclonedds.idl import annotations, make_idl_struct, types

    package, kind, short = name.split('/')
    fields: dict[str, Any] = {}
    if prefix:
        fields = {'client_guid': types.uint64, 'sequence_number': types.int64}
    fields.update((f'{n}_', _idl_field(*desc)) for n, desc in interface(name).fields)
    struct = make_idl_struct(f'{short}_', f'{package}.{kind}.dds_.{short}_', fields)
    return annotations.final(struct)


@cache
def topic_type(name: str, prefix: str = '') -> Any:
    """Return the wheel's type of a topic, with its description; see `idl_type`."""
    found = idl_type(name, prefix)
    describe(found, f'{name} {prefix} {type_hash(name)}')
    return found


def _idl_field(kind: int, details: Any) -> Any:
    """Return the wheel's type of a field described by rosbags."""
    from cyclonedds.idl import types

    if kind == Nodetype.NAME:
        return idl_type(details)
    inner, size = details
    if kind == Nodetype.BASE:
        if inner == 'string':
            return types.bounded_str[size] if size else str
        return bool if inner == 'bool' else getattr(types, inner)
    one = _idl_field(*inner)
    if kind == Nodetype.ARRAY:
        return types.array[one, size]
    return types.sequence[one, size] if size else types.sequence[one]


class Endpoint:
    """A reader or a writer of one DDS topic."""

    def __init__(
        self,
        participant: WireParticipant,
        topic: str,
        type_name: str,
        qos: QoSProfile,
        user_data: str = '',
        prefix: str = '',
    ) -> None:
        self.participant = participant
        self.name = topic
        self.topic = participant.topic(topic, topic_type(type_name, prefix))
        self._qos = to_dds(qos, f'{user_data}typehash={type_hash(type_name)};')
        self.entity: Any = None

    @property
    def gid(self) -> bytes:
        """The 16 bytes that identify this endpoint."""
        return bytes(self.entity.get_guid().bytes)

    def delete(self) -> None:
        """Leave the topic."""
        delete(self.entity)


class Writer(Endpoint):
    """Sends serialised messages."""

    def __init__(self, *args: Any, **options: Any) -> None:
        from cyclonedds._clayer import ddspy_write
        from cyclonedds.internal import DDS
        from cyclonedds.pub import DataWriter

        super().__init__(*args, **options)
        library = DDS._dll_handle
        # Messages then wait for a flush, and many are sent in one packet. The wheel's profiles lack
        # this setting; a writer keeps its value from creation.
        library.dds_write_set_batch(c_bool(True))
        try:
            self.entity = DataWriter(self.participant.entity, self.topic, qos=self._qos)
        finally:
            library.dds_write_set_batch(c_bool(False))
        self._write = ddspy_write
        self._flush = library.dds_write_flush

    def write(self, payload: bytes) -> None:
        """Send one message, its encapsulation header included."""
        self.write_all([payload])

    def write_message(self, message: Message) -> None:
        """Send a message; errors as of `write`."""
        self.write(serialize_message(message))

    def write_all(self, payloads: Iterable[bytes]) -> None:
        """Send messages, as many per packet as fit: each packet costs both ends a call."""
        try:
            for payload in payloads:
                self._write_payload(payload)
        finally:
            self._flush(self.entity._ref)

    def _write_payload(self, payload: bytes) -> None:
        code = self._write(self.entity._ref, payload + bytes(-len(payload) % 4))
        if code < 0:
            gone = '' if self.participant.ok() else ': the context is shut down'
            raise ImuCalibError(f'{self.name}: Cyclone DDS refuses to send ({code}){gone}.')

    def acknowledged(self, timeout_ns: int) -> bool:
        """Wait until every reliable reader has everything; return whether that is so."""
        # The wheel's own wait_for_acks raises an error at the timeout.
        code = int(self.entity._wait_for_acks(self.entity._ref, timeout_ns))
        return code == 0

    def matched(self) -> int:
        """Return the number of matching readers."""
        return len(self.entity.get_matched_subscriptions())

    def user_data_of_readers(self) -> list[bytes]:
        """Return the user data of all matching readers."""
        found = map(
            self.entity.get_matched_subscription_data, self.entity.get_matched_subscriptions()
        )
        return [data for data in map(_user_data, found) if data is not None]

    def incompatible(self) -> QoSIncompatibleInfo | None:
        """Return mismatches since the last call, None without any."""
        return _incompatible(self.entity.get_offered_incompatible_qos_status())


class Reader(Endpoint):
    """Receives serialised messages."""

    def __init__(self, *args: Any, **options: Any) -> None:
        from cyclonedds._clayer import ddspy_take
        from cyclonedds.core import ReadCondition
        from cyclonedds.sub import DataReader

        super().__init__(*args, **options)
        self.entity = DataReader(self.participant.entity, self.topic, qos=self._qos)
        self.condition = ReadCondition(self.entity, _ANY)
        self._take = ddspy_take

    def drain(self, most: int | None = None) -> list[bytes]:
        """Return all arrived messages, or at most `most` of the oldest."""
        payloads: list[bytes] = []
        while most is None or len(payloads) < most:
            room = _BULK if most is None else min(_BULK, most - len(payloads))
            taken = self._pop_messages(room)
            # A sample without data reports that a writer has left.
            payloads += [payload for payload, info in taken if info.valid_data]
            if len(taken) < room:
                break
        return payloads

    def read(self, most: int, message_type: type[Message]) -> Iterator[Message]:
        """Yield at most `most` of the oldest messages."""
        return (deserialize_message(payload, message_type) for payload in self.drain(most))

    def drain_sources(self, most: int = _BULK) -> list[tuple[bytes, bytes]]:
        """Return the oldest arrived messages, each with the number of its writer, 8 bytes."""
        return [
            (payload, info.publication_handle.to_bytes(8, 'little'))
            for payload, info in self._pop_messages(min(most, _BULK))
            if info.valid_data
        ]

    def user_data_of(self, source: bytes) -> bytes | None:
        """Return the user data of a writer by its number (`drain_sources`), None if it has left."""
        handle = int.from_bytes(source, 'little')
        return _user_data(self.entity.get_matched_publication_data(handle))

    def _pop_messages(self, room: int) -> list[Any]:
        taken = self._take(self.entity._ref, _ANY, room)
        if isinstance(taken, int):
            raise ImuCalibError(f'{self.name}: Cyclone DDS cannot take ({taken}).')
        return list(taken)

    def matched(self) -> int:
        """Return the number of matching writers."""
        return len(self.entity.get_matched_publications())

    def incompatible(self) -> QoSIncompatibleInfo | None:
        """Return mismatches since the last call, None without any."""
        return _incompatible(self.entity.get_requested_incompatible_qos_status())

    def delete(self) -> None:
        """Leave the topic."""
        delete(self.condition)
        super().delete()


class WaitSet:
    """Waits until any reader has messages, and returns which.

    The wheel's own reports only that some have: asking each reader costs more than most messages.
    """

    def __init__(self, participant: WireParticipant, readers: Sequence[Reader]) -> None:
        from cyclonedds import core

        attach, self._call = _waiting()
        self._entity = core.WaitSet(participant.entity)
        # An empty wait set does not wait; this one always holds a condition that is never met.
        self._never = core.GuardCondition(participant.entity)
        self._found = (c_ssize_t * (len(readers) + 1))()
        conditions = [*(reader.condition for reader in readers), self._never]
        for k, condition in enumerate(conditions):
            _check(attach(self._entity._ref, condition._ref, k))

    def wait(self, nanoseconds: int) -> list[int]:
        """Return which readers have messages, as ascending indices.

        Raises:
            TransportError: The wait set or a reader has been deleted.
        """
        found = self._found
        count = self._call(self._entity._ref, found, len(found), nanoseconds)
        return sorted(found[: _check(count)])

    def delete(self) -> None:
        """Delete the wait set."""
        delete(self._entity)
        delete(self._never)


@cache
def _waiting() -> tuple[Any, Any]:
    """Return dds_waitset_attach and dds_waitset_wait; those of the wheel keep their own types."""
    from cyclonedds.internal import DDS

    library, code, entity = DDS._dll_handle, c_int32, c_int32
    attach = CFUNCTYPE(code, entity, entity, c_ssize_t)
    wait = CFUNCTYPE(code, entity, c_void_p, c_size_t, c_int64)
    return attach(('dds_waitset_attach', library)), wait(('dds_waitset_wait', library))


def _check(code: int) -> int:
    if code < 0:
        raise TransportError(f'Cyclone DDS returns {code} while waiting for messages.')
    return code


def _user_data(endpoint: Any) -> bytes | None:
    """Return the user data of a description of an endpoint, None if there is none of it."""
    from cyclonedds.qos import Policy

    if endpoint is None:
        return None
    return endpoint.qos[Policy.Userdata].data if Policy.Userdata in endpoint.qos else b''


def _incompatible(status: Any) -> QoSIncompatibleInfo | None:
    if status.total_count_change <= 0:
        return None
    kind = _POLICIES.get(status.last_policy_id, 0)
    return QoSIncompatibleInfo(status.total_count, status.total_count_change, kind)
