"""Whole numbers and lists of them in a device's file, checked: key, found, expected."""

from __future__ import annotations

import numpy as np

from ..config import Section
from ..errors import InputError


def is_whole(value: object, lower: int, upper: int) -> bool:
    """Say whether a value is a whole number from `lower` to `upper`."""
    return isinstance(value, int) and not isinstance(value, bool) and lower <= value <= upper


def whole(section: Section, name: str, lower: int, upper: int, default: int | None = None) -> int:
    """Read a whole number from `lower` to `upper`."""
    if default is not None and not section.has(name):
        return default
    value = section.raw(name)
    if not is_whole(value, lower, upper):
        raise InputError(
            f'{section.key(name)}: found {value!r}, expected a whole number from {lower} to '
            f'{upper}.'
        )
    return int(value)


def whole_list(section: Section, name: str, lower: int, upper: int) -> list[int]:
    """Read a list of whole numbers from `lower` to `upper`."""
    values = section.items(name)
    for value in values:
        if not is_whole(value, lower, upper):
            raise InputError(
                f'{section.key(name)}: found {value!r}, expected whole numbers from {lower} to '
                f'{upper}.'
            )
    return values


def numbers(section: Section, name: str, most: int = 3) -> list[float]:
    """Read one number or a list of them; 1 where there is none."""
    if not section.has(name):
        return [1.0]
    raw = section.raw(name)
    values = raw if isinstance(raw, list) else [raw]
    numeric = all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in values)
    if not numeric or not 1 <= len(values) <= most or not all(np.isfinite(v) and v for v in values):
        raise InputError(f'{section.key(name)}: found {raw!r}, expected a number other than 0.')
    return [float(v) for v in values]
