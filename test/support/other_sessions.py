"""Sessions of `other_world`, fed to the package: three units, and what is true of them."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
from other_world import (
    DEG,
    Matrix,
    Recording,
    Stop,
    Unit,
    Vector,
    World,
    record,
)
from sessions import gathered

from imu_calib.calibration.calibration import Calibration
from imu_calib.calibration.calibrator import Calibrator
from imu_calib.common.stream import Floats, ImuBlock, JointBlock, Units
from imu_calib.estimation.evidence import Evidence
from imu_calib.estimation.setup import Setup
from imu_calib.model.earth import Site
from imu_calib.session.imu import ImuSpec, TriadSpec
from imu_calib.session.plan import Plan, load_plan
from imu_calib.session.table import Table, load_table

PPM, ARCMIN, DEG_H, MICRO_G = 1e-6, DEG / 60, DEG / 3600, 9.80665e-6
EPOCH = 1_700_000_000


def matrix(scale: Vector, off: tuple[float, ...]) -> Matrix:
    a, b, c, d, e, f = off
    return (scale[0], a, b), (c, scale[1], d), (e, f, scale[2])


ERRORS = {
    'gyro_m': matrix((800 * PPM, -500 * PPM, 300 * PPM), (1e-3, -5e-4, 7e-4, 2e-4, -9e-4, 4e-4)),
    'accel_m': matrix((-900 * PPM, 400 * PPM, 250 * PPM), (-6e-4, 8e-4, 1e-4, -3e-4, 5e-4, -7e-4)),
    'gyro_d': (1.2 * DEG_H, -0.7 * DEG_H, 0.4 * DEG_H),
    'accel_d': (300 * MICRO_G, -450 * MICRO_G, 150 * MICRO_G),
}
MEDIUM = Unit(**ERRORS)
NAVIGATION = Unit(
    **ERRORS,
    gyro_walk=0.002 * DEG / 60,
    accel_walk=5 * MICRO_G,
    gyro_pulse=0.1 / 3600 * DEG,
    accel_pulse=1e-5,
)
CONSUMER = Unit(
    **ERRORS,
    gyro_walk=0.3 * DEG / 60,
    accel_walk=80 * MICRO_G,
    gyro_pulse=0.004 * DEG,
    accel_pulse=100 * MICRO_G,
    counts=True,
)


def true_vector(unit: Unit) -> Floats:
    """The 24 in the package's order: K, E row by row, D; gyros, then accelerometers."""
    parts = []
    for m, d in ((unit.gyro_m, unit.gyro_d), (unit.accel_m, unit.accel_d)):
        parts += [m[0][0], m[1][1], m[2][2]]
        parts += [m[i][j] for i in range(3) for j in range(3) if i != j]
        parts += d
    return np.array(parts)


def segmented(world: World, unit: Unit, seed: int = 0) -> Evidence:
    """What the segmentation makes of a session."""
    return gathered(fed(world, unit, seed))


# A session is made once for what solves it in several ways, of one unit or of both by turns.
@lru_cache(maxsize=4)
def recorded(world: World, unit: Unit, seed: int) -> tuple[JointBlock, ImuBlock]:
    return blocks_of(record(world, unit, seed))


def blocks_of(recording: Recording) -> tuple[JointBlock, ImuBlock]:
    stamps = EPOCH * 10**9 + np.rint(np.array(recording.imu_stamps) * 1e9).astype(np.int64)
    joints = EPOCH * 10**9 + np.rint(np.array(recording.joint_stamps) * 1e9).astype(np.int64)
    angles = np.array(recording.angles)
    nothing = np.full_like(angles, np.nan)
    return (
        JointBlock(joints, ('outer', 'middle', 'inner'), angles, nothing),
        ImuBlock(stamps, np.array(recording.gyro), np.array(recording.accel)),
    )


def fed(
    world: World,
    unit: Unit,
    seed: int = 0,
    plan: Plan | None = None,
    *,
    find_terms: bool = False,
    table: Table | None = None,
    blocks: tuple[JointBlock, ImuBlock] | None = None,
    si: bool = False,
) -> Calibrator:
    gyro, accel = (
        TriadSpec(unit.gyro_pulse, unit.gyro_walk),
        TriadSpec(unit.accel_pulse, unit.accel_walk),
    )
    units = Units.COUNTS if unit.counts else Units.PULSES
    if si:
        units = Units.SI
        gyro, accel = (replace(t, scale_factor=1.0, pulse=t.scale_factor) for t in (gyro, accel))
    spec = ImuSpec('other', units, unit.rate, gyro, accel)
    site = Site.at(world.latitude, 0.0, world.gravity)
    plan = load_plan('twelve_position') if plan is None else plan
    table = load_table('three_axis') if table is None else table
    setup = Setup(spec, plan, table, site, search_terms=find_terms)
    calibrator = Calibrator(setup)
    for block in recorded(world, unit, seed) if blocks is None else blocks:
        calibrator.add_block(block)
    return calibrator


def in_si(unit: Unit, block: ImuBlock) -> ImuBlock:
    """Return pulses as a driver gives them that divides by the stated interval."""
    gyro, accel = unit.gyro_pulse * unit.rate, unit.accel_pulse * unit.rate
    return ImuBlock(block.stamp, gyro * block.gyro, accel * block.accel)


def errors(calibration: Calibration, unit: Unit) -> Floats:
    return np.asarray((calibration.values[:24] - true_vector(unit)) / calibration.std[:24])


def stop(outer: float, middle: float, inner: float, *rates: float, turning: int = 0) -> Stop:
    angles = (outer * DEG, middle * DEG, inner * DEG)
    return Stop(angles, tuple(rate * DEG for rate in rates), turning)
