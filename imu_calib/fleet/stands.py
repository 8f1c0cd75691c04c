"""Unit or stand: compare stands by units that were on several, and name those with a shift.

Effects of stands in all parameters are explained by as few shifts as possible (forward selection,
common causes before single parameters, the probability of each multiplied by the number of shifts
that were tried); docs/history.md, 'Unit or stand?'.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from ..common.stream import Floats
from ..model.parameters import AXES, PARAMETER_NAMES, PARAMETERS, ParameterKind
from .results import Rules, Stands, StandShift
from .sentences import listed
from .trends import quantile

# The crossed model of units and stands: the effect of a stand on every unit.
#
# A session is unit + stand + trend of the type + scatter. Units are fixed effects: only differences
# of a unit between stands determine the effects of stands, however much units differ. Source: Huber
# 1981, 7.6 and 7.7 (robust regression, its covariance and scale); docs/history.md, 'Unit or
# stand?'.


_TUNING = 2.0
"""Standard deviations beyond which the weight of a session is limited: 99 % efficient for normal
residuals, and robust to a repaired unit."""
_NORMAL = (
    math.erf(_TUNING / math.sqrt(2))
    - 2 * _TUNING * math.exp(-(_TUNING**2) / 2) / math.sqrt(2 * math.pi)
    + _TUNING**2 * math.erfc(_TUNING / math.sqrt(2))
)
"""Mean square of normal residuals limited at that (Huber 1964, proposal 2). The scale comes
from it and uses all degrees of freedom: the median deviation of a dozen sessions is so uncertain
that t exceeded the limit of Student's t ten times too often."""
_ROUNDS = 100  #: Largest number of reweighting iterations; they end when no weight changes.
_SETTLED = 1e-4  #: Change of a weight below which iterations end.
_CROSSED_RANK = 1e-9
"""Singular values, of columns scaled to one, that count as zero: far above rounding (1e-14 with
some hundred sessions), far below any design that separates stands (1 / sessions)."""
_STEPS = 100
"""Largest number of scoring steps; they end when the variance changes by less than 1e-9 of
itself."""


@dataclass(frozen=True, eq=False)
class Effects:
    """Effects of s stands on one parameter."""

    effect: Floats  #: (s,) of a stand minus the mean of all.
    covariance: Floats  #: (s, s) of these, of rank s - 1.
    freedom: int  #: Degrees of freedom.
    #: (n,) of the sessions over their standard deviations, outliers clipped; NaN if a session does
    #: not count.
    residuals: Floats
    comparable: bool  #: Whether all stands can be compared.


