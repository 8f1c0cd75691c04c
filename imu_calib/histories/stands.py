"""Unit or stand: compare stands by units that were on several, and name those with a shift.

Effects of stands in all parameters are explained by as few shifts as possible (forward selection,
the probability of each multiplied by the number of shifts that were tried); docs/history.md, 'Unit
or stand?'.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from ..model import PARAMETER_NAMES, PARAMETERS
from ..stream import Floats
from .crossed import Effects, crossed, reproducibility
from .patterns import PATTERNS, Pattern
from .results import Rules, Stands, StandShift
from .sentences import listed
from .trends import quantile

_MOST = 20
"""Largest number of named shifts: with more, all stands differ from each other."""
_RANK = 1e-9
"""Ratio of an eigenvalue of a covariance to the largest, below which it is rounding."""
_DISTINCT = 1e-6
"""Independent share of a stand's column below which the other columns determine it."""


@dataclass(frozen=True, eq=False)
class _Group:
    """Stands linked by common units: their sessions, and the effects in each parameter.

    `correlation` (24, 24) is that of the sessions' residuals, and so of the effects of a stand.
    """

    stands: NDArray[np.int64]
    rows: NDArray[np.int64]
    effects: list[Effects]
    correlation: Floats


def judge_stands(
    units: NDArray[np.int64],
    names: Sequence[str],
    trends: Floats,
    values: Floats,
    variance: Floats,
    rules: Rules,
) -> Stands:
    """Compare stands.

    Args:
        units: (n,) index of each session's unit.
        names: (n) its stand; empty if unknown: such a session does not count.
        trends: (n, k) columns for the trends of the types.
        values: (n, 24) SI units.
        variance: (n, 24) of sessions.
        rules: Rules of the evaluation.
    """
    known = np.array([bool(name) for name in names], dtype=bool)
    every = sorted({name for name in names if name})
    of = np.array([every.index(name) if name else -1 for name in names], dtype=np.int64)
    groups = linked(units[known], of[known], len(every))
    effect, std = (np.full((len(every), len(PARAMETERS)), np.nan) for _ in range(2))
    spread = np.full(len(PARAMETERS), np.nan)
    found: list[StandShift] = []
    findings: list[str] = []
    judged = [g for g in groups if len(g) > 1]
    for mine in judged:
        rows = np.flatnonzero(np.isin(of, mine))
        group = _group(np.array(mine), rows, units, of, trends, values, variance)
        for p, one in enumerate(group.effects):
            effect[mine, p] = one.effect
            std[mine, p] = np.sqrt(np.maximum(np.diag(one.covariance), 0.0))
        if len(mine) == max(map(len, judged)):
            spread = np.array([reproducibility(one) for one in group.effects])
        found += _shifts(group, every, units, of, rules, len(judged))
        if not all(one.comparable for one in group.effects if one.freedom):
            findings.append(
                f'Stands {listed([every[k] for k in mine])}: they were used one after the other, '
                'and the offset of a stand cannot be separated from the drift of the units. Bring '
                'units back to a stand on which they were.'
            )
    findings += _apart([[every[k] for k in g] for g in groups], int(np.sum(~known)), len(names))
    return Stands(
        names=tuple(every),
        sessions=np.bincount(of[known], minlength=len(every)),
        units=np.array([len(np.unique(units[of == k])) for k in range(len(every))], dtype=np.int64),
        groups=tuple(tuple(every[k] for k in g) for g in groups),
        effect=effect,
        std=std,
        reproducibility=spread,
        shifts=tuple(found),
        findings=tuple(findings),
    )


def linked(units: NDArray[np.int64], stands: NDArray[np.int64], count: int) -> list[list[int]]:
    """Return the stands linked by units, directly or indirectly, largest group first."""
    if not count:
        return []
    number, total = np.unique(units, return_inverse=True)[1], len(np.unique(units))
    size = total + count
    graph = scipy.sparse.coo_matrix(
        (np.ones(len(units)), (number, total + stands)), shape=(size, size)
    )
    labels = scipy.sparse.csgraph.connected_components(graph, directed=False)[1][total:]
    groups = [np.flatnonzero(labels == one).tolist() for one in np.unique(labels)]
    return sorted(groups, key=lambda g: (-len(g), g))


