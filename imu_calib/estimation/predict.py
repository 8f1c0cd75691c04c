"""Compute the evidence that a session of a plan would give, before it is run.

The expected outputs follow from the model, the variances of their means from random walk, pulses
and durations alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import scipy

from ..common.errors import InputError
from ..common.rotations import across, cross, rotation, rotation_vectors, rotations
from ..common.stream import Floats, Mode, Units
from ..model.earth import Site
from ..model.parameters import BIASES
from ..model.sensors import SensorModel, Skewed, has_motion_terms
from ..segmentation.clock import ClockFit
from ..segmentation.counters import mean_rate, rate_between
from ..segmentation.course import Temperature
from ..segmentation.moves import COARSEST
from ..segmentation.segmented import Move, VelocitySteps
from ..segmentation.segments import Segment, Statistics, Turn
from ..session.imu import NEARLY, ImuSpec, TriadSpec
from ..session.plan import Step
from ..session.table import TURN, Course, Table, moving, travel_time
from .bias_drift import STATED_TIME, BiasDrift
from .evidence import UP, Evidence, thermal_of
from .hand import NAME as FREE_POSITIONS
from .known_noise import stated_walk
from .session_model import Nuisance, SessionModel
from .setup import Setup

# A noise-free counter at the expected rate is processed by the same estimators as a session
# (`segmentation.counters`).

SPARE = 1.0
"""Time before and after the measured turns in which a table surely keeps its rate, s. A choice."""

_SAMPLE_RATE = 100.0  #: Hz, if the IMU's file states none. A choice.
_PHASE = 0.5  #: Pulses: a counter starts at any phase, on average in the middle of a pulse.


def reading(spec: ImuSpec, mean: Floats, seconds: float, spare: float | None = None) -> Statistics:
    """Return the statistics of readings (rad/s, m/s^2) whose mean is (6,) `mean`.

    `spare` is the time on both sides of whole turns in which counts are also read; None at rest.
    """
    gain, quantisation = np.full(6, 1 / seconds), np.zeros(6)
    period = period_of(spec)
    steps = np.array([triad.scale_factor for triad in triads(spec)])
    for c, triad in enumerate(triads(spec)):
        if spec.units is Units.COUNTS:
            quantisation[c] = _rounded(triad, period)
        elif spec.units is Units.PULSES:
            walk = triad.random_walk / triad.scale_factor
            pulses = _pulses(triad, period, float(mean[c]), seconds + 2 * (spare or 0.0))
            first = (len(pulses) - seconds / period) / 2
            found = (
                mean_rate(pulses, period, walk)
                if spare is None
                else rate_between(pulses, period, first, len(pulses) - first, walk)
            ).scaled(triad.scale_factor)
            gain[c], quantisation[c] = found.walk_gain, found.quantisation_variance
    return replace(
        duration_alone(seconds),
        samples=round(seconds / period),
        mean=mean,
        walk_gain=gain,
        quantisation_variance=quantisation,
        end_points=mean,
        pulse=steps if spec.units is Units.PULSES else np.zeros(6),
    )


def duration_alone(seconds: float) -> Statistics:
    """Return statistics that hold the duration alone, s."""
    return Statistics(
        samples=0,
        missing=0,
        duration=seconds,
        mean=np.zeros(6),
        walk_gain=np.zeros(6),
        quantisation_variance=np.zeros(6),
        end_points=np.zeros(6),
        blocks=tuple(np.empty((0, 4)) for _ in range(6)),
        drift=np.full(6, np.nan),
    )


def skewed_alone(spec: ImuSpec) -> ImuSpec:
    """Return an IMU whose first gyro is the skewed one."""
    assert spec.skewed is not None
    return replace(spec, gyro=spec.skewed, skewed=None)


def each_turn(
    spec: ImuSpec, whole: Statistics, askew: Statistics | None, rate: float
) -> Floats | None:
    """Return means of single turns that scatter exactly by the expected noise."""
    count = max(1, round(abs(rate) * whole.duration / TURN))
    if count < 2:
        return None
    seconds = whole.duration / count
    single = reading(spec, whole.mean, seconds, SPARE)
    mean, square = whole.mean[:3], single.variance(stated_walk(spec))[:3]
    if askew is not None:
        alone = skewed_alone(spec)
        single = reading(alone, askew.mean, seconds, SPARE)
        mean = np.append(mean, askew.mean[0])
        square = np.append(square, single.variance(stated_walk(alone))[0])
    ramp = np.arange(count) - (count - 1) / 2
    return np.asarray(mean + np.outer(ramp / ramp.std(ddof=1), np.sqrt(square)))


def _pulses(triad: TriadSpec, period: float, mean: float, seconds: float) -> Floats:
    """Return the pulses of a noise-free counter at a rate (rad/s or m/s^2)."""
    edges = np.arange(max(2, math.ceil(seconds / period)) + 1)
    return np.diff(np.floor(edges * (mean * period / triad.scale_factor) + _PHASE))


def _rounded(triad: TriadSpec, period: float) -> float:
    """Return the variance of an ADC's rounding: Widrow and Kollar 2008, section 4.4."""
    step = triad.scale_factor
    noise = triad.random_walk**2 / period / step**2
    return step**2 / 12 * math.exp(-4 * math.pi**2 * noise)