def crossed(
    units: NDArray[np.int64],
    stands: NDArray[np.int64],
    trends: Floats,
    values: Floats,
    variance: Floats,
) -> Effects:
    """Return the effects of stands on one parameter.

    Args:
        units: (n,) index of each session's unit.
        stands: (n,) index of its stand, from 0 without gaps.
        trends: (n, k) further columns.
        values: (n,) NaN if a session does not count.
        variance: (n,) of sessions, up to a common factor.
    """
    count = int(stands.max()) + 1
    there = np.isfinite(values) & np.isfinite(variance)
    own = np.unique(units[there], return_inverse=True)[1]
    size = np.bincount(own)
    weight = 1 / np.maximum(variance[there], np.finfo(float).tiny)
    columns = np.column_stack([np.eye(count)[stands[there]], trends[there], values[there]])
    plain = _centred_by_unit(columns, own, weight)
    rank = _rank(plain[:, :-1], weight)
    rest = int(there.sum()) - len(size) - rank
    comparable = rank == columns.shape[1] - 2
    if rest < 1 or rank == 0:
        unknown = np.full(count, np.nan)
        empty = np.full(len(values), np.nan)
        return Effects(unknown, np.full((count, count), np.nan), max(rest, 0), empty, False)
    # The mean of a unit reduces each of its residuals.
    share = np.sqrt(np.maximum(1 - 1 / size[own], 0.0))
    trust = np.ones(len(own))
    for _ in range(_ROUNDS):
        less = _centred_by_unit(columns, own, weight * trust)
        coefficients, _ = _solved(less[:, :-1], weight * trust, less[:, -1])
        deviations = (less[:, -1] - less[:, :-1] @ coefficients) * np.sqrt(weight)
        z = np.divide(deviations, share, out=np.zeros_like(deviations), where=share > 0)
        scale = float(np.sqrt(np.sum((deviations * trust) ** 2) / rest / _NORMAL))
        bound = np.maximum(_TUNING * scale, np.finfo(float).tiny)
        before = trust
        trust = bound / np.maximum(np.abs(z), bound)
        if np.max(np.abs(trust - before)) < _SETTLED:
            break
    bounded = deviations * trust
    whole = float(np.mean(trust[share > 0] == 1.0))
    parameters = len(size) + rank
    kappa = 1 + parameters / len(own) * (1 - whole) / whole
    factor = kappa**2 * float(np.sum(bounded**2)) / rest / whole**2
    _, inverse = _solved(plain[:, :-1], weight, plain[:, -1])
    residuals = np.full(len(values), np.nan)
    residuals[there] = bounded
    return Effects(
        coefficients[:count],
        factor * inverse[:count, :count],
        rest,
        residuals,
        comparable,
    )


def reproducibility(effects: Effects) -> float:
    """Return the standard deviation between stands, by restricted maximum likelihood.

    Along the eigenvectors of the contrasts' covariance each has the variance t + lambda.
    """
    count = len(effects.effect)
    if not effects.comparable or count < 2:
        return float('nan')
    centred = np.linalg.svd(np.eye(count) - 1 / count)[0][:, : count - 1]
    own, vectors = np.linalg.eigh(centred.T @ effects.covariance @ centred)
    square = (vectors.T @ centred.T @ effects.effect) ** 2
    own = np.maximum(own, 0.0)
    found = float(np.mean(square))
    for _ in range(_STEPS):
        weights = 1 / np.maximum(own + found, np.finfo(float).tiny)
        step = np.sum(weights**2 * (square - own - found)) / np.sum(weights**2)
        after = max(found + float(step), 0.0)
        if abs(after - found) <= 1e-9 * max(after, found):
            break
        found = after
    return float(np.sqrt(found))


def _centred_by_unit(columns: Floats, units: NDArray[np.int64], weight: Floats) -> Floats:
    """Return columns (n, p) minus their weighted mean over the sessions of each unit."""
    total = np.bincount(units, weight)
    means = np.column_stack([np.bincount(units, weight * one) / total for one in columns.T])
    return np.asarray(columns - means[units])


def _rank(columns: Floats, weight: Floats) -> int:
    matrix = columns.T @ (weight[:, None] * columns)
    scale = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    scale = np.where(scale > 0, scale, 1.0)
    return int(
        np.linalg.matrix_rank(matrix / np.outer(scale, scale), tol=_CROSSED_RANK, hermitian=True)
    )


