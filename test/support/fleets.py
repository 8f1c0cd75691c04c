"""Catalogues of many units that nobody calibrated: written with pyarrow, with known troubles.

Of every hundred units two drift, one steps at its newest session, of two the newest recording
failed; one stand shifts the accelerometers' scale factors. What a page is told of their histories
is worked out here in the simplest way: a large catalogue is there at once, and what is on the page
is known.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from imu_calib.common.units import ARCMIN, DEG_H, MICRO_G, PPM
from imu_calib.fleet.catalogue import schema
from imu_calib.fleet.page_contents import Fleet, Recordings
from imu_calib.fleet.results import (
    Cause,
    Chart,
    ChartLimits,
    Charts,
    Forecast,
    History,
    Outlier,
    Population,
    Rules,
    Scatter,
    Signal,
    Stands,
    StandShift,
    Step,
    Trend,
    UnitHistory,
)
from imu_calib.model.parameters import PARAMETER_NAMES, PARAMETERS, ParameterKind
from imu_calib.session.imu import Verdict, judge

TODAY = np.datetime64('2026-11-22', 's')
TYPES = ('fog_medium', 'mems_counts', 'stim300')
STANDS = ('east', 'west', 'north')
OFF = 'west'
SHIFT = 5 * PPM
"""Of the scale factors of the accelerometers, on the stand that is off."""
MONTH = 30.4375 * 86400

_UNIT = {
    (ParameterKind.SCALE_FACTOR_ERROR, 'g'): (300 * PPM, 3 * PPM, 1500 * PPM),
    (ParameterKind.SCALE_FACTOR_ERROR, 'a'): (300 * PPM, 2 * PPM, 1500 * PPM),
    (ParameterKind.MISALIGNMENT, 'g'): (1 * ARCMIN, 0.01 * ARCMIN, 6 * ARCMIN),
    (ParameterKind.MISALIGNMENT, 'a'): (1 * ARCMIN, 0.01 * ARCMIN, 6 * ARCMIN),
    (ParameterKind.BIAS, 'g'): (0.3 * DEG_H, 0.02 * DEG_H, 1.5 * DEG_H),
    (ParameterKind.BIAS, 'a'): (200 * MICRO_G, 2 * MICRO_G, 1000 * MICRO_G),
}
"""Standard deviation between units, of a session, and the limit."""
SPREAD, STD, LIMIT = np.array([_UNIT[p.kind, p.triad] for p in PARAMETERS]).T


@dataclass(frozen=True, eq=False)
class Invented:
    """Rows of a catalogue and what is wrong with whom, by serial number."""

    rows: dict[str, Any]
    values: np.ndarray
    covariance: np.ndarray
    drifting: frozenset[str]
    stepping: frozenset[str]
    failing: frozenset[str]
    unit: np.ndarray = field(repr=False)


def serial(k: int) -> str:
    return f'A{1000 + k}'


def lot_of_unit(k: int, units: int) -> str:
    return f'{23 + 4 * k // units}'


def invented(units: int, sessions: int = 6, seed: int = 1) -> Invented:
    """Calibrations of units, every half year, some of them with one failed recording more."""
    rng = np.random.default_rng(seed)
    n = units * sessions
    unit, turn = np.divmod(np.arange(n), sessions)
    ages = (turn - sessions + 1) * 6 * MONTH - rng.uniform(0, 6 * MONTH, units)[unit]
    stand = rng.integers(0, len(STANDS), n)
    values = (SPREAD * rng.normal(size=(units, 24)))[unit] + STD * rng.normal(size=(n, 24))
    where = np.arange(units)
    drifting, stepping, failing = where % 50 == 7, where % 100 == 23, where % 50 == 31
    values[:, 0] += drifting[unit] * 4 * PPM * ages / MONTH
    values[:, 21] += stepping[unit] * (turn == sessions - 1) * 40 * MICRO_G
    of_scale = [k for k, p in enumerate(PARAMETERS) if p.name.startswith('K_a')]
    values[np.ix_(stand == STANDS.index(OFF), of_scale)] += SHIFT
    date = TODAY + ages.astype('m8[s]')
    numbers = [serial(k) for k in unit]
    verdicts = [_verdict(v).value for v in values]
    rows: dict[str, Any] = {
        'key': [f'{k:032x}' for k in range(n)],
        'recording': [f'recordings/{date[k]!s:.10}/rec_{k:06d}.mcap' for k in range(n)],
        'status': ['calibrated'] * n,
        'error': [''] * n,
        'serial': numbers,
        'lot': [lot_of_unit(k, units) for k in unit],
        'imu': [TYPES[k % len(TYPES)] for k in unit],
        'stand': [STANDS[k] for k in stand],
        'exit_code': [0] * n,
        'date': list(date),
        'verdict': verdicts,
        'findings': [
            ['The table was tilted by 3 arcsec.'] if k % 40 == 0 else [] for k in range(n)
        ],
        'calibration': [
            f'calibrations/{TYPES[u % len(TYPES)]}/{serial(u)}/'
            f'{str(date[k]).replace(":", "")}Z_{k:08x}.yaml'
            for k, u in enumerate(unit)
        ],
    }
    for k in np.flatnonzero(failing):
        _add_failed(
            rows,
            n + int(k),
            serial(int(k)),
            TYPES[k % len(TYPES)],
            TODAY - np.timedelta64(3600, 's'),
        )
    names = [frozenset(serial(int(k)) for k in np.flatnonzero(some))
             for some in (drifting, stepping, failing)]  # fmt: skip
    covariance = np.broadcast_to(np.diag(STD**2), (n, 24, 24))
    return Invented(rows, values, covariance, *names, unit=unit)


def _add_failed(
    rows: dict[str, Any], number: int, unit: str, imu: str, date: np.datetime64
) -> None:
    """Add a recording that gave no calibration."""
    path = f'recordings/rec_{number:06d}.mcap'
    more = {
        'key': f'{number:032x}',
        'recording': path,
        'status': 'failed',
        'error': f'{path}: the recording ends after 3 of 12 positions.',
        'serial': unit,
        'lot': None,
        'imu': imu,
        'stand': STANDS[0],
        'exit_code': 1,
        'date': date,
        'verdict': None,
        'findings': None,
        'calibration': None,
    }
    for name, value in more.items():
        rows[name].append(value)


def _verdict(values: np.ndarray) -> Verdict:
    found = {judge(v, s, m) for v, s, m in zip(values, STD, LIMIT, strict=True)}
    return next(v for v in (Verdict.FAIL, Verdict.MARGINAL, Verdict.PASS) if v in found)


def write(folder: Path, made: Invented) -> Path:
    """Write a catalogue as a batch would have, without the calibrations' files."""
    (folder / 'rows').mkdir(parents=True)
    count, known = len(made.rows['key']), len(made.values)
    columns: dict[str, Any] = {}
    for name in schema().names:
        column = made.rows.get(name)
        columns[name] = pa.nulls(count, schema().field(name).type) if column is None else column
    lost = np.full((count - known, 24), np.nan)
    for k, name in enumerate(PARAMETER_NAMES):
        columns[name] = np.concatenate([made.values[:, k], lost[:, k]])
        columns[f'std_{name}'] = np.concatenate([np.full(known, STD[k]), lost[:, k]])
    offsets = np.minimum(np.arange(count + 1), known)
    for name, each in (
        ('parameters', np.tile(PARAMETER_NAMES, known)),
        ('values', made.values.ravel()),
        ('covariance', made.covariance.ravel()),
        ('limits', np.tile(LIMIT, known)),
    ):
        size = len(each) // max(known, 1)
        columns[name] = pa.ListArray.from_arrays(pa.array(offsets * size, pa.int32()), each)
    pq.write_table(pa.table(columns).cast(schema()), folder / 'rows' / 'part-000000.parquet')
    return folder


