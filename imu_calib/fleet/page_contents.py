"""Contents of the page, and the flags of each unit."""

from __future__ import annotations

import base64
import json
import struct
import zlib
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.finding import is_warning
from ..common.stream import Floats
from ..common.units import decimals, typeset
from ..model.parameters import PARAMETERS, engineering
from ..session.imu import Verdict
from . import results
from .results import Dates, Flags, History, UnitHistory
from .sentences import percent

AHEAD = 90.0
"""Days before a due recalibration from which the page shows it: three months for planning."""


@dataclass(frozen=True)
class State:
    """A possible state of a unit, for a badge and a filter."""

    words: str  #: Text of the badge.
    kind: str  #: Class of the badge.
    meaning: str  #: Explanation of the text.


class Flag(Enum):
    """Possible flags of a unit, the worst first."""

    OUTSIDE = State('outside', 'fail', 'outside its specification, uncertainty considered')
    OVERDUE = State('overdue', 'fail', 'the date by which it was to be recalibrated has passed')
    FAILED = State(
        'failed', 'fail', 'its newest recording, or one without a date, gave no calibration'
    )
    OFF_STAND = State(
        'stand off', 'fail', 'its newest calibration is from a stand that is off, and has its error'
    )
    CONTROL = State('out of control', 'fail', 'a control chart signals at its newest session')
    WARNED = State(
        'warned',
        'marginal',
        'a calibration of it has warnings: values may be wrong by more than stated',
    )
    STEP = State('step', 'marginal', 'changed since the session before its newest')
    DRIFTS = State('drifts', 'marginal', 'has a significant trend')
    DUE = State('due', 'marginal', 'is to be recalibrated soon')
    MARGINAL = State('marginal', 'marginal', 'a limit lies within the uncertainty')
    SIMULATED = State('simulated', 'marginal', 'its newest calibration is of simulated data')
    OUTLIER = State('outlier', 'plain', 'unlike the others of its type')
    UNJUDGED = State('not calibrated', 'plain', 'none of its recordings gave a calibration')


@dataclass(frozen=True, eq=False)
class Recordings:
    """Rows of a catalogue, n of them."""

    key: Sequence[str]  #: Key of the task.
    recording: Sequence[str]  #: Its name.
    imu: Sequence[str]  #: Type; for a failed one as stated.
    serial: Sequence[str]  #: Serial number of the unit; empty if not stated.
    stand: Sequence[str]  #: Its stand; empty if not stated.
    date: Dates  #: (n,) date, UTC; NaT if unknown.
    calibrated: Flags  #: (n,) whether it gave a calibration.
    error: Sequence[str]  #: Reason of the failure, a sentence.
    verdict: Sequence[str]  #: Against the specification; empty without one.
    simulated: Sequence[bool]  #: Whether its data were simulated.
    values: Floats  #: (n, 24) SI units; NaN if not estimated.
    std: Floats  #: (n, 24) stated standard deviations.
    findings: Sequence[Sequence[str]]  #: Of its calibration, sentences.
    calibration: Sequence[str]  #: Link to its file, relative to the page; empty without one.
    report: Sequence[str]  #: Likewise to its report.


