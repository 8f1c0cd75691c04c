"""Read the provenance in a calibration file, with a check of each known key.

Unknown keys are kept: laboratories may add notes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from .channel_noise import COEFFICIENTS, CURVE
from .config import Section, as_number
from .earth import LEAST_GRAVITY, MOST_GRAVITY
from .errors import InputError

_CHANNELS = 6
"""Channels of an IMU, gx to az."""
_TEXTS = ('recording', 'sha256', 'recorded', 'method', 'plan', 'table', 'gravity_source', 'frame')
_LISTS_OF_TEXTS = ('topics', 'terms', 'missing_positions', 'shared_with')
_FLAGS = ('terms_looked_for', 'height_assumed')
_COUNTS = ('segments', 'turns', 'samples')
_NUMBERS = ('height', 'azimuth_seen_deg', 'azimuth_seen_std_deg', 'condition_number')
_SIX = ('random_walk', 'sensor_random_walk', 'residual_rms', 'bias_drift')
_NOT_NEGATIVE = (
    *('table_clock_std', 'latitude_std_deg', 'gravity_std', 'highest_rate'),
    'accel_interpolated_from_hz',
)


def read_origin(section: Section) -> dict[str, Any]:
    """Return the provenance in a file, unchanged.

    Raises:
        InputError: Names the key, what was found and what was expected.
    """
    if not section.has('provenance'):
        return {}
    found = section.raw('provenance')
    mine = section.section('provenance')
    readers: tuple[tuple[tuple[str, ...], Callable[[str], object]], ...] = (
        (_TEXTS, mine.text),
        (_LISTS_OF_TEXTS, mine.texts),
        (_FLAGS, lambda name: mine.flag(name, default=False)),
        (_COUNTS, lambda name: mine.whole(name, 0)),
        (_NUMBERS, mine.number),
        (_NOT_NEGATIVE, lambda name: _number(mine, name, 0.0)),
        (('latitude_deg',), lambda name: _number(mine, name, -90.0, 90.0)),
        (('gravity',), lambda name: _number(mine, name, LEAST_GRAVITY, MOST_GRAVITY)),
        (_SIX, lambda name: _numbers(mine, name, _CHANNELS)),
        (('temperature',), lambda name: _each(mine.section(name), ('mean', 'lowest', 'highest'))),
        (('clock',), lambda name: _clock(mine.section(name))),
        (('closed_form', 'versions'), mine.section),
        (('tests_of_terms',), lambda name: _tests(mine.section(name))),
        (('noise',), lambda name: _noise(mine.section(name))),
    )
    for names, read in readers:
        for name in names:
            if mine.has(name):
                read(name)
    return dict(found)


def _number(section: Section, name: str, least: float, most: float | None = None) -> float:
    value = section.number(name)
    if value < least or (most is not None and value > most):
        bound = f'{least:g} or more' if most is None else f'{least:g} to {most:g}'
        raise InputError(f'{section.key(name)}: found {value:g}, expected {bound}.')
    return value


def _numbers(section: Section, name: str, count: int | None = None) -> int:
    """Check a list of numbers, some possibly unknown; return their number."""
    values = section.raw(name)
    known = isinstance(values, list) and all(
        value is None or as_number(value) is not None for value in values
    )
    if not known or (count is not None and len(values) != count):
        wanted = 'a list of numbers' if count is None else f'a list of {count} numbers'
        raise InputError(f'{section.key(name)}: found {values!r}, expected {wanted}.')
    return len(values)


def _each(section: Section, names: tuple[str, ...]) -> None:
    for name in names:
        section.number(name)


def _clock(section: Section) -> None:
    for name in ('offset_s', 'offset_std_s', 'rate_ppm', 'rate_std_ppm'):
        # Any number: the deviation of a clock that was not compared is infinite.
        if section.has(name) and as_number(section.raw(name)) is None:
            raise InputError(
                f'{section.key(name)}: found {section.raw(name)!r}, expected a number.'
            )
    if section.has('motions'):
        section.whole('motions', 0)


def _tests(section: Section) -> None:
    for name in section.names():
        if section.has(name):
            section.section(name).text('state')


def _noise(section: Section) -> None:
    for name in section.names():
        if not section.has(name):
            continue
        channel = section.section(name)
        counts = {_numbers(channel, key) for key in CURVE}
        if len(counts) > 1:
            raise InputError(f'{channel.where}: found {", ".join(CURVE)} of different lengths.')
        channel.raw('timed')
        channel.flag('timed', default=False)
        for key in (f'{name}{end}' for name in COEFFICIENTS for end in ('', '_std', '_below')):
            if channel.has(key):
                _number(channel, key, 0.0)
        channel.finish()
