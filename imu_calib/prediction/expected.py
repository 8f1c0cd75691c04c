"""The evidence that a session of a plan would give, before it is run.

What the sensors would read follows from the model; how well their means would be known follows
from random walk, pulses and times alone (`readings`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ..calibrator import Setup
from ..courses import Course
from ..errors import InputError
from ..estimation.bias_drift import STATED_TIME, BiasDrift
from ..imu import ImuSpec, TriadSpec
from ..methods.free_positions import NAME as FREE_POSITIONS
from ..model import BIASES, SensorModel, Skewed
from ..model.motion import has_motion_terms
from ..observation.evidence import UP, Evidence
from ..observation.headings import headings, mean_over_turn
from ..observation.ideal_moves import (
    BY_HAND_MOVE,
    ideal_holds,
    ideal_move,
    ideal_move_by_hand,
    joint_course,
    nanoseconds,
)
from ..rotations import rotation
from ..segmentation.clock import ClockFit
from ..segmentation.moves import COARSEST
from ..segmentation.segment import Segment, Turn
from ..segmentation.segmented import Move
from ..segmentation.sensor import NEARLY
from ..stream import Floats, Mode
from ..turntable import TURN
from .readings import SPARE, each_turn, period_of, reading, skewed_alone, triads, walk_of
from .schedule import SETTLE, schedule

_UNSEEN = 0.5
"""What the segmentation leaves at the two ends of a rest: a window of the joint states each, s."""

_BY_HAND_TURN = 2.0
"""s for a whole turn by hand."""
_BY_HAND_STILL = 2.0
"""Before and after a turn by hand, s: what divides it from the moves around it."""

_BY_HAND_LEVEL = 0.25
"""What such a turn leaves of a level rate where it rises and falls for a third of a second each."""

_ANYHOW = Skewed(np.full((1, 3), 1 / math.sqrt(3)), np.zeros(1))
"""A skewed gyro whose direction is not stated: between all three."""


@dataclass(frozen=True, eq=False)
class _Dwell:
    """The table stands at one attitude, from `start` to `end` (s since the first step).

    `course` leads there from the rest before, where nothing is turned in between.
    """

    position: str
    attitude: Floats
    start: float
    end: float
    angles: Floats | None = None
    course: Course | None = None


@dataclass(frozen=True, eq=False)
class _Turning:
    """Whole turns at a signed rate about up (rad/s), of which `seconds` are measured."""

    position: str
    up: Floats
    start: float
    seconds: float
    rate: float
    angles: Floats | None = None
    joint: int | None = None


def expected(setup: Setup, truth: SensorModel, azimuth: float | None = None) -> Evidence:
    """Return what a session would give whose outputs hit their expectation.

    Args:
        setup: Plan, table, IMU and site.
        truth: What the sensors are thought to be: how fast its counters run depends on it.
        azimuth: True heading of the table's zero, rad; None for what the table says, or north.

    Raises:
        InputError: The table cannot run the plan, or the IMU states no noise.

    """
    walk = walk_of(setup.imu)
    if not (walk > 0).all():
        raise InputError(
            f'The IMU {setup.imu.id} states no angle_random_walk or no velocity_random_walk: '
            'there is nothing to predict from.'
        )
    dwells, turnings = _course(setup)
    stated = setup.table.azimuth if setup.table is not None else None
    heading = (stated or 0.0) if azimuth is None else azimuth
    # The attitudes of a session are those of the table's own idea of north.
    world = rotation(UP, (stated or 0.0) - heading)
    earth, force = world @ setup.site.earth_rate, setup.site.specific_force
    segments = []
    for dwell in dwells:
        body = dwell.attitude.T
        mean = np.concatenate(truth.predict(body @ earth, body @ force))
        statistics = reading(setup.imu, mean, dwell.end - dwell.start)
        segments.append(
            Segment(
                nanoseconds(dwell.start),
                nanoseconds(dwell.end),
                statistics,
                dwell.attitude,
                dwell.position,
                dwell.angles,
            )
        )
    turns = []
    for turning in turnings:
        spin = turning.up * (turning.rate + setup.site.up_rate)
        turned = headings(turning.up[None])
        both = turned @ earth + turning.up * turning.rate, turned @ force
        mean = mean_over_turn(np.concatenate(truth.predict(*both), axis=-1))[0]
        spare = 0.0 if setup.plan.by_hand else SPARE
        statistics = reading(setup.imu, mean, turning.seconds, spare)
        askew = None
        if setup.imu.skewed is not None:
            lies = truth.skewed or _ANYHOW
            fourth = np.append(lies.predict(spin)[0], np.zeros(5))
            askew = reading(skewed_alone(setup.imu), fourth, turning.seconds, SPARE)
        turns.append(
            Turn(
                nanoseconds(turning.start),
                nanoseconds(turning.start + turning.seconds),
                statistics,
                turning.rate * turning.seconds,
                None if setup.plan.by_hand else turning.seconds,
                turning.up,
                turning.position,
                skewed=askew,
                each=each_turn(setup.imu, statistics, askew, turning.rate),
                level=_BY_HAND_LEVEL if setup.plan.by_hand else 0.0,
                angles=turning.angles,
                joint=turning.joint,
            )
        )
    free = setup.method_name == FREE_POSITIONS
    if free:
        segments = ideal_holds(segments)
        moves = [ideal_move_by_hand(a, b, truth, setup.site) for a, b in pairwise(segments)]
    else:
        moves = [
            move
            for before, after, dwell in zip(segments, segments[1:], dwells[1:], strict=False)
            if dwell.course is not None
            and setup.table is not None
            and _followed(
                move := ideal_move(before, after, dwell.course, setup.table, truth, (earth, force)),
                setup.imu,
            )
        ]
    # Joint states at 100 Hz tell the clocks apart far better than any parameter needs.
    clock = ClockFit(0.0, 0.0, 0.0, 0.0, 0.0, len(turns))
    positioning = setup.table.positioning if setup.table is not None else 0.0
    return Evidence(
        tuple(segments),
        tuple(turns),
        setup.plan,
        setup.site,
        clock,
        stated,
        walk,
        positioning,
        moves=tuple(moves),
        table=setup.table,
        free=free,
        coarse=has_motion_terms(setup.terms),
    )


def _course(setup: Setup) -> tuple[list[_Dwell], list[_Turning]]:
    """Say when the unit would stand and when it would turn."""
    if setup.plan.by_hand:
        return _by_hand(setup)
    table = setup.table
    if table is None:
        raise InputError(f'Plan {setup.plan.name} needs a table.')
    steps = setup.plan.steps(table)
    dwells: list[_Dwell] = []
    turnings: list[_Turning] = []
    standing = 0.0
    at: Floats | None = None
    for visit in schedule(steps, table, settle=SETTLE):
        if visit.rest > visit.begin:
            standing = visit.rest
        step = visit.step
        if step.mode is Mode.RATE:
            joint = next(k for k, rate in enumerate(step.rates) if rate)
            up = table.attitude(step.angles)[2]
            sense = math.copysign(1.0, float(table.joint_axis(joint, step.angles) @ up))
            rate = float(step.rates[joint])
            seconds = TURN * step.turns / abs(rate)
            start = (visit.begin + visit.rest - seconds) / 2
            turnings.append(
                _Turning(step.position, up, start, seconds, sense * rate, step.angles, joint)
            )
            at = None
        elif step.dwell:
            attitude = table.attitude(step.angles)
            span = (standing + _UNSEEN / 2, visit.end - _UNSEEN / 2)
            course = None
            if at is not None and not np.array_equal(at, visit.angles):
                course = joint_course(table, at, visit.angles)
            dwells.append(_Dwell(step.position, attitude, *span, visit.angles, course))
            at = visit.angles
        else:
            at = None
    return dwells, turnings


def _by_hand(setup: Setup) -> tuple[list[_Dwell], list[_Turning]]:
    dwells, turnings, now = [], [], 0.0
    for position in setup.plan.positions:
        if position.rate_test is not None:
            turns = position.rate_test.turns
            seconds = turns * _BY_HAND_TURN
            rate = TURN * turns / seconds
            now += _BY_HAND_STILL
            turnings.append(_Turning(position.id, position.up, now, seconds, rate))
            now += seconds + _BY_HAND_STILL
        if position.dwell:
            dwells.append(_Dwell(position.id, position.attitude, now, now + position.dwell))
        now += position.dwell + BY_HAND_MOVE
    return dwells, turnings


def _followed(move: Move, spec: ImuSpec) -> bool:
    """Say whether a session would lead a move on: see `segmentation.moves`."""
    fastest = float(np.abs(move.turned / move.seconds[:, None]).max())
    return fastest * period_of(spec) <= COARSEST and fastest < NEARLY * spec.gyro.range


def bias_drift_covariance(evidence: Evidence, spec: ImuSpec) -> Floats:
    """Return the covariance of the outputs by biases that drift, (m + u,) square.

    First-order Gauss-Markov processes whose standard deviations are the data sheet's bias
    instabilities, seen by the means of static dwells and turns and by what moves sum up; u is the
    number of turns that a skewed gyro saw.

    Args:
        evidence: Static dwells and turns in time.
        spec: Bias instabilities.

    """
    dwells, turns = evidence.segments, evidence.turns
    moves = [link.move for link in evidence.links.links]
    spans = [(s.start, s.end) for s in dwells]
    spans += [(t.start, t.end) for t in turns]
    spans += [(m.start, m.end) for m in moves]
    begin, end = (np.array(spans).reshape(-1, 2).T) * 1e-9
    none = np.zeros((len(spans), 3, 3)), np.zeros(len(spans), dtype=bool)
    means = BiasDrift.over(begin, end - begin, *none).of_one(STATED_TIME)
    askew = [len(dwells) + k for k, t in enumerate(turns) if t.skewed is not None]
    rows = evidence.layout
    channel = [*rows.channels.tolist(), *[6] * len(askew)]
    which = np.concatenate([rows.segment, np.array(askew, dtype=int)])
    figures = [t.bias_instability for t in (*triads(spec), spec.skewed or TriadSpec())]
    # What a move carries along as it turns; all else reads its own bias.
    answers = np.eye(7)[channel]
    led = evidence.links.by_parameters(SensorModel(), BIASES)
    answers[rows.move, :6] = led[:, :3]
    answers[rows.velocity, :6] = led[list(rows.moves_with_accels), 3:]
    by_bias = answers * figures
    return np.asarray(means[np.ix_(which, which)] * (by_bias @ by_bias.T))
