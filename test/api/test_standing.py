"""`imu_calib.stand`: a simulated stand from Python."""

import argparse
from dataclasses import replace

import numpy as np
import pytest
from live import LIMIT, short_plan

import imu_calib
from imu_calib.api.session import TRUE_TABLE
from imu_calib.api.stand import truth_in_session
from imu_calib.cli import resume, stand_session
from imu_calib.cli.main import main
from imu_calib.common.errors import InputError, NotObservable
from imu_calib.common.files import named_file
from imu_calib.common.units import as_options


@pytest.mark.repeats
def test_a_stand_is_run_to_its_calibration(tmp_path):
    folder, file = tmp_path / 'a stand', tmp_path / 'table.yaml'
    file.write_text('table: {zeros: 3 arcsec}')
    # Below zero and with a blank: neither is taken for an option, or for two.
    found = imu_calib.stand(
        short_plan(tmp_path, dwell=3.0),
        folder,
        latitude=-34.0,
        serial='unit 7',
        imperfections=file,
        seed=3,
    )
    assert found.path == folder
    assert found.recording == folder / 'journal'
    assert found.calibration.to_yaml() == (folder / resume.RESULT).read_text()
    assert found.calibration.serial_number == 'unit 7'
    assert found.calibration.provenance['latitude_deg'] == -34.0
    assert found.true_table.is_file()
    # Zeros of joints are in the misalignments, and in no scale factor.
    off = found.calibration.values[:3] - found.truth.values[:3]
    assert (np.abs(off) < LIMIT * found.calibration.std[:3]).all()
    with pytest.raises(InputError, match='exists already; recordings are not overwritten'):
        imu_calib.stand('twelve_position', folder)


def test_the_truth_beside_a_result_is_that_of_its_temperature(tmp_path):
    """K_gy of a unit with 2 ppm/K was 12 standard deviations off the truth at 25 degC."""
    file = tmp_path / 'warm.yaml'
    file.write_text(
        'temperature: {offset: 2 K, gyro: {scale_factor: 2 ppm/K}, warm_up: {gyro: 1 deg/h}}'
    )
    true = imu_calib.Calibration.load(named_file('truths', 'cao2022_table1'))
    found = replace(true, provenance={'temperature': {'mean': 27.0}})
    there, notes = truth_in_session(true, found, file, None)
    wanted = true.values[:3] + 4e-6 * (1 + true.values[:3])
    assert there.values[:3] == pytest.approx(wanted, abs=1e-12)
    assert 'that of 27.00 degC' in notes[0] and 'truth.yaml has it at 25 degC' in notes[0]
    assert 'without the warm-up of the biases' in notes[1]
    file.write_text('stamps: {jitter: 0.1 ms}')
    assert truth_in_session(true, found, file, None) == (true, [])


def test_it_says_what_the_command_says(tmp_path, capsys):
    with pytest.raises(NotObservable) as refused:
        imu_calib.stand('six_position', tmp_path / 'stand', method='six_position')
    words = ['six_position', '--method', 'six_position', '-o', str(tmp_path / 'stand')]
    assert main(['stand', *words]) == 1
    assert capsys.readouterr().err == f'imu-calib stand: {as_options(str(refused.value))}\n'
    assert 'need north' in str(refused.value)
    assert not (tmp_path / 'stand').exists()


def test_the_errors_that_a_unit_of_ones_own_is_given_are_said(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(stand_session, 'run', lambda *_: None)
    file = tmp_path / 'mine.yaml'
    file.write_text(named_file('imus', 'fog_medium').read_text())
    said = 'simulated unit: cao2022_table1; yours: --truth FILE\n'
    words = ['stand', 'twelve_position', '--imu', str(file), '-o']
    assert main([*words, str(tmp_path / 'one')]) == 0 and said in capsys.readouterr().out
    assert main([*words, str(tmp_path / 'two'), '--truth', 'cao2022_table1']) == 0
    assert main(['stand', 'twelve_position', '-o', str(tmp_path / 'three')]) == 0
    assert 'simulated unit' not in capsys.readouterr().out


def test_a_simulated_table_with_errors_that_its_description_lacks_is_said(tmp_path):
    """Misalignments are then tens of standard deviations off: a beginner must know why."""
    exact = argparse.Namespace(table='three_axis')
    assert stand_session._true_table_hint(exact, tmp_path) == []
    (tmp_path / TRUE_TABLE).write_text('')
    (sentence,) = stand_session._true_table_hint(exact, tmp_path)
    assert f'the errors of {tmp_path / TRUE_TABLE}' in sentence
    assert 'its description, three_axis, states none' in sentence
    described = tmp_path / 'mine.yaml'
    shipped = named_file('tables', 'three_axis').read_text()
    described.write_text(shipped.replace('simulated: true', ''))
    assert stand_session._true_table_hint(argparse.Namespace(table=str(described)), tmp_path) == []
