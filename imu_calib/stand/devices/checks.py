"""The checksum of a device's frames and messages, as its YAML describes it."""

from __future__ import annotations

from dataclasses import dataclass

from ...common.config import Section
from ...common.errors import InputError
from .checksum import CATALOGUE, Algorithm, Crc, Fletcher, Sum, Xor
from .fields import HIGH_WORD_FIRST, LOW_WORD_FIRST, Number

_ORDERS = {'little': '<', 'big': '>'}
ORDERS = {**_ORDERS, 'low_word_first': LOW_WORD_FIRST, 'high_word_first': HIGH_WORD_FIRST}
"""Byte orders of a number."""
OWN_KINDS = ('sum', 'xor', 'crc', 'fletcher')
"""Checksums outside the catalogue."""
WORDS = (8, 16, 32)
"""Bits of the words of a sum."""
FLETCHER = (255, 256)
"""Moduli of Fletcher's checksum."""


@dataclass(frozen=True)
class FrameCheck:
    """Position of a checksum, and the bytes that it covers: from `first` to `end` - 1."""

    algorithm: Algorithm
    number: Number
    first: int
    end: int
    padding: int = 0


def read_algorithm(check: Section, order: str) -> Algorithm:
    """Read `kind` of a checksum and its parameters; `order` is its default byte order."""
    kind = check.text('kind')
    if kind in CATALOGUE:
        return CATALOGUE[kind]
    if kind == 'xor':
        return Xor(check.whole('init', 0, 255, 0))
    if kind == 'sum':
        word = _one_of(check, 'word', WORDS, 8)
        negated = check.flag('negated', default=False)
        return Sum(_width(check, word), negated, word, read_order(check, order))
    if kind == 'fletcher':
        return Fletcher(_one_of(check, 'modulus', FLETCHER, None))
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
    known = ', '.join([*OWN_KINDS, *CATALOGUE])
    raise InputError(f'{check.key("kind")}: found {kind!r}, expected one of {known}.')


def _width(check: Section, default: int | None) -> int:
    width = check.whole('width', 8, 32, default)
    if width % 8:
        raise InputError(f'{check.key("width")}: found {width}, expected 8, 16, 24 or 32 bits.')
    return width


def _one_of(check: Section, name: str, values: tuple[int, ...], default: int | None) -> int:
    value = check.whole(name, values[0], values[-1], default)
    if value not in values:
        *first, last = values
        expected = f'{", ".join(map(str, first))} or {last}'
        raise InputError(f'{check.key(name)}: found {value}, expected {expected}.')
    return value


def read_order(section: Section, default: str | None) -> str:
    """Read the order of a number's bytes: '<' lowest first, '>' highest."""
    if default is not None and not section.has('byte_order'):
        return default
    return section.choice('byte_order', _ORDERS)


def read_number_order(section: Section, default: str, size: int) -> str:
    """Read the byte order of a number of `size` bytes: its words may be swapped, too."""
    if not section.has('byte_order'):
        return default
    order = section.choice('byte_order', ORDERS)
    if order in {LOW_WORD_FIRST, HIGH_WORD_FIRST} and size not in {2, 4, 8}:
        raise InputError(
            f'{section.key("byte_order")}: found {section.raw("byte_order")}, but words of 16 bits '
            f'make numbers of 16, 32 or 64 bits; these are {8 * size}.'
        )
    return order
