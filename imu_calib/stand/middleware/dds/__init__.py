"""The subset of rclpy over the wheel `cyclonedds`; see `imu_calib.stand.middleware`."""

from ...network import LEASES
from ..interface_types import ACTIONS, MESSAGES, InterfaceTypes
from .action import ActionClient, GoalServer, action_type
from .beside import run_beside
from .clock import Clock, ClockType, Time, in_step
from .codec import deserialize_message, serialize_message
from .context import init, ok, shutdown, try_shutdown
from .drains import acknowledged, drain, drain_sources, open_drain, open_stream, publish_all
from .endpoints import Trigger
from .managed import ManagedNode
from .messages import message_class
from .middleware_dds_executor import (
    ExternalShutdownException,
    SingleThreadedExecutor,
    spin,
    spin_once,
    spin_until_future_complete,
)
from .node import Node, parameter_names
from .node_parameters import (
    FloatingPointRange,
    IntegerRange,
    InvalidParameterTypeException,
    ParameterAlreadyDeclaredException,
    ParameterDescriptor,
    ParameterNotDeclaredException,
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
