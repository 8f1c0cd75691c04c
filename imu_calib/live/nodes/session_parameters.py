"""Declare the set-up of a session as parameters of a node."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from ...common.errors import InputError
from ...common.stream import Floats
from ...common.units import DEG
from ...estimation.setup import Setup
from ...session.imu import load_imu
from ...session.keywords import node_parameters, stated_by_node
from ...session.metadata import describe, shared_description
from ...session.plan import UNPLANNED, load_plan
from ...session.table import load_table
from ...session.units_file import load_units, remaining
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

    Raises:
        InputError: As `declared_setup`; the units' file is broken, or leaves no unit.
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


def declared_setup(node: Node) -> tuple[Setup, dict[str, str]]:
    """Declare and read the set-up of a session.

    Returns:
        The set-up, and recording entries that describe it.

    Raises:
        InputError: A file is missing or broken, or the latitude is not stated.
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
    """Declare tolerances and times, and return them.

    Args:
        declare: `parameters.declare` of the node.

    Raises:
        InputError: A value has another type or lies outside its range.
    """
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
