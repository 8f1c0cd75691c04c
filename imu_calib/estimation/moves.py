"""Moves as observations: gyros and accelerometers integrated between two static dwells.

With C the rotation by the gyros of a model from rest a to rest b, of a vector fixed in inertial
space, v the velocity gained by its accelerometers (`VelocityIncrement`), f the specific force of
gravity and T the time,

    e = log( C (R_b^T exp(-[w_ie] T) R_a)^T ) = noise,    three equations in the body axes at rest b
    z = exp(-[R_b e] / 2) R_b v - f T = noise,            three in the frame of the attitudes

Half of the rotation error is removed from the velocity. The attitudes of both ends then have the
same effect on it, and the noise of the gyros is independent in the two equations.

Source: docs/mathematics.md, 'Moves' and 'Velocities of moves'; the strapdown equations of Savage
1998.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ..common.gaussian import MAD_TO_STD
from ..common.rotations import cross, cross_matrix, rotation_vector, rotations
from ..common.stream import Floats
from ..model.parameters import AXES, PARAMETERS, Parameter, ParameterKind, indices_of
from ..model.sensors import SensorModel, motion_parameters, regressors
from ..segmentation.segmented import Move
from ..segmentation.segments import Segment, Turn
from .arms import ACCEL_DISTANCE, ARM_STD
from .gyro_paths import GyroPath, VelocityIncrement, by_delay, by_places, summed
from .remainders import ApproximateSensors, remainder_covariance

_FORESEEN = 1.0
"""Standard deviation of counters' rates from their prediction before a session, pulses a second:
both ends of a move of two seconds then have independent phases. With pulses of 0.5 mm/s a bias
error of 50 ug makes as much, and gravity for one more millisecond twenty pulses."""

_EDGES = 1 / 6
"""Square of a pulse due to the counter's remainders at both ends of a move: 2 / 12. The remainders
between (`remainders`) have little effect for gyros, which count in every step."""

_LATE = 0.01
"""Standard deviation of the delay of accelerometers against gyros, s: low-pass filters of MEMS
delay either by 2 to 19 ms (MPU-6050, register map, DLPF_CFG)."""

_LEAST_OFF = 1e-3
"""Least assumed error of accelerometers, as a ratio: misalignments do not change the length."""

_WORSE = 10.0
"""Upper limit of the standard deviation of a move's mean force by its velocity, over that of a
dwell's: beyond it a move adds less than a hundredth to what the dwell before it gives."""

_LEVEL = np.array([1.0, 1.0, 0.0])  #: Effect of a rotation of the axes on gravity: none along it.

_CACHED = 4
"""Models whose integrated moves are cached: a search uses two solutions alternately, and the step
to the next from either."""

_LINEAR = frozenset(p for p in PARAMETERS if p.triad == 'a' and p.column is not None)
"""Scale factors and misalignments of the accelerometers."""

Cached = TypeVar('Cached')


@dataclass(frozen=True, eq=False)
class LinkedMove:
    """A move, and the indices of the segments at rest at its ends."""

    first: int  #: Index of the segment before.
    second: int  #: Index of the segment after.
    move: Move  #: The move.
    rounding: Floats  #: (6,) variance by the rounding of each sample, rad^2 and (m/s)^2.
    encoders: float  #: Variance by the noise of the encoders at both ends, about any axis, rad^2.
    coning_variance: float  #: Variance by rates that do not change linearly, rad^2.
    second_order_error: float  #: Error of the velocity by the second order, m/s.


