"""Sentences on units and stands: due dates, trends, steps, shifts of stands."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ..model.parameters import PARAMETER_NAMES, PARAMETERS
from .results import Cause, Chart, Rules, Signal, StandShift, Step, UnitHistory

_BY_NAME = dict(zip(PARAMETER_NAMES, PARAMETERS, strict=True))
_NAMED = 6
"""Number of parameters that a sentence names; of further ones it states the number."""


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


def quantity(value: float, parameter: str, *, per: str = '', sign: bool = False) -> str:
    """Return a value (SI) of a parameter in engineering units.

    Examples:
        >>> quantity(5.1e-6, 'K_ax', sign=True), quantity(1e-6, 'K_gx', per='month')
        ('+5.1 ppm', '1 ppm/month')
    """
    unit = _BY_NAME[parameter].unit
    shown = f'{unit.shown}/{per}' if per else unit.shown
    return f'{value / unit.scale:{"+" if sign else ""}.3g} {shown}'


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
        *(step_sentence(step) for step in unit.steps),
        *_signals(unit),
        *_few(unit),
    )


def _outside(unit: UnitHistory) -> Iterator[str]:
    for name in unit.outside:
        k = PARAMETER_NAMES.index(name)
        yield (
            f'{name} is outside its specification: {quantity(unit.values[-1, k], name)}, allowed '
            f'{quantity(unit.limit[k], name)} to either side.'
        )


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
    where = '' if np.isnat(crossing) else f' Its line crosses the limit on {crossing}.'
    borrowed = ' The unit has too few sessions for trends of its own: those of its type are used.'
    if due.recalibrate <= unit.date[-1]:
        yield (
            f'Recalibrate now: the chance that all parameters are inside their specification is '
            f'below {percent(rules.inside)}; {name} is the one most likely outside.{where}'
        )
        return
    yield (
        f'Recalibrate by {due.recalibrate}: until then all parameters are inside their '
        f'specification with {percent(rules.inside)}; {name} is the first that may be '
        f'outside.{where}'
        f'{borrowed if due.borrowed else ""}'
    )


def _drifts(unit: UnitHistory, rules: Rules) -> Iterator[str]:
    trend = unit.trend
    for k in np.flatnonzero(trend.significant):
        name = PARAMETER_NAMES[k]
        low, high = (quantity(x[k], name, per='month', sign=True) for x in (trend.low, trend.high))
        yield (
            f'{name} drifts: {quantity(trend.slope[k], name, per="month", sign=True)} '
            f'({percent(rules.confidence)}: {low} to {high}).'
        )


def step_sentence(step: Step) -> str:
    """Return a sentence on a step, its sessions and its cause."""
    parts = [
        f'{name} {quantity(size, name, sign=True)}'
        for name, size in zip(step.parameters, step.size, strict=True)
    ]
    looks = (
        'gyros and accelerometers turned by the same angle: a mount shift'
        if step.cause is Cause.MOUNT
        else 'the unit itself changed (a repair, a shock)'
    )
    return f'Step between {_day(step.after)} and {_day(step.before)}: {listed(parts)}; {looks}.'


def _signals(unit: UnitHistory) -> Iterator[str]:
    by_session: dict[int, list[Signal]] = {}
    for one in unit.charts.signals:
        by_session.setdefault(one.index, []).append(one)
    for index, signals in by_session.items():
        parts = []
        for chart in Chart:
            mine = [s for s in signals if s.chart is chart]
            names = [s.parameter for s in mine if s.parameter]
            if mine:
                parts.append(f'{chart.value} ({listed(names)})' if names else chart.value)
        yield f'Out of control on {_day(unit.date[index])}: {"; ".join(parts)}.'


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


def _day(date: np.datetime64) -> str:
    return str(date.astype('datetime64[D]'))
