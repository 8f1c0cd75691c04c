"""The checksum of a device's frames and messages, as its YAML describes it."""

from __future__ import annotations

from dataclasses import dataclass

from ..config import Section
from ..errors import InputError
from .checksum import CATALOGUE, Algorithm, Crc, Sum, Xor
from .fields import Number

_ORDERS = {'little': '<', 'big': '>'}


@dataclass(frozen=True)
class FrameCheck:
    """Where a checksum stands and which bytes it covers: from `first` up to, without, `end`."""

    algorithm: Algorithm
    number: Number
    first: int
    end: int
    padding: int = 0


def read_algorithm(check: Section) -> Algorithm:
    """Read `kind` of a checksum and its parameters."""
    kind = check.text('kind')
    if kind in CATALOGUE:
        return CATALOGUE[kind]
    if kind == 'xor':
        return Xor(check.whole('init', 0, 255, 0))
    if kind == 'sum':
        return Sum(_width(check, 8), check.flag('negated', default=False))
    if kind == 'crc':
        width = _width(check, None)
        highest = (1 << width) - 1
        return Crc(
            width,
            check.whole('poly', 1, highest),
            check.whole('init', 0, highest, 0),
            check.flag('refin', default=False),
            check.flag('refout', default=False),
            check.whole('xorout', 0, highest, 0),
        )
    known = ', '.join(['sum', 'xor', 'crc', *CATALOGUE])
    raise InputError(f'{check.key("kind")}: found {kind!r}, expected one of {known}.')


def _width(check: Section, default: int | None) -> int:
    width = check.whole('width', 8, 32, default)
    if width % 8:
        raise InputError(f'{check.key("width")}: found {width}, expected 8, 16, 24 or 32 bits.')
    return width


def read_order(section: Section, default: str | None) -> str:
    """Read the order of a number's bytes: '<' lowest first, '>' highest."""
    if default is not None and not section.has('byte_order'):
        return default
    return section.choice('byte_order', _ORDERS)
