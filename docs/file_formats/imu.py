"""The keys of an IMU's file."""

from __future__ import annotations

from imu_calib.common.stream import Units
from imu_calib.common.units import Dimension
from imu_calib.model.parameters import TRIADS, ParameterKind

from .keys import (
    REQUIRED,
    Key,
    Schema,
    Tables,
    Value,
    choice,
    has,
    mapping,
    quantity,
    text,
    when,
)

D = Dimension
_PULSES, _COUNTS, _INCREMENTS, _RATES, _SI = (u.value for u in Units)

_SCALE = {
    ('g', _PULSES): D.ANGLE_PER_PULSE,
    ('g', _COUNTS): D.RATE_PER_COUNT,
    ('a', _PULSES): D.VELOCITY_PER_PULSE,
    ('a', _COUNTS): D.ACCELERATION_PER_COUNT,
    ('g', _INCREMENTS): D.ANGLE,
    ('a', _INCREMENTS): D.VELOCITY,
    ('g', _RATES): D.RATE,
    ('a', _RATES): D.ACCELERATION,
}
_SCALE_MEANING = 'nominal size of one pulse or count, or of the number 1'


def _figures(letter: str) -> list[Key]:
    """Return the keys of a triad whatever its units."""
    gyro = letter == 'g'
    walk, white = (
        ('angle_random_walk', D.ANGLE_RANDOM_WALK)
        if gyro
        else ('velocity_random_walk', D.VELOCITY_RANDOM_WALK)
    )
    value, kelvin, si = (
        (D.RATE, D.RATE_PER_KELVIN, 'rad/s')
        if gyro
        else (D.ACCELERATION, D.ACCELERATION_PER_KELVIN, 'm/s^2')
    )
    zero = 'rad/sqrt(s)' if gyro else '(m/s)/sqrt(s)'
    return [
        Key(walk, quantity(white, '0 or more'), 'white noise of the channels', f'0 {zero}'),
        Key(
            'bias_instability',
            quantity(value, '0 or more'),
            'drift of a bias within a session; included in every standard deviation, unless '
            'the data clearly shows less',
            f'0 {si}',
        ),
        Key(
            'range',
            quantity(value, 'above 0'),
            'largest measurable rate' if gyro else 'largest measurable specific force',
            None,
            'not limited',
        ),
        Key(
            'scale_factor_temperature',
            quantity(D.RATIO_PER_KELVIN, '0 or more'),
            'change of the scale factors with temperature, one standard deviation',
            '0 ppm/K',
        ),
        Key(
            'bias_temperature',
            quantity(kelvin, '0 or more'),
            'the same for the biases',
            f'0 ({si})/K',
        ),
    ]


def _pulse(letter: str) -> Key:
    dimension = _SCALE[letter, _PULSES]
    return Key(
        'pulse',
        quantity(dimension, '0 or more'),
        'with `units: si` only: the pulse of the counter that the values were computed from '
        '([why](../devices.md#questions-that-come-up))',
        '0 rad/pulse' if letter == 'g' else '0 (m/s)/pulse',
    )


def _triad(letter: str, units: str) -> Value:
    if units == _SI:
        return mapping([*_figures(letter), _pulse(letter)])
    scale = quantity(_SCALE[letter, units], 'above 0')
    return mapping([Key('scale_factor', scale, _SCALE_MEANING, REQUIRED), *_figures(letter)])


def _shown(letter: str) -> list[Key]:
    every = (_PULSES, _COUNTS, _INCREMENTS, _RATES)
    words = ', '.join(
        f'{quantity(_SCALE[letter, u], "above 0").words.removesuffix(", above 0")} with {u}'
        for u in every
    )
    scale = Value({}, f'{words}; above 0')
    return [
        Key('scale_factor', scale, _SCALE_MEANING, REQUIRED, 'must be given; not with `si`'),
        *_figures(letter),
        _pulse(letter),
    ]


def _limits(letter: str) -> list[Key]:
    rows = [k.value for k in ParameterKind if k is not ParameterKind.RESPONSE]
    return [
        Key(row.key, quantity(row.units[letter].dimension, 'above 0'), f'largest {row.words}')
        for row in rows
        if letter in row.units
    ]


def _by_units(units: str) -> Schema:
    triads = {'gyro': 'g', 'accelerometer': 'a', 'skewed_gyro': 'g'}
    schemas = {name: _triad(letter, units).schema for name, letter in triads.items()}
    for name in triads:
        if name == 'skewed_gyro' or units == _SI:
            schemas[name] = {**schemas[name], 'type': ['object', 'null']}
    then: Schema = {'properties': schemas}
    if units != _SI:
        then['required'] = ['gyro', 'accelerometer']
    return when(has('units', units), then)


_ANY = Value({'type': 'object'}, 'keys, below')
_NEEDED = 'must be given; optional with `si`'

KEYS = [
    Key('id', text(), 'name of the unit, or of its type', REQUIRED),
    Key(
        'units',
        choice([u.value for u in Units]),
        'meaning of the numbers in the Imu messages: whole increments per sample, codes '
        'proportional to rate and specific force, increments that are no whole numbers (rad, m/s), '
        'rates in other units than SI (deg/s, g), or rad/s and m/s^2',
        REQUIRED,
    ),
    Key(
        'sample_rate',
        quantity(D.FREQUENCY, 'above 0'),
        'nominal; the true one follows from the stamps',
    ),
    Key('gyro', _ANY, 'the three gyros', None, _NEEDED),
    Key('accelerometer', _ANY, 'the three accelerometers', None, _NEEDED),
    Key('skewed_gyro', _ANY, 'a further gyro, skewed to the three; the keys of `gyro`'),
    Key(
        'specification',
        mapping(
            [
                Key(name, mapping(_limits(letter), words='keys, below'), f'of each {name}')
                for letter, name in TRIADS.items()
            ],
            words='keys, below',
        ),
        'limits of the parameters, for the verdicts of [reports](../report.md)',
    ),
]

TABLES: Tables = {
    'imu': KEYS,
    'gyro': _shown('g'),
    'accelerometer': _shown('a'),
    'specification gyro': _limits('g'),
    'specification accelerometer': _limits('a'),
}
VALUE = mapping(KEYS, *(_by_units(u.value) for u in Units))
TITLE = 'An IMU: the meaning of its numbers, and its noise by the data sheet'
