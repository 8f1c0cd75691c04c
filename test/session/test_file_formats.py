"""Files that people write: schemas and suite refuse the same, and the pages are true of both.

Every example of the pages, and what they leave out, is changed in one place at a time: a key left
out, of another type, in another unit, beyond zero, unknown. Schema and suite must say the same.
"""

import copy
import json
import re
import sys
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import pytest
import yaml
from jsonschema import Draft202012Validator, validators
from loopback import CHECKOUT

from imu_calib.calibration.thermal import read_calibration
from imu_calib.cli.main import main
from imu_calib.common.config import Section
from imu_calib.common.errors import InputError
from imu_calib.common.files import share_folder
from imu_calib.common.units import Dimension, parse
from imu_calib.estimation.methods import METHODS
from imu_calib.live.devices.format import load_format, read_format
from imu_calib.reports.certificate_fields import read_fields
from imu_calib.session.imu import load_imu, read_imu
from imu_calib.session.plan import METHOD_NAMES, load_plan, read_plan
from imu_calib.session.table import load_table, read_table
from imu_calib.session.units_file import read_units
from imu_calib.simulation.options import StandOptions, read_imperfections

sys.path.insert(0, str(CHECKOUT / 'docs'))

from file_formats import pages
from file_formats.keys import pattern

TABLE = load_table('three_axis')
READERS = {
    'imu': read_imu,
    'table': read_table,
    'plan': read_plan,
    'device': read_format,
    'calibration': read_calibration,
    'certificate': read_fields,
    'units': read_units,
    'imperfections': lambda section: read_imperfections(section, StandOptions(), TABLE, 1),
}
FOLDERS = {
    'imus': 'imu',
    'tables': 'table',
    'plans': 'plan',
    'devices': 'device',
    'truths': 'calibration',
    'imperfections': 'imperfections',
    'certificates': 'certificate',
}
SHIPPED = [
    pytest.param(kind, path, id=f'{folder}/{path.stem}')
    for folder, kind in FOLDERS.items()
    for path in sorted((CHECKOUT / 'config' / folder).glob('*.yaml'))
]
PAGES = sorted(pages.PAGES.glob('*.md'))
EXAMPLE = re.compile(r'<!-- example: (\w+) -->\n```yaml\n(.*?)```', re.DOTALL)
MESSAGES = re.compile(r'<!-- messages: (\w+) -->\n(.*?)<!-- end -->', re.DOTALL)


@cache
def validator(kind):
    """By the file that is shipped, not by what would be written now."""
    return Draft202012Validator(json.loads((pages.SCHEMAS / f'{kind}.json').read_text()))


def remembering(kind):
    """Return a validator for documents that share most of what they hold: it looks at that once."""
    known = {}

    def once(name):
        check = Draft202012Validator.VALIDATORS[name]

        def first_error(by, value, instance, schema):
            key = id(value), id(instance)
            if key not in known:
                # The instance is kept: as long as it is there, no other has its number.
                known[key] = instance, next(check(by, value, instance, schema) or iter(()), None)
            return (error for _, error in [known[key]] if error is not None)

        return first_error

    costly = {name: once(name) for name in ('$ref', 'properties', 'items', 'allOf', 'anyOf')}
    return validators.extend(Draft202012Validator, costly)(validator(kind).schema)


def refusal(kind, document):
    """Return what the suite says of a document, and None where it reads it."""
    try:
        READERS[kind](Section(document, 'my.yaml'))
    except InputError as error:
        return str(error)
    return None


@cache
def examples():
    found = [m for page in PAGES for m in EXAMPLE.findall(page.read_text())]
    return [(kind, yaml.safe_load(text)) for kind, text in found]


def example(kind, number=0):
    return copy.deepcopy([document for of, document in examples() if of == kind][number])


def with_values(document, **values):
    """Return a document with values at paths whose parts are joined by two underscores."""
    for path, value in values.items():
        *above, key = (int(k) if k.isdigit() else k for k in path.split('__'))
        place = document
        for part in above:
            place = place[part]
        place[key] = value
    return document


