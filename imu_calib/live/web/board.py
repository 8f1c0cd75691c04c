"""Keep the state of a running stand from the messages of its nodes."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any

import numpy as np

from ...common.errors import ImuCalibError
from ...common.stream import NS, Floats, Mode
from ...common.units import DEG
from ...estimation.forecast import forecast
from ...estimation.setup import Setup
from ...model.parameters import Parameter
from ...model.sensors import SensorModel
from ...reports.convergence import Converging, Courses, Pace, in_words
from ...session.imu import ChannelNoise, Specification, Verdict, load_imu
from ...session.units_file import MountedUnit
from ..rules import Phase, Severity


@dataclass(frozen=True, eq=False)
class Streams:
    """Results from the samples."""

    #: Samples per second by their stamps, Hz; NaN before the first two seconds.
    rate: float = float('nan')
    #: (6,) mean of the channels over two seconds: pulses/s, counts, or rad/s and m/s^2.
    means: Floats = field(default_factory=lambda: np.full(6, np.nan))
    taken: int = 0  #: Number of samples received by this page.
    missing: int = 0  #: Number of missing samples, by the stamps.
    #: By channel, of the dwells so far; empty before the first.
    noise: Mapping[str, ChannelNoise] = field(default_factory=dict)
    dwells: int = 0  #: Number of dwells used for the noise.
    revision: int = 0  #: Changes with the noise.


class SessionOutcome(Enum):
    """Outcome of a session, if it has ended."""

    OPEN = 'open'
    DONE = 'done'
    INCOMPLETE = 'incomplete'
    PARTLY = 'partly'
    """Of several units some have no calibration."""
    FAILED = 'failed'

    @property
    def has_result(self) -> bool:
        """Whether there is a calibration."""
        return self not in {SessionOutcome.OPEN, SessionOutcome.FAILED}


@dataclass(frozen=True)
class Sentence:
    """A node's report on one of its parts."""

    source: str  #: For instance 'imu_node: stream'.
    level: Severity  #: Severity.
    text: str  #: A sentence.
    figures: tuple[tuple[str, str], ...] = ()  #: Values with their units, by name.

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
    """Known values of a session before it begins."""

    plan: str  #: Name of the plan.
    imu: str  #: Name of the unit's type.
    table: str  #: Name of the table; empty if a hand holds the unit.
    steps: tuple[PlannedStep, ...]  #: Of the plan; empty if a hand holds the unit.
    parameters: tuple[Parameter, ...]  #: Parameters that the session's method estimates.
    #: (n,) predicted standard deviations of the plan, SI; NaN if unknown.
    predicted: tuple[float, ...]
    specification: Specification | None = None  #: The limits of the unit; None without.
    joints: tuple[str, ...] = ()  #: Names of the table's joints.


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
    """Content of a page at one moment."""

    expected: Expected  #: Known values before the session.
    table: TableState | None = None  #: Last state of the table; None before the first.
    table_silent: float = 0.0  #: Duration without a state, s; 0 while states come.
    calibrator_silent: float = 0.0  #: The same for the calibrator.
    progress: str = ''  #: One sentence of the calibrator; empty before the first.
    seen: int = 0  #: Steps of the plan that have begun in its present run.
    repeats: tuple[int, ...] = ()  #: Steps to be repeated.
    next: tuple[str, ...] = ()  #: Attitudes that a hand should hold next.
    outcome: SessionOutcome = SessionOutcome.OPEN  #: Outcome of the session.
    outcome_text: str = ''  #: Text on the outcome.
    rows: tuple[Converging, ...] = ()  #: The parameters.
    sentences: tuple[Sentence, ...] = ()  #: Reports of the nodes, the worst first.
    streams: Streams | None = None  #: Results from the IMU's samples; None before the first.
    celsius: float = math.nan  #: The unit's temperature, degrees Celsius; NaN if not measured.
    speed: float = 1.0  #: Seconds of the stand per second of the wall clock.
    elapsed: float = 0.0  #: Since the session began, s of the stand's time.
    worked: float = 0.0  #: Of the present run of the plan, without pauses, s of the stand's time.
    answer: str = ''  #: Answer to the last command of a viewer; empty before the first.
    report: str = ''  #: Name of the report's file when it is written.
    report_text: str = ''  #: Text on the report.

    @property
    def problems(self) -> tuple[Sentence, ...]:
        """Reports that need attention, the worst first, after the outcome of the session."""
        over = self.outcome is not SessionOutcome.OPEN
        found = [
            sentence
            for sentence in self.sentences
            if sentence.level is not Severity.OK
            and not (over and sentence.source.endswith('calibrator_node: calibration'))
        ]
        if self.outside:
            text = f'The unit is outside its specification in {", ".join(self.outside)}.'
            found.append(Sentence('specification', Severity.WARN, text))
        return tuple(found)

    @property
    def outside(self) -> tuple[str, ...]:
        """Names of the parameters that are proven to be beyond their limits, so far."""
        return tuple(row.parameter.name for row in self.rows if row.verdict is Verdict.FAIL)

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
        if self.outcome.has_result:
            return 1.0
        seconds = math.nan if self.table is None else self.table.seconds_left
        if self.table is not None and self.table.phase is Phase.DONE:
            return 1.0
        if self.table is not None and self.table.phase in NOT_BEGUN:
            return 0.0
        whole = self.worked + seconds
        return self.worked / whole if whole > 0 else 0.0


