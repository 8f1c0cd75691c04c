"""imu-calib stand: run a plan live, with the suite's nodes as processes of their own."""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..calibration import Calibration
from ..calibrator import Setup
from ..earth import Site
from ..errors import InputError, NotObservable
from ..imu import load_imu
from ..methods import free
from ..plan import load_plan
from ..prediction import check_session
from ..report.parameters import parameter_table
from ..turntable import load_table
from ..units import DEG
from . import by_hand, options
from .processes import Outcome, Processes, free_port, private_network
from .simulate import LUOYANG
from .terminal import OUTPUT, progress_bar, sentence_list

_ORDER = ('stand_node', 'hand_node', 'imu_node', 'calibrator_node', 'turntable_node')
_IMU, _TRUTH, _HELD = 'fog_medium', 'cao2022_table1', 'mems_counts'
_JOURNAL = 'journal'
_RESULT = 'calibration.yaml'
_START = 30.0
"""Longest wait for the nodes to find each other, s."""


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = commands.add_parser('stand', help='run a stand live', description=__doc__)
    parser.add_argument('plan', metavar='PLAN', help='name of a plan, or a file')
    parser.add_argument(
        '-o', '--output', default='stand', metavar='DIR', help='folder to create (default: stand)'
    )
    parser.add_argument(
        '--imu',
        metavar='NAME|FILE',
        help=f'default: {_IMU}; {_HELD} where the unit is held by hand',
    )
    parser.add_argument(
        '--table', default='three_axis', metavar='NAME|FILE', help='default: %(default)s'
    )
    options.add_method_option(parser)
    options.add_serial_option(parser)
    options.add_site_options(parser)
    real = parser.add_argument_group(
        'real hardware', 'The table is then led by setpoints in the ROS domain of the environment.'
    )
    real.add_argument('--port', metavar='URL', help='where the IMU is, for instance /dev/ttyUSB0')
    real.add_argument(
        '--device', default='', metavar='NAME|FILE', help="format of the IMU's frames"
    )
    simulated = parser.add_argument_group('simulated hardware')
    simulated.add_argument(
        '--truth',
        metavar='NAME|FILE',
        help=f"the unit's true parameters (default: {_TRUTH}; {_HELD} where it is held by hand)",
    )
    simulated.add_argument(
        '--azimuth', type=float, default=0.0, metavar='DEG', help="true heading of the table's zero"
    )
    simulated.add_argument(
        '--sample-rate', type=float, default=0.0, metavar='HZ', help="default: the IMU's own"
    )
    simulated.add_argument('--seed', type=int, default=0, help='same seed, same errors')
    simulated.add_argument(
        '--speed',
        type=float,
        default=0.0,
        metavar='X',
        help='times real time at most (default: as fast as the nodes follow)',
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Run the stand to its end and print what came out.

    Raises:
        InputError: Wrong usage, or a node does not start.
        NotObservable: The session gives no calibration; says why.

    """
    folder = Path(arguments.output).expanduser()
    _complete(arguments)
    truth = _check(arguments, folder)
    folder.mkdir(parents=True)
    environment = {} if arguments.port else private_network()
    parameters = _parameters(arguments, folder)
    began = time.monotonic()
    if environment:
        joined = ' '.join(f"{key}='{value}'" for key, value in environment.items())
        OUTPUT.print(f'to look on: export {joined}', markup=False)
    with Processes(folder, environment) as processes:
        for node in _ORDER:
            if node in parameters:
                processes.start(node, parameters[node])
        if load_plan(arguments.plan).by_hand:
            outcome = by_hand.follow(processes, environment)
        else:
            outcome = _follow(processes, environment)
    if not outcome.finished:
        raise NotObservable(outcome.text)
    calibration = Calibration.load(folder / _RESULT)
    if truth is not None:
        truth.save(folder / 'truth.yaml')
    OUTPUT.print(parameter_table(calibration, truth))
    seconds = time.monotonic() - began
    OUTPUT.print(
        f'\n{calibration.provenance["samples"]} samples, {outcome.duration:.0f} s of the stand in '
        f'{seconds:.0f} s; recording: {folder / _JOURNAL}, result: {folder / _RESULT}'
    )
    sentence_list('Worth knowing', calibration.findings)


def _check(arguments: argparse.Namespace, folder: Path) -> Calibration | None:
    """Refuse what cannot work before anything moves; return the truth of a simulation."""
    if folder.exists():
        raise InputError(f'{folder} exists already; recordings are not overwritten.')
    if arguments.port and arguments.latitude is None:
        raise InputError('--port: a real stand needs --latitude.')
    latitude = LUOYANG if arguments.latitude is None else arguments.latitude
    site = Site.at(latitude * DEG, arguments.height or 0.0, arguments.gravity)
    plan, imu = load_plan(arguments.plan), load_imu(arguments.imu)
    table = None if plan.by_hand else load_table(arguments.table)
    setup = Setup(imu, plan, table, site, arguments.method)
    _check_session(setup)
    if plan.by_hand and not arguments.port and setup.method_name != free.NAME:
        raise InputError(
            f'Plan {plan.name} is for a hand: give --port, where the IMU is. Simulated hands hold '
            f'free positions alone (plan {free.NAME}).'
        )
    if arguments.port:
        return None
    return options.load_truth(arguments.truth, imu)


def _check_session(setup: Setup) -> None:
    """Refuse what the method could not solve; say who tells north where that is missing."""
    try:
        check_session(setup)
    except NotObservable as error:
        table = setup.table
        if table is None or table.azimuth is not None:
            raise
        check_session(replace(setup, table=replace(table, azimuth=0.0)))
        raise NotObservable(
            f'{error} Here the file of the table says where north is (azimuth: 12.3 deg); that of '
            f'{table.name} does not.'
        ) from None


def _complete(arguments: argparse.Namespace) -> None:
    """Put in what goes without saying: the IMU, and what it truly is where it is simulated."""
    held = load_plan(arguments.plan).by_hand
    arguments.imu = arguments.imu or (_HELD if held else _IMU)
    arguments.truth = arguments.truth or (_HELD if held else _TRUTH)


def _parameters(arguments: argparse.Namespace, folder: Path) -> dict[str, dict[str, Any]]:
    """Return the parameters of every node that is to run."""
    _complete(arguments)
    simulated = not arguments.port
    site = {
        'latitude': LUOYANG if arguments.latitude is None else arguments.latitude,
        'height': arguments.height or 0.0,
        'gravity': math.nan if arguments.gravity is None else arguments.gravity,
    }
    clock = {'use_sim_time': simulated}
    port = free_port() if simulated else 0
    described = {'imu': arguments.imu, 'table': arguments.table}
    nodes: dict[str, dict[str, Any]] = {
        'imu_node': {
            **clock,
            'imu': arguments.imu,
            'device': arguments.device or _frames(arguments),
            'sample_rate': arguments.sample_rate,
            'port': arguments.port or f'socket://127.0.0.1:{port}',
        },
        'calibrator_node': {
            **clock,
            **described,
            **site,
            'plan': arguments.plan,
            'method': arguments.method or '',
            'serial_number': arguments.serial or '',
            'journal': str(folder / _JOURNAL),
            'output': str(folder / _RESULT),
        },
        'turntable_node': {
            **clock,
            'plan': arguments.plan,
            'table': arguments.table,
            'autostart': True,
        },
    }
    if load_plan(arguments.plan).by_hand:
        del nodes['turntable_node'], nodes['calibrator_node']['table']
        if simulated:
            nodes['hand_node'] = {
                **site,
                'imu': arguments.imu,
                'truth': arguments.truth,
                'sample_rate': arguments.sample_rate,
                'seed': arguments.seed,
                'speed': arguments.speed,
                'port': port,
            }
        return nodes
    if simulated:
        # Simulated time stands still while a busy machine catches up: that is no silence.
        nodes['turntable_node'] |= {'watchdog_timeout': 10.0, 'calibrator_timeout': 10.0}
        # A stop that was pressed on this table is no word on the next one.
        nodes['turntable_node']['state_folder'] = str(folder / 'state')
        nodes['stand_node'] = {
            **described,
            **site,
            'truth': arguments.truth,
            'azimuth': arguments.azimuth,
            'sample_rate': arguments.sample_rate,
            'seed': arguments.seed,
            'speed': arguments.speed,
            'port': port,
        }
    return nodes


def _frames(arguments: argparse.Namespace) -> str:
    """Name the frames of the simulated IMU: those of a skewed gyro hold its count as well."""
    skewed = load_imu(arguments.imu).skewed is not None
    return 'simulated_skewed' if skewed and not arguments.port else 'simulated'


def _follow(processes: Processes, environment: dict[str, str]) -> Outcome:
    """Watch the session until it ends, with a progress bar."""
    # Which runtime there is, is asked here alone: the other commands need none.
    from .monitor import watching

    with watching(environment) as monitor, progress_bar('starting') as show:
        deadline = time.monotonic() + _START
        while True:
            monitor.spin(0.1)
            processes.check()
            done = round(monitor.duration)
            show(done, done + round(monitor.remaining), monitor.text)
            if monitor.outcome is not None:
                return Outcome(*monitor.outcome, monitor.duration)
            if monitor.stopped:
                return Outcome(False, f'The table has stopped. {monitor.stopped}', monitor.duration)
            if not monitor.begun and time.monotonic() > deadline:
                raise InputError(f'The stand does not start: {monitor.text}.')
