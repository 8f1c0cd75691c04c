"""Exports: the consumer's own formula, on the file it reads, gives our compensated values."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from c_program import compensated_in_c
from installed import needs_modules

import imu_calib
from imu_calib.calibration.calibration import Calibration
from imu_calib.calibration.exports import EXPORTS, ExportSource
from imu_calib.cli.main import main
from imu_calib.common.errors import InputError
from imu_calib.common.stream import Floats, Units
from imu_calib.common.units import DEG, DEG_H, STANDARD_GRAVITY
from imu_calib.model.sensors import SensorModel, Triad
from imu_calib.session.imu import ImuSpec, TriadSpec, load_imu

RATE = 100.0
WALK = [1e-5, 2e-5, 3e-5, 1e-3, 2e-3, 3e-3]


def unit(name: str = 'fog_medium') -> Calibration:
    """Large errors of all kinds, g-sensitivity too: what is exchanged or left out shows."""
    rng = np.random.default_rng(5)
    model = SensorModel(
        Triad(rng.normal(0, 0.02, (3, 3)), rng.normal(0, 30 * DEG_H, 3)),
        Triad(rng.normal(0, 0.02, (3, 3)), rng.normal(0, 0.1, 3)),
        rng.normal(0, 1e-5, (3, 3)),
    )
    curve = {'tau': [1.0], 'deviation': [1.0], 'std': [1.0], 'timed': False}
    noise = {
        name: {**curve, 'rate_random_walk': 1e-6 * (k + 1)}
        for k, name in enumerate(('gx', 'gy', 'gz', 'ax', 'ay', 'az'))
    }
    provenance = {'random_walk': WALK, 'noise': noise}
    square = np.eye(len(model.parameters)) * 1e-12
    return Calibration(
        load_imu(name), model, square, provenance=provenance, parameters=model.parameters
    )


def samples(calibration: Calibration) -> tuple[Floats, Floats]:
    """Raw gyro and accelerometer numbers of the unit's own kind, (5, 3) each."""
    rng = np.random.default_rng(6)
    per_second = RATE if calibration.imu.units is Units.PULSES else 1.0
    gyro = rng.normal(0, 1.0, (5, 3)) / (calibration.imu.gyro.scale_factor * per_second)
    accel = rng.normal(0, 9.8, (5, 3)) / (calibration.imu.accel.scale_factor * per_second)
    return gyro, accel


def ours(calibration: Calibration, gyro: Floats, accel: Floats) -> tuple[Floats, Floats]:
    per_second = RATE if calibration.imu.units is Units.PULSES else 1.0
    return calibration.model.compensate(
        gyro * calibration.imu.gyro.scale_factor * per_second,
        accel * calibration.imu.accel.scale_factor * per_second,
    )


def exported(name: str, calibration: Calibration) -> str:
    source = ExportSource(calibration, Path('/robot/calibration.yaml'), RATE, '/imu0')
    return EXPORTS[name](source).text


def assert_same(found: tuple[Floats, Floats], expected: tuple[Floats, Floats]) -> None:
    for mine, theirs in zip(found, expected, strict=True):
        assert np.abs(mine - theirs).max() < 1e-12 * np.abs(theirs).max()


@pytest.mark.parametrize('name', ['fog_medium', 'mems_counts', 'si'])
def test_imucal_gives_our_values(name):
    # imucal's documentation: (raw - b_a) through inv(R_a) inv(K_a); likewise the gyros after K_ga.
    calibration = unit(name)
    gyro, accel = samples(calibration)
    file = json.loads(exported('imucal', calibration))
    p = {k: np.array(v) for k, v in file.items() if k[0] in 'KRb'}
    force = np.array([np.linalg.inv(p['K_a'] @ p['R_a']) @ (n - p['b_a']) for n in accel])
    free = gyro - force @ p['K_ga'].T - p['b_g']
    rate = np.array([np.linalg.inv(p['K_g'] @ p['R_g']) @ n for n in free])
    assert file['gyr_unit'] == 'deg/s'
    assert_same((rate * DEG, force), ours(calibration, gyro, accel))


