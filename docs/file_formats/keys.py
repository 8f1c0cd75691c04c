"""Keys of the files, described once: JSON Schemas and the tables of docs/files are made of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

from imu_calib.common.config import Section
from imu_calib.common.keys import REQUIRED, FieldKey, field_keys, parts, record, records
from imu_calib.common.units import Dimension

Schema = dict[str, Any]

_UNSIGNED = r'(?:[0-9]+\.?[0-9]*|\.[0-9]+)'
_EXPONENT = r'(?:[eE][-+]?[0-9]+)?'
_ZERO = r'(?:0+\.?0*|\.0+)'
_SIGNS = {
    '': rf'[-+]?{_UNSIGNED}',
    'above 0': rf'\+?(?=[0.]*[1-9]){_UNSIGNED}',
    '0 or more': rf'(?:\+?{_UNSIGNED}|-{_ZERO})',
    'not 0': rf'[-+]?(?=[0.]*[1-9]){_UNSIGNED}',
}
_ESCAPED = str.maketrans({c: f'\\{c}' for c in '().^/$*+?|[]{}'})


@dataclass(frozen=True)
class Value:
    """What may stand behind a key.

    Attributes:
        schema: As JSON Schema has it.
        words: As a table has it.
    """

    schema: Schema
    words: str


@dataclass(frozen=True)
class Key:
    """A key of a mapping.

    Attributes:
        name: As it is written.
        value: What may stand behind it.
        meaning: For a person.
        default: Taken where the key is left out or empty; `REQUIRED` where it must not be, None
            where nothing takes its place.
        otherwise: Words in place of the default.
    """

    name: str
    value: Value
    meaning: str
    default: object = None
    otherwise: str = ''


def dimension_words(dimension: Dimension) -> str:
    """Return a dimension's name as the page of units has it."""
    return dimension.name.lower().replace('_', ' ')


def pattern(dimension: Dimension, sign: str = '') -> str:
    """Return the regular expression of a number with a unit, as ECMA 262 and Python read it."""
    units = [unit.translate(_ESCAPED) for unit in dimension.spellings if not unit[0].isdigit()]
    # What begins with a digit would be part of the number.
    spaced = [unit.translate(_ESCAPED) for unit in dimension.spellings if unit[0].isdigit()]
    ways = [rf'\s*(?:{"|".join(units)})'] * bool(units) + [rf'\s+(?:{"|".join(spaced)})'] * bool(
        spaced
    )
    return rf'^\s*{_SIGNS[sign]}{_EXPONENT}(?:{"|".join(ways)})\s*$'


def quantity(dimension: Dimension, sign: str = '') -> Value:
    """Return a number with a unit; `sign` is '', 'above 0', '0 or more' or 'not 0'."""
    words = f'[{dimension_words(dimension)}](index.md#units)'
    return Value(
        {'type': 'string', 'pattern': pattern(dimension, sign)},
        f'{words}, {sign}' if sign else words,
    )


def limited(value: Value, most: str) -> Value:
    """Return a value with words on an upper limit, which no schema can state."""
    return Value(value.schema, f'{value.words}, at most {most}')


def text() -> Value:
    """Return a text; numbers count as theirs."""
    return Value({'type': ['string', 'number']}, 'text')


def choice(values: Sequence[str]) -> Value:
    """Return one of some texts."""
    return Value({'enum': list(values)}, ', '.join(f'`{v}`' for v in values))


def flag() -> Value:
    """Return true or false."""
    return Value({'type': 'boolean'}, '`true` or `false`')


def number(least: float | None = None, above: float | None = None) -> Value:
    """Return a number without a unit."""
    schema: Schema = {'type': 'number'}
    words = 'number'
    if least is not None:
        schema['minimum'], words = least, f'number, {least:g} or more'
    if above is not None:
        schema['exclusiveMinimum'], words = above, f'number above {above:g}'
    return Value(schema, words)


def whole(least: int, most: int | None = None, words: str = '') -> Value:
    """Return a whole number within bounds; `words` take the place of those for the upper one."""
    schema: Schema = {'type': 'integer', 'minimum': least}
    if most is not None:
        schema['maximum'] = most
        upper = f', {least} to {most}' if most < 2**32 else f', from {least}'
        words = words or f'whole number{upper}'
    return Value(schema, words or f'whole number, {least} or more')


def array(item: Value, least: int = 1, most: int | None = None, words: str = '') -> Value:
    """Return a list of values of one kind."""
    schema: Schema = {'type': 'array', 'items': item.schema, 'minItems': least}
    if most is not None:
        schema['maxItems'] = most
    return Value(schema, words or f'list: {item.words}')


def either(*values: Value, words: str = '') -> Value:
    """Return one of several kinds of values."""
    return Value(
        {'anyOf': [v.schema for v in values]}, words or ', or '.join(v.words for v in values)
    )


def mapping(keys: Sequence[Key], *conditions: Schema, words: str = 'keys') -> Value:
    """Return a mapping of keys; conditions are further schemas that it must fulfil."""
    schema: Schema = {
        'type': 'object',
        'properties': {key.name: property_of(key) for key in keys},
        'additionalProperties': False,
    }
    if needed := [key.name for key in keys if key.default is REQUIRED]:
        schema['required'] = needed
    if conditions:
        schema['allOf'] = list(conditions)
    return Value(schema, words)


