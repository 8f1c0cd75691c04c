"""Texts of message definitions, as a recording carries them along and as nodes exchange them."""

from __future__ import annotations

import os
import re
from pathlib import Path

from .errors import InputError
from .share import message_folder

_OWN = 'imu_calib_msgs'
_RULE = '=' * 80
_PRIMITIVES = frozenset(
    {'bool', 'byte', 'char', 'string', 'wstring', 'float32', 'float64'}
    | {f'{sign}int{bits}' for sign in ('', 'u') for bits in (8, 16, 32, 64)}
)
# A field, not a constant: a type, perhaps an array, a name, perhaps a default value.
_FIELD = re.compile(r'^\s*([A-Za-z][\w/]*)(?:<=\d+)?(?:\[[^\]]*\])?\s+[a-z]\w*\s*(?:$|[^=\s])')

# What the suite records and what its nodes exchange, for where no ROS is installed.
_BUILT_IN = {
    'builtin_interfaces/msg/Time': 'int32 sec\nuint32 nanosec\n',
    'std_msgs/msg/Header': 'builtin_interfaces/Time stamp\nstring frame_id\n',
    'geometry_msgs/msg/Vector3': 'float64 x\nfloat64 y\nfloat64 z\n',
    'geometry_msgs/msg/Quaternion': 'float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n',
    'sensor_msgs/msg/Imu': (
        'std_msgs/Header header\n'
        'geometry_msgs/Quaternion orientation\n'
        'float64[9] orientation_covariance\n'
        'geometry_msgs/Vector3 angular_velocity\n'
        'float64[9] angular_velocity_covariance\n'
        'geometry_msgs/Vector3 linear_acceleration\n'
        'float64[9] linear_acceleration_covariance\n'
    ),
    'sensor_msgs/msg/JointState': (
        'std_msgs/Header header\n'
        'string[] name\n'
        'float64[] position\n'
        'float64[] velocity\n'
        'float64[] effort\n'
    ),
    'sensor_msgs/msg/Temperature': (
        'std_msgs/Header header\nfloat64 temperature\nfloat64 variance\n'
    ),
    'builtin_interfaces/msg/Duration': 'int32 sec\nuint32 nanosec\n',
    'std_msgs/msg/Bool': 'bool data\n',
    'std_msgs/msg/String': 'string data\n',
    'diagnostic_msgs/msg/KeyValue': 'string key\nstring value\n',
    'diagnostic_msgs/msg/DiagnosticStatus': (
        'byte OK=0\nbyte WARN=1\nbyte ERROR=2\nbyte STALE=3\n'
        'byte level\nstring name\nstring message\nstring hardware_id\nKeyValue[] values\n'
    ),
    'diagnostic_msgs/msg/DiagnosticArray': 'std_msgs/Header header\nDiagnosticStatus[] status\n',
    'rosgraph_msgs/msg/Clock': 'builtin_interfaces/Time clock\n',
    'trajectory_msgs/msg/JointTrajectoryPoint': (
        'float64[] positions\nfloat64[] velocities\nfloat64[] accelerations\nfloat64[] effort\n'
        'builtin_interfaces/Duration time_from_start\n'
    ),
    'trajectory_msgs/msg/JointTrajectory': (
        'std_msgs/Header header\nstring[] joint_names\nJointTrajectoryPoint[] points\n'
    ),
    # The empty request of a service is one byte on the wire.
    'std_srvs/srv/Trigger_Request': 'uint8 structure_needs_at_least_one_member\n',
    'std_srvs/srv/Trigger_Response': 'bool success\nstring message\n',
    # char[16] in ROS, which means uint8 there.
    'rmw_dds_common/msg/Gid': 'uint8[16] data\n',
    'rmw_dds_common/msg/NodeEntitiesInfo': (
        'string<=256 node_namespace\nstring<=256 node_name\n'
        'Gid[] reader_gid_seq\nGid[] writer_gid_seq\n'
    ),
    'rmw_dds_common/msg/ParticipantEntitiesInfo': (
        'Gid gid\nNodeEntitiesInfo[] node_entities_info_seq\n'
    ),
}


def definition(type_name: str) -> str:
    """Return a message definition together with those of all messages in it.

    Args:
        type_name: Full name, for instance sensor_msgs/msg/Imu.

    Returns:
        Text in the form that mcap calls ros2msg: the definition, then each further one after a
        rule and its name.

    Raises:
        InputError: The definition of one of them is not to be found.

    """
    parts = [message_text(type_name)]
    seen = [type_name]
    for name in seen:
        for inner in _inner_types(name):
            if inner not in seen:
                seen.append(inner)
                parts.append(f'{_RULE}\nMSG: {inner.replace("/msg/", "/")}\n{message_text(inner)}')
    return '\n'.join(part.rstrip('\n') for part in parts) + '\n'


def message_text(type_name: str) -> str:
    """Return the text of one .msg file.

    Standard messages are built in, the suite's own are read from its files, and others from the
    ROS installation, where there is one.

    Args:
        type_name: Full name, for instance sensor_msgs/msg/Imu.

    Raises:
        InputError: It is not to be found.

    """
    if type_name in _BUILT_IN:
        return _BUILT_IN[type_name]
    for path in _candidates(type_name):
        if path.is_file():
            return path.read_text(encoding='utf-8')
    raise InputError(f'No definition of the message type {type_name!r} is to be found.')


def _candidates(type_name: str) -> list[Path]:
    package, _, name = type_name.partition('/msg/')
    prefixes = [p for p in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep) if p]
    files = [Path(p) / 'share' / package / 'msg' / f'{name}.msg' for p in prefixes]
    return [message_folder() / f'{name}.msg', *files] if package == _OWN else files


def _inner_types(type_name: str) -> list[str]:
    """Return the full names of the message types that the fields of a message have."""
    package = type_name.partition('/')[0]
    found = []
    for line in message_text(type_name).splitlines():
        field = _FIELD.match(line.partition('#')[0].rstrip())
        if field and field[1] not in _PRIMITIVES:
            own, _, name = field[1].rpartition('/')
            found.append(f'{(own or package).removesuffix("/msg")}/msg/{name}')
    return found
