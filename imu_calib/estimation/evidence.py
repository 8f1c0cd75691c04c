"""Input of a method: the labelled segments of a session, and their uncertainties."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.errors import NotObservable
from ..common.stream import Floats, Stamps, Units
from ..model.earth import Site
from ..segmentation.clock import ClockFit
from ..segmentation.course import Temperature
from ..segmentation.labelling import OUTAGE, Labelled
from ..segmentation.segmented import Move, Segmented
from ..segmentation.segments import Segment, Statistics, Turn
from ..session.imu import ImuSpec
from ..session.plan import Plan
from ..session.table import Table
from ..session.table_errors import LEVELLED, TableErrors
from .arms import Arms, headings
from .known_noise import known_noise
from .moves import Moves
from .outputs import OutputLayout
from .positioning_errors import (
    AttitudeErrors,
    AttitudeStep,
    around,
    hold_errors,
    joint_errors,
    step_errors,
    stop_errors,
)

UP = np.array([0.0, 0.0, 1.0])  #: In east, north, up.
_AXIS_TOLERANCE = 0.05
"""Largest amount by which the cosine of a vertical axis is below one: 18 deg, beyond any error of a
table and less than half of the 45 deg to the next attitude of any plan."""
_CACHED = 48
"""Results kept in `Evidence.state_cache`: a dozen at each of four states, those of the last step
and of solutions used alternately or from which the next fits start."""

_QUARTZ = 50e-6
"""Standard deviation of the rate between clocks that are not compared by motions, as a ratio:
quartz oscillators are sold for 20 to 100 ppm over their temperatures."""

SMALLEST_VARIANCE = 1e-24
"""Replaces zero where a noise-free session is divided by its variance, SI units squared.