_SILENT = 5.0
"""s: a node publishes once or twice a second."""
_BEGINS_ANEW = NOT_BEGUN | {Phase.DONE}
"""From these a plan that has run begins with its first step."""


@dataclass
class _LastMessage:
    """Time of the last message of a node, by the steady clock."""

    at: float | None = None

    def silence(self, now: float) -> float:
        """Return the duration of its silence, s; 0 before the first message."""
        if self.at is None or now - self.at < _SILENT:
            return 0.0
        return now - self.at


class Board:
    """Receives the nodes' messages, and keeps the state that pages show.

    Times `now` are of the steady clock, s. Only the fields of messages are used, independent of
    their transport.
    """

    def __init__(self, expected: Expected) -> None:
        self._state = Snapshot(expected)
        predicted = (p.name for p in expected.parameters)
        self._courses = Courses(
            {parameter.name: parameter for parameter in expected.parameters},
            dict(zip(predicted, expected.predicted, strict=True)),
            expected.specification,
            by_hand=not expected.table,
        )
        self._table, self._calibrator = _LastMessage(), _LastMessage()
        self._parts: dict[str, Sentence] = {}
        self._nodes: dict[str, float] = {}
        self._pace = Pace()
        self._first: float | None = None
        self._ran_at: float | None = None
        self._reached: int | None = None
        self._worked_from: float | None = None

    def on_state(self, message: Any, now: float) -> None:
        """Show imu_calib_msgs/TurntableState."""
        self._table.at = now
        stamp = _seconds(message.header.stamp)
        state = TableState(
            message.plan,
            int(message.step),
            int(message.steps),
            message.position_id,
            Phase(message.phase),
            message.reason,
            tuple(message.joint_names),
            tuple(float(a) for a in message.positions),
            tuple(float(r) for r in message.rates),
            float(message.turns_done),
            float(message.seconds_left),
        )
        self._follow_run(state, stamp, now)
        if state.phase not in {Phase.IDLE, Phase.DONE}:
            self._first = stamp if self._first is None else self._first
        if self._first is not None and state.phase is not Phase.DONE:
            self._state = replace(self._state, elapsed=max(0.0, stamp - self._first))
        self._state = replace(self._state, table=state)

    def _follow_run(self, state: TableState, stamp: float, now: float) -> None:
        """Follow how far the plan has run, and how fast; pauses are left out."""
        if not state.phase.at_a_step:
            self._pace.pause()
            self._ran_at = None
            return
        before = self._state.table
        if before is not None and before.phase in _BEGINS_ANEW and self._first is not None:
            # What the calibrator has of the run before is to be measured again.
            self._reached = 0
            self._state = replace(self._state, worked=0.0)
        if self._reached is not None:
            self._reached = max(self._reached, state.step)
        if self._ran_at is not None:
            worked = self._state.worked + max(0.0, stamp - self._ran_at)
            self._state = replace(self._state, worked=worked)
        self._ran_at = stamp
        self._pace.note(stamp, now)

    def on_progress(self, message: Any, now: float) -> None:
        """Show imu_calib_msgs/CalibrationProgress."""
        self._calibrator.at = now
        stamp = _seconds(message.header.stamp)
        if stamp > 0:
            begin = stamp if self._worked_from is None else self._worked_from
            if stamp < begin:
                # A new session.
                self._courses.begin()
                begin = stamp
            self._worked_from = begin
            self._courses.note(stamp - begin, message.parameter_names, message.standard_deviations)
            if self._state.table is None:
                self._state = replace(self._state, elapsed=stamp - begin)
        failed = message.state == message.FAILED
        over = self._state.outcome is not SessionOutcome.OPEN and message.state in {
            message.WAITING,
            message.COLLECTING,
            message.DETERMINED,
        }
        if over:
            # The calibrator was reset.
            self._state = replace(
                self._state, outcome=SessionOutcome.OPEN, outcome_text='', report='', report_text=''
            )
        if failed:
            self._state = replace(
                self._state, outcome=SessionOutcome.FAILED, outcome_text=message.text
            )
        self._state = replace(
            self._state,
            progress=message.text,
            seen=int(message.step),
            repeats=tuple(self._too_little(message.repeat_steps)),
            next=tuple(message.next_attitudes),
        )

    def on_calibration(self, message: Any) -> bool:
        """Show imu_calib_msgs/ImuCalibration; return whether it is the session's final one."""
        for name, value in _values(message):
            self._courses.value(name, value)
        outcomes = {
            message.VALID: SessionOutcome.DONE,
            message.INCOMPLETE: SessionOutcome.INCOMPLETE,
            message.REFUSED: SessionOutcome.FAILED,
        }
        outcome = outcomes.get(message.status)
        if outcome is None:
            return False
        if outcome is not SessionOutcome.FAILED and self._worked_from is not None:
            known = {row.parameter.name for row in self._courses.rows()}
            pairs = zip(message.parameter_names, message.standard_deviations, strict=True)
            mine = [(name, std) for name, std in pairs if name in known]
            self._courses.note(
                self._state.elapsed, [name for name, _ in mine], [std for _, std in mine]
            )
        self._state = replace(self._state, outcome=outcome, outcome_text=message.status_text)
        return True

    def set_outcome(self, outcome: SessionOutcome, text: str) -> None:
        """Show the outcome of the session, with a text."""
        self._state = replace(self._state, outcome=outcome, outcome_text=text)

    def on_diagnostics(self, message: Any, now: float) -> None:
        """Show diagnostic_msgs/DiagnosticArray."""
        for sentence in sentences_of(message):
            self.set_sentence(sentence, now)

    def set_sentence(self, sentence: Sentence, now: float) -> None:
        """Show a node's report on one of its parts."""
        self._parts[sentence.source] = sentence
        self._nodes[_node(sentence.source)] = now

    def set_temperature(self, celsius: float) -> None:
        """Show a temperature, degrees Celsius."""
        self._state = replace(self._state, celsius=celsius)

    def set_streams(self, streams: Streams) -> None:
        """Show the results from the samples."""
        self._state = replace(self._state, streams=streams)

    def set_answer(self, text: str) -> None:
        """Show the answer to a command."""
        self._state = replace(self._state, answer=text)

    def set_report(self, name: str, text: str) -> None:
        """Show the name of the report's file, empty without one, and a text on it."""
        self._state = replace(self._state, report=name, report_text=text)

    def _too_little(self, steps: Iterable[int]) -> Iterator[int]:
        """Yield the steps with insufficient data, except those whose data is still to come."""
        table = self._state.table
        running = () if table is None or table.phase is Phase.DONE else (table.step - 1, table.step)
        return (int(step) for step in steps if step not in running)

    def snapshot(self, now: float) -> Snapshot:
        """Return the state at a moment."""
        state = self._state
        seen = state.seen if self._reached is None else min(state.seen, self._reached)
        return replace(
            state,
            seen=seen,
            repeats=tuple(step for step in state.repeats if step < seen),
            table_silent=self._table.silence(now),
            calibrator_silent=self._calibrator.silence(now),
            rows=self._courses.rows(),
            sentences=tuple(self._sentences(now)),
            speed=self._pace.speed,
        )

    def _sentences(self, now: float) -> Iterable[Sentence]:
        """Return the reports of the nodes, the worst first; for a silent one, its silence."""
        silent = {node: now - at for node, at in self._nodes.items() if now - at > _SILENT}
        found = [s for s in self._parts.values() if _node(s.source) not in silent]
        if self._state.outcome is SessionOutcome.OPEN:
            found += [
                Sentence(
                    node,
                    Severity.ERROR,
                    silence(passed),
                )
                for node, passed in silent.items()
            ]
        return sorted(found, key=lambda sentence: (-sentence.level, sentence.source))