def property_of(key: Key) -> Schema:
    """Return the schema of what stands behind a key: nothing counts as no key, unless required."""
    schema = dict(key.value.schema)
    if key.default is not REQUIRED:
        schema = or_nothing(schema)
        if key.default is not None:
            schema['default'] = key.default
    said = f' ({plain(key.value.words)})' if 'pattern' in key.value.schema else ''
    return {'description': plain(key.meaning) + said, **schema}


def or_nothing(schema: Schema) -> Schema:
    """Return a schema that takes null as well."""
    if 'enum' in schema:
        return {**schema, 'enum': [*schema['enum'], None]}
    if 'type' in schema:
        types = schema['type'] if isinstance(schema['type'], list) else [schema['type']]
        return {**schema, 'type': [*types, 'null']}
    if 'anyOf' in schema:
        return {**schema, 'anyOf': [*schema['anyOf'], {'type': 'null'}]}
    return schema


def given(*names: str) -> Schema:
    """Return the condition that keys are there, and not empty."""
    return {
        'required': list(names),
        'properties': {name: {'not': {'type': 'null'}} for name in names},
    }


def absent(*names: str) -> Schema:
    """Return the condition that keys are not there, not even empty."""
    return {'properties': dict.fromkeys(names, False)}


def has(name: str, *values: object) -> Schema:
    """Return the condition that a key has one of some values."""
    return {'required': [name], 'properties': {name: {'enum': list(values)}}}


def one_of(*names: str) -> Schema:
    """Return the condition that exactly one of some keys is there, where there is a mapping."""
    return when({'type': 'object'}, {'oneOf': [given(name) for name in names]})


def when(condition: Schema, then: Schema, otherwise: Schema | None = None) -> Schema:
    """Return the schema of what must hold under a condition."""
    schema = {'if': condition, 'then': then}
    return schema if otherwise is None else {**schema, 'else': otherwise}


def document(kind: str, title: str, value: Value) -> Schema:
    """Return a whole JSON Schema (draft 2020-12)."""
    return {
        '$schema': 'https://json-schema.org/draft/2020-12/schema',
        '$id': f'urn:imu_calib:{kind}',
        'title': title,
        **value.schema,
    }


def keys_of(kind: type, variant: object = 'key') -> list[Key]:
    """Return the keys that the fields of a record declare, as `field_keys` has them."""
    keys = []
    for each in fields(kind):
        if each.name in parts(kind):
            keys += keys_of(parts(kind)[each.name], variant)
        if declared := field_keys(kind, variant).get(each.name):
            keys.append(key_of(declared))
    return keys


def key_of(declared: FieldKey) -> Key:
    """Return the key that a field declares."""
    name, value = declared.name, VALUES[declared.read](*declared.arguments, **declared.bounds)
    if declared.read is records:
        most = declared.bounds.get('most')
        number = '' if most is None else f'1 to {most} '
        value = Value(value.schema, f'list of {number}{name}, below')
    clause = f' ({declared.source})' if declared.source else ''
    return Key(name, value, declared.meaning + clause, declared.default, declared.otherwise)


CONDITIONS: dict[type, list[Schema]] = {}
"""What the keys of a record must fulfil together; the descriptions of files fill it."""


def mapping_of(kind: type, variant: object = 'key', words: str = 'keys, below') -> Value:
    """Return the mapping of a record, with the conditions on its keys."""
    return mapping(keys_of(kind, variant), *CONDITIONS.get(kind, ()), words=words)


def _sign(above: float | None = None, least: float | None = None) -> str:
    return 'above 0' if above is not None else '' if least is None else '0 or more'


VALUES: dict[Callable[..., Any], Callable[..., Value]] = {
    Section.text: text,
    Section.texts: lambda: array(text(), 0),
    Section.flag: flag,
    Section.number: number,
    Section.choice: lambda choices: choice(list(choices)),
    Section.whole: whole,
    Section.quantity: lambda dimension, **bounds: quantity(dimension, _sign(**bounds)),
    record: mapping_of,
    records: lambda kind, most=None: array(mapping_of(kind), 1, most),
}
"""What may stand behind a key, by its reader; the descriptions of files add those of their own."""


def table(keys: Sequence[Key]) -> str:
    """Return keys as a table in Markdown."""
    rows = ['| key | value | default | meaning |', '|---|---|---|---|']
    for key in keys:
        if key.default is REQUIRED:
            default = key.otherwise or 'must be given'
        elif key.default is None:
            default = key.otherwise or 'none'
        else:
            default = f'`{_shown(key.default)}`' if key.default != '' else 'empty'
        rows.append(f'| `{key.name}` | {key.value.words} | {default} | {key.meaning} |')
    return '\n'.join(rows)


def _shown(default: object) -> str:
    return str(default).lower() if isinstance(default, bool) else str(default)


def plain(words: str) -> str:
    """Return words of a table without their links and marks."""
    out, rest = '', words
    while '](' in rest:
        before, _, after = rest.partition('](')
        head, _, label = before.rpartition('[')
        out += head + label
        rest = after.partition(')')[2]
    return (out + rest).replace('`', '').replace(r'\|', '|')


Tables = Mapping[str, Sequence[Key]]
