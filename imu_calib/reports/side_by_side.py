"""Calibrations side by side: of several units, and of one unit with significant differences."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from rich.table import Table

from ..calibration.agreement import Agreement, agreement
from ..calibration.calibration import Calibration
from ..common.errors import InputError
from ..common.stream import Floats
from ..common.units import ARCSEC, DEG, decimals, rounded
from ..estimation.common_unknowns import TableEstimate
from ..model.parameters import AXES, Parameter, ParameterKind, engineering, indices_of
from ..model.sensors import OF_MOTION
from ..session.imu import COVERAGE
from .plain_table import plain_table

_COARSE = 60 * ARCSEC
"""Standard deviation from which an angle is shown in degrees."""
_ANY = 90 * DEG
"""Prior standard deviation of an unknown heading."""
_AT_ONCE = 8
"""Units of one table: with the parameters' names they are 110 characters wide, half a screen."""


def comparison_tables(units: Sequence[tuple[str, Calibration]]) -> Iterator[Table]:
    """Yield tables of all parameters that any unit has, with eight serial numbers in each."""
    parameters: list[Parameter] = []
    for _, calibration in units:
        parameters += [p for p in calibration.parameters if p not in parameters]
    for first in range(0, len(units), _AT_ONCE):
        yield _table(units[first : first + _AT_ONCE], parameters)


def table_estimate(seen: TableEstimate) -> Table:
    """Return the table errors estimated from several units, with their prior values."""
    table = plain_table(('unknown', 'value', 'std', 'beforehand', 'unit'), 'lrrrl')
    for name, value, std, prior in zip(seen.names, seen.values, seen.std, seen.prior, strict=True):
        unit, size = ('deg', DEG) if std > _COARSE else ('arcsec', ARCSEC)
        before = 'any' if prior > _ANY else f'{prior / size:.3g}'
        table.add_row(name, *rounded(value / size, std / size), before, unit)
    return table


def _table(units: Sequence[tuple[str, Calibration]], parameters: Sequence[Parameter]) -> Table:
    serials = [serial for serial, _ in units]
    table = plain_table(['parameter', *serials, 'unit'], f'l{"r" * len(serials)}l')
    known = [
        {
            p: (float(value), float(std))
            for p, value, std in zip(c.parameters, c.values, c.std, strict=True)
        }
        for _, c in units
    ]
    for parameter in parameters:
        cells = [_cell(parameter, of.get(parameter)) for of in known]
        if any(cells):
            table.add_row(parameter.name, *cells, engineering(parameter).unit)
    return table


def _cell(parameter: Parameter, found: tuple[float, float] | None) -> str:
    """Return value and standard deviation in engineering units; empty without a value."""
    if found is None or not np.isfinite(found[1]):
        return ''
    return '\u00b1'.join(rounded(*(x / engineering(parameter).scale for x in found)))


_MORE = 2
"""Most further decimals for a difference: a hundredth of the last digit is nothing."""


@dataclass(frozen=True, eq=False)
class SideBySide:
    """Calibrations converted to the nominal scale factors of the first."""

    calibrations: tuple[Calibration, ...]  #: k of them.
    parameters: tuple[Parameter, ...]  #: The n that all of them estimated.
    only: tuple[tuple[str, ...], ...]  #: For each the names of its parameters that others lack.
    agreement: Agreement  #: Which of `parameters` differ by more than the covariances explain.
    std: Floats  #: (k - 1, n) standard deviations of the differences from the first, SI units.

    @property
    def expanded(self) -> Floats:
        """Expanded uncertainties (k, n), 95 %: by the budgets, else twice the deviation."""
        rows = [indices_of(self.parameters, c.parameters) for c in self.calibrations]
        return np.array(
            [
                (COVERAGE * c.std if c.budget is None else c.budget.expanded)[mine]
                for c, mine in zip(self.calibrations, rows, strict=True)
            ]
        )

    @property
    def e_n(self) -> Floats:
        """E_n of the differences from the first, (k - 1, n); NaN where both are exact.

        The difference over its expanded uncertainty (ISO 13528:2022, 9.7), in which the common
        gravity of one place does not count, as in `std`.
        """
        values = np.array([c.model.values(self.parameters) for c in self.calibrations])
        stds = np.array(
            [c.std[indices_of(self.parameters, c.parameters)] for c in self.calibrations]
        )
        with np.errstate(invalid='ignore', divide='ignore'):
            own = np.hypot(self.expanded[0], self.expanded[1:]) / np.hypot(stds[0], stds[1:])
            return np.asarray((values[0] - values[1:]) / (own * self.std))

    @property
    def by_hand(self) -> bool:
        """Whether the first was made of a unit held by hand: its units are then shown."""
        return self.calibrations[0].by_hand