CURVE = {'tau': [1.0, 2.0], 'deviation': [1e-6, 1e-6], 'std': [1e-7, 1e-7]}
ORIGIN = {
    'recording': 'session',
    'sha256': 'a1',
    'imu_sha256': 'b2',
    'table_sha256': 'c3',
    'topics': ['/imu/pulses'],
    'recorded': '2026-01-31T12:00:00Z',
    'terms': ['g_sensitivity'],
    'terms_looked_for': True,
    'plan': 'twelve_position',
    'table': 'three_axis',
    'table_clock_std': 1e-5,
    'latitude_deg': 34.65,
    'latitude_std_deg': 0.01,
    'gravity': 9.797,
    'gravity_source': 'measured',
    'gravity_std': 1e-4,
    'height': 300.0,
    'height_assumed': False,
    'azimuth_seen_deg': 3.0,
    'azimuth_seen_std_deg': 0.1,
    'segments': 12,
    'turns': 18,
    'samples': 1000,
    'random_walk': [1e-6] * 6,
    'residual_rms': [1e-6, None, 1e-6, 1e-5, 1e-5, 1e-5],
    'bias_drift': [1e-6] * 6,
    'condition_number': 4.2,
    'highest_rate': 1.0,
    'temperature': {'mean': 25.0, 'lowest': 24.0, 'highest': 26.0},
    'missing_positions': ['7'],
    'shared_with': ['A1002'],
    'closed_form': {
        'method': 'twelve_position',
        'joint_std_over_closed_form': 0.9,
        'difference_in_std': {'K_gx': -0.5},
    },
    'clock': {'offset_s': 0.001, 'rate_ppm': 3.0, 'rate_std_ppm': 0.1, 'motions': 20},
    'versions': {'numpy': '2'},
    'frame': 'accelerometers',
    'tests_of_terms': {
        'gyro_cubic': {
            'state': 'off',
            'log10_p': -0.5,
            'found_from': [1e-5, None, 2e-5],
            'would_move': {'C_gx': {'parameter': 'K_gx', 'by': 2.8}},
        },
        'trend': {'state': 'off', 'probability': 0.2},
    },
    'noise': {'gx': {**CURVE, 'random_walk': 1e-6, 'random_walk_std': 1e-7, 'timed': True}},
}
"""Every key that is checked; laboratories may add theirs."""


def calibrations():
    """Yield calibrations with what the examples have not, and the paths to that."""
    gyros = example('calibration')
    names = gyros['covariance']['parameters']
    line = {'source': 'sensor_noise', 'evaluation': 'A', 'description': 'noise'}
    std = np.sqrt(np.diag(gyros['covariance']['matrix'])).tolist()
    line |= {'standard_uncertainty': std, 'degrees_of_freedom': [float('inf')] * 12}
    gyros['gyro']['std'] = {'bias': std[9:]}
    gyros['uncertainty_budget'] = {'parameters': names, 'coverage_factor': [2.0], 'sources': [line]}
    coefficient = {'term': 'thermal', 'of': 'D_gx', 'value': 1e-8, 'std': 1e-9, 'unit': 'rad/s/K'}
    gyros['session_terms'] = {
        'coefficients': [coefficient],
        'covariance': [[1e-18]],
        # One row for each of the 24: those of the accelerometers are there as well.
        'cross_covariance': [[0.0]] * 24,
        'time_constant': 600.0,
        'instant': 1.7e9,
    }
    gyros['provenance'] |= ORIGIN
    yield gyros, [('uncertainty_budget',), ('session_terms',), ('provenance',), ('gyro', 'std')]
    whole = example('calibration', 1)
    whole['skewed_gyro'] = {'scale_factor': 1, 'response': [[0.58, 0.58, 0.58]], 'bias': [0.0]}
    whole['gyro'] |= {'g_sensitivity': [[0.0] * 3] * 3, 'std': {'bias': [0, 0, 0]}}
    whole['accelerometer'] |= {'accel_cross': [[0.0] * 3] * 3, 'accel_cubic': [0, 0, 0]}
    yield whole, [('skewed_gyro',), ('gyro',), ('accelerometer',)]
    parts = [example('calibration', 1) for _ in range(2)]
    for mean, part in zip((10.0, 40.0), parts, strict=True):
        part['provenance'] = {'temperature': {'mean': mean, 'lowest': mean, 'highest': mean}}
    both = {'format': 1, 'imu': 'a', 'serial_number': 7, 'order': 1, 'calibrations': parts}
    yield both, [*((k,) for k in list(both)[:-1]), ('calibrations', 0, 'provenance')]


