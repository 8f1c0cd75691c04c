"""The units of one type: the evaluation of each, and of all together."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..common.stream import Floats
from ..model.parameters import PARAMETER_NAMES
from ..session.imu import Verdict, judge
from .blocks import SIZE, Block, blocks, typical_variance
from .causes import steps_of
from .charts import Correlations, ewma_of, scores_of, signals_of
from .forecast import Due, forecast
from .histories_scatter import between, interval
from .population import lot_shifts, outliers, robust
from .results import (
    MONTH_DAYS,
    QUANTILES,
    ChartLimits,
    Charts,
    Forecast,
    LotShift,
    Outlier,
    Population,
    Rules,
    Scatter,
    Sessions,
    Trend,
    UnitHistory,
)
from .scatter import Prior
from .sentences import unit_sentences
from .steps import Places, chance_of, find_steps, step_design
from .trends import Lines, Slopes, fit_lines, quantile, slopes_of


@dataclass(frozen=True, eq=False)
class Judged:
    """The units of a type, and its typical values."""

    units: tuple[UnitHistory, ...]
    prior: Prior
    slopes: Slopes


@dataclass(frozen=True, eq=False)
class _Part:
    """Some units of a type with their results."""

    block: Block
    weights: Floats
    places: Places
    lines: Lines
    scores: Floats


def judge_type(
    units: Sequence[Sequence[int]],
    recorded: Sessions,
    corrected: Sessions,
    prior: Prior,
    limit: Floats,
    rules: Rules,
    chart: ChartLimits,
) -> Judged:
    """Return the evaluation of the sessions of each unit of a type.

    Args:
        units: Rows of each, by date.
        recorded: All sessions.
        corrected: The same, minus the effects of stands.
        prior: Typical scatter of the type.
        limit: (24,) SI units; NaN without one.
        rules: Rules of the evaluation.
        chart: Limits of the charts.
    """
    rows = np.concatenate([np.array(one) for one in units])
    typical = typical_variance(recorded.covariance[rows])
    parts = [
        _part(block.part(which), prior, rules)
        for block in blocks(units, corrected, typical)
        for which in block.parts()
    ]
    slopes = slopes_of(
        np.concatenate([one.lines.coefficients[..., 1] for one in parts]),
        np.concatenate([_slope_variance(one.lines) for one in parts]),
    )
    correlations = Correlations([one.scores for one in parts])
    found = [
        unit
        for part in parts
        for unit in _units(
            part, recorded, corrected, prior, slopes, correlations, limit, rules, chart
        )
    ]
    return Judged(tuple(sorted(found, key=lambda u: u.serial)), prior, slopes)


def _part(block: Block, prior: Prior, rules: Rules) -> _Part:
    variance = block.stated + np.maximum(prior.between, np.finfo(float).tiny)[:, None]
    weights = np.where(np.isfinite(variance), 1 / variance, 0.0)
    places = find_steps(block, weights, prior, rules.false_alarm)
    lines = fit_lines(block, weights, places, prior)
    return _Part(block, weights, places, lines, scores_of(block, prior))


def _slope_variance(lines: Lines) -> Floats:
    """Return the variances (u, 24) of slopes that the units' own scatter determines."""
    return np.where(lines.freedom > _NO_VARIANCE, lines.covariance[..., 1, 1], np.nan)


_NO_VARIANCE = 2
"""Degrees of freedom up to which Student's t has no variance."""


