"""A certificate: its contents as a value, and as HTML for A4 (ISO/IEC 17025:2017, 7.8)."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date, timedelta
from hashlib import sha256
from html import escape
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from ..calibration.calibration import Calibration, is_as_saved
from ..common.budget import PROBABILITY, Budget, ErrorSource
from ..common.errors import InputError
from ..common.files import version
from ..common.stream import Units
from ..common.units import ARCSEC, STANDARD_GRAVITY, counted, rounded
from ..model.earth import MEASURED
from ..model.parameters import Parameter, engineering
from ..recordings.storage import UNSORTED
from ..session.imu import Specification
from . import provenance
from .budget import assumed_inputs, budget_parts, freedom_words
from .certificate_fields import Conformity, Equipment, Fields, decide, missing
from .charts import tag
from .html import bullets, document, named_rows, paragraph, section, sheet, table
from .tables import minus

OUTPUT = {
    Units.PULSES: 'pulse',
    Units.COUNTS: 'count',
    Units.INCREMENTS: 'unit of the output',
    Units.RATES: 'unit of the output',
    Units.SI: 'unit of the output',
}
"""What a nominal scale factor refers to."""

_ZONES = timedelta(days=1)
"""Largest difference between a local date and the UTC date of the same instant: one day."""


_HINT = re.compile(
    r'(?:^|(?<=[.;:]) )(?:Calibrate|Check|Describe|Fasten|Give|Hold|Keep|Leave|Let|Level|Look|'
    r'Measure|Mount|Name|Raise|Record|Repeat|Run|Set|State|Take|To tell,|Turn|Use|Wait) (?=[a-z`])'
    r'.*?(?:[.](?= |$)|$)',
    re.IGNORECASE,
)
"""A sentence, or its last clause, that tells the operator what to do."""


_TOO_UNCERTAIN = (
    'Not assessed: U exceeds the limit, so that the measurement cannot show that a value conforms '
    '(measurement capability index below 1; JCGM 106:2012, 7.6).'
)


@dataclass(frozen=True)
class Stated:
    """A result, SI units."""

    parameter: Parameter  #: The parameter.
    value: float  #: The estimate.
    std: float  #: u, the standard uncertainty.
    expanded: float  #: U, the uncertainty expanded to `PROBABILITY`.
    factor: float  #: k, the factor on the standard uncertainty.
    freedom: float  #: Effective degrees of freedom; infinite for known values.
    limit: float | None = None  #: Largest amount that the specification allows; None without one.
    conformity: Conformity | None = None  #: Statement on that limit; None if none is requested.


@dataclass(frozen=True, eq=False)
class Certificate:
    """Contents of a certificate."""

    fields: Fields  #: Statements of the laboratory.
    calibration: Calibration  #: The result.
    budget: Budget  #: Of its uncertainties.
    results: tuple[Stated, ...]  #: Every estimated parameter.
    file: str  #: Name of the file of the calibration, if it has one, and its SHA-256.
    missing: tuple[str, ...] = ()  #: Required but missing statements; only a draft has any.
    draft: bool = False  #: Whether it is not yet a certificate.

    def __repr__(self) -> str:
        kind = 'a draft' if self.draft else counted(len(self.results), 'result')
        return f'<Certificate of {self.calibration}: {kind}>'

    @property
    def remarks(self) -> tuple[str, ...]:
        """The laboratory's remarks, and the findings without what they advise the operator."""
        # Messages that were sorted have no effect on the result.
        findings = (text for text in self.calibration.findings if UNSORTED not in text)
        found = (_HINT.sub('', text).strip() for text in findings)
        return (
            *self.fields.remarks,
            *(re.sub('[;:]$|;(?= [A-Z])', '.', text) for text in found if text),
        )

    @property
    def conformity(self) -> Conformity | None:
        """The worst statement on any parameter; None without statements."""
        found = [r.conformity for r in self.results if r.conformity is not None]
        return max(found, key=list(Conformity).index) if found else None

    @property
    def rule(self) -> str:
        """The decision rule and its risk, as text; empty without one."""
        rule, none = self.fields.conformity.rule, {None, Conformity.NOT_ASSESSED}
        if rule is None:
            return ''
        found = [r.conformity for r in self.results]
        words = rule.words(sum(one not in none for one in found))
        return f'{words} {_TOO_UNCERTAIN}' if Conformity.NOT_ASSESSED in found else words


