"""Distributions of the units of each type, and recordings by stand and by type."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from html import escape

import numpy as np

from ..common.stream import Floats
from ..model.parameters import PARAMETERS
from ..reports.charts import drawing, tag
from ..reports.html import paragraph, table
from ..reports.tables import decimals, engineering
from .formats import count, unit_of
from .page_contents import Fleet
from .results import Population, UnitHistory

_BINS = 24
"""Bins of a small distribution: 5 px each."""
_WIDTH, _HEIGHT = 120.0, 18.0
"""px."""
_REACH = 4.0
"""Range of a distribution to either side of the median, in robust standard deviations."""


def types(fleet: Fleet) -> str:
    """Return a table of the parameters for each type; the script shows one at a time."""
    of_type: dict[str, list[UnitHistory]] = {}
    for unit in fleet.history.units:
        if unit.serial:
            of_type.setdefault(unit.imu, []).append(unit)
    parts = [
        _type(population, of_type.get(imu, []))
        for imu, population in sorted(fleet.history.populations.items())
    ]
    return ''.join(parts)


def _type(population: Population, units: Sequence[UnitHistory]) -> str:
    newest = np.reshape([u.values[-1] for u in units], (-1, len(PARAMETERS)))
    limits = np.reshape([u.limit for u in units], (-1, len(PARAMETERS)))
    apart = Counter(outlier.parameter for outlier in population.outliers)
    headings = ['', 'median', 'robust std', 'turn-on std', 'trend per month', 'unit']
    headings += ['distribution', 'outside', 'apart']
    rows = [_row(population, k, newest[:, k], limits[:, k], apart) for k in range(len(PARAMETERS))]
    words = (
        f'{count(population.units, "unit")} of {population.imu} in '
        f'{count(population.sessions, "session")}, each by its newest one. Robust std is between '
        'units, turn-on std between the sessions of a unit.'
    )
    inside = paragraph(words, 'note') + table(headings, rows, 'plain population', 'lrrrrllrr')
    return tag(
        'div', tag('h3', escape(population.imu)) + inside, class_='type', data_imu=population.imu
    )


def _row(
    population: Population, k: int, newest: Floats, limits: Floats, apart: Counter[str]
) -> list[str]:
    parameter = PARAMETERS[k]
    scale = engineering(parameter).scale
    spread, turn_on = population.robust_std[k] / scale, population.turn_on[k] / scale
    places = decimals(spread)
    slope, slope_std = population.trend[k] / scale, population.trend_std[k] / scale
    button = tag('button', parameter.name, type='button', class_='choose', data_k=k)
    return [
        button,
        _number(population.median[k] / scale, places),
        _number(spread, places),
        _number(turn_on, decimals(turn_on)),
        _number(slope, decimals(slope_std) if slope_std > 0 else 3),
        escape(unit_of(parameter)),
        _distribution(
            parameter.name, newest, limits, population.median[k], population.robust_std[k]
        ),
        f'{int(population.outside[k])}' if population.outside[k] else '',
        f'{apart[parameter.name]}' if apart[parameter.name] else '',
    ]


def _number(value: float, places: int) -> str:
    return f'{value:.{places}f}'.replace('-', '\u2212') if np.isfinite(value) else '\u2013'


def _distribution(name: str, values: Floats, limits: Floats, median: float, spread: float) -> str:
    """Draw a distribution of units over the range that the specification allows."""
    known = values[np.isfinite(values)]
    if not len(known) or not spread > 0:
        return ''
    low, high = median - _REACH * spread, median + _REACH * spread
    counts, _ = np.histogram(np.clip(known, low, high), _BINS, (low, high))
    width = _WIDTH / _BINS
    parts = []
    stated = limits[np.isfinite(limits)]
    if len(stated):
        ends = np.clip([-stated[0], stated[0]], low, high)
        left, right = (ends - low) / (high - low) * _WIDTH
        parts.append(
            tag(
                'rect', x=float(left), y=0.0, width=float(right - left), height=_HEIGHT,
                class_='within',
            )
        )  # fmt: skip
    for place, number in enumerate(counts):
        if number:
            height = max(1.0, _HEIGHT * number / counts.max())
            parts.append(
                tag(
                    'rect', x=place * width, y=_HEIGHT - height, width=width - 0.6, height=height,
                    class_='count',
                )
            )  # fmt: skip
    return drawing(parts, _WIDTH, _HEIGHT, f'distribution of {name}')


def counts(fleet: Fleet) -> str:
    """Return tables of the number of recordings by stand and by type."""
    rows = fleet.recordings
    stands = _counted('stand', rows.stand, fleet)
    types = _counted('type', rows.imu, fleet)
    return tag('div', stands + types, class_='panels halves')


def _counted(name: str, labels: Sequence[str], fleet: Fleet) -> str:
    rows = fleet.recordings
    total: Counter[str] = Counter(labels)
    lost = Counter(one for one, fine in zip(labels, rows.calibrated, strict=True) if not fine)
    units: dict[str, set[tuple[str, str]]] = {}
    for one, imu, serial in zip(labels, rows.imu, rows.serial, strict=True):
        units.setdefault(one, set()).add((imu, serial))
    cells = []
    for one, number in sorted(total.items()):
        share = f'{100 * lost[one] / number:.1f} %' if lost[one] else ''
        cells.append(
            [
                escape(one) or 'not stated',
                f'{sum(bool(serial) for _, serial in units[one])}',
                f'{number}',
                f'{lost[one]}',
                share,
            ]
        )
    return tag('div', table([name, 'units', 'recordings', 'failed', ''], cells, 'plain', 'lrrrr'))
