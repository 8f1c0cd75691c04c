"""Calibrations of one unit side by side, in the form of Cao 2022's Table 1."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from rich.table import Table

from ..agreement import Agreement, agreement
from ..calibration import Calibration
from ..errors import InputError
from ..model import AXES, PARAMETERS, Parameter, ParameterKind
from ..model.motion import OF_MOTION
from ..plain_table import plain_table
from ..stream import Floats
from ..units import ARCSEC, PPM, STANDARD_GRAVITY
from .parameter_table import Shown, decimals, engineering, section_of

_MORE = 2
"""Most further decimals for a difference: a hundredth of the last digit is nothing."""


@dataclass(frozen=True, eq=False)
class SideBySide:
    """Calibrations converted to the nominal scale factors of the first.

    Attributes:
        calibrations: k of them.
        parameters: The n that all of them estimated.
        only: For each the names of its parameters that others lack.
        agreement: Which of `parameters` differ by more than the covariances explain.
        std: (k - 1, n) standard deviations of the differences from the first, SI units.
    """

    calibrations: tuple[Calibration, ...]
    parameters: tuple[Parameter, ...]
    only: tuple[tuple[str, ...], ...]
    agreement: Agreement
    std: Floats


def side_by_side(calibrations: Sequence[Calibration]) -> SideBySide:
    """Compare two or more calibrations.

    Raises:
        InputError: Their streams have different units.
    """
    first = calibrations[0]
    in_scale = (first, *(in_scale_of(one, first) for one in calibrations[1:]))
    known = [
        {p for p, s in zip(c.parameters, c.std, strict=True) if np.isfinite(s)} for c in in_scale
    ]
    common = set.intersection(*known)
    parameters = tuple(p for p in first.parameters if p in common)
    only = tuple(
        tuple(p.name for p in c.parameters if p in mine - common)
        for c, mine in zip(in_scale, known, strict=True)
    )
    return SideBySide(in_scale, parameters, only, *agreement(in_scale, parameters))


def comparison_table(compared: SideBySide, names: Sequence[str]) -> Table:
    """Return calibrations side by side, in the units and the order of Cao 2022's Table 1.

    That table gives K as a deviation of the scale factor, S - S0 = -S0 K / (1 + K), and names
    misalignments by the transpose of the matrix in its eqs. (1)-(2) (its E_AXY is the response of
    the Y channel to an input along X, eq. 18; that its gyro names follow suit is our reading). Both
    names are printed.

    Args:
        compared: The calibrations.
        names: Their names.
    """
    calibrations, found, std = compared.calibrations, compared.agreement, compared.std
    two = len(calibrations) == 2
    numbers = (*names, *(('difference', 'in std') if two else ('chi-square',)))
    sides = f'll{"r" * len(numbers)}ll'
    # Columns that do not fit into a line continue in the next: no number and no unit is cut.
    table = plain_table(('Table 1', 'here', *numbers, 'unit', ''), sides, no_wrap=True)
    differ = dict(zip(found.parameters, found.differ, strict=True))
    places = _places(compared)
    last = None
    for parameter in sorted(found.parameters, key=_table_order):
        if last is not None and section_of(parameter) != section_of(last):
            table.add_section()
        last = parameter
        k = found.parameters.index(parameter)
        shown, values = _as_table_1(parameter, calibrations)
        digits = places[_alike(parameter)]
        rest = [f'{found.chi_square[k]:.1f}' if found.freedom[k] else '-']
        if two:
            one, other = (float(c.model.values((parameter,))[0]) for c in calibrations)
            ratio = _signed((one - other) / std[0, k], 2) if std[0, k] > 0 else '-'
            rest = [_signed(values[0] - values[1], digits), ratio]
        table.add_row(
            _table_name(parameter),
            parameter.name,
            *(f'{v:.{digits}f}' for v in values),
            *rest,
            shown.unit,
            'differs' if differ[parameter] else '',
        )
    return table


def _signed(value: float, digits: int) -> str:
    """Return a number with its sign; zero has none."""
    text = f'{value:+.{digits}f}'
    return text if float(text) else f'{0:.{digits}f}'


def _alike(parameter: Parameter) -> tuple[object, ...]:
    """Return the key of the rows that have the same decimals: their points are in one column."""
    return *section_of(parameter), parameter.kind


def _places(compared: SideBySide) -> dict[tuple[object, ...], int]:
    """Return the decimals of rows: two of the deviation, and one of the difference of two."""
    places: dict[tuple[object, ...], int] = {}
    for k, parameter in enumerate(compared.parameters):
        shown, values = _as_table_1(parameter, compared.calibrations)
        own = _table_decimals(parameter, shown, float(np.min(compared.std[:, k])))
        if len(values) == 2 and (apart := abs(values[0] - values[1])):
            first = int(np.ceil(-np.log10(apart)))
            own = max(own, min(first, own + _MORE))
        places[_alike(parameter)] = max(own, places.get(_alike(parameter), 0))
    return places


def agreement_lines(found: Agreement, count: int) -> list[str]:
    """Return sentences on significant differences of calibrations, with the rule.

    Args:
        found: Their agreement.
        count: Number of calibrations.
    """
    if not found.total_freedom:
        return ['None of them states standard deviations: significance cannot be tested.']
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
    """Return a calibration converted to the nominal scale factors of another.

    With twice the nominal scale factor the same unit has twice the response: I + M, bias and the
    coefficients of terms double.

    Raises:
        InputError: The streams have different units.
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
    # A scale factor error is the response minus one.
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
    """Return the factor of a parameter when its triad's nominal scale factor changes.

    Positions and delays are lengths and times, independent of the units of outputs.
    """
    if parameter.kind in OF_MOTION:
        return 1.0
    return askew if parameter.row >= len(AXES) else triads[parameter.triad]


