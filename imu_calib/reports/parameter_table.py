"""The parameters in the units that engineers write; every table of them is made here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from rich.table import Table

from ..agreement import Agreement
from ..alignment import SCALE, SHOWN
from ..calibration import Calibration
from ..errors import InputError
from ..model import AXES, PARAMETERS, TERMS, Parameter, ParameterKind
from ..stream import Floats, Units
from ..units import ARCSEC, PPM, STANDARD_GRAVITY

_OF_TERMS = {term.kind for term in TERMS}


@dataclass(frozen=True)
class Shown:
    """How a parameter is shown: its unit in words, and the unit's SI value."""

    unit: str
    scale: float


def engineering(parameter: Parameter) -> Shown:
    """Return the unit in which engineers write a parameter."""
    return Shown(parameter.unit.shown, parameter.unit.scale)


def decimals(deviation: float) -> int:
    """Return how many decimals show a standard deviation with two significant digits."""
    if not np.isfinite(deviation) or deviation <= 0:
        return 4
    return int(np.clip(1 - np.floor(np.log10(deviation)), 0, 9))


def three_digits(value: float) -> str:
    """Return a number with three significant digits, large ones whole.

    Examples:
        >>> three_digits(0.012345), three_digits(2231.7)
        ('0.0123', '2232')

    """
    return f'{value:.0f}' if abs(value) >= 1000 else f'{value:.3g}'


def change_table(calibration: Calibration) -> Table | None:
    """Return what terms of the session found; None where none were asked for."""
    if calibration.changes is None:
        return None
    table = Table(box=None, pad_edge=False, header_style='bold')
    for heading in ('term', 'of', 'value', 'std', 'unit'):
        table.add_column(heading, justify='right' if heading in {'value', 'std'} else 'left')
    for term, name, value, deviation, unit in calibration.changes.shown():
        places = decimals(deviation)
        table.add_row(term, name, f'{value:.{places}f}', f'{deviation:.{places}f}', unit)
    return table


def change_note(calibration: Calibration) -> str:
    """Say of which state the parameters are, and what becomes of the coefficients."""
    changes = calibration.changes
    if changes is None:
        return ''
    if changes.follows_temperature:
        mean = calibration.provenance['temperature']['mean']
        return (
            f'K, E and D are those of {mean:.2f} degC, the mean of the session; compensation adds '
            'what follows the temperature, as far as the session saw it.'
        )
    fading = ''
    if np.isfinite(changes.time_constant):
        fading = f' The warm-up fades with {changes.time_constant:.0f} s.'
    return (
        'K, E and D are those of the mean over the session. How they changed in it is past, and no '
        f'part of compensation.{fading}'
    )


def parameter_table(calibration: Calibration, truth: Calibration | None = None) -> Table:
    """Return the parameters that were estimated: value, standard deviation, unit.

    Args:
        calibration: What to show.
        truth: What a simulation was given; adds the error in standard deviations.

    """
    table = _headed('parameter', against_truth=truth is not None)
    parameters, deviations = calibration.parameters, calibration.std
    values = calibration.values
    true_values = truth.model.values(parameters) if truth is not None else values
    last = parameters[0]
    for k, parameter in enumerate(parameters):
        if not np.isfinite(deviations[k]):
            continue
        if _section(parameter) != _section(last):
            table.add_section()
        last = parameter
        shown = engineering(parameter)
        true = None if truth is None else true_values[k] / shown.scale
        value, deviation = values[k] / shown.scale, deviations[k] / shown.scale
        table.add_row(parameter.name, *_cells(value, deviation, shown.unit, true))
    return table


def _headed(first: str, *, against_truth: bool) -> Table:
    """Return a table of values whose rows begin with a name."""
    table = Table(box=None, pad_edge=False, header_style='bold')
    for heading in (first, 'value', 'std', 'unit', *(['truth', 'error/std'] * against_truth)):
        table.add_column(heading, justify='left' if heading in {first, 'unit'} else 'right')
    return table


def _cells(value: float, deviation: float, unit: str, true: float | None) -> list[str]:
    """Return what follows the name in such a table, in shown units."""
    places = decimals(deviation)
    cells = [f'{value:.{places}f}', f'{deviation:.{places}f}', unit]
    if true is not None:
        ratio = f'{(value - true) / deviation:+.2f}' if deviation > 0 else '-'
        cells += [f'{true:.{places}f}', ratio]
    return cells


FREE_OF_FRAME = (
    'xy: the input axes x and y are so much less than 90 deg apart. X: the gyros are turned so '
    "much about X against the accelerometers. The table's frame is in none of these."
)
"""What `angle_table` shows, for a person."""


