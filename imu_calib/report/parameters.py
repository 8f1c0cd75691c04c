"""The parameters in the units that engineers write; every table of them is made here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from rich.table import Table

from ..calibration import Calibration
from ..model import PARAMETERS, Parameter, ParameterKind
from ..stream import Units
from ..units import ARCMIN, ARCSEC, DEG_H, MICRO_G, PPM, STANDARD_GRAVITY


@dataclass(frozen=True)
class Shown:
    """How a parameter is shown: its unit in words, and the unit's SI value."""

    unit: str
    scale: float


def engineering(parameter: Parameter) -> Shown:
    """Return the unit in which engineers write a parameter."""
    if parameter.kind is ParameterKind.SCALE_FACTOR_ERROR:
        return Shown('ppm', PPM)
    if parameter.kind is ParameterKind.MISALIGNMENT:
        return Shown('arcmin', ARCMIN)
    if parameter.kind is ParameterKind.RESPONSE:
        return Shown('', 1.0)
    if parameter.kind is ParameterKind.G_SENSITIVITY:
        return Shown('(deg/h)/g', DEG_H / STANDARD_GRAVITY)
    return Shown('deg/h', DEG_H) if parameter.triad == 'g' else Shown('ug', MICRO_G)


def decimals(deviation: float) -> int:
    """Return how many decimals show a standard deviation with two significant digits."""
    if not np.isfinite(deviation) or deviation <= 0:
        return 4
    return int(np.clip(1 - np.floor(np.log10(deviation)), 0, 9))


def parameter_table(calibration: Calibration, truth: Calibration | None = None) -> Table:
    """Return the parameters that were estimated: value, standard deviation, unit.

    Args:
        calibration: What to show.
        truth: What a simulation was given; adds the error in standard deviations.

    """
    table = Table(box=None, pad_edge=False, header_style='bold')
    headings = ['parameter', 'value', 'std', 'unit']
    if truth is not None:
        headings += ['truth', 'error/std']
    for heading in headings:
        table.add_column(heading, justify='left' if heading in {'parameter', 'unit'} else 'right')
    parameters, deviations = calibration.parameters, calibration.std
    values = calibration.values
    true_values = truth.model.values(parameters) if truth is not None else values
    last = parameters[0]
    for k, parameter in enumerate(parameters):
        if not np.isfinite(deviations[k]):
            continue
        if (parameter.triad, parameter.row > 2) != (last.triad, last.row > 2) or (
            ParameterKind.G_SENSITIVITY in {parameter.kind, last.kind}
            and parameter.kind is not last.kind
        ):
            table.add_section()
        last = parameter
        shown = engineering(parameter)
        value, deviation = values[k] / shown.scale, deviations[k] / shown.scale
        places = decimals(deviation)
        row = [parameter.name, f'{value:.{places}f}', f'{deviation:.{places}f}', shown.unit]
        if truth is not None:
            true = true_values[k] / shown.scale
            ratio = f'{(value - true) / deviation:+.2f}' if deviation > 0 else '-'
            row += [f'{true:.{places}f}', ratio]
        table.add_row(*row)
    return table


def comparison_table(calibrations: Sequence[Calibration], names: Sequence[str]) -> Table:
    """Return two calibrations side by side, in the units and the order of Cao 2022's Table 1.

    That table gives K as a deviation of the scale factor, S - S0 = -S0 K / (1 + K), and names
    misalignments by the transpose of the matrix in its eqs. (1)-(2) (its E_AXY is the response of
    the Y channel to an input along X, eq. 18; that its gyro names follow suit is our reading). Both
    names are printed.
    """
    table = Table(box=None, pad_edge=False, header_style='bold')
    for heading in ('Table 1', 'here', *names, 'difference', 'in std', 'unit'):
        left = heading in {'Table 1', 'here', 'unit'}
        table.add_column(heading, justify='left' if left else 'right')
    first, second = calibrations
    deviations = np.sqrt(first.std[:24] ** 2 + second.std[:24] ** 2)
    rows = sorted(
        range(24), key=lambda k: (PARAMETERS[k].triad != 'g', _table_order(PARAMETERS[k]))
    )
    for k in rows:
        if not np.isfinite(deviations[k]):
            continue
        parameter = PARAMETERS[k]
        shown, values = _as_table_1(parameter, k, calibrations)
        difference = first.model.vector()[k] - second.model.vector()[k]
        ratio = difference / deviations[k] if deviations[k] > 0 else np.nan
        places = _table_decimals(shown)
        table.add_row(
            _table_name(parameter),
            parameter.name,
            *(f'{v:.{places}f}' for v in values),
            f'{values[0] - values[1]:+.{places}f}',
            '-' if np.isnan(ratio) else f'{ratio:+.1f}',
            shown.unit,
        )
        if k == _last_gyro(rows):
            table.add_section()
    return table


def _last_gyro(rows: Sequence[int]) -> int:
    return [k for k in rows if PARAMETERS[k].triad == 'g'][-1]


def _table_name(parameter: Parameter) -> str:
    name = parameter.name.upper()
    if parameter.kind is ParameterKind.MISALIGNMENT:
        return name[:-2] + name[-1] + name[-2]
    return name


def _table_order(parameter: Parameter) -> tuple[int, str]:
    kinds = [ParameterKind.SCALE_FACTOR_ERROR, ParameterKind.MISALIGNMENT, ParameterKind.BIAS]
    return kinds.index(parameter.kind), _table_name(parameter)


def _as_table_1(
    parameter: Parameter, index: int, calibrations: Sequence[Calibration]
) -> tuple[Shown, list[float]]:
    values = [float(c.model.vector()[index]) for c in calibrations]
    if parameter.kind is ParameterKind.SCALE_FACTOR_ERROR:
        if calibrations[0].imu.units is not Units.PULSES:
            return Shown('ppm', PPM), [v / PPM for v in values]
        gyro = parameter.triad == 'g'
        shown = Shown('arcsec/p', ARCSEC) if gyro else Shown('(m/s)/p', 1.0)
        nominal = [
            c.imu.gyro.scale_factor if gyro else c.imu.accel.scale_factor for c in calibrations
        ]
        return shown, [-s * v / (1 + v) / shown.scale for s, v in zip(nominal, values, strict=True)]
    shown = engineering(parameter)
    if shown.unit == 'ug':
        shown = Shown('g', STANDARD_GRAVITY)
    return shown, [v / shown.scale for v in values]


def _table_decimals(shown: Shown) -> int:
    """Two digits more than the paper prints."""
    printed = {'arcsec/p': 3, '(m/s)/p': 4, 'ppm': 0, 'arcmin': 2, 'deg/h': 2, 'g': 4}
    return printed[shown.unit] + 2