def triads(spec: ImuSpec) -> list[TriadSpec]:
    """Return the description of each of the six channels."""
    return [spec.gyro] * 3 + [spec.accel] * 3


def period_of(spec: ImuSpec) -> float:
    """Return the sample interval, s; that of 100 Hz if none is stated."""
    return 1 / (spec.sample_rate or _SAMPLE_RATE)


SETTLE = 1.0  #: s from arrival to the start of a dwell, as stand and sequencer wait.


@dataclass(frozen=True, eq=False)
class Visit:
    """Times of a step."""

    step: Step  #: The step.
    begin: float  #: Start of the motion, s since the first step.
    rest: float  #: Arrival at rest, s.
    end: float  #: Start of the next step, s.
    angles: Floats  #: (k,) joint angles at rest, rad.


def schedule(steps: Sequence[Step], table: Table) -> tuple[Visit, ...]:
    """Compute the times of steps by the limits of a table, which stands at the first.

    Raises:
        InputError: A joint has no limit of rate or acceleration: its motions have no known
            duration.
    """
    table.check_limited('the time that a plan takes needs')
    visits: list[Visit] = []
    now, angles = 0.0, steps[0].angles
    for step in steps:
        moving = [
            travel_time(float(goal - origin), joint.max_rate, joint.max_acceleration)
            for goal, origin, joint in zip(step.angles, angles, table.joints, strict=True)
        ]
        rest, angles = now + max(moving), step.angles.copy()
        if step.mode is Mode.RATE:
            k = next(k for k, rate in enumerate(step.rates) if rate)
            rate, travel = float(step.rates[k]), TURN * (step.turns + 1)
            rest += travel_time(travel, abs(rate), table.joints[k].max_acceleration)
            angles[k] += math.copysign(travel, rate)
        end = rest + SETTLE + step.dwell
        visits.append(Visit(step, now, rest, end, angles))
        now = end
    return tuple(visits)


def duration(steps: Sequence[Step], table: Table) -> float:
    """Return the duration of a plan, s: moves, run-ups, settling, turns and dwells."""
    return schedule(steps, table)[-1].end


BY_HAND_MOVE = 2.0
"""Duration of a move from one dwell to the next, s. A choice: that of simulated hands
(`simulation.hand`)."""

_STEP = 0.01  #: Length of the steps of a move, s: no step turns by more than a degree at 100 deg/s.

_SHORT_STEPS = 40  #: Steps of a turn by hand: at most 4.5 degrees each.

_PARALLEL = 1e-6
"""Sine of the angle between two directions below which they define no axis: rounding of 1e-16 turns
the axis of so short a product by 1e-10."""


def joint_course(table: Table, origin: Floats, goal: Floats) -> Course:
    """Return the course of the joints at the table's limits."""
    limits = [(joint.max_rate, joint.max_acceleration) for joint in table.joints]
    rates, accelerations = zip(*limits, strict=True)
    return moving(origin.tolist(), goal.tolist(), rates, accelerations)


def ideal_move(
    before: Segment,
    after: Segment,
    course: Course,
    table: Table,
    truth: SensorModel,
    world: tuple[Floats, Floats],
) -> Move:
    """Return the ideal sensor outputs on the way from one dwell to the next.

    `world` is the Earth rate and the specific force in the frame of the attitudes, (3,) each.
    """
    seconds = (after.start - before.end) * 1e-9
    knots = np.linspace(0.0, course.end, max(2, math.ceil(course.end / _STEP)) + 1)
    attitudes = table.attitude(course.at(knots)[0])
    # The attitude of the table at both ends, before and after.
    stood = (seconds - course.end) / 2
    attitudes = np.concatenate([attitudes[:1], attitudes, attitudes[-1:]])
    spans = np.array([stood, *np.diff(knots), stood])
    turned, velocity = _along(attitudes, spans, truth, world)
    pulse = before.statistics.pulse
    gained = VelocitySteps(velocity, np.zeros_like(velocity), pulse[3:], predicted=True)
    return Move(before.end, after.start, turned, spans, pulse[:3], velocity_steps=gained)


