"""Texts of message definitions, as a recording carries them along."""

from __future__ import annotations

import os
import re
from pathlib import Path

from ..errors import InputError
from ..share import message_folder

_OWN = 'imu_calib_msgs'
_RULE = '=' * 80
_PRIMITIVES = frozenset(
    {'bool', 'byte', 'char', 'string', 'wstring', 'float32', 'float64'}
    | {f'{sign}int{bits}' for sign in ('', 'u') for bits in (8, 16, 32, 64)}
)
# A field, not a constant: a type, perhaps an array, a name, perhaps a default value.
_FIELD = re.compile(r'^\s*([A-Za-z][\w/]*)(?:<=\d+)?(?:\[[^\]]*\])?\s+[a-z]\w*\s*(?:$|[^=\s])')

# What the suite records has to be describable where no ROS is installed.
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