def parameter_tables(
    calibration: Calibration, truth: Calibration | None = None
) -> list[Table | str]:
    """Return what a terminal shows of a calibration: its parameters, and its angles.

    Args:
        calibration: What to show.
        truth: What a simulation was given; adds the errors in standard deviations.

    """
    angles = angle_table(calibration, truth)
    return [parameter_table(calibration, truth), '', angles, FREE_OF_FRAME]


def angle_table(calibration: Calibration, truth: Calibration | None = None) -> Table:
    """Return the angles between input axes: value, standard deviation, unit.

    Args:
        calibration: What to show.
        truth: What a simulation was given; adds the error in standard deviations.

    """
    table = _headed('free of frame', against_truth=truth is not None)
    true = {} if truth is None else {a.group: a.values for a in truth.free_of_frame}
    for angles in calibration.free_of_frame:
        known = true.get(angles.group, angles.values)
        rows = zip(angles.group.names, angles.values, angles.std, known, strict=True)
        for name, value, std, right in rows:
            there = None if truth is None else right / SCALE
            cells = _cells(value / SCALE, std / SCALE, SHOWN, there)
            table.add_row(f'{angles.group.words} {name}', *cells)
        table.add_section()
    return table


def _section(parameter: Parameter) -> tuple[object, ...]:
    """Return what parameters of one section of a table have in common."""
    kind = parameter.kind if parameter.kind in _OF_TERMS else None
    return parameter.triad, parameter.row >= len(AXES), kind


def comparison_table(
    calibrations: Sequence[Calibration], names: Sequence[str], found: Agreement, std: Floats
) -> Table:
    """Return calibrations side by side, in the units and the order of Cao 2022's Table 1.

    That table gives K as a deviation of the scale factor, S - S0 = -S0 K / (1 + K), and names
    misalignments by the transpose of the matrix in its eqs. (1)-(2) (its E_AXY is the response of
    the Y channel to an input along X, eq. 18; that its gyro names follow suit is our reading). Both
    names are printed.

    Args:
        calibrations: With the nominal scale factors of the first.
        names: What to call them.
        found: Their agreement, which says of which parameters there are rows.
        std: Standard deviations of the differences from the first: (n,) of two, (k - 1, n) of more.

    """
    two = std.ndim == 1
    table = Table(box=None, pad_edge=False, header_style='bold')
    between = ('difference', 'in std') if two else ('chi-square',)
    for heading in ('Table 1', 'here', *names, *between, 'unit', ''):
        left = heading in {'Table 1', 'here', 'unit', ''}
        # What does not fit into a line goes on in the next: no number and no unit is cut.
        table.add_column(heading, justify='left' if left else 'right', no_wrap=True)
    differ = dict(zip(found.parameters, found.differ, strict=True))
    last = None
    for parameter in sorted(found.parameters, key=_table_order):
        if last is not None and _section(parameter) != _section(last):
            table.add_section()
        last = parameter
        k = found.parameters.index(parameter)
        shown, values = _as_table_1(parameter, calibrations)
        places = _table_decimals(parameter, shown, float(np.min(std[..., k])))
        rest = [f'{found.chi_square[k]:.1f}' if found.freedom[k] else '-']
        if two:
            one, other = (float(c.model.values((parameter,))[0]) for c in calibrations)
            ratio = f'{(one - other) / std[k]:+.1f}' if std[k] > 0 else '-'
            rest = [f'{values[0] - values[1]:+.{places}f}', ratio]
        table.add_row(
            _table_name(parameter),
            parameter.name,
            *(f'{v:.{places}f}' for v in values),
            *rest,
            shown.unit,
            'differs' if differ[parameter] else '',
        )
    return table


def agreement_lines(found: Agreement, count: int) -> list[str]:
    """Say what of some calibrations differs significantly, and by which rule.

    Args:
        found: Their agreement.
        count: How many there are.

    """
    if not found.total_freedom:
        return ['None of them states a deviation: nothing says which difference is significant.']
    rule = (
        f'A parameter differs where its chi-square ({count - 1} degree{"s" * (count > 2)} of '
        f'freedom) comes by chance less often than once in {1 / found.limit:.0f}: of a hundred '
        'comparisons of a unit that has not changed, one marks a parameter.'
    )
    every = (
        f'All parameters together: chi-square {found.total:.1f} with {found.total_freedom} degrees '
        f'of freedom, chance {found.total_chance:.2g}: '
        + ('they agree.' if found.consistent else 'they do not agree.')
    )
    names = ', '.join(found.names)
    return [f'Significantly different: {names or "none"}.', rule, every]


