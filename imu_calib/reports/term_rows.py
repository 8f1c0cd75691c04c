"""The tests of terms as rows of text, for the terminal and the report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ..calibration.calibration import Calibration
from ..common.units import significant
from ..model.parameters import Parameter
from ..model.sensors import by_name
from ..model.session_terms import Change, largest
from ..model.terms import coefficients_of

TERM_HEADINGS = ('term', 'kind', 'state', 'chance', 'found from', 'would move')

TERM_NOTE = (
    'Kind: what the term is an error of. State: terms "asked for" and "found" are estimated; one '
    'that is "off" was tested and is not significant; "likely" is the probability of a small one '
    'for which the standard deviations allow. Chance: how often a session without the term would '
    'look like this one. Found from: a coefficient of this size would have been found nine times '
    'in ten. Would move: what a smaller one, if it exists, does to the parameter it moves most.'
)
"""Explanation of the columns, in their order."""


def term_rows(calibration: Calibration) -> list[list[str]]:
    """Return a row of cells for each term that was tested; none without entries on terms."""
    rows = []
    for name, test in (calibration.provenance.get('tests_of_terms') or {}).items():
        coefficients = coefficients_of(name)
        rows.append(
            [
                name,
                _kind(coefficients),
                _state(test),
                _chance(test.get('log10_p')),
                _smallest(coefficients, test.get('found_from')),
                _moved(coefficients, test.get('would_move')),
            ]
        )
    return rows


def _kind(coefficients: Sequence[Parameter | Change]) -> str:
    if not coefficients:
        return 'error of the table'
    first = coefficients[0]
    return first.course.words if isinstance(first, Change) else first.kind.value.words


def _state(test: Mapping[str, Any]) -> str:
    """Return the state of a term, with the probability for which the deviations allow."""
    probability = test.get('probability')
    return test['state'] if probability is None else f'{test["state"]} ({probability:.2g} likely)'


def _unit(coefficient: Parameter | Change) -> tuple[str, float]:
    """Return the unit in which a coefficient is shown, and its SI value."""
    unit = coefficient.unit
    if not isinstance(coefficient, Change):
        return unit.shown, unit.scale
    words, scale = coefficient.course.shown_per
    return f'{unit.shown}{words}', unit.scale * scale


def _chance(log10_p: float | None) -> str:
    if log10_p is None:
        return '-'
    return f'{10**log10_p:.2g}' if log10_p > -3 else f'1e{log10_p:.0f}'


def _smallest(
    coefficients: Sequence[Parameter | Change], found_from: Sequence[float | None] | None
) -> str:
    """Return the largest coefficient among the detection limits."""
    if not coefficients or found_from is None:
        return '-'
    changes = [one for one in coefficients if isinstance(one, Change)]
    if changes:
        return largest(changes, found_from) or 'not shown'
    seen = [value for value in found_from if value is not None]
    unit, scale = _unit(coefficients[0])
    return f'{significant(max(seen) / scale)} {unit}' if seen else 'not shown'


def _moved(
    coefficients: Sequence[Parameter | Change], moved: Mapping[str, Mapping[str, Any]] | None
) -> str:
    """Return the effect of the most important coefficient on a parameter, per unit."""
    if not coefficients or not moved:
        return '-'
    name, entry = max(moved.items(), key=lambda pair: abs(pair[1]['by']))
    other = by_name([entry['parameter']])[0]
    unit, scale = _unit(next(one for one in coefficients if one.name == name))
    by = abs(entry['by']) * scale / other.unit.scale
    return f'{other.name}: {significant(by)} {other.unit.shown} for 1 {unit}'
