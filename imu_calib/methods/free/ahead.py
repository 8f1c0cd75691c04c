"""What holds in the attitudes of a plan would tell, before anybody holds anything."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from ...earth import Site
from ...imu import ImuSpec
from ...model import PARAMETERS, SensorModel
from ...observation.information import Information
from ...plan import Position
from ...stream import Floats
from .guidance import TURN_SECONDS, planned_hold, planned_swing
from .system import FREE, System


def deviations(
    positions: Sequence[Position], imu: ImuSpec, site: Site, model: SensorModel
) -> Floats:
    """Return the standard deviations that a session of holds would reach.

    Turned is the short way from hold to hold, once.

    Args:
        positions: Directions of up, and how long each is held.
        imu: Random walks; both above zero.
        site: Gravity.
        model: What the sensors are thought to be, in the frame of the accelerometers.

    Returns:
        (24,) SI units; zero for what the frame sets to zero, NaN for what is not observed.

    """
    ups = np.array([p.up for p in positions])
    walks = np.array([imu.gyro.random_walk, imu.accel.random_walk])
    holds = [planned_hold(p.up, model, walks**2 / p.dwell, site) for p in positions]
    swings = [
        planned_swing(k, first, second, model, float(walks[0] ** 2 * TURN_SECONDS))
        for k, (first, second) in enumerate(pairwise(ups))
    ]
    system = System(tuple(holds), tuple(swings), site, np.ones(3))
    information = Information.of(system.rows(model, ups)[0][:, system.free])
    std = np.zeros(len(PARAMETERS))
    std[FREE] = np.sqrt(np.diag(information.covariance)[: int(FREE.sum())])
    return std
