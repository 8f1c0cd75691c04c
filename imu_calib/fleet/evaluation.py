"""The units of one type: the evaluation of each, and of all together."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from ..common.stream import Floats
from ..common.units import MONTH_DAYS
from ..model.parameters import PARAMETER_NAMES, PARAMETERS, ParameterKind
from ..session.imu import Verdict, judge
from .control_charts import (
    SIZE,
    Block,
    Correlations,
    StepPlaces,
    blocks,
    chance_of,
    chart_limits,
    ewma_of,
    find_steps,
    sample,
    scores_of,
    signals_of,
    stated_variance,
    step_design,
    typical_variance,
    units_of,
)
from .results import (
    QUANTILES,
    USUAL,
    Cause,
    ChartLimits,
    Charts,
    Dates,
    Forecast,
    History,
    LotShift,
    Outlier,
    Population,
    Rules,
    Scatter,
    Sessions,
    Stands,
    Step,
    Trend,
    UnitHistory,
)
from .scatter import Prior, between, interval, lot_shifts, outliers, prior_of, robust
from .sentences import listed, off_stand_sentence, stand_sentence, unit_sentences
from .stands import corrections, judge_stands, turned
from .trends import Due, Lines, Slopes, fit_lines, forecast, quantile, slopes_of

# Source: docs/history.md, 'Steps'; the rotation as in docs/mathematics.md, 'Free of frame'.

_TURNS = np.column_stack([turned(axis) for axis in range(3)])
"""(24, 3) changes of the parameters by rotations about X, Y and Z."""
_LEAST = 2
"""Fewest misalignments that step together in a rotation about one axis: those of one triad."""


def steps_of(
    unit: int, places: StepPlaces, lines: Lines, date: Dates, values: Floats, rules: Rules
) -> tuple[Step, ...]:
    """Return the steps of the unit at an index of a block, with dates (n,) of its sessions.

    Parameters that step at the same session are combined. Steps to one session and back, by the
    values (n, 24), are of that session.
    """
    found: list[Step] = []
    for place, parameters in places.of_unit(unit).items():
        size, std, reach = (np.zeros(len(parameters)) for _ in range(3))
        for k, p in enumerate(parameters):
            which = places.by_parameter[unit, p].index(place)
            sizes, deviations = lines.steps[unit, p]
            size[k], std[k] = sizes[which], deviations[which]
            freedom = np.array(lines.freedom[unit, p])
            reach[k] = float(quantile(freedom, rules.confidence)) * std[k]
        cause, rotation = _cause(parameters, size, std, rules)
        found.append(
            Step(
                index=place,
                after=date[place - 1],
                before=date[place],
                parameters=tuple(PARAMETER_NAMES[p] for p in parameters),
                size=size,
                std=std,
                low=size - reach,
                high=size + reach,
                cause=cause,
                rotation=rotation,
            )
        )
    for k, (to, back) in enumerate(itertools.pairwise(found)):
        both = [PARAMETER_NAMES.index(name) for name in {*to.parameters, *back.parameters}]
        if back.index == to.index + 1 and found[k].cause is not Cause.RETURN:
            before, at, after = values[to.index - 1 : to.index + 2, both]
            if (np.abs(after - before) < np.abs(at - (before + after) / 2)).all():
                unknown = np.full(3, np.nan)
                found[k] = replace(to, cause=Cause.OUTLIER, rotation=unknown)
                found[k + 1] = replace(back, cause=Cause.RETURN, rotation=unknown)
    return tuple(found)


def _cause(parameters: list[int], size: Floats, std: Floats, rules: Rules) -> tuple[Cause, Floats]:
    """Return the cause of a step, and the rotation of a mount.

    A rotation has three numbers. If it explains the steps of the misalignments of both triads, and
    no other parameter steps, the cause is a mount shift.
    """
    unknown = np.full(3, np.nan)
    kinds = {PARAMETERS[p].kind for p in parameters}
    triads = {PARAMETERS[p].triad for p in parameters}
    if kinds != {ParameterKind.MISALIGNMENT} or len(triads) < _LEAST or not np.all(std > 0):
        return Cause.UNIT, unknown
    weighted = _TURNS[parameters] / std[:, None]
    moved = np.any(weighted != 0, axis=0)
    rotation = np.zeros(3)
    rotation[moved] = np.linalg.lstsq(weighted[:, moved], size / std, rcond=None)[0]
    square = float(np.sum((size / std - weighted @ rotation) ** 2))
    freedom = len(parameters) - int(np.linalg.matrix_rank(weighted))
    if freedom < 1 or scipy.special.chdtrc(freedom, square) < rules.false_alarm:
        return Cause.UNIT, unknown
    return Cause.MOUNT, rotation


@dataclass(frozen=True, eq=False)
class Judged:
    """The units of a type, and its typical values."""

    units: tuple[UnitHistory, ...]
    prior: Prior
    slopes: Slopes


@dataclass(frozen=True, eq=False)
class FittedUnits:
    """Some units of a type with their results."""

    block: Block
    weights: Floats
    places: StepPlaces
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
        _fitted(block.part(which), prior, rules)
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


def _fitted(block: Block, prior: Prior, rules: Rules) -> FittedUnits:
    variance = block.stated + np.maximum(prior.between, np.finfo(float).tiny)[:, None]
    weights = np.where(np.isfinite(variance), 1 / variance, 0.0)
    places = find_steps(block, weights, prior, rules.false_alarm)
    lines = fit_lines(block, weights, places, prior)
    return FittedUnits(block, weights, places, lines, scores_of(block, prior))


def _slope_variance(lines: Lines) -> Floats:
    """Return the variances (u, 24) of slopes that the units' own scatter determines."""
    return np.where(lines.freedom > _NO_VARIANCE, lines.covariance[..., 1, 1], np.nan)


