"""Read YAML mappings once and check them whole: file, key, found, expected."""

from __future__ import annotations

import math
import re
from collections.abc import Hashable, Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import yaml
from yaml.reader import ReaderError

from .errors import InputError
from .files import named_file, other_format, read_bytes
from .stream import Floats
from .units import LARGEST, Dimension, parse, point_for_comma

try:
    from yaml import CSafeDumper as SafeDumper
    from yaml import CSafeLoader as SafeLoader
except ImportError:  # PyYAML without libyaml reads and writes the same texts, more slowly.
    from yaml import SafeDumper, SafeLoader  # type: ignore[assignment]

__all__ = ['SafeDumper']  #: Handed on to those that dump in a form of their own.


_INT = 'tag:yaml.org,2002:int'
_DATE = 'tag:yaml.org,2002:timestamp'
_MOST_BITS = 10_000
"""Of a whole number, some 3000 digits; Python converts no more than 4300 to text."""
_MOST_VALUES = 10_000_000  #: Values of a document; a calibration of 40 parameters has 4000.
_SHOWN = 40  #: Characters of a value that are shown.
_WHOLE_NUMBER = re.compile(r'[-+]?(?:0|[1-9][0-9_]*|0b[01_]+|0x[0-9a-fA-F_]+)$')


class _Loader(SafeLoader):
    """Refuses a key that stands twice in a mapping; reads 0012, 12:30 and 2026-02-30 as texts.

    Of two values the first would silently count for nothing. By YAML 1.1 these numbers are octal
    and sexagesimal, 10 and 750: a serial number would silently become another. Dates are checked
    by those who ask for one, with the key: PyYAML raises ValueError for a day that does not exist.
    """

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        try:
            found = super().construct_object(node, deep)
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError):
            # What PyYAML raises for `!!int x`, `0x_`, `!!timestamp x`, `!!bool x`, 5000 digits.
            raise yaml.constructor.ConstructorError(
                problem=f'found {str(node.value)[:_SHOWN]!r}, which is no value of its kind',
                problem_mark=node.start_mark,
            ) from None
        if isinstance(found, int) and found.bit_length() > _MOST_BITS:
            raise yaml.constructor.ConstructorError(
                problem='found a whole number of thousands of digits', problem_mark=node.start_mark
            )
        return found

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        keys = set()
        for key in (key for key, _ in node.value if isinstance(key, yaml.ScalarNode)):
            if key.value in keys:
                raise yaml.constructor.ConstructorError(
                    problem=f'found the key {key.value} more than once', problem_mark=key.start_mark
                )
            keys.add(key.value)
        return super().construct_mapping(node, deep)


_Loader.yaml_implicit_resolvers = {
    first: [
        (tag, _WHOLE_NUMBER if tag == _INT else form) for tag, form in resolvers if tag != _DATE
    ]
    for first, resolvers in SafeLoader.yaml_implicit_resolvers.items()
}


def load(text: str) -> Any:
    """Return the value of a text with one document.

    Raises:
        yaml.YAMLError: Not YAML, or more than plain values.
    """
    loader = _Loader(text)
    try:
        node = loader.get_single_node()
        if node is None:
            return None
        if _values(node, {}) > _MOST_VALUES:
            raise yaml.YAMLError(f'found more than {_MOST_VALUES} values by its aliases')
        return loader.construct_document(node)
    except RecursionError:
        raise yaml.YAMLError('found lists or mappings within each other without end') from None
    finally:
        loader.dispose()


def told(error: yaml.YAMLError, text: str) -> str:
    """Return what is wrong with a text, which line it is, and what was expected there."""
    if not isinstance(error, yaml.MarkedYAMLError) or error.problem_mark is None:
        return ' '.join(str(error).split())
    if isinstance(error, yaml.constructor.ConstructorError):
        return f'{error.problem} in line {error.problem_mark.line + 1}'
    said, met = f'{error.context} {error.problem}', error.problem_mark
    for part, words in _OPENED.items():
        if part in said:
            return _told_of_line((error.context_mark or met).line, text, words)
    words = next((words for part, words in _MET.items() if part in said), _PAIR)
    return _told_of_line(met.line, text, words)


def _told_of_line(number: int, text: str, expected: str) -> str:
    lines = text.splitlines()
    number = min(number, len(lines) - 1)
    return f'line {number + 1} is {lines[number].rstrip()[:_SHOWN]!r}, expected {expected}'


