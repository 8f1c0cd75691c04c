"""The keys of a file of imperfections."""

from __future__ import annotations

from imu_calib.common.units import ARCSEC, PPM, Dimension
from imu_calib.simulation.options import Shake, StandOptions, Vibration, WarmUp

from .keys import (
    REQUIRED,
    Key,
    Tables,
    Value,
    array,
    either,
    mapping,
    quantity,
    whole,
)

D = Dimension
_BELOW = 'keys, below'
_DEFAULT = StandOptions()


def _size(
    name: str, meaning: str, dimension: D = D.ANGLE, default: object = None, sign: str = '0 or more'
) -> Key:
    """Return a key for a size; 0 where it is left out."""
    zero = {D.ANGLE: '0 arcsec', D.TIME: '0 s', D.RATIO: '0 ppm'}.get(dimension)
    return Key(name, quantity(dimension, sign), meaning, zero if default is None else default)


_TILT = [
    Key('east', quantity(D.ANGLE), 'about east', '0 arcsec'),
    Key('north', quantity(D.ANGLE), 'about north', '0 arcsec'),
]
_HARMONICS = [_size('once', 'once per turn'), _size('twice', 'twice per turn')]
_POSITIONING = [
    _size(
        'joints',
        'positioning error of a joint, not shown by its encoder, until it moves again',
    ),
    _size('tilt', 'lean of the whole table about either horizontal axis, new at every stop'),
    _size('heading', 'rotation of it about the vertical, new at every stop'),
]
_TABLE = [
    Key(
        'tilt',
        mapping(_TILT, words='`east` and `north`, angles'),
        'rotation of the whole table about east and about north, as stated',
        None,
        'level',
    ),
    _size('zeros', "standard deviation of each joint's true zero about the described one"),
    _size(
        'orthogonality',
        'standard deviation of each axis about both directions across it; the first axis leans by '
        'the tilt',
    ),
    Key(
        'wobble',
        mapping(_HARMONICS, words='`once` and `twice`, angles'),
        'standard deviation by which an axis leans about both directions across it, once and twice '
        'per turn of its joint',
        None,
        '0 arcsec',
    ),
    Key(
        'encoder',
        mapping(_HARMONICS, words='`once` and `twice`, angles'),
        "standard deviation of an encoder's error within the turn, once and twice per turn",
        None,
        '0 arcsec',
    ),
    Key(
        'positioning',
        mapping(_POSITIONING, words=_BELOW),
        "errors of joints and table at each stop; replaces `positioning` of the table's file",
        None,
        "`positioning` of the table's file",
    ),
    _size('servo', 'largest difference of a stopped joint from its goal, shown by its encoder'),
    Key(
        'rate',
        quantity(D.RATIO, '0 or more'),
        'largest error of a steady rate',
        f'{_DEFAULT.rate_error / PPM:g} ppm',
    ),
    Key(
        'acceleration',
        quantity(D.ANGULAR_ACCELERATION, 'above 0'),
        'of all joints, where their limits allow more: long ramps',
        None,
        'their limits',
    ),
]
_JOINT_STATES = [
    _size('noise', 'standard deviation of one reading'),
    Key(
        'resolution',
        quantity(D.ANGLE, '0 or more'),
        'step of the angles',
        None,
        f'{_DEFAULT.encoder_resolution / ARCSEC:.3g} arcsec (22 bits)',
    ),
    _size('jitter', 'standard deviation of the stamps; up to 0.45 of their spacing', D.TIME),
    Key(
        'rate',
        quantity(D.FREQUENCY, 'above 0'),
        'their rate',
        None,
        f'`{_DEFAULT.joint_state_rate:g} Hz`, or `joint_state_rate` of stand_node',
    ),
]
_SHARE = quantity(D.RATIO, '0 or more')
_AT_MOST = Value(_SHARE.schema, f'{_SHARE.words}, at most 100 %')
_STAMPS = [
    _size('jitter', 'standard deviation; up to 0.45 of a sample', D.TIME),
    Key('late', _AT_MOST, 'share of delayed samples', '0 %'),
    _size(
        'delay',
        'their mean delay (exponential); samples behind them queue',
        D.TIME,
    ),
    Key('bunch', whole(1), 'number of samples that come and are stamped together', 1),
    Key(
        'clock_rate',
        quantity(D.RATIO),
        "how much faster the unit's clock runs than the table's",
        None,
        '`0 ppm`, or `clock_drift` of stand_node',
    ),
    Key(
        'clock_offset',
        quantity(D.TIME),
        'its offset at the start',
        None,
        '`0 s`, or `clock_offset` of stand_node',
    ),
]
_FROZEN = [
    Key('every', quantity(D.TIME, 'above 0'), 'mean time between', REQUIRED),
    Key('for', quantity(D.TIME, '0 or more'), 'how long', REQUIRED),
]
_SAMPLES = [
    Key('lost', _AT_MOST, 'share of lost samples, independent of each other', '0 %'),
    Key('twice', _AT_MOST, 'share of samples sent twice', '0 %'),
    Key(
        'frozen',
        mapping(_FROZEN, words='`every` and `for`, times'),
        'every so long in the mean the device repeats its last sample for so long, and what its '
        'sensors counted is lost',
    ),
]
_RINGING = [
    _size('rate', 'amplitude at first', D.RATE, '0 deg/s'),
    _size('force', 'amplitude at first', D.ACCELERATION, '0 mg'),
    _size('frequency', 'of the ringing', D.FREQUENCY, f'{Vibration().frequency:g} Hz', 'above 0'),
    _size('decay', 'time constant', D.TIME, f'{Vibration().decay:g} s', 'above 0'),
]
_FLOOR = [
    _size('rate', 'root mean square about each axis', D.RATE, '0 deg/s'),
    _size('force', 'root mean square along each axis', D.ACCELERATION, '0 mg'),
    _size('lowest', 'lower end of its tones', D.FREQUENCY, f'{Shake().lowest:g} Hz'),
    _size('highest', 'upper end', D.FREQUENCY, f'{Shake().highest:g} Hz'),
]
_MOUNTING = [
    Key(
        'ringing',
        mapping(_RINGING, words=_BELOW),
        'of the mounting after each stop, in random directions',
    ),
    Key('floor', mapping(_FLOOR, words=_BELOW), 'constant vibration of the floor'),
]