_NO_VARIANCE = 2  #: Degrees of freedom up to which Student's t has no variance.


def _units(
    part: FittedUnits,
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
            trend=Trend(*(one[u] for one in (*trend, part.places.least))),
            forecast=_forecast(
                due, u, newest, limit, lines, outside=_worst(verdicts) is Verdict.FAIL
            ),
            steps=steps_of(
                u, part.places, lines, recorded.date[rows], corrected.values[rows], rules
            ),
            charts=Charts(part.scores[u], ewma[u], t2, t2_limit, t2_chance, signals),
            findings=(),
            by_hand=recorded.imu[first] in recorded.by_hand,
        )
        yield replace(unit, findings=unit_sentences(unit, rules))


def _trends(lines: Lines, rules: Rules) -> tuple[Any, ...]:
    """Return the fields of `Trend`, (u, 24) each."""
    slope = np.where(lines.known, lines.coefficients[..., 1], np.nan)
    std = np.sqrt(lines.covariance[..., 1, 1])
    reach = quantile(lines.freedom, rules.confidence) * std
    t = np.divide(slope, std, out=np.zeros_like(slope), where=std > 0)
    chance = chance_of(np.nan_to_num(t), lines.freedom)
    return (
        np.where(lines.known, lines.coefficients[..., 0], np.nan),
        np.sqrt(lines.covariance[..., 0, 0]),
        np.where(np.isfinite(std), slope, np.nan),
        std,
        slope - reach,
        slope + reach,
        np.where(np.isfinite(std), chance, np.nan),
        chance * SIZE < rules.false_alarm,
    )


