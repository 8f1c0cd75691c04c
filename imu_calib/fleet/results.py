"""Inputs and results of a history as values, without formulae.

Arrays of parameters are in the order of `model.PARAMETERS`, SI units; NaN if unknown. Dates are
numpy's datetime64 in UTC; NaT if missing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.errors import InputError
from ..common.stream import Floats
from ..common.units import counted
from ..model.parameters import PARAMETER_NAMES, PARAMETERS
from ..session.imu import Verdict

Dates = NDArray[np.datetime64]
Flags = NDArray[np.bool_]

LEAST_SMOOTHING = 0.05
"""Smallest smoothing of an EWMA; below it run lengths are less accurate than stated."""

MONTH_DAYS = 30.4375
"""A month, one twelfth of the Julian year."""


@dataclass(frozen=True)
class Rules:
    """Rules of the evaluation of a history.

    Attributes:
        false_alarm: Largest probability of a wrong statement: for each kind of chart that any
            parameter of a unit gives a signal at a session; that any step, or any significant
            trend, is found in a unit without one; that any stand is named, any unit called an
            outlier, or any lot called different without cause.
        confidence: Of all intervals.
        inside: Probability with which a unit is still within its specification when it is due.
        smoothing: Weight of the newest session in an EWMA chart.
        horizon: Years from the newest session beyond which nothing is predicted.

    Raises:
        InputError: A number is outside its range.
    """

    false_alarm: float = 0.01
    confidence: float = 0.95
    inside: float = 0.95
    smoothing: float = 0.2
    horizon: float = 10.0

    def __post_init__(self) -> None:
        for name, low, high in (
            ('false_alarm', 0.0, 0.5),
            ('confidence', 0.5, 1.0),
            ('inside', 0.5, 1.0),
            ('horizon', 0.0, 100.0),
        ):
            if not low < getattr(self, name) < high:
                raise InputError(
                    f'{name}: found {getattr(self, name)}, expected a number between {low:g} and '
                    f'{high:g}.'
                )
        if not LEAST_SMOOTHING <= self.smoothing <= 1:
            raise InputError(
                f'smoothing: found {self.smoothing}, expected {LEAST_SMOOTHING:g} to 1.'
            )


USUAL = Rules()
"""The default rules."""


@dataclass(frozen=True, eq=False)
class Sessions:
    """Calibrations of units, n of them, in any order.

    Attributes:
        key: Identifies each session.
        serial: Serial number of the unit; with its type it identifies the unit.
        imu: Type.
        lot: Of the unit; empty if unknown.
        stand: Where it was calibrated; empty if unknown.
        date: (n,) date, UTC.
        values: (n, 24) SI units; NaN if not estimated.
        covariance: (n, 24, 24) as stated; NaN if not stated.
    """

    key: tuple[str, ...]
    serial: tuple[str, ...]
    imu: tuple[str, ...]
    lot: tuple[str, ...]
    stand: tuple[str, ...]
    date: Dates
    values: Floats
    covariance: Floats


@dataclass(frozen=True, eq=False)
class Scatter:
    """Scatter of a unit's parameters between sessions: turn-on repeatability, (24,) each.

    Attributes:
        std: Standard deviation between sessions beyond the stated ones, by restricted maximum
            likelihood.
        low: Lower end of its interval.
        high: Upper end.
        stated: Standard deviation stated by a session, root mean square.
        freedom: Degrees of freedom of the scatter.
        overstated: Whether the scatter is smaller than stated: the sessions have a common error, or
            their stated deviations are too large. `high` is then the limit for all scatter as that
            between sessions.
    """

    std: Floats
    low: Floats
    high: Floats
    stated: Floats
    freedom: Floats
    overstated: Flags


@dataclass(frozen=True, eq=False)
class Trend:
    """A unit's line through its sessions, with its steps; (24,) each.

    Attributes:
        slope: SI units per month.
        std: Its standard deviation.
        low: Lower end of its interval.
        high: Upper end.
        chance: Probability of at least this slope in a unit without a trend.
        significant: Whether it differs from zero, corrected for all parameters of the unit.
        level: Of the line at the newest session, SI units.
        level_std: Its standard deviation.
    """

    slope: Floats
    std: Floats
    low: Floats
    high: Floats
    chance: Floats
    significant: Flags
    level: Floats
    level_std: Floats


@dataclass(frozen=True, eq=False)
class Forecast:
    """When a unit leaves its specification.

    Attributes:
        limit: (24,) largest amount allowed, SI units; NaN without one.
        leaves: (24,) date at which the line crosses the limit; NaT: after the horizon.
        earliest: (24,) date until which the parameter is inside with the probability `inside`.
        recalibrate: Date until which all parameters together are inside with that probability; NaT:
            after the horizon, or unknown (`reason`).
        parameter: Name of the one that is most likely outside then; empty without a date.
        borrowed: Whether trends of the type are used where the unit's own sessions are
            insufficient.
        reason: Why there is no date, a sentence; else empty.
    """

    limit: Floats
    leaves: Dates
    earliest: Dates
    recalibrate: np.datetime64
    parameter: str
    borrowed: bool
    reason: str


class Cause(Enum):
    """Cause of a step."""

    MOUNT = 'mount'
    """Gyros and accelerometers are rotated together, and nothing else changed."""
    UNIT = 'unit'
    """In the unit itself, by a repair or a shock."""


@dataclass(frozen=True, eq=False)
class Step:
    """A change between two sessions that no trend explains.

    Attributes:
        index: Of the first session after it, in the unit's course.
        after: Date of the last session before it.
        before: Date of the first session after it.
        parameters: Names of the k that changed significantly.
        size: (k,) SI units.
        std: (k,) standard deviations.
        low: (k,) lower ends of their intervals.
        high: (k,) upper ends.
        cause: Its cause.
        rotation: (3,) rad about X, Y, Z of a mount; else NaN.
    """

    index: int
    after: np.datetime64
    before: np.datetime64
    parameters: tuple[str, ...]
    size: Floats
    std: Floats
    low: Floats
    high: Floats
    cause: Cause
    rotation: Floats


class Chart(Enum):
    """A kind of control chart."""

    INDIVIDUALS = 'individuals'
    EWMA = 'EWMA'
    T2 = 'T^2'


@dataclass(frozen=True)
class ChartLimits:
    """Limits of the charts, and their run lengths for a unit in control.

    Attributes:
        individuals: Of the normal scores, on both sides.
        ewma: Of the EWMA of normal scores, on both sides.
        parameter_run: Mean number of sessions between false alarms of one parameter on one chart.
        unit_run: The same for any of the 24 on one chart, a lower bound; and for T^2.
    """

    individuals: float
    ewma: float
    parameter_run: float
    unit_run: float


@dataclass(frozen=True)
class Signal:
    """A session at which a chart leaves its limits.

    Attributes:
        chart: Kind of the chart.
        index: Of the session, in the unit's course.
        parameter: Name; empty for T^2.
        value: Value on the chart.
        limit: Its limit.
    """

    chart: Chart
    index: int
    parameter: str
    value: float
    limit: float


@dataclass(frozen=True, eq=False)
class Charts:
    """Control charts of a unit; each session is compared with the preceding ones.

    Attributes:
        score: (n, 24) normal scores: the session minus its prediction from its predecessors, as a
            standard normal deviate. NaN without a prediction.
        ewma: (n, 24) their exponentially weighted moving average.
        t2: (n,) Hotelling's T^2 of the scores of a session.
        t2_limit: (n,) its limit.
        t2_chance: (n,) probability of at least this value in control.
        signals: Sessions at which a chart leaves its limits.
    """

    score: Floats
    ewma: Floats
    t2: Floats
    t2_limit: Floats
    t2_chance: Floats
    signals: tuple[Signal, ...]


@dataclass(frozen=True, eq=False)
class UnitHistory:
    """Evaluation of the n sessions of one unit, by date.

    Attributes:
        serial: Its serial number.
        imu: Its type.
        lot: Its lot; empty if unknown.
        key: (n) keys of the sessions.
        date: (n,) dates.
        stand: (n) stands; empty if unknown.
        values: (n, 24) estimates, SI units.
        std: (n, 24) stated standard deviations.
        corrected: (n, 24) values minus the shifts of named stands, used for trend, steps, charts
            and forecast.
        limit: (24,) of the specification, SI units; NaN without one.
        verdict: Of the newest session against the specification; None without one.
        outside: Names of parameters that are proven to be outside at the newest session.
        scatter: Between sessions.
        trend: Over time.
        forecast: When it is due.
        steps: Changes between sessions.
        charts: Control charts.
        findings: Messages for the user on this unit, sentences.
    """

    serial: str
    imu: str
    lot: str
    key: tuple[str, ...]
    date: Dates
    stand: tuple[str, ...]
    values: Floats
    std: Floats
    corrected: Floats
    limit: Floats
    verdict: Verdict | None
    outside: tuple[str, ...]
    scatter: Scatter
    trend: Trend
    forecast: Forecast
    steps: tuple[Step, ...]
    charts: Charts
    findings: tuple[str, ...]


@dataclass(frozen=True)
class Outlier:
    """A unit that differs from the others of its type.

    Attributes:
        serial: Its serial number.
        parameter: Name.
        value: Its level, SI units.
        score: Distance from the median in robust standard deviations.
    """

    serial: str
    parameter: str
    value: float
    score: float


@dataclass(frozen=True)
class LotShift:
    """A lot that differs from the others of its type.

    Attributes:
        lot: Its name.
        parameter: Name.
        units: Number of its units.
        shift: Mean of its units minus that of all others, SI units.
        std: Its standard deviation.
        chance: Probability of at least this shift between lots that do not differ.
    """

    lot: str
    parameter: str
    units: int
    shift: float
    std: float
    chance: float


QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
"""Quantiles of a population that are stated."""


@dataclass(frozen=True, eq=False)
class Population:
    """The units of one type; one value for each, that of its newest session; (24,) each.

    Attributes:
        imu: Type.
        units: Number of units.
        sessions: Number of sessions of all units.
        count: Number of units with a value.
        mean: SI units.
        std: Between units, including stated deviations and scatter.
        median: SI units.
        robust_std: 1.4826 times the median absolute deviation from it.
        quantiles: (5, 24) at `QUANTILES`.
        turn_on: Standard deviation between sessions of a unit, typical of the type.
        trend: Mean slope, per month.
        trend_std: Standard deviation of the units' true slopes.
        outside: Number of units proven to be outside their specification by this parameter.
        outliers: Units that differ from the others.
        lots: Lots that differ from the others.
    """

    imu: str
    units: int
    sessions: int
    count: NDArray[np.int64]
    mean: Floats
    std: Floats
    median: Floats
    robust_std: Floats
    quantiles: Floats
    turn_on: Floats
    trend: Floats
    trend_std: Floats
    outside: NDArray[np.int64]
    outliers: tuple[Outlier, ...]
    lots: tuple[LotShift, ...]


@dataclass(frozen=True)
class StandShift:
    """A stand with a common shift of all units.

    Attributes:
        stand: Its name; for a pair of different stands that of the second (not `identified`).
        others: Stands in the comparison.
        identified: Whether this stand is the cause; with only two stands it is unknown which is.
        what: Name of a parameter, or of a common cause of several ('K_a', 'E about X').
        parameters: Names of the shifted ones.
        unit: SI unit of the numbers.
        shift: Its size, SI units.
        std: Its standard deviation.
        low: Lower end of its interval, corrected for all tests.
        high: Upper end.
        chance: Probability of at least this shift without cause, corrected for all tests.
        units: Number of units that were on this stand and on another.
    """

    stand: str
    others: tuple[str, ...]
    identified: bool
    what: str
    parameters: tuple[str, ...]
    unit: str
    shift: float
    std: float
    low: float
    high: float
    chance: float
    units: int


@dataclass(frozen=True, eq=False)
class Stands:
    """Comparison of m stands by the units that were on several.

    Attributes:
        names: Names of the m stands.
        sessions: (m,) number of sessions of each.
        units: (m,) number of units of each.
        groups: Stands linked by common units; only those of one group can be compared.
        effect: (m, 24) of a stand minus the mean of its group, SI units; NaN if undetermined.
        std: (m, 24) their standard deviations.
        reproducibility: (24,) standard deviation between stands, by restricted maximum likelihood.
        shifts: Shifts of stands.
        findings: Messages for the user, sentences, including what cannot be separated.
    """

    names: tuple[str, ...]
    sessions: NDArray[np.int64]
    units: NDArray[np.int64]
    groups: tuple[tuple[str, ...], ...]
    effect: Floats
    std: Floats
    reproducibility: Floats
    shifts: tuple[StandShift, ...]
    findings: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class History:
    """Evaluation of all sessions.

    Attributes:
        rules: Rules of the evaluation.
        limits: Of the charts.
        units: By type and serial number.
        populations: By type.
        stands: Their comparison.
        findings: Messages for the user on the whole, sentences.
    """

    rules: Rules
    limits: ChartLimits
    units: tuple[UnitHistory, ...]
    populations: Mapping[str, Population]
    stands: Stands
    findings: tuple[str, ...] = field(default=())

    def __repr__(self) -> str:
        """Return one line."""
        kinds = counted(len(self.populations), 'type')
        return f'<History of {counted(len(self.units), "unit")} of {kinds}>'

    @property
    def outside(self) -> tuple[UnitHistory, ...]:
        """Units proven to be outside their specification at their newest session."""
        return tuple(unit for unit in self.units if unit.outside)

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain values, SI units, with the keys of docs/files/output.md."""
        return plain_history(self)


# A history as plain values, SI units, with the keys of docs/files/output.md.


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


def unit_rows(unit: UnitHistory) -> list[dict[str, Any]]:
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


def _unit(unit: UnitHistory) -> dict[str, Any]:
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
