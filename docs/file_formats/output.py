"""The keys of the documents that --json leaves on stdout."""

from __future__ import annotations

from imu_calib.cli.outcome import FORMAT
from imu_calib.model.parameters import TRIADS

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

COMMANDS = ('calibrate', 'verify', 'compare', 'info', 'report', 'history')
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
    _key('message', _TEXT, 'the sentence on stderr'),
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
_SEVERAL_UNIT = [
    _key('serial_number', _TEXT, 'of the unit'),
    _key('topic', _TEXT, 'of its samples'),
    _key('place', _TEXT, 'on the fixture; empty if not stated'),
    _key('exit_code', choice([0, 1, 2, 3]), 'of the unit alone; the worst is that of the command'),
    _key('error', _maybe(_below(_ERROR)), 'why it failed'),
    _key('result', _maybe(_below(_CALIBRATE)), 'as of one unit, above'),
]
_SEEN = [
    _key('name', _TEXT, 'azimuth, tilt, or a joint and the position at which it stopped'),
    _key('value', _NUMBER, 'rad'),
    _key('std', _NUMBER, 'its standard deviation, rad'),
    _key('prior_std', _NUMBER, 'the one beforehand, rad'),
]
_LEFT_OUT = [
    _key('serial_number', _TEXT, 'of the unit'),
    _key('message', _TEXT, 'why it is calibrated by itself'),
]
_SEVERAL = [
    _key('units', _rows(_SEVERAL_UNIT), 'of several units on one table, each'),
    _key('table', _maybe(_rows(_SEEN)), 'their common estimate of the table'),
    _key('shared', _TEXTS, 'serial numbers of the units that it is estimated from'),
    _key('left_out', _rows(_LEFT_OUT), 'units that contradict the others'),
]
_MOVED = [
    _NAME,
    _key('difference', _NUMBER, 'by the recording'),
    _key('std', _NUMBER, 'its standard deviation'),
    _UNIT,
]
_TRIAD = [
    _key('sensors', choice(_STEPS), 'which'),
    _key('verdict', _VERDICT, 'of these'),
    _key('chi_square', _NUMBER, 'of all their equations'),
    _key('degrees_of_freedom', whole(0), 'of that'),
    _key('symptom', _maybe(_TEXT), 'what is wrong'),
    _key('moved', _rows(_MOVED), 'parameters that differ'),
]
_QUANTITIES = ['gravity', 'direction', 'earth_rate', 'up_rate', 'turn', 'turn_axis']
_COMPARED = [
    _key('position', _TEXT, 'where'),
    _key('at', _UNKNOWN, 's after the first dwell; `null` of a turn'),
    _key('rate', _NUMBER, 'of a turn, rad/s; 0 at rest'),
    _key('quantity', choice(_QUANTITIES), 'what is compared'),
    _key('deviation', _NUMBER, 'result less expected value'),
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
    _key(
        'own_recording',
        flag(),
        'whether the calibration was made from the recording, which tests nothing: exit code 1',
    ),
    _key('limits', _below(_LIMITS), 'of the verdicts'),
    _key('triads', _rows(_TRIAD), 'gyros and accelerometers'),
    _key('compared', _rows(_COMPARED), 'every quantity at every position'),
    _key('findings', _TEXTS, 'what the user of the result must know'),
]
_SIDE_BY_SIDE = [
    _NAME,
    _UNIT,
    _key('values', array(_NUMBER, 2, words='list of numbers'), 'of each calibration, in order'),
    _key('std', array(_NUMBER, 2, words='list of numbers'), 'their standard deviations'),
    _key('chi_square', _UNKNOWN, 'about the best fit; `null` if all are exact'),
    _key('degrees_of_freedom', whole(0), 'of that'),
    _key('chance', _UNKNOWN, 'probability of this or more in an unchanged unit'),
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
    _key('false_alarm', _NUMBER, 'probability that any does in an unchanged unit'),
    _key('all', _below(_ALL), 'all parameters together'),
    _key(
        'only',
        array(_TEXTS, 2, words='list of lists'),
        'for each, the parameters that not all have',
    ),
    _key('findings', _TEXTS, 'what the user of the result must know'),
]
_TOPIC = [
    _key('name', _TEXT, 'of the topic'),
    _key('type', _TEXT, 'of its messages'),
    _key('messages', whole(0), 'how many'),
    _key('rate', _UNKNOWN, 'messages a second'),
]
_SIX = array(_NUMBER, 6, 6, 'list of 6 numbers')
_DWELL = [
    _key('at', _NUMBER, 's from the start of the recording'),
    _key('seconds', _NUMBER, 'how long'),
    _key('missing', whole(0), 'samples that are lost, or excluded as disturbed'),
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
_LISTED = [
    _key('kind', _TEXT, 'hold or turn'),
    _key('start', _NUMBER, 's after the first sample of the IMU'),
    _key('end', _NUMBER, 's, likewise'),
    _key('attitude', _TEXT, 'what is up'),
]
_STREAMS = [
    _key('dwells', _rows(_DWELL), 'static dwells'),
    _key('turns', _rows(_TURN), 'whole turns'),
    _key('plan', _TEXT, 'its name; empty without one'),
    _key('missing', _maybe(_TEXTS), 'of the plan; `null` without a binding plan'),
    _key('summary', _TEXT, 'whether all parameters are determined'),
    _key('latitude', _maybe(_LATITUDE), 'by the gyros, and its standard deviation, deg'),
    _key('contradictions', _TEXTS, 'of latitude, plan or IMU; why it cannot be calibrated'),
    _key('left_out', _TEXTS, 'unused data, with the reason'),
    _key('lost', _TEXTS, 'lost data'),
    _key('segments', _rows(_LISTED), 'the dwells and turns with both ends'),
]
_CLOCK = [
    _key('topic', _TEXT, 'its name'),
    _key('seconds', _NUMBER, 'from the least header stamp to the largest'),
    _key('rate', _UNKNOWN, 'messages per second of stamps'),
    _key('log_seconds', _NUMBER, 'from the first log time to the last'),
    _key('log_rate', _UNKNOWN, 'messages per second of log times'),
    _key('faster', _UNKNOWN, 'rate of the clock of the stamps against that of the log, less one'),
    _key('faster_std', _UNKNOWN, 'its standard deviation'),
    _key(
        'log_steps',
        array(array(_NUMBER, 2, 2), 0, words='list of pairs of numbers'),
        'where log times step against stamps: s from the start, and by how much, s',
    ),
    _key('contradiction', _TEXT, 'why the stamps cannot be right; empty if they can'),
]
_INFO = [
    _key('path', _TEXT, 'of the recording'),
    _key('seconds', _NUMBER, 'from the first message to the last'),
    _key('files', whole(0), 'how many'),
    _key('compensated', _TEXT, 'calibration that it was compensated with; empty if none'),
    _key('topics', _rows(_TOPIC), 'all of them'),
    _key('lost', _TEXTS, 'missing or damaged data of the topics that were read'),
    _key('streams', _maybe(_below(_STREAMS)), 'the streams; `null` if their meaning is not stated'),
    _key('missing_input', _TEXT, 'what must be stated for that; the exit code is 2 then'),
    _key('clocks', _rows(_CLOCK), 'of topics whose samples were read: their stamps'),
]
_REPORT = [_FILE, _SPECIFIED]
_DAY = _maybe(_TEXT, 'date, `2026-11-22`, or `null`')
_EACH = array(_UNKNOWN, 24, 24, 'list of 24 numbers, each may be `null`')
_RULES = [
    _key('false_alarm', _NUMBER, 'largest probability of a wrong statement of each kind'),
    _key('confidence', _NUMBER, 'of intervals'),
    _key('inside', _NUMBER, 'probability of being within the specification until due'),
    _key('smoothing', _NUMBER, 'weight of the newest session in an EWMA'),
    _key('horizon', _NUMBER, 'years beyond which nothing is predicted'),
    _key('individuals_limit', _NUMBER, 'of scores, to either side'),
    _key('ewma_limit', _NUMBER, 'of their EWMA, to either side'),
    _key('parameter_run', _NUMBER, 'sessions between false alarms of one parameter'),
    _key('unit_run', _NUMBER, 'sessions between false alarms of a unit, at least'),
]
_OF_UNIT = [
    _NAME,
    _UNIT,
    _key('value', _UNKNOWN, 'at the newest session'),
    _key('std', _UNKNOWN, 'its standard deviation, as stated'),
    _key('limit', _UNKNOWN, 'largest amount allowed'),
    _key('outside', flag(), 'whether it is significantly beyond that'),
    _key('level', _UNKNOWN, 'of the line at the newest session'),
    _key('level_std', _UNKNOWN, 'its standard deviation'),
    _key('slope', _UNKNOWN, 'of the line, per month'),
    _key('slope_std', _UNKNOWN, 'its standard deviation'),
    _key('slope_low', _UNKNOWN, 'lower end of its interval'),
    _key('slope_high', _UNKNOWN, 'upper end'),
    _key('slope_chance', _UNKNOWN, 'probability of so much without a trend'),
    _key('drifts', flag(), 'whether the slope is significant, all parameters considered'),
    _key('turn_on', _UNKNOWN, 'standard deviation between sessions, beyond what they state'),
    _key('turn_on_low', _UNKNOWN, 'lower end of its interval'),
    _key('turn_on_high', _UNKNOWN, 'upper end'),
    _key('stated', _UNKNOWN, 'standard deviation that sessions state, root mean square'),
    _key('degrees_of_freedom', _NUMBER, 'of the scatter'),
    _key('overstated', flag(), 'whether sessions agree better than they state'),
    _key('leaves', _DAY, 'when the line crosses the limit'),
    _key('inside_until', _DAY, 'until when it is inside with the probability `inside`'),
]
_OF_SESSION = [
    _key('key', _TEXT, 'of the row in the catalogue'),
    _key('date', _TEXT, 'UTC'),
    _key('stand', _TEXT, 'empty where it is not known'),
    _key('values', _EACH, 'in the order of `parameters`'),
    _key('std', _EACH, 'as stated'),
    _key('corrected', _EACH, 'values less what a named stand adds'),
    _key('score', _EACH, 'against the sessions before, as normal deviates'),
    _key('ewma', _EACH, 'of the scores'),
    _key('t2', _UNKNOWN, "Hotelling's T^2 of the scores"),
    _key('t2_limit', _UNKNOWN, 'its limit'),
    _key('t2_chance', _UNKNOWN, 'probability of so much in control'),
]
_STEPPED = [
    _NAME,
    _UNIT,
    _key('size', _NUMBER, 'after less before'),
    _key('std', _NUMBER, 'its standard deviation'),
    _key('low', _NUMBER, 'lower end of its interval'),
    _key('high', _NUMBER, 'upper end'),
]
_STEP = [
    _key('session', whole(0), 'first one after it, from 0'),
    _key('after', _TEXT, 'date of the last session before it'),
    _key('before', _TEXT, 'date of the first session after it'),
    _key('cause', choice(['mount', 'unit']), 'what it looks like'),
    _key('rotation', array(_UNKNOWN, 3, 3, 'list of 3 numbers'), 'of a mount, rad; else `null`'),
    _key('parameters', _rows(_STEPPED), 'that step significantly'),
]
_SIGNAL = [
    _key('chart', choice(['individuals', 'EWMA', 'T^2']), 'which'),
    _key('session', whole(0), 'from 0'),
    _key('parameter', _TEXT, 'empty for T^2'),
    _key('value', _NUMBER, 'what the chart shows'),
    _key('limit', _NUMBER, 'that it leaves'),
]
_OF_UNITS = [
    _key('serial', _TEXT, 'number'),
    _key('imu', _TEXT, 'type'),
    _key('lot', _TEXT, 'empty where it is not known'),
    _key('verdict', _maybe(_VERDICT), 'of the newest session'),
    _key('outside', _TEXTS, 'parameters beyond their limits'),
    _key('recalibrate', _DAY, 'until when all parameters are inside'),
    _key('first_in_doubt', _TEXT, 'parameter that is most likely outside then'),
    _key('borrowed', flag(), "whether the type's trends stand in for the unit's"),
    _key('reason', _TEXT, 'why there is no date; else empty'),
    _key('parameters', _rows(_OF_UNIT), 'all 24'),
    _key('sessions', _rows(_OF_SESSION), 'by date'),
    _key('steps', _rows(_STEP), 'between sessions'),
    _key('signals', _rows(_SIGNAL), 'of the charts'),
    _key('findings', _TEXTS, 'what the user of the result must know'),
]
_DISTRIBUTION = [
    _NAME,
    _UNIT,
    _key('count', whole(0), 'units with a value'),
    _key('mean', _UNKNOWN, 'of the newest values'),
    _key('std', _UNKNOWN, 'between units'),
    _key('median', _UNKNOWN, 'of them'),
    _key('robust_std', _UNKNOWN, '1.4826 times the median absolute deviation'),
    _key('quantiles', Value({'type': 'object'}, 'by probability'), 'of them'),
    _key('turn_on', _UNKNOWN, 'typical standard deviation between sessions'),
    _key('trend', _UNKNOWN, 'mean slope, per month'),
    _key('trend_std', _UNKNOWN, "of units' slopes about it"),
    _key('outside', whole(0), 'units beyond the limit'),
]
_OUTLIER = [
    _key('serial', _TEXT, 'unit'),
    _key('parameter', _TEXT, 'name'),
    _key('value', _NUMBER, 'SI'),
    _key('score', _UNKNOWN, 'distance from the median in robust standard deviations'),
]
_LOT = [
    _key('lot', _TEXT, 'name'),
    _key('parameter', _TEXT, 'name'),
    _key('units', whole(0), 'of it'),
    _key('shift', _NUMBER, 'against all others, SI'),
    _key('std', _NUMBER, 'its standard deviation'),
    _key('chance', _NUMBER, 'probability of this or more, corrected for all tests'),
]
_POPULATION = [
    _key('imu', _TEXT, 'type'),
    _key('units', whole(0), 'how many'),
    _key('sessions', whole(0), 'of all'),
    _key('parameters', _rows(_DISTRIBUTION), 'all 24'),
    _key('outliers', _rows(_OUTLIER), 'outlying units'),
    _key('lots', _rows(_LOT), 'outlying lots'),
]
_COUNTS = array(whole(0), 0, words='list of numbers')
_EFFECT = [
    _key('stand', _TEXT, 'name'),
    _key('effect', _EACH, 'less the mean of the linked stands'),
    _key('std', _EACH, 'their standard deviations'),
]
_SHIFT = [
    _key('stand', _TEXT, 'name'),
    _key('others', _TEXTS, 'stands that it was compared with'),
    _key('identified', flag(), 'whether this one is off'),
    _key('what', _TEXT, 'a parameter, or `K_g`, `K_a`, `E about X`'),
    _key('parameters', _TEXTS, 'shifted parameters'),
    _UNIT,
    _key('shift', _NUMBER, 'its shift'),
    _key('std', _NUMBER, 'its standard deviation'),
    _key('low', _NUMBER, 'lower end of its interval, simultaneous for all tests'),
    _key('high', _NUMBER, 'upper end'),
    _key('chance', _NUMBER, 'probability of this or more, corrected for all tests'),
    _key('units', whole(0), 'units that were on this stand and on another'),
]
_STANDS = [
    _key('names', _TEXTS, 'of the stands'),
    _key('sessions', _COUNTS, 'of each'),
    _key('units', _COUNTS, 'of each'),
    _key('groups', array(_TEXTS, 0, words='list of lists'), 'linked by units'),
    _key('effects', _rows(_EFFECT), 'of each'),
    _key('reproducibility', _EACH, 'standard deviation between stands'),
    _key('shifts', _rows(_SHIFT), 'stands that are off'),
]
_HISTORY = [
    _key('rules', _below(_RULES), 'limits and probabilities used'),
    _key('units', _rows(_OF_UNITS), 'by type and serial number'),
    _key('populations', _rows(_POPULATION), 'of each type'),
    _key('stands', _below(_STANDS), 'compared with each other'),
    _key('findings', _TEXTS, 'on all units: what the user of the result must know'),
]
_RESULTS = {
    'calibrate': _CALIBRATE,
    'verify': _VERIFY,
    'compare': _COMPARE,
    'info': _INFO,
    'report': _REPORT,
    'history': _HISTORY,
}


def _of_command(name: str) -> Schema:
    schema = mapping(_RESULTS[name]).schema
    if name == 'calibrate':
        schema = {'anyOf': [schema, mapping(_SEVERAL).schema]}
    result = or_nothing(schema)
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
    'several': _SEVERAL,
    'several_unit': _SEVERAL_UNIT,
    'seen': _SEEN,
    'left_out': _LEFT_OUT,
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
    'clocks': _CLOCK,
    'streams': _STREAMS,
    'dwells': _DWELL,
    'turns': _TURN,
    'segments': _LISTED,
    'report': _REPORT,
    'history': _HISTORY,
    'rules': _RULES,
    'units': _OF_UNITS,
    'of_unit': _OF_UNIT,
    'sessions': _OF_SESSION,
    'steps': _STEP,
    'stepped': _STEPPED,
    'signals': _SIGNAL,
    'populations': _POPULATION,
    'distribution': _DISTRIBUTION,
    'outliers': _OUTLIER,
    'lots': _LOT,
    'stands': _STANDS,
    'effects': _EFFECT,
    'shifts': _SHIFT,
}
VALUE = mapping(KEYS, *(_of_command(name) for name in COMMANDS))
TITLE = 'What calibrate, verify, compare, info, report and history write to stdout with --json'
