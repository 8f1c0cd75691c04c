"""Convert units: text to SI on input, engineers' units on output."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from enum import Enum

from .errors import InputError

LARGEST = 1e100
"""Largest amount of a value: none in SI units, counts or pulses is near; its square is finite."""
DEG = math.pi / 180  #: rad.
ARCMIN = DEG / 60  #: rad.
ARCSEC = DEG / 3600  #: rad.
DEG_H = DEG / 3600  #: rad/s.
HOUR = 3600.0  #: s.
MONTH_DAYS = 30.4375  #: A month, one twelfth of the Julian year.
STANDARD_GRAVITY = 9.80665  #: m/s^2 (third CGPM, 1901); the unit 'g' in files.
MICRO_G = STANDARD_GRAVITY * 1e-6  #: m/s^2.
PPM = 1e-6  #: A ratio.

_ANGLES: dict[str, float] = {'rad': 1.0, 'deg': DEG, 'arcmin': ARCMIN, 'arcsec': ARCSEC}
"""rad per unit."""
_ACCELERATIONS: dict[str, float] = {
    **dict.fromkeys(('m/s^2', 'm/s2', 'm/s\u00b2'), 1.0),
    'g': STANDARD_GRAVITY,
    'mg': STANDARD_GRAVITY * 1e-3,
    'ug': MICRO_G,
}
"""m/s^2 per unit."""
_RATES: dict[str, float] = {
    f'{angle}/{time}': value / seconds
    for angle, value in _ANGLES.items()
    for time, seconds in {'s': 1.0, 'min': 60.0, 'h': HOUR}.items()
} | {'\u00b0/s': DEG, 'dps': DEG, 'mdeg/s': 1e-3 * DEG, 'mdps': 1e-3 * DEG}
"""rad/s per unit; the last four as data sheets of MEMS units have them."""
_SHEET_RATES = {unit: _RATES[unit] for unit in ('deg/s', '\u00b0/s', 'dps', 'mdeg/s', 'mdps')}
_SHEET_ACCELERATIONS = {unit: _ACCELERATIONS[unit] for unit in ('g', 'mg', 'ug', 'm/s^2')}
"""Units of sensitivities in data sheets of MEMS units, which call a count LSB."""
_VELOCITIES = {'m/s': 1.0, 'mm/s': 1e-3}  #: m/s per unit of a velocity.
_ROOT_HOUR = math.sqrt(HOUR)


def _per(word: str, units: Mapping[str, float]) -> dict[str, float]:
    return {
        spelling: value
        for unit, value in units.items()
        for spelling in (
            (f'({unit})/{word}', f'{unit}/{word}') if '/' in unit else (f'{unit}/{word}',)
        )
    }


class Dimension(Enum):
    """A kind of quantity: its accepted units, and their SI values."""

    ANGLE = _ANGLES
    RATE = _RATES
    ANGULAR_ACCELERATION = {f'{a}/s^2': v for a, v in _ANGLES.items()}
    ACCELERATION = _ACCELERATIONS
    TIME = {'s': 1.0, 'ms': 1e-3, 'us': 1e-6, 'min': 60.0, 'h': HOUR}
    FREQUENCY = {'Hz': 1.0, 'kHz': 1e3}
    TEMPERATURE = {'K': 1.0}
    TEMPERATURE_RATE = {'K/s': 1.0, 'K/min': 1 / 60, 'K/h': 1 / HOUR}
    RATE_PER_KELVIN = _per('K', _RATES)
    ACCELERATION_PER_KELVIN = _per('K', _ACCELERATIONS)
    RATIO_PER_KELVIN = {'ppm/K': PPM, '%/K': 0.01}
    LENGTH = {'m': 1.0, 'mm': 1e-3, 'km': 1e3}
    RATIO = {'ppm': PPM, '%': 0.01}
    ANGLE_PER_PULSE = _per('pulse', _ANGLES)
    RATE_PER_COUNT = _per('count', _RATES) | _per('LSB', _SHEET_RATES)
    VELOCITY = _VELOCITIES
    VELOCITY_PER_PULSE = _per('pulse', _VELOCITIES)
    ACCELERATION_PER_COUNT = _per('count', _ACCELERATIONS) | _per('LSB', _SHEET_ACCELERATIONS)
    ANGLE_RANDOM_WALK = {
        'rad/sqrt(s)': 1.0,
        'deg/sqrt(s)': DEG,
        'deg/sqrt(h)': DEG / _ROOT_HOUR,
        'arcsec/sqrt(s)': ARCSEC,
        '(deg/s)/sqrt(Hz)': DEG,
        'deg/s/sqrt(Hz)': DEG,
        'dps/sqrt(Hz)': DEG,
        'mdps/sqrt(Hz)': 1e-3 * DEG,
        '(deg/h)/sqrt(Hz)': DEG_H,
    }
    G_SENSITIVITY = {
        '(rad/s)/(m/s^2)': 1.0,
        '(deg/h)/g': DEG_H / STANDARD_GRAVITY,
        '(deg/s)/g': DEG / STANDARD_GRAVITY,
    }
    PER_ACCELERATION = {
        '1/(m/s^2)': 1.0,
        'ug/g^2': MICRO_G / STANDARD_GRAVITY**2,
        'mg/g^2': MICRO_G * 1e3 / STANDARD_GRAVITY**2,
    }
    PER_ACCELERATION_SQUARED = {
        '1/(m/s^2)^2': 1.0,
        'ug/g^3': MICRO_G / STANDARD_GRAVITY**3,
        'mg/g^3': MICRO_G * 1e3 / STANDARD_GRAVITY**3,
    }
    RATE_PER_ACCELERATION_SQUARED = {
        '(rad/s)/(m/s^2)^2': 1.0,
        '(deg/h)/g^2': DEG_H / STANDARD_GRAVITY**2,
        '(deg/s)/g^2': DEG / STANDARD_GRAVITY**2,
    }
    VELOCITY_RANDOM_WALK = {
        '(m/s)/sqrt(s)': 1.0,
        '(m/s)/sqrt(h)': 1 / _ROOT_HOUR,
        'm/s/sqrt(h)': 1 / _ROOT_HOUR,
        'ug/sqrt(Hz)': MICRO_G,
        'mg/sqrt(Hz)': MICRO_G * 1e3,
    }

    @property
    def inverses(self) -> Mapping[str, float]:
        """Units of its inverse, as 16384 LSB/g: the SI value of what they are per."""
        return _INVERSES.get(self, {})

    @property
    def spellings(self) -> tuple[str, ...]:
        """All accepted units."""
        return (*self.value, *self.inverses)


def _counts_per(units: Mapping[str, float]) -> dict[str, float]:
    return {
        spelling: value
        for word in ('LSB', 'count')
        for unit, value in units.items()
        for spelling in (f'{word}/{unit}', f'{word}/({unit})')[: 1 + ('/' in unit)]
    }


_INVERSES = {
    Dimension.RATE_PER_COUNT: _counts_per(_SHEET_RATES),
    Dimension.ACCELERATION_PER_COUNT: _counts_per(_SHEET_ACCELERATIONS),
}


_QUANTITY = re.compile(r'^\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(\S.*?)?\s*$', re.ASCII)


_COMMA = re.compile(r'\s*[-+]?\d*,\d+(?![\d,.]).*', re.ASCII)


def point_for_comma(text: object) -> str:
    """Return a hint on a number with a decimal comma; empty for all else.

    Examples:
        >>> point_for_comma('59,9'), point_for_comma('59.9')
        (' The decimal sign is a point: write 59.9.', '')
    """
    if not isinstance(text, str) or not _COMMA.fullmatch(text):
        return ''
    return f' The decimal sign is a point: write {text.strip().replace(",", ".", 1)}.'


def counted(number: int, noun: str, plural: str = '') -> str:
    """Return a number with its noun, in the singular for one.

    A plural is given if it is not the singular with an s.

    Examples:
        >>> counted(1, 'turn'), counted(0, 'turn'), counted(2, 'is', 'are')
        ('1 turn', '0 turns', '2 are')
    """
    return f'{number} {noun if number == 1 else plural or f"{noun}s"}'


def lasting(seconds: float) -> str:
    """Return a duration of a rest in hours, below one in minutes.

    Examples:
        >>> lasting(120.0), lasting(9000.0)
        ('2 min', '2.5 h')
    """
    return f'{seconds / 60:.3g} min' if seconds < HOUR else f'{seconds / HOUR:.3g} h'


def significant(value: float, digits: int = 2) -> str:
    """Return a number with so many significant digits, without an exponent.

    Examples:
        >>> significant(123.4), significant(0.0123), significant(2.0), significant(3400.0, 3)
        ('120', '0.012', '2', '3400')
    """
    if not value or not math.isfinite(value):
        return f'{value:g}'
    places = digits - 1 - math.floor(math.log10(abs(value)))
    text = f'{round(value, places):.{max(0, places)}f}'
    return text.rstrip('0').rstrip('.') if '.' in text else text


_TYPESET = (
    (re.compile(r'(?<![\w./-])ug(?![\w]|[.-]\w)'), '\u00b5g'),
    (re.compile(r'sqrt\((\w+)\)'), '\u221a\\1'),
    (re.compile(r'(?<=[A-Za-z)])\^2'), '\u00b2'),
    (re.compile(r'(?<=[A-Za-z)])\^3'), '\u00b3'),
    (re.compile(r'\bdegC\b'), '\u00b0C'),
    (re.compile(r' \+- '), ' \u00b1 '),
)
"""Spellings of a terminal, and what pages set. A name of a file that holds `ug` is left alone."""


def typeset(text: str) -> str:
    """Return units as pages show them; terminals and files keep to ASCII.

    Examples:
        >>> typeset('50 ug'), typeset('deg/sqrt(h)'), typeset('3 +- 1 m/s^2')
        ('50 \u00b5g', 'deg/\u221ah', '3 \u00b1 1 m/s\u00b2')
    """
    for pattern, shown in _TYPESET:
        text = pattern.sub(shown, text)
    return text


def as_options(sentence: str, shown: str = '{}') -> str:
    """Return a sentence with the names of keywords, as `imu_topic`, as options, --imu-topic."""
    return re.sub(
        r'`([a-z_]+)`', lambda name: shown.format(f'--{name[1].replace("_", "-")}'), sentence
    )


def decimals(deviation: float) -> int:
    """Return the decimals that show a standard deviation with two significant digits.

    Examples:
        >>> decimals(0.0946), decimals(0.0996), decimals(146.0)
        (3, 2, 0)
    """
    return max(_place(deviation), 0)


def _place(deviation: float) -> int:
    """Return the place of the second significant digit of a rounded number; 0 are the ones."""
    if not math.isfinite(deviation) or deviation <= 0:
        return 4
    return min(1 - int(f'{deviation:.1e}'.partition('e')[2]), 9)


def rounded(value: float, *uncertainties: float) -> tuple[str, ...]:
    """Return a value and its uncertainties as text.

    Two significant digits of each uncertainty, and the value to the last of the first's (JCGM
    100:2008, 7.2.6; EA-4/02 M:2022, 6.3).

    Examples:
        >>> rounded(1923.04, 2.71), rounded(-90908.3, 146.0), rounded(5.22741, 0.0187, 0.00936)
        (('1923.0', '2.7'), ('-90910', '150'), ('5.227', '0.019', '0.0094'))
    """
    places = [_place(uncertainty) for uncertainty in uncertainties]
    pairs = zip((value, *uncertainties), (places[0], *places), strict=True)
    # Zero has no sign.
    return tuple(f'{round(x, at) + 0.0:.{max(at, 0)}f}' for x, at in pairs)


_LISTED = 8  #: Units that a message lists at most. A choice: more are not read.


def _listed(units: Mapping[str, float]) -> str:
    """Return the units that are accepted, of many the first spellings."""
    if len(units) <= _LISTED:
        return ', '.join(units)
    return f'{", ".join([unit for unit in units if not unit.startswith("(")][:_LISTED])} and others'


def parse(text: object, dimension: Dimension, key: str) -> float:
    """Convert a quantity with its unit to SI; `key` names it in errors.

    Examples:
        >>> parse('180 deg', Dimension.ANGLE, 'mount')
        3.141592653589793
        >>> parse('100 LSB/(m/s^2)', Dimension.ACCELERATION_PER_COUNT, 'scale_factor')
        0.01
    """
    units: Mapping[str, float] = dimension.value
    match = _QUANTITY.match(text) if isinstance(text, str) else None
    if match is None or match[2] not in dimension.spellings:
        raise InputError(
            f'{key}: found {text!r}, expected a number with a unit, one of {_listed(units)}.'
            f'{point_for_comma(text)}'
        )
    number, unit = float(match[1]), match[2]
    if unit in units:
        value = number * units[unit]
    else:
        value = dimension.inverses[unit] / number if number else math.inf
    if not math.isfinite(value):
        raise InputError(f'{key}: found {text!r}, expected a finite number.')
    return value
