"""Calibrations of several units side by side: a column for each unit."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from rich.table import Table

from ..calibration.calibration import Calibration
from ..common.units import ARCSEC, DEG
from ..estimation.common_unknowns import TableEstimate
from ..model.parameters import Parameter
from .parameter_table import decimals, engineering
from .plain_table import plain_table

_COARSE = 60 * ARCSEC
"""Standard deviation from which an angle is shown in degrees."""
_ANY = 90 * DEG
"""Prior standard deviation of an unknown heading."""
_AT_ONCE = 8
"""Units of one table: with the parameters' names they are 110 characters wide, half a screen."""


def comparison_tables(units: Sequence[tuple[str, Calibration]]) -> Iterator[Table]:
    """Yield tables of all parameters that any unit has, with eight units in each.

    Args:
        units: Serial numbers with calibrations.
    """
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
        places = decimals(std / size)
        before = 'any' if prior > _ANY else f'{prior / size:.3g}'
        table.add_row(name, f'{value / size:.{places}f}', f'{std / size:.{places}f}', before, unit)
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
    value, std = (x / engineering(parameter).scale for x in found)
    places = decimals(std)
    return f'{value:.{places}f}\u00b1{std:.{places}f}'
