"""The topics that are one node's alone: what it publishes, and who else does."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

from ..middleware import Node
from . import qos
from .publishers import OnePublisher

_REMEMBERED = 256
"""So many messages may be on their way back to the node that sent them."""


class OwnTopics:
    """Watches that topics have one publisher, and tells own messages from those of others.

    Args:
        node: The one whose topics they are.
        own: Message types by the names of the topics that the node publishes.
        others: Names of those that one other node publishes.
        on_foreign: Called with name and bytes of a message on an own topic that another sent.

    """

    def __init__(
        self,
        node: Node,
        own: dict[str, Any],
        others: Iterable[str],
        on_foreign: Callable[[str, bytes], None],
    ) -> None:
        self._on_foreign = on_foreign
        self._sent: deque[bytes] = deque(maxlen=_REMEMBERED)
        for name, kind in own.items():
            hear = partial(self._hear, name)
            node.create_subscription(kind, name, hear, qos.own_topic(), raw=True)
        self._watched = {
            name: OnePublisher(node, node.resolve_topic_name(name)) for name in (*others, *own)
        }

    def publish(self, publisher: Any, payload: bytes) -> None:
        """Publish on an own topic, and know the message again."""
        self._sent.append(_content(payload))
        publisher.publish(payload)

    def look(self, now: float) -> dict[str, str]:
        """Return what is wrong by topic, in sentences, at a time of the steady clock, s."""
        return {name: watched.look(now) for name, watched in self._watched.items()}

    def heard_two(self, name: str, now: float) -> None:
        """Take it that a topic has a second publisher, whatever is seen of it."""
        self._watched[name].heard_two(now)

    def is_alone(self, name: str, now: float) -> bool:
        """Tell whether a topic has had one publisher for a while."""
        return self._watched[name].is_alone(now)

    def _hear(self, name: str, payload: bytes) -> None:
        payload = bytes(payload)
        if _content(payload) not in self._sent:
            self._on_foreign(name, payload)


def _content(payload: bytes) -> bytes:
    """Return a serialised message without what the middleware may add: padding, and its length."""
    return payload[4:].rstrip(b'\0')