def _units(
    part: _Part,
    recorded: Sessions,
    corrected: Sessions,
    prior: Prior,
    slopes: Slopes,
    correlations: Correlations,
    limit: Floats,
    rules: Rules,
    chart: ChartLimits,
) -> Iterator[UnitHistory]:
    block, lines = part.block, part.lines
    helped = fit_lines(block, part.weights, part.places, prior, slopes)
    due = forecast(block, helped, prior, limit, rules)
    trend = _trends(lines, rules)
    scatter = _scatters(block, part.places, rules)
    ewma = ewma_of(part.scores, rules.smoothing)
    for u, rows in enumerate(block.rows):
        t2, t2_limit, t2_chance = correlations.t2(part.scores[u], rules.false_alarm)
        signals = signals_of(part.scores[u], ewma[u], t2, t2_limit, chart, PARAMETER_NAMES)
        first = int(rows[0])
        values = recorded.values[rows]
        variance = np.diagonal(recorded.covariance[rows], axis1=-2, axis2=-1)
        std = np.sqrt(np.where(variance >= 0, variance, np.nan))
        newest = recorded.date[rows[-1]]
        verdicts = _verdicts(values[-1], std[-1], limit)
        unit = UnitHistory(
            serial=recorded.serial[first],
            imu=recorded.imu[first],
            lot=next((recorded.lot[k] for k in reversed(rows) if recorded.lot[k]), ''),
            key=tuple(recorded.key[k] for k in rows),
            date=recorded.date[rows],
            stand=tuple(recorded.stand[k] for k in rows),
            values=values,
            std=std,
            corrected=corrected.values[rows],
            limit=limit,
            verdict=_worst(verdicts),
            outside=tuple(
                name
                for name, verdict in zip(PARAMETER_NAMES, verdicts, strict=True)
                if verdict is Verdict.FAIL
            ),
            scatter=Scatter(*(one[u] for one in scatter)),
            trend=Trend(*(one[u] for one in trend)),
            forecast=_forecast(due, u, newest, limit, lines),
            steps=steps_of(u, part.places, lines, recorded.date[rows], rules),
            charts=Charts(part.scores[u], ewma[u], t2, t2_limit, t2_chance, signals),
            findings=(),
        )
        yield replace(unit, findings=unit_sentences(unit, rules))


def _trends(lines: Lines, rules: Rules) -> tuple[Any, ...]:
    """Return the fields of `Trend`, (u, 24) each."""
    slope = np.where(lines.known, lines.coefficients[..., 1], np.nan)
    std = np.sqrt(lines.covariance[..., 1, 1])
    reach = quantile(lines.freedom, rules.confidence) * std
    t = np.divide(slope, std, out=np.zeros_like(slope), where=std > 0)
    chance = chance_of(np.nan_to_num(t), lines.freedom)
    level = np.where(lines.known, lines.coefficients[..., 0], np.nan)
    return (
        np.where(np.isfinite(std), slope, np.nan),
        std,
        slope - reach,
        slope + reach,
        np.where(np.isfinite(std), chance, np.nan),
        chance * SIZE < rules.false_alarm,
        level,
        np.sqrt(lines.covariance[..., 0, 0]),
    )


def _scatters(block: Block, places: Places, rules: Rules) -> tuple[Any, ...]:
    """Return the fields of `Scatter`, (u, 24) each."""
    design = block.design
    found = between(design, block.stated, block.values)
    low, high, over = interval(design, block.stated, block.values, rules.confidence)
    freedom = np.isfinite(block.stated).sum(axis=-1) - (1 + (np.ptp(design[..., 1], axis=-1) > 0))
    for (u, p), places_of in places.of.items():
        columns = step_design(block.months[u], places_of)
        own = (columns, block.stated[u, p], block.values[u, p])
        found[u, p] = between(*own)
        low[u, p], high[u, p], over[u, p] = interval(*own, rules.confidence)
        freedom[u, p] = np.isfinite(block.stated[u, p]).sum() - columns.shape[1]
    there = np.isfinite(block.stated)
    stated = np.sum(np.where(there, block.stated, 0.0), axis=-1) / np.maximum(there.sum(-1), 1)
    return (
        np.sqrt(found),
        np.sqrt(low),
        np.sqrt(high),
        np.where(there.any(axis=-1), np.sqrt(stated), np.nan),
        np.maximum(freedom, 0).astype(float),
        over,
    )


def _verdicts(values: Floats, std: Floats, limit: Floats) -> list[Verdict | None]:
    return [
        judge(float(v), float(s), float(one)) if np.isfinite(one) and np.isfinite(v) else None
        for v, s, one in zip(values, std, limit, strict=True)
    ]


def _worst(verdicts: Sequence[Verdict | None]) -> Verdict | None:
    for one in (Verdict.FAIL, Verdict.MARGINAL, Verdict.PASS):
        if one in verdicts:
            return one
    return None


