"""Evaluate all sessions: first stands, then units corrected for their effects, then types."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..common.stream import Floats
from ..model.parameters import PARAMETERS
from .blocks import sample, typical_variance, units_of
from .charts import chart_limits
from .evaluation import Judged, judge_type, population_of
from .results import USUAL, History, Rules, Sessions, Stands
from .scatter import Prior, prior_of
from .sentences import listed, stand_sentence
from .stands import corrections, judge_stands


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
            *_of_serials(units),
            *_of_limits(by_type, limits),
            *_of_covariances(by_type, sessions),
        ),
    )


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
        stated = np.diagonal(sessions.covariance[mine], axis1=-2, axis2=-1)
        stated = np.where(np.isfinite(stated) & (stated >= 0), stated, typical)
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


def _of_serials(units: Mapping[tuple[str, str], list[int]]) -> list[str]:
    count = Counter(serial for _, serial in units)
    return [
        f'Serial number {serial} occurs with the types '
        f'{listed([imu for imu, other in units if other == serial])}: counted as {count[serial]} '
        'units.'
        for serial in sorted(count)
        if count[serial] > 1
    ]


def _of_limits(by_type: Mapping[str, object], limits: Mapping[str, Floats]) -> list[str]:
    without = [i for i in by_type if i not in limits or not np.isfinite(limits[i]).any()]
    return [
        f'No specification of {imu or "a type without a name"} is known: when its units '
        'are due cannot be computed. Add the section specification to its file (docs/files/imu.md).'
        for imu in without
    ]


def _of_covariances(by_type: Mapping[str, list[list[int]]], sessions: Sessions) -> list[str]:
    found = []
    for imu, units in by_type.items():
        rows = np.concatenate([np.array(rows) for rows in units])
        values = np.isfinite(sessions.values[rows])
        stated = np.diagonal(sessions.covariance[rows], axis1=-2, axis2=-1)
        lacking = int(np.sum((values & ~(np.isfinite(stated) & (stated >= 0))).any(axis=1)))
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
