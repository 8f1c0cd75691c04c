"""Prediction of a plan on the terminal: standard deviations, terms, and the shortest dwells."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..api.predict import (
    is_widened_by_leaning_holds,
    predicted,
    setup_of,
    shortest,
    times_on,
    with_best_deviations,
)
from ..api.session import as_truth
from ..common.errors import NotObservable
from ..common.units import DEG, PPM
from ..reports.tables import decimals, engineering, plain_table
from ..session.plan import Plan
from ..session.table import Table
from . import options
from .terminal import OUTPUT

if TYPE_CHECKING:
    from ..estimation.forecast import ChangeForecast, Forecast, TermForecast
    from ..estimation.methods import Setup
    from ..model.parameters import Parameter
    from ..model.sensors import SensorModel

_ON_A_TABLE = (
    'Predicted standard deviations: those of the method named, and the smallest possible in this '
    'session (Cramer-Rao bound; azimuth and tilts unknown), which the joint estimate reaches.'
)
_IN_THE_HAND = (
    'Predicted standard deviations by the noise, for turns of two seconds, each about one axis.'
)
_LEANING = (
    'Holds that lean add to this: half of their angle to E_a, the whole lean of a turn to E_g, and '
    'in the closed form a sixth of the angle times g to D_a.'
)
_TURNS_AND_DWELLS = 'the same dwells and turns early and late'


def show_prediction(arguments: argparse.Namespace) -> None:
    """Print the prediction of a plan, by the options.

    Raises:
        InputError: As of `predict` and `reach`.
        NotObservable: A parameter is not determined, or no dwell reaches the requested value.
    """
    setup = setup_of(options.stated(arguments))
    truth = as_truth(arguments.truth).model
    plan, imu, held, site = setup.plan, setup.imu, setup.table, setup.site
    OUTPUT.print(f'{plan.title} ({plan.source})')
    where = 'by hand' if held is None else f'on table {held.name}'
    OUTPUT.print(f'{where} with IMU {imu.id}, latitude {site.latitude / DEG:.3f} deg\n')
    if held is not None and held.assumption:
        OUTPUT.print(f'{held.assumption}\n')
    if arguments.reach:
        _show_reach(arguments, setup, truth)
        return
    drifting, rise = arguments.bias_instability, arguments.temperature_rise
    prediction = predicted(setup, truth, drifting=drifting, rise=rise)
    found, own = prediction.forecast, prediction.closed_form
    if own is None:
        _show_forecast(found)
    elif own.refusal:
        _show_forecast(found)
        OUTPUT.print(f'closed form {own.method}: {own.refusal}', markup=False)
    else:
        _show_forecast(with_best_deviations(own, found), best=found.method)
    if not drifting and imu.gyro.bias_instability + imu.accel.bias_instability:
        OUTPUT.print(
            'Biases are constant here; with --bias-instability they drift by the data sheet'
            f'{"." if plan.by_hand else ", as the joint estimate allows for."}'
        )
    for sentence in prediction.notes:
        OUTPUT.print(sentence, markup=False)
    _show_terms(prediction.terms, prediction.changes)
    if held is not None:
        show_time(plan, held)
    if found.refusal:
        raise NotObservable(f'Plan {plan.name}, method {found.method}: {found.refusal}')


def _show_reach(arguments: argparse.Namespace, setup: Setup, truth: SensorModel) -> None:
    wanted = dict(_parted(text) for text in arguments.reach)
    reached = shortest(setup, truth, wanted, arguments.scheduler)
    _show_forecast(reached.forecast, reached.wanted)
    rows = plain_table(('position', 'dwell, s', 'instead of'), 'lrr')
    for position in reached.plan.positions:
        before = setup.plan.position(position.id).dwell
        if before:
            rows.add_row(position.id, f'{position.dwell:.0f}', f'{before:.0f}')
    OUTPUT.print()
    OUTPUT.print(rows)
    if setup.table is not None:
        show_time(reached.plan, setup.table)


def _parted(text: str) -> tuple[str, str]:
    """Split NAME=STD; the parser of the name reports other forms."""
    name, _, value = text.partition('=')
    return name.strip(), value


def _show_forecast(
    found: Forecast, wanted: Mapping[str, float] | None = None, *, best: str = 'best'
) -> None:
    on_a_table = not found.evidence.plan.by_hand
    bounded = bool(np.isfinite(found.best).any())
    headings = ['parameter', found.method, *[best] * bounded, 'unit']
    if wanted is not None:
        headings.insert(-1, 'wanted')
    rows = plain_table(headings, f'l{"r" * (len(headings) - 2)}l')
    last: Parameter | None = None
    for parameter, std, least in zip(found.parameters, found.std, found.best, strict=True):
        if last is not None and parameter.triad != last.triad:
            rows.add_section()
        last = parameter
        shown = engineering(parameter)
        cells = [_cell(value / shown.scale) for value in (std, *[least] * bounded)]
        if wanted is not None:
            cells.append(_cell(wanted.get(parameter.name, np.nan) / shown.scale, empty=''))
        rows.add_row(parameter.name, *cells, shown.unit)
    OUTPUT.print(rows)
    OUTPUT.print(f'\n{_ON_A_TABLE if on_a_table else _IN_THE_HAND}')
    if is_widened_by_leaning_holds(found):
        OUTPUT.print(_LEANING)
    relative_std = found.evidence.site.gravity_relative_std
    if relative_std:
        OUTPUT.print(
            f'K_a includes the uncertainty of gravity, {relative_std / PPM:.3g} ppm: state '
            '--height, or --gravity as measured, to reduce it.'
        )


def _show_terms(found: Sequence[TermForecast], changes: Sequence[ChangeForecast]) -> None:
    if not found and not changes:
        return
    headings = ('term', 'std', 'unit', 'effect on the others, or what it requires')
    rows = plain_table(headings, 'lrll')
    for one in found:
        shown = engineering(one.term.parameters[0])
        worst = float(one.std.max()) / shown.scale if one.determined else np.nan
        words = _costs(one.worsened) if one.determined else f'requires {one.term.needs}'
        rows.add_row(one.term.name, _cell(worst), shown.unit, words)
    for each in changes:
        first = each.changes[0]
        per, scale = first.course.shown_per
        shown = engineering(first.parameters[0])
        worst = float(each.std.max()) / (shown.scale * scale)
        words = _costs(each.worsened) if each.determined else f'requires {_TURNS_AND_DWELLS}'
        kind = f'{first.parameters[0].kind.value.symbol}_{first.parameters[0].triad}'
        rows.add_row(f'{first.course.value}:{kind}', _cell(worst), f'{shown.unit}{per}', words)
    OUTPUT.print(
        '\nPredicted standard deviation of each term when it is added alone (worst channel).'
    )
    OUTPUT.print(rows)
    if changes:
        thermal = 'thermal is predicted for a temperature that changes: --temperature-rise K.'
        if any(each.follows_temperature for each in changes):
            thermal = 'thermal is that of a temperature that rises evenly.'
        OUTPUT.print(f'warm_up is that of a time constant of a quarter of the session. {thermal}')
    OUTPUT.print()


def _costs(dearer: Sequence[tuple[Parameter, float]]) -> str:
    """Return the factors by which a term increases other deviations, the largest of each kind."""
    worst: dict[str, float] = {}
    for parameter, times in dearer:
        kind = f'{parameter.kind.value.symbol}_{parameter.triad}'
        worst[kind] = max(times, worst.get(kind, 0.0))
    return ', '.join(f'{kind} {times:.1f} times' for kind, times in worst.items())


def _cell(value: float, empty: str = '-') -> str:
    return f'{value:.{decimals(value)}f}' if np.isfinite(value) else empty


def show_time(plan: Plan, table: Table) -> None:
    """Print the duration of a plan on a table."""
    if plan.by_hand:
        return
    total, standing = times_on(plan, table)
    OUTPUT.print(
        f'{total / 60:.1f} min on table {table.name}: {standing / 60:.1f} min of dwells, the rest '
        'moves, turns with their run-ups, and settling'
    )
