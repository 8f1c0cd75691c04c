"""Message definitions: their texts, their fields, and the type hash that ROS 2 puts on the wire."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import dataclass
from functools import cache

from ...bags.definitions import message_text
from ...errors import InputError

# What the nodes exchange beside the messages that a recording holds.
_TEXTS = {
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

# Numbers of type_description_interfaces/msg/FieldType.
_TYPE_IDS = {
    'int8': 2,
    'uint8': 3,
    'int16': 4,
    'uint16': 5,
    'int32': 6,
    'uint32': 7,
    'int64': 8,
    'uint64': 9,
    'float32': 10,
    'float64': 11,
    'bool': 15,
    'byte': 16,
    'string': 17,
}
_NESTED, _BOUNDED_STRING = 1, 21
_ARRAY, _BOUNDED_SEQUENCE, _SEQUENCE = 48, 96, 144

_LINE = re.compile(
    r'^(?P<base>[A-Za-z][\w/]*)(?:<=(?P<string>\d+))?(?P<many>\[(?:<=)?\d*\])?'
    r'\s+(?P<name>[A-Za-z]\w*)\s*(?P<constant>=)?\s*(?P<value>.*)$'
)


@dataclass(frozen=True)
class Field:
    """One field of a message.

    Attributes:
        name: Name of the field.
        base: A primitive type, or the full name of a message.
        size: Elements of a fixed array, upper bound of a bounded sequence, else 0.
        sequence: Whether the number of elements changes.
        string_bound: Longest string, 0 where there is no bound.
        default: Text of the default value, empty where there is none.

    """

    name: str
    base: str
    size: int
    sequence: bool
    string_bound: int
    default: str

    @property
    def nested(self) -> bool:
        """Whether the elements are messages."""
        return '/' in self.base

    @property
    def many(self) -> bool:
        """Whether it is an array or a sequence."""
        return self.sequence or self.size > 0


@dataclass(frozen=True)
class Interface:
    """The fields and the constants of a message."""

    name: str
    fields: tuple[Field, ...]
    constants: tuple[tuple[str, str, str], ...]


@cache
def interface(name: str) -> Interface:
    """Return the definition of a message.

    Args:
        name: Full name, for instance sensor_msgs/msg/Imu.

    Raises:
        InputError: There is no definition, or a line of it cannot be read.

    """
    fields, constants = [], []
    for raw in _text(name).splitlines():
        line = raw.partition('#')[0].strip()
        if not line:
            continue
        match = _LINE.match(line)
        if match is None:
            raise InputError(f'{name}: {line!r} is neither a field nor a constant.')
        if match['constant']:
            constants.append((match['name'], match['base'], match['value'].strip()))
        else:
            fields.append(_field(name, match))
    return Interface(name, tuple(fields), tuple(constants))


def type_hash(name: str) -> str:
    """Return the hash of a message's definition (REP 2016), as ROS 2 computes it."""
    described = {
        'type_description': _description(name),
        'referenced_type_descriptions': [_description(n) for n in sorted(_inner(name))],
    }
    text = json.dumps(described, ensure_ascii=True, separators=(', ', ': '))
    return f'RIHS01_{hashlib.sha256(text.encode()).hexdigest()}'


def _text(name: str) -> str:
    return _TEXTS[name] if name in _TEXTS else message_text(name)


def _field(owner: str, match: re.Match[str]) -> Field:
    base, many = match['base'], match['many'] or ''
    if base not in _TYPE_IDS:
        package, _, short = base.rpartition('/')
        base = f'{package.removesuffix("/msg") or owner.partition("/")[0]}/msg/{short}'
    digits = many.strip('[]<=')
    return Field(
        name=match['name'],
        base=base,
        size=int(digits or 0),
        sequence=bool(many) and (not digits or '<=' in many),
        string_bound=int(match['string'] or 0),
        default=match['value'].strip(),
    )


def _inner(name: str) -> set[str]:
    """Return the names of all messages inside a message, at any depth."""
    found: set[str] = set()
    for field in interface(name).fields:
        if field.nested:
            found |= {field.base} | _inner(field.base)
    return found


def _description(name: str) -> dict[str, object]:
    fields = [{'name': f.name, 'type': _field_type(f)} for f in interface(name).fields]
    return {'type_name': name, 'fields': fields}


def _field_type(field: Field) -> dict[str, object]:
    number = _NESTED if field.nested else _TYPE_IDS[field.base]
    if field.string_bound:
        number = _BOUNDED_STRING
    if field.many:
        bounded = _BOUNDED_SEQUENCE if field.size else _SEQUENCE
        number += bounded if field.sequence else _ARRAY
    return {
        'type_id': number,
        'capacity': field.size,
        'string_capacity': field.string_bound,
        'nested_type_name': field.base if field.nested else '',
    }
