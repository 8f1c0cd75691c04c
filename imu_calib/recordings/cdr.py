"""Serialised messages in one buffer, offsets of their fields, and texts of their definitions."""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..common.errors import InputError
from ..common.files import message_folder
from ..common.stream import NS, Floats, Stamps

Bytes: TypeAlias = NDArray[np.uint8]
Indices: TypeAlias = NDArray[np.int64]


class CdrError(InputError):
    """A serialised message contradicts its type."""


@dataclass(frozen=True, eq=False)
class Messages:
    """Serialised messages of one topic at any offsets in one buffer."""

    buffer: Bytes  #: (bytes,) memory that holds the messages, and possibly more.
    offset: Indices  #: (n,) start of each message, at its 4-byte encapsulation header.
    size: Indices  #: (n,) bytes of each message, encapsulation header included.

    def __post_init__(self) -> None:
        """Refuse messages outside the buffer: the decoders read without further checks."""
        if len(self.offset) == 1:
            start, size = self.offset.item(), self.size.item()
            beyond = start < 0 or size < 0 or start + size > len(self.buffer)
        else:
            beyond = self._any_beyond()
        if beyond:
            raise ValueError(f'Messages reach beyond their buffer of {len(self.buffer)} bytes.')

    def _any_beyond(self) -> bool:
        return len(self.offset) > 0 and bool(
            self.offset.min() < 0
            or self.size.min() < 0
            or (self.offset + self.size).max() > len(self.buffer)
        )

    @classmethod
    def join(cls, payloads: Sequence[bytes]) -> Messages:
        """Copy messages that are scattered in memory into one buffer."""
        size = np.fromiter(map(len, payloads), np.int64, len(payloads))
        buffer = np.frombuffer(b''.join(payloads), np.uint8)
        return cls(buffer, np.cumsum(size) - size, size)

    def __len__(self) -> int:
        return len(self.offset)

    def select(self, index: slice | Indices | NDArray[np.bool_]) -> Messages:
        """Return some of the messages; the buffer is shared."""
        return Messages(self.buffer, self.offset[index], self.size[index])

    def payload(self, index: int) -> bytes:
        """Return a copy of one message's bytes."""
        start = int(self.offset[index])
        return self.buffer[start : start + int(self.size[index])].tobytes()

    def payloads(self) -> list[bytes]:
        """Return a copy of every message's bytes."""
        whole = np.ascontiguousarray(self.buffer).data
        ends = (self.offset + self.size).tolist()
        return [bytes(whole[a:b]) for a, b in zip(self.offset.tolist(), ends, strict=True)]

    def leading_bytes(self, size: int) -> Bytes:
        """Gather the first bytes, (n, size), of every message; none may be shorter.

        They are contiguous, and the buffer's own if the messages adjoin.
        """
        if self._is_matrix(size):
            start = int(self.offset[0])
            return self.buffer[start : start + len(self) * size].reshape(-1, size)
        return self.gather(0, size)

    def _is_matrix(self, size: int) -> bool:
        """Return whether messages of a size adjoin, as `join` places them."""
        if len(self) == 0 or int(self.offset[-1] - self.offset[0]) != (len(self) - 1) * size:
            return False
        return bool((self.offset[1:] - self.offset[:-1] == size).all())

    def gather(self, start: int, size: int) -> Bytes:
        """Copy (n, size) bytes from the same place in every message; none may end before."""
        if len(self) == 0:
            return np.empty((0, size), np.uint8)
        # Every possible position is one element of this overlapping view, so that one indexed copy
        # gathers them all from any positions.
        last = len(self.buffer) - size + 1
        anywhere = np.ndarray((last,), f'V{size}', buffer=self.buffer, strides=(1,))
        gathered: Bytes = anywhere[self.offset + start].view(np.uint8).reshape(-1, size)
        return gathered


@dataclass
class Malformed:
    """Count of the messages that a decoder skipped, and what was wrong with the first."""

    count: int = 0  #: Messages skipped so far.
    reason: str = ''  #: What was wrong with the first of them.

    def count_skipped(self, reason: str) -> None:
        """Count one more message."""
        self.count += 1
        self.reason = self.reason or reason