def sentences_of(message: Any) -> Iterator[Sentence]:
    """Yield the reports in diagnostic_msgs/DiagnosticArray."""
    for status in message.status:
        yield Sentence(
            status.name,
            Severity(min(status.level[0], Severity.ERROR)),
            status.message,
            tuple((v.key, v.value) for v in status.values),
        )


def _values(message: Any) -> Sequence[tuple[str, float]]:
    """Return the parameters in a calibration, by name, SI."""
    further = dict(zip(message.term_parameters, message.term_values, strict=True))
    found = []
    for name in message.parameter_names:
        value = further.get(name, getattr(message, name.lower(), math.nan))
        if isinstance(value, float) and math.isfinite(value):
            found.append((name, value))
    return found


def _node(source: str) -> str:
    return source.partition(':')[0]


def _seconds(stamp: Any) -> float:
    return float(stamp.sec + stamp.nanosec / NS)


_CALIBRATOR = 'calibrator_node: '
_DEVICE = 'imu_node: stream'
_STREAM_SOURCES = ('calibrator_node: stream', _DEVICE, 'imu_node')
"""Nodes that report on a unit's samples; the last if its own node is silent."""


@dataclass(frozen=True)
class ShownUnit:
    """Known values of a unit before a session begins."""

    serial_number: str  #: Of the unit.
    place: str  #: Its place, for display; may be empty.
    expected: Expected  #: Of its calibration.


