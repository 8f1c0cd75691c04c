"""Declare the parameters that the simulated stand and the simulated hand have in common."""

from __future__ import annotations

import math
from typing import NamedTuple

from ...common.units import DEG
from ...model.earth import LUOYANG, Site
from ...session.imu import ImuSpec, load_imu
from ...simulation.options import StandOptions
from ..middleware import Node
from .frame_server import IN_MEMORY
from .parameters import declare


class Simulation(NamedTuple):
    """What a node simulates, and how its frames are read."""

    imu: ImuSpec
    truth: str  #: Name or file.
    site: Site
    options: StandOptions  #: Without imperfections.
    imperfections: str  #: Name or file; empty: none.
    seed: int
    start: float  #: Of the simulated time, s.
    speed: float  #: Highest, in multiples of real time; 0: no limit.
    port: int


def declare_simulation(node: Node, imu: str, truth: str) -> Simulation:
    """Declare a simulation and return it.

    Args:
        node: Declares the parameters.
        imu: Default of the IMU.
        truth: Default of the unit's true parameters.

    Raises:
        InputError: A value has another type or lies outside its range, or the IMU's file is broken.
    """
    spec = load_imu(declare(node, 'imu', imu, 'Name or file of the simulated IMU.'))
    words = "Name or file of the unit's true parameters; of several, of those that state none."
    truth = declare(node, 'truth', truth, words)
    latitude = declare(node, 'latitude', LUOYANG, 'Latitude, deg, negative in the south.')
    height = declare(node, 'height', 0.0, 'Height above the ellipsoid, m.')
    gravity = declare(node, 'gravity', math.nan, 'Gravity, m/s^2; nan: normal gravity.')
    drifting = declare(node, 'bias_instability', False, 'Whether the biases drift.')
    words = "Sample rate of the IMU, Hz; 0: as the IMU's file says."
    rate = declare(node, 'sample_rate', 0.0, words, lower=0.0)
    words = 'When the simulated time begins, s; the noise differs from start to start.'
    start = declare(node, 'start', 0.0, words, lower=0.0)
    options = StandOptions(
        bias_instability=drifting,
        sample_rate=rate or None,
        start_time=round(start * 1e9) + StandOptions.start_time,
    )
    words = 'Seed of all random numbers: the same seed gives the same errors.'
    seed = declare(node, 'seed', 0, words, lower=0)
    wrong = declare(node, 'imperfections', '', 'Name or file of the imperfections; empty: none.')
    words = 'Highest speed in multiples of real time; 0: as fast as the readers follow.'
    speed = declare(node, 'speed', 0.0, words, lower=0.0)
    words = (
        "TCP port that serves the IMU's frames; of several units the first one's, the next ones "
        'follow; 0: within the process, which has all nodes.'
    )
    port = declare(node, 'port', 5760, words, lower=IN_MEMORY, upper=65535)
    site = Site.at(latitude * DEG, height, None if math.isnan(gravity) else gravity)
    return Simulation(spec, truth, site, options, wrong, seed, start, speed, port)