def _table_name(parameter: Parameter) -> str:
    """Return the name of a parameter in Table 1, which has only the 24."""
    if parameter not in PARAMETERS:
        return '-'
    name = parameter.name.upper()
    if parameter.kind is ParameterKind.MISALIGNMENT:
        return name[:-2] + name[-1] + name[-2]
    return name


def _table_order(parameter: Parameter) -> tuple[bool, bool, int, str]:
    """Return a key that sorts the 24 as in Table 1, and then the others in their order."""
    if parameter not in PARAMETERS:
        return True, False, 0, ''
    kinds = [ParameterKind.SCALE_FACTOR_ERROR, ParameterKind.MISALIGNMENT, ParameterKind.BIAS]
    return False, parameter.triad != 'g', kinds.index(parameter.kind), _table_name(parameter)


def _as_table_1(
    parameter: Parameter, calibrations: Sequence[Calibration]
) -> tuple[Shown, list[float]]:
    """Return the display of a parameter, and its values; a deviation has the same scale."""
    values = [float(c.model.values((parameter,))[0]) for c in calibrations]
    shown = engineering(parameter)
    if parameter not in PARAMETERS:
        return shown, [v / shown.scale for v in values]
    if parameter.kind is not ParameterKind.SCALE_FACTOR_ERROR:
        if shown.unit == 'ug':
            shown = Shown('g', STANDARD_GRAVITY)
        return shown, [v / shown.scale for v in values]
    imu = calibrations[0].imu
    if not imu.units.per_interval:
        return Shown('ppm', PPM), [v / PPM for v in values]
    gyro = parameter.triad == 'g'
    nominal = imu.gyro.scale_factor if gyro else imu.accel.scale_factor
    unit = Shown('arcsec/p', ARCSEC / nominal) if gyro else Shown('(m/s)/p', 1 / nominal)
    return unit, [-v / (1 + v) / unit.scale for v in values]


def _table_decimals(parameter: Parameter, shown: Shown, std: float) -> int:
    """Return the decimals by the deviation, at least two more than in the paper."""
    if parameter not in PARAMETERS:
        return decimals(std / shown.scale)
    printed = {'arcsec/p': 3, '(m/s)/p': 4, 'ppm': 0, 'arcmin': 2, 'deg/h': 2, 'g': 4}
    least = printed[shown.unit] + 2
    return max(least, decimals(std / shown.scale)) if std > 0 else least
