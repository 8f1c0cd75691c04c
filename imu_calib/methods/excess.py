"""What scatters beyond random walk and quantisation: biases that wander, arrivals that miss.

Both are estimated from the session itself by restricted maximum likelihood (Patterson and Thompson
1971, Biometrika 58, 545): the likelihood of what the parameters cannot explain. A bias wanders as
a first-order Gauss-Markov process, variance s^2 and correlation time tau, seen between the
stretches by their means and within them by their slopes; an arrival errs as `Equations.arrivals`
says. Correlation times reach to three lengths of the session: what is slower yet is no other than
a bias. Either counts where the likelihood asks for it, so that a session of pure noise keeps the
weights that suit it. One session tells neither s nor tau well: the covariance that then counts is
the mean of the posterior over a grid, not the most likely one, which would be too sure of itself.

A wandering that the data sheet states (bias instability) is a floor: a session of half an hour
does not show a drift of the size of its own noise, and its mean errs by it all the same. It is
weighed against less of it by what the data says, with odds of ten to one for the data sheet.

Source: methods.md, section 11 (weights from the data, drift within and between segments).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy
from numpy.typing import NDArray

from ..budget import Source
from ..segmentation.session import Move
from ..stream import Floats
from .components import Component, Dense
from .equations import Equations
from .evidence import SMALLEST_VARIANCE

_TIMES = (1 / 30, 1 / 10, 1 / 3, 1.0, 3.0)
_RATIOS = 10.0 ** np.arange(-1.5, 8.1, 0.5)
_ARRIVAL_RATIOS = np.concatenate([[0.0], 10.0 ** np.arange(-1, 6.1, 0.5)])
_CALLED_FOR = 4.5
_STATED_TIME = 1000.0
_SHARES = np.array([0.0, 1 / 16, 1 / 4, 1.0])
_LOG_ODDS = np.log([1 / 33, 1 / 33, 1 / 33, 10 / 11])
_NODES = 8
_BLOCKS_FOR_A_SLOPE = 4


@dataclass(frozen=True, eq=False)
class _Wandering:
    """Where a process is looked at: nodes in time, and the means and slopes over them."""

    nodes: Floats
    functionals: Floats
    slopes: int

    @classmethod
    def of(
        cls, starts: Floats, durations: Floats, units: Floats, with_slope: NDArray[np.bool_]
    ) -> _Wandering:
        """Lay nodes over stretches: rows of `functionals` are all means, then the slopes.

        Args:
            starts: (n,) of the stretches, s.
            durations: (n,) s.
            units: (n,) what a mean of one counts for: the time of a move, whose output is an angle.
            with_slope: (n,) whether the slope counts too.

        """
        grid = (np.arange(_NODES) + 0.5) / _NODES
        nodes = (starts[:, None] + durations[:, None] * grid).ravel()
        means = np.kron(np.diag(units), np.full(_NODES, 1 / _NODES))
        centred = grid - 0.5
        line = np.kron(np.diag(1 / durations), centred / (centred @ centred))
        return cls(nodes, np.vstack([means, line[with_slope]]), int(np.sum(with_slope)))

    @property
    def span(self) -> float:
        """Length of the session, s."""
        return max(float(np.ptp(self.nodes)), 1.0)

    def kernel(self, time: float) -> Floats:
        """Return the covariance of means and slopes for unit variance.

        Args:
            time: Correlation time as a fraction of the session.

        """
        apart = np.abs(self.nodes[:, None] - self.nodes) / self.span
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
    stated: float

    def weigh(self, arrival: float) -> tuple[Floats, Floats]:
        """Return log likelihoods for one error of arrival.

        Args:
            arrival: Its variance, rad^2.

        Returns:
            (shares,) for shares of the wandering stated, and (taus, ratios) for what comes on top
            of it.

        """
        covariance = self.base + arrival * (self.arrivals @ self.arrivals.T)
        factor = np.linalg.cholesky(covariance)
        columns = np.column_stack([self.jacobian, self.left])
        columns = np.vstack(
            [
                scipy.linalg.solve_triangular(factor, columns, lower=True, check_finite=False),
                self.prior,
            ]
        )
        full, triangle = np.linalg.qr(columns[:, :-1], mode='complete')
        free = full[:, triangle.shape[1] :]
        # The volume of the parameters' and of the noise's own ellipsoid, for unlike arrivals.
        volume = -np.log(np.diag(factor)).sum() - np.log(np.abs(np.diag(triangle))).sum()
        slopes = self.slope_left / np.sqrt(self.slope_variances)
        z = np.concatenate([free.T @ columns[:, -1], slopes])
        rows = len(self.left)
        back = scipy.linalg.solve_triangular(factor, np.eye(rows), lower=True, check_finite=False)
        project = np.zeros((rows + len(slopes), len(z)))
        project[:rows, : free.shape[1]] = back.T @ free[:rows]
        project[rows:, free.shape[1] :] = np.diag(1 / np.sqrt(self.slope_variances))
        stated, *beyond = self.kernels
        beforehand = project.T @ stated @ project
        calm = volume + _likelihoods(beforehand, z, _SHARES)
        if self.stated > 0:
            root = np.linalg.cholesky(np.eye(len(z)) + beforehand)
            volume -= np.log(np.diag(root)).sum()
            z = scipy.linalg.solve_triangular(root, z, lower=True, check_finite=False)
            project = scipy.linalg.solve_triangular(
                root, project.T, lower=True, check_finite=False
            ).T
        found = [volume + _likelihoods(project.T @ k @ project, z, _RATIOS) for k in beyond]
        return calm, np.array(found)

    @cached_property
    def kernels(self) -> list[Floats]:
        """Covariances of the rows: by the wandering stated, and by unit ratios of each time."""
        stated = self.spread(self.stated_kernel())
        beyond = [self.spread(self.wandering.kernel(time)) for time in _TIMES]
        return [stated, *(kernel * self.typical for kernel in beyond)]

    def stated_kernel(self) -> Floats:
        """Return the covariance of means and slopes by the wandering that is stated."""
        kernel = self.wandering.kernel(_STATED_TIME / self.wandering.span)
        return np.asarray(self.stated * kernel)

    def spread(self, kernel: Floats) -> Floats:
        """Repeat a kernel over stretches for three channels, in the order of the rows."""
        return np.asarray(np.kron(kernel, np.eye(3)), dtype=float)


def _likelihoods(kernel: Floats, z: Floats, ratios: Floats) -> Floats:
    """Return the log likelihoods of z with the covariances 1 + ratio kernel, one per ratio."""
    if not kernel.any():
        return np.full(len(ratios), -0.5 * float(z @ z))
    values, vectors = np.linalg.eigh(kernel)
    grown = 1 + np.outer(ratios, np.maximum(values, 0.0))
    square = (vectors.T @ z) ** 2
    return np.asarray(-0.5 * (np.log(grown) + square / grown).sum(axis=1))


@dataclass(frozen=True, eq=False)
class Excess:
    """What scatters beyond random walk and quantisation, as the session shows it.

    Attributes:
        positioning: Standard deviation of an arrival's error, rad.
        wandering: (6,) standard deviation of the wandering biases, rad/s and m/s^2.
        extra: What wandering adds to the covariance of the outputs: as the data sheet states it,
            and what the session shows beyond.

    """

    positioning: float
    wandering: Floats
    extra: tuple[Component, ...] = ()

    @property
    def stated(self) -> tuple[Component, ...]:
        """The part of `extra` that the data sheet states."""
        return tuple(c for c in self.extra if c.source is Source.BIAS_STATED)


def excess(equations: Equations, state: Floats) -> Excess:
    """Estimate the excess scatter of a session about a solution.

    Args:
        equations: The session, any earlier excess is ignored.
        state: (n,) a solution close to the final one.

    """
    plain = replace(equations, extra=(), positioning=None)
    evidence = plain.evidence
    positioning = evidence.positioning
    if not evidence.segments or plain.own_variances.max() <= SMALLEST_VARIANCE:
        return Excess(positioning, np.zeros(6))
    covariance = plain.covariance(state)
    jacobian, left = plain.jacobian(state), plain.outputs - plain.predict(state)
    arrivals = plain.arrivals(state)

    accel = _triad(plain, 3, (jacobian, left, covariance, arrivals), state)
    candidates = _ARRIVAL_RATIOS * (accel.typical / evidence.site.gravity**2)
    weights = _posterior(accel, candidates)
    arrival = float(weights.arrivals @ candidates)
    of_accels, accels_extra = _spread_out(accel, weights)
    gyro = _triad(
        plain, 0, (jacobian, left, covariance + arrival * (arrivals @ arrivals.T), arrivals), state
    )
    of_gyros, gyros_extra = _spread_out(gyro, _posterior(gyro, np.zeros(1)))
    return Excess(
        float(np.sqrt(positioning**2 + arrival)),
        np.repeat([of_gyros, of_accels], 3),
        (*gyros_extra, *accels_extra),
    )


@dataclass(frozen=True, eq=False)
class _Weights:
    """Posterior weights: (a, shares) of what is stated, (a, taus, ratios) of what is beyond."""

    calm: Floats
    beyond: Floats

    @property
    def arrivals(self) -> Floats:
        """Weights of the errors of arrival, (a,)."""
        return np.asarray(self.calm.sum(axis=1) + self.beyond.sum(axis=(1, 2)))

    @property
    def stated(self) -> float:
        """Mean share of the wandering stated."""
        return float(self.calm.sum(axis=0) @ _SHARES + self.beyond.sum())


def _posterior(triad: _Triad, candidates: Floats) -> _Weights:
    """Return the weights over a grid of arrival errors (none of which comes first) and wanderings.

    What is known beforehand stands unless the likelihood rises by the factor exp(`_CALLED_FOR`)
    without it. Then the other cases share the weight: a few arrivals that miss and a bias that
    wanders slowly look alike, and do unlike harm.
    """
    pairs = [triad.weigh(float(arrival)) for arrival in candidates]
    calm = np.array([pair[0] for pair in pairs]) + _LOG_ODDS
    beyond = np.array([pair[1] for pair in pairs])
    known = float(scipy.special.logsumexp(calm[0]))
    some, none = np.zeros_like(beyond), np.zeros_like(calm)
    if (
        max(float(beyond.max()), float(scipy.special.logsumexp(calm, axis=1).max()))
        < known + _CALLED_FOR
    ):
        none[0] = np.exp(calm[0] - known)
        return _Weights(none, some)
    still, moved = slice(0, 1), slice(1, None)
    for part in (still, moved):
        some[part] = beyond[part] - np.log(max(1, beyond[part].size))
    none[still], none[moved] = -np.inf, calm[moved] - np.log(max(1, len(calm) - 1))
    total = float(scipy.special.logsumexp(np.concatenate([none.ravel(), some.ravel()])))
    return _Weights(np.exp(none - total), np.exp(some - total))


def _spread_out(triad: _Triad, weights: _Weights) -> tuple[float, tuple[Component, ...]]:
    """Return the wandering's standard deviation, and the posterior's mean of its covariance."""
    means = len(triad.left) // 3
    stated = weights.stated * triad.spread(triad.stated_kernel()[:means, :means])
    found = np.zeros_like(stated)
    by_ratio = weights.beyond.sum(axis=0)
    for k, time in enumerate(_TIMES):
        kernel = triad.wandering.kernel(time)[:means, :means]
        found += float(by_ratio[k] @ _RATIOS) * triad.typical * triad.spread(kernel)
    beyond = by_ratio.sum(axis=0)
    total = weights.stated * triad.stated + float(beyond @ _RATIOS) * triad.typical
    parts = []
    if weights.stated * triad.stated:
        parts.append(Component(Source.BIAS_STATED, Dense(triad.rows, stated)))
    if beyond.any():
        parts.append(Component(Source.BIAS_FOUND, Dense(triad.rows, found)))
    return float(np.sqrt(total)), tuple(parts)


def _triad(
    equations: Equations, first: int, parts: tuple[Floats, Floats, Floats, Floats], state: Floats
) -> _Triad:
    """Cut out gyros (first = 0, with the turns) or accelerometers (first = 3)."""
    evidence = equations.evidence
    rows = equations.rows.gyros if first == 0 else equations.rows.accels
    stretches = [(x.statistics, x.start) for x in evidence.segments]
    moves: list[Move] = []
    if first == 0:
        stretches += [(x.statistics, x.start) for x in evidence.turns]
        moves = [link.move for link in evidence.led.links]
    jacobian, left, covariance, arrivals = parts
    seen = np.flatnonzero(np.any(jacobian[rows] != 0, axis=0))
    prior = equations.prior_rows(state)
    starts = np.array([start for _, start in stretches] + [m.start for m in moves], dtype=np.int64)
    durations = np.array([x.duration for x, _ in stretches] + [m.duration for m in moves])
    units = np.concatenate([np.ones(len(stretches)), durations[len(stretches) :]])
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
    wandering = _Wandering.of(
        (starts - starts.min()) * 1e-9,
        durations,
        units,
        np.array(with_slope + [False] * len(moves), dtype=bool),
    )
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
        float(np.median(equations.own_variances[equations.rows.rest[:, first : first + 3]])),
        float(evidence.instability[first] ** 2),
    )


def _slope_variance(blocks: Floats, walk: float) -> float:
    """Return the variance of the line through block means that `Statistics.drift` is."""
    centred = blocks[:, 3] - blocks[:, 3].mean()
    weights = centred / (centred @ centred)
    return float(weights**2 @ (walk**2 * blocks[:, 1] + blocks[:, 2]))
