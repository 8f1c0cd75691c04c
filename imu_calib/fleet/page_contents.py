"""Contents of the page, and the flags of each unit."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from ..common.stream import Floats
from ..session.imu import Verdict
from .results import Dates, Flags, History, UnitHistory

AHEAD = 90.0
"""Days before a due recalibration from which the page shows it: three months for planning."""


@dataclass(frozen=True)
class State:
    """A possible state of a unit, for a badge and a filter.

    Attributes:
        words: Text of the badge.
        kind: Class of the badge.
        meaning: Explanation of the text.
    """

    words: str
    kind: str
    meaning: str


class Flag(Enum):
    """Possible flags of a unit, the worst first."""

    OUTSIDE = State('outside', 'fail', 'outside its specification, uncertainty considered')
    OVERDUE = State('overdue', 'fail', 'the date by which it was to be recalibrated has passed')
    FAILED = State('failed', 'fail', 'its newest recording gave no calibration')
    CONTROL = State('out of control', 'fail', 'a control chart signals at its newest session')
    STEP = State('step', 'marginal', 'changed since the session before its newest')
    DRIFTS = State('drifts', 'marginal', 'has a significant trend')
    DUE = State('due', 'marginal', 'is to be recalibrated soon')
    MARGINAL = State('marginal', 'marginal', 'a limit lies within the uncertainty')
    OUTLIER = State('outlier', 'plain', 'unlike the others of its type')
    UNJUDGED = State('not calibrated', 'plain', 'none of its recordings gave a calibration')


@dataclass(frozen=True, eq=False)
class Recordings:
    """Rows of a catalogue, n of them.

    Attributes:
        key: Key of the task.
        recording: Its name.
        imu: Type; for a failed one as stated.
        serial: Serial number of the unit; empty if not stated.
        stand: Its stand; empty if not stated.
        date: (n,) date, UTC; NaT if unknown.
        calibrated: (n,) whether it gave a calibration.
        error: Reason of the failure, a sentence.
        verdict: Against the specification; empty without one.
        values: (n, 24) SI units; NaN if not estimated.
        std: (n, 24) stated standard deviations.
        findings: Of its calibration, sentences.
        calibration: Link to its file, relative to the page; empty without one.
        report: Likewise to its report.
    """

    key: Sequence[str]
    recording: Sequence[str]
    imu: Sequence[str]
    serial: Sequence[str]
    stand: Sequence[str]
    date: Dates
    calibrated: Flags
    error: Sequence[str]
    verdict: Sequence[str]
    values: Floats
    std: Floats
    findings: Sequence[Sequence[str]]
    calibration: Sequence[str]
    report: Sequence[str]


@dataclass(frozen=True, eq=False)
class Unit:
    """A unit with its recordings.

    Attributes:
        imu: Type; empty if only failed recordings name the unit, without a type.
        serial: Serial number.
        sessions: Rows of `Recordings` with a calibration: first those without a date, which
            `history` lacks, then those of `history`, by date.
        failed: Rows without a calibration, by date.
        replaced: Rows of recordings that were calibrated again: the newer row counts.
        history: Evaluation of the sessions; None without one.
        flags: Its flags, worst first.
    """

    imu: str
    serial: str
    sessions: tuple[int, ...]
    failed: tuple[int, ...]
    replaced: tuple[int, ...]
    history: UnitHistory | None
    flags: tuple[Flag, ...]

    @property
    def rows(self) -> tuple[int, ...]:
        """All rows, sessions first."""
        return (*self.sessions, *self.failed, *self.replaced)

    @property
    def name(self) -> str:
        """Type and serial number."""
        return f'{self.imu} {self.serial}'.strip()


@dataclass(frozen=True, eq=False)
class Fleet:
    """Contents of the page.

    Attributes:
        name: Name of the catalogue.
        recordings: Its rows.
        history: Their evaluation.
        today: Date of the page, UTC: due dates are counted from it.
        ahead: Days before a due recalibration from which the page shows it.
        units: The units of the history, as the page shows them.
    """

    name: str
    recordings: Recordings
    history: History
    today: np.datetime64
    ahead: float = AHEAD
    units: tuple[Unit, ...] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, 'units', tuple(_units(self)))

    def flagged(self, flag: Flag) -> list[Unit]:
        """Return the units with a flag."""
        return [unit for unit in self.units if flag in unit.flags]


def _units(fleet: Fleet) -> Iterable[Unit]:
    """Yield all units by type and serial number."""
    rows, known = fleet.recordings, {(u.imu, u.serial): u for u in fleet.history.units}
    place = {key: k for k, key in enumerate(rows.key)}
    sessions: dict[tuple[str, str], list[int]] = defaultdict(list)
    for k in np.flatnonzero(rows.calibrated).tolist():
        sessions[rows.imu[k], rows.serial[k]].append(k)
    of_number: dict[str, list[tuple[str, str]]] = defaultdict(list)
    for imu, serial in {**known, **sessions}:
        of_number[serial].append((imu, serial))
    failed: dict[tuple[str, str], list[int]] = defaultdict(list)
    for k in np.flatnonzero(~rows.calibrated).tolist():
        if rows.serial[k]:
            failed[_unit_of(rows.imu[k], rows.serial[k], of_number)].append(k)
    apart = {
        (population.imu, outlier.serial)
        for population in fleet.history.populations.values()
        for outlier in population.outliers
    }
    for name in sorted({**known, **sessions, **failed}):
        if not name[1]:
            continue
        found = known.get(name)
        mine = _by_date(rows, sessions[name])
        again: list[int] = []
        if found is not None:
            known_rows = [place[key] for key in found.key]
            others = [k for k in mine if k not in set(known_rows)]
            again = [k for k in others if not np.isnat(rows.date[k])]
            mine = [*(k for k in others if np.isnat(rows.date[k])), *known_rows]
        lost = _by_date(rows, failed[name])
        flags = tuple(_flags(fleet, found, mine, lost, name in apart))
        yield Unit(*name, tuple(mine), tuple(lost), tuple(again), found, flags)


def _unit_of(
    imu: str, serial: str, of_number: Mapping[str, Sequence[tuple[str, str]]]
) -> tuple[str, str]:
    """Return the unit of a failed recording: its stated type may be a file."""
    units = of_number.get(serial, ())
    same = [unit for unit in units if unit[0] == imu]
    if same or len(units) == 1:
        return same[0] if same else units[0]
    return imu, serial


def _by_date(rows: Recordings, chosen: Sequence[int]) -> list[int]:
    """Return rows by date, those without a date first."""
    return sorted(chosen, key=lambda k: (not np.isnat(rows.date[k]), rows.date[k].astype('M8[s]')))


def _flags(
    fleet: Fleet,
    history: UnitHistory | None,
    sessions: Sequence[int],
    failed: Sequence[int],
    apart: bool,
) -> Iterable[Flag]:
    rows = fleet.recordings
    last = _newest(rows, sessions)
    flags = {Flag.FAILED: bool(failed) and _later(_newest(rows, failed), last)}
    flags[Flag.OUTLIER], flags[Flag.UNJUDGED] = apart, not sessions
    if history is not None:
        newest, due = len(history.key) - 1, history.forecast.recalibrate
        # A unit that is outside has no date until which it is inside.
        known = not np.isnat(due) and not history.outside
        flags[Flag.OUTSIDE] = bool(history.outside)
        flags[Flag.MARGINAL] = history.verdict is Verdict.MARGINAL
        flags[Flag.OVERDUE] = bool(known and due < fleet.today)
        flags[Flag.DUE] = bool(known and fleet.today <= due <= fleet.today + days(fleet.ahead))
        flags[Flag.CONTROL] = any(s.index == newest for s in history.charts.signals)
        flags[Flag.STEP] = any(s.index == newest for s in history.steps)
        flags[Flag.DRIFTS] = bool(history.trend.significant.any())
    elif sessions:
        flags[Flag.OUTSIDE] = rows.verdict[sessions[-1]] == Verdict.FAIL.value
        flags[Flag.MARGINAL] = rows.verdict[sessions[-1]] == Verdict.MARGINAL.value
    return (flag for flag in Flag if flags.get(flag))


def days(count: float) -> np.timedelta64:
    """Return a number of days as a time span."""
    return np.timedelta64(round(count * 86400), 's')


def _newest(rows: Recordings, chosen: Sequence[int]) -> np.datetime64:
    dates = rows.date[list(chosen)] if chosen else np.array([], 'M8[s]')
    known = dates[~np.isnat(dates)]
    return known.max() if len(known) else np.datetime64('NaT', 's')


def _later(one: np.datetime64, other: np.datetime64) -> bool:
    """Return whether a date is after another; true if the other is unknown."""
    return bool(np.isnat(other) or one > other)