@pytest.mark.parametrize('name', ['fog_medium', 'mems_counts', 'si'])
def test_imucal_itself_reads_the_file_and_gives_our_values(name):
    imucal = pytest.importorskip('imucal')
    calibration = unit(name)
    gyro, accel = samples(calibration)
    info = imucal.CalibrationInfo.from_json(exported('imucal', calibration))
    assert type(info).__name__ == 'TurntableCalibrationInfo'
    for matrix in (info.K_a, info.K_g):
        assert np.array_equal(matrix, np.diag(np.diag(matrix)))
    force, rate = info.calibrate(accel, gyro, info.from_acc_unit, info.from_gyr_unit)
    assert_same((rate * DEG, force), ours(calibration, gyro, accel))


def kalibr(calibration: Calibration) -> dict[str, Any]:
    return dict(yaml.safe_load(exported('kalibr', calibration)))


def test_kalibr_predicts_what_our_model_predicts():
    # IccSensors.py, IccScaledMisalignedImu: alpha = M (C_i_b a_b) + b and
    # omega = M (C_gyro_i C_i_b w_b) + Ma (C_gyro_i C_i_b a_b) + b.
    calibration = unit('si')
    file = kalibr(calibration)
    gyros, accels = file['gyroscopes'], file['accelerometers']
    c_i_b = np.array(file['T_i_b'])[:3, :3]
    c_gyro_b = np.array(gyros['C_gyro_i']) @ c_i_b
    rng = np.random.default_rng(1)
    rate, force = rng.normal(0, 1, (5, 3)), rng.normal(0, 9.8, (5, 3))
    omega = np.array(
        [
            np.array(gyros['M']) @ c_gyro_b @ w + np.array(gyros['A']) @ c_gyro_b @ a
            for w, a in zip(rate, force, strict=True)
        ]
    ) + np.array(gyros['bias'])
    alpha = np.array([np.array(accels['M']) @ c_i_b @ a for a in force]) + np.array(accels['bias'])
    assert_same((omega, alpha), calibration.model.predict(rate, force))


def test_kalibrs_matrices_have_its_form_and_its_noise_its_units():
    file = kalibr(unit('si'))
    rotations = [np.array(file['T_i_b'])[:3, :3], np.array(file['gyroscopes']['C_gyro_i'])]
    for rotation in rotations:
        assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
        assert np.linalg.det(rotation) > 0
        # It is a choice of frame, not a turn to another axis.
        assert np.diag(rotation).min() > 0.99
    for matrix in (file['gyroscopes']['M'], file['accelerometers']['M']):
        assert np.array_equal(matrix, np.tril(matrix))
    assert file['update_rate'] == RATE
    assert file['rostopic'] == '/imu0'
    # One figure for three axes: the root mean square. The IMU noise model of Kalibr's wiki has
    # densities in rad/s/sqrt(Hz) and m/s^2/sqrt(Hz), random walks in rad/s^2/sqrt(Hz) and
    # m/s^3/sqrt(Hz); 1/sqrt(Hz) is sqrt(s), so that ours in rad/sqrt(s) and so on are the same.
    assert file['gyroscope_noise_density'] == pytest.approx(np.sqrt(14 / 3) * 1e-5)
    assert file['accelerometer_noise_density'] == pytest.approx(np.sqrt(14 / 3) * 1e-3)
    assert file['gyroscope_random_walk'] == pytest.approx(np.sqrt((1 + 4 + 9) / 3) * 1e-6)
    assert file['accelerometer_random_walk'] == pytest.approx(np.sqrt((16 + 25 + 36) / 3) * 1e-6)


def test_kalibrs_formula_makes_the_noise_that_its_figure_was_measured_from():
    # The wiki: sigma_discrete = sigma / sqrt(dt). White samples of that size, summed up,
    # are the random walk that our figure states: sigma^2 * t.
    file = kalibr(unit('si'))
    rng, dt, seconds, runs = np.random.default_rng(8), 0.1, 100.0, 400
    for sensor, stated in (('gyroscope', WALK[:3]), ('accelerometer', WALK[3:])):
        discrete = file[f'{sensor}_noise_density'] / np.sqrt(dt)
        sums = discrete * rng.standard_normal((runs, round(seconds / dt))).sum(axis=1) * dt
        expected = np.mean(np.square(stated)) * seconds
        # 400 of them: 7 %, four deviations of that.
        assert np.mean(sums**2) == pytest.approx(expected, rel=0.28)


