"""Inputs and results of a history as values, without formulae, and their plain form.

Arrays of parameters are in the order of `PARAMETERS`, SI units; NaN if unknown. Dates are
numpy's datetime64 in UTC; NaT if missing. In the plain form (docs/files/output.md) a field has its
own name, or the `key` of its metadata.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
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


@dataclass(frozen=True)
class Rules:
    """Rules of the evaluation of a history."""

    #: Largest probability of a wrong statement: for each kind of chart that any parameter of a unit
    #: gives a signal at a session; that any step, or any significant trend, is found in a unit
    #: without one; that any stand is named, any unit called an outlier, or any lot called different
    #: without cause.
    false_alarm: float = 0.01
    confidence: float = 0.95  #: Of all intervals.
    #: Probability with which a unit is still within its specification when it is due.
    inside: float = 0.95
    smoothing: float = 0.2  #: Weight of the newest session in an EWMA chart.
    horizon: float = 10.0  #: Years from the newest session beyond which nothing is predicted.

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


USUAL = Rules()  #: The default rules.


@dataclass(frozen=True, eq=False)
class Sessions:
    """Calibrations of units, n of them, in any order."""

    key: tuple[str, ...]  #: Identifies each session.
    serial: tuple[str, ...]  #: Serial number of the unit; with its type it identifies the unit.
    imu: tuple[str, ...]  #: Type.
    lot: tuple[str, ...]  #: Of the unit; empty if unknown.
    stand: tuple[str, ...]  #: Where it was calibrated; empty if unknown.
    date: Dates  #: (n,) date, UTC.
    values: Floats  #: (n, 24) SI units; NaN if not estimated.
    covariance: Floats  #: (n, 24, 24) as stated; NaN if not stated.
    #: Types of which every session was held by hand: they are shown in units of that grade.
    by_hand: frozenset[str] = frozenset()


@dataclass(frozen=True, eq=False)
class Scatter:
    """Scatter of a unit's parameters between sessions: turn-on repeatability, (24,) each."""

    #: Standard deviation between sessions beyond the stated ones, by restricted maximum likelihood.
    std: Floats = field(metadata={'key': 'turn_on'})
    low: Floats = field(metadata={'key': 'turn_on_low'})  #: Lower end of its interval.
    high: Floats = field(metadata={'key': 'turn_on_high'})  #: Upper end.
    stated: Floats  #: Standard deviation stated by a session, root mean square.
    freedom: Floats = field(metadata={'key': 'degrees_of_freedom'})  #: Of the scatter.
    #: Whether the scatter is smaller than stated: the sessions have a common error, or their stated
    #: deviations are too large. `high` is then the limit for all scatter as that between sessions.
    overstated: Flags


@dataclass(frozen=True, eq=False)
class Trend:
    """A unit's line through its sessions, with its steps; (24,) each."""

    level: Floats  #: Of the line at the newest session, SI units.
    level_std: Floats  #: Its standard deviation.
    slope: Floats  #: SI units per month.
    std: Floats = field(metadata={'key': 'slope_std'})  #: Its standard deviation.
    low: Floats = field(metadata={'key': 'slope_low'})  #: Lower end of its interval.
    high: Floats = field(metadata={'key': 'slope_high'})  #: Upper end.
    #: Probability of at least this slope in a unit without a trend.
    chance: Floats = field(metadata={'key': 'slope_chance'})
    #: Whether it differs from zero, corrected for all parameters of the unit.
    significant: Flags = field(metadata={'key': 'drifts'})
    #: Smallest step at the newest session that would be found as one; unknown with fewer than four
    #: sessions, and where a step is found.
    least_step: Floats


@dataclass(frozen=True, eq=False)
class Forecast:
    """When a unit leaves its specification."""

    limit: Floats  #: (24,) largest amount allowed, SI units; NaN without one.
    leaves: Dates  #: (24,) date at which the line crosses the limit; NaT: after the horizon.
    #: (24,) date until which the parameter is inside with the probability `inside`.
    earliest: Dates = field(metadata={'key': 'inside_until'})
    #: Date until which all parameters together are inside with that probability; NaT: after the
    #: horizon, or unknown (`reason`).
    recalibrate: np.datetime64
    #: Name of the one that is most likely outside then; empty without a date.
    parameter: str = field(metadata={'key': 'first_in_doubt'})
    #: Whether trends of the type are used where the unit's own sessions are insufficient.
    borrowed: bool
    reason: str  #: Why there is no date, a sentence; else empty.


