import numpy as np
import pytest

from imu_calib.common.errors import NotObservable
from imu_calib.model.parameters import PARAMETER_NAMES
from imu_calib.model.sensors import SensorModel, Triad


def test_prediction_by_hand() -> None:
    # Cao 2022, eq. (1), row y: n = E_yx wx + (1 + K_y) wy + E_yz wz + D_y.
    matrix = np.array([[0.1, 0, 0], [0.02, 0.3, 0.04], [0, 0, 0]])
    model = SensorModel(Triad(matrix, np.array([0, 5.0, 0])))
    gyro, accel = model.predict(np.array([1.0, 2.0, 3.0]), np.array([7.0, 8.0, 9.0]))
    assert gyro == pytest.approx([1.1, 0.02 + 1.3 * 2 + 0.04 * 3 + 5, 3.0])
    assert accel == pytest.approx([7, 8, 9])


def test_g_sensitivity_adds_to_the_gyros_alone() -> None:
    model = SensorModel(g_sensitivity=np.array([[0, 0, 1e-3], [0, 0, 0], [0, 0, 0]]))
    gyro, accel = model.predict(np.zeros(3), np.array([0, 0, 9.8]))
    assert gyro == pytest.approx([9.8e-3, 0, 0])
    assert accel == pytest.approx([0, 0, 9.8])


def test_compensation_undoes_prediction() -> None:
    rng = np.random.default_rng(0)
    model = SensorModel(
        Triad(rng.normal(0, 0.05, (3, 3)), rng.normal(size=3)),
        Triad(rng.normal(0, 0.05, (3, 3)), rng.normal(size=3)),
        rng.normal(0, 1e-3, (3, 3)),
    )
    rate, force = rng.normal(size=(50, 3)), rng.normal(size=(50, 3))
    back_rate, back_force = model.compensate(*model.predict(rate, force))
    assert back_rate == pytest.approx(rate, abs=1e-12)
    assert back_force == pytest.approx(force, abs=1e-12)


def test_a_singular_model_cannot_compensate() -> None:
    model = SensorModel(Triad(-np.eye(3)))
    with pytest.raises(NotObservable, match='singular'):
        model.compensate(np.zeros(3), np.zeros(3))


def test_names_are_row_and_column_of_the_matrix() -> None:
    vector = np.zeros(24)
    vector[PARAMETER_NAMES.index('E_gxy')] = 1.0
    vector[PARAMETER_NAMES.index('D_az')] = 2.0
    model = SensorModel.from_vector(vector)
    assert model.gyro.error_matrix[0, 1] == 1.0
    assert model.accel.bias[2] == 2.0
    assert np.array_equal(model.vector(), vector)
    assert len(set(PARAMETER_NAMES)) == 24


def test_no_parameters_have_no_derivatives() -> None:
    """As where every term is on, and none is left to be looked for."""
    at = np.zeros((4, 3))
    assert SensorModel().derivatives(at, at, ()).shape == (4, 6, 0)