def _group(
    mine: NDArray[np.int64],
    rows: NDArray[np.int64],
    units: NDArray[np.int64],
    of: NDArray[np.int64],
    trends: Floats,
    values: Floats,
    variance: Floats,
) -> _Group:
    own = np.searchsorted(mine, of[rows])
    columns = trends[rows]
    columns = columns[:, np.ptp(columns, axis=0) > 0]
    columns = columns / np.maximum(np.std(columns, axis=0), np.finfo(float).tiny)
    effects = [
        crossed(units[rows], own, columns, values[rows, p], variance[rows, p])
        for p in range(len(PARAMETERS))
    ]
    residuals = np.column_stack([one.residuals for one in effects])
    return _Group(mine, rows, effects, _correlation(residuals))


def _root(covariance: Floats) -> Floats:
    """Return the symmetric root of a covariance; zero if it is unknown."""
    values, vectors = np.linalg.eigh(np.nan_to_num(covariance))
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


def _correlation(residuals: Floats) -> Floats:
    """Return the correlations of the columns of (n, 24) residuals; NaN counts as zero."""
    known = np.nan_to_num(residuals)
    matrix = known.T @ known
    scale = np.sqrt(np.diag(matrix))
    scale = np.where(scale > 0, scale, 1.0)
    found = matrix / np.outer(scale, scale)
    np.fill_diagonal(found, 1.0)
    return np.asarray(found)


class _Tested:
    """One pattern in a group of s stands: the mean of their effects on its parameters.

    Its covariance uses only the pattern's own parameters: correlations of all 24 are too uncertain
    for weights.
    """

    def __init__(self, pattern: Pattern, group: _Group) -> None:
        self.pattern = pattern
        self.share = pattern.of / len(pattern.parameters)
        self.freedom = min(group.effects[p].freedom for p in pattern.parameters)
        s = len(group.stands)
        covariance = np.zeros((s, s))
        roots = {p: _root(group.effects[p].covariance) for p in pattern.parameters}
        for i, one in roots.items():
            for j, other in roots.items():
                weight = self.share[i] * self.share[j] * group.correlation[i, j]
                covariance += weight * (one @ other + other @ one) / 2
        values, vectors = np.linalg.eigh(covariance)
        good = values > _RANK * max(float(values[-1]), 0.0)
        self._white = (vectors[:, good] / np.sqrt(values[good])).T
        self._columns = self._white @ (np.eye(s) - 1 / s)
        self.chosen: list[int] = []

    def partial(self, effect: Floats) -> Floats:
        """Return absolute t (s,) of each stand beyond the selected ones, from (s, 24) effects."""
        columns, rest = self._columns, self._white @ effect @ self.share
        if self.chosen:
            basis = np.linalg.qr(columns[:, self.chosen])[0]
            columns, rest = columns - basis @ (basis.T @ columns), rest - basis @ (basis.T @ rest)
        own, before = np.sum(columns**2, axis=0), np.sum(self._columns**2, axis=0)
        distinct = own > _DISTINCT * before
        return np.asarray(
            np.abs(
                np.divide(columns.T @ rest, np.sqrt(own), out=np.zeros(len(own)), where=distinct)
            )
        )

    def sizes(self, effect: Floats) -> tuple[Floats, Floats]:
        """Return the joint sizes of the selected shifts, and their standard deviations."""
        columns = self._columns[:, self.chosen]
        inverse = np.linalg.inv(columns.T @ columns)
        size = inverse @ (columns.T @ (self._white @ effect @ self.share))
        return size, np.sqrt(np.diag(inverse))

    def added(self, size: Floats) -> Floats:
        """Return the effects of the selected stands (s, 24), minus the mean of all stands."""
        s = self._columns.shape[1]
        return np.outer((np.eye(s) - 1 / s)[:, self.chosen] @ size, self.pattern.of)


