"""Parameters that no strapdown IMU has are refused wherever a calibration is read."""

from dataclasses import replace

import numpy as np
import pytest
from sessions import truth

from imu_calib.calibration.calibration import Calibration
from imu_calib.calibration.provenance import check_plausible
from imu_calib.common.errors import InputError
from imu_calib.common.files import named_file
from imu_calib.common.stream import Units
from imu_calib.model.sensors import SensorModel, Skewed
from imu_calib.session.imu import load_imu

NAMES = [p.name for p in truth().parameters]


def changed(**values):
    vector = truth().model.vector().copy()
    for name, value in values.items():
        vector[NAMES.index(name)] = value
    return replace(truth(), model=SensorModel.from_vector(vector))


@pytest.mark.parametrize(
    'name', ['cao2022_table1', 'fog_navigation_33', 'fog_skewed', 'mems_counts']
)
def test_every_shipped_truth_is_plausible(name):
    Calibration.load(named_file('truths', name))


# Just inside and just outside of what is accepted, with everything else at zero.
@pytest.mark.parametrize(
    ('name', 'inside', 'outside', 'words'),
    [
        ('K_ay', 0.99, 1.01, 'accelerometer Y answers 2.01 times'),
        ('K_gz', -0.49, -0.51, 'gyro Z answers 0.49 times'),
        ('E_gxy', 0.57, 0.59, 'gyro X lies 3. deg off'),
        ('D_gx', 1.7, 1.8, 'gyro bias: found 1.8 rad/s, expected at most 1.745'),
        ('D_az', -9.7, -9.9, 'accelerometer bias: found 9.9 m/s'),
    ],
)
def test_limits(name, inside, outside, words):
    ideal = replace(truth(), model=SensorModel())
    vector = np.zeros(24)
    for value in (inside, outside):
        vector[NAMES.index(name)] = value
        calibration = replace(ideal, model=SensorModel.from_vector(vector))
        if value == inside:
            check_plausible(calibration, 'file')
        else:
            with pytest.raises(InputError, match=words):
                check_plausible(calibration, 'file')


def test_the_range_of_the_unit_limits_its_bias():
    imu = load_imu('fog_medium')
    narrow = replace(imu, gyro=replace(imu.gyro, range=0.1))
    with pytest.raises(InputError, match='gyro bias'):
        check_plausible(replace(changed(D_gx=0.11), imu=narrow), 'file')


def test_adc_codes_may_count_from_any_offset():
    imu = replace(load_imu('mems_counts'), units=Units.COUNTS)
    check_plausible(replace(changed(D_ax=330.0, D_gx=50.0), imu=imu), 'file')


def test_a_mirrored_axis_is_refused():
    with pytest.raises(InputError, match=r'gyro Y lies 180 deg off.*mirrored'):
        check_plausible(changed(K_gy=-2.0), 'file')


def test_g_sensitivity_is_limited():
    model = replace(truth().model, g_sensitivity=np.full((3, 3), 0.02))
    with pytest.raises(InputError, match=r'g-sensitivity: found 0.02'):
        check_plausible(
            replace(
                truth(), model=model, covariance=np.zeros((33, 33)), parameters=model.parameters
            ),
            'file',
        )


def test_a_skewed_gyro_is_limited():
    model = replace(truth().model, skewed=Skewed(np.full((1, 3), 3.0), np.zeros(1)))
    covariance = np.zeros((28, 28))
    with pytest.raises(InputError, match=r'skewed gyro X answers 5.196 times'):
        check_plausible(
            replace(truth(), model=model, covariance=covariance, parameters=model.parameters),
            'file',
        )


@pytest.mark.parametrize('kind', ['negative', 'lopsided', 'impossible', 'infinite', 'gyro missing'])
def test_what_is_no_covariance_is_refused(kind):
    covariance = np.diag(np.geomspace(1e-20, 1e-6, 24))
    check_plausible(replace(truth(), covariance=covariance), 'file')
    if kind == 'negative':
        covariance[3, 3] *= -1
    elif kind == 'lopsided':
        covariance[0, 1] = 0.5 * np.sqrt(covariance[0, 0] * covariance[1, 1])
    elif kind == 'impossible':
        covariance[0, 1] = covariance[1, 0] = 1.1 * np.sqrt(covariance[0, 0] * covariance[1, 1])
    elif kind == 'infinite':
        covariance[5, 5] = np.inf
    else:
        covariance[2] = covariance[:, 2] = np.nan
    with pytest.raises(InputError, match='covariance'):
        check_plausible(replace(truth(), covariance=covariance), 'file')


def test_gyros_alone_are_plausible():
    covariance = np.zeros((24, 24))
    covariance[12:] = covariance[:, 12:] = np.nan
    check_plausible(replace(truth(), covariance=covariance), 'file')


def test_a_file_is_refused_with_its_name(tmp_path):
    path = tmp_path / 'unit.yaml'
    changed(K_az=3.0).save(path)
    with pytest.raises(InputError, match=r'unit\.yaml: accelerometer Z answers 4 times'):
        Calibration.load(path)


def test_a_combined_file_is_refused(tmp_path):
    from calibrations import point

    from imu_calib.calibration.thermal import ThermalCalibration, load_calibration

    parts = point(0.0, 0.0), point(20.0, 3.0)
    ThermalCalibration(parts).save(tmp_path / 'both.yaml')
    with pytest.raises(InputError, match=r'both\.yaml: calibrations\[1\]: gyro bias'):
        load_calibration(tmp_path / 'both.yaml')
