"""A session as equations: what every static dwell and turn should read, its derivatives, its noise.

One state vector holds the parameters of the sensors and, after them, what the session does not
care for but must allow for (`Nuisance`). The table stands turned by the azimuth about up and
tilted by two small angles, R_nb = Rz(azimuth) Rx(tilt) Ry(tilt) A with A by the encoders, so that
the Earth's rate and gravity are constant vectors in the frame of A.

Sources: Cao 2022, eqs. (1)-(2), and Luo 2018, section 6.2, for what the channels answer;
docs/mathematics.md, 'Joint estimate', for what goes into the state.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from functools import cached_property
from typing import TypeVar, cast

import numpy as np
import scipy
from numpy.typing import NDArray

from ..budget import Share, Source
from ..directions import cross
from ..earth import Site
from ..model import PARAMETERS, Parameter, ParameterKind, SensorModel
from ..model.session_terms import Change
from ..rotations import GENERATORS, rotation
from ..stream import Floats, Units
from ..units import ARCMIN, DEG
from .components import Component, Diagonal, Factor, shares
from .evidence import SMALLEST_VARIANCE, Evidence
from .headings import mean_over_turn
from .layout import OutputLayout
from .modulation import columns, slopes, stated_changes
from .output_noise import (
    encoder_rate_errors,
    encoder_rates,
    level_gravity,
    own_parts,
    unknown_north,
)
from .positioning_errors import NO_POSITIONING_ERRORS, PositioningErrors


class Nuisance(IntEnum):
    """What the state holds besides the sensors, in this order after them, and before the arms."""

    AZIMUTH = 0
    TILT_X = 1
    TILT_Y = 2
    CLOCK = 3


ANY_AZIMUTH = 180 * DEG / np.sqrt(3)
"""Standard deviation of a heading that may be any."""

_FEW = 32
"""Outputs of five rests, which determine nothing: numpy solves for so few in 0.1 ms, and loading
scipy takes longer than all else that is done with such a session."""

GIVEN_AZIMUTH = 1 * ARCMIN
"""How well a table's azimuth is known where its configuration states it."""


_X, _Y, _Z = np.eye(3)
"""Unit vectors of the axes."""


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Earth rate and gravity in the frame of the attitudes, with derivatives by azimuth and tilts.

    Attributes:
        rate: (3,) rad/s.
        force: (3,) m/s^2.
        rate_by_latitude: (3,) d rate by the latitude of the site, 1/s.
        rate_slopes: (3, 3) d rate, one column for each of azimuth and tilts.
        force_slopes: (3, 3) d force.
        level: (3, 3) takes vectors of that frame to level, as far as the heading of its own.

    """

    rate: Floats
    force: Floats
    rate_by_latitude: Floats
    rate_slopes: Floats
    force_slopes: Floats
    level: Floats

    @classmethod
    def at(cls, site: Site, azimuth: float, tilt_x: float, tilt_y: float) -> Surroundings:
        """Turn a site's vectors into the frame of a table that is turned and tilted, rad."""
        gx, gy, gz = GENERATORS
        about_x, about_y = rotation(_X, -tilt_x), rotation(_Y, -tilt_y)
        both = about_y @ about_x
        vectors, slopes = [], []
        for world in (site.earth_rate, site.specific_force):
            headed = rotation(_Z, -azimuth) @ world
            level = both @ headed
            vectors.append(level)
            by_azimuth = both @ (-gz @ headed)
            by_x = about_y @ (-gx @ (about_x @ headed))
            slopes.append(np.column_stack([by_azimuth, by_x, -gy @ level]))
        by_latitude = both @ rotation(_Z, -azimuth) @ site.earth_rate_by_latitude
        return cls(vectors[0], vectors[1], by_latitude, slopes[0], slopes[1], both.T)


_Inputs = tuple[Surroundings, Floats, Floats, Floats, Floats]
Value = TypeVar('Value')


