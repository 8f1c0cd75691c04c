"""The keys of the documents that --json leaves on stdout."""

from __future__ import annotations

import inspect
import re
from dataclasses import fields
from enum import Enum
from typing import Any, get_type_hints

import numpy as np
from numpy.typing import NDArray

from imu_calib.cli.outcome import FORMAT
from imu_calib.common.stream import Floats
from imu_calib.fleet import results
from imu_calib.fleet.results import Dates, Flags
from imu_calib.model.parameters import TRIADS
from imu_calib.session.imu import Verdict

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
_RECORD = [
    _key('unit', _maybe(_TEXT), 'serial number of the recording; `null` if it is not stated'),
    _key('recording', _TEXT, 'its name'),
    _key('sha256', _maybe(_TEXT), 'of the recording'),
    _key('recorded', _maybe(_TEXT), 'when it began, UTC'),
    _key('calibration', _TEXT, 'name of its file'),
    _key('calibrated_unit', _maybe(_TEXT), 'serial number in it'),
    _key('calibration_recorded', _maybe(_TEXT), 'when the recording it was made from began, UTC'),
    _key('calibration_sha256', _maybe(_TEXT), 'of its file; `null` of a value'),
    _key(
        'calibration_as_saved',
        _maybe(flag()),
        'whether its checksum is that of its text; `null` without one',
    ),
    _key('gravity', _NUMBER, 'compared with, m/s^2'),
    _key('gravity_source', _TEXT, '`measured`, or how it was computed'),
    _key('latitude_deg', _NUMBER, 'of the site, deg'),
    _key('table', _maybe(_TEXT), 'its name; `null` without joint states'),
    _key('version', _TEXT, 'of imu_calib that verified'),
]
_VERIFY = [
    _key(
        'verdict',
        choice(['pass', 'marginal', 'fail', 'not tested']),
        '`fail` and `not tested` are exit code 1; `marginal` is accepted',
    ),
    _key(
        'own_recording',
        flag(),
        'whether the calibration was made from the recording, which tests nothing: exit code 1',
    ),
    _key(
        'untested',
        _TEXTS,
        'parameters whose errors the recording would not show; accepted with any: exit code 4',
    ),
    _key('limits', _below(_LIMITS), 'of the verdicts'),
    _key('triads', _rows(_TRIAD), 'gyros and accelerometers'),
    _key('compared', _rows(_COMPARED), 'every quantity at every position'),
    _key('findings', _TEXTS, 'what the user of the result must know'),
    _key('record', _below(_RECORD), 'what was verified with what'),
]
_SIDE_BY_SIDE = [
    _NAME,
    _UNIT,
    _key('values', array(_NUMBER, 2, words='list of numbers'), 'of each calibration, in order'),
    _key('std', array(_NUMBER, 2, words='list of numbers'), 'their standard deviations'),
    _key(
        'expanded',
        array(_NUMBER, 2, words='list of numbers'),
        'their expanded uncertainties, 95 %',
    ),
    _key(
        'e_n',
        array(_UNKNOWN, 1, words='list of numbers'),
        'of the first less each other, over its expanded uncertainty (ISO 13528)',
    ),
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
    _key('by_hand', flag(), 'whether a hand holds the unit'),
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
    _key('units', _TEXTS, 'type and serial number of each unit, as far as stated'),
    _key('simulated', flag(), 'whether the data were simulated'),
    _key('lost', _TEXTS, 'missing or damaged data of the topics that were read'),
    _key('streams', _maybe(_below(_STREAMS)), 'the streams; `null` if their meaning is not stated'),
    _key('missing_input', _TEXT, 'what must be stated for that; the exit code is 2 then'),
    _key('clocks', _rows(_CLOCK), 'of topics whose samples were read: their stamps'),
]
_REPORT = [_FILE, _SPECIFIED]
_DAY = _maybe(_TEXT, 'date, `2026-11-22`, or `null`')
_EACH = array(_UNKNOWN, 24, 24, 'list of 24 numbers, each may be `null`')
_OF_TYPES: dict[Any, Value] = {
    str: _TEXT,
    bool: flag(),
    int: whole(0),
    float: _NUMBER,
    np.datetime64: _DAY,
    Verdict | None: _maybe(_VERDICT),
    tuple[str, ...]: _TEXTS,
    tuple[tuple[str, ...], ...]: array(_TEXTS, 0, words='list of lists'),
    NDArray[np.int64]: array(whole(0), 0, words='list of numbers'),
}
_IN_ROWS: dict[Any, Value] = {
    Floats: _UNKNOWN,
    Dates: _DAY,
    Flags: flag(),
    NDArray[np.int64]: whole(0),
    tuple[str, ...]: _TEXT,
}
_SHAPE = re.compile(r'\(\w+(?:, \w+|,)?\) ')
_FIRST = re.compile(r"^[A-Z](?=[a-z]+\b(?!'))")
"""First letter of a sentence, not of a name."""