# Offsets of the fields in a message: found by reading one message, then checked for all others.
#
# CDR (OMG formal/02-06-51) aligns a number to its own size, counted from the byte after the 4-byte
# encapsulation header. Two messages of a type whose strings and sequence lengths agree therefore
# have every field at the same offset, and a run of them is a matrix of bytes.


ENCAPSULATION = 4  #: Bytes of the header that states the byte order (RTPS 2.5, section 10.2).
ORDERS = {b'\x00\x00': '>', b'\x00\x01': '<'}
#: Headers of XCDR2: RTPS 2.5, table 10.3, and the numbers of DDS-XTypes 1.2, section 7.4.3.4.
_XCDR2 = {bytes([0, k]) for k in (*range(0x06, 0x0C), *range(0x10, 0x16))}


@dataclass(frozen=True)
class Layout:
    """Offsets of the fields in messages of one shape."""

    order: str  #: '<' or '>', the byte order.
    size: int  #: Bytes of the whole message.
    #: Offsets and contents of the bytes that define the shape.
    fixed: tuple[tuple[int, bytes], ...]
    stamp: int  #: Offset of the header's stamp.
    columns: dict[str, tuple[int, int]]  #: Offset and number of the float64 of each column.
    names: tuple[str, ...]  #: The strings of the message, in order.

    @cached_property
    def head(self) -> int:
        """Bytes up to the end of the last fixed one or of the stamp."""
        return max(self.stamp + 8, *(start + len(content) for start, content in self.fixed))

    def fits(self, payload: bytes) -> bool:
        """Return whether one message has this layout."""
        return len(payload) == self.size and all(
            payload.startswith(content, start) for start, content in self.fixed
        )

    def holds(self, rows: Bytes) -> np.ndarray[Any, np.dtype[np.bool_]]:
        """Return which messages, (n,), have this layout, by their first bytes, (n, head).

        They must have the right size.
        """
        same = np.ones(len(rows), np.bool_)
        for start, kind, value in self._words:
            same &= np.ndarray((len(rows),), kind, rows, start, (self.head,)) == value
        return same

    @cached_property
    def _words(self) -> list[tuple[int, str, np.unsignedinteger[Any]]]:
        """The fixed bytes as integers, which compare far faster than bytes."""
        words = []
        for start, content in self.fixed:
            width = next(w for w in (8, 4, 2, 1) if w <= len(content))
            # The last word may overlap the one before.
            for at in {*range(0, len(content) - width, width), len(content) - width}:
                kind = f'<u{width}'
                words.append((start + at, kind, np.frombuffer(content, kind, 1, at)[0]))
        return words

    def stamps(self, rows: Bytes) -> Stamps:
        """Return the (n,) header stamps in ns, of the same bytes as `holds`."""
        shape, strides = (len(rows),), (self.head,)
        sec = np.ndarray(shape, f'{self.order}i4', rows, self.stamp, strides)
        nanosec = np.ndarray(shape, f'{self.order}u4', rows, self.stamp + 4, strides)
        stamp: Stamps = sec.astype(np.int64) * NS + nanosec
        return stamp

    def stamp_of(self, payload: bytes) -> Stamps:
        """Return the header stamp of one message, (1,) ns."""
        sec, nanosec = struct.unpack_from(f'{self.order}iI', payload, self.stamp)
        return np.array([sec * NS + nanosec], np.int64)

    def row_of(self, payload: bytes, name: str) -> Floats:
        """Return the numbers of a column of one message, (1, k)."""
        offset, width = self.columns[name]
        return np.array([struct.unpack_from(f'{self.order}{width}d', payload, offset)])

    def column(self, messages: Messages, name: str) -> Floats:
        """Return the (n, k) numbers of a column, in new memory."""
        offset, width = self.columns[name]
        stored = messages.gather(offset, 8 * width).view(f'{self.order}f8')
        return stored.astype(np.float64, copy=False)