class Cause(Enum):
    """Cause of a step."""

    MOUNT = 'mount'
    """Gyros and accelerometers are rotated together, and nothing else changed."""
    UNIT = 'unit'
    """In the unit itself, by a repair or a shock."""
    OUTLIER = 'outlier'
    """The session after it is unlike those before and after."""
    RETURN = 'return'
    """Back after such a session."""


@dataclass(frozen=True, eq=False)
class Step:
    """A change between two sessions that no trend explains."""

    #: Of the first session after it, in the unit's course.
    index: int = field(metadata={'key': 'session'})
    after: np.datetime64  #: Date of the last session before it.
    before: np.datetime64  #: Date of the first session after it.
    parameters: tuple[str, ...]  #: Names of the k that changed significantly.
    size: Floats  #: (k,) SI units.
    std: Floats  #: (k,) standard deviations.
    low: Floats  #: (k,) lower ends of their intervals.
    high: Floats  #: (k,) upper ends.
    cause: Cause  #: Its cause.
    rotation: Floats  #: (3,) rad about X, Y, Z of a mount; else NaN.


class Chart(Enum):
    """A kind of control chart."""

    INDIVIDUALS = 'individuals'
    EWMA = 'EWMA'
    T2 = 'T^2'


@dataclass(frozen=True)
class ChartLimits:
    """Limits of the charts, and their run lengths for a unit in control."""

    #: Of the normal scores, on both sides.
    individuals: float = field(metadata={'key': 'individuals_limit'})
    #: Of the EWMA of normal scores, on both sides.
    ewma: float = field(metadata={'key': 'ewma_limit'})
    #: Mean number of sessions between false alarms of one parameter on one chart.
    parameter_run: float
    unit_run: float  #: The same for any of the 24 on one chart, a lower bound; and for T^2.


@dataclass(frozen=True)
class Signal:
    """A session at which a chart leaves its limits."""

    chart: Chart  #: Kind of the chart.
    index: int = field(metadata={'key': 'session'})  #: Of the session, in the unit's course.
    parameter: str  #: Name; empty for T^2.
    value: float  #: Value on the chart.
    limit: float  #: Its limit.


@dataclass(frozen=True, eq=False)
class Charts:
    """Control charts of a unit; each session is compared with the preceding ones."""

    #: (n, 24) normal scores: the session minus its prediction from its predecessors, as a standard
    #: normal deviate. NaN without a prediction.
    score: Floats
    ewma: Floats  #: (n, 24) their exponentially weighted moving average.
    t2: Floats  #: (n,) Hotelling's T^2 of the scores of a session.
    t2_limit: Floats  #: (n,) its limit.
    t2_chance: Floats  #: (n,) probability of at least this value in control.
    signals: tuple[Signal, ...]  #: Sessions at which a chart leaves its limits.


@dataclass(frozen=True, eq=False)
class UnitHistory:
    """Evaluation of the n sessions of one unit, by date."""

    serial: str  #: Its serial number.
    imu: str  #: Its type.
    lot: str  #: Its lot; empty if unknown.
    key: tuple[str, ...]  #: (n) keys of the sessions.
    date: Dates  #: (n,) dates.
    stand: tuple[str, ...]  #: (n) stands; empty if unknown.
    values: Floats  #: (n, 24) estimates, SI units.
    std: Floats  #: (n, 24) stated standard deviations.
    #: (n, 24) values minus the shifts of named stands, used for trend, steps, charts and forecast.
    corrected: Floats
    limit: Floats  #: (24,) of the specification, SI units; NaN without one.
    verdict: Verdict | None  #: Of the newest session against the specification; None without one.
    #: Names of parameters that are proven to be outside at the newest session.
    outside: tuple[str, ...]
    scatter: Scatter  #: Between sessions.
    trend: Trend  #: Over time.
    forecast: Forecast  #: When it is due.
    steps: tuple[Step, ...]  #: Changes between sessions.
    charts: Charts  #: Control charts.
    findings: tuple[str, ...]  #: Messages for the user on this unit, sentences.
    by_hand: bool = False  #: Whether its type is held by hand, for the units shown.
    warnings: tuple[str, ...] = ()  #: Of its calibrations, with their dates.

    @property
    def own_steps(self) -> tuple[Step, ...]:
        """Steps that are not those of one session."""
        return tuple(s for s in self.steps if s.cause in {Cause.MOUNT, Cause.UNIT})


