"""Topics that only one node may publish: check for other publishers."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

from ..middleware import Node
from . import qos
from .publishers import OnePublisher

_KEPT = 256
"""Most messages that may be on their way back to the node that sent them. A judgement."""


class OwnTopics:
    """Checks that topics have one publisher, and separates own messages from foreign ones.

    Args:
        node: The node that owns the topics.
        own: Message types by the names of the topics that the node publishes.
        others: Names of topics that one other node publishes.
        on_foreign: Called with name and bytes of a foreign message on an own topic.
    """

    def __init__(
        self,
        node: Node,
        own: dict[str, Any],
        others: Iterable[str],
        on_foreign: Callable[[str, bytes], None],
    ) -> None:
        self._on_foreign = on_foreign
        self._sent: deque[bytes] = deque(maxlen=_KEPT)
        for name, kind in own.items():
            receive = partial(self._receive, name)
            node.create_subscription(kind, name, receive, qos.own_topic(), raw=True)
        self._watched = {
            name: OnePublisher(node, node.resolve_topic_name(name)) for name in (*others, *own)
        }

    def publish(self, publisher: Any, payload: bytes) -> None:
        """Publish on an own topic, and remember the message."""
        self._sent.append(_content(payload))
        publisher.publish(payload)

    def faults(self, now: float) -> dict[str, str]:
        """Return the fault of each topic, in sentences, at a time of the steady clock, s."""
        return {name: watched.fault(now) for name, watched in self._watched.items()}

    def note_two_sources(self, name: str, now: float) -> None:
        """Record that messages on a topic show a second publisher."""
        self._watched[name].note_two_sources(now)

    def is_alone(self, name: str, now: float) -> bool:
        """Return whether a topic has had one publisher for some time."""
        return self._watched[name].is_alone(now)

    def _receive(self, name: str, payload: bytes) -> None:
        payload = bytes(payload)
        if _content(payload) not in self._sent:
            self._on_foreign(name, payload)


def _content(payload: bytes) -> bytes:
    """Return a serialised message without what the middleware may add: padding, and its length."""
    return payload[4:].rstrip(b'\0')
