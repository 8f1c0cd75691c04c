"""A session of `imu-calib stand`: its nodes, from their start to the result."""

from __future__ import annotations

import argparse
import os
import shlex
import shutil
import signal
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from datetime import datetime
from pathlib import Path
from typing import Any

import yaml
from rich.live import Live
from rich.text import Text

from ..api.session import TRUE_TABLE
from ..api.stand import (
    check_stand,
    end_of_journal,
    has_simulated_hands,
    is_finished,
    setup_of_stand,
    true_table_of,
)
from ..calibration.calibration import Calibration
from ..common.errors import InputError, NotObservable
from ..common.files import named_file, read_text, user_path, write_whole
from ..live.devices.format import FrameFormat
from ..live.devices.health import Reception, Severity
from ..live.devices.source import Baud, Source, steady_time
from ..live.network import forced
from ..live.web.board import Board, UnitsBoard
from ..live.web.expectation import expectation, units_board
from ..model.earth import LUOYANG, Site
from ..reports.tables import parameter_tables
from ..session.imu import ImuSpec, load_imu
from ..session.keywords import DEFAULT_TERMS, AtSite
from ..session.plan import Plan, load_plan
from ..session.table import Table, load_table
from . import options, several, web_page
from .displays import Start, follow, view_table
from .embedded import Embedded, Nodes
from .processes import (
    START,
    Processes,
    SessionEnd,
    free_ports,
    network_of_hardware,
    private_network,
)
from .terminal import ERRORS, OUTPUT, NodeReports, NothingComes, sentence_list

# Settings in a stand's folder, used to resume an interrupted session.


JOURNAL = 'journal'
RESULT = 'calibration.yaml'
_SETTINGS = 'settings'
_OPTIONS = 'options.yaml'
_RUNNING = 'running'
_FILES = {
    'plan': 'plans',
    'imu': 'imus',
    'table': 'tables',
    'device': 'devices',
    'truth': 'truths',
    'imperfections': 'imperfections',
}
"""Options that name a file, with its kind."""

_OF_THE_RUN = frozenset(
    {'command', 'run', 'default_of', 'closing_line', 'output', 'resume', 'start'}
    | {'web', 'web_host', 'control', 'verbose'}
)
"""Options of one run, which do not belong to the session."""

_MAY_CHANGE = frozenset(
    {'port', 'baud', 'speed', 'network', 'without', 'processes', 'table_port', 'table_baud'}
)
"""A device or a network may have another name after a power failure; the speed of a simulation has
no effect; a unit may have failed permanently."""

_OUTAGE = 10
"""Time without simulated hardware, s of its time: longer than the accepted silence of joint
states."""

_PATIENCE = 30.0
"""Longest wait for the nodes of a killed run, s: they stop the table first, and wait for the
acknowledgement."""


def save_settings(arguments: argparse.Namespace, folder: Path) -> None:
    """Write the settings of a session into its folder, with paths of the copies there.

    Files are copied: the session is resumed unchanged even if the originals change.

    Raises:
        InputError: One of the files is missing, or cannot be written.
    """
    settings = folder / _SETTINGS
    settings.mkdir()
    for option, kind in _FILES.items():
        name = getattr(arguments, option)
        if name:
            write_whole(settings / f'{option}.yaml', read_text(named_file(kind, name)))
    if arguments.imus:
        several.save_settings(arguments, settings)
    kept = {k: v for k, v in vars(arguments).items() if k not in {*_OF_THE_RUN, *_FILES, 'imus'}}
    # Last: a folder without it does not belong to a stand.
    write_whole(settings / _OPTIONS, yaml.safe_dump(kept))
    _point_at_copies(arguments, settings)


def restore(arguments: argparse.Namespace) -> Path:
    """Set the options of the interrupted session; return its folder.

    Raises:
        InputError: The folder is not a stand's, or options are given that belong to the session.
    """
    folder = user_path(arguments.resume)
    settings = folder / _SETTINGS
    try:
        kept: Any = yaml.safe_load((settings / _OPTIONS).read_text(encoding='utf-8'))
        if not isinstance(kept, dict):
            raise ValueError('it holds no options')
    except (OSError, ValueError, yaml.YAMLError) as error:
        if not folder.is_dir():
            raise InputError(f'--resume {folder}: there is no such folder.') from None
        if isinstance(error, FileNotFoundError | NotADirectoryError):
            raise InputError(f'--resume: {folder} holds no session of imu-calib stand.') from None
        reason = error.strerror if isinstance(error, OSError) else ' '.join(str(error).split())
        raise InputError(f'--resume: {settings / _OPTIONS} cannot be read ({reason}).') from None
    _refuse_other_settings(arguments, folder)
    if arguments.port and not kept.get('port'):
        raise InputError(f'--resume {folder}: its hardware is simulated; leave --port out.')
    for name, value in kept.items():
        if name not in _MAY_CHANGE or getattr(arguments, name) == arguments.default_of(name):
            setattr(arguments, name, value)
    _point_at_copies(arguments, settings)
    return folder