def in_scale_of(calibration: Calibration, other: Calibration) -> Calibration:
    """Return a calibration as it reads with the nominal scale factors of another.

    The same unit with twice the nominal scale factor answers twice as much: I + M, bias and the
    coefficients of terms double.

    Raises:
        InputError: The streams are not of the same units.

    """
    mine, its = calibration.imu, other.imu
    if mine.units is not its.units:
        raise InputError(
            f'Calibrations of {its.units.value} and of {mine.units.value} cannot be compared.'
        )
    gyro = its.gyro.scale_factor / mine.gyro.scale_factor
    accel = its.accel.scale_factor / mine.accel.scale_factor
    if gyro == accel == 1.0:
        return calibration
    askew = 1.0
    if calibration.model.skewed is not None:
        askew = (its.skewed or its.gyro).scale_factor / (mine.skewed or mine.gyro).scale_factor
    parameters = calibration.parameters
    factors = np.array([_factor_of(p, {'g': gyro, 'a': accel}, askew) for p in parameters])
    # A scale-factor error is what a response has beyond one.
    one = np.array([p.kind is ParameterKind.SCALE_FACTOR_ERROR for p in parameters])
    values = (one + calibration.values) * factors - one
    return replace(
        calibration,
        imu=replace(its, id=mine.id),
        model=calibration.model.with_values(parameters, values),
        covariance=calibration.covariance * np.outer(factors, factors),
        budget=None if calibration.budget is None else calibration.budget.scaled(factors),
    )


def _factor_of(parameter: Parameter, triads: Mapping[str, float], askew: float) -> float:
    return askew if parameter.row >= len(AXES) else triads[parameter.triad]


def unmatched(calibrations: Sequence[Calibration]) -> tuple[list[str], ...]:
    """Return for each calibration the names of what it has, and not all others."""
    known = [
        {p.name for p, s in zip(c.parameters, c.std, strict=True) if np.isfinite(s)}
        for c in calibrations
    ]
    common = set.intersection(*known)
    return tuple(
        [p.name for p in c.parameters if p.name in mine - common]
        for c, mine in zip(calibrations, known, strict=True)
    )


def _table_name(parameter: Parameter) -> str:
    """Return the name that Table 1 has for a parameter; it knows the 24 alone."""
    if parameter not in PARAMETERS:
        return '-'
    name = parameter.name.upper()
    if parameter.kind is ParameterKind.MISALIGNMENT:
        return name[:-2] + name[-1] + name[-2]
    return name


def _table_order(parameter: Parameter) -> tuple[bool, bool, int, str]:
    """Return what sorts the 24 as Table 1 does, and leaves the others in their order behind."""
    if parameter not in PARAMETERS:
        return True, False, 0, ''
    kinds = [ParameterKind.SCALE_FACTOR_ERROR, ParameterKind.MISALIGNMENT, ParameterKind.BIAS]
    return False, parameter.triad != 'g', kinds.index(parameter.kind), _table_name(parameter)


def _as_table_1(
    parameter: Parameter, calibrations: Sequence[Calibration]
) -> tuple[Shown, list[float]]:
    """Return how a parameter is shown, and its values; a deviation has the same scale."""
    values = [float(c.model.values((parameter,))[0]) for c in calibrations]
    shown = engineering(parameter)
    if parameter not in PARAMETERS:
        return shown, [v / shown.scale for v in values]
    if parameter.kind is not ParameterKind.SCALE_FACTOR_ERROR:
        if shown.unit == 'ug':
            shown = Shown('g', STANDARD_GRAVITY)
        return shown, [v / shown.scale for v in values]
    imu = calibrations[0].imu
    if imu.units is not Units.PULSES:
        return Shown('ppm', PPM), [v / PPM for v in values]
    gyro = parameter.triad == 'g'
    nominal = imu.gyro.scale_factor if gyro else imu.accel.scale_factor
    unit = Shown('arcsec/p', ARCSEC / nominal) if gyro else Shown('(m/s)/p', 1 / nominal)
    return unit, [-v / (1 + v) / unit.scale for v in values]


def _table_decimals(parameter: Parameter, shown: Shown, std: float) -> int:
    """Return as many as a deviation says, and two more than the paper prints at least."""
    if parameter not in PARAMETERS:
        return decimals(std / shown.scale)
    printed = {'arcsec/p': 3, '(m/s)/p': 4, 'ppm': 0, 'arcmin': 2, 'deg/h': 2, 'g': 4}
    least = printed[shown.unit] + 2
    return max(least, decimals(std / shown.scale)) if std > 0 else least
