"""rclpy under the names that the nodes use, and the functions that it lacks."""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable, Iterable
from functools import cache
from importlib import import_module
from itertools import repeat
from typing import Any

import rclpy
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy import (
    get_global_executor,
    ok,
    shutdown,
    spin,
    spin_once,
    spin_until_future_complete,
    try_shutdown,
)
from rclpy.action import ActionClient, ActionServer, CancelResponse, GoalResponse
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
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
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

from ...common.errors import ImuCalibError, InputError
from ..network import LEASES, LONGEST_LEASE
from ..network import domain_id as checked_domain
from .shared import ACTIONS, MESSAGES, GoalStatus, InterfaceTypes, WorkerThread

# As `dds` lists them, which cannot be loaded here: under ROS there is no rosbags.
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

# The publisher of a message under rclpy: rcl has it, rclpy of Jazzy does not pass it on.
#
# The struct is rmw_message_info_t of rmw/types.h, unchanged since Galactic: two times, two sequence
# numbers, then the publisher's identifier. Every message is checked for this by the middleware's
# name in front of the identifier.


_ROOM = 512
"""Bytes for the struct: several times its size in Jazzy (64), so that a longer one fits too."""
_GID = 16
"""Bytes of an identifier (RMW_GID_STORAGE_SIZE in Jazzy; longer ones end in zeros)."""


class _Allocator(ctypes.Structure):
    _fields_ = [(f'entry_{k}', ctypes.c_void_p) for k in range(5)]


class _Serialized(ctypes.Structure):
    _fields_ = [
        ('buffer', ctypes.c_void_p),
        ('length', ctypes.c_size_t),
        ('capacity', ctypes.c_size_t),
        ('allocator', _Allocator),
    ]


class _Info(ctypes.Structure):
    _fields_ = [
        ('times', ctypes.c_int64 * 2),
        ('numbers', ctypes.c_uint64 * 2),
        ('middleware', ctypes.c_char_p),
        ('gid', ctypes.c_uint8 * _GID),
        ('rest', ctypes.c_uint8 * (_ROOM - 40 - _GID)),
    ]


@cache
def _libraries() -> tuple[Any, Any]:
    """Return rcl and rcutils, which rclpy has loaded already."""
    rcl, rcutils = ctypes.CDLL('librcl.so'), ctypes.CDLL('librcutils.so')
    rcutils.rcutils_get_default_allocator.restype = _Allocator
    rcl.rcl_take_serialized_message.argtypes = [ctypes.c_void_p] * 4
    return rcl, rcutils


def take_serialized(handle: Any) -> tuple[bytes, bytes] | None:
    """Take a message from the entered handle of a subscription.

    Returns:
        Its serialised bytes, and the identifier of its publisher: empty if this middleware does not
        provide it. None if no message waits.
    """
    rcl, rcutils = _libraries()
    taken, info = _Serialized(), _Info()
    allocator = rcutils.rcutils_get_default_allocator()
    rcutils.rcutils_uint8_array_init(
        ctypes.byref(taken), ctypes.c_size_t(0), ctypes.byref(allocator)
    )
    try:
        code = rcl.rcl_take_serialized_message(
            handle.pointer, ctypes.addressof(taken), ctypes.addressof(info), None
        )
        if code != 0:
            rcutils.rcutils_reset_error()
            return None
        payload = ctypes.string_at(taken.buffer, taken.length)
    finally:
        rcutils.rcutils_uint8_array_fini(ctypes.byref(taken))
    known = info.middleware == _middleware()
    return payload, bytes(info.gid) if known else b''


@cache
def _middleware() -> bytes:
    return str(get_rmw_implementation_identifier()).encode()


# rclpy's action server, with goals that the node ends; see `dds.endpoints`.


class ServerGoal:
    """A goal that was accepted; see `dds.endpoints.ServerGoal`."""

    def __init__(self, server: _Server, handle: Any) -> None:
        self._server = server
        self._handle = handle
        self.request = handle.request

    @property
    def is_cancel_requested(self) -> bool:
        """Whether a client has requested to cancel it, and the request was accepted."""
        return bool(self._handle.is_cancel_requested)

    def publish_feedback(self, feedback: Any) -> None:
        """Publish the progress of the goal."""
        self._handle.publish_feedback(feedback)

    def end(self, status: GoalStatus, result: Any) -> None:
        """End it; clients receive its result when the node is spun."""

        def ended(handle: Any) -> Any:
            {
                GoalStatus.SUCCEEDED: handle.succeed,
                GoalStatus.CANCELED: handle.canceled,
                GoalStatus.ABORTED: handle.abort,
            }[status]()
            return result

        self._server.schedule(self._handle, ended)


class _Server(ActionServer):  # type: ignore[misc,unused-ignore]
    """Runs no execute callback: one that waits would block rclpy's executor."""

    def notify_execute(self, goal_handle: Any, execute_callback: Any) -> None:
        """Do nothing with a goal that begins."""
        if execute_callback is not None:
            super().notify_execute(goal_handle, execute_callback)

    def schedule(self, handle: Any, ended: Callable[[Any], Any]) -> None:
        """Let the executor end a goal."""
        node = self._node
        if node.executor is None:
            # The executor does not spin a node that ends; its owner spins it.
            get_global_executor().add_node(node)
        self.notify_execute(handle, ended)


