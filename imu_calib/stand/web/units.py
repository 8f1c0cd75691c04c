"""The state of a stand with several units: of all, and of each."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from ...model.parameters import Parameter
from ...reports.timeline import Converging
from ..devices.health import Severity
from .board import Board, sentences_of
from .snapshot import Expected, Outcome, Sentence, Snapshot

_CALIBRATOR = 'calibrator_node: '
_DEVICE = 'imu_node: stream'
_STREAM_SOURCES = ('calibrator_node: stream', _DEVICE, 'imu_node')
"""Nodes that report on a unit's samples; the last if its own node is silent."""


@dataclass(frozen=True)
class ShownUnit:
    """Known values of a unit before a session begins.

    Attributes:
        serial_number: Of the unit.
        place: Its place, for display; may be empty.
        expected: Of its calibration.
    """

    serial_number: str
    place: str
    expected: Expected


@dataclass(frozen=True)
class UnitRow:
    """State of a unit in one line.

    Attributes:
        name: Its namespace.
        serial_number: Of the unit.
        place: Its place; may be empty.
        level: Severity.
        words: Its state in a few words.
        rate: Samples per second with their unit, as its node reports; may be empty.
        lost: Number of lost frames, as its node reports; may be empty.
        determined: Number of its determined parameters.
        parameters: Number of its parameters.
        worst: The parameter furthest from the plan's prediction; None before any is known.
    """

    name: str
    serial_number: str
    place: str
    level: Severity
    words: str
    rate: str
    lost: str
    determined: int
    parameters: int
    worst: Converging | None

    @property
    def ratio(self) -> float:
        """Standard deviation of the worst over its prediction; NaN if unknown."""
        return math.nan if self.worst is None else self.worst.std / self.worst.predicted


class UnitsBoard:
    """Receives the nodes' messages, and keeps a `Board` for each unit and one for all.

    Args:
        units: By their namespaces.
    """

    def __init__(self, units: Mapping[str, ShownUnit]) -> None:
        self._units = dict(units)
        self.each = {name: Board(unit.expected) for name, unit in units.items()}
        self.common = Board(_of_all([unit.expected for unit in units.values()]))
        self._present: frozenset[str] | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Namespaces of the units."""
        return tuple(self._units)

    def take_state(self, message: Any, now: float) -> None:
        """Take imu_calib_msgs/TurntableState."""
        for board in (self.common, *self.each.values()):
            board.take_state(message, now)

    def take_progress(self, message: Any, now: float) -> None:
        """Take imu_calib_msgs/CalibrationProgress of all units."""
        self.common.take_progress(message, now)
        self._present = frozenset(message.serial_numbers)
        if message.state == message.FINISHED:
            missed = any(
                board.snapshot(now).outcome in {Outcome.FAILED, Outcome.INCOMPLETE}
                for name, board in self.each.items()
                if not self._is_left_out(name)
            )
            outcome = Outcome.INCOMPLETE if missed else Outcome.DONE
            self.common.take_end(outcome, message.text)

    def take_diagnostics(self, message: Any, now: float) -> None:
        """Take diagnostic_msgs/DiagnosticArray: reports on one unit also go to its board."""
        self.common.take_diagnostics(message, now)
        for sentence in sentences_of(message):
            for name, board in self.each.items():
                own = self._as_its_own(sentence, name)
                if own is not None:
                    board.take_sentence(own, now)

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
        ends = {
            Outcome.DONE: (Severity.OK, 'Calibrated'),
            Outcome.INCOMPLETE: (Severity.WARN, 'Calibrated, positions are missing'),
            Outcome.FAILED: (Severity.ERROR, f'No calibration: {shown.outcome_text}'),
        }
        if shown.outcome in ends:
            return ends[shown.outcome]
        received = [one for one in sentences if one is not None]
        if not received:
            return Severity.WARN, 'No message yet'
        worst = max(received, key=lambda one: one.level)
        return worst.level, 'Samples come in' if worst.level is Severity.OK else worst.text


def furthest(rows: tuple[Converging, ...]) -> Converging | None:
    """Return the determined parameter that is furthest from the plan's prediction."""
    known = [row for row in rows if row.determined and row.predicted > 0]
    return max(known, key=lambda row: row.std / row.predicted, default=None)


def _of_all(expected: list[Expected]) -> Expected:
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
