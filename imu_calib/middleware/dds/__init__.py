"""The subset of rclpy over the wheel `cyclonedds`; see `imu_calib.middleware`."""

from . import standard as messages
from . import standard_actions as actions
from .action import ActionClient, GoalServer
from .clock import Clock, ClockType, Duration, Time
from .codec import deserialize_message, serialize_message
from .context import Context, get_default_context, init, ok, shutdown, try_shutdown
from .drains import acknowledged, drain, drain_sources, open_drain, open_stream, publish_all
from .executor import (
    ExternalShutdownException,
    SingleThreadedExecutor,
    spin,
    spin_once,
    spin_until_future_complete,
)
from .future import Future
from .logging import Logger, LoggingSeverity, get_logger
from .managed import ManagedNode
from .node import Node, create_node
from .node_parameters import (
    FloatingPointRange,
    IntegerRange,
    InvalidParameterTypeException,
    InvalidParameterValueException,
    Parameter,
    ParameterAlreadyDeclaredException,
    ParameterDescriptor,
    ParameterException,
    ParameterNotDeclaredException,
    SetParametersResult,
)
from .qos import (
    DurabilityPolicy,
    HistoryPolicy,
    PublisherEventCallbacks,
    QoSOverridingOptions,
    QoSPolicyKind,
    QoSProfile,
    ReliabilityPolicy,
    SubscriptionEventCallbacks,
    qos_profile_sensor_data,
)
from .services import Trigger

__all__ = [
    'ActionClient',
    'Clock',
    'ClockType',
    'Context',
    'DurabilityPolicy',
    'Duration',
    'ExternalShutdownException',
    'FloatingPointRange',
    'Future',
    'GoalServer',
    'HistoryPolicy',
    'IntegerRange',
    'InvalidParameterTypeException',
    'InvalidParameterValueException',
    'Logger',
    'LoggingSeverity',
    'ManagedNode',
    'Node',
    'Parameter',
    'ParameterAlreadyDeclaredException',
    'ParameterDescriptor',
    'ParameterException',
    'ParameterNotDeclaredException',
    'PublisherEventCallbacks',
    'QoSOverridingOptions',
    'QoSPolicyKind',
    'QoSProfile',
    'ReliabilityPolicy',
    'SetParametersResult',
    'SingleThreadedExecutor',
    'SubscriptionEventCallbacks',
    'Time',
    'Trigger',
    'acknowledged',
    'actions',
    'create_node',
    'deserialize_message',
    'drain',
    'drain_sources',
    'get_default_context',
    'get_logger',
    'init',
    'messages',
    'ok',
    'open_drain',
    'open_stream',
    'publish_all',
    'qos_profile_sensor_data',
    'serialize_message',
    'shutdown',
    'spin',
    'spin_once',
    'spin_until_future_complete',
    'try_shutdown',
]
