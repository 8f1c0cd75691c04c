"""The report: one HTML file that needs nothing else, neither network nor script."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from ..calibration import Calibration
from ..calibrator import Result
from ..imu import ImuSpec
from . import allan_plot, repeatability, residuals, timeline
from .assessment import angles_table, assess, badge, summary, tables, worst
from .budget import budget_section
from .html import bullets, facts, paragraph, section, table
from .parameter_table import FREE_OF_FRAME, change_note, decimals
from .style import STYLE
from .svg import tag
from .terms import terms_section

_POLICY = "default-src 'none'; style-src 'unsafe-inline'"
_LIMITS = (
    'Pass and fail are given where the value and its error bar of two standard deviations lie '
    'wholly on one side of the limit (ISO 14253-1); between them it is marginal.'
)


@dataclass(frozen=True, eq=False)
class Contents:
    """What a report is written from.

    Attributes:
        calibration: The result.
        name: Of its file.
        imu: The unit's description with its specification and data sheet; None where not given.
        result: What the recording gives when it is calibrated anew; None without a recording.
        others: Further calibrations of the unit by name, to compare with.

    """

    calibration: Calibration
    name: str
    imu: ImuSpec | None = None
    result: Result | None = None
    others: Mapping[str, Calibration] | None = None


def page(contents: Contents) -> str:
    """Return the report as HTML.

    The same contents give the same text: nothing in it depends on when or where it is written.

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
            section('Uncertainty budget', *budget_section(calibration), kind='page'),
            _course(contents.result),
            _residuals(contents),
            _noise(contents),
            _repeatability(contents),
            section('Provenance', _provenance(calibration), kind='dense'),
        ]
    )
    head = ''.join(
        [
            tag('meta', charset='utf-8'),
            tag('meta', http_equiv='Content-Security-Policy', content=_POLICY),
            tag('meta', name='viewport', content='width=device-width, initial-scale=1'),
            tag('title', escape(title)),
            tag('style', STYLE),
        ]
    )
    return f'<!DOCTYPE html>\n{tag("html", tag("head", head) + tag("body", body), lang="en")}\n'


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
        ('recorded', _words(where.get('recorded')).replace('T', ' ').replace('Z', ' UTC')),
        ('recording', _words(where.get('recording'))),
        ('plan', _words(where.get('plan'))),
        ('method', _words(where.get('method'))),
        ('table', _words(where.get('table'))),
        ('site', _site(where)),
        ('static dwells', _words(where.get('segments'))),
        ('turns', _words(where.get('turns'))),
        ('samples used', _words(where.get('samples'))),
    ]
    return paragraph(f'from {contents.name}', 'subtitle') + outcome + facts(pairs)


def _words(value: object) -> str:
    if isinstance(value, bool) or value is None:
        return '-'
    if isinstance(value, int):
        return f'{value:,}'.replace(',', '\u2009')
    return f'{value:.6g}' if isinstance(value, float) else str(value)


def _site(where: Mapping[str, object]) -> str:
    latitude, gravity = where.get('latitude_deg'), where.get('gravity')
    if not isinstance(latitude, float) or not isinstance(gravity, float):
        return '-'
    return f'latitude {latitude:.3f}\u00b0, gravity {gravity:.5f}\u00a0m/s\u00b2'


def _parameters(contents: Contents) -> str:
    specification = contents.imu.specification if contents.imu is not None else None
    assessed = assess(contents.calibration, specification)
    note = paragraph(_LIMITS if specification is not None else '', 'note')
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
    found = timeline.stretches(result)
    rejected = timeline.rejected_table(found)
    return section(
        'Course of the session',
        timeline.time_line(found, result.session.duration),
        rejected or paragraph('Every segment of the session was used.', 'note'),
        kind='page',
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
        allan_plot.noise_notes(seen),
        kind='page' if contents.calibration.residuals else '',
    )


def _repeatability(contents: Contents) -> str:
    if not contents.others:
        return ''
    names = [contents.name, *contents.others]
    rows = repeatability.repeated([contents.calibration, *contents.others.values()], names)
    return section(
        'Repeatability',
        paragraph(f'Compared: {", ".join(names)}.'),
        repeatability.repeatability_table(rows),
        repeatability.repeatability_notes(rows),
        repeatability.overlay(rows),
        kind='page',
    )


def _provenance(calibration: Calibration) -> str:
    return facts(list(_flat(calibration.provenance)))


def _flat(tree: Mapping[str, object], above: str = '') -> list[tuple[str, str]]:
    """Return nested entries as pairs; noise and terms have sections of their own."""
    pairs = []
    for key, value in tree.items():
        name = f'{above}{key}'.replace('_', ' ')
        if name in ('noise', 'tests of terms'):
            continue
        if isinstance(value, Mapping):
            pairs += _flat(value, f'{name}: ')
        elif isinstance(value, (list, tuple)):
            pairs.append((name, ', '.join(_listed(v) for v in value) or '-'))
        else:
            pairs.append((name, _words(value)))
    return pairs


def _listed(value: object) -> str:
    return f'{value:.3g}' if isinstance(value, float) and np.isfinite(value) else _words(value)
