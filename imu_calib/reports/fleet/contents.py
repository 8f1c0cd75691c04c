"""What the page is written from, and what it says of each unit as a whole."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from ...histories.results import Dates, Flags, History, UnitHistory
from ...specification import Verdict
from ...stream import Floats

AHEAD = 90.0
"""Days before a recalibration is due from which the page says so: three months to plan it in."""


@dataclass(frozen=True)
class State:
    """What a unit can be, for a badge and a filter.

    Attributes:
        words: On the badge.
        kind: Class of the badge.
        meaning: For who does not know the word.

    """

    words: str
    kind: str
    meaning: str


class Flag(Enum):
    """What may be said of a unit, what is worst first."""

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
        key: What a task is known by.
        recording: Its name.
        imu: Type; of a failed one as it was stated.
        serial: Number of the unit; empty where not stated.
        stand: Where; empty likewise.
        date: (n,) when, UTC; NaT where unknown.
        calibrated: (n,) whether it gave a calibration.
        error: Why not, a sentence.
        verdict: Against the specification; empty without one.
        values: (n, 24) SI units; NaN for what was not estimated.
        std: (n, 24) as stated.
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
        imu: Type; empty where only failed recordings name it, and none says which.
        serial: Number.
        sessions: Rows of `Recordings` that gave a calibration: those that `history` has not
            (without a date), then those that it has, by date.
        failed: Rows that gave none, by date.
        replaced: Rows of recordings that were calibrated again: the newer row counts.
        history: What the sessions say; None without one.
        flags: What is to be said of it, worst first.

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
        """Type and number."""
        return f'{self.imu} {self.serial}'.strip()


@dataclass(frozen=True, eq=False)
class Fleet:
    """What the page is written from.

    Attributes:
        name: Of the catalogue.
        recordings: Its rows.
        history: What they say.
        today: The day of which the page is, UTC: what is due counts from it.
        ahead: Days before a recalibration is due from which the page says so.

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
        """Return the units of which something is to be said."""
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
    """Return which unit a failed recording is of: what it states of its type may be a file."""
    units = of_number.get(serial, ())
    same = [unit for unit in units if unit[0] == imu]
    if same or len(units) == 1:
        return same[0] if same else units[0]
    return imu, serial


def _by_date(rows: Recordings, chosen: Sequence[int]) -> list[int]:
    """Return rows by date, those without one first."""
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
    said = {Flag.FAILED: bool(failed) and _later(_newest(rows, failed), last)}
    said[Flag.OUTLIER], said[Flag.UNJUDGED] = apart, not sessions
    if history is not None:
        newest, due = len(history.key) - 1, history.forecast.recalibrate
        known = not np.isnat(due)
        said[Flag.OUTSIDE] = bool(history.outside)
        said[Flag.MARGINAL] = history.verdict is Verdict.MARGINAL
        said[Flag.OVERDUE] = bool(known and due < fleet.today)
        said[Flag.DUE] = bool(known and fleet.today <= due <= fleet.today + days(fleet.ahead))
        said[Flag.CONTROL] = any(s.index == newest for s in history.charts.signals)
        said[Flag.STEP] = any(s.index == newest for s in history.steps)
        said[Flag.DRIFTS] = bool(history.trend.significant.any())
    elif sessions:
        said[Flag.OUTSIDE] = rows.verdict[sessions[-1]] == Verdict.FAIL.value
        said[Flag.MARGINAL] = rows.verdict[sessions[-1]] == Verdict.MARGINAL.value
    return (flag for flag in Flag if said.get(flag))


def days(count: float) -> np.timedelta64:
    """Return a number of days as a span of time."""
    return np.timedelta64(round(count * 86400), 's')


def _newest(rows: Recordings, chosen: Sequence[int]) -> np.datetime64:
    dates = rows.date[list(chosen)] if chosen else np.array([], 'M8[s]')
    known = dates[~np.isnat(dates)]
    return known.max() if len(known) else np.datetime64('NaT', 's')


def _later(one: np.datetime64, other: np.datetime64) -> bool:
    """Whether something was after something else; without the other's date it was."""
    return bool(np.isnat(other) or one > other)
