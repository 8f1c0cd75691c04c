"""Launch files: arguments that are refused in words, and processes that end with their launcher."""

import ast
import os
import re
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest
from loopback import CHECKOUT, until

from imu_calib.common.errors import InputError
from imu_calib.live import launching
from imu_calib.live.launching import wrong

SOUND = {
    'plan': 'twelve_position',
    'imu': '',
    'table': 'three_axis',
    'truth': 'cao2022_table1',
    'device': 'stim300',
    'method': '',
    'terms': 'none',
    'port': 'socket://10.0.0.3:5000',
    'baud': '921600',
    'latitude': '-34.5',
    'gravity': 'nan',
    'azimuth': '12.3',
    'true_azimuth': '0.0',
    'autostart': 'true',
    'view': 'False',
    'table_output': 'trajectory',
    'seed': '3',
    'frame_port': '5760',
    'params_file': str(CHECKOUT / 'config' / 'nodes' / 'stand.yaml'),
    'of_another_launch_file': 'nope',
}
FILES = sorted((CHECKOUT / 'launch').glob('*.launch.py'))


def test_sound_arguments_are_taken():
    assert wrong(SOUND) == []


@pytest.mark.parametrize(
    ('name', 'value', 'expected'),
    [
        ('autostart', 'nope', "found 'nope', expected true or false."),
        ('view', '', "found '', expected true or false."),
        ('latitude', '91', "found '91', expected a number from -90 to 90."),
        ('latitude', 'nan', "found 'nan', expected a number from -90 to 90."),
        ('latitude', '48,1', "found '48,1', expected a number from -90 to 90."),
        ('gravity', 'much', "found 'much', expected a number."),
        ('baud', '9600.5', "found '9600.5', expected 0 or a whole number from 50 to 10000000."),
        ('baud', '49', "found '49', expected 0 or a whole number from 50 to 10000000."),
        ('table_baud', '0', "found '0', expected a whole number from 50 to 10000000."),
        ('height', '1e5', "found '1e5', expected nan or a number from -500 to 10000."),
        ('gravity_std', '-1', "found '-1', expected nan or a number from 0 to"),
        ('seed', '-1', "found '-1', expected a whole number"),
        ('seed', '[', "found '[', expected a whole number"),
        ('seed', '', "found '', expected a whole number"),
        ('plan', 'twelve', 'there are:'),
        ('device', 'kvh', 'there are:'),
        ('imu', 'no/such.yaml', 'no such file'),
        ('port', '/dev/ttyUSB9', 'there is no such device'),
        ('method', 'guess', 'expected one of'),
        ('terms', 'guess', 'No term is called'),
        ('table_output', 'setpoints', 'expected one of setpoint, trajectory.'),
        ('params_file', 'none.yaml', 'none.yaml'),
    ],
)
def test_an_argument_is_refused_by_name_with_what_was_found_and_expected(name, value, expected):
    (sentence,) = wrong({**SOUND, name: value})
    assert sentence.startswith(f'Argument {name}:={value}: ')
    assert expected in sentence


def test_every_argument_of_every_launch_file_is_known():
    # What is any text: topics, names, files that are written.
    free = {'namespace', 'journal', 'output', 'imu_topic', 'joint_topic', 'setpoint_topic'}
    free |= {'skew_topic', 'temperature_topic', 'output_topic', 'frame_id', 'serial'}
    free |= {'calibration', 'calibrations', 'table_port', 'without'}
    declared = {name for path in FILES for name in _declared(path.read_text())}
    declared |= set(launching._launched())
    assert 'plan' in declared
    assert declared - free <= set(launching._CHECKS)


@pytest.mark.parametrize('path', FILES, ids=lambda path: path.name)
def test_what_a_launch_file_gives_by_itself_is_taken(path):
    defaults = {k: v.value for k, v in _declared(path.read_text()).items() if v is not None}
    assert defaults
    assert wrong(defaults) == []


def _declared(text):
    """Return the arguments that a launch file declares, with their defaults where they are text."""
    found = {}
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Call) and getattr(node.func, 'id', '') == 'DeclareLaunchArgument':
            default = next((k.value for k in node.keywords if k.arg == 'default_value'), None)
            if isinstance(node.args[0], ast.Constant):
                found[node.args[0].value] = default
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Dict):
            if getattr(node.targets[0], 'id', '') != 'ARGUMENTS':
                continue
            for key, value in zip(node.value.keys, node.value.values, strict=True):
                found[key.value] = value.elts[0]
    return {k: v if isinstance(v, ast.Constant) else None for k, v in found.items()}


