"""What a session is made of, from the command line, or from what the recording says of itself."""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..calibration import Calibration
from ..cdr import Kind
from ..config import Section
from ..earth import HEIGHT_STD, LATITUDE_STD, MEASURED, NORMAL_GRAVITY_STD, Site
from ..errors import InputError
from ..imu import ImuSpec, load_imu, read_imu
from ..model import AUTO_TERMS, NO_TERMS, TERMS, Term, chosen, looked_for
from ..model.session_terms import SESSION_TERMS, Change, parted
from ..plan import UNPLANNED, Plan, load_plan, read_plan
from ..session import SERIAL_NUMBER, described_imu, described_site, imu_key
from ..share import named_file
from ..turntable import Table, load_table, read_table
from ..units import DEG

if TYPE_CHECKING:
    # Costs more to load than most commands need.
    from ..bags import Recording, Topic

NO_PLAN = 'none'
"""What --plan says where no plan was run, or the recording's own is not to be used."""

_SKEW = 'imu/skew'
_TEMPERATURE = 'imu/temperature'


TRUE_TABLE = 'true_table.yaml'
"""Beside a simulated recording: the table as it truly is, where it is not as described."""


def add_imperfections_option(parser: argparse._ActionsContainer) -> None:
    """Add what is wrong with a simulated stand."""
    parser.add_argument(
        '--imperfections',
        metavar='NAME|FILE',
        help='what is wrong with the stand: axes, wobble, zeros and encoders of the table in '
        'arcsec, arrivals, ramps in deg/s^2, stamps in ms, samples lost or sent twice in %%, '
        'frozen counts in s, ringing, a floor that shakes, temperature, warm-up of the biases '
        f'(shipped: {shipped("imperfections")}; docs/simulation.md; default: nothing). The table '
        f'as it then truly is goes to {TRUE_TABLE}',
    )


def add_site_options(parser: argparse.ArgumentParser) -> None:
    """Add --latitude, --height and --gravity, with their standard deviations."""
    parser.add_argument(
        '--latitude', type=float, metavar='DEG', help='degrees, negative in the south'
    )
    parser.add_argument(
        '--latitude-std',
        type=float,
        metavar='DEG',
        help=f'standard deviation of --latitude (default: {LATITUDE_STD / DEG:g})',
    )
    parser.add_argument(
        '--height',
        type=float,
        metavar='M',
        help=f'metres above the ellipsoid (default: 0, in doubt by {HEIGHT_STD:g} m); it says what '
        'gravity is, and does not count beside --gravity',
    )
    parser.add_argument(
        '--height-std',
        type=float,
        metavar='M',
        help='standard deviation of --height (default: 0)',
    )
    parser.add_argument(
        '--gravity',
        type=float,
        metavar='M/S2',
        help='local gravity as measured, m/s^2 (default: normal gravity)',
    )
    parser.add_argument(
        '--gravity-std',
        type=float,
        metavar='M/S2',
        help='standard deviation of gravity (default: 0 for a measured one, '
        f'{NORMAL_GRAVITY_STD:g} for normal gravity at a known height)',
    )


def add_serial_option(parser: argparse.ArgumentParser) -> None:
    """Add --serial."""
    parser.add_argument(
        '--serial',
        metavar='NUMBER',
        help="serial number of the unit (default: the recording's, where it says)",
    )


def add_session_options(parser: argparse.ArgumentParser) -> None:
    """Add what says how a recording is to be read and solved."""
    add_recording_options(parser)
    add_method_option(parser)
    add_serial_option(parser)


def add_method_option(parser: argparse.ArgumentParser) -> None:
    """Add --method and --terms."""
    parser.add_argument(
        '--method',
        metavar='NAME',
        help="the estimator (default: joint where it applies, else the plan's own)",
    )
    names = ', '.join([*(term.name for term in TERMS), *SESSION_TERMS])
    parser.add_argument(
        '--terms',
        metavar='NAME,NAME',
        help=f'what the joint estimate adds to the 24 parameters: {AUTO_TERMS}, those that the '
        f'session shows; {NO_TERMS}; or of {names} (default: {AUTO_TERMS})',
    )


