"""Estimate which errors of a model's parameters explain a session, for one triad.

    left = jacobian d + unknown x + noise,    d ~ (0, factor factor'),    x by its own prior

With attitudes, the equations are the triad's rows of the joint estimate, and the unknowns are
its nuisances. Source: docs/mathematics.md, 'Verification'.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import cast

import numpy as np
import scipy
from numpy.typing import NDArray

from ..common.budget import ErrorSource
from ..common.errors import NotObservable
from ..common.rotations import rotations
from ..common.stream import Floats
from ..model.earth import EARTH_RATE, Site
from ..model.parameters import Parameter
from ..model.sensors import Triad
from ..segmentation.labelling import label
from ..segmentation.segmented import Segmented
from ..session.imu import ImuSpec, StampingClock, TriadSpec
from ..session.plan import Plan
from ..session.table import Table
from .components import Blocks, Component, whiten
from .equations import Equations
from .evidence import Evidence, in_table_time
from .excess_scatter import drift_about_mean, kept_share
from .free_dwells import Sensors, Up, compare_lengths, noise_at_rest
from .information import Information
from .outputs import Indices
from .positioning_errors import PositioningErrors
from .session_model import Nuisance
from .solve import STARTS, least_squares, linear_step
from .variances import Variance, choose_variances, restricted


@dataclass(frozen=True, eq=False)
class Observed:
    """A session to verify a calibration by."""

    #: Dwells and turns by name; without attitudes and turns if these are unknown.
    evidence: Evidence
    imu: ImuSpec  #: The recording's description of its IMU.
    notes: tuple[str, ...] = ()  #: What was left out, in sentences.
    #: By how much the recording is warmer than the calibration, K; None if either is unknown.
    warmer: float | None = None

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
        if spec.units is not self.imu.units:
            # Each states what its own numbers are, and parameters are ratios and SI biases.
            return 1.0, 1.0
        own = self.imu
        return (
            spec.gyro.scale_factor / own.gyro.scale_factor,
            spec.accel.scale_factor / own.accel.scale_factor,
        )


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
    return Observed(evidence, imu, (*labelled.notes, *session.losses))


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

_LEAST_GAIN = 5.0
"""Least gain in log likelihood by scatter of a kind beyond the noise, half of chi-square: one sound
session in three hundred gains as much by chance in one of three kinds."""

_PROBABLE = 0.05
"""Probability of a kind of scatter below which it is none. A judgement: positioning errors that a
few dwells seem to show affect turns so much that a millionth of them would widen these."""

_SEEN = 1e-6  #: Share of a column that is no rounding: far above it, and far below any correlation.
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
    #: Whether the search converged; else chi-square is that of its start, which is larger.
    converged: bool

    @property
    def chance(self) -> float:
        """Probability of a larger chi-square if the model is right."""
        if self.freedom <= 0:
            return 1.0
        return float(scipy.special.chdtrc(self.freedom, self.chi_square))


@dataclass(frozen=True, eq=False)
class Scatter:
    """Scatter of dwells, turns and moves beyond their noise, whatever the parameters."""

    #: Variances of dwells, turns and moves over those of their noise, and of positioning errors of
    #: joints, rad^2.
    variances: Floats = field(default_factory=lambda: np.zeros(4))
    factors: tuple[float, ...] = (1.0, 1.0, 1.0)  #: Times the noise of dwells, turns and moves.
    at_rest: float = 0.0  #: Degrees of freedom of the residuals of dwells.
    freedom: float = 0.0  #: Those of all.


@dataclass(frozen=True, eq=False)
class Shifts:
    """Equations of shifts of the parameters beyond their deviations, in standard deviations.

    residuals = columns shift + noise of variance 1. The likelihood of a shift depends on no more.
    """

    columns: Floats  #: (n, p)
    residuals: Floats  #: (n,)

    @property
    def sensitivities(self) -> Floats:
        """(p,) deviations by which a shift of one unit of each parameter shows."""
        return np.asarray(np.linalg.norm(self.columns, axis=0))

    @property
    def deviates(self) -> Floats:
        """(p,) score statistics: standard normal numbers unless a parameter has moved."""
        return self._of(self.columns, self.residuals)

    def beyond(self, limit: float, among: NDArray[np.bool_]) -> list[tuple[int, float, float]]:
        """Return index, size and standard deviation of the shifts (p,) that explain the session.

        The largest is taken out until none of the others is beyond a limit: one that moved shows
        in whatever it is correlated with, too.
        """
        found: list[int] = []
        left, residuals = self.columns, self.residuals
        while True:
            deviates = np.where(among, np.abs(self._of(left, residuals)), 0.0)
            deviates[found] = 0.0
            if not deviates.max(initial=0.0) > limit:
                break
            found.append(int(np.argmax(deviates)))
            taken = np.linalg.qr(self.columns[:, found])[0]
            left = self.columns - taken @ (taken.T @ self.columns)
            residuals = self.residuals - taken @ (taken.T @ self.residuals)
        if not found:
            return []
        columns = self.columns[:, found]
        size = np.linalg.lstsq(columns, self.residuals, rcond=None)[0]
        std = np.linalg.norm(np.linalg.pinv(columns), axis=1)
        return list(zip(found, size.tolist(), std.tolist(), strict=True))

    def _of(self, columns: Floats, residuals: Floats) -> Floats:
        own, now = self.sensitivities, np.linalg.norm(columns, axis=0)
        # Rounding is left of what no session shows, or what others take up.
        seen = now > _SEEN * np.where(own > 0, own, 1.0)
        return np.where(seen, columns.T @ residuals / np.where(seen, now, 1.0), 0.0)


_System = Callable[[Floats], tuple[Floats, Floats]]
"""Derivatives and residuals at a point, both in standard deviations."""


@dataclass(frozen=True, eq=False)
class TriadSystem:
    """The equations of one triad in one session."""

    observed: Observed  #: The session.
    sensors: Sensors  #: Gyros or accelerometers.
    reading: float = 1.0  #: Factor by which the outputs are to be multiplied.
    up: Up | None = None  #: Direction of up by the accelerometers; None if attitudes are known.
    scatter: Scatter = field(default_factory=Scatter)  #: That is allowed for.
    drift: float = 0.0  #: Share of the variance of the drift that the data sheet states.
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
        return self.evidence.dwell_attitudes[:, 2] * self.evidence.site.gravity

    @cached_property
    def equations(self) -> Equations:
        """The equations of the joint estimate, with known attitudes."""
        extra: tuple[Component, ...] = ()
        if self.drift:
            drifting = Blocks(self._mine[None], self.drift * self._stated_drift[None])
            extra = (Component(ErrorSource.BIAS_STATED, drifting),)
        return Equations(
            self.evidence,
            self.sensors.parameters,
            levelled=None if self.gyros else _ANY_TILT,
            extra=extra,
            considered=self.considered,
            positioning=PositioningErrors(float(np.sqrt(self.scatter.variances[3]))),
        )

    @cached_property
    def _mine(self) -> Indices:
        """Indices of the triad's equations: at rest, of turns, of moves."""
        return self.evidence.layout.gyros if self.gyros else self.evidence.layout.accels

    @cached_property
    def _stated_drift(self) -> Floats:
        """Covariance (m, m) of the outputs by the drift stated, about its mean.

        The mean is part of the parameters' covariance: biases differ between sessions.
        """
        known, key = self.evidence.cache, ('drift', self.gyros)
        if key not in known:
            known[key] = drift_about_mean(self.evidence, self.sensors.channels.start)
        return cast('Floats', known[key]) * (self.spec.bias_instability * self.reading) ** 2

    @cached_property
    def _kinds(self) -> Indices:
        """(m,) kind of each of the triad's equations: at rest (0), of turns (1), of moves (2)."""
        if self.up is not None:
            return np.zeros(len(self.outputs) * (2 if self.gyros else 1), dtype=np.intp)
        rows = self.evidence.layout
        of_moves = np.isin(self._mine, rows.moving)
        return np.where(self._mine < rows.dwell.size, 0, np.where(of_moves, 2, 1))

    @property
    def _inflation(self) -> Floats:
        """(m,) factors on the noise of each equation."""
        return np.asarray(np.sqrt(1 + self.scatter.variances[self._kinds]))

    @property
    def _block(self) -> tuple[Indices, ...]:
        return np.ix_(self._mine, self._mine)

    def _lengths(self, values: Floats) -> tuple[Floats, Floats, Floats]:
        """Return derivatives, residuals and covariance of the equations without attitudes."""
        assert self.up is not None
        noise, site = self._noise_at_rest, self.evidence.site
        return compare_lengths(self.sensors, values, self.outputs, noise, self.up, site)

    def _covariance(self, state: Floats) -> Floats:
        if self.up is not None:
            return self._lengths(state)[2]
        return self.equations.covariance(state)[self._block]

    def _root(self, covariance: Floats) -> Floats:
        """Return the lower root of a covariance of the triad's equations, with their scatter."""
        return np.asarray(np.linalg.cholesky(covariance) * self._inflation)

    @property
    def _known(self) -> Floats:
        """(u,) prior values of the nuisances; empty with lengths."""
        return np.zeros(0 if self.up is not None else self.equations.nuisances)

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
            every = np.arange(len(self.outputs))
            return np.asarray(self._noise_at_rest[every, :, every])
        state, deviations = np.append(values, self._known), self.equations.prior_deviations
        further = self.equations.jacobian(state)[self._mine, len(values) :] * deviations
        further = further[:, ~self._free[: len(deviations)]]
        parts = np.hstack([self._root(self._covariance(state)), further])
        rows = parts.reshape(-1, 3, parts.shape[1])
        return np.asarray(rows @ np.swapaxes(rows, 1, 2))

    @cached_property
    def _noise_at_rest(self) -> Floats:
        """Covariance of the readings at rest, (s, 3, s, 3), parameters excluded."""
        count = len(self.outputs)
        found = (self.drift * self._stated_drift).reshape(count, 3, count, 3)
        own = noise_at_rest(self.evidence.variances()[:, self.sensors.channels], self.magnitude)
        found[np.arange(count), :, np.arange(count)] += own
        return found

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

    def shown_drift(self, columns: Floats, residuals: Floats, state: Floats) -> float:
        """Return the share of the drift stated that whitened equations without it show."""
        count, own = len(self._kinds), self._covariance(state)
        prior = np.column_stack([columns, residuals])[count:]
        project, left = restricted(columns[:count], residuals[:count], np.eye(count), prior)
        root, by_drift = self._root(own), replace(self, drift=1.0)._covariance(state) - own
        entering = whiten(root, whiten(root, by_drift).T)
        return kept_share(left, project.T @ entering @ project)

    def likely_scatter(self, columns: Floats, residuals: Floats, state: Floats) -> Scatter:
        """Find the scatter in whitened equations (m + q, n) at a state, priors last."""
        count = len(self._kinds)
        root = self._root(self._covariance(state))
        own = [np.eye(count)[:, self._kinds == kind] for kind in range(3)]
        by_joints = self.equations.positioning_error_effects(state)[0]
        effects = [*own, whiten(root, by_joints[self._mine])]
        prior = np.column_stack([columns, residuals])[count:]
        project, left = restricted(columns[:count], residuals[:count], np.eye(count), prior)
        # As large as noise for a variance of one.
        units = np.array([float((one**2).sum()) / count or 1.0 for one in effects])
        entering = [project.T @ one for one in effects]
        sought = [[Variance((e @ e.T / unit,))] for e, unit in zip(entering, units, strict=True)]
        chosen = choose_variances([(left, np.eye(len(left)))], (), sought, _LEAST_GAIN)
        probable = [chosen.probability(kind) > _PROBABLE for kind in range(len(units))]
        variances = np.where(probable, np.concatenate(chosen.means) / units, 0.0)
        total = sum(v * (e**2).sum(axis=1) for v, e in zip(variances, effects, strict=True))
        freedom = (project**2).sum(axis=1)
        mine = [total[self._kinds == kind] for kind in range(3)]
        return Scatter(
            variances,
            tuple(float(np.sqrt(1 + one.mean())) if len(one) else 1.0 for one in mine),
            float(freedom[self._kinds == 0].sum()),
            float(freedom.sum()),
        )

    @cached_property
    def _without_moves(self) -> TriadSystem:
        """The system without moves, which are nonlinear for large errors."""
        if not len(self.evidence.used_moves):
            return self
        known, key = self.observed.evidence.cache, 'without moves'
        if key not in known:
            known[key] = replace(self.observed, evidence=replace(self.observed.evidence, moves=()))
        return replace(self, observed=cast('Observed', known[key]))

    def fit(self, values: Floats, factor: Floats, chance: float = 0.0) -> Fit:
        """Fit errors of parameters (p,) with a covariance factor (p, k) to the session.

        Where dwells and turns alone show that the probability is far below `chance`, chi-square is
        theirs at the start; half of it allows for nonlinearity.
        """
        resting, k = self._without_moves, factor.shape[1]
        known = self._known if self.seen is None else self.seen
        point = np.pad(np.append(np.zeros(k), known), (0, len(self._free) - len(known)))
        at_rest, system = (one.allowing(values, factor) for one in (resting, self))
        if self.seen is None and self.up is None and self._free[Nuisance.AZIMUTH]:
            headings = 2 * np.pi / STARTS * np.arange(STARTS)
            around = np.tile(point, (STARTS, 1))
            around[:, k + Nuisance.AZIMUTH] = headings
            squares = np.array([least_square(*at_rest(one)) for one in around])
            # Chi-square is nearly a sine of the heading.
            point[k + Nuisance.AZIMUTH] = np.angle(-squares @ np.exp(1j * headings))
        here, converged, square = self, False, least_square(*at_rest(point))
        if scipy.special.chdtrc(len(resting._kinds), square / 2) < chance:
            here, system = resting, at_rest
        else:
            # If nothing fits nearby, chi-square at the start rejects the hypothesis.
            with suppress(NotObservable):
                rounds = _ROUNDS if self.up is None else _ROUNDS_OF_LENGTHS
                point, converged = least_squares(point, system, np.add, rounds), True
        return here._fit_at(*system(point), point, factor, converged=converged)

    def allowing(self, values: Floats, factor: Floats) -> _System:
        """Return the equations at a (k + u,) point: errors of the parameters, and the unknowns."""
        (p, k), known = factor.shape, dict[bytes, tuple[Floats, Floats]]()

        def system(point: Floats) -> tuple[Floats, Floats]:
            # The first and last points of a search are evaluated twice.
            if (key := point.tobytes()) not in known:
                rows = self._whitened(values + factor @ point[:k], point[k:])
                columns = np.hstack([rows[:, :p] @ factor, rows[:, p:-1]])
                columns = np.vstack([columns, np.eye(k, columns.shape[1])])
                known[key] = columns, np.append(rows[:, -1], -point[:k])
            return known[key]

        return system

    def shifts(self, values: Floats, factor: Floats, fit: Fit) -> Shifts:
        """Return what the session shows of shifts of the parameters (p,) beyond their deviations.

        Those are by the factor (p, k) of their covariance. What the other unknowns take up of a
        shift, such as the tilt of the table, is left out.
        """
        rows = self._whitened(values + fit.delta, fit.unknown)
        count = len(values)
        shown, others = rows[:, [*range(count), -1]], rows[:, count:-1]
        if others.size:
            shown = shown - others @ np.linalg.lstsq(others, shown, rcond=None)[0]
        orthogonal, columns = np.linalg.qr(shown[:, :count])
        residuals = orthogonal.T @ shown[:, count] + columns @ fit.delta
        by_parameters = columns @ factor
        root = np.linalg.cholesky(np.eye(len(columns)) + by_parameters @ by_parameters.T)
        return Shifts(np.linalg.solve(root, columns), np.linalg.solve(root, residuals))

    def _whitened(self, values: Floats, unknown: Floats) -> Floats:
        """Return derivatives and residuals (m + q, p + u + 1) in deviations, priors last."""
        if self.up is not None:
            jacobian, residuals, covariance = self._lengths(values)
            return whiten(self._root(covariance), np.column_stack([jacobian, residuals]))
        equations, mount = self.equations, unknown[len(self._known) :]
        if mount.any():
            equations = replace(equations, evidence=_mounted(self.evidence, mount))
        state = np.append(values, unknown[: len(self._known)])
        turned = [equations.mount_derivatives(state)] if self.mount_free else []
        residuals = equations.outputs - equations.predict(state)
        rows = np.column_stack([equations.jacobian(state), *turned, residuals])[self._mine]
        prior = np.insert(equations.prior_rows(state), [-1] * len(mount), 0.0, axis=1)
        root = self._root(equations.covariance(state)[self._block])
        return np.vstack([whiten(root, rows), prior])

    def _fit_at(
        self, columns: Floats, residuals: Floats, point: Floats, factor: Floats, *, converged: bool
    ) -> Fit:
        k, count = factor.shape[1], len(self._kinds)
        found = Information.from_jacobian(columns)
        free = columns[:, k:][:, self._free]
        norms = np.linalg.norm(free[:count], axis=0)
        # Ignore columns at rounding level relative to their prior (a heading with turns alone).
        seen = norms > np.finfo(float).eps * np.linalg.norm(free, axis=0)
        # NumPy 2.2 and older cannot compute the rank of an empty matrix.
        spanned = free[:count, seen] / norms[seen]
        rank = int(np.linalg.matrix_rank(spanned)) if spanned.size else 0
        spread = np.diag(factor @ found.covariance[:k, :k] @ factor.T)
        return Fit(
            float(residuals @ residuals),
            count - rank,
            factor @ point[:k],
            np.sqrt(np.maximum(spread, 0.0)),
            point[k:],
            converged,
        )


def least_square(columns: Floats, residuals: Floats) -> float:
    """Return the sum of squared residuals at the minimum if all is linear."""
    return float(((residuals - columns @ linear_step(columns, residuals)) ** 2).sum())


def _mounted(evidence: Evidence, small: Floats) -> Evidence:
    """Return the session with the unit rotated in its mount by a rotation vector (3,)."""
    turned = rotations(small[None])[0]
    turns = tuple(replace(t, up=turned @ t.up) for t in evidence.turns)
    return replace(evidence.with_attitudes(evidence.dwell_attitudes @ turned.T), turns=turns)


def factor_of(covariance: Floats) -> Floats:
    """Return a factor (n, n) of a covariance; eigenvalues below rounding are raised to it."""
    given = np.sqrt(np.diag(covariance))
    size = np.where(given > 0, given, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(size, size))
    # Smaller eigenvalues of a 64-bit matrix are rounding.
    rounding = len(values) * np.finfo(float).eps * values.max(initial=0.0)
    return np.asarray(given[:, None] * vectors * np.sqrt(np.maximum(values, rounding)))
