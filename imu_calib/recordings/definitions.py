"""Texts of message definitions, as stored in recordings and exchanged by nodes."""

from __future__ import annotations

import os
import re
from pathlib import Path

from ..common.errors import InputError
from ..common.files import message_folder

_OWN = 'imu_calib_msgs'
_RULE = '=' * 80  #: Line between two definitions (MCAP, well-known schema encoding 'ros2msg').
_PRIMITIVES = frozenset(
    {'bool', 'byte', 'char', 'string', 'wstring', 'float32', 'float64'}
    | {f'{sign}int{bits}' for sign in ('', 'u') for bits in (8, 16, 32, 64)}
)
# A field, not a constant: a type, perhaps an array, a name, perhaps a default value.
_FIELD = re.compile(r'^\s*([A-Za-z][\w/]*)(?:<=\d+)?(?:\[[^\]]*\])?\s+[a-z]\w*\s*(?:$|[^=\s])')

# Messages that the suite records and its nodes exchange, for machines without ROS.
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
    'trajectory_msgs/msg/MultiDOFJointTrajectoryPoint': (
        'geometry_msgs/Transform[] transforms\ngeometry_msgs/Twist[] velocities\n'
        'geometry_msgs/Twist[] accelerations\nbuiltin_interfaces/Duration time_from_start\n'
    ),
    'trajectory_msgs/msg/MultiDOFJointTrajectory': (
        'std_msgs/Header header\nstring[] joint_names\nMultiDOFJointTrajectoryPoint[] points\n'
    ),
    'geometry_msgs/msg/Transform': 'Vector3 translation\nQuaternion rotation\n',
    'geometry_msgs/msg/Twist': 'Vector3 linear\nVector3 angular\n',
    'control_msgs/msg/JointTolerance': (
        'string name\nfloat64 position\nfloat64 velocity\nfloat64 acceleration\n'
    ),
    'control_msgs/msg/JointComponentTolerance': (
        'uint16 X_AXIS=1\nuint16 Y_AXIS=2\nuint16 Z_AXIS=3\nuint16 TRANSLATION=4\n'
        'uint16 ROTATION=5\nstring joint_name\nuint16 component\n'
        'float64 position\nfloat64 velocity\nfloat64 acceleration\n'
    ),
    'unique_identifier_msgs/msg/UUID': 'uint8[16] uuid\n',
    'action_msgs/msg/GoalInfo': (
        'unique_identifier_msgs/UUID goal_id\nbuiltin_interfaces/Time stamp\n'
    ),
    'action_msgs/msg/GoalStatus': (
        'int8 STATUS_UNKNOWN=0\nint8 STATUS_ACCEPTED=1\nint8 STATUS_EXECUTING=2\n'
        'int8 STATUS_CANCELING=3\nint8 STATUS_SUCCEEDED=4\nint8 STATUS_CANCELED=5\n'
        'int8 STATUS_ABORTED=6\nGoalInfo goal_info\nint8 status\n'
    ),
    'action_msgs/msg/GoalStatusArray': 'GoalStatus[] status_list\n',
    'action_msgs/srv/CancelGoal_Request': 'action_msgs/GoalInfo goal_info\n',
    'action_msgs/srv/CancelGoal_Response': (
        'int8 ERROR_NONE=0\nint8 ERROR_REJECTED=1\nint8 ERROR_UNKNOWN_GOAL_ID=2\n'
        'int8 ERROR_GOAL_TERMINATED=3\nint8 return_code\naction_msgs/GoalInfo[] goals_canceling\n'
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

# Goal, result and feedback, as separated by rules in an .action file.
_ACTIONS = {
    'control_msgs/action/FollowJointTrajectory': (
        'trajectory_msgs/JointTrajectory trajectory\n'
        'trajectory_msgs/MultiDOFJointTrajectory multi_dof_trajectory\n'
        'control_msgs/JointTolerance[] path_tolerance\n'
        'control_msgs/JointComponentTolerance[] component_path_tolerance\n'
        'control_msgs/JointTolerance[] goal_tolerance\n'
        'control_msgs/JointComponentTolerance[] component_goal_tolerance\n'
        'builtin_interfaces/Duration goal_time_tolerance\n'
        '---\n'
        'int32 SUCCESSFUL=0\nint32 INVALID_GOAL=-1\nint32 INVALID_JOINTS=-2\n'
        'int32 OLD_HEADER_TIMESTAMP=-3\nint32 PATH_TOLERANCE_VIOLATED=-4\n'
        'int32 GOAL_TOLERANCE_VIOLATED=-5\n'
        'int32 error_code\nstring error_string\n'
        '---\n'
        'std_msgs/Header header\nstring[] joint_names\n'
        'trajectory_msgs/JointTrajectoryPoint desired\n'
        'trajectory_msgs/JointTrajectoryPoint actual\n'
        'trajectory_msgs/JointTrajectoryPoint error\n'
        'string[] multi_dof_joint_names\n'
        'trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_desired\n'
        'trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_actual\n'
        'trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_error\n'
    )
}
_PARTS = ('Goal', 'Result', 'Feedback')
# The messages that ROS makes of every action (design.ros2.org/articles/actions.html).
_OF_ACTIONS = {
    'SendGoal_Request': 'unique_identifier_msgs/UUID goal_id\n{action}_Goal goal\n',
    'SendGoal_Response': 'bool accepted\nbuiltin_interfaces/Time stamp\n',
    'GetResult_Request': 'unique_identifier_msgs/UUID goal_id\n',
    'GetResult_Response': 'int8 status\n{action}_Result result\n',
    'FeedbackMessage': 'unique_identifier_msgs/UUID goal_id\n{action}_Feedback feedback\n',
}


def definition(type_name: str) -> str:
    """Return a message definition together with those of all messages in it.

    In mcap's form ros2msg: the definition, then each further one after a rule and its name.
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

    Standard messages are built in, the suite's own are read from its files, others from the ROS
    installation, if there is one.
    """
    if type_name in _BUILT_IN:
        return _BUILT_IN[type_name]
    if '/action/' in type_name:
        return _action_definition(type_name)
    return _text_of_file(type_name)


def _action_definition(type_name: str) -> str:
    """Return the text of one of the messages of an action, for instance pkg/action/Name_Goal."""
    package, _, short = type_name.partition('/action/')
    name, _, part = short.partition('_')
    action = f'{package}/action/{name}'
    if part in _OF_ACTIONS:
        return _OF_ACTIONS[part].format(action=action)
    text = _ACTIONS.get(action) or _text_of_file(action)
    # A rule is a whole line; comments may contain three hyphens.
    parts = re.split(r'^---$', text, flags=re.MULTILINE)
    return parts[_PARTS.index(part)].lstrip('\n')


def _text_of_file(type_name: str) -> str:
    for path in _candidates(type_name):
        if path.is_file():
            return path.read_text(encoding='utf-8')
    raise InputError(f'No definition of the message type {type_name!r} is to be found.')


def _candidates(type_name: str) -> list[Path]:
    package, kind, name = type_name.split('/')
    file = Path(kind, f'{name}.{kind}')
    prefixes = [p for p in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep) if p]
    files = [Path(p) / 'share' / package / file for p in prefixes]
    return [message_folder().parent / file, *files] if package == _OWN else files


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
