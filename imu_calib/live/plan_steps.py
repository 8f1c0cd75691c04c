"""Steps of a plan as setpoints: end positions, durations, limits of the table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..common.errors import InputError
from ..common.stream import Floats, Mode, Setpoint
from ..common.units import DEG
from ..session.plan import Plan, Step
from ..session.table import TURN, Table, travel_time


def steps_of_plan(plan: Plan, table: Table, start: Floats) -> tuple[tuple[Step, ...], Step]:
    """Return the steps of a plan from the table's present position, and the way back there.

    Args:
        plan: The plan.
        table: The table.
        start: (k,) present angles of the table, rad.

    Raises:
        InputError: Beyond the table's limits: names joint, value and limit.
    """
    still = np.zeros(len(start))
    table.check(start, still, 'Where the table stands')
    steps = plan.steps(table, start)
    if not steps:
        raise InputError(f'Plan {plan.name} has no positions.')
    for step in steps:
        check(step, table)
    return steps, Step(steps[-1].index, '', Mode.POSITION, start, still, 0, 0.0)


def check(step: Step, table: Table) -> None:
    """Refuse steps beyond the table's limits of angle, rate and acceleration.

    Raises:
        InputError: Names joint, value and limit.
    """
    where = f'Step {step.index + 1}, position {step.position or "of the start"}'
    table.check(step.angles, step.rates, where)
    table.check(end_of(step), step.rates, where)
    for joint, rate in zip(table.joints, step.rates, strict=True):
        # One extra turn is available for run-up and run-down, which use v^2 / a of it.
        needed = float(rate) ** 2 / TURN
        if needed > joint.max_acceleration * (1 + 1e-9):
            raise InputError(
                f'{where}: to reach {rate / DEG:g} deg/s joint {joint.name} needs '
                f'{needed / DEG:.4g} deg/s^2, table {table.name} allows '
                f'{joint.max_acceleration / DEG:g} deg/s^2.'
            )


def end_of(step: Step) -> Floats:
    """Return the (k,) angles at rest after a step, rad."""
    travel = np.where(step.rates == 0, 0.0, np.copysign(TURN * (step.turns + 1), step.rates))
    return np.asarray(step.angles + travel)


def approach_step(step: Step) -> Step:
    """Return the step that moves to the start of a turn."""
    still = np.zeros(len(step.rates))
    return replace(step, mode=Mode.POSITION, rates=still, turns=0, dwell=0.0)


def motion_time(step: Step, before: Floats, table: Table) -> float:
    """Return the duration of a step's motion from (k,) angles at the table's limits, s."""
    ways = end_of(step) - before
    return max(
        travel_time(
            float(way), abs(float(rate)) if rate else joint.max_rate, joint.max_acceleration
        )
        for way, rate, joint in zip(ways, step.rates, table.joints, strict=True)
    )


def setpoint_of(step: Step, plan: str, joints: tuple[str, ...]) -> Setpoint:
    """Return the setpoint of a step, not yet stamped."""
    return Setpoint(
        stamp=0,
        plan=plan,
        step=step.index,
        position=step.position,
        mode=step.mode,
        joints=joints,
        angles=tuple(step.angles.tolist()),
        rates=tuple(step.rates.tolist()),
        turns=float(step.turns),
        dwell=float(step.dwell),
    )


def held(current: Step | None, angles: Sequence[float] | None, plan: str, table: Table) -> Setpoint:
    """Return the setpoint that stops a table where it is; the sender sets its stamp.

    Args:
        current: The interrupted step, if any.
        angles: Present angles, rad, for the record; None if unknown.
        plan: Name of the plan.
        table: The table.
    """
    joints = table.joints
    known = (0.0,) * len(joints) if angles is None else angles
    return Setpoint(
        stamp=0,
        plan=plan,
        step=0 if current is None else current.index,
        position='' if current is None else current.position,
        mode=Mode.HOLD,
        joints=table.names,
        angles=tuple(min(max(a, j.lower), j.upper) for a, j in zip(known, joints, strict=True)),
        rates=(0.0,) * len(joints),
        turns=0.0,
        dwell=0.0,
    )
