"""The keys of an IMU's file."""

from __future__ import annotations

from dataclasses import replace

from imu_calib.common.stream import Units
from imu_calib.model.parameters import TRIADS, ParameterKind
from imu_calib.session.imu import ImuSpec, TriadSpec, read_specification, read_triad

from .keys import VALUES, Key, Schema, Tables, Value, has, keys_of, mapping, quantity, when


def _shown(triad: str) -> list[Key]:
    """Return the keys of a triad, whatever its units."""
    ways = {u.value: keys_of(TriadSpec, (triad, u))[0] for u in Units if u is not Units.SI}
    words = ', '.join(
        f'{key.value.words.removesuffix(", above 0")} with {units}' for units, key in ways.items()
    )
    scale = replace(
        ways[Units.PULSES.value],
        value=Value({}, f'{words}; above 0'),
        otherwise='must be given; not with `si`',
    )
    return [scale, *keys_of(TriadSpec, (triad, Units.SI))]


def _limits(letter: str) -> list[Key]:
    rows = [k.value for k in ParameterKind if k is not ParameterKind.RESPONSE]
    return [
        Key(row.key, quantity(row.units[letter].dimension, 'above 0'), f'largest {row.words}')
        for row in rows
        if letter in row.units
    ]


def _by_units(units: Units) -> Schema:
    triads = {'gyro': 'gyro', 'accelerometer': 'accelerometer', 'skewed_gyro': 'gyro'}
    schemas = {
        name: mapping(keys_of(TriadSpec, (triad, units))).schema for name, triad in triads.items()
    }
    for name in triads:
        if name == 'skewed_gyro' or units is Units.SI:
            schemas[name] = {**schemas[name], 'type': ['object', 'null']}
    then: Schema = {'properties': schemas}
    if units is not Units.SI:
        then['required'] = ['gyro', 'accelerometer']
    return when(has('units', units.value), then)


VALUES[read_triad] = lambda _: Value({'type': 'object'}, 'keys, below')
VALUES[read_specification] = lambda: mapping(
    [
        Key(name, mapping(_limits(letter), words='keys, below'), f'of each {name}')
        for letter, name in TRIADS.items()
    ],
    words='keys, below',
)
KEYS = keys_of(ImuSpec)
TABLES: Tables = {
    'imu': KEYS,
    'gyro': _shown('gyro'),
    'accelerometer': _shown('accelerometer'),
    'specification gyro': _limits('g'),
    'specification accelerometer': _limits('a'),
}
VALUE = mapping(KEYS, *(_by_units(units) for units in Units))
TITLE = 'An IMU: the meaning of its numbers, and its noise by the data sheet'
