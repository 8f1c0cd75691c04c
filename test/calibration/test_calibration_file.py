from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from sessions import truth

from imu_calib.calibration.calibration import Calibration, ResidualRow, is_as_saved
from imu_calib.common.errors import InputError
from imu_calib.common.units import ARCMIN
from imu_calib.model.sensors import SensorModel
from imu_calib.reports.tables import angle_table, parameter_table

DOCS = Path(__file__).parents[2] / 'docs'


def example() -> Calibration:
    rng = np.random.default_rng(0)
    square = rng.normal(size=(24, 24)) * 1e-6
    return Calibration(
        truth().imu,
        SensorModel.from_vector(rng.normal(size=24) * 1e-3),
        square @ square.T,
        (ResidualRow('1', 12.5, rng.normal(size=3), rng.normal(size=3)),),
        ('Position 3: left out, the sensor is saturated.',),
        {'plan': 'twelve_position'},
    )


def test_a_calibration_comes_back_from_its_file_bit_for_bit(tmp_path):
    saved, path = example(), tmp_path / 'calibration.yaml'
    saved.save(path)
    loaded = Calibration.load(path)
    assert loaded.to_yaml() == saved.to_yaml()
    assert np.array_equal(loaded.model.vector(), saved.model.vector())
    assert np.array_equal(loaded.covariance, saved.covariance)
    assert [p.name for p in tmp_path.iterdir()] == ['calibration.yaml']


def test_a_file_shows_that_it_was_edited(tmp_path):
    path = tmp_path / 'calibration.yaml'
    example().save(path)
    saved = path.read_bytes()
    assert is_as_saved(path) is True
    path.write_bytes(saved.replace(b'\n', b'\r\n'))
    assert is_as_saved(path) is True
    path.write_bytes(saved.replace(b'imu: ', b'imu:  '))
    assert is_as_saved(path) is False
    path.write_bytes(saved[: saved.rindex(b'checksum')])
    assert is_as_saved(path) is None


def test_a_mean_temperature_that_was_rounded_beyond_the_readings_is_loaded(tmp_path):
    seen, path = {'mean': 25.299999999999997, 'lowest': 25.3, 'highest': 25.3}, tmp_path / 'c.yaml'
    replace(example(), provenance={'temperature': seen}).save(path)
    assert Calibration.load(path).provenance['temperature'] == seen


@pytest.mark.parametrize('name', ['E_gxy', 'D_az'])
@pytest.mark.parametrize('number', [np.nan, np.inf])
@pytest.mark.parametrize('spoilt', ['value', 'std'])
def test_a_parameter_without_a_number_is_not_written(tmp_path, name, number, spoilt):
    calibration, path = example(), tmp_path / 'calibration.yaml'
    k = [p.name for p in calibration.parameters].index(name)
    values, covariance = calibration.values.copy(), calibration.covariance.copy()
    if spoilt == 'value':
        values[k] = number
    else:
        covariance[k, k] = number
    parameters = calibration.parameters
    calibration = replace(
        calibration,
        model=calibration.model.with_values(parameters, values),
        covariance=covariance,
    )
    with pytest.raises(InputError, match=f'cannot be written: {name} is not a number'):
        calibration.save(path)
    assert not path.exists()


def test_the_file_says_the_angles_between_input_axes_and_cannot_contradict_itself():
    calibration = example()
    text = calibration.to_yaml()
    document = yaml.safe_load(text)
    written = document['free_of_frame']
    axes = np.eye(3) + np.array(document['gyro']['error_matrix'])
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    between = [np.pi / 2 - np.arccos(axes[i] @ axes[j]) for i, j in ((0, 1), (0, 2), (1, 2))]
    assert written['gyro_nonorthogonality'] == pytest.approx(between, abs=1e-12)
    assert set(written) - {'std'} == set(written['std'])
    found = {a.group.key: a for a in calibration.free_of_frame}
    assert written['std']['gyro_to_accelerometer'] == list(found['gyro_to_accelerometer'].std)
    # Somebody changes the block: what is read follows from matrices and covariance alone.
    first = written['gyro_nonorthogonality'][0]
    changed = text.replace(repr(first), '0.5')
    assert changed != text
    assert Calibration.from_yaml(changed, 'c.yaml').to_yaml() == text


