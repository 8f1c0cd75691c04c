"""JSON Schemas and pages as they should be, by the descriptions of the files."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from imu_calib.common.units import Dimension

from . import calibration, certificate, device, imperfections, imu, output, plan, table
from . import units as several_units
from .keys import Schema, dimension_words, document
from .keys import table as table_of

CHECKOUT = Path(__file__).parents[2]
SCHEMAS = CHECKOUT / 'config' / 'schemas'
PAGES = CHECKOUT / 'docs' / 'files'

FORMATS = {
    'imu': imu,
    'table': table,
    'plan': plan,
    'device': device,
    'calibration': calibration,
    'imperfections': imperfections,
    'output': output,
    'certificate': certificate,
    'units': several_units,
}

_WIDTH = 110
_MARKED = re.compile(r'(<!-- keys: (.+?) -->\n).*?(<!-- end -->)', re.DOTALL)


def schema(kind: str) -> Schema:
    """Return the JSON Schema of a format."""
    return document(kind, FORMATS[kind].TITLE, FORMATS[kind].VALUE)


def dump(value: Any, indent: str = '') -> str:
    """Return JSON, on one line what fits."""
    line = json.dumps(value, ensure_ascii=False)
    if len(indent + line) <= _WIDTH or not isinstance(value, (dict, list)):
        return line
    deeper = indent + '  '
    if isinstance(value, list):
        rows, ends = [dump(v, deeper) for v in value], '[]'
    else:
        rows, ends = [f'{json.dumps(k)}: {dump(v, deeper)}' for k, v in value.items()], '{}'
    inside = f',\n{deeper}'.join(rows)
    return f'{ends[0]}\n{deeper}{inside}\n{indent}{ends[1]}'


def units() -> str:
    """Return the table of dimensions and the units that each may be written in."""
    rows = ['| quantity | units |', '|---|---|']
    for dimension in Dimension:
        names = ', '.join(f'`{unit}`' for unit in dimension.spellings)
        rows.append(f'| {dimension_words(dimension)} | {names} |')
    return '\n'.join(rows)


def _filled(page: Path) -> str:
    """Return a page with the tables between its marks as they should be."""

    def table_for(match: re.Match[str]) -> str:
        if match[2] == 'dimensions':
            keys = units()
        else:
            kind, _, name = match[2].partition(': ')
            keys = table_of(FORMATS[kind].TABLES[name or kind])
        return f'{match[1]}\n{keys}\n\n{match[3]}'

    return _MARKED.sub(table_for, page.read_text(encoding='utf-8'))


def written() -> dict[Path, str]:
    """Return every file that is made of the descriptions, with its text."""
    schemas = {SCHEMAS / f'{kind}.json': dump(schema(kind)) + '\n' for kind in FORMATS}
    return schemas | {page: _filled(page) for page in sorted(PAGES.glob('*.md'))}
