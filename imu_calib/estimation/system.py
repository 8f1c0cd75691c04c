"""Estimate which errors of a model's parameters explain a session, for one triad.

    left = jacobian d + unknown x + noise,    d ~ (0, factor factor'),    x by its own prior

With attitudes, the equations are the triad's rows of the joint estimate, and the unknowns are
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

from ..common.budget import ErrorSource
from ..common.errors import NotObservable
from ..common.rotations import rotations
from ..common.stream import Floats, Units
from ..model.earth import EARTH_RATE, Site
from ..model.parameters import Parameter
from ..model.sensors import Triad
from ..segmentation.labelling import label
from ..segmentation.segmented import Segmented
from ..session.imu import ImuSpec, StampingClock, TriadSpec
from ..session.plan import Plan
from ..session.table import Table
from .components import Component, Diagonal, whiten
from .equations import Equations
from .evidence import Evidence, in_table_time
from .free_dwells import Sensors, Up, compare_lengths, noise_at_rest
from .information import Information
from .outputs import Indices
from .session_model import Nuisance
from .solve import least_squares, linear_step


@dataclass(frozen=True, eq=False)
class Observed:
    """A session to verify a calibration by."""

    #: Dwells and turns by name; without attitudes and turns if these are unknown.
    evidence: Evidence
    imu: ImuSpec  #: The recording's description of its IMU.
    sample_rate: float  #: Samples per second, Hz.
    notes: tuple[str, ...] = ()  #: What was left out, in sentences.

    @property
    def site(self) -> Site:
        """Gravity and Earth rate."""
        return self.evidence.site

    @property
    def with_attitudes(self) -> bool:
        """Whether directions can be compared, not only lengths."""
        return all(s.attitude is not None for s in self.evidence.segments)

    def reading(self, spec: ImuSpec) -> tuple[float, float]:
        """Return the factors on the outputs for reading them by another description.

        A user of a calibration interprets the stream by the calibration's own description of the
        IMU. The factors are for gyros and accelerometers, dimensionless.
        """
        gyro, accel = self._si_per_number(spec) / self._si_per_number(self.imu)
        return float(gyro), float(accel)

    def _si_per_number(self, spec: ImuSpec) -> Floats:
        if spec.units is Units.SI:
            return np.ones(2)
        scales = np.array([spec.gyro.scale_factor, spec.accel.scale_factor])
        return scales * (self.sample_rate if spec.units.per_interval else 1.0)


def observe(
    session: Segmented,
    imu: ImuSpec,
    site: Site,
    plan: Plan,
    table: Table | None,
    clock: StampingClock | None = None,
) -> Observed:
    """Collect dwells and turns of a session.

    Args:
        session: Contents of the streams.
        imu: The recording's description of its IMU.
        site: Gravity and Earth rate.
        plan: The plan that was run; `plan.UNPLANNED` if unknown: dwells are then named by their
            attitudes, or numbered if those are unknown.
        table: The table whose joint states were recorded; None for the IMU alone.
        clock: The calibration's estimate of the stamping clock; None if its parameters refer to
            that clock.

    Raises:
        InputError: The setpoints name none of the plan's positions.
        NotObservable: Neither dwells nor turns were found.
    """
    with_angles = any(s.attitude is not None for s in session.segments) or bool(session.turns)
    labelled = label(session, plan, table if with_angles or plan.is_stated else None)
    if not labelled.segments and not labelled.turns:
        raise NotObservable(
            f'Neither static dwells nor whole turns were found in {session.samples} IMU samples '
            f'({session.duration:.0f} s): nothing can be compared.'
        )
    # A plan of turns alone has no named dwells.
    timed = [s.statistics for s in labelled.segments or labelled.turns]
    sample_rate = float(np.median([s.samples / s.duration for s in timed]))
    # Attitudes held by hand are accurate to degrees only.
    known = not plan.by_hand and all(s.attitude is not None for s in labelled.segments)
    segments = tuple(
        replace(s, position=s.position or str(k + 1), attitude=s.attitude if known else None)
        for k, s in enumerate(labelled.segments)
    )
    turns = tuple(
        replace(t, position=t.position or str(k + 1)) for k, t in enumerate(labelled.turns)
    )
    named = replace(labelled, segments=segments, turns=turns)
    evidence = _by_the_clock_of(
        clock, Evidence.from_session(named, session, plan, imu, site, table)
    )
    evidence = evidence if known else replace(evidence, turns=(), moves=())
    return Observed(evidence, imu, sample_rate, (*labelled.notes, *session.losses))


def _by_the_clock_of(clock: StampingClock | None, evidence: Evidence) -> Evidence:
    """Return a session by the clock that the calibration refers to.

    A calibration that states the clock ratio refers to the table's clock, and so does a session
    that determines it; a session that does not is taken to be stamped by the same clock. Other
    calibrations of pulses refer to the stamping clock, by which the table's turns take longer.
    """
    if clock is not None:
        if not evidence.clocks_compared:
            # With the prior of quartz clocks, the estimated ratio would be too small.
            known = replace(evidence.clock, rate=clock.faster, rate_std=0.0)
            evidence = replace(evidence, clock=known)
        return in_table_time(evidence)
    if not evidence.units.per_interval:
        return evidence
    faster = 1 + evidence.clock_rate()[0]
    turns = (
        t if t.seconds is None else replace(t, seconds=t.seconds * faster) for t in evidence.turns
    )
    return replace(evidence, turns=tuple(turns))


_ROUNDS = 30  #: Most steps of a fit. Near the minimum three suffice; what needs more does not fit.
_ROUNDS_OF_LENGTHS = 100
"""Most steps with lengths, where a calibration itself is judged: the variance of a square depends
on the state, and errors shrink by a constant factor a step or oscillate until steps are halved.
Calibrations with biases off by 0.005 to 20 deg/s took up to 85 steps, or 59 half steps."""
_ROUNDS_OF_SHARE = 3
"""Newton's steps for a factor that is known to some percent: two leave 1e-8 of it."""