def further():
    """Yield documents of kinds that the examples are not, and the paths to what is new there."""
    counts = {'id': 'a', 'units': 'counts', 'gyro': {'scale_factor': '0.01 (deg/s)/count'}}
    counts |= {'accelerometer': {'scale_factor': '1 mg/count'}, 'skewed_gyro': counts['gyro']}
    yield 'imu', counts
    yield 'table', with_values(example('table'), mount=['-x', 'y', '-z']), [('mount',)]
    device = example('device')
    for checksum in (
        {'kind': 'sum', 'width': 16, 'negated': True, 'offset': 46},
        {'kind': 'sum', 'word': 16, 'width': 16, 'offset': 46},
        {'kind': 'fletcher', 'modulus': 256, 'offset': 46},
        {'kind': 'xor', 'init': 0xFF, 'offset': 46},
        {'kind': 'CRC-16/MODBUS', 'offset': 46},
        {'kind': 'crc', 'width': 8, 'poly': 7, 'offset': 46},
        'none',
    ):
        yield 'device', {**device, 'checksum': checksum, 'others': None}, [('checksum',)]
    fields = {
        'gyro': {'type': 'f32', 'offset': [10, 14, 18], 'scale': [2]},
        'accelerometer': {'type': 'f32', 'offset': [22, 26, 30]},
        'time': {'type': 'u32', 'offset': 6, 'unit': 'us', 'modulus': 1000},
        'status': {'type': 'u64', 'offset': 34, 'faults': [{'bit': 63, 'says': 'no'}]},
    }
    yield 'device', {**device, 'checksum': 'none', 'others': None, 'fields': fields}, [('fields',)]
    yield from (('calibration', *rest) for rest in calibrations())


EVERYWHERE = ((),)
DOCUMENTS = [
    pytest.param(*(*d, EVERYWHERE)[:3], id=f'{d[0]} {i}')
    for i, d in enumerate([*examples(), *further()])
]


def described(kind, document):
    """Yield the path of every key that a document may have, and each schema that holds for it."""
    root = validator(kind).schema
    yield from _described(root, document, root, ())


def _described(schema, node, root, path):
    if '$ref' in schema:
        part = root
        for name in schema['$ref'].split('/')[1:]:
            part = part[name]
        yield from _described(part, node, root, path)
    fits = Draft202012Validator(root).evolve
    parts = [*schema.get('allOf', ()), *schema.get('anyOf', ())]
    if 'if' in schema:
        holds = fits(schema=schema['if']).is_valid(node)
        parts.append(schema.get('then' if holds else 'else', {}))
    for part in parts:
        if fits(schema=part).is_valid(node):
            yield path, part
            yield from _described(part, node, root, path)
    for name, value in schema.get('properties', {}).items() if isinstance(node, dict) else ():
        if isinstance(value, dict):
            yield (*path, name), value
            if node.get(name) is not None:
                yield from _described(value, node[name], root, (*path, name))
    for i, item in enumerate(node if isinstance(node, list) and 'items' in schema else ()):
        yield (*path, i), schema['items']
        yield from _described(schema['items'], item, root, (*path, i))


@dataclass
class Case:
    path: tuple
    what: str
    document: Any


def places(node, path=()):
    """Yield the path of every value below a node; in lists of plain values of the first alone."""
    children = list(node.items() if isinstance(node, dict) else enumerate(node))
    if isinstance(node, list) and not any(isinstance(v, dict) for v in node):
        children = children[:1]
    for key, child in children:
        yield (*path, key)
        if isinstance(child, (dict, list)):
            yield from places(child, (*path, key))


def at(document, path):
    for key in path:
        document = document[key]
    return document


OTHERS = {
    'nothing': None,
    'a mapping': {},
    'a list': [],
    'a list of a list': [[]],
    'a list of a number': [1],
    'a text': 'nonsense',
    'a text in capitals': 'NONE',
    'an empty text': '',
    'a fraction': 0.25,
    'a whole number with a point': 2.0,
    'true': True,
    'zero': 0,
    'minus one': -1,
    'one': 1,
    'many': 10**6,
}
QUANTITY = re.compile(r'([-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?)\s*(\S.*)')
UNITS = sorted({unit for dimension in Dimension for unit in dimension.spellings})
SOME_UNITS = UNITS[::15]
"""Another test takes all."""
SPELT = ('-1e-7 {}', '0 {}', '1e9 {}', '{}', '1', '1 parsec', '1,5 {}', '1 {} {}', '\u0663 {}')


