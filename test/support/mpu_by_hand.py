"""A cheap unit without a data sheet in the hand, whose holds may sway."""

from functools import cache

import numpy as np
from shaky import GRAVITY, LATITUDE, Shaky, shaky

from imu_calib.calibration.hand import HandCalibrator
from imu_calib.calibration.results import Result
from imu_calib.common.stream import Floats, ImuBlock, Units
from imu_calib.common.units import DEG
from imu_calib.estimation.hand import FREE, in_frame_of_accelerometers
from imu_calib.estimation.setup import Setup
from imu_calib.model.earth import Site
from imu_calib.model.sensors import SensorModel, Triad
from imu_calib.session.imu import ImuSpec, TriadSpec
from imu_calib.session.plan import load_plan

IMU = ImuSpec('mpu', Units.SI, None, TriadSpec(), TriadSpec())
UNIT = SensorModel(
    Triad(np.diag([4e-3, -6e-3, 5e-3]), np.array([0.02, -0.01, 0.03])),
    Triad(np.diag([-5e-3, 3e-3, 6e-3]), np.array([0.1, -0.2, 0.15])),
)


def off(found: Result) -> Floats:
    """Errors of the 21 parameters in standard deviations."""
    truth = in_frame_of_accelerometers(UNIT).vector()
    wrong = found.calibration.values[:24] - truth
    return np.asarray(wrong[FREE] / found.calibration.std[:24][FREE])


SITE = Site.at(LATITUDE, gravity=GRAVITY)
SWAYS, LEAN = 5, 0.1 * DEG
NOISE = 0.02
"""m/s^2, of a sample at 100 Hz: a random walk of 2e-3 (m/s)/sqrt(s)."""


def calibrator(held: Shaky, pieces: int = 1) -> HandCalibrator:
    found = HandCalibrator(Setup(IMU, load_plan('free_positions'), None, SITE))
    for rows in np.array_split(np.arange(len(held.block.stamp)), pieces):
        block = held.block
        found.add_block(ImuBlock(block.stamp[rows], block.gyro[rows], block.accel[rows], 'imu'))
    return found


@cache
def session(swaying: bool, seed: int = 0) -> Shaky:
    sway = (SWAYS, LEAN) if swaying else None
    return shaky(UNIT, rate=100, noise=(0.3 * DEG, NOISE), swaying=sway, seed=seed)


@cache
def result(swaying: bool, seed: int = 0) -> Result:
    return calibrator(session(swaying, seed)).finish()
