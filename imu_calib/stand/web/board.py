"""Keep the state of a running stand from the messages of its nodes."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from ...common.stream import NS
from ...reports.timeline import Courses, Pace, in_words
from ..devices.health import Severity
from ..rules import Phase
from .samples import Streams
from .snapshot import NOT_BEGUN, Expected, Outcome, Sentence, Snapshot, TableState

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

    Args:
        expected: Known values before the session begins.
    """

    def __init__(self, expected: Expected) -> None:
        self._state = Snapshot(expected)
        predicted = (p.name for p in expected.parameters)
        self._courses = Courses(
            {parameter.name: parameter for parameter in expected.parameters},
            dict(zip(predicted, expected.predicted, strict=True)),
            expected.specification,
        )
        self._table, self._calibrator = _LastMessage(), _LastMessage()
        self._parts: dict[str, Sentence] = {}
        self._nodes: dict[str, float] = {}
        self._pace = Pace()
        self._first: float | None = None
        self._ran_at: float | None = None
        self._reached: int | None = None
        self._worked_from: float | None = None

    def take_state(self, message: Any, now: float) -> None:
        """Take imu_calib_msgs/TurntableState."""
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

    def take_progress(self, message: Any, now: float) -> None:
        """Take imu_calib_msgs/CalibrationProgress."""
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
        over = self._state.outcome is not Outcome.OPEN and message.state in {
            message.WAITING,
            message.COLLECTING,
            message.DETERMINED,
        }
        if over:
            # The calibrator was reset.
            self._state = replace(
                self._state, outcome=Outcome.OPEN, outcome_text='', report='', report_text=''
            )
        if failed:
            self._state = replace(self._state, outcome=Outcome.FAILED, outcome_text=message.text)
        self._state = replace(
            self._state,
            progress=message.text,
            seen=int(message.step),
            repeats=tuple(self._too_little(message.repeat_steps)),
            next=tuple(message.next_attitudes),
        )

    def take_calibration(self, message: Any) -> bool:
        """Take imu_calib_msgs/ImuCalibration; return whether it is the session's final one."""
        for name, value in _values(message):
            self._courses.value(name, value)
        outcomes = {
            message.VALID: Outcome.DONE,
            message.INCOMPLETE: Outcome.INCOMPLETE,
            message.REFUSED: Outcome.FAILED,
        }
        outcome = outcomes.get(message.status)
        if outcome is None:
            return False
        if outcome is not Outcome.FAILED and self._worked_from is not None:
            known = {row.parameter.name for row in self._courses.rows()}
            pairs = zip(message.parameter_names, message.standard_deviations, strict=True)
            mine = [(name, std) for name, std in pairs if name in known]
            self._courses.note(
                self._state.elapsed, [name for name, _ in mine], [std for _, std in mine]
            )
        self._state = replace(self._state, outcome=outcome, outcome_text=message.status_text)
        return True

    def take_end(self, outcome: Outcome, text: str) -> None:
        """Take the outcome of the session, with a text."""
        self._state = replace(self._state, outcome=outcome, outcome_text=text)

    def take_diagnostics(self, message: Any, now: float) -> None:
        """Take diagnostic_msgs/DiagnosticArray."""
        for sentence in sentences_of(message):
            self.take_sentence(sentence, now)

    def take_sentence(self, sentence: Sentence, now: float) -> None:
        """Take a node's report on one of its parts."""
        self._parts[sentence.source] = sentence
        self._nodes[_node(sentence.source)] = now

    def take_temperature(self, celsius: float) -> None:
        """Take a temperature, degrees Celsius."""
        self._state = replace(self._state, celsius=celsius)

    def take_streams(self, streams: Streams) -> None:
        """Take the results from the samples."""
        self._state = replace(self._state, streams=streams)

    def take_answer(self, text: str) -> None:
        """Take the answer to a command."""
        self._state = replace(self._state, answer=text)

    def take_report(self, name: str, text: str) -> None:
        """Take the name of the report's file, empty without one, and a text on it."""
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
        if self._state.outcome is Outcome.OPEN:
            found += [
                Sentence(
                    node,
                    Severity.ERROR,
                    f'No message has come for {in_words(passed)}: has it ended?',
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
