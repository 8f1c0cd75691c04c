"""Outputs of a session predicted from a state, and their derivatives.

One state vector holds the parameters of the sensors, then the nuisance parameters (`Nuisance`), the
lever arms of turns and the coefficients by which parameters change.

Sources: Cao 2022, eqs. (1)-(2), and Luo 2018, section 6.2, for the outputs of the channels;
docs/mathematics.md, 'Joint estimate', for the contents of the state.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property, wraps
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from ..common.rotations import GENERATORS, rotation
from ..common.stream import Floats
from ..model.earth import Site
from ..model.parameters import PARAMETERS, Parameter
from ..model.sensors import SensorModel
from ..model.session_terms import Change
from .arms import mean_over_turn
from .evidence import Evidence
from .modulation import columns, rates
from .outputs import OutputLayout

# The table stands turned by the azimuth about up and tilted by two small angles, R_nb = Rz(azimuth)
# Rx(tilt) Ry(tilt) A with A by the encoders, so that the Earth's rate and gravity are constant
# vectors in the frame of A.
# Source: docs/mathematics.md, 'Joint estimate'.

_X, _Y, _Z = np.eye(3)  #: Unit vectors of the axes.


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Earth rate and gravity in the frame of the attitudes; derivatives by azimuth and tilts."""

    rate: Floats  #: (3,) rad/s.
    force: Floats  #: (3,) m/s^2.
    rate_by_latitude: Floats  #: (3,) d rate by the latitude of the site, 1/s.
    rate_slopes: Floats  #: (3, 3) d rate, one column for each of azimuth and tilts.
    force_slopes: Floats  #: (3, 3) d force.
    level: Floats  #: (3, 3) transforms vectors of that frame to level, at the frame's own heading.

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

    @classmethod
    def vertical(cls, site: Site) -> Surroundings:
        """Return the vertical part of a site's vectors, which no azimuth or tilt turns."""
        none = np.zeros((3, 3))
        return cls(
            site.earth_rate * _Z,
            site.specific_force,
            site.earth_rate_by_latitude * _Z,
            none,
            none,
            np.eye(3),
        )


class Nuisance(IntEnum):
    """Entries of the state after the sensors and before the arms, in this order."""

    AZIMUTH = 0
    TILT_X = 1
    TILT_Y = 2
    CLOCK = 3


_Inputs = tuple[Surroundings, Floats, Floats, Floats, Floats]
Value = TypeVar('Value')


def cached_by_state(method: Callable[[Any, Floats], Value]) -> Callable[[Any, Floats], Value]:
    """Cache results at each state (n,) that do not depend on the weights."""

    @wraps(method)
    def remembered(session: Any, state: Floats) -> Value:
        found: Value = session.remembered(method.__name__, state, method)
        return found

    return remembered