def certificate_of(
    calibration: Calibration,
    fields: Fields,
    specification: Specification | None = None,
    *,
    source: Path | None = None,
    dcc: bool = False,
    draft: bool = False,
) -> Certificate:
    """Return the contents of a certificate.

    Args:
        calibration: With a budget of its uncertainties.
        fields: Statements of the laboratory; missing serial number and date of the recording are
            taken from the calibration.
        specification: Limits of the unit.
        source: File of the calibration; None for the one that its `save` writes.
        dcc: Whether a DCC is written too.
        draft: Whether missing statements are allowed, and the result is marked as a draft.

    Raises:
        InputError: The calibration has no budget, something that ISO/IEC 17025 requires is missing
            (everything missing is named), or the fields contradict the calibration.
    """
    budget = calibration.budget
    if budget is None or not np.nanmax(calibration.std) > 0:
        raise InputError(
            'The calibration has no uncertainty budget, and ISO/IEC 17025 asks for uncertainties '
            'with their coverage: expected one with uncertainty_budget (docs/budget.md).'
        )
    fields = _completed(fields, calibration)
    wrong = _contradictions(fields, calibration)
    lacking = missing(fields, dcc=dcc, limits=specification is not None)
    if not calibration.serial_number:
        lacking.append(
            'a serial number in the calibration, without which nothing says that it is of this '
            'unit: calibrate again with `serial` (7.8.2.1 g)'
        )
    if calibration.simulated:
        lacking.append('measured data: those of this calibration were simulated (7.2.1)')
    elif calibration.provenance.get('table_simulated'):
        lacking.append(
            f'a real table: {calibration.provenance.get("table")} is a simulated one by its file; '
            'calibrate again, and name the table by `table` (7.8.4.1 c)'
        )
    if provenance.impossible_gravity(calibration.provenance):
        lacking.append(
            'a possible gravity: what was stated lies beyond that of any place of this latitude '
            'and height; calibrate again with the measured `gravity` (7.6.1)'
        )
    if not provenance.number(calibration.provenance, 'gravity_std'):
        lacking.append(
            'a standard uncertainty of gravity, which the calibration takes as exact: calibrate '
            'again with `gravity_std` (7.6.1)'
        )
    if source is not None and not (whole := is_as_saved(source)):
        found = 'has no checksum' if whole is None else 'was edited after it was saved'
        lacking.append(
            f'a file of the calibration as it was saved: {source.name} {found}; calibrate again '
            '(7.11.3)'
        )
    lacking += _unnamed_references(fields, calibration, budget)
    if wrong or (lacking and not draft):
        raise InputError(f'{fields.where}: {_refusal(wrong, [] if draft else lacking)}')
    results = _results(calibration, budget, fields, specification or Specification())
    data = calibration.to_yaml().encode() if source is None else source.read_bytes()
    file = f'{"as saved" if source is None else source.name}, SHA-256 {sha256(data).hexdigest()}'
    return Certificate(fields, calibration, budget, results, file, tuple(lacking), draft)


def _refusal(wrong: Sequence[str], lacking: Sequence[str]) -> str:
    """Return all that speaks against a certificate: several items on a line each."""
    parts = []
    if wrong:
        head = f'{len(wrong)} entries contradict the calibration:'
        parts.append(wrong[0] if len(wrong) == 1 else '\n  - '.join([head, *wrong]))
    if lacking:
        are = 'is' if len(lacking) == 1 else 'are'
        head = f'{len(lacking)} of the entries that a certificate needs {are} missing:'
        listed = f'{head} {lacking[0]}. ' if len(lacking) == 1 else '\n  - '.join([head, *lacking])
        advice = 'State them, or write a draft (`draft`), which is marked as one.'
        parts.append(f'{listed}{advice}' if len(lacking) == 1 else f'{listed}\n{advice}')
    return '\n'.join(parts)


