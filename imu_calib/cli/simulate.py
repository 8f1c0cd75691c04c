"""Simulated sessions, one or many: imu-calib simulate, montecarlo."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.table import Table as Rows

from ..api.files import new_folder, output_path, removed_on_failure
from ..api.session import DEFAULT_TRUTH, HELD_UNIT, USUAL_IMU, Drifting
from ..api.simulate import (
    TRUTH,
    Simulated,
    SimulatedTable,
    SimulatedUnits,
    Simulation,
    montecarlo,
    simulate,
    simulate_units,
)
from ..calibration.views import empty_figure
from ..common.errors import InputError
from ..common.files import write_by
from ..common.units import counted, decimals
from ..model.parameters import engineering
from ..reports.plain_table import plain_table
from ..session.keywords import AtSite, Numbered, Solved
from ..session.plan import METHOD_NAMES
from ..session.units_file import TRUTHS
from . import options
from .terminal import OUTPUT, print_findings, print_text, progress_bar

if TYPE_CHECKING:
    from ..simulation.repetition import RunStatistics

_IMU = f'default: {USUAL_IMU}; {HELD_UNIT} where the plan is run by hand'


def add_simulate_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument('plan', metavar='PLAN', help='name of a plan, or a file')
    parser.add_argument('-o', '--output', required=True, metavar='DIR', help='folder to create')
    parser.add_argument('--imu', metavar='NAME|FILE', help=_IMU)
    options.add_imus_option(parser)
    parser.add_argument(
        '--units',
        type=int,
        metavar='N',
        help='write N recordings: each of a unit of its own, with the next seed',
    )
    options.add_statements(parser, Simulation)
    options.add_statements(parser, Numbered)
    options.add_statements(parser, AtSite)


def run_simulate(arguments: argparse.Namespace) -> None:
    """Write the recording of a simulated stand, or of a unit in the hand."""
    if arguments.imus is not None:
        _run_several(arguments)
        return
    if arguments.units is not None:
        _run_each(arguments)
        return
    done = simulate(
        arguments.plan,
        arguments.output,
        **options.keywords(simulate, arguments),
        progress=progress_bar,
    )
    _say(done, f'the true parameters to {done.path / TRUTH}')


def _run_each(arguments: argparse.Namespace) -> None:
    """Write a recording for each of --units: serial numbers make the units differ."""
    count, first, folder = arguments.units, arguments.seed, new_folder(arguments.output)
    if count < 1:
        raise InputError(f'--units: found {count}, expected 1 or more.')
    if arguments.serial is not None:
        raise InputError('--serial names one unit, and --units numbers several: leave one out.')
    with removed_on_failure(folder):
        folder.mkdir()
        for k in range(count):
            arguments.serial = f'unit_{k + 1:0{len(str(count))}d}'
            arguments.seed = first + k
            simulate(
                arguments.plan,
                folder / arguments.serial,
                **options.keywords(simulate, arguments),
                progress=progress_bar,
            )
    OUTPUT.print(
        f'{counted(count, "recording")} written to {folder}, each of another unit, with its true '
        f'parameters in {TRUTH}'
    )


def _run_several(arguments: argparse.Namespace) -> None:
    options.refuse_with_imus(arguments, 'imu', 'serial', 'units')
    done = simulate_units(
        arguments.plan,
        arguments.output,
        arguments.imus,
        **options.keywords(simulate_units, arguments),
        progress=progress_bar,
    )
    units = len(done.truths)
    _say(done, f'the true parameters of {units} units to {done.path / TRUTHS}')


def _say(done: Simulated | SimulatedUnits, written: str) -> None:
    if done.true_table is not None:
        written += f', the true table to {done.true_table}'
    OUTPUT.print(
        f'{done.duration:.0f} s of plan {done.plan.name} written to {done.path}, {written}'
    )


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


def add_montecarlo_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument('plan', metavar='PLAN', help='name of a plan, or a file')
    parser.add_argument('--runs', type=int, default=100, help='default: %(default)s')
    parser.add_argument('--seed', type=int, default=0, help='seed of the first run (default: 0)')
    parser.add_argument(
        '--jobs',
        type=int,
        default=os.cpu_count() or 1,
        metavar='N',
        help='processes (default: all cores)',
    )
    options.add_scheduler_option(parser)
    parser.add_argument('--imu', metavar='NAME|FILE', help=_IMU)
    options.add_statements(parser, SimulatedTable)
    parser.add_argument(
        '--truth',
        metavar='NAME|FILE',
        help=f'default: {DEFAULT_TRUTH}; {HELD_UNIT} where the plan is run by hand',
    )
    parser.add_argument(
        '--azimuth',
        type=float,
        metavar='DEG',
        help="heading of the table's zero, if known; without it each run has another heading, "
        'which the calibrator does not know',
    )
    options.add_statements(parser, Solved)
    options.add_statements(parser, Drifting)
    parser.add_argument(
        '-o',
        '--output',
        metavar='FILE.png',
        help='plot of the normalised errors (needs matplotlib, the extra plot)',
    )
    options.add_statements(parser, AtSite)
    parser.epilog = f'Methods: {", ".join(sorted(METHOD_NAMES))}.'


def run_montecarlo(arguments: argparse.Namespace) -> None:
    """Repeat a simulated session, and print the errors of its method."""
    target = _plot_path(arguments.output) if arguments.output else None
    repeated = montecarlo(
        arguments.plan,
        arguments.imu,
        **options.keywords(montecarlo, arguments),
        progress=progress_bar,
    )
    outcome, setup = repeated.outcome, repeated.setup
    OUTPUT.print(_table(outcome, by_hand=setup.plan.by_hand))
    OUTPUT.print()
    print_text(
        f'{len(outcome.errors)} runs of plan {setup.plan.name}, method {setup.method_name}. '
        'Worst: the largest error. Normalised: root mean square of errors over the standard '
        'deviations stated with them.'
    )
    print_findings(repeated.findings, verbose=True)
    if target is not None:
        figure, ending = repeated.plot(), target.suffix.removeprefix('.')
        write_by(target, lambda file: figure.savefig(file, format=ending.lower()))
        OUTPUT.print(f'\ndrawn to {target}', markup=False)


def _table(outcome: RunStatistics, *, by_hand: bool) -> Rows:
    rows = plain_table(_HEADINGS, 'lrrrrrrl')
    normalised, worst = outcome.rms, outcome.worst
    for k, parameter in enumerate(outcome.parameters):
        stated = float(outcome.mean_stated[k])
        # Not estimated, or a zero by the choice of axes.
        if not stated > 0:
            continue
        shown = engineering(parameter, by_hand=by_hand)
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


def _plot_path(text: str) -> Path:
    """Return the path of a plot that can be drawn and written; checked before the computation."""
    target = output_path(text)
    figure = empty_figure(1.0, 1.0, f'--output {text}: a plot')
    known = sorted(figure.canvas.get_supported_filetypes())
    if target.suffix.removeprefix('.').lower() not in known:
        raise InputError(
            f'--output {text}: found the ending {target.suffix!r}, expected one of '
            f'{", ".join(known)}.'
        )
    return target
