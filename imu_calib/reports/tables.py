"""The parameters in engineering units, as tables on the screen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from rich.table import Table

from ..calibration.calibration import Calibration
from ..common.stream import at
from ..common.units import DEG, MICRO_G, decimals, typeset
from ..model.alignment import SCALE, SHOWN
from ..model.parameters import AXES, Parameter, ParameterKind
from ..model.terms import TERMS
from .plain_table import plain_table

_OF_TERMS = {term.kind for term in TERMS}


@dataclass(frozen=True)
class Shown:
    """Display of a parameter: its unit as text, and the unit's SI value."""

    unit: str
    scale: float

    @property
    def symbol(self) -> str:
        """The unit on a page."""
        return typeset(self.unit)


_BY_HAND = {
    (ParameterKind.SCALE_FACTOR_ERROR, 'g'): Shown('%', 0.01),
    (ParameterKind.SCALE_FACTOR_ERROR, 'a'): Shown('%', 0.01),
    (ParameterKind.MISALIGNMENT, 'g'): Shown('deg', DEG),
    (ParameterKind.MISALIGNMENT, 'a'): Shown('deg', DEG),
    (ParameterKind.BIAS, 'g'): Shown('deg/s', DEG),
    (ParameterKind.BIAS, 'a'): Shown('mg', 1e3 * MICRO_G),
}
"""Units of the grade of the units that are calibrated in the hand."""


def engineering(parameter: Parameter, *, by_hand: bool = False) -> Shown:
    """Return the unit that engineers use for a parameter, on a table or of a unit in the hand."""
    own = Shown(parameter.unit.shown, parameter.unit.scale)
    return _BY_HAND.get((parameter.kind, parameter.triad), own) if by_hand else own


def fixed(value: float, places: int) -> str:
    """Return a number with some decimals, for a page: with a minus sign, not a hyphen."""
    return f'{value:.{places}f}'.replace('-', '\u2212')


def three_digits(value: float) -> str:
    """Return a number with three significant digits, large ones as integers.

    Examples:
        >>> three_digits(0.012345), three_digits(2231.7)
        ('0.0123', '2232')
    """
    return f'{value:.0f}' if abs(value) >= 1000 else f'{value:.3g}'


def change_table(calibration: Calibration) -> Table | None:
    """Return the estimated terms of the session; None without requested terms."""
    if calibration.changes is None:
        return None
    table = plain_table(('term', 'of', 'value', 'std', 'unit'), 'llrrl')
    for term, name, value, deviation, unit in calibration.changes.shown():
        places = decimals(deviation)
        table.add_row(term, name, f'{value:.{places}f}', f'{deviation:.{places}f}', unit)
    return table


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
    last = parameters[0]
    for k, parameter in enumerate(parameters):
        if not np.isfinite(deviations[k]) or values[k] == deviations[k] == 0:
            continue
        if section_of(parameter) != section_of(last):
            table.add_section()
        last = parameter
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
    places = decimals(deviation)
    cells = [f'{value:.{places}f}', f'{deviation:.{places}f}', unit]
    if true is not None:
        ratio = f'{(value - true) / deviation:+.2f}' if deviation > 0 else '-'
        cells += [f'{true:.{places}f}', ratio]
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
        table.add_section()
    return table


def section_of(parameter: Parameter) -> tuple[object, ...]:
    """Return the key that parameters of one section of a table have in common."""
    kind = parameter.kind if parameter.kind in _OF_TERMS else None
    return parameter.triad, parameter.row >= len(AXES), kind