_GRAVITY = ('gravi',)
_REFERENCES = (
    (ErrorSource.GRAVITY, _GRAVITY, 'gravity, which was measured, with "gravity"'),
    (
        ErrorSource.TABLE_CLOCK,
        ('clock', 'frequency'),
        'the stated clock of the table, with "clock" or "frequency"',
    ),
    (ErrorSource.TABLE, ('table', 'angle'), 'the angles of the table, with "table" or "angle"'),
)
"""References that contribute if they are stated, and the words by which equipment names them."""


def _names(one: Equipment, words: Sequence[str]) -> bool:
    said = f'{one.name} {one.traceability}'.lower()
    return any(word in said for word in words)


def _unnamed_references(fields: Fields, calibration: Calibration, budget: Budget) -> Iterator[str]:
    """Yield the references that contribute to the budget and that no equipment names."""
    used = {line.source for line in budget.lines if np.any(line.std > 0)}
    if calibration.provenance.get('gravity_source') != MEASURED:
        used.discard(ErrorSource.GRAVITY)
    for source, words, which in _REFERENCES:
        if source in used and not any(_names(one, words) for one in fields.equipment):
            yield f'equipment: a reference of {which} in its name or traceability (7.8.4.1 c)'


def _completed(fields: Fields, calibration: Calibration) -> Fields:
    """Fill in fields from the calibration."""
    day = recorded(calibration)
    if fields.calibrated is None and day is not None:
        fields = replace(fields, calibrated=(day, day))
    if not fields.item.serial_number:
        item = replace(fields.item, serial_number=calibration.serial_number)
        fields = replace(fields, item=item)
    return fields


def recorded(calibration: Calibration) -> date | None:
    """Return the date on which the recording began, UTC; None if it is not stated."""
    try:
        found = provenance.recorded(calibration.provenance)
    except ValueError:
        return None
    return None if found is None else found.date()


def _contradictions(fields: Fields, calibration: Calibration) -> list[str]:
    """Return sentences on fields of another unit or session, and references that were not valid.

    Source: ISO/IEC 17025:2017, 6.4.4 and 6.5.1 for references.
    """
    wrong = []
    found, expected = fields.item.serial_number, calibration.serial_number
    if found and expected and found != expected:
        wrong.append(
            f'item: serial_number: found {found}, expected {expected} as in the calibration.'
        )
    day, began = recorded(calibration), 'when the recording of the calibration began.'
    ended = None if fields.calibrated is None else fields.calibrated[1]
    if day is not None and fields.calibrated is not None:
        first, last = fields.calibrated
        if not first - _ZONES <= day <= last + _ZONES:
            wrong.append(f'calibrated: found {first} to {last}, expected {day}, {began}')
            ended = day
    if day is not None and fields.received is not None and fields.received > day + _ZONES:
        wrong.append(f'received: found {fields.received}, after {day}, {began}')
    if day is not None and fields.issued is not None and fields.issued < day - _ZONES:
        wrong.append(f'issued: found {fields.issued}, before {day}, {began}')
    source = calibration.provenance.get('gravity_source')
    for k, one in enumerate(fields.equipment):
        if source not in {None, MEASURED} and _names(one, _GRAVITY):
            wrong.append(
                f'equipment[{k}]: found {one.name}, but the calibration used {source}: '
                'the results are not traceable to it. Leave it out, or calibrate again with '
                '`gravity` and `gravity_std`.'
            )
        if ended is None or one.valid_until is None:
            continue
        if one.valid_until < ended:
            wrong.append(
                f'equipment[{k}]: valid_until: found {one.valid_until}, before the end of the '
                f'calibration, {ended}: the results are not traceable to it. State the certificate '
                'that was valid then, or calibrate again with a valid reference.'
            )
    return wrong


