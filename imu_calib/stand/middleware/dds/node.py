"""Node: the part of rclpy's class that the suite's nodes use."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from ....common.errors import ImuCalibError
from ....common.stream import NS
from . import names
from .clock import Clock, ClockType
from .context import CONTEXT
from .endpoints import Client, Service
from .logging import Logger
from .messages import Message, message_class
from .middleware_dds_endpoints import Publisher, Subscription
from .node_parameters import Parameter, ParameterDescriptor, Parameters
from .qos import QoSProfile, ReliabilityPolicy, overridden, profile
from .timer import Timer

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from .graph import TopicEndpointInfo
    from .qos import QoSOverridingOptions, SubscriptionEventCallbacks

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
