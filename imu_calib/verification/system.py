"""A session as one triad sees it: which errors of a model's parameters explain what was read.

    left = jacobian d + unknown x + noise,    d ~ (0, factor factor'),    x by its own prior

With attitudes the equations are those of the joint estimate, a triad's rows of them; unknown are
its nuisances. Source: docs/mathematics.md, 'Verification'.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Protocol, cast

import numpy as np
import scipy
from numpy.typing import NDArray

from ..budget import Source
from ..earth import EARTH_RATE
from ..errors import NotObservable
from ..estimation.converge import least_squares, linear_step
from ..imu import TriadSpec
from ..model import Parameter, Triad
from ..observation.components import Component, Diagonal
from ..observation.equations import Equations
from ..observation.evidence import Evidence
from ..observation.information import Information
from ..observation.layout import Indices
from ..observation.lengths import Sensors, Up, compare_lengths, noise_at_rest
from ..observation.session_model import Nuisance
from ..rotations import rotations
from ..stream import Floats
from .observed import Observed

_ROUNDS = 30
"""Most steps of a fit. Near the minimum three do; what needs more fits nothing."""
_ROUNDS_OF_LENGTHS = 100
"""The same of lengths, where a calibration itself is judged: the variance of a square follows the
state, and errors shrink by a constant factor a step, or go round the minimum until steps are
halved. Calibrations whose biases were off by 0.005 to 20 deg/s took up to 85 steps, or 59 half
steps."""

_TOO_FEW = 2.0
"""Degrees of freedom up to which residuals tell nothing of the noise."""

_ANY_TILT = 0.1
"""rad: a table that stands as it may. Accelerometers say how."""


@dataclass(frozen=True, eq=False)
class Fit:
    """What is left when errors of the parameters within their deviations are allowed for.

    Attributes:
        chi_square: Chi-square.
        freedom: Its degrees of freedom.
        delta: (p,) the parameters' likely errors.
        std: (p,) their standard deviations.
        unknown: (u,) what else the session shows: `Nuisance`, and where it was asked for a small
            rotation in the mount, rad; nothing without attitudes.
        ratios: Squared residual over its expectation: of dwells, of turns, of moves (1 without).
        spare: How many residuals at rest are left to tell by, beyond what was estimated.
        converged: Whether the errors that explain the session best were found; else chi-square is
            that of where the search began, which is larger.
    """

    chi_square: float
    freedom: int
    delta: Floats
    std: Floats
    unknown: Floats
    ratios: tuple[float, ...]
    spare: float
    converged: bool = True

    @property
    def chance(self) -> float:
        """Probability of a chi-square so large where all is well."""
        if self.freedom <= 0:
            return 1.0
        return float(scipy.special.chdtrc(self.freedom, self.chi_square))


class _System(Protocol):
    """Derivatives and residuals at a point, both in standard deviations (`_whitened`)."""

    def __call__(self, point: Floats, /, *opposite: Floats) -> tuple[Floats, Floats]: ...


@dataclass(frozen=True, eq=False)
class TriadSystem:
    """The equations of one triad in one session.

    Attributes:
        observed: The session.
        sensors: Gyros or accelerometers.
        reading: Factor by which the outputs are to be multiplied.
        up: By the accelerometers; None where attitudes tell it.
        inflation: Factors on the noise of dwells, of turns and of moves.
        bias_drift: Standard deviation of the biases from rest to rest, rad/s or m/s^2.
        seen: The unknowns that the session shows whatever the parameters, to begin with; None
            before that is known.
        mount_free: Whether the unit may sit otherwise in its mount, by a small rotation.
        doubts: Parameters of the other triad and their standard deviations: gyros carry the axes
            of velocities.
    """

    observed: Observed
    sensors: Sensors
    reading: float = 1.0
    up: Up | None = None
    inflation: tuple[float, ...] = (1.0, 1.0, 1.0)
    bias_drift: float = 0.0
    seen: Floats | None = None
    mount_free: bool = False
    doubts: tuple[tuple[Parameter, float], ...] = ()

    @property
    def gyros(self) -> bool:
        """Which."""
        return self.sensors.gyros

    @property
    def magnitude(self) -> float:
        """Earth rate or gravity, SI."""
        return EARTH_RATE if self.gyros else self.observed.evidence.site.gravity

    @property
    def spec(self) -> TriadSpec:
        """How the recording describes the triad."""
        return self.observed.imu.gyro if self.gyros else self.observed.imu.accel

    @cached_property
    def evidence(self) -> Evidence:
        """The session as it is read: one for all systems that read it alike, with what it knows."""
        factors = np.ones(6)
        factors[self.sensors.channels] = self.reading
        known, key = self.observed.evidence.cache, ('read', tuple(factors.tolist()))
        if key not in known:
            known[key] = self.observed.evidence.scaled(factors)
        return cast(Evidence, known[key])

    @cached_property
    def outputs(self) -> Floats:
        """(s, 3) at rest, as they are read."""
        return self.evidence.outputs()[:, self.sensors.channels]

    @property
    def forces(self) -> Floats:
        """(s, 3) specific forces at rest in body axes, m/s^2."""
        if self.up is not None:
            return self.up.forces
        return self.evidence.attitudes()[:, 2] * self.evidence.site.gravity

    @cached_property
    def equations(self) -> Equations:
        """Those of the joint estimate, where attitudes are known."""
        rows = self.evidence.layout
        drifts = np.zeros(len(rows))
        drifts[rows.dwell] = self.bias_drift * self.reading
        seconds = np.array([m.move.duration for m in self.evidence.links.links]).reshape(-1, 1)
        drifts[rows.move] = self.bias_drift * self.reading * seconds
        felt = seconds[list(rows.moves_with_accels)]
        drifts[rows.velocity] = self.bias_drift * self.reading * felt
        return Equations(
            self.evidence,
            self.sensors.parameters,
            levelled=None if self.gyros else _ANY_TILT,
            extra=(Component(Source.BIAS_STATED, Diagonal(drifts**2)),),
            doubts=self.doubts,
        )

    @cached_property
    def _mine(self) -> Indices:
        """Which of these are the triad's: those at rest, of turns, of moves."""
        return self.equations.layout.gyros if self.gyros else self.equations.layout.accels

    @cached_property
    def _kinds(self) -> Indices:
        """Which of the triad's equations are at rest (0), of turns (1) and of moves (2), (m,)."""
        if self.up is not None:
            return np.zeros(len(self.outputs) * (2 if self.gyros else 1), dtype=np.intp)
        rows = self.evidence.layout
        of_moves = np.isin(self._mine, rows.moving)
        return np.where(self._mine < rows.dwell.size, 0, np.where(of_moves, 2, 1))

    @property
    def _widened(self) -> Floats:
        return np.array(self.inflation)[self._kinds]

    @cached_property
    def _known(self) -> Floats:
        """Of nuisances what is known beforehand, (u,), as far as lengths have any."""
        return np.zeros(0) if self.up is not None else self.equations.prior[0]

    @cached_property
    def _free(self) -> NDArray[np.bool_]:
        """Of which unknowns nothing is known: heading of gyros, tilt of accelerometers, mount."""
        free = np.zeros(len(self._known), dtype=bool)
        if self.up is None and not self.gyros:
            free[[Nuisance.TILT_X, Nuisance.TILT_Y]] = True
        elif self.up is None:
            free[Nuisance.AZIMUTH] = not self.equations.north_known
        return np.concatenate([free, np.full(3 if self.mount_free else 0, True)])

    def spread(self, values: Floats) -> Floats:
        """Return the covariances of what dwells, turns and moves read, whatever the parameters.

        What is known beforehand but not exactly counts: clock, heading, tilt.

        Args:
            values: (p,) of the parameters.

        Returns:
            (s + t + m, 3, 3).
        """
        if self.up is not None:
            return self._noise_at_rest
        state, deviations = np.append(values, self._known), self.equations.prior[1]
        besides = self.equations.jacobian(state)[:, len(values) :] * deviations
        besides = besides[:, ~self._free[: len(deviations)]]
        covariance = self.equations.covariance(state) + besides @ besides.T
        rows = self._mine.reshape(-1, 3)
        found = covariance[rows[:, :, None], rows[:, None, :]]
        return np.asarray(found * self._widened[::3, None, None] ** 2)

    @cached_property
    def _noise_at_rest(self) -> Floats:
        """The covariances of what dwells read, (s, 3, 3), whatever the parameters."""
        variances = self.evidence.variances()[:, self.sensors.channels]
        return noise_at_rest(variances + (self.bias_drift * self.reading) ** 2, self.magnitude)

    def predicted(self, values: Floats) -> Floats:
        """Return the predicted outputs (s + t + m, 3), the table as it is described."""
        state = np.append(values, self._known)
        return self.equations.predict(state)[self._mine].reshape(-1, 3)

    def share(self, values: Floats) -> float:
        """Return by what the outputs would have to be multiplied to be as a model says."""
        if self.up is not None:
            bias = Triad.from_vector(values).bias
            return self.magnitude / float(np.median(np.linalg.norm(self.outputs - bias, axis=1)))
        # Moves read no difference: they tell nothing of it.
        seen = self.equations.outputs[self._mine]
        weighed = seen / np.diagonal(self.spread(values), axis1=1, axis2=2).ravel()
        return float(weighed @ self.predicted(values).ravel() / (weighed @ seen))

    def inflated(self, ratios: tuple[float, ...]) -> TriadSystem:
        """Return the system with its noise widened."""
        factors = np.sqrt(np.maximum(ratios, 1.0)) * self.inflation
        return replace(self, inflation=tuple(factors.tolist()))

    @cached_property
    def _without_moves(self) -> TriadSystem:
        """The system without moves, which are not linear in what is far off."""
        if not len(self.evidence.links):
            return self
        known, key = self.observed.evidence.cache, 'without moves'
        if key not in known:
            known[key] = replace(self.observed, evidence=self.observed.evidence.with_moves(()))
        return replace(self, observed=cast(Observed, known[key]))

    def fit(self, values: Floats, factor: Floats) -> Fit:
        """Explain the session by a model whose parameters have errors.

        Args:
            values: (p,) of the parameters.
            factor: (p, k) of their covariance: factor times its transpose.
        """
        system = self._allowing(values, factor)
        begin = self._begun(system, values, factor)[0]
        rounds = _ROUNDS if self.up is None else _ROUNDS_OF_LENGTHS
        return self._fitted(begin, system, factor, rounds)

    def begun(
        self, values: Floats, factor: Floats, point: Floats
    ) -> tuple[float, Callable[[], Fit]]:
        """Return what chi-square would be if all were linear at a point, and the fit from there.

        Args:
            values: (p,) of the parameters.
            factor: (p, k) of their covariance: factor times its transpose.
            point: (k + u,) multiples of the factor's columns, and the unknowns.
        """
        system = self._allowing(values, factor)
        columns, left = system(point)
        return _linear(columns, left)[1], partial(self._fitted, point, system, factor)

    def fit_likely(self, values: Floats, factor: Floats, chance: float) -> Fit | None:
        """Return `fit`; None where already the dwells and turns have by far less than a chance.

        Twice the chi-square that counts is left for what is not linear: the errors must be small.
        Moves are not led then.
        """
        system = self._allowing(values, factor)
        point, square = self._begun(system, values, factor)
        if scipy.special.chdtrc(len(self._without_moves._kinds), square / 2) < chance:
            return None
        return self._fitted(point, system, factor)

    def _begun(self, system: _System, values: Floats, factor: Floats) -> tuple[Floats, float]:
        """Return where `fit` begins and what chi-square would be there, by dwells and turns."""
        resting = self._without_moves
        if resting is not self:
            system = resting._allowing(values, factor)
        return resting._start(system, factor.shape[1])

    def _fitted(self, point: Floats, system: _System, factor: Floats, rounds: int = _ROUNDS) -> Fit:
        try:
            point, converged = least_squares(point, system, np.add, rounds), True
        except NotObservable:
            # Where nothing fits nearby, chi-square where it began rejects it.
            converged = False
        found = self._concluded(*system(point), point, factor)
        return replace(found, converged=converged)

    def _allowing(self, values: Floats, factor: Floats) -> _System:
        """Return the equations at a (k + u,) point: errors of the parameters, and the unknowns."""
        k = factor.shape[1]
        known: dict[bytes, tuple[Floats, Floats]] = {}

        def system(point: Floats, *opposite: Floats) -> tuple[Floats, Floats]:
            # Those of where a search begins and ends are asked for twice.
            key = b''.join(one.tobytes() for one in (point, *opposite))
            if key not in known:
                others = [one[k:] for one in opposite]
                columns, left = self._whitened(values + factor @ point[:k], point[k:], *others)
                by_parameters, besides = np.split(columns, [len(values)], axis=1)
                columns = np.hstack([by_parameters @ factor, besides])
                prior = np.eye(k, columns.shape[1])
                known[key] = np.vstack([columns, prior]), np.append(left, -point[:k])
            return known[key]

        return system

    def _start(self, system: _System, k: int) -> tuple[Floats, float]:
        """Return where to begin, and chi-square at the minimum if all were linear.

        Any heading begins where the level Earth rate fits best, whatever its size: all is linear in
        it, and reversed by half a turn.
        """
        point = np.zeros(k + len(self._free))
        point[k : k + len(self._known)] = self._known if self.seen is None else self.seen
        azimuth = k + Nuisance.AZIMUTH
        headed = self.up is None and bool(self._free[Nuisance.AZIMUTH])
        opposite = []
        if headed:
            point[azimuth] = 0.0
            opposite = [point + np.pi * (np.arange(len(point)) == azimuth)]
        step, square = _linear(*system(point, *opposite))
        if headed:
            point[azimuth] = np.arctan2(step[azimuth], 1 + step[-1])
        return point, square

    def _whitened(
        self, values: Floats, unknown: Floats, *opposite: Floats
    ) -> tuple[Floats, Floats]:
        """Return derivatives (m + q, p + u) and residuals in standard deviations, priors last.

        Where unknowns opposite to these are given, half the way from them is the last derivative.
        """
        if self.up is not None:
            noise, site = self.spread(values), self.evidence.site
            jacobian, left, covariance = compare_lengths(
                self.sensors, values, self.outputs, noise, self.up, site
            )
            rows, below = np.column_stack([jacobian, left]), np.zeros((0, len(values) + 1))
        else:
            nuisances, mount = np.split(unknown, [len(self._known)])
            equations, state = self.equations, np.append(values, nuisances)
            if mount.any():
                equations = replace(equations, evidence=_mounted(self.evidence, mount))
            turned = (
                equations.by_mount(state) if len(mount) else np.zeros((len(equations.layout), 0))
            )
            predicted = equations.predict(state)
            left, derivatives = equations.outputs - predicted, equations.jacobian(state)
            others = (np.append(values, other[: len(nuisances)]) for other in opposite)
            halves = [(predicted - equations.predict(other)) / 2 for other in others]
            rows = np.column_stack([derivatives, turned, *halves, left])[self._mine]
            without = [-1] * (len(mount) + len(halves))
            below = np.insert(equations.prior_rows(state), without, 0.0, axis=1)
            covariance = equations.covariance(state)[np.ix_(self._mine, self._mine)]
        factor = np.linalg.cholesky(covariance) * self._widened[:, None]
        rows = scipy.linalg.solve_triangular(factor, rows, lower=True, check_finite=False)
        rows = np.vstack([rows, below])
        return rows[:, :-1], rows[:, -1]

    def _concluded(self, columns: Floats, left: Floats, point: Floats, factor: Floats) -> Fit:
        k, count = factor.shape[1], len(self._kinds)
        found = Information.of(columns)
        spare = 1 - np.einsum('ij,ji->i', columns[:count], found.gain[:, :count])
        free = columns[:, k:][:, self._free]
        norms = np.linalg.norm(free[:count], axis=0)
        # Beside what is known beforehand, rounding shows nothing (a heading where all are turns).
        seen = norms > np.finfo(float).eps * np.linalg.norm(free, axis=0)
        # NumPy 2.2 and older know no rank of no columns.
        spanned = free[:count, seen] / norms[seen]
        rank = int(np.linalg.matrix_rank(spanned)) if spanned.size else 0
        spread = np.diag(factor @ found.covariance[:k, :k] @ factor.T)

        def ratio(kind: int) -> float:
            these = self._kinds == kind
            expected, square = float(spare[these].sum()), float((left[:count][these] ** 2).sum())
            return square / expected if expected > _TOO_FEW else 1.0

        return Fit(
            float(left @ left),
            count - rank,
            factor @ point[:k],
            np.sqrt(np.maximum(spread, 0.0)),
            point[k:],
            tuple(ratio(kind) for kind in range(len(self.inflation))),
            float(spare[self._kinds == 0].sum()),
        )


def _linear(columns: Floats, left: Floats) -> tuple[Floats, float]:
    """Return the step of least squares, and what of them is left after it if all is linear."""
    step = linear_step(columns, left)
    return step, float(((left - columns @ step) ** 2).sum())


def _mounted(evidence: Evidence, small: Floats) -> Evidence:
    """Return a session of a unit that is turned in its mount by a rotation vector (3,)."""
    turned = rotations(small[None])[0]
    turns = tuple(replace(t, up=turned @ t.up) for t in evidence.turns)
    return replace(evidence.with_attitudes(evidence.attitudes() @ turned.T), turns=turns)


def factor_of(covariance: Floats) -> Floats:
    """Return a factor (n, n) of a covariance: what rounding makes negative is zero of its size."""
    given = np.sqrt(np.diag(covariance))
    size = np.where(given > 0, given, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(size, size))
    # A matrix of 64-bit numbers holds its eigenvalues to so much: what is smaller is not zero.
    rounding = len(values) * np.finfo(float).eps * values.max(initial=0.0)
    return np.asarray(given[:, None] * vectors * np.sqrt(np.maximum(values, rounding)))
