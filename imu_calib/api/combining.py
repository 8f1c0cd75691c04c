"""Combine calibrations of one unit at several temperatures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from ..calibration.calibration import Calibration
from ..calibration.thermal import ThermalCalibration
from ..calibration.thermal import combine as of_temperatures
from ..common.config import checked
from .named import Named, as_calibration, as_list, name_of

if TYPE_CHECKING:
    from ..calibration.results import Result


@checked
def combine(
    calibrations: Result | Calibration | Named | Sequence[Result | Calibration | Named],
    output: Named | None = None,
    *,
    order: int | None = None,
) -> ThermalCalibration:
    """Combine calibrations of one unit at several temperatures.

    Args:
        calibrations: Two or more, in any order: files, calibrations, or results of `calibrate`.
        output: File to write, or None.
        order: Degree of a polynomial in temperature; None for straight lines between neighbours.

    Returns:
        The calibration for `compensate` and compensator_node: `at(celsius)` is the calibration at a
        temperature.

    Raises:
        InputError: They are not of one unit, a temperature is missing or repeated, they are too few
            for the order, or a file cannot be read or written.
    """
    given = as_list(calibrations)
    names = [name_of(one, f'calibration {k + 1}') for k, one in enumerate(given)]
    combined = of_temperatures([as_calibration(one) for one in given], names, order)
    if output is not None:
        combined.save(output)
    return combined
