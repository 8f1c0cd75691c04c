"""Publishers, subscriptions and services."""

from __future__ import annotations

import re
import secrets
import struct
import time
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

from .context import Future
from .message_types import Message, deserialize_message, message_class, serialize_message
from .qos import QoSPolicyKind, QoSProfile

if TYPE_CHECKING:
    from collections.abc import Callable

    from .context import AnyParticipant, Logger
    from .qos import SubscriptionEventCallbacks

_AT_ONCE = 4096
"""Messages taken per call, so that other callbacks can run."""


class _TopicEnd:
    """Common part of publishers and subscriptions."""

    MISMATCH: ClassVar[str]

    def __init__(
        self,
        logger: Logger,
        msg_type: type[Message],
        topic: str,
        qos: QoSProfile,
        events: SubscriptionEventCallbacks | None,
        end: Any,
    ) -> None:
        self._logger = logger
        self.destroyed = False
        self.msg_type = msg_type
        self.topic_name = topic
        self.qos_profile = qos
        self._end = end
        self._notify = None if events is None else events.incompatible_qos

    def report_mismatches(self) -> None:
        """Report mismatches of quality of service: to the callback, else in the log."""
        info = self._end.incompatible()
        if info is None:
            return
        if self._notify is not None:
            self._notify(info)
        else:
            kinds = {int(kind): kind.name for kind in QoSPolicyKind}
            policy = kinds.get(info.last_policy_kind, 'another')
            found = self.MISMATCH.format(self.topic_name)
            self._logger.warning(f'{found} Last incompatible policy: {policy}')

    def destroy(self) -> None:
        """Leave the topic."""
        self.destroyed = True
        self._end.delete()


class Publisher(_TopicEnd):
    """Publishes messages of one type on one topic."""

    MISMATCH = (
        "New subscription discovered on topic '{}', requesting incompatible QoS. "
        'No messages will be sent to it.'
    )

    def __init__(
        self,
        participant: AnyParticipant,
        logger: Logger,
        msg_type: type[Message],
        topic: str,
        qos: QoSProfile,
    ) -> None:
        self.writer = participant.writer(f'rt{topic}', msg_type.TYPE_NAME, qos)
        super().__init__(logger, msg_type, topic, qos, None, self.writer)

    def publish(self, msg: Message | bytes) -> None:
        """Send a message, or the bytes of a serialised one.

        With KEEP ALL on both ends this waits for slow subscriptions; for a killed one until its
        lease of ten seconds ends (the same under rclpy).

        Raises:
            TypeError: The message has another type than the topic.
            ImuCalibError: The middleware refuses it.
        """
        if isinstance(msg, bytes):
            self.writer.write(msg)
        elif isinstance(msg, self.msg_type):
            self.writer.write_message(msg)
        else:
            raise TypeError(f'Expected {self.msg_type}, got {type(msg)}')

    def get_subscription_count(self) -> int:
        """Return the number of matching subscriptions."""
        return self.writer.matched()


class Subscription(_TopicEnd):
    """Receives messages of one type from one topic."""

    MISMATCH = (
        "New publisher discovered on topic '{}', offering incompatible QoS. "
        'No messages will be received from it.'
    )

    def __init__(
        self,
        participant: AnyParticipant,
        logger: Logger,
        msg_type: type[Message],
        topic: str,
        callback: Callable[[Any], Any] | None,
        qos: QoSProfile,
        events: SubscriptionEventCallbacks | None,
        raw: bool,
    ) -> None:
        self.raw = raw
        self.callback = callback
        self.in_bulk = False
        self.reader = participant.reader(f'rt{topic}', msg_type.TYPE_NAME, qos)
        super().__init__(logger, msg_type, topic, qos, events, self.reader)

    def get_publisher_count(self) -> int:
        """Return the number of matching publishers."""
        return self.reader.matched()

    def execute(self, most: int) -> bool:
        """Pass arrived messages to the callback; return whether there were any."""
        if self.callback is None:
            return False
        if self.in_bulk:
            payloads = self.reader.drain(_AT_ONCE)
            if payloads:
                self.callback(payloads)
            return bool(payloads)
        received = self.reader.drain(most) if self.raw else self.reader.read(most, self.msg_type)
        came = False
        for message in received:
            came = True
            if self.destroyed:  # by the callback
                break
            self.callback(message)
        return came


# Services (std_srvs/Trigger and similar) with the protocol of rmw_cyclonedds.

_REQUEST_ID = struct.Struct('<Qq')
_CLIENT = re.compile(rb'clientid=[^;]*;')
"""Marks both ends of one client in their user data."""


class Trigger:
    """std_srvs/srv/Trigger."""

    TYPE_NAME = 'std_srvs/srv/Trigger'
    Request = message_class('std_srvs/srv/Trigger_Request')
    Response = message_class('std_srvs/srv/Trigger_Response')


class _ServiceEnd:
    """One side of a service: the DDS endpoints of requests and of replies."""

    def __init__(
        self, participant: AnyParticipant, srv_type: Any, srv_name: str, gid: bytes, *, serves: bool
    ) -> None:
        self.srv_type = srv_type
        self.srv_name = srv_name
        self.destroyed = False
        numbers = '.'.join(f'{b:x}' for b in gid)
        identity = f'{"service" if serves else "client"}id= {numbers};'
        qos = QoSProfile(depth=10)
        read = f'rq{srv_name}Request', srv_type.Request.TYPE_NAME
        written = f'rr{srv_name}Reply', srv_type.Response.TYPE_NAME
        if not serves:
            read, written = written, read
        self.reader = participant.reader(*read, qos, identity, 'service')
        self.writer = participant.writer(*written, qos, identity, 'service')

    def destroy(self) -> None:
        """Leave the service's topics."""
        self.destroyed = True
        self.reader.delete()
        self.writer.delete()


class Service(_ServiceEnd):
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
        super().__init__(participant, srv_type, srv_name, secrets.token_bytes(16), serves=True)
        self.callback = callback
        self._retry = retry

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


def _when_done(answer: Callable[[Any], None], done: Future) -> None:
    answer(done.result())


def _request_id(payload: bytes) -> bytes:
    order = '<' if payload[1] else '>'
    return _REQUEST_ID.pack(*struct.unpack(f'{order}Qq', payload[4:20]))


class Client(_ServiceEnd):
    """Calls a service; the answer is a future."""

    def __init__(self, participant: AnyParticipant, srv_type: Any, srv_name: str) -> None:
        gid = secrets.token_bytes(16)
        super().__init__(participant, srv_type, srv_name, gid, serves=False)
        self._guid = int.from_bytes(gid[:8], 'little')
        self._sequence = 0
        self._pending: dict[int, Future] = {}

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
