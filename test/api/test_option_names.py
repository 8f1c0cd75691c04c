"""A sentence names a keyword to who calls a function, and the option to who runs a command."""

import pytest

import imu_calib
from imu_calib.cli.main import main
from imu_calib.common.errors import InputError


def test_a_command_says_the_option_where_a_function_says_the_keyword(tmp_path, capsys):
    arguments = {'seed': 0, 'latitude': 34.65, 'start': 'noon'}
    with pytest.raises(InputError, match=r'^`start`: found noon, expected a date'):
        imu_calib.simulate('twelve_position', tmp_path / 'bag', **arguments)
    words = [f'--{name}={value}' for name, value in arguments.items()]
    command = ['simulate', 'twelve_position', '-o', str(tmp_path / 'bag'), *words]
    assert main(command) == 2
    assert 'imu-calib simulate: --start: found noon, expected a date' in capsys.readouterr().err
