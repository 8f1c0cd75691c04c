import numpy as np
import pytest

from imu_calib.model.parameters import PARAMETER_NAMES
from imu_calib.model.sensors import SensorModel, Triad


def test_prediction_by_hand():
    # Cao 2022, eq. (1), row y: n = E_yx wx + (1 + K_y) wy + E_yz wz + D_y.
    matrix = np.array([[0.1, 0, 0], [0.02, 0.3, 0.04], [0, 0, 0]])
    model = SensorModel(Triad(matrix, np.array([0, 5.0, 0])))
    gyro, accel = model.predict(np.array([1.0, 2.0, 3.0]), np.array([7.0, 8.0, 9.0]))
    assert gyro == pytest.approx([1.1, 0.02 + 1.3 * 2 + 0.04 * 3 + 5, 3.0])
    assert accel == pytest.approx([7, 8, 9])


def test_names_are_row_and_column_of_the_matrix():
    vector = np.zeros(24)
    vector[PARAMETER_NAMES.index('E_gxy')] = 1.0
    vector[PARAMETER_NAMES.index('D_az')] = 2.0
    model = SensorModel.from_vector(vector)
    assert model.gyro.error_matrix[0, 1] == 1.0
    assert model.accel.bias[2] == 2.0
    assert np.array_equal(model.vector(), vector)
    assert len(set(PARAMETER_NAMES)) == 24


def test_no_parameters_have_no_derivatives():
    """As where every term is on, and none is left to be looked for."""
    at = np.zeros((4, 3))
    assert SensorModel().derivatives(at, at, ()).shape == (4, 6, 0)
