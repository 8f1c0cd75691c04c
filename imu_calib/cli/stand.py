"""A live stand, and the keys of its nodes: imu-calib stand, security."""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path

from ..api.session import HELD_UNIT, USUAL_IMU, SimulatedHardware
from ..calibration.calibration import Calibration
from ..common.errors import InputError
from ..common.files import is_shipped, shipped, unwritable, user_path
from ..live.devices.format import FrameFormat, load_format
from ..live.devices.health import Reception
from ..live.devices.source import (
    Baud,
    DeviceReader,
    check_port,
    choose_baud,
    is_serial,
    steady_time,
    too_slow,
)
from ..live.network import enclave, make_keystore
from ..live.rules import Severity
from ..live.table_line import STATE_LINE, BadReply, ControllerLine, parse_state
from ..model.earth import LUOYANG
from ..session.imu import ImuSpec, check_live, load_imu
from ..session.keywords import AtSite, Numbered, Solved, azimuth_of
from ..session.plan import load_plan
from ..session.table import load_table
from . import options, several, web_page
from .outcome import OUTSIDE, CommandResult, add_specification_option
from .processes import network_of_hardware
from .terminal import OUTPUT, NodeReports

_SLOWEST = 50  #: The slowest rate of a serial port that POSIX names, bit/s.
_REPLY = 2.0  #: s for a controller's first reply: milliseconds; one that wakes may take a second.
_HIGHEST_RATE, _LARGEST_SEED = 1e5, 1 << 62
"""Hz, and a seed: the largest parameters that nodes take (`imu_node`, `parameters.declare`)."""


def add_stand_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument('plan', metavar='PLAN', nargs='?', help='name of a plan, or a file')
    parser.add_argument(
        '--resume',
        metavar='FOLDER',
        help='instead of a plan: resume the interrupted session of a folder',
    )
    parser.add_argument(
        '-o', '--output', default='stand', metavar='DIR', help='folder to create (default: stand)'
    )
    parser.add_argument(
        '--imu',
        metavar='NAME|FILE',
        help=f'default: {USUAL_IMU}; {HELD_UNIT} where the unit is held by hand',
    )
    options.add_imus_option(parser)
    several.add_options(parser)
    parser.add_argument(
        '--table', default='three_axis', metavar='NAME|FILE', help='default: %(default)s'
    )
    options.add_statements(parser, Solved)
    options.add_statements(parser, Numbered)
    options.add_statements(parser, AtSite)
    parser.add_argument(
        '--processes',
        action='store_true',
        help=(
            "run each node as a process of its own on ROS 2's wire, where other programs can "
            'watch; so it is with a table that another program drives'
        ),
    )
    parser.add_argument(
        '--verbose',
        action='store_true',
        help='print all tables and notes; also the network variables by which other programs watch',
    )
    add_specification_option(parser)
    web_page.add_options(parser)
    real = parser.add_argument_group(
        'real hardware',
        'Without --table-port the table is led by setpoints in the ROS domain of the environment, '
        'which must not be the default one, on the loopback interface.',
    )
    real.add_argument('--port', metavar='URL', help='where the IMU is, for instance /dev/ttyUSB0')
    real.add_argument(
        '--device', default='', metavar='NAME|FILE', help="format of the IMU's frames"
    )
    real.add_argument(
        '--baud',
        type=int,
        metavar='BIT/S',
        help="baud rate of a serial port (default: as the device's file says, else 115200)",
    )
    real.add_argument(
        '--table-port',
        metavar='URL',
        help=(
            "the table's port, serial or socket://host:port; its controller speaks the line "
            'protocol of docs/tables.md, and all nodes run in this process, without ROS'
        ),
    )
    real.add_argument(
        '--table-baud',
        type=int,
        default=115200,
        metavar='BIT/S',
        help='baud rate of that port (default: %(default)s)',
    )
    real.add_argument(
        '--network',
        metavar='INTERFACE',
        help=(
            'use that network interface, for instance eth0, not this machine alone: anyone on that '
            'network can then lead the table, unless SROS 2 is enforced'
        ),
    )
    real.add_argument(
        '--stop-required',
        action='store_true',
        help='nothing moves without a heartbeat on the topic heartbeat',
    )
    simulated = parser.add_argument_group(
        'simulated hardware', 'Faults come on a topic while it runs: docs/stand.md lists them.'
    )
    options.add_statements(simulated, SimulatedHardware)
    parser.set_defaults(start=0.0, default_of=parser.get_default)


