"""Quality of service: rclpy's names, and their equivalents in DDS."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum, IntEnum
from typing import TYPE_CHECKING, Any

from ....common.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

INFINITE = 2**63 - 1
"""Longest duration, ns: DDS's infinity."""


class ReliabilityPolicy(IntEnum):
    """Whether lost messages are sent again."""

    RELIABLE = 1
    BEST_EFFORT = 2


class DurabilityPolicy(IntEnum):
    """Whether late subscribers receive earlier messages."""

    TRANSIENT_LOCAL = 1
    VOLATILE = 2


class HistoryPolicy(IntEnum):
    """How many messages wait for a slow reader."""

    KEEP_LAST = 1
    KEEP_ALL = 2


@dataclass
class QoSProfile:
    """The subset of rclpy's profile: history, depth, reliability and durability."""

    history: HistoryPolicy = HistoryPolicy.KEEP_LAST
    depth: int = 0
    reliability: ReliabilityPolicy = ReliabilityPolicy.RELIABLE
    durability: DurabilityPolicy = DurabilityPolicy.VOLATILE

    def __post_init__(self) -> None:
        """Refuse a history without a length, as rclpy does."""
        if self.history == HistoryPolicy.KEEP_LAST and self.depth < 1:
            raise InputError(
                f'A QoSProfile has the depth {self.depth}, expected 1 or more, or KEEP_ALL.'
            )


qos_profile_sensor_data = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)


class QoSPolicyKind(IntEnum):
    """Policies that a parameter may override, and names of incompatible ones."""

    DURABILITY = 1 << 1
    RELIABILITY = 1 << 4
    HISTORY = 1 << 5
    DEPTH = 1 << 11


@dataclass(frozen=True)
class QoSOverridingOptions:
    """Policies of an endpoint that parameters may override.

    The parameters are `qos_overrides.<topic>.<publisher|subscription>.<policy>`, as in ROS.
    """

    policy_kinds: Sequence[QoSPolicyKind]

    @classmethod
    def with_default_policies(cls) -> QoSOverridingOptions:
        """Allow history, depth and reliability to be overridden."""
        return cls((QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY))


@dataclass(frozen=True)
class QoSIncompatibleInfo:
    """Number of mismatched peers, and the policy of the last one."""

    total_count: int
    total_count_change: int
    last_policy_kind: int


@dataclass
class SubscriptionEventCallbacks:
    """Callbacks of a subscription for a publisher that offers less than it requests."""

    incompatible_qos: Callable[[QoSIncompatibleInfo], None] | None = None


@dataclass(frozen=True)
class TopicEndpointInfo:
    """One publisher or subscription of a topic, as in rclpy's class of that name."""

    node_name: str  #: Name of its node.
    node_namespace: str  #: Namespace of its node.
    topic_type: str  #: For instance std_msgs/msg/Bool.
    endpoint_gid: list[int]  #: 16 bytes; the first twelve are those of its participant.
    qos_profile: QoSProfile  #: Offered or requested reliability and durability.


def profile(qos: QoSProfile | int) -> QoSProfile:
    """Return a profile; a number is the depth of a reliable, volatile one."""
    return QoSProfile(depth=qos) if isinstance(qos, int) else replace(qos)


_ENUMS: dict[str, type[Enum]] = {
    'history': HistoryPolicy,
    'reliability': ReliabilityPolicy,
    'durability': DurabilityPolicy,
}


def overridden(
    qos: QoSProfile,
    options: QoSOverridingOptions | None,
    prefix: str,
    declare: Callable[[str, Any], Any],
) -> QoSProfile:
    """Apply the parameters that override a profile; `prefix` begins their names."""
    if options is None:
        return qos
    values: dict[str, Any] = {}
    for kind in options.policy_kinds:
        name = kind.name.lower()
        known = _ENUMS.get(name)
        now = getattr(qos, name)
        value = declare(f'{prefix}.{name}', now if known is None else now.name.lower())
        if known is not None:
            if value.upper() not in known.__members__:
                words = ', '.join(m.lower() for m in known.__members__)
                raise InputError(f'Parameter {prefix}.{name} is {value!r}, expected {words}.')
            value = known[value.upper()]
        values[name] = value
    return replace(qos, **values)


def to_dds(qos: QoSProfile, user_data: str) -> Any:
    """Return the wheel's Qos of a profile; discovery sends `user_data`, mainly the type hash."""
    from cyclonedds.qos import Policy, Qos

    keep_all = qos.history is HistoryPolicy.KEEP_ALL
    history = Policy.History.KeepAll if keep_all else Policy.History.KeepLast(qos.depth)
    policies = [
        history,
        # A reliable writer waits for a slow reader without limit, as in ROS.
        Policy.Reliability.Reliable(max_blocking_time=INFINITE)
        if qos.reliability == ReliabilityPolicy.RELIABLE
        else Policy.Reliability.BestEffort,
        Policy.DataRepresentation(use_cdrv0_representation=True),
        Policy.WriterDataLifecycle(autodispose=False),
        Policy.IgnoreLocal.Nothing,
        Policy.Userdata(user_data.encode()),
    ]
    if qos.durability == DurabilityPolicy.TRANSIENT_LOCAL:
        # The history for late subscribers is that of the durability service, not the one above.
        policies += [
            Policy.Durability.TransientLocal,
            Policy.DurabilityService(0, history, -1, -1, -1),
        ]
    else:
        policies.append(Policy.Durability.Volatile)
    return Qos(*policies)


def from_dds(qos: Any) -> QoSProfile:
    """Return reliability and durability of an endpoint as discovery reports them."""
    from cyclonedds.qos import Policy

    best_effort = Policy.Reliability.BestEffort in qos
    volatile = Policy.Durability.Volatile in qos
    return QoSProfile(
        history=HistoryPolicy.KEEP_ALL,
        reliability=ReliabilityPolicy.BEST_EFFORT if best_effort else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.VOLATILE if volatile else DurabilityPolicy.TRANSIENT_LOCAL,
    )
