"""imu-calib plans: list the supplied plans; print one; predict its results and its duration."""

from __future__ import annotations

import argparse

from rich.table import Table as Rows

from ..api.predict import optimise, plan_file, times_on
from ..common.errors import InputError
from ..common.files import share_folder
from ..common.stream import Mode
from ..common.units import DEG
from ..reports.tables import plain_table
from ..session.plan import METHOD_NAMES, Plan, Position, Step, load_plan
from ..session.table import Table, load_table
from . import options
from .predicted import show_prediction, show_time
from .terminal import OUTPUT, progress_bar

_OF_A_PREDICTION = (
    'method',
    'terms',
    'azimuth',
    'bias_instability',
    'temperature_rise',
    'latitude',
    'latitude_std',
    'height',
    'height_std',
    'gravity',
    'gravity_std',
)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
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
        help='the shortest dwells that reach a standard deviation, for instance D_gx=0.05deg/h; '
        'may be given several times',
    )
    options.add_scheduler_option(parser)
    parser.add_argument(
        '--optimise',
        type=float,
        metavar='MINUTES',
        help=(
            'find the plan that determines the parameters best in this time on the table, and '
            'write it to -o'
        ),
    )
    parser.add_argument(
        '--rate',
        type=float,
        metavar='DEG/S',
        help='rate of the turns of --optimise (default: 60, or that of the slowest joint)',
    )
    parser.add_argument(
        '-o', '--output', metavar='FILE', help='file for the plan that --optimise finds'
    )
    parser.add_argument(
        '--truth',
        default='cao2022_table1',
        metavar='NAME|FILE',
        help=(
            'assumed true parameters of the unit; pulse rates follow from them (default: '
            '%(default)s)'
        ),
    )
    parser.add_argument(
        '--azimuth', type=float, metavar='DEG', help="heading of the table's zero, where known"
    )
    options.add_method_option(parser)
    options.add_bias_instability_option(parser)
    parser.add_argument(
        '--temperature-rise',
        type=float,
        metavar='K',
        help='of the unit over the session, evenly and recorded: predict what follows it, too',
    )
    options.add_site_options(parser)
    parser.epilog = f'Methods: {", ".join(sorted(METHOD_NAMES))}.'
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Print the list, the steps of one plan, or its prediction."""
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
        _list_plans(table)
    elif arguments.imu is None:
        _refuse_without_imu(arguments)
        _lay_out(load_plan(arguments.plan), table)
    else:
        show_prediction(arguments)


def _check_optimise(arguments: argparse.Namespace) -> None:
    if arguments.optimise is None:
        if arguments.output is not None or arguments.rate is not None:
            raise InputError('--output and --rate are for --optimise MINUTES.')
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


def _list_plans(table: Table) -> None:
    headings = ('plan', 'positions', 'turns', 'time, min', 'method', 'what it is')
    rows = plain_table(headings, 'lrrrll')
    for path in sorted((share_folder() / 'config' / 'plans').glob('*.yaml')):
        plan = load_plan(path)
        turns = sum(len(p.rate_test.rates) or 1 for p in plan.positions if p.rate_test)
        rows.add_row(
            plan.name,
            str(len(plan.positions)),
            str(turns),
            _minutes(plan, table),
            plan.method,
            f'{plan.title} ({plan.source})',
        )
    OUTPUT.print(rows)


def _minutes(plan: Plan, table: Table) -> str:
    if plan.by_hand:
        return 'by hand'
    try:
        return f'{times_on(plan, table)[0] / 60:.1f}'
    except InputError:
        return 'not on this table'


def _lay_out(plan: Plan, table: Table) -> None:
    OUTPUT.print(f'{plan.title} ({plan.source})\n')
    if plan.by_hand:
        for position in plan.positions:
            OUTPUT.print(f'  {position.id}: {_in_words(position)}')
        return
    steps = plan.steps(table)
    OUTPUT.print(_step_rows(steps, table))
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
