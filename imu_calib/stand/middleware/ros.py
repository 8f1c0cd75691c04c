"""rclpy under the names that the nodes use, and the functions that it lacks."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from importlib import import_module
from itertools import repeat
from typing import Any

import rclpy
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
)
from rclpy import (
    ok,
    shutdown,
    spin,
    spin_once,
    spin_until_future_complete,
    try_shutdown,
)
from rclpy.action import ActionClient
from rclpy.callback_groups import CallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.exceptions import (
    InvalidParameterTypeException,
    ParameterAlreadyDeclaredException,
    ParameterNotDeclaredException,
)
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    QoSPolicyKind,
    QoSProfile,
    ReliabilityPolicy,
    qos_profile_sensor_data,
)
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.signals import SignalHandlerOptions
from rclpy.time import Time
from rclpy.utilities import get_rmw_implementation_identifier
from std_srvs.srv import Trigger

from ...common.errors import InputError
from ..network import LEASES, LONGEST_LEASE
from . import ros_sources
from .beside import Beside
from .interface_types import ACTIONS, MESSAGES, InterfaceTypes
from .ros_actions import GoalServer
from .ros_lifecycle import ManagedNode
from .running import domain_id as checked_domain

__all__ = [
    'LEASE',
    'ActionClient',
    'Clock',
    'ClockType',
    'DurabilityPolicy',
    'ExternalShutdownException',
    'FloatingPointRange',
    'GoalServer',
    'HistoryPolicy',
    'IntegerRange',
    'InvalidParameterTypeException',
    'ManagedNode',
    'Node',
    'ParameterAlreadyDeclaredException',
    'ParameterDescriptor',
    'ParameterNotDeclaredException',
    'QoSOverridingOptions',
    'QoSPolicyKind',
    'QoSProfile',
    'ReliabilityPolicy',
    'SingleThreadedExecutor',
    'SubscriptionEventCallbacks',
    'Time',
    'Trigger',
    'acknowledged',
    'actions',
    'deserialize_message',
    'drain',
    'drain_sources',
    'in_step',
    'init',
    'messages',
    'ok',
    'open_drain',
    'open_stream',
    'parameter_names',
    'publish_all',
    'qos_profile_sensor_data',
    'run_beside',
    'serialize_message',
    'shutdown',
    'spin',
    'spin_once',
    'spin_until_future_complete',
    'try_shutdown',
]

_AT_ONCE = 4096
"""Messages taken per call, so that other callbacks can run."""

LEASE = LEASES.get(get_rmw_implementation_identifier(), LONGEST_LEASE)

RCLError = rclpy_implementation.RCLError
UnknownROSArgsError = rclpy_implementation.UnknownROSArgsError


def _interface(name: str) -> Any:
    package, kind, short = name.split('/')
    try:
        return getattr(import_module(f'{package}.{kind}'), short)
    except (ImportError, AttributeError) as error:
        raise InputError(
            f'The interface {name} is not installed: {error}. Install the package {package} '
            '(rosdep install --from-paths src --ignore-src), or rebuild it.'
        ) from error


messages = InterfaceTypes(MESSAGES, _interface)
actions = InterfaceTypes(ACTIONS, _interface)


def init(**options: Any) -> None:
    """Initialise rclpy without its signal handlers, which would end the context at once.

    Args:
        **options: Arguments of rclpy.init.

    Raises:
        InputError: ROS_DOMAIN_ID is out of range, or --ros-args is invalid.
    """
    checked_domain()
    options.setdefault('signal_handler_options', SignalHandlerOptions.NO)
    try:
        rclpy.init(**options)
    except (RCLError, UnknownROSArgsError) as error:
        raise InputError(f'rclpy does not start: {error}') from error


class _Never(CallbackGroup):  # type: ignore[misc]
    """Excludes drained subscriptions from the executor."""

    def can_execute(self, entity: Any) -> bool:  # noqa: ARG002
        return False

    def beginning_execution(self, entity: Any) -> bool:  # noqa: ARG002
        return False

    def ending_execution(self, entity: Any) -> None:
        pass


def open_drain(node: Any, msg_type: Any, topic: str, qos_profile: Any, **options: Any) -> Any:
    """Subscribe without a callback; see `dds.drains.open_drain`."""
    return node.create_subscription(
        msg_type,
        topic,
        lambda _: None,
        qos_profile,
        raw=True,
        callback_group=_Never(),
        **options,
    )


def open_stream(
    node: Any,
    msg_type: Any,
    topic: str,
    callback: Callable[[list[bytes]], Any],
    qos_profile: Any,
    **options: Any,
) -> Any:
    """Subscribe with a callback that takes all that has arrived; see `dds.drains.open_stream`."""
    subscription: Any = None

    def take(payload: bytes) -> None:
        # The executor has taken the oldest; take newer ones without another round of it.
        callback([payload, *drain(subscription, _AT_ONCE)])

    subscription = node.create_subscription(msg_type, topic, take, qos_profile, raw=True, **options)
    return subscription


def drain(subscription: Any, most: int | None = None) -> list[bytes]:
    """Return what has arrived, serialised, oldest first; see `dds.drains.drain`."""
    payloads: list[bytes] = []
    handle, kind = subscription.handle, subscription.msg_type
    with handle:
        # As rclpy's own wait_for_message does; a callback per message is twenty times slower.
        take = handle.take_message
        for _ in repeat(None) if most is None else repeat(None, most):
            taken = take(kind, True)
            if taken is None:
                break
            payloads.append(taken[0])
    return payloads


def drain_sources(subscription: Any) -> list[tuple[bytes, bytes]]:
    """Return what has arrived with its publishers; see `dds.drains.drain_sources`."""
    taken: list[tuple[bytes, bytes]] = []
    handle = subscription.handle
    with handle:
        while len(taken) < _AT_ONCE and (one := ros_sources.take(handle)) is not None:
            taken.append(one)
    return taken


def publish_all(publisher: Any, payloads: Iterable[bytes]) -> None:
    """Publish serialised messages without losses; see `dds.drains.publish_all`."""
    for payload in payloads:
        until = time.monotonic() + LONGEST_LEASE
        while True:
            try:
                publisher.publish(payload)
                break
            except RCLError:
                # Fast DDS waits a tenth of a second for room in the history, then refuses: a killed
                # reader takes nothing until its lease ends.
                if time.monotonic() > until or not ok():
                    raise


def acknowledged(publisher: Any, timeout_sec: float) -> bool:
    """Wait until all reliable subscriptions have all messages; return whether they have."""
    return bool(publisher.wait_for_all_acked(Duration(seconds=timeout_sec)))


run_beside = Beside


def in_step() -> bool:
    """Return False: see `dds.clock.in_step`."""
    return False


def parameter_names(node: Any) -> tuple[list[str], list[str]]:
    """Return the names of a node's parameters: those given, and those declared."""
    return list(node._parameter_overrides), list(node._parameters)