def other_values(value):
    """Yield what may stand wrongly in place of a value, and some that may stand there."""
    yield from OTHERS.items()
    match = QUANTITY.fullmatch(value) if isinstance(value, str) else None
    if match and match[2] in UNITS:
        for text in (spelt.format(match[2], match[2]) for spelt in SPELT):
            yield repr(text), text
        yield from ((f'in {unit}', f'1e-7 {unit}') for unit in SOME_UNITS)
    elif isinstance(value, str):
        for text in (f'-{value}', f'{value}s', f' {value}', value.upper()):
            yield repr(text), text
    if isinstance(value, list):
        yield 'the last left out', value[:-1]
        yield 'the first twice', [*value, copy.deepcopy(value[0])]
        yield 'the other way round', value[::-1]


GONE = object()


def put(document, path, value):
    """Return a document with another value at a path; what is not on the way is shared."""
    key, *rest = path
    copied = copy.copy(document)
    if rest:
        copied[key] = put(document[key], rest, value)
    elif value is GONE:
        del copied[key]
    else:
        copied[key] = value
    return copied


def changed(kind, document, where):
    """Yield documents that differ from one in one place: on the way to some paths, or below."""
    mine = [
        path
        for path in places(document)
        if any(path[: len(way)] == way[: len(path)] for way in where)
    ]
    for path in mine:
        yield Case(path, 'left out', put(document, path, GONE))
        for what, value in other_values(at(document, path)):
            yield Case(path, what, put(document, path, value))
        if isinstance(at(document, path), dict):
            yield Case((*path, 'nonsense'), 'unknown', put(document, (*path, 'nonsense'), 1))
    yield Case(('nonsense',), 'unknown', {**document, 'nonsense': 1})
    for path, part in described(kind, document):
        if path in mine and isinstance(at(document, path), (int, float)):
            for bound in {part.get('minimum'), part.get('maximum')} - {None}:
                for value in (bound - 1, bound, bound + 1):
                    yield Case(path, str(value), put(document, path, value))


