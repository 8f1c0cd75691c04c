"""What a session should read by a state, and its derivatives.

One state vector holds the parameters of the sensors and, after them, what the session does not
care for but must allow for (`Nuisance`), the lever arms of turns and the coefficients by which
parameters change.

Sources: Cao 2022, eqs. (1)-(2), and Luo 2018, section 6.2, for what the channels answer;
docs/mathematics.md, 'Joint estimate', for what goes into the state.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from ..model import PARAMETERS, Parameter, SensorModel
from ..model.session_terms import Change
from ..rotations import GENERATORS
from ..stream import Floats, Units
from .evidence import Evidence
from .headings import mean_over_turn
from .layout import OutputLayout
from .modulation import columns, slopes
from .output_noise import encoder_rate_errors
from .surroundings import Surroundings


class Nuisance(IntEnum):
    """What the state holds besides the sensors, in this order after them, and before the arms."""

    AZIMUTH = 0
    TILT_X = 1
    TILT_Y = 2
    CLOCK = 3


_Inputs = tuple[Surroundings, Floats, Floats, Floats, Floats]
Value = TypeVar('Value')


@dataclass(frozen=True, eq=False)
class SessionModel:
    """What a session should read.

    The order of its outputs is that of `layout`.

    Attributes:
        evidence: The session, in the time of its table (`timebase`).
        parameters: Of the sensors, in the order of the state, which they begin.
        changes: Coefficients by which parameters change during the session: the end of the state.
        time_constant: Of a warm-up among them, as a fraction of the session.

    """

    evidence: Evidence
    parameters: tuple[Parameter, ...] = PARAMETERS
    changes: tuple[Change, ...] = ()
    time_constant: float = 1.0

    @property
    def sensors(self) -> int:
        """Number of parameters of the sensors."""
        return len(self.parameters)

    @property
    def layout(self) -> OutputLayout:
        """Where the outputs of dwells, turns and moves lie."""
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

    @cached_property
    def outputs(self) -> Floats:
        """What was read, (m,) rad/s, m/s^2, rad and m/s: moves read no difference."""
        turned = np.array([t.statistics.mean for t in self.evidence.turns]).reshape(-1, 6)
        moved = np.zeros((len(self.evidence.links), 6))
        return self.layout.joined(self.evidence.outputs(), turned, moved)

    def nominal(self) -> Floats:
        """Return the state (n,) of ideal sensors on the table as it is described."""
        return np.zeros(self.sensors + self.nuisances + len(self.changes))

    def model(self, state: Floats) -> SensorModel:
        """Return the sensors that a state (n,) describes, in the mean over the session."""
        return self._once('sensors', state, self._model)

    def _model(self, state: Floats) -> SensorModel:
        return SensorModel().with_values(self.parameters, state[: self.sensors])

    def surroundings(self, state: Floats) -> Surroundings:
        """Return Earth rate and gravity in the frame of the attitudes, by a state (n,).

        An azimuth that is given is already in the attitudes: the state holds what is left of it.
        Holds by hand have a heading and a tilt each, and none in common: both are scatter.
        """
        return self._once('surroundings', state, self._surroundings)

    def _surroundings(self, state: Floats) -> Surroundings:
        if self.evidence.plan.by_hand:
            return Surroundings.vertical(self.evidence.site)
        azimuth, tilt_x, tilt_y = state[self.sensors : self.clock]
        return Surroundings.at(self.evidence.site, azimuth, tilt_x, tilt_y)

    def earth(self, state: Floats) -> Floats:
        """Return the Earth rate in the frame of each dwell's attitude, (s, 3) rad/s."""
        return np.tile(self.surroundings(state).rate, (len(self.evidence.segments), 1))

    @property
    def _attitudes(self) -> Floats:
        return self.evidence.dwell_attitudes

    @property
    def _turning(self) -> tuple[Floats, Floats, NDArray[np.bool_]]:
        """Up in body axes (t, 3), rate by the table's own clock (t,), whether that clock counts."""
        return self.evidence.turn_inputs

    @property
    def _headings(self) -> Floats:
        return self.evidence.headings

    def _once(self, what: Hashable, state: Floats, worked_out: Callable[[Floats], Value]) -> Value:
        """Return what is the same whatever the weights: it is worked out once at each state."""
        key = (what, state.tobytes(), self.time_constant)
        # Most of what is asked for is of the last state.
        for known, parameters, changes, value in reversed(self.evidence.state_cache):
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
        around, model = self.surroundings(state), self.model(state)
        at_rest, turned = self.answers(state)
        led = self.evidence.links.misclosures(model, self.earth(state), around.force)
        if state[self.clock]:
            led = led + self._once('clock', state, self._by_clock) * state[self.clock]
        predicted = self.layout.joined(at_rest, turned, led)
        predicted[self._divided] /= 1 + state[self.clock]
        return predicted

    def answers(self, state: Floats) -> tuple[Floats, Floats]:
        """Return what dwells (s, 6) and turns (t, 6) read by the table's clock."""
        _, rate, force, turning, felt = self._inputs(state)
        model = self.model(state)
        at_rest = np.hstack(model.predict(rate, force))
        return at_rest, mean_over_turn(np.concatenate(model.predict(turning, felt), axis=-1))

    def jacobian(self, state: Floats) -> Floats:
        """Return the derivatives of `predict`, (m, n).

        By the table they are those of the mean parameters: what changes of these is parts in 1e5.
        """
        return self._once('derivatives', state, self._derivatives)

    def _derivatives(self, state: Floats) -> Floats:
        around, _, _, turning, felt = self._inputs(state)
        model, n = self.model(state), self.sensors
        at_rest, turned, led = (
            np.zeros((count, 6, self.size))
            for count in (self.layout.dwells, self.layout.turns, self.layout.moves)
        )
        arms, by_force = self.evidence.arms, model.slopes(turning, felt)[..., 3:]
        turned[arms.turns, :, self.arms] = mean_over_turn(by_force)[arms.turns] @ arms.slopes
        led[:, :, self.clock] = self._once('clock', state, self._by_clock)
        result = self.layout.joined(at_rest, turned, led)
        faster, divided = 1 + state[self.clock], self._divided
        result[divided] /= faster
        world = np.vstack([around.rate_slopes, around.force_slopes])
        result[:, n : n + 3] = self.by_world(state) @ world
        result[:, :n] = self.by_parameters(state, self.parameters)
        answered = self.layout.joined(*self.answers(state), np.zeros_like(led[:, :, 0]))
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

    def _by_clock(self, state: Floats) -> Floats:
        return self._led_by_clock(self.model(state), self.surroundings(state))

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

    def by_world(self, state: Floats) -> Floats:
        """Return the derivatives of `predict` by Earth rate and gravity.

        Returns:
            (m, 6), both in the frame of the attitudes.

        """
        return self._once('by world', state, self._by_world)

    def _by_world(self, state: Floats) -> Floats:
        _, rate, force, turning, felt = self._inputs(state)
        model, moves = self.model(state), self.evidence.links
        at_rest = model.slopes(rate, force) @ _both(self._to_body)
        turned = mean_over_turn(model.slopes(turning, felt) @ _both(self._headings))
        led = np.concatenate([moves.by_rate(), moves.by_force()], axis=2)
        result = self.layout.joined(at_rest, turned, led)
        result[self._divided] /= 1 + state[self.clock]
        return result

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
        assert self.evidence.table is not None
        # Trials with other errors of the table share what was worked out of the session.
        what = 'table', self.evidence.table.errors
        return self._once(what, state, lambda there: self._leaning(there, at_rest, turning))

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
        walk = self.evidence.walk
        return self._by_rates(state, np.array([t.rate_std(walk) for t in self.evidence.turns]))

    def by_ways(self, state: Floats) -> Floats:
        """Return what stops beside the mark do by the way of whole motions, (m, w) per rad.

        Either end of a motion is off, and the next may begin with the error of this one's end.
        """
        relative, some = self.evidence.whole_ways
        return self._by_rates(state, relative)[:, some]

    def _by_rates(self, state: Floats, relative: Floats) -> Floats:
        evidence, response = self.evidence, self.model(state).gyro.response
        result = np.zeros((len(self.layout), len(evidence.turns)))
        rates, pulled = self._turning[1], self._pulled(state)
        for turns, rows, seen in encoder_rate_errors(evidence, relative, rates, response, pulled):
            result[rows, turns[:, None]] = seen
        return result

    def latitude_slope(self, state: Floats) -> Floats:
        """Return the derivatives of `predict` by the latitude, (m,) per rad."""
        by_rate = self.by_world(state)[:, :3]
        return np.asarray(by_rate @ self.surroundings(state).rate_by_latitude)

    def clock_slope(self, state: Floats) -> Floats:
        """Return the derivatives of `predict` by the rate between the clocks."""
        return np.asarray(self.jacobian(state)[:, self.clock])

    def by_positioning(self, state: Floats) -> tuple[Floats, Floats]:
        """Return how positioning errors enter the outputs: (m, errors), per rad.

        Those of joints that stop, and what each stop leans of its own.
        """
        return self._once('positioning', state, self._positioning_columns)

    def _positioning_columns(self, state: Floats) -> tuple[Floats, Floats]:
        both = self.evidence.positioning_leans
        at_rest, turning = (
            np.concatenate(parts, axis=2)
            for parts in zip(*((one.at_rest, one.turning) for one in both), strict=True)
        )
        leaning = self._leaning(state, at_rest, turning)
        joints, stops = np.split(leaning, [both[0].at_rest.shape[2]], axis=1)
        return np.hstack([joints, self.by_ways(state)]), stops

    def _leaning(self, state: Floats, at_rest: Floats, turned: Floats) -> Floats:
        """Return what attitudes that lean do to the outputs, (m, e).

        Args:
            state: (n,) of sensors and table.
            at_rest: (s, 3, e) rotations of the static dwells about the body axes, rad.
            turned: (t, 3, e) of the turns.

        """
        s, by_each = len(at_rest), self._once('leaning', state, self._by_leaning)
        led = self.evidence.links.by_attitudes(self.model(state), at_rest)
        return self.layout.joined(by_each[:s] @ at_rest, by_each[s:] @ turned, led)

    def _by_leaning(self, state: Floats) -> Floats:
        """Return the derivatives by rotations about the body axes, (s + t, 6, 3): not of moves."""
        _, rate, force, turning, felt = self._inputs(state)
        rates, forces = (
            np.vstack([rate, mean_over_turn(turning)]),
            np.vstack([force, mean_over_turn(felt)]),
        )
        # What is seen is crossed with a rotation of the axes.
        crossed = [np.tensordot(seen, GENERATORS, axes=1) for seen in (rates, forces)]
        slopes = self.model(state).slopes(rates, forces)
        return np.asarray(slopes @ np.concatenate(crossed, axis=1))


def _both(rotations: Floats) -> Floats:
    """Return rotations (..., 3, 3) of rates and forces alike: (..., 6, 6)."""
    result = np.zeros((*rotations.shape[:-2], 6, 6))
    result[..., :3, :3] = result[..., 3:, 3:] = rotations
    return result
