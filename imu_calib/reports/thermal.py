"""The report of a combined file: the parameters of one unit over temperature."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np

from ..calibration.thermal import ThermalCalibration, temperature_range
from ..common.units import decimals
from ..session.imu import ImuSpec
from . import provenance
from .assessment import LIMITS, Assessed, assess, badge, outcome, worst
from .charts import panels, small, tag
from .html import STYLE, bullets, document, facts, paragraph, section, table
from .tables import engineering, fixed

_SIDE_BY_SIDE = 4
"""Temperatures of one table: as many as fit side by side on A4."""
_POINTS = 41
"""Points of a drawn curve."""
_NOTE = (
    'Each column is one session; the error is two standard deviations. Between the temperatures '
    'the parameters are interpolated (dashed): beyond the lowest and the highest the nearest holds.'
)


def thermal_page(combined: ThermalCalibration, name: str, imu: ImuSpec | None = None) -> str:
    """Return the report of a combined file as HTML; the same file gives the same text."""
    first = combined.calibrations[0]
    specification = None if imu is None else imu.specification
    each = [assess(c, specification) for c in combined.calibrations]
    title = f'{first.serial_number or first.unit_name} over temperature'
    sessions = ''.join(_session(combined, k) for k in range(len(combined.calibrations)))
    return document(
        title,
        tag('h1', escape(title))
        + _head(combined, name, each)
        + section(
            'Parameters',
            *_values(combined, each),
            paragraph(_NOTE, 'note'),
            paragraph(LIMITS, 'note') if specification is not None else '',
        )
        + section('Over temperature', panels(_curves(combined)), kind='page')
        + section('Sessions', _sessions(combined), sessions, kind='page'),
        STYLE,
    )


def _head(combined: ThermalCalibration, name: str, each: Sequence[Sequence[Assessed]]) -> str:
    first, last = combined.calibrations[0], combined.calibrations[-1]
    verdict = worst([a for some in each for a in some])
    if verdict is None:
        text = 'No specification was given: values without verdicts.'
    else:
        passed = sum(all(a.verdict is None or a.verdict.value == 'pass' for a in s) for s in each)
        text = f'Within the specification at {passed} of {len(each)} temperatures.'
    low, high = temperature_range(combined)
    ends = [provenance.date(one.provenance) for one in (first, last)]
    between = 'straight lines'
    if combined.order is not None:
        between = f'polynomials of order {combined.order}'
    pairs = [
        ('sessions', str(len(each))),
        ('temperatures', f'{_celsius(combined, 0)} to {_celsius(combined, -1)}'),
        ('counts from', f'{low:.1f} to {high:.1f}\u00a0\u00b0C'),
        ('in between', between),
        ('IMU description', first.imu.id),
        ('recorded at the ends', ' and '.join(dict.fromkeys(ends))),
    ]
    return (
        paragraph(f'Calibration, from {name}', 'subtitle') + outcome(verdict, text) + facts(pairs)
    )


def _celsius(combined: ThermalCalibration, k: int) -> str:
    return f'{fixed(combined.temperatures[k], 1)}\u00a0\u00b0C'


def _values(combined: ThermalCalibration, each: Sequence[Sequence[Assessed]]) -> list[str]:
    """Return the values at all temperatures, in as many tables as the paper requires."""
    found = []
    for first in range(0, len(each), _SIDE_BY_SIDE):
        some = range(first, min(first + _SIDE_BY_SIDE, len(each)))
        temperatures = [_celsius(combined, k) for k in some]
        found.append(_table([each[k] for k in some], temperatures))
    return found


def _table(each: Sequence[Sequence[Assessed]], temperatures: Sequence[str]) -> str:
    """Return the values at some temperatures, a row for each parameter."""
    rows = []
    for across in zip(*each, strict=True):
        shown = engineering(across[0].parameter, by_hand=across[0].by_hand)
        limit = across[0].limit
        cells = [
            tag('b', across[0].parameter.name),
            badge(worst(across)),
            '' if limit is None else f'\u00b1{limit / shown.scale:g}',
            escape(shown.symbol),
        ]
        for one in across:
            places = decimals(one.std / shown.scale)
            value, error = one.value / shown.scale, 2 * one.std / shown.scale
            cells.append(f'{fixed(value, places)} \u00b1 {error:.{places}f}')
        rows.append(cells)
    headings, columns = ['', '', 'limit', 'unit', *temperatures], 'llrl' + 'r' * len(each)
    if not any(row[1] for row in rows):
        # Without limits there are no verdicts.
        rows = [[row[0], *row[3:]] for row in rows]
        headings, columns = [headings[0], *headings[3:]], columns[0] + columns[3:]
    return table(headings, rows, 'plain', columns)


def _curves(combined: ThermalCalibration) -> list[str]:
    """Draw every parameter that all sessions estimated over temperature."""
    points = combined.temperatures
    values = np.array([c.values for c in combined.calibrations])
    std = np.array([c.std for c in combined.calibrations])
    fine = np.linspace(points[0], points[-1], _POINTS)
    between = np.array([combined.at(float(celsius)).values for celsius in fine])
    ends = f'{points[0]:.1f} \u00b0C', f'{points[-1]:.1f} \u00b0C'
    return [
        small(
            parameter.name,
            engineering(parameter, by_hand=combined.calibrations[0].by_hand),
            points,
            values[:, k],
            std[:, k],
            ends,
            list(zip(fine.tolist(), between[:, k].tolist(), strict=True)),
        )
        for k, parameter in enumerate(combined.calibrations[0].parameters)
        if np.isfinite(std[:, k]).all()
    ]


def _sessions(combined: ThermalCalibration) -> str:
    rows = []
    for k, calibration in enumerate(combined.calibrations):
        seen = calibration.provenance
        about = seen['temperature']
        rows.append(
            [
                tag('b', _celsius(combined, k)),
                f'{about["lowest"]:.1f} to {about["highest"]:.1f}',
                escape(provenance.date(seen)),
                escape(str(seen.get('recording') or '-')),
                escape(provenance.plan(seen)),
                str(seen.get('segments', '-')),
            ]
        )
    headings = ['mean', 'range, \u00b0C', 'recorded', 'recording', 'plan', 'dwells']
    return table(headings, rows, 'plain', 'lrrllr')


def _session(combined: ThermalCalibration, k: int) -> str:
    calibration = combined.calibrations[k]
    return (
        tag('h3', f'Session at {_celsius(combined, k)}')
        + bullets(calibration.findings)
        + provenance.provenance(calibration)
    )