def history(made: Invented) -> History:
    """What a page is told of them, by straight lines through all but the newest session."""
    numbers, dates = np.array(made.rows['serial']), np.array(made.rows['date'], 'M8[s]')
    known = len(made.values)
    order = np.arange(known).reshape(made.unit[-1] + 1, -1)
    units = tuple(
        _unit(made, numbers[rows[0]], dates[rows], rows, made.rows['stand']) for rows in order
    )
    populations = {imu: _population(imu, [u for u in units if u.imu == imu]) for imu in TYPES}
    limits = ChartLimits(individuals=4.1, ewma=1.4, parameter_run=24000.0, unit_run=1000.0)
    return History(Rules(), limits, units, populations, _stands(made))


def _unit(
    made: Invented, number: str, dates: np.ndarray, rows: np.ndarray, stands: list[str]
) -> UnitHistory:
    values, n = made.values[rows], len(rows)
    months = (dates - dates[-1]).astype(float) / MONTH
    centred = months - months.mean()
    information = max(float(centred @ centred), 1e-9)
    slope, slope_std = centred @ values / information, STD / np.sqrt(information)
    drifts = number in made.drifting
    significant = np.array([drifts and k == 0 for k in range(24)])
    level = values.mean(axis=0) - slope * months.mean()
    leaves = np.full(24, np.datetime64('NaT', 's'))
    due = dates[-1] + np.timedelta64(int(12 * MONTH), 's')
    if drifts:
        away = np.clip((np.sign(slope[0]) * LIMIT[0] - level[0]) / slope[0], 0, 100)
        leaves[0] = dates[-1] + np.timedelta64(int(away * MONTH), 's')
        due = min(due, leaves[0])
    score = np.vstack([np.full((min(n, 2), 24), np.nan), (np.diff(values, axis=0) / STD / 1.5)[1:]])
    smooth = np.full_like(score, np.nan)
    for k in range(2, n):
        smooth[k] = 0.2 * score[k] + 0.8 * np.nan_to_num(smooth[k - 1])
    steps, signals = [], []
    if number in made.stepping:
        size = np.array([40 * MICRO_G])
        low, high, none = size - 2 * STD[21], size + 2 * STD[21], np.full(3, np.nan)
        steps = [Step(n - 1, dates[-2], dates[-1], (PARAMETER_NAMES[21],), size, STD[[21]],
                      low, high, Cause.UNIT, none)]  # fmt: skip
        signals = [Signal(Chart.INDIVIDUALS, n - 1, PARAMETER_NAMES[21], 11.3, 4.1)]
    last = values[-1]
    outside = tuple(p for p, v, s, m in zip(PARAMETER_NAMES, last, STD, LIMIT, strict=True)
                    if judge(v, s, m) is Verdict.FAIL)  # fmt: skip
    some = np.full(24, 1.0)
    at = [stands[k] for k in rows]
    shift = np.array([[SHIFT if s == OFF and p.startswith('K_a') else 0.0 for p in PARAMETER_NAMES]
                      for s in at])  # fmt: skip
    spread = values.std(axis=0, ddof=1) if n > 1 else np.full(24, np.nan)
    return UnitHistory(
        serial=number,
        imu=TYPES[made.unit[rows[0]] % len(TYPES)],
        lot=lot_of_unit(made.unit[rows[0]], made.unit[-1] + 1),
        key=tuple(made.rows['key'][k] for k in rows),
        date=dates,
        stand=tuple(at),
        values=values,
        std=np.tile(STD, (n, 1)),
        corrected=values - shift,
        limit=LIMIT,
        verdict=_verdict(last),
        outside=outside,
        scatter=Scatter(spread, 0.7 * spread, 1.8 * spread, STD, (n - 1) * some, some > 2),
        trend=Trend(level, STD / np.sqrt(n), slope, slope_std, slope - 2 * slope_std,
                    slope + 2 * slope_std, some, significant, np.full(24, np.nan)),
        forecast=Forecast(LIMIT, leaves, leaves, due, 'K_gx' if drifts else 'D_gy', False, ''),
        steps=tuple(steps),
        charts=Charts(score, smooth, np.nansum(score**2, axis=1), np.full(n, 55.0), np.full(n, 0.5),
                      tuple(signals)),
        findings=('It drifts.',) if drifts else (),
    )  # fmt: skip


