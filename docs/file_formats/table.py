"""The keys of a table's file."""

from __future__ import annotations

from imu_calib.common.units import Dimension
from imu_calib.session.table import (
    Joint,
    Limits,
    Table,
    Turns,
    read_axis,
    read_azimuth,
    read_clock_rate,
    read_limits,
    read_mount,
)
from imu_calib.session.table_errors import read_deviation

from .keys import (
    VALUES,
    Tables,
    Value,
    array,
    choice,
    either,
    keys_of,
    limited,
    mapping,
    quantity,
)

_LETTERS = choice(['x', 'y', 'z', '-x', '-y', '-z'])
_DIRECTION = Value(
    {
        'type': 'array',
        'items': {'type': 'number'},
        'minItems': 3,
        'maxItems': 3,
        'contains': {'not': {'const': 0}},
    },
    'three numbers',
)
_AXIS = either(_LETTERS, _DIRECTION)
_LIMITS = either(
    choice(['continuous']),
    mapping(keys_of(Limits)),
    words='`continuous`, or `lower` and `upper`',
)
_MOUNT = either(
    array(_AXIS, 3, 3),
    mapping(keys_of(Turns)),
    words='list of three axes, or `yaw`, `pitch` and `roll`',
)
VALUES.update(
    {
        read_axis: lambda: _AXIS,
        read_limits: lambda: _LIMITS,
        read_mount: lambda: _MOUNT,
        read_azimuth: lambda: either(choice(['unknown']), quantity(Dimension.ANGLE)),
        read_clock_rate: lambda: limited(quantity(Dimension.RATIO, '0 or more'), '1000 ppm'),
        read_deviation: lambda above=None: limited(
            quantity(Dimension.ANGLE, '0 or more' if above is None else 'above 0'), '1 deg'
        ),
    }
)

KEYS = keys_of(Table)
_FIRST_ERROR = [key.name for key in KEYS].index('positioning')

TABLES: Tables = {
    'table': KEYS[:_FIRST_ERROR],
    'joints': keys_of(Joint),
    'limits': keys_of(Limits),
    'mount': keys_of(Turns),
    'errors': KEYS[_FIRST_ERROR:],
}
VALUE = mapping(KEYS)
TITLE = 'A turntable: joints, limits, mounting and accuracy'
