"""Blocks of sessions, control charts of units, and steps between two sessions.

Self-starting: a session minus the mean of its predecessors, over the scatter of these and of the
type, is a Student deviate. Its normal score is used in the individuals chart, EWMA and T^2, whose
false alarms are then those of a process with known mean and scatter. Sources: Quesenberry 1991 (Q
charts), Hawkins 1987, Lucas & Saccucci 1990, Hotelling 1947; docs/history.md.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import scipy
from numpy.polynomial.legendre import leggauss
from numpy.typing import NDArray

from ..calibration.agreement import FEWEST_FOR_A_STEP
from ..common.stream import Floats
from ..common.units import MONTH_DAYS
from ..model.parameters import PARAMETERS
from .results import Chart, ChartLimits, Rules, Sessions, Signal
from .scatter import Fit, Prior, fit, line_design, sampled

# Source: the integral equation of Crowder 1987; Lucas & Saccucci 1990 tabulate its solutions;
# docs/history.md, 'Control charts'.

_NODES = 64  #: Nodes of the quadrature: run lengths to five digits for smoothings from 0.05 on.
_WIDEST = 8.0  #: Largest limit in standard deviations: a false alarm in 1e15 sessions.
_HALVINGS = 50  #: Bisections of the bracket from zero to _WIDEST: down to rounding (8 / 2^50).


def ewma_std(smoothing: float) -> float:
    """Return the standard deviation of an EWMA of many standard normal scores."""
    return math.sqrt(smoothing / (2 - smoothing))


def mean_run_length(smoothing: float, limit: float, shift: float = 0.0) -> float:
    """Return the mean number of sessions until an EWMA that starts at zero leaves its limits.

    L(u) = 1 + integral of L(y) phi((y - (1 - s) u) / s - shift) / s over the limits, at u = 0.

    Args:
        smoothing: Weight s of the newest score.
        limit: On both sides, in standard deviations of the EWMA.
        shift: Mean of the scores; zero in control.
    """
    half = limit * ewma_std(smoothing)
    nodes, weights = leggauss(_NODES)
    y = half * nodes

    def kernel(u: np.ndarray) -> np.ndarray:
        z = (y - (1 - smoothing) * u[:, None]) / smoothing - shift
        density = np.exp(-(z**2) / 2) / (math.sqrt(2 * math.pi) * smoothing)
        return np.asarray(half * weights * density)

    runs = np.linalg.solve(np.eye(_NODES) - kernel(y), np.ones(_NODES))
    return float(1 + (kernel(np.zeros(1)) @ runs)[0])


@cache
def ewma_limit(smoothing: float, run: float) -> float:
    """Return the limit, in standard deviations of the EWMA, with a mean run length in control."""
    low, high = 0.0, _WIDEST
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        if mean_run_length(smoothing, middle) < run:
            low = middle
        else:
            high = middle
    return (low + high) / 2


SIZE = len(PARAMETERS)
_CELLS = 20_000  #: Sessions processed together: their arrays take some 100 MB.


@dataclass(frozen=True, eq=False)
class Block:
    """u units of one type, n sessions each, by date."""

    rows: NDArray[np.int64]  #: (u, n) of the sessions.
    months: Floats  #: (u, n) relative to the newest session of each, zero or less.
    values: Floats  #: (u, 24, n) SI units, NaN if not estimated.
    #: (u, 24, n) variances; infinite without a value. A session that states none has the typical
    #: variance of the type.
    stated: Floats

    @property
    def design(self) -> Floats:
        """Return the design matrix of each unit's line for its scatter, (u, 24, n, 2).

        The slope is omitted with fewer than four sessions of the parameter: with three, a line has
        one degree of freedom.
        """
        enough = np.isfinite(self.stated).sum(axis=-1) > _NO_SLOPE
        months = np.where(enough[..., None], self.months[:, None], 0.0)
        return np.stack([np.ones(self.values.shape), months], axis=-1)

    @property
    def mean_stated(self) -> Floats:
        """Return the mean stated variance of a session, (u, 24); zero without a session."""
        there = np.isfinite(self.stated)
        total = np.sum(np.where(there, self.stated, 0.0), axis=-1)
        return np.asarray(total / np.maximum(there.sum(axis=-1), 1))

    def parts(self) -> Iterator[slice]:
        """Yield slices of units to be processed together."""
        step = max(1, _CELLS // self.months.shape[1])
        for start in range(0, len(self.months), step):
            yield slice(start, start + step)

    def part(self, which: slice | NDArray[np.int64]) -> Block:
        """Return some of the units."""
        return Block(self.rows[which], self.months[which], self.values[which], self.stated[which])


_SHORTEST = 1.0
"""Months: sessions within less give no slope, as those of one date. It would be stated per month,
and dates years ahead follow from it: what changes within days (repairs, turn-on, weather) is no
drift. A judgement."""

_NO_SLOPE = 3
"""Sessions with which a line has one degree of freedom: too few for a slope in the scatter."""


def units_of(sessions: Sequence[int], found: Sessions) -> dict[tuple[str, str], list[int]]:
    """Return the rows of each unit by date, keyed by (type, serial number)."""
    units: dict[tuple[str, str], list[int]] = defaultdict(list)
    for row in sessions:
        units[found.imu[row], found.serial[row]].append(row)
    # Sorting keeps the order of sessions with equal dates.
    return {
        unit: [rows[k] for k in np.argsort(found.date[rows], kind='stable')]
        for unit, rows in sorted(units.items())
    }


def block(rows: NDArray[np.int64], found: Sessions, typical: Floats) -> Block:
    """Return a block of units with their sessions.

    Rows (u, n) are by date, negative without a session; sessions that state no variance have the
    typical one, (24,).
    """
    none = rows < 0
    date = found.date[rows].astype('datetime64[s]').astype(np.int64) / 86400.0
    newest = np.max(np.where(none, -np.inf, date), axis=1, keepdims=True)
    months = np.where(none, 0.0, (date - newest) / MONTH_DAYS)
    months[months.min(axis=1) > -_SHORTEST] = 0.0
    values = np.moveaxis(np.where(none[..., None], np.nan, found.values[rows]), 1, 2)
    stated = np.moveaxis(stated_variance(found.covariance[rows]), 1, 2)
    stated = np.where(np.isnan(stated), typical[:, None], stated)
    return Block(rows, months, values, np.where(np.isfinite(values), stated, np.inf))


def blocks(units: Sequence[Sequence[int]], found: Sessions, typical: Floats) -> list[Block]:
    """Return blocks of units with equal numbers of sessions."""
    by_count: dict[int, list[Sequence[int]]] = defaultdict(list)
    for rows in units:
        by_count[len(rows)].append(rows)
    return [block(np.array(rows), found, typical) for _, rows in sorted(by_count.items())]


def sample(units: Sequence[Sequence[int]], found: Sessions, typical: Floats) -> Block:
    """Return some units of a type in one block, padded with sessions without weight."""
    some = [units[int(k)] for k in sampled(len(units))]
    most = max(len(rows) for rows in some)
    rows = np.full((len(some), most), -1)
    for k, mine in enumerate(some):
        rows[k, : len(mine)] = mine
    return block(rows, found, typical)


def stated_variance(covariance: Floats) -> Floats:
    """Return the diagonals of covariances (..., p, p); NaN where none is stated."""
    stated = np.diagonal(covariance, axis1=-2, axis2=-1)
    return np.where(np.isfinite(stated) & (stated >= 0), stated, np.nan)


def typical_variance(covariance: Floats) -> Floats:
    """Return the median of the stated variances, (24,); zero without any."""
    stated = stated_variance(covariance)
    known = np.isfinite(stated)
    some = known.any(axis=0)
    median = np.nanmedian(np.where(known | ~some, np.where(some, stated, 0.0), np.nan), axis=0)
    return np.asarray(np.where(some, median, 0.0))


_CLIPPED = 3.0
"""Normal scores beyond which a session is clipped in the estimate of correlations. One normal score
in 370 is beyond."""
_PER_PARAMETER = 2
"""Sessions of other units per parameter for the estimate of correlations: with fewer, T^2 has
hardly any power (its F distribution has too few degrees of freedom)."""


def chart_limits(rules: Rules) -> ChartLimits:
    """Return the limits for a false alarm rate of all parameters of a unit together."""
    run = SIZE / rules.false_alarm
    return ChartLimits(
        individuals=float(-scipy.special.ndtri(1 / run / 2)),
        ewma=ewma_limit(rules.smoothing, run) * ewma_std(rules.smoothing),
        parameter_run=run,
        unit_run=1 / rules.false_alarm,
    )


def scores_of(block: Block, prior: Prior) -> Floats:
    """Return the normal scores (u, n, 24) of sessions relative to the preceding ones.

    The recursive residual w = y - mean of the predecessors has the variance f (h + 1 / sum of their
    1 / h), h = v + t; f is estimated from the preceding residuals and the type (Brown, Durbin &
    Evans 1975; Quesenberry 1991, case of unknown mean and variance).
    """
    count = block.months.shape[1]
    shape = block.values.shape[:2]
    total, sums, square, freedom = (np.zeros(shape) for _ in range(4))
    found = np.full((shape[0], count, SIZE), np.nan)
    for i in range(count):
        variance = block.stated[..., i] + prior.between
        there = np.isfinite(block.stated[..., i])
        y = np.where(there, block.values[..., i], 0.0)
        weight = np.where(there, 1 / np.maximum(variance, np.finfo(float).tiny), 0.0)
        before = there & (total > 0)
        spread = variance + np.divide(1.0, total, out=np.zeros(shape), where=total > 0)
        mean = np.divide(sums, total, out=np.zeros(shape), where=total > 0)
        own = np.where(before, (y - mean) / np.sqrt(np.where(before, spread, 1.0)), 0.0)
        scale, known = prior.moderated(square, freedom)
        determined = before & (known > 0) & (scale > 0)
        t = np.divide(own, np.sqrt(np.where(determined, scale, 1.0)))
        found[:, i] = np.where(determined, _normal(t, np.where(determined, known, 1.0)), np.nan)
        square += own**2
        freedom += before
        total += weight
        sums += weight * y
    return found


def _normal(t: Floats, freedom: Floats) -> Floats:
    """Return the normal deviate with the probability of a Student deviate."""
    chance = np.maximum(scipy.special.stdtr(freedom, -np.abs(t)), np.finfo(float).tiny)
    return np.asarray(-np.sign(t) * scipy.special.ndtri(chance))


def ewma_of(scores: Floats, smoothing: float) -> Floats:
    """Return the EWMA (u, n, 24) of scores; missing ones are skipped."""
    found = np.full(scores.shape, np.nan)
    at = np.zeros((len(scores), SIZE))
    for i in range(scores.shape[1]):
        there = np.isfinite(scores[:, i])
        at = np.where(there, smoothing * np.nan_to_num(scores[:, i]) + (1 - smoothing) * at, at)
        found[:, i] = np.where(there, at, np.nan)
    return found


class Correlations:
    """Correlations of the scores of one session, from the units of a type.

    Scores of a unit are compared with those of all others: the sum of their squares S over m
    sessions gives T^2 = m q' S^-1 q, and T^2 (m - p + 1) / (m p) has an F distribution with
    (p, m - p + 1) degrees of freedom.

    Args:
        scores: (u, n, 24) of all units.
    """

    def __init__(self, scores: list[Floats]) -> None:
        flat = [_complete_scores(one) for one in scores]
        self._sum = sum((q.T @ q for q in flat), np.zeros((SIZE, SIZE)))
        self._count = sum(len(q) for q in flat)

    def t2(self, scores: Floats, false_alarm: float) -> tuple[Floats, Floats, Floats]:
        """Return T^2 of the sessions of one unit, its limits, and its probabilities, (n,) each.

        Args:
            scores: (n, 24) NaN if unknown; T^2 is NaN if the others have too few sessions.
            false_alarm: At each session.
        """
        own = _complete_scores(scores)
        others = self._sum - own.T @ own
        m = self._count - len(own)
        found = tuple(np.full(len(scores), np.nan) for _ in range(3))
        there = np.isfinite(scores)
        for pattern in np.unique(there, axis=0):
            p = int(pattern.sum())
            if p == 0 or m < _PER_PARAMETER * p:
                continue
            which = np.flatnonzero(np.all(there == pattern, axis=1))
            part = others[np.ix_(pattern, pattern)]
            q = scores[which][:, pattern]
            t2 = m * np.sum(q * np.linalg.solve(part, q.T).T, axis=1)
            factor, rest = m * p / (m - p + 1), float(m - p + 1)
            found[0][which] = t2
            found[1][which] = factor * scipy.special.fdtri(float(p), rest, 1 - false_alarm)
            found[2][which] = scipy.special.fdtrc(float(p), rest, t2 / factor)
        return found[0], found[1], found[2]


def _complete_scores(scores: Floats) -> Floats:
    """Return the scores (m, 24) of sessions with all parameters, outliers clipped."""
    flat = scores.reshape(-1, SIZE)
    return np.clip(flat[np.isfinite(flat).all(axis=1)], -_CLIPPED, _CLIPPED)


def signals_of(
    scores: Floats,
    ewma: Floats,
    t2: Floats,
    t2_limit: Floats,
    limits: ChartLimits,
    names: tuple[str, ...],
) -> tuple[Signal, ...]:
    """Return the signals of a unit's charts, by session."""
    found = [
        Signal(chart, int(i), names[p], float(shown[i, p]), limit)
        for chart, shown, limit in (
            (Chart.INDIVIDUALS, scores, limits.individuals),
            (Chart.EWMA, ewma, limits.ewma),
        )
        for i, p in np.argwhere(np.abs(shown) > limit)
    ]
    found += [
        Signal(Chart.T2, int(i), '', float(t2[i]), float(t2_limit[i]))
        for i in np.flatnonzero(t2 > t2_limit)
    ]
    return tuple(sorted(found, key=lambda one: one.index))