def check_unfinished(folder: Path) -> None:
    """Refuse to resume a complete session.

    Raises:
        InputError: It is complete; the text states where the result is, or how to see why there is
            none.
    """
    if not unfinished(folder):
        raise InputError(_complete(folder))


def unfinished(folder: Path) -> bool:
    """Return whether a folder has a session that can be resumed."""
    if not (folder / _SETTINGS / _OPTIONS).is_file():
        return False
    return not is_finished(folder / JOURNAL)


def switched_on_at(folder: Path) -> float:
    """Return when simulated hardware is switched on again, s after its epoch."""
    end = end_of_journal(folder / JOURNAL)
    return 0.0 if end is None else end + _OUTAGE


def command(folder: str) -> str:
    """Return the command that resumes a session in a folder."""
    return f'imu-calib stand --resume {shlex.quote(folder)}'


@contextmanager
def locked_folder(folder: Path) -> Iterator[int]:
    """Lock a folder for this run; yield the file descriptor that its nodes must inherit.

    The lock ends with the last process that has it, in every case.

    Raises:
        InputError: Another stand runs in it.
    """
    descriptor = os.open(folder / _RUNNING, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        _lock(descriptor, folder)
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, str(os.getpid()).encode(), 0)
        yield descriptor
    finally:
        os.close(descriptor)


def _lock(descriptor: int, folder: Path) -> None:
    # What Linux has is imported where it is used.
    import fcntl

    deadline = time.monotonic() + _PATIENCE
    waits = False
    while True:
        with suppress(BlockingIOError):
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        number = os.pread(descriptor, 20, 0).decode(errors='replace')
        if _runs(number):
            raise InputError(
                f'{folder}: the stand of this folder still runs (process {number}). End it with '
                'Ctrl-C first, or let it finish.'
            )
        if time.monotonic() > deadline:
            raise InputError(f'{folder}: nodes of the interrupted stand still run. End them first.')
        if not waits:
            waits = True
            ERRORS.print('The nodes of the interrupted stand are still ending.')
        time.sleep(0.1)


def _runs(number: str) -> bool:
    try:
        os.kill(int(number), 0)
    except (ValueError, ProcessLookupError):
        return False
    except PermissionError:
        return True
    return True


def _point_at_copies(arguments: argparse.Namespace, settings: Path) -> None:
    for option in (*_FILES, 'imus'):
        copy = settings / f'{option}.yaml'
        if copy.is_file():
            setattr(arguments, option, str(copy))


def _refuse_other_settings(arguments: argparse.Namespace, folder: Path) -> None:
    given = [
        name
        for name, value in vars(arguments).items()
        if name not in _OF_THE_RUN
        and name not in _MAY_CHANGE
        and value != arguments.default_of(name)
    ]
    if arguments.output != arguments.default_of('output'):
        given.append('output')
    if given:
        named = ', '.join('PLAN' if n == 'plan' else f'--{n.replace("_", "-")}' for n in given)
        raise InputError(
            f'--resume {folder}: found {named} too, expected at most --port, --baud, --speed and '
            '--without: the session goes on with the settings it began with.'
        )


def _complete(folder: Path) -> str:
    for result in (folder / RESULT, folder / several.CALIBRATIONS):
        if result.is_file() or (result.is_dir() and any(result.iterdir())):
            return f'--resume {folder}: its session is complete; the result is {result}.'
    return (
        f'--resume {folder}: its session has ended without a result and cannot be resumed. '
        f'imu-calib calibrate {shlex.quote(str(folder / JOURNAL))} says why.'
    )


_ORDER = (
    'stand_node',
    'hand_node',
    'ascii_table_node',
    'imu_node',
    'calibrator_node',
    'turntable_node',
)
_START_OF_EACH = 5.0
"""s more for each of several units: a node takes some 2 s of a core to load."""


