"""Read YAML mappings once and check them whole: file, key, found, expected."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import yaml
from yaml.reader import ReaderError

from .errors import InputError
from .files import read_bytes
from .other_formats import other_format
from .share import named_file
from .stream import Floats
from .units import LARGEST, Dimension, parse, point_for_comma
from .yaml_text import load

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


class Section:
    """A mapping of a YAML file whose keys must all be read.

    `where` names the mapping in every message. Call `finish` after reading all known keys: the
    others are misspelt.
    """

    def __init__(self, data: object, where: str) -> None:
        if not isinstance(data, dict):
            raise InputError(f'{where}: found {_kind(data)}, expected keys with values.')
        self._data: dict[str, Any] = {str(key): value for key, value in data.items()}
        self._known: list[str] = []
        self.where = where

    @classmethod
    def load(cls, path: Path, expected: str = 'a YAML file') -> Section:
        """Read the mapping at the top of a YAML file.

        Args:
            path: The file.
            expected: What it is to be, for the sentence on a recording in its place.

        Raises:
            InputError: Unreadable, not YAML, or not a mapping.
        """
        try:
            text = read_bytes(path).decode('utf-8')
        except UnicodeDecodeError:
            sentence = f'{path}: found binary data, expected YAML text.'
            raise InputError(other_format(path, expected) or sentence) from None
        try:
            return cls.parse(text, str(path))
        except InputError as error:
            raise InputError(other_format(path, expected) or str(error)) from None

    @classmethod
    def named(cls, kind: str, name: str | Path) -> Section:
        """Read a file given by name or path.

        Args:
            kind: Folder below config, as of `named_file`.
            name: A supplied name, or the path of a file.

        Raises:
            InputError: There is none, or as of `load`.
        """
        return cls.load(named_file(kind, name), _KINDS[kind])

    @classmethod
    def parse(cls, text: str, where: str) -> Section:
        """Read the mapping at the top of a YAML text."""
        try:
            return cls(load(text), where)
        except ReaderError:
            raise InputError(f'{where}: found binary data, expected YAML text.') from None
        except yaml.YAMLError as error:
            raise InputError(f'{where}: not YAML: {" ".join(str(error).split())}') from None

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
            raise InputError(f'{self.where}: the key {name!r} is missing{self._instead(name)}')
        return self._data[name]

    def _instead(self, name: str) -> str:
        """Return the end of a sentence on a missing key: a similar key, if there is one."""
        others = [key for key in self._data if key not in self._known]
        alike = get_close_matches(name, others, n=1)
        return f'; is {alike[0]!r} a misspelling of it?' if alike else '.'

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

    def flag(self, name: str, *, default: bool) -> bool:
        """Return true or false."""
        if not self.has(name):
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

    def items(self, name: str) -> list[Any]:
        """Return a list."""
        value = self.raw(name)
        if not isinstance(value, list) or not value:
            raise InputError(f'{self.key(name)}: found {_kind(value)}, expected a list.')
        return value

    def section(self, name: str) -> Section:
        """Return a mapping below this one."""
        return Section(self.raw(name), self.key(name))

    def skip(self, *names: str) -> None:
        """Accept mappings that are for people, without reading them."""
        for name in names:
            if self.has(name):
                self.section(name)

    def sections(self, name: str) -> list[Section]:
        """Return a list of mappings."""
        return [Section(v, f'{self.key(name)}[{i}]') for i, v in enumerate(self.items(name))]

    def finish(self) -> None:
        """Refuse unknown keys.

        Raises:
            InputError: Names the unknown and the known keys.
        """
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
