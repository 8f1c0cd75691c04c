"""State of a running stand at one moment, for pages and terminals."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from ...model.parameters import Parameter
from ...reports.timeline import Converging
from ...session.imu import Specification
from ..devices.health import Severity
from ..rules import Phase
from .samples import Streams


class Outcome(Enum):
    """Outcome of a session, if it has ended."""

    OPEN = 'open'
    DONE = 'done'
    INCOMPLETE = 'incomplete'
    FAILED = 'failed'


@dataclass(frozen=True)
class Sentence:
    """A node's report on one of its parts.

    Attributes:
        source: For instance 'imu_node: stream'.
        level: Severity.
        text: A sentence.
        figures: Values with their units, by name.
    """

    source: str
    level: Severity
    text: str
    figures: tuple[tuple[str, str], ...] = ()

    def figure(self, name: str) -> str:
        """Return a value with its unit; empty if it is missing."""
        return dict(self.figures).get(name, '')


NOT_BEGUN = frozenset({Phase.IDLE, Phase.ABORTED})
"""In these a start begins the plan with its first step."""


@dataclass(frozen=True)
class PlannedStep:
    """A step of the plan: its target, and its action as text."""

    position: str
    words: str


@dataclass(frozen=True)
class Expected:
    """Known values of a session before it begins.

    Attributes:
        plan: Name of the plan.
        imu: Name of the unit's type.
        table: Name of the table; empty if a hand holds the unit.
        steps: Of the plan; empty if a hand holds the unit.
        parameters: Parameters that the session's method estimates.
        predicted: (n,) predicted standard deviations of the plan, SI; NaN if unknown.
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
    """State of the table; angles in rad, rates in rad/s."""

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
    """Content of a page at one moment.

    Attributes:
        expected: Known values before the session.
        table: Last state of the table; None before the first.
        table_silent: Duration without a state, s; 0 while states come.
        calibrator_silent: The same for the calibrator.
        progress: One sentence of the calibrator; empty before the first.
        seen: Steps of the plan that have begun in its present run.
        repeats: Steps to be repeated.
        next: Attitudes that a hand should hold next.
        outcome: Outcome of the session.
        outcome_text: Text on the outcome.
        rows: The parameters.
        sentences: Reports of the nodes, the worst first.
        streams: Results from the IMU's samples; None before the first.
        celsius: The unit's temperature, degrees Celsius; NaN if not measured.
        speed: Seconds of the stand per second of the wall clock.
        elapsed: Since the session began, s of the stand's time.
        worked: Of the present run of the plan, without pauses, s of the stand's time.
        answer: Answer to the last command of a viewer; empty before the first.
        report: Name of the report's file when it is written.
        report_text: Text on the report.
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
    worked: float = 0.0
    answer: str = ''
    report: str = ''
    report_text: str = ''

    @property
    def problems(self) -> tuple[Sentence, ...]:
        """Reports that need attention, the worst first, after the outcome of the session."""
        over = self.outcome is not Outcome.OPEN
        return tuple(
            sentence
            for sentence in self.sentences
            if sentence.level is not Severity.OK
            and not (over and sentence.source.endswith('calibrator_node: calibration'))
        )

    @property
    def silent(self) -> bool:
        """Whether the table or the calibrator has fallen silent: the state is out of date."""
        return self.table_silent > 0 or self.calibrator_silent > 0

    @property
    def wall_seconds_left(self) -> float:
        """Remaining time by the wall clock, s; NaN if unknown."""
        return math.nan if self.table is None else self.table.seconds_left / self.speed

    @property
    def share(self) -> float:
        """Elapsed share of the session's time, 0 to 1."""
        if self.outcome in {Outcome.DONE, Outcome.INCOMPLETE}:
            return 1.0
        seconds = math.nan if self.table is None else self.table.seconds_left
        if self.table is not None and self.table.phase is Phase.DONE:
            return 1.0
        if self.table is not None and self.table.phase in NOT_BEGUN:
            return 0.0
        whole = self.worked + seconds
        return self.worked / whole if whole > 0 else 0.0