def _channels(name: str, dimension: D, meaning: str, default: str) -> Key:
    one = quantity(dimension)
    words = f'{one.words}, or a list of three'
    value = either(one, array(one, 3, 3), words=words)
    return Key(name, value, meaning, default)


def _drift(dimension: D, zero: str) -> list[Key]:
    return [
        _channels('bias', dimension, 'change of the biases per kelvin', zero),
        _channels('scale_factor', D.RATIO_PER_KELVIN, 'of the scale factors', '0 ppm/K'),
    ]


_WARM_UP = [
    _channels('gyro', D.RATE, 'biases at the start', '0 deg/h'),
    _channels('accelerometer', D.ACCELERATION, 'biases at the start', '0 ug'),
    _size('time_constant', 'of their decay', D.TIME, f'{WarmUp().time_constant:g} s', 'above 0'),
]
_BIAS_STEP = [
    Key('time', quantity(D.TIME, '0 or more'), 'from the start of the session to it', REQUIRED),
    _channels('gyro', D.RATE, 'added to the biases from then on', '0 deg/h'),
    _channels('accelerometer', D.ACCELERATION, 'added to the biases from then on', '0 ug'),
]
_TEMPERATURE = [
    Key('offset', quantity(D.TEMPERATURE), 'at the start, above 25 degrees Celsius', '0 K'),
    Key('ramp', quantity(D.TEMPERATURE_RATE), 'steady change', '0 K/h'),
    Key('rise', quantity(D.TEMPERATURE), 'final value, reached with `time_constant`', '0 K'),
    _size(
        'time_constant',
        'of the rise',
        D.TIME,
        f'{_DEFAULT.warming.time_constant:g} s',
        'above 0',
    ),
    Key('gyro', mapping(_drift(D.RATE_PER_KELVIN, '0 (deg/h)/K'), words=_BELOW), 'its effect'),
    Key(
        'accelerometer',
        mapping(_drift(D.ACCELERATION_PER_KELVIN, '0 ug/K'), words=_BELOW),
        'its effect; the keys of `gyro`, per kelvin and in units of acceleration',
    ),
    Key(
        'warm_up',
        mapping(_WARM_UP, words=_BELOW),
        'biases that decay, independent of the thermometer',
    ),
]

KEYS = [
    Key('table', mapping(_TABLE, words=_BELOW), 'the turntable'),
    Key('joint_states', mapping(_JOINT_STATES, words=_BELOW), 'readings of its encoders'),
    Key('stamps', mapping(_STAMPS, words=_BELOW), "of the IMU's samples"),
    Key('samples', mapping(_SAMPLES, words=_BELOW), 'on their way'),
    Key('mounting', mapping(_MOUNTING, words=_BELOW), 'of the unit on the table'),
    Key('temperature', mapping(_TEMPERATURE, words=_BELOW), 'of the unit'),
    Key('bias_step', mapping(_BIAS_STEP, words=_BELOW), 'of a unit that is switched off and on'),
]

TABLES: Tables = {
    'imperfections': KEYS,
    'table': _TABLE,
    'positioning': _POSITIONING,
    'joint_states': _JOINT_STATES,
    'stamps': _STAMPS,
    'samples': _SAMPLES,
    'ringing': _RINGING,
    'floor': _FLOOR,
    'temperature': _TEMPERATURE,
    'gyro': _drift(D.RATE_PER_KELVIN, '0 (deg/h)/K'),
    'warm_up': _WARM_UP,
    'bias_step': _BIAS_STEP,
}
VALUE = mapping(KEYS)
TITLE = 'Imperfections of a simulated stand'
