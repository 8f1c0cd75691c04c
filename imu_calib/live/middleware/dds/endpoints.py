"""Publishers, subscriptions, services and actions."""

from __future__ import annotations

import re
import secrets
import struct
import time
from functools import cache, partial
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, ClassVar

from ..shared import ENDS, GoalStatus
from .context import Future
from .message_types import Message, deserialize_message, message_class, serialize_message
from .qos import DurabilityPolicy, QoSPolicyKind, QoSProfile

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

    `retry` is called with a function that is to be called again and again until it returns True.
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


# Actions of ROS 2: three services and two topics below the action's name.


_KEPT = 16
"""Number of ended goals whose results may still be requested."""
_NONE, _REJECTED, _UNKNOWN, _TERMINATED = range(4)
"""Return codes of action_msgs/srv/CancelGoal."""


@cache
def action_type(name: str) -> Any:
    """Return an action's type, with Goal, Result and Feedback, by its full name."""

    def service(full: str) -> Any:
        return SimpleNamespace(
            Request=message_class(f'{full}_Request'), Response=message_class(f'{full}_Response')
        )

    return SimpleNamespace(
        **{part: message_class(f'{name}_{part}') for part in ('Goal', 'Result', 'Feedback')},
        Impl=SimpleNamespace(
            SendGoalService=service(f'{name}_SendGoal'),
            GetResultService=service(f'{name}_GetResult'),
            CancelGoalService=service('action_msgs/srv/CancelGoal'),
            FeedbackMessage=message_class(f'{name}_FeedbackMessage'),
        ),
    )


class ServerGoal:
    """A goal that was accepted; see `GoalServer`."""

    def __init__(self, server: GoalServer, identity: bytes, request: Any, stamp: Any) -> None:
        self._server = server
        self.identity = identity
        self.request = request
        self.stamp = stamp
        self.status = GoalStatus.EXECUTING
        self.answer = Future()

    @property
    def is_cancel_requested(self) -> bool:
        """Whether a client has requested to cancel it, and the request was accepted."""
        return self.status is GoalStatus.CANCELING

    def publish_feedback(self, feedback: Any) -> None:
        """Publish the progress of the goal."""
        self._server.publish_feedback(self, feedback)

    def end(self, status: GoalStatus, result: Any) -> None:
        """End it, with a result for clients; CANCELED only after a request to cancel, as in ROS."""
        self._server.end(self, status, result)


