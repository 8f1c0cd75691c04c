"""YAML mappings that are read once and checked whole: file, key, found, expected."""

from __future__ import annotations

from difflib import get_close_matches
from pathlib import Path
from typing import Any

import yaml

from .errors import InputError
from .units import Dimension, parse
from .yaml_text import load


class Section:
    """A mapping of a YAML file whose keys must all be asked for.

    `where` names the place in every message. Call `finish` when all known keys were read: what is
    left over was misspelt by somebody.
    """

    def __init__(self, data: object, where: str) -> None:
        if not isinstance(data, dict):
            raise InputError(f'{where}: found {_kind(data)}, expected keys with values.')
        self._data: dict[str, Any] = {str(key): value for key, value in data.items()}
        self._known: list[str] = []
        self.where = where

    @classmethod
    def load(cls, path: Path) -> Section:
        """Read the mapping at the top of a YAML file.

        Raises:
            InputError: Unreadable, not YAML, or no mapping.

        """
        try:
            text = path.read_text(encoding='utf-8')
        except OSError as error:
            raise InputError(f'{path}: cannot be read ({error.strerror}).') from None
        except UnicodeDecodeError:
            raise InputError(f'{path}: found binary data, expected YAML text.') from None
        return cls.parse(text, str(path))

    @classmethod
    def parse(cls, text: str, where: str) -> Section:
        """Read the mapping at the top of a YAML text."""
        try:
            return cls(load(text), where)
        except yaml.YAMLError as error:
            raise InputError(f'{where}: not YAML: {" ".join(str(error).split())}') from None

    def key(self, name: str) -> str:
        """Return the full name of a key, for a message."""
        return f'{self.where}: {name}'

    def has(self, name: str) -> bool:
        """Say whether the key is there."""
        self._known.append(name)
        return self._data.get(name) is not None

    def raw(self, name: str) -> Any:
        """Return the value as YAML gives it."""
        self._known.append(name)
        if self._data.get(name) is None:
            raise InputError(f'{self.where}: the key {name!r} is missing{self._instead(name)}')
        return self._data[name]

    def _instead(self, name: str) -> str:
        """End a sentence on a missing key: with one that may be it, if there is one."""
        others = [key for key in self._data if key not in self._known]
        alike = get_close_matches(name, others, n=1)
        return f'; is {alike[0]!r} a misspelling of it?' if alike else '.'

    def text(self, name: str, default: str | None = None) -> str:
        """Return a string (numbers count as their text)."""
        if default is not None and not self.has(name):
            return default
        value = self.raw(name)
        if isinstance(value, (dict, list)):
            raise InputError(f'{self.key(name)}: found {_kind(value)}, expected a text.')
        return str(value)

    def number(self, name: str, default: float | None = None) -> float:
        """Return a number without a unit."""
        if default is not None and not self.has(name):
            return default
        value = self.raw(name)
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise InputError(f'{self.key(name)}: found {value!r}, expected a number.')
        return float(value)

    def flag(self, name: str, *, default: bool) -> bool:
        """Return true or false."""
        if not self.has(name):
            return default
        value = self.raw(name)
        if not isinstance(value, bool):
            raise InputError(f'{self.key(name)}: found {value!r}, expected true or false.')
        return value

    def quantity(self, name: str, dimension: Dimension, default: float | None = None) -> float:
        """Return a number with a unit, in SI."""
        if default is not None and not self.has(name):
            return default
        return parse(self.raw(name), dimension, self.key(name))

    def items(self, name: str) -> list[Any]:
        """Return a list."""
        value = self.raw(name)
        if not isinstance(value, list) or not value:
            raise InputError(f'{self.key(name)}: found {_kind(value)}, expected a list.')
        return value

    def section(self, name: str) -> Section:
        """Return a mapping below this one."""
        return Section(self.raw(name), self.key(name))

    def sections(self, name: str) -> list[Section]:
        """Return a list of mappings."""
        return [Section(v, f'{self.key(name)}[{i}]') for i, v in enumerate(self.items(name))]

    def finish(self) -> None:
        """Refuse keys that nobody asked for.

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


def _kind(value: object) -> str:
    names = {dict: 'a mapping', list: 'a list', str: 'a text', type(None): 'nothing'}
    return names.get(type(value), repr(value))
