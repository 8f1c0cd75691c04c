"""Sentences on units and stands: due dates, trends, steps, shifts of stands."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np
from rich.table import Table

from ..common.units import decimals
from ..model.parameters import PARAMETER_NAMES, PARAMETERS, engineering
from ..reports.plain_table import plain_table
from .results import Cause, Chart, Population, Rules, Signal, StandShift, Step, UnitHistory, day

_BY_NAME = {parameter.name: parameter for parameter in PARAMETERS}
_MANY = 3  #: Sessions with signals of one parameter that share a sentence.
_NAMED = 6  #: Number of parameters that a sentence names; of further ones it states the number.


def listed(names: Sequence[str], most: int = _NAMED) -> str:
    """Return names as a list in a sentence.

    Examples:
        >>> listed(['A', 'B', 'C']), listed(['A', 'B', 'C'], 2)
        ('A, B and C', 'A, B and 1 more')
    """
    shown = list(names[:most])
    if len(names) > most:
        shown.append(f'{len(names) - most} more')
    return shown[0] if len(shown) == 1 else f'{", ".join(shown[:-1])} and {shown[-1]}'


def quantity(
    value: float, parameter: str, *, per: str = '', sign: bool = False, by_hand: bool = False
) -> str:
    """Return a value (SI) of a parameter in engineering units, or in those of a unit in the hand.

    Examples:
        >>> quantity(5.1e-6, 'K_ax', sign=True), quantity(1e-6, 'K_gx', per='month')
        ('+5.1 ppm', '1 ppm/month')
        >>> quantity(-0.303362, 'K_az')
        '-303362 ppm'
    """
    unit = engineering(_BY_NAME[parameter], by_hand=by_hand)
    shown = f'{unit.unit}/{per}' if per else unit.unit
    number = value / unit.scale
    form = '.0f' if 1e3 <= abs(number) < 1e9 else '.3g'
    return f'{number:{"+" if sign else ""}{form}} {shown}'


def percent(share: float) -> str:
    """Return a share as a percentage.

    Examples:
        >>> percent(0.95), percent(0.001)
        ('95 %', '0.1 %')
    """
    return f'{100 * share:.4g} %'


def unit_sentences(unit: UnitHistory, rules: Rules) -> tuple[str, ...]:
    """Return messages for the user on a unit, the most urgent first."""
    return (
        *_outside(unit),
        *_due(unit, rules),
        *_drifts(unit, rules),
        *(
            step_sentence(step, by_hand=unit.by_hand)
            for step in unit.steps
            if step.cause is not Cause.RETURN
        ),
        *_signals(unit),
        *_few(unit),
    )


def _outside(unit: UnitHistory) -> Iterator[str]:
    for name in unit.outside:
        k = PARAMETER_NAMES.index(name)
        value, limit = (
            quantity(x, name, by_hand=unit.by_hand) for x in (unit.values[-1, k], unit.limit[k])
        )
        yield f'{name} is outside its specification: {value}, allowed {limit} to either side.'


def _due(unit: UnitHistory, rules: Rules) -> Iterator[str]:
    due = unit.forecast
    if unit.outside:
        return
    if due.reason:
        yield due.reason
        return
    name = due.parameter
    k = PARAMETER_NAMES.index(name)
    crossing = unit.forecast.leaves[k]
    where = '' if np.isnat(crossing) else f' (its line crosses the limit on {crossing})'
    borrowed = ' The unit has too few sessions for trends of its own: those of its type are used.'
    if due.recalibrate <= unit.date[-1]:
        yield (
            f'Recalibrate now: the chance that all parameters are inside their specification is '
            f'below {percent(rules.inside)}; {name} is the one most likely outside{where}.'
        )
        return
    yield (
        f'Recalibrate by {due.recalibrate}: until then all parameters are inside their '
        f'specification with {percent(rules.inside)}; {name} is the first that may be '
        f'outside{where}.'
        f'{borrowed if due.borrowed else ""}'
    )


def _drifts(unit: UnitHistory, rules: Rules) -> Iterator[str]:
    trend = unit.trend
    for k in np.flatnonzero(trend.significant):
        name = PARAMETER_NAMES[k]
        slope, low, high = (
            quantity(x[k], name, per='month', sign=True, by_hand=unit.by_hand)
            for x in (trend.slope, trend.low, trend.high)
        )
        yield f'{name} drifts: {slope} ({percent(rules.confidence)}: {low} to {high}).'


def step_sentence(step: Step, *, by_hand: bool) -> str:
    """Return a sentence on a step of a unit, its sessions and its cause."""
    parts = []
    for k, name in enumerate(step.parameters):
        size, low, high = (
            quantity(x[k], name, sign=True, by_hand=by_hand)
            for x in (step.size, step.low, step.high)
        )
        parts.append(f'{name} {size} ({low} to {high})')
    if step.cause is Cause.OUTLIER:
        return (
            f'The session of {day(step.before)} is unlike those before and after '
            f'({listed(parts)}): repeat it.'
        )
    looks = (
        'gyros and accelerometers turned by the same angle: a mount shift'
        if step.cause is Cause.MOUNT
        else 'the unit itself changed (a repair, a shock)'
    )
    return f'Step between {day(step.after)} and {day(step.before)}: {listed(parts)}; {looks}.'


def _signals(unit: UnitHistory) -> Iterator[str]:
    by_session: dict[int, list[Signal]] = {}
    for one in unit.charts.signals:
        by_session.setdefault(one.index, []).append(one)
    # From the first signal of a parameter on, it explains T^2 and other charts of these sessions.
    counts = Counter(name for some in by_session.values() for name in {s.parameter for s in some})
    del counts['']
    name, count = max(counts.items(), key=lambda one: one[1], default=('', 0))
    if count >= _MANY:
        first = min(i for i, some in by_session.items() if any(s.parameter == name for s in some))
        since = len(unit.date) - first
        mine = [i for i, some in by_session.items() if {s.parameter for s in some} & {name, ''}]
        mine = [i for i in mine if i >= first]
        others = {s.parameter for i in mine for s in by_session[i]} - {name, ''}
        also = f', some also by {listed(sorted(others))}' if others else ''
        yield (
            f'Out of control at {len(mine)} of {since} sessions since {day(unit.date[first])}, by '
            f'{name}{also}.'
        )
        by_session = {i: some for i, some in by_session.items() if i not in mine}
    for index, signals in by_session.items():
        parts = []
        for chart in Chart:
            mine_of = [s for s in signals if s.chart is chart]
            names = [s.parameter for s in mine_of if s.parameter]
            if mine_of:
                parts.append(f'{chart.value} ({listed(names)})' if names else chart.value)
        yield f'Out of control on {day(unit.date[index])}: {"; ".join(parts)}.'


def _few(unit: UnitHistory) -> Iterator[str]:
    count = len(unit.date)
    if count == 1:
        yield 'One session: scatter and trend of this unit are unknown.'
    elif len(np.unique(unit.date)) == 1:
        yield f'All {count} sessions have one date: a trend cannot be determined.'
    elif count == 2 and np.isnan(unit.trend.slope).all():
        yield 'Two sessions: a trend of this unit cannot be distinguished from their scatter.'


def stand_sentence(shift: StandShift) -> str:
    """Return a sentence on the shift of a stand, and on the stands compared."""
    name = shift.parameters[0]
    size, low, high = (quantity(x, name, sign=True) for x in (shift.shift, shift.low, shift.high))
    by = f'{shift.units} unit{"s" * (shift.units != 1)}'
    what = shift.what if len(shift.parameters) == 1 else f'{shift.what} (all alike)'
    agree = 'agree' if len(shift.others) > 1 else 'does not'
    if shift.identified:
        return (
            f'Stand {shift.stand} is off: it adds {size} ({low} to {high}) to {what} of every '
            f'unit, by {by}; {listed(shift.others)} {agree}.'
        )
    return (
        f'Stands {shift.stand} and {listed(shift.others)} differ: {shift.stand} adds {size} '
        f'({low} to {high}) to {what} of every unit, by {by}. Which of them is off needs a further '
        'stand.'
    )


def off_stand_sentence(stand: str) -> str:
    """Return a sentence on a unit whose newest calibration is from a stand that is off."""
    return (
        f'The newest calibration is from stand {stand}, which is off, and has its error: '
        'repeat it on another stand before use, or subtract the shift.'
    )


_NEVER = np.datetime64('9999-12-31', 'D')
_UNKNOWN = '-'
_OF_UNITS = (
    *('serial', 'type', 'sessions', 'newest', 'specification', 'recalibrate by'),
    *('first', 'drifts', 'steps', 'out of control'),
)
_SIZES = ('units', 'median', 'robust std', '5 %', '95 %', 'turn-on', 'per month', 'std')
_HEADS = (*_SIZES, 'outside', 'outliers')
SCATTER_WORDS = (
    'Robust std is the scatter between units, 1.4826 times the median distance from the median, '
    'which a few odd units do not widen; turn-on is the scatter between the sessions of a unit.'
)


def by_urgency(units: Sequence[UnitHistory]) -> list[UnitHistory]:
    """Return units by urgency: outside, due, then by date."""

    def key(unit: UnitHistory) -> tuple[bool, np.datetime64, bool, str, str]:
        due = unit.forecast.recalibrate
        odd = not (unit.own_steps or unit.charts.signals)
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
            day(unit.date[-1]) or _UNKNOWN,
            _UNKNOWN if unit.verdict is None else unit.verdict.value,
            day(due.recalibrate) or _UNKNOWN,
            due.parameter or _UNKNOWN,
            str(int(unit.trend.significant.sum())),
            str(len(unit.own_steps)),
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
            day(date) or _UNKNOWN,
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
    headings = ('', *numbers, 'step from', 'unit', 'leaves', 'inside until')
    table = plain_table(headings, 'lrrrrrrrrlll', no_wrap=True)
    trend, scatter, due = unit.trend, unit.scatter, unit.forecast
    for k, parameter in enumerate(PARAMETERS):
        if not np.isfinite(unit.values[-1, k]):
            continue
        shown = engineering(parameter, by_hand=unit.by_hand)
        std = unit.std[-1, k] / shown.scale
        places = decimals(std if std > 0 else scatter.std[k] / shown.scale)
        finer = decimals(trend.std[k] / shown.scale)

        def text(value: float, to: int = places, scale: float = shown.scale) -> str:
            return _number(value / scale, to)

        shifted = bool(unit.values[-1, k] != unit.corrected[-1, k])
        table.add_row(
            parameter.name,
            text(unit.values[-1, k]) + '*' * shifted,
            text(unit.std[-1, k]),
            _UNKNOWN if np.isnan(unit.limit[k]) else f'±{unit.limit[k] / shown.scale:g}',
            text(scatter.std[k]),
            _interval(text(scatter.low[k]), text(scatter.high[k])),
            text(trend.slope[k], finer),
            _interval(text(trend.low[k], finer), text(trend.high[k], finer)),
            text(trend.least_step[k]),
            shown.unit,
            day(due.leaves[k]) or _UNKNOWN,
            day(due.earliest[k]) or _UNKNOWN,
        )
    return table


def population_table(one: Population) -> Table:
    """Return one row for each parameter of a type."""
    table = plain_table(('', *_HEADS, 'unit'), f'l{"r" * len(_HEADS)}l', no_wrap=True)
    for k, parameter in enumerate(PARAMETERS):
        if not one.count[k]:
            continue
        shown = engineering(parameter, by_hand=one.by_hand)
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
    return f'{round(value, places) + 0.0:.{places}f}' if np.isfinite(value) else _UNKNOWN
