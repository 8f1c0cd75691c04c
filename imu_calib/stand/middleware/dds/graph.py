"""The nodes of the graph: own ones are announced, others are listed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from .message_types import deserialize_message, message_class, serialize_message
from .qos import DurabilityPolicy, HistoryPolicy, QoSProfile, from_dds
from .wire import WireParticipant, delete

if TYPE_CHECKING:
    from collections.abc import Iterable

_TOPIC = 'ros_discovery_info'
_TYPE = 'rmw_dds_common/msg/ParticipantEntitiesInfo'
_MOST = 256
"""Changes taken per call; further ones follow in the next iteration. The wheel allocates room for
this number each time."""
_ALIVE = 16
"""DDS_ALIVE_INSTANCE_STATE."""

UNKNOWN_NAME, UNKNOWN_NAMESPACE = '_NODE_NAME_UNKNOWN_', '_NODE_NAMESPACE_UNKNOWN_'
"""ROS's name for the node of an endpoint before the node is announced."""


@dataclass(frozen=True)
class TopicEndpointInfo:
    """One publisher or subscription of a topic, as in rclpy's class of that name."""

    node_name: str  #: Name of its node.
    node_namespace: str  #: Namespace of its node.
    topic_type: str  #: For instance std_msgs/msg/Bool.
    endpoint_gid: list[int]  #: 16 bytes; the first twelve are those of its participant.
    qos_profile: QoSProfile  #: Offered or requested reliability and durability.


class Graph:
    """The ROS graph as one participant sees it."""

    def __init__(self, participant: WireParticipant) -> None:
        from cyclonedds.builtin import (
            BuiltinDataReader,
            BuiltinTopicDcpsPublication,
            BuiltinTopicDcpsSubscription,
        )

        self._participant = participant
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        everything = QoSProfile(
            history=HistoryPolicy.KEEP_ALL, durability=DurabilityPolicy.TRANSIENT_LOCAL
        )
        self._writer = participant.writer(_TOPIC, _TYPE, latched)
        self._reader = participant.reader(_TOPIC, _TYPE, everything)
        entity = participant.entity
        self._publications = _Endpoints(BuiltinDataReader(entity, BuiltinTopicDcpsPublication))
        self._subscriptions = _Endpoints(BuiltinDataReader(entity, BuiltinTopicDcpsSubscription))
        self._participants: dict[bytes, list[Any]] = {}
        self._announcements = 0
        self._listed: dict[str, list[TopicEndpointInfo]] = {}
        self._listed_of = 0, 0

    def announce(self, own: Iterable[Any]) -> None:
        """Announce the nodes and endpoints of this participant to the others."""
        gid = message_class('rmw_dds_common/msg/Gid')
        node_info = message_class('rmw_dds_common/msg/NodeEntitiesInfo')
        nodes = [
            node_info(
                node_namespace=node.get_namespace(),
                node_name=node.get_name(),
                reader_gid_seq=[gid(data=list(r.gid)) for r in node.readers()],
                writer_gid_seq=[gid(data=list(w.gid)) for w in node.writers()],
            )
            for node in own
        ]
        here = gid(data=list(self._participant.entity.get_guid().bytes))
        info = message_class(_TYPE)(gid=here, node_entities_info_seq=nodes)
        self._writer.write(serialize_message(info))

    def nodes(self) -> list[tuple[str, str]]:
        """Return (name, namespace) of every present node, own ones included."""
        self._read_announcements()
        alive = {e.participant_key.bytes for e in self._publications.alive()}
        return [
            (node.node_name, node.node_namespace)
            for gid, nodes in self._participants.items()
            if gid in alive
            for node in nodes
        ]

    def writers(self, topic: str) -> list[TopicEndpointInfo]:
        """Return the writers of a DDS topic, own ones included."""
        endpoints = self._publications.alive()
        self._read_announcements()
        # Nodes ask ten times a second, but changes are rare.
        changes = self._publications.changes, self._announcements
        if changes != self._listed_of:
            self._listed_of = changes
            self._listed.clear()
        if topic not in self._listed:
            self._listed[topic] = self._described([e for e in endpoints if e.topic_name == topic])
        return list(self._listed[topic])

    def _described(self, endpoints: list[Any]) -> list[TopicEndpointInfo]:
        owners = {
            bytes(gid.data): (node.node_name, node.node_namespace)
            for nodes in self._participants.values()
            for node in nodes
            for gid in node.writer_gid_seq
        }
        unknown = UNKNOWN_NAME, UNKNOWN_NAMESPACE
        return [
            TopicEndpointInfo(
                *owners.get(e.key.bytes, unknown),
                _ros_type(e.type_name),
                list(e.key.bytes),
                from_dds(e.qos),
            )
            for e in endpoints
        ]

    def count_writers(self, topic: str) -> int:
        """Return the number of writers of a DDS topic."""
        return sum(e.topic_name == topic for e in self._publications.alive())

    def count_readers(self, topic: str) -> int:
        """Return the number of readers of a DDS topic."""
        return sum(e.topic_name == topic for e in self._subscriptions.alive())

    def close(self) -> None:
        """Leave the discovery topics."""
        self._writer.delete()
        self._reader.delete()
        self._publications.close()
        self._subscriptions.close()

    def _read_announcements(self) -> None:
        """Read the nodes that participants have announced."""
        for payload in self._reader.drain():
            info = deserialize_message(payload, message_class(_TYPE))
            self._participants[bytes(info.gid.data)] = list(info.node_entities_info_seq)
            self._announcements += 1


class _Endpoints:
    """All writers, or all readers, of a domain: only changes are read.

    Attributes:
        changes: Number of changes so far.
    """

    def __init__(self, reader: Any) -> None:
        from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState

        self._reader = reader
        self._condition = ReadCondition(reader, ViewState.Any | InstanceState.Any | SampleState.Any)
        self._known: dict[bytes, Any] = {}
        self.changes = 0

    def alive(self) -> list[Any]:
        """Return the endpoints that are alive."""
        while changes := self._reader.take(N=_MOST, condition=self._condition):
            self.changes += len(changes)
            for endpoint in changes:
                if endpoint.sample_info.instance_state != _ALIVE:
                    self._known.pop(endpoint.key.bytes, None)
                elif endpoint.sample_info.valid_data:
                    self._known[endpoint.key.bytes] = endpoint
        return list(self._known.values())

    def close(self) -> None:
        """Stop reading."""
        delete(self._condition)
        delete(self._reader)


def _ros_type(name: str) -> str:
    """Return a type in ROS notation: std_msgs::msg::dds_::Bool_ is std_msgs/msg/Bool."""
    return name.replace('::dds_::', '::').removesuffix('_').replace('::', '/')