_TOO_FEW = 2.0  #: Degrees of freedom up to which residuals do not determine the noise.

_ANY_TILT = 0.1  #: rad: prior std of an unlevelled table. Accelerometers determine the tilt.


@dataclass(frozen=True, eq=False)
class Fit:
    """Residuals after fitting errors of the parameters within their deviations."""

    chi_square: float  #: Chi-square.
    freedom: int  #: Its degrees of freedom.
    delta: Floats  #: (p,) estimated errors of the parameters.
    std: Floats  #: (p,) their standard deviations.
    #: (u,) the other unknowns: `Nuisance`, and if requested a small rotation in the mount, rad;
    #: empty without attitudes.
    unknown: Floats
    #: Squared residual over its expectation: of dwells, of turns, of moves (1 without).
    ratios: tuple[float, ...]
    spare: float  #: Degrees of freedom of the residuals at rest.
    #: Whether the search converged; else chi-square is that of its start, which is larger.
    converged: bool = True

    @property
    def chance(self) -> float:
        """Probability of a larger chi-square if the model is right."""
        if self.freedom <= 0:
            return 1.0
        return float(scipy.special.chdtrc(self.freedom, self.chi_square))


class _System(Protocol):
    """Derivatives and residuals at a point, both in standard deviations (`_whitened`)."""

    def __call__(self, point: Floats, /, *opposite: Floats) -> tuple[Floats, Floats]: ...