def check(
    arguments: argparse.Namespace, imu: ImuSpec, plan: Plan, table: Table | None, site: Site
) -> None:
    """Refuse a session that could give no result, or that cannot run here.

    Raises:
        ImuCalibError: There is no middleware for the nodes.
        InputError: The table cannot run the plan, there is no such method, or no table for it.
        NotObservable: The text states what cannot be determined, and why.
    """
    # The runtime is checked only here: the other commands need none.
    with forced('embedded') if several.is_embedded(arguments) else nullcontext():
        from . import monitor  # noqa: F401

    setup = setup_of_stand(options.stated(arguments), imu, plan, table, site)
    check_stand(setup)
    if plan.by_hand and not arguments.port and not has_simulated_hands(setup):
        raise InputError(
            f'Plan {plan.name} is for a hand: give --port, where the IMU is. Simulated hands hold '
            'free positions alone (plan free_positions).'
        )
    if arguments.imperfections:
        true_table_of(arguments.imperfections, table, arguments.seed)


@contextmanager
def signals() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end the session like Ctrl-C: the table first."""
    numbers = [n for n in (signal.SIGTERM, signal.SIGHUP) if signal.getsignal(n) is signal.SIG_DFL]
    for number in numbers:
        signal.signal(number, signal.default_int_handler)
    try:
        yield
    finally:
        for number in numbers:
            signal.signal(number, signal.SIG_DFL)


def run(
    arguments: argparse.Namespace,
    folder: Path,
    truth: Mapping[str, Calibration],
    claim: int,
    reports: NodeReports,
) -> None:
    """Run a checked session, and print the result.

    Args:
        arguments: The command line.
        folder: Of the stand; it exists.
        truth: Of simulated units by serial number; of a single unit by an empty name.
        claim: File descriptor that the nodes inherit.
        reports: Shows the reports of the nodes.

    Raises:
        InputError: A node does not start, or the IMU sends nothing.
        NotObservable: The session gives no calibration; the text states why.
    """
    given = parameters(arguments, folder)
    began = time.monotonic()
    missing: list[str] = []
    try:
        with _nodes(arguments, folder, claim) as processes:
            if processes.environment and arguments.verbose:
                joined = ' '.join(f"{k}='{value}'" for k, value in processes.environment.items())
                OUTPUT.print(f'to watch from another terminal: export {joined}', markup=False)
            outcome = _session(arguments, processes, given, reports)
            # Viewers in a browser must see the result too.
            processes.end_all_but({web_page.NODE})
            if outcome.finished:
                missing = _print_result(arguments, folder, truth, outcome, time.monotonic() - began)
            elif processes.runs(web_page.NODE):
                ERRORS.print(outcome.text, style='red', markup=False)
            web_page.serve_until_interrupted(arguments, processes)
    except NothingComes:
        if not arguments.resume:
            # Nothing was recorded: the same command must work when the device is connected.
            shutil.rmtree(folder)
        raise
    finally:
        if unfinished(folder):
            name = arguments.resume or arguments.output
            arguments.closing_line = f'To go on with it: {command(name)}'
    if missing or not outcome.finished:
        raise NotObservable(outcome.text)


def _print_result(
    arguments: argparse.Namespace,
    folder: Path,
    truth: Mapping[str, Calibration],
    outcome: SessionEnd,
    seconds: float,
) -> list[str]:
    """Print the result and, if known, the truth; return the units without result."""
    if truth:
        _save_true_table(arguments, folder)
    if arguments.imus:
        missing = several.print_results(arguments, folder, truth)
        OUTPUT.print(
            f'\n{outcome.duration:.0f} s of the stand in {seconds:.0f} s; recording: '
            f'{folder / JOURNAL}, results: {folder / several.CALIBRATIONS}'
        )
        return missing
    calibration = Calibration.load(folder / RESULT)
    true = truth.get('')
    if true is not None:
        true.save(folder / 'truth.yaml')
    for part in parameter_tables(calibration, true):
        OUTPUT.print(part)
    OUTPUT.print(
        f'\n{calibration.provenance["samples"]} samples, {outcome.duration:.0f} s of the stand in '
        f'{seconds:.0f} s; recording: {folder / JOURNAL}, result: {folder / RESULT}'
    )
    sentence_list('Worth knowing', [*_of_true_table(arguments, folder), *calibration.findings])
    return []


def _of_true_table(arguments: argparse.Namespace, folder: Path) -> list[str]:
    """Say which comparison with the truth shows errors of a table that is described as exact."""
    table = load_table(arguments.table)
    if not (table.understated_errors and (folder / TRUE_TABLE).exists()):
        return []
    return [
        f'The simulated table has the errors of {folder / TRUE_TABLE}, and its description, '
        f'{table.name}, states none: error/std of the parameters above contains them. Copy the '
        'description, leave out simulated, state what the table has, and give it by --table.'
    ]


def _nodes(arguments: argparse.Namespace, folder: Path, claim: int) -> Nodes:
    """Return what runs the nodes: this process, or one for each."""
    if several.is_embedded(arguments):
        return Embedded(folder, in_step=not (several.is_real(arguments) or arguments.speed))
    return Processes(folder, _network(arguments), (claim,))


def _network(arguments: argparse.Namespace) -> dict[str, str]:
    if not several.is_real(arguments):
        return private_network()
    return network_of_hardware(arguments.network, alone=load_plan(arguments.plan).by_hand)


def _save_true_table(arguments: argparse.Namespace, folder: Path) -> None:
    """Write the differences of the simulated table from its description, if any."""
    if not arguments.imperfections or load_plan(arguments.plan).by_hand:
        return
    table = load_table(arguments.table)
    true = true_table_of(arguments.imperfections, table, arguments.seed)
    if true is not None:
        true.save(folder / TRUE_TABLE, table)


def _session(
    arguments: argparse.Namespace,
    processes: Nodes,
    given: dict[str, dict[str, Any]],
    reports: NodeReports,
) -> SessionEnd:
    """Start the nodes, and monitor them until the session ends."""
    remapped = several.remappings(arguments)
    for node in _in_order(given):
        # One of several units may fail: the others continue.
        needed = '/' not in node
        processes.start(node, given[node], needed=needed, remapped=remapped.get(node, {}))
    if web_page.NODE in given:
        web_page.start(arguments, processes, given[web_page.NODE])
    if load_plan(arguments.plan).by_hand:
        return follow(processes, reports)
    site = options.stated(arguments).site(LUOYANG)
    plan, table = load_plan(arguments.plan), load_table(arguments.table)
    imu = load_imu(several.units_of(arguments)[0].imu)
    setup = setup_of_stand(options.stated(arguments), imu, plan, table, site)
    board: Board | UnitsBoard
    if arguments.imus:
        board = units_board(setup, several.units_of(arguments))
    else:
        board = Board(expectation(setup))
    return _follow(processes, reports, board, control=arguments.control)


def _in_order(given: Mapping[str, Any]) -> list[str]:
    """Return the nodes in the order of their start, without the page's."""
    names = {node: node.rpartition('/')[2] for node in given}
    known = [node for node, name in names.items() if name in _ORDER]
    return sorted(known, key=lambda node: _ORDER.index(names[node]))


