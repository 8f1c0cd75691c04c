"""A joint that turns opposite to its axis in the table's file, told from mirrored gyros."""

from dataclasses import replace

import numpy as np
import pytest
from extent import again
from other_sessions import MEDIUM, NAVIGATION, fed, recorded
from other_world import DEG, Unit, World

from imu_calib.calibration.calibrator import Calibrator
from imu_calib.common.errors import Contradiction
from imu_calib.common.stream import ImuBlock, JointBlock

JOINTS = ('outer', 'middle', 'inner')
CONSUMER = Unit(
    gyro_m=((0.013, 6e-3, -4e-3), (8e-3, -0.008, 2e-3), (-5e-3, 4e-3, 0.005)),
    gyro_d=(0.8 * DEG, -0.5 * DEG, 0.3 * DEG),
    gyro_walk=0.3 * DEG / 60,
    accel_walk=3e-3,
    gyro_pulse=DEG / 131,
    accel_pulse=9.80665 / 4096,
    counts=True,
)
"""Whose biases turn a move by more degrees than its scale factors do."""


def fed_with(joint_signs: tuple[int, ...], gyro_signs: tuple[int, ...], unit: object) -> Calibrator:
    calibrator = Calibrator(fed(World(), unit)._setup)
    joints, imu = recorded(World(), unit, 0)
    calibrator.add_block(
        JointBlock(joints.stamp, joints.names, joints.position * joint_signs, joints.velocity)
    )
    calibrator.add_block(ImuBlock(imu.stamp, imu.gyro * gyro_signs, imu.accel))
    return calibrator


@pytest.mark.parametrize(
    'unit', [MEDIUM, CONSUMER, again(NAVIGATION), again(replace(MEDIUM, counts=True))]
)
@pytest.mark.parametrize('reversed_ones', [(0,), (1,), (2,), (0, 2)])
def test_the_sentence_names_the_joint(reversed_ones, unit):
    signs = tuple(-1 if k in reversed_ones else 1 for k in range(3))
    names = ' and '.join(JOINTS[k] for k in reversed_ones)
    with pytest.raises(Contradiction, match=f'Joints? {names} turns? opposite to') as refused:
        fed_with(signs, (1, 1, 1), unit).finish()
    assert 'mirrored' not in str(refused.value)


@pytest.mark.parametrize('mirrored', [(-1, -1, -1), (1, -1, 1)])
def test_mirrored_gyros_are_not_taken_for_joints(mirrored):
    with pytest.raises(Contradiction, match='axes of the gyros are mirrored') as refused:
        fed_with((1, 1, 1), mirrored, MEDIUM).finish()
    assert 'opposite to' not in str(refused.value)


def test_what_agrees_is_not_asked():
    assert np.isfinite(fed_with((1, 1, 1), (1, 1, 1), MEDIUM).finish().calibration.std).all()