class GoalServer:
    """Serves an action; see `dds.endpoints.GoalServer`."""

    def __init__(
        self,
        node: Any,
        kind: Any,
        name: str,
        *,
        accept: Callable[[Any], bool],
        begin: Callable[[ServerGoal], None],
        cancel: Callable[[ServerGoal], bool],
    ) -> None:
        goals: dict[bytes, ServerGoal] = {}

        def accepted(handle: Any) -> None:
            goal = goals[bytes(handle.goal_id.uuid)] = ServerGoal(self._server, handle)
            handle.execute()
            begin(goal)

        def cancelled(handle: Any) -> CancelResponse:
            goal = goals[bytes(handle.goal_id.uuid)]
            return CancelResponse.ACCEPT if cancel(goal) else CancelResponse.REJECT

        self._server = _Server(
            node,
            kind,
            name,
            execute_callback=lambda _: None,
            goal_callback=lambda goal: GoalResponse.ACCEPT if accept(goal) else GoalResponse.REJECT,
            handle_accepted_callback=accepted,
            cancel_callback=cancelled,
        )


class ManagedNode(LifecycleNode):  # type: ignore[misc,unused-ignore]
    """A node with the states of ROS 2 (design.ros2.org/articles/node_lifecycle.html).

    Subclasses implement four steps without arguments: `configure`, `activate`, `deactivate` and
    `cleanup`. If a step raises ImuCalibError, it fails and the node keeps its state.
    """

    def __init__(self, node_name: str) -> None:
        super().__init__(node_name)
        self._wrong: ImuCalibError | None = None
        self._begins = False
        # rclpy ends the process at a request for a transition that the state does not have.
        self._change_state = self._service_change_state.callback
        self._service_change_state.callback = self._on_change_state

    def _on_change_state(self, request: Any, response: Any) -> Any:
        try:
            return self._change_state(request, response)
        except rclpy_implementation.RCLError as error:
            self.get_logger().warning(f'A change of state is refused: {error}')
            response.success = False
            return response

    def configure(self) -> None:
        """Read what is needed; open and publish nothing."""

    def activate(self) -> None:
        """Start working."""

    def deactivate(self) -> None:
        """Stop working."""

    def cleanup(self) -> None:
        """Discard what was read."""

    def begin(self, *, autostart: bool) -> None:
        """Configure and activate, unless a lifecycle manager does so."""
        if not autostart:
            return
        self._begins = True
        for trigger in (self.trigger_configure, self.trigger_activate):
            if trigger() is not TransitionCallbackReturn.SUCCESS:
                raise self._wrong or ImuCalibError('A transition failed; the log says why.')
        self._begins = False

    def on_configure(self, state: Any) -> Any:  # noqa: ARG002
        """Run `configure` for rclpy."""
        return self._try(self.configure)

    def on_activate(self, state: Any) -> Any:
        """Run `activate` for rclpy."""
        super().on_activate(state)
        return self._try(self.activate)

    def on_deactivate(self, state: Any) -> Any:
        """Run `deactivate` for rclpy."""
        super().on_deactivate(state)
        return self._try(self.deactivate)

    def on_cleanup(self, state: Any) -> Any:  # noqa: ARG002
        """Run `cleanup` for rclpy."""
        return self._try(self.cleanup)

    def on_shutdown(self, state: Any) -> Any:
        """Stop all work for rclpy."""
        if state.label == 'active':
            self.deactivate()
        return TransitionCallbackReturn.SUCCESS

    def _try(self, step: Callable[[], None]) -> TransitionCallbackReturn:
        try:
            step()
        except ImuCalibError as error:
            self._wrong = error
            if not self._begins:
                self.get_logger().error(str(error))
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS


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
    """Initialise rclpy without its signal handlers, which would end the context at once."""
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
    """Subscribe without a callback; see `dds.node.open_drain`."""
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
    """Subscribe with a callback that takes all that has arrived; see `dds.node.open_stream`."""
    subscription: Any = None

    def pass_on(payload: bytes) -> None:
        # The executor has taken the oldest; take newer ones without another round of it.
        callback([payload, *drain(subscription, _AT_ONCE)])

    subscription = node.create_subscription(
        msg_type, topic, pass_on, qos_profile, raw=True, **options
    )
    return subscription


def drain(subscription: Any, most: int | None = None) -> list[bytes]:
    """Return what has arrived, serialised, oldest first; see `dds.node.drain`."""
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
    """Return what has arrived with its publishers; see `dds.node.drain_sources`."""
    taken: list[tuple[bytes, bytes]] = []
    handle = subscription.handle
    with handle:
        while len(taken) < _AT_ONCE and (one := take_serialized(handle)) is not None:
            taken.append(one)
    return taken


def publish_all(publisher: Any, payloads: Iterable[bytes]) -> None:
    """Publish serialised messages without losses; see `dds.node.publish_all`."""
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


run_beside = WorkerThread


def in_step() -> bool:
    """Return False: see `dds.context.in_step`."""
    return False


def parameter_names(node: Any) -> tuple[list[str], list[str]]:
    """Return the names of a node's parameters: those given, and those declared."""
    return list(node._parameter_overrides), list(node._parameters)