def _values(node: yaml.Node, counts: dict[int, float]) -> float:
    """Return the number of values below a node, its aliases written out; infinite in a circle."""
    if isinstance(node, yaml.ScalarNode):
        return 1
    if id(node) not in counts:
        counts[id(node)] = float('inf')
        of_mapping = isinstance(node, yaml.MappingNode)
        parts = [p for pair in node.value for p in pair] if of_mapping else node.value
        counts[id(node)] = 1 + sum(_values(part, counts) for part in parts)
    return counts[id(node)]


def dump(value: Any, dumper: type[SafeDumper] = SafeDumper, **form: Any) -> str:
    """Return a value as text, keys in their own order; `form` as in `yaml.dump`."""
    return str(yaml.dump(value, Dumper=dumper, sort_keys=False, **form))


T = TypeVar('T')

_EXPONENTIAL = re.compile(r'[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)[eE][-+]?[0-9]+')

_KINDS = {
    'plans': 'the file of a plan',
    'imus': 'the file of an IMU',
    'tables': 'the file of a table',
    'imperfections': 'the file of imperfections',
    'devices': 'the file of a device',
}
"""What the files of a folder below config are."""
_ANY = 'a YAML file'
_PAIR = "'key: value'"
_OPENED = {
    'simple key': _PAIR,
    'flow': 'a bracket that is closed, with commas between the values',
    'quoted scalar': 'a quote that is closed',
}
"""What is expected where PyYAML's error began, by words of it."""
_MET = {
    'mapping values': f'one {_PAIR} in a line, with quotes around a value that has a colon',
    'block': 'the indent of the lines above',
    'start any token': 'blanks to indent a line, no tab, and quotes around a value that begins so',
}
"""The same, where PyYAML met it."""
_SIGNS = {
    'the file of a plan': {'positions[]'},
    'the file of an IMU': {'id', 'units'},
    'the file of a table': {'joints[]'},
    'the file of a device': {'fields', 'length'},
    'the file of several units': {'units[]'},
    'the fields of a certificate': {'laboratory', 'item'},
    'the file of imperfections': {'stamps', 'samples'},
    'a calibration file': {'format', 'imu'},
}
"""Keys by which a file is known for what it is, [] at those with a list: no other kind has them."""