@pytest.mark.parametrize('share', [0.5, 2.0])
def test_noise_from_the_data_sheet_is_in_kalibrs_units(share):
    calibration = replace(unit('si'), provenance={})
    sheet = load_imu('fog_medium')
    sheet = replace(sheet, accel=replace(sheet.accel, random_walk=share * 1e-3))
    file = yaml.safe_load(
        EXPORTS['kalibr'](ExportSource(calibration, Path('/c.yaml'), RATE, sheet=sheet)).text
    )
    assert file['accelerometer_noise_density'] == pytest.approx(share * 1e-3)
    assert file['gyroscope_noise_density'] == pytest.approx(sheet.gyro.random_walk)
    assert file['accelerometer_random_walk'] == pytest.approx(sheet.accel.bias_instability / 60)


def test_noise_that_nobody_measured_is_the_data_sheets_and_it_is_said():
    calibration = replace(unit('si'), provenance={'random_walk': WALK})
    sheet = load_imu('fog_medium')
    found = EXPORTS['kalibr'](ExportSource(calibration, Path('/c.yaml'), sheet=sheet))
    file = yaml.safe_load(found.text)
    # 0.1 deg/h over the root of an hour.
    assert file['gyroscope_random_walk'] == pytest.approx(0.1 * DEG_H / 60)
    assert file['update_rate'] == 100.0
    assert any('rule of thumb' in sentence for sentence in found.findings)


def test_the_noise_of_a_hand_is_not_written_as_that_of_the_sensor():
    noise = unit('si').provenance
    held = replace(unit('si'), provenance={**noise, 'by_hand': True})
    with pytest.raises(InputError, match=r'noise of the accelerometers.*imu-calib noise BAG'):
        EXPORTS['kalibr'](ExportSource(held, Path('/c.yaml'), RATE))
    sheet = load_imu('mems_counts')
    file = EXPORTS['kalibr'](ExportSource(held, Path('/c.yaml'), RATE, sheet=sheet))
    density = yaml.safe_load(file.text)['gyroscope_noise_density']
    assert density == pytest.approx(sheet.gyro.random_walk)


def test_kalibr_is_refused_what_it_needs_in_words():
    calibration = unit('si')
    with pytest.raises(InputError, match='give `sample_rate`'):
        EXPORTS['kalibr'](ExportSource(calibration, Path('/c.yaml')))
    with pytest.raises(InputError, match='noise of the accelerometers'):
        EXPORTS['kalibr'](ExportSource(replace(calibration, provenance={}), Path('/c.yaml'), RATE))
    with pytest.raises(InputError, match="'imu data' is not a valid name of a topic"):
        EXPORTS['kalibr'](ExportSource(calibration, Path('/c.yaml'), RATE, 'imu data'))
    mirrored = replace(calibration.model, gyro=Triad(np.diag([0.0, -2.0, 0.0])))
    with pytest.raises(InputError, match='gyros are'):
        EXPORTS['kalibr'](ExportSource(replace(calibration, model=mirrored), Path('/c.yaml'), RATE))


@pytest.mark.parametrize('name', ['fog_medium', 'mems_counts', 'si'])
@pytest.mark.parametrize(('define', 'tolerance'), [(None, 1e-12), ('IMU_CALIB_FLOAT', 3e-6)])
def test_the_c_header_gives_our_values(name, define, tolerance, tmp_path):
    calibration = unit(name)
    gyro, accel = samples(calibration)
    header = exported('c', calibration)
    found = compensated_in_c(tmp_path, header, np.hstack([gyro, accel]), define)
    for mine, theirs in zip(
        (found[:, 0::2], found[:, 1::2]), ours(calibration, gyro, accel), strict=True
    ):
        assert np.abs(mine - theirs).max() < tolerance * np.abs(theirs).max()


def test_the_c_header_is_included_by_its_name(tmp_path):
    imu_calib.export(unit('si'), 'c', tmp_path / 'imu.h')
    assert '#include "imu.h"' in (tmp_path / 'imu.h').read_text(encoding='utf-8')


