"""Texts of message definitions, as stored in recordings and exchanged by nodes."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any

import yaml

from ..common import config as yaml_text
from ..common.errors import InputError
from ..common.files import message_folder

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from .remote import AnyPath
    from .storage import Topic

_OWN = 'imu_calib_msgs'
_RULE = '=' * 80
"""Line between two definitions (MCAP, well-known schema encoding 'ros2msg')."""
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
        return _of_action(type_name)
    return _text_of_file(type_name)


def _of_action(type_name: str) -> str:
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


NAME = 'metadata.yaml'
VERSION = 9
"""Version of metadata.yaml as written by rosbag2 of Jazzy."""
_KEY = 'rosbag2_bagfile_information'
_TEXTS = 4
"""Texts cached: a recording has two, and may be compared with another."""


@dataclass(frozen=True)
class Metadata:
    """The parts of metadata.yaml used for reading."""

    #: Names of the storage files, in order; None if not stated.
    files: tuple[str, ...] | None = None
    custom_data: Mapping[str, str] = field(default_factory=dict)  #: The user's own entries.
    counts: Mapping[str, int] = field(default_factory=dict)  #: Messages by topic name.
    problem: str = ''  #: Why the metadata is invalid or missing; else empty.


def read_metadata(folder: AnyPath) -> Metadata:
    """Read the metadata of a folder; `problem` names a missing or broken file.

    Raises:
        OSError: The file exists but cannot be read.
    """
    path = folder / NAME
    if not path.is_file():
        return Metadata(problem=f'{NAME} is missing')
    try:
        return _metadata(path.read_text(encoding='utf-8'))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        return Metadata(problem=f'{NAME} is not YAML ({" ".join(str(error).split())[:120]})')


# A command that examines the topics first opens a recording twice.
@lru_cache(maxsize=_TEXTS)
def _metadata(text: str) -> Metadata:
    content = yaml_text.load(text)
    information = content.get(_KEY) if isinstance(content, dict) else None
    if not isinstance(information, dict):
        information = {}
    files = information.get('relative_file_paths')
    if not isinstance(files, list):
        return Metadata(problem=f'{NAME} has no {_KEY}: relative_file_paths')
    # Before version 4 the paths start with the folder's own name.
    names = tuple(PurePath(str(name)).name for name in files)
    counts = _counts(information.get('topics_with_message_count'))
    return Metadata(names, _strings(information.get('custom_data')), counts)


@lru_cache(maxsize=_TEXTS)
def custom_data_of(text: str) -> Mapping[str, str]:
    """Return the custom data in the metadata that rosbag2 writes into its storage files."""
    try:
        content = yaml_text.load(text)
    except yaml.YAMLError:
        return {}
    return _strings(content.get('custom_data')) if isinstance(content, dict) else {}


def _counts(entries: Any) -> dict[str, int]:
    try:
        return {str(e['topic_metadata']['name']): int(e['message_count']) for e in entries}
    except (TypeError, KeyError, ValueError, OverflowError):
        return {}


def _strings(pairs: Any) -> dict[str, str]:
    if not isinstance(pairs, dict):
        return {}
    return {str(key): str(value) for key, value in pairs.items()}


def qos_profile(*, transient_local: bool = False) -> dict[str, Any]:
    """Return the QoS of the suite's topics as rosbag2 writes it from version 9 on."""
    forever = {'sec': 9223372036, 'nsec': 854775807}
    return {
        'history': 'keep_last' if transient_local else 'keep_all',
        'depth': 1 if transient_local else 0,
        'reliability': 'reliable',
        'durability': 'transient_local' if transient_local else 'volatile',
        'deadline': dict(forever),
        'lifespan': dict(forever),
        'liveliness': 'automatic',
        'liveliness_lease_duration': dict(forever),
        'avoid_ros_namespace_conventions': False,
    }


def offered_profiles(text: str) -> list[dict[str, Any]]:
    """Return the QoS profiles that a recorder wrote as YAML; none if that is not a list."""
    try:
        profiles = yaml_text.load(text)
    except yaml.YAMLError:
        return []
    if not isinstance(profiles, list) or not all(isinstance(p, dict) for p in profiles):
        return []
    return profiles


def dump(value: Any) -> str:
    """Write a value as YAML, in its own order."""
    return yaml_text.dump(value, default_flow_style=False)


@dataclass(frozen=True)
class FileSpan:
    """One storage file: its name, its first and last log time in ns, its number of messages."""

    name: str
    start_ns: int
    end_ns: int
    count: int

    def entry(self) -> dict[str, Any]:
        """Return the file's entry in the metadata."""
        return {
            'path': self.name,
            'starting_time': {'nanoseconds_since_epoch': self.start_ns},
            'duration': {'nanoseconds': self.end_ns - self.start_ns},
            'message_count': self.count,
        }


def information(
    files: Sequence[FileSpan],
    topics: Sequence[Topic],
    profiles: Mapping[str, Sequence[dict[str, Any]]],
    custom_data: Mapping[str, str],
) -> dict[str, Any]:
    """Build the metadata of a recording in mcap files, as ROS 2 Jazzy writes it.

    It is the content below `rosbag2_bagfile_information`: files in order, topics with their counts,
    QoS offered for each by its name, and the user's own entries.
    """
    filled = [file for file in files if file.count]
    start = min((file.start_ns for file in filled), default=0)
    end = max((file.end_ns for file in filled), default=0)
    return {
        'version': VERSION,
        'storage_identifier': 'mcap',
        'duration': {'nanoseconds': end - start},
        'starting_time': {'nanoseconds_since_epoch': start},
        'message_count': sum(topic.count or 0 for topic in topics),
        'topics_with_message_count': [
            {
                'topic_metadata': {
                    'name': topic.name,
                    'type': topic.type,
                    'serialization_format': topic.encoding,
                    'offered_qos_profiles': list(profiles[topic.name]),
                    'type_description_hash': '',
                },
                'message_count': topic.count or 0,
            }
            for topic in topics
        ],
        'compression_format': '',
        'compression_mode': '',
        'relative_file_paths': [file.name for file in files],
        'files': [file.entry() for file in files],
        'custom_data': dict(custom_data) or None,
        'ros_distro': 'jazzy',
    }


def write_metadata(folder: Path, content: Mapping[str, Any]) -> None:
    """Write metadata.yaml; it appears whole or not at all."""
    partial = folder / f'{NAME}.part'
    partial.write_text(dump({_KEY: dict(content)}), encoding='utf-8')
    partial.replace(folder / NAME)