def _along(
    attitudes: Floats, spans: Floats, truth: SensorModel, world: tuple[Floats, Floats]
) -> tuple[Floats, Floats]:
    """Return the ideal angles and velocities (n, 3) through (n + 1, 3, 3) attitudes.

    They are (n,) seconds apart.
    """
    earth, force = world
    steps = rotation_vectors(np.swapaxes(attitudes[:-1], 1, 2) @ attitudes[1:])
    middles = (attitudes[:-1] + attitudes[1:]) / 2
    rates = steps / spans[:, None] + np.einsum('i,nij->nj', earth, middles)
    gyro, accel = truth.predict(rates, np.einsum('i,nij->nj', force, middles))
    return gyro * spans[:, None], accel * spans[:, None]


def ideal_holds(segments: list[Segment]) -> list[Segment]:
    """Return holds with the same ups, each reached from the last by the shortest rotation."""
    found = segments[:1]
    for segment in segments[1:]:
        assert segment.attitude is not None
        shown = shortest(found[-1], segment.attitude[2])
        found.append(replace(segment, attitude=shown))
    return found


def next_hold(last: Segment, up: Floats, seconds: float) -> Segment:
    """Return a hold of so many seconds after another, reached by the shortest rotation."""
    start = last.end + nanoseconds(BY_HAND_MOVE)
    statistics = replace(last.statistics, duration=seconds, walk_gain=np.full(6, 1 / seconds))
    return replace(
        last,
        start=start,
        end=start + nanoseconds(seconds),
        statistics=statistics,
        attitude=shortest(last, up),
    )


def shortest(last: Segment, up: Floats) -> Floats:
    """Return the attitude (3, 3) with (3,) `up` up, by the shortest rotation."""
    assert last.attitude is not None
    rising = last.attitude[2]
    axis = cross(up, rising)
    sine, cosine = float(np.linalg.norm(axis)), float(up @ rising)
    if sine < _PARALLEL:
        # Half a turn may go about any level axis; rounding must not choose it.
        axis = across(np.round(rising, 9))[0]
    turn = rotation(axis / np.linalg.norm(axis), math.atan2(sine, cosine))
    return np.asarray(last.attitude @ turn)


def ideal_move_by_hand(before: Segment, after: Segment, truth: SensorModel, site: Site) -> Move:
    """Return the ideal gyro outputs of the shortest rotation between holds, at constant rate."""
    assert before.attitude is not None
    assert after.attitude is not None
    ends = np.array([before.attitude, after.attitude])
    turn = rotation_vectors(ends[0].T @ ends[1])
    parts = np.linspace(0.0, 1.0, _SHORT_STEPS + 1)[:, None] * turn
    attitudes = ends[0] @ rotations(parts)
    spans = np.full(_SHORT_STEPS, (after.start - before.end) * 1e-9 / _SHORT_STEPS)
    world = site.up_rate * UP, site.specific_force
    turned, _ = _along(attitudes, spans, truth, world)
    return Move(before.end, after.start, turned, spans, before.statistics.pulse[:3])


def nanoseconds(seconds: float) -> int:
    """Return seconds at the resolution of stamps."""
    return round(seconds * 1e9)


_UNSEEN = 0.5
"""s not used at each end of a dwell by the segmentation: a window of the joint states."""

_BY_HAND_TURN = 2.0
"""s for a whole turn by hand. A choice: that of simulated hands (`simulation.hand`)."""
_BY_HAND_STILL = 2.0
"""s at rest before and after a turn by hand, which separate it from the moves around it. A choice,
likewise."""

_BY_HAND_LEVEL_SHARE = 0.25
"""Share of a level rate that such a turn does not average out: its rate rises and falls for a third
of a second each."""

_WARMTH = 20.0  #: Mean temperature of a session, degrees Celsius: only differences from it matter.

_ANYHOW = Skewed(np.full((1, 3), 1 / math.sqrt(3)), np.zeros(1))
"""Direction assumed where that of a skewed gyro is not stated: the space diagonal."""