def run_stand(arguments: argparse.Namespace) -> CommandResult:
    """Run a plan live, on a real or a simulated stand."""
    if arguments.resume:
        folder = _resume_session(arguments)
    elif arguments.plan:
        folder = _begin(arguments)
    else:
        raise InputError('Give a PLAN (imu-calib plans lists them), or --resume FOLDER.')
    return _judged(arguments, folder) if arguments.specification else CommandResult()


def _judged(arguments: argparse.Namespace, folder: Path) -> CommandResult:
    """Compare the results of a session with the specifications of the units' types."""
    from ..api.compare import conformity
    from .resume import RESULT

    sentences = []
    for unit in several.units_of(arguments):
        serial = unit.serial_number
        file = f'{several.CALIBRATIONS}/{serial}.yaml' if arguments.imus else RESULT
        if text := conformity(folder / file, unit.imu).sentence():
            sentences.append(f'{serial}: {text}' if arguments.imus else text)
    return CommandResult(None, OUTSIDE, ' '.join(sentences)) if sentences else CommandResult()


def _begin(arguments: argparse.Namespace) -> Path:
    """Run a session from its start; return its folder."""
    several.complete(arguments)
    folder = _new_folder(arguments)
    several.check(arguments)
    reports = NodeReports(real=several.is_real(arguments))
    truth = _check(arguments, reports)
    if '' in truth and not arguments.truth and not is_shipped('imus', arguments.imu):
        usual = several.usual_truth(arguments)
        OUTPUT.print(f'simulated unit: {usual}; yours: --truth FILE', markup=False)
    from . import resume, stand_session

    folder.mkdir(parents=True)
    with resume.locked_folder(folder) as claim, stand_session.signals():
        _save_settings(arguments, folder, truth.get(''))
        stand_session.run(arguments, folder, truth, claim, reports)
    return folder


def _save_settings(arguments: argparse.Namespace, folder: Path, truth: Calibration | None) -> None:
    """Write the settings of a new session, or leave no folder that could not be resumed."""
    from ..api.files import removed_on_failure
    from . import resume

    try:
        with removed_on_failure(folder):
            resume.save_settings(arguments, folder, truth)
    except OSError as error:
        raise InputError(unwritable(folder, error)) from None


def _resume_session(arguments: argparse.Namespace) -> Path:
    """Resume an interrupted session; return its folder."""
    from . import resume, stand_session

    folder = resume.restore(arguments)
    several.complete(arguments)
    # Nodes of the interrupted stand that are still ending occupy the port.
    with resume.locked_folder(folder) as claim, stand_session.signals():
        resume.check_unfinished(folder)
        several.check(arguments)
        real = several.is_real(arguments)
        reports = NodeReports(real=real)
        truth = _check(arguments, reports)
        arguments.start = 0.0 if real else resume.switched_on_at(folder)
        stand_session.run(arguments, folder, truth, claim, reports)
    return folder


def _new_folder(arguments: argparse.Namespace) -> Path:
    """Return the folder to create."""
    folder = user_path(arguments.output)
    if not folder.exists():
        return folder
    from ..api.stand import can_be_resumed
    from . import resume

    if can_be_resumed(folder):
        raise InputError(
            f'{folder} exists already and holds a session that was interrupted. Go on with it: '
            f'{resume.command(arguments.output)}, or name another folder with -o.'
        )
    raise InputError(
        f'{folder} exists already; recordings are not overwritten. Name another folder with -o.'
    )