@dataclass(frozen=True)
class UnitRow:
    """State of a unit in one line."""

    name: str  #: Its namespace.
    serial_number: str  #: Of the unit.
    place: str  #: Its place; may be empty.
    level: Severity  #: Severity.
    words: str  #: Its state in a few words.
    rate: str  #: Samples per second with their unit, as its node reports; may be empty.
    lost: str  #: Number of lost frames, as its node reports; may be empty.
    determined: int  #: Number of its determined parameters.
    parameters: int  #: Number of its parameters.
    #: The parameter furthest from the plan's prediction; None before any is known.
    worst: Converging | None

    @property
    def ratio(self) -> float:
        """Standard deviation of the worst over its prediction; NaN if unknown."""
        return math.nan if self.worst is None else self.worst.std / self.worst.predicted


class UnitsBoard:
    """Receives the nodes' messages, and keeps a `Board` for each unit and one for all."""

    def __init__(self, units: Mapping[str, ShownUnit]) -> None:
        self._units = dict(units)
        self.each = {name: Board(unit.expected) for name, unit in units.items()}
        self.common = Board(_expected_of_all([unit.expected for unit in units.values()]))
        self._present: frozenset[str] | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Namespaces of the units."""
        return tuple(self._units)

    def on_state(self, message: Any, now: float) -> None:
        """Show imu_calib_msgs/TurntableState."""
        for board in (self.common, *self.each.values()):
            board.on_state(message, now)

    def on_progress(self, message: Any, now: float) -> None:
        """Show imu_calib_msgs/CalibrationProgress of all units."""
        self.common.on_progress(message, now)
        self._present = frozenset(message.serial_numbers)
        if message.state == message.FINISHED:
            ends = {
                board.snapshot(now).outcome
                for name, board in self.each.items()
                if not self._is_left_out(name)
            }
            if SessionOutcome.FAILED in ends:
                self.common.set_outcome(SessionOutcome.PARTLY, message.text)
            elif SessionOutcome.INCOMPLETE in ends:
                self.common.set_outcome(SessionOutcome.INCOMPLETE, message.text)
            else:
                # Each unit has its findings.
                self.common.set_outcome(SessionOutcome.DONE, '')

    def on_diagnostics(self, message: Any, now: float) -> None:
        """Show diagnostic_msgs/DiagnosticArray: reports on one unit also go to its board."""
        self.common.on_diagnostics(message, now)
        for sentence in sentences_of(message):
            for name, board in self.each.items():
                own = self._as_its_own(sentence, name)
                if own is not None:
                    board.set_sentence(own, now)

    def _as_its_own(self, sentence: Sentence, name: str) -> Sentence | None:
        """Return a report as for a single unit; None if it is on another unit."""
        source = sentence.source
        for other in self._units:
            mark = f'{_CALIBRATOR}{other}: '
            if source.startswith(mark):
                if other != name:
                    return None
                return replace(sentence, source=_CALIBRATOR + source.removeprefix(mark))
            if source.startswith(f'{other}/') and other != name:
                return None
        return sentence

    def _is_left_out(self, name: str) -> bool:
        return self._present is not None and (
            self._units[name].serial_number not in self._present and bool(self._present)
        )

    def snapshot(self, now: float, name: str = '') -> Snapshot:
        """Return the state of a unit at a moment; without a name of all."""
        return (self.each[name] if name else self.common).snapshot(now)

    def unit_rows(self, now: float) -> tuple[UnitRow, ...]:
        """Return the state of each unit at a moment."""
        return tuple(self._row(name, self.each[name].snapshot(now)) for name in self._units)

    def _row(self, name: str, shown: Snapshot) -> UnitRow:
        unit = self._units[name]
        sentences = {s.source.rpartition('/')[2]: s for s in shown.sentences}
        device = sentences.get(_DEVICE)
        level, words = self._state_text(
            name, shown, [sentences.get(part) for part in _STREAM_SOURCES]
        )
        return UnitRow(
            name,
            unit.serial_number,
            unit.place,
            level,
            words,
            device.figure('rate') if device else '',
            device.figure('lost frames') if device else '',
            sum(row.determined for row in shown.rows),
            len(shown.rows),
            furthest(shown.rows),
        )

    def _state_text(
        self, name: str, shown: Snapshot, sentences: Sequence[Sentence | None]
    ) -> tuple[Severity, str]:
        if self._is_left_out(name):
            return Severity.WARN, 'Left out'
        outside = Severity.WARN, 'Calibrated, outside its specification'
        ends = {
            SessionOutcome.DONE: outside if shown.outside else (Severity.OK, 'Calibrated'),
            SessionOutcome.INCOMPLETE: (Severity.WARN, 'Calibrated, positions are missing'),
            SessionOutcome.FAILED: (Severity.ERROR, f'No calibration: {shown.outcome_text}'),
        }
        if shown.outcome in ends:
            return ends[shown.outcome]
        received = [one for one in sentences if one is not None]
        if not received:
            return Severity.WARN, 'No message yet'
        worst = max(received, key=lambda one: one.level)
        return worst.level, 'Samples come in' if worst.level is Severity.OK else worst.text


def silence(seconds: float) -> str:
    """Return the sentence on a node that was heard before."""
    return f'No message has come for {in_words(seconds)}: its program may have ended.'


def furthest(rows: tuple[Converging, ...]) -> Converging | None:
    """Return the determined parameter that is furthest from the plan's prediction."""
    known = [row for row in rows if row.determined and row.predicted > 0]
    return max(known, key=lambda row: row.std / row.predicted, default=None)


