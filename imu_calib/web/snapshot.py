"""What is known of a running stand at one moment, as pages and terminals show it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from ..devices.health import Severity
from ..model import Parameter
from ..reports.convergence import Converging
from ..sequencing import Phase
from ..specification import Specification
from .samples import Streams


class Outcome(Enum):
    """How a session has ended, if it has."""

    OPEN = 'open'
    DONE = 'done'
    INCOMPLETE = 'incomplete'
    FAILED = 'failed'


@dataclass(frozen=True)
class Sentence:
    """What a node says of one part of itself.

    Attributes:
        source: For instance 'imu_node: stream'.
        level: How bad it is.
        text: A sentence.
        figures: Values with their units, by name.

    """

    source: str
    level: Severity
    text: str
    figures: tuple[tuple[str, str], ...] = ()

    def figure(self, name: str) -> str:
        """Return a value with its unit; empty where it is not said."""
        return dict(self.figures).get(name, '')


@dataclass(frozen=True)
class PlannedStep:
    """A step of the plan: where it goes, and what is done there in words."""

    position: str
    words: str


@dataclass(frozen=True)
class Expected:
    """What is known of a session before it begins.

    Attributes:
        plan: Name of the plan.
        imu: Name of the unit's type.
        table: Name of the table; empty where a hand holds the unit.
        steps: Of the plan; empty where a hand holds the unit.
        parameters: What the session's method estimates.
        predicted: (n,) standard deviations that the plan will reach, SI; NaN where unknown.
        specification: The limits of the unit; None without.
        joints: Names of the table's joints.

    """

    plan: str
    imu: str
    table: str
    steps: tuple[PlannedStep, ...]
    parameters: tuple[Parameter, ...]
    predicted: tuple[float, ...]
    specification: Specification | None = None
    joints: tuple[str, ...] = ()


@dataclass(frozen=True)
class TableState:
    """What the table's leader says; angles in rad, rates in rad/s."""

    plan: str = ''
    step: int = 0
    steps: int = 0
    position: str = ''
    phase: Phase = Phase.IDLE
    reason: str = ''
    joints: tuple[str, ...] = ()
    angles: tuple[float, ...] = ()
    rates: tuple[float, ...] = ()
    turns_done: float = 0.0
    seconds_left: float = math.nan


@dataclass(frozen=True)
class Snapshot:
    """All that a page shows, at one moment.

    Attributes:
        expected: What was known before.
        table: What the table's leader said last; None before it was heard.
        table_silent: For how long it has said nothing, s; 0 while it speaks.
        calibrator_silent: Likewise of the calibrator.
        progress: One sentence of the calibrator; empty before it was heard.
        seen: Steps of the plan that have been begun.
        repeats: Steps that are to be run again.
        next: Attitudes that a hand should hold next.
        outcome: How the session has ended.
        outcome_text: What is said of its end.
        rows: The parameters.
        sentences: What the nodes say of themselves, the worst first.
        streams: What the IMU's samples show; None before the first.
        celsius: The unit's temperature, degrees Celsius; NaN where it is not measured.
        speed: Seconds of the stand in a second on the wall.
        elapsed: Since the session began, s of the stand's time.
        answer: What was answered to the last command of a person; empty before the first.
        report: Name of the report's file, once it is written.
        report_text: What is said of the report.

    """

    expected: Expected
    table: TableState | None = None
    table_silent: float = 0.0
    calibrator_silent: float = 0.0
    progress: str = ''
    seen: int = 0
    repeats: tuple[int, ...] = ()
    next: tuple[str, ...] = ()
    outcome: Outcome = Outcome.OPEN
    outcome_text: str = ''
    rows: tuple[Converging, ...] = ()
    sentences: tuple[Sentence, ...] = ()
    streams: Streams | None = None
    celsius: float = math.nan
    speed: float = 1.0
    elapsed: float = 0.0
    answer: str = ''
    report: str = ''
    report_text: str = ''

    @property
    def wrong(self) -> tuple[Sentence, ...]:
        """What a person should look at, the worst first; how the session ended is said first."""
        over = self.outcome is not Outcome.OPEN
        return tuple(
            sentence
            for sentence in self.sentences
            if sentence.level is not Severity.OK
            and not (over and sentence.source.endswith('calibrator_node: calibration'))
        )

    @property
    def wall_seconds_left(self) -> float:
        """Time left by the clock on the wall, s; NaN where unknown."""
        return math.nan if self.table is None else self.table.seconds_left / self.speed

    @property
    def share(self) -> float:
        """How much of the session's time is over, 0 to 1."""
        if self.outcome in {Outcome.DONE, Outcome.INCOMPLETE}:
            return 1.0
        left = math.nan if self.table is None else self.table.seconds_left
        if self.table is not None and self.table.phase is Phase.DONE:
            return 1.0
        whole = self.elapsed + left
        return self.elapsed / whole if whole > 0 else 0.0
