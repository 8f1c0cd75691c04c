"""Reports, each a self-contained HTML file: of a calibration, and of one over temperature."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from ..calibration.agreement import two_units
from ..calibration.calibration import Calibration
from ..calibration.results import Result
from ..calibration.thermal import ThermalCalibration, temperature_range
from ..common.stream import Floats
from ..common.units import rounded, typeset
from ..model.parameters import bias_units, engineering
from ..session.imu import COVERAGE, ImuSpec
from . import course, provenance, repeatability
from .assessment import (
    LIMITS,
    Assessed,
    angles_table,
    assess,
    badge,
    limits_tables,
    outcome,
    summary,
    worst,
)
from .budget import budget_section
from .charts import Axis, Panel, drawing, label, legend, panels, small, tag
from .html import STYLE, bullets, document, facts, paragraph, scrolling, section, table
from .noise import noise_notes, noise_plots, noise_table
from .tables import (
    CHANGE_HEADINGS,
    FREE_OF_FRAME,
    TERM_HEADINGS,
    TERM_NOTE,
    change_note,
    change_rows,
    fixed,
    minus,
    term_rows,
    three_digits,
)

_WIDTH, _HEIGHT, _LEFT, _TOP, _GAP = 760.0, 120.0, 58.0, 34.0, 46.0
"""px; layout."""
_LABELS = 24
"""Most names side by side below a plot."""
_LETTER = 6.4
"""px: mean width of a character."""
_EXPECTED = 3.0
"""Standard deviations, drawn as lines: one residual of 370 is beyond."""
_LEAST_RANGE = 3.5
"""Smallest range of a plot in standard deviations, so that its limits are visible."""


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of a session."""

    positions: tuple[str, ...]  #: Name of every static dwell.
    value: Floats  #: (s, 6) rad/s and m/s^2; NaN if a triad was not estimated.
    #: (s, 6) standard deviation of each static dwell's own mean; None without the recording.
    std: Floats | None

    @property
    def numbered(self) -> bool:
        """Whether the names are too long to fit side by side below a plot."""
        room = (_WIDTH - _LEFT - 12) / min(max(len(self.positions), 1), _LABELS)
        return max(map(len, self.positions), default=0) * _LETTER > room

    @property
    def normalised(self) -> Floats | None:
        """Residuals in standard deviations, (s, 6)."""
        if self.std is None:
            return None
        return np.divide(
            self.value, self.std, out=np.full_like(self.value, np.nan), where=self.std > 0
        )


def residuals_of(calibration: Calibration, result: Result | None) -> Residuals:
    """Return the residuals of a calibration, with deviations if its recording is available."""
    rows = calibration.residuals
    value = np.array([[*r.gyro, *r.accel] for r in rows], dtype=float).reshape(-1, 6)
    std = None
    if result is not None and len(result.solution.residuals) == len(rows):
        std = np.array([r.std for r in result.solution.residuals], dtype=float).reshape(-1, 6)
    return Residuals(tuple(r.position for r in rows), value, std)


def residual_plots(residuals: Residuals, *, by_hand: bool) -> str:
    """Draw the residuals of both triads, and below them the same in standard deviations."""
    if not residuals.positions:
        return ''
    both = [
        (f'{name}, {unit.symbol}', channels, unit.scale)
        for name, channels, unit in zip(
            ('gyros', 'accelerometers'),
            (slice(0, 3), slice(3, 6)),
            bias_units(by_hand=by_hand),
            strict=True,
        )
    ]
    shown = [b for b in both if np.isfinite(residuals.value[:, b[1]]).any()]
    parts = [legend('XYZ', _WIDTH - 220, 14)]
    top = _TOP
    for title, channels, scale in shown:
        std = None if residuals.std is None else residuals.std[:, channels] / scale
        panel = _panel(residuals, top, residuals.value[:, channels] / scale, std, title)
        parts += panel.parts
        top += _HEIGHT + _GAP
    normalised = residuals.normalised
    if normalised is not None:
        for title, channels, _ in shown:
            name = f'{title.partition(",")[0]}, residual / std'
            panel = _panel(residuals, top, normalised[:, channels], None, name, limits=True)
            parts += panel.parts
            top += _HEIGHT + _GAP
    return scrolling(drawing(parts, _WIDTH, top - _GAP + 36, 'Residuals of every static dwell'))