@dataclass(frozen=True, eq=False)
class TriadSystem:
    """The equations of one triad in one session."""

    observed: Observed  #: The session.
    sensors: Sensors  #: Gyros or accelerometers.
    reading: float = 1.0  #: Factor by which the outputs are to be multiplied.
    up: Up | None = None  #: Direction of up by the accelerometers; None if attitudes are known.
    #: Factors on the noise of dwells, of turns and of moves.
    inflation: tuple[float, ...] = (1.0, 1.0, 1.0)
    #: Standard deviation of the biases from dwell to dwell, rad/s or m/s^2.
    bias_drift: float = 0.0
    #: The unknowns fitted with all parameters free, as a start; None before that fit.
    seen: Floats | None = None
    mount_free: bool = False  #: Whether a small rotation of the unit in its mount is estimated.
    #: Parameters of the other triad and their standard deviations: gyros propagate the axes of
    #: velocity changes.
    considered: tuple[tuple[Parameter, float], ...] = ()

    @property
    def gyros(self) -> bool:
        """Whether the triad is that of the gyros."""
        return self.sensors.gyros

    @property
    def magnitude(self) -> float:
        """Earth rate or gravity, SI."""
        return EARTH_RATE if self.gyros else self.observed.evidence.site.gravity

    @property
    def spec(self) -> TriadSpec:
        """The recording's description of the triad."""
        return self.observed.imu.gyro if self.gyros else self.observed.imu.accel

    @cached_property
    def evidence(self) -> Evidence:
        """The session as read; shared, with its cache, by all systems with the same reading."""
        factors = np.ones(6)
        factors[self.sensors.channels] = self.reading
        known, key = self.observed.evidence.cache, ('read', tuple(factors.tolist()))
        if key not in known:
            known[key] = self.observed.evidence.scaled(factors)
        return cast('Evidence', known[key])

    @cached_property
    def outputs(self) -> Floats:
        """(s, 3) outputs at rest, as read."""
        return self.evidence.outputs()[:, self.sensors.channels]

    @property
    def forces(self) -> Floats:
        """(s, 3) specific forces at rest in body axes, m/s^2."""
        if self.up is not None:
            return self.up.forces
        return self.evidence.attitudes()[:, 2] * self.evidence.site.gravity

    @cached_property
    def equations(self) -> Equations:
        """The equations of the joint estimate, with known attitudes."""
        rows = self.evidence.layout
        drifts = np.zeros(len(rows))
        drifts[rows.dwell] = self.bias_drift * self.reading
        seconds = np.array([m.move.duration for m in self.evidence.used_moves.linked]).reshape(
            -1, 1
        )
        drifts[rows.move] = self.bias_drift * self.reading * seconds
        durations = seconds[list(rows.moves_with_accels)]
        drifts[rows.velocity] = self.bias_drift * self.reading * durations
        return Equations(
            self.evidence,
            self.sensors.parameters,
            levelled=None if self.gyros else _ANY_TILT,
            extra=(Component(ErrorSource.BIAS_STATED, Diagonal(drifts**2)),),
            considered=self.considered,
        )

    @cached_property
    def _mine(self) -> Indices:
        """Indices of the triad's equations: at rest, of turns, of moves."""
        return self.equations.layout.gyros if self.gyros else self.equations.layout.accels

    @cached_property
    def _kinds(self) -> Indices:
        """(m,) kind of each of the triad's equations: at rest (0), of turns (1), of moves (2)."""
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
        """(u,) prior values of the nuisances; empty with lengths."""
        return np.zeros(0) if self.up is not None else self.equations.prior[0]

    @cached_property
    def _free(self) -> NDArray[np.bool_]:
        """Mask of unknowns without a prior: heading of gyros, tilt of accelerometers, mount."""
        free = np.zeros(len(self._known), dtype=bool)
        if self.up is None and not self.gyros:
            free[[Nuisance.TILT_X, Nuisance.TILT_Y]] = True
        elif self.up is None:
            free[Nuisance.AZIMUTH] = not self.equations.north_known
        return np.concatenate([free, np.full(3 if self.mount_free else 0, True)])

    def spread(self, values: Floats) -> Floats:
        """Return the covariances (s + t + m, 3, 3) of dwells, turns and moves, parameters excluded.

        Unknowns with an uncertain prior are included: clock, heading, tilt.
        """
        if self.up is not None:
            return self._noise_at_rest
        state, deviations = np.append(values, self._known), self.equations.prior[1]
        further = self.equations.jacobian(state)[:, len(values) :] * deviations
        further = further[:, ~self._free[: len(deviations)]]
        covariance = self.equations.covariance(state) + further @ further.T
        rows = self._mine.reshape(-1, 3)
        found = covariance[rows[:, :, None], rows[:, None, :]]
        return np.asarray(found * self._widened[::3, None, None] ** 2)

    @cached_property
    def _noise_at_rest(self) -> Floats:
        """Covariances of the readings at rest, (s, 3, 3), parameters excluded."""
        variances = self.evidence.variances()[:, self.sensors.channels]
        return noise_at_rest(variances + (self.bias_drift * self.reading) ** 2, self.magnitude)

    def predicted(self, values: Floats) -> Floats:
        """Return the predicted outputs (s + t + m, 3), with the table as described."""
        state = np.append(values, self._known)
        return self.equations.predict(state)[self._mine].reshape(-1, 3)

    def share(self, values: Floats) -> float:
        """Return the factor on the outputs that fits a model best."""
        if self.up is not None:
            return self._share_by_lengths(values)
        # Moves read no difference and do not determine the factor.
        seen = self.equations.outputs[self._mine]
        weighted = seen / np.diagonal(self.spread(values), axis1=1, axis2=2).ravel()
        return float(weighted @ self.predicted(values).ravel() / (weighted @ seen))

    def _share_by_lengths(self, values: Floats) -> float:
        bias = Triad.from_vector(values).bias
        share = self.magnitude / float(np.median(np.linalg.norm(self.outputs - bias, axis=1)))
        if self.gyros:
            return share
        # Scale factors of some percent would hide a gravity that is off by less.
        for _ in range(_ROUNDS_OF_SHARE):
            force, by_outputs, _ = self.sensors.compensated(
                values, self.outputs * share, self.forces
            )
            length = np.linalg.norm(force, axis=1)
            slope = np.einsum('ki,kij,kj->k', force, by_outputs, self.outputs) / length
            share += float(slope @ (self.magnitude - length) / (slope @ slope))
        return share

    def inflated(self, ratios: tuple[float, ...]) -> TriadSystem:
        """Return the system with its noise widened."""
        factors = np.sqrt(np.maximum(ratios, 1.0)) * self.inflation
        return replace(self, inflation=tuple(factors.tolist()))

    @cached_property
    def _without_moves(self) -> TriadSystem:
        """The system without moves, which are nonlinear for large errors."""
        if not len(self.evidence.used_moves):
            return self
        known, key = self.observed.evidence.cache, 'without moves'
        if key not in known:
            known[key] = replace(self.observed, evidence=self.observed.evidence.with_moves(()))
        return replace(self, observed=cast('Observed', known[key]))

    def fit(self, values: Floats, factor: Floats) -> Fit:
        """Fit errors of parameters (p,) with a covariance factor (p, k) to the session."""
        system = self._allowing(values, factor)
        begin = self._begun(system, values, factor)[0]
        rounds = _ROUNDS if self.up is None else _ROUNDS_OF_LENGTHS
        return self._fitted(begin, system, factor, rounds)

    def begun(
        self, values: Floats, factor: Floats, point: Floats
    ) -> tuple[float, Callable[[], Fit]]:
        """Return chi-square by the equations linearised at a point, and the fit from there.

        The point is (k + u,): multiples of the columns of the factor (p, k), and the unknowns.
        """
        system = self._allowing(values, factor)
        columns, residuals = system(point)
        return _linear(columns, residuals)[1], partial(self._fitted, point, system, factor)

    def fit_likely(self, values: Floats, factor: Floats, chance: float) -> Fit | None:
        """Return `fit`; None if dwells and turns alone give a probability far below `chance`.

        Half of chi-square is compared, which allows for nonlinearity: the errors must be small.
        Moves are then not integrated.
        """
        system = self._allowing(values, factor)
        point, square = self._begun(system, values, factor)
        return self._fitted(point, system, factor) if self._likely(square, chance) else None

    def likely(self, values: Floats, factor: Floats, chance: float) -> Callable[[Floats], bool]:
        """Return a function that tells of other values whether `fit_likely` would fit them.

        Without moves, the predictions and their derivatives by the unknowns are linear in the
        parameters: p + 1 points give them for all values. With lengths all are likely.
        """
        if self.up is not None:
            return lambda _: True
        resting, k = self._without_moves, factor.shape[1]
        first = [one[k:] for one in resting._first(k)]

        def rows_of(values: Floats) -> Floats:
            return resting._rows(resting.equations, *(np.append(values, one) for one in first))

        origin = rows_of(values)
        slopes = np.array([rows_of(values + one) - origin for one in np.eye(len(values))])

        def tested(other: Floats) -> bool:
            rows = origin + np.tensordot(other - values, slopes, axes=1)
            try:
                found = resting._by_noise(resting.equations, np.append(other, first[0]), rows)
            except np.linalg.LinAlgError:
                return False
            return self._likely(_linear(*_with_errors(*found, factor, np.zeros(k)))[1], chance)

        return tested

    def _likely(self, square: float, chance: float) -> bool:
        """Return whether half of chi-square by dwells and turns is not too large for `chance`."""
        freedom = len(self._without_moves._kinds)
        return bool(scipy.special.chdtrc(freedom, square / 2) >= chance)

    def _begun(self, system: _System, values: Floats, factor: Floats) -> tuple[Floats, float]:
        """Return the start of `fit` and the linear chi-square there, by dwells and turns."""
        resting = self._without_moves
        if resting is not self:
            system = resting._allowing(values, factor)
        return resting._start(system, factor.shape[1])

    def _fitted(self, point: Floats, system: _System, factor: Floats, rounds: int = _ROUNDS) -> Fit:
        try:
            point, converged = least_squares(point, system, np.add, rounds), True
        except NotObservable:
            # If nothing fits nearby, chi-square at the start rejects the hypothesis.
            converged = False
        found = self._fit_at(*system(point), point, factor)
        return replace(found, converged=converged)

    def _allowing(self, values: Floats, factor: Floats) -> _System:
        """Return the equations at a (k + u,) point: errors of the parameters, and the unknowns."""
        k = factor.shape[1]
        known: dict[bytes, tuple[Floats, Floats]] = {}

        def system(point: Floats, *opposite: Floats) -> tuple[Floats, Floats]:
            # The first and last points of a search are evaluated twice.
            key = b''.join(one.tobytes() for one in (point, *opposite))
            if key not in known:
                others = [one[k:] for one in opposite]
                found = self._whitened(values + factor @ point[:k], point[k:], *others)
                known[key] = _with_errors(*found, factor, point[:k])
            return known[key]

        return system

    def _start(self, system: _System, k: int) -> tuple[Floats, float]:
        """Return the start, and chi-square at the minimum of the linear equations.

        An unknown heading starts at the best fit of the level Earth rate of free size: the
        equations are linear in its components, which change sign with half a turn.
        """
        point, *opposite = self._first(k)
        step, square = _linear(*system(point, *opposite))
        if opposite:
            azimuth = k + Nuisance.AZIMUTH
            point[azimuth] = np.arctan2(step[azimuth], 1 + step[-1])
        return point, square

    def _first(self, k: int) -> list[Floats]:
        """Return the (k + u,) point where `_start` is linear; and the one opposite, if headed."""
        point = np.zeros(k + len(self._free))
        point[k : k + len(self._known)] = self._known if self.seen is None else self.seen
        if self.up is not None or not self._free[Nuisance.AZIMUTH]:
            return [point]
        point[k + Nuisance.AZIMUTH] = 0.0
        opposite = point.copy()
        opposite[k + Nuisance.AZIMUTH] = np.pi
        return [point, opposite]

    def _whitened(
        self, values: Floats, unknown: Floats, *opposite: Floats
    ) -> tuple[Floats, Floats]:
        """Return derivatives (m + q, p + u) and residuals in standard deviations, priors last.

        For each opposite point, half the difference of the predictions is one more last column.
        """
        if self.up is not None:
            noise, site = self.spread(values), self.evidence.site
            jacobian, residuals, covariance = compare_lengths(
                self.sensors, values, self.outputs, noise, self.up, site
            )
            none = np.zeros((0, len(values) + 1))
            return self._scaled(np.column_stack([jacobian, residuals]), covariance, none)
        equations, mount = self.equations, unknown[len(self._known) :]
        if mount.any():
            equations = replace(equations, evidence=_mounted(self.evidence, mount))
        states = [np.append(values, one[: len(self._known)]) for one in (unknown, *opposite)]
        return self._by_noise(equations, states[0], self._rows(equations, *states))

    def _rows(self, equations: Equations, state: Floats, *opposite: Floats) -> Floats:
        """Return derivatives and residuals (m, p + u + 1) as `_whitened`, not divided by noise."""
        turned = [equations.mount_derivatives(state)] if self.mount_free else []
        predicted = equations.predict(state)
        halves = [(predicted - equations.predict(other)) / 2 for other in opposite]
        columns = [equations.jacobian(state), *turned, *halves, equations.outputs - predicted]
        return np.column_stack(columns)[self._mine]

    def _by_noise(self, equations: Equations, state: Floats, rows: Floats) -> tuple[Floats, Floats]:
        """Return `_rows` in standard deviations, priors last."""
        prior = equations.prior_rows(state)
        below = np.insert(prior, [-1] * (rows.shape[1] - prior.shape[1]), 0.0, axis=1)
        covariance = equations.covariance(state)[np.ix_(self._mine, self._mine)]
        return self._scaled(rows, covariance, below)

    def _scaled(self, rows: Floats, covariance: Floats, below: Floats) -> tuple[Floats, Floats]:
        factor = np.linalg.cholesky(covariance) * self._widened[:, None]
        rows = np.vstack([whiten(factor, rows), below])
        return rows[:, :-1], rows[:, -1]

    def _fit_at(self, columns: Floats, residuals: Floats, point: Floats, factor: Floats) -> Fit:
        k, count = factor.shape[1], len(self._kinds)
        found = Information.from_jacobian(columns)
        spare = 1 - np.einsum('ij,ji->i', columns[:count], found.gain[:, :count])
        free = columns[:, k:][:, self._free]
        norms = np.linalg.norm(free[:count], axis=0)
        # Ignore columns at rounding level relative to their prior (a heading with turns alone).
        seen = norms > np.finfo(float).eps * np.linalg.norm(free, axis=0)
        # NumPy 2.2 and older cannot compute the rank of an empty matrix.
        spanned = free[:count, seen] / norms[seen]
        rank = int(np.linalg.matrix_rank(spanned)) if spanned.size else 0
        spread = np.diag(factor @ found.covariance[:k, :k] @ factor.T)

        def ratio(kind: int) -> float:
            these = self._kinds == kind
            expected, square = (
                float(spare[these].sum()),
                float((residuals[:count][these] ** 2).sum()),
            )
            return square / expected if expected > _TOO_FEW else 1.0

        return Fit(
            float(residuals @ residuals),
            count - rank,
            factor @ point[:k],
            np.sqrt(np.maximum(spread, 0.0)),
            point[k:],
            tuple(ratio(kind) for kind in range(len(self.inflation))),
            float(spare[self._kinds == 0].sum()),
        )


