"""Rotations against those of scipy, and that one module holds them."""

import re

import numpy as np
import pytest
from loopback import CHECKOUT
from scipy.spatial.transform import Rotation

from imu_calib.common import rotations as ours

RANDOM = np.random.default_rng(24)
SIZES = [1e-12, 1e-9, 1e-6, 1e-3, 0.3, 3.0]
ROUNDING = 8 * np.finfo(float).eps


def vectors(size, count=50):
    directions = RANDOM.normal(size=(count, 3))
    return size * directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.mark.parametrize('size', SIZES)
def test_matrices_of_vectors_and_of_axes_are_those_of_scipy(size):
    turned = vectors(size)
    expected = Rotation.from_rotvec(turned).as_matrix()
    assert np.abs(ours.rotations(turned) - expected).max() < ROUNDING
    axes = turned / np.linalg.norm(turned, axis=1, keepdims=True)
    about = np.array([ours.rotation(axis, size) for axis in axes])
    assert np.abs(about - expected).max() < ROUNDING


def test_a_row_of_angles_gives_a_row_of_matrices():
    angles, axis = np.linspace(-7.0, 7.0, 9), vectors(1.0)[0]
    expected = Rotation.from_rotvec(axis * angles[:, None]).as_matrix()
    assert np.abs(ours.rotation(axis, angles) - expected).max() < ROUNDING
    rows = RANDOM.normal(size=(9, 3))
    seen = ours.in_rotated_frame(rows, axis, angles)
    assert np.abs(seen - np.einsum('ni,nij->nj', rows, expected)).max() < 4 * ROUNDING
    one = ours.in_rotated_frame(rows, axis, angles[:1])
    assert np.abs(one - rows @ expected[0]).max() < 4 * ROUNDING


@pytest.mark.parametrize('size', SIZES)
def test_vectors_and_angles_come_back(size):
    turned = vectors(size)
    matrices = Rotation.from_rotvec(turned).as_matrix()
    # What a matrix of 1 and size can hold of a rotation near half a turn falls with its sine.
    held = ROUNDING / abs(np.sinc(size / np.pi))
    assert np.abs(ours.rotation_vectors(matrices) - turned).max() < held
    for vector, matrix in zip(turned, matrices, strict=True):
        assert np.abs(ours.rotation_vector(matrix) - vector).max() < held
        assert ours.angle_about(vector / size, matrix) == pytest.approx(size, abs=held)
    if size > 1e-3:
        base = ours.rotations(vectors(1.0))
        between = ours.angle_between(base, base @ matrices)
        assert np.abs(between - size).max() < held / abs(np.sin(size))


def test_the_vector_of_half_a_turn_is_found_in_a_row():
    matrix = np.diag([1.0, -1.0, -1.0])
    assert np.abs(ours.rotation_vectors(matrix[None])[0]) == pytest.approx([np.pi, 0.0, 0.0])


def test_the_short_way_takes_one_direction_to_the_other():
    starts, ends = vectors(1.0), vectors(1.0)
    for start, end in zip(starts, ends, strict=True):
        turned = ours.shortest(start, end)
        worst = ROUNDING / (1 + start @ end)
        assert np.abs(turned @ start - end).max() < worst
        angle = np.arccos(np.clip(start @ end, -1, 1))
        axis = np.cross(start, end)
        expected = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis))
        assert ours.angle_between(turned, np.eye(3)) == pytest.approx(angle, abs=1e-7)
        assert np.abs(turned - expected.as_matrix()).max() < 1e-12


def test_generators_are_the_slopes_of_rotations_and_crossing_is_the_cross_product():
    step = 1e-6
    for axis, generator in zip(np.eye(3), ours.GENERATORS, strict=True):
        slope = (ours.rotation(axis, step) - ours.rotation(axis, -step)) / (2 * step)
        assert np.abs(slope - generator).max() < step
    first, second = vectors(2.0, 2)
    assert ours.cross_matrix(first) @ second == pytest.approx(np.cross(first, second))


def test_products_are_those_of_the_matrices():
    first, second = (ours.rotations_last(vectors(1.0)) for _ in range(2))
    expected = np.moveaxis(first, -1, 0) @ np.moveaxis(second, -1, 0)
    assert np.moveaxis(ours.product(first, second), -1, 0) == pytest.approx(expected)


def test_no_other_module_makes_rotations_by_itself():
    # An antisymmetric matrix written out, the angle of a trace, the class of scipy.
    by_hand = re.compile(r'\[0\.?0?, -\w+, \w+\]|trace\(.*\) - 1|scipy\.spatial')
    found = [
        file.name
        for file in (CHECKOUT / 'imu_calib').rglob('*.py')
        if by_hand.search(file.read_text())
    ]
    assert found == ['rotations.py']
