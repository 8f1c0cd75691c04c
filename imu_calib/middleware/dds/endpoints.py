"""Publishers and subscriptions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from .clock import Duration
from .codec import deserialize_message, serialize_message
from .messages import Message
from .wire import Reader, Writer

if TYPE_CHECKING:
    from collections.abc import Callable

    from .node import Node
    from .qos import PublisherEventCallbacks, QoSProfile, SubscriptionEventCallbacks


class Publisher:
    """Publishes messages of one type on one topic."""

    def __init__(
        self,
        node: Node,
        msg_type: type[Message],
        topic: str,
        qos: QoSProfile,
        events: PublisherEventCallbacks | None,
    ) -> None:
        self.msg_type = msg_type
        self.topic_name = topic
        self.qos_profile = qos
        self.node = node
        self.writer = Writer(node.context, f'rt{topic}', msg_type.TYPE_NAME, qos)
        self._events = events

    def publish(self, msg: Message | bytes) -> None:
        """Send a message, or the bytes of a serialised one.

        With KEEP ALL on both ends this waits for a subscription that lags; for one whose process
        died, until its lease of ten seconds ends (the same under rclpy).

        Raises:
            TypeError: It is of another type than the topic.
            ImuCalibError: The middleware refuses it.

        """
        if isinstance(msg, bytes):
            self.writer.write(msg)
        elif isinstance(msg, self.msg_type):
            self.writer.write(serialize_message(msg))
        else:
            raise TypeError(f'Expected {self.msg_type}, got {type(msg)}')

    def get_subscription_count(self) -> int:
        """Return how many subscriptions match."""
        return self.writer.matched()

    def wait_for_all_acked(self, timeout: Duration | None = None) -> bool:
        """Wait until all reliable subscriptions have all messages.

        Args:
            timeout: How long at most; none waits for ever.

        Returns:
            Whether they have.

        """
        nanoseconds = 2**63 - 1 if timeout is None else timeout.nanoseconds
        return self.writer.acknowledged(nanoseconds)

    def tend(self) -> None:
        """Report what does not match."""
        if self._events is not None and self._events.incompatible_qos is not None:
            info = self.writer.incompatible()
            if info is not None:
                self._events.incompatible_qos(info)

    def destroy(self) -> None:
        """Leave the topic."""
        self.writer.delete()


class Subscription:
    """Receives messages of one type from one topic."""

    def __init__(
        self,
        node: Node,
        msg_type: type[Message],
        topic: str,
        callback: Callable[[Any], Any] | None,
        qos: QoSProfile,
        events: SubscriptionEventCallbacks | None,
        raw: bool,
    ) -> None:
        self.msg_type = msg_type
        self.topic_name = topic
        self.qos_profile = qos
        self.raw = raw
        self.callback = callback
        self.node = node
        self.reader = Reader(node.context, f'rt{topic}', msg_type.TYPE_NAME, qos)
        self._events = events

    def get_publisher_count(self) -> int:
        """Return how many publishers match."""
        return self.reader.matched()

    def execute(self, most: int) -> bool:
        """Hand messages that have arrived to the callback; return whether there were any."""
        if self.callback is None:
            return False
        payloads = self.reader.drain(most)
        for payload in payloads:
            if self.destroyed:
                break
            self.callback(payload if self.raw else deserialize_message(payload, self.msg_type))
        return bool(payloads)

    @property
    def destroyed(self) -> bool:
        """Whether a callback has destroyed it in the meantime."""
        return self not in self.node.subscriptions_

    def tend(self) -> None:
        """Report what does not match."""
        if self._events is not None and self._events.incompatible_qos is not None:
            info = self.reader.incompatible()
            if info is not None:
                self._events.incompatible_qos(info)

    def destroy(self) -> None:
        """Leave the topic."""
        self.reader.delete()