def parameters(arguments: argparse.Namespace, folder: Path) -> dict[str, dict[str, Any]]:
    """Return the parameters of every node to run."""
    several.complete(arguments)
    simulated = not several.is_real(arguments)
    named = {name: getattr(arguments, name) for name in AtSite.__annotations__}
    stated_site = {'latitude': LUOYANG} | {n: v for n, v in named.items() if v is not None}
    site = {name: value for name, value in stated_site.items() if not name.endswith('_std')}
    clock = {'use_sim_time': simulated}
    apart = simulated and not several.is_embedded(arguments)
    port = free_ports(len(several.units_of(arguments))) if apart else 0
    described = {'table': arguments.table}
    if arguments.imus:
        described |= {'units': arguments.imus, 'without': arguments.without}
    else:
        described |= {'imu': arguments.imu}
    result = several.CALIBRATIONS if arguments.imus else RESULT
    nodes: dict[str, dict[str, Any]] = {
        **several.node_parameters(arguments, clock, port),
        'calibrator_node': {
            **clock,
            **described,
            **stated_site,
            'plan': arguments.plan,
            'method': arguments.method or '',
            'terms': arguments.terms or DEFAULT_TERMS,
            'serial_number': arguments.serial or '',
            'journal': str(folder / JOURNAL),
            'output': str(folder / result),
        },
        'turntable_node': {
            **clock,
            'plan': arguments.plan,
            'table': arguments.table,
            'autostart': True,
            'resume': bool(arguments.resume),
            'stop_required': arguments.stop_required,
        },
    }
    # The node that simulates the stand, or the hand.
    played = {
        'truth': arguments.truth,
        'imperfections': arguments.imperfections or '',
        'sample_rate': arguments.sample_rate,
        'seed': arguments.seed,
        'start': arguments.start,
        'speed': arguments.speed,
        'port': port,
    }
    if load_plan(arguments.plan).by_hand:
        del nodes['turntable_node'], nodes['calibrator_node']['table']
        if simulated:
            nodes['hand_node'] = {
                **site,
                'imu': arguments.imu,
                **played,
            }
        return nodes | web_page.parameters(arguments, nodes['calibrator_node'])
    if arguments.table_port:
        nodes['ascii_table_node'] = {
            'table': arguments.table,
            'port': arguments.table_port,
            'baud': arguments.table_baud,
        }
    if simulated:
        # Simulated time stands still while a busy machine catches up: this is not silence.
        nodes['turntable_node'] |= {'watchdog_timeout': 10.0, 'calibrator_timeout': 10.0}
        # A stop pressed on this table must not affect the next one.
        nodes['turntable_node']['state_folder'] = str(folder / 'state')
        nodes['stand_node'] = {
            **described,
            **site,
            'azimuth': arguments.azimuth,
            **played,
        }
    return nodes | web_page.parameters(arguments, nodes['calibrator_node'])


