"""The parameters in engineering units, and the tests of terms, as tables on the screen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rich.table import Table

from ..calibration.calibration import Calibration
from ..common.stream import at
from ..common.units import DEG, rounded, significant
from ..model.alignment import SCALE, SHOWN
from ..model.parameters import Parameter, Shown, engineering
from ..model.sensors import by_name
from ..model.session_terms import Change, largest
from ..model.terms import coefficients_of
from .plain_table import plain_table


def fixed(value: float, places: int) -> str:
    """Return a number with some decimals, for a page; zero without a sign."""
    return minus(f'{round(value, places) + 0.0:.{places}f}')


def minus(number: str) -> str:
    """Return a number for a page: with a minus sign, not a hyphen."""
    return number.replace('-', '\u2212')


def three_digits(value: float) -> str:
    """Return a number with three significant digits, large ones as integers.

    Examples:
        >>> three_digits(0.012345), three_digits(2231.7)
        ('0.0123', '2232')
    """
    return f'{value:.0f}' if abs(value) >= 1000 else f'{value:.3g}'


CHANGE_HEADINGS = ('term', 'of', 'value', 'std', 'unit')


def change_rows(calibration: Calibration) -> list[list[str]]:
    """Return the estimated terms of the session as rows; none without requested terms."""
    rows = []
    changes, by_hand = calibration.changes, calibration.by_hand
    for term, name, value, std, unit in changes.shown(by_hand=by_hand) if changes else ():
        rows.append([term, name, *rounded(value, std), unit])
    return rows


def change_note(calibration: Calibration) -> str:
    """Return a sentence on the state of the parameters and the use of the coefficients."""
    changes = calibration.changes
    if changes is None:
        return ''
    if changes.follows_temperature:
        mean = calibration.provenance['temperature']['mean']
        return (
            f'K, E and D are those of {mean:.2f} degC, the mean of the session; compensation adds '
            'what follows the temperature, within the range of the session.'
        )
    fading = ''
    if np.isfinite(changes.time_constant):
        fading = f' The warm-up fades with {changes.time_constant:.0f} s.'
    if np.isfinite(changes.instant):
        fading = f' The step is at {at(round(changes.instant * 1e9))}.'
    return (
        'K, E and D are those of the mean over the session. Their course during the session is not '
        f'part of the compensation.{fading}'
    )


def parameter_table(calibration: Calibration, truth: Calibration | None = None) -> Table:
    """Return the estimated parameters: value, standard deviation, unit.

    Those that are zero by the choice of the axes have no row. The truth of a simulation adds the
    errors in standard deviations.
    """
    table = _headed('parameter', against_truth=truth is not None)
    parameters, deviations = calibration.parameters, calibration.std
    values = calibration.values
    true_values = truth.model.values(parameters) if truth is not None else values
    for k, parameter in enumerate(parameters):
        if not np.isfinite(deviations[k]) or values[k] == deviations[k] == 0:
            continue
        shown = engineering(parameter, by_hand=calibration.by_hand)
        true = None if truth is None else true_values[k] / shown.scale
        value, deviation = values[k] / shown.scale, deviations[k] / shown.scale
        table.add_row(parameter.name, *_cells(value, deviation, shown.unit, true))
    return table


def _headed(first: str, *, against_truth: bool) -> Table:
    """Return a table of values whose rows begin with a name."""
    headings = (first, 'value', 'std', 'unit', *(['truth', 'error/std'] * against_truth))
    return plain_table(headings, 'lrrlrr'[: len(headings)])


def _cells(value: float, deviation: float, unit: str, true: float | None) -> list[str]:
    """Return the cells after the name in such a table, in display units."""
    cells = [*rounded(value, deviation), unit]
    if true is not None:
        ratio = f'{(value - true) / deviation:+.2f}' if deviation > 0 else '-'
        cells += [rounded(true, deviation)[0], ratio]
    return cells


FREE_OF_FRAME = (
    'xy: 90 deg less the angle between the input axes x and y. X: rotation of the gyros about X '
    "against the accelerometers. These do not depend on the table's axes."
)
"""Explanation of `angle_table`."""


def angle_unit(calibration: Calibration) -> Shown:
    """Return the unit of the angles between input axes."""
    return Shown('deg', DEG) if calibration.by_hand else Shown(SHOWN, SCALE)


def angle_table(calibration: Calibration, truth: Calibration | None = None) -> Table:
    """Return the angles between input axes: value, standard deviation, unit."""
    table = _headed('free of frame', against_truth=truth is not None)
    unit = angle_unit(calibration)
    true = {} if truth is None else {a.group: a.values for a in truth.free_of_frame}
    for angles in calibration.free_of_frame:
        known = true.get(angles.group, angles.values)
        rows = zip(angles.group.names, angles.values, angles.std, known, strict=True)
        for name, value, std, right in rows:
            there = None if truth is None else right / unit.scale
            cells = _cells(value / unit.scale, std / unit.scale, unit.unit, there)
            table.add_row(f'{angles.group.words} {name}', *cells)
    return table


# The tests of terms as rows of text, for the terminal and the report.

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
                _smallest(coefficients, test.get('found_from'), calibration.by_hand),
                _moved(coefficients, test.get('would_move'), calibration.by_hand),
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


def _chance(log10_p: float | None) -> str:
    if log10_p is None:
        return '-'
    return f'{10**log10_p:.2g}' if log10_p > -3 else f'1e{log10_p:.0f}'


def _smallest(
    coefficients: Sequence[Parameter | Change],
    found_from: Sequence[float | None] | None,
    by_hand: bool,
) -> str:
    """Return the largest coefficient among the detection limits."""
    if not coefficients or found_from is None:
        return '-'
    changes = [one for one in coefficients if isinstance(one, Change)]
    if changes:
        return largest(changes, found_from, by_hand=by_hand) or 'not shown'
    seen = [value for value in found_from if value is not None]
    of = coefficients[0].unit.engineering(by_hand=by_hand)
    return f'{significant(max(seen) / of.scale)} {of.unit}' if seen else 'not shown'


def _moved(
    coefficients: Sequence[Parameter | Change],
    moved: Mapping[str, Mapping[str, Any]] | None,
    by_hand: bool,
) -> str:
    """Return the effect of the most important coefficient on a parameter, per unit."""
    if not coefficients or not moved:
        return '-'
    name, entry = max(moved.items(), key=lambda pair: abs(pair[1]['by']))
    other = by_name([entry['parameter']])[0]
    (one,) = (one for one in coefficients if one.name == name)
    of = (one if isinstance(one, Change) else one.unit).engineering(by_hand=by_hand)
    there = engineering(other, by_hand=by_hand)
    by = abs(entry['by']) * of.scale / there.scale
    return f'{other.name}: {significant(by)} {there.unit} for 1 {of.unit}'
