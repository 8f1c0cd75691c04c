"""Calibrations at several temperatures, combined: from drifting simulated hardware, and by hand."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from calibrations import point
from sessions import at_one_rate, calibrate, quick_plan, session, stand, truth

from imu_calib.calibration.calibration import Calibration
from imu_calib.calibration.thermal import (
    ThermalCalibration,
    combine,
    load_calibration,
)
from imu_calib.cli.main import main
from imu_calib.common.errors import InputError
from imu_calib.common.stream import TemperatureBlock
from imu_calib.common.units import DEG_H, MICRO_G
from imu_calib.model.sensors import SensorModel, Triad
from imu_calib.segmentation.course import Thermometer
from imu_calib.session.imu import StampingClock
from imu_calib.simulation.options import ThermalDrift, Warming

TEMPERATURES = (-20.0, 20.0, 55.0)
REFERENCE = 25.0
DRIFT = ThermalDrift(
    gyro_bias=(0.1 * DEG_H, -0.2 * DEG_H, 0.15 * DEG_H),
    gyro_scale=(20e-6, -30e-6, 10e-6),
    accel_bias=(50 * MICRO_G, -30 * MICRO_G, 40 * MICRO_G),
    accel_scale=(15e-6, 25e-6, -10e-6),
)


def true_model(celsius):
    """The unit at a temperature, by the coefficients that were given to the simulation."""
    excess, model = celsius - REFERENCE, truth().model

    def drifted(triad, bias, scale):
        response = (1 + excess * np.array(scale))[:, None] * triad.response
        return Triad(response - np.eye(3), triad.bias + excess * np.array(bias))

    return SensorModel(
        drifted(model.gyro, DRIFT.gyro_bias, DRIFT.gyro_scale),
        drifted(model.accel, DRIFT.accel_bias, DRIFT.accel_scale),
    )


@cache
def at(celsius, dwell=12.0):
    plan = at_one_rate(quick_plan('twelve_position', dwell=dwell))
    warming = Warming(reference=REFERENCE, offset=celsius - REFERENCE)
    options = stand(warming=warming, thermal_drift=DRIFT)
    return calibrate(session(plan, options, seed=round(celsius) % 97), plan).calibration


def combined(order=None):
    return combine([at(t) for t in TEMPERATURES], [f'{t}' for t in TEMPERATURES], order)


@pytest.mark.parametrize('order', [None, 1, 2])
def test_between_the_temperatures_the_truth_lies_within_the_deviations(order):
    thermal = combined(order)
    worst, squares = 0.0, []
    for celsius in (-20.0, -7.0, 3.0, 20.0, 31.0, 46.0, 55.0):
        found = thermal.at(celsius)
        error = (found.values - true_model(celsius).vector()) / found.std
        worst = max(worst, np.abs(error).max())
        squares.append(np.mean(error**2))
    # 24 parameters of three independent sessions: 72 normal numbers and what they make.
    assert worst < 4.0
    # The doubt of straight lines widens; nothing may make the deviations too small.
    assert np.mean(squares) < 1.5
    # The drift over the gaps is many deviations: without it the same bound fails.
    still = (at(20.0).values - true_model(46.0).vector()) / at(20.0).std
    assert np.abs(still).max() > 10


def test_a_session_tells_its_temperature():
    provenance = at(-20.0).provenance['temperature']
    assert provenance == pytest.approx({'mean': -20.0, 'lowest': -20.0, 'highest': -20.0})


def test_a_temperature_is_the_same_however_it_came_in():
    rng = np.random.default_rng(0)
    celsius = np.append(rng.normal(20.0, 3.0, 1000), [np.nan, 1e9])
    stamp = 10**9 * np.arange(len(celsius)) + 7
    whole = Thermometer()
    whole.add_temperatures(TemperatureBlock(stamp, celsius))
    for seed in range(5):
        order = np.random.default_rng(seed).permutation(len(celsius))
        parts = Thermometer()
        for piece in np.array_split(order, 17):
            parts.add_temperatures(TemperatureBlock(stamp[piece], celsius[piece]))
        assert parts.temperature == whole.temperature
        assert (parts.temperature.course == whole.temperature.course).all()
    assert whole.temperature.mean == pytest.approx(celsius[:1000].mean(), abs=1e-6)


def test_temperatures_may_be_half_a_kelvin_apart_and_no_closer():
    assert combine([point(0.5, 1.0), point(0.0, 2.0)], ['a', 'b']).temperatures.tolist() == [0, 0.5]
    with pytest.raises(InputError, match=r'Two calibrations at 0\.00 and 0\.49 degC'):
        combine([point(0.49, 1.0), point(0.0, 2.0)], ['a', 'b'])


def test_the_file_says_what_lies_in_between():
    points = [point(0.0, 1.0), point(10.0, 2.0), point(20.0, 4.0)]
    assert '\norder: lines\n' in combine(points, list('abc')).to_yaml()
    assert '\norder: 2\n' in combine(points, list('abc'), 2).to_yaml()


def test_the_clock_is_weighed_as_the_parameters_are():
    clocks = [StampingClock('imu', 'table', f, s) for f, s in ((2e-5, 3e-6), (6e-5, 4e-6))]
    timed = [
        replace(point(t, 1.0), clock=clock) for t, clock in zip((0.0, 10.0), clocks, strict=True)
    ]
    found = combine(timed, ['a', 'b']).at(2.5).clock
    assert found.faster == pytest.approx(0.75 * 2e-5 + 0.25 * 6e-5)
    assert found.std == pytest.approx(np.hypot(0.75 * 3e-6, 0.25 * 4e-6))
    assert (found.name, found.against) == ('imu', 'table')


def test_the_command_combines_files_in_any_order(tmp_path):
    names = []
    for celsius in (20.0, 55.0, -20.0):
        names.append(str(tmp_path / f'{celsius:g}.yaml'))
        at(celsius).save(tmp_path / f'{celsius:g}.yaml')
    output = tmp_path / 'all.yaml'
    assert main(['combine', *names, '-o', str(output)]) == 0
    read = load_calibration(output)
    assert isinstance(read, ThermalCalibration)
    assert read.to_yaml() == output.read_text()
    assert np.array_equal(read.at(3.0).values, combined().at(3.0).values)
    assert np.array_equal(read.at(3.0).covariance, combined().at(3.0).covariance)
    single = load_calibration(tmp_path / '20.yaml')
    assert isinstance(single, Calibration)