# Source: partial t test of a step in addition to line and steps, at every place and in every
# parameter, the probability multiplied by their number (Bonferroni); docs/history.md, 'Steps'.

_MOST = 5  #: Most steps of one parameter: more are not steps but another course.
_DISTINCT = 1e-6
"""Share of a step that is independent of line and steps, below which it is one of them."""


@dataclass(frozen=True, eq=False)
class StepPlaces:
    """Steps of the units of a block: for each parameter, the first sessions after them."""

    #: Sessions by (unit, parameter), indices in the block; without steps there is no entry.
    by_parameter: dict[tuple[int, int], tuple[int, ...]]
    #: (u, 24) smallest step at the newest session that would be one; NaN without a test, and where
    #: a step is found.
    least: Floats

    def of_unit(self, unit: int) -> dict[int, list[int]]:
        """Return the parameters that step, by the first session after the step."""
        found: dict[int, list[int]] = {}
        for (u, p), places in self.by_parameter.items():
            if u == unit:
                for k in places:
                    found.setdefault(k, []).append(p)
        return dict(sorted(found.items()))


def find_steps(block: Block, weights: Floats, prior: Prior, false_alarm: float) -> StepPlaces:
    """Return the steps of units, with a false step in at most one unit of 1 / false_alarm.

    Args:
        block: u units.
        weights: (u, 24, n) of the sessions.
        prior: Of their type.
        false_alarm: For all places and parameters of a unit together.
    """
    count = block.months.shape[1]
    if count < FEWEST_FOR_A_STEP:
        return StepPlaces({}, np.full(weights.shape[:2], np.nan))
    level = false_alarm / (SIZE * (count - 1))
    design = line_design(block.months)[:, None]
    at = fit(design, weights, block.values)
    t, freedom = (np.zeros((*weights.shape[:2], count)) for _ in range(2))
    for k in range(1, count):
        t[..., k], freedom[..., k], std = _t_at(k, design, weights, at, prior)
    least = std * scipy.special.stdtrit(np.maximum(freedom[..., -1], 1.0), 1 - level / 2)
    found = {}
    for u, p in np.argwhere(np.min(chance_of(t, freedom), axis=-1) < level):
        places: tuple[int, ...] = (int(np.argmax(t[u, p])),)
        own = (block.months[u], weights[u, p], block.values[u, p])
        one = Prior(prior.between[p], prior.scale[p], prior.freedom[p])
        while len(places) < _MOST and (more := _next(places, *own, one, level)) is not None:
            places = tuple(sorted((*places, more)))
        found[int(u), int(p)] = places
        least[u, p] = np.nan
    return StepPlaces(found, least)