def _check(arguments: argparse.Namespace, reports: NodeReports) -> dict[str, Calibration]:
    """Refuse what cannot work before anything moves; return the true parameters of a simulation.

    They are keyed by serial number; for a single unit by an empty name.
    """
    web_page.check(arguments)
    _check_table_port(arguments)
    _check_run(arguments)
    if arguments.imus:
        _refuse_for_several(arguments)
    else:
        _refuse_for_one(arguments)
    site, plan = options.stated(arguments).site(LUOYANG), load_plan(arguments.plan)
    units, real = several.units_of(arguments), several.is_real(arguments)
    types = {unit.imu: load_imu(unit.imu) for unit in units}
    table = None if plan.by_hand else load_table(arguments.table)
    if real:
        if not several.is_embedded(arguments):
            network_of_hardware(arguments.network, alone=plan.by_hand)
        reports.nodes = [several.node_of(unit) for unit in units]
        for unit in units:
            imu, frames = types[unit.imu], load_format(several.device_of(unit, arguments))
            baud = choose_baud(unit.baud or None, frames)
            if not arguments.imus and is_serial(unit.port):
                _say_baud(arguments, frames, imu, baud)
            rate = arguments.sample_rate
            listen(unit.port, frames, imu, baud, reports, several.node_of(unit), rate)
    # Loading what runs a session takes longer than the check of the IMU.
    from ..api.compare import specification_of
    from . import stand_session

    for imu in types.values():
        if arguments.specification:
            specification_of(imu)
        if not real:
            check_live(imu)
        stand_session.check(arguments, imu, plan, table, site)
    return {} if real else several.truths(arguments)


def _refuse_for_one(arguments: argparse.Namespace) -> None:
    """Refuse options that do not apply to one unit."""
    _check_baud(arguments)
    if arguments.port:
        if arguments.imperfections:
            raise InputError('--imperfections is for simulated hardware; leave it out with --port.')
        _check_device(arguments)
    elif arguments.network:
        raise InputError('--network: simulated hardware stays on this machine; leave it out.')
    elif arguments.device:
        raise InputError('--device: simulated hardware has frames of its own; give --port, too.')


def _refuse_for_several(arguments: argparse.Namespace) -> None:
    """Refuse options that do not apply to several units."""
    real = several.is_real(arguments)
    if real and arguments.imperfections:
        raise InputError('--imperfections is for simulated hardware; leave it out with ports.')
    if real and arguments.latitude is None:
        raise InputError('--imus: give --latitude, of a real stand, in degrees.')
    if not real and (arguments.network or arguments.device):
        name = '--network' if arguments.network else '--device'
        raise InputError(f'{name} is for real hardware; {arguments.imus} names no port.')


def _check_run(arguments: argparse.Namespace) -> None:
    """Refuse numbers that nodes would refuse, and a heartbeat that none could receive."""
    if not (arguments.speed >= 0 and math.isfinite(arguments.speed)):
        raise InputError(f'--speed: found {arguments.speed:g}, expected 0 or more.')
    if not 0 <= arguments.sample_rate <= _HIGHEST_RATE:
        found = arguments.sample_rate
        raise InputError(f'--sample-rate: found {found:g} Hz, expected 0 to {_HIGHEST_RATE:g}.')
    if not 0 <= arguments.seed <= _LARGEST_SEED:
        raise InputError(f'--seed: found {arguments.seed}, expected 0 to {_LARGEST_SEED}.')
    if arguments.stop_required and several.is_embedded(arguments):
        raise InputError(
            '--stop-required: no heartbeat of another program reaches the nodes in this process; '
            'give --processes, too.'
        )
    azimuth_of(arguments.azimuth)


def _check_table_port(arguments: argparse.Namespace) -> None:
    """Refuse a controller's port where the table is simulated, or there is none."""
    if not arguments.table_port:
        return
    if not several.is_real(arguments):
        raise InputError('--table-port: the table of a simulated unit is simulated; give --port.')
    if load_plan(arguments.plan).by_hand:
        raise InputError(f'--table-port: plan {arguments.plan} needs no table; leave it out.')
    if arguments.table_baud < _SLOWEST:
        found = arguments.table_baud
        raise InputError(f'--table-baud: found {found}, expected {_SLOWEST} bit/s or more.')
    axes = len(load_table(arguments.table).joints)
    try:
        line = ControllerLine(arguments.table_port, arguments.table_baud, _REPLY)
        try:
            parse_state(line.request(STATE_LINE), axes)
        finally:
            line.close()
    except (OSError, BadReply) as error:
        raise InputError(
            f'--table-port: the controller at {arguments.table_port} gives no state of its axes '
            f'({error}). Switch it on, and check port, baud rate and --table.'
        ) from None


