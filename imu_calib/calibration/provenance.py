"""Read the provenance in a calibration file, with a check of each known key.

Numbers are returned as numbers and texts as texts, so that nothing needs to check them again.
Unknown keys are kept: laboratories may add notes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import isfinite, isnan
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.budget import LEAST_FREEDOM, PROBABILITY, Budget, BudgetLine, ErrorSource
from ..common.config import Section, as_number, numbers_of
from ..common.errors import InputError
from ..common.stream import Floats
from ..common.units import LARGEST
from ..model.earth import SITE_BOUNDS
from ..model.parameters import MOST_SKEWED, Parameter
from ..model.sensors import parameters_of
from ..model.terms import TERMS, coefficients_of
from ..session.imu import COEFFICIENTS, CURVE

_CHANNELS = 6  #: Channels of an IMU, gx to az.
_TEXTS = (
    *('recording', 'sha256', 'segments_file', 'recorded', 'method', 'plan', 'table'),
    *('gravity_source', 'frame'),
)
_LISTS_OF_TEXTS = ('topics', 'terms', 'missing_positions', 'shared_with')
_FLAGS = ('terms_looked_for', 'height_assumed', 'by_hand')
_COUNTS = ('segments', 'turns', 'samples')
_NUMBERS = ('height', 'azimuth_seen_deg', 'condition_number')
_SIX = ('random_walk', 'sensor_random_walk', 'residual_rms', 'bias_drift')
_NOT_NEGATIVE = (
    *('table_clock_std', 'latitude_std_deg', 'gravity_std', 'highest_rate'),
    *('azimuth_seen_std_deg', 'duration', 'gravity_off_before', 'gravity_off_after'),
)
_LEAST = 1e-30
"""Smallest averaging time and sample rate in SI: none is near, and its square is not zero."""

Reader = Callable[[str], Any]


def read_origin(section: Section) -> dict[str, Any]:
    """Return the provenance in a file; empty without one."""
    if not section.has('provenance'):
        return {}
    mine = section.section('provenance')
    return _read(
        mine,
        {
            **dict.fromkeys(_TEXTS, mine.text),
            **dict.fromkeys(_LISTS_OF_TEXTS, lambda name: list(mine.texts(name))),
            **dict.fromkeys(_FLAGS, lambda name: mine.flag(name, default=False)),
            **dict.fromkeys(_COUNTS, lambda name: mine.whole(name, 0)),
            **dict.fromkeys(_NUMBERS, mine.number),
            **dict.fromkeys(_NOT_NEGATIVE, lambda name: _number(mine, name, 0.0)),
            'accel_interpolated_from_hz': lambda name: _number(mine, name, _LEAST),
            'latitude_deg': lambda name: _number(mine, name, *SITE_BOUNDS['latitude']),
            'gravity': lambda name: _number(mine, name, *SITE_BOUNDS['gravity']),
            **dict.fromkeys(_SIX, lambda name: _numbers(mine, name, _CHANNELS)),
            'temperature': lambda name: _temperature(mine.section(name)),
            'clock': lambda name: _clock(mine.section(name)),
            'closed_form': lambda name: _closed_form(mine.section(name)),
            'versions': lambda name: _read_each(mine.section(name), Section.text),
            'tests_of_terms': lambda name: _tests(mine.section(name)),
            'noise': lambda name: _noise(mine.section(name)),
        },
    )


def _read(section: Section, readers: Mapping[str, Reader]) -> dict[str, Any]:
    """Return the values of a mapping: those of known keys as read, others as they are."""
    return {
        name: readers.get(name, section.raw)(name) if section.has(name) else None
        for name in section.names()
    }


def _read_each(section: Section, read: Callable[[Section, str], Any]) -> dict[str, Any]:
    """Return the values of a mapping whose keys are names, all read alike; none may be empty."""
    return {name: read(section, name) for name in section.names()}


def _number(section: Section, name: str, least: float, most: float | None = None) -> float:
    value = section.number(name)
    if value < least or (most is not None and value > most):
        bound = f'{least:g} or more' if most is None else f'{least:g} to {most:g}'
        raise InputError(f'{section.key(name)}: found {value:g}, expected {bound}.')
    return value


def _possible(section: Section, name: str) -> float:
    """Return a number that may be infinite or unknown."""
    value = as_number(section.raw(name))
    if value is None or (isfinite(value) and abs(value) > LARGEST):
        raise InputError(f'{section.key(name)}: found {section.raw(name)!r}, expected a number.')
    return value


def _numbers(
    section: Section, name: str, count: int | None = None, least: float = 0.0
) -> list[float | None]:
    """Return a list of numbers, some possibly unknown."""
    values = section.raw(name)
    found = [as_number(value) for value in values] if isinstance(values, list) else []
    known = isinstance(values, list) and all(
        value is None or (number is not None and (isnan(number) or least <= number <= LARGEST))
        for value, number in zip(values, found, strict=True)
    )
    if not known or (count is not None and len(found) != count):
        wanted = 'numbers' if count is None else f'{count} numbers'
        raise InputError(
            f'{section.key(name)}: found {values!r}, expected a list of {wanted}, '
            f'{least:g} or more.'
        )
    return found


def _temperature(section: Section) -> dict[str, Any]:
    lowest, mean, highest = (section.number(name) for name in ('lowest', 'mean', 'highest'))
    if not lowest <= mean <= highest:
        raise InputError(
            f'{section.where}: found mean {mean:g}, expected one from lowest, {lowest:g}, to '
            f'highest, {highest:g}.'
        )
    return _read(section, dict.fromkeys(('mean', 'lowest', 'highest'), section.number))


def _clock(section: Section) -> dict[str, Any]:
    names = ('offset_s', 'offset_std_s', 'rate_ppm', 'rate_std_ppm')
    # Any number: the deviation of a clock that was not compared is infinite.
    return _read(
        section,
        {
            **dict.fromkeys(names, lambda name: _possible(section, name)),
            'motions': lambda name: section.whole(name, 0),
        },
    )


def _closed_form(section: Section) -> dict[str, Any]:
    return _read(
        section,
        {
            **dict.fromkeys(('method', 'refusal'), section.text),
            'joint_std_over_closed_form': lambda name: _number(section, name, 0.0),
            'difference_in_std': lambda name: _read_each(section.section(name), Section.number),
        },
    )


def _tests(section: Section) -> dict[str, Any]:
    return _read_each(
        section, lambda tests, name: _test(tests.section(name), tests.key(name), name)
    )


def _test(section: Section, where: str, name: str) -> dict[str, Any]:
    """Return the test of a term."""
    try:
        known = {one.name for one in coefficients_of(name)}
    except InputError as error:
        raise InputError(f'{where}: {error}') from None
    section.raw('state')
    found = _read(
        section,
        {
            'state': section.text,
            # Of a number that is zero in double precision.
            'log10_p': lambda key: _number(section, key, -LARGEST, 0.0),
            'probability': lambda key: _number(section, key, 0.0, 1.0),
            'found_from': lambda key: _numbers(section, key, len(known) or None),
            'would_move': lambda key: _read_each(section.section(key), _moved),
        },
    )
    for one in found.get('would_move') or ():
        if known and one not in known:
            raise InputError(
                f'{section.key("would_move")}: found {one!r}, expected {", ".join(sorted(known))}.'
            )
    return found


def _moved(section: Section, name: str) -> dict[str, Any]:
    mine = section.section(name)
    moved = {'parameter': mine.text('parameter'), 'by': mine.number('by')}
    if moved['parameter'] not in _NAMES:
        raise InputError(
            f'{mine.key("parameter")}: found {moved["parameter"]!r}, expected the name of a '
            'parameter.'
        )
    mine.refuse_unknown_keys()
    return moved


_NAMES = {parameter.name for parameter in parameters_of(TERMS, skewed=MOST_SKEWED)}


def _noise(section: Section) -> dict[str, Any]:
    return _read_each(section, lambda channels, name: _channel(channels.section(name)))


def _channel(section: Section) -> dict[str, Any]:
    names = [f'{name}{end}' for name in COEFFICIENTS for end in ('', '_std', '_below')]
    section.raw('timed')
    found = {key: _number(section, key, 0.0) for key in names if section.has(key)}
    curve = {key: _numbers(section, key, least=_LEAST if key == 'tau' else 0.0) for key in CURVE}
    timed = section.flag('timed', default=False)
    section.refuse_unknown_keys()
    if len({len(values) for values in curve.values()}) > 1:
        raise InputError(f'{section.where}: found {", ".join(CURVE)} of different lengths.')
    return {**found, **curve, 'timed': timed}


# The uncertainty budget as `uncertainty_budget` of calibration.yaml: SI units, named.

_NOTHING = 1e-24
"""Variance in SI of what is held at its value: what rounding leaves of it is no contradiction."""
_ROUNDED = 1e-3
"""Ratio by which the sum of the sources may differ from a variance: certificates state two digits
of an uncertainty. Differences of nearly equal covariances lose some 1e-5 in exact sessions."""
_FOLLOWS = (
    'units',
    'standard_uncertainty',
    'effective_degrees_of_freedom',
    'coverage_probability',
    'coverage_factor',
    'expanded_uncertainty',
)
"""Keys of the file that are for the reader: they follow from the sources."""


def budget_document(
    budget: Budget, parameters: Sequence[Parameter], known: NDArray[np.bool_]
) -> dict[str, Any]:
    """Return the mapping of a budget in a file.

    Args:
        budget: Of n parameters.
        parameters: Their names.
        known: (n,) mask of the estimated ones; the others are left out.
    """

    def row(values: Floats) -> list[float]:
        return [float(v) for v in values[known]]

    estimated = [p for p, k in zip(parameters, known, strict=True) if k]
    return {
        'parameters': [p.name for p in estimated],
        'units': [p.unit.si for p in estimated],
        'standard_uncertainty': row(budget.std),
        'effective_degrees_of_freedom': row(budget.freedom),
        'coverage_probability': PROBABILITY,
        'coverage_factor': row(budget.coverage_factor),
        'expanded_uncertainty': row(budget.expanded),
        'sources': [
            {
                'source': line.source.value,
                'evaluation': line.source.evaluation,
                'description': line.source.words,
                'standard_uncertainty': row(line.std),
                'degrees_of_freedom': row(line.freedom),
            }
            for line in budget.lines
        ],
    }


def read_budget(section: Section, parameters: Sequence[Parameter], variances: Floats) -> Budget:
    """Read a budget from its mapping; quantities that follow from the sources are recomputed.

    Args:
        section: The mapping.
        parameters: Those of the calibration, n.
        variances: (n,) theirs, NaN for those that were not estimated.

    Raises:
        InputError: Other parameters, an unknown source, no standard deviations, or sources that do
            not add up to the variances.
    """
    known = np.isfinite(variances)
    names = [p.name for p, k in zip(parameters, known, strict=True) if k]
    if section.items('parameters') != names:
        raise InputError(
            f'{section.key("parameters")}: not the {len(names)} parameters of the covariance in '
            'their order.'
        )
    lines = []
    for entry in section.sections('sources'):
        source = entry.choice('source', {s.value: s for s in ErrorSource})
        std = _row(entry, 'standard_uncertainty', known)
        freedom = _row(entry, 'degrees_of_freedom', known)
        if not (std[known] <= LARGEST).all():
            raise InputError(f'{entry.key("standard_uncertainty")}: expected finite numbers.')
        if not (freedom[known] >= LEAST_FREEDOM).all():
            raise InputError(
                f'{entry.key("degrees_of_freedom")}: expected {LEAST_FREEDOM:g} or more each.'
            )
        for key in ('evaluation', 'description'):
            entry.text(key, '')
        entry.refuse_unknown_keys()
        lines.append(BudgetLine(source, std, freedom))
    for key in _FOLLOWS:
        section.has(key)
    section.refuse_unknown_keys()
    budget = Budget(tuple(lines))
    doubt = np.abs(budget.variances.sum(axis=0) - variances)[known]
    if not (doubt <= _ROUNDED * variances[known] + _NOTHING).all():
        raise InputError(
            f'{section.key("sources")}: their squares do not add up to the variances in covariance.'
        )
    return budget


def _row(entry: Section, key: str, known: NDArray[np.bool_]) -> Floats:
    """Return a row of non-negative numbers, NaN for parameters not estimated."""
    values = numbers_of(entry.items(key))
    if values is None:
        raise InputError(f'{entry.key(key)}: found no numbers.')
    count = int(known.sum())
    if values.shape != (count,) or not (values >= 0).all():
        raise InputError(f'{entry.key(key)}: expected {count} numbers, none of them negative.')
    row = np.full(len(known), np.nan)
    row[known] = values
    return row
