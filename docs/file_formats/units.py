"""The keys of the file of several units on one table."""

from __future__ import annotations

from imu_calib.session.units_file import (
    MOST_UNITS,
    SERIAL,
    TOPIC,
    MountedUnit,
    read_lever,
    read_matching,
)

from . import table
from .keys import REQUIRED, VALUES, Key, Tables, Value, array, keys_of, mapping, number

_PATTERNS = {
    SERIAL: Value(
        {'type': ['string', 'number'], 'pattern': f'^{SERIAL}$'}, 'text that can name a file'
    ),
    TOPIC: Value({'type': 'string', 'pattern': f'^{TOPIC}$'}, 'name of a topic'),
}
VALUES[read_matching] = lambda pattern, _: _PATTERNS[pattern]
VALUES[read_lever] = lambda: array(number(), 3, 3, 'three numbers, m')
_UNIT = keys_of(MountedUnit)
KEYS = [
    Key(
        'units',
        array(mapping(_UNIT), 1, MOST_UNITS, f'list of 1 to {MOST_UNITS} units, below'),
        'on the table, in any order',
        REQUIRED,
    )
]
TABLES: Tables = {'units': KEYS, 'unit': _UNIT, 'mount': table.TABLES['mount']}
VALUE = mapping(KEYS)
TITLE = 'Several units on one table: serial numbers, types, topics and mounting'