@dataclass(frozen=True, eq=False)
class Equations:
    """The equations of a session.

    Their order is that of `layout`.

    Attributes:
        evidence: The session, in the time of its table (`timebase`).
        parameters: Of the sensors, in the order of the state, which they begin.
        levelled: Standard deviation of the table's tilt about either axis, rad; None for what the
            table states.
        any_heading: Whether the azimuth may be any, though the table's configuration states one.
        positioning: What positioning errors scatter by beyond what the table states.
        extra: Further parts of the covariance of the outputs.
        inflation: (m,) factors on the variance of each output's own noise, or None.
        changes: Coefficients by which parameters change during the session: the end of the state.
        time_constant: Of a warm-up among them, as a fraction of the session.
        doubts: Parameters that are not in the state, and the standard deviation about zero of each.
        held: Kinds of parameters of motion that are zero for certain: what is in no state the
            covariance allows for otherwise.

    """

    evidence: Evidence
    parameters: tuple[Parameter, ...] = PARAMETERS
    levelled: float | None = None
    any_heading: bool = False
    positioning: PositioningErrors = NO_POSITIONING_ERRORS
    extra: tuple[Component, ...] = field(default=(), repr=False)
    inflation: Floats | None = field(default=None, repr=False)
    changes: tuple[Change, ...] = ()
    time_constant: float = 1.0
    doubts: tuple[tuple[Parameter, float], ...] = ()
    held: frozenset[ParameterKind] = frozenset()

    @property
    def sensors(self) -> int:
        """Number of parameters of the sensors."""
        return len(self.parameters)

    @property
    def layout(self) -> OutputLayout:
        """Where the outputs of rests, turns and moves lie."""
        return self.evidence.layout

    @property
    def size(self) -> int:
        """Length of the state."""
        return self.sensors + self.nuisances + len(self.changes)

    @property
    def nuisances(self) -> int:
        """How many entries of the state have priors: `Nuisance`, then the lever arms of turns."""
        return len(Nuisance) + len(self.evidence.arms)

    @property
    def table(self) -> slice:
        """Where the nuisances lie in the state."""
        return slice(self.sensors, self.sensors + self.nuisances)

    @property
    def arms(self) -> slice:
        """Where the lever arms of turns lie in the state."""
        return slice(self.sensors + len(Nuisance), self.sensors + self.nuisances)

    @property
    def clock(self) -> int:
        """Where the rate between the clocks lies in the state."""
        return self.sensors + Nuisance.CLOCK

    @property
    def changing(self) -> slice:
        """Where the coefficients of the session's terms lie in the state."""
        start = self.sensors + self.nuisances
        return slice(start, start + len(self.changes))

    @property
    def north_known(self) -> bool:
        """Whether the attitudes are against north."""
        return self.evidence.azimuth is not None and not self.any_heading

    @cached_property
    def outputs(self) -> Floats:
        """What was read, (m,) rad/s, m/s^2, rad and m/s: moves read no difference."""
        turned = np.array([t.statistics.mean for t in self.evidence.turns]).reshape(-1, 6)
        moved = np.zeros((len(self.evidence.links), 6))
        return self.layout.joined(self.evidence.outputs(), turned, moved)

    @cached_property
    def prior(self) -> tuple[Floats, Floats]:
        """What is known of the nuisances beforehand: means and standard deviations, (k,) each."""
        evidence = self.evidence
        azimuth = GIVEN_AZIMUTH if self.north_known else ANY_AZIMUTH
        clock_std = evidence.clock_rate()[1]
        # A clock that has no say still needs a width above zero to be whitened by.
        level = evidence.levelling if self.levelled is None else self.levelled
        deviations = [azimuth, level, level, max(clock_std, 1e-15), *evidence.arms.deviations]
        return np.zeros(self.nuisances), np.array(deviations)

    def prior_rows(self, state: Floats) -> Floats:
        """Return the priors as equations: (k, n + 1), derivatives and what is left.

        A heading that may be any is pulled nowhere; its width stands for what is not known of it.
        """
        mean, deviation = self.prior
        rows = np.zeros((self.nuisances, self.size + 1))
        rows[:, self.table] = np.diag(1 / deviation)
        rows[:, -1] = (mean - state[self.table]) / deviation
        if not self.north_known:
            rows[Nuisance.AZIMUTH, -1] = 0.0
        return rows

    def nominal(self) -> Floats:
        """Return the state (n,) of ideal sensors on the table as it is described."""
        return np.concatenate([np.zeros(self.sensors), self.prior[0], np.zeros(len(self.changes))])

    def model(self, state: Floats) -> SensorModel:
        """Return the sensors that a state (n,) describes, in the mean over the session."""
        return self._once('sensors', state, self._model)

    def _model(self, state: Floats) -> SensorModel:
        return SensorModel().with_values(self.parameters, state[: self.sensors])

    def surroundings(self, state: Floats) -> Surroundings:
        """Return Earth rate and gravity in the frame of the attitudes, by a state (n,).

        An azimuth that is given is already in the attitudes: the state holds what is left of it.
        """
        return self._once('surroundings', state, self._surroundings)

    def _surroundings(self, state: Floats) -> Surroundings:
        azimuth, tilt_x, tilt_y = state[self.sensors : self.clock]
        return Surroundings.at(self.evidence.site, azimuth, tilt_x, tilt_y)

    def earth(self, state: Floats) -> Floats:
        """Return the Earth rate in the frame of each rest's attitude, (s, 3) rad/s."""
        return np.tile(self.surroundings(state).rate, (len(self.evidence.segments), 1))

    @property
    def _attitudes(self) -> Floats:
        return self.evidence.rest_attitudes

    @property
    def _turning(self) -> tuple[Floats, Floats, NDArray[np.bool_]]:
        """Up in body axes (t, 3), rate by the table's own clock (t,), whether that clock counts."""
        return self.evidence.turn_inputs

    @property
    def _headings(self) -> Floats:
        return self.evidence.headings

    def _once(self, what: str, state: Floats, worked_out: Callable[[Floats], Value]) -> Value:
        """Return what is the same whatever the weights: it is worked out once at each state."""
        key = (what, state.tobytes(), self.time_constant)
        for known, parameters, changes, value in self.evidence.state_cache:
            if known == key and parameters is self.parameters and changes is self.changes:
                return cast(Value, value)
        found = worked_out(state)
        self.evidence.state_cache.append((key, self.parameters, self.changes, found))
        return found

    def _inputs(self, state: Floats) -> _Inputs:
        """Return the surroundings, rates and forces at rest (s, 3), those of the turns (t, 8, 3).

        Turns are seen at eight headings: of what is linear the mean is the part along the axis.
        """
        return self._once('inputs', state, self._seen)

    def _seen(self, state: Floats) -> _Inputs:
        around, earth = self.surroundings(state), self.earth(state)
        ups, rates, _ = self._turning
        felt = self._headings @ around.force
        felt[self.evidence.arms.turns] += self._pulled(state)[:, None]
        return (
            around,
            np.einsum('si,sij->sj', earth, self._attitudes),
            around.force @ self._attitudes,
            self._headings @ around.rate + (ups * rates[:, None])[:, None],
            felt,
        )

    def _pulled(self, state: Floats) -> Floats:
        """Return the specific force that lever arms make in turns, (f, 3) m/s^2, body axes."""
        return np.asarray(self.evidence.arms.slopes @ state[self.arms])

    def predict(self, state: Floats) -> Floats:
        """Return what a state says that should be read, (m,)."""
        predicted = self._once('prediction', state, self._predicted)
        if not state[self.changing].any():
            return predicted
        return np.asarray(predicted + self.jacobian(state)[:, self.changing] @ state[self.changing])

    def _predicted(self, state: Floats) -> Floats:
        """Return what is read by the parameters of the session's mean, (m,)."""
        around, *inputs = self._inputs(state)
        model = self.model(state)
        at_rest, turned = self._answers(model, inputs)
        led = self.evidence.links.misclosures(model, self.earth(state), around.force)
        if state[self.clock]:
            led = led + self._led_by_clock(model, around) * state[self.clock]
        predicted = self.layout.joined(at_rest, turned, led)
        predicted[self._divided] /= 1 + state[self.clock]
        return predicted

    def _answers(self, model: SensorModel, inputs: Sequence[Floats]) -> tuple[Floats, Floats]:
        """Return what rests (s, 6) and turns (t, 6) read by the table's clock.

        Args:
            model: The sensors.
            inputs: As `_inputs` returns them: rates and forces at rest, then in turns.

        """
        rate, force, turning, felt = inputs
        at_rest = np.hstack(model.predict(rate, force))
        return at_rest, mean_over_turn(np.concatenate(model.predict(turning, felt), axis=-1))

    def jacobian(self, state: Floats) -> Floats:
        """Return the derivatives of `predict`, (m, n).

        By the table they are those of the mean parameters: what changes of these is parts in 1e5.
        """
        return self._once('derivatives', state, self._derivatives)

    def _derivatives(self, state: Floats) -> Floats:
        around, rate, force, turning, felt = self._inputs(state)
        model, n = self.model(state), self.sensors
        at_rest = np.zeros((len(rate), 6, self.size))
        turned = np.zeros((len(turning), 6, self.size))
        moves = self.evidence.links
        led = np.zeros((len(moves), 6, self.size))
        world = np.vstack([around.rate_slopes, around.force_slopes])
        at_rest[:, :, n : n + 3] = model.slopes(rate, force) @ _both(self._to_body) @ world
        slopes = model.slopes(turning, felt)
        turned[:, :, n : n + 3] = mean_over_turn(slopes @ _both(self._headings) @ world)
        arms = self.evidence.arms
        turned[arms.turns, :, self.arms] = mean_over_turn(slopes[..., 3:])[arms.turns] @ arms.slopes
        led[:, :, n : n + 3] = moves.by_rate() @ around.rate_slopes
        led[:, :, n : n + 3] += moves.by_force() @ around.force_slopes
        led[:, :, self.clock] = self._led_by_clock(model, around)
        result = self.layout.joined(at_rest, turned, led)
        faster, divided = 1 + state[self.clock], self._divided
        result[divided] /= faster
        result[:, :n] = self.by_parameters(state, self.parameters)
        answers = self._answers(model, (rate, force, turning, felt))
        answered = self.layout.joined(*answers, np.zeros_like(led[:, :, 0]))
        result[divided, self.clock] = -answered[divided] / faster**2
        result[:, self.changing] = self.columns(self.changes, result)
        return result

    def by_parameters(self, state: Floats, parameters: tuple[Parameter, ...]) -> Floats:
        """Return the derivatives of `predict` by p parameters, (m, p).

        Args:
            state: (n,) of sensors and table.
            parameters: Of the sensors, in the state or not.

        """
        _, rate, force, turning, felt = self._inputs(state)
        model = self.model(state)
        at_rest = model.derivatives(rate, force, parameters)
        turned = mean_over_turn(model.derivatives(turning, felt, parameters))
        led = self.evidence.links.by_parameters(model, parameters)
        result = self.layout.joined(at_rest, turned, led)
        result[self._divided] /= 1 + state[self.clock]
        return result

    @cached_property
    def _divided(self) -> NDArray[np.intp]:
        """Which outputs are counts over seconds of the stamping clock.

        Where no motions compare the clocks these seconds are taken as they are, but for turns: the
        table's own clock times those.
        """
        if self.evidence.units is not Units.PULSES:
            return np.zeros(0, dtype=np.intp)
        if self.evidence.clocks_compared:
            return np.setdiff1d(np.arange(len(self.layout)), self.layout.moving)
        return self.layout.turn[self._turning[2]].ravel()

    def _led_by_clock(self, model: SensorModel, around: Surroundings) -> Floats:
        """Return the derivatives of the moves by the rate between the clocks, (m, 6)."""
        counted = self.evidence.units is Units.PULSES
        if counted and not self.evidence.clocks_compared:
            return np.zeros((len(self.evidence.links), 6))
        return self.evidence.links.by_clock(model, around.force, counted=counted)

    def columns(self, changes: Sequence[Change], derivatives: Floats) -> Floats:
        """Return the derivatives by coefficients of a session's terms, on or off, (m, k).

        Args:
            changes: The k coefficients.
            derivatives: (m, n) by the parameters of the sensors, as `jacobian` begins.

        """
        return columns(self.evidence, changes, derivatives, self.parameters, self.time_constant)

    def slopes(self, state: Floats) -> Floats:
        """Return by how much outputs rise within their segment, (m,) per s: by what changes."""
        jacobian, changes, time = self.jacobian(state), self.changes, self.time_constant
        found = slopes(self.evidence, changes, jacobian, self.parameters, time)
        return np.asarray(found @ state[self.changing])

    @property
    def _to_body(self) -> Floats:
        return np.transpose(self._attitudes, (0, 2, 1))

    @cached_property
    def own(self) -> tuple[Component, ...]:
        """The parts of the covariance that each output has for itself, whatever the state."""
        if self.inflation is not None:
            return own_parts(self.evidence, self.inflation)
        # Most equations of a session differ in what comes on top of this.
        known = self.evidence.cache
        if 'own' not in known:
            known['own'] = own_parts(self.evidence, None)
        return cast(tuple[Component, ...], known['own'])

    @cached_property
    def own_variances(self) -> Floats:
        """Variances of the outputs by walk, quantisation and encoders, (m,)."""
        diagonals = [c.part.variances for c in self.own if isinstance(c.part, Diagonal)]
        own = np.asarray(np.sum(diagonals, axis=0)).reshape(len(self.outputs))
        # Parts that make up the smallest variance may round above it, and no noise is no scatter.
        least = own < SMALLEST_VARIANCE * (1 + 1e-9)
        return np.asarray(np.where(least, SMALLEST_VARIANCE, own))

    def shared(self, state: Floats) -> tuple[Component, ...]:
        """Return the parts of the covariance that outputs have in common.

        The outputs of one turn share the error of the encoder's rate, those of neighbours the
        positioning error of the table, and all the error of the latitude.
        """
        evidence, response = self.evidence, self.model(state).gyro.response
        turning, rates, _ = self._turning
        ups = np.vstack([self._attitudes[:, 2], turning])
        found = [
            *encoder_rates(evidence, rates, response, self._pulled(state)),
            unknown_north(evidence, ups, response),
            level_gravity(evidence, turning, float(self.prior[1][Nuisance.TILT_X])),
            *self.extra,
            *self._by_positioning(state),
        ]
        if self.doubts:
            parameters, deviations = zip(*self.doubts, strict=True)
            columns = self.by_parameters(state, parameters) * np.array(deviations)
            found.append(Component(Source.TERMS, Factor(columns)))
        if self.layout.moves_with_accels:
            found += self._levers(state)
        if (by_table := self.by_table(state)).shape[1]:
            found.append(Component(Source.TABLE, Factor(by_table)))
        if evidence.site.latitude_std:
            slope = self.latitude_slope(state) * evidence.site.latitude_std
            found.append(Component(Source.LATITUDE, Factor(slope[:, None])))
        if evidence.temperature is not None and evidence.thermal.any():
            found.append(self._warmth(self.jacobian(state)))
        return tuple(found)

    def _levers(self, state: Floats) -> list[Component]:
        """Return what lever arms and the accelerometers' delay do to the velocities of moves."""
        rate = self.surroundings(state).rate
        known = self.held | {p.kind for p in self.parameters}
        arms, delays = self.evidence.links.shared_velocity_errors(self.model(state), rate, known)
        return [
            Component(Source.ARM, Factor(self._of_moves(arms))),
            Component(Source.DELAY, Factor(self._of_moves(delays))),
        ]

    def _of_moves(self, led: Floats) -> Floats:
        """Return values (m, 6, ...) of moves in the order of the outputs, those of others zero."""
        at_rest, turned = (
            np.zeros((count, *led.shape[1:])) for count in (self.layout.rests, self.layout.turns)
        )
        return self.layout.joined(at_rest, turned, led)

    def _warmth(self, derivatives: Floats) -> Component:
        """Return what the temperature does by the coefficients that the data sheet states."""
        changes, sizes = stated_changes(self.parameters, self.evidence.thermal)
        return Component(Source.TEMPERATURE, Factor(self.columns(changes, derivatives) * sizes))

    def covariance(self, state: Floats) -> Floats:
        """Return the covariance of the outputs, (m,) square."""
        result = np.diag(self.own_variances)
        for component in self.shared(state):
            component.part.add_to(result)
        return result

    def shares(self, state: Floats, gain: Floats) -> dict[Source, Share]:
        """Return by source the covariance of parameters that are a `gain` times the outputs.

        Args:
            state: (n,) where they are.
            gain: (p, m).

        Source: docs/mathematics.md, 'Uncertainty budget'.
        """
        return shares((*self.own, *self.shared(state)), gain)

    @property
    def prior_sources(self) -> tuple[tuple[Source, list[int], float], ...]:
        """Whose priors the rows of `prior_rows` are, and degrees of freedom of their size."""
        return (
            (Source.AZIMUTH, [Nuisance.AZIMUTH], np.inf),
            (Source.TILT, [Nuisance.TILT_X, Nuisance.TILT_Y], np.inf),
            (Source.CLOCK, [Nuisance.CLOCK], self.evidence.clock_freedom),
            (Source.ARM, list(range(len(Nuisance), self.nuisances)), np.inf),
        )

    def by_rate(self, state: Floats) -> Floats:
        """Return the derivatives of `predict` by the Earth rate in the frame of the attitudes.

        Returns:
            (m, 3).

        """
        return self._once('by rate', state, self._by_rate)

    def _by_rate(self, state: Floats) -> Floats:
        _, rate, force, turning, felt = self._inputs(state)
        model = self.model(state)
        at_rest = model.slopes(rate, force)[..., :3] @ self._to_body
        turned = mean_over_turn(model.slopes(turning, felt)[..., :3] @ self._headings)
        return self.layout.joined(at_rest, turned, self.evidence.links.by_rate())

    def by_mount(self, state: Floats) -> Floats:
        """Return the derivatives of `predict` by rotations of the unit in its mount.

        Returns:
            (m, 3) per rad about the body axes.

        """
        every = len(self.evidence.segments), len(self.evidence.turns)
        # What the unit is turned by, attitudes lean the other way.
        at_rest, turned = (np.broadcast_to(-np.eye(3), (count, 3, 3)) for count in every)
        return self._leaning(state, at_rest, turned)

    def by_table(self, state: Floats) -> Floats:
        """Return what the errors that the table states do to the outputs, (m, e): one deviation."""
        at_rest, turning = self.evidence.leaning
        if not at_rest.shape[2]:
            return np.zeros((len(self.layout), 0))
        return self._leaning(state, at_rest, turning)

    def by_attitude_errors(self, state: Floats, at_rest: Floats, turned: Floats) -> Floats:
        """Return what e errors of attitudes do to the outputs, (m, e).

        Args:
            state: (n,) of sensors and table.
            at_rest: (s, 3, e) rotations of the static dwells about the body axes, rad.
            turned: (t, 3, e) of the turns.

        """
        return self._leaning(state, at_rest, turned)

    def by_encoder_rates(self, state: Floats) -> Floats:
        """Return what the error of the encoder's rate in each turn does, (m, t): one deviation."""
        evidence, response = self.evidence, self.model(state).gyro.response
        result = np.zeros((len(self.layout), len(evidence.turns)))
        rates, pulled = self._turning[1], self._pulled(state)
        for turns, rows, seen in encoder_rate_errors(evidence, rates, response, pulled):
            result[rows, turns[:, None]] = seen
        return result

    def latitude_slope(self, state: Floats) -> Floats:
        """Return the derivatives of `predict` by the latitude, (m,) per rad."""
        return np.asarray(self.by_rate(state) @ self.surroundings(state).rate_by_latitude)

    def clock_slope(self, state: Floats) -> Floats:
        """Return the derivatives of `predict` by the rate between the clocks."""
        return np.asarray(self.jacobian(state)[:, self.clock])

    def _by_positioning(self, state: Floats) -> list[Component]:
        stated, found = self.evidence.positioning, self.positioning
        parts = []
        if stated or found.joints:
            joints = self.by_positioning(state)[0]
            for source, size in (
                (Source.POSITIONING_STATED, stated),
                (Source.POSITIONING_FOUND, found.joints),
            ):
                if size:
                    parts.append(Component(source, Factor(joints * size)))
        if found.stops:
            parts.append(
                Component(Source.STOPS, Factor(self.by_positioning(state)[1] * found.stops))
            )
        return parts

    def by_positioning(self, state: Floats) -> tuple[Floats, Floats]:
        """Return how positioning errors enter the outputs: (m, errors), per rad.

        Those of joints that stop, and what each stop leans of its own.
        """
        return self._once('positioning', state, self._positioning_columns)

    def _positioning_columns(self, state: Floats) -> tuple[Floats, Floats]:
        joints, stops = (
            self._leaning(state, leaning.at_rest, leaning.turning)
            for leaning in self.evidence.positioning_leans
        )
        return joints, stops

    def _leaning(self, state: Floats, at_rest: Floats, turned: Floats) -> Floats:
        """Return what attitudes that lean do to the outputs, (m, e).

        Args:
            state: (n,) of sensors and table.
            at_rest: (s, 3, e) rotations of the static dwells about the body axes, rad.
            turned: (t, 3, e) of the turns.

        """
        _, rate, force, turning, felt = self._inputs(state)
        model, s = self.model(state), len(rate)
        rates, forces = (
            np.vstack([rate, mean_over_turn(turning)]),
            np.vstack([force, mean_over_turn(felt)]),
        )
        about = np.swapaxes(np.concatenate([at_rest, turned]), 1, 2)
        moved = [np.swapaxes(cross(v[:, None], about), 1, 2) for v in (rates, forces)]
        changed = model.slopes(rates, forces) @ np.concatenate(moved, axis=1)
        led = self.evidence.links.by_attitudes(model, at_rest)
        return self.layout.joined(changed[:s], changed[s:], led)

    def whitened(self, state: Floats) -> tuple[Floats, Floats]:
        """Return derivatives and residuals in standard deviations, the priors' rows last.

        Returns:
            (m + k, n) derivatives and (m + k,) outputs less prediction.

        """
        columns = self._weighed(state)[1]
        return columns[:, :-1], columns[:, -1]

    def factor(self, state: Floats) -> Floats:
        """Return the lower root of `covariance`, (m,) square, by which outputs are whitened."""
        return self._weighed(state)[0]

    def _weighed(self, state: Floats) -> tuple[Floats, Floats]:
        """Return the root of the covariance, and the columns that are whitened by it."""
        # A fit ends where what follows begins.
        key = state.tobytes()
        if key not in self._latest:
            self._latest.clear()
            factor = np.asarray(np.linalg.cholesky(self.covariance(state)), dtype=float)
            self._latest[key] = factor, self.whitened_by(factor, state)
        return self._latest[key]

    @cached_property
    def _latest(self) -> dict[bytes, tuple[Floats, Floats]]:
        return {}

    def whitened_by(self, factor: Floats, state: Floats) -> Floats:
        """Return derivatives and residuals, (m + k, n + 1), by a root (m, m) of a covariance."""
        columns = np.column_stack([self.jacobian(state), self.outputs - self.predict(state)])
        if len(columns):
            columns = _solved(factor, columns)
        columns = np.vstack([columns, self.prior_rows(state)])
        columns.flags.writeable = False
        return columns


def _solved(root: Floats, columns: Floats) -> Floats:
    """Solve for columns (m, n) by a lower root (m, m)."""
    if len(root) <= _FEW:
        return np.asarray(np.linalg.solve(root, columns))
    return np.asarray(scipy.linalg.solve_triangular(root, columns, lower=True, check_finite=False))


def _both(rotations: Floats) -> Floats:
    """Return rotations (..., 3, 3) of rates and forces alike: (..., 6, 6)."""
    result = np.zeros((*rotations.shape[:-2], 6, 6))
    result[..., :3, :3] = result[..., 3:, 3:] = rotations
    return result
