"""imu-calib stand: run a plan live, with the suite's nodes as processes of their own."""

from __future__ import annotations

import argparse
import shutil
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..calibration import Calibration
from ..calibrator import Setup
from ..devices import check_port, choose_baud, is_serial, load_format, too_slow
from ..errors import InputError, NotObservable
from ..imu import load_imu
from ..methods import free
from ..model import NO_TERMS
from ..plan import load_plan
from ..prediction import check_session
from ..report.parameters import parameter_table
from ..simulation import StandOptions, load_imperfections
from ..turntable import load_table
from . import by_hand, options, resume
from .processes import Outcome, Processes, free_port, private_network
from .simulate import LUOYANG
from .terminal import OUTPUT, progress_bar, sentence_list
from .words import NothingComes

_ORDER = ('stand_node', 'hand_node', 'imu_node', 'calibrator_node', 'turntable_node')
_IMU, _TRUTH, _HELD = 'fog_medium', 'cao2022_table1', 'mems_counts'
_SLOWEST = 50
"""The slowest rate of a serial port that POSIX names, bit/s."""
_START = 30.0
"""Longest wait for the nodes to find each other, s."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument('plan', metavar='PLAN', nargs='?', help='name of a plan, or a file')
    parser.add_argument(
        '--resume',
        metavar='FOLDER',
        help='instead of a plan: go on with the interrupted session of a folder',
    )
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
    real.add_argument(
        '--baud',
        type=int,
        metavar='BIT/S',
        help="of a serial port (default: as the device's file says, else 115200)",
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
    options.add_imperfections_option(simulated)
    simulated.add_argument('--seed', type=int, default=0, help='same seed, same errors')
    simulated.add_argument(
        '--speed',
        type=float,
        default=0.0,
        metavar='X',
        help='times real time at most (default: as fast as the nodes follow)',
    )
    parser.set_defaults(run=run, start=0.0, default_of=parser.get_default)


def run(arguments: argparse.Namespace) -> None:
    """Run the stand to its end and print what came out.

    Raises:
        InputError: Wrong usage, or a node does not start.
        NotObservable: The session gives no calibration; says why.

    """
    # Which runtime there is, is asked here alone: the other commands need none.
    from . import monitor  # noqa: F401

    if not (arguments.plan or arguments.resume):
        raise InputError('Give a PLAN (imu-calib plans lists them), or --resume FOLDER.')
    if arguments.resume:
        resume.restore(arguments)
    _complete(arguments)
    truth = _check(arguments)
    folder = Path(arguments.resume).expanduser() if arguments.resume else _new_folder(arguments)
    _say_baud(arguments)
    folder.mkdir(parents=True, exist_ok=bool(arguments.resume))
    with resume.claimed(folder) as claim, _signals():
        if arguments.resume:
            resume.check_unfinished(folder)
            arguments.start = 0.0 if arguments.port else resume.switched_on_at(folder)
        else:
            resume.keep(arguments, folder)
        _run(arguments, folder, truth, claim)


def _new_folder(arguments: argparse.Namespace) -> Path:
    """Return the folder to create."""
    folder = Path(arguments.output).expanduser()
    if not folder.exists():
        return folder
    if resume.unfinished(folder):
        raise InputError(
            f'{folder} exists already and holds a session that was interrupted. Go on with it: '
            f'{resume.command(arguments.output)}, or name another folder with -o.'
        )
    raise InputError(
        f'{folder} exists already; recordings are not overwritten. Name another folder with -o.'
    )


@contextmanager
def _signals() -> Iterator[None]:
    """Have SIGTERM and SIGHUP end the session as Ctrl-C does: the table first."""
    numbers = [n for n in (signal.SIGTERM, signal.SIGHUP) if signal.getsignal(n) is signal.SIG_DFL]
    for number in numbers:
        signal.signal(number, signal.default_int_handler)
    try:
        yield
    finally:
        for number in numbers:
            signal.signal(number, signal.SIG_DFL)


def _run(
    arguments: argparse.Namespace, folder: Path, truth: Calibration | None, claim: int
) -> None:
    """Run a session that can be run, and print what came out."""
    environment = {} if arguments.port else private_network()
    parameters = _parameters(arguments, folder)
    began = time.monotonic()
    if environment:
        joined = ' '.join(f"{key}='{value}'" for key, value in environment.items())
        OUTPUT.print(f'to look on: export {joined}', markup=False)
    try:
        with Processes(folder, environment, (claim,)) as processes:
            outcome = _session(arguments, processes, parameters)
    except NothingComes:
        if not arguments.resume:
            # Nothing was recorded: the same command is to work once the device is there.
            shutil.rmtree(folder)
        raise
    finally:
        if resume.unfinished(folder):
            given = arguments.resume or arguments.output
            arguments.last_word = f'To go on with it: {resume.command(given)}'
    if not outcome.finished:
        raise NotObservable(outcome.text)
    calibration = Calibration.load(folder / resume.RESULT)
    if truth is not None:
        truth.save(folder / 'truth.yaml')
        _save_true_table(arguments, folder)
    OUTPUT.print(parameter_table(calibration, truth))
    seconds = time.monotonic() - began
    OUTPUT.print(
        f'\n{calibration.provenance["samples"]} samples, {outcome.duration:.0f} s of the stand in '
        f'{seconds:.0f} s; recording: {folder / resume.JOURNAL}, result: {folder / resume.RESULT}'
    )
    sentence_list('Worth knowing', calibration.findings)


def _save_true_table(arguments: argparse.Namespace, folder: Path) -> None:
    """Write how the simulated table differs from its description, if it does."""
    if not arguments.imperfections or load_plan(arguments.plan).by_hand:
        return
    table = load_table(arguments.table)
    read = load_imperfections(arguments.imperfections, StandOptions(), table, arguments.seed)
    if read.true is not None:
        read.true.save(folder / options.TRUE_TABLE, table)


def _session(
    arguments: argparse.Namespace,
    processes: Processes,
    parameters: dict[str, dict[str, Any]],
) -> Outcome:
    """Start the nodes, and watch them until the session ends."""
    for node in _ORDER:
        if node in parameters:
            processes.start(node, parameters[node])
    if load_plan(arguments.plan).by_hand:
        return by_hand.follow(processes)
    return _follow(processes)


def _check(arguments: argparse.Namespace) -> Calibration | None:
    """Refuse what cannot work before anything moves; return the truth of a simulation."""
    _check_baud(arguments)
    if arguments.port:
        _check_device(arguments)
    elif arguments.device:
        raise InputError('--device: simulated hardware has frames of its own; give --port, too.')
    site = options.site_at(arguments, LUOYANG)
    plan, imu = load_plan(arguments.plan), load_imu(arguments.imu)
    table = None if plan.by_hand else load_table(arguments.table)
    terms = options.find_terms(arguments)
    setup = Setup(imu, plan, table, site, arguments.method, terms=terms)
    _check_session(setup)
    if plan.by_hand and not arguments.port and setup.method_name != free.NAME:
        raise InputError(
            f'Plan {plan.name} is for a hand: give --port, where the IMU is. Simulated hands hold '
            f'free positions alone (plan {free.NAME}).'
        )
    if arguments.port:
        if arguments.imperfections:
            raise InputError('--imperfections: of simulated hardware; leave it out with --port.')
        return None
    if arguments.imperfections:
        load_imperfections(arguments.imperfections, StandOptions(), table, arguments.seed)
    return options.load_truth(arguments.truth, imu)


def _check_baud(arguments: argparse.Namespace) -> None:
    """Refuse the rate of a serial port that is none, or no rate."""
    if arguments.baud is None:
        return
    if not arguments.port:
        raise InputError('--baud: simulated hardware has no serial port; give --port, too.')
    if not is_serial(arguments.port):
        raise InputError(f'--baud: {arguments.port} is no serial port; leave --baud out.')
    if arguments.baud < _SLOWEST:
        raise InputError(f'--baud: found {arguments.baud}, expected {_SLOWEST} bit/s or more.')


def _say_baud(arguments: argparse.Namespace) -> None:
    """Say at what rate a serial port is read, and where its frames do not fit."""
    if not arguments.port or not is_serial(arguments.port):
        return
    frames = load_format(arguments.device or _frames(arguments))
    baud = choose_baud(arguments.baud, frames)
    OUTPUT.print(f'{arguments.port} is read at {baud}.', markup=False)
    rate = arguments.sample_rate or load_imu(arguments.imu).sample_rate
    if sentence := too_slow(baud.rate, frames, rate):
        OUTPUT.print(sentence, markup=False)


def _check_device(arguments: argparse.Namespace) -> None:
    """Refuse a device that cannot be read."""
    missing = []
    if not arguments.device:
        missing.append(
            "--device, the format of the frames that come there: a device's name "
            f'({options.shipped("devices")}), or a file of your own (docs/devices.md)'
        )
    if arguments.latitude is None:
        missing.append('--latitude, of a real stand, in degrees')
    if missing:
        raise InputError(f'--port: give {"; and ".join(missing)}.')
    load_format(arguments.device)
    check_port(arguments.port)


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
    if not arguments.port:
        arguments.truth = arguments.truth or (_HELD if held else _TRUTH)


def _parameters(arguments: argparse.Namespace, folder: Path) -> dict[str, dict[str, Any]]:
    """Return the parameters of every node that is to run."""
    _complete(arguments)
    simulated = not arguments.port
    stated = ('height', 'gravity', 'height_std', 'gravity_std')
    doubts = {name: v for name in stated if (v := getattr(arguments, name)) is not None}
    doubts['latitude'] = LUOYANG if arguments.latitude is None else arguments.latitude
    site = {name: value for name, value in doubts.items() if not name.endswith('_std')}
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
            'baud': arguments.baud or 0,
        },
        'calibrator_node': {
            **clock,
            **described,
            **doubts,
            'plan': arguments.plan,
            'method': arguments.method or '',
            'terms': arguments.terms or NO_TERMS,
            'serial_number': arguments.serial or '',
            'journal': str(folder / resume.JOURNAL),
            'output': str(folder / resume.RESULT),
        },
        'turntable_node': {
            **clock,
            'plan': arguments.plan,
            'table': arguments.table,
            'autostart': True,
            'resume': bool(arguments.resume),
        },
    }
    if load_plan(arguments.plan).by_hand:
        del nodes['turntable_node'], nodes['calibrator_node']['table']
        if simulated:
            nodes['hand_node'] = {
                **site,
                'imu': arguments.imu,
                'truth': arguments.truth,
                'imperfections': arguments.imperfections or '',
                'sample_rate': arguments.sample_rate,
                'seed': arguments.seed,
                'start': arguments.start,
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
            'imperfections': arguments.imperfections or '',
            'sample_rate': arguments.sample_rate,
            'seed': arguments.seed,
            'start': arguments.start,
            'speed': arguments.speed,
            'port': port,
        }
    return nodes


def _frames(arguments: argparse.Namespace) -> str:
    """Name the frames of the simulated IMU: those of a skewed gyro hold its count as well."""
    skewed = load_imu(arguments.imu).skewed is not None
    return 'simulated_skewed' if skewed and not arguments.port else 'simulated'


def _follow(processes: Processes) -> Outcome:
    """Watch the session until it ends, with a progress bar."""
    from .monitor import watching

    with watching(processes) as monitor, progress_bar('starting') as show:
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