def _panel(
    residuals: Residuals,
    top: float,
    values: Floats,
    std: Floats | None,
    title: str,
    *,
    limits: bool = False,
) -> Panel:
    count = len(residuals.positions)
    reach = np.abs(values) + (0 if std is None else std)
    largest = float(np.nanmax(reach)) if np.isfinite(reach).any() else 1.0
    largest = max(largest, _LEAST_RANGE) if limits else largest
    x, y = Axis(0.0, float(count)), Axis.around([-largest, largest])
    panel = Panel(x, y, _LEFT, top, _WIDTH - _LEFT - 12, _HEIGHT)
    panel.frame('', title, x_ticks=False)
    panel.level(0.0, 'zero')
    if limits:
        panel.level(_EXPECTED)
        panel.level(-_EXPECTED)
    every = -(-count // _LABELS)
    for k, position in enumerate(residuals.positions):
        if k % every == 0:
            name = str(k + 1) if residuals.numbered else position
            at = panel.across(k + 0.5)
            bottom = top + _HEIGHT + 15
            panel.parts.append(label(name, at, bottom, class_='tick', text_anchor='middle'))
        for c in range(3):
            value = float(values[k, c])
            if np.isfinite(value):
                spread = None
                if std is not None:
                    spread = value - float(std[k, c]), value + float(std[k, c])
                panel.point(k + 0.25 + 0.25 * c, value, c, spread)
    return panel


def residual_notes(residuals: Residuals, rms: Sequence[object] | None, *, by_hand: bool) -> str:
    """Return sentences on the size of the residuals, and on outliers."""
    parts = []
    if residuals.numbered:
        named = '; '.join(f'{k + 1} {name}' for k, name in enumerate(residuals.positions))
        parts.append(paragraph(f'Static dwells in order of time: {named}.', 'note'))
    if rms is not None and len(rms) == 6:
        units = zip('ga', bias_units(by_hand=by_hand), strict=True)
        channels = [(f'{triad}{axis}', unit) for triad, unit in units for axis in 'xyz']
        cells = [
            '-' if not isinstance(v, (int, float)) else three_digits(float(v) / unit.scale)
            for v, (_, unit) in zip(rms, channels, strict=True)
        ]
        headings = ['RMS', *(f'{name}, {unit.symbol}' for name, unit in channels)]
        parts.append(table(headings, [['', *cells]], 'plain', 'lrrrrrr'))
    normalised = residuals.normalised
    if normalised is not None:
        finite = normalised[np.isfinite(normalised)]
        beyond = int(np.sum(np.abs(finite) > _EXPECTED))
        parts.append(
            paragraph(
                f'{beyond} of {len(finite)} residuals are beyond {_EXPECTED:g} standard deviations '
                "of the dwell's own noise (dashed lines). More than a few of them mean that "
                'something else changed: positioning errors of the table, a hand that trembled, or '
                'bias drift.',
                'note',
            )
        )
    return ''.join(parts)


def terms_section(calibration: Calibration) -> tuple[str, ...]:
    """Return the section's contents; empty for a calibration without entries on terms."""
    rows = [[escape(typeset(cell)) for cell in row] for row in term_rows(calibration)]
    if not rows:
        return ()
    return table(TERM_HEADINGS, rows, 'terms stacked', 'lllrll'), paragraph(TERM_NOTE, 'note')


@dataclass(frozen=True, eq=False)
class Contents:
    """Contents of a report."""

    calibration: Calibration  #: The result.
    name: str  #: Of its file.
    #: The unit's description with its specification and data sheet; None if not given.
    imu: ImuSpec | None = None
    #: Result of calibrating the recording again; None without a recording.
    result: Result | None = None
    #: Further calibrations of the unit by name, for comparison.
    others: Mapping[str, Calibration] | None = None


def page(contents: Contents) -> str:
    """Return the report as HTML.

    Equal contents give equal text, independent of time and place.
    """
    calibration = contents.calibration
    title = _title(calibration)
    body = ''.join(
        [
            tag('h1', escape(title)),
            _head(contents),
            section('Warnings and notes', bullets(calibration.findings)),
            _parameters(contents),
            _changes(contents.calibration),
            section('Terms', *terms_section(calibration)),
            section('Uncertainty budget', *budget_section(calibration)),
            _course(contents.result),
            _residuals(contents),
            _noise(contents),
            _repeatability(contents),
            section('Provenance', provenance.provenance(calibration)),
        ]
    )
    return document(f'{title}: calibration', body, STYLE)


def _title(calibration: Calibration) -> str:
    """Return the serial number; a unit without is known by its type, or its recording."""
    name = calibration.unit_name
    return name.removeprefix(f'{calibration.imu.id} ') if calibration.serial_number else name


def _head(contents: Contents) -> str:
    where = contents.calibration.provenance
    specification = contents.imu.specification if contents.imu is not None else None
    assessed = assess(contents.calibration, specification)
    shown = outcome(worst(assessed), summary(assessed))
    pairs = [
        ('recorded', provenance.date(where)),
        ('recording', str(where.get('recording') or '-')),
        ('IMU description', contents.calibration.imu.id),
        ('plan', provenance.plan(where)),
        ('method', str(where.get('method') or '-')),
        ('table', str(where.get('table') or '-')),
        ('site', provenance.site(where)),
        ('dwells, turns', f'{where.get("segments", "-")}, {where.get("turns", "-")}'),
        ('samples used', provenance.count(where.get('samples'))),
    ]
    verdict = paragraph(provenance.verdict_line(contents.calibration))
    title = paragraph(f'Calibration, from {contents.name}', 'subtitle')
    return title + verdict + shown + facts(pairs)


def _parameters(contents: Contents) -> str:
    specification = contents.imu.specification if contents.imu is not None else None
    assessed = assess(contents.calibration, specification)
    note = paragraph(LIMITS, 'note')
    missing = []
    if not contents.calibration.has_accelerometers:
        missing = ['The accelerometers were not calibrated.']
    return section(
        'Parameters',
        limits_tables(assessed),
        note if specification is not None else '',
        bullets(missing),
        angles_table(contents.calibration),
        paragraph(FREE_OF_FRAME, 'note'),
    )


def _changes(calibration: Calibration) -> str:
    rows = [[escape(typeset(cell)) for cell in row] for row in change_rows(calibration)]
    if not rows:
        return ''
    return section(
        'Terms of the session',
        table(CHANGE_HEADINGS, rows, 'parameters plain', 'llrrl'),
        paragraph(change_note(calibration), 'note'),
    )


def _course(result: Result | None) -> str:
    if result is None:
        return ''
    found = course.intervals(result)
    rejected = course.rejected_table(found, result.session.start)
    return section(
        'Course of the session',
        paragraph(course.when(result), 'note'),
        course.time_line(found, result.session.duration),
        course.signals_plot(result, found),
        rejected or paragraph('Every segment of the session was used.', 'note'),
        tag('h3', 'Positions') + course.attitudes(course.stands(result)),
    )


def _residuals(contents: Contents) -> str:
    found = residuals_of(contents.calibration, contents.result)
    rms = contents.calibration.provenance.get('residual_rms')
    by_hand = contents.calibration.by_hand
    plots = residual_plots(found, by_hand=by_hand)
    if not plots:
        return ''
    listed = rms if isinstance(rms, Sequence) else None
    return section('Residuals', plots, residual_notes(found, listed, by_hand=by_hand))


def _noise(contents: Contents) -> str:
    seen = contents.calibration.noise
    return section(
        'Noise',
        noise_plots(seen, contents.imu),
        noise_table(seen, contents.imu),
        noise_notes(
            seen,
            contents.imu,
            provenance.number(contents.calibration.provenance, 'accel_interpolated_from_hz'),
        ),
    )


def _repeatability(contents: Contents) -> str:
    if not contents.others:
        return ''
    names = [contents.name, *contents.others]
    all_of_them = [contents.calibration, *contents.others.values()]
    rows = repeatability.repeated(all_of_them, names)
    return section(
        'Repeatability',
        repeatability.dates_table(all_of_them, names),
        repeatability.repeatability_table(rows),
        bullets(two_units(all_of_them, names)),
        repeatability.repeatability_notes(rows),
        repeatability.overlay(rows),
    )


# The report of a combined file: the parameters of one unit over temperature.

_SIDE_BY_SIDE = 4
"""Temperatures of one table: as many as fit side by side on A4."""
_POINTS = 41
"""Points of a drawn curve."""
_THERMAL_NOTE = (
    'Each column is one session; the error is two standard deviations. Between the temperatures '
    'the parameters are interpolated (dashed): beyond the lowest and the highest the nearest holds.'
)


def thermal_page(combined: ThermalCalibration, name: str, imu: ImuSpec | None = None) -> str:
    """Return the report of a combined file as HTML; the same file gives the same text."""
    first = combined.calibrations[0]
    specification = None if imu is None else imu.specification
    each = [assess(c, specification) for c in combined.calibrations]
    title = f'{_title(first)} over temperature'
    sessions = ''.join(_session(combined, k) for k in range(len(combined.calibrations)))
    return document(
        title,
        tag('h1', escape(title))
        + _thermal_head(combined, name, each)
        + section(
            'Parameters',
            *_values(combined, each),
            paragraph(_THERMAL_NOTE, 'note'),
            paragraph(LIMITS, 'note') if specification is not None else '',
        )
        + section('Over temperature', panels(_curves(combined)), kind='page')
        + section('Sessions', _sessions(combined), sessions, kind='page'),
        STYLE,
    )


def _thermal_head(
    combined: ThermalCalibration, name: str, each: Sequence[Sequence[Assessed]]
) -> str:
    first, last = combined.calibrations[0], combined.calibrations[-1]
    verdict = worst([a for some in each for a in some])
    if verdict is None:
        text = 'The values are not judged: no file of the IMU with a specification was given.'
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
    title = paragraph(f'Calibration, from {name}', 'subtitle')
    sound = paragraph(provenance.verdict_line(*combined.calibrations))
    return title + sound + outcome(verdict, text) + facts(pairs)


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
            value, error = rounded(one.value / shown.scale, COVERAGE * one.std / shown.scale)
            cells.append(f'{minus(value)} \u00b1 {error}')
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
