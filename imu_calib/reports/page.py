"""The report: one self-contained HTML file without network and script."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

from ..calibration.calibration import Calibration
from ..calibration.results import Result
from ..session.imu import ImuSpec
from . import allan_plot, attitudes, provenance, repeatability, residuals, timeline
from .assessment import LIMITS, angles_table, assess, badge, summary, tables, worst
from .budget import budget_section
from .charts import tag
from .html import STYLE
from .parameter_table import FREE_OF_FRAME, change_note, decimals
from .reports_html import bullets, document, facts, paragraph, section, table
from .terms import terms_section


@dataclass(frozen=True, eq=False)
class Contents:
    """Contents of a report.

    Attributes:
        calibration: The result.
        name: Of its file.
        imu: The unit's description with its specification and data sheet; None if not given.
        result: Result of calibrating the recording again; None without a recording.
        others: Further calibrations of the unit by name, for comparison.
    """

    calibration: Calibration
    name: str
    imu: ImuSpec | None = None
    result: Result | None = None
    others: Mapping[str, Calibration] | None = None


def page(contents: Contents) -> str:
    """Return the report as HTML.

    Equal contents give equal text, independent of time and place.

    Raises:
        InputError: The calibrations to compare are not of one unit.
    """
    calibration = contents.calibration
    title = f'Calibration of {calibration.imu.id}'
    body = ''.join(
        [
            tag('h1', escape(title)),
            _head(contents),
            section('Findings', bullets(calibration.findings)),
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
    return document(title, body, STYLE)


def _head(contents: Contents) -> str:
    where = contents.calibration.provenance
    specification = contents.imu.specification if contents.imu is not None else None
    assessed = assess(contents.calibration, specification)
    verdict = worst(assessed)
    outcome = tag(
        'div',
        badge(verdict) + tag('span', escape(summary(assessed))),
        class_=f'outcome {verdict.value if verdict else ""}'.strip(),
    )
    pairs = [
        ('recorded', provenance.date(where)),
        ('recording', str(where.get('recording') or '-')),
        ('serial number', contents.calibration.serial_number or '-'),
        ('plan', provenance.plan(where)),
        ('method', str(where.get('method') or '-')),
        ('table', str(where.get('table') or '-')),
        ('site', provenance.site(where)),
        ('dwells, turns', f'{where.get("segments", "-")}, {where.get("turns", "-")}'),
        ('samples used', provenance.count(where.get('samples'))),
    ]
    return paragraph(f'from {contents.name}', 'subtitle') + outcome + facts(pairs)


def _parameters(contents: Contents) -> str:
    specification = contents.imu.specification if contents.imu is not None else None
    assessed = assess(contents.calibration, specification)
    note = paragraph(LIMITS, 'note')
    missing = []
    if not contents.calibration.has_accelerometers:
        missing = ['The accelerometers were not calibrated.']
    return section(
        'Parameters',
        tables(assessed),
        note if specification is not None else '',
        bullets(missing),
        angles_table(contents.calibration),
        paragraph(FREE_OF_FRAME, 'note'),
    )


def _changes(calibration: Calibration) -> str:
    if calibration.changes is None:
        return ''
    rows = []
    for term, name, value, std, unit in calibration.changes.shown():
        places = decimals(std)
        cells = (term, name, f'{value:.{places}f}', f'{std:.{places}f}', unit)
        rows.append([escape(cell) for cell in cells])
    headings = ['term', 'of', 'value', 'std', 'unit']
    return section(
        'Terms of the session',
        table(headings, rows, 'parameters plain', 'llrrl'),
        paragraph(change_note(calibration), 'note'),
    )


def _course(result: Result | None) -> str:
    if result is None:
        return ''
    found = timeline.intervals(result)
    rejected = timeline.rejected_table(found, result.session.start)
    return section(
        'Course of the session',
        paragraph(timeline.when(result), 'note'),
        timeline.time_line(found, result.session.duration),
        rejected or paragraph('Every segment of the session was used.', 'note'),
        tag('h3', 'Positions') + attitudes.attitudes(attitudes.stands(result)),
    )


def _residuals(contents: Contents) -> str:
    found = residuals.residuals_of(contents.calibration, contents.result)
    rms = contents.calibration.provenance.get('residual_rms')
    plots = residuals.residual_plots(found)
    if not plots:
        return ''
    listed = rms if isinstance(rms, Sequence) else None
    return section('Residuals', plots, residuals.residual_notes(found, listed))


def _noise(contents: Contents) -> str:
    seen = contents.calibration.noise
    return section(
        'Noise',
        allan_plot.noise_plots(seen, contents.imu),
        allan_plot.noise_table(seen, contents.imu),
        allan_plot.noise_notes(
            seen, provenance.number(contents.calibration.provenance, 'accel_interpolated_from_hz')
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
        repeatability.repeatability_notes(rows),
        repeatability.overlay(rows),
    )