def _stated(kind: type, *names: str, rows: bool = False, **others: Value) -> list[Key]:
    """Return keys of a result by its fields, with the words beside them (`#:`).

    Args:
        kind: The result.
        names: Of the fields; without any all of which the value follows from the type.
        rows: Whether arrays are columns, of which a row has one element.
        others: Values where they do not follow from the type.
    """
    hints, words, keys = get_type_hints(kind), _beside(kind), []
    for each in fields(kind):
        hint, meaning = hints[each.name], words[each.name]
        value = others.get(each.name) or (_IN_ROWS if rows else _OF_TYPES).get(hint)
        if isinstance(hint, type) and issubclass(hint, Enum):
            value = choice([one.value for one in hint])
        elif hint == Floats and (', 24)' in meaning or not rows) and each.name not in others:
            value = _EACH
        if (each.name in names or not names) and value is not None:
            meaning = re.sub('NaN|NaT|None', '`null`', _SHAPE.sub('', meaning).rstrip('.'))
            meaning = _FIRST.sub(lambda first: first[0].lower(), meaning)
            keys.append(_key(each.metadata.get('key', each.name), value, meaning))
    return keys


def _beside(kind: type) -> dict[str, str]:
    """Return the words beside the fields of a result, or above them."""
    found: dict[str, str] = {}
    above: list[str] = []
    for line in inspect.getsource(kind).splitlines():
        code, _, words = line.partition('#:')
        field = re.match(r'    (\w+):', code)
        above.append(words.strip())
        if field:
            found[field[1]] = ' '.join(filter(None, above))
        if field or not words:
            above.clear()
    return found


_OF_UNIT = [
    _NAME,
    _UNIT,
    _key('value', _UNKNOWN, 'at the newest session'),
    _key('std', _UNKNOWN, 'its standard deviation, as stated'),
    _key('outside', flag(), 'whether it is significantly beyond its limit'),
    *_stated(results.Trend, rows=True),
    *_stated(results.Scatter, rows=True),
    *_stated(results.Forecast, 'limit', 'leaves', 'earliest', rows=True),
]
_OF_SESSION = [
    *_stated(results.UnitHistory, 'key', 'stand', 'values', 'std', 'corrected', rows=True),
    _key('date', _TEXT, 'UTC'),
    *_stated(results.Charts, rows=True),
]
_STEPPED = [_NAME, _UNIT, *_stated(results.Step, 'size', 'std', 'low', 'high', rows=True)]
_STEP = [
    *_stated(
        results.Step,
        *('index', 'after', 'before', 'cause', 'rotation'),
        rotation=array(_UNKNOWN, 3, 3, 'list of 3 numbers'),
    ),
    _key('parameters', _rows(_STEPPED), 'that step significantly'),
]
_OF_UNITS = [
    *_stated(results.UnitHistory, 'serial', 'imu', 'lot', 'verdict', 'outside'),
    *_stated(results.Forecast, 'recalibrate', 'parameter', 'borrowed', 'reason'),
    _key('parameters', _rows(_OF_UNIT), 'all 24'),
    _key('sessions', _rows(_OF_SESSION), 'by date'),
    _key('steps', _rows(_STEP), 'between sessions'),
    _key('signals', _rows(_stated(results.Signal)), 'of the charts'),
    _key('warnings', _TEXTS, 'of its calibrations: values may be wrong by more than stated'),
    _key('findings', _TEXTS, 'what the user of the result must know'),
]
_DISTRIBUTION = [
    _NAME,
    _UNIT,
    *_stated(results.Population, rows=True, quantiles=Value({'type': 'object'}, 'by probability')),
]
_POPULATION = [
    *_stated(results.Population, 'imu', 'units', 'sessions'),
    _key('parameters', _rows(_DISTRIBUTION), 'all 24'),
    _key('outliers', _rows(_stated(results.Outlier, score=_UNKNOWN)), 'outlying units'),
    _key('lots', _rows(_stated(results.LotShift)), 'outlying lots'),
]
_EFFECT = [_key('stand', _TEXT, 'name'), *_stated(results.Stands, 'effect', 'std')]
_STANDS = [
    *_stated(results.Stands, 'names', 'sessions', 'units', 'groups'),
    _key('effects', _rows(_EFFECT), 'of each'),
    *_stated(results.Stands, 'reproducibility'),
    _key('shifts', _rows(_stated(results.StandShift)), 'stands that are off'),
]
_RULES = [*_stated(results.Rules), *_stated(results.ChartLimits)]
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
    _key('exit_code', choice([0, 1, 2, 3, 4, 130]), 'of the command'),
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
    'record': _RECORD,
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
    'signals': _stated(results.Signal),
    'populations': _POPULATION,
    'distribution': _DISTRIBUTION,
    'outliers': _stated(results.Outlier, score=_UNKNOWN),
    'lots': _stated(results.LotShift),
    'stands': _STANDS,
    'effects': _EFFECT,
    'shifts': _stated(results.StandShift),
}
VALUE = mapping(KEYS, *(_of_command(name) for name in COMMANDS))
TITLE = 'What calibrate, verify, compare, info, report and history write to stdout with --json'
