"""Whole turns at headings at equal steps, against turns of a thousand small ones."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_calib.estimation.arms import headings, mean_over_turn

UPS = Rotation.random(5, random_state=2).as_matrix()[:, 2]


def test_headings_are_equal_steps_about_up() -> None:
    found = headings(UPS)
    assert found.shape == (5, 8, 3, 3)
    for up, attitudes in zip(UPS, found, strict=True):
        for k, attitude in enumerate(attitudes):
            np.testing.assert_allclose(attitude.T @ attitude, np.eye(3), atol=1e-14)
            assert np.linalg.det(attitude) == pytest.approx(1.0)
            np.testing.assert_array_equal(attitude[:, 2], up)
            # From the first on, the level axes turn by an eighth of a turn each time.
            wanted = Rotation.from_rotvec(up * k * np.pi / 4).as_matrix() @ attitudes[0]
            np.testing.assert_allclose(attitude, wanted, atol=1e-14)


def test_the_second_half_is_the_first_reversed_to_the_last_bit() -> None:
    found = headings(UPS)
    np.testing.assert_array_equal(found[:, 4:, :, :2], -found[:, :4, :, :2])
    assert not mean_over_turn(found[..., :2]).any()


@pytest.mark.parametrize('inputs', range(1, 8))
def test_means_of_products_of_up_to_seven_inputs_are_those_over_the_turn(inputs: int) -> None:
    force = np.array([0.3, -0.5, 9.8])
    at_steps = np.prod([(headings(UPS) @ force)[..., k % 3] for k in range(inputs)], axis=0)
    first = headings(UPS)[:, 0]
    angles = np.arange(1000) * 2 * np.pi / 1000
    for up, attitude, mean in zip(UPS, first, mean_over_turn(at_steps), strict=True):
        felt = Rotation.from_rotvec(up * angles[:, None]).apply(attitude @ force)
        wanted = np.prod([felt[:, k % 3] for k in range(inputs)], axis=0).mean()
        assert mean == pytest.approx(wanted, rel=1e-12, abs=1e-10)
