"""A session as equations for one triad: what a model predicts, and what is left of the outputs.

With attitudes there are three equations for each rest and each turn: the outputs, against the model
of what the attitude says (gravity or Earth rate, turned into body axes). Without, there are the
lengths of the compensated vectors and, for the gyros, their part along gravity, which is the
vertical Earth rate wherever the unit stands.

Unknown beside the errors of the parameters are the tilt of the table and the azimuth of its zero;
where the table's file states the error of its arrivals, it is one small rotation for all that was
measured with the same axis up.

Source: Cao 2022, eqs. (1)-(2); Luo 2018, eqs. (2-190) to (2-193).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from ..earth import EARTH_RATE, Site
from ..methods.equations import headings, whole
from ..methods.evidence import SMALLEST_VARIANCE
from ..model import AXES, Parameter, SensorModel, Triad
from ..stream import Floats
from ..turntable import rotation
from .observed import Observed

_PASSES = 6
_CONVERGED = 1e-3
_SAME_UP = 0.99


@dataclass(frozen=True, eq=False)
class Sensors:
    """One triad of a model, with all that the model adds to its channels.

    Attributes:
        model: The whole model.
        gyros: Gyros or accelerometers.
        parameters: The triad's, in the order of vectors.

    """

    model: SensorModel
    gyros: bool
    parameters: tuple[Parameter, ...]

    @classmethod
    def of(cls, model: SensorModel, parameters: tuple[Parameter, ...], *, gyros: bool) -> Sensors:
        """Take one triad of a model; skewed gyros are not among its three."""
        return cls(model, gyros, of_triad(parameters, gyros=gyros))

    @property
    def triad(self) -> Triad:
        """The linear part but for g-sensitivity."""
        return self.model.gyro if self.gyros else self.model.accel

    @property
    def values(self) -> Floats:
        """(p,) values of the parameters."""
        return self.model.values(self.parameters)

    def with_triad(self, triad: Triad) -> Sensors:
        """Return the sensors with another linear part."""
        if self.gyros:
            return replace(self, model=replace(self.model, gyro=triad))
        return replace(self, model=replace(self.model, accel=triad))

    def with_values(self, parameters: tuple[Parameter, ...], values: Floats) -> Sensors:
        """Return the sensors with other values of some parameters."""
        return replace(self, model=self.model.with_values(parameters, values))

    def moved(self, delta: Floats) -> Sensors:
        """Add (p,) to the parameters."""
        return self.with_values(self.parameters, self.values + delta)

    def predict(self, inputs: Floats, forces: Floats) -> Floats:
        """Return what the triad reads, (..., 3), at its inputs and the specific forces."""
        return self.model.predict(*self._both(inputs, forces))[0 if self.gyros else 1]

    def compensate(self, outputs: Floats, forces: Floats) -> Floats:
        """Return the inputs (m, 3) that outputs mean where the forces are known."""
        if not self.gyros:
            return self.model.compensate(np.zeros_like(outputs), outputs)[1]
        felt = self.model.predict(np.zeros_like(forces), forces)[1]
        return self.model.compensate(outputs, felt)[0]

    def jacobian(self, inputs: Floats, forces: Floats) -> Floats:
        """Return what the outputs change by with each parameter, (..., 3, p)."""
        both = self._both(inputs, forces)
        return self.model.derivatives(*both, self.parameters)[..., self._own, :]

    def slopes(self, inputs: Floats, forces: Floats) -> Floats:
        """Return what the outputs change by with the inputs, (..., 3, 3)."""
        return self.model.slopes(*self._both(inputs, forces))[..., self._own, self._own]

    @property
    def _own(self) -> slice:
        return slice(0, 3) if self.gyros else slice(3, 6)

    def _both(self, inputs: Floats, forces: Floats) -> tuple[Floats, Floats]:
        # What accelerometers answer does not depend on rates.
        return (inputs, forces) if self.gyros else (np.zeros_like(inputs), inputs)


def turning_inputs(ups: Floats, rates: Floats, site: Site) -> tuple[Floats, Floats]:
    """Return rates and specific forces at the headings of whole turns, (t, 8, 3) each.

    Args:
        ups: (t, 3) up in body axes.
        rates: (t,) of the table about up, rad/s.
        site: Earth rate and gravity.

    """
    turned = headings(ups)
    spun = (ups * rates[:, None])[:, None]
    return turned @ site.earth_rate + spun, turned @ site.specific_force


def of_triad(parameters: tuple[Parameter, ...], *, gyros: bool) -> tuple[Parameter, ...]:
    """Return the parameters of the three gyros, or of the accelerometers."""
    letter = 'g' if gyros else 'a'
    return tuple(p for p in parameters if p.triad == letter and p.row < len(AXES))


@dataclass(frozen=True, eq=False)
class World:
    """What the rests see: a vector in the table's frame, and how the unit sits in its mount.

    Attributes:
        vector: (3,) Earth rate or specific force in the frame of the attitudes.
        mount: (3, 3) rotation of the body against what the table's file says.

    """

    vector: Floats
    mount: Floats


@dataclass(frozen=True, eq=False)
class Rows:
    """Linearised equations: residual = jacobian d + free x + prior y + noise.

    Attributes:
        residual: (n,) outputs less prediction.
        outputs: (n,) what was measured.
        sigma: (n,) standard deviation of the noise.
        jacobian: (n, p) to the parameters.
        free: (n, b) to what is unknown.
        prior: (n, c) to what is known to have a standard deviation of one.
        turns: (n,) whether an equation is a turn's.

    """

    residual: Floats
    outputs: Floats
    sigma: Floats
    jacobian: Floats
    free: Floats
    prior: Floats
    turns: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Fit:
    """What is left when errors of the parameters within their deviations are allowed for.

    Attributes:
        square: Chi-square.
        freedom: Its degrees of freedom.
        delta: (p,) the parameters' likely errors.
        std: (p,) their standard deviations.
        world: As the session shows it.
        ratios: Squared residual over its expectation: of rests, and of turns (1 without).
        spare: How many residuals at rest are left to tell by, beyond what was estimated.
        mounted: (3,) small rotation in the mount, rad; zero unless it was asked for.

    """

    square: float
    freedom: int
    delta: Floats
    std: Floats
    world: World
    ratios: tuple[float, float]
    spare: float
    mounted: Floats

    @property
    def chance(self) -> float:
        """Probability of a chi-square so large where all is well."""
        return float(scipy.special.chdtrc(self.freedom, self.square)) if self.freedom > 0 else 1.0


@dataclass(frozen=True, eq=False)
class Leaning:
    """How far off the directions of up are that the accelerometers show.

    Attributes:
        columns: (s, 3, c) for errors of their parameters of one standard deviation.
        noise: (s, 3, 3) covariances by their noise at each rest.

    """

    columns: Floats
    noise: Floats

    @classmethod
    def of(cls, accelerometers: Sensors, factor: Floats, forces: Floats, noise: Floats) -> Leaning:
        """Turn errors of the accelerometers into errors of up, to first order.

        Args:
            accelerometers: The triad.
            factor: (12, c) of the covariance of its parameters.
            forces: (s, 3) specific forces at rest in body axes.
            noise: (s, 3) variances of the outputs.

        """
        inverse = np.linalg.inv(accelerometers.slopes(forces, forces))
        size = np.linalg.norm(forces, axis=1)[:, None, None]
        up = forces[:, :, None] / size
        level = (np.eye(3) - up @ np.swapaxes(up, 1, 2)) @ inverse / size
        columns = level @ accelerometers.jacobian(forces, forces) @ factor
        return cls(columns, np.einsum('mij,mj,mkj->mik', level, noise, level))


@dataclass(frozen=True, eq=False)
class System:
    """The equations of one triad in one session.

    Attributes:
        observed: The session.
        gyros: Gyros or accelerometers.
        reading: Factor by which the outputs are to be multiplied.
        forces: (s, 3) specific forces at rest in body axes.
        parameters: Of the triad.
        inflation: Factors on the noise of rests and of turns.
        wander: Standard deviation of the biases from rest to rest, rad/s or m/s^2.
        leaning: Of up, where gyros are held against what the accelerometers show of it.

    """

    observed: Observed
    gyros: bool
    reading: float
    forces: Floats
    parameters: tuple[Parameter, ...]
    inflation: tuple[float, float] = (1.0, 1.0)
    wander: float = 0.0
    leaning: Leaning | None = None

    def inflated(self, ratios: tuple[float, float]) -> System:
        """Return the system with its noise widened."""
        a, b = self.inflation
        factors = (a * np.sqrt(max(ratios[0], 1.0)), b * np.sqrt(max(ratios[1], 1.0)))
        return replace(self, inflation=(float(factors[0]), float(factors[1])))

    @property
    def world(self) -> World:
        """What is to be seen where the table stands level and its zero points north."""
        site = self.observed.site
        vector = site.earth_rate if self.gyros else site.specific_force
        return World(vector, np.eye(3))

    @property
    def magnitude(self) -> float:
        """Earth rate or gravity, SI."""
        return EARTH_RATE if self.gyros else self.observed.site.gravity

    @property
    def outputs(self) -> Floats:
        """(s, 3) at rest, as they are read."""
        mine = slice(0, 3) if self.gyros else slice(3, 6)
        return np.array([r.output[mine] for r in self.observed.rests]).reshape(-1, 3) * self.reading

    @property
    def variances(self) -> Floats:
        """(s, 3) of these, all noise included."""
        mine = slice(0, 3) if self.gyros else slice(3, 6)
        rests = np.array([r.variance[mine] for r in self.observed.rests]).reshape(-1, 3)
        noise = (rests * self.inflation[0] ** 2 + self.wander**2) * self.reading**2
        # Known a billion times better than turns, rests would leave what turns say to rounding.
        return np.asarray(np.maximum(noise, SMALLEST_VARIANCE * max(1.0, self.magnitude) ** 2))

    @property
    def turn_variances(self) -> Floats:
        """(t, 3) of the outputs in turns, but for the error of the encoder's rate."""
        noise = np.array([t.variance for t in self.observed.turns]).reshape(-1, 3)
        factor = (self.inflation[1] * self.reading) ** 2
        # Rounding is a share of the output: a turn's is that of its rate.
        rates = np.array([t.rate for t in self.observed.turns])[:, None]
        least = SMALLEST_VARIANCE * np.maximum(1.0, np.abs(rates)) ** 2
        return np.asarray(np.maximum(noise * factor, least))

    def rows(self, sensors: Sensors, world: World, step: Floats, *, level_known: bool) -> Rows:
        """Set the equations up around a model.

        Args:
            sensors: The model.
            world: The vector that is seen at rest.
            step: (size, k) by which the model has been moved or, at first, may have to be.
            level_known: Whether the length of its level part is settled (gyros alone).

        """
        if not self.observed.with_attitudes:
            return self._lengths(sensors, step)
        return self._outputs(sensors, world, level_known=level_known)

    def _outputs(self, sensors: Sensors, world: World, *, level_known: bool) -> Rows:
        seen = self.observed
        to_body = np.array([r.attitude.T for r in seen.rests if r.attitude is not None])
        to_body = world.mount @ to_body.reshape(-1, 3, 3)
        inputs, forces = to_body @ world.vector, to_body @ seen.site.specific_force
        outputs, variances = self.outputs, self.variances
        predicted = sensors.predict(inputs, forces)
        jacobian = sensors.jacobian(inputs, forces)
        ups = to_body[:, :, 2]
        at_rest = np.ones(len(inputs), dtype=bool)
        if self.gyros and seen.turns:
            up = np.array([t.up for t in seen.turns]) @ world.mount.T
            rates = np.array([t.rate for t in seen.turns])
            errors = np.array([t.rate_error for t in seen.turns]) * rates * self.inflation[1]
            along = (up @ sensors.triad.response.T * errors[:, None]) ** 2
            turning = turning_inputs(up, rates, seen.site)
            predicted = np.vstack([predicted, whole(sensors.predict(*turning))])
            jacobian = np.vstack([jacobian, whole(sensors.jacobian(*turning))])
            inputs = np.vstack([inputs, up * (rates + seen.site.up_rate)[:, None]])
            outputs = np.vstack([outputs, [t.output * self.reading for t in seen.turns]])
            variances = np.vstack([variances, self.turn_variances + along])
            ups = np.vstack([ups, up])
            at_rest = np.concatenate([at_rest, np.zeros(len(up), dtype=bool)])
        response = sensors.triad.response
        free = np.einsum('ij,mjk->mik', response, to_body) @ self._unknown(
            world, level_known=level_known
        )
        unseen = np.zeros((len(inputs) - len(free), 3, free.shape[2]))
        prior = np.zeros((len(inputs), 3, 0))
        if seen.positioning:
            prior = _arrivals(ups, inputs, response) * seen.positioning
        if self.gyros:
            clock = np.where(at_rest[:, None], 0.0, inputs @ response.T) * seen.clock_std
            prior = np.concatenate([prior, clock[:, :, None]], axis=2)
        return Rows(
            (outputs - predicted).ravel(),
            outputs.ravel(),
            np.sqrt(variances).ravel(),
            jacobian.reshape(-1, len(self.parameters)),
            np.concatenate([free, unseen]).reshape(3 * len(inputs), -1),
            prior.reshape(3 * len(inputs), -1),
            np.repeat(~at_rest, 3),
        )

    def _unknown(self, world: World, *, level_known: bool) -> Floats:
        """Return what of the world is unknown, (3, b): columns of its vector's derivatives."""
        if not self.gyros or not level_known:
            known = self.gyros and self.observed.north_known
            return np.eye(3)[:, :0] if known else np.eye(3)[:, :2] * self.magnitude
        if self.observed.north_known:
            return np.eye(3)[:, :0]
        east, north, _ = world.vector
        return np.array([[-north], [east], [0.0]])

    def _lengths(self, sensors: Sensors, step: Floats) -> Rows:
        """Compare lengths, and what of the rate lies along gravity: no attitude is needed."""
        seen = sensors.compensate(self.outputs, self.forces)
        inverse = np.linalg.inv(sensors.slopes(seen, self.forces))
        jacobian = -inverse @ sensors.jacobian(seen, self.forces)
        noise = np.einsum('mij,mj,mkj->mik', inverse, self.variances, inverse)
        magnitude = self.magnitude
        # What a step leaves to second order: the further it went, the less its end is the minimum.
        bent = np.einsum('mip,pk->mik', jacobian, step)
        bent = np.einsum('mik,mik->m', bent, bent) / magnitude
        # The mean of a squared length is the square of the mean and the noise.
        trace = np.trace(noise, axis1=1, axis2=2)
        excess = (np.einsum('mi,mi->m', seen, seen) - trace - magnitude**2) / (2 * magnitude)
        spread = 4 * np.einsum('mi,mij,mj->m', seen, noise, seen)
        spread += 2 * np.einsum('mij,mji->m', noise, noise)
        prior = np.zeros((len(seen) * (2 if self.gyros else 1), 0))
        residuals, sigmas = [-excess], [np.hypot(np.sqrt(spread) / (2 * magnitude), bent)]
        jacobians = [np.einsum('mi,mip->mp', seen, jacobian) / magnitude]
        if self.gyros:
            up = self.forces / np.linalg.norm(self.forces, axis=1)[:, None]
            residuals.append(self.observed.site.up_rate - np.einsum('mi,mi->m', seen, up))
            spread = np.einsum('mi,mij,mj->m', up, noise, up)
            jacobians.append(np.einsum('mi,mip->mp', up, jacobian))
            if self.leaning is not None:
                spread += np.einsum('mi,mij,mj->m', seen, self.leaning.noise, seen)
                prior = np.einsum('mi,mic->mc', seen, self.leaning.columns)
                prior = np.vstack([np.zeros_like(prior), prior])
            sigmas.append(np.hypot(np.sqrt(spread), bent))
        count = sum(len(r) for r in residuals)
        return Rows(
            np.concatenate(residuals),
            np.zeros(count),
            np.concatenate(sigmas),
            np.vstack(jacobians),
            np.zeros((count, 0)),
            prior,
            np.zeros(count, dtype=bool),
        )

    def fit(self, sensors: Sensors, factor: Floats, *, mount_free: bool = False) -> Fit:
        """Explain the session by a model whose parameters have errors.

        Args:
            sensors: The model.
            factor: (p, k) of the covariance of its parameters: factor times its transpose.
            mount_free: Whether the unit may sit otherwise in its mount, by a small rotation.

        """
        delta = np.zeros(len(self.parameters))
        mounted = np.zeros(3)
        world = self.world
        at_once = not self.gyros or self.observed.north_known or not self.observed.with_attitudes
        before, step = np.inf, factor
        # Lengths are no straight lines: the noise is taken for what a step leaves to second order,
        # until the steps are small.
        approach = 0 if self.observed.with_attitudes else _PASSES
        for attempt in range(approach + _PASSES):
            now = sensors.moved(delta)
            level_known = at_once or attempt > 0
            bent = step if attempt < approach else np.zeros_like(step)
            rows = self.rows(now, world, bent, level_known=level_known)
            extra = rows.free
            if mount_free:
                extra = np.hstack([extra, self._mount_columns(now, world, len(rows.residual))])
            solved = _Solved.of(rows, factor, extra, rows.residual + rows.jacobian @ delta)
            step = (factor @ solved.scaled - delta)[:, None]
            delta = factor @ solved.scaled
            count = rows.free.shape[1]
            world = self._step(world, solved.free[:count], level_known=level_known)
            if mount_free:
                mounted = mounted + solved.free[count:]
                world = World(world.vector, _turned(mounted))
            # What is hopeless need not converge: it is told from what explains the session.
            if attempt > approach and abs(before - solved.square) < _CONVERGED * (
                1 + solved.square
            ):
                break
            before = solved.square
        rests = solved.ratio(~rows.turns)
        turns = solved.ratio(rows.turns)
        spare = float((1 - solved.leverage[~rows.turns]).sum())
        freedom = len(rows.residual) - solved.rank_free
        std = np.sqrt(np.maximum(np.diag(factor @ solved.covariance @ factor.T), 0.0))
        return Fit(solved.square, freedom, delta, std, world, (rests, turns), spare, mounted)

    def _step(self, world: World, change: Floats, *, level_known: bool) -> World:
        if not len(change):
            return world
        vector = world.vector.copy()
        if len(change) == 1:
            turned = rotation(np.array([0.0, 0.0, 1.0]), float(change[0]))
            return World(turned @ vector, world.mount)
        vector[:2] += change * self.magnitude
        if not level_known:
            level = float(np.hypot(vector[0], vector[1]))
            vector[:2] *= self.observed.site.north_rate / max(level, SMALLEST_VARIANCE)
        else:
            left = self.magnitude**2 - float(vector[:2] @ vector[:2])
            vector[2] = np.sqrt(max(left, 0.0))
        return World(vector, world.mount)

    def _mount_columns(self, sensors: Sensors, world: World, count: int) -> Floats:
        seen = self.observed
        if not seen.with_attitudes:
            return np.zeros((count, 0))
        to_body = np.array([r.attitude.T for r in seen.rests if r.attitude is not None])
        inputs = world.mount @ to_body.reshape(-1, 3, 3) @ world.vector
        if self.gyros and seen.turns:
            rates = [t.up * (t.rate + seen.site.up_rate) for t in seen.turns]
            inputs = np.vstack([inputs, np.array(rates) @ world.mount.T])
        return (sensors.triad.response @ _cross(inputs)).reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class _Solved:
    """Least squares of whitened equations, the prior as rows of its own."""

    square: float
    scaled: Floats
    free: Floats
    covariance: Floats
    rank_free: int
    left: Floats
    leverage: Floats

    @classmethod
    def of(cls, rows: Rows, factor: Floats, free: Floats, target: Floats) -> _Solved:
        known = np.hstack([rows.jacobian @ factor, rows.prior]) / rows.sigma[:, None]
        free = free / rows.sigma[:, None]
        size = np.linalg.norm(free, axis=0) if free.shape[1] else np.zeros(0)
        size = np.where(size > 0, size, 1.0)
        top = np.hstack([known, free / size])
        below = np.eye(known.shape[1], top.shape[1])
        wanted = np.concatenate([target / rows.sigma, np.zeros(len(below))])
        u, s, vt = np.linalg.svd(np.vstack([top, below]), full_matrices=False)
        good = s > s.max(initial=0.0) * 1e-13
        inverse = (vt[good].T / s[good]) @ u[:, good].T
        solution = inverse @ wanted
        left = wanted - np.vstack([top, below]) @ solution
        covariance = (vt[good].T / s[good] ** 2) @ vt[good]
        k = factor.shape[1]
        return cls(
            float(left @ left),
            solution[:k],
            solution[known.shape[1] :] / size,
            covariance[:k, :k],
            int(np.linalg.matrix_rank(free / size)) if free.shape[1] else 0,
            left[: len(target)],
            np.einsum('ij,ij->i', u[: len(target), good], u[: len(target), good]),
        )

    def ratio(self, mine: NDArray[np.bool_]) -> float:
        """Return squared residuals over their expectation; 1 where too few are left to tell."""
        expected = float((1 - self.leverage[mine]).sum())
        return float(self.left[mine] @ self.left[mine]) / expected if expected > 2 else 1.0


def _arrivals(ups: Floats, inputs: Floats, response: Floats) -> Floats:
    """Return the columns of one small rotation for all that has the same axis up, (m, 3, c)."""
    groups: list[Floats] = []
    number = np.zeros(len(ups), dtype=int)
    for k, up in enumerate(ups):
        alike = [g for g, other in enumerate(groups) if other @ up > _SAME_UP]
        number[k] = alike[0] if alike else len(groups)
        if not alike:
            groups.append(up)
    columns = np.zeros((len(ups), 3, 3 * len(groups)))
    rotated = response @ _cross(inputs)
    for k, group in enumerate(number):
        columns[k, :, 3 * group : 3 * group + 3] = rotated[k]
    return columns


def _cross(vectors: Floats) -> Floats:
    """Return what (m, 3) vectors change by with a small rotation, (m, 3, 3)."""
    x, y, z = vectors.T
    o = np.zeros_like(x)
    return np.moveaxis(np.array([[o, z, -y], [-z, o, x], [y, -x, o]]), 2, 0)


def _turned(small: Floats) -> Floats:
    angle = float(np.linalg.norm(small))
    return rotation(small / angle, angle) if angle > 0 else np.eye(3)
