"""Node: the part of rclpy's class that the suite's nodes use."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from ....common.errors import ImuCalibError, InputError
from ....common.stream import NS
from . import arguments as names
from .context import CONTEXT, Clock, ClockType, Logger, Timer
from .endpoints import Client, Publisher, Service, Subscription
from .message_types import Message, message_class
from .qos import QoSProfile, ReliabilityPolicy, overridden, profile

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from .qos import QoSOverridingOptions, SubscriptionEventCallbacks, TopicEndpointInfo

# Parameters of a node: typed, described, and checked when declared.
#
# Without parameter services they keep the values of files and arguments.


_KINDS = {bool: 'BOOL', int: 'INTEGER', float: 'DOUBLE', str: 'STRING'}


class ParameterException(Exception):
    """Base of all errors of parameters."""


class ParameterAlreadyDeclaredException(ParameterException):
    """It is declared twice."""


class ParameterNotDeclaredException(ParameterException):
    """It was not declared."""


class InvalidParameterTypeException(ParameterException):
    """Its value has another type than declared."""


class InvalidParameterValueException(ParameterException):
    """Its value is out of range."""


@dataclass
class FloatingPointRange:
    """Range of a float parameter; the step is not enforced."""

    from_value: float = 0.0
    to_value: float = 0.0
    step: float = 0.0


class IntegerRange(FloatingPointRange):
    """Range of an integer parameter."""


@dataclass
class ParameterDescriptor:
    """Description of a parameter: the used part of rcl_interfaces/ParameterDescriptor."""

    description: str = ''
    read_only: bool = False
    floating_point_range: list[FloatingPointRange] = field(default_factory=list)
    integer_range: list[IntegerRange] = field(default_factory=list)


@dataclass(frozen=True)
class Parameter:
    """A named value."""

    name: str
    value: Any


class Parameters:
    """The parameters of one node."""

    def __init__(self, overrides: dict[str, Any], node: str) -> None:
        self._overrides = overrides
        self._node = node
        self._values: dict[str, Parameter] = {}

    def declare(
        self, name: str, value: Any, descriptor: ParameterDescriptor | None = None
    ) -> Parameter:
        """Declare a parameter; a value from a file or an argument replaces the default.

        Raises:
            ParameterException: Declared before, or of the wrong type, or out of range.
        """
        where = f'Parameter {name!r} of {self._node}'
        if name in self._values:
            raise ParameterAlreadyDeclaredException(f'{where} is declared twice.')
        found = self._overrides.get(name, value)
        kind = _kind(value)
        # An empty list matches a list of any type.
        if _kind(found) != kind and not (found == [] and isinstance(value, list)):
            raise InvalidParameterTypeException(
                f'{where}: found {found!r} ({_kind(found)}), expected {kind}.'
            )
        described = descriptor or ParameterDescriptor()
        for limits in (*described.floating_point_range, *described.integer_range):
            if not limits.from_value <= found <= limits.to_value:
                raise InvalidParameterValueException(
                    f'{where}: found {found!r}, expected {limits.from_value} to {limits.to_value}.'
                )
        self._values[name] = Parameter(name, found)
        return self._values[name]

    def names(self) -> tuple[list[str], list[str]]:
        """Return the names given, and those declared."""
        return list(self._overrides), list(self._values)

    def get(self, name: str) -> Parameter:
        """Return a parameter."""
        if name not in self._values:
            raise ParameterNotDeclaredException(
                f'Parameter {name!r} of {self._node} is not declared.'
            )
        return self._values[name]


def _kind(value: Any) -> str:
    """Return ROS's name for the type of a value, or Python's if ROS has no such parameter."""
    if isinstance(value, list):
        kinds = {_kind(one) for one in value}
        return f'{kinds.pop()}_ARRAY' if len(kinds) == 1 else 'list of several types'
    return _KINDS.get(type(value), type(value).__name__)


_TEND_PERIOD = 0.5
"""Seconds between two checks for peers with mismatched quality of service: each check reads every
endpoint, which at ten per second took a fifth of an idle node's time."""

_RETRY_PERIOD = 0.01
"""As of rmw_cyclonedds, which waits for the reader of a client by such steps."""


