"""Who publishes on a topic that is one node's alone."""

from __future__ import annotations

import math
from typing import Any

GHOST = 25.0
"""How long a publisher that was killed may be listed, s: until its lease ends, 10 s with Cyclone
DDS, 20 s with Fast DDS, and some more for a machine that is busy."""

_NAMELESS = 2.0
"""A node's name comes a little later than its publishers, s."""

_FRESH = 3.0
"""For so long a second publisher counts that has left again, s: what it said may still come."""

_HELD = 'The table is held, and nothing starts while this lasts.'
_UNKNOWN = ('_NODE_NAME_UNKNOWN_', '_CREATED_BY_BARE_DDS_APP_')
_PARTICIPANT = 12
"""So many bytes of an endpoint's GUID are its participant's prefix (RTPS 2.5, 9.3.1)."""


class OnePublisher:
    """Says whether more than one publisher is on a topic.

    Of two nodes with different names both live, and so do two publishers of one participant. Of
    two that bear the same name, in different participants, one may be the process that was killed
    before the other was started anew: they count as two when both are heard (`heard_two`), and
    else when they are listed for longer than the killed one's lease.

    Args:
        node: Asks the graph.
        topic: Full name.

    """

    def __init__(self, node: Any, topic: str) -> None:
        self._node = node
        self.topic = topic
        self._since: float | None = None
        self._heard_two_at = self._two_at = -math.inf

    def heard_two(self, now: float) -> None:
        """Note that what comes shows two sources, at a time of the steady clock, s."""
        self._heard_two_at = now

    def is_alone(self, now: float) -> bool:
        """Say whether what comes is one node's word: for some seconds there was no other."""
        return not self.look(now) and now - self._two_at > _FRESH

    def look(self, now: float) -> str:
        """Return what is wrong, in sentences with the nodes' names; empty where one publishes.

        Args:
            now: Of the steady clock, s.

        """
        listed = self._node.get_publishers_info_by_topic(self.topic)
        heard_two = now - self._heard_two_at <= _FRESH
        if len(listed) < 2:
            self._since = None
            left = f'A node that has gone since published on {self.topic}. {_HELD}'
            return left if heard_two else ''
        self._since = now if self._since is None else self._since
        if not (heard_two or self._are_two(listed, now - self._since)):
            return ''
        self._two_at = now
        names = ', '.join(names_of(listed))
        return (
            f'{len(listed)} publishers are on {self.topic}: {names}. {_HELD} End all but one; a '
            'process that was killed is listed for up to 20 s.'
        )

    def _are_two(self, listed: list[Any], seconds: float) -> bool:
        participants = {bytes(p.endpoint_gid)[:_PARTICIPANT] for p in listed}
        known = {_name(p) for p in listed if p.node_name not in _UNKNOWN}
        nameless = any(p.node_name in _UNKNOWN for p in listed)
        return (
            len(participants) < len(listed)
            or len(known) > 1
            or (nameless and seconds > _NAMELESS)
            or seconds > GHOST
        )


def names_of(listed: list[Any]) -> list[str]:
    """Return the names of the nodes that publishers are of, in order."""
    return sorted(_name(publisher) for publisher in listed)


def _name(publisher: Any) -> str:
    if publisher.node_name in _UNKNOWN:
        return 'a node without a name'
    return f'{publisher.node_namespace.rstrip("/")}/{publisher.node_name}'