def find_terms(arguments: argparse.Namespace) -> tuple[Term, ...]:
    """Return the terms that --terms names.

    Raises:
        InputError: No such term.

    """
    return chosen(parted(_terms(arguments))[0])


def find_changes(arguments: argparse.Namespace) -> tuple[Change, ...]:
    """Return the coefficients of the session's terms that --terms names.

    Raises:
        InputError: No such term, or two that exclude each other.

    """
    return parted(_terms(arguments))[1]


def find_look(arguments: argparse.Namespace) -> bool:
    """Return whether terms that the session shows are to be estimated too."""
    return looked_for(_terms(arguments))


def _terms(arguments: argparse.Namespace) -> str:
    return AUTO_TERMS if arguments.terms is None else str(arguments.terms)


def add_recording_options(parser: argparse.ArgumentParser) -> None:
    """Add what says how a recording is to be read."""
    parser.add_argument(
        '--plan',
        metavar='NAME|FILE',
        help="the plan that was run (default: the recording's own, else none); "
        f'{NO_PLAN}: no plan, joint states tell the attitudes',
    )
    parser.add_argument('--imu', metavar='NAME|FILE', help="what the IMU's numbers mean")
    parser.add_argument('--table', metavar='NAME|FILE', help='the turntable (default: three_axis)')
    parser.add_argument(
        '--azimuth', type=float, metavar='DEG', help="heading of the table's zero against north"
    )
    parser.add_argument('--imu-topic', metavar='TOPIC', help='sensor_msgs/Imu topic')
    parser.add_argument('--joint-topic', metavar='TOPIC', help='sensor_msgs/JointState topic')
    parser.add_argument('--setpoint-topic', metavar='TOPIC', help='TurntableSetpoint topic')
    parser.add_argument(
        '--imu-only', action='store_true', help='use the IMU and the order of the plan alone'
    )
    add_site_options(parser)


@dataclass(frozen=True)
class Streams:
    """Names of the topics to read; None where the recording has none."""

    imu: str
    joints: str | None
    setpoints: str | None
    skew: str | None = None
    temperature: str | None = None

    def kinds(self) -> dict[str, Kind]:
        """Return what each topic carries."""
        named = {self.imu: Kind.IMU}
        if self.joints is not None:
            named[self.joints] = Kind.JOINTS
        if self.setpoints is not None:
            named[self.setpoints] = Kind.SETPOINTS
        if self.skew is not None:
            named[self.skew] = Kind.SKEW
        if self.temperature is not None:
            named[self.temperature] = Kind.TEMPERATURES
        return named


def find_plan(
    arguments: argparse.Namespace, data: Mapping[str, str], where: str, streams: Streams
) -> Plan:
    """Return the plan of a recording; none is needed where joint states tell the attitudes.

    Raises:
        InputError: There is neither, or the file is broken.

    """
    if (plan := stated_plan(arguments, data, where)) is not None:
        return plan
    if streams.joints is not None:
        return UNPLANNED
    raise InputError(
        f'{where} does not say which plan was run: give --plan ({shipped("plans")}). '
        'None is needed where joint states of a table tell the attitudes; here are none.'
    )


def stated_plan(arguments: argparse.Namespace, data: Mapping[str, str], where: str) -> Plan | None:
    """Return the plan of the command line, or the one that the recording carries; None without.

    Raises:
        InputError: The file is broken.

    """
    if arguments.plan == NO_PLAN:
        return None
    if arguments.plan is not None:
        return load_plan(arguments.plan)
    if 'imu_calib.plan' in data:
        return read_plan(Section.parse(data['imu_calib.plan'], f'{where}: its plan'))
    return None


def find_imu(
    arguments: argparse.Namespace, data: Mapping[str, str], where: str, topic: str
) -> ImuSpec:
    """Return the IMU of the command line, or the one that the recording carries for a topic.

    Raises:
        InputError: There is neither, or the file is broken.

    """
    if (stated := stated_imu(arguments, data, where, topic)) is not None:
        return stated[0]
    raise InputError(
        f"{where} does not say what the IMU's numbers mean: "
        f'give --imu ({shipped("imus")}, or a file).'
    )