@dataclass(frozen=True, eq=False)
class _Times:
    """Times of dwells and turns, without readings."""

    dwells: list[Segment]  #: Static dwells.
    turns: list[Turn]  #: Whole turns, with the time measured.
    #: For each dwell, the motion from the dwell before it; None if there is a turn between.
    courses: list[Course | None]


def expected(
    setup: Setup, truth: SensorModel, azimuth: float | None = None, *, rise: float = 0.0
) -> Evidence:
    """Return the evidence of a session whose outputs equal their expectation.

    Args:
        setup: Plan, table, IMU and site.
        truth: Assumed sensors: the rate of the counters depends on them.
        azimuth: True heading of the table's zero, rad; None for the table's own, or north.
        rise: Linear rise of the temperature over the session, K; 0 without a thermometer.

    Raises:
        InputError: The table cannot run the plan, or the IMU states no noise.
    """
    walk = stated_walk(setup.imu)
    if not (walk > 0).all():
        raise InputError(
            f'The IMU {setup.imu.id} states no angle_random_walk or no velocity_random_walk: '
            'there is nothing to predict from.'
        )
    times = _by_hand(setup) if setup.plan.by_hand else _by_table(setup)
    stated = setup.table.azimuth if setup.table is not None else None
    # Joint states at 100 Hz determine the clock ratio far better than any parameter requires.
    bare = Evidence(
        tuple(times.dwells),
        tuple(times.turns),
        setup.plan,
        setup.site,
        ClockFit(0.0, 0.0, 0.0, 0.0, 0.0, len(times.turns)),
        stated,
        walk,
        setup.table.positioning if setup.table is not None else 0.0,
        table=setup.table,
        temperature=_rising(times, rise) if rise else None,
        thermal=thermal_of(setup.imu),
        free=setup.method_name == FREE_POSITIONS,
        coarse=has_motion_terms(setup.terms),
    )
    session = SessionModel(bare, truth.parameters)
    state = session.nominal()
    state[: session.sensors] = truth.values(truth.parameters)
    # The attitudes of a session refer to the table's own estimate of north.
    heading = 0.0 if azimuth is None else azimuth - (stated or 0.0)
    state[session.sensors + Nuisance.AZIMUTH] = heading
    at_rest, turned = session.predicted_by_segment(state)
    segments = [
        replace(dwell, statistics=reading(setup.imu, mean, dwell.statistics.duration))
        for dwell, mean in zip(times.dwells, at_rest, strict=True)
    ]
    turns = [
        _with_readings(turn, mean, setup, truth)
        for turn, mean in zip(times.turns, turned, strict=True)
    ]
    if bare.free:
        segments = ideal_holds(segments)
        moves = [ideal_move_by_hand(a, b, truth, setup.site) for a, b in pairwise(segments)]
    else:
        around = session.surroundings(state)
        world = around.rate, around.force
        moves = [
            ideal_move(before, after, course, setup.table, truth, world)
            for (before, after), course in zip(pairwise(segments), times.courses[1:], strict=True)
            if course is not None and setup.table is not None
        ]
        moves = [move for move in moves if _followed(move, setup.imu)]
    return replace(bare, segments=tuple(segments), turns=tuple(turns), moves=tuple(moves))


def _rising(times: _Times, rise: float) -> Temperature:
    """Return a temperature that rises linearly, K, over the dwells and turns."""
    parts: list[Segment | Turn] = [*times.dwells, *times.turns]
    ends = [min(part.start for part in parts), max(part.end for part in parts)]
    lowest, highest = _WARMTH - abs(rise) / 2, _WARMTH + abs(rise) / 2
    course = np.column_stack([ends, [_WARMTH - rise / 2, _WARMTH + rise / 2]])
    return Temperature(_WARMTH, lowest, highest, course)


def _with_readings(turn: Turn, mean: Floats, setup: Setup, truth: SensorModel) -> Turn:
    """Return a turn with the readings of the six channels, and of a skewed gyro if there is one."""
    seconds, spare = turn.statistics.duration, 0.0 if setup.plan.by_hand else SPARE
    statistics, askew = reading(setup.imu, mean, seconds, spare), None
    if setup.imu.skewed is not None:
        lies = truth.skewed or _ANYHOW
        seen = lies.predict(turn.up * (turn.rate() + setup.site.up_rate))
        fourth = np.append(seen[0], np.zeros(5))
        askew = reading(skewed_alone(setup.imu), fourth, seconds, SPARE)
    each = each_turn(setup.imu, statistics, askew, turn.rate())
    return replace(turn, statistics=statistics, skewed=askew, each=each)