def _results(
    calibration: Calibration, budget: Budget, fields: Fields, specification: Specification
) -> tuple[Stated, ...]:
    expanded, factor, freedom = budget.expanded, budget.coverage_factor, budget.freedom
    found = []
    for k, parameter in enumerate(calibration.parameters):
        # Parameters that define the frame are zero by definition, not results.
        if not calibration.std[k] > 0:
            continue
        value, limit = float(calibration.values[k]), specification.limit(parameter)
        decision = None
        if fields.conformity.rule is not None and limit is not None:
            decision = decide(value, float(expanded[k]), limit, fields.conformity.rule)
        numbers = (
            float(calibration.std[k]),
            float(expanded[k]),
            float(factor[k]),
            float(freedom[k]),
        )
        found.append(Stated(parameter, value, *numbers, limit, decision))
    return tuple(found)


def groups(results: Sequence[Stated]) -> list[tuple[str, list[Stated]]]:
    """Return the results of gyros and of accelerometers, with a heading."""
    named = [('Gyros', 'g'), ('Accelerometers', 'a')]
    found = [
        (title, [r for r in results if r.parameter.triad == letter]) for title, letter in named
    ]
    return [(title, some) for title, some in found if some]


# The certificate as HTML, and printed.

_PAGES = """
@page {{ size: A4; margin: 20mm 16mm 18mm 20mm;
  @top-left {{ content: {title}; font: 8.5pt {font}; color: #333; }}
  @top-right {{ content: {mark}; font: bold 8.5pt {font}; color: #b3261e; }}
  @bottom-left {{ content: {laboratory}; font: 8.5pt {font}; color: #333; }}
  @bottom-right {{ content: "page " counter(page) " of " counter(pages);
    font: 8.5pt {font}; color: #333; }} }}
"""
_FONT = '"DejaVu Sans", Arial, sans-serif'
_SHEET = sheet('certificate.css')


def style(title: str, laboratory: str, mark: str) -> str:
    """Return the style of a certificate, with texts for the margins of every printed page."""
    texts = {'title': title, 'laboratory': laboratory, 'mark': mark}
    quoted = {name: _quoted(text) for name, text in texts.items()}
    return _PAGES.format(font=_FONT, **quoted) + _SHEET


def _quoted(text: str) -> str:
    """Return a text as a string of CSS, escaped so that it cannot end its string or element."""
    kept = ''.join(c if c.isalnum() or c in ' .,-' else f'\\{ord(c):x} ' for c in text)
    return f'"{kept}"'


_MISSING = 'MISSING'
_UNCERTAINTY = (
    'u is the standard uncertainty, \u03bd its effective degrees of freedom (Welch-Satterthwaite), '
    "U = k u the expanded uncertainty: the coverage factor k is Student's t for a coverage "
    f'probability of {100 * PROBABILITY:g} %. They were evaluated by JCGM 100:2008 (GUM). '
    'The results are correlated: their covariance is in the file of the calibration ({file}), and '
    'is needed for the uncertainty of what is computed from several of them (JCGM 100:2008, 7.2.5).'
)
_DEFINITION = (
    'input = (I + M)\u207b\u00b9 (output \u00d7 scale factor {per} \u2212 D). M holds the '
    'scale-factor errors K on its diagonal and the misalignments E beside it (row: channel, '
    'column: input axis), D are the biases. Misalignments are those against {frame}.'
)
_UNIT_G = (
    f' As a unit g is the standard acceleration {STANDARD_GRAVITY} m/s\u00b2, \u00b5g is '
    '10\u207b\u2076 g.'
)
_STATEMENTS = (
    'The results relate only to the item calibrated, as it was received and at the time and under '
    'the conditions stated.',
    'This certificate may be reproduced in full only, unless the laboratory approves otherwise in '
    'writing.',
)


def certificate_page(certificate: Certificate) -> str:
    """Return a certificate as HTML; equal contents give equal text."""
    fields, calibration = certificate.fields, certificate.calibration
    title = f'Calibration certificate {fields.number or _MISSING}'
    laboratory = fields.laboratory.name or _MISSING
    mark = 'DRAFT, not a certificate' if certificate.draft else ''
    body = ''.join(
        [
            _head(certificate),
            _draft(certificate),
            _parties(certificate),
            section('Procedure and traceability', _procedure(certificate)),
            section('Results', *_results_section(certificate)),
            _conformity(certificate),
            section('Uncertainty budget', *budget_parts(calibration, certificate.budget)),
            section('Remarks', bullets(certificate.remarks)),
            section('Statements', bullets(_STATEMENTS)),
            _signatures(certificate),
        ]
    )
    return document(title, body, style(title, laboratory, mark))