def _check_baud(arguments: argparse.Namespace) -> None:
    """Refuse an invalid rate of a serial port, or one for another port."""
    if arguments.baud is None:
        return
    if not arguments.port:
        raise InputError('--baud: simulated hardware has no serial port; give --port, too.')
    if not is_serial(arguments.port):
        raise InputError(f'--baud: {arguments.port} is not a serial port; leave --baud out.')
    if arguments.baud < _SLOWEST:
        raise InputError(f'--baud: found {arguments.baud}, expected {_SLOWEST} bit/s or more.')


def _say_baud(arguments: argparse.Namespace, frames: FrameFormat, imu: ImuSpec, baud: Baud) -> None:
    """Report the rate of a serial port, and whether its frames fit."""
    OUTPUT.print(f'{arguments.port} is read at {baud}.', markup=False)
    rate = arguments.sample_rate or imu.sample_rate
    if sentence := too_slow(baud.rate, frames, rate):
        OUTPUT.print(sentence, markup=False)


def _check_device(arguments: argparse.Namespace) -> None:
    """Refuse a device that cannot be read."""
    missing = []
    if not arguments.device:
        missing.append(
            "--device, the format of the frames that come there: a device's name "
            f'({shipped("devices")}), or a file of your own (docs/devices.md)'
        )
    if arguments.latitude is None:
        missing.append('--latitude, of a real stand, in degrees')
    if missing:
        raise InputError(f'--port needs {"; and ".join(missing)}.')
    load_format(arguments.device)
    check_port(arguments.port)


# The first bytes of the IMU before anything starts: whether it is present and as described.
# #
# # The nodes would detect this too, but later: they load slowly and must discover each other.


_ROUND = 0.02  #: Between two checks, s: too short to be noticed.
_LONGEST_WAIT = 3.0
"""Longest wait, s: longer than a host may take to answer (2 s). The nodes wait for slower ones."""


def listen(
    port: str,
    frames: FrameFormat,
    imu: ImuSpec,
    baud: Baud,
    reports: NodeReports,
    node: str = 'imu_node',
    sample_rate: float = 0.0,
) -> None:
    """Read a port until the device is confirmed, or its silence or another device is reported."""
    # imu_node continues with the present state of the device.
    source = DeviceReader(port, time.time_ns, baud.rate, commands=frames.commands, restarts=False)
    reception = Reception(frames, imu, sample_rate, live=source.live)
    source.start()
    deadline = time.monotonic() + _LONGEST_WAIT
    try:
        while time.monotonic() < deadline and not _decided(source, reception, reports, node):
            time.sleep(_ROUND)
    finally:
        source.stop()


def _decided(source: DeviceReader, reception: Reception, reports: NodeReports, node: str) -> bool:
    """Take new bytes, and show messages; return whether the check is complete."""
    state, now, steady = source.state, time.time_ns(), steady_time() * 1e-9
    chunks = source.pop_chunks()
    if chunks:
        reception.decode_chunks(chunks, now, steady)
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


def add_security_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument('keystore', metavar='KEYSTORE', help='folder to create or update')
    parser.add_argument(
        '--namespace', default='', metavar='NAME', help='ROS domain of the nodes of the stand'
    )
    parser.add_argument(
        '--policy', metavar='FILE', help='policy of your own (default: config/security/policy.xml)'
    )


def run_security(arguments: argparse.Namespace) -> None:
    """Make the keystore with which a stand's nodes prove their identity."""
    keystore = user_path(arguments.keystore).absolute()
    policy = None if arguments.policy is None else user_path(arguments.policy)
    enclaves = make_keystore(keystore, arguments.namespace, policy)
    OUTPUT.print(f'{keystore} holds the keys of:', markup=False)
    for name in enclaves:
        OUTPUT.print(f'  {name}', markup=False)
    OUTPUT.print(
        f'Where nodes of the stand run:\n  export ROS_SECURITY_KEYSTORE={keystore} '
        'ROS_SECURITY_ENABLE=true ROS_SECURITY_STRATEGY=Enforce\nand in the terminal of the person '
        'who leads the stand:\n  export '
        f'ROS_SECURITY_ENCLAVE_OVERRIDE={enclave("operator")}\n{keystore / "private"} signs the '
        'keys that the stand trusts: keep it on a machine where no node runs.',
        markup=False,
        soft_wrap=True,
    )