class LayoutReader:
    """Read one message from its first byte to its last and record the offsets.

    Raises:
        CdrError: From every method, if the message is too short or contradicts its type.
    """

    def __init__(self, payload: bytes) -> None:
        order = ORDERS.get(payload[:2])
        if len(payload) < ENCAPSULATION or order is None:
            header = payload[:ENCAPSULATION].hex(' ') or 'missing'
            named = ' of XCDR2' if payload[:2] in _XCDR2 else ''
            raise CdrError(
                f'encapsulation header {header}{named}, expected 00 00 or 00 01 (plain CDR)'
            )
        self.order = order
        self._payload = payload
        self._position = ENCAPSULATION
        self._fixed: list[tuple[int, int]] = [(0, 2)]
        self._stamp = 0
        self._columns: dict[str, tuple[int, int]] = {}
        self._names: list[str] = []

    def _advance(self, alignment: int, size: int) -> int:
        start = self._position + (ENCAPSULATION - self._position) % alignment
        if start + size > len(self._payload):
            raise CdrError(
                f'{len(self._payload)} bytes, but a field of {size} bytes starts at {start}'
            )
        self._position = start + size
        return start

    def _keep(self, start: int, end: int) -> None:
        if self._fixed and self._fixed[-1][1] == start:
            start = self._fixed.pop()[0]
        self._fixed.append((start, end))

    def number(self, code: str) -> Any:
        """Read one number that may differ between messages."""
        size = struct.calcsize(code)
        return struct.unpack_from(self.order + code, self._payload, self._advance(size, size))[0]

    def stamp(self) -> int:
        """Read a builtin_interfaces/Time, in ns."""
        self._stamp = self._position
        return int(self.number('i')) * NS + int(self.number('I'))

    def count(self) -> int:
        """Read the length of a sequence; it belongs to the layout."""
        start = self._advance(4, 4)
        self._keep(start, self._position)
        return int(struct.unpack_from(f'{self.order}I', self._payload, start)[0])

    def string(self) -> str:
        """Read a string; it belongs to the layout."""
        length = self.count()
        start = self._advance(1, length)
        self._keep(start, self._position)
        content = self._payload[start : self._position]
        if length and content[-1]:
            raise CdrError('a string does not end with a zero byte')
        try:
            text = content[:-1].decode()
        except UnicodeDecodeError:
            raise CdrError(f'a string is not UTF-8: {content[:40]!r}') from None
        self._names.append(text)
        return text

    def strings(self) -> tuple[str, ...]:
        """Read a sequence of strings; it belongs to the layout."""
        return tuple(self.string() for _ in range(self.count()))

    def column(self, name: str, width: int) -> None:
        """Skip float64 numbers that form the column `name`."""
        start = self._advance(8, 8 * width) if width else self._position
        self._columns[name] = (start, width)

    def sequence(self, name: str) -> int:
        """Skip a float64 sequence that forms the column `name`; return its length."""
        width = self.count()
        self.column(name, width)
        return width

    def floats(self) -> tuple[float, ...]:
        """Read a float64 sequence."""
        width = self.count()
        start = self._advance(8, 8 * width) if width else self._position
        values: tuple[float, ...] = struct.unpack_from(
            f'{self.order}{width}d', self._payload, start
        )
        return values

    def end_layout(self) -> Layout:
        """Return the layout; the message must end here, except for padding.

        Middlewares pad a message up to 4 or 8 bytes; more than that is another type.
        """
        rest = len(self._payload) - self._position
        if rest >= 8:
            raise CdrError(f'{len(self._payload)} bytes, {rest} more than the fields take')
        return self.layout()

    def layout(self) -> Layout:
        """Return the layout of the part read so far."""
        return Layout(
            order=self.order,
            size=len(self._payload),
            fixed=tuple((a, self._payload[a:b]) for a, b in self._fixed),
            stamp=self._stamp,
            columns=self._columns,
            names=tuple(self._names),
        )


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
    raise InputError(f'The message type {type_name!r} is unknown: it has no definition here.')


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
