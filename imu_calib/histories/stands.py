"""Unit or stand: compare stands by units that were on several, and name those with a shift.

Effects of stands in all parameters are explained by as few shifts as possible (forward selection,
common causes before single parameters, the probability of each multiplied by the number of shifts
that were tried); docs/history.md, 'Unit or stand?'.
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


class _Block:
    """Patterns that share parameters, in a group of s stands, as one least-squares problem.

    Effects of stands on all k parameters of the block are weighed by their covariance, that of the
    stands times the correlations of the parameters, so that all shifts are fitted together. The
    correlations of all 24 would be too uncertain for that; those of a block are drawn towards zero
    by the share of k parameters in their degrees of freedom.
    """

    def __init__(self, block: Sequence[Pattern], group: _Group) -> None:
        self.patterns = list(block)
        parameters = sorted({p for pattern in block for p in pattern.parameters})
        k, s = len(parameters), len(group.stands)
        effects = [group.effects[p] for p in parameters]
        freedom = min(one.freedom for one in effects)
        # The correlations are estimated, and cost degrees of freedom (Rao 1967).
        self.freedom = max(freedom - (k - 1), 1)
        correlation = group.correlation[np.ix_(parameters, parameters)]
        correlation = correlation + k / (k + freedom) * (np.eye(k) - correlation)
        roots = [_root(one.covariance) for one in effects]
        covariance = np.block(
            [
                [
                    correlation[i, j] * (one @ other + other @ one) / 2
                    for j, other in enumerate(roots)
                ]
                for i, one in enumerate(roots)
            ]
        )
        covariance *= freedom / self.freedom
        values, vectors = np.linalg.eigh(covariance)
        good = values > _RANK * max(float(values[-1]), 0.0)
        white = (vectors[:, good] / np.sqrt(values[good])).T
        shift = np.eye(s) - 1 / s
        # Columns (pattern, stand), each on all effects (parameter, stand).
        made = [np.kron(pattern.of[parameters][:, None], shift) for pattern in block]
        self._columns = white @ np.hstack(made)
        self._stands = s
        effect = np.nan_to_num(np.concatenate([one.effect for one in effects]))
        self._effect = white @ effect
        self.chosen: list[int] = []

    def partial(self) -> Floats:
        """Return absolute t (patterns, s) of each shift beyond the selected ones."""
        columns, rest = self._columns, self._effect
        if self.chosen:
            basis = np.linalg.qr(columns[:, self.chosen])[0]
            columns, rest = columns - basis @ (basis.T @ columns), rest - basis @ (basis.T @ rest)
        own, before = np.sum(columns**2, axis=0), np.sum(self._columns**2, axis=0)
        distinct = own > _DISTINCT * before
        t = np.divide(columns.T @ rest, np.sqrt(own), out=np.zeros(len(own)), where=distinct)
        return np.asarray(np.abs(t).reshape(len(self.patterns), self._stands))

    def choose(self, pattern: int, stand: int) -> None:
        """Select a shift."""
        self.chosen.append(pattern * self._stands + stand)

    def sizes(self) -> tuple[Floats, Floats]:
        """Return the joint sizes of the selected shifts, and their standard deviations."""
        columns = self._columns[:, self.chosen]
        inverse = np.linalg.inv(columns.T @ columns)
        return inverse @ (columns.T @ self._effect), np.sqrt(np.diag(inverse))

    def places(self) -> list[tuple[int, int]]:
        """Return pattern and stand of the selected shifts."""
        return [divmod(column, self._stands) for column in self.chosen]


def _blocks(group: _Group) -> list[_Block]:
    """Return the blocks of a group: a common cause with its parameters, and single parameters."""
    left = [p for p in PATTERNS if all(group.effects[k].comparable for k in p.parameters)]
    blocks = []
    for common in [pattern for pattern in left if len(pattern.parameters) > 1]:
        mine = [p for p in left if set(p.parameters) <= set(common.parameters)]
        blocks.append(_Block(mine, group))
        left = [p for p in left if p not in mine]
    return [*blocks, *(_Block([pattern], group) for pattern in left)]


def _shifts(
    group: _Group,
    every: Sequence[str],
    units: NDArray[np.int64],
    of: NDArray[np.int64],
    rules: Rules,
    groups: int,
) -> Iterator[StandShift]:
    """Yield the shifts of stands in a group, block by block."""
    blocks = _blocks(group)
    tests = groups * len(group.stands) * sum(len(block.patterns) for block in blocks)
    alternatives: dict[tuple[str, int], NDArray[np.bool_]] = {}
    while blocks and len(alternatives) < _MOST:
        found = [_next_shift(block, tests, rules.false_alarm) for block in blocks]
        most = max(range(len(found)), key=lambda b: found[b][0])
        t, i, k, near = found[most]
        if not t:
            break
        alternatives[blocks[most].patterns[i].name, k] = near
        blocks[most].choose(i, k)
    for block in blocks:
        if not block.chosen:
            continue
        for (i, k), size, std in zip(block.places(), *block.sizes(), strict=True):
            pattern = block.patterns[i]
            shift = k, float(size), float(std), alternatives[pattern.name, k]
            yield _shift(group, pattern, block.freedom, shift, every, units, of, tests, rules)


def _next_shift(
    block: _Block, tests: int, false_alarm: float
) -> tuple[float, int, int, NDArray[np.bool_]]:
    """Return the most significant further shift of a block.

    A common cause goes before single parameters, unless one of these has better odds: a shift of
    all by one size is an accident otherwise.

    Returns:
        Absolute t, 0 if none is significant, pattern and stand, and which other stands (s,) may be
        meant.
    """
    t = block.partial()
    chance = 2 * scipy.special.stdtr(float(block.freedom), -t) * tests
    # Odds of two shifts with equal prior probabilities: exp of half of the difference of squares.
    alike = t**2 > t.max() ** 2 + 2 * np.log(false_alarm)
    common = np.array([len(pattern.parameters) > 1 for pattern in block.patterns])
    first = alike & common[:, None] & (chance < false_alarm)
    # By t: the probabilities of large values are all zero.
    i, k = divmod(int(np.argmax(np.where(first, t, 0.0) if first.any() else t)), t.shape[1])
    near = t[i] ** 2 > t[i, k] ** 2 + 2 * np.log(false_alarm)
    size = float(t[i, k]) if chance[i, k] < false_alarm else 0.0
    return size, i, k, near & (np.arange(t.shape[1]) != k)


def _shift(
    group: _Group,
    pattern: Pattern,
    freedom: int,
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
    reach = float(quantile(np.array(float(freedom)), 1 - (1 - rules.confidence) / tests)) * std
    chance = 2 * float(scipy.special.stdtr(float(freedom), -abs(size) / std)) * tests
    return StandShift(
        stand=names[k],
        others=tuple(doubtful or [name for name in names if name != names[k]]),
        identified=not doubtful,
        what=pattern.name,
        parameters=tuple(PARAMETER_NAMES[p] for p in pattern.parameters),
        unit=pattern.unit,
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