class Section:
    """A mapping of a YAML file whose keys must all be read.

    `where` names the mapping in every message. Call `refuse_unknown_keys` after reading
    all known keys: the others are misspelt.
    """

    def __init__(self, data: object, where: str, *keys: str) -> None:
        if not isinstance(data, dict):
            named = f' ({", ".join(keys)})' if keys else ''
            raise InputError(f'{where}: found {_kind(data)}, expected keys with values{named}.')
        self._data: dict[str, Any] = {str(key): value for key, value in data.items()}
        self._known: list[str] = []
        self.where = where

    @classmethod
    def load(cls, path: Path, expected: str = _ANY) -> Section:
        """Read the mapping at the top of a YAML file.

        If a recording was given in its place, the sentence says what was `expected`.
        """
        try:
            text = read_bytes(path).decode('utf-8')
        except UnicodeDecodeError:
            sentence = (
                f'{path}: found binary data, expected YAML text. Give in its place {expected}.'
            )
            raise InputError(other_format(path, expected) or sentence) from None
        try:
            section = cls.parse(text, str(path), expected)
        except InputError as error:
            raise InputError(other_format(path, expected) or str(error)) from None
        section._refuse_other_kind(expected)
        return section

    @classmethod
    def named(cls, kind: str, name: str | Path) -> Section:
        """Read a file of a kind, as of `named_file`, given by name or path."""
        return cls.load(named_file(kind, name), _KINDS[kind])

    @classmethod
    def parse(cls, text: str, where: str, expected: str = '') -> Section:
        """Read the mapping at the top of a YAML text, of a file as of `load` if that is stated."""
        instead = f' Give in its place {expected}.' if expected else ''
        advice = f' Mend that line, or give {expected}.' if expected else ''
        if text.lstrip().startswith('<'):
            page = 'line 1 is of a web page (HTML or XML). Download the file itself.'
            raise InputError(f'{where}: not YAML: {page}{instead}')
        try:
            value = load(text)
        except ReaderError:
            raise InputError(f'{where}: found binary data, expected YAML text.{instead}') from None
        except yaml.YAMLError as error:
            raise InputError(f'{where}: not YAML: {told(error, text)}.{advice}') from None
        if isinstance(value, str):
            raise InputError(f'{where}: not YAML: {_told_of_line(0, text, _PAIR)}.{instead}')
        return cls(value, where)

    def _refuse_other_kind(self, expected: str) -> None:
        """Refuse a file with the keys of another kind, and without those of what is `expected`."""
        keys = {f'{k}[]' if isinstance(v, list) else k for k, v in self._data.items()}
        kinds = [kind for kind, signs in _SIGNS.items() if signs <= keys]
        if kinds and not expected.startswith((_ANY, *kinds)):
            raise InputError(f'{self.where} looks like {kinds[0]}, expected {expected}.')

    def key(self, name: str) -> str:
        """Return the full name of a key, for a message."""
        return f'{self.where}: {name}'

    def has(self, name: str) -> bool:
        """Return whether the key is present."""
        self._known.append(name)
        return self._data.get(name) is not None

    def names(self) -> tuple[str, ...]:
        """Return the names of all keys, for mappings whose keys are names chosen by the user."""
        return tuple(self._data)

    def raw(self, name: str) -> Any:
        """Return the value as given by YAML."""
        self._known.append(name)
        if self._data.get(name) is None:
            raise InputError(f'{self.where}: the key {name!r} is missing{self.instead(name)}')
        return self._data[name]

    def alike(self, name: str) -> str:
        """Return a key that may be a misspelling of a missing one; empty without one."""
        others = [key for key in self._data if key not in self._known]
        return next(iter(get_close_matches(name, others, n=1)), '')

    def instead(self, name: str) -> str:
        """Return the end of a sentence on a missing key: a similar key, if there is one."""
        alike = self.alike(name)
        return f'; is {alike!r} a misspelling of it?' if alike else '.'

    def text(self, name: str, default: str | None = None) -> str:
        """Return a string (numbers count as their text)."""
        if default is not None and not self.has(name):
            return default
        value = self.raw(name)
        if isinstance(value, (bool, dict, list)):
            # YAML reads yes, no, on and off as true and false.
            quoted = ' in quotes' if isinstance(value, bool) else ''
            raise InputError(f'{self.key(name)}: found {_kind(value)}, expected a text{quoted}.')
        return str(value)

    def choice(self, name: str, choices: Mapping[str, T], default: str | None = None) -> T:
        """Return the meaning of one of some words."""
        word = self.text(name, default)
        if word not in choices:
            raise InputError(
                f'{self.key(name)}: found {word!r}, expected one of {", ".join(choices)}.'
            )
        return choices[word]

    def number(self, name: str, default: float | None = None) -> float:
        """Return a finite number without a unit."""
        if default is not None and not self.has(name):
            return default
        value = as_number(self.raw(name))
        if value is None or not math.isfinite(value):
            point = point_for_comma(self.raw(name))
            raise InputError(
                f'{self.key(name)}: found {self.raw(name)!r}, expected a number.{point}'
            )
        self._check_size(name, abs(value))
        return value

    def _check_size(self, name: str, amount: float) -> None:
        if amount > LARGEST:
            raise InputError(
                f'{self.key(name)}: found {amount:g}, expected amounts up to {LARGEST:g}.'
            )

    def whole(
        self, name: str, least: int, most: int | None = None, default: int | None = None
    ) -> int:
        """Return an integer from `least` to `most`, which may be open."""
        if default is not None and not self.has(name):
            return default
        value = as_whole(self.raw(name), least, most)
        if value is None:
            bounds = f', {least} or more' if most is None else f' from {least} to {most}'
            raise InputError(
                f'{self.key(name)}: found {self.raw(name)!r}, expected a whole number{bounds}.'
            )
        return value

    def array(self, name: str, shape: tuple[int, ...]) -> Floats:
        """Return finite numbers in rows, as an array of a shape."""
        values = numbers_of(self.raw(name))
        if values is None:
            raise InputError(f'{self.key(name)}: found no numbers.')
        found, expected = ('x'.join(map(str, s)) or '1' for s in (values.shape, shape))
        if values.shape != shape:
            raise InputError(f'{self.key(name)}: found {found} numbers, expected {expected}.')
        if not np.isfinite(values).all():
            raise InputError(f'{self.key(name)}: found {found} numbers that are not all finite.')
        self._check_size(name, np.abs(values).max(initial=0.0))
        return values

    def texts(self, name: str) -> tuple[str, ...]:
        """Return a list of strings, empty if absent."""
        if not self.has(name) or self.raw(name) == []:
            return ()
        items = {str(i): item for i, item in enumerate(self.items(name))}
        return tuple(Section(items, self.key(name)).text(key) for key in items)

    def flag(self, name: str, *, default: bool | None = None) -> bool:
        """Return true or false."""
        if default is not None and not self.has(name):
            return default
        value = self.raw(name)
        if not isinstance(value, bool):
            raise InputError(f'{self.key(name)}: found {value!r}, expected true or false.')
        return value

    def quantity(
        self,
        name: str,
        dimension: Dimension,
        default: float | None = None,
        *,
        least: float = -math.inf,
        above: float = -math.inf,
    ) -> float:
        """Return a number with a unit, in SI: not below `least`, more than `above`."""
        if default is not None and not self.has(name):
            return default
        value = parse(self.raw(name), dimension, self.key(name))
        self._check_size(name, abs(value))
        if value < least or not value > above:
            bound = f'{least:g} or more' if value < least else f'above {above:g}'
            raise InputError(f'{self.key(name)}: found {self.raw(name)}, expected {bound}.')
        return value

    def items(self, name: str, of: str = 'values: [..., ...]') -> list[Any]:
        """Return a list that is not empty."""
        value = self.raw(name)
        if not isinstance(value, list) or not value:
            found = 'an empty list' if value == [] else _kind(value)
            raise InputError(f'{self.key(name)}: found {found}, expected a list of {of}.')
        return value

    def section(self, name: str, *keys: str) -> Section:
        """Return a mapping below this one, of which some keys are named where it is none."""
        return Section(self.raw(name), self.key(name), *keys)

    def skip(self, *names: str) -> None:
        """Accept mappings that are for people, without reading them."""
        for name in names:
            if self.has(name):
                self.section(name)

    def sections(self, name: str, *keys: str) -> list[Section]:
        """Return a list of mappings; keys as of `section`."""
        of = f'keys with values ({", ".join(keys)})' if keys else 'keys with values'
        items = self.items(name, of)
        return [Section(v, f'{self.key(name)}[{i}]', *keys) for i, v in enumerate(items)]

    def either(self, first: str, second: str) -> str:
        """Return which of two keys is present, after all others were read: refuses unknown ones."""
        present = [name for name in (first, second) if self.has(name)]
        self.refuse_unknown_keys()
        if len(present) != 1:
            found = 'both' if present else 'neither'
            raise InputError(
                f'{self.where}: found {found} of {first!r} and {second!r}, expected one of them.'
            )
        return present[0]

    def refuse_unknown_keys(self) -> None:
        """Refuse unknown keys."""
        unknown = sorted(set(self._data) - set(self._known))
        if unknown:
            known = sorted(set(self._known))
            alike = get_close_matches(unknown[0], [k for k in known if k not in self._data], n=1)
            meant = f' Is {alike[0]!r} meant?' if alike else ''
            raise InputError(
                f'{self.where}: unknown key {unknown[0]!r}; known are {", ".join(known)}.{meant}'
            )