def _follow(
    processes: Nodes,
    reports: NodeReports,
    board: Board | UnitsBoard,
    *,
    control: bool,
) -> SessionEnd:
    """Monitor the session until it ends, and show its progress.

    Args:
        processes: The nodes.
        reports: Shows the reports of the nodes.
        board: Holds the displayed state.
        control: Whether a viewer can resume a table that has stopped.
    """
    from .monitor import watching

    with (
        watching(processes, reports, board) as monitor,
        Live(console=ERRORS, refresh_per_second=4, transient=True) as display,
    ):
        several_units = len(board.names) if isinstance(board, UnitsBoard) else 0
        start = Start(reports, START + _START_OF_EACH * several_units)
        shown = ''
        while True:
            monitor.spin(0.1)
            processes.check()
            now = time.monotonic()
            units = board.unit_rows(now) if isinstance(board, UnitsBoard) else ()
            screen = view_table(board.snapshot(now), datetime.now(), ERRORS.width, units)
            reading = '' if monitor.is_running else start.words
            display.update(Text(reading) if reading else screen)
            if monitor.outcome is not None:
                return SessionEnd(*monitor.outcome, monitor.duration)
            if monitor.stopped and not control:
                return SessionEnd(
                    False, f'The table has stopped. {monitor.stopped}', monitor.duration
                )
            if monitor.stopped != shown:
                shown = monitor.stopped
                if shown:
                    text = (
                        f'The table has stopped. {shown} Go on from the page, or end with Ctrl-C.'
                    )
                    ERRORS.print(text, style='yellow', markup=False)
            if not monitor.is_running:
                start.check(f'The stand does not start: {monitor.text}.')


# Check the first bytes of the IMU before anything starts: whether it is present and as described.
#
# The nodes would detect this too, but later: they load slowly and must discover each other.


_ROUND = 0.02
"""Between two checks, s: too short to be noticed."""

_LONGEST = 3.0
"""Longest wait, s: longer than a host may take to answer (2 s). The nodes wait for slower ones."""


def listen(
    port: str,
    frames: FrameFormat,
    imu: ImuSpec,
    baud: Baud,
    reports: NodeReports,
    node: str = 'imu_node',
) -> None:
    """Read until the device is confirmed to be the described one, or its silence is reported.

    Args:
        port: As for `Source`; it is closed at the end.
        frames: The format of the device's frames.
        imu: Description of its numbers.
        baud: Of a serial port.
        reports: Shows messages.
        node: Name of the node shown in messages.

    Raises:
        InputError: The port is invalid.
        NothingComes: It does not open, or its data does not match the files.
    """
    # imu_node continues with the present state of the device.
    source = Source(port, time.time_ns, baud.rate, commands=frames.commands, restarts=False)
    reception = Reception(frames, imu, live=source.live)
    source.start()
    deadline = time.monotonic() + _LONGEST
    try:
        while time.monotonic() < deadline and not _decided(source, reception, reports, node):
            time.sleep(_ROUND)
    finally:
        source.stop()


def _decided(source: Source, reception: Reception, reports: NodeReports, node: str) -> bool:
    """Take new bytes, and show messages; return whether the check is complete."""
    state, now, steady = source.state, time.time_ns(), steady_time() * 1e-9
    chunks = source.take()
    if chunks:
        reception.take(chunks, now, steady)
    silent = came = False
    for status in reception.statuses(state, now, steady):
        came |= status.figures.get('bytes', '0') != '0'
        silent |= status.part == 'stream' and status.severity is Severity.ERROR
        reports.note(f'{node}: {status.part}', status.severity, status.text, came=came)
    reports.show()
    if state.ended:
        # A short recording: no more data will come.
        return reception.health.has_frames and not chunks
    return reception.health.judged or (state.open and silent and not came)