class Node:
    """A node with publishers, subscriptions, timers, services and parameters.

    Not supported: lifecycle, callback groups, parameter services (`ros2 param`), /rosout,
    /parameter_events, content filters, serialised services, QoS beyond `QoSProfile`.
    """

    def __init__(
        self,
        node_name: str,
        *,
        namespace: str | None = None,
    ) -> None:
        if not CONTEXT.ok():
            raise ImuCalibError(f'The node {node_name} is made before init().')
        own = CONTEXT.arguments
        self._remaps = own.remaps
        self._name = names.check_node_name(own.special('__node', node_name) or node_name)
        self._namespace = names.namespace_of(own.special('__ns', node_name) or namespace or '')
        overrides = own.parameters_of(self.get_fully_qualified_name())
        self._parameters = Parameters(overrides, self.get_fully_qualified_name())
        self._logger = Logger(self.get_fully_qualified_name()[1:].replace('/', '.'), CONTEXT.log)
        self._clock = Clock(clock_type=ClockType.ROS_TIME)
        self.publishers_: list[Publisher] = []
        self.subscriptions_: list[Subscription] = []
        self.timers_: list[Timer] = []
        self.services_: list[Service | Client] = []
        self._tended = 0.0
        CONTEXT.nodes.append(self)
        self._follow_clock()
        CONTEXT.announce()

    def get_name(self) -> str:
        """Return the name."""
        return self._name

    def get_namespace(self) -> str:
        """Return the namespace, with its leading slash."""
        return self._namespace

    def get_fully_qualified_name(self) -> str:
        """Return namespace and name."""
        return names.fully_qualified(self._namespace, self._name)

    def get_logger(self) -> Logger:
        """Return the node's logger."""
        return self._logger

    def get_clock(self) -> Clock:
        """Return the node's ROS clock."""
        return self._clock

    def resolve_topic_name(self, topic: str, *, only_expand: bool = False) -> str:
        """Return the absolute name of a topic, remapped."""
        rules = () if only_expand else self._remaps
        return names.remapped(topic, self._namespace, self._name, rules)

    resolve_service_name = resolve_topic_name

    def create_publisher(
        self,
        msg_type: type[Message],
        topic: str,
        qos_profile: QoSProfile | int,
        *,
        qos_overriding_options: QoSOverridingOptions | None = None,
    ) -> Publisher:
        """Create a publisher; its publish takes messages and serialised bytes."""
        name = self.resolve_topic_name(topic)
        prefix = f'qos_overrides.{name}.publisher'
        qos = self._overridden(qos_profile, qos_overriding_options, prefix)
        publisher = Publisher(CONTEXT.joined(), self._logger, msg_type, name, qos)
        self.publishers_.append(publisher)
        CONTEXT.announce()
        return publisher

    def create_subscription(
        self,
        msg_type: type[Message],
        topic: str,
        callback: Callable[[Any], Any] | None,
        qos_profile: QoSProfile | int,
        *,
        event_callbacks: SubscriptionEventCallbacks | None = None,
        qos_overriding_options: QoSOverridingOptions | None = None,
        raw: bool = False,
    ) -> Subscription:
        """Create a subscription; without a callback the messages wait for `drain`."""
        name = self.resolve_topic_name(topic)
        prefix = f'qos_overrides.{name}.subscription'
        qos = self._overridden(qos_profile, qos_overriding_options, prefix)
        subscription = Subscription(
            CONTEXT.joined(), self._logger, msg_type, name, callback, qos, event_callbacks, raw
        )
        self.subscriptions_.append(subscription)
        CONTEXT.announce()
        return subscription

    def _overridden(
        self, qos: QoSProfile | int, options: QoSOverridingOptions | None, prefix: str
    ) -> QoSProfile:
        def declare(name: str, default: Any) -> Any:
            described = ParameterDescriptor(read_only=True)
            return self.declare_parameter(name, default, described).value

        return overridden(profile(qos), options, prefix, declare)

    def create_timer(
        self,
        timer_period_sec: float,
        callback: Callable[[], Any],
        callback_group: None = None,  # noqa: ARG002 (rclpy's third argument)
        clock: Clock | None = None,
    ) -> Timer:
        """Create a timer, on ROS time unless another clock is given.

        Simulated steady time is for nodes whose ROS time is simulated.
        """
        clock = clock or self._clock
        if clock.clock_type is ClockType.STEADY_TIME and not self._clock.ros_time_is_active:
            clock = Clock(clock_type=ClockType.STEADY_TIME, of_the_wall=True)
        timer = Timer(int(timer_period_sec * 1e9), callback, clock)
        self.timers_.append(timer)
        return timer

    def create_service(
        self, srv_type: Any, srv_name: str, callback: Callable[[Any, Any], Any]
    ) -> Service:
        """Create a service; peers on rmw_fastrtps cannot call it."""
        name = self.resolve_service_name(srv_name)
        service = Service(CONTEXT.joined(), srv_type, name, callback, self._retry)
        self.services_.append(service)
        CONTEXT.announce()
        return service

    def _retry(self, attempt: Callable[[], bool]) -> None:
        """Call a function periodically until it returns True."""

        def on_timer() -> None:
            if attempt():
                self.destroy_timer(timer)

        steady = Clock(clock_type=ClockType.STEADY_TIME)
        timer = self.create_timer(_RETRY_PERIOD, on_timer, clock=steady)

    def create_client(self, srv_type: Any, srv_name: str) -> Client:
        """Create a client; a service on rmw_fastrtps never answers."""
        client = Client(CONTEXT.joined(), srv_type, self.resolve_service_name(srv_name))
        self.services_.append(client)
        CONTEXT.announce()
        return client

    def declare_parameter(
        self, name: str, value: Any, descriptor: ParameterDescriptor | None = None
    ) -> Parameter:
        """Declare a parameter; arguments and errors as `Parameters.declare`."""
        return self._parameters.declare(name, value, descriptor)

    def get_parameter(self, name: str) -> Parameter:
        """Return a declared parameter."""
        return self._parameters.get(name)

    def count_publishers(self, topic_name: str) -> int:
        """Return the number of publishers of a topic in the domain; names are not remapped."""
        name = self.resolve_topic_name(topic_name, only_expand=True)
        return CONTEXT.graph.count_writers(f'rt{name}')

    def count_subscribers(self, topic_name: str) -> int:
        """Return the number of subscriptions of a topic in the domain; names are not remapped."""
        name = self.resolve_topic_name(topic_name, only_expand=True)
        return CONTEXT.graph.count_readers(f'rt{name}')

    def get_publishers_info_by_topic(self, topic_name: str) -> list[TopicEndpointInfo]:
        """Return the publishers of a topic in the domain; names are not remapped."""
        name = self.resolve_topic_name(topic_name, only_expand=True)
        return CONTEXT.graph.writers(f'rt{name}')

    def get_node_names(self) -> list[str]:
        """Return the names of all present nodes."""
        return [name for name, _ in self.get_node_names_and_namespaces()]

    def get_node_names_and_namespaces(self) -> list[tuple[str, str]]:
        """Return (name, namespace) of all present nodes."""
        return CONTEXT.graph.nodes()

    def destroy_publisher(self, publisher: Publisher) -> bool:
        """Remove a publisher; return whether it was this node's."""
        return self._destroy(publisher, self.publishers_)

    def destroy_subscription(self, subscription: Subscription) -> bool:
        """Remove a subscription; return whether it was this node's."""
        return self._destroy(subscription, self.subscriptions_)

    def destroy_client(self, client: Client) -> bool:
        """Remove a client; return whether it was this node's."""
        return self._destroy(client, self.services_)

    def destroy_timer(self, timer: Timer) -> bool:
        """Remove a timer; return whether it was this node's."""
        timer.cancel()
        if timer not in self.timers_:
            return False
        self.timers_.remove(timer)
        return True

    def _destroy(self, entity: Any, among: list[Any]) -> bool:
        if entity not in among:
            return False
        among.remove(entity)
        entity.destroy()
        CONTEXT.announce()
        return True

    def destroy_node(self) -> None:
        """Remove the node with all its entities."""
        if self not in CONTEXT.nodes:
            return
        CONTEXT.nodes.remove(self)
        for timer in self.timers_:
            timer.cancel()
        for entity in (*self.publishers_, *self.subscriptions_, *self.services_):
            entity.destroy()
        for kind in (self.publishers_, self.subscriptions_, self.services_, self.timers_):
            kind.clear()
        CONTEXT.announce()

    def readers(self) -> Iterator[Any]:
        """Yield all DDS readers of the node."""
        yield from (entity.reader for entity in (*self.subscriptions_, *self.services_))

    def writers(self) -> Iterator[Any]:
        """Yield all DDS writers of the node."""
        yield from (entity.writer for entity in (*self.publishers_, *self.services_))

    def awaited(self) -> list[Subscription | Service | Client]:
        """Return the endpoints for an executor to wait on."""
        return [*(s for s in self.subscriptions_ if s.callback is not None), *self.services_]

    def run_timers(self) -> bool:
        """Run the callbacks of due timers; return whether there were any."""
        self._report_mismatches()
        ran = False
        for timer in list(self.timers_):
            ran |= timer in self.timers_ and timer.execute()
        return ran

    def _report_mismatches(self) -> None:
        now = time.monotonic()
        if now < self._tended + _TEND_PERIOD:
            return
        self._tended = now
        endpoints: list[Publisher | Subscription] = [*self.publishers_, *self.subscriptions_]
        for endpoint in endpoints:
            endpoint.report_mismatches()

    def _follow_clock(self) -> None:
        """Subscribe to /clock if use_sim_time is set."""
        if self.declare_parameter('use_sim_time', False).value:
            self._clock.simulated = 0
            qos = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
            kind = message_class('rosgraph_msgs/msg/Clock')
            self.create_subscription(kind, '/clock', self._on_clock, qos)

    def _on_clock(self, msg: Any) -> None:
        self._clock.simulated = msg.clock.sec * NS + msg.clock.nanosec