def _forecast(due: Due, u: int, newest: np.datetime64, limit: Floats, lines: Lines) -> Forecast:
    """Return the forecast of one unit, as dates."""
    day = newest.astype('datetime64[D]')
    determined = np.isfinite(limit) & ~np.isnan(due.earliest[u])
    reason = ''
    if not np.isfinite(limit).any():
        reason = 'No specification is known: when it is due cannot be computed.'
    elif not determined.any():
        reason = (
            'Neither its sessions nor the units of its type are enough to estimate its drift: '
            'when it is due cannot be computed.'
        )
    elif not np.isfinite(due.unit[u]):
        reason = 'By its trend and scatter it stays within its specification beyond the horizon.'
    none = bool(reason)
    return Forecast(
        limit=limit,
        leaves=_dates(day, due.leaves[u]),
        earliest=_dates(day, due.earliest[u]),
        recalibrate=np.datetime64('NaT', 'D') if none else _dates(day, due.unit[u : u + 1])[0],
        parameter='' if none else PARAMETER_NAMES[int(due.worst[u])],
        borrowed=bool(np.any(determined & ~(lines.known[u] & (lines.freedom[u] > 0)))),
        reason=reason,
    )


def _dates(day: np.datetime64, months: Floats) -> np.ndarray[tuple[int], np.dtype[np.datetime64]]:
    """Return dates some months later; NaT if they are not finite."""
    some = np.isfinite(months)
    days = np.floor(np.where(some, months, 0.0) * MONTH_DAYS).astype(np.int64)
    return np.where(some, day + days.astype('timedelta64[D]'), np.datetime64('NaT', 'D'))


def population_of(imu: str, judged: Judged, false_alarm: float) -> Population:
    """Return the evaluation of the units of a type together.

    Args:
        imu: Type.
        judged: Its units.
        false_alarm: Probability that any unit is called an outlier, or any lot different, without
            cause.
    """
    units = judged.units
    newest = np.array([_newest(unit.corrected) for unit in units])
    median, deviation = robust(newest)
    count = np.isfinite(newest).sum(axis=0)
    apart: list[Outlier] = []
    lots: list[LotShift] = []
    tests = SIZE * max(1, len({unit.lot for unit in units if unit.lot}))
    for p, name in enumerate(PARAMETER_NAMES):
        some = np.flatnonzero(np.isfinite(newest[:, p]))
        values = newest[some, p]
        far = outliers(values, false_alarm / SIZE)
        scale = deviation[p] if deviation[p] > 0 else np.nan
        apart += [
            Outlier(
                units[some[k]].serial,
                name,
                float(values[k]),
                float((values[k] - median[p]) / scale),
            )
            for k in far
        ]
        inside = np.delete(some, far)
        lots += [
            LotShift(lot, name, n, shift, std, min(1.0, chance * tests))
            for lot, n, shift, std, chance in lot_shifts(
                newest[inside, p], [units[k].lot for k in inside]
            )
            if chance * tests < false_alarm
        ]
    some_values = np.where(count > 0, newest, 0.0)
    unknown = np.where(count > 0, 0.0, np.nan)
    spread = np.sqrt(
        np.nansum((newest - np.nanmean(some_values, axis=0)) ** 2, axis=0)
        / np.maximum(count - 1, 1)
    )
    return Population(
        imu=imu,
        units=len(units),
        sessions=sum(len(unit.date) for unit in units),
        count=count,
        mean=np.nanmean(some_values, axis=0) + unknown,
        std=np.where(count > 1, spread, np.nan),
        median=median,
        robust_std=deviation,
        quantiles=np.nanquantile(some_values, QUANTILES, axis=0) + unknown,
        turn_on=_turn_on(units, judged.prior),
        trend=judged.slopes.mean,
        trend_std=np.sqrt(judged.slopes.variance),
        outside=np.array([sum(name in unit.outside for unit in units) for name in PARAMETER_NAMES]),
        outliers=tuple(apart),
        lots=tuple(lots),
    )


def _newest(values: Floats) -> Floats:
    """Return the newest value of each parameter, (24,); NaN without one."""
    there = np.isfinite(values)
    last = len(values) - 1 - np.argmax(there[::-1], axis=0)
    return np.asarray(np.where(there.any(axis=0), values[last, np.arange(SIZE)], np.nan))


def _turn_on(units: Sequence[UnitHistory], prior: Prior) -> Floats:
    """Return the typical standard deviation between sessions; NaN if no unit determines it."""
    determined = np.any([np.isfinite(unit.scatter.std) for unit in units], axis=0)
    return np.where(determined, np.sqrt(prior.between), np.nan)