def stated_imu(
    arguments: argparse.Namespace, data: Mapping[str, str], where: str, topic: str
) -> tuple[ImuSpec, str] | None:
    """Return what is said of the IMU behind a topic, and who says it; None where nobody does.

    Raises:
        InputError: The file is broken.

    """
    text, says = described_imu(data, topic), f'{where}: its IMU'
    described = None if text is None else read_imu(Section.parse(text, says))
    if arguments.imu is None:
        return None if described is None else (described, says)
    given = load_imu(arguments.imu)
    if described is not None and imu_key(topic) in data and given.units is not described.units:
        raise InputError(
            f'--imu {arguments.imu}: units: found {given.units.value}, but {topic} of {where} was '
            f'computed from the raw stream and holds {described.units.value}: leave --imu out.'
        )
    return given, arguments.imu


def find_serial(arguments: argparse.Namespace, data: Mapping[str, str], where: str) -> str:
    """Return the serial number of the command line or of the recording; empty without one.

    Raises:
        InputError: The two differ.

    """
    said = data.get(SERIAL_NUMBER, '')
    given: str | None = arguments.serial
    if given is not None and said and given != said:
        raise InputError(
            f'--serial: found {given}, but {where} is of the unit with serial number {said}.'
        )
    return given or said


def find_table(arguments: argparse.Namespace, data: Mapping[str, str], where: str) -> Table:
    """Return the table of the command line, of the recording, or the three-axis table."""
    if arguments.table is not None:
        table = load_table(arguments.table)
    elif 'imu_calib.table' in data:
        table = read_table(Section.parse(data['imu_calib.table'], f'{where}: its table'))
    else:
        table = load_table('three_axis')
    if arguments.azimuth is not None:
        if not math.isfinite(arguments.azimuth):
            raise InputError(f'--azimuth: found {arguments.azimuth}, expected degrees.')
        table = replace(table, azimuth=arguments.azimuth * DEG)
    return table


def find_site(arguments: argparse.Namespace, data: Mapping[str, str], where: str) -> Site:
    """Return the site of the command line, or the one that the recording carries.

    What the command line says of height and gravity counts at the recording's latitude too.

    Raises:
        InputError: Nobody says where it was taken, or no place on Earth is there.

    """
    if arguments.latitude is not None:
        return site_at(arguments, arguments.latitude)
    own = described_site(data, where)
    height, gravity = arguments.height, arguments.gravity
    doubts = (arguments.height_std, arguments.gravity_std, arguments.latitude_std)
    if all(value is None for value in (height, gravity, *doubts)):
        return own
    if height is None:
        height = own.height
        if gravity is None and own.gravity_source == MEASURED:
            gravity = own.gravity
    return Site.at(
        own.latitude,
        height,
        gravity,
        height_std=arguments.height_std,
        gravity_std=arguments.gravity_std,
        latitude_std=_latitude_std(arguments, own.latitude_std),
    )


def site_at(arguments: argparse.Namespace, default_latitude: float) -> Site:
    """Return the site of the command line alone; its latitude in degrees has a default.

    Raises:
        InputError: No place on Earth is there.

    """
    latitude = default_latitude if arguments.latitude is None else arguments.latitude
    return Site.at(
        latitude * DEG,
        arguments.height,
        arguments.gravity,
        height_std=arguments.height_std,
        gravity_std=arguments.gravity_std,
        latitude_std=_latitude_std(arguments),
    )


def _latitude_std(arguments: argparse.Namespace, otherwise: float | None = None) -> float | None:
    """Return the standard deviation of the latitude, rad, as the command line states it."""
    stated: float | None = arguments.latitude_std
    return otherwise if stated is None else stated * DEG


def load_truth(name: str, imu: ImuSpec) -> Calibration:
    """Return the true parameters of a simulated unit.

    Raises:
        InputError: They tell nothing of the unit's skewed gyro.

    """
    truth = Calibration.load(named_file('truths', name))
    if imu.skewed is not None and truth.model.skewed is None:
        raise InputError(
            f'--truth {name} tells nothing of the skewed gyro of IMU {imu.id}: a simulated one '
            'needs it (for instance --truth fog_skewed).'
        )
    return truth


