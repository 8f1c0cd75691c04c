"""The keys of the file of several units on one table."""

from __future__ import annotations

from imu_calib.session.units_file import (
    SERIAL,
    TOPIC,
    MountedUnit,
    Units,
    read_lever,
    read_matching,
)

from . import table
from .keys import VALUES, Tables, Value, array, keys_of, mapping, number

_PATTERNS = {
    SERIAL: Value(
        {'type': ['string', 'number'], 'pattern': f'^{SERIAL}$'}, 'text that can name a file'
    ),
    TOPIC: Value({'type': 'string', 'pattern': f'^{TOPIC}$'}, 'name of a topic'),
}
VALUES[read_matching] = lambda pattern, _: _PATTERNS[pattern]
VALUES[read_lever] = lambda: array(number(), 3, 3, 'three numbers, m')
KEYS = keys_of(Units)
TABLES: Tables = {'units': KEYS, 'unit': keys_of(MountedUnit), 'mount': table.TABLES['mount']}
VALUE = mapping(KEYS)
TITLE = 'Several units on one table: serial numbers, types, topics and mounting'
