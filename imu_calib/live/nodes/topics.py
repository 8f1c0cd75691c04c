"""The quality of service of the suite's topics; each call returns a new profile."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from ...common.stream import Block, SetpointBlock
from ...estimation.setup import Setup
from ...recordings.cdr import Malformed
from ...recordings.cdr_codec import Kind
from ...session.units_file import MOST_UNITS
from .. import middleware as ros
from ..middleware import (
    DurabilityPolicy,
    HistoryPolicy,
    Node,
    QoSOverridingOptions,
    QoSProfile,
    ReliabilityPolicy,
    messages,
)
from ..network import LONGEST_LEASE
from ..web.board import Board, UnitsBoard


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


def own_topic() -> QoSProfile:
    """Return the profile for detecting other publishers on a node's own topics."""
    return QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)


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
            node.create_subscription(kind, name, receive, own_topic(), raw=True)
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


# Subscriptions of a calibrator: one topic of each kind, with the offered quality of service.
#
# The table has its topics; each of several units has its own in its namespace.


_MOST = 4096
"""Messages taken per call: one second at 4 kHz, so that other callbacks can run."""
_TOPICS = {
    Kind.SETPOINTS: ('turntable/setpoint', messages.TurntableSetpoint),
    Kind.JOINTS: ('turntable/joint_states', messages.JointState),
    Kind.TEMPERATURES: ('imu/temperature', messages.Temperature),
    Kind.IMU: ('imu/pulses', messages.Imu),
    Kind.SKEW: ('imu/skew', messages.Imu),
}
_OF_THE_TABLE = (Kind.SETPOINTS, Kind.JOINTS)


def topics_of_table(setup: Setup) -> dict[Kind, str]:
    """Return the names of the table's topics by content; empty without a table."""
    kinds = _OF_THE_TABLE if setup.table is not None else ()
    return {kind: _TOPICS[kind][0] for kind in kinds}


def topics_of_unit(setup: Setup, namespace: str = '', imu_topic: str = '') -> dict[Kind, str]:
    """Return the names of a unit's topics by content.

    Args:
        setup: States whether the unit has a skewed gyro.
        namespace: Of the unit; empty for a single one.
        imu_topic: Topic of its samples; empty: imu/pulses.
    """
    kinds = [kind for kind in _TOPICS if kind not in _OF_THE_TABLE]
    if setup.imu.skewed is None:
        kinds.remove(Kind.SKEW)
    names = {kind: '/'.join(filter(None, [namespace, _TOPICS[kind][0]])) for kind in kinds}
    return {**names, Kind.IMU: imu_topic or names[Kind.IMU]}


class Subscriptions:
    """Subscriptions that are drained.

    Args:
        node: The node that subscribes.
        topics: Names by content.

    Attributes:
        topics: Their full names.
    """

    def __init__(self, node: ros.Node, topics: Mapping[Kind, str]) -> None:
        self._node = node
        self._names = dict(topics)
        self.topics = {kind: node.resolve_topic_name(name) for kind, name in topics.items()}
        self._unreliable: set[Kind] = set()
        self._drains = {kind: self._open(kind, reliable=True) for kind in topics}
        self._two_since: float | None = None

    def received(self) -> Iterator[tuple[Kind, list[bytes]]]:
        """Yield the new serialised messages, grouped by kind."""
        for kind, subscription in self._drains.items():
            payloads = ros.drain(subscription, _MOST)
            if payloads:
                yield kind, payloads

    def begin(self) -> None:
        """Begin a session: earlier publishers do not count."""
        self._two_since = None

    @property
    def two_devices(self) -> bool:
        """Whether the IMU's topic has more than one publisher."""
        return bool(self._node.count_publishers(self.topics[Kind.IMU]) > 1)

    def two_devices_persist(self) -> bool:
        """Return whether there are two for long: a killed one stays listed until its lease ends."""
        if not self.two_devices:
            self._two_since = None
            return False
        now = time.monotonic()
        if self._two_since is None:
            self._two_since = now
        return now - self._two_since > ros.LEASE

    def subscribe_anew(self) -> list[str]:
        """Subscribe best effort to best-effort publishers; return their topics."""
        found = list(self._unreliable)
        for kind in found:
            self._node.destroy_subscription(self._drains[kind])
            self._drains[kind] = self._open(kind, reliable=False)
        self._unreliable.clear()
        return [self.topics[kind] for kind in found]

    def _open(self, kind: Kind, *, reliable: bool) -> Any:
        """Subscribe to a topic; note a publisher that offers best effort alone."""
        topic, message = self._names[kind], _TOPICS[kind][1]

        def incompatible(_: Any) -> None:
            self._unreliable.add(kind)

        return ros.open_drain(
            self._node,
            message,
            topic,
            stream(reliable=reliable),
            event_callbacks=ros.SubscriptionEventCallbacks(incompatible_qos=incompatible),
            # Messages of the first subscription must not make the second one reliable.
            qos_overriding_options=overridable() if reliable else None,
        )


@dataclass(eq=False)
class TopicIntake:
    """One topic of the session."""

    kind: Kind  #: Content of the topic.
    topic: str  #: Full name.
    malformed: Malformed  #: Number of messages that could not be read.
    received_at: float  #: When the newest came, s of the steady clock.
    count: int = 0  #: Number of samples, those of the journal included.
    #: Number of joint states that lack a joint of the table, or setpoints of another plan.
    ignored: int = 0
    oldest: int | None = None  #: Stamp of the first, ns; None before it.
    newest: int | None = None  #: Stamp of the newest, ns; None before the first.

    def note(self, block: Block, *, strange: bool) -> None:
        """Count a block; a foreign one, for instance of other joints, is ignored."""
        if strange:
            self.ignored += len(block)
            return
        self.count += len(block)
        if isinstance(block, SetpointBlock):
            self.newest = block.setpoints[-1].stamp if block.setpoints else self.newest
        elif len(block):
            self.oldest = int(block.stamp[0]) if self.oldest is None else self.oldest
            self.newest = int(block.stamp[-1])


def listen_to_each(node: ros.Node, board: UnitsBoard) -> None:
    """Subscribe to calibration and calibration/progress of every unit.

    Args:
        node: The node that subscribes.
        board: Receives the messages.
    """
    for name, own in board.each.items():
        node.create_subscription(
            messages.CalibrationProgress,
            f'{name}/calibration/progress',
            partial(_take, own),
            latched(),
        )
        node.create_subscription(
            messages.ImuCalibration, f'{name}/calibration', own.take_calibration, latched()
        )


def _take(board: Board, message: Any) -> None:
    board.take_progress(message, time.monotonic())