@dataclass(frozen=True)
class Outlier:
    """A unit that differs from the others of its type."""

    serial: str  #: Its serial number.
    parameter: str  #: Name.
    value: float  #: Its level, SI units.
    score: float  #: Distance from the median in robust standard deviations.


@dataclass(frozen=True)
class LotShift:
    """A lot that differs from the others of its type."""

    lot: str  #: Its name.
    parameter: str  #: Name.
    units: int  #: Number of its units.
    shift: float  #: Mean of its units minus that of all others, SI units.
    std: float  #: Its standard deviation.
    chance: float  #: Probability of at least this shift between lots that do not differ.


QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)  #: Quantiles of a population that are stated.


@dataclass(frozen=True, eq=False)
class Population:
    """The units of one type; one value for each, that of its newest session; (24,) each."""

    imu: str  #: Type.
    units: int  #: Number of units.
    sessions: int  #: Number of sessions of all units.
    count: NDArray[np.int64]  #: Number of units with a value.
    mean: Floats  #: SI units.
    std: Floats  #: Between units, including stated deviations and scatter.
    median: Floats  #: SI units.
    robust_std: Floats  #: 1.4826 times the median absolute deviation from it.
    quantiles: Floats  #: (5, 24) at `QUANTILES`.
    turn_on: Floats  #: Standard deviation between sessions of a unit, typical of the type.
    trend: Floats  #: Mean slope, per month.
    trend_std: Floats  #: Standard deviation of the units' true slopes.
    #: Number of units proven to be outside their specification by this parameter.
    outside: NDArray[np.int64]
    outliers: tuple[Outlier, ...]  #: Units that differ from the others.
    lots: tuple[LotShift, ...]  #: Lots that differ from the others.
    by_hand: bool = False  #: Whether they are held by hand, for the units shown.


@dataclass(frozen=True)
class StandShift:
    """A stand with a common shift of all units."""

    stand: str  #: Its name; for a pair of different stands that of the second (not `identified`).
    others: tuple[str, ...]  #: Stands in the comparison.
    #: Whether this stand is the cause; with only two stands it is unknown which is.
    identified: bool
    what: str  #: Name of a parameter, or of a common cause of several ('K_a', 'E about X').
    parameters: tuple[str, ...]  #: Names of the shifted ones.
    unit: str  #: SI unit of the numbers.
    shift: float  #: Its size, SI units.
    std: float  #: Its standard deviation.
    low: float  #: Lower end of its interval, corrected for all tests.
    high: float  #: Upper end.
    chance: float  #: Probability of at least this shift without cause, corrected for all tests.
    units: int  #: Number of units that were on this stand and on another.


@dataclass(frozen=True, eq=False)
class Stands:
    """Comparison of m stands by the units that were on several."""

    names: tuple[str, ...]  #: Names of the m stands.
    sessions: NDArray[np.int64]  #: (m,) number of sessions of each.
    units: NDArray[np.int64]  #: (m,) number of units of each.
    #: Stands linked by common units; only those of one group can be compared.
    groups: tuple[tuple[str, ...], ...]
    #: (m, 24) of a stand minus the mean of its group, SI units; NaN if undetermined.
    effect: Floats
    std: Floats  #: (m, 24) their standard deviations.
    #: (24,) standard deviation between stands, by restricted maximum likelihood.
    reproducibility: Floats
    shifts: tuple[StandShift, ...]  #: Shifts of stands.
    #: Messages for the user, sentences, including what cannot be separated.
    findings: tuple[str, ...]

    @property
    def off(self) -> frozenset[str]:
        """Stands that are known to be off."""
        return frozenset(shift.stand for shift in self.shifts if shift.identified)


