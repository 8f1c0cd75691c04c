"""A session of `imu-calib stand`: its nodes, from their start to the result."""

from __future__ import annotations

import argparse
import shutil
import signal
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

from rich.console import Group
from rich.live import Live
from rich.text import Text

from ..api.session import TRUE_TABLE
from ..api.stand import (
    can_be_resumed,
    check_stand,
    has_simulated_hands,
    setup_of_stand,
    true_table_of,
    truth_in_session,
)
from ..calibration.calibration import Calibration
from ..common.errors import InputError, NotObservable
from ..live.network import forced
from ..live.web.board import Board, UnitsBoard, expectation, units_board
from ..model.earth import LUOYANG, Site
from ..recordings.rosbag2 import JOURNAL
from ..session.imu import ImuSpec, load_imu
from ..session.keywords import DEFAULT_TERMS, AtSite
from ..session.plan import Plan, load_plan
from ..session.table import Table, load_table
from . import options, several, web_page
from .displays import Start, follow, view_table
from .processes import (
    START,
    Embedded,
    Nodes,
    Processes,
    SessionEnd,
    free_ports,
    network_of_hardware,
    private_network,
)
from .resume import RESULT, command, ended
from .terminal import (
    ERRORS,
    OUTPUT,
    ROOM,
    NodeReports,
    NothingComes,
    print_findings,
    print_text,
    show_calibration,
)

_ORDER = (
    'stand_node',
    'hand_node',
    'ascii_table_node',
    'imu_node',
    'calibrator_node',
    'turntable_node',
)
_START_OF_EACH = 5.0  #: s more for each of several units: a node takes some 2 s of a core to load.


def check(
    arguments: argparse.Namespace, imu: ImuSpec, plan: Plan, table: Table | None, site: Site
) -> None:
    """Refuse a session that could give no result, or that cannot run here."""
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
    except KeyboardInterrupt:
        arguments.closing_line = ended(folder)
        raise
    finally:
        if can_be_resumed(folder):
            name = arguments.resume or arguments.output
            arguments.closing_line = f'To go on with it: {command(name)}'
    if missing:
        raise NotObservable(f'No calibration of {", ".join(missing)}: see above.')
    if not outcome.finished:
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
        missing = several.print_results(arguments, folder, truth, outcome.text)
        OUTPUT.print(
            f'\n{outcome.duration:.0f} s of the stand in {seconds:.0f} s; recording: '
            f'{folder / JOURNAL}, results: {folder / several.CALIBRATIONS}'
        )
        return missing
    # The file of a result lacks what the data sheet states: noise and limits.
    calibration = replace(Calibration.load(folder / RESULT), imu=load_imu(arguments.imu))
    true = truth.get('')
    if true is not None:
        true.save(folder / 'truth.yaml')
    hints = _true_table_hint(arguments, folder)
    if true is not None and arguments.imperfections:
        table = None if load_plan(arguments.plan).by_hand else load_table(arguments.table)
        true, of_unit = truth_in_session(true, calibration, arguments.imperfections, table)
        hints += of_unit
    show_calibration(calibration, true, verbose=arguments.verbose)
    findings = [*hints, *calibration.findings]
    print_findings(findings, verbose=arguments.verbose, room=ROOM)
    print_text(
        f'{outcome.duration:.0f} s of the stand in {seconds:.0f} s; recording: '
        f'{folder / JOURNAL}, result: {folder / RESULT}'
    )
    return []


def _true_table_hint(arguments: argparse.Namespace, folder: Path) -> list[str]:
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
    lead = Text(web_page.how_to_lead(arguments), style='dim')
    return _follow(processes, reports, board, lead, control=arguments.control)


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
        # The settings of a session state that of each unit.
        'truth': arguments.truth or several.usual_truth(arguments),
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
        nodes['calibrator_node']['imu_timeout'] = 10.0
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
    lead: Text,
    *,
    control: bool,
) -> SessionEnd:
    """Monitor the session until it ends, and show its progress; with `control` a stop is no end."""
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
            display.update(Text(reading) if reading else Group(screen, lead))
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
