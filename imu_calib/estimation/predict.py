"""Compute the evidence that a session of a plan would give, before it is run.

The expected outputs follow from the model, the variances of their means from random walk, pulses
and durations alone (`readings`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import scipy

from ..common.errors import InputError
from ..common.stream import Floats, Mode
from ..model.parameters import BIASES
from ..model.sensors import SensorModel, Skewed, has_motion_terms
from ..segmentation.clock import ClockFit
from ..segmentation.moves import COARSEST
from ..segmentation.segments import Segment, Statistics, Turn
from ..segmentation.stream_facts import Move, Temperature
from ..session.imu import NEARLY, ImuSpec, TriadSpec
from ..session.table import TURN, Course
from .estimation_bias_drift import STATED_TIME, BiasDrift
from .evidence import Evidence, thermal_of
from .hand import NAME as FREE_POSITIONS
from .ideal_moves import (
    BY_HAND_MOVE,
    ideal_holds,
    ideal_move,
    ideal_move_by_hand,
    joint_course,
    nanoseconds,
)
from .readings import (
    SPARE,
    duration_alone,
    each_turn,
    period_of,
    reading,
    skewed_alone,
    triads,
    walk_of,
)
from .schedule import SETTLE, schedule
from .session_model import Nuisance, SessionModel
from .setup import Setup

_UNSEEN = 0.5
"""s not used at each end of a dwell by the segmentation: a window of the joint states."""

_BY_HAND_TURN = 2.0
"""s for a whole turn by hand. A choice: that of simulated hands (`simulation/hand`)."""
_BY_HAND_STILL = 2.0
"""s at rest before and after a turn by hand, which separate it from the moves around it. A choice,
likewise."""

_BY_HAND_LEVEL_SHARE = 0.25
"""Share of a level rate that such a turn does not average out: its rate rises and falls for a third
of a second each."""

_WARMTH = 20.0
"""Mean temperature of a session, degrees Celsius: only differences from it matter."""

_ANYHOW = Skewed(np.full((1, 3), 1 / math.sqrt(3)), np.zeros(1))
"""Direction assumed where that of a skewed gyro is not stated: the space diagonal."""


@dataclass(frozen=True, eq=False)
class _Times:
    """Times of dwells and turns, without readings.

    Attributes:
        dwells: Static dwells.
        turns: Whole turns, with the time measured.
        courses: For each dwell, the motion from the dwell before it; None if there is a turn
            between.
    """

    dwells: list[Segment]
    turns: list[Turn]
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
    walk = walk_of(setup.imu)
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
    for visit in schedule(setup.plan.steps(table), table, settle=SETTLE):
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

    Args:
        evidence: Static dwells and turns in time.
        spec: Bias instabilities.
    """
    dwells, turns = evidence.segments, evidence.turns
    moves = [link.move for link in evidence.used_moves.linked]
    parts: list[Segment | Turn | Move] = [*dwells, *turns, *moves]
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
