"""Tolerances and times of a sequencer, and the phases that it reports."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from ..units import DEG


class Phase(IntEnum):
    """What the table is doing; values as in imu_calib_msgs/TurntableState."""

    IDLE = 0
    MOVING = 1
    SETTLING = 2
    TURNING = 3
    DWELLING = 4
    PAUSED = 5
    DONE = 6
    ABORTED = 7


@dataclass(frozen=True)
class Rules:
    """Tolerances and times; all times count the stamps of the joint states.

    Attributes:
        settle: From the arrival at a step's end to the start of its dwell, s.
        arrival: A joint has arrived that stands within this of its goal, rad.
        overshoot: How far a joint may pass its goal, or stray from its way, rad.
        feedback_timeout: Longest gap between joint states, s.
        supervised: Whether a calibrator says which steps are to be repeated.
        repeats: How often a step is repeated at most because the calibrator asks for it.
        repeat_wait: How long the end of the plan waits for the calibrator's word, s.

    """

    settle: float = 1.0
    arrival: float = 0.01 * DEG
    overshoot: float = 0.5 * DEG
    feedback_timeout: float = 0.5
    supervised: bool = True
    repeats: int = 2
    repeat_wait: float = 600.0


@dataclass(frozen=True)
class SequencerState:
    """What the sequencer is doing: the content of imu_calib_msgs/TurntableState.

    Attributes:
        plan: Name of the plan.
        step: Index of the step that is run, or was run last.
        steps: Number of steps, 0 before the first start.
        position: Id of the plan's position, empty on the way back to the start.
        phase: What it does.
        reason: Why it is PAUSED or ABORTED, DONE without the calibrator's word, or what happened
            to a table that is not led; else empty.
        fault: Whether something went wrong, and the stop was not asked for.
        waits_for: What a start that was accepted waits for, else empty.
        angles: (k,) measured, unwrapped, rad; empty before the first joint state.
        rates: (k,) measured, rad/s.
        turns_done: Turns at rate of the current RATE step, without sign.
        seconds_left: Expected time to the end of the plan, s.

    """

    plan: str
    step: int
    steps: int
    position: str
    phase: Phase
    reason: str
    fault: bool
    waits_for: str
    angles: tuple[float, ...]
    rates: tuple[float, ...]
    turns_done: float
    seconds_left: float