def _expected_of_all(expected: list[Expected]) -> Expected:
    """Return the expectation for all units: each parameter as in the worst unit."""
    predicted: dict[str, float] = {}
    parameters: dict[str, Parameter] = {}
    for one in expected:
        for parameter, value in zip(one.parameters, one.predicted, strict=True):
            parameters.setdefault(parameter.name, parameter)
            least = predicted.get(parameter.name, 0.0)
            unknown = math.isnan(value + least)
            predicted[parameter.name] = math.nan if unknown else max(least, value)
    return replace(
        expected[0],
        imu=f'{len(expected)} units',
        parameters=tuple(parameters.values()),
        predicted=tuple(predicted.values()),
        specification=None,
    )


def expectation(setup: Setup) -> Expected:
    """Return the known values of a session before it begins.

    In the prediction the biases drift by the data sheet's figure, as calibrations assume.
    """
    table = setup.table
    steps = tuple(
        PlannedStep(step.position, _words(step.mode, step.rates.tolist(), step.turns, step.dwell))
        for step in setup.steps
    )
    predicted: dict[str, float] = {}
    # Without the noise of a data sheet there is no prediction; everything else is shown.
    with suppress(ImuCalibError):
        found = forecast(setup, SensorModel(), drifting=True)
        names = [parameter.name for parameter in found.parameters]
        predicted = dict(zip(names, found.std.tolist(), strict=True))
    return Expected(
        setup.plan.name,
        setup.imu.id,
        '' if table is None else table.name,
        steps,
        setup.parameters,
        tuple(predicted.get(p.name, float('nan')) for p in setup.parameters),
        setup.imu.specification,
        () if table is None else table.names,
    )


def units_board(setup: Setup, units: Sequence[MountedUnit]) -> UnitsBoard:
    """Return a board for several units, with the known values of each before the session begins."""
    # A forecast takes time; units of one type share it.
    types: dict[str, Expected] = {}
    for unit in units:
        if unit.imu not in types:
            types[unit.imu] = expectation(replace(setup, imu=load_imu(unit.imu)))
    return UnitsBoard(
        {unit.name: ShownUnit(unit.serial_number, unit.place, types[unit.imu]) for unit in units}
    )


def _words(mode: Mode, rates: list[float], turns: int, dwell: float) -> str:
    if mode is Mode.RATE:
        rate = next((r for r in rates if r), 0.0) / DEG
        return f'{turns} turn{"s" * (turns != 1)} at {rate:g} deg/s.'
    return f'Stands still for {dwell:g} s.'