@dataclass(frozen=True, eq=False)
class Unit:
    """A unit with its recordings."""

    imu: str  #: Type; empty if only failed recordings name the unit, without a type.
    serial: str  #: Serial number.
    #: Rows of `Recordings` with a calibration: first those without a date, which `history` lacks,
    #: then those of `history`, by date.
    sessions: tuple[int, ...]
    failed: tuple[int, ...]  #: Rows without a calibration, by date.
    #: Rows of recordings that were calibrated again: the newer row counts.
    replaced: tuple[int, ...]
    history: UnitHistory | None  #: Evaluation of the sessions; None without one.
    flags: tuple[Flag, ...]  #: Its flags, worst first.

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
    """Contents of the page."""

    name: str  #: Name of the catalogue.
    recordings: Recordings  #: Its rows.
    history: History  #: Their evaluation.
    today: np.datetime64  #: Date of the page, UTC: due dates are counted from it.
    ahead: float = AHEAD  #: Days before a due recalibration from which the page shows it.
    #: The units of the history, as the page shows them.
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
    flags = {Flag.FAILED: any(_later(rows.date[k], last) for k in failed)}
    flags[Flag.OUTLIER], flags[Flag.UNJUDGED] = apart, not sessions
    flags[Flag.SIMULATED] = bool(sessions) and rows.simulated[sessions[-1]]
    flags[Flag.WARNED] = any(is_warning(text) for k in sessions for text in rows.findings[k])
    if history is not None:
        newest, due = len(history.key) - 1, history.forecast.recalibrate
        # A unit that is outside has no date until which it is inside.
        known = not np.isnat(due) and not history.outside
        flags[Flag.OUTSIDE] = bool(history.outside)
        flags[Flag.OFF_STAND] = history.stand[-1] in fleet.history.stands.off
        flags[Flag.MARGINAL] = history.verdict is Verdict.MARGINAL
        flags[Flag.OVERDUE] = bool(known and due < fleet.today)
        flags[Flag.DUE] = bool(known and fleet.today <= due <= fleet.today + days(fleet.ahead))
        flags[Flag.CONTROL] = any(s.index == newest for s in history.charts.signals)
        flags[Flag.STEP] = any(s.index == newest for s in history.own_steps)
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
    """Return whether a date is after another; true if one of them is unknown."""
    return bool(np.isnat(one) or np.isnat(other) or one > other)


PLACE_OF = {p.name: k for k, p in enumerate(PARAMETERS)}


def day(date: np.datetime64) -> str:
    """Return a date as text.

    Examples:
        >>> day(np.datetime64('2026-03-02T14:30')), day(np.datetime64('NaT', 's'))
        ('2026-03-02', 'no date')
    """
    return results.day(date) or 'no date'


def count(number: int, noun: str, nouns: str = '') -> str:
    """Return a number with its noun.

    Examples:
        >>> count(1, 'unit'), count(12345, 'unit'), count(0, 'entry', 'entries')
        ('1 unit', '12 345 units', '0 entries')
    """
    written = f'{number:,}'.replace(',', '\u202f' if number >= 10_000 else '')
    return f'{written} {noun if number == 1 else nouns or noun + "s"}'.replace('\u202f', ' ')


# Arrays and texts as one compressed text for the page's script.
#
# zlib( length of the head, 4 bytes | head, JSON | arrays, one after the other )
#
# in base64. The head lists the arrays with type and length, and contains the texts. The bytes of an
# array are stored in planes, lowest first: neighbours are similar and compress well. Numbers have
# only the precision that is shown: a page on 5000 units is read over network drives and on phones.


NO_DAY = -(2**31)  #: Code of a missing date.
STEP = 0.05
"""Resolution in stated deviations: of values, and of normal scores. A judgement: a pixel."""
_CODES = 254
"""Codes of a standard deviation, in equal ratios: 2 % each for a range of a factor of 100."""
_MANTISSA = 12  #: Bits kept of other numbers: relative precision 1e-4.
_KINDS = {'u1': 'Uint8Array', 'i1': 'Int8Array', 'i4': 'Int32Array', 'f4': 'Float32Array'}


def pack(arrays: Mapping[str, NDArray[Any]], texts: Mapping[str, object]) -> str:
    """Return packed arrays of uint8, int8, int32 or float32 with texts (JSON values)."""
    head: dict[str, object] = {'texts': texts}
    listed, parts = [], []
    for name, array in arrays.items():
        flat = np.ascontiguousarray(array).reshape(-1)
        listed.append([name, _KINDS[flat.dtype.str[1:]], len(flat)])
        planes = flat.astype(flat.dtype.newbyteorder('<')).view(np.uint8)
        parts.append(planes.reshape(-1, flat.dtype.itemsize).T.tobytes())
    head['arrays'] = listed
    # JSON has no NaN; a page with one would not open.
    header = json.dumps(head, ensure_ascii=False, separators=(',', ':'), allow_nan=False)
    coded = header.encode('utf-8', 'replace')
    content = struct.pack('<I', len(coded)) + coded + b''.join(parts)
    return base64.b64encode(zlib.compress(content, 6)).decode('ascii')