@dataclass(frozen=True, eq=False)
class Moves:
    """The moves between segments whose attitudes are known from encoders."""

    linked: tuple[LinkedMove, ...]  #: In order.
    attitudes: Floats  #: (s, 3, 3) of all segments.
    gravity: float  #: m/s^2.
    #: Their outputs, to count pulses; None where the attitudes are unknown.
    approximate_sensors: ApproximateSensors | None = None
    _paths: dict[bytes, tuple[GyroPath, ...]] = field(default_factory=dict, init=False, repr=False)
    _increments_cache: dict[bytes, tuple[VelocityIncrement, ...]] = field(
        default_factory=dict, init=False, repr=False
    )

    @classmethod
    def between(
        cls,
        segments: Sequence[Segment],
        turns: Sequence[Turn],
        moves: Sequence[Move],
        gravity: float,
        walk: Floats,
        *,
        free: bool = False,
        coarse: bool = False,
    ) -> Moves:
        """Choose the moves to use; all of a unit in the hand, whose attitudes are `free`.

        A move that contains measured turns shares its noise with them and adds little: the turns
        are used instead. Where no joint moved the move is not used. A velocity with little
        information beside the rest is left out, unless `coarse`: pulses of some mm/s dominate it.
        """
        by_end = {s.end: k for k, s in enumerate(segments) if free or s.angles is not None}
        by_start = {s.start: k for k, s in enumerate(segments) if free or s.angles is not None}
        misfit = _gravity_misfit(segments, gravity)
        links = []
        for move in moves:
            first, second = by_end.get(move.start), by_start.get(move.end)
            if first is None or second is None:
                continue
            if any(t.start < move.end and t.end > move.start for t in turns):
                continue
            before, after = segments[first].angles, segments[second].angles
            if not free and np.array_equal(np.asarray(before), np.asarray(after)):
                continue
            encoders = sum(segments[end].attitude_error ** 2 for end in (first, second))
            # A hand does not hold a rate: samples rounded one by one average out.
            rounding = np.zeros(6) if free else _rounding(move, segments[first])
            kept = move if coarse else _informative(move, rounding, segments[first], walk)
            cut = misfit * gravity * _seconds_of_second_order(move)
            links.append(
                LinkedMove(first, second, kept, rounding, encoders, coning_variance(move), cut)
            )
        # Without them no move of a table is used; for a unit in the hand they are estimated.
        attitudes = [np.eye(3) if s.attitude is None else s.attitude for s in segments]
        turned = np.array(attitudes).reshape(-1, 3, 3)
        known = links and not free
        sensors = (
            ApproximateSensors.fitted(segments, turns, gravity * turned[:, 2], walk)
            if known
            else None
        )
        return cls(tuple(links), turned, gravity, sensors)

    def __len__(self) -> int:
        return len(self.linked)

    @property
    def with_accels(self) -> tuple[int, ...]:
        """Which of them have accelerometers that are used."""
        return tuple(
            k for k, link in enumerate(self.linked) if link.move.velocity_steps is not None
        )

    def paths(self, model: SensorModel) -> tuple[GyroPath, ...]:
        """Return the moves by a model's gyros."""

        def integrated() -> tuple[GyroPath, ...]:
            motions = [
                (k.move.turned, k.move.seconds, self.gravity * self.attitudes[k.second, 2])
                for k in self.linked
            ]
            return GyroPath.of_each(motions, model)

        return _cached(self._paths, model.gyros_fingerprint(), integrated)

    def velocity_increments(self, model: SensorModel) -> tuple[VelocityIncrement, ...]:
        """Return the velocities gained by a model's accelerometers in the moves `with_accels`."""

        def gained() -> tuple[VelocityIncrement, ...]:
            paths = self.paths(model)
            each = [link.move.velocity_steps for link in self.linked]
            used = [paths[k] for k in self.with_accels]
            return VelocityIncrement.of_each([one for one in each if one is not None], used, model)

        return _cached(self._increments_cache, model.fingerprint(), gained)

    @cached_property
    def _with_accels(self) -> NDArray[np.intp]:
        """`with_accels`, as indices."""
        return np.array(self.with_accels, dtype=np.intp)

    @cached_property
    def _ends(self) -> NDArray[np.intp]:
        """Indices of the segments at the start and end of moves, (2, m)."""
        ends = [(link.first, link.second) for link in self.linked]
        return np.array(ends, dtype=np.intp).reshape(-1, 2).T

    @property
    def _reached(self) -> Floats:
        """Attitudes at the end of the moves whose accelerometers are used, (v, 3, 3)."""
        return np.asarray(self.attitudes[self._ends[1][self._with_accels]])

    def misclosures(self, model: SensorModel, earth_rate: Floats, force: Floats) -> Floats:
        """Return e and z, (m, 6) rad and m/s; z is zero where accelerometers are not used.

        The Earth rate is in the frame of the attitudes, (3,) or of each of them (s, 3), rad/s; the
        specific force at rest (3,) likewise, m/s^2.
        """
        found = np.zeros((len(self), 6))
        if not self.linked:
            return found
        first, second = self._ends
        rates = np.broadcast_to(earth_rate, (len(self.attitudes), 3))[second]
        seconds, ends = self._seconds[:, None], self.attitudes[second]
        # The rotation by the encoders, inverted.
        back = np.swapaxes(self.attitudes[first], -1, -2) @ rotations(rates * seconds) @ ends
        rotated = np.array([path.rotation for path in self.paths(model)])
        found[:, :3] = rotation_vector(rotated @ back)
        if increments := self.velocity_increments(model):
            mine = self._with_accels
            half_way = rotations(_times(ends[mine], found[mine, :3]) / -2)
            gained = _times(ends[mine], np.array([p.velocity + p.correction for p in increments]))
            # The Earth turns the frame meanwhile.
            displaced = _times(ends[mine], np.array([p.displacement for p in increments]))
            gained += cross(rates[mine], displaced)
            found[mine, 3:] = _times(half_way, gained) - force * seconds[mine]
        return found

    def parameter_derivatives(
        self, model: SensorModel, parameters: tuple[Parameter, ...]
    ) -> Floats:
        """Return the derivatives of `misclosures` by parameters of the sensors, (m, 6, p)."""
        paths, by = self.paths(model), regressors(parameters)
        result = np.zeros((len(self), 6, len(parameters)))
        if not paths:
            return result
        rates = np.concatenate([path.rates for path in paths])
        forces = np.concatenate([path.forces for path in paths])
        ends = np.cumsum([len(path.rates) for path in paths])[:-1]
        courses = np.split(by.at(rates, forces), ends)
        gyros = np.flatnonzero(by.channels < len(AXES))
        accels = np.flatnonzero((by.channels >= len(AXES)) & (by.channels < 2 * len(AXES)))
        # Of each channel, the last index but one, and course.
        turned = np.array(
            [summed(path.timed_transfer, c) for path, c in zip(paths, courses, strict=True)]
        )
        result[:, :3, gyros] = turned[:, :, by.channels[gyros], by.index[gyros]]
        increments, own = self.velocity_increments(model), motion_parameters(parameters)
        if not increments:
            return result
        mine = [
            (increment, courses[k])
            for increment, k in zip(increments, self._with_accels, strict=True)
        ]
        leant = np.array([summed(increment.turning, course) for increment, course in mine])
        integrated_courses = np.array(
            [increment.integrated_courses(course) for increment, course in mine]
        )
        slopes = np.zeros((len(increments), 3, len(parameters)))
        slopes[..., gyros] = leant[:, :, by.channels[gyros], by.index[gyros]]
        slopes[..., accels] = -integrated_courses[
            :, :, by.channels[accels] - len(AXES), by.index[accels]
        ]
        specific_force = np.array([increment.integrated_force for increment in increments])
        for k, parameter in enumerate(parameters):
            if parameter in _LINEAR:
                slopes[..., k] = -specific_force[:, :, parameter.row, parameter.column]
        if own:
            places, delay = by_places(increments), by_delay(increments)
            for k, p in zip(indices_of(own, parameters), own, strict=True):
                at_place = p.kind is ParameterKind.PLACE
                slopes[..., k] = places[..., 3 * p.row + (p.column or 0)] if at_place else delay
        result[self._with_accels, 3:] = self._reached @ slopes
        return result

    def clock_derivatives(self, model: SensorModel, force: Floats, *, counted: bool) -> Floats:
        """Return the derivatives of `misclosures` by the rate of the clock, (m, 6).

        Where the outputs are counted pulses their sum does not depend on the clock; rates times
        shorter seconds turn by less. The specific force is that of `misclosures`.
        """
        found = np.zeros((len(self), 6))
        increments, mine = self.velocity_increments(model), self._with_accels
        if counted:
            if increments:
                gained = _times(
                    self._reached, np.array([increment.by_seconds for increment in increments])
                )
                found[mine, 3:] = force * self._seconds[mine, None] - gained
            return found
        answers = [path.rates @ model.gyro.response.T for path in self.paths(model)]
        for k, path in enumerate(self.paths(model)):
            found[k, :3] = np.einsum('nij,nj->i', path.timed_transfer, answers[k])
        if increments:
            leant = [
                np.einsum('nij,nj->i', increment.turning, answers[k])
                for k, increment in zip(mine, increments, strict=True)
            ]
            found[mine, 3:] = _times(self._reached, np.array(leant))
        return found

    def world_derivatives(self) -> Floats:
        """Return the derivatives of `misclosures` by Earth rate and force at rest, (m, 6, 6).

        In axes half way between both ends the rotation of the frame does not change the velocity.
        """
        found, seconds = np.zeros((len(self), 6, 6)), self._seconds[:, None, None]
        found[:, :3, :3] = np.swapaxes(self.attitudes[self._ends[1]], -1, -2) * seconds
        found[:, 3:, 3:] = -seconds * np.eye(3)
        return found

    def attitude_error_effects(self, model: SensorModel, attitude_errors: Floats) -> Floats:
        """Return the derivatives (m, 6, e) of `misclosures` by attitude errors at both ends.

        `attitude_errors` (s, 3, e) are rotations in body axes, per unit of each of e errors.
        """
        found = np.zeros((len(self), 6, attitude_errors.shape[2]))
        if not self.linked:
            return found
        first, second = self._ends
        rotated = np.array([path.rotation for path in self.paths(model)])
        found[:, :3] = attitude_errors[second] - rotated @ attitude_errors[first]
        mine = self._with_accels
        # Half of either, times gravity as a cross product.
        about = self.attitudes[:, :2] @ attitude_errors
        half = (self.gravity / 2 * self._seconds[mine])[:, None, None]
        both = (about[first[mine]] + about[second[mine]]) * half
        found[mine, 3], found[mine, 4] = both[:, 1], -both[:, 0]
        return found

    def shared_velocity_errors(
        self,
        model: SensorModel,
        earth_rate: Floats,
        known: AbstractSet[ParameterKind] = frozenset(),
    ) -> tuple[Floats, Floats]:
        """Return the errors of velocities beyond the parameters, common to many moves.

        Kinds that are `known` are parameters, or taken as zero. Return (m, 6, 12) by the place of
        the unit and of its accelerometers, 3 where their places are known, and (m, 6, 1) by their
        delay, per standard deviation.
        """
        apart, late = (kind not in known for kind in (ParameterKind.PLACE, ParameterKind.DELAY))
        arms = np.zeros((len(self), 6, 12 if apart else 3))
        delays = np.zeros((len(self), 6, 1 if late else 0))
        increments = self.velocity_increments(model)
        if not increments:
            return arms, delays
        mine, reached = self._with_accels, self._reached
        # The unit ends at another place than it began.
        away = reached - self.attitudes[self._ends[0][mine]]
        arms[mine, 3:, :3] = -2 * ARM_STD * cross_matrix(earth_rate) @ away
        if late:
            delays[mine, 3:, 0] = _LATE * _times(reached, by_delay(increments))
        if apart:
            arms[mine, 3:, 3:] = ACCEL_DISTANCE * reached @ by_places(increments)
        return arms, delays

    def noise(self, walk: Floats) -> tuple[Floats, Floats]:
        """Return the variances of `misclosures` by gyros and by accelerometers, (m, 6) each.

        Random walks of the three channels are equal, so that mixing by the rotation of the axes
        does not change them. In axes half way between both ends a velocity has a twelfth of the
        effect of the rotation at the end over the whole time.
        """
        gyro, accel = (float(np.mean(part**2)) for part in (walk[:3], walk[3:]))
        quiet = np.array([link.move.quiet for link in self.linked])
        seconds = (self._seconds - quiet)[:, None]
        turning = gyro * seconds * self._turning
        turning[:, 3:] /= 12
        return turning, accel * seconds * np.repeat([0.0, 1.0], 3)

    def quantisation(self) -> Floats:
        """Return the variances of `misclosures` by pulses, rounding and samples' length, (m, 6).

        Half of the rotation by a remainder at either end is in the velocity, and the error of each
        step adds to it like random walk.
        """
        found = np.zeros((len(self), 6))
        for k, (link, turning) in enumerate(zip(self.linked, self._turning, strict=True)):
            ends, bent = _EDGES * link.move.pulse**2, link.coning_variance
            found[k, :3] = ends + link.rounding[:3] + bent + link.move.filled
            found[k, 3:] = turning[3:] * (ends.mean() / 4 + bent / 12 + link.move.filled / 4)
            if (gained := link.move.velocity_steps) is not None:
                held = np.diag(self.by_remainders[k])
                own = link.rounding[3:].mean() + gained.filled + link.second_order_error**2
                found[k, 3:] += held + own
        return found

    @cached_property
    def by_remainders(self) -> Floats:
        """The covariances of velocities by the remainders of counters, (m, 3, 3) (m/s)^2."""
        found = np.zeros((len(self), 3, 3))
        for k in self.with_accels:
            gained = self.linked[k].move.velocity_steps
            if gained is not None and gained.pulse.any():
                accel_std = _FORESEEN * gained.pulse if gained.predicted else np.zeros(3)
                found[k] = self._remainder_covariance(k, gained.pulse, accel_std)
        return found

    def _remainder_covariance(self, index: int, pulse: Floats, least: Floats) -> Floats:
        """Return the covariance (3, 3) of the velocity of a move by remainders of pulses, (m/s)^2.

        `least` are the least standard deviations (3,) of the counters' rates, m/s^2.
        """
        if self.approximate_sensors is None:
            return np.eye(3) * _EDGES * np.mean(pulse**2)
        path = self.paths(self.approximate_sensors.model)[index]
        directions = self.attitudes[self.linked[index].second] @ path.axes
        _, outputs = self.approximate_sensors.model.predict(path.rates, path.forces)
        accel_std = np.maximum(self.approximate_sensors.accel_std, least)
        return remainder_covariance(directions, path.seconds, outputs, accel_std, pulse)

    def encoders(self) -> Floats:
        """Return the variances of `misclosures` by the encoders' noise at both ends, (m, 6)."""
        errors = np.array([link.encoders for link in self.linked]).reshape(-1, 1)
        return np.asarray(errors * self._turning * np.repeat([1.0, 0.25], 3))

    def variances(self, walk: Floats) -> Floats:
        """Return the sum of all three, (m, 6)."""
        return np.asarray(sum(self.noise(walk)) + self.quantisation() + self.encoders())

    @cached_property
    def _seconds(self) -> Floats:
        """Their durations, (m,)."""
        return np.array([link.move.duration for link in self.linked], dtype=float)

    @property
    def _turning(self) -> Floats:
        """Squares of the effect of a rotation of the axes at the end on e and on R_b v, (m, 6)."""
        along = _LEVEL * (self.gravity * self._seconds[:, None]) ** 2
        return np.hstack([np.ones((len(self), 3)), along])


