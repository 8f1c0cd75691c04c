"""Several units on one table: common unknowns are estimated once, from all units.

The normal equations have the form of an arrowhead: a block for each unit, and a border for the
common unknowns. The parameters of each unit are eliminated (the Schur complement of its block), the
reduced information on the common unknowns is summed, these are solved for, and the parameters of
each unit follow by substitution. This is iterated by Gauss-Newton. With eight units K_g of
navigation grade and D_a of medium grade err by a quarter less than by themselves
(docs/units_study.md).

Source: docs/mathematics.md, 'Several units on one table'; Golub and Plemmons 1980, Linear Algebra
Appl. 34, 3 (block angular least squares); Schweppe 1973, section 5.5, for the test.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from ..common.budget import ErrorSource, Share
from ..common.errors import NotObservable
from ..common.stream import Floats
from .components import Component, unwhiten, whiten
from .components import parts as parts_of
from .equations import ENCODER_FREEDOM, Equations
from .estimate import Estimate
from .evidence import SMALLEST_VARIANCE
from .session_model import Nuisance
from .table_effects import SHARED, TABLE_STATE, CommonSizes, CommonTable, dwell_counts

_ROUNDS = 30
"""Most steps: the estimate of each single unit is within its deviations of the solution."""
_CONVERGED = 1e-6
"""Standard deviations by which a last step may move any unknown. A judgement: nothing beside a
standard deviation."""
_INFORMATIVE = 1e-3
"""Of the information of the other units and the priors on a direction: with less, a unit cannot
contradict them in it. A tenth of a percent of information is 0.05 % of a deviation."""
_CHANCE = 1e-6  #: Chance by which a sound unit is left out: one in a million units.
_HALF = 0.5
"""Share of a session's dwells that a unit must have seen to be used for the table: a stream that
ended or froze half way only has its own estimate. A judgement."""
_SINGULAR = 1e-12
"""Of the largest element of a triangle, columns of norm one: parameters that a unit does not
determine even where the table is known."""


@dataclass(frozen=True, eq=False)
class TableEstimate:
    """Common estimate of the table by several units."""

    names: tuple[str, ...]  #: Of the k determined unknowns.
    values: Floats  #: (k,) rad.
    std: Floats  #: (k,) standard deviations, rad.
    prior: Floats  #: (k,) prior standard deviations, rad.

    def to_dict(self) -> list[dict[str, object]]:
        """Return it as built-in values, rad, by the keys of docs/files/output.md."""
        rows = zip(self.names, self.values, self.std, self.prior, strict=True)
        return [
            {'name': name, 'value': float(value), 'std': float(std), 'prior_std': float(prior)}
            for name, value, std, prior in rows
        ]


@dataclass(frozen=True)
class Contradicting:
    """A unit whose part in the common unknowns contradicts that of the others."""

    unit: int  #: Its index among all.
    chi_square: float  #: Of its part, against the others and the priors.
    freedom: int  #: Its degrees of freedom.


@dataclass(frozen=True, eq=False)
class Joined:
    """Estimates of several units with common unknowns estimated once."""

    estimates: dict[int, Estimate]  #: Of each unit that took part, by its index.
    table: TableEstimate | None  #: Their common estimate of the table.
    contradicting: tuple[Contradicting, ...] = ()  #: Those that were left out, the worst first.
    #: Units that saw less than half of the dwells: index, number seen, total number.
    partial: tuple[tuple[int, int, int], ...] = ()


def join(alone: Sequence[Estimate]) -> Joined:
    """Estimate the common unknowns of several units from all of them.

    Units that saw less than half of the dwells are left out, and units whose part contradicts the
    others, the worst first, while three or more remain; of two that contradict each other it is
    unknown which is right.
    """
    seen, of_all = dwell_counts([found.equations for found in alone])
    partial = tuple((k, n, of_all) for k, n in enumerate(seen) if n < _HALF * of_all)
    kept = [k for k, n in enumerate(seen) if n >= _HALF * of_all]
    out: list[Contradicting] = []
    while len(kept) > 1:
        system = _likeliest([alone[k] for k in kept])
        worst = _worst(system, kept)
        if worst is None:
            estimates = {k: system.estimate(i) for i, k in enumerate(kept)}
            return Joined(estimates, system.table_estimate(), tuple(out), partial)
        out.append(worst)
        kept = [] if len(kept) == 2 else [k for k in kept if k != worst.unit]
    return Joined({}, None, tuple(out), partial)


def _likeliest(alone: Sequence[Estimate]) -> _System:
    """Solve with the table's errors as large as found by any unit; return the likeliest.

    By the restricted likelihood of all units: a unit whose own scatter looks like errors of the
    table does not raise it for the others.
    """
    sizes = dict.fromkeys(CommonSizes.of_one_unit(found.equations) for found in alone)
    systems: list[_System] = []
    refused: NotObservable | None = None
    for size in sizes:
        system = _System(alone, size)
        try:
            system.solve()
        except NotObservable as error:
            refused = error
        else:
            systems.append(system)
    if refused is not None and not systems:
        raise refused
    return max(systems, key=lambda system: system.log_likelihood)


def _worst(system: _System, kept: Sequence[int]) -> Contradicting | None:
    """Return the unit that contradicts the others most, if any."""
    worst: tuple[float, Contradicting] | None = None
    limit = float(np.log(_CHANCE))
    for i, unit in enumerate(kept):
        square, freedom = system.contradiction(i)
        if not freedom:
            continue
        log_p = float(scipy.stats.chi2.logsf(square, freedom))
        if log_p < limit and (worst is None or square / freedom > worst[0]):
            worst = square / freedom, Contradicting(unit, square, freedom)
    return None if worst is None else worst[1]


@dataclass(frozen=True, eq=False)
class _Reduced:
    """The equations of a unit about a state, its own parameters eliminated."""

    orthonormal: Floats  #: (r, n) basis of its own parameters' effects on its equations.
    #: (n, n) inverse of the triangle: its own parameters by coordinates in that basis.
    inverse: Floats
    #: (r, c) derivatives by the common unknowns, whitened, orthogonal to its own parameters.
    common: Floats
    by_common: Floats  #: (n, c) derivatives of its own parameters by the common unknowns.
    own: Floats  #: (n,) step of its own parameters with the common unknowns fixed.
    #: (c,) derivatives of half of chi-square by the common unknowns, with reversed sign.
    gradient: Floats
    chi_square: float  #: Sum of squared whitened residuals after its own parameters.
    factor: Floats  #: (m, m) root of the covariance of its outputs.

    @property
    def information(self) -> Floats:
        """(c, c) information on the common unknowns."""
        return np.asarray(self.common.T @ self.common)


class _System:
    """The equations of several units about the current state."""

    def __init__(self, alone: Sequence[Estimate], sizes: CommonSizes) -> None:
        self._alone = alone
        self._units = [found.equations for found in alone]
        self._common = CommonTable(self._units, sizes)
        self._states = [found.state.copy() for found in alone]
        best = min(alone, key=lambda found: found.nuisance(Nuisance.AZIMUTH)[1])
        self._table = best.state[best.equations.sensors :][: len(TABLE_STATE)].copy()
        self._copy_table_to_states()
        self._errors = self._common.errors_at(self._states)
        self._values = np.zeros(len(self._errors.sources))

    def solve(self) -> None:
        """Iterate to the least squares."""
        for _ in range(_ROUNDS):
            self._linearise()
            step = self._inverse @ self._gradient
            moved = float(np.abs(step / np.sqrt(np.diag(self._inverse))).max())
            self._table += step[: len(TABLE_STATE)]
            self._values += step[len(TABLE_STATE) :]
            for k, reduced in enumerate(self._reduced):
                own = reduced.own - reduced.by_common @ step
                self._states[k][self._own(k)] += own
                deviations = np.sqrt((reduced.inverse**2).sum(axis=1))
                moved = max(moved, float(np.abs(own / deviations).max()))
            self._copy_table_to_states()
            if moved < _CONVERGED:
                self._linearise()
                return
        raise NotObservable(
            f'The least squares over all units did not converge in {_ROUNDS} steps. Calibrate each '
            'unit alone (`serial`) to see which one contradicts its description.'
        )

    @property
    def log_likelihood(self) -> float:
        """Restricted likelihood of the sizes of the table's errors, but for a constant."""
        found = np.concatenate([self._table, self._values])
        prior = np.diag(self._prior)
        pulled = prior * found**2
        if not all(unit.north_known for unit in self._units):
            pulled[Nuisance.AZIMUTH] = 0.0
        square = float(pulled.sum()) + sum(one.chi_square for one in self._reduced)
        gained = np.linalg.slogdet(self._information)[1] - np.log(prior).sum()
        return -0.5 * float(square + gained)

    def estimate(self, k: int) -> Estimate:
        """Return the result of a unit."""
        alone, unit, mine = self._alone[k], self._units[k], self._reduced[k]
        own, n = self._own(k), self._units[k].sensors
        common = self._inverse
        covariance = np.zeros((unit.size, unit.size))
        by_common = mine.by_common
        covariance[np.ix_(own, own)] = (
            mine.inverse @ mine.inverse.T + by_common @ common @ by_common.T
        )
        of_table = n + np.arange(len(TABLE_STATE))
        covariance[np.ix_(of_table, of_table)] = common[: len(of_table), : len(of_table)]
        crossed = -(by_common @ common)[:, : len(of_table)]
        covariance[np.ix_(own, of_table)] = crossed
        covariance[np.ix_(of_table, own)] = crossed.T
        if alone.between is not None:
            covariance = covariance + alone.between
        return replace(
            alone, state=self._states[k], covariance=covariance, by_source=self._shares(k)
        )

    def contradiction(self, k: int) -> tuple[float, int]:
        """Return chi-square and degrees of freedom of a unit's part, against all the others.

        Its gradient at the solution of the others alone, and the covariance of that: along the
        directions on which it has information.
        """
        mine = self._reduced[k].information
        others = self._information - mine
        scale = 1 / np.sqrt(np.diag(others))
        root = np.linalg.cholesky(others * np.outer(scale, scale))
        half = whiten(root, self._reduced[k].common.T * scale[:, None])
        ratios, vectors = np.linalg.eigh(half @ half.T)
        gradient = vectors.T @ whiten(root, self._reduced[k].gradient * scale)
        informative = ratios > _INFORMATIVE
        square = (1 + ratios[informative]) * gradient[informative] ** 2 / ratios[informative]
        return float(square.sum()), int(informative.sum())

    def table_estimate(self) -> TableEstimate:
        """Return the estimate of the table."""
        errors, count = self._errors, len(TABLE_STATE)
        std = np.sqrt(np.diag(self._inverse))
        named = [k for k, name in enumerate(errors.names) if name]
        sizes = errors.sizes[named]
        tilts = 1 / np.sqrt(np.diag(self._prior)[:count])
        return TableEstimate(
            ('azimuth', 'tilt about x', 'tilt about y', *(errors.names[k] for k in named)),
            np.concatenate([self._table, self._values[named] * sizes]),
            np.concatenate([std[:count], std[count:][named] * sizes]),
            np.concatenate([tilts, sizes]),
        )

    def _own(self, k: int) -> NDArray[np.intp]:
        """Return which entries of its state belong to a unit alone."""
        unit = self._units[k]
        return np.delete(np.arange(unit.size), unit.sensors + np.arange(len(TABLE_STATE)))

    def _copy_table_to_states(self) -> None:
        for unit, state in zip(self._units, self._states, strict=True):
            state[unit.sensors + np.arange(len(TABLE_STATE))] = self._table

    def _linearise(self) -> None:
        """Compute information and gradient on the common unknowns at the current states."""
        self._errors = self._common.errors_at(self._states)
        self._reduced = [self._eliminated(k) for k in range(len(self._units))]
        self._information_by_errors: dict[int, list[tuple[Floats, float]]] = {}
        self._prior, pulled = self._priors()
        self._information = self._prior + sum(one.information for one in self._reduced)
        self._gradient = pulled + sum(one.gradient for one in self._reduced)
        scale = 1 / np.sqrt(np.diag(self._information))
        scaled = self._information * np.outer(scale, scale)
        self._inverse = np.linalg.inv(scaled) * np.outer(scale, scale)

    def _priors(self) -> tuple[Floats, Floats]:
        """Return the information of the priors on the common unknowns, and their gradient."""
        first = len(TABLE_STATE)
        # If one unit shows another north, or a less level table, this holds for all.
        deviations = np.max([unit.prior_deviations[:first] for unit in self._units], axis=0)
        known = np.ones(first + len(self._values))
        known[:first] = 1 / deviations**2
        pulled = -known * np.concatenate([self._table, self._values])
        if not all(unit.north_known for unit in self._units):
            pulled[Nuisance.AZIMUTH] = 0.0
        return np.diag(known), pulled

    def _eliminated(self, k: int) -> _Reduced:
        """Whiten a unit's equations by its own covariance, and eliminate its own parameters."""
        unit, state, own = self._units[k], self._states[k], self._own(k)
        jacobian, columns = unit.jacobian(state), self._errors.columns[k]
        of_table = unit.sensors + np.arange(len(TABLE_STATE))
        residuals = unit.outputs - unit.predict(state) - columns @ self._values
        factor = np.linalg.cholesky(own_covariance(unit, state))
        whole = np.column_stack([jacobian[:, own], jacobian[:, of_table], columns, residuals])
        whole = whiten(factor, whole)
        prior = np.delete(unit.prior_rows(state), TABLE_STATE, axis=0)
        below = np.zeros((len(prior), whole.shape[1]))
        below[:, : len(own)], below[:, -1] = prior[:, own], prior[:, -1]
        whole = np.vstack([whole, below])
        mine, common, residuals = whole[:, : len(own)], whole[:, len(own) : -1], whole[:, -1]
        scale = 1 / np.linalg.norm(mine, axis=0)
        basis, triangle = np.linalg.qr(mine * scale)
        diagonal = np.abs(np.diag(triangle))
        if diagonal.min() < _SINGULAR * diagonal.max():
            raise NotObservable(
                'The data of a unit does not determine all its parameters, not even on a table '
                'that is known exactly. Calibrate each unit alone (`serial`) to see which ones.'
            )
        inverse = scale[:, None] * scipy.linalg.solve_triangular(triangle, np.eye(len(own)))
        along = basis.T @ np.column_stack([common, residuals])
        reduced = common - basis @ along[:, :-1]
        over = residuals - basis @ along[:, -1]
        return _Reduced(
            basis,
            inverse,
            reduced,
            inverse @ along[:, :-1],
            inverse @ along[:, -1],
            reduced.T @ residuals,
            float(over @ over),
            np.asarray(factor, dtype=np.float64),
        )

    def _shares(self, k: int) -> dict[ErrorSource, Share]:
        """Return by source the covariance of a unit's parameters.

        Its own errors, those of the other units, and the priors of the common unknowns: they add
        up.
        """
        unit, mine, n = self._units[k], self._reduced[k], self._units[k].sensors
        by_common = mine.by_common[:n] @ self._inverse
        gain = mine.inverse[:n] @ mine.orthonormal.T - by_common @ mine.common.T
        m = len(unit.outputs)
        found = parts_of(own_components(unit, self._states[k]), unwhiten(mine.factor, gain[:, :m]))
        row = m
        for source, which, freedom in unit.prior_sources:
            if kept := len([w for w in which if w not in TABLE_STATE]):
                prior = gain[:, row : row + kept]
                found[source].append((prior @ prior.T, freedom))
                row += kept
        others = [self._information_on_common(j) for j in range(len(self._units)) if j != k]
        found[ErrorSource.OTHER_UNITS] += [
            (by_common @ information @ by_common.T, freedom)
            for estimates in others
            for information, freedom in estimates
        ]
        sources = [ErrorSource.AZIMUTH, ErrorSource.TILT, ErrorSource.TILT, *self._errors.sources]
        spread = by_common * np.sqrt(np.diag(self._prior))
        for source, prior in zip(sources, spread.T, strict=True):
            covariance = np.outer(prior, prior)
            stated = self._common.stated_share if source is ErrorSource.POSITIONING_STATED else 1.0
            freedom = ENCODER_FREEDOM if source is ErrorSource.ENCODER_RATE else np.inf
            found[source].append((stated * covariance, freedom))
            if stated < 1:
                found[ErrorSource.POSITIONING_FOUND].append(((1 - stated) * covariance, freedom))
        return {source: Share.from_parts(parts) for source, parts in found.items() if parts}

    def _information_on_common(self, k: int) -> list[tuple[Floats, float]]:
        """Return a unit's information on the common unknowns: (c, c) covariances by its own errors.

        Each with the degrees of freedom of its size; that of its own priors is taken as known.
        """
        if k not in self._information_by_errors:
            unit, mine = self._units[k], self._reduced[k]
            gain = unwhiten(mine.factor, mine.common.T[:, : len(unit.outputs)])
            by_errors = parts_of(own_components(unit, self._states[k]), gain)
            found = [part for parts in by_errors.values() for part in parts]
            prior = mine.common[len(unit.outputs) :]
            self._information_by_errors[k] = [*found, (prior.T @ prior, np.inf)]
        return self._information_by_errors[k]


def own_components(unit: Equations, state: Floats) -> list[Component]:
    """Return the parts of the covariance of a unit's outputs that are not common to all units."""
    return [c for c in (*unit.own, *unit.shared(state)) if c.source not in SHARED]


def own_covariance(unit: Equations, state: Floats) -> Floats:
    """Return their sum, the covariance (m, m) of a unit's outputs."""
    result = np.zeros((len(unit.outputs),) * 2)
    for component in own_components(unit, state):
        component.part.add_to(result)
    least = np.diag_indices(len(result))
    result[least] = np.maximum(result[least], SMALLEST_VARIANCE)
    return result
