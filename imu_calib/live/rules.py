"""Tolerances and times of a sequencer, the phases of its state, and levels of a status."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from ..common.units import DEG


class Severity(IntEnum):
    """Levels as in diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


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
    """Tolerances and times; all times are by the stamps of the joint states."""

    settle: float = 1.0  #: From the arrival at a step's end to the start of its dwell, s.
    arrival: float = 0.01 * DEG  #: Largest distance from its goal of a joint that has arrived, rad.
    #: Largest distance of a joint beyond its goal, or off its way, rad.
    overshoot: float = 0.5 * DEG
    feedback_timeout: float = 0.5  #: Longest gap between joint states, s.
    supervised: bool = True  #: Whether a calibrator requests repetitions of steps.
    repeats: int = 2  #: Most repetitions of a step at the calibrator's request.
    #: Longest wait for the calibrator's reply at the end of the plan, s.
    repeat_wait: float = 600.0


@dataclass(frozen=True)
class SequencerState:
    """State of the sequencer: the content of imu_calib_msgs/TurntableState."""

    plan: str  #: Name of the plan.
    step: int  #: Index of the current or last step.
    steps: int  #: Number of steps, 0 before the first start.
    position: str  #: Id of the plan's position, empty on the way back to the start.
    phase: Phase  #: Present phase.
    #: Why it is PAUSED or ABORTED, DONE without the calibrator's reply, or what happened to an idle
    #: table; else empty.
    reason: str
    fault: bool  #: Whether there was a fault, not a requested stop.
    waits_for: str  #: What an accepted start waits for, else empty.
    angles: tuple[float, ...]  #: (k,) measured, unwrapped, rad; empty before the first joint state.
    rates: tuple[float, ...]  #: (k,) measured, rad/s.
    turns_done: float  #: Turns at rate of the current RATE step, without sign.
    seconds_left: float  #: Expected time to the end of the plan, s.