def test_the_file_alone_is_enough_to_apply_it():
    # The README's formula on what yaml.safe_load returns, against the model's own compensation.
    calibration = example()
    document = yaml.safe_load(calibration.to_yaml())
    pulses, interval = np.array([3.0, -1.0, 7.0]), 0.01
    part = document['accelerometer']
    response = np.eye(3) + np.array(part['error_matrix'])
    force = np.linalg.solve(response, pulses * part['scale_factor'] / interval - part['bias'])
    _, expected = calibration.model.compensate(np.zeros(3), pulses * 0.01 / interval)
    assert force == pytest.approx(expected, rel=1e-12)


def rendered(table: object) -> list[list[str]]:
    columns = [list(column.cells) for column in table.columns]
    return [[str(cell) for cell in row] for row in zip(*columns, strict=True)]


def test_the_truth_of_the_paper_prints_as_the_paper_prints_it(monkeypatch):
    # Cao 2022, Table 1, twelve positions; names, order, numbers and units are the paper's.
    monkeypatch.syspath_prepend(DOCS)
    from table_1 import table_1

    rows = {r[0]: (float(r[2]), r[-1]) for r in rendered(table_1(truth(), truth()))}
    printed = {
        'K_GX': (-0.015, 'arcsec/p'),
        'K_GZ': (0.008, 'arcsec/p'),
        'E_GXY': (5.23, 'arcmin'),
        'E_GYX': (-4.79, 'arcmin'),
        'E_GZY': (-1.60, 'arcmin'),
        'D_GX': (1.75, 'deg/h'),
        'K_AX': (0.0010, '(m/s)/p'),
        'K_AZ': (-0.002, '(m/s)/p'),
        'E_AXY': (4.57, 'arcmin'),
        'E_AYZ': (7.55, 'arcmin'),
        'D_AX': (0.0003, 'g'),
        'D_AZ': (-0.0007, 'g'),
    }
    for name, (value, unit) in printed.items():
        assert rows[name][0] == pytest.approx(value, abs=1e-6)
        assert rows[name][1] == unit
    assert list(rows)[:4] == ['K_GX', 'K_GY', 'K_GZ', 'E_GXY']


def test_the_screen_shows_the_angles_of_the_file_beside_those_of_the_truth():
    calibration = example()
    rows = rendered(angle_table(calibration, calibration))
    shown = [pair for a in calibration.free_of_frame for pair in zip(a.values, a.std, strict=True)]
    assert len(rows) == len(shown) == 9
    for (_, value, std, unit, true, ratio), (wanted, deviation) in zip(rows, shown, strict=True):
        places = len(std.partition('.')[2])
        assert float(value) == pytest.approx(wanted / ARCMIN, abs=0.51 * 10**-places)
        assert float(std) == pytest.approx(deviation / ARCMIN, rel=0.06)
        assert (unit, true, float(ratio)) == ('arcmin', value, 0.0)
    names = ['gyros xy', 'accelerometers xz', 'gyros to accelerometers Z']
    assert [row[0] for row in rows[::4]] == names


def test_the_table_shows_as_many_digits_as_the_deviation_deserves():
    rows = rendered(parameter_table(example(), example()))
    assert len(rows) == 24
    for name, value, deviation, unit, _, ratio in rows:
        assert unit == {'K': 'ppm', 'E': 'arcmin'}.get(name[0], 'deg/h' if name[2] == 'g' else 'ug')
        assert value.partition('.')[2] == '' or len(value.partition('.')[2]) == len(
            deviation.partition('.')[2]
        )
        assert float(ratio) == 0.0