def parameter_names(node: Node) -> tuple[list[str], list[str]]:
    """Return the names of a node's parameters: those given, and those declared."""
    return node._parameters.names()


# A managed node without ROS 2: it starts by itself, because there is no lifecycle manager.


class ManagedNode(Node):
    """A node that is active from start to end; see `ros.ManagedNode`."""

    def configure(self) -> None:
        """Read what is needed; open and publish nothing."""

    def activate(self) -> None:
        """Start working."""

    def begin(self, *, autostart: bool) -> None:
        """Configure and activate."""
        if not autostart:
            raise InputError(
                'Parameter autostart: found false, expected true: without ROS 2 no tool can '
                'configure and activate a node.'
            )
        self.configure()
        self.activate()


def open_drain(
    node: Node, msg_type: Any, topic: str, qos_profile: QoSProfile | int, **options: Any
) -> Subscription:
    """Subscribe without a callback: messages wait until `drain` takes them.

    Options are those of create_subscription; keep all on both ends loses nothing.
    """
    return node.create_subscription(msg_type, topic, None, qos_profile, raw=True, **options)


def open_stream(
    node: Node,
    msg_type: Any,
    topic: str,
    callback: Callable[[list[bytes]], Any],
    qos_profile: QoSProfile | int,
    **options: Any,
) -> Subscription:
    """Subscribe with a callback that takes all that has arrived, serialised, oldest first.

    The callback is called as soon as messages arrive: a single message does not wait for a timer,
    and many are taken together.

    Options are those of create_subscription; keep all on both ends loses nothing.
    """
    subscription = node.create_subscription(
        msg_type, topic, callback, qos_profile, raw=True, **options
    )
    subscription.in_bulk = True
    return subscription


def drain(subscription: Subscription, most: int | None = None) -> list[bytes]:
    """Return what has arrived, serialised, oldest first; for `cdr.Messages.join`.

    With a few thousand messages at most they fit the processor's cache and decode fastest.
    """
    return subscription.reader.drain(most)


def drain_sources(subscription: Subscription) -> list[tuple[bytes, bytes]]:
    """Return what has arrived, serialised, oldest first, each with the identifier of its publisher.

    Under rclpy it is empty where the publisher is unknown.
    """
    return subscription.reader.drain_sources()


def publish_all(publisher: Publisher, payloads: Iterable[bytes]) -> None:
    """Publish serialised messages, losing none.

    With keep all on both ends this waits for slow subscriptions, and for a killed one until its
    lease ends: 10 s with Cyclone DDS, 20 s with Fast DDS.

    Raises:
        ImuCalibError: The middleware refuses one for good (rclpy: RCLError, after 30 s).
    """
    publisher.writer.write_all(payloads)


def acknowledged(publisher: Publisher, timeout_sec: float) -> bool:
    """Wait until all reliable subscriptions have all messages; return whether they have."""
    return publisher.writer.acknowledged(int(timeout_sec * 1e9))