def _cached(memo: dict[bytes, Cached], key: bytes, worked_out: Callable[[], Cached]) -> Cached:
    """Return the cached result for a model, or compute it; the oldest is dropped.

    A model whose term has zero coefficients gives the same result as one without the term.
    """
    if key not in memo:
        if len(memo) == _CACHED:
            del memo[next(iter(memo))]
        memo[key] = worked_out()
    return memo[key]


def _times(matrices: Floats, vectors: Floats) -> Floats:
    """Return (n, 3, 3) matrices times (n, 3) vectors."""
    return np.asarray((matrices @ vectors[..., None])[..., 0])


def _informative(move: Move, rounding: Floats, rest: Segment, walk: Floats) -> Move:
    """Return a move without its velocity, if that adds little to the rest before it."""
    if move.velocity_steps is None:
        return move
    variance = _EDGES * move.velocity_steps.pulse**2 + rounding[3:] + walk[3:] ** 2 * move.duration
    own = float(np.mean(variance)) / move.duration**2
    if own <= _WORSE**2 * float(np.mean(rest.statistics.variance(walk)[3:])):
        return move
    return replace(move, velocity_steps=None)


def from_mean_attitudes(moves: Sequence[Move], sensor_walk: Floats) -> tuple[Move, ...]:
    """Return moves in the hand from the mean attitude of one hold to that of the next.

    The accelerometers give the mean attitude of a hold, and a hand trembles, and begins and ends
    turns gently, within it. With q the variance of the sensors' random walk over that of tremor and
    sensors, the best estimate of the angle at an edge is 1 - q times what the gyros show. Its error
    does not depend on that of the hold's mean rate, and of T seconds has the variance (1 - q) T / 3
    of the sensors' walk. Angles from the start to the mean less those from there to the end show q,
    without a constant bias: those of noise have a variance of T / 3 of it.

    Source: docs/mathematics.md, 'Free positions'.
    """
    holds = [hold for move in moves for hold in move.edges or ()]
    apart = [(one.from_mean - one.to_mean) / np.sqrt(one.seconds / 3) for one in holds]
    # The medians: of biases that settle, few holds show much.
    spread = np.median(np.abs(apart - np.median(apart, axis=0))) if apart else 0.0
    seen, own = float(MAD_TO_STD * spread) ** 2, float(np.mean(sensor_walk[:3] ** 2))
    # A unit that is held still has none; of counters without a data sheet the noise is not known.
    if not seen > own:
        return tuple(moves)
    share = 1 - own / seen
    usual = float(np.median([one.seconds for one in holds]))

    def extended(move: Move) -> Move:
        if move.edges is None:
            # As far from the mean attitudes as the edges of the others, two of them together.
            return replace(move, filled=move.filled + seen * usual / 3)
        before, after = move.edges
        held = np.array([before.seconds, after.seconds])
        spans = share / 2 * held
        seconds = np.concatenate([spans[:1], move.seconds, spans[1:]])
        turned = np.vstack([share * before.from_mean, move.turned, share * after.to_mean])
        # The weights of an edge rise linearly towards the move.
        moment = spans @ ((move.duration / 2 + held / 3) * [-1, 1])
        later, quiet = float(moment / seconds.sum()), float(spans.sum()) / 3
        filled = move.filled + share**2 * (before.filled[1] + after.filled[0])
        return replace(
            move,
            turned=turned,
            seconds=seconds,
            edges=None,
            quiet=quiet,
            later=later,
            filled=filled,
        )

    return tuple(map(extended, moves))


