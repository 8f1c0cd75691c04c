"""The evidence that a session of a plan would give, before it is run.

What the sensors would read follows from the model; how well their means would be known follows
from random walk, pulses and times alone. A counter without noise, run at the rate that it would
see, goes through the very estimators that a session goes through (`segmentation.counter`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import scipy

from ..calibrator import Setup
from ..directions import across
from ..earth import Site
from ..errors import InputError
from ..estimation.wandering import STATED_TIME, Wandering
from ..imu import ImuSpec, TriadSpec
from ..methods.free import NAME as FREE_POSITIONS
from ..model import BIASES, SensorModel, Skewed
from ..observation.evidence import Evidence
from ..observation.headings import headings, whole
from ..profile import Course, moving
from ..segmentation.clock import ClockFit
from ..segmentation.counter import mean_rate, rate_between
from ..segmentation.moves import COARSEST
from ..segmentation.segment import Segment, Statistics, Turn
from ..segmentation.sensor import NEARLY
from ..segmentation.session import Move
from ..stream import Floats, Mode, Units
from ..turntable import TURN, Table, rotation
from .schedule import SETTLE, schedule

_SAMPLE_RATE = 100.0
_UNSEEN = 0.5
"""What the segmentation leaves at the two ends of a rest: a window of the joint states each, s."""

_SPARE = 1.0
"""How long a table surely keeps its rate before and after the turns that are measured, s."""

_BY_HAND_TURN = 2.0
BY_HAND_MOVE = 2.0
"""From one rest to the next, s."""

_BY_HAND_STILL = 2.0
"""Before and after a turn by hand, s: what divides it from the moves around it."""

_BY_HAND_LEVEL = 0.25
"""What such a turn leaves of a level rate where it rises and falls for a third of a second each."""

_STEP = 0.01
"""Into which a move is cut, s: no step turns by more than a degree at 100 deg/s."""

_SHORT_STEPS = 40
"""Into which a turn by hand is cut: at most 4.5 degrees each."""

_PARALLEL = 1e-6
_UP = np.array([0.0, 0.0, 1.0])
_PHASE = 0.5
_ANYHOW = Skewed(np.full((1, 3), 1 / math.sqrt(3)), np.zeros(1))
"""A skewed gyro of which nobody says how it lies: between all three."""


@dataclass(frozen=True, eq=False)
class _Rest:
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
    walk = _walk(setup.imu)
    if not (walk > 0).all():
        raise InputError(
            f'The IMU {setup.imu.id} states no angle_random_walk or no velocity_random_walk: '
            'there is nothing to predict from.'
        )
    rests, turnings = _course(setup)
    stated = setup.table.azimuth if setup.table is not None else None
    heading = (stated or 0.0) if azimuth is None else azimuth
    # The attitudes of a session are those of the table's own idea of north.
    world = rotation(_UP, (stated or 0.0) - heading)
    earth, force = world @ setup.site.earth_rate, setup.site.specific_force
    segments = []
    for rest in rests:
        body = rest.attitude.T
        mean = np.concatenate(truth.predict(body @ earth, body @ force))
        statistics = _read(setup.imu, mean, rest.end - rest.start)
        segments.append(
            Segment(
                _ns(rest.start),
                _ns(rest.end),
                statistics,
                rest.attitude,
                rest.position,
                rest.angles,
            )
        )
    turns = []
    for turning in turnings:
        spin = turning.up * (turning.rate + setup.site.up_rate)
        turned = headings(turning.up[None])
        both = turned @ earth + turning.up * turning.rate, turned @ force
        mean = whole(np.concatenate(truth.predict(*both), axis=-1))[0]
        spare = 0.0 if setup.plan.by_hand else _SPARE
        statistics = _read(setup.imu, mean, turning.seconds, spare)
        askew = None
        if setup.imu.skewed is not None:
            lies = truth.skewed or _ANYHOW
            fourth = np.append(lies.predict(spin)[0], np.zeros(5))
            askew = _read(skewed_alone(setup.imu), fourth, turning.seconds, _SPARE)
        turns.append(
            Turn(
                _ns(turning.start),
                _ns(turning.start + turning.seconds),
                statistics,
                turning.rate * turning.seconds,
                None if setup.plan.by_hand else turning.seconds,
                turning.up,
                turning.position,
                skewed=askew,
                each=_each(setup.imu, statistics, askew, turning),
                level=_BY_HAND_LEVEL if setup.plan.by_hand else 0.0,
                angles=turning.angles,
                joint=turning.joint,
            )
        )
    free = setup.method_name == FREE_POSITIONS
    if free:
        segments = _held(segments)
        moves = [short_move(a, b, truth, setup.site) for a, b in pairwise(segments)]
    else:
        moves = [
            move
            for before, after, rest in zip(segments, segments[1:], rests[1:], strict=False)
            if rest.course is not None
            and setup.table is not None
            and _followed(
                move := _move(before, after, rest.course, setup.table, truth, (earth, force)),
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
    )


def _course(setup: Setup) -> tuple[list[_Rest], list[_Turning]]:
    """Say when the unit would stand and when it would turn."""
    if setup.plan.by_hand:
        return _by_hand(setup)
    table = setup.table
    if table is None:
        raise InputError(f'Plan {setup.plan.name} needs a table.')
    steps = setup.plan.steps(table)
    rests: list[_Rest] = []
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
                course = _way(table, at, visit.angles)
            rests.append(_Rest(step.position, attitude, *span, visit.angles, course))
            at = visit.angles
        else:
            at = None
    return rests, turnings


def _way(table: Table, origin: Floats, goal: Floats) -> Course:
    """Return the course of the joints at the table's limits."""
    limits = [(joint.max_rate, joint.max_acceleration) for joint in table.joints]
    rates, accelerations = zip(*limits, strict=True)
    return moving(origin.tolist(), goal.tolist(), rates, accelerations)