In 64-bit numbers a mean over samples of gravity is resolved to some 1e-14 m/s^2, and whole turns at
90 deg/s, cut at a line through thousands of angles, to some 1e-12 rad/s: no smaller error is
claimed.
"""


@dataclass(frozen=True, eq=False)
class Evidence:
    """A labelled session, ready to be solved."""

    segments: tuple[Segment, ...]  #: Static dwells with position and attitude.
    turns: tuple[Turn, ...]  #: Whole turns about the vertical.
    plan: Plan  #: What was run; `plan.UNPLANNED` where unknown.
    site: Site  #: Gravity and Earth rate.
    clock: ClockFit  #: Table against IMU.
    azimuth: float | None  #: Heading of the table's zero against north, rad; None when unknown.
    walk: Floats  #: (6,) random-walk coefficients, rad/sqrt(s) and (m/s)/sqrt(s).
    #: Standard deviation of a positioning error of the table, rad; 0 when not stated.
    positioning: float = 0.0
    #: (6,) standard deviation of drifting biases, by the data sheet, rad/s and m/s^2; 0 when not
    #: stated.
    instability: Floats = field(default_factory=lambda: np.zeros(6))
    #: (6,) degrees of freedom of the squares of `walk`; infinite for exact ones.
    walk_freedom: Floats = field(default_factory=lambda: np.full(6, np.inf))
    #: Motions seen by the gyros between one static dwell and the next.
    moves: tuple[Move, ...] = ()
    #: The table that turned the unit; None where the errors of its axes are unknown.
    table: Table | None = None
    units: Units = Units.PULSES  #: Of the numbers of the unit's stream.
    temperature: Temperature | None = None  #: Of the session; None without a thermometer.
    #: (2, 2) scale factor and bias per K of gyros and of accelerometers, by the data sheet,
    #: standard deviations, 1/K and SI/K; 0 where not stated.
    thermal: Floats = field(default_factory=lambda: np.zeros((2, 2)))
    #: Whether the attitudes are unknown: they are then estimated, and moves join them.
    free: bool = False
    #: Whether to use velocities of moves with little information beside the dwells: for parameters
    #: that only motion determines.
    coarse: bool = False
    #: As in `Segmented`: the unit may have been switched off and on there.
    interruptions: tuple[tuple[int, int], ...] = ()
    #: Steps of the attitudes against the joints' readings, of which the outputs' covariance knows.
    attitude_steps: tuple[AttitudeStep, ...] = ()
    #: (6,) as `walk`, of the sensors without what a hand adds at rest, which a move measures; None
    #: where both are the same.
    sensor_walk: Floats | None = None

    @classmethod
    def from_session(
        cls,
        labelled: Labelled,
        session: Segmented,
        plan: Plan,
        imu: ImuSpec,
        site: Site,
        table: Table | None,
    ) -> Evidence:
        """Gather the evidence of a session whose dwells and turns have names.

        Raises:
            NotObservable: Neither the data nor the IMU's description gives the noise.
        """
        walk, freedom = known_noise(labelled.segments, imu)
        return cls(
            labelled.segments,
            tuple(turn.by_more_accurate_rate(walk) for turn in labelled.turns),
            plan,
            site,
            session.clock,
            table.azimuth if table is not None else None,
            walk,
            table.positioning if table is not None else 0.0,
            np.repeat([imu.gyro.bias_instability, imu.accel.bias_instability], 3),
            freedom,
            session.moves,
            table,
            imu.units,
            session.temperature,
            thermal_of(imu),
            interruptions=session.interruptions,
        )

    def with_table_errors(self, errors: TableErrors) -> Evidence:
        """Return the session on its table with other errors."""
        assert self.table is not None, 'no table, and none of its errors'
        return replace(self, table=replace(self.table, errors=errors))

    @property
    def parts(self) -> list[Segment | Turn]:
        """Static dwells, then turns."""
        return [*self.segments, *self.turns]

    @cached_property
    def state_cache(self) -> deque[tuple[Any, ...]]:
        """Cached results at the last few states (`Equations`)."""
        return deque(maxlen=_CACHED)

    @cached_property
    def cache(self) -> dict[Any, Any]:
        """Cached results that do not depend on the state (`Equations`)."""
        return {}

    @cached_property
    def dwell_attitudes(self) -> Floats:
        """R_nb of the static dwells, (s, 3, 3), in the frame of the table's azimuth."""
        return np.array([s.attitude for s in self.segments]).reshape(-1, 3, 3)

    @cached_property
    def turn_inputs(self) -> tuple[Floats, Floats, NDArray[np.bool_]]:
        """Up in body axes (t, 3), rate by the table's clock (t,), whether that clock is used."""
        ups = np.array([t.up for t in self.turns]).reshape(-1, 3)
        timed = np.array([t.seconds is not None for t in self.turns], dtype=bool)
        return ups, np.array([t.rate() for t in self.turns]), timed

    @cached_property
    def rest_to_rest_rates(self) -> tuple[Floats, NDArray[np.bool_]]:
        """Relative change of the rate of a whole motion by one rad at either end, (t,).

        Zero for a turn without a whole motion from rest to rest; and whether it has one.
        """
        ways = [t.whole_way for t in self.turns]
        some = np.array([way is not None for way in ways], dtype=bool)
        return np.array([2 / way.way if way else 0.0 for way in ways]), some

    @cached_property
    def headings(self) -> Floats:
        """The attitudes during turns, (t, 8, 3, 3), see `headings`."""
        return headings(self.turn_inputs[0])

    @cached_property
    def used_moves(self) -> Moves:
        """The moves that are used as observations."""
        site = self.site
        return Moves.between(
            self.segments,
            self.turns,
            self.moves,
            site.gravity,
            self.walk,
            free=self.free,
            coarse=self.coarse,
        )

    @cached_property
    def layout(self) -> OutputLayout:
        """Where the outputs lie among the equations."""
        accel_turns = tuple(self.arms.turns.tolist())
        return OutputLayout(
            len(self.segments),
            len(self.turns),
            len(self.used_moves),
            accel_turns,
            self.used_moves.with_accels,
        )

    @cached_property
    def instants(self) -> tuple[Stamps, Stamps]:
        """First and last stamp of each dwell, turn and move, (s + t + m,) ns."""
        spans = [(part.start, part.end) for part in self.parts]
        spans += [link.move.span for link in self.used_moves.linked]
        starts, ends = np.array(spans, dtype=np.int64).reshape(-1, 2).T
        return starts, ends

    @cached_property
    def arms(self) -> Arms:
        """The lever arms of the turns whose accelerometers are used."""
        return Arms.from_turns(self.turns, self.site.up_rate)

    @cached_property
    def table_attitude_errors(self) -> tuple[Floats, Floats]:
        """Attitude errors by the table's geometry and by steps, rad per standard deviation.

        Rotations about the body axes, (s, 3, e) of the static dwells and (t, 3, e) of the turns;
        those of a turn are means over all angles of the joint that turns.
        """
        known = [part.angles for part in self.parts]
        if self.table is None or any(a is None for a in known):
            return np.zeros((len(self.segments), 3, 0)), np.zeros((len(self.turns), 3, 0))
        by_geometry = self._geometry_errors(self.table)
        if not self.attitude_steps:
            return by_geometry
        by_steps = step_errors(self.attitude_steps, self.segments, self.turns, self.table)
        both = zip(by_geometry, by_steps, strict=True)
        at_rest, turning = (np.concatenate(pair, axis=2) for pair in both)
        return at_rest, turning

    def _geometry_errors(self, table: Table) -> tuple[Floats, Floats]:
        if table.errors.exact:
            return np.zeros((len(self.segments), 3, 0)), np.zeros((len(self.turns), 3, 0))
        angles = np.array([part.angles for part in self.parts]).reshape(-1, len(table.joints))
        dwells = len(self.segments)
        turned = [
            held[None] if turn.joint is None else around(held, turn.joint)
            for turn, held in zip(self.turns, angles[dwells:], strict=True)
        ]
        # All at once: a call takes longer than the computation for one turn.
        errors = table.attitude_errors(np.concatenate([angles[:dwells], *turned]))
        ends = dwells + np.cumsum([len(one) for one in turned], dtype=int)
        turning = [
            errors[end - len(one) : end].mean(axis=0)
            for one, end in zip(turned, ends.tolist(), strict=True)
        ]
        return errors[:dwells], np.array(turning).reshape(len(self.turns), *errors.shape[1:])

    @cached_property
    def positioning_attitude_errors(self) -> tuple[AttitudeErrors, AttitudeErrors]:
        """Attitude errors by positioning errors of joints, and by each stop separately.

        In the hand both are the same.
        """
        if self.plan.by_hand:
            held = hold_errors(self.segments, self.turns)
            return held, held
        return (
            joint_errors(self.segments, self.turns, self.table, self.restarts),
            stop_errors(self.segments, self.turns),
        )

    @property
    def restarts(self) -> list[tuple[int, int]]:
        """Interruptions in which the stand may have been started anew."""
        return [(last, begins) for last, begins in self.interruptions if begins - last > OUTAGE]

    @property
    def levelling(self) -> float:
        """Standard deviation of the table's tilt about either level axis, rad."""
        return LEVELLED if self.table is None else self.table.level

    @property
    def encoder_step(self) -> float:
        """The step of the encoders that at least half of the turns show, rad; else 0.

        A ramp of round numbers, read at equal intervals, looks coarse by chance.
        """
        steps = sorted(turn.step for turn in self.turns)
        return steps[(len(steps) - 1) // 2] if steps else 0.0

    def scaled(self, factors: Floats) -> Evidence:
        """Return the session with outputs, and their noise, multiplied by (6,) factors."""
        segments = (replace(s, statistics=s.statistics.scaled(factors)) for s in self.segments)
        turns = (replace(t, statistics=t.statistics.scaled(factors)) for t in self.turns)
        moves = (m.scaled(factors) for m in self.moves)
        walk, own = self.walk * factors, self.sensor_walk
        own = None if own is None else own * factors
        changed = replace(self, segments=tuple(segments), turns=tuple(turns), moves=tuple(moves))
        return replace(changed, walk=walk, sensor_walk=own)

    @property
    def walk_of_moves(self) -> Floats:
        """The random-walk coefficients of moves, (6,)."""
        return self.walk if self.sensor_walk is None else np.fmin(self.walk, self.sensor_walk)

    def with_attitudes(self, attitudes: Floats) -> Evidence:
        """Return the session in other attitudes, (s, 3, 3) R_nb."""
        pairs = zip(self.segments, attitudes, strict=True)
        return replace(self, segments=tuple(replace(s, attitude=a) for s, a in pairs))

    def outputs(self) -> Floats:
        """Return the mean outputs at rest, (s, 6)."""
        return np.array([s.statistics.mean for s in self.segments]).reshape(-1, 6)

    def variances(self) -> Floats:
        """Return the variances of the mean outputs at rest, (s, 6): not below those of rounding."""
        rows = [s.variance(self.walk, self.site.gravity) for s in self.segments]
        return np.maximum(np.array(rows).reshape(-1, 6), SMALLEST_VARIANCE)

    def precision_weights(self) -> Floats:
        """Return the weight of every static dwell in the mean of its position, (s, 6).

        A position measured several times is averaged first, each time by its variance.
        """
        precision = 1 / self.variances()
        names = [s.position for s in self.segments]
        total = np.array(
            [precision[[other == name for other in names]].sum(axis=0) for name in names]
        ).reshape(-1, 6)
        return np.asarray(precision / total)

    def vertical_axes(self) -> list[tuple[int, int]]:
        """Return for every static dwell which body axis is vertical, and +1 up or -1 down."""
        pairs = zip(self.dwell_attitudes, self.segments, strict=True)
        return [vertical_axis(attitude[2], s.position) for attitude, s in pairs]

    def off_axis(self) -> Floats:
        """Return the deviation of up, by encoders, from the vertical body axis, (s, 3)."""
        exact = [sign * np.eye(3)[axis] for axis, sign in self.vertical_axes()]
        return np.asarray(self.dwell_attitudes[:, 2] - np.array(exact).reshape(-1, 3))

    def clock_rate(self) -> tuple[float, float]:
        """Return the relative rate of the IMU's clock against the table's, and its deviation.

        The estimate from the motions is combined with the tolerance of two quartz clocks. Where
        they are not compared and no turn was timed by a table, seconds are those of the stamps.
        """
        if not self.clocks_compared:
            timed = any(turn.seconds is not None for turn in self.turns)
            return 0.0, _QUARTZ if timed else 0.0
        share = _QUARTZ**2 / (_QUARTZ**2 + self.clock.rate_std**2)
        return share * self.clock.rate, float(np.sqrt(share)) * self.clock.rate_std

    @property
    def clocks_compared(self) -> bool:
        """Whether motions of a table determine the rate of the clock of the stamps."""
        return bool(np.isfinite(self.clock.rate_std))

    @property
    def turns_clock_std(self) -> float:
        """Standard deviation of the clocks' rate, where it affects responses to turns.

        Pulses are counted over seconds of one clock and turns timed by the other; counts and SI
        values are already rates.
        """
        return self.clock_rate()[1] if self.units.per_interval else 0.0

    @property
    def clock_freedom(self) -> float:
        """Degrees of freedom of the deviation of `clock_rate`; infinite if from quartz alone."""
        if not self.clocks_compared:
            return np.inf
        # A rate, and an offset for each piece between jumps.
        return max(1.0, float(self.clock.motions - 2 - len(self.clock.jumps)))

    def missing_positions(self) -> list[str]:
        """Return the names of the plan's positions without a usable segment."""
        found = {s.position for s in self.segments}
        return [p.id for p in self.plan.positions if p.dwell > 0 and p.id not in found]

    def missing_words(self) -> str:
        """Return `missing_positions` as the end of a clause; empty where none is missing."""
        missing = self.missing_positions()
        return f' (missing: {", ".join(missing)})' if missing else ''

    def positions_in_words(self) -> str:
        """Return how many positions were found, and which are missing, as part of a sentence."""
        return f'{len({s.position for s in self.segments})} positions{self.missing_words()}'


def vertical_axis(up: Floats, position: str | None) -> tuple[int, int]:
    """Return which body axis is vertical, and +1 up or -1 down."""
    axis = int(np.argmax(np.abs(up)))
    if abs(up[axis]) < 1 - _AXIS_TOLERANCE:
        raise NotObservable(
            f'Position {position}: no axis is vertical (up is {np.round(up, 2)} in X, Y, Z); '
            'this method needs one of X, Y, Z up or down.'
        )
    return axis, int(np.sign(up[axis]))


def thermal_of(imu: ImuSpec) -> Floats:
    """Return scale factor and bias per K of gyros and of accelerometers by the data sheet, (2, 2).

    Standard deviations, 1/K and SI/K; 0 where not stated.
    """
    return np.array(
        [[t.scale_factor_temperature, t.bias_temperature] for t in (imu.gyro, imu.accel)]
    )


# The clock of the stamps is fast by r against the table's. Pulses over its seconds are 1 / (1 + r)
# of those over the table's; counts and SI values are unchanged, and angles summed over its seconds
# are (1 + r) times too large. The remaining error of the rate is an unknown of the equations
# (`Nuisance.CLOCK`), and the ratio is stored with the calibration (`clock`).
# Source: docs/mathematics.md, 'Clocks'.


def in_table_time(evidence: Evidence) -> Evidence:
    """Return a session whose seconds are the table's, as far as motions compare the clocks.

    Standard deviations are unchanged: they would change by parts in a million.
    """
    rate, clock = evidence.clock_rate()[0], evidence.clock
    if not rate and clock.bend is None:
        return evidence

    def factors(part: Segment | Turn | Move) -> tuple[float, float, float]:
        """Return by how much the clock is faster, and factors on rates and on increments."""
        faster = 1 + rate + clock.rate_over(part.start, part.end)
        # Pulses are sums, divided by seconds to give rates; counts and SI values are rates.
        of_increments = evidence.units.per_interval
        return (faster, faster, 1.0) if of_increments else (faster, 1.0, 1 / faster)

    def retimed_turn(turn: Turn) -> Turn:
        faster, on_rates, _ = factors(turn)
        return replace(
            turn,
            statistics=_retimed_statistics(turn.statistics, faster, on_rates),
            skewed=turn.skewed and _retimed_statistics(turn.skewed, faster, on_rates),
            each=None if turn.each is None else turn.each * on_rates,
        )

    return replace(
        evidence,
        segments=tuple(
            replace(s, statistics=_retimed_statistics(s.statistics, *factors(s)[:2]))
            for s in evidence.segments
        ),
        turns=tuple(map(retimed_turn, evidence.turns)),
        moves=tuple(_retimed_move(m, *factors(m)[::2]) for m in evidence.moves),
        clock=replace(clock, rate=0.0, bend=None),
    )


def _retimed_statistics(statistics: Statistics, faster: float, on_rates: float) -> Statistics:
    """Return statistics by a clock that is slower by a factor, with a factor on their outputs."""
    return replace(
        statistics,
        duration=statistics.duration / faster,
        mean=statistics.mean * on_rates,
        end_points=statistics.end_points * on_rates,
        blocks=tuple(b * np.array([on_rates, 1.0, 1.0, 1 / faster]) for b in statistics.blocks),
        drift=statistics.drift * on_rates * faster,
    )


def _retimed_move(move: Move, faster: float, on_increments: float) -> Move:
    """Return a move by a clock that is slower by a factor, with a factor on its increments."""
    gained = move.velocity_steps
    if gained is not None:
        gained = replace(
            gained, velocity=gained.velocity * on_increments, mean=gained.mean * on_increments
        )
    turned, seconds = move.turned * on_increments, move.seconds / faster
    return replace(move, turned=turned, seconds=seconds, velocity_steps=gained)
