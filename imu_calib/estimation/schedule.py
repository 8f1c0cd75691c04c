"""Compute when a table would run the steps of a plan: moves, run-ups, settling and dwells."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from ..common.stream import Floats, Mode
from ..session.plan import Step
from ..session.table import TURN, Table, travel_time

SETTLE = 1.0
"""s from arrival to the start of a dwell, as stand and sequencer wait."""


@dataclass(frozen=True, eq=False)
class Visit:
    """Times of a step.

    Attributes:
        step: The step.
        begin: Start of the motion, s since the first step.
        rest: Arrival at rest, s.
        end: Start of the next step, s.
        angles: (k,) joint angles at rest, rad.
    """

    step: Step
    begin: float
    rest: float
    end: float
    angles: Floats


def schedule(steps: Sequence[Step], table: Table, *, settle: float = SETTLE) -> tuple[Visit, ...]:
    """Compute the times of steps.

    Args:
        steps: As `Plan.steps` returns them for this table; the table stands at the first.
        table: Its limits apply.
        settle: Wait after each arrival, s.

    Raises:
        InputError: A joint has no limit of rate or acceleration: its motions have no known
            duration.
    """
    table.check_limited('the time that a plan takes needs')
    visits: list[Visit] = []
    now, angles = 0.0, steps[0].angles
    for step in steps:
        moving = [
            travel_time(float(goal - origin), joint.max_rate, joint.max_acceleration)
            for goal, origin, joint in zip(step.angles, angles, table.joints, strict=True)
        ]
        rest, angles = now + max(moving), step.angles.copy()
        if step.mode is Mode.RATE:
            k = next(k for k, rate in enumerate(step.rates) if rate)
            rate, travel = float(step.rates[k]), TURN * (step.turns + 1)
            rest += travel_time(travel, abs(rate), table.joints[k].max_acceleration)
            angles[k] += math.copysign(travel, rate)
        end = rest + settle + step.dwell
        visits.append(Visit(step, now, rest, end, angles))
        now = end
    return tuple(visits)


def duration(steps: Sequence[Step], table: Table, *, settle: float = SETTLE) -> float:
    """Return the duration of a plan, s: moves, run-ups, settling, turns and dwells."""
    return schedule(steps, table, settle=settle)[-1].end
