"""Data for the page's script: units for the table, sessions for the drawings."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from ..common.stream import Floats
from ..model.parameters import PARAMETERS
from ..reports.tables import decimals, engineering
from . import packed
from .formats import PLACE_OF, day, unit_of
from .page_contents import Flag, Fleet, Unit
from .results import UnitHistory

_NUMBER = len(PARAMETERS)
_NONE = np.full(_NUMBER, np.nan)


def units_data(fleet: Fleet) -> str:
    """Return the data of the table of units."""
    units, rows = fleet.units, fleet.recordings
    newest = [_newest_row(fleet, unit) for unit in units]
    histories = [unit.history for unit in units]
    imus, imu = packed.distinct([unit.imu for unit in units])
    lots, lot = packed.distinct([h.lot if h is not None else '' for h in histories])
    stands, stand = packed.distinct([rows.stand[k] if k >= 0 else '' for k in newest])
    verdicts, verdict = packed.distinct([_verdict(fleet, unit) for unit in units])
    none = np.datetime64('NaT', 's')
    last = np.array([rows.date[k] if k >= 0 else none for k in newest], 'M8[s]')
    due = [h.forecast.recalibrate if h is not None else none for h in histories]
    places = {flag: k for k, flag in enumerate(Flag)}
    arrays: dict[str, NDArray[np.generic]] = {
        'imu': imu,
        'lot': lot,
        'stand': stand,
        'verdict': verdict,
        'last': packed.minutes(last),
        'due': packed.minutes(np.array(due, 'M8[s]')),
        'because': np.array([_because(h) for h in histories], np.int8),
        'sessions': np.array([len(u.sessions) for u in units], np.int32),
        'failed': np.array([len(u.failed) for u in units], np.int32),
        'rows': np.array([len(u.rows) for u in units], np.int32),
        'bitmask': np.array([sum(1 << places[f] for f in u.flags) for u in units], np.int32),
    }
    texts = {
        'serials': [unit.serial for unit in units],
        'imus': imus,
        'lots': lots,
        'stands': stands,
        'verdicts': verdicts,
        'flags': [[f.name, f.value.words, f.value.kind, f.value.meaning] for f in Flag],
        'parameters': [
            [
                p.name,
                p.kind.value.words,
                unit_of(p),
                engineering(p).scale,
            ]
            for p in PARAMETERS
        ],
        'today': day(fleet.today),
    }
    return packed.pack(arrays, texts)


def sessions_data(fleet: Fleet) -> str:
    """Return the data of the units' details: sessions by unit, failed recordings likewise."""
    rows, units = fleet.recordings, fleet.units
    chosen = [k for unit in units for k in unit.rows]
    sessions = [k for unit in units for k in unit.sessions]
    stands, stand = packed.distinct([rows.stand[k] for k in chosen])
    errors, error = packed.distinct([rows.error[k] for k in chosen])
    remarks, remark = packed.distinct(['\n'.join(rows.findings[k]) for k in chosen])
    verdicts, verdict = packed.distinct([rows.verdict[k] for k in chosen])
    values, std = rows.values[sessions], rows.std[sessions]
    differences, steps = packed.packed_differences(values, std)
    codes, scales = packed.deviations(std)
    shift = _of_sessions(units, lambda h: h.values - h.corrected)
    arrays: dict[str, NDArray[np.generic]] = {
        'date': packed.minutes(rows.date[chosen]),
        'stand': stand,
        'error': error,
        'remark': remark,
        'verdict': verdict,
        'fine': rows.calibrated[chosen].astype(np.uint8),
        'value': differences,
        'known': np.isfinite(values).T.astype(np.uint8),
        'std': codes,
        'shift': packed.short(np.nan_to_num(shift).T),
        'score': packed.scores(_of_sessions(units, lambda h: h.charts.score)).T,
        'ewma': packed.scores(_of_sessions(units, lambda h: h.charts.ewma)).T,
        't2': packed.short(_of_sessions(units, lambda h: h.charts.t2[:, None], 1)),
        't2_limit': packed.short(_of_sessions(units, lambda h: h.charts.t2_limit[:, None], 1)),
        'slope': _of_units(units, lambda h: h.trend.slope),
        'slope_std': _of_units(units, lambda h: h.trend.std),
        'level': _of_units(units, lambda h: h.trend.level),
        'scatter': _of_units(units, lambda h: h.scatter.std),
        'limit': _of_units(units, lambda h: h.limit),
        'leaves': packed.minutes(
            np.array([h.forecast.leaves if h else [_NO_DATE] * _NUMBER for h in _histories(units)])
            .astype('M8[s]')
            .T
        ),
        'significant': np.array(
            [
                h.trend.significant if h is not None else np.zeros(_NUMBER, bool)
                for h in _histories(units)
            ]
        )
        .reshape(-1, _NUMBER)
        .T.astype(np.uint8),
    }
    limits = fleet.history.limits
    texts = {
        'calibrated': len(sessions),
        'recordings': [rows.recording[k] for k in chosen],
        'calibrations': [rows.calibration[k] for k in chosen],
        'reports': [rows.report[k] for k in chosen],
        'stands': stands,
        'errors': errors,
        'remarks': remarks,
        'verdicts': verdicts,
        'valueSteps': steps,
        'stdScales': scales,
        'scoreStep': packed.STEP,
        'individualsLimit': limits.individuals,
        'ewmaLimit': limits.ewma,
        'findings': [list(h.findings) if h is not None else [] for h in _histories(units)],
        'reasons': [h.forecast.reason if h is not None else '' for h in _histories(units)],
        'steps': [_steps(unit) for unit in units],
    }
    return packed.pack(arrays, texts)


_NO_DATE = np.datetime64('NaT', 's')


def _histories(units: Sequence[Unit]) -> list[UnitHistory | None]:
    return [unit.history for unit in units]


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


def _of_sessions(
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


def _of_units(units: Sequence[Unit], what: Callable[[UnitHistory], Floats]) -> NDArray[np.float32]:
    """Return (24, m) values of all units."""
    rows = [_NONE if u.history is None else what(u.history) for u in units]
    return packed.short(np.reshape(np.array(rows, np.float64), (-1, _NUMBER)).T)


def _steps(unit: Unit) -> list[list[object]]:
    """Return the steps of a unit: [index of the session after it, looks like, sizes as shown]."""
    found: list[list[object]] = []
    before = len(unit.sessions) - _sessions_in_history(unit)
    for step in unit.history.steps if unit.history is not None else ():
        sizes = [
            [name, _shown(name, size), _shown(name, std)]
            for name, size, std in zip(step.parameters, step.size, step.std, strict=True)
        ]
        found.append([before + step.index, step.cause.value, sizes])
    return found


def _shown(name: str, value: float) -> float:
    parameter = PARAMETERS[PLACE_OF[name]]
    shown = value / engineering(parameter).scale
    return round(float(shown), decimals(abs(shown)) + 1) if np.isfinite(shown) else 0.0
