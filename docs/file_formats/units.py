"""The keys of the file of several units on one table."""

from __future__ import annotations

from imu_calib.session.table import Turns, read_mount
from imu_calib.session.units_file import SERIAL, TOPIC

from .keys import REQUIRED, VALUES, Key, Tables, Value, array, keys_of, mapping, number, text, whole

_UNIT = [
    Key(
        'serial_number',
        Value(
            {'type': ['string', 'number'], 'pattern': f'^{SERIAL}$'}, 'text that can name a file'
        ),
        'of the unit, also the name of its calibration file; no two alike',
        REQUIRED,
    ),
    Key('imu', text(), 'name or file of its type', REQUIRED),
    Key(
        'topic',
        Value({'type': 'string', 'pattern': f'^{TOPIC}$'}, 'name of a topic'),
        'of its `sensor_msgs/Imu` messages; no two alike',
        None,
        '`unit_<serial number>/imu/pulses`',
    ),
    Key('place', text(), 'place on the fixture, for people', ''),
    Key(
        'mount',
        VALUES[read_mount](),
        "its body axes X, Y, Z in those that the table's file mounts: perpendicular, right-handed",
        None,
        '`[x, y, z]`',
    ),
    Key(
        'lever',
        array(number(), 3, 3, 'three numbers, m'),
        'of a simulated unit: from the centre of rotation to its accelerometers, its body axes',
        None,
        '`[0, 0, 0]`',
    ),
    Key(
        'port', text(), 'of its device, for a stand: serial port, socket or file', None, 'simulated'
    ),
    Key('device', text(), 'name or file of the format of its frames', None, 'as for all units'),
    Key(
        'baud',
        whole(0, 10_000_000),
        "of a serial port, bit/s; 0: as the device's file says",
        0,
    ),
    Key(
        'truth',
        text(),
        'of a simulated unit: name or file of its true parameters',
        None,
        'as for all units',
    ),
    Key('seed', whole(0), 'of the noise of a simulated unit', None, "follows the session's"),
]
KEYS = [
    Key(
        'units',
        array(mapping(_UNIT), 1, 256, 'list of 1 to 256 units, below'),
        'on the table, in any order',
        REQUIRED,
    )
]
TABLES: Tables = {'units': KEYS, 'unit': _UNIT, 'mount': keys_of(Turns)}
VALUE = mapping(KEYS)
TITLE = 'Several units on one table: serial numbers, types, topics and mounting'
