"""What a history is worked out from, and what it says; values, without the formulae.

Arrays of parameters are in the order of `model.PARAMETERS`, SI units; NaN where nothing is known.
Dates are numpy's datetime64 in UTC; NaT where there is none.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..specification import Verdict
from ..stream import Floats

Dates = NDArray[np.datetime64]
Flags = NDArray[np.bool_]

LEAST_SMOOTHING = 0.05
"""Of an EWMA; of less, run lengths are worked out less exactly than stated."""

MONTH_DAYS = 30.4375
"""A month, which is a twelfth of the Julian year."""


@dataclass(frozen=True)
class Rules:
    """What a history is judged by.

    Attributes:
        false_alarm: Largest chance of a wrong statement: for each kind of chart that any parameter
            of a unit gives a signal at a session; that any step is found, or any trend called
            significant, in a unit that has none; that any stand is named, any unit called an
            outlier, any lot called different where none is.
        confidence: Of all intervals.
        inside: Probability with which a unit is still within its specification when it is due.
        smoothing: Weight of the newest session in an EWMA chart.
        horizon: Years from the newest session beyond which nothing is predicted.

    Raises:
        InputError: A number is not in its range.

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
"""The rules by default."""


@dataclass(frozen=True, eq=False)
class Sessions:
    """Calibrations of units, n of them, in any order.

    Attributes:
        key: Names each session, to find it again.
        serial: Number of the unit; with its type it names the unit.
        imu: Type.
        lot: Of the unit; empty where it is not known.
        stand: Where it was calibrated; empty where it is not known.
        date: (n,) when, UTC.
        values: (n, 24) SI units; NaN for what was not estimated.
        covariance: (n, 24, 24) as stated; NaN where nothing is stated.

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
        std: Standard deviation between sessions beyond what they state, by restricted maximum
            likelihood.
        low: Lower end of its interval.
        high: Upper end.
        stated: Standard deviation that a session states, root mean square.
        freedom: Degrees of freedom of the scatter.
        overstated: Where the sessions agree better than they state: their errors have a part in
            common, or are stated too large. `high` then takes all scatter for that between
            sessions.

    """

    std: Floats
    low: Floats
    high: Floats
    stated: Floats
    freedom: Floats
    overstated: Flags


@dataclass(frozen=True, eq=False)
class Trend:
    """A unit's line through its sessions, beside its steps; (24,) each.

    Attributes:
        slope: SI units per month.
        std: Its standard deviation.
        low: Lower end of its interval.
        high: Upper end.
        chance: Probability of so much in a unit without a trend.
        significant: Whether it differs from zero, all parameters of the unit considered.
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
        leaves: (24,) date at which the line crosses the limit; NaT: not before the horizon.
        earliest: (24,) date until which the parameter is inside with the probability `inside`.
        recalibrate: Until when all parameters together are inside with that probability; NaT: the
            horizon is reached, or nothing is known (`reason`).
        parameter: Name of the one that is most likely to be outside then; empty without a date.
        borrowed: Whether the type's trends stand in for what the unit's own sessions leave open.
        reason: Why there is no date, a sentence; empty where there is one.

    """

    limit: Floats
    leaves: Dates
    earliest: Dates
    recalibrate: np.datetime64
    parameter: str
    borrowed: bool
    reason: str


class Cause(Enum):
    """What a step looks like."""

    MOUNT = 'mount'
    """Gyros and accelerometers turned alike, and nothing else changed."""
    UNIT = 'unit'
    """Of the unit itself, as a repair or a shock."""


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
        cause: What it looks like.
        rotation: (3,) rad about X, Y, Z of a mount; NaN otherwise.

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
    """Limits of the charts, and what they mean for a unit in control.

    Attributes:
        individuals: Of the normal scores, to either side.
        ewma: Of the EWMA of normal scores, to either side.
        parameter_run: Sessions between false alarms of one parameter on one chart, mean.
        unit_run: Likewise of any of the 24 on one chart, at least; and of T^2.

    """

    individuals: float
    ewma: float
    parameter_run: float
    unit_run: float


@dataclass(frozen=True)
class Signal:
    """A session at which a chart leaves its limits.

    Attributes:
        chart: Which.
        index: Of the session, in the unit's course.
        parameter: Name; empty for T^2.
        value: What the chart shows.
        limit: What it would have to stay within.

    """

    chart: Chart
    index: int
    parameter: str
    value: float
    limit: float