def _move(
    before: Segment,
    after: Segment,
    course: Course,
    table: Table,
    truth: SensorModel,
    world: tuple[Floats, Floats],
) -> Move:
    """Return what the gyros would give on the way from one rest to the next.

    Args:
        before: The rest that it begins at.
        after: The rest that it ends at.
        course: Of the joints.
        table: Whose.
        truth: The sensors.
        world: (3,) Earth rate and (3,) specific force in the frame of the attitudes, SI.

    """
    seconds = (after.start - before.end) * 1e-9
    knots = np.linspace(0.0, course.end, max(2, math.ceil(course.end / _STEP)) + 1)
    attitudes = table.attitude(course.at(knots)[0])
    # What the table stands at both ends, before and after.
    stood = (seconds - course.end) / 2
    attitudes = np.concatenate([attitudes[:1], attitudes, attitudes[-1:]])
    return _along(before, after, attitudes, np.array([stood, *np.diff(knots), stood]), truth, world)


def _along(
    before: Segment,
    after: Segment,
    attitudes: Floats,
    spans: Floats,
    truth: SensorModel,
    world: tuple[Floats, Floats],
) -> Move:
    """Return what the gyros would give through (n + 1, 3, 3) attitudes, (n,) seconds apart."""
    earth, force = world
    steps = scipy.spatial.transform.Rotation.from_matrix(
        np.swapaxes(attitudes[:-1], 1, 2) @ attitudes[1:]
    ).as_rotvec()
    middles = (attitudes[:-1] + attitudes[1:]) / 2
    rates = steps / spans[:, None] + np.einsum('i,nij->nj', earth, middles)
    gyro, _ = truth.predict(rates, np.einsum('i,nij->nj', force, middles))
    quantum = before.statistics.pulse[:3]
    return Move(before.end, after.start, gyro * spans[:, None], spans, quantum)


def _held(segments: list[Segment]) -> list[Segment]:
    """Return holds in other attitudes of the same ups, each the short way from the one before."""
    found = segments[:1]
    for segment in segments[1:]:
        assert segment.attitude is not None
        shown = shortest(found[-1], segment.attitude[2])
        found.append(replace(segment, attitude=shown))
    return found