@dataclass(frozen=True, eq=False)
class SessionModel:
    """Predicts the outputs of a session.

    The order of its outputs is that of `layout`. Methods named `..._derivatives` return derivatives
    of `predict`, and those named `..._effects` what errors of a given size change in it.
    """

    evidence: Evidence  #: The session, in the time of its table (`in_table_time`).
    #: Of the sensors, in the order of the state, at its beginning.
    parameters: tuple[Parameter, ...] = PARAMETERS
    #: Coefficients by which parameters change during the session: the end of the state.
    changes: tuple[Change, ...] = ()
    #: Time constant of a warm-up or instant of a step, as a fraction of the session.
    shape: float = 1.0

    @property
    def sensors(self) -> int:
        """Number of parameters of the sensors."""
        return len(self.parameters)

    @property
    def layout(self) -> OutputLayout:
        """Indices of the outputs of dwells, turns and moves."""
        return self.evidence.layout

    @property
    def size(self) -> int:
        """Length of the state."""
        return self.sensors + self.nuisances + len(self.changes)

    @property
    def nuisances(self) -> int:
        """Number of entries of the state with priors: `Nuisance`, then the lever arms of turns."""
        return len(Nuisance) + len(self.evidence.arms)

    @property
    def nuisance_slice(self) -> slice:
        """Slice of the nuisances in the state."""
        return slice(self.sensors, self.sensors + self.nuisances)

    @property
    def arm_slice(self) -> slice:
        """Slice of the lever arms of turns in the state."""
        return slice(self.sensors + len(Nuisance), self.sensors + self.nuisances)

    @property
    def clock_index(self) -> int:
        """Index of the rate between the clocks in the state."""
        return self.sensors + Nuisance.CLOCK

    @property
    def change_slice(self) -> slice:
        """Slice of the coefficients of the session's terms in the state."""
        start = self.sensors + self.nuisances
        return slice(start, start + len(self.changes))

    @cached_property
    def outputs(self) -> Floats:
        """Measured outputs, (m,) rad/s, m/s^2, rad and m/s: zero for the misclosures of moves."""
        turned = np.array([t.statistics.mean for t in self.evidence.turns]).reshape(-1, 6)
        moved = np.zeros((len(self.evidence.used_moves), 6))
        return self.layout.joined(self.evidence.outputs(), turned, moved)

    def nominal(self) -> Floats:
        """Return the state (n,) of ideal sensors on the table as it is described."""
        return np.zeros(self.sensors + self.nuisances + len(self.changes))

    @cached_by_state
    def model(self, state: Floats) -> SensorModel:
        """Return the sensors of a state (n,), in the mean over the session."""
        return SensorModel().with_values(self.parameters, state[: self.sensors])

    @cached_by_state
    def surroundings(self, state: Floats) -> Surroundings:
        """Return Earth rate and gravity in the frame of the attitudes, by a state (n,).

        A given azimuth is already in the attitudes: the state holds its correction. Holds by hand
        have each a heading and a tilt, none in common: both are scatter.
        """
        if self.evidence.plan.by_hand:
            return Surroundings.vertical(self.evidence.site)
        azimuth, tilt_x, tilt_y = state[self.sensors : self.clock_index]
        return Surroundings.at(self.evidence.site, azimuth, tilt_x, tilt_y)

    def earth(self, state: Floats) -> Floats:
        """Return the Earth rate in the frame of each dwell's attitude, (s, 3) rad/s."""
        return np.tile(self.surroundings(state).rate, (len(self.evidence.segments), 1))

    def remembered(
        self,
        what: Hashable,
        state: Floats,
        worked_out: Callable[[Any, Floats], Value],
        *held: object,
    ) -> Value:
        """Return the cached result for a state (n,) and the same objects, or compute it."""
        key = (what, state.tobytes(), self.shape)
        held = (self.parameters, self.changes, *held)
        # Most requests are for the last state.
        for known, objects, value in reversed(self.evidence.state_cache):
            if known == key and all(a is b for a, b in zip(objects, held, strict=True)):
                return cast(Value, value)
        found = worked_out(self, state)
        self.evidence.state_cache.append((key, held, found))
        return found

    @cached_by_state
    def _inputs(self, state: Floats) -> _Inputs:
        """Return the surroundings, rates and forces at rest (s, 3), those of the turns (t, 8, 3).

        Turns are evaluated at eight headings: the mean of linear responses is the part along the
        axis.
        """
        around, earth = self.surroundings(state), self.earth(state)
        ups, rates, _ = self.evidence.turn_inputs
        attitudes, headings = self.evidence.dwell_attitudes, self.evidence.headings
        turning_force = headings @ around.force
        turning_force[self.evidence.arms.turns] += self._pulled(state)[:, None]
        return (
            around,
            np.einsum('si,sij->sj', earth, attitudes),
            around.force @ attitudes,
            headings @ around.rate + (ups * rates[:, None])[:, None],
            turning_force,
        )

    def _pulled(self, state: Floats) -> Floats:
        """Return the specific force by lever arms in turns, (f, 3) m/s^2, body axes."""
        return np.asarray(self.evidence.arms.slopes @ state[self.arm_slice])

    def predict(self, state: Floats) -> Floats:
        """Return the outputs predicted from a state, (m,)."""
        predicted = self._predicted(state)
        if not state[self.change_slice].any():
            return predicted
        return np.asarray(
            predicted + self.jacobian(state)[:, self.change_slice] @ state[self.change_slice]
        )

    @cached_by_state
    def _predicted(self, state: Floats) -> Floats:
        """Return the outputs predicted from the session's mean parameters, (m,)."""
        around, model = self.surroundings(state), self.model(state)
        at_rest, turned = self.predicted_by_segment(state)
        in_moves = self.evidence.used_moves.misclosures(model, self.earth(state), around.force)
        if state[self.clock_index]:
            in_moves = in_moves + self._clock_derivatives(state) * state[self.clock_index]
        predicted = self.layout.joined(at_rest, turned, in_moves)
        predicted[self._divided] /= 1 + state[self.clock_index]
        return predicted

    def predicted_by_segment(self, state: Floats) -> tuple[Floats, Floats]:
        """Return the predicted outputs of dwells (s, 6) and turns (t, 6) by the table's clock."""
        _, rate, force, turning, turning_force = self._inputs(state)
        model = self.model(state)
        at_rest = np.hstack(model.predict(rate, force))
        return at_rest, mean_over_turn(
            np.concatenate(model.predict(turning, turning_force), axis=-1)
        )

    @cached_by_state
    def jacobian(self, state: Floats) -> Floats:
        """Return the derivatives of `predict`, (m, n).

        Those by the table are taken at the mean parameters, whose changes are parts in 1e5.
        """
        return self._derivatives(state)

    def _derivatives(self, state: Floats) -> Floats:
        """Return the derivatives of `predict` by the whole state, (m, n)."""
        around, _, _, turning, turning_force = self._inputs(state)
        model, n = self.model(state), self.sensors
        at_rest, turned, in_moves = (
            np.zeros((count, 6, self.size))
            for count in (self.layout.dwells, self.layout.turns, self.layout.moves)
        )
        arms, by_force = self.evidence.arms, model.slopes(turning, turning_force)[..., 3:]
        turned[arms.turns, :, self.arm_slice] = mean_over_turn(by_force)[arms.turns] @ arms.slopes
        in_moves[:, :, self.clock_index] = self._clock_derivatives(state)
        result = self.layout.joined(at_rest, turned, in_moves)
        faster, divided = 1 + state[self.clock_index], self._divided
        result[divided] /= faster
        world = np.vstack([around.rate_slopes, around.force_slopes])
        result[:, n : n + 3] = self.world_derivatives(state) @ world
        result[:, :n] = self.parameter_derivatives(state, self.parameters)
        answered = self.layout.joined(
            *self.predicted_by_segment(state), np.zeros_like(in_moves[:, :, 0])
        )
        result[divided, self.clock_index] = -answered[divided] / faster**2
        result[:, self.change_slice] = self.columns(self.changes, result)
        return result

    def parameter_derivatives(self, state: Floats, parameters: tuple[Parameter, ...]) -> Floats:
        """Return the derivatives (m, p) of `predict` by parameters, in the state or not."""
        _, rate, force, turning, turning_force = self._inputs(state)
        model = self.model(state)
        at_rest = model.derivatives(rate, force, parameters)
        turned = mean_over_turn(model.derivatives(turning, turning_force, parameters))
        in_moves = self.evidence.used_moves.parameter_derivatives(model, parameters)
        result = self.layout.joined(at_rest, turned, in_moves)
        result[self._divided] /= 1 + state[self.clock_index]
        return result

    @cached_property
    def _divided(self) -> NDArray[np.intp]:
        """Which outputs are counts over seconds of the stamping clock.

        Where motions do not compare the clocks these seconds are used unchanged, but for turns,
        which are timed by the table's clock.
        """
        if not self.evidence.units.per_interval:
            return np.zeros(0, dtype=np.intp)
        if self.evidence.clocks_compared:
            return np.setdiff1d(np.arange(len(self.layout)), self.layout.moving)
        return self.layout.turn[self.evidence.turn_inputs[2]].ravel()

    @cached_by_state
    def _clock_derivatives(self, state: Floats) -> Floats:
        """Return the derivatives of the moves by the rate between the clocks, (m, 6)."""
        counted = self.evidence.units.per_interval
        if counted and not self.evidence.clocks_compared:
            return np.zeros((len(self.evidence.used_moves), 6))
        force = self.surroundings(state).force
        return self.evidence.used_moves.clock_derivatives(self.model(state), force, counted=counted)

    def columns(self, changes: Sequence[Change], derivatives: Floats) -> Floats:
        """Return the derivatives by coefficients of a session's terms, on or off, (m, k).

        `derivatives` (m, n) are those by the parameters of the sensors, as `jacobian` begins.
        """
        return columns(self.evidence, changes, derivatives, self.parameters, self.shape)

    def slopes(self, state: Floats) -> Floats:
        """Return the slopes of outputs within their segment, (m,) per s, by changing parameters."""
        jacobian, known = self.jacobian(state), (self.parameters, self.shape)
        found = columns(self.evidence, self.changes, jacobian, *known, rates)
        return np.asarray(found @ state[self.change_slice])

    @cached_by_state
    def world_derivatives(self, state: Floats) -> Floats:
        """Return the derivatives (m, 6) by Earth rate and gravity in the frame of the attitudes."""
        _, rate, force, turning, turning_force = self._inputs(state)
        model = self.model(state)
        to_body = np.transpose(self.evidence.dwell_attitudes, (0, 2, 1))
        at_rest = model.slopes(rate, force) @ _for_rates_and_forces(to_body)
        turned = mean_over_turn(
            model.slopes(turning, turning_force) @ _for_rates_and_forces(self.evidence.headings)
        )
        in_moves = self.evidence.used_moves.world_derivatives()
        result = self.layout.joined(at_rest, turned, in_moves)
        result[self._divided] /= 1 + state[self.clock_index]
        return result

    def mount_derivatives(self, state: Floats) -> Floats:
        """Return the derivatives (m, 3) by rotations of the unit about its body axes, per rad."""
        every = len(self.evidence.segments), len(self.evidence.turns)
        # Attitudes lean opposite to the rotation of the unit.
        at_rest, turned = (np.broadcast_to(-np.eye(3), (count, 3, 3)) for count in every)
        return self.attitude_error_effects(state, at_rest, turned)

    @cached_by_state
    def table_error_effects(self, state: Floats) -> Floats:
        """Return the effect of the table's stated errors on the outputs, (m, e): one deviation."""
        return self.attitude_error_effects(state, *self.evidence.table_attitude_errors)

    def attitude_error_effects(self, state: Floats, at_rest: Floats, turned: Floats) -> Floats:
        """Return the effect of e errors of attitudes on the outputs, (m, e).

        The errors are rotations about the body axes, rad: (s, 3, e) of dwells, (t, 3, e) of turns.
        """
        s, by_each = len(at_rest), self._rotation_derivatives(state)
        in_moves = self.evidence.used_moves.attitude_error_effects(self.model(state), at_rest)
        return self.layout.joined(by_each[:s] @ at_rest, by_each[s:] @ turned, in_moves)

    def encoder_rate_effects(self, state: Floats) -> Floats:
        """Return the effect of one deviation of the encoder's rate in each turn, (m, t)."""
        walk = self.evidence.walk
        return self._rate_error_effects(
            state, np.array([t.rate_std(walk) for t in self.evidence.turns])
        )

    def rest_to_rest_effects(self, state: Floats) -> Floats:
        """Return the effect of positioning errors on rates by whole motions, (m, w) per rad.

        Either end of a motion has an error, and the next may begin with the error of this one's
        end.
        """
        relative, some = self.evidence.rest_to_rest_rates
        return self._rate_error_effects(state, relative)[:, some]

    def _rate_error_effects(self, state: Floats, relative: Floats) -> Floats:
        """Return the effect of relative errors (t,) of the table's rate on the outputs, (m, t)."""
        ups, rates, _ = self.evidence.turn_inputs
        turns, both = np.arange(len(rates))[:, None], self.evidence.arms.turns
        result = np.zeros((len(self.layout), len(rates)))
        seen = (relative * rates)[:, None] * (ups @ self.model(state).gyro.response.T)
        result[self.layout.turn, turns] = seen
        # The specific force by lever arms grows with the square of the rate.
        pulled = 2 * relative[both][:, None] * self._pulled(state)
        result[self.layout.turn_accels, turns[both]] = pulled
        return result

    def latitude_derivatives(self, state: Floats) -> Floats:
        """Return the derivatives of `predict` by the latitude, (m,) per rad."""
        by_rate = self.world_derivatives(state)[:, :3]
        return np.asarray(by_rate @ self.surroundings(state).rate_by_latitude)

    @cached_by_state
    def positioning_error_effects(self, state: Floats) -> tuple[Floats, Floats]:
        """Return the effect of positioning errors on the outputs: (m, errors), per rad.

        Those of joints, then those of each stop.
        """
        both = self.evidence.positioning_attitude_errors
        at_rest, turning = (
            np.concatenate(parts, axis=2)
            for parts in zip(*((one.at_rest, one.turning) for one in both), strict=True)
        )
        effects = self.attitude_error_effects(state, at_rest, turning)
        joints, stops = np.split(effects, [both[0].at_rest.shape[2]], axis=1)
        return np.hstack([joints, self.rest_to_rest_effects(state)]), stops

    @cached_by_state
    def _rotation_derivatives(self, state: Floats) -> Floats:
        """Return the derivatives by rotations about the body axes, (s + t, 6, 3); without moves."""
        _, rate, force, turning, turning_force = self._inputs(state)
        seen = [
            np.vstack([at_rest, mean_over_turn(turned)])
            for at_rest, turned in ((rate, turning), (force, turning_force))
        ]
        # The input crossed with a rotation of the axes.
        crossed = [np.tensordot(one, GENERATORS, axes=1) for one in seen]
        slopes = self.model(state).slopes(*seen)
        return np.asarray(slopes @ np.concatenate(crossed, axis=1))


def _for_rates_and_forces(rotations: Floats) -> Floats:
    """Return rotations (..., 3, 3) of rates and forces alike: (..., 6, 6)."""
    result = np.zeros((*rotations.shape[:-2], 6, 6))
    result[..., :3, :3] = result[..., 3:, 3:] = rotations
    return result