def _solved(columns: Floats, weight: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Return the coefficients of least norm, and the pseudo-inverse of the normal matrix.

    With least norm the effects of stands have the sum zero.
    """
    matrix = columns.T @ (weight[:, None] * columns)
    inverse = np.linalg.pinv(matrix, rcond=_CROSSED_RANK, hermitian=True)
    return np.asarray(inverse @ (columns.T @ (weight * values))), np.asarray(inverse)


# Source: docs/history.md, 'Unit or stand?'.


@dataclass(frozen=True, eq=False)
class Pattern:
    """A possible shift by a stand: of one parameter, or of several together."""

    name: str  #: For display.
    shifts: Floats  #: (24,) shift of each parameter for a size of one.

    @property
    def parameters(self) -> tuple[int, ...]:
        """Return the parameters that it shifts."""
        return tuple(int(k) for k in np.flatnonzero(self.shifts))

    @property
    def unit(self) -> str:
        """Return the SI unit of its size."""
        return PARAMETERS[self.parameters[0]].unit.si


def turned(axis: int) -> Floats:
    """Return the changes of the 24 parameters by a mount rotation of 1 rad about an axis, (24,).

    A unit rotated by t measures R(t)' f: its error matrix changes by -[t x].
    """
    found = np.zeros(len(PARAMETERS))
    for k, parameter in enumerate(PARAMETERS):
        if parameter.kind is ParameterKind.MISALIGNMENT and parameter.column is not None:
            row, column = parameter.row, parameter.column
            if axis not in (row, column):
                # -[t x] has +t_z at xy, -t_z at yx, and so on cyclically.
                found[k] = 1.0 if (row + 1) % len(AXES) == column else -1.0
    return found


def patterns() -> tuple[Pattern, ...]:
    """Return the patterns to test: every parameter, and common causes of several.

    An error of gravity or of a rate at a stand scales a whole triad; a rotated fixture rotates all
    sensors.
    """
    single = [Pattern(name, row) for name, row in zip(PARAMETER_NAMES, np.eye(24), strict=True)]
    common = []
    for triad in 'ga':
        scale = [
            p.triad == triad and p.kind is ParameterKind.SCALE_FACTOR_ERROR for p in PARAMETERS
        ]
        common.append(Pattern(f'K_{triad}', np.array(scale, dtype=float)))
    return (*single, *common, *(Pattern(f'E about {a}', turned(k)) for k, a in enumerate('XYZ')))


PATTERNS = patterns()


_MOST = 20  #: Largest number of named shifts: with more, all stands differ from each other.
_RANK = 1e-9  #: Ratio of an eigenvalue of a covariance to the largest, below which it is rounding.
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
    stand_of = np.array([every.index(name) if name else -1 for name in names], dtype=np.int64)
    groups = linked(units[known], stand_of[known], len(every))
    effect, std = (np.full((len(every), len(PARAMETERS)), np.nan) for _ in range(2))
    spread = np.full(len(PARAMETERS), np.nan)
    found: list[StandShift] = []
    findings: list[str] = []
    judged = [g for g in groups if len(g) > 1]
    for mine in judged:
        rows = np.flatnonzero(np.isin(stand_of, mine))
        group = _group(np.array(mine), rows, units, stand_of, trends, values, variance)
        for p, one in enumerate(group.effects):
            effect[mine, p] = one.effect
            std[mine, p] = np.sqrt(np.maximum(np.diag(one.covariance), 0.0))
        if len(mine) == max(map(len, judged)):
            spread = np.array([reproducibility(one) for one in group.effects])
        found += _shifts(group, every, units, stand_of, rules, len(judged))
        if not all(one.comparable for one in group.effects if one.freedom):
            findings.append(
                f'Stands {listed([every[k] for k in mine])}: they were used one after the other, '
                'and the offset of a stand cannot be separated from the drift of the units. Bring '
                'units back to a stand on which they were.'
            )
    findings += _incomparable(
        [[every[k] for k in g] for g in groups], int(np.sum(~known)), len(names)
    )
    return Stands(
        names=tuple(every),
        sessions=np.bincount(stand_of[known], minlength=len(every)),
        units=np.array(
            [len(np.unique(units[stand_of == k])) for k in range(len(every))], dtype=np.int64
        ),
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
    stand_of: NDArray[np.int64],
    trends: Floats,
    values: Floats,
    variance: Floats,
) -> _Group:
    own = np.searchsorted(mine, stand_of[rows])
    columns = trends[rows]
    columns = columns[:, np.ptp(columns, axis=0) > 0]
    columns = columns / np.maximum(np.std(columns, axis=0), np.finfo(float).tiny)
    effects = [
        crossed(units[rows], own, columns, values[rows, p], variance[rows, p])
        for p in range(len(PARAMETERS))
    ]
    residuals = np.column_stack([one.residuals for one in effects])
    return _Group(mine, rows, effects, _correlation(residuals))


def _covariance(correlation: Floats, effects: Sequence[Effects]) -> Floats:
    """Return the covariance (k s, k s) of the effects of s stands on k parameters."""
    roots = [_root(one.covariance) for one in effects]
    return np.block(
        [
            [correlation[i, j] * (one @ other + other @ one) / 2 for j, other in enumerate(roots)]
            for i, one in enumerate(roots)
        ]
    )


def _root(covariance: Floats) -> Floats:
    """Return the symmetric root of a covariance."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


def _white(covariance: Floats) -> Floats:
    """Return the matrix that makes the covariance one, without directions that have none."""
    values, vectors = np.linalg.eigh(covariance)
    good = values > _RANK * max(float(values[-1]), 0.0)
    return np.asarray((vectors[:, good] / np.sqrt(values[good])).T)


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

    Shifts are found and sized with equal weights of the parameters, which have the same unit, and
    with the estimated covariance of the sum: so each t is Student's with all degrees of freedom,
    however parameters correlate and however few sessions there are. Weights from an estimated
    covariance would need corrections for its errors (Rao 1967). They only tell which of the shifts
    that are found explains the effects best.

    Attributes:
        patterns: The patterns.
        freedom: Degrees of freedom.
    """

    def __init__(self, block: Sequence[Pattern], group: _Group) -> None:
        self.patterns = list(block)
        parameters = sorted({p for pattern in block for p in pattern.parameters})
        k, s = len(parameters), len(group.stands)
        effects = [group.effects[p] for p in parameters]
        self.freedom = min(one.freedom for one in effects)
        effect = np.concatenate([one.effect for one in effects])
        shift = np.eye(s) - 1 / s
        # Columns (pattern, stand), each on all effects (parameter, stand).
        columns = np.hstack([np.kron(p.shifts[parameters][:, None], shift) for p in block])
        correlation = group.correlation[np.ix_(parameters, parameters)]
        stands = _white(np.sum([one.covariance for one in effects], axis=0))
        equal: Floats = np.asarray(np.kron(np.eye(k), stands), dtype=np.float64)
        self._columns = equal @ columns
        self._effect = equal @ effect
        self._covariance = equal @ _covariance(correlation, effects) @ equal.T
        # Correlations as weights: drawn towards zero by the share of k parameters in their freedom.
        correlation = correlation + k / (k + self.freedom) * (np.eye(k) - correlation)
        weighed = _white(_covariance(correlation, effects))
        weighed *= np.sqrt(max(self.freedom - (k - 1), 1) / self.freedom)
        self._weighed = weighed @ columns, weighed @ effect
        self._stands = s
        self._chosen: list[int] = []

    def t(self) -> Floats:
        """Return absolute t (patterns, s) of each shift beyond the selected ones."""
        columns, own = self._beyond(self._columns)
        weights = np.divide(columns, own, out=np.zeros_like(columns), where=own > 0)
        variance = np.sum(weights * (self._covariance @ weights), axis=0)
        known = variance > _RANK * variance.max()
        std = np.sqrt(np.where(known, variance, np.inf))
        return np.asarray(np.abs(weights.T @ self._effect) / std).reshape(-1, self._stands)

    def square(self) -> Floats:
        """Return by how much each shift (patterns, s) reduces the weighed square of the effects."""
        columns, effect = self._weighed
        columns, own = self._beyond(columns)
        found = np.divide((columns.T @ effect) ** 2, own, out=np.zeros_like(own), where=own > 0)
        return np.asarray(found.reshape(-1, self._stands))

    def _beyond(self, columns: Floats) -> tuple[Floats, Floats]:
        """Return columns less the selected ones, and their squares; zero if these determine it."""
        basis = np.linalg.qr(columns[:, self._chosen])[0]
        rest = columns - basis @ (basis.T @ columns)
        own = np.sum(rest**2, axis=0)
        return rest, np.where(own > _DISTINCT * np.sum(columns**2, axis=0), own, 0.0)

    def choose(self, pattern: int, stand: int) -> None:
        """Select a shift."""
        self._chosen.append(pattern * self._stands + stand)

    def sizes(self) -> tuple[Floats, Floats]:
        """Return the joint sizes of the selected shifts, and their standard deviations."""
        weights = np.linalg.pinv(self._columns[:, self._chosen])
        return weights @ self._effect, np.sqrt(np.diag(weights @ self._covariance @ weights.T))

    def places(self) -> list[tuple[int, int]]:
        """Return pattern and stand of the selected shifts."""
        return [divmod(column, self._stands) for column in self._chosen]


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
    stand_of: NDArray[np.int64],
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
        if not block.places():
            continue
        for (i, k), size, std in zip(block.places(), *block.sizes(), strict=True):
            pattern = block.patterns[i]
            shift = k, float(size), float(std), alternatives[pattern.name, k]
            yield _shift(group, pattern, block.freedom, shift, every, units, stand_of, tests, rules)


def _next_shift(
    block: _Block, tests: int, false_alarm: float
) -> tuple[float, int, int, NDArray[np.bool_]]:
    """Return the most likely further shift of a block among those that are significant.

    Each is tested by itself, its probability times the number of tests (Bonferroni): so the
    probability that any is found where there is none is at most the rate of false alarms. A common
    cause goes before single parameters, unless one of these has better odds: a shift of all by one
    size is an accident otherwise.

    Returns:
        Absolute t, 0 if none is significant, pattern and stand, and which other stands (s,) may be
        meant.
    """
    t, square = block.t(), block.square()
    found = 2 * scipy.special.stdtr(float(block.freedom), -t) * tests < false_alarm
    # Odds of two shifts with equal prior probabilities: exp of half of the difference of squares.
    margin = 2 * np.log(false_alarm)
    alike = found & (square > np.max(square, where=found, initial=0.0) + margin)
    common = np.array([len(pattern.parameters) > 1 for pattern in block.patterns])
    first = alike & common[:, None]
    which = first if first.any() else found
    i, k = divmod(int(np.argmax(np.where(which, square, -1.0))), t.shape[1])
    near = square[i] > square[i, k] + margin
    return float(t[i, k]) if found[i, k] else 0.0, i, k, near & (np.arange(t.shape[1]) != k)


def _shift(
    group: _Group,
    pattern: Pattern,
    freedom: int,
    found: tuple[int, float, float, NDArray[np.bool_]],
    every: Sequence[str],
    units: NDArray[np.int64],
    stand_of: NDArray[np.int64],
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
        units=_shared(units[group.rows], stand_of[group.rows], int(group.stands[k])),
    )


def _shared(units: NDArray[np.int64], stand_of: NDArray[np.int64], stand: int) -> int:
    """Return the number of units that were on a stand and on another."""
    return len(np.intersect1d(units[stand_of == stand], units[stand_of != stand]))


def corrections(stands: Stands, names: Sequence[str]) -> Floats:
    """Return the correction of each session (n, 24), SI units: the shift of its stand."""
    by_name = {pattern.name: pattern.shifts for pattern in PATTERNS}
    found = np.zeros((len(names), len(PARAMETERS)))
    stand_of = np.array(names)
    for one in stands.shifts:
        found[stand_of == one.stand] += one.shift * by_name[one.what]
    return found


def _incomparable(groups: list[list[str]], unknown: int, sessions: int) -> list[str]:
    """Return sentences on stands that cannot be compared, with reasons."""
    if not sessions:
        return []
    if unknown == sessions:
        return [
            'No session says on which stand it was: offsets of stands are attributed to units. '
            'State them in the column stand of a manifest; nothing is calibrated again for that.'
        ]
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
