"""The fast path: serialised messages in bulk, in one call, without losses at the publisher."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from .middleware_dds_endpoints import Publisher, Subscription
    from .node import Node
    from .qos import QoSProfile


def open_drain(
    node: Node, msg_type: Any, topic: str, qos_profile: QoSProfile | int, **options: Any
) -> Subscription:
    """Subscribe without a callback: messages wait until `drain` takes them.

    Args:
        node: Node that subscribes.
        msg_type: Class of the messages.
        topic: Name of the topic.
        qos_profile: Keep all on both ends loses nothing.
        **options: Further arguments of create_subscription.
    """
    return node.create_subscription(msg_type, topic, None, qos_profile, raw=True, **options)


def open_stream(
    node: Node,
    msg_type: Any,
    topic: str,
    callback: Callable[[list[bytes]], Any],
    qos_profile: QoSProfile | int,
    **options: Any,
) -> Subscription:
    """Subscribe with a callback that takes all that has arrived, serialised, oldest first.

    The callback is called as soon as messages arrive: a single message does not wait for a timer,
    and many are taken together.

    Args:
        node: Node that subscribes.
        msg_type: Class of the messages.
        topic: Name of the topic.
        callback: Takes at least one message.
        qos_profile: Keep all on both ends loses nothing.
        **options: Further arguments of create_subscription.
    """
    subscription = node.create_subscription(
        msg_type, topic, callback, qos_profile, raw=True, **options
    )
    subscription.in_bulk = True
    return subscription


def drain(subscription: Subscription, most: int | None = None) -> list[bytes]:
    """Return what has arrived, serialised, oldest first; for `cdr.Messages.join`.

    Args:
        subscription: One of `open_drain`.
        most: Largest number to take; a few thousand fit the processor's cache and decode fastest.
    """
    return subscription.reader.drain(most)


def drain_sources(subscription: Subscription) -> list[tuple[bytes, bytes]]:
    """Return what has arrived, serialised, each with the identifier of its publisher.

    Args:
        subscription: One of `open_drain`.

    Returns:
        Oldest first; the identifier is empty if the publisher is unknown (not on this runtime).
    """
    return subscription.reader.drain_sources()


def publish_all(publisher: Publisher, payloads: Iterable[bytes]) -> None:
    """Publish serialised messages, losing none.

    With keep all on both ends this waits for slow subscriptions, and for a killed one until its
    lease ends: 10 s with Cyclone DDS, 20 s with Fast DDS.

    Args:
        publisher: Publisher that keeps all.
        payloads: Messages.

    Raises:
        ImuCalibError: The middleware refuses one for good (rclpy: RCLError, after 30 s).
    """
    publisher.writer.write_all(payloads)


def acknowledged(publisher: Publisher, timeout_sec: float) -> bool:
    """Wait until all reliable subscriptions have all messages of a publisher.

    Args:
        publisher: Publisher.
        timeout_sec: Longest wait, s.

    Returns:
        Whether they have.
    """
    return publisher.writer.acknowledged(int(timeout_sec * 1e9))
