"""Who publishes on a topic that only one node may publish."""

from __future__ import annotations

import math
from typing import Any

from ..network import LONGEST_LEASE

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

    Args:
        node: Queries the graph.
        topic: Full name.
    """

    def __init__(self, node: Any, topic: str) -> None:
        self._node = node
        self.topic = topic
        self._since: float | None = None
        self._two_sources_at = self._two_at = -math.inf

    def note_two_sources(self, now: float) -> None:
        """Record that messages of two sources arrived, at a time of the steady clock, s."""
        self._two_sources_at = now

    def is_alone(self, now: float) -> bool:
        """Return whether messages come from one node: for some seconds there was one publisher."""
        return not self.fault(now) and now - self._two_at > _FRESH

    def fault(self, now: float) -> str:
        """Return the fault, in sentences with the nodes' names; empty with one publisher.

        Args:
            now: Of the steady clock, s.
        """
        listed = self._node.get_publishers_info_by_topic(self.topic)
        two_sources = now - self._two_sources_at <= _FRESH
        if len(listed) < 2:
            self._since = None
            gone = f'A second node published on {self.topic} and has ended since. {_HELD}'
            return gone if two_sources else ''
        self._since = now if self._since is None else self._since
        if not (two_sources or self._are_two(listed, now - self._since)):
            return ''
        self._two_at = now
        names = ', '.join(names_of(listed))
        return (
            f'{len(listed)} publishers are on {self.topic}: {names}. {_HELD} End all but one; a '
            'process that was killed is listed for up to 20 s.'
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