def find_streams(arguments: argparse.Namespace, recording: Recording) -> Streams:
    """Choose the topics: those that were named, or the only candidate of each type.

    Raises:
        InputError: No IMU topic, or several candidates; they are listed.

    """
    imu = find_imu_topic(arguments.imu_topic, recording)
    skew = find_skew(recording, imu)
    temperature = find_temperature(recording)
    if arguments.imu_only:
        return Streams(imu, None, None, skew, temperature)
    joints = _choose(recording, Kind.JOINTS, arguments.joint_topic, '--joint-topic')
    setpoints = _choose(recording, Kind.SETPOINTS, arguments.setpoint_topic, '--setpoint-topic')
    return Streams(imu, joints, setpoints, skew, temperature)


def find_imu_topic(wanted: str | None, recording: Recording) -> str:
    """Return the topic of the IMU: the one that was named, or the only candidate.

    Raises:
        InputError: There is none, or several; they are listed.

    """
    imu = _choose(recording, Kind.IMU, wanted, '--imu-topic')
    if imu is None:
        listed = ', '.join(f'{t.name} ({t.type})' for t in recording.topics) or 'none at all'
        raise InputError(
            f'{recording.path}: no topic of type {Kind.IMU.type_name}; its topics: {listed}.'
        )
    return imu


def find_skew(recording: Recording, imu: str) -> str | None:
    """Return the topic of a skewed gyro beside an IMU's; None without one, or with several."""
    skewed = [
        t.name
        for t in recording.topics
        if t.type == Kind.IMU.type_name
        and t.name.endswith(_SKEW)
        and t.name != imu
        and t.count != 0
    ]
    return skewed[0] if len(skewed) == 1 else None


def find_temperature(recording: Recording) -> str | None:
    """Return the topic of the unit's thermometer: the only one, or the one that is called so."""
    kind = Kind.TEMPERATURES.type_name
    filled = [t.name for t in recording.topics if t.type == kind and t.count != 0]
    if len(filled) > 1:
        filled = [name for name in filled if name.endswith(_TEMPERATURE)]
    return filled[0] if len(filled) == 1 else None


def _choose(recording: Recording, kind: Kind, wanted: str | None, option: str) -> str | None:
    candidates = [t for t in recording.topics if t.type == kind.type_name]
    if wanted is not None:
        return _named(recording, candidates, wanted, kind, option)
    filled = [t for t in candidates if t.count != 0 and not t.name.endswith(_SKEW)]
    filled = filled or candidates
    if not filled:
        return None
    if len(filled) > 1:
        listed = ', '.join(t.name for t in filled)
        raise InputError(
            f'{recording.path}: {len(filled)} topics of type {kind.type_name}: {listed}. '
            f'Choose with {option}.'
        )
    return filled[0].name


def _named(
    recording: Recording, candidates: list[Topic], wanted: str, kind: Kind, option: str
) -> str:
    name = wanted if wanted.startswith('/') else f'/{wanted}'
    for topic in recording.topics:
        if topic.name in {wanted, name}:
            if topic.type != kind.type_name:
                raise InputError(
                    f'{option} {wanted}: found {topic.type}, expected {kind.type_name}.'
                )
            return topic.name
    listed = ', '.join(t.name for t in candidates) or 'none'
    raise InputError(
        f'{option} {wanted}: {recording.path} has no such topic; '
        f'of type {kind.type_name} it has: {listed}.'
    )


def shipped(kind: str) -> str:
    """List the names that ship of a kind of file, as for `named_file`."""
    folder = named_file(kind, _ANY[kind]).parent
    return ', '.join(sorted(path.stem for path in folder.glob('*.yaml')))


_ANY = {
    'plans': 'twelve_position',
    'imus': 'si',
    'devices': 'simulated',
    'imperfections': 'laboratory',
}


def output_path(text: str) -> Path:
    """Return the path of a file to be written.

    Raises:
        InputError: Its folder does not exist.

    """
    path = Path(text).expanduser()
    if not path.parent.is_dir():
        raise InputError(f'{path}: the folder {path.parent} does not exist.')
    if path.is_dir():
        raise InputError(f'{path}: is a folder, expected the name of a file.')
    return path
