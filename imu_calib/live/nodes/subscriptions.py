"""Subscriptions of a calibrator: one topic of each kind, with the offered quality of service.

The table has its topics; each of several units has its own in its namespace.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from ...common.stream import Block, SetpointBlock
from ...estimation.setup import Setup
from ...recordings.cdr import Malformed
from ...recordings.cdr_codec import Kind
from .. import middleware as ros
from ..middleware import (
    messages,
)
from ..web.board import Board, UnitsBoard
from .qos import latched, overridable, stream

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
            partial(_on_progress, own),
            latched(),
        )
        node.create_subscription(
            messages.ImuCalibration, f'{name}/calibration', own.on_calibration, latched()
        )


def _on_progress(board: Board, message: Any) -> None:
    board.on_progress(message, time.monotonic())