def distinct(texts: Sequence[str]) -> tuple[list[str], NDArray[np.int32]]:
    """Return the distinct texts, and the index of each text."""
    places: dict[str, int] = {}
    index = [places.setdefault(text, len(places)) for text in texts]
    return list(places), np.array(index, np.int32)


def minutes(dates: Dates) -> NDArray[np.int32]:
    """Return dates as minutes since 1970."""
    content = dates.astype('M8[m]')
    counted = np.clip(content.astype(np.int64), NO_DAY + 1, 2**31 - 1)
    return np.where(np.isnat(content), NO_DAY, counted).astype(np.int32)


def short(values: Floats) -> NDArray[np.float32]:
    """Return numbers with the shown digits, so that they compress well."""
    with np.errstate(over='ignore'):
        found = np.ascontiguousarray(values, np.float32)
    drop = 23 - _MANTISSA
    bits = found.view(np.uint32)
    rounded = (bits + np.uint32(1 << (drop - 1))) & np.uint32(0xFFFFFFFF << drop & 0xFFFFFFFF)
    # Rounding the bits of infinity or NaN would change them to other values.
    return np.where(np.isfinite(found), rounded.view(np.float32), found)


def scores(values: Floats) -> NDArray[np.int8]:
    """Return normal scores in steps, -128 for none; larger ones are at the chart's edge."""
    steps = np.clip(np.nan_to_num(values, nan=0.0) / STEP, -127, 127).round()
    return np.where(np.isnan(values), -128, steps).astype(np.int8)


def deviations(std: Floats) -> tuple[NDArray[np.uint8], list[list[float]]]:
    """Return standard deviations as codes by equal ratios.

    Args:
        std: (n, m) NaN or zero for none.

    Returns:
        (m, n) codes, 0 for none; for each column [smallest, logarithm of the ratio of two codes].
    """
    codes = np.zeros(std.shape[::-1], np.uint8)
    scales = []
    for k, column in enumerate(std.T):
        known = np.isfinite(column) & (column > 0)
        if not known.any():
            scales.append([1.0, 0.0])
            continue
        low, high = float(column[known].min()), float(column[known].max())
        ratio = np.log(high / low) / (_CODES - 1)
        steps = np.log(column[known] / low) / ratio if ratio > 0 else np.zeros(known.sum())
        codes[k, known] = 1 + np.rint(steps).astype(np.uint8)
        scales.append([low, float(ratio)])
    return codes, scales


def packed_differences(values: Floats, std: Floats) -> tuple[NDArray[np.int32], list[float]]:
    """Return values in steps of a share of their smallest deviation, as differences.

    Args:
        values: (n, m); values that are not finite repeat the previous one.
        std: (n, m) their standard deviations.

    Returns:
        (m, n) differences, whose sums wrap at 32 bits; and the step of each column.
    """
    found = np.zeros(values.shape[::-1], np.int32)
    steps = []
    for k, (column, deviation) in enumerate(zip(values.T, std.T, strict=True)):
        known = np.isfinite(column)
        filled = np.where(known, column, 0.0)
        meant = np.isfinite(deviation) & (deviation > 0)
        reach = float(np.abs(filled).max(initial=0.0))
        step = max(
            STEP * float(deviation[meant].min()) if meant.any() else 0.0, reach / (2**31 - 2)
        )
        steps.append(step or 1.0)
        counted = np.rint(filled / steps[-1]).astype(np.int64)
        last = np.maximum.accumulate(np.where(known, np.arange(len(column)), -1))
        held = np.where(last >= 0, counted[np.maximum(last, 0)], 0)
        found[k] = np.diff(held, prepend=0).astype(np.int64).astype(np.uint32).view(np.int32)
    return found, steps


_NUMBER = len(PARAMETERS)