BEYOND_A_SCHEMA = {
    'table': [
        ({'joints__1__name': 'outer'}, 'joints: two joints have the same name'),
        ({'mount': ['x', 'x', 'z']}, r'mount: found .*expected three perpendicular axes'),
        ({'mount': ['x', 'y', '-z']}, 'mount: the three axes are left-handed'),
        ({'joints__1__limits__upper': '-190 deg'}, 'limits: lower is not below upper'),
        ({'wobble': '61 arcmin'}, 'found .* deg, expected 0 to 1 deg'),
        ({'level': '2 deg'}, 'level: found .* deg, expected more than 0 to 1 deg'),
        ({'clock': '1 %'}, 'clock: found .* ppm, expected at most 1000 ppm'),
        ({'joints__1__axis': [float('inf'), 0, 0]}, 'axis: found .*inf'),
    ],
    'plan': [
        ({'positions__1__id': 'x_up'}, 'positions: two positions have the id'),
        ({'dwell': '1000 h'}, 'its dwells last .* days in all, expected at most 30'),
    ],
    'imu': [
        ({'gyro__range': '1e999 deg/s'}, 'range: found .* expected a finite number'),
        ({'gyro__range': '1e-999 deg/s'}, 'range: found .* expected above 0'),
    ],
    'device': [
        ({'length': 40}, 'offset: found .* expected .*whole number'),
        ({'start__0__wait': '11 s'}, 'wait: found .* expected at most 10 s'),
        ({'start__1__text': 'x' * 1025}, 'found 1025 bytes, expected at most 1024'),
        ({'start_again': '0.4 s'}, 'start_again: found .* expected 0.5 or more'),
        ({'stop__0__wait': '2.5 s'}, 'stop: the waits add up to .* expected at most 2 s'),
        (
            {'checksum': {'kind': 'sum', 'word': 16, 'offset': 46, 'covers': [1, 45]}},
            'covers: found .* bytes, expected whole words',
        ),
        ({'fields__temperature__offset': 47}, "reach beyond the frame's length of 48"),
        ({'sync': [0] * 60, 'constant': None}, 'constant bytes reach beyond the length'),
        ({'fields__counter__bits': [11, 0]}, 'bits: found .* expected the first and the last bit'),
        ({'fields__time__offset': 1}, 'byte .* is part of constant bytes'),
        ({'fields__time__offset': 44}, 'byte .* is part of the checksum'),
        ({'fields__counter__modulus': 4097}, 'modulus: found .* expected .*whole number'),
        ({'fields__counter__step': 4000}, 'step: found .* expected a whole number'),
        ({'fields__status__0__faults__0__bit': 8}, 'bit: found .* expected a whole number'),
        ({'fields__status__0__faults__1__mask': 256}, 'mask: found .* expected a whole number'),
        (
            {'fields__status__0__faults': [{'bit': 0, 'says': 'no'}] * 63},
            'found 63 faults, at most 62',
        ),
        ({'checksum__covers': [2, 46]}, 'covers: the checksum cannot cover itself'),
        ({'checksum__covers': [45, 2]}, 'covers: found .* expected the offsets'),
        ({'checksum__covers': [2, 60]}, 'covers: found .* expected whole numbers'),
        ({'others__0__checksum__covers': [1, -1]}, 'covers: found .* expected the first byte'),
        ({'others__1__length': 1}, 'length: found 1, expected a whole number'),
    ],
    'calibration': [
        ({'covariance__parameters': ['K_gx']}, 'not the .* parameters'),
        ({'covariance__matrix': [[0.0]]}, r'found (\d+x)*\d+ numbers, expected \d'),
        ({'covariance__matrix__0': [1]}, 'found no numbers'),
        ({'covariance__matrix__0__1': 1}, 'covariance: not that of any errors'),
        ({'covariance__matrix__0__0': -1}, 'covariance: found a negative variance'),
        ({'gyro__error_matrix__0__0': 1.5}, 'times its nominal scale factor'),
        ({'gyro__error_matrix__0__1': 1.0}, 'lies .* off its body axis'),
        ({'gyro__bias__0': 2.0}, 'found .* expected at most'),
        ({'gyro__bias__0': float('nan')}, 'bias: found 3 numbers that are not all finite'),
        ({'gyro__bias__0': 1e300}, r'bias: found 1e\+300, expected amounts up to'),
        ({'gyro__bias__0': 10**400}, 'bias: found 3 numbers that are not all finite'),
    ],
    'certificate': [
        ({'received': '2026-02-30'}, 'received: found .* expected a date'),
        ({'issued': '2020-01-01'}, 'issued: found 2020-01-01, before'),
        ({'calibrated__to': '2020-01-01'}, 'to: found 2020-01-01, before'),
    ],
    'units': [
        ({'units__1__serial_number': 'A1001'}, 'found serial_number unit_A1001 twice'),
        ({'units__1__topic': 'left/imu/pulses'}, 'found topic /left/imu/pulses twice'),
        ({'units__0__port': '/dev/ttyUSB1'}, 'found port /dev/ttyUSB1 twice'),
        ({'units__1__mount': ['x', 'x', 'z']}, r'mount: found .*expected three perpendicular axes'),
        ({'units__1__mount': ['x', 'y', '-z']}, 'mount: the three axes are left-handed'),
        ({'units__1__lever': [float('inf'), 0, 0]}, 'lever: found 3 numbers that are not all fin'),
    ],
    'imperfections': [
        ({'mounting__floor__lowest': '50 Hz'}, 'floor: found lowest .* above highest'),
        ({'samples__lost': '101 %'}, 'found .* expected 100 % or less'),
    ],
}
"""What the suite refuses and no schema can: docs/files/index.md gives this list in words."""

