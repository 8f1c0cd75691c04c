"""Tolerances and times of a sequencer, and the phases of its state."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from ..common.units import DEG


class Phase(IntEnum):
    """Phase of the table; values as in imu_calib_msgs/TurntableState."""

    IDLE = 0
    MOVING = 1
    SETTLING = 2
    TURNING = 3
    DWELLING = 4
    PAUSED = 5
    DONE = 6
    ABORTED = 7

    @property
    def at_a_step(self) -> bool:
        """Whether the table is at a step of the plan."""
        return self in {Phase.MOVING, Phase.SETTLING, Phase.TURNING, Phase.DWELLING}


@dataclass(frozen=True)
class Rules:
    """Tolerances and times; all times are by the stamps of the joint states.

    Attributes:
        settle: From the arrival at a step's end to the start of its dwell, s.
        arrival: Largest distance from its goal of a joint that has arrived, rad.
        overshoot: Largest distance of a joint beyond its goal, or off its way, rad.
        feedback_timeout: Longest gap between joint states, s.
        supervised: Whether a calibrator requests repetitions of steps.
        repeats: Most repetitions of a step at the calibrator's request.
        repeat_wait: Longest wait for the calibrator's reply at the end of the plan, s.
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
    """State of the sequencer: the content of imu_calib_msgs/TurntableState.

    Attributes:
        plan: Name of the plan.
        step: Index of the current or last step.
        steps: Number of steps, 0 before the first start.
        position: Id of the plan's position, empty on the way back to the start.
        phase: Present phase.
        reason: Why it is PAUSED or ABORTED, DONE without the calibrator's reply, or what happened
            to an idle table; else empty.
        fault: Whether there was a fault, not a requested stop.
        waits_for: What an accepted start waits for, else empty.
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