def _linear(columns: Floats, residuals: Floats) -> tuple[Floats, float]:
    """Return the least-squares step, and the sum of squared residuals after it if linear."""
    step = linear_step(columns, residuals)
    return step, float(((residuals - columns @ step) ** 2).sum())


def _with_errors(
    columns: Floats, residuals: Floats, factor: Floats, errors: Floats
) -> tuple[Floats, Floats]:
    """Return equations for multiples (k,) of a factor's columns (p, k), with their prior."""
    count, k = factor.shape
    columns = np.hstack([columns[:, :count] @ factor, columns[:, count:]])
    prior = np.eye(k, columns.shape[1])
    return np.vstack([columns, prior]), np.append(residuals, -errors)


def _mounted(evidence: Evidence, small: Floats) -> Evidence:
    """Return the session with the unit rotated in its mount by a rotation vector (3,)."""
    turned = rotations(small[None])[0]
    turns = tuple(replace(t, up=turned @ t.up) for t in evidence.turns)
    return replace(evidence.with_attitudes(evidence.attitudes() @ turned.T), turns=turns)


def factor_of(covariance: Floats) -> Floats:
    """Return a factor (n, n) of a covariance; eigenvalues below rounding are raised to it."""
    given = np.sqrt(np.diag(covariance))
    size = np.where(given > 0, given, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(size, size))
    # Smaller eigenvalues of a 64-bit matrix are rounding.
    rounding = len(values) * np.finfo(float).eps * values.max(initial=0.0)
    return np.asarray(given[:, None] * vectors * np.sqrt(np.maximum(values, rounding)))