OF_CALIBRATIONS = [
    (0, {'session_terms__coefficients__0__of': 'D_gq'}, 'of: thermal: found .* expected D_g'),
    (0, {'session_terms__coefficients__0__of': 'D_g'}, 'of: thermal: found .* expected one param'),
    (0, {'session_terms__coefficients__0__term': 'trend'}, 'unit: found .* expected'),
    (0, {'uncertainty_budget__parameters': ['K_gx']}, 'not the .* parameters'),
    (
        0,
        {'uncertainty_budget__sources__0__degrees_of_freedom': [1]},
        'expected 12 numbers, none of them negative',
    ),
    (
        0,
        {'uncertainty_budget__sources__0__standard_uncertainty__0': 1.0},
        'sources: their squares do not add up',
    ),
    (
        0,
        {'uncertainty_budget__sources__0__standard_uncertainty__0': float('inf')},
        'expected finite numbers',
    ),
    (0, {'gyro__std__bias__0': -1e-9}, 'gyro: std: bias: not the square roots'),
    (0, {'gyro__std__bias__0': float('nan')}, 'std: bias: found 3 numbers that are not all finite'),
    (0, {'session_terms__coefficients__0__std': 2e-9}, 'coefficients: std: not the square roots'),
    (
        0,
        {'session_terms__cross_covariance__0__0': 1.0},
        'cross_covariance: not those of any errors',
    ),
    (
        0,
        {'provenance__tests_of_terms__gyro_cubic__found_from': [1e-5]},
        'found_from: found .* expected a list of 3 numbers',
    ),
    (
        0,
        {'provenance__tests_of_terms__gyro_cubic__would_move__C_gx__parameter': 'K_gw'},
        'parameter: found .* expected the name of a parameter',
    ),
    (
        0,
        {
            'provenance__tests_of_terms__gyro_cubic__would_move': {
                'C_gw': {'parameter': 'K_gx', 'by': 1}
            }
        },
        'would_move: found .* expected C_gx, C_gy, C_gz',
    ),
    (0, {'provenance__tests_of_terms__trend:D_gw': {'state': 'off'}}, "trend: found 'D_gw'"),
    (0, {'provenance__temperature__lowest': 25.5}, 'temperature: found mean 25, expected one from'),
    (0, {'provenance__height': 1e300}, 'height: found 1e.300, expected amounts up to'),
    (0, {'provenance': {}}, 'provenance: temperature: found'),
    (0, {'provenance__noise__gx__tau': [1.0]}, 'noise: gx: found .* of different lengths'),
    (2, {'calibrations__0__imu': 'another'}, 'found .* expected .* as in'),
    (2, {'calibrations__0__gyro__gyro_asymmetry': None}, 'parameters: found .* as in'),
    (
        2,
        {
            'calibrations__0__provenance__temperature': {
                'mean': 40.2,
                'lowest': 40.0,
                'highest': 41.0,
            }
        },
        'Two calibrations at .* between them',
    ),
    (2, {'order': 4}, 'expected an order from 1 to 1'),
]

CROSSED = [
    *((kind, example(kind), *c) for kind, cases in BEYOND_A_SCHEMA.items() for c in cases),
    *(
        ('calibration', copy.deepcopy(list(calibrations())[number][0]), *c)
        for number, *c in OF_CALIBRATIONS
    ),
]
"""A document, what is changed in it, and what the suite then says."""

# Without `calibrations` a file is read as a single one, without `by_hand` its rates are read.
ELSEWHERE = {('by_hand',): "rate_test: the key 'rates'", ('calibrations',): "the key 'units'"}


@pytest.mark.parametrize(('kind', 'path'), SHIPPED)
def test_every_shipped_file_is_valid_and_read(kind, path):
    document = yaml.safe_load(path.read_text())
    assert [error.message for error in validator(kind).iter_errors(document)] == []
    assert refusal(kind, document) is None


@pytest.mark.parametrize(('kind', 'document', 'where'), DOCUMENTS)
def test_schema_and_suite_refuse_the_same_and_the_suite_names_the_key(kind, document, where):
    assert [error.message for error in validator(kind).iter_errors(document)] == []
    assert refusal(kind, document) is None
    crossed = [words for of, _, _, words in CROSSED if of == kind]
    wrong, schema = [], remembering(kind)
    for case in changed(kind, document, where):
        message = refusal(kind, case.document)
        valid = schema.is_valid(case.document)
        if valid and message:
            right = any(re.search(words, message) for words in crossed)
        elif message:
            key = next(part for part in reversed(case.path) if isinstance(part, str))
            named = rf'my\.yaml: (.*\b{re.escape(key)}\b|{ELSEWHERE.get(case.path, "$.")})'
            right = re.match(named, message)
        else:
            right = valid
        if not right:
            wrong.append((case.path, case.what, 'valid' if valid else 'invalid', message))
    assert wrong == []


@pytest.mark.parametrize(('kind', 'document', 'change', 'words'), CROSSED)
def test_what_no_schema_can_say_is_refused_by_the_suite(kind, document, change, words):
    changed = with_values(copy.deepcopy(document), **change)
    assert validator(kind).is_valid(changed)
    assert re.search(rf'my\.yaml: .*({words})', refusal(kind, changed) or '')


@pytest.mark.parametrize(('kind', 'source'), [*SHIPPED, *((d.values[:2]) for d in DOCUMENTS)])
def test_a_misspelt_key_is_named_and_not_what_follows_from_its_absence(kind, source):
    document = source if isinstance(source, dict) else yaml.safe_load(source.read_text())
    unnamed = []
    for *above, key in places(document):
        # Provenance may have keys of the laboratory.
        if isinstance(key, str) and 'provenance' not in above:
            wrong = f'{key}s' if len(key) < 3 else f'{key[:-1]}_'
            of = at(document, above)
            mine = {wrong if name == key else name: value for name, value in of.items()}
            message = refusal(kind, put(document, above, mine) if above else mine)
            if message is None or wrong not in message:
                unnamed.append((*above, key, message))
    assert unnamed == []


