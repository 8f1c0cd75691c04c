"""The terms of a calibration for the report: on, off, and upper limits of those that are off."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape

from ..calibration import Calibration
from ..model import TERMS, Parameter, by_name
from ..model.session_terms import SESSION_TERMS, Change, Course, largest, session_term
from ..units import significant
from .html import paragraph, table

_NOTE = (
    'A term that is "off" was tested and is not significant: a single coefficient of the stated '
    'size would have been found nine times in ten. A term that the session does not show may still '
    'be present: the parameter that it would bias is stated.'
)


def terms_section(calibration: Calibration) -> tuple[str, ...]:
    """Return the section's contents; empty for a calibration without entries on terms."""
    tests = calibration.provenance.get('tests_of_terms')
    if not isinstance(tests, Mapping):
        return ()
    known = {term.name: term for term in TERMS}
    rows = []
    for name, test in tests.items():
        term = known.get(name)
        words = 'error of the table' if term is None else term.kind.value.words
        changes: tuple[Change, ...] = ()
        if name in SESSION_TERMS:
            words, changes = Course(name).words, session_term(str(name))
        parameters = () if term is None else term.parameters
        rows.append(
            [
                escape(str(name)),
                escape(words),
                escape(str(test.get('state', '-'))),
                _chance(test.get('log10_p')),
                _smallest(parameters, changes, test.get('found_from')),
                _moved(parameters, changes, test.get('would_move')),
            ]
        )
    headings = ['', 'kind', 'state', 'chance', 'found from', 'would move']
    return table(headings, rows, 'terms stacked', 'lllrll'), paragraph(_NOTE, 'note')


def _chance(log10_p: object) -> str:
    if not isinstance(log10_p, (int, float)):
        return '-'
    return f'{10**log10_p:.2g}' if log10_p > -3 else f'10<sup>{log10_p:.0f}</sup>'


def _smallest(
    parameters: tuple[Parameter, ...], changes: tuple[Change, ...], found_from: object
) -> str:
    """Return the largest coefficient among the detection limits."""
    if changes and isinstance(found_from, list) and len(found_from) == len(changes):
        return escape(largest(changes, found_from)) or 'not shown'
    if not parameters or not isinstance(found_from, list):
        return '-'
    seen = [v for v in found_from if isinstance(v, (int, float))]
    unit = parameters[0].unit
    return escape(f'{significant(max(seen) / unit.scale)} {unit.shown}') if seen else 'not shown'


def _moved(parameters: tuple[Parameter, ...], changes: tuple[Change, ...], moved: object) -> str:
    """Return the effect of the most important coefficient on a parameter, per unit."""
    if not isinstance(moved, Mapping) or not moved:
        return '-'
    coefficient, entry = max(moved.items(), key=lambda pair: abs(pair[1]['by']))
    other = by_name([entry['parameter']])[0]
    by = abs(entry['by']) / other.unit.scale
    for one in changes:
        if one.name == coefficient:
            words, scale = one.course.shown_per
            by *= one.unit.scale * scale
            return escape(
                f'{other.name}: {significant(by)} {other.unit.shown} for 1 {one.unit.shown}{words}'
            )
    unit = next(p.unit for p in parameters if p.name == coefficient)
    by *= unit.scale
    return escape(f'{other.name}: {significant(by)} {other.unit.shown} for 1 {unit.shown}')
