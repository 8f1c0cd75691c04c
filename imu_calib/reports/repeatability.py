"""Several calibrations of one unit: do they repeat within what they state, and do they drift."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from html import escape

import numpy as np
import scipy

from ..calibration import Calibration
from ..errors import InputError
from ..gravity import same_place, without_gravity
from ..model import Parameter
from ..stream import Floats
from .html import paragraph, table
from .parameter_table import decimals, engineering
from .svg import COLOURS, Axis, Panel, drawing, label, tag

_SURPRISING = 0.001
"""Probability of chance below which sessions scatter."""
_SIGNIFICANT = 3.0
"""Standard deviations: a drift by chance in one of 370 parameters."""
_DAY = 86400.0
_FEWEST_FOR_A_DRIFT = 3
"""Dates: two always lie on a line."""
_WIDTH, _CELL, _HEIGHT, _COLUMNS = 760.0, 182.0, 74.0, 4
_ALIKE = 1e-6
"""Relative: scale factors that differ by more make other parameters."""


@dataclass(frozen=True, eq=False)
class Repeated:
    """One parameter in several calibrations, SI units.

    Attributes:
        parameter: Which.
        value: (n,) as estimated.
        std: (n,) as stated.
        days: (n,) when, days after the first; None where a calibration has no date.

    """

    parameter: Parameter
    value: Floats
    std: Floats
    days: Floats | None

    @property
    def spread(self) -> float:
        """Standard deviation of the values about their mean."""
        return float(np.std(self.value, ddof=1))

    @property
    def stated(self) -> float:
        """Root mean square of the stated standard deviations."""
        return float(np.sqrt(np.mean(self.std**2)))

    @property
    def chance(self) -> float:
        """Probability of so large a spread if the stated deviations were all there is.

        Chi-squared about the weighted mean.
        """
        weights = 1 / np.maximum(self.std, 1e-300) ** 2
        mean = weights @ self.value / weights.sum()
        return float(scipy.special.chdtrc(len(self.value) - 1, weights @ (self.value - mean) ** 2))

    @property
    def drift(self) -> tuple[float, float] | None:
        """Slope and its standard deviation, per day; None without three different dates.

        Weighted least squares; the deviation is widened where the values scatter more about the
        line than is stated.
        """
        if self.days is None or len(set(self.days.tolist())) < _FEWEST_FOR_A_DRIFT:
            return None
        weights = 1 / np.maximum(self.std, 1e-300) ** 2
        centred = self.days - weights @ self.days / weights.sum()
        information = weights @ centred**2
        slope = float(weights * centred @ self.value / information)
        left = self.value - weights @ self.value / weights.sum() - slope * centred
        excess = max(1.0, float(weights @ left**2) / max(1, len(self.value) - 2))
        return slope, float(np.sqrt(excess / information))


def date_of(calibration: Calibration) -> datetime | None:
    """Return when the recording of a calibration began; None where it does not say.

    Raises:
        InputError: What it says is no date.

    """
    text = calibration.provenance.get('recorded')
    if text is None:
        return None
    try:
        return datetime.fromisoformat(str(text).replace('Z', '+00:00'))
    except ValueError:
        raise InputError(
            f'provenance: recorded: found {text!r}, expected a date as 2026-01-31T12:00:00Z.'
        ) from None


def repeated(calibrations: Sequence[Calibration], names: Sequence[str]) -> list[Repeated]:
    """Line up the parameters that all calibrations have.

    Args:
        calibrations: At least two, of one unit.
        names: Of their files, for messages.

    Raises:
        InputError: They are of different units, or have no parameter in common.

    """
    first = calibrations[0]
    for other, name in zip(calibrations[1:], names[1:], strict=True):
        if other.imu.id != first.imu.id:
            raise InputError(
                f'{name}: is of unit {other.imu.id!r}, expected {first.imu.id!r} as {names[0]}.'
            )
        scales = [
            (c.imu.units.value, c.imu.gyro.scale_factor, c.imu.accel.scale_factor)
            for c in (first, other)
        ]
        if scales[0][0] != scales[1][0] or not np.allclose(scales[0][1:], scales[1][1:], _ALIKE):
            raise InputError(
                f'{name}: its nominal scale factors or units are not those of {names[0]}: the '
                'parameters cannot be compared.'
            )
    dates = [date_of(c) for c in calibrations]
    known = [d for d in dates if d is not None]
    days = None
    if len(known) == len(dates):
        days = np.array([(d - min(known)).total_seconds() / _DAY for d in known])
    # Calibrations of one place share the error of its gravity: it makes none of them differ.
    where = first.provenance
    shared = all(
        same_place(c, where.get('gravity'), where.get('latitude_deg')) for c in calibrations
    )
    squares = [np.diag(without_gravity(c) if shared else c.covariance) for c in calibrations]
    found = []
    for parameter in first.parameters:
        rows = [
            c.parameters.index(parameter) if parameter in c.parameters else -1 for c in calibrations
        ]
        if min(rows) < 0:
            continue
        value = np.array([c.values[k] for c, k in zip(calibrations, rows, strict=True)])
        std = np.sqrt([square[k] for square, k in zip(squares, rows, strict=True)])
        if np.isfinite(std).all():
            found.append(Repeated(parameter, value, std, days))
    if not found:
        raise InputError(f'{", ".join(names)}: no parameter was estimated in all of them.')
    return found


def repeatability_table(rows: Sequence[Repeated]) -> str:
    """Return spread against stated deviation, and the drift, of every parameter."""
    cells = []
    for row in rows:
        shown = engineering(row.parameter)
        places = decimals(row.stated / shown.scale)
        drift = row.drift
        ratio = row.spread / row.stated if row.stated > 0 else float('nan')
        cells.append(
            [
                tag('b', row.parameter.name),
                _written(float(row.value.mean()) / shown.scale, places),
                f'{row.spread / shown.scale:.{places}f}',
                f'{row.stated / shown.scale:.{places}f}',
                f'{ratio:.1f}' if np.isfinite(ratio) else '-',
                '-' if drift is None else _drift(drift, shown.scale),
                escape(shown.unit.replace('ug', '\u00b5g')),
                _verdict(row),
            ]
        )
    headings = ['', 'mean', 'spread', 'stated std', 'ratio', 'drift per day', 'unit', '']
    return table(headings, cells, 'plain', 'lrrrrrll')


def _drift(drift: tuple[float, float], scale: float) -> str:
    slope, std = drift[0] / scale, drift[1] / scale
    places = decimals(std)
    return f'{_written(slope, places)} \u00b1 {std:.{places}f}'


def _written(value: float, places: int) -> str:
    return f'{value:.{places}f}'.replace('-', '\u2212')


def _verdict(row: Repeated) -> str:
    drift = row.drift
    if drift is not None and abs(drift[0]) > _SIGNIFICANT * drift[1]:
        return tag('span', 'drifts', class_='badge fail')
    if row.chance < _SURPRISING:
        return tag('span', 'scatters', class_='badge marginal')
    return tag('span', 'repeats', class_='badge pass')


def overlay(rows: Sequence[Repeated]) -> str:
    """Draw every parameter over time, or over the order given where dates are missing."""
    lines = -(-len(rows) // _COLUMNS)
    parts = []
    for k, row in enumerate(rows):
        left = (k % _COLUMNS) * (_CELL + 8) + 44
        top = (k // _COLUMNS) * (_HEIGHT + 44) + 22
        parts += _small(row, left, top)
    return drawing(parts, _WIDTH, lines * (_HEIGHT + 44) + 12, 'Parameters over time')


def _small(row: Repeated, left: float, top: float) -> list[str]:
    shown = engineering(row.parameter)
    value, std = row.value / shown.scale, row.std / shown.scale
    when = row.days if row.days is not None else np.arange(float(len(value)))
    mean = float(value.mean())
    reach = float(np.max(np.abs(value - mean) + 2 * std)) or 1.0
    panel = Panel(
        Axis.around(when.tolist(), 0.1),
        Axis.around([-reach, reach]),
        left,
        top,
        _CELL - 44,
        _HEIGHT,
    )
    panel.frame('', '', x_ticks=False)
    panel.level(0.0, 'zero')
    unit = f', {shown.unit}' if shown.unit else ''
    heading = f'{row.parameter.name} \u2212 mean{unit}'.replace('ug', '\u00b5g')
    panel.parts.append(label(heading, left, top - 6, class_='tick'))
    for x, y, s in zip(when, value - mean, std, strict=True):
        panel.point(float(x), float(y), 0, (float(y - 2 * s), float(y + 2 * s)))
    if row.drift is not None and abs(row.drift[0]) > _SIGNIFICANT * row.drift[1]:
        slope = row.drift[0] / shown.scale
        middle = float(when.mean())
        ends = float(when.min()), float(when.max())
        panel.curve([(x, slope * (x - middle)) for x in ends], COLOURS[1], '4 3')
    bottom = top + _HEIGHT + 14
    last = f'{when.max():.3g} d' if row.days is not None else f'{len(when)}'
    first = '0' if row.days is not None else '1'
    panel.parts += [
        label(first, panel.across(float(when.min())), bottom, class_='tick', text_anchor='middle'),
        label(last, panel.across(float(when.max())), bottom, class_='tick', text_anchor='middle'),
    ]
    return panel.parts


def repeatability_notes(rows: Sequence[Repeated]) -> str:
    """Say in words what the comparison shows."""
    count = len(rows[0].value)
    drifting = [r.parameter.name for r in rows if 'drifts' in _verdict(r)]
    scattering = [r.parameter.name for r in rows if 'scatters' in _verdict(r)]
    sentences = [
        f'{count} calibrations; spread is the standard deviation of their values, stated std what '
        'they say of themselves. "Scatters": less than one in a thousand such sets would spread so '
        'far if the stated deviations were all there is. Error bars are two standard deviations.'
    ]
    if rows[0].days is None:
        sentences.append('Not all of them say when they were recorded: no drift is looked for.')
    elif rows[0].drift is None:
        sentences.append('A drift needs three different dates.')
    if drifting:
        sentences.append(f'Drifting by more than three standard deviations: {", ".join(drifting)}.')
    if scattering:
        sentences.append(f'Scattering more than stated: {", ".join(scattering)}.')
    return paragraph(' '.join(sentences), 'note')
