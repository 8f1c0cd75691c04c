"""imu-calib montecarlo: a simulated session many times, and what its method makes of it."""

from __future__ import annotations

import argparse
import math
import os

import numpy as np
from rich.table import Table as Rows

from ..calibration import Calibration
from ..calibrator import Setup
from ..earth import LUOYANG
from ..errors import InputError, NotObservable
from ..imu import load_imu
from ..methods import METHODS, method
from ..montecarlo import Outcome, Study, economical, repeat
from ..plan import load_plan
from ..reports.parameter_table import decimals, engineering
from ..share import named_file
from ..simulation import StandOptions
from . import options
from .plot import draw_normalised, plot_path
from .terminal import OUTPUT, progress_bar, sentence_list

_HEADINGS = (
    'parameter',
    'bias',
    'spread',
    'stated',
    'spread/stated',
    'worst',
    'normalised',
    'unit',
)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument('plan', metavar='PLAN', help='name of a plan, or a file')
    parser.add_argument('--runs', type=int, default=100, help='default: %(default)s')
    parser.add_argument('--seed', type=int, default=0, help='of the first run (default: 0)')
    parser.add_argument('--jobs', type=int, metavar='N', help='processes (default: all cores)')
    parser.add_argument(
        '--imu', default='fog_medium', metavar='NAME|FILE', help='default: %(default)s'
    )
    parser.add_argument(
        '--table', default='three_axis', metavar='NAME|FILE', help='default: %(default)s'
    )
    parser.add_argument(
        '--truth', default='cao2022_table1', metavar='NAME|FILE', help='default: %(default)s'
    )
    parser.add_argument(
        '--azimuth',
        type=float,
        metavar='DEG',
        help="heading of the table's zero, known to the calibrator; without it the heading is "
        'another one in each run, and unknown',
    )
    options.add_method_option(parser)
    parser.add_argument(
        '--bias-instability', action='store_true', help="let the biases drift by the IMU's figure"
    )
    parser.add_argument(
        '-o',
        '--output',
        metavar='FILE.png',
        help='plot of the normalised errors (needs matplotlib, the extra plot)',
    )
    options.add_site_options(parser)
    parser.epilog = f'Methods: {", ".join(sorted(METHODS))}.'
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Simulate, calibrate, and print what came out."""
    if arguments.runs < 1 or (arguments.jobs is not None and arguments.jobs < 1):
        raise InputError('--runs and --jobs: expected a whole number above 0.')
    target = plot_path('--output', arguments.output) if arguments.output else None
    study = _study(arguments)
    jobs = min(arguments.jobs or os.cpu_count() or 1, arguments.runs)
    with progress_bar('simulating and calibrating') as show:
        outcome = repeat(study, arguments.runs, arguments.seed, jobs, show)
    refusals = sorted({r.refusal for r in outcome.refused})
    if len(outcome.refused) == len(outcome.runs):
        raise NotObservable(f'All of {len(outcome.runs)} runs were refused: {refusals[0]}')
    OUTPUT.print(_table(outcome))
    setup = study.setup
    OUTPUT.print(
        f'\n{len(outcome.errors)} runs of plan {setup.plan.name}, method {setup.method_name}. '
        'Worst: the largest error. Normalised: root mean square of errors over the standard '
        'deviations stated with them.'
    )
    if setup.table is not None and setup.table.assumption:
        OUTPUT.print(setup.table.assumption)
    sentence_list(f'Refused: {len(outcome.refused)} runs', refusals[:5])
    if target is not None:
        known = np.isfinite(outcome.mean_stated)
        names = [p.name for p, k in zip(outcome.parameters, known, strict=True) if k]
        title = f'{setup.plan.name}, {setup.method_name}: {len(outcome.errors)} runs'
        draw_normalised(target, title, names, outcome.normalised[:, known])
        OUTPUT.print(f'\ndrawn to {target}', markup=False)


def _study(arguments: argparse.Namespace) -> Study:
    stated = options.stated(arguments)
    site, table = stated.site(LUOYANG), stated.simulated_table()
    plan = load_plan(arguments.plan)
    terms, changes = stated.sensor_terms, stated.changes
    if arguments.method is not None:
        method(arguments.method, terms, changes)
    if plan.by_hand:
        raise InputError(f'Plan {plan.name} is run by hand: only a table can be simulated here.')
    plan.steps(table)
    stand = StandOptions(
        # A uniform error of this half width has the standard deviation that the table states.
        positioning_error=math.sqrt(3) * table.positioning,
        bias_instability=arguments.bias_instability,
    )
    setup = Setup(
        load_imu(arguments.imu),
        plan,
        table,
        site,
        arguments.method,
        terms=terms,
        changes=changes,
        look=stated.look,
    )
    truth = Calibration.load(named_file('truths', arguments.truth)).model
    return Study(setup, truth, economical(stand), table.azimuth)


def _table(outcome: Outcome) -> Rows:
    rows = Rows(box=None, pad_edge=False, header_style='bold')
    for heading in _HEADINGS:
        rows.add_column(heading, justify='left' if heading in {'parameter', 'unit'} else 'right')
    normalised = np.sqrt((outcome.normalised**2).mean(axis=0))
    worst = np.abs(outcome.errors).max(axis=0)
    last = outcome.parameters[0]
    for k, parameter in enumerate(outcome.parameters):
        stated = float(outcome.mean_stated[k])
        if not np.isfinite(stated):
            continue
        if parameter.triad != last.triad:
            rows.add_section()
        last = parameter
        shown = engineering(parameter)
        places = decimals(stated / shown.scale)
        values = [outcome.bias[k], outcome.spread[k], stated]
        cells = ['-' if np.isnan(v) else f'{v / shown.scale:.{places}f}' for v in values]
        ratio = outcome.spread[k] / stated if stated > 0 else np.nan
        rows.add_row(
            parameter.name,
            *cells,
            '-' if np.isnan(ratio) else f'{ratio:.3f}',
            f'{worst[k] / shown.scale:.{places}f}',
            f'{normalised[k]:.3f}',
            shown.unit,
        )
    return rows
