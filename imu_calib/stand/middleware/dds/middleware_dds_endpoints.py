"""Publishers and subscriptions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

from .messages import Message
from .qos import QoSPolicyKind

if TYPE_CHECKING:
    from collections.abc import Callable

    from .context import AnyParticipant
    from .logging import Logger
    from .qos import QoSProfile, SubscriptionEventCallbacks


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
        received = self.reader.drain(most) if self.raw else self.reader.take(most, self.msg_type)
        came = False
        for message in received:
            came = True
            if self.destroyed:  # by the callback
                break
            self.callback(message)
        return came