def _shifts(
    group: _Group,
    every: Sequence[str],
    units: NDArray[np.int64],
    of: NDArray[np.int64],
    rules: Rules,
    groups: int,
) -> Iterator[StandShift]:
    """Yield the shifts of stands in a group, pattern by pattern."""
    tried = [
        _Tested(pattern, group)
        for pattern in PATTERNS
        if all(group.effects[p].comparable for p in pattern.parameters)
    ]
    s = len(group.stands)
    tests = groups * len(tried) * s
    effect = np.nan_to_num(np.column_stack([one.effect for one in group.effects]))
    explained = {one.pattern.name: np.zeros_like(effect) for one in tried}
    alternatives: dict[tuple[str, int], NDArray[np.bool_]] = {}
    while tried and len(alternatives) < _MOST:
        rest = effect - sum(explained.values())
        t = np.array([one.partial(rest + explained[one.pattern.name]) for one in tried])
        freedom = np.array([[one.freedom] for one in tried], dtype=float)
        chance = 2 * scipy.special.stdtr(freedom, -t) * tests
        # By t: the probabilities of large values are all zero.
        i, k = divmod(int(np.argmax(t)), s)
        if not chance[i, k] < rules.false_alarm:
            break
        best = tried[i]
        # Odds of two stands with equal prior probabilities: exp of half of this.
        near = t[i] ** 2 > t[i, k] ** 2 + 2 * np.log(rules.false_alarm)
        alternatives[best.pattern.name, k] = near & (np.arange(s) != k)
        best.chosen.append(k)
        own = rest + explained[best.pattern.name]
        explained[best.pattern.name] = best.added(best.sizes(own)[0])
    total = sum(explained.values(), np.zeros_like(effect))
    for one in tried:
        if one.chosen:
            size, std = one.sizes(effect - total + explained[one.pattern.name])
            for place, value, deviation in zip(one.chosen, size, std, strict=True):
                near = alternatives[one.pattern.name, place]
                yield _shift(
                    group,
                    one,
                    (place, float(value), float(deviation), near),
                    every,
                    units,
                    of,
                    tests,
                    rules,
                )


def _shift(
    group: _Group,
    tested: _Tested,
    found: tuple[int, float, float, NDArray[np.bool_]],
    every: Sequence[str],
    units: NDArray[np.int64],
    of: NDArray[np.int64],
    tests: int,
    rules: Rules,
) -> StandShift:
    """Return one shift of one stand: its index in the group, size, deviation, and alternatives."""
    k, size, std, near = found
    names = [every[q] for q in group.stands]
    doubtful = [name for name, also in zip(names, near, strict=True) if also]
    freedom = np.array(float(tested.freedom))
    reach = float(quantile(freedom, 1 - (1 - rules.confidence) / tests)) * std
    chance = 2 * float(scipy.special.stdtr(freedom, -abs(size) / std)) * tests
    return StandShift(
        stand=names[k],
        others=tuple(doubtful or [name for name in names if name != names[k]]),
        identified=not doubtful,
        what=tested.pattern.name,
        parameters=tuple(PARAMETER_NAMES[p] for p in tested.pattern.parameters),
        unit=tested.pattern.unit,
        shift=float(size),
        std=float(std),
        low=float(size - reach),
        high=float(size + reach),
        chance=min(1.0, chance),
        units=_shared(units[group.rows], of[group.rows], int(group.stands[k])),
    )


def _shared(units: NDArray[np.int64], of: NDArray[np.int64], stand: int) -> int:
    """Return the number of units that were on a stand and on another."""
    return len(np.intersect1d(units[of == stand], units[of != stand]))


def corrections(stands: Stands, names: Sequence[str]) -> Floats:
    """Return the correction of each session (n, 24), SI units: the shift of its stand."""
    by_name = {pattern.name: pattern.of for pattern in PATTERNS}
    found = np.zeros((len(names), len(PARAMETERS)))
    of = np.array(names)
    for one in stands.shifts:
        found[of == one.stand] += one.shift * by_name[one.what]
    return found


def _apart(groups: list[list[str]], unknown: int, sessions: int) -> list[str]:
    """Return sentences on stands that cannot be compared, with reasons."""
    if not sessions:
        return []
    if unknown == sessions:
        return ['No session says on which stand it was: offsets of stands are attributed to units.']
    found = []
    if unknown:
        found.append(
            f'{unknown} of {sessions} sessions do not say on which stand they were: they are not '
            'used to compare stands.'
        )
    if len(groups) == 1 and len(groups[0]) == 1:
        found.append(
            f'All sessions were on one stand, {groups[0][0]}: its offset cannot be separated from '
            'the errors of the units. Calibrate some of them on another.'
        )
    if len(groups) > 1:
        parts = '; '.join(listed(group) for group in groups)
        found.append(
            f'No unit links these stands: {parts}. The offset of a stand cannot be separated from '
            'the errors of its units: calibrate some units on both sides.'
        )
    return found
