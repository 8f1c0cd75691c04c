"""A history as plain values, SI units, with the keys of docs/files/output.md."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from ..model.parameters import PARAMETER_NAMES, PARAMETERS
from .results import QUANTILES, History, Population, Signal, Step
from .results import UnitHistory as Unit


def plain_history(history: History) -> dict[str, Any]:
    """Return the complete history."""
    rules, limits, stands = history.rules, history.limits, history.stands
    return {
        'rules': {
            **asdict(rules),
            'individuals_limit': limits.individuals,
            'ewma_limit': limits.ewma,
            'parameter_run': limits.parameter_run,
            'unit_run': limits.unit_run,
        },
        'units': [_unit(unit) for unit in history.units],
        'populations': [_population(one) for one in history.populations.values()],
        'stands': {
            'names': list(stands.names),
            'sessions': stands.sessions.tolist(),
            'units': stands.units.tolist(),
            'groups': [list(group) for group in stands.groups],
            'effects': [
                {
                    'stand': name,
                    'effect': stands.effect[k].tolist(),
                    'std': stands.std[k].tolist(),
                }
                for k, name in enumerate(stands.names)
            ],
            'reproducibility': stands.reproducibility.tolist(),
            'shifts': [
                {**asdict(one), 'others': list(one.others), 'parameters': list(one.parameters)}
                for one in stands.shifts
            ],
        },
        'findings': list(history.findings),
    }


def unit_rows(unit: Unit) -> list[dict[str, Any]]:
    """Return the results on each parameter of a unit."""
    trend, scatter, due = unit.trend, unit.scatter, unit.forecast
    return [
        {
            'name': name,
            'unit': PARAMETERS[k].unit.si,
            'value': float(unit.values[-1, k]),
            'std': float(unit.std[-1, k]),
            'limit': float(unit.limit[k]),
            'outside': name in unit.outside,
            'level': float(trend.level[k]),
            'level_std': float(trend.level_std[k]),
            'slope': float(trend.slope[k]),
            'slope_std': float(trend.std[k]),
            'slope_low': float(trend.low[k]),
            'slope_high': float(trend.high[k]),
            'slope_chance': float(trend.chance[k]),
            'drifts': bool(trend.significant[k]),
            'turn_on': float(scatter.std[k]),
            'turn_on_low': float(scatter.low[k]),
            'turn_on_high': float(scatter.high[k]),
            'stated': float(scatter.stated[k]),
            'degrees_of_freedom': float(scatter.freedom[k]),
            'overstated': bool(scatter.overstated[k]),
            'leaves': day(due.leaves[k]),
            'inside_until': day(due.earliest[k]),
        }
        for k, name in enumerate(PARAMETER_NAMES)
    ]


def day(date: np.datetime64) -> str | None:
    """Return a date as text; None without one."""
    return None if np.isnat(date) else str(date.astype('datetime64[D]'))


def _unit(unit: Unit) -> dict[str, Any]:
    charts = unit.charts
    return {
        'serial': unit.serial,
        'imu': unit.imu,
        'lot': unit.lot,
        'verdict': None if unit.verdict is None else unit.verdict.value,
        'outside': list(unit.outside),
        'recalibrate': day(unit.forecast.recalibrate),
        'first_in_doubt': unit.forecast.parameter,
        'borrowed': unit.forecast.borrowed,
        'reason': unit.forecast.reason,
        'parameters': unit_rows(unit),
        'sessions': [
            {
                'key': unit.key[i],
                'date': f'{unit.date[i].astype("datetime64[s]")}Z',
                'stand': unit.stand[i],
                'values': unit.values[i].tolist(),
                'std': unit.std[i].tolist(),
                'corrected': unit.corrected[i].tolist(),
                'score': charts.score[i].tolist(),
                'ewma': charts.ewma[i].tolist(),
                't2': float(charts.t2[i]),
                't2_limit': float(charts.t2_limit[i]),
                't2_chance': float(charts.t2_chance[i]),
            }
            for i in range(len(unit.key))
        ],
        'steps': [_step(one) for one in unit.steps],
        'signals': [_signal(one) for one in charts.signals],
        'findings': list(unit.findings),
    }


def _step(step: Step) -> dict[str, Any]:
    return {
        'session': step.index,
        'after': day(step.after),
        'before': day(step.before),
        'cause': step.cause.value,
        'rotation': step.rotation.tolist(),
        'parameters': [
            {
                'name': name,
                'unit': PARAMETERS[PARAMETER_NAMES.index(name)].unit.si,
                'size': float(step.size[k]),
                'std': float(step.std[k]),
                'low': float(step.low[k]),
                'high': float(step.high[k]),
            }
            for k, name in enumerate(step.parameters)
        ],
    }


def _signal(signal: Signal) -> dict[str, Any]:
    return {
        'chart': signal.chart.value,
        'session': signal.index,
        'parameter': signal.parameter,
        'value': signal.value,
        'limit': signal.limit,
    }


def _population(one: Population) -> dict[str, Any]:
    return {
        'imu': one.imu,
        'units': one.units,
        'sessions': one.sessions,
        'parameters': [
            {
                'name': name,
                'unit': PARAMETERS[k].unit.si,
                'count': int(one.count[k]),
                'mean': float(one.mean[k]),
                'std': float(one.std[k]),
                'median': float(one.median[k]),
                'robust_std': float(one.robust_std[k]),
                'quantiles': {
                    f'{q:g}': float(one.quantiles[i, k]) for i, q in enumerate(QUANTILES)
                },
                'turn_on': float(one.turn_on[k]),
                'trend': float(one.trend[k]),
                'trend_std': float(one.trend_std[k]),
                'outside': int(one.outside[k]),
            }
            for k, name in enumerate(PARAMETER_NAMES)
        ],
        'outliers': [asdict(outlier) for outlier in one.outliers],
        'lots': [asdict(lot) for lot in one.lots],
    }
