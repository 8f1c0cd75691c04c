"""The angles between input axes, against a unit that is turned as a whole in plain loops."""

import math

import numpy as np
import pytest

from imu_calib.common.units import ARCSEC
from imu_calib.model.alignment import GROUPS, free_of_frame
from imu_calib.model.parameters import PARAMETERS
from imu_calib.model.sensors import SensorModel, Triad

Rows = list[list[float]]
IDENTITY = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]


def product(a: Rows, b: Rows) -> Rows:
    return [[sum(a[i][k] * b[k][j] for k in range(3)) for j in range(3)] for i in range(3)]


def transposed(a: Rows) -> Rows:
    return [[a[j][i] for j in range(3)] for i in range(3)]


def inverse(a: Rows) -> Rows:
    """By cofactors."""

    def minor(i: int, j: int) -> float:
        (p, q), (r, s) = ([k for k in range(3) if k != m] for m in (i, j))
        return (-1) ** (i + j) * (a[p][r] * a[q][s] - a[p][s] * a[q][r])

    whole = sum(a[0][j] * minor(0, j) for j in range(3))
    return [[minor(j, i) / whole for j in range(3)] for i in range(3)]


def turned_about(vector: list[float]) -> Rows:
    """The rotation by a vector, by the series of the exponential."""
    x, y, z = vector
    cross = [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]
    total, power = IDENTITY, IDENTITY
    for n in range(1, 40):
        power = [[v / n for v in row] for row in product(power, cross)]
        total = [[total[i][j] + power[i][j] for j in range(3)] for i in range(3)]
    return total


def units(a: Rows) -> Rows:
    return [[v / math.sqrt(sum(w * w for w in row)) for v in row] for row in a]


def nearest_rotation(a: Rows) -> Rows:
    """By Newton's iteration of the mean of a matrix and the transpose of its inverse."""
    for _ in range(50):
        other = transposed(inverse(a))
        a = [[(a[i][j] + other[i][j]) / 2 for j in range(3)] for i in range(3)]
    return a


def vector_of(a: Rows) -> list[float]:
    angle = math.acos((a[0][0] + a[1][1] + a[2][2] - 1) / 2)
    ratio = angle / (2 * math.sin(angle))
    return [
        (a[2][1] - a[1][2]) * ratio,
        (a[0][2] - a[2][0]) * ratio,
        (a[1][0] - a[0][1]) * ratio,
    ]


def expected(gyro: Rows, accel: Rows) -> list[float]:
    found = []
    for axes in (units(gyro), units(accel)):
        for i, j in ((0, 1), (0, 2), (1, 2)):
            angle = math.acos(sum(axes[i][k] * axes[j][k] for k in range(3)))
            found.append(math.pi / 2 - angle)
    frames = [nearest_rotation(units(a)) for a in (gyro, accel)]
    return found + vector_of(product(frames[1], transposed(frames[0])))


def angles(gyro: Rows, accel: Rows, covariance: np.ndarray | None = None):
    model = SensorModel(Triad(np.array(gyro) - np.eye(3)), Triad(np.array(accel) - np.eye(3)))
    return free_of_frame(
        model, np.zeros((24, 24)) if covariance is None else covariance, PARAMETERS
    )


def values(gyro: Rows, accel: Rows) -> np.ndarray:
    return np.concatenate([group.values for group in angles(gyro, accel)])


# Scale-factor errors of 2000 ppm, axes off by some arc minutes.
GYRO = [[1.0019, 2e-3, -7e-4], [-1.4e-3, 0.9986, 9e-4], [5e-4, -1.1e-3, 1.0023]]
ACCEL = [[0.9991, -1.3e-3, 4e-4], [2.2e-3, 1.0007, -1.9e-3], [-3e-4, 6e-4, 0.9979]]


