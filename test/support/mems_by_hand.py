"""A MEMS unit in the hand: thirty holds, and holds as the segmentation gives them."""

from functools import cache

import numpy as np
from hand_sessions import spread_holds
from sessions import SITE

from imu_calib.calibration.hand import HandCalibrator
from imu_calib.calibration.results import Result
from imu_calib.common.stream import Floats
from imu_calib.common.units import DEG
from imu_calib.estimation.evidence import Evidence
from imu_calib.estimation.setup import Setup
from imu_calib.model.earth import Site
from imu_calib.model.sensors import SensorModel, Triad
from imu_calib.segmentation.clock import NO_CLOCK
from imu_calib.segmentation.segmented import Move
from imu_calib.segmentation.segments import Segment, Statistics
from imu_calib.session.imu import load_imu
from imu_calib.session.plan import load_plan
from imu_calib.simulation.hand import HandSession
from imu_calib.simulation.options import ImuOptions

SPEC = load_imu('mems_counts')


def unit(seed: int) -> SensorModel:
    """A MEMS unit: half a percent and half a centiradian, 0.3 deg/s, 20 mg."""
    rng = np.random.default_rng([seed, 17])
    gyro = Triad(rng.normal(0, 5e-3, (3, 3)), rng.normal(0, 0.3 * DEG, 3))
    return SensorModel(gyro, Triad(rng.normal(0, 5e-3, (3, 3)), rng.normal(0, 0.2, 3)))


def calibrator(session: HandSession, model: SensorModel, seed: int, **options: object):
    free = HandCalibrator(Setup(SPEC, load_plan('free_positions'), None, SITE))
    for block in session.blocks(SPEC, model, SITE, ImuOptions(**options), seed):
        free.add_block(block)
    return free


@cache
def thirty(seed: int) -> tuple[HandCalibrator, Result]:
    free = calibrator(spread_holds(30, seed), unit(seed), seed)
    return free, free.finish()


def result(seed: int = 0) -> Result:
    return thirty(seed)[1]


class Still(Site):
    """A place on an Earth that does not turn."""

    north_rate = 0.0
    up_rate = 0.0


NOWHERE = Still(SITE.latitude, SITE.gravity, SITE.gravity_source)


def held(
    model: SensorModel, ups: Floats, rng: np.random.Generator, site: Site = NOWHERE
) -> Evidence:
    """Holds at (k, 3) ups and the shortest turns between them, each in 20 samples, a second."""
    at_rest, turning, period, walk = 2e-5, 1e-4, 0.05, np.repeat([1e-4, 1e-3], 3)
    gain, none = (np.repeat([at_rest, 1e-3], 3) / walk) ** 2, np.zeros(6)
    holds, moves = [], []
    for k, up in enumerate(ups):
        rate, force = model.predict(np.zeros(3), up * SITE.gravity)
        gyro, accel = rate + at_rest * rng.standard_normal(3), force + 1e-3 * rng.standard_normal(3)
        mean, start = np.concatenate([gyro, accel]), 2_000_000_000 * k
        seen = Statistics(100, 0, 1.0, mean, gain, none, mean, (), none)
        holds.append(Segment(start, start + 1_000_000_000, seen, np.eye(3), str(k + 1)))
        if k + 1 == len(ups):
            continue
        # The body turns so that up moves from here to the next one.
        axis = np.cross(ups[k + 1], up)
        angle = np.arctan2(np.linalg.norm(axis), up @ ups[k + 1])
        if np.linalg.norm(axis) < 1e-9:
            axis = np.cross(up, [0.3, 0.5, 0.7])
        true = np.tile(axis / np.linalg.norm(axis) * angle / 20, (20, 1)) / period
        increments = (true @ model.gyro.response.T + model.gyro.bias) * period
        increments += turning / np.sqrt(20) * rng.standard_normal((20, 3))
        begin = holds[-1].end
        seconds = np.full(20, period)
        moves.append(Move(begin, begin + 1_000_000_000, increments, seconds, np.zeros(3)))
    plan = load_plan('free_positions')
    return Evidence(
        tuple(holds), (), plan, site, NO_CLOCK, None, walk, moves=tuple(moves), free=True
    )