def side_by_side(calibrations: Sequence[Calibration]) -> SideBySide:
    """Compare two or more calibrations."""
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
    """Return calibrations side by side, with the names, units and order of `parameter_table`."""
    calibrations, found, std = compared.calibrations, compared.agreement, compared.std
    two = len(calibrations) == 2
    numbers = (*names, 'chi-square')
    if two:
        numbers = (names[0], 'U', names[1], 'U', 'difference', 'E_n')
    expanded, errors = compared.expanded, compared.e_n
    sides = f'l{"r" * len(numbers)}ll'
    # Columns that do not fit into a line continue in the next: no number and no unit is cut.
    table = plain_table(('parameter', *numbers, 'unit', ''), sides, no_wrap=True)
    places = _places(compared)
    for k, parameter in enumerate(found.parameters):
        shown = engineering(parameter, by_hand=compared.by_hand)
        values, digits = _shown(parameter, calibrations), places[_alike(parameter)]
        if not (any(values) or std[:, k].any()):
            # Zero by the choice of the axes: no row, as in `parameter_table`.
            continue
        cells = [f'{v:.{digits}f}' for v in values]
        if two:
            error = float(errors[0, k])
            around = [f'{u / shown.scale:.{digits}f}' for u in expanded[:, k]]
            cells = [
                cells[0],
                around[0],
                cells[1],
                around[1],
                _signed(values[0] - values[1], digits),
            ]
            cells.append(_signed(error, 2) if np.isfinite(error) else '-')
        else:
            cells.append(f'{found.chi_square[k]:.1f}' if found.freedom[k] else '-')
        table.add_row(
            parameter.name,
            *cells,
            shown.unit,
            'differs' if found.differ[k] else '',
        )
    return table


def _shown(parameter: Parameter, calibrations: Sequence[Calibration]) -> list[float]:
    """Return the values of a parameter in its unit for people."""
    scale = engineering(parameter, by_hand=calibrations[0].by_hand).scale
    return [float(c.model.values((parameter,))[0]) / scale for c in calibrations]


def _signed(value: float, digits: int) -> str:
    """Return a number with its sign; zero has none."""
    text = f'{value:+.{digits}f}'
    return text if float(text) else f'{0:.{digits}f}'


def _alike(parameter: Parameter) -> tuple[object, ...]:
    """Return the key of the rows that have the same decimals: their points are in one column."""
    return parameter.triad, parameter.row >= len(AXES), parameter.kind


def _places(compared: SideBySide) -> dict[tuple[object, ...], int]:
    """Return the decimals of rows: two of the deviation, and one of the difference of two."""
    places: dict[tuple[object, ...], int] = {}
    for k, parameter in enumerate(compared.parameters):
        values = _shown(parameter, compared.calibrations)
        shown = engineering(parameter, by_hand=compared.by_hand)
        own = decimals(float(np.min(compared.std[:, k])) / shown.scale)
        if len(values) == 2 and (apart := abs(values[0] - values[1])):
            first = int(np.ceil(-np.log10(apart)))
            own = max(own, min(first, own + _MORE))
        places[_alike(parameter)] = max(own, places.get(_alike(parameter), 0))
    return places


def agreement_lines(found: Agreement) -> list[str]:
    """Return sentences on significant differences, with the rule."""
    if not found.total_freedom:
        return ['None of them states standard deviations: significance cannot be tested.']
    every = (
        f'All parameters together: chi-square {found.total:.1f} with {found.total_freedom} degrees '
        f'of freedom, chance {found.total_chance:.2g}: '
        + ('they agree.' if found.consistent else 'they do not agree.')
    )
    marked = (
        f'Significantly different: {", ".join(found.names) or "none"}. Of a parameter it takes a '
        f'chance below 1 in {1 / found.limit:.0f}: of a hundred comparisons of equal units one has '
        'a false mark.'
    )
    return [marked, every]


def error_line(compared: SideBySide) -> str:
    """Return which parameters of two calibrations have |E_n| above 1, and what that means."""
    over = np.abs(compared.e_n[0]) > 1
    names = ', '.join(p.name for p, beyond in zip(compared.parameters, over, strict=True) if beyond)
    return (
        f'|E_n| above 1: {names or "none"}; by chance about one of twenty. E_n is the difference '
        'over its expanded uncertainty (95 %, ISO 13528), in which a common gravity cancels.'
    )


def in_scale_of(calibration: Calibration, other: Calibration) -> Calibration:
    """Return a calibration converted to the nominal scale factors of another.

    With twice the nominal scale factor the same unit has twice the response: I + M, bias and the
    coefficients of terms double. Errors of counts and of rates are those in SI units: they are the
    same if the rates were made with the nominal scale factors of the counts.
    """
    mine, its = calibration.imu, other.imu
    if mine.units is not its.units:
        if not (mine.units.per_interval or its.units.per_interval):
            return calibration
        raise InputError(
            f'Calibrations of {its.units.value} and of {mine.units.value} cannot be compared: '
            'with which sample interval one was made of the other is not known.'
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
