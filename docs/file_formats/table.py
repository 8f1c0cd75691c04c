"""The keys of a table's file."""

from __future__ import annotations

from imu_calib.common.units import ARCSEC, Dimension
from imu_calib.session.table_errors import ASSUMED

from .keys import (
    REQUIRED,
    Key,
    Tables,
    Value,
    array,
    choice,
    either,
    flag,
    mapping,
    quantity,
    text,
)

D = Dimension

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
AXIS = either(_LETTERS, _DIRECTION)

_LIMITS = [
    Key('lower', quantity(D.ANGLE), 'lowest angle of the encoder', REQUIRED),
    Key('upper', quantity(D.ANGLE), 'highest angle; above `lower`', REQUIRED),
]
_CONTINUOUS = choice(['continuous'])

_JOINT = [
    Key('name', text(), 'as in joint states and setpoints; no two alike', REQUIRED),
    Key('axis', AXIS, 'in the frame of the joint before it; of any length', REQUIRED),
    Key('zero', quantity(D.ANGLE), "added to the encoder's angle", '0 deg'),
    Key(
        'limits',
        either(_CONTINUOUS, mapping(_LIMITS), words='`continuous`, or `lower` and `upper`'),
        'range of rotation; rate tests need a continuous one',
        'continuous',
    ),
    Key('max_rate', quantity(D.RATE, 'above 0'), 'largest commanded rate', REQUIRED),
    Key(
        'max_acceleration',
        quantity(D.ANGULAR_ACCELERATION, 'above 0'),
        'of its starts and stops',
        REQUIRED,
    ),
]

TURNS = [
    Key(name, quantity(D.ANGLE), f'turn about {axis}, in this order', '0 deg')
    for name, axis in (('yaw', 'z'), ('pitch', 'y'), ('roll', 'x'))
]

_OF_ERRORS = {
    'positioning': 'of a stopped joint, not shown by the encoder',
    'level': 'of the tilt of the table, about either horizontal axis',
    'zeros': 'of the zeros of all joints but the first, whose zero is the azimuth',
    'orthogonality': 'of each axis to the one before it, about either direction across',
    'wobble': 'of an axis as it turns: once and twice per turn, each',
    'encoder': 'of an encoder within the turn: once and twice per turn, each',
}


def _error(name: str) -> Key:
    sign = 'above 0' if name == 'level' else '0 or more'
    value = quantity(D.ANGLE, sign)
    words = f'{value.words}, at most 1 deg'
    default = f'{ASSUMED[name] / ARCSEC:g} arcsec'
    return Key(name, Value(value.schema, words), _OF_ERRORS[name], default)


_CLOCK = quantity(D.RATIO, '0 or more')
ERRORS = [
    *(_error(name) for name in ASSUMED),
    Key(
        'simulated',
        flag(),
        'whether it is a simulated one: of others less than 1 arcsec counts as 1 arcsec',
        default=False,
    ),
    Key(
        'clock',
        Value(_CLOCK.schema, f'{_CLOCK.words}, at most 1000 ppm'),
        'of the rate of the clock that stamps the joint states',
        '0 ppm',
    ),
]
MOUNT = Key(
    'mount',
    either(
        array(AXIS, 3, 3),
        mapping(TURNS),
        words='list of three axes, or `yaw`, `pitch` and `roll`',
    ),
    'where the body axes X, Y, Z lie on the last joint: perpendicular and right-handed',
    None,
    '`[x, y, z]`',
)
KEYS = [
    Key('name', text(), 'of the table, for messages', REQUIRED),
    Key(
        'azimuth',
        either(choice(['unknown']), quantity(D.ANGLE)),
        "heading of the table's zero, from north about up",
        'unknown',
    ),
    Key(
        'joints',
        array(mapping(_JOINT), 1, 3, 'list of 1 to 3 joints, below'),
        'from the base outwards',
        REQUIRED,
    ),
    MOUNT,
]

TABLES: Tables = {
    'table': KEYS,
    'joints': _JOINT,
    'limits': _LIMITS,
    'mount': TURNS,
    'errors': ERRORS,
}
VALUE = mapping([*KEYS, *ERRORS])
TITLE = 'A turntable: joints, limits, mounting and accuracy'