def test_every_unit_is_in_the_pattern_of_its_quantity_and_no_other():
    for dimension in Dimension:
        for sign in ('', 'above 0', '0 or more', 'not 0'):
            known = re.compile(pattern(dimension, sign))
            for unit in UNITS:
                assert bool(known.search(f'1.5e-3 {unit}')) == (unit in dimension.spellings)
            unit = next(iter(dimension.value))
            for number in (
                '-1',
                '0',
                '-0.0',
                '.0',
                '1',
                '00.10',
                '1.',
                '-1e-7',
                '+2',
                '0e9',
                '.',
                '1e',
            ):
                try:
                    value = parse(f'{number} {unit}', dimension, 'key')
                except InputError:
                    value = None
                fits = (
                    value is not None
                    and {
                        '': True,
                        'above 0': value > 0,
                        '0 or more': value >= 0,
                        'not 0': value != 0,
                    }[sign]
                )
                assert bool(known.search(f'{number} {unit}')) == fits


def test_an_exponent_without_a_point_is_a_number_although_yaml_1_1_says_text():
    document = yaml.safe_load('{name: 1e-6, faster: 2e-5, against: a, faster_std: 1E-6}')
    assert document['faster'] == '2e-5'
    calibration = {**example('calibration'), 'clock': document}
    assert READERS['calibration'](Section(calibration, 'my.yaml')).clock.faster == 2e-5
    device = {**example('device'), 'baud': yaml.safe_load('1e6')}
    assert READERS['device'](Section(device, 'my.yaml')).baud == 1_000_000


@pytest.mark.parametrize(('kind', 'document', 'where'), DOCUMENTS)
def test_a_default_is_what_the_suite_takes_where_the_key_is_left_out(kind, document, where):
    stated = {path: part for path, part in described(kind, document) if 'default' in part}
    for (*above, key), part in stated.items():
        given, lacking = copy.deepcopy(document), copy.deepcopy(document)
        at(given, above)[key] = part['default']
        at(lacking, above).pop(key, None)
        # The key may be none of this document's kind: `init` where the checksum is a sum.
        if validator(kind).is_valid(given):
            assert written_out(kind, given) == written_out(kind, lacking), (above, key)


def written_out(kind, document):
    """Return all that the suite reads of a document as text, but which keys it lacked."""
    with np.printoptions(precision=17, threshold=sys.maxsize):
        text = repr(READERS[kind](Section(document, 'my.yaml')))
    text = re.sub(r'assumed=\(.*?\)', '', text)
    # 10 ppm is 1e-05 but for rounding.
    return re.sub(r'[0-9.]+e-[0-9]+', lambda m: f'{float(m[0]):.12g}', text)


MISTAKES = {
    'imu': [{'units': 'volts'}, {'gyro': {}}, {'gyro__range': '-300 deg/s'}],
    'table': [
        {'joints__1__axis': 'q'},
        {'joints__1__max_rate': '0 deg/s'},
        {'level': '0 deg'},
        {'mount': ['x', 'y', '-z']},
    ],
    'plan': [
        {'positions__2__axes': ['U', 'N', 'E']},
        {'positions__1__dwell': '0 s'},
        {'positions__1__id': 'x_up'},
    ],
    'device': [
        {'fields__gyro__type': 'i12'},
        {'checksum__covers': [2, 46]},
        {'fields__temperature__offset': 47},
    ],
    'calibration': [
        {'format': 2},
        {'covariance__parameters': ['K_gx']},
        {'covariance__matrix__0__1': 1},
    ],
    'truth': [{'gyro__bias': [0, 0, 0, 0]}, {'gyro__error_matrix__0__0': 2.0}],
    'imperfections': [
        {'table__zeros': '-3 arcsec'},
        {'samples__lost': '150 %'},
        {'stamps__bunch': 2.5},
    ],
    'certificate': [
        {'received': '2026-02-30'},
        {'issued': '2026-01-29'},
        {'customer__country': 'Germany'},
    ],
    'index': [
        {'gyro__angle_random_walk': '0.05 deg/h'},
        {'sample_rat': '100 Hz'},
    ],
}


