"""imu-calib simulate: write the recording of a simulated stand, or of a unit in the hand."""

from __future__ import annotations

import argparse

from ..api.simulate import TRUTH, Simulated, SimulatedUnits, simulate, simulate_units
from ..session.keywords import AtSite, Numbered
from ..session.units_file import TRUTHS
from . import options
from .terminal import OUTPUT, progress_bar

_IMU = 'fog_medium'


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument('plan', metavar='PLAN', help='name of a plan, or a file')
    parser.add_argument('-o', '--output', required=True, metavar='DIR', help='folder to create')
    parser.add_argument('--imu', metavar='NAME|FILE', help=f'default: {_IMU}')
    options.add_imus_option(parser)
    parser.add_argument(
        '--table',
        metavar='NAME|FILE',
        help='default: three_axis; none where the plan is run by hand',
    )
    parser.add_argument(
        '--truth',
        metavar='NAME|FILE',
        help=(
            "the unit's true parameters, as a calibration file (default: cao2022_table1; units "
            'with serial numbers differ from it, and from each other, by a tenth)'
        ),
    )
    parser.add_argument(
        '--azimuth',
        type=float,
        metavar='DEG',
        help="true heading of the table's zero against north, about up (default: 0)",
    )
    options.add_bias_instability_option(parser)
    options.add_imperfections_option(parser)
    parser.add_argument('--seed', type=int, default=0, help='same seed, same bits (default: 0)')
    parser.add_argument(
        '--compression',
        choices=('lz4', 'zstd'),
        default='',
        help='compression of the recording',
    )
    parser.add_argument(
        '--start',
        metavar='DATE',
        help='when the recording begins, for instance 2026-01-31T12:00:00Z (default: '
        '2023-11-14T22:13:20Z)',
    )
    parser.add_argument(
        '--temperature',
        type=float,
        metavar='T',
        help=(
            'temperature of the unit at the start, degC (default: 25, at which the true parameters '
            'hold); --imperfections state its effect'
        ),
    )
    options.add_statements(parser, Numbered)
    options.add_statements(parser, AtSite)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Simulate, write, and print what was written."""
    if arguments.imus is not None:
        _run_several(arguments)
        return
    arguments.imu = arguments.imu or _IMU
    done = simulate(
        arguments.plan,
        arguments.output,
        **options.keywords(simulate, arguments),
        progress=progress_bar,
    )
    _say(done, f'the true parameters to {done.path / TRUTH}')


def _run_several(arguments: argparse.Namespace) -> None:
    options.refuse_with_imus(arguments, 'imu', 'serial')
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
