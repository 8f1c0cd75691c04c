"""Who is there: the nodes of this process told to the others, and theirs to us."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from .codec import deserialize_message, serialize_message
from .messages import message_class
from .qos import DurabilityPolicy, HistoryPolicy, QoSProfile
from .wire import Reader, Writer, delete

if TYPE_CHECKING:
    from .context import Context

_TOPIC = 'ros_discovery_info'
_TYPE = 'rmw_dds_common/msg/ParticipantEntitiesInfo'


class Graph:
    """The ROS graph as one participant sees it."""

    def __init__(self, context: Context) -> None:
        from cyclonedds.builtin import (
            BuiltinDataReader,
            BuiltinTopicDcpsPublication,
            BuiltinTopicDcpsSubscription,
        )

        self._context = context
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        everything = QoSProfile(
            history=HistoryPolicy.KEEP_ALL, durability=DurabilityPolicy.TRANSIENT_LOCAL
        )
        self._writer = Writer(context, _TOPIC, _TYPE, latched)
        self._reader = Reader(context, _TOPIC, _TYPE, everything)
        participant = context.participant
        self._publications = BuiltinDataReader(participant, BuiltinTopicDcpsPublication)
        self._subscriptions = BuiltinDataReader(participant, BuiltinTopicDcpsSubscription)
        self._participants: dict[bytes, list[tuple[str, str]]] = {}

    def announce(self) -> None:
        """Tell the other participants which nodes and endpoints are in this one."""
        gid = message_class('rmw_dds_common/msg/Gid')
        node_info = message_class('rmw_dds_common/msg/NodeEntitiesInfo')
        nodes = [
            node_info(
                node_namespace=node.get_namespace(),
                node_name=node.get_name(),
                reader_gid_seq=[gid(data=list(r.gid)) for r in node.readers()],
                writer_gid_seq=[gid(data=list(w.gid)) for w in node.writers()],
            )
            for node in self._context.nodes
        ]
        own = gid(data=list(self._context.participant.get_guid().bytes))
        info = message_class(_TYPE)(gid=own, node_entities_info_seq=nodes)
        self._writer.write(serialize_message(info))

    def nodes(self) -> list[tuple[str, str]]:
        """Return (name, namespace) of every node that is there, those of this process too."""
        for payload in self._reader.drain():
            info = deserialize_message(payload, message_class(_TYPE))
            listed = [(n.node_name, n.node_namespace) for n in info.node_entities_info_seq]
            self._participants[bytes(info.gid.data)] = listed
        alive = {e.participant_key.bytes for e in self._endpoints(self._publications)}
        return [n for gid, nodes in self._participants.items() if gid in alive for n in nodes]

    def count_writers(self, topic: str) -> int:
        """Return how many writers a DDS topic has."""
        return sum(e.topic_name == topic for e in self._endpoints(self._publications))

    def count_readers(self, topic: str) -> int:
        """Return how many readers a DDS topic has."""
        return sum(e.topic_name == topic for e in self._endpoints(self._subscriptions))

    def close(self) -> None:
        """Leave the discovery topics."""
        self._writer.delete()
        self._reader.delete()
        delete(self._publications)
        delete(self._subscriptions)

    def _endpoints(self, reader: Any) -> list[Any]:
        from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState

        mask = ViewState.Any | InstanceState.Alive | SampleState.Any
        condition = ReadCondition(reader, mask)
        try:
            return list(reader.read(N=10_000, condition=condition))
        finally:
            delete(condition)
