"""Accelerometers in the hand that are not linear: found, or named with what holds without them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from extent import ALL
from mpu_by_hand import IMU, UNIT, off
from scipy.spatial.transform import Rotation
from shaky import GRAVITY, LATITUDE, shaky

from imu_calib.calibration.hand import HandCalibrator
from imu_calib.calibration.results import Result
from imu_calib.calibration.verify import Verdict, verify
from imu_calib.common.stream import ImuBlock
from imu_calib.common.units import DEG
from imu_calib.estimation.setup import Setup
from imu_calib.estimation.system import observe
from imu_calib.model.earth import Site
from imu_calib.model.sensors import SensorModel
from imu_calib.model.terms import ACCEL_QUADRATIC
from imu_calib.segmentation.segmenter import Segmenter
from imu_calib.session.plan import UNPLANNED, load_plan

SITE = Site.at(LATITUDE, gravity=GRAVITY)
NONE = (0.0, 0.0, 0.0)
SQUARES = (2e-4, -1.5e-4, 1e-4)
"""Of the force, 1/(m/s^2): 2, 1.5 and 1 mg/g^2, as of chips."""


def faces(count: int, seed: int) -> Rotation:
    """Attitudes of a box that stands on its faces, to two degrees."""
    rng = np.random.default_rng(seed)
    group = Rotation.create_group('O')
    about = Rotation.from_euler('z', rng.uniform(-np.pi, np.pi, (count, 1)))
    leaning = Rotation.from_rotvec(rng.normal(0, 2 * DEG, (count, 3)))
    return about * group[rng.integers(24, size=count)] * leaning


@cache
def session(squares: tuple[float, ...], seed: int, on_faces: bool = False) -> Result:
    """Calibrate a unit whose accelerometers add so much of the square of the force to theirs."""
    return fed(squares, seed, on_faces).finish()


def fed(squares: tuple[float, ...], seed: int, on_faces: bool = False) -> HandCalibrator:
    found = HandCalibrator(Setup(IMU, load_plan('free_positions'), None, SITE))
    found.add_block(recorded(squares, seed, on_faces))
    return found


def recorded(squares: tuple[float, ...], seed: int, on_faces: bool) -> ImuBlock:
    attitudes = faces(31, seed) if on_faces else None
    held = shaky(
        SensorModel(), rate=100, noise=(0.1 * DEG, 0.01), holds=30, attitudes=attitudes, seed=seed
    )
    block = held.block
    force = block.accel
    accel = force @ UNIT.accel.response.T + UNIT.accel.bias + np.array(squares) * force**2
    gyro = block.gyro @ UNIT.gyro.response.T + UNIT.gyro.bias
    return replace(block, gyro=gyro, accel=accel)


def test_squares_of_the_force_are_found_and_estimated() -> None:
    for seed in range(3):
        found = session(SQUARES, seed)
        assert found.calibration.parameters[24:] == ACCEL_QUADRATIC.parameters
        assert np.abs(off(found)).max() < 4.5
        wrong = found.calibration.values[24:] - np.array(SQUARES)
        assert np.abs(wrong / found.calibration.std[24:]).max() < 4.5
        said = ' '.join(found.calibration.findings)
        assert 'The session shows accelerometer quadratic term (accel_quadratic, by up to' in said
        # Nothing scatters beyond the noise.
        assert 'times their noise' not in said
        assert found.terms[0] == 'terms: accel_quadratic'


def test_linear_accelerometers_have_no_term() -> None:
    for seed in range(12 if ALL else 4):
        found = session(NONE, seed)
        assert len(found.calibration.parameters) == 24
        assert np.abs(off(found)).max() < 4.5


def test_on_the_faces_of_a_box_the_alternative_is_named() -> None:
    """At 0 and 1 g a square of the force is a bias, and a response of two slopes the same."""
    found = session(tuple(s / 4 for s in SQUARES), 1, on_faces=True)
    assert found.calibration.parameters[24:] == ACCEL_QUADRATIC.parameters
    assert np.abs(off(found)).max() < 4.5
    assert 'accel_asymmetry would explain it as well' in ' '.join(found.calibration.findings)
    (held,) = [text for text in found.terms if 'does not show accel_asymmetry' in text]
    assert 'which could bias K2_ax, K2_ay, K2_az' in held


def test_another_session_verifies_the_terms_and_another_unit_fails() -> None:
    found = session(SQUARES, 0).calibration
    for squares, verdict in ((SQUARES, Verdict.PASS), (NONE, Verdict.FAIL)):
        segmenter = Segmenter(IMU, None)
        segmenter.add_block(recorded(squares, 5, False))
        observed = observe(segmenter.finish(), IMU, SITE, UNPLANNED, None)
        (judged,) = [t for t in verify(found, observed).triads if not t.gyros]
        assert judged.verdict is verdict
