"""Quality of service of the suite's topics, and who publishes on them."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

from ...session.units_file import MOST_UNITS
from ..middleware import (
    DurabilityPolicy,
    HistoryPolicy,
    Node,
    QoSOverridingOptions,
    QoSProfile,
    ReliabilityPolicy,
)
from ..network import LONGEST_LEASE


def stream(*, reliable: bool = True) -> QoSProfile:
    """Return the profile of sample streams: keep all on both ends loses nothing."""
    reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
    return QoSProfile(history=HistoryPolicy.KEEP_ALL, reliability=reliability)


def sensor_data() -> QoSProfile:
    """Return ROS's profile of sensor data as a new object: overrides must not change ROS's own."""
    return QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)


def overridable() -> QoSOverridingOptions:
    """Return what parameters may change in a sample stream: history, depth, reliability.

    Commands and latched states have no such parameters: the stand's safety requires volatile
    setpoints and latched states.
    """
    return QoSOverridingOptions.with_default_policies()


def command() -> QoSProfile:
    """Return the profile of setpoints: only the last counts, and late subscribers receive none."""
    return QoSProfile(depth=1)


def latched(depth: int = 1) -> QoSProfile:
    """Return the profile of states and results: late subscribers receive the last ones."""
    return QoSProfile(depth=depth, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def results() -> QoSProfile:
    """Return the profile for the final results of several units, which come all at once."""
    return latched(MOST_UNITS)


def as_offered(offered: QoSProfile) -> QoSProfile:
    """Return the profile that receives all that a publisher offers, latched messages included."""
    return QoSProfile(depth=10, reliability=offered.reliability, durability=offered.durability)


def best_effort(topic: str) -> str:
    """Return the warning on a publisher that does not repeat what was lost."""
    return f'{topic} is published best effort: messages can be lost. Publish it reliably.'


def none_yet(topic: str) -> str:
    """Return the sentence on a topic without messages."""
    return f'There is no message on {topic} yet.'


def two_publishers(topic: str) -> str:
    """Return the sentence on samples of two devices, which cannot be told apart."""
    return f'Two publishers on {topic}: stop one of them.'


def observer_profile(depth: int) -> QoSProfile:
    """Return the profile of an observer: publishers do not wait for it, it may miss messages."""
    return QoSProfile(depth=depth, reliability=ReliabilityPolicy.BEST_EFFORT)


_NAMELESS = 2.0
"""s by which a node's name may appear later than its publishers. A judgement."""

_FRESH = 3.0
"""s for which a second publisher counts after it left: its messages may still arrive."""

_HELD = 'The table is held, and nothing starts while this lasts.'
_UNKNOWN = ('_NODE_NAME_UNKNOWN_', '_CREATED_BY_BARE_DDS_APP_')
_PARTICIPANT = 12
"""Length of the participant's prefix in an endpoint's GUID, bytes (RTPS 2.5, 9.3.1)."""


class OnePublisher:
    """Detects more than one publisher on a topic.

    Two nodes with different names are both alive, and so are two publishers of one participant. If
    two have the same name in different participants, one may be a killed process that was
    restarted: they count as two when messages of both arrive (`note_two_sources`), or when both are
    listed for longer than the killed one's lease.
    """

    def __init__(self, node: Any, topic: str, consequence: str = _HELD) -> None:
        self._node = node
        self.topic = topic
        self._consequence = consequence
        self._since: float | None = None
        self._two_sources_at = self._two_at = -math.inf

    def note_two_sources(self, now: float) -> None:
        """Record that messages of two sources arrived, at a time of the steady clock, s."""
        self._two_sources_at = now

    def is_alone(self, now: float) -> bool:
        """Return whether messages come from one node: for some seconds there was one publisher."""
        return not self.fault(now) and now - self._two_at > _FRESH

    def fault(self, now: float) -> str:
        """Return the fault, in sentences with the nodes' names; empty with one publisher."""
        listed = self._node.get_publishers_info_by_topic(self.topic)
        two_sources = now - self._two_sources_at <= _FRESH
        if len(listed) < 2:
            self._since = None
            gone = (
                f'A second node published on {self.topic} and has ended since. {self._consequence}'
            )
            return gone if two_sources else ''
        self._since = now if self._since is None else self._since
        if not (two_sources or self._are_two(listed, now - self._since)):
            return ''
        self._two_at = now
        names = ', '.join(names_of(listed))
        return (
            f'{len(listed)} publishers are on {self.topic}: {names}. {self._consequence} End all '
            'but one; a process that was killed is listed for up to 20 s.'
        )

    def _are_two(self, listed: list[Any], seconds: float) -> bool:
        """Return whether the listed publishers, for so many seconds, are of two nodes."""
        participants = {bytes(p.endpoint_gid)[:_PARTICIPANT] for p in listed}
        known = {_name(p) for p in listed if p.node_name not in _UNKNOWN}
        nameless = any(p.node_name in _UNKNOWN for p in listed)
        return (
            len(participants) < len(listed)
            or len(known) > 1
            or (nameless and seconds > _NAMELESS)
            or seconds > LONGEST_LEASE
        )


def names_of(listed: list[Any]) -> list[str]:
    """Return the names of the publishers' nodes, in order."""
    return sorted(_name(publisher) for publisher in listed)


def _name(publisher: Any) -> str:
    if publisher.node_name in _UNKNOWN:
        return 'a node without a name'
    return f'{publisher.node_namespace.rstrip("/")}/{publisher.node_name}'


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
            node.create_subscription(kind, name, receive, observer_profile(100), raw=True)
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
