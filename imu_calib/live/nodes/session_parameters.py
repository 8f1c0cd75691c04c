"""The parameters that state a session, its tolerances, or its simulation."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from ...common.errors import InputError
from ...common.stream import Floats
from ...common.units import DEG
from ...estimation.setup import Setup
from ...model.earth import LUOYANG, Site
from ...session.imu import ImuSpec, load_imu
from ...session.keywords import node_parameters, stated_by_node
from ...session.metadata import describe, shared_description
from ...session.plan import UNPLANNED, load_plan
from ...session.table import load_table
from ...session.units_file import load_units, remaining
from ...simulation.options import StandOptions, begin_of
from ..devices.simulated import IN_MEMORY
from ..middleware import Node
from ..rules import Rules
from .parameters import declare


@dataclass(frozen=True, eq=False)
class StatedUnit:
    """A unit whose samples a node receives."""

    setup: Setup  #: What is calibrated, and how.
    name: str  #: Of its namespace; empty for a single unit.
    imu: str  #: Name or file of its type.
    topic: str = ''  #: Topic of its samples; empty: imu/pulses in its namespace.
    #: (3, 3) rotation of its axes against those of the plan; None if they are equal.
    mount: Floats | None = None

    @property
    def solved(self) -> Setup:
        """The set-up used to solve its session.

        A unit whose axes differ from the plan's is solved without the plan, from the attitudes of
        the joint states.
        """
        return self.setup if self.mount is None else replace(self.setup, plan=UNPLANNED)


def declare_units_file(node: Node) -> tuple[str, str]:
    """Declare the file of several units and those to be left out, and return both."""
    words = 'File of several units on the table, in place of imu; empty: one unit.'
    file = declare(node, 'units', '', words)
    words = 'Serial numbers of units of that file that are left out, commas between.'
    return file, declare(node, 'without', '', words)


def declared_units(node: Node) -> tuple[tuple[StatedUnit, ...], dict[str, str]]:
    """Declare and read the set-up of a session with one unit or several.

    Returns:
        The units without the excluded ones, and recording entries that describe what they share; of
        a single unit, the unit too.
    """
    setup, description = declared_setup(node)
    file, without = declare_units_file(node)
    if not file:
        return (StatedUnit(setup, '', str(node.get_parameter('imu').value)),), description
    if setup.table is None:
        raise InputError(f'Parameter units: plan {setup.plan.name} is for one unit in the hand.')
    units = tuple(
        StatedUnit(
            setup.of_unit(unit, load_imu(unit.imu)),
            unit.name,
            unit.imu,
            unit.named_topic,
            unit.mount if unit.turned else None,
        )
        for unit in remaining(load_units(file), without)
    )
    return units, shared_description(description)


def absent_units(node: Node) -> tuple[str, ...]:
    """Return the names of the units of the declared file that are left out."""
    file, without = (str(node.get_parameter(name).value) for name in ('units', 'without'))
    units = load_units(file)
    kept = {unit.name for unit in remaining(units, without)}
    return tuple(unit.name for unit in units if unit.name not in kept)


def declared_setup(node: Node) -> tuple[Setup, dict[str, str]]:
    """Declare and read the set-up of a session.

    Returns:
        The set-up, and recording entries that describe it.
    """
    given = {
        name: declare(node, name, one.default, one.description)
        for name, one in node_parameters().items()
    }
    stated = stated_by_node(given)
    site, plan, table = stated.site(math.nan), load_plan(stated.plan), None
    if not plan.by_hand:
        table = load_table(stated.table)
        if stated.azimuth is not None:
            table = replace(table, azimuth=stated.azimuth * DEG)
    serial = stated.serial or ''
    setup = Setup(
        load_imu(stated.imu),
        plan,
        table,
        site,
        stated.method,
        serial,
        stated.sensor_terms,
        stated.changes,
        stated.search_terms,
    )
    described = None if table is None else stated.table
    return setup, describe(stated.plan, stated.imu, described, site, serial)


def declare_rules(declare: Callable[..., Any]) -> Rules:
    """Declare tolerances and times, and return them."""
    default = Rules()
    return Rules(
        settle=declare(
            'settle',
            default.settle,
            'From the stop of the joints to the start of the dwell, s of the joint states.',
            lower=0.0,
        ),
        arrival=DEG
        * declare(
            'arrival_tolerance',
            default.arrival / DEG,
            'A joint this close to its goal has arrived, deg.',
            lower=1e-6,
            upper=1.0,
        ),
        overshoot=DEG
        * declare(
            'overshoot_tolerance',
            default.overshoot / DEG,
            'Largest overshoot of a goal, and deviation from the path, of a joint, deg.',
            lower=1e-5,
            upper=10.0,
        ),
        feedback_timeout=declare(
            'feedback_timeout',
            default.feedback_timeout,
            'Longest gap between two joint states, s of their stamps.',
            lower=0.001,
        ),
        supervised=declare(
            'supervised',
            default.supervised,
            'Whether a calibrator is required; it asks for steps to be repeated.',
        ),
        repeats=declare(
            'repeats',
            default.repeats,
            'Largest number of times that a step is repeated when the calibrator asks for it.',
            lower=0,
        ),
        repeat_wait=declare(
            'repeat_wait',
            default.repeat_wait,
            'Longest wait for the calibrator at the end of the plan, s of the joint states.',
            lower=0.0,
        ),
    )


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
    """Declare a simulation with default IMU and true parameters, and return it."""
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
    words = 'Seed of all random numbers: the same seed gives the same errors.'
    seed = declare(node, 'seed', 0, words, lower=0)
    options = StandOptions(
        bias_instability=drifting,
        sample_rate=rate or None,
        start_time=round(start * 1e9) + begin_of(seed),
    )
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
