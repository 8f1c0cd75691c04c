"""The keys of the documents that --json leaves on stdout."""

from __future__ import annotations

from imu_calib.cli.outcome import FORMAT
from imu_calib.model import TRIADS

from .keys import (
    REQUIRED,
    Key,
    Schema,
    Tables,
    Value,
    array,
    choice,
    flag,
    has,
    mapping,
    number,
    or_nothing,
    when,
    whole,
)

COMMANDS = ('calibrate', 'verify', 'compare', 'info', 'report')
_STEPS = tuple(f'{name}s' for name in TRIADS.values())


def _key(name: str, value: Value, meaning: str) -> Key:
    """Return a key that is always there."""
    return Key(name, value, meaning, REQUIRED)


def _maybe(value: Value, words: str = '') -> Value:
    """Return what may be nothing, too."""
    return Value(or_nothing(value.schema), words or f'{value.words}, or `null`')


def _rows(keys: list[Key]) -> Value:
    return array(mapping(keys), 0, words='list, below')


def _below(keys: list[Key]) -> Value:
    return mapping(keys, words='keys, below')


_TEXT = Value({'type': 'string'}, 'text')
_NUMBER = number()
_UNKNOWN = _maybe(_NUMBER)
_TEXTS = array(_TEXT, 0, words='list of texts')
_NAME = _key('name', _TEXT, 'of the parameter')
_UNIT = _key('unit', _TEXT, 'SI unit of value, std and limit; `1` of a ratio')

_ERROR = [
    _key(
        'kind',
        choice(['input', 'not_observable', 'interrupted']),
        'wrong usage or input (exit code 2), data that cannot give the answer (1), Ctrl-C (130)',
    ),
    _key('message', _TEXT, 'the sentence that stderr has'),
]
_VERDICT = choice(['pass', 'marginal', 'fail'])
_JUDGED = [
    _NAME,
    _key('value', _NUMBER, 'as estimated'),
    _key('std', _NUMBER, 'its standard deviation'),
    _UNIT,
    _key('limit', _UNKNOWN, 'largest amount allowed; none is specified'),
    _key('verdict', _maybe(_VERDICT), 'by value, 2 std and limit (ISO 14253-1)'),
]
_SPECIFICATION = [
    _key('verdict', _maybe(_VERDICT), 'of the worst parameter; `fail` is exit code 3'),
    _key('coverage_factor', _NUMBER, 'standard deviations to either side'),
    _key('parameters', _rows(_JUDGED), 'each with its limit'),
]
_SPECIFIED = _key(
    'specification',
    _maybe(_below(_SPECIFICATION)),
    'the unit against its limits; `null` without `--specification`, or without limits',
)
_FILE = _key('file', _TEXT, 'that was written')
_PARAMETER = [
    _NAME,
    _key('value', _NUMBER, 'as estimated'),
    _key('std', _NUMBER, 'its standard deviation'),
    _UNIT,
]
_CALIBRATE = [
    _key(
        'calibration',
        Value({'type': 'object'}, 'keys of [calibration.yaml](calibration.md)'),
        'the file that was written: findings and provenance too',
    ),
    _key('parameters', _rows(_PARAMETER), 'those that were estimated'),
    _key('terms', _TEXTS, 'sentences on the terms'),
    _key('duration', _NUMBER, 'of the session, s'),
    _key('samples', whole(0), 'of the IMU'),
    _SPECIFIED,
    _FILE,
]
_MOVED = [
    _NAME,
    _key('difference', _NUMBER, 'that the recording sees'),
    _key('std', _NUMBER, 'its standard deviation'),
    _UNIT,
]
_TRIAD = [
    _key('sensors', choice(_STEPS), 'which'),
    _key('verdict', _VERDICT, 'of these'),
    _key('chi_square', _NUMBER, 'of all their equations'),
    _key('degrees_of_freedom', whole(0), 'of that'),
    _key('symptom', _maybe(_TEXT), 'what is wrong'),
    _key('moved', _rows(_MOVED), 'parameters that are elsewhere'),
]
_QUANTITIES = ['gravity', 'direction', 'earth_rate', 'up_rate', 'turn', 'turn_axis']
_COMPARED = [
    _key('position', _TEXT, 'where'),
    _key('at', _UNKNOWN, 's after the first rest; `null` of a turn'),
    _key('rate', _NUMBER, 'of a turn, rad/s; 0 at rest'),
    _key('quantity', choice(_QUANTITIES), 'what is compared'),
    _key('deviation', _NUMBER, 'what came out less what should'),
    _key('std', _NUMBER, 'its standard deviation'),
    _key('unit', _TEXT, 'SI unit of both'),
    _key('in_std', _NUMBER, 'one over the other'),
]
_LIMITS = [
    _key('doubt', _NUMBER, 'standard deviations from which a quantity is doubtful'),
    _key('rejection', _NUMBER, 'from which it is rejected'),
]
_VERIFY = [
    _key('verdict', _VERDICT, '`fail` is exit code 1: rejected; `marginal` is accepted'),
    _key('limits', _below(_LIMITS), 'that the verdicts go by'),
    _key('triads', _rows(_TRIAD), 'gyros and accelerometers'),
    _key('compared', _rows(_COMPARED), 'every quantity at every position'),
    _key('findings', _TEXTS, 'what a person should know'),
]
_SIDE_BY_SIDE = [
    _NAME,
    _UNIT,
    _key('values', array(_NUMBER, 2, words='list of numbers'), 'of each calibration, in order'),
    _key('std', array(_NUMBER, 2, words='list of numbers'), 'their standard deviations'),
    _key('chi_square', _UNKNOWN, 'about what fits all best; `null` where all are exact'),
    _key('degrees_of_freedom', whole(0), 'of that'),
    _key('chance', _UNKNOWN, 'probability of so much in a unit that has not changed'),
    _key('differs', flag(), 'whether it differs significantly'),
]
_ALL = [
    _key('chi_square', _UNKNOWN, 'of all parameters together'),
    _key('degrees_of_freedom', whole(0), 'of that'),
    _key('chance', _UNKNOWN, 'its probability'),
    _key('consistent', flag(), 'whether chance explains it'),
]
_COMPARE = [
    _key('names', _TEXTS, 'of the calibrations'),
    _key('parameters', _rows(_SIDE_BY_SIDE), 'those that all have'),
    _key('differing', _TEXTS, 'names of those that differ significantly'),
    _key('false_alarm', _NUMBER, 'chance that any does in a unit that has not changed'),
    _key('all', _below(_ALL), 'all parameters together'),
    _key('only', array(_TEXTS, 2, words='list of lists'), 'for each what it has, and not all'),
    _key('findings', _TEXTS, 'what a person should know'),
]
_TOPIC = [
    _key('name', _TEXT, 'of the topic'),
    _key('type', _TEXT, 'of its messages'),
    _key('messages', whole(0), 'how many'),
    _key('rate', _UNKNOWN, 'messages a second'),
]
_SIX = array(_NUMBER, 6, 6, 'list of 6 numbers')
_REST = [
    _key('at', _NUMBER, 's from the start of the recording'),
    _key('seconds', _NUMBER, 'how long'),
    _key('missing', whole(0), 'samples'),
    _key('up', _TEXT, 'attitude in words'),
    _key('heading', _UNKNOWN, 'about up by the angles of the table, deg'),
    _key('position', _TEXT, 'of the plan, `on the way` or `not used`; empty without a plan'),
    _key('mean', _SIX, 'outputs, rad/s and m/s^2'),
]
_TURN = [
    _key('at', _NUMBER, 's from the start of the recording'),
    _key('seconds', _NUMBER, 'how long'),
    _key('up', _TEXT, 'attitude in words'),
    _key('rate', _NUMBER, 'rad/s, counter-clockwise seen from above'),
    _key('turns', whole(0), 'whole turns'),
    _key('position', _TEXT, 'of the plan; empty without one'),
]
_LATITUDE = array(_NUMBER, 2, 2, 'list of 2 numbers')
_INSIDE = [
    _key('rests', _rows(_REST), 'static dwells'),
    _key('turns', _rows(_TURN), 'whole turns'),
    _key('plan', _TEXT, 'its name; empty without one'),
    _key('missing', _maybe(_TEXTS), 'of the plan; `null` where none has to be kept to'),
    _key('told', _TEXT, 'whether all parameters are determined'),
    _key('latitude', _maybe(_LATITUDE), 'that the gyros see, and its standard deviation, deg'),
    _key('contradictions', _TEXTS, 'of latitude, plan or IMU; why no calibration comes of it'),
    _key('left_out', _TEXTS, 'what is not used, and why'),
    _key('lost', _TEXTS, 'what was lost'),
]
_INFO = [
    _key('path', _TEXT, 'of the recording'),
    _key('seconds', _NUMBER, 'from the first message to the last'),
    _key('files', whole(0), 'how many'),
    _key('compensated', _TEXT, 'calibration that it was compensated by; empty where it was not'),
    _key('topics', _rows(_TOPIC), 'all of them'),
    _key(
        'inside', _maybe(_below(_INSIDE)), 'the streams; `null` where it is not said what they mean'
    ),
    _key('not_said', _TEXT, 'what would have to be said for that'),
]
_REPORT = [_FILE, _SPECIFIED]
_RESULTS = {
    'calibrate': _CALIBRATE,
    'verify': _VERIFY,
    'compare': _COMPARE,
    'info': _INFO,
    'report': _REPORT,
}


