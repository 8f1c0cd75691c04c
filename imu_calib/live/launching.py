"""Common parts of all launch files: nodes that end with their launcher, checks of arguments."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Any

import yaml

from ..common import processes
from ..common.errors import ImuCalibError, InputError
from ..common.files import named_file, user_path
from ..common.processes import ENDS_WITH
from ..common.units import point_for_comma
from ..estimation.methods import METHODS
from ..model.terms import named_terms
from ..session.imu import load_imu
from ..session.keywords import NodeParameter, Session, node_parameters, numeric
from ..session.plan import load_plan
from ..session.table import load_table
from ..session.units_file import PULSES, load_units, remaining
from .devices.format import load_format
from .devices.source import check_port
from .network import BUILD_MESSAGES, LOOPBACK, REACH, check_domain, in_enclave, interface_variables

_MODULES = {
    'numpy': 'Install python3-numpy.',
    'scipy': 'Install python3-scipy.',
    'rich': 'Install python3-rich.',
    'serial': 'Install python3-serial.',
    'imu_calib_msgs': BUILD_MESSAGES,
}
"""Python modules that the nodes need, and how to get them."""


_PACKAGE = 'imu_calib'
"""By which ROS finds the launch files."""

BECOMING = (sys.executable, '-m', processes.__name__)
"""Command prefix for programs outside this package, so that they end with their launcher."""


def arguments(declared: Mapping[str, tuple[str | None, str]]) -> list[Any]:
    """Return launch arguments from their defaults, None if required, and descriptions."""
    from launch.actions import DeclareLaunchArgument

    return [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, (default, description) in declared.items()
    ]


def session_arguments(*names: str) -> list[Any]:
    """Return launch arguments that state a session, all or some, for parameters of their names."""
    return arguments(
        {
            name: (None if one.required else str(one.default), one.description)
            for name, one in _launched().items()
            if not names or name in names
        }
    )


def session_parameters() -> dict[str, Any]:
    """Return the parameters of a node that these arguments give."""
    from launch.substitutions import LaunchConfiguration
    from launch_ros.parameter_descriptions import ParameterValue

    return {
        name: ParameterValue(LaunchConfiguration(name), value_type=type(one.default))
        for name, one in _launched().items()
    }


def _launched() -> dict[str, NodeParameter]:
    """Return the parameters that are launch arguments: all but the serial number."""
    return {n: one for n, one in node_parameters().items() if n != 'serial_number'}


def node(*, foreign: bool = False, **options: Any) -> Any:
    """Return a launch_ros Node that ends with its launcher, even if that one is killed.

    Args:
        foreign: Whether it is outside this package: it is then started through this package's
            `common.processes`, which requests the signal from the kernel.
        **options: Of the Node.
    """
    from launch_ros.actions import Node

    if foreign:
        options['prefix'] = ' '.join(BECOMING)
    else:
        # Parameters of a node without a name are written as those of all nodes, and a parameter
        # file that states one for this node would outdo the argument.
        options['name'] = options['executable']
    own = {ENDS_WITH: str(os.getpid()), **in_enclave(options['executable'])}
    return Node(additional_env=own, **options)


def checks(*, view: bool = False, port: bool = True, table: bool = False) -> Any:
    """Return the action that checks arguments and packages, to be placed before the first node.

    Args:
        view: Whether the table is shown by default.
        port: Whether the IMU's port must exist at the start.
        table: Whether a table is moved, a real one unless the device is simulated.
    """
    from launch.actions import OpaqueFunction

    def check(context: Any) -> list[Any]:
        # Of a file that another includes, all configurations are those of the other, too.
        known = _declared(context)
        given = {n: v for n, v in context.launch_configurations.items() if n in known}
        if not port:
            given.pop('port', None)
        packages = (*(_viewers(given) if view else ()), *_action_package(given))
        problems = _unknown_arguments(context, known) or wrong(given) or missing(packages)
        if problems:
            raise InputError(' '.join(problems))
        real = table and given.get('device') != _SIMULATED
        return _restrict_reach() if real else []

    return OpaqueFunction(function=check)


def _declared(context: Any) -> list[str]:
    """Return the names of the arguments of the launch file that is being executed."""
    from launch.launch_description_sources import get_launch_description_from_any_launch_file

    description = get_launch_description_from_any_launch_file(_current_file(context))
    return [argument.name for argument in description.get_launch_arguments()]


def _current_file(context: Any) -> str:
    return str(context.locals.current_launch_file_path)


def _is_typed(file: str) -> bool:
    """Tell whether the command line names a launch file itself, and not one that includes it."""
    words = [word for word in sys.argv if ':=' not in word]
    by_package = (_PACKAGE, Path(file).name) in pairwise(words)
    return by_package or Path(file).resolve() in {Path(word).resolve() for word in words}


def _unknown_arguments(context: Any, known: Sequence[str]) -> list[str]:
    """Return sentences on arguments of the command line that the launch file does not have.

    ROS ignores them: with `stop_requird:=true` a table would move without a heartbeat. Included
    files are not checked: they receive all arguments of the including one.
    """
    file = _current_file(context)
    if not _is_typed(file):
        return []
    typed = [word.partition(':=')[0] for word in sys.argv if ':=' in word]
    sentences = []
    for name in typed:
        if name not in known:
            alike = get_close_matches(name, known, n=1)
            meant = f': is {alike[0]} meant?' if alike else '.'
            sentences.append(f'{Path(file).name} has no argument {name}{meant}')
    return [*sentences, f'All: ros2 launch {file} -s.'] if sentences else []


@dataclass(frozen=True)
class Device:
    """One of several units, read by a node."""

    namespace: str  #: Of its node, below the stand's.
    parameters: dict[str, Any]  #: Of its node.
    remappings: list[tuple[str, str]]  #: Of its topics.


def devices(given: Mapping[str, str]) -> list[Device]:
    """Return the units of a stand that are read by separate nodes; none without a units file.

    Args:
        given: Arguments by name: units and without; device, the default for units; port.
    """
    if not given.get('units'):
        missing = [name for name in ('port', 'device') if not given.get(name)]
        if missing:
            raise InputError(
                f'Give {" and ".join(f"{name}:=" for name in missing)} of the IMU, or units:= with '
                'the file of several.'
            )
        return []
    if given.get('port'):
        raise InputError(f'port:={given["port"]}: leave it out, the file of units states it.')
    found = []
    for unit in remaining(load_units(given['units']), given.get('without', '')):
        device = unit.device or given.get('device', '')
        if not unit.port or not device:
            what = 'device' if unit.port else 'port'
            raise InputError(f'units:={given["units"]}: unit {unit.serial_number} has no {what}.')
        check_port(unit.port)
        load_format(device)
        parameters = {
            'imu': unit.imu,
            'port': unit.port,
            'device': device,
            'baud': unit.baud,
            'frame_id': f'{unit.name}_imu_link',
        }
        renamed = [(PULSES, unit.named_topic)] if unit.named_topic else []
        found.append(Device(unit.name, parameters, renamed))
    return found


_SIMULATED = 'simulated'
"""Frames of the simulated stand, whose table is not dangerous."""


def _restrict_reach() -> list[Any]:
    """Restrict a stand to this machine, unless the environment sets otherwise, and to its own
    domain.
    """
    from launch.actions import LogInfo, SetEnvironmentVariable

    check_domain()
    if os.environ.get(REACH, '').strip():
        return []
    own = interface_variables(LOOPBACK)
    text = ' '.join(f"{name}='{value}'" for name, value in own.items())
    return [
        *(SetEnvironmentVariable(name, value) for name, value in own.items()),
        LogInfo(msg=f'The stand stays on this machine. In every other terminal: export {text}'),
    ]


def _viewers(given: Mapping[str, str]) -> tuple[str, ...]:
    """Return the packages that show the table, by the arguments."""
    if given.get('view', 'true').lower() == 'false':
        return ()
    shows = given.get('rviz', 'false').lower() == 'true'
    return ('robot_state_publisher', 'rviz2') if shows else ('robot_state_publisher',)


def _action_package(given: Mapping[str, str]) -> tuple[str, ...]:
    """Return the package of the action that moves a table of ros2_control."""
    return ('control_msgs',) if given.get('table_output') == 'trajectory' else ()


def missing(packages: tuple[str, ...]) -> list[str]:
    """Return what is not installed, and how to install it."""
    from ament_index_python.packages import get_packages_with_prefixes

    modules = [
        f'The Python module {module} is missing. {remedy}'
        for module, remedy in _MODULES.items()
        if find_spec(module) is None
    ]
    known = get_packages_with_prefixes() if packages else {}
    distribution = os.environ.get('ROS_DISTRO', 'jazzy')
    return modules + [
        f'The package {package} is missing: sudo apt install '
        f'ros-{distribution}-{package.replace("_", "-")}{_WITHOUT.get(package, "")}.'
        for package in packages
        if package not in known
    ]


_WITHOUT = {
    'robot_state_publisher': '; or do without the view, view:=false',
    'rviz2': '; or do without, rviz:=false',
}


def wrong(given: Mapping[str, str]) -> list[str]:
    """Return which arguments are invalid, what was found, and what is expected."""
    sentences = []
    for name, check in _CHECKS.items():
        if name not in given:
            continue
        try:
            check(given[name])
        except ImuCalibError as error:
            sentences.append(f'Argument {name}:={given[name]}: {error}')
    return sentences


def _boolean(text: str) -> None:
    if text not in {'true', 'false', 'True', 'False'}:
        raise InputError(f'found {text!r}, expected true or false.')


def _number(lower: float = -math.inf, upper: float = math.inf) -> Callable[[str], None]:
    """Return a check of a number; nan means none and is accepted if any number is."""
    limited = lower > -math.inf

    def check(text: str) -> None:
        try:
            value = float(text)
        except ValueError:
            value = math.inf
        if math.isinf(value) or (limited and not lower <= value <= upper):
            limits = f' from {lower:g} to {upper:g}' if limited else ''
            point = point_for_comma(text)
            raise InputError(f'found {text!r}, expected a number{limits}.{point}')

    return check


def _stated_number(parameter: NodeParameter) -> Callable[[str], None]:
    """Return a check of a number; nan is accepted beside a range unless it is required."""
    check = _number(*parameter.bounds)
    limited = parameter.bounds[0] > -math.inf and not parameter.required
    return _or('nan', check) if limited else check


def _whole_number(lower: int, upper: int) -> Callable[[str], None]:
    def check(text: str) -> None:
        try:
            value = yaml.safe_load(text)
        except yaml.YAMLError:
            value = None
        if type(value) is not int or not lower <= value <= upper:
            raise InputError(f'found {text!r}, expected a whole number from {lower} to {upper}.')

    return check


def _one_of(*known: str) -> Callable[[str], None]:
    def check(text: str) -> None:
        if text not in known:
            raise InputError(f'found {text!r}, expected one of {", ".join(filter(None, known))}.')

    return check


def _or(word: str, check: Callable[[str], Any]) -> Callable[[str], None]:
    """Also accept a word that means not given."""

    def checked(text: str) -> None:
        if text == word:
            return
        try:
            check(text)
        except InputError as error:
            text = str(error).replace('expected ', f'expected {word} or ')
            raise InputError(text) from None

    return checked


def _unless_empty(check: Callable[[str], Any]) -> Callable[[str], None]:
    def checked(text: str) -> None:
        if text:
            check(text)

    return checked


def _file(text: str) -> None:
    if not user_path(text).is_file():
        raise InputError('there is no such file.')


_BAUD = _whole_number(50, 10_000_000)
"""bit/s: from the lowest rate in POSIX to more than the fastest adapter."""
_CHECKS: dict[str, Callable[[str], Any]] = {
    'plan': load_plan,
    'imu': _unless_empty(load_imu),
    'table': load_table,
    'truth': lambda name: named_file('truths', name),
    'device': _unless_empty(load_format),
    'method': _one_of('', *METHODS),
    'terms': named_terms,
    'port': _unless_empty(check_port),
    'baud': _or('0', _BAUD),
    'table_baud': _BAUD,
    'frame_port': _whole_number(1, 65535),
    'seed': _whole_number(0, 2**62),
    **{name: _stated_number(node_parameters()[name]) for name in numeric(Session)},
    'speed': _number(0.0, 1e6),
    'true_azimuth': _number(-360.0, 360.0),
    'autostart': _boolean,
    'stop_required': _boolean,
    'use_sim_time': _unless_empty(_boolean),
    'view': _boolean,
    'rviz': _boolean,
    'table_output': _one_of('setpoint', 'trajectory'),
    'params_file': _file,
    'urdf': _unless_empty(_file),
    'units': _unless_empty(load_units),
}