def as_number(value: object) -> float | None:
    """Return a number, None for anything else.

    YAML 1.1, which PyYAML reads, takes 1e-5 for a text: its exponents need a decimal point before
    them and a sign.
    """
    if isinstance(value, str) and _EXPONENTIAL.fullmatch(value):
        return float(value)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    try:
        return float(value)
    except OverflowError:
        return math.inf


def as_whole(value: object, least: int, most: int | None) -> int | None:
    """Return an integer from `least` to `most`, None for anything else; 2.0 and 2e0 are valid."""
    if isinstance(value, bool) or not isinstance(value, int):
        number = as_number(value)
        if number is None or not number.is_integer():
            return None
        value = int(number)
    return value if least <= value and (most is None or value <= most) else None


def numbers_of(value: object) -> Floats | None:
    """Return lists of numbers as an array; None if they are ragged or not numbers."""
    if not isinstance(value, list):
        number = as_number(value)
        return None if number is None else np.array(number)
    rows = [numbers_of(row) for row in value]
    known = [row for row in rows if row is not None]
    if len(known) < len(rows) or len({row.shape for row in known}) > 1:
        return None
    return np.array(known)


def _kind(value: object) -> str:
    names = {dict: 'a mapping', list: 'a list', str: 'a text', type(None): 'nothing'}
    return names.get(type(value), repr(value))