def units_data(fleet: Fleet) -> str:
    """Return the data of the table of units."""
    units, rows = fleet.units, fleet.recordings
    newest = [_newest_row(fleet, unit) for unit in units]
    histories = [unit.history for unit in units]
    indices, texts_of = _indexed(
        imu=[unit.imu for unit in units],
        lot=[h.lot if h is not None else '' for h in histories],
        stand=[rows.stand[k] if k >= 0 else '' for k in newest],
        verdict=[_verdict(fleet, unit) for unit in units],
    )
    last = np.array([rows.date[k] if k >= 0 else _NO_DATE for k in newest], 'M8[s]')
    due = [h.forecast.recalibrate if h is not None else _NO_DATE for h in histories]
    places = {flag: k for k, flag in enumerate(Flag)}
    arrays: dict[str, NDArray[np.generic]] = {
        **indices,
        'last': minutes(last),
        'due': minutes(np.array(due, 'M8[s]')),
        'because': np.array([_because(h) for h in histories], np.int8),
        'sessions': np.array([len(u.sessions) for u in units], np.int32),
        'failed': np.array([len(u.failed) for u in units], np.int32),
        'rows': np.array([len(u.rows) for u in units], np.int32),
        'by_hand': np.array([h is not None and h.by_hand for h in histories], np.int8),
        'bitmask': np.array([sum(1 << places[f] for f in u.flags) for u in units], np.int32),
    }
    texts = {
        'serials': [unit.serial for unit in units],
        **texts_of,
        'flags': [[f.name, f.value.words, f.value.kind, f.value.meaning] for f in Flag],
        'parameters': _headings(by_hand=False),
        'parameters_by_hand': _headings(by_hand=True),
        'today': day(fleet.today),
    }
    return pack(arrays, texts)


def _headings(*, by_hand: bool) -> list[list[object]]:
    """Return name, words, unit and the unit's size of each parameter."""
    shown = [engineering(p, by_hand=by_hand) for p in PARAMETERS]
    return [
        [p.name, p.kind.value.words, one.symbol, one.scale]
        for p, one in zip(PARAMETERS, shown, strict=True)
    ]


def sessions_data(fleet: Fleet) -> str:
    """Return the data of the units' details: sessions by unit, failed recordings likewise."""
    rows, units = fleet.recordings, fleet.units
    chosen = [k for unit in units for k in unit.rows]
    sessions = [k for unit in units for k in unit.sessions]
    histories = [unit.history for unit in units]
    indices, texts_of = _indexed(
        stand=[rows.stand[k] for k in chosen],
        error=[typeset(rows.error[k]) for k in chosen],
        remark=[typeset('\n'.join(rows.findings[k])) for k in chosen],
        verdict=[rows.verdict[k] for k in chosen],
    )
    values, std = rows.values[sessions], rows.std[sessions]
    differences, steps = packed_differences(values, std)
    codes, scales = deviations(std)
    shift = _session_values(units, lambda h: h.values - h.corrected)
    arrays: dict[str, NDArray[np.generic]] = {
        'date': minutes(rows.date[chosen]),
        **indices,
        'fine': rows.calibrated[chosen].astype(np.uint8),
        'value': differences,
        'known': np.isfinite(values).T.astype(np.uint8),
        'std': codes,
        'shift': short(np.nan_to_num(shift).T),
        'score': scores(_session_values(units, lambda h: h.charts.score)).T,
        'ewma': scores(_session_values(units, lambda h: h.charts.ewma)).T,
        't2': short(_session_values(units, lambda h: h.charts.t2[:, None], 1)),
        't2_limit': short(_session_values(units, lambda h: h.charts.t2_limit[:, None], 1)),
        'slope': short(_by_parameter(histories, lambda h: h.trend.slope)),
        'slope_reach': short(_by_parameter(histories, lambda h: (h.trend.high - h.trend.low) / 2)),
        'level': short(_by_parameter(histories, lambda h: h.trend.level)),
        'scatter': short(_by_parameter(histories, lambda h: h.scatter.std)),
        'limit': short(_by_parameter(histories, lambda h: h.limit)),
        'leaves': minutes(_by_parameter(histories, lambda h: h.forecast.leaves, _NO_DATE)),
        'significant': _by_parameter(histories, lambda h: h.trend.significant, False).astype('u1'),
    }
    limits = fleet.history.limits
    texts = {
        'calibrated': len(sessions),
        'recordings': [rows.recording[k] for k in chosen],
        'calibrations': [rows.calibration[k] for k in chosen],
        'reports': [rows.report[k] for k in chosen],
        **texts_of,
        'valueSteps': steps,
        'stdScales': scales,
        'scoreStep': STEP,
        'individualsLimit': limits.individuals,
        'ewmaLimit': limits.ewma,
        'confidence': percent(fleet.history.rules.confidence),
        'findings': [list(map(typeset, h.findings)) if h is not None else [] for h in histories],
        'reasons': [typeset(h.forecast.reason) if h is not None else '' for h in histories],
        'steps': [_steps(unit) for unit in units],
    }
    return pack(arrays, texts)


