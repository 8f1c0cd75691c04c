"""Files that people write: JSON Schemas and the suite refuse the same, and the pages say so."""

import copy
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

import pytest
import yaml
from jsonschema import Draft202012Validator
from loopback import CHECKOUT

from imu_calib.compensation.thermal import read_calibration
from imu_calib.config import Section
from imu_calib.devices import read_format
from imu_calib.errors import InputError
from imu_calib.imu import read_imu
from imu_calib.plan import read_plan
from imu_calib.simulation import StandOptions
from imu_calib.simulation.imperfections import read_imperfections
from imu_calib.turntable import load_table, read_table
from imu_calib.units import Dimension, parse

sys.path.insert(0, str(CHECKOUT / 'docs'))

from file_formats import pages
from file_formats.keys import pattern

READERS = {
    'imu': read_imu,
    'table': read_table,
    'plan': read_plan,
    'device': read_format,
    'calibration': read_calibration,
    'imperfections': lambda s: read_imperfections(s, StandOptions(), load_table('three_axis'), 1),
}
FOLDERS = {
    'imus': 'imu',
    'tables': 'table',
    'plans': 'plan',
    'devices': 'device',
    'truths': 'calibration',
    'imperfections': 'imperfections',
}
SHIPPED = [
    pytest.param(kind, path, id=f'{folder}/{path.stem}')
    for folder, kind in FOLDERS.items()
    for path in sorted((CHECKOUT / 'config' / folder).glob('*.yaml'))
]
PAGES = sorted(pages.PAGES.glob('*.md'))
BLOCK = re.compile(r'<!-- example: (\w+) -->\n```yaml\n(.*?)```', re.DOTALL)


@cache
def validator(kind):
    return Draft202012Validator(pages.schema(kind))


def refusal(kind, document):
    """Return what the suite says of a document; None where it reads it."""
    try:
        READERS[kind](Section(copy.deepcopy(document), 'my.yaml'))
    except InputError as error:
        return str(error)
    return None


def examples():
    return [
        (kind, yaml.safe_load(text))
        for page in PAGES
        for kind, text in BLOCK.findall(page.read_text())
    ]


@dataclass
class Case:
    kind: str
    path: tuple
    what: str
    document: Any


def places(node, path=()) -> Iterator[tuple]:
    """Yield the path of every value below a document."""
    children = node.items() if isinstance(node, dict) else enumerate(node)
    for key, child in children:
        yield (*path, key)
        if isinstance(child, (dict, list)):
            yield from places(child, (*path, key))


def at(document, path):
    for key in path:
        document = document[key]
    return document


OTHER_TYPES = {
    'nothing': None, 'a mapping': {}, 'a list': [], 'a list of a list': [[]], 'a text': 'nonsense',
    'an empty text': '', 'a number': 0.25, 'true': True, 'zero': 0, 'minus one': -1, 'one': 1,
    'many': 10**6, 'a list of a number': [1], 'a text in capitals': 'NONE',
}
QUANTITY = re.compile(r'^\s*([-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?)\s*(\S.*)$')
KNOWN_UNITS = {unit for dimension in Dimension for unit in dimension.value}


def values(value):
    """Yield other values in place of one."""
    yield from OTHER_TYPES.items()
    match = QUANTITY.match(value) if isinstance(value, str) else None
    if match and match[2] in KNOWN_UNITS:
        unit = match[2]
        for text in (
            f'-1e-7 {unit}', f'0 {unit}', f'-0.0 {unit}', f'0e5{unit}', f'+.5e-7{unit}', f'1e-7  {unit} ',
            f'{unit}', '1', '1 parsec', f'1,5 {unit}', f'1 {unit} {unit}', f'--1 {unit}', f'1e {unit}',
            f'٣ {unit}',
        ):
            yield f'the quantity {text!r}', text
        for dimension in Dimension:
            for other in dimension.value:
                yield f'the quantity in {other}', f'1e-7 {other}'
    if isinstance(value, list):
        yield 'the last left out', value[:-1]
        yield 'the first twice', [*value, copy.deepcopy(value[0])]
        yield 'the other way round', value[::-1]


def changed(kind, document):
    """Yield documents that differ in one place."""
    for path in places(document):
        *above, key = path
        lacking = copy.deepcopy(document)
        del at(lacking, above)[key]
        yield Case(kind, path, 'left out', lacking)
        for what, value in values(at(document, path)):
            other = copy.deepcopy(document)
            at(other, above)[key] = copy.deepcopy(value)
            yield Case(kind, path, what, other)
    for path in ((), *places(document)):
        if isinstance(at(document, path), dict):
            for name in ('nonsense', 'nam'):
                further = copy.deepcopy(document)
                at(further, path)[name] = 1
                yield Case(kind, (*path, name), 'unknown', further)


if __name__ == '__main__':
    import collections, traceback
    n = 0
    for kind, document in examples():
        if len(sys.argv) > 1 and kind not in sys.argv[1:]: continue
        if (r := refusal(kind, document)) or not validator(kind).is_valid(document):
            print('EXAMPLE', kind, r, [ (list(e.absolute_path), e.message[:150]) for e in validator(kind).iter_errors(document)]); continue
        for case in changed(kind, document):
            n += 1
            try:
                said = refusal(kind, case.document)
            except Exception as e:
                print('CRASH', kind, case.path, case.what, repr(e)[:100]); continue
            ok = validator(kind).is_valid(case.document)
            if ok != (said is None):
                print('schema', 'ACCEPTS' if ok else 'refuses', kind, case.path, '|', case.what, '|', said)
    print(n)