def step_design(months: Floats, places: tuple[int, ...]) -> Floats:
    """Return the columns of a line with steps, (n, 2 + s): its level is that after the last step.

    A place is the first session after a step.
    """
    before = np.arange(len(months))[:, None] < np.array(places, dtype=int)
    return np.column_stack([line_design(months), -before.astype(float)])


def _next(
    places: tuple[int, ...],
    months: Floats,
    weights: Floats,
    values: Floats,
    prior: Prior,
    level: float,
) -> int | None:
    """Return the place of a further step of one parameter, None if none is significant."""
    design = step_design(months, places)
    at = fit(design, weights, values)
    t, freedom = np.zeros(len(months)), np.zeros(len(months))
    for k in set(range(1, len(months))) - set(places):
        t[k], freedom[k], _ = _t_at(k, design, weights, at, prior)
    # By t: the probabilities of large values are all zero.
    best = int(np.argmax(t))
    return best if chance_of(t, freedom)[best] < level else None


def _t_at(
    place: int, design: Floats, weights: Floats, at: Fit, prior: Prior
) -> tuple[Floats, Floats, Floats]:
    """Return absolute t (...) of a step at a session in addition to the fit, and its freedom.

    Both are zero without information.

    Returns:
        These, and the standard deviation of the step's size; NaN without information.
    """
    after = slice(place, None)
    along = np.sum((weights * at.residuals)[..., after], axis=-1)
    crossed = np.sum(weights[..., after, None] * design[..., after, :], axis=-2)
    explained = np.einsum('...i,...ij,...j->...', crossed, at.inverse, crossed)
    own = np.sum(weights[..., after], axis=-1)
    unexplained = own - explained
    determined = unexplained > _DISTINCT * own
    gain = np.divide(along**2, unexplained, out=np.zeros_like(along), where=determined)
    rest = np.maximum(at.square - gain, 0.0)
    scale, freedom = prior.moderated(rest, np.maximum(at.freedom - 1.0, 0.0))
    determined = (
        determined
        & (freedom > 0)
        & (np.sum(weights > 0, axis=-1) >= FEWEST_FOR_A_STEP)
        & (scale > 0)
    )
    t = np.sqrt(np.divide(gain, scale, out=np.zeros_like(gain), where=determined))
    variance = np.divide(scale, unexplained, out=np.full_like(gain, np.nan), where=determined)
    return t, np.where(determined, freedom, 0.0), np.sqrt(variance)


def chance_of(t: Floats, freedom: Floats) -> Floats:
    """Return the two-sided p-value of Student's t; 1 without freedom."""
    some = freedom > 0
    return np.where(some, 2 * scipy.special.stdtr(np.where(some, freedom, 1.0), -np.abs(t)), 1.0)