class GoalServer:
    """Serves an action; a goal is executed from its acceptance until its `end` is called.

    Args:
        node: The node that serves.
        kind: The action's type.
        name: Of the action; relative, absolute or private.
        accept: Returns whether a goal is accepted.
        begin: Called with the accepted `ServerGoal`.
        cancel: Returns whether a goal will be cancelled.
    """

    def __init__(
        self,
        node: Any,
        kind: Any,
        name: str,
        *,
        accept: Callable[[Any], bool],
        begin: Callable[[ServerGoal], None],
        cancel: Callable[[ServerGoal], bool],
    ) -> None:
        self._node, self._kind = node, kind
        self._accept, self._begin, self._cancel = accept, begin, cancel
        self._goals: dict[bytes, ServerGoal] = {}
        self._array = message_class('action_msgs/msg/GoalStatusArray')
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        below = f'{name}/_action'
        self._feedback = node.create_publisher(kind.Impl.FeedbackMessage, f'{below}/feedback', 10)
        self._status = node.create_publisher(self._array, f'{below}/status', latched)
        impl = kind.Impl
        node.create_service(impl.SendGoalService, f'{below}/send_goal', self._on_goal)
        node.create_service(impl.CancelGoalService, f'{below}/cancel_goal', self._on_cancel)
        node.create_service(impl.GetResultService, f'{below}/get_result', self._on_result)

    def publish_feedback(self, goal: ServerGoal, feedback: Any) -> None:
        """Publish the progress of a goal."""
        message = self._kind.Impl.FeedbackMessage(feedback=feedback)
        message.goal_id.uuid = list(goal.identity)
        self._feedback.publish(message)

    def end(self, goal: ServerGoal, status: GoalStatus, result: Any) -> None:
        """End a goal."""
        goal.status = status
        response = self._kind.Impl.GetResultService.Response(status=int(status), result=result)
        goal.answer.set_result(response)
        ended = [k for k, g in self._goals.items() if g.status in ENDS]
        for identity in ended[:-_KEPT]:
            del self._goals[identity]
        self._publish_status()

    def _on_goal(self, request: Any, response: Any) -> Any:
        identity = bytes(request.goal_id.uuid)
        if identity in self._goals or not self._accept(request.goal):
            return response
        response.accepted = True
        response.stamp = self._node.get_clock().now().to_msg()
        goal = self._goals[identity] = ServerGoal(self, identity, request.goal, response.stamp)
        self._publish_status()
        self._begin(goal)
        return response

    def _on_cancel(self, request: Any, response: Any) -> Any:
        wanted = self._wanted(request.goal_info)
        active = [goal for goal in wanted if goal.status not in ENDS]
        agreed = [g for g in active if g.is_cancel_requested or self._cancel(g)]
        for goal in agreed:
            goal.status = GoalStatus.CANCELING
        response.goals_canceling = [self._info(goal) for goal in agreed]
        if agreed:
            self._publish_status()
            response.return_code = _NONE
        elif active:
            response.return_code = _REJECTED
        elif any(request.goal_info.goal_id.uuid):
            response.return_code = _TERMINATED if wanted else _UNKNOWN
        return response

    def _wanted(self, info: Any) -> list[ServerGoal]:
        """Return the goals that a cancel request selects, as action_msgs/srv/CancelGoal defines."""
        identity, until = bytes(info.goal_id.uuid), _seconds(info.stamp)
        if not any(identity) and until == (0, 0):
            return list(self._goals.values())
        return [
            goal
            for key, goal in self._goals.items()
            if key == identity or (until != (0, 0) and _seconds(goal.stamp) <= until)
        ]

    def _on_result(self, request: Any, response: Any) -> Any:
        """Answer with the result, now or later; for an unknown goal with status UNKNOWN."""
        goal = self._goals.get(bytes(request.goal_id.uuid))
        return response if goal is None else goal.answer

    def _info(self, goal: ServerGoal) -> Any:
        info = message_class('action_msgs/msg/GoalInfo')(stamp=goal.stamp)
        info.goal_id.uuid = list(goal.identity)
        return info

    def _publish_status(self) -> None:
        kind = message_class('action_msgs/msg/GoalStatus')
        listed = [kind(goal_info=self._info(g), status=int(g.status)) for g in self._goals.values()]
        self._status.publish(self._array(status_list=listed))


class ClientGoalHandle:
    """rclpy's class: a goal that a server has accepted or rejected."""

    def __init__(self, client: ActionClient, identity: bytes, response: Any) -> None:
        self._client = client
        self.identity = identity
        self.accepted = bool(response.accepted)
        self.stamp = response.stamp

    def get_result_async(self) -> Future:
        """Request the result; the future holds `status` and `result` when the goal has ended."""
        return self._client.ask_for_result(self.identity)

    def cancel_goal_async(self) -> Future:
        """Request to cancel it; the future holds the answer of the server."""
        return self._client.ask_to_cancel(self.identity)


class ActionClient:
    """rclpy's class without feedback: sends goals to a server."""

    def __init__(self, node: Any, kind: Any, name: str) -> None:
        self._kind = kind
        impl, below = kind.Impl, f'{name}/_action'
        self._send: Client = node.create_client(impl.SendGoalService, f'{below}/send_goal')
        self._result: Client = node.create_client(impl.GetResultService, f'{below}/get_result')
        self._cancel: Client = node.create_client(impl.CancelGoalService, f'{below}/cancel_goal')

    def server_is_ready(self) -> bool:
        """Return whether the action has a server."""
        clients = (self._send, self._result, self._cancel)
        return all(client.service_is_ready() for client in clients)

    def send_goal_async(self, goal: Any) -> Future:
        """Send a goal; the future holds its `ClientGoalHandle` when the server has answered."""
        identity = secrets.token_bytes(16)
        request = self._kind.Impl.SendGoalService.Request(goal=goal)
        request.goal_id.uuid = list(identity)
        handle = Future()
        self._send.call_async(request).add_done_callback(
            lambda done: handle.set_result(ClientGoalHandle(self, identity, done.result()))
        )
        return handle

    def ask_for_result(self, identity: bytes) -> Future:
        """Request the result of a goal."""
        request = self._kind.Impl.GetResultService.Request()
        request.goal_id.uuid = list(identity)
        return self._result.call_async(request)

    def ask_to_cancel(self, identity: bytes) -> Future:
        """Request to cancel a goal."""
        request = self._kind.Impl.CancelGoalService.Request()
        request.goal_info.goal_id.uuid = list(identity)
        return self._cancel.call_async(request)


def _seconds(stamp: Any) -> tuple[int, int]:
    return stamp.sec, stamp.nanosec
