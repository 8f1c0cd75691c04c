"""Services (std_srvs/Trigger and similar) with the protocol of rmw_cyclonedds."""

from __future__ import annotations

import re
import secrets
import struct
import time
from functools import partial
from typing import TYPE_CHECKING, Any

from .codec import deserialize_message, serialize_message
from .future import Future
from .messages import message_class
from .qos import QoSProfile

if TYPE_CHECKING:
    from collections.abc import Callable

    from .context import AnyParticipant

_REQUEST_ID = struct.Struct('<Qq')
_CLIENT = re.compile(rb'clientid=[^;]*;')
"""Marks both ends of one client in their user data."""


class Trigger:
    """std_srvs/srv/Trigger."""

    TYPE_NAME = 'std_srvs/srv/Trigger'
    Request = message_class('std_srvs/srv/Trigger_Request')
    Response = message_class('std_srvs/srv/Trigger_Response')


def _identity(gid: bytes, role: str) -> str:
    numbers = '.'.join(f'{b:x}' for b in gid)
    return f'{role}id= {numbers};'


def _ends(
    participant: AnyParticipant, srv_type: Any, name: str, serves: bool, gid: bytes
) -> tuple[Any, Any]:
    """Create the two DDS endpoints of one side of a service."""
    identity = _identity(gid, 'service' if serves else 'client')
    request, reply = f'rq{name}Request', f'rr{name}Reply'
    qos = QoSProfile(depth=10)
    request_type, response_type = srv_type.Request.TYPE_NAME, srv_type.Response.TYPE_NAME
    read, written = (request, request_type), (reply, response_type)
    if not serves:
        read, written = written, read
    return (
        participant.reader(*read, qos, identity, 'service'),
        participant.writer(*written, qos, identity, 'service'),
    )


class Service:
    """Answers requests; the callback takes request and response and returns the response.

    It may return a future of the response instead.

    Args:
        participant: AnyParticipant of the node that serves.
        srv_type: Class of the service.
        srv_name: Absolute name.
        callback: Answers a request.
        retry: Called with a function that is to be called again and again until it returns True.
    """

    def __init__(
        self,
        participant: AnyParticipant,
        srv_type: Any,
        srv_name: str,
        callback: Callable[[Any, Any], Any],
        retry: Callable[[Callable[[], bool]], None],
    ) -> None:
        self.srv_type = srv_type
        self.srv_name = srv_name
        self.callback = callback
        self._retry = retry
        self.destroyed = False
        self.reader, self.writer = _ends(
            participant, srv_type, srv_name, True, secrets.token_bytes(16)
        )

    def execute(self, most: int) -> bool:
        """Answer pending requests; return whether there were any."""
        requests = self.reader.drain_sources(most)
        for payload, client in requests:
            request = deserialize_message(payload, self.srv_type.Request, skip=16)
            response = self.callback(request, self.srv_type.Response())
            answer = partial(self._answer, client, _request_id(payload))
            if isinstance(response, Future):
                response.add_done_callback(partial(_when_done, answer))
            else:
                answer(response)
        return bool(requests)

    def _answer(self, client: bytes, request_id: bytes, response: Any) -> None:
        if not isinstance(response, self.srv_type.Response):
            raise TypeError(
                f'The callback of {self.srv_name} returned {type(response).__name__}, '
                f'expected {self.srv_type.Response.__name__}.'
            )
        send = partial(self._send, client, serialize_message(response, request_id))
        if not send():
            self._retry(send)

    def _send(self, client: bytes, answer: bytes) -> bool:
        """Send an answer; return False while its client could not receive it.

        DDS announces the writer and the reader of a client one after the other. An answer that is
        sent between the two is lost: rmw_cyclonedds holds it back as well (rmw_send_response).
        """
        if self.destroyed:
            return True
        wanted = self.reader.user_data_of(client)
        if wanted is None:
            return True  # The client has left.
        identity = _CLIENT.search(wanted)
        if identity is not None and not any(
            identity[0] in reader for reader in self.writer.user_data_of_readers()
        ):
            return False
        self.writer.write(answer)
        return True

    def destroy(self) -> None:
        """Leave the service's topics."""
        self.destroyed = True
        self.reader.delete()
        self.writer.delete()


def _when_done(answer: Callable[[Any], None], done: Future) -> None:
    answer(done.result())


def _request_id(payload: bytes) -> bytes:
    order = '<' if payload[1] else '>'
    return _REQUEST_ID.pack(*struct.unpack(f'{order}Qq', payload[4:20]))


class Client:
    """Calls a service; the answer is a future."""

    def __init__(self, participant: AnyParticipant, srv_type: Any, srv_name: str) -> None:
        self.srv_type = srv_type
        self.srv_name = srv_name
        gid = secrets.token_bytes(16)
        self._guid = int.from_bytes(gid[:8], 'little')
        self._sequence = 0
        self.destroyed = False
        self._pending: dict[int, Future] = {}
        self.reader, self.writer = _ends(participant, srv_type, srv_name, False, gid)

    def service_is_ready(self) -> bool:
        """Return whether the service has a server."""
        return bool(self.writer.matched() and self.reader.matched())

    def wait_for_service(self, timeout_sec: float | None = None) -> bool:
        """Wait for a server; return whether there is one."""
        end = None if timeout_sec is None else time.monotonic() + timeout_sec
        while not self.service_is_ready():
            if end is not None and time.monotonic() >= end:
                return False
            time.sleep(0.02)
        return True

    def call_async(self, request: Any) -> Future:
        """Send a request; the future is done when the answer has come and the node is spun."""
        if not isinstance(request, self.srv_type.Request):
            raise TypeError(f'Expected {self.srv_type.Request}, got {type(request)}')
        self._sequence += 1
        future = self._pending[self._sequence] = Future()
        prefix = _REQUEST_ID.pack(self._guid, self._sequence)
        self.writer.write(serialize_message(request, prefix))
        return future

    def execute(self, most: int) -> bool:
        """Take arrived answers; return whether there were any."""
        found = False
        for payload in self.reader.drain(most):
            guid, sequence = _REQUEST_ID.unpack(_request_id(payload))
            # The answers to all clients come on one topic.
            future = self._pending.pop(sequence, None) if guid == self._guid else None
            if future is not None:
                found = True
                future.set_result(deserialize_message(payload, self.srv_type.Response, skip=16))
        return found

    def destroy(self) -> None:
        """Leave the service's topics."""
        self.destroyed = True
        self.reader.delete()
        self.writer.delete()
