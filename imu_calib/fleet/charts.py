"""Control charts of units: each session is compared with the preceding ones.

Self-starting: a session minus the mean of its predecessors, over the scatter of these and of the
type, is a Student deviate. Its normal score is used in the individuals chart, EWMA and T^2, whose
false alarms are then those of a process with known mean and scatter. Sources: Quesenberry 1991 (Q
charts), Hawkins 1987, Lucas & Saccucci 1990, Hotelling 1947; docs/history.md.
"""

from __future__ import annotations

import numpy as np
import scipy

from ..common.stream import Floats
from .blocks import SIZE, Block
from .results import Chart, ChartLimits, Rules, Signal
from .run_length import ewma_limit, ewma_std
from .scatter import Prior

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
        flat = [_whole(one) for one in scores]
        self._sum = sum((q.T @ q for q in flat), np.zeros((SIZE, SIZE)))
        self._count = sum(len(q) for q in flat)

    def t2(self, scores: Floats, false_alarm: float) -> tuple[Floats, Floats, Floats]:
        """Return T^2 of the sessions of one unit, its limits, and its probabilities, (n,) each.

        Args:
            scores: (n, 24) NaN if unknown; T^2 is NaN if the others have too few sessions.
            false_alarm: At each session.
        """
        own = _whole(scores)
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


def _whole(scores: Floats) -> Floats:
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