_NO_DATE = np.datetime64('NaT', 's')


def _indexed(**columns: Sequence[str]) -> tuple[dict[str, NDArray[np.int32]], dict[str, Any]]:
    """Return the indices of texts by column, and the distinct texts by its plural."""
    found = {name: distinct(texts) for name, texts in columns.items()}
    indices = {name: index for name, (_, index) in found.items()}
    return indices, {f'{name}s': texts for name, (texts, _) in found.items()}


def _newest_row(fleet: Fleet, unit: Unit) -> int:
    """Return the row of a unit's newest recording; -1 without any."""
    both = (*unit.failed, *unit.sessions)
    dates = fleet.recordings.date
    known = [k for k in both if not np.isnat(dates[k])]
    if known:
        return max(known, key=lambda k: dates[k])
    return both[-1] if both else -1


def _verdict(fleet: Fleet, unit: Unit) -> str:
    history = unit.history
    if history is not None:
        return '' if history.verdict is None else history.verdict.value
    return fleet.recordings.verdict[unit.sessions[-1]] if unit.sessions else ''


def _because(history: UnitHistory | None) -> int:
    """Return the parameter that determines a unit's due date; -1 without any."""
    return -1 if history is None else PLACE_OF.get(history.forecast.parameter, -1)


def _session_values(
    units: Sequence[Unit], what: Callable[[UnitHistory], Floats], width: int = _NUMBER
) -> Floats:
    """Return (n, width) values of all sessions, by unit; none for a unit without history."""
    parts = [
        part
        for unit in units
        for part in (
            np.full((len(unit.sessions) - _sessions_in_history(unit), width), np.nan),
            *(() if unit.history is None else (what(unit.history),)),
        )
    ]
    return np.concatenate([np.empty((0, width)), *parts])


def _sessions_in_history(unit: Unit) -> int:
    """Return the number of sessions in the history of a unit."""
    return 0 if unit.history is None else len(unit.history.key)


def _by_parameter(
    histories: Sequence[UnitHistory | None],
    what: Callable[[UnitHistory], NDArray[Any]],
    none: object = np.nan,
) -> NDArray[Any]:
    """Return (24, m) values of all units."""
    rows = [[none] * _NUMBER if one is None else what(one) for one in histories]
    return np.reshape(np.array(rows), (-1, _NUMBER)).T


def _steps(unit: Unit) -> list[list[object]]:
    """Return the steps of a unit: [index of the session after it, looks like, sizes as shown]."""
    found: list[list[object]] = []
    before = len(unit.sessions) - _sessions_in_history(unit)
    by_hand = unit.history is not None and unit.history.by_hand
    for step in unit.history.steps if unit.history is not None else ():
        sizes = [
            [name, _shown(name, size, by_hand=by_hand), _shown(name, std, by_hand=by_hand)]
            for name, size, std in zip(step.parameters, step.size, step.std, strict=True)
        ]
        found.append([before + step.index, step.cause.value, sizes])
    return found


def _shown(name: str, value: float, *, by_hand: bool) -> float:
    parameter = PARAMETERS[PLACE_OF[name]]
    shown = value / engineering(parameter, by_hand=by_hand).scale
    return round(float(shown), decimals(abs(shown)) + 1) if np.isfinite(shown) else 0.0