def test_axes_of_a_unit_enclose_what_they_enclose():
    # Known by construction: all pairs of accelerometers at acos(0.01), gyros at right angles and
    # turned against them by a known vector.
    c, turn = 0.01, [3e-3, -1e-3, 2e-3]
    accel = [[1, c, c], [c, 1, c], [c, c, 1]]
    gyro = transposed(turned_about(turn))
    sine = (2 * c + c * c) / (1 + 2 * c * c)
    found = dict(zip((g.key for g in GROUPS), angles(gyro, accel), strict=True))
    assert found['gyro_nonorthogonality'].values == pytest.approx([0.0] * 3, abs=1e-15)
    assert found['accelerometer_nonorthogonality'].values == pytest.approx([math.asin(sine)] * 3)
    assert found['gyro_to_accelerometer'].values == pytest.approx(turn, rel=1e-9)


def test_a_common_rotation_changes_nothing():
    wanted = expected(GYRO, ACCEL)
    assert values(GYRO, ACCEL) == pytest.approx(wanted, abs=1e-12)
    for turn in ([2e-4, -1e-4, 3e-4], [0.05, 0.02, -0.03], [0.9, -0.4, 1.3]):
        # Rows are input axes: the unit turned by R has those times the transpose of R.
        back = transposed(turned_about(turn))
        assert values(product(GYRO, back), product(ACCEL, back)) == pytest.approx(wanted, abs=1e-12)
    alone = product(GYRO, transposed(turned_about([2e-4, 0.0, 0.0])))
    assert abs(values(alone, ACCEL)[6] - wanted[6]) == pytest.approx(2e-4, rel=5e-3)


def test_scale_factors_are_no_angles():
    longer = [[f * v for v in row] for f, row in zip((1.01, 0.98, 1.003), GYRO, strict=True)]
    assert values(longer, ACCEL) == pytest.approx(values(GYRO, ACCEL), abs=1e-12)


def by_parameter(k: int, step: float) -> list[float]:
    """The angles with one parameter changed, of those that turn or scale an axis."""
    parameter = PARAMETERS[k]
    changed = {'g': [row[:] for row in GYRO], 'a': [row[:] for row in ACCEL]}
    if 'D' not in parameter.name:
        column = parameter.row if parameter.column is None else parameter.column
        changed[parameter.triad][parameter.row][column] += step
    return expected(changed['g'], changed['a'])


def test_deviations_follow_from_the_whole_covariance():
    root = np.random.default_rng(4).normal(size=(24, 24)) * 1e-5
    covariance = root @ root.T
    step = 1e-4
    slopes = np.array(
        [np.subtract(by_parameter(k, step), by_parameter(k, -step)) for k in range(24)]
    ).T / (2 * step)
    std = np.concatenate([group.std for group in angles(GYRO, ACCEL, covariance)])
    assert std == pytest.approx(np.sqrt(np.diag(slopes @ covariance @ slopes.T)), rel=1e-5)


def test_what_turns_the_whole_unit_is_in_no_deviation():
    # The table's frame is known to 30 arcsec about each axis, the axes among themselves to 1e-7.
    doubt, own = 30 * ARCSEC, 1e-7
    covariance = own**2 * np.eye(24)
    for axis in range(3):
        back = transposed(turned_about([1e-6 * (k == axis) for k in range(3)]))
        moved = [
            Triad((np.array(product(a, back)) - np.array(a)) / 1e-6).vector() for a in (GYRO, ACCEL)
        ]
        change = doubt * np.concatenate(moved)
        covariance += np.outer(change, change)
    misaligned = [k for k, p in enumerate(PARAMETERS) if p.name.startswith('E')]
    assert np.sqrt(np.diag(covariance)[misaligned]).min() > 0.9 * doubt
    std = np.concatenate([group.std for group in angles(GYRO, ACCEL, covariance)])
    # A non-orthogonality is the sum of two misalignments, an alignment half a sum of four.
    assert std == pytest.approx([own * math.sqrt(2)] * 6 + [own] * 3, rel=0.02)


def test_a_triad_that_was_not_estimated_has_no_angles():
    covariance = np.zeros((24, 24))
    covariance[12:], covariance[:, 12:] = np.nan, np.nan
    assert [group.group.key for group in angles(GYRO, ACCEL, covariance)] == [
        'gyro_nonorthogonality'
    ]
