"""The subset of rclpy over the wheel `cyclonedds`; see `imu_calib.live.middleware`."""

from ...network import LEASES
from ..shared import ACTIONS, MESSAGES, InterfaceTypes
from .context import Clock, ClockType, Time, in_step, init, ok, shutdown, try_shutdown
from .endpoints import ActionClient, GoalServer, Trigger, action_type
from .executor import (
    ExternalShutdownException,
    SingleThreadedExecutor,
    run_beside,
    spin,
    spin_once,
    spin_until_future_complete,
)
from .message_types import deserialize_message, message_class, serialize_message
from .node import (
    FloatingPointRange,
    IntegerRange,
    InvalidParameterTypeException,
    ManagedNode,
    Node,
    ParameterAlreadyDeclaredException,
    ParameterDescriptor,
    ParameterNotDeclaredException,
    acknowledged,
    drain,
    drain_sources,
    open_drain,
    open_stream,
    parameter_names,
    publish_all,
)
from .qos import (
    DurabilityPolicy,
    HistoryPolicy,
    QoSOverridingOptions,
    QoSPolicyKind,
    QoSProfile,
    ReliabilityPolicy,
    SubscriptionEventCallbacks,
    qos_profile_sensor_data,
)

LEASE = LEASES['rmw_cyclonedds_cpp']
messages = InterfaceTypes(MESSAGES, message_class)
actions = InterfaceTypes(ACTIONS, action_type)

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
