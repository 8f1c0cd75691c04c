"""What scatters beyond random walk and quantisation: biases that wander, arrivals that miss.

Both are estimated from the session itself by restricted maximum likelihood (Patterson and Thompson
1971, Biometrika 58, 545): the likelihood of what the parameters cannot explain. A bias wanders as
a first-order Gauss-Markov process, variance s^2 and correlation time tau, seen between the
stretches by their means and within them by their slopes; an arrival errs as `Equations.arrivals`
says. Correlation times reach to three lengths of the session: what is slower yet is no other than
a bias. Either counts where the likelihood asks for it, so that a session of pure noise keeps the
weights that suit it. One session tells neither s nor tau well: the covariance that then counts is
the mean of the posterior over a grid, not the most likely one, which would be too sure of itself.

Source: methods.md, section 11 (weights from the data, drift within and between segments).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.special import logsumexp

from ..segmentation.segment import Statistics
from ..stream import Floats
from .equations import Equations
from .evidence import SMALLEST_VARIANCE

_TIMES = (1 / 30, 1 / 10, 1 / 3, 1.0, 3.0)
_RATIOS = 10.0 ** np.arange(-1.5, 8.1, 0.5)
_ARRIVAL_RATIOS = np.concatenate([[0.0], 10.0 ** np.arange(-1, 6.1, 0.5)])
_CALLED_FOR = 4.5
_NODES = 8
_BLOCKS_FOR_A_SLOPE = 4


@dataclass(frozen=True, eq=False)
class _Wandering:
    """Where a process is looked at: nodes in time, and the means and slopes over them."""

    nodes: Floats
    functionals: Floats
    slopes: int

    @classmethod
    def of(cls, statistics: list[Statistics], starts: Floats, with_slope: list[bool]) -> _Wandering:
        """Lay nodes over stretches: rows of `functionals` are all means, then the slopes."""
        grid = (np.arange(_NODES) + 0.5) / _NODES
        durations = np.array([s.duration for s in statistics])
        nodes = (starts[:, None] + durations[:, None] * grid).ravel()
        n = len(statistics)
        means = np.kron(np.eye(n), np.full(_NODES, 1 / _NODES))
        centred = grid - 0.5
        line = np.kron(np.diag(1 / durations), centred / (centred @ centred))
        return cls(nodes, np.vstack([means, line[with_slope]]), int(np.sum(with_slope)))

    def kernel(self, time: float) -> Floats:
        """Return the covariance of means and slopes for unit variance.

        Args:
            time: Correlation time as a fraction of the session.

        """
        apart = np.abs(self.nodes[:, None] - self.nodes) / max(float(np.ptp(self.nodes)), 1.0)
        return np.asarray(self.functionals @ np.exp(-apart / time) @ self.functionals.T)


@dataclass(frozen=True, eq=False)
class _Triad:
    """The equations of three channels of a kind, with slopes, whitened but for the excess."""

    rows: NDArray[np.intp]
    jacobian: Floats
    left: Floats
    base: Floats
    arrivals: Floats
    prior: Floats
    slope_left: Floats
    slope_variances: Floats
    wandering: _Wandering
    typical: float

    def weigh(self, arrival: float) -> tuple[Floats, float]:
        """Return the log likelihood (taus, ratios) and without wandering, for one arrival error.

        Args:
            arrival: Its variance, rad^2.

        """
        covariance = self.base + arrival * (self.arrivals @ self.arrivals.T)
        factor = np.linalg.cholesky(covariance)
        columns = np.column_stack([self.jacobian, self.left])
        columns = np.vstack(
            [solve_triangular(factor, columns, lower=True, check_finite=False), self.prior]
        )
        full, triangle = np.linalg.qr(columns[:, :-1], mode='complete')
        n = triangle.shape[1]
        free = full[:, n:]
        # The volume of the parameters' and of the noise's own ellipsoid, for unlike arrivals.
        volume = -np.log(np.diag(factor)).sum() - np.log(np.abs(np.diag(triangle))).sum()
        slopes = self.slope_left / np.sqrt(self.slope_variances)
        z = np.concatenate([free.T @ columns[:, -1], slopes])
        without = float(volume) - 0.5 * float(z @ z)
        rows = len(self.left)
        back = solve_triangular(factor, np.eye(rows), lower=True, check_finite=False)
        project = np.zeros((rows + len(slopes), len(z)))
        project[:rows, : free.shape[1]] = back.T @ free[:rows]
        project[rows:, free.shape[1] :] = np.diag(1 / np.sqrt(self.slope_variances))
        found = []
        for time in _TIMES:
            kernel = self.spread(self.wandering.kernel(time)) * self.typical
            values, vectors = np.linalg.eigh(project.T @ kernel @ project)
            grown = 1 + np.outer(_RATIOS, np.maximum(values, 0.0))
            square = (vectors.T @ z) ** 2
            gained = np.log(grown) + square / grown
            found.append(float(volume) - 0.5 * gained.sum(axis=1))
        return np.asarray(found), without

    def spread(self, kernel: Floats) -> Floats:
        """Repeat a kernel over stretches for three channels, in the order of the rows."""
        return np.asarray(np.kron(kernel, np.eye(3)), dtype=float)


@dataclass(frozen=True, eq=False)
class Excess:
    """What scatters beyond random walk and quantisation, as the session shows it.

    Attributes:
        positioning: Standard deviation of an arrival's error, rad.
        wandering: (6,) standard deviation of the wandering biases, rad/s and m/s^2.
        extra: (6 s + 3 t,) square: the covariance that wandering adds.

    """

    positioning: float
    wandering: Floats
    extra: Floats

    def without(self) -> Excess:
        """Return no excess at all, for the same session."""
        return Excess(0.0, np.zeros(6), np.zeros_like(self.extra))


def excess(equations: Equations, state: Floats) -> Excess:
    """Estimate the excess scatter of a session about a solution.

    Args:
        equations: The session, any earlier excess is ignored.
        state: A solution close to the final one.

    """
    plain = replace(equations, extra=None, positioning=None)
    evidence = plain.evidence
    s, t = len(evidence.segments), len(evidence.turns)
    size = 6 * s + 3 * t
    stated = evidence.positioning
    if not s or plain.own_variances.max() <= SMALLEST_VARIANCE:
        return Excess(stated, np.zeros(6), np.zeros((size, size)))
    covariance = plain.covariance(state)
    jacobian, left = plain.jacobian(state), plain.outputs - plain.predict(state)
    arrivals = plain.arrivals(state)
    extra = np.zeros((size, size))
    wandering = np.zeros(6)

    accel = _triad(plain, 3, (jacobian, left, covariance, arrivals), state)
    unit = float(accel.typical) / evidence.site.gravity**2
    candidates = _ARRIVAL_RATIOS * unit
    weights = _posterior(accel, candidates)
    arrival = float(weights.sum(axis=(1, 2)) @ candidates)
    wandering[3:] = _spread_out(accel, weights, extra)
    gyro = _triad(
        plain, 0, (jacobian, left, covariance + arrival * (arrivals @ arrivals.T), arrivals), state
    )
    wandering[:3] = _spread_out(gyro, _posterior(gyro, np.zeros(1)), extra)
    return Excess(float(np.sqrt(stated**2 + arrival)), wandering, extra)


def _posterior(triad: _Triad, candidates: Floats) -> Floats:
    """Return the weights (arrivals, taus, 1 + ratios) of the grid; none of either comes first.

    Pure noise stands unless the likelihood rises by the factor exp(`_CALLED_FOR`) without it. Then
    the other cases share the weight: a few arrivals that miss and a bias that wanders slowly look
    alike, and do unlike harm.
    """
    table = np.zeros((len(candidates), len(_TIMES), 1 + len(_RATIOS)))
    for k, arrival in enumerate(candidates):
        table[k, :, 1:], table[k, :, 0] = triad.weigh(float(arrival))
    nothing = table[0, 0, 0]
    weights = np.zeros_like(table)
    if table.max() < nothing + _CALLED_FOR:
        weights[0, 0, 0] = 1.0
        return weights
    none, some = slice(0, 1), slice(1, None)
    for a, r in ((none, some), (some, none), (some, some)):
        part = table[a, :, r]
        if part.size:
            weights[a, :, r] = part - np.log(part.size)
    weights[0, :, 0] = -np.inf
    return np.asarray(np.exp(weights - logsumexp(weights)))


def _spread_out(triad: _Triad, weights: Floats, extra: Floats) -> float:
    """Add the posterior's mean of the wandering's covariance; return its standard deviation."""
    means = len(triad.left) // 3
    total = 0.0
    for k, time in enumerate(_TIMES):
        variance = float(weights[:, k, 1:].sum(axis=0) @ _RATIOS) * triad.typical
        kernel = triad.wandering.kernel(time)[:means, :means]
        extra[np.ix_(triad.rows, triad.rows)] += variance * triad.spread(kernel)
        total += variance
    return float(np.sqrt(total))


def _triad(
    equations: Equations, first: int, parts: tuple[Floats, Floats, Floats, Floats], state: Floats
) -> _Triad:
    """Cut out gyros (first = 0, with the turns) or accelerometers (first = 3)."""
    evidence = equations.evidence
    s = len(evidence.segments)
    rows = (6 * np.arange(s)[:, None] + first + np.arange(3)).ravel()
    stretches = [(x.statistics, x.start) for x in evidence.segments]
    if first == 0:
        rows = np.concatenate([rows, 6 * s + np.arange(3 * len(evidence.turns))])
        stretches += [(x.statistics, x.start) for x in evidence.turns]
    jacobian, left, covariance, arrivals = parts
    seen = np.flatnonzero(np.any(jacobian[rows] != 0, axis=0))
    prior = equations.prior_rows(state)
    origin = min(start for _, start in stretches)
    starts = np.array([(start - origin) * 1e-9 for _, start in stretches])
    with_slope = [
        all(len(b) >= _BLOCKS_FOR_A_SLOPE for b in x.blocks[first : first + 3])
        for x, _ in stretches
    ]
    sloped = [x for (x, _), good in zip(stretches, with_slope, strict=True) if good]
    slope_left = np.array([x.drift[first : first + 3] for x in sloped]).ravel()
    slope_variances = np.array(
        [
            [_slope_variance(x.blocks[c], evidence.walk[c]) for c in range(first, first + 3)]
            for x in sloped
        ]
    ).ravel()
    wandering = _Wandering.of([x for x, _ in stretches], starts, with_slope)
    return _Triad(
        rows,
        jacobian[np.ix_(rows, seen)],
        left[rows],
        covariance[np.ix_(rows, rows)],
        arrivals[rows],
        prior[:, np.append(seen, equations.size)],
        slope_left,
        slope_variances,
        wandering,
        float(np.median(equations.own_variances[rows[: 3 * s]])),
    )


def _slope_variance(blocks: Floats, walk: float) -> float:
    """Return the variance of the line through block means that `Statistics.drift` is."""
    centred = blocks[:, 3] - blocks[:, 3].mean()
    weights = centred / (centred @ centred)
    return float(weights**2 @ (walk**2 * blocks[:, 1] + blocks[:, 2]))