@dataclass(frozen=True, eq=False)
class Charts:
    """Control charts of a unit; each session is held against those before it.

    Attributes:
        score: (n, 24) normal scores: the session less what its predecessors predict, as a standard
            normal deviate. NaN where they predict nothing yet.
        ewma: (n, 24) their exponentially weighted moving average.
        t2: (n,) Hotelling's T^2 of the scores of a session.
        t2_limit: (n,) its limit.
        t2_chance: (n,) probability of so much in control.
        signals: Where a chart leaves its limits, by session.

    """

    score: Floats
    ewma: Floats
    t2: Floats
    t2_limit: Floats
    t2_chance: Floats
    signals: tuple[Signal, ...]


@dataclass(frozen=True, eq=False)
class UnitHistory:
    """What the sessions of one unit say, n of them by date.

    Attributes:
        serial: Its number.
        imu: Its type.
        lot: Its lot; empty where it is not known.
        key: (n) sessions.
        date: (n,) when.
        stand: (n) where; empty where it is not known.
        values: (n, 24) as estimated, SI units.
        std: (n, 24) as stated.
        corrected: (n, 24) values less what a stand shifts that was named; trend, steps, charts and
            forecast are of these.
        limit: (24,) of the specification, SI units; NaN without one.
        verdict: Of the newest session against the specification; None without one.
        outside: Names of parameters that are proven to be outside at the newest session.
        scatter: Between sessions.
        trend: With time.
        forecast: When it is due.
        steps: Changes between sessions.
        charts: Control charts.
        findings: What a person should know of this unit, sentences.

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
    """A unit unlike the others of its type.

    Attributes:
        serial: Its number.
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
    """A lot unlike the others of its type.

    Attributes:
        lot: Its name.
        parameter: Name.
        units: How many of it.
        shift: Mean of its units less that of all others, SI units.
        std: Its standard deviation.
        chance: Probability of so much between lots that do not differ.

    """

    lot: str
    parameter: str
    units: int
    shift: float
    std: float
    chance: float


QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
"""Of a population, that are stated."""


@dataclass(frozen=True, eq=False)
class Population:
    """The units of one type; one value for each, that of its newest session; (24,) each.

    Attributes:
        imu: Type.
        units: How many.
        sessions: How many of all units.
        count: Units with a value.
        mean: SI units.
        std: Between units, what sessions state and scatter included.
        median: SI units.
        robust_std: 1.4826 times the median absolute deviation from it.
        quantiles: (5, 24) at `QUANTILES`.
        turn_on: Standard deviation between sessions of a unit, typical of the type.
        trend: Mean slope, per month.
        trend_std: Of the units' true slopes about it.
        outside: Units proven to be outside their specification by this parameter.
        outliers: Units apart from the others.
        lots: Lots apart from the others.

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
    """A stand that shifts every unit.

    Attributes:
        stand: Its name; of two stands that differ the one that is named second (`alone`).
        others: Stands that it was held against.
        alone: Whether it is this stand that is off: three stands or more tell, two do not.
        what: Name of a parameter, or of what several have in common ('K_a', 'E about X').
        parameters: Names of those that are shifted alike.
        unit: SI unit of the numbers.
        shift: What it adds, SI units.
        std: Its standard deviation.
        low: Lower end of its interval, all that was tested considered.
        high: Upper end.
        chance: Probability of so much where no stand is off, all that was tested considered.
        units: How many units tell: those that were on this stand and on another.

    """

    stand: str
    others: tuple[str, ...]
    alone: bool
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
    """Stands held against each other by the units that were on several, m of them.

    Attributes:
        names: m of them.
        sessions: (m,) of each.
        units: (m,) of each.
        groups: Stands that shared units link; only those of one group can be compared.
        effect: (m, 24) of a stand less the mean of its group, SI units; NaN where nothing tells.
        std: (m, 24) their standard deviations.
        reproducibility: (24,) standard deviation between stands, by restricted maximum likelihood.
        shifts: Stands that are off.
        findings: What a person should know, sentences: what cannot be separated, too.

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
    """What all sessions say.

    Attributes:
        rules: What was judged by.
        limits: Of the charts.
        units: By type and serial number.
        populations: By type.
        stands: Held against each other.
        findings: What a person should know of the whole, sentences.

    """

    rules: Rules
    limits: ChartLimits
    units: tuple[UnitHistory, ...]
    populations: Mapping[str, Population]
    stands: Stands
    findings: tuple[str, ...] = field(default=())

    @property
    def outside(self) -> tuple[UnitHistory, ...]:
        """Units proven to be outside their specification at their newest session."""
        return tuple(unit for unit in self.units if unit.outside)

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain values, SI units, by the keys of docs/files/output.md."""
        from .plain import plain_history

        return plain_history(self)