@pytest.mark.parametrize('name', MISTAKES)
def test_the_messages_of_a_page_are_those_of_the_suite(name):
    text = (pages.PAGES / f'{name}.md').read_text()
    ((kind, block),) = MESSAGES.findall(text)
    own = [yaml.safe_load(m) for _, m in EXAMPLE.findall(text)]
    document = own[0] if own else example(kind, 1)
    message = [refusal(kind, with_values(copy.deepcopy(document), **m)) for m in MISTAKES[name]]
    stated = [line.split(': ', 1)[1] for line in block.splitlines()]
    assert stated == [words.removeprefix('my.yaml: ') for words in message]


@pytest.mark.parametrize('path', pages.written(), ids=lambda p: p.name)
def test_schemas_and_tables_are_those_of_the_descriptions(path):
    assert path.read_text(encoding='utf-8') == pages.written()[path], 'run python docs/file_formats'


def test_every_key_of_a_schema_is_in_a_table_of_its_page():
    def keys(schema):
        if isinstance(schema, dict):
            yield from schema.get('properties', ())
            for part in schema.values():
                yield from keys(part)
        elif isinstance(schema, list):
            for part in schema:
                yield from keys(part)

    for kind in READERS:
        page = (pages.PAGES / f'{kind}.md').read_text()
        listed = set(re.findall(r'^\| `(\w+)` \|', page, re.MULTILINE))
        # These stand in the line of the key above them.
        inline = {'east', 'north', 'once', 'twice', 'every', 'for', 'ringing', 'floor'}
        assert set(keys(pages.schema(kind))) - listed <= inline & set(re.findall(r'\w+', page))


def test_the_methods_of_plans_are_those_that_there_are():
    assert set(METHOD_NAMES) == set(METHODS)


@pytest.mark.parametrize('kind', READERS)
def test_the_command_prints_a_schema(kind, capsys):
    assert main(['schema', kind]) == 0
    assert json.loads(capsys.readouterr().out) == pages.schema(kind)


@pytest.mark.parametrize('file', sorted((share_folder() / 'config' / 'plans').glob('*.yaml')))
def test_the_text_of_a_plan_is_that_plan(file, tmp_path):
    plan = load_plan(file)
    (tmp_path / 'again.yaml').write_text(plan.text(plan.name))
    again = load_plan(tmp_path / 'again.yaml')
    head = ('name', 'title', 'source', 'method', 'by_hand')
    assert [getattr(again, key) for key in head] == [getattr(plan, key) for key in head]
    for one, other in zip(again.positions, plan.positions, strict=True):
        assert (one.id, one.dwell) == (other.id, other.dwell)
        np.testing.assert_allclose(one.attitude, other.attitude, atol=1e-9)
        assert (one.rate_test is None) == (other.rate_test is None)
        if one.rate_test is not None and other.rate_test is not None:
            assert one.rate_test.turns == other.rate_test.turns
            assert one.rate_test.rates == pytest.approx(other.rate_test.rates)


LOADERS = {
    'an IMU': (load_imu, 'imus/si'),
    'a table': (load_table, 'tables/two_axis'),
    'a plan': (load_plan, 'plans/six_position'),
    'a device': (load_format, 'devices/stim300'),
}


@pytest.mark.parametrize('expected', LOADERS)
def test_a_file_of_another_kind_is_named_with_both_kinds(expected):
    load, _ = LOADERS[expected]
    for kind, (_, name) in LOADERS.items():
        if kind != expected:
            words = f'looks like the file of {kind}, expected the file of {expected}'
            with pytest.raises(InputError, match=words):
                load(CHECKOUT / 'config' / f'{name}.yaml')


@pytest.mark.parametrize(
    ('key', 'value', 'words'),
    [
        (
            'limits',
            ['-90 deg', '90 deg'],
            'expected continuous or {lower: -90 deg, upper: 90 deg}.',
        ),
        ('mount', 'x', 'expected keys with values (yaw, pitch, roll).'),
        ('joints', 'x', 'expected a list of keys with values (name, axis, max_rate, '),
    ],
)
def test_a_value_of_another_shape_is_refused_with_that_shape(key, value, words):
    table = yaml.safe_load((CHECKOUT / 'config' / 'tables' / 'two_axis.yaml').read_text())
    place = table if key in table else table['joints'][0]
    place[key] = value
    with pytest.raises(InputError, match=re.escape(words)):
        read_table(Section(table, 'my.yaml'))
