"""`imu-calib stand --imus`: what is refused before anything moves, and what a folder keeps."""

import argparse

import numpy as np
import pytest
import yaml
from calibrations import brick_at

from imu_calib.cli import dispatch, main, processes, several, terminal
from imu_calib.cli.terminal import NodeReports
from imu_calib.common.errors import InputError, NotObservable
from imu_calib.common.files import named_file
from imu_calib.session.imu import load_imu
from imu_calib.session.units_file import load_units

PORT = 'socket://127.0.0.1:9'


@pytest.fixture
def file(tmp_path):
    """Write the units that are given as a file, and return its path."""

    def write(*units):
        path = tmp_path / 'units.yaml'
        listed = [{'imu': 'fog_medium', 'serial_number': f'U{k}', **u} for k, u in enumerate(units)]
        path.write_text(yaml.safe_dump({'units': listed}))
        return str(path)

    return write


def refused(capsys, *words):
    assert main.main(['stand', *words]) == InputError.exit_code
    return capsys.readouterr().err


@pytest.mark.parametrize(
    ('units', 'words', 'expected'),
    [
        ([{}, {}], ['--imu', 'fog_medium'], '--imu: found fog_medium, but'),
        ([{}, {}], ['--serial', 'A1'], '--serial: found A1, but'),
        ([{}, {}], ['--port', PORT, '--device', 'stim300'], f'--port: found {PORT}, but'),
        ([{}, {}], ['--without', 'U7'], "found 'U7', expected some of U0, U1"),
        ([{}, {}], ['--without', 'U0,U1'], 'All units are left out'),
        ([{'port': PORT}, {}], ['--latitude', '48'], 'unit U1 has no port, and U0 has'),
        ([{'port': PORT}], ['--latitude', '48'], 'unit U0 has no device'),
        ([{'port': PORT, 'device': 'stim300'}], [], 'give --latitude, of a real stand'),
        ([{}, {}], ['--device', 'stim300'], '--device is for real hardware'),
        ([{'imu': 'nope'}], [], "No imu is called 'nope'"),
    ],
)
def test_what_does_not_go_together_is_refused_in_words(
    capsys, file, tmp_path, units, words, expected
):
    output = str(tmp_path / 'stand')
    message = refused(capsys, 'twelve_position', '--imus', file(*units), '-o', output, *words)
    assert expected in ' '.join(message.split())
    assert not (tmp_path / 'stand').exists()


def test_several_units_are_not_held_by_hand(capsys, file, tmp_path):
    words = 'free_positions', '--imus', file({}, {}), '-o', str(tmp_path / 'stand')
    assert 'is for one unit in the hand' in refused(capsys, *words)


def test_without_says_that_it_is_of_several_units(capsys, tmp_path):
    words = 'twelve_position', '--without', 'U1', '-o', str(tmp_path / 'stand')
    assert '--without is for several units' in refused(capsys, *words)


def test_a_stand_keeps_the_units_and_all_files_that_they_name(file, tmp_path):
    """The session is gone on with as it began, whatever becomes of the originals."""
    own = tmp_path / 'my_imu.yaml'
    own.write_text(named_file('imus', 'fog_medium').read_text())
    mount = ['y', '-x', 'z']
    given = file({'imu': 'my_imu.yaml', 'mount': mount, 'place': 'left'}, {'seed': 7})
    settings = tmp_path / 'settings'
    settings.mkdir()
    before = load_units(given)
    several.save_settings(argparse.Namespace(imus=given, truth=None), settings)
    own.unlink()
    after = load_units(settings / 'imus.yaml')
    assert [unit.name for unit in after] == [unit.name for unit in before]
    assert np.array_equal(after[0].mount, before[0].mount)
    assert (after[0].place, after[1].seed) == ('left', 7)
    assert load_imu(after[0].imu).id == load_imu(after[1].imu).id == 'fog_medium'


@pytest.mark.parametrize('stated', [None, 'cao2022_table1'])
def test_simulated_units_differ_unless_their_truth_is_stated(file, tmp_path, stated):
    arguments = argparse.Namespace(imus=file({}, {}), without='', truth=stated)
    first, second = several.truths(arguments).values()
    assert np.array_equal(first.values, second.values) == bool(stated)
    several.save_settings(arguments, tmp_path)
    arguments.imus = str(tmp_path / 'imus.yaml')
    again = several.truths(arguments).values()
    assert [one.values.tolist() for one in again] == [first.values.tolist(), second.values.tolist()]


def test_a_device_of_their_own_counts_before_that_of_all(file):
    units = load_units(file({'device': 'stim300', 'port': PORT}, {'port': f'{PORT}1'}))
    arguments = argparse.Namespace(device='kvh_1750')
    assert [several.device_of(unit, arguments) for unit in units] == ['stim300', 'kvh_1750']


def test_each_unit_is_read_by_a_node_of_its_own(file):
    arguments = argparse.Namespace(
        imus=file({}, {'topic': 'second/imu'}), without='', device='', sample_rate=0.0
    )
    nodes = several.node_parameters(arguments, {'use_sim_time': True}, 5760)
    assert list(nodes) == ['unit_U0/imu_node', 'unit_U1/imu_node']
    assert [n['port'][-4:] for n in nodes.values()] == ['5760', '5761']
    assert several.remappings(arguments) == {'unit_U1/imu_node': {'imu/pulses': '/second/imu'}}


def test_ports_in_a_row_are_free():
    assert 0 < processes.free_ports(8) <= 65535 - 7


def test_units_without_a_result_are_named(file, tmp_path, capsys):
    arguments = argparse.Namespace(imus=file({}, {}, {}), without='U2', verbose=False)
    assert several.print_results(arguments, tmp_path, {}, 'U0: it fell.') == ['U0', 'U1']
    assert capsys.readouterr().out.startswith('No calibration of U0, U1. U0: it fell.')


def test_a_narrow_terminal_shows_each_result_whole(file, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(terminal.OUTPUT, 'width', 40)
    arguments = argparse.Namespace(
        imus=file({'serial_number': 'A1001-2026'}), without='', verbose=False, imperfections=''
    )
    result = brick_at(20.0, std=1e-6, samples=123456)
    (tmp_path / 'calibrations').mkdir()
    result.save(tmp_path / 'calibrations' / 'A1001-2026.yaml')
    several.print_results(arguments, tmp_path, {'A1001-2026': brick_at(20.0)})
    shown = capsys.readouterr().out
    assert all(word in shown for word in ('A1001-2026', 'brick', '123456', 'D_gx ±0.206 deg/h'))


@pytest.mark.parametrize('several_units', [False, True])
def test_a_stand_that_ends_without_a_result_says_why(file, tmp_path, monkeypatch, several_units):
    stand_session = pytest.importorskip('imu_calib.cli.stand_session')
    words = ['stand', 'twelve_position', '-o', str(tmp_path / 'stand')]
    words += ['--imus', file({}, {})] if several_units else []
    arguments = dispatch.build_parser().parse_args(words)
    (tmp_path / 'stand').mkdir()
    ended = processes.SessionEnd(False, 'The table has stopped.', 0.0)
    monkeypatch.setattr(stand_session, '_session', lambda *_: ended)
    with pytest.raises(NotObservable, match='The table has stopped'):
        stand_session.run(arguments, tmp_path / 'stand', {}, 0, NodeReports(real=False))