def _of_command(name: str) -> Schema:
    result = or_nothing(mapping(_RESULTS[name]).schema)
    return when(has('command', name), {'properties': {'result': result}})


KEYS = [
    _key('format', Value({'const': FORMAT, 'type': 'number'}, f'`{FORMAT}`'), 'of the document'),
    _key('command', Value({'enum': [*COMMANDS, '']}, ', '.join(f'`{c}`' for c in COMMANDS)), 'run'),
    _key('exit_code', choice([0, 1, 2, 3, 130]), 'of the command'),
    _key('error', _maybe(_below(_ERROR)), 'why there is no result'),
    _key('result', Value({'type': ['object', 'null']}, 'keys, below, or `null`'), 'SI units'),
]
TABLES: Tables = {
    'output': KEYS,
    'error': _ERROR,
    'calibrate': _CALIBRATE,
    'estimated': _PARAMETER,
    'specification': _SPECIFICATION,
    'judged': _JUDGED,
    'verify': _VERIFY,
    'limits': _LIMITS,
    'triads': _TRIAD,
    'moved': _MOVED,
    'compared': _COMPARED,
    'compare': _COMPARE,
    'parameters': _SIDE_BY_SIDE,
    'all': _ALL,
    'info': _INFO,
    'topics': _TOPIC,
    'inside': _INSIDE,
    'rests': _REST,
    'turns': _TURN,
    'report': _REPORT,
}
VALUE = mapping(KEYS, *(_of_command(name) for name in COMMANDS))
TITLE = 'What calibrate, verify, compare, info and report write to stdout with --json'
