"""What a calibrator listens to: one topic of each kind, by the quality of service it comes with."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

from .. import middleware as ros
from ..calibrator import Setup
from ..cdr import Kind
from ..middleware import messages
from . import qos

_MOST = 4096
"""Messages taken at once: one second at 4 kHz, so that other callbacks get their turn."""
_GHOST = 15.0
"""s: a publisher that was killed is seen until its lease ends, ten seconds with Cyclone DDS."""
_TOPICS = {
    Kind.SETPOINTS: ('turntable/setpoint', messages.TurntableSetpoint),
    Kind.JOINTS: ('turntable/joint_states', messages.JointState),
    Kind.TEMPERATURES: ('imu/temperature', messages.Temperature),
    Kind.IMU: ('imu/pulses', messages.Imu),
    Kind.SKEW: ('imu/skew', messages.Imu),
}
_OF_THE_TABLE = (Kind.SETPOINTS, Kind.JOINTS)


class Hearing:
    """Subscriptions that are drained, of all that a set-up has: no table, no joint states.

    Attributes:
        topics: Their full names.

    """

    def __init__(self, node: ros.Node, setup: Setup) -> None:
        self._node = node
        left_out = set() if setup.table is not None else set(_OF_THE_TABLE)
        if setup.imu.skewed is None:
            left_out.add(Kind.SKEW)
        kinds = [kind for kind in _TOPICS if kind not in left_out]
        self.topics = {kind: node.resolve_topic_name(_TOPICS[kind][0]) for kind in kinds}
        self._unreliable: set[Kind] = set()
        self._drains = {kind: self._open(kind, reliable=True) for kind in kinds}
        self._two_since: float | None = None

    def take(self) -> Iterator[tuple[Kind, list[bytes]]]:
        """Yield the serialised messages that have come since, those of a kind together."""
        for kind, subscription in self._drains.items():
            payloads = ros.drain(subscription, _MOST)
            if payloads:
                yield kind, payloads

    def begin(self) -> None:
        """Begin a session: who published before does not count."""
        self._two_since = None

    @property
    def two_devices(self) -> bool:
        """Whether more than one publisher of the IMU's topic is seen."""
        return bool(self._node.count_publishers(self.topics[Kind.IMU]) > 1)

    def two_devices_stay(self) -> bool:
        """Tell whether they are two for long: one that was killed is seen for ten seconds more."""
        if not self.two_devices:
            self._two_since = None
            return False
        now = time.monotonic()
        if self._two_since is None:
            self._two_since = now
        return now - self._two_since > _GHOST

    def subscribe_anew(self) -> list[str]:
        """Take what a publisher offers that does not send again what is lost; return its topics."""
        found = list(self._unreliable)
        for kind in found:
            self._node.destroy_subscription(self._drains[kind])
            self._drains[kind] = self._open(kind, reliable=False)
        self._unreliable.clear()
        return [self.topics[kind] for kind in found]

    def _open(self, kind: Kind, *, reliable: bool) -> Any:
        topic, message = _TOPICS[kind]

        def incompatible(_: Any) -> None:
            self._unreliable.add(kind)

        return ros.open_drain(
            self._node,
            message,
            topic,
            qos.stream(reliable=reliable),
            event_callbacks=ros.SubscriptionEventCallbacks(incompatible_qos=incompatible),
            # The second subscription of a topic is not to be made reliable by what the first took.
            qos_overriding_options=qos.overridable() if reliable else None,
        )