def next_hold(last: Segment, up: Floats, seconds: float) -> Segment:
    """Return a hold like another one, to which the unit is turned the short way.

    Args:
        last: The hold before, in its attitude.
        up: (3,) in body axes, unit vector.
        seconds: How long it is held.

    """
    start = last.end + _ns(BY_HAND_MOVE)
    statistics = replace(last.statistics, duration=seconds, walk_gain=np.full(6, 1 / seconds))
    return replace(
        last,
        start=start,
        end=start + _ns(seconds),
        statistics=statistics,
        attitude=shortest(last, up),
    )


def shortest(last: Segment, up: Floats) -> Floats:
    """Return the attitude (3, 3) to which the short way leads where (3,) `up` is up."""
    assert last.attitude is not None
    rising = last.attitude[2]
    axis = np.cross(up, rising)
    sine, cosine = float(np.linalg.norm(axis)), float(up @ rising)
    if sine < _PARALLEL:
        # Half a turn goes about any level axis; rounding must not choose it.
        axis = across(np.round(rising, 9))[0]
    turn = rotation(axis / np.linalg.norm(axis), math.atan2(sine, cosine))
    return np.asarray(last.attitude @ turn)


def short_move(before: Segment, after: Segment, truth: SensorModel, site: Site) -> Move:
    """Return what the gyros would give on the short way from hold to hold, at an even pace."""
    assert before.attitude is not None
    assert after.attitude is not None
    ends = np.array([before.attitude, after.attitude])
    turn = scipy.spatial.transform.Rotation.from_matrix(ends[0].T @ ends[1]).as_rotvec()
    parts = np.linspace(0.0, 1.0, _SHORT_STEPS + 1)[:, None] * turn
    attitudes = ends[0] @ scipy.spatial.transform.Rotation.from_rotvec(parts).as_matrix()
    spans = np.full(_SHORT_STEPS, (after.start - before.end) * 1e-9 / _SHORT_STEPS)
    world = site.up_rate * _UP, site.specific_force
    return _along(before, after, attitudes, spans, truth, world)


def _followed(move: Move, spec: ImuSpec) -> bool:
    """Say whether a session would lead a move on: see `segmentation.moves`."""
    fastest = float(np.abs(move.turned / move.seconds[:, None]).max())
    return fastest * _period(spec) <= COARSEST and fastest < NEARLY * spec.gyro.range


def _by_hand(setup: Setup) -> tuple[list[_Rest], list[_Turning]]:
    rests, turnings, now = [], [], 0.0
    for position in setup.plan.positions:
        if position.rate_test is not None:
            turns = position.rate_test.turns
            seconds = turns * _BY_HAND_TURN
            rate = TURN * turns / seconds
            now += _BY_HAND_STILL
            turnings.append(_Turning(position.id, position.up, now, seconds, rate))
            now += seconds + _BY_HAND_STILL
        if position.dwell:
            rests.append(_Rest(position.id, position.attitude, now, now + position.dwell))
        now += position.dwell + BY_HAND_MOVE
    return rests, turnings


def _read(spec: ImuSpec, mean: Floats, seconds: float, spare: float | None = None) -> Statistics:
    """Return the statistics of what reads (6,) `mean`.

    Args:
        spec: Units and noise.
        mean: Outputs, rad/s and m/s^2.
        seconds: How long.
        spare: Of whole turns, beyond which counts are read on both sides, s; None at rest.

    """
    gain, quantum = np.full(6, 1 / seconds), np.zeros(6)
    period, nothing = _period(spec), np.full(6, np.nan)
    steps = np.array([triad.scale_factor for triad in _triads(spec)])
    for c, triad in enumerate(_triads(spec)):
        if spec.units is Units.COUNTS:
            quantum[c] = _rounded(triad, period)
        elif spec.units is Units.PULSES:
            walk = triad.random_walk / triad.scale_factor
            pulses = _pulses(triad, period, float(mean[c]), seconds + 2 * (spare or 0.0))
            first = (len(pulses) - seconds / period) / 2
            found = (
                mean_rate(pulses, period, walk)
                if spare is None
                else rate_between(pulses, period, first, len(pulses) - first, walk)
            )
            gain[c], quantum[c] = found.walk_gain, found.quantum * triad.scale_factor**2
    return Statistics(
        samples=round(seconds / period),
        missing=0,
        duration=seconds,
        mean=mean,
        walk_gain=gain,
        quantum=quantum,
        end_points=mean,
        blocks=tuple(np.empty((0, 4)) for _ in range(6)),
        drift=nothing,
        drift_std=nothing,
        pulse=steps if spec.units is Units.PULSES else np.zeros(6),
    )


