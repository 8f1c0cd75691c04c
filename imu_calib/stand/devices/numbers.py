"""Read lists of integers, and scales, from a device's file, with checks."""

from __future__ import annotations

import math

from ...common.config import Section, as_number, as_whole
from ...common.errors import InputError


def whole_list(section: Section, name: str, lower: int, upper: int) -> list[int]:
    """Read a list of integers from `lower` to `upper`."""
    found = []
    for value in section.items(name):
        number = as_whole(value, lower, upper)
        if number is None:
            raise InputError(
                f'{section.key(name)}: found {value!r}, expected whole numbers from {lower} to '
                f'{upper}.'
            )
        found.append(number)
    return found


def numbers(section: Section, name: str, most: int = 3) -> list[float]:
    """Read one number or a list of them; 1 if absent."""
    if not section.has(name):
        return [1.0]
    raw = section.raw(name)
    values = raw if isinstance(raw, list) else [raw]
    found = [v for v in map(as_number, values) if v and math.isfinite(v)]
    if len(found) < len(values) or not 1 <= len(values) <= most:
        raise InputError(f'{section.key(name)}: found {raw!r}, expected a number other than 0.')
    return found
