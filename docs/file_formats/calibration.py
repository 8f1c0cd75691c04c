"""The keys of calibration.yaml, of files of several temperatures, and of truths: one format."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from imu_calib.calibration import provenance
from imu_calib.calibration.thermal import MOST
from imu_calib.common.budget import ErrorSource
from imu_calib.common.config import Section
from imu_calib.common.keys import FieldKey
from imu_calib.common.stream import Units
from imu_calib.model.alignment import GROUPS
from imu_calib.model.parameters import AXES, MOST_SKEWED, TRIADS
from imu_calib.model.session_terms import Course
from imu_calib.model.terms import TERMS

from .keys import (
    REQUIRED,
    VALUES,
    Key,
    Schema,
    Tables,
    Value,
    array,
    choice,
    either,
    flag,
    given,
    key_of,
    mapping,
    number,
    text,
    when,
    whole,
)

_NUMBER = number()
_BELOW = 'keys, below'
_READERS = 'not read: for people only'


def _row(count: int) -> Value:
    return array(_NUMBER, count, count, f'list of {count} numbers')


def _matrix(rows: int, columns: int) -> Value:
    return array(_row(columns), rows, rows, f'{rows} x {columns} numbers')


_ROWS = array(array(_NUMBER), words='rows of numbers')
_FORMAT = Key(
    'format', Value({'const': 1, 'type': 'number'}, '`1`'), 'version of the format', REQUIRED
)
_IMU = Key('imu', text(), '`id` of the [IMU](imu.md)', REQUIRED)
_SERIAL = Key('serial_number', text(), 'of the unit', '')
_CHECKSUM = Key(
    'checksum',
    text(),
    'SHA-256 of all lines above: `certificate` refuses a file that was edited, `verify` says so',
)

_SCALE = Key(
    'scale_factor',
    number(above=0),
    'nominal: rad or m/s per pulse, rad/s or m/s^2 per count, 1 for SI',
    REQUIRED,
)
_RANGE = Key(
    'range', number(above=0), 'rad/s or m/s^2: beyond, a bias is refused', None, 'no limit'
)
_MATRIX = Key(
    'error_matrix',
    _matrix(3, 3),
    'scale-factor errors on the diagonal, misalignments (rad) off it: row is the channel, column '
    'the input axis',
    None,
    'must be given; omitted with `bias` for accelerometers that were not estimated',
)
_BIAS = Key('bias', _row(3), 'rad/s or m/s^2', None, 'must be given with `error_matrix`')


def _terms(letter: str) -> list[Key]:
    """Return a key for each term of a triad."""
    keys = []
    for term in TERMS:
        if term.triad == letter:
            count = len(term.parameters) // len(AXES)
            value = (number(), _row(3))[count] if count < 2 else _matrix(3, count)
            unit = term.kind.value.units[letter].si
            unit = '' if unit == '1' else f', {unit}'
            meaning = f'{term.kind.value.words}{unit}: to channel i add `{term.formula}`'
            keys.append(Key(term.name, value, meaning.replace('|', r'\|')))
    return keys


def _std(keys: list[Key]) -> Key:
    """Return the key for the standard deviations of others."""
    mine = [replace(key, default=None, otherwise='') for key in keys]
    return Key(
        'std',
        mapping(mine),
        'standard deviations by key, for people: refused if they are not those of `covariance`',
    )


def _triad(letter: str) -> list[Key]:
    linear = [_MATRIX, _BIAS, *_terms(letter)]
    return [_SCALE, _RANGE, *linear, _std(linear)]


_BOTH = given('error_matrix', 'bias')
_ESTIMATED = when({'anyOf': [given(k.name) for k in _triad('a')[2:]]}, _BOTH)

_EACH_SKEWED = [
    Key(
        'response',
        array(_row(3), 1, MOST_SKEWED, 'a row of 3 numbers for each gyro'),
        'to rates about X, Y, Z',
        REQUIRED,
    ),
    Key('bias', array(_NUMBER, 1, MOST_SKEWED, 'a number for each gyro'), 'rad/s', REQUIRED),
]
_SKEWED = [_SCALE, _RANGE, *_EACH_SKEWED, _std(_EACH_SKEWED)]
_COVARIANCE = [
    Key(
        'parameters',
        array(text(), words='list of names'),
        'the parameters that were estimated, in the order of the suite '
        '([parameters](../mathematics.md#7-terms))',
        REQUIRED,
    ),
    Key('matrix', _ROWS, 'their covariance, SI units: symmetric, positive semidefinite', REQUIRED),
]
_LINE = [
    Key('source', choice([s.value for s in ErrorSource]), 'of uncertainty', REQUIRED),
    Key('evaluation', text(), f"'A' by statistics, 'B' by other means; {_READERS}"),
    Key('description', text(), f'in words; {_READERS}'),
    Key(
        'standard_uncertainty',
        array(number(least=0), words='list of numbers, 0 or more'),
        'contribution to each parameter, SI units',
        REQUIRED,
    ),
    Key(
        'degrees_of_freedom',
        array(number(least=1), words='list of numbers, 1 or more, or `.inf`'),
        'of each',
        REQUIRED,
    ),
]
_ANYTHING = Value({}, 'list')
_BUDGET = [
    Key('parameters', array(text(), words='list of names'), 'as in `covariance`', REQUIRED),
    Key('units', _ANYTHING, f'of each; {_READERS}'),
    Key('standard_uncertainty', _ANYTHING, f'of each; {_READERS}'),
    Key('effective_degrees_of_freedom', _ANYTHING, f'of each; {_READERS}'),
    Key('coverage_probability', Value({}, 'number'), _READERS),
    Key('coverage_factor', _ANYTHING, f'of each; {_READERS}'),
    Key('expanded_uncertainty', _ANYTHING, f'of each; {_READERS}'),
    Key('sources', array(mapping(_LINE), words='list of sources, below'), 'the lines', REQUIRED),
]
_COEFFICIENT = [
    Key('term', choice([c.value for c in Course]), 'time or temperature', REQUIRED),
    Key('of', text(), 'its parameter, or `K_g`, `K_a` for all of a triad', REQUIRED),
    Key('value', _NUMBER, 'of the coefficient', REQUIRED),
    Key('std', _NUMBER, 'its standard deviation', REQUIRED),
    Key('unit', text(), 'SI unit of both', REQUIRED),
]
_CHANGES = [
    Key(
        'coefficients',
        array(mapping(_COEFFICIENT), words='list of coefficients, below'),
        'one for each parameter or triad',
        REQUIRED,
    ),
    Key('covariance', _ROWS, 'of the coefficients', REQUIRED),
    Key('cross_covariance', _ROWS, 'of the parameters (rows) and the coefficients', REQUIRED),
    Key('time_constant', _NUMBER, 'of a warm-up, s'),
    Key('instant', _NUMBER, 'of a step, s by the stamps of the table'),
]
_CLOCK = [
    Key('name', text(), 'node whose stamps the clock makes', REQUIRED),
    Key('against', text(), 'the clock that it is compared with', REQUIRED),
    Key(
        'faster',
        Value(
            {'type': 'number', 'exclusiveMinimum': -0.1, 'exclusiveMaximum': 0.1},
            'number, between -0.1 and 0.1',
        ),
        'relative excess of its rate, a ratio less one',
        REQUIRED,
    ),
    Key('faster_std', number(least=0), 'standard deviation of that', REQUIRED),
]
_RESIDUAL = [
    Key('position', text(), 'where', REQUIRED),
    Key('time', _NUMBER, 's since the session began', REQUIRED),
    Key('gyro', _row(3), 'rad/s', None, 'not estimated'),
    Key('accelerometer', _row(3), 'm/s^2', None, 'not estimated'),
]


def _between(least: float, most: float) -> Value:
    return Value(
        {'type': 'number', 'minimum': least, 'maximum': most}, f'number, {least:g} to {most:g}'
    )


def _noted(keys: list[Key]) -> Value:
    """Return a mapping that may have further keys."""
    return Value({**mapping(keys).schema, 'additionalProperties': True}, _BELOW)


def _named(value: Value, words: str) -> Value:
    """Return a mapping of names that somebody gave to values of one kind."""
    return Value({'type': 'object', 'additionalProperties': value.schema}, words)


_MAYBE = Value({'type': ['number', 'null'], 'minimum': 0}, 'number')
_CURVE_OF = array(_MAYBE, 0, None, 'list of numbers, 0 or more')
_TIMES = array(
    Value({'type': ['number', 'null'], 'exclusiveMinimum': 0}, 'number'),
    0,
    None,
    'list of numbers above 0',
)
_TEMPERATURE = [
    Key(name, _NUMBER, f'{words}, degC', REQUIRED)
    for name, words in (
        ('mean', 'of the session'),
        ('lowest', 'of the session'),
        ('highest', 'of the session'),
    )
]
_CHANNEL = [
    *(
        Key(f'{name}{end}', number(least=0), f'{words}{what}, SI units')
        for name, words in (
            ('random_walk', 'random walk'),
            ('bias_instability', 'bias instability'),
            ('quantisation', 'quantisation'),
            ('rate_random_walk', 'rate random walk'),
        )
        for end, what in (('', ''), ('_std', ': standard deviation'), ('_below', ': 95 % limit'))
    ),
    Key('tau', _TIMES, 'averaging times of the Allan deviation, s', REQUIRED),
    Key('deviation', _CURVE_OF, 'Allan deviation, SI units', REQUIRED),
    Key('std', _CURVE_OF, 'its standard deviation', REQUIRED),
    Key('timed', flag(), 'whether pulses were timed', REQUIRED),
]
_MOVED = [
    Key('parameter', text(), 'its name', REQUIRED),
    Key('by', _NUMBER, 'for a coefficient of 1, SI units', REQUIRED),
]
_TEST = [
    Key('state', text(), 'estimated, off or requested', REQUIRED),
    Key(
        'log10_p',
        Value({'type': 'number', 'maximum': 0}, 'number, 0 or less'),
        'decimal logarithm of the probability by chance',
    ),
    Key('probability', _between(0, 1), 'of a drift that was not detected'),
    Key(
        'found_from',
        array(_MAYBE, 0, None, 'list of numbers, 0 or more'),
        'coefficients that would be found nine times in ten, SI units',
    ),
    Key(
        'would_move',
        _named(mapping(_MOVED), 'by coefficient: `parameter`, `by`'),
        'the parameter that a coefficient would move most',
    ),
]


def _entries(known: Mapping[str, FieldKey]) -> list[Key]:
    return [key_of(replace(one, name=name)) for name, one in known.items()]


def _at_least(least: float, most: float | None = None) -> Value:
    if most is not None:
        return _between(*(int(x) if x == round(x) else x for x in (least, most)))
    return number(above=0) if least == provenance.LEAST else number(least=least)


_NAMED = {
    Section.number: (_NUMBER, 'numbers by name'),
    Section.text: (text(), 'by name'),
    provenance.test_of_term: (_noted(_TEST), 'by the name of the term'),
    provenance.channel_noise: (mapping(_CHANNEL), 'by channel, `gx` to `az`'),
}
VALUES.update(
    {
        provenance.texts: lambda: array(text(), 0, words='list of texts'),
        provenance.number_within: _at_least,
        provenance.possible: number,
        provenance.numbers: lambda count=None: array(
            _MAYBE, count or 0, count, f'list of {f"{count} " if count else ""}numbers, 0 or more'
        ),
        provenance.temperature: lambda: _noted(_TEMPERATURE),
        provenance.entries: lambda known: _noted(_entries(known)),
        provenance.each: lambda read: _named(*_NAMED[read]),
    }
)
_PROVENANCE = _entries(provenance.ENTRIES)


def _needed(key: Key) -> Key:
    return replace(key, default=REQUIRED) if key in (_MATRIX, _BIAS) else key


_TRIADS = {
    'g': mapping([_needed(key) for key in _triad('g')], words=_BELOW),
    'a': mapping(_triad('a'), _ESTIMATED, words=_BELOW),
}

KEYS = [
    _FORMAT,
    _IMU,
    _SERIAL,
    Key(
        'units', choice([u.value for u in Units]), "of the IMU's numbers, as in its file", REQUIRED
    ),
    *(Key(name, _TRIADS[letter], f'the {name}s', REQUIRED) for letter, name in TRIADS.items()),
    Key('skewed_gyro', mapping(_SKEWED, words=_BELOW), 'further gyros, skewed to the three'),
    Key(
        'free_of_frame',
        Value({'type': 'object'}, ', '.join(f'`{g.key}`' for g in GROUPS)),
        f'angles between input axes, rad, and their `std`; {_READERS}',
    ),
    Key(
        'covariance',
        mapping(_COVARIANCE, words=_BELOW),
        'of the parameters',
        None,
        'none: exact, as a truth is',
    ),
    Key(
        'uncertainty_budget',
        mapping(_BUDGET, words=_BELOW),
        'the variances by source ([budget](../budget.md))',
    ),
    Key(
        'session_terms',
        mapping(_CHANGES, words=_BELOW),
        'parameters that changed with time or temperature',
    ),
    Key('clock', mapping(_CLOCK, words=_BELOW), "that stamps the samples, against the table's"),
    Key(
        'residuals',
        array(mapping(_RESIDUAL), 0, words='list, below'),
        'of every static dwell',
    ),
    Key(
        'findings',
        array(text(), 0, words='list of sentences'),
        'what the user of the result must know: warnings, which begin with `Warning:`, then notes '
        'by their effect on the numbers',
    ),
    Key('provenance', _noted(_PROVENANCE), 'origin of the calibration; other keys are allowed'),
    _CHECKSUM,
]
_SINGLE = mapping(KEYS)

COMBINED = [
    _FORMAT,
    _IMU,
    _SERIAL,
    Key(
        'order',
        either(choice(['lines']), whole(1, MOST), words=f'`lines`, or 1 to {MOST}'),
        'straight lines between temperatures, or a polynomial of this order',
        'lines',
    ),
    Key(
        'calibrations',
        array(Value({'$ref': '#/$defs/single'}, ''), 2, words='list of calibrations'),
        'each as in its own file, with `provenance: temperature`',
        REQUIRED,
    ),
    _CHECKSUM,
]

TABLES: Tables = {
    'calibration': KEYS,
    'gyro': _triad('g'),
    'accelerometer terms': _terms('a'),
    'skewed_gyro': _SKEWED,
    'covariance': _COVARIANCE,
    'uncertainty_budget': _BUDGET,
    'sources': _LINE,
    'session_terms': _CHANGES,
    'coefficients': _COEFFICIENT,
    'clock': _CLOCK,
    'residuals': _RESIDUAL,
    'provenance': _PROVENANCE,
    'temperature': _TEMPERATURE,
    'clocks': _entries(provenance.ENTRIES['clock'].arguments[0]),
    'tests': _TEST,
    'moved': _MOVED,
    'closed form': _entries(provenance.ENTRIES['closed_form'].arguments[0]),
    'noise': _CHANNEL,
    'combined': COMBINED,
}
_WHOLE: Schema = {
    '$defs': {'single': _SINGLE.schema},
    'type': 'object',
    **when(given('calibrations'), mapping(COMBINED).schema, {'$ref': '#/$defs/single'}),
}
VALUE = Value(_WHOLE, '')
TITLE = 'A calibration, one of several temperatures, or the truth of a simulated unit'