def _or_dash(value: object) -> str:
    """Return the statement; in a draft that it is missing."""
    return str(value) if value not in (None, '', ()) else _MISSING


def _head(certificate: Certificate) -> str:
    fields = certificate.fields
    replaced = f'replaces certificate {fields.replaces}' if fields.replaces else ''
    code = fields.laboratory.accreditation
    accredited = f' Accreditation {code}.' if code else ''
    left = tag('h1', 'Calibration certificate') + paragraph(
        f'Contents by ISO/IEC 17025:2017, 7.8.{accredited}', 'note'
    )
    right = tag('div', escape(_or_dash(fields.number)), class_='number') + paragraph(
        replaced, 'note'
    )
    return tag('div', tag('div', left) + tag('div', right), class_='head')


def _draft(certificate: Certificate) -> str:
    if not certificate.draft:
        return ''
    words = 'This is a draft, not a certificate.'
    if certificate.missing:
        words += f' Missing: {"; ".join(certificate.missing)}.'
    return tag('div', escape(words), class_='draft')


def _parties(certificate: Certificate) -> str:
    fields = certificate.fields
    item = fields.item
    period = _MISSING
    if fields.calibrated is not None:
        first, last = fields.calibrated
        period = f'{first}' if first == last else f'{first} to {last}'
    site = {'laboratory': "the laboratory's premises", 'customer': "the customer's premises"}
    rows = [
        ('laboratory', _or_dash(', '.join(fields.laboratory.lines))),
        ('calibrated at', site.get(fields.location, fields.location)),
        ('customer', _or_dash(', '.join(fields.customer.lines))),
        ('item', _or_dash(item.description)),
        ('manufacturer, model', f'{_or_dash(item.manufacturer)}, {_or_dash(item.model)}'),
        ('serial number', _or_dash(item.serial_number)),
        *([('identification by the customer', item.customer_id)] if item.customer_id else []),
        ('condition', _or_dash(item.condition)),
        ('adjustment', _or_dash(item.adjustment)),
        ('received', _or_dash(fields.received)),
        ('calibrated', period),
        ('issued', _or_dash(fields.issued)),
    ]
    return section('Item and parties', named_rows(rows))


def _procedure(certificate: Certificate) -> str:
    fields, where = certificate.fields, certificate.calibration.provenance
    unit = provenance.temperature(where)
    rows = [
        ('procedure', f'{_or_dash(fields.procedure.name)}; {_or_dash(fields.procedure.reference)}'),
        ('plan and estimator', provenance.procedure(where)),
        ('software', _software(where)),
        ('recording', f'{where.get("recording") or "-"}, begun {provenance.date(where)}'),
        ('SHA-256 of the recording', str(where.get('sha256') or '-')),
        ('IMU description', provenance.file_words(certificate.calibration.imu.id, where, 'imu')),
        ('table', provenance.file_words(where.get('table'), where, 'table')),
        ('latitude, (u) in its last digits', provenance.latitude(where) or '-'),
        ('gravity, (u) in its last digits', provenance.gravity(where) or '-'),
        ('assumed', assumed_inputs(certificate.calibration) or 'nothing'),
        ('environment, limits', _environment(certificate)),
        *([('temperature of the item', unit)] if unit else []),
    ]
    headings = ['reference', 'serial number', 'certificate', 'valid until', 'traceability']
    equipment = [[escape(cell) for cell in _reference(e)] for e in fields.equipment]
    listed = table(headings, equipment, 'stacked') if equipment else paragraph(_MISSING, 'missing')
    return named_rows(rows) + tag('h3', 'Reference equipment') + listed


