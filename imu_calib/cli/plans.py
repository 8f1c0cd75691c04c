"""Plans, listed, laid out, predicted or found: imu-calib plans."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from rich.table import Table as Rows

from ..api.predict import (
    is_widened_by_leaning_holds,
    optimise,
    plan_file,
    predicted,
    setup_of,
    shortest,
    times_on,
    with_best_deviations,
)
from ..api.session import DEFAULT_TRUTH, HELD_UNIT, Drifting, as_truth, usual_unit
from ..common.errors import InputError, NotObservable
from ..common.files import share_folder, write_whole
from ..common.finding import by_effect
from ..common.stream import Mode
from ..common.units import DEG, PPM, decimals
from ..model.parameters import engineering
from ..reports.plain_table import folded, plain_table
from ..session.keywords import AtSite, Solved
from ..session.plan import METHOD_NAMES, Plan, Position, Step, load_plan
from ..session.table import Table, load_table
from . import options
from .outcome import add_verbose_option
from .terminal import OUTPUT, WIDEST_LINE, print_findings, print_text, progress_bar

if TYPE_CHECKING:
    from ..estimation.forecast import ChangeForecast, Forecast, TermForecast
    from ..estimation.setup import Setup
    from ..model.parameters import Parameter
    from ..model.sensors import SensorModel

# Prediction of a plan on the terminal: standard deviations, terms, and the shortest dwells.


_ON_A_TABLE = 'Predicted standard deviations. No estimate has smaller ones than joint (Cramer-Rao).'
_IN_THE_HAND = (
    'Predicted standard deviations by the noise, for turns of two seconds, each about one axis.'
)
_LEANING = (
    'Holds that lean add to this: half of their angle to E_a, the whole lean of a turn to E_g, and '
    'in the closed form a sixth of the angle times g to D_a.'
)
_ROOM = 5  #: Lines of notes with which a prediction of 24 parameters fits a screen of 40.
_TURNS_AND_DWELLS = 'the same dwells and turns early and late'


def show_prediction(arguments: argparse.Namespace) -> None:
    """Print the prediction of a plan, by the options."""
    setup = setup_of(options.stated(arguments))
    truth = as_truth(arguments.truth or usual_unit(setup.plan)[1]).model
    plan, imu, held, site = setup.plan, setup.imu, setup.table, setup.site
    if arguments.reach:
        _show_reach(arguments, setup, truth)
        return
    drifting, rise = arguments.bias_instability, arguments.temperature_rise
    prediction = predicted(setup, truth, drifting=drifting, rise=rise)
    found, own = prediction.forecast, prediction.closed_form
    _show_conditions(setup)
    notes = []
    if relative_std := site.gravity_relative_std:
        todo = 'as --gravity-std states'
        if arguments.gravity is None:
            todo = 'measure it for less (--gravity, --gravity-std)'
            if arguments.height is None:
                todo = 'state --height or --gravity'
        notes.append(f'K_a includes {relative_std / PPM:.3g} ppm of gravity: {todo}.')
    if own is None:
        _show_forecast(found)
    elif own.refusal:
        _show_forecast(found)
        notes.append(f'Closed form {own.method}: {own.refusal}')
    else:
        _show_forecast(with_best_deviations(own, found), best=found.method)
    if not drifting and imu.gyro.bias_instability + imu.accel.bias_instability:
        notes.append('Biases are taken as constant: with --bias-instability they drift.')
    found_first = by_effect([*prediction.notes, *notes])
    print_findings(found_first, verbose=arguments.verbose, room=_ROOM)
    if arguments.verbose:
        _show_terms(prediction.terms, prediction.changes)
    OUTPUT.print()
    if held is not None:
        show_time(plan, held)
    if found.refusal:
        raise NotObservable(f'Plan {plan.name}, method {found.method}: {found.refusal}')


def _show_conditions(setup: Setup) -> None:
    print_text(setup.plan.title)
    where = 'by hand' if setup.table is None else f'on table {setup.table.name}'
    latitude = setup.site.latitude / DEG
    OUTPUT.print(f'{where} with IMU {setup.imu.id}, latitude {latitude:.3f} deg\n')
    if setup.table is not None and setup.table.assumption:
        print_text(f'{setup.table.assumption}\n')


def _show_reach(arguments: argparse.Namespace, setup: Setup, truth: SensorModel) -> None:
    wanted = dict(_parted(text) for text in arguments.reach)
    target = None if arguments.output is None else plan_file(arguments.output)
    reached = shortest(setup, truth, wanted, arguments.scheduler, drifting=True)
    _show_conditions(setup)
    _show_forecast(reached.forecast, reached.wanted)
    dwells = [
        f'{position.id}: {position.dwell:.0f} ({before:.0f})'
        for position in reached.plan.positions
        if (before := setup.plan.position(position.id).dwell)
    ]
    OUTPUT.print()
    print_text(f'Dwell in s at each position (that of the plan): {", ".join(dwells)}.')
    if setup.imu.gyro.bias_instability + setup.imu.accel.bias_instability:
        OUTPUT.print(f'Biases drift as the file of {setup.imu.id} states.', markup=False)
    else:
        print_text(
            f'The file of {setup.imu.id} states no bias_instability: biases are taken as constant, '
            'and a session gives larger standard deviations.'
        )
    if setup.table is not None:
        show_time(reached.plan, setup.table)
    if target is not None:
        write_whole(target, reached.plan.text(target.stem))
        OUTPUT.print(f'written to {target}', markup=False, highlight=False)


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
    for parameter, std, least in zip(found.parameters, found.std, found.best, strict=True):
        shown = engineering(parameter, by_hand=not on_a_table)
        cells = [_cell(value / shown.scale) for value in (std, *[least] * bounded)]
        if wanted is not None:
            cells.append(_cell(wanted.get(parameter.name, np.nan) / shown.scale, empty=''))
        rows.add_row(parameter.name, *cells, shown.unit)
    OUTPUT.print(folded(rows) if OUTPUT.width >= WIDEST_LINE else rows)
    OUTPUT.print()
    print_text(_ON_A_TABLE if on_a_table else _IN_THE_HAND)
    if is_widened_by_leaning_holds(found):
        print_text(_LEANING)


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
        print_text(f'warm_up is that of a time constant of a quarter of the session. {thermal}')


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
    print_text(f'{total / 60:.1f} min on table {table.name}, {standing / 60:.1f} min of it dwells.')


_OF_A_PREDICTION = (
    *('method', 'terms', 'azimuth', 'bias_instability', 'temperature_rise'),
    *AtSite.__annotations__,
)


def add_plans_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument(
        'plan', nargs='?', metavar='NAME|FILE', help='lay this plan out, step by step'
    )
    parser.add_argument(
        '--table', default='three_axis', metavar='NAME|FILE', help='default: %(default)s'
    )
    parser.add_argument(
        '--imu', metavar='NAME|FILE', help='predict what the plan gives with this IMU'
    )
    parser.add_argument(
        '--reach',
        action='append',
        default=[],
        metavar='NAME=STD',
        help='find the shortest dwells for a precision (a standard deviation, as D_gx=0.05deg/h); '
        'may be given several times',
    )
    options.add_scheduler_option(parser)
    parser.add_argument(
        '--optimise',
        type=float,
        metavar='MINUTES',
        help=(
            'find the best plan of this duration: it determines the parameters best in this time '
            'on the table, and is written to -o'
        ),
    )
    parser.add_argument(
        '--rate',
        type=float,
        metavar='DEG/S',
        help='rate of the turns of --optimise (default: 60, or that of the slowest joint)',
    )
    parser.add_argument(
        '-o', '--output', metavar='FILE', help='file for the plan of --optimise or --reach'
    )
    parser.add_argument(
        '--truth',
        metavar='NAME|FILE',
        help=(
            'assumed true parameters of the unit; pulse rates follow from them (default: '
            f'{DEFAULT_TRUTH}, or {HELD_UNIT} where the plan is run by hand)'
        ),
    )
    parser.add_argument(
        '--azimuth', type=float, metavar='DEG', help="heading of the table's zero, where known"
    )
    options.add_statements(parser, Solved)
    options.add_statements(parser, Drifting)
    parser.add_argument(
        '--temperature-rise',
        type=float,
        metavar='K',
        help='of the unit over the session, evenly and recorded: predict what follows it, too',
    )
    options.add_statements(parser, AtSite)
    add_verbose_option(parser)
    parser.epilog = f'Methods: {", ".join(sorted(METHOD_NAMES))}.'


def run_plans(arguments: argparse.Namespace) -> None:
    """List the supplied plans; print one; predict its results and its duration."""
    table = load_table(arguments.table)
    if arguments.reach and (arguments.imu is None or arguments.plan is None):
        raise InputError('--reach needs a plan and --imu, whose noise determines the dwells.')
    if arguments.temperature_rise is not None and arguments.reach:
        raise InputError(
            '--reach cannot be combined with --temperature-rise: give the one or the other.'
        )
    if arguments.scheduler is not None and not arguments.reach:
        raise InputError('--scheduler is for --reach alone, which takes long: leave it out.')
    _check_optimise(arguments)
    if arguments.optimise is not None:
        _optimise(arguments)
    elif arguments.plan is None:
        if arguments.imu is not None:
            raise InputError('--imu predicts what one plan gives: name the plan.')
        _refuse_without_imu(arguments)
        _list_plans(table, verbose=arguments.verbose)
    elif arguments.imu is None:
        _refuse_without_imu(arguments)
        _lay_out(load_plan(arguments.plan), table, verbose=arguments.verbose)
    else:
        show_prediction(arguments)


def _check_optimise(arguments: argparse.Namespace) -> None:
    if arguments.optimise is None:
        if arguments.rate is not None:
            raise InputError('--rate is for --optimise MINUTES.')
        if arguments.output is not None and not arguments.reach:
            raise InputError('--output is for --optimise MINUTES and --reach NAME=STD.')
        return
    if arguments.plan is not None:
        raise InputError(f'--optimise finds a plan: found {arguments.plan!r}, expected no PLAN.')
    if arguments.imu is None or arguments.output is None:
        lacking = '--imu NAME|FILE' if arguments.imu is None else '-o FILE'
        raise InputError(f'--optimise needs {lacking}.')


def _optimise(arguments: argparse.Namespace) -> None:
    """Find a plan, write it, and print its prediction."""
    target, stated = plan_file(arguments.output), options.keywords(optimise, arguments)
    stated['output'] = target
    optimise(arguments.imu, arguments.optimise, **stated, progress=progress_bar)
    arguments.plan = str(target)
    show_prediction(arguments)
    OUTPUT.print(f'written to {target}', markup=False, highlight=False)


def _refuse_without_imu(arguments: argparse.Namespace) -> None:
    """Refuse options that affect only a prediction when none is requested."""
    stated = {name: getattr(arguments, name) for name in _OF_A_PREDICTION}
    given = [name for name, value in stated.items() if value is not None and value is not False]
    if given:
        option = f'--{given[0].replace("_", "-")}'
        raise InputError(f'{option} is for the prediction of a plan: give PLAN and --imu, too.')


def _list_plans(table: Table, *, verbose: bool) -> None:
    headings = ['plan', 'positions', 'turns', 'time, min', 'what it is']
    rows = plain_table(
        [*headings, 'method', 'source'] if verbose else headings, 'lrrrlll' if verbose else 'lrrrl'
    )
    for path in sorted((share_folder() / 'config' / 'plans').glob('*.yaml')):
        plan = load_plan(path)
        turns = sum(len(p.rate_test.rates) or 1 for p in plan.positions if p.rate_test)
        rows.add_row(
            plan.name,
            str(len(plan.positions)),
            str(turns),
            _minutes(plan, table),
            plan.title,
            *([plan.method, plan.source] if verbose else []),
        )
    OUTPUT.print(rows)


def _minutes(plan: Plan, table: Table) -> str:
    if plan.by_hand:
        return 'by hand'
    try:
        return f'{times_on(plan, table)[0] / 60:.1f}'
    except InputError:
        return 'not on this table'


_STEPS = 30  #: Of a plan that fit a screen with its title and its duration.


def _lay_out(plan: Plan, table: Table, *, verbose: bool) -> None:
    print_text(f'{plan.title} ({plan.source})\n')
    steps = () if plan.by_hand else plan.steps(table)
    every = plan.positions if plan.by_hand else steps
    shown = len(every) if verbose else _STEPS
    if plan.by_hand:
        for position in plan.positions[:shown]:
            OUTPUT.print(f'  {position.id}: {_in_words(position)}')
    else:
        OUTPUT.print(_step_rows(steps[:shown], table))
    if len(every) > shown:
        OUTPUT.print(f'{len(every) - shown} more: --verbose')
    OUTPUT.print()
    show_time(plan, table)


def _in_words(position: Position) -> str:
    words = [f'hold {position.dwell:g} s'] if position.dwell else []
    if position.rate_test is not None:
        turns = position.rate_test.turns
        often = 'once' if turns == 1 else f'{turns} times'
        words.insert(0, f'turn {often} about the vertical, still for 2 s before and after')
    return ', then '.join(words)


def _step_rows(steps: tuple[Step, ...], table: Table) -> Rows:
    angles = [f'{name}, deg' for name in table.names]
    headings = ['step', 'position', 'does', *angles, 'rate, deg/s', 'turns', 'dwell, s']
    rows = plain_table(headings, f'lll{"r" * len(angles)}rrr')
    for step in steps:
        turning = step.mode is Mode.RATE
        rate = next((r for r in step.rates if r), 0.0)
        rows.add_row(
            str(step.index),
            step.position,
            'turn' if turning else 'stand',
            *(f'{a / DEG:.1f}' for a in step.angles),
            f'{rate / DEG:+.1f}' if turning else '',
            str(step.turns) if turning else '',
            f'{step.dwell:g}' if step.dwell else '',
        )
    return rows