def _population(imu: str, units: list[UnitHistory]) -> Population:
    last = np.array([u.values[-1] for u in units])
    median = np.median(last, axis=0)
    robust = 1.4826 * np.median(np.abs(last - median), axis=0)
    score = (last - median) / np.where(robust > 0, robust, 1)
    outliers = tuple(
        Outlier(units[u].serial, PARAMETER_NAMES[k], float(last[u, k]), float(score[u, k]))
        for u, k in np.argwhere(np.abs(score) > 4.5)
    )
    outside = np.array([sum(p in u.outside for u in units) for p in PARAMETER_NAMES])
    return Population(
        imu, len(units), sum(len(u.key) for u in units), np.full(24, len(units)), last.mean(axis=0),
        last.std(axis=0), median, robust, np.quantile(last, (0.05, 0.25, 0.5, 0.75, 0.95), axis=0),
        STD * 1.1, np.zeros(24), 0.1 * STD, outside, outliers, (),
    )  # fmt: skip


def _stands(made: Invented) -> Stands:
    counts = np.array([made.rows['stand'].count(s) for s in STANDS])
    shift = StandShift(
        OFF, tuple(s for s in STANDS if s != OFF), True, 'K_a', ('K_ax', 'K_ay', 'K_az'), '1',
        SHIFT, 0.2 * PPM, SHIFT - 0.6 * PPM, SHIFT + 0.6 * PPM, 1e-9, int(counts[1]),
    )  # fmt: skip
    none = np.zeros((len(STANDS), 24))
    return Stands(STANDS, counts, counts, (STANDS,), none, none + STD, STD, (shift,), ())


def fleet(made: Invented) -> Fleet:
    """What a page on them is written from."""
    rows, lost = made.rows, np.full((len(made.rows['key']) - len(made.values), 24), np.nan)
    recordings = Recordings(
        key=rows['key'],
        recording=rows['recording'],
        imu=rows['imu'],
        serial=rows['serial'],
        stand=rows['stand'],
        date=np.array(rows['date'], 'M8[s]'),
        calibrated=np.array([one == 'calibrated' for one in rows['status']]),
        error=rows['error'],
        verdict=[one or '' for one in rows['verdict']],
        simulated=[False] * len(rows['key']),
        values=np.vstack([made.values, lost]),
        std=np.vstack([np.tile(STD, (len(made.values), 1)), lost]),
        findings=[one or [] for one in rows['findings']],
        calibration=[one or '' for one in rows['calibration']],
        report=[''] * len(rows['key']),
    )
    return Fleet('laboratory', recordings, history(made), TODAY)