def _software(where: Mapping[str, Any]) -> str:
    used = (where.get('versions') or {}).get('imu_calib', '-')
    return f'imu_calib {used}' + ('' if used == version() else f'; certificate: {version()}')


def _environment(certificate: Certificate) -> str:
    texts = []
    for words, unit, condition in certificate.fields.environment.stated.values():
        texts.append(f'{words} ({condition.value:g} \u00b1 {condition.within:g}) {unit}')
    return _or_dash(', '.join(texts))


def _reference(equipment: Equipment) -> list[str]:
    made = ' '.join(part for part in (equipment.manufacturer, equipment.model) if part)
    return [
        f'{_or_dash(equipment.name)}{": " + made if made else ""}',
        _or_dash(equipment.serial_number),
        f'{_or_dash(equipment.certificate)}, {_or_dash(equipment.issued_by)}',
        str(equipment.valid_until or '-'),
        _or_dash(equipment.traceability),
    ]


def _results_section(certificate: Certificate) -> list[str]:
    calibration = certificate.calibration
    imu = calibration.imu
    pulses = imu.units.per_interval
    per = '/ sample interval' if pulses else ''
    by_sensors = calibration.provenance.get('frame') is not None
    frame = 'the frame that the remarks state' if by_sensors else 'the axes of the table'
    definition = _DEFINITION.format(per=per, frame=frame).replace('  ', ' ')
    shown = [engineering(r.parameter, by_hand=calibration.by_hand) for r in certificate.results]
    if any(re.search(r'\b[um]?g\b', one.unit) for one in shown):
        definition += _UNIT_G
    parts = [paragraph(definition, 'note')]
    scales = [
        (
            'nominal scale factor of the gyros',
            _nominal_scale(imu.gyro.scale_factor, imu.units, 'g'),
        ),
        ('of the accelerometers', _nominal_scale(imu.accel.scale_factor, imu.units, 'a')),
    ]
    parts.append(named_rows(scales))
    limits = any(r.limit is not None for r in certificate.results)
    verdicts = certificate.conformity is not None
    headings = ['', 'measurand', 'value', 'u', '\u03bd', 'k', 'U', 'unit']
    columns = 'llrrrrrl'
    if limits:
        headings, columns = [*headings, 'limit'], columns + 'r'
    if verdicts:
        headings, columns = [*headings, 'conformity'], columns + 'l'
    for title, results in groups(certificate.results):
        rows = [
            _row(r, limits=limits, verdicts=verdicts, by_hand=calibration.by_hand) for r in results
        ]
        parts.append(tag('h3', title) + table(headings, rows, 'numbers stacked', columns))
    parts.append(paragraph(_UNCERTAINTY.format(file=certificate.file), 'note'))
    return parts


def _nominal_scale(value: float, units: Units, triad: str) -> str:
    if units is Units.SI:
        return '1: the output is in SI units'
    per = OUTPUT[units]
    if triad == 'g':
        shown, unit = value / ARCSEC, 'arcsec' if units.per_interval else 'arcsec/s'
    else:
        shown, unit = value, 'm/s' if units.per_interval else 'm/s\u00b2'
    return f'{shown:.10g} {unit} per {per}'


def _row(result: Stated, *, limits: bool, verdicts: bool, by_hand: bool) -> list[str]:
    shown = engineering(result.parameter, by_hand=by_hand)
    amounts = (result.value, result.expanded, result.std)
    value, expanded, std = rounded(*(amount / shown.scale for amount in amounts))
    cells = [
        tag('b', result.parameter.name),
        f'{result.parameter.kind.value.words}',
        minus(value),
        std,
        escape(freedom_words(result.freedom).replace('inf', '\u221e')),
        f'{result.factor:.2f}',
        expanded,
        escape(shown.symbol),
    ]
    if limits:
        cells.append('-' if result.limit is None else f'\u00b1{result.limit / shown.scale:g}')
    if verdicts:
        cells.append('-' if result.conformity is None else result.conformity.words)
    return cells