@pytest.mark.parametrize(
    ('units', 'scales', 'said'),
    [
        (Units.RATES, (DEG, STANDARD_GRAVITY), 'raw_gyro in deg/s, raw_accel in g.'),
        (Units.RATES, (0.5, 1.0), 'raw_gyro in units of 0.5 rad/s, raw_accel in m/s^2.'),
        (Units.SI, (1.0, 1.0), 'raw_gyro in rad/s, raw_accel in m/s^2.'),
    ],
)
def test_the_c_header_names_the_units_of_raw_values(units, scales, said):
    triads = map(TriadSpec, scales)
    assert said in exported('c', replace(unit('si'), imu=ImuSpec('a', units, None, *triads)))


def test_the_example_of_the_c_header_states_no_interval_to_be_copied():
    """A calibration does not hold the rate of its unit: 0.01 s was that of no other than 100 Hz."""
    assert '(raw_gyro, raw_accel, seconds, rate, force)' in exported('c', unit('si'))


@pytest.mark.parametrize('name', EXPORTS)
def test_an_export_names_the_unit_or_its_recording_in_one_line(name):
    calibration = unit('si')
    recorded = replace(calibration, provenance={**calibration.provenance, 'recording': 'shelf_2'})
    assert 'shelf_2' in exported(name, recorded)
    numbered = exported(name, replace(calibration, serial_number='A\nkey: 1'))
    assert 'A key: 1' in numbered or r'A\nkey: 1' in numbered


@pytest.mark.parametrize('node', ['/compensator_node', '/robot/compensator_node'])
def test_the_ros_file_reaches_the_node_in_any_namespace(node, tmp_path):
    needs_modules('cyclonedds')
    from imu_calib.live.middleware.dds.arguments import parse

    path = tmp_path / 'params.yaml'
    path.write_text(exported('ros', unit()))
    arguments = parse(['--ros-args', '--params-file', str(path)])
    assert arguments.parameters_of(node) == {'calibration': '/robot/calibration.yaml'}
    assert arguments.parameters_of('/imu_node') == {}


def test_the_command_writes_and_says_what_is_lost(tmp_path, capsys):
    file = tmp_path / 'calibration.yaml'
    unit().save(file)
    for name in EXPORTS:
        target = tmp_path / name
        code = main(
            ['export', str(file), '--format', name, '-o', str(target), '--sample-rate', '100']
        )
        assert code == 0
        assert target.stat().st_size > 0
        assert str(target) in capsys.readouterr().out
    assert yaml.safe_load((tmp_path / 'ros').read_text())['/**']['compensator_node'][
        'ros__parameters'
    ] == {'calibration': str(file)}
    assert main(['export', str(file), '--format', 'imucal', '-o', str(tmp_path / 'x')]) == 2
    assert main(['export', str(file), '--format', 'c', '-o', str(file)]) == 2
    assert 'is an input of the command' in capsys.readouterr().err
    assert main(['export', str(file), '--format', 'c', '-o', '-']) == 2
    assert '/dev/stdout is the standard output' in capsys.readouterr().err


def test_a_gyro_only_calibration_says_so():
    calibration = unit('si')
    covariance = calibration.covariance[:24, :24].copy()
    covariance[12:, :], covariance[:, 12:] = np.nan, np.nan
    model = SensorModel(calibration.model.gyro)
    gyros_alone = replace(
        calibration, covariance=covariance, model=model, parameters=model.parameters
    )
    left = EXPORTS['c'](ExportSource(gyros_alone, Path('/c.yaml'))).findings
    assert any('accelerometers were not calibrated' in sentence for sentence in left)


def test_the_default_topic_is_that_of_a_recording_in_si():
    calibration = unit()
    named = {**calibration.provenance, 'topics': ['/imu/temperature', '/my/imu']}
    for units, topic in (('si', '/my/imu'), ('mems_counts', '/imu/data')):
        one = replace(calibration, imu=load_imu(units), provenance=named)
        words = {'sample_rate': RATE, 'imu': 'mems_counts'}
        text = imu_calib.export(one, 'kalibr', **words).text
        assert f'rostopic: {topic}\n' in text and '# Gyros: density in rad/s/sqrt(Hz)' in text