@dataclass(frozen=True, eq=False)
class History:
    """Evaluation of all sessions."""

    rules: Rules  #: Rules of the evaluation.
    limits: ChartLimits  #: Of the charts.
    units: tuple[UnitHistory, ...]  #: By type and serial number.
    populations: Mapping[str, Population]  #: By type.
    stands: Stands  #: Their comparison.
    findings: tuple[str, ...] = field(default=())  #: Messages for the user on the whole, sentences.

    def __repr__(self) -> str:
        kinds = counted(len(self.populations), 'type')
        return f'<History of {counted(len(self.units), "unit")} of {kinds}>'

    @property
    def outside(self) -> tuple[UnitHistory, ...]:
        """Units proven to be outside their specification at their newest session."""
        return tuple(unit for unit in self.units if unit.outside)

    @property
    def off_stand(self) -> tuple[UnitHistory, ...]:
        """Units whose newest calibration is from a stand that is off, and has its error."""
        off = self.stands.off
        return tuple(unit for unit in self.units if unit.stand[-1] in off)

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain values, SI units, with the keys of docs/files/output.md."""
        stands = self.stands
        effects = {'stand': stands.names, **_some(stands, 'effect', 'std')}
        return {
            'rules': {**_plain(self.rules), **_plain(self.limits)},
            'units': [_unit(unit) for unit in self.units],
            'populations': [_population(one) for one in self.populations.values()],
            'stands': {
                **_some(stands, 'names', 'sessions', 'units', 'groups'),
                'effects': _rows(effects),
                **_some(stands, 'reproducibility', 'shifts'),
            },
            'findings': list(self.findings),
        }


def unit_rows(unit: UnitHistory) -> list[dict[str, Any]]:
    """Return the results on each parameter of a unit."""
    return _rows(
        {
            **_OF_PARAMETERS,
            'value': _plain(unit.values[-1]),
            'std': _plain(unit.std[-1]),
            'limit': _plain(unit.limit),
            'outside': [name in unit.outside for name in PARAMETER_NAMES],
            **_arrays(unit.trend),
            **_arrays(unit.scatter),
            **_arrays(unit.forecast),
        }
    )


def day(date: np.datetime64) -> str | None:
    """Return a date as text; None without one."""
    return None if np.isnat(date) else str(date.astype('datetime64[D]'))


_SI = {parameter.name: parameter.unit.si for parameter in PARAMETERS}
_OF_PARAMETERS = {'name': list(_SI), 'unit': list(_SI.values())}


def _plain(value: Any) -> Any:
    """Return a value in its plain form."""
    if isinstance(value, (np.ndarray, np.generic)) and value.dtype.kind != 'M':
        return value.tolist()
    if isinstance(value, np.datetime64):
        return day(value)
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, (tuple, np.ndarray)):
        return [_plain(one) for one in value]
    if is_dataclass(value):
        return _some(value, *(one.name for one in fields(value)))
    return value


def _some(value: Any, *names: str) -> dict[str, Any]:
    """Return some fields of a dataclass by their keys."""
    return {
        one.metadata.get('key', one.name): _plain(getattr(value, one.name))
        for one in fields(value)
        if one.name in names
    }


def _arrays(value: Any) -> dict[str, Any]:
    """Return the fields that are arrays."""
    names = [one.name for one in fields(value)]
    return _some(value, *(n for n in names if isinstance(getattr(value, n), np.ndarray)))


def _rows(columns: Mapping[str, Sequence[Any]]) -> list[dict[str, Any]]:
    """Return columns of equal length as rows."""
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def _unit(unit: UnitHistory) -> dict[str, Any]:
    sessions = {
        'key': unit.key,
        'date': [f'{date.astype("datetime64[s]")}Z' for date in unit.date],
        'stand': unit.stand,
        **_some(unit, 'values', 'std', 'corrected'),
        **_arrays(unit.charts),
    }
    return {
        **_some(unit, 'serial', 'imu', 'lot', 'verdict', 'outside'),
        **_some(unit.forecast, 'recalibrate', 'parameter', 'borrowed', 'reason'),
        'parameters': unit_rows(unit),
        'sessions': _rows(sessions),
        'steps': [_step(one) for one in unit.steps],
        **_some(unit.charts, 'signals'),
        **_some(unit, 'warnings'),
        'findings': list(unit.findings),
    }


def _step(step: Step) -> dict[str, Any]:
    columns = {
        'name': step.parameters,
        'unit': [_SI[name] for name in step.parameters],
        **_some(step, 'size', 'std', 'low', 'high'),
    }
    return {
        **_some(step, 'index', 'after', 'before', 'cause', 'rotation'),
        'parameters': _rows(columns),
    }


def _population(one: Population) -> dict[str, Any]:
    names = [f'{share:g}' for share in QUANTILES]
    quantiles = [dict(zip(names, each, strict=True)) for each in one.quantiles.T.tolist()]
    return {
        **_some(one, 'imu', 'units', 'sessions'),
        'parameters': _rows({**_OF_PARAMETERS, **_arrays(one), 'quantiles': quantiles}),
        **_some(one, 'outliers', 'lots'),
    }
