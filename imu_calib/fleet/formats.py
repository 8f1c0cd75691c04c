"""Dates, numbers and counts of the page as text."""

from __future__ import annotations

import numpy as np

from ..model.parameters import PARAMETERS, Parameter
from ..reports.tables import decimals, engineering

NO_DATE = 'no date'
PLACE_OF = {p.name: k for k, p in enumerate(PARAMETERS)}


def day(date: np.datetime64) -> str:
    """Return a date as text.

    Examples:
        >>> day(np.datetime64('2026-03-02T14:30')), day(np.datetime64('NaT', 's'))
        ('2026-03-02', 'no date')
    """
    return NO_DATE if np.isnat(date) else str(date.astype('M8[D]'))


def count(number: int, noun: str, nouns: str = '') -> str:
    """Return a number with its noun.

    Examples:
        >>> count(1, 'unit'), count(12345, 'unit'), count(0, 'entry', 'entries')
        ('1 unit', '12 345 units', '0 entries')
    """
    written = f'{number:,}'.replace(',', '\u202f' if number >= 10_000 else '')
    return f'{written} {noun if number == 1 else nouns or noun + "s"}'.replace('\u202f', ' ')


def unit_of(parameter: Parameter) -> str:
    """Return the display unit of a parameter."""
    return engineering(parameter).unit.replace('ug', '\u00b5g')


def amount(parameter: Parameter, value: float, std: float) -> str:
    """Return an SI value with its standard deviation in the parameter's display unit."""
    scale = engineering(parameter).scale
    places = decimals(std / scale)
    return f'{value / scale:.{places}f} \u00b1 {std / scale:.{places}f}'.replace('-', '\u2212')
