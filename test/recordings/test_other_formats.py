"""Recordings of other software, given to any command: what they are, and the way."""

import argparse
import re
from functools import cache
from pathlib import Path

import pytest

import imu_calib
from imu_calib.cli.dispatch import COMMANDS, build_parser
from imu_calib.cli.main import main
from imu_calib.common.errors import InputError
from imu_calib.common.files import named_file

FILES = {
    'log.ulg': (b'ULog\x01\x125\x01\x00 and so on', 'is a log of PX4.*ulog2csv.*imu-calib convert'),
    'run.bag': (b'#ROSBAG V2.0\n\x01\xff\xfe', 'is a bag of ROS 1.*imu-calib convert .*run.bag'),
    'run.csv': (b't,wx,wy\n0,1,2\n1,2,3\n', 'is a text file.*imu-calib convert .*run.csv -o'),
    'run.txt': (b't wx wy\n0 1 2\n1 2 3\n', 'is a text file.*imu-calib convert .*run.txt -o'),
    'run.mcap.gz': (
        b'\x1f\x8b\x08\x08' + bytes(9),
        'is a packed file.*gunzip -k .*run.mcap.gz unp',
    ),
    'run.mat': (b'MATLAB 5.0' + bytes(9) + b'\xff', 'is a file of MATLAB.*imu-calib convert'),
}
CONVERTED = {
    '.bag': 'cannot be converted: .*Expected a bag of ROS 1',
    '.csv': 'its columns are t, wx, wy. State',
    '.txt': 'its columns are t, wx, wy. State',
}
"""convert knows the way itself."""
READ = ('calibrate', 'verify', 'compensate', 'noise', 'info', 'report', 'convert', 'batch')
"""Commands that read text files."""
NO_FILE = {'keystore': 'the folder of keys is created'}
"""Arguments that name no file to be read, and why."""


STATED = {
    'calibration': named_file('truths', 'cao2022_table1'),
    'files': named_file('truths', 'cao2022_table1'),
    'plan': 'six_position',
    'format': 'c',
}
"""What the arguments beside the file are, where they are read before it."""


@cache
def commands() -> dict[str, argparse.ArgumentParser]:
    parser = build_parser()
    (found,) = (a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    assert set(found.choices) == set(COMMANDS)
    return dict(found.choices)


def is_needed(action: argparse.Action) -> bool:
    return action.required or not action.option_strings


def files_of_commands() -> list[tuple[str, str]]:
    """Return every argument of every command that names a file to be read, without options that
    may be left out."""
    return [
        (name, action.dest)
        for name, command in commands().items()
        for action in command._actions
        if is_needed(action)
        and action.dest not in NO_FILE
        and '-o' not in action.option_strings
        and action.choices is None
    ]


def command_line(name: str, argument: str, file: Path) -> list[str]:
    """Return a command line with a file in place of one argument."""
    words = [name]
    for action in commands()[name]._actions:
        if not is_needed(action):
            continue
        value = file if action.dest == argument else STATED.get(action.dest, file.parent / 'x.html')
        words += [*action.option_strings[-1:], str(value)]
    return words


@pytest.mark.parametrize('file', FILES)
@pytest.mark.parametrize(('name', 'argument'), files_of_commands())
def test_any_command_names_the_way(name, argument, file, tmp_path, monkeypatch, capsys):
    content, sentence = FILES[file]
    path = tmp_path / file
    path.write_bytes(content)
    monkeypatch.chdir(tmp_path)
    assert main(command_line(name, argument, path)) == 2
    said = ' '.join(capsys.readouterr().err.split())
    if name == 'convert' or (
        name in READ and argument in {'bag', 'sources'} and path.suffix != '.bag'
    ):
        sentence = CONVERTED.get(path.suffix, sentence)
    assert re.search(sentence, said), said


@pytest.mark.parametrize(
    ('load', 'expected'),
    [
        (imu_calib.load_plan, 'expected the file of a plan: '),
        (imu_calib.load_imu, 'expected the file of an IMU: '),
        (imu_calib.load_table, 'expected the file of a table: '),
        (imu_calib.load_units, 'expected the file of several units: '),
        (
            imu_calib.Calibration.load,
            'expected a calibration file, which imu-calib calibrate makes of a recording: ',
        ),
        (
            imu_calib.Catalogue,
            'expected the folder of a catalogue, which imu-calib batch makes of recordings: ',
        ),
    ],
)
def test_a_recording_in_place_of_another_file_says_what_that_is(load, expected, tmp_path):
    for file, (content, _) in FILES.items():
        (tmp_path / file).write_bytes(content)
        with pytest.raises(InputError, match=expected):
            load(tmp_path / file)
    (tmp_path / 'run.db3').touch()
    with pytest.raises(InputError, match=f'run.db3 is a recording, {expected[:-2]}.'):
        load(tmp_path / 'run.db3')


@pytest.mark.parametrize('name', ['run.mat', 'run.ASC'])
def test_text_under_the_name_of_another_format_is_read_as_text(name, tmp_path, capsys):
    (tmp_path / name).write_bytes(FILES['run.csv'][0])
    assert main(['calibrate', str(tmp_path / name)]) == 2
    assert 'its columns are t, wx, wy. State' in ' '.join(capsys.readouterr().err.split())


def test_what_is_right_inside_may_have_any_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path('plan.txt').write_text(named_file('plans', 'six_position').read_text())
    assert imu_calib.load_plan('plan.txt').name == 'six_position'
    Path('truth.dat').write_text(named_file('truths', 'cao2022_table1').read_text())
    assert imu_calib.Calibration.load('truth.dat').imu.id == 'fog_medium'


def test_binary_data_is_not_shown_as_a_fault_of_yaml(tmp_path):
    file = tmp_path / 'plan.yaml'
    file.write_bytes(b'ULog\x01\x125')
    with pytest.raises(InputError, match=r'plan.yaml: found binary data, expected YAML text.'):
        imu_calib.load_plan(file)
