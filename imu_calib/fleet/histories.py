"""Tables of a history: units by urgency, the parameters of one, the population of a type."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from rich.table import Table

from ..model.parameters import PARAMETER_NAMES, PARAMETERS
from ..reports.tables import decimals, engineering, plain_table
from .results import Population, UnitHistory

_NEVER = np.datetime64('9999-12-31', 'D')
_UNKNOWN = '-'
_OF_UNITS = (
    *('serial', 'type', 'sessions', 'newest', 'specification', 'recalibrate by'),
    *('first', 'drifts', 'steps', 'out of control'),
)
_SIZES = ('units', 'median', 'robust std', '5 %', '95 %', 'turn-on', 'per month', 'std')
_HEADS = (*_SIZES, 'outside', 'outliers')


def by_urgency(units: Sequence[UnitHistory]) -> list[UnitHistory]:
    """Return units by urgency: outside, due, then by date."""

    def key(unit: UnitHistory) -> tuple[bool, np.datetime64, bool, str, str]:
        due = unit.forecast.recalibrate
        odd = not (unit.steps or unit.charts.signals)
        return (not unit.outside, _NEVER if np.isnat(due) else due, odd, unit.imu, unit.serial)

    return sorted(units, key=key)


def unit_table(units: Sequence[UnitHistory]) -> Table:
    """Return one row for each unit."""
    table = plain_table(_OF_UNITS, 'llrllllrrr', no_wrap=True)
    for unit in units:
        due = unit.forecast
        table.add_row(
            unit.serial,
            unit.imu,
            str(len(unit.key)),
            _urgent_day(unit.date[-1]),
            _UNKNOWN if unit.verdict is None else unit.verdict.value,
            _urgent_day(due.recalibrate),
            due.parameter or _UNKNOWN,
            str(int(unit.trend.significant.sum())),
            str(len(unit.steps)),
            str(len({one.index for one in unit.charts.signals})),
        )
    return table


def course_table(unit: UnitHistory) -> Table:
    """Return one row for each session of a unit."""
    charts = unit.charts
    headings = ('date', 'stand', 'largest score', 'of', 'T^2', 'limit', 'chance')
    table = plain_table(headings, 'llrlrrr', no_wrap=True)
    for i, date in enumerate(unit.date):
        score = np.nan_to_num(charts.score[i])
        k = int(np.argmax(np.abs(score)))
        charted = bool(np.isfinite(charts.score[i]).any())
        table.add_row(
            _urgent_day(date),
            unit.stand[i] or _UNKNOWN,
            f'{score[k]:+.2f}' if charted else _UNKNOWN,
            PARAMETER_NAMES[k] if charted else _UNKNOWN,
            _number(charts.t2[i], 1),
            _number(charts.t2_limit[i], 1),
            f'{charts.t2_chance[i]:.2g}' if np.isfinite(charts.t2_chance[i]) else _UNKNOWN,
        )
    return table


def parameter_course_table(unit: UnitHistory, confidence: float) -> Table:
    """Return one row for each parameter of a unit."""
    share = f'{100 * confidence:g} %'
    numbers = ('value', 'std', 'limit', 'turn-on', share, 'per month', share)
    headings = ('', *numbers, 'unit', 'leaves', 'inside until')
    table = plain_table(headings, 'lrrrrrrrlll', no_wrap=True)
    trend, scatter, due = unit.trend, unit.scatter, unit.forecast
    for k, parameter in enumerate(PARAMETERS):
        if not np.isfinite(unit.values[-1, k]):
            continue
        shown = engineering(parameter)
        std = unit.std[-1, k] / shown.scale
        places = decimals(std if std > 0 else scatter.std[k] / shown.scale)
        finer = decimals(trend.std[k] / shown.scale)

        def text(value: float, to: int = places, scale: float = shown.scale) -> str:
            return _number(value / scale, to)

        table.add_row(
            parameter.name,
            text(unit.values[-1, k]),
            text(unit.std[-1, k]),
            _UNKNOWN if np.isnan(unit.limit[k]) else f'±{unit.limit[k] / shown.scale:g}',
            text(scatter.std[k]),
            _interval(text(scatter.low[k]), text(scatter.high[k])),
            text(trend.slope[k], finer),
            _interval(text(trend.low[k], finer), text(trend.high[k], finer)),
            shown.unit,
            _urgent_day(due.leaves[k]),
            _urgent_day(due.earliest[k]),
        )
    return table


def population_table(one: Population) -> Table:
    """Return one row for each parameter of a type."""
    table = plain_table(('', *_HEADS, 'unit'), f'l{"r" * len(_HEADS)}l', no_wrap=True)
    for k, parameter in enumerate(PARAMETERS):
        shown = engineering(parameter)
        places = decimals(one.robust_std[k] / shown.scale / 10)
        finer = decimals(one.trend_std[k] / shown.scale)
        turn_on = one.turn_on[k] / shown.scale
        table.add_row(
            parameter.name,
            str(int(one.count[k])),
            *(
                _number(value / shown.scale, places)
                for value in (
                    one.median[k],
                    one.robust_std[k],
                    one.quantiles[0, k],
                    one.quantiles[-1, k],
                )
            ),
            _number(turn_on, decimals(turn_on)),
            _number(one.trend[k] / shown.scale, finer),
            _number(one.trend_std[k] / shown.scale, finer),
            str(int(one.outside[k])),
            str(sum(apart.parameter == parameter.name for apart in one.outliers)),
            shown.unit,
        )
    return table


def _interval(low: str, high: str) -> str:
    return _UNKNOWN if _UNKNOWN in (low, high) else f'{low} to {high}'


def _number(value: float, places: int) -> str:
    return f'{value:.{places}f}' if np.isfinite(value) else _UNKNOWN


def _urgent_day(date: np.datetime64) -> str:
    return _UNKNOWN if np.isnat(date) else str(date.astype('datetime64[D]'))