def _interval(start: float, seconds: float) -> tuple[int, int, Statistics]:
    """Return the stamps and the duration without readings, from s since the first step."""
    return nanoseconds(start), nanoseconds(start + seconds), duration_alone(seconds)


def _by_table(setup: Setup) -> _Times:
    table, times = setup.table, _Times([], [], [])
    if table is None:
        raise InputError(f'Plan {setup.plan.name} needs a table.')
    standing = 0.0
    at: Floats | None = None
    for visit in schedule(setup.plan.steps(table), table):
        if visit.rest > visit.begin:
            standing = visit.rest
        step = visit.step
        attitude = table.attitude(step.angles)
        if step.mode is Mode.RATE:
            joint = next(k for k, rate in enumerate(step.rates) if rate)
            up = attitude[2]
            sense = math.copysign(1.0, float(table.joint_axis(joint, step.angles) @ up))
            seconds = TURN * step.turns / abs(float(step.rates[joint]))
            angle = math.copysign(TURN * step.turns, sense * step.rates[joint])
            interval = _interval((visit.begin + visit.rest - seconds) / 2, seconds)
            times.turns.append(
                Turn(*interval, angle, seconds, up, step.position, angles=step.angles, joint=joint)
            )
            at = None
        elif step.dwell:
            begin = standing + _UNSEEN / 2
            interval = _interval(begin, visit.end - _UNSEEN / 2 - begin)
            moved = None if at is None or np.array_equal(at, visit.angles) else at
            times.courses.append(
                None if moved is None else joint_course(table, moved, visit.angles)
            )
            times.dwells.append(Segment(*interval, attitude, step.position, visit.angles))
            at = visit.angles
        else:
            at = None
    return times


def _by_hand(setup: Setup) -> _Times:
    times, now = _Times([], [], []), 0.0
    for position in setup.plan.positions:
        if position.rate_test is not None:
            angle = TURN * position.rate_test.turns
            seconds = position.rate_test.turns * _BY_HAND_TURN
            now += _BY_HAND_STILL
            interval = _interval(now, seconds)
            times.turns.append(
                Turn(
                    *interval,
                    angle,
                    None,
                    position.up,
                    position.id,
                    level_share=_BY_HAND_LEVEL_SHARE,
                )
            )
            now += seconds + _BY_HAND_STILL
        if position.dwell:
            interval = _interval(now, position.dwell)
            times.dwells.append(Segment(*interval, position.attitude, position.id))
            times.courses.append(None)
        now += position.dwell + BY_HAND_MOVE
    return times


def _followed(move: Move, spec: ImuSpec) -> bool:
    """Return whether a session would integrate a move: see `segmentation.moves`."""
    fastest = float(np.abs(move.turned / move.seconds[:, None]).max())
    return fastest * period_of(spec) <= COARSEST and fastest < NEARLY * spec.gyro.range


def bias_drift_covariance(evidence: Evidence, spec: ImuSpec) -> Floats:
    """Return the covariance of the outputs from bias drift, (m + u,) square.

    Biases are first-order Gauss-Markov processes with the bias instabilities of the data sheet as
    standard deviations. They enter the means of static dwells and turns and the integrals over
    moves; u is the number of turns with readings of a skewed gyro.
    """
    dwells, turns = evidence.segments, evidence.turns
    parts = [*evidence.parts, *(link.move for link in evidence.used_moves.linked)]
    begin, end = np.array([(p.start, p.end) for p in parts]).reshape(-1, 2).T * 1e-9
    none = np.zeros((len(parts), 3, 3)), np.zeros(len(parts), dtype=bool)
    means = BiasDrift.over(begin, end - begin, *none).one_channel(STATED_TIME)
    askew = [len(dwells) + k for k, t in enumerate(turns) if t.skewed is not None]
    which = np.concatenate([evidence.layout.segment, np.array(askew, dtype=int)])
    figures = [t.bias_instability for t in (*triads(spec), spec.skewed or TriadSpec())]
    session = SessionModel(evidence)
    # A move rotates the axes of its biases; all other outputs contain their own bias.
    answers = session.parameter_derivatives(session.nominal(), BIASES)
    by_bias = scipy.linalg.block_diag(answers, np.ones((len(askew), 1))) * figures
    return np.asarray(means[np.ix_(which, which)] * (by_bias @ by_bias.T))