def _conformity(certificate: Certificate) -> str:
    fields, worst = certificate.fields, certificate.conformity
    if fields.conformity.rule is None:
        return section(
            'Conformity', paragraph('No statement of conformity was requested, and none is made.')
        )
    if worst is None:
        return section('Conformity', paragraph(_MISSING, 'missing'))
    counted = _counted(certificate.results)
    return section(
        'Conformity',
        paragraph(f'Requirement: {_or_dash(fields.conformity.requirement)}.'),
        paragraph(f'Decision rule: {certificate.rule}'),
        paragraph(f'Statement: {worst.words}. {counted}'),
        kind='whole',
    )


def _counted(results: Sequence[Stated]) -> str:
    found = [r.conformity for r in results if r.conformity is not None]
    words = [
        f'{found.count(kind)} of {len(found)} parameters: {kind.words}'
        for kind in dict.fromkeys(found)
    ]
    without = len(results) - len(found)
    rest = f'; {without} have no limit, and nothing is stated of them' if without else ''
    return f'{"; ".join(words)}{rest}.'


def _signatures(certificate: Certificate) -> str:
    boxes = [
        tag('div', tag('b', escape(_or_dash(s.name))) + tag('br') + escape(_or_dash(s.role)))
        for s in certificate.fields.signatures
    ]
    inside = ''.join(boxes) or tag('div', _MISSING, class_='missing')
    issued = paragraph(f'Issued on {_or_dash(certificate.fields.issued)}, authorized by:')
    return section('Authorization', issued + tag('div', inside, class_='signatures'))


_BROWSERS = ('chromium', 'chromium-browser', 'google-chrome', 'chrome')
_OLDEST = 131
"""First version of Chromium that prints the margin boxes of @page."""
_PATIENCE = 300.0
"""s: a page takes a second or two; a machine may be very busy."""


def pdf(html: str) -> bytes:
    """Print a page.

    Raises:
        InputError: No printing software is installed, or it failed; the text states the remedy.
    """
    by_weasyprint = _weasyprint()
    if by_weasyprint is not None:
        return by_weasyprint(html)
    browser = next(filter(None, map(shutil.which, _BROWSERS)), None)
    if browser is None:
        raise InputError(
            'A PDF needs WeasyPrint or Chromium, and neither is installed. Run '
            f"{sys.executable} -m pip install '.[pdf]' in a clone of imu_calib, or write "
            'the .html and print it from a browser.'
        )
    return _by_chromium(html, browser)


def _weasyprint() -> Callable[[str], bytes] | None:
    """Return a function that prints by WeasyPrint; None if it, or a system library, is missing."""
    if find_spec('weasyprint') is None:
        return None
    try:
        from weasyprint import HTML
    except OSError:
        return None
    return lambda html: bytes(HTML(string=html).write_pdf())


def _by_chromium(html: str, browser: str) -> bytes:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        page, target = folder / 'page.html', folder / 'page.pdf'
        page.write_text(html, encoding='utf-8')
        _run([browser, '--version'], oldest=True)
        _run(
            [
                browser,
                '--headless',
                # As root Chromium has no sandbox; the page has no script and loads nothing.
                *(['--no-sandbox'] if os.geteuid() == 0 else []),
                '--disable-gpu',
                '--no-first-run',
                '--disable-background-networking',
                f'--user-data-dir={folder / "profile"}',
                '--no-pdf-header-footer',
                f'--print-to-pdf={target}',
                page.as_uri(),
            ]
        )
        try:
            return target.read_bytes()
        except OSError as error:
            raise InputError(f'{browser} printed no PDF ({error.strerror}).') from None


def _run(command: list[str], *, oldest: bool = False) -> None:
    """Run a browser."""
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=_PATIENCE, check=True
        )
    except (OSError, subprocess.SubprocessError) as error:
        raise InputError(f'{command[0]} printed no PDF ({error}).') from None
    found = re.search(r'(\d+)\.\d+', done.stdout)
    if oldest and found and int(found[1]) < _OLDEST:
        raise InputError(
            f'{command[0]} is version {found[1]}, which does not number pages; expected '
            f'{_OLDEST} or newer, or WeasyPrint (pip install weasyprint).'
        )