CHILD = (
    'from imu_calib.common.processes import end_with_parent as e; import time; e(); '
    'print(1, flush=True);'
)
LAUNCHER = """
import os, subprocess, sys
os.environ['IMU_CALIB_ENDS_WITH'] = str(os.getpid())
child = subprocess.Popen(sys.argv[1:], stdout=subprocess.PIPE)
print(child.pid, flush=True)
print('ready' if child.stdout.readline() else 'ended', flush=True)
child.wait()
"""
NODE = [sys.executable, '-c', f'{CHILD} time.sleep(1000)']
# A kernel before 5.3, or a container that allows no pidfd_open(2).
OLD_KERNEL = 'import os; d = lambda n: (_ for _ in ()).throw(OSError(38, "")); os.pidfd_open = d;'
PROGRAM = 'import time; print(1, flush=True); time.sleep(1000)'


@pytest.mark.parametrize(
    'command',
    [
        NODE,
        # As a prefix of ros2 launch: a process in between.
        ['sh', '-c', '"$0" "$@"; :', *NODE],
        ['sh', '-c', '"$0" "$@"; :', sys.executable, '-c', f'{OLD_KERNEL} {NODE[2]}'],
        # A program that is not ours becomes it.
        [*launching.BECOMING, sys.executable, '-c', PROGRAM],
    ],
)
@pytest.mark.skipif(not sys.platform.startswith('linux'), reason='the kernel is to tell')
def test_what_is_launched_ends_with_its_launcher_even_if_that_is_killed(command, tmp_path):
    mark = f'IMU_CALIB_TEST_OF={tmp_path}'
    launcher = subprocess.Popen(
        [sys.executable, '-c', LAUNCHER, *command],
        stdout=subprocess.PIPE,
        env={**os.environ, 'PYTHONPATH': str(CHECKOUT), 'IMU_CALIB_TEST_OF': str(tmp_path)},
        start_new_session=True,
    )
    try:
        assert launcher.stdout.readline()
        assert launcher.stdout.readline() == b'ready\n'
        assert processes_with(mark)
        launcher.kill()
        launcher.wait()
        assert until(lambda: not processes_with(mark)), processes_with(mark)
    finally:
        launcher.stdout.close()
        for number in processes_with(mark):
            os.kill(number, signal.SIGKILL)


def processes_with(mark):
    """Return the processes with a mark in their environment."""
    found = []
    for process in Path('/proc').glob('[0-9]*'):
        # It may end while it is looked at.
        with suppress(OSError):
            environment = (process / 'environ').read_bytes().split(b'\0')
            if mark.encode() in environment and (process / 'cmdline').read_bytes():
                found.append(int(process.name))
    return found


UNITS = """
units:
  - {serial_number: A1, imu: fog_medium, port: 'socket://10.0.0.3:5000', device: stim300}
  - {serial_number: B-2, imu: fog_medium, port: 'socket://10.0.0.4:5000', topic: second/imu}
"""


def test_a_file_of_units_becomes_a_node_for_each(tmp_path):
    file = tmp_path / 'units.yaml'
    file.write_text(UNITS)
    first, second = launching.devices({'units': str(file), 'device': 'kvh_1750'})
    assert (first.namespace, second.namespace) == ('unit_A1', 'unit_B_2')
    assert first.parameters['device'] == 'stim300'
    assert second.parameters['device'] == 'kvh_1750'
    assert second.parameters['frame_id'] == 'unit_B_2_imu_link'
    assert first.remappings == []
    assert second.remappings == [('imu/pulses', '/second/imu')]
    (processes_with,) = launching.devices({'units': str(file), 'without': 'B-2'})
    assert processes_with.namespace == 'unit_A1'


@pytest.mark.parametrize(
    ('given', 'expected'),
    [
        ({}, 'Give port:= and device:= of the IMU, or units:='),
        ({'port': '/dev/ttyUSB0'}, 'Give device:= of the IMU'),
        ({'units': '{file}', 'port': '/dev/ttyUSB0'}, 'the file of units states it'),
        ({'units': '{file}'}, 'unit B-2 has no device'),
        ({'units': '{file}', 'without': 'C3'}, "found 'C3', expected some of A1, B-2"),
        ({'units': '{file}', 'without': 'A1, B-2'}, 'All units are left out'),
    ],
)
def test_units_that_cannot_be_read_are_refused_in_words(tmp_path, given, expected):
    file = tmp_path / 'units.yaml'
    file.write_text(UNITS)
    given = {key: value.replace('{file}', str(file)) for key, value in given.items()}
    with pytest.raises(InputError, match=re.escape(expected)):
        launching.devices(given)


def test_one_unit_needs_no_file():
    assert launching.devices({'port': '/dev/ttyUSB0', 'device': 'stim300'}) == []