def _gravity_misfit(segments: Sequence[Segment], gravity: float) -> float:
    """Return the largest relative deviation of specific forces at rest from gravity."""
    sizes = [float(np.linalg.norm(s.statistics.mean[3:])) / gravity for s in segments]
    return max([_LEAST_OFF, *(abs(size - 1) for size in sizes)])


def _seconds_of_second_order(move: Move) -> float:
    """Return the error of a velocity per change of the specific force by a model, s.

    Within a step each sample is turned by the angle to its middle: for a change of force that is
    even in the time from there the error is a twelfth of the square of the step's angle.
    """
    return float((move.turned**2).sum(axis=1) @ move.seconds) / 12


def _rounding(move: Move, rest: Segment) -> Floats:
    """Return the variance by an ADC's rounding: the mean at rest has this error, and so has a move.

    A counter carries its remainder on: it has an error only at the ends of a move, see `_EDGES`.
    """
    variance = rest.statistics.quantisation_variance * move.duration**2
    pulses = np.zeros(3) if move.velocity_steps is None else move.velocity_steps.pulse
    return np.where(np.append(move.pulse, pulses) > 0, 0.0, variance)


def coning_variance(move: Move) -> float:
    """Return the variance of an angle by coning beyond the second order, rad^2.

    For a rate that changes linearly the cross product of one step with the next is constant, and a
    twelfth of it is the coning term: a joint that starts or stops, and directions that turn, change
    it. Each step may have that error, independently.
    """
    crossed = cross(move.turned[:-1], move.turned[1:])
    return float((np.diff(crossed, axis=0) ** 2).sum()) / 12**2