def skewed_alone(spec: ImuSpec) -> ImuSpec:
    """Return an IMU whose first gyro is the skewed one."""
    assert spec.skewed is not None
    return replace(spec, gyro=spec.skewed, skewed=None)


def _each(
    spec: ImuSpec, whole: Statistics, askew: Statistics | None, turning: _Turning
) -> Floats | None:
    """Return means of the single turns that scatter just as their noise would on average."""
    count = max(1, round(abs(turning.rate) * turning.seconds / TURN))
    if count < 2:
        return None
    seconds = turning.seconds / count
    single = _read(spec, whole.mean, seconds, _SPARE)
    mean, square = whole.mean[:3], single.variance(_walk(spec))[:3]
    if askew is not None:
        alone = skewed_alone(spec)
        single = _read(alone, askew.mean, seconds, _SPARE)
        mean = np.append(mean, askew.mean[0])
        square = np.append(square, single.variance(_walk(alone))[0])
    ramp = np.arange(count) - (count - 1) / 2
    return np.asarray(mean + np.outer(ramp / ramp.std(ddof=1), np.sqrt(square)))


def _pulses(triad: TriadSpec, period: float, mean: float, seconds: float) -> Floats:
    """Return what a counter without noise delivers at a rate (rad/s or m/s^2)."""
    edges = np.arange(max(2, math.ceil(seconds / period)) + 1)
    return np.diff(np.floor(edges * (mean * period / triad.scale_factor) + _PHASE))


def _rounded(triad: TriadSpec, period: float) -> float:
    """Return the variance that an ADC's rounding leaves: Widrow and Kollar 2008, section 4.4."""
    step = triad.scale_factor
    noise = triad.random_walk**2 / period / step**2
    return step**2 / 12 * math.exp(-4 * math.pi**2 * noise)


def wandering(evidence: Evidence, spec: ImuSpec) -> Floats:
    """Return the covariance of the outputs by biases that wander, (m + u,) square.

    First-order Gauss-Markov processes whose standard deviations are the data sheet's bias
    instabilities, seen by the means of stretches and turns and by the angles of m moves; u is the
    number of turns that a skewed gyro saw.

    Args:
        evidence: Stretches and turns in time.
        spec: Bias instabilities.

    """
    rests, turns = evidence.segments, evidence.turns
    moves = [link.move for link in evidence.led.links]
    spans = [(s.start, s.end) for s in rests]
    spans += [(t.start, t.end) for t in turns]
    spans += [(m.start, m.end) for m in moves]
    begin, end = (np.array(spans).reshape(-1, 2).T) * 1e-9
    none = np.zeros((len(spans), 3, 3)), np.zeros(len(spans), dtype=bool)
    means = Wandering.over(begin, end - begin, *none).of_one(STATED_TIME)
    askew = [len(rests) + k for k, t in enumerate(turns) if t.skewed is not None]
    rows = evidence.rows
    channel = [*rows.channels.tolist(), *[6] * len(askew)]
    which = np.concatenate([rows.stretch, np.array(askew, dtype=int)])
    figures = [t.bias_instability for t in (*_triads(spec), spec.skewed or TriadSpec())]
    # What a move carries along as it turns; all else reads its own bias.
    answers = np.eye(7)[channel]
    answers[rows.move, :3] = evidence.led.by_parameters(SensorModel(), BIASES[:3])
    by_bias = answers * figures
    return np.asarray(means[np.ix_(which, which)] * (by_bias @ by_bias.T))


def _walk(spec: ImuSpec) -> Floats:
    return np.repeat([spec.gyro.random_walk, spec.accel.random_walk], 3)


def _triads(spec: ImuSpec) -> list[TriadSpec]:
    return [spec.gyro] * 3 + [spec.accel] * 3


def _period(spec: ImuSpec) -> float:
    return 1 / (spec.sample_rate or _SAMPLE_RATE)


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)