def _scatters(block: Block, places: StepPlaces, rules: Rules) -> tuple[Any, ...]:
    """Return the fields of `Scatter`, (u, 24) each."""
    design = block.design
    found = between(design, block.stated, block.values)
    low, high, over = interval(design, block.stated, block.values, rules.confidence)
    freedom = np.isfinite(block.stated).sum(axis=-1) - (1 + (np.ptp(design[..., 1], axis=-1) > 0))
    for (u, p), places_of in places.by_parameter.items():
        columns = step_design(block.months[u], places_of)
        own = (columns, block.stated[u, p], block.values[u, p])
        found[u, p] = between(*own)
        low[u, p], high[u, p], over[u, p] = interval(*own, rules.confidence)
        freedom[u, p] = np.isfinite(block.stated[u, p]).sum() - columns.shape[1]
    known = np.isfinite(block.stated).any(axis=-1)
    return (
        np.sqrt(found),
        np.sqrt(low),
        np.sqrt(high),
        np.where(known, np.sqrt(block.mean_stated), np.nan),
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


def _forecast(
    due: Due, u: int, newest: np.datetime64, limit: Floats, lines: Lines, *, outside: bool
) -> Forecast:
    """Return the forecast of one unit, as dates; one that is outside needs none."""
    day = newest.astype('datetime64[D]')
    determined = np.isfinite(limit) & ~np.isnan(due.earliest[u])
    reason = ''
    if outside:
        reason = 'It is outside its specification already.'
    elif not np.isfinite(limit).any():
        reason = 'Its type has no specification: the date when it is due cannot be computed.'
    elif not determined.any():
        reason = (
            'It and its type have too few sessions, or those of less than a month, to estimate the '
            'drift: the date when it is due cannot be computed.'
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

    A false alarm calls any unit an outlier, or any lot different, without cause.
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
        by_hand=any(unit.by_hand for unit in units),
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


def backtest(sessions: Sessions, limits: Mapping[str, Floats], rules: Rules = USUAL) -> History:
    """Return the history of units, types and stands from their sessions.

    Args:
        sessions: Of all units, in any order. Those without a date, a serial number or a value do
            not count; a sentence states their number.
        limits: (24,) largest amounts of each type, SI units; NaN without one. Types without limits
            have no forecast.
        rules: Rules of the evaluation.
    """
    dropped, rows = _sound(sessions)
    units = units_of(rows, sessions)
    by_type: dict[str, list[list[int]]] = {}
    for (imu, _), mine in units.items():
        by_type.setdefault(imu, []).append(mine)
    priors = {imu: _prior(mine, sessions) for imu, mine in by_type.items()}
    stands = _stands(sessions, by_type, priors, rules)
    corrected = replace(sessions, values=sessions.values - corrections(stands, sessions.stand))
    chart = chart_limits(rules)
    none = np.full(len(PARAMETERS), np.nan)
    judged: dict[str, Judged] = {}
    for imu, own in by_type.items():
        prior = _prior(own, corrected) if stands.shifts else priors[imu]
        limit = limits.get(imu, none)
        judged[imu] = judge_type(own, sessions, corrected, prior, limit, rules, chart)
        named = tuple(_with_stand(unit, stands) for unit in judged[imu].units)
        judged[imu] = replace(judged[imu], units=named)
    families = max(1, len(by_type))
    return History(
        rules=rules,
        limits=chart,
        units=tuple(unit for one in judged.values() for unit in one.units),
        populations={
            imu: population_of(imu, one, rules.false_alarm / families)
            for imu, one in judged.items()
        },
        stands=stands,
        findings=(
            *(stand_sentence(one) for one in stands.shifts),
            *stands.findings,
            *dropped,
            *_shared_serials(units),
            *_missing_limits(by_type, limits),
            *_missing_deviations(by_type, sessions),
        ),
    )


def _with_stand(unit: UnitHistory, stands: Stands) -> UnitHistory:
    """Return a unit that says so if its newest calibration is from a stand that is off."""
    if unit.stand[-1] not in stands.off:
        return unit
    return replace(unit, findings=(off_stand_sentence(unit.stand[-1]), *unit.findings))


def _sound(sessions: Sessions) -> tuple[list[str], list[int]]:
    """Return sentences on sessions that do not count, and the rows of those that do."""
    dated = ~np.isnat(sessions.date)
    numbered = np.array([bool(serial) for serial in sessions.serial], dtype=bool)
    estimated = np.isfinite(sessions.values).any(axis=1)
    reasons = (
        (~numbered, 'no serial number. State it in the manifest'),
        (numbered & ~dated, 'no date. State it in the manifest'),
        (numbered & dated & ~estimated, 'no estimated parameter'),
    )
    sentences = [
        f'{int(which.sum())} of {len(which)} sessions are ignored: they have {why}.'
        for which, why in reasons
        if which.any()
    ]
    return sentences, np.flatnonzero(dated & numbered & estimated).tolist()


def _prior(units: list[list[int]], sessions: Sessions) -> Prior:
    rows = np.concatenate([np.array(rows) for rows in units])
    some = sample(units, sessions, typical_variance(sessions.covariance[rows]))
    return prior_of(some.design, some.stated, some.values)


def _stands(
    sessions: Sessions,
    by_type: Mapping[str, list[list[int]]],
    priors: Mapping[str, Prior],
    rules: Rules,
) -> Stands:
    """Compare the stands of all types: the effect of a stand is the same on each unit."""
    rows: list[NDArray[np.int64]] = []
    numbers: list[NDArray[np.int64]] = []
    variance: list[Floats] = []
    kinds: list[NDArray[np.int64]] = []
    for kind, (imu, units) in enumerate(by_type.items()):
        for unit in units:
            own = np.array(unit)
            rows.append(own)
            numbers.append(np.full(len(own), len(numbers)))
            kinds.append(np.full(len(own), kind))
        mine = np.concatenate(rows[len(rows) - len(units) :])
        typical = typical_variance(sessions.covariance[mine])
        stated = stated_variance(sessions.covariance[mine])
        stated = np.where(np.isnan(stated), typical, stated)
        variance.append(stated + priors[imu].between)
    if not rows:
        empty = np.zeros((0, len(PARAMETERS)))
        return judge_stands(np.zeros(0, int), (), np.zeros((0, 0)), empty, empty, rules)
    every = np.concatenate(rows)
    days = sessions.date[every].astype('datetime64[s]').astype(np.float64) / 86400
    of_type = np.concatenate(kinds)[:, None] == np.arange(len(by_type))
    return judge_stands(
        np.concatenate(numbers),
        [sessions.stand[k] for k in every],
        of_type * (days - days.mean())[:, None],
        sessions.values[every],
        np.concatenate(variance),
        rules,
    )


def _shared_serials(units: Mapping[tuple[str, str], list[int]]) -> list[str]:
    count = Counter(serial for _, serial in units)
    return [
        f'Serial number {serial} occurs with the types '
        f'{listed([imu for imu, other in units if other == serial])}: counted as {count[serial]} '
        'units.'
        for serial in sorted(count)
        if count[serial] > 1
    ]


def _missing_limits(by_type: Mapping[str, object], limits: Mapping[str, Floats]) -> list[str]:
    without = [i for i in by_type if i not in limits or not np.isfinite(limits[i]).any()]
    return [
        f'No specification of {imu or "a type without a name"} is known: when its units '
        'are due cannot be computed. Add the section specification to its file (docs/files/imu.md).'
        for imu in without
    ]


def _missing_deviations(by_type: Mapping[str, list[list[int]]], sessions: Sessions) -> list[str]:
    found = []
    for imu, units in by_type.items():
        rows = np.concatenate([np.array(rows) for rows in units])
        values = np.isfinite(sessions.values[rows])
        stated = stated_variance(sessions.covariance[rows])
        lacking = int(np.sum((values & np.isnan(stated)).any(axis=1)))
        if lacking == len(rows):
            found.append(
                f'No session of {imu} states a standard deviation: all scatter is attributed to '
                'changes between sessions.'
            )
        elif lacking:
            found.append(
                f'{lacking} of {len(rows)} sessions of {imu} state no standard deviation: the '
                'median of the others stands in for it.'
            )
    return found
