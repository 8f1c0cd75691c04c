"""Sessions of `units_world`, solved by the package: each unit by itself."""

from dataclasses import replace

import numpy as np
import units_world as world

from imu_calib.calibration.calibrator import Calibrator
from imu_calib.common.stream import ImuBlock, JointBlock, Units
from imu_calib.estimation.setup import Setup
from imu_calib.model.earth import Site
from imu_calib.session.imu import ImuSpec, TriadSpec
from imu_calib.session.plan import UNPLANNED
from imu_calib.session.table import load_table

EPOCH = 1_700_000_000_000_000_000
WALK, PULSE = (np.deg2rad(0.002) / 60, 5 * 9.80665e-6), (0.1 * world.ARCSEC, 1e-5)
TABLE = replace(load_table('three_axis'), positioning=3 * world.ARCSEC, level=5 * world.ARCSEC)
TURNED = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])


def solved(table, unit, counts):
    """Calibrate a unit by itself."""
    triads = [TriadSpec(pulse, walk) for pulse, walk in zip(unit.pulse, unit.walk, strict=True)]
    spec = ImuSpec('simulated', Units.PULSES, 1 / world.STEP, *triads)
    mounted = replace(TABLE, mount=TABLE.mount @ unit.mount)
    site = Site.at(world.LATITUDE, None, world.GRAVITY, gravity_std=0.0, latitude_std=0.0)
    calibrator = Calibrator(Setup(spec, UNPLANNED, mounted, site))
    stamp = EPOCH + np.round(table.time * 1e9).astype(np.int64)
    rates = np.zeros_like(table.read)
    calibrator.add_block(JointBlock(stamp, TABLE.names, table.read, rates))
    calibrator.add_block(ImuBlock(stamp[1:][: len(counts)], counts[:, :3], counts[:, 3:], 'imu'))
    return calibrator.finish()


def truth(unit):
    """K, E row by row, D: gyros, then accelerometers."""
    return np.concatenate(
        [
            np.concatenate([np.diag(m), m[~np.eye(3, dtype=bool)], d])
            for m, d in zip(unit.m, unit.d, strict=True)
        ]
    )


def tilt(table):
    """The base's tilt in the frame that its azimuth turns."""
    return world.about(2, -table.azimuth)[:2, :2] @ table.tilt
