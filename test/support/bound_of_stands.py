"""The Cramer-Rao bound of a session on a table that is not perfect.

What is wrong with the stand enters as errors of known size: their covariance is that of what they
do to the outputs. How the table leans by them comes from rotations written out in plain loops
(`other_world`), by differences.

Readings of an encoder count in turns, where they tell the rate: with the noise and the jitter of
each, and in steps. A rounded reading says that the table is within half a step of it, and no place
there is likelier than another. So an offset and a slope are as likely as any other pair with which
all readings of a turn come out, and the variance of the slope over those pairs is the least mean
square of any estimator (the mean of the posterior has it). Turns whose steps come in time with the
readings err by up to (q / T)^2 / 6; others by far less. To write q^2 / 12 for each reading, as if
each erred for itself, would be far too little of the former.

At rest a rounded reading tells nothing beside the plan: the table was sent to an angle, and comes
within its positioning errors of it. A bound that took q / sqrt(12) for it would be above what that
knowledge allows. The same holds of where turns begin and end. So where readings are off, what the
gyros turn from rest to rest is in the bound beside what they turn on the rate.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from bound import (
    _BEYOND,
    _LEVELLED,
    _WITHIN,
    moves,
    read,
    travel,
    variance,
    variance_between,
)
from other_world import SOUND, Flaw, World, attitude, rotation_vector, times, transposed

from imu_calib.common.stream import Floats
from imu_calib.model.earth import Site
from imu_calib.model.sensors import SensorModel
from imu_calib.session.imu import ImuSpec
from imu_calib.session.plan import Plan
from imu_calib.session.table import TURN, Table

_STEP = 1e-6
_TAU = 1000.0
_SETTLE = 1.0
_READINGS = 100
"""Of the encoders, per second."""
_OFFSETS = 16
"""At which steps may lie beside the first reading."""


@dataclass(frozen=True, kw_only=True)
class Stand:
    """What is not known of a stand: standard deviations, rad where nothing else is said.

    Attributes:
        positioning: Of a joint that stops, until it moves again.
        stops: By which the table leans at each stop, about each of three axes.
        zeros, orthogonality, wobble, encoder: As in the table's file; the latter two at once and
            at twice per turn, each.
        readings: Noise of one reading of an encoder.
        jitter: Of the times of the readings, s.
        step: Of the readings.
        azimuth: Of the table, where it is stated; None where nobody knows it.
        drift: Of gyros' and accelerometers' biases, that wander with 1000 s, rad/s and m/s^2.
        ramp: Whether biases and, of each triad together, scale factors drift evenly.
    """

    positioning: float = 0.0
    stops: float = 0.0
    zeros: float = 0.0
    orthogonality: float = 0.0
    wobble: float = 0.0
    encoder: float = 0.0
    readings: float = 0.0
    jitter: float = 0.0
    step: float = 0.0
    azimuth: float | None = None
    drift: tuple[float, float] = (0.0, 0.0)
    ramp: bool = False


@dataclass(frozen=True, eq=False)
class Part:
    """A rest, a turn or a move.

    Attributes:
        kind: 'rest', 'turn' or 'move'.
        angles: Of the joints, rad: of a turn where it begins, of a move where it ends.
        begin: s.
        seconds: How long it takes.
        rate: Of a turn about the outer axis, rad/s.
        whole: Of a turn: how long it takes from rest to rest, s, and how long it is on the rate.
        turned: Of a turn: whole turns from rest to rest, rad.
        ends: Of a move: the rests between which it lies, among the parts.
    """

    kind: str
    angles: Floats
    begin: float
    seconds: float
    rate: float = 0.0
    whole: tuple[float, float] = (0.0, 0.0)
    turned: float = 0.0
    ends: tuple[int, int] = (0, 0)


@dataclass(frozen=True)
class Course:
    """What a table does in a plan, and how its errors turn the unit.

    Attributes:
        parts: In the order of `bound.read`.
        leans: (e, p, 3) by one radian of each of e errors, about the unit's axes, in a turn in the
            mean, by the field of `Stand`.
        ends: (e, p) what each error of `positioning` adds to a turn from rest to rest, about up.
    """

    parts: list[Part]
    leans: dict[str, Floats]
    ends: Floats


def bound_of(
    plan: Plan, spec: ImuSpec, model: SensorModel, site: Site, table: Table, stand: Stand
) -> Floats:
    """Standard deviations (24,) that no unbiased estimator falls below.

    Rotations of moves are in it, and velocities are not: beside rests of the units that it is for
    they tell nothing.

    Args:
        plan: Its positions and whole turns about the outer axis.
        spec: Random walk, pulses and sample rate.
        model: The truth.
        site: Gravity and Earth rate.
        table: Outer axis z, middle x, inner z.
        stand: What is not known of it.
    """
    course = _course_of(plan, table)
    jacobian, arms = _jacobian(plan, model, site, table)
    covariance = np.diag(_own(spec, course.parts))
    leaning = _by_leaning(course.parts, model, site)
    shared = _drifting(course.parts, jacobian, stand)
    arriving = np.zeros((len(covariance), 0))
    for name, leans in course.leans.items():
        columns = leaning @ leans.reshape(len(leans), -1).T * getattr(stand, name)
        if name == 'positioning':
            arriving = columns
        else:
            shared += columns @ columns.T
    if stand.ramp:
        jacobian = np.hstack([jacobian, _ramp(course.parts, jacobian)])
    if stand.readings or stand.jitter or stand.step:
        # What is turned from rest to rest, beside what is turned on the rate.
        beside = _Ways.of(course, spec, model)
        jacobian = np.vstack([jacobian, beside.scaled @ jacobian + beside.resting(jacobian)])
        both = np.vstack([np.eye(len(covariance)), beside.scaled])
        shared = both @ shared @ both.T
        arriving = np.vstack([arriving, beside.scaled @ arriving + beside.ends * stand.positioning])
        covariance = np.block([[covariance, beside.common.T], [beside.common, beside.own]])
        for k, part in enumerate(course.parts):
            if part.kind == 'turn':
                column = np.zeros(len(covariance))
                first = _rows(course.parts, k).start
                slope = _slope_error(part.rate, part.whole[1], stand)
                column[first : first + 3] = model.gyro.response @ _turned(part.angles)[2] * slope
                covariance += np.outer(column, column)
    covariance += shared + arriving @ arriving.T
    white = np.linalg.solve(np.linalg.cholesky(covariance), jacobian)
    information = white.T @ white
    north = 0.0 if stand.azimuth is None else stand.azimuth**-2
    known = range(24, 27 + arms)
    information[known, known] += [north, *[_LEVELLED**-2] * 2, *[_WITHIN**-2] * arms]
    scale = 1 / np.sqrt(np.diag(information))
    found = np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)
    return np.asarray(np.sqrt(np.diag(found))[:24])


@dataclass(frozen=True)
class _Ways:
    """What the gyros turn in motions with a turn, from rest to rest: three outputs of each, rad.

    Attributes:
        scaled: (3 w, m) what of them is as in the turn on the rate, by the outputs of that.
        lasting: (3 w, m) likewise, how long a bias counts besides, s.
        ends: (3 w, e) by one radian of each positioning error.
        own: (3 w, 3 w) their noise.
        common: (3 w, m) what of it is in the turn on the rate.
    """

    scaled: Floats
    lasting: Floats
    ends: Floats
    own: Floats
    common: Floats

    @classmethod
    def of(cls, course: Course, spec: ImuSpec, model: SensorModel) -> _Ways:
        parts = course.parts
        turns = [k for k, part in enumerate(parts) if part.kind == 'turn']
        size = _rows(parts, len(parts) - 1).stop
        scaled, lasting, common = (np.zeros((3 * len(turns), size)) for _ in range(3))
        ends = np.zeros((3 * len(turns), len(course.ends)))
        noise = []
        walk = spec.gyro.random_walk**2
        for n, k in enumerate(turns):
            part, first = parts[k], _rows(parts, k).start
            on_rate = part.turned / abs(part.rate)
            for axis in range(3):
                scaled[3 * n + axis, first + axis] = on_rate
                lasting[3 * n + axis, first + axis] = part.whole[0] - on_rate
                common[3 * n + axis, first + axis] = walk
            about = model.gyro.response @ _turned(part.angles)[2]
            ends[3 * n : 3 * n + 3] = np.outer(about, course.ends[:, k])
            noise += 3 * [walk * part.whole[0] + _own_of_pulses(spec)]
        return cls(scaled, lasting, ends, np.diag(noise), common)

    def resting(self, jacobian: Floats) -> Floats:
        """Return what biases do beside the rate, by the derivatives of all outputs (m, n)."""
        found = np.zeros((len(self.lasting), jacobian.shape[1]))
        found[:, 9:12] = self.lasting @ jacobian[:, 9:12]
        return found


def _own_of_pulses(spec: ImuSpec) -> float:
    """Return the variance of an angle by what a counter holds back at both ends, rad^2."""
    return spec.gyro.scale_factor**2 / 6 if spec.units.name == 'PULSES' else 0.0


def _slope_error(rate: float, seconds: float, stand: Stand) -> float:
    """Return how far off the slope of all readings on the rate is, a deviation, rad/s."""
    reading = float(np.hypot(stand.readings, stand.jitter * rate))
    line = reading * np.sqrt(12 / (_READINGS * seconds)) / seconds
    return float(np.hypot(line, slope_by_steps(abs(rate), seconds, stand.step)))


@cache
def slope_by_steps(rate: float, seconds: float, step: float) -> float:
    """Return the deviation of a slope of which readings in steps are all that is known, rad/s.

    The root of the mean, over where the steps lie, of the variance over all slopes with an offset
    by which each reading comes out.

    Args:
        rate: Of the table, rad/s.
        seconds: For how long it is read.
        step: rad; 0 for none.
    """
    if not step:
        return 0.0
    times_ = np.arange(int(seconds * _READINGS)) / _READINGS
    off = np.linspace(-1.5, 1.5, 601) * step / seconds
    found = []
    for part in (np.arange(_OFFSETS) + 0.5) / _OFFSETS:
        angle = rate * times_ + part * step
        missed = np.round(angle / step) * step - angle
        # How many offsets each slope has: as long as no reading is further off than half a step.
        room = np.array([step - np.ptp(missed - slope * times_) for slope in off])
        room = np.maximum(room, 0.0)
        if not room.any():
            # Known finer than slopes are tried.
            found.append(0.0)
            continue
        mean = float(room @ off) / room.sum()
        found.append(float(room @ (off - mean) ** 2) / room.sum())
    return float(np.sqrt(np.mean(found)))


_memo: dict[tuple[object, ...], tuple[Floats, int]] = {}


def _jacobian(plan: Plan, model: SensorModel, site: Site, table: Table) -> tuple[Floats, int]:
    """Derivatives of `bound.read`, and how many lever arms there are: one by one plan and unit."""
    key = (plan, model.vector().tobytes())
    if key not in _memo:
        ways = moves(plan, table)
        arms = 3 * sum(p.rate_test is not None for p in plan.positions)
        state = np.concatenate([model.vector(), np.zeros(3 + arms)])
        steps = np.concatenate([np.full(24, 1e-3), np.full(3, 1e-4), np.full(arms, 1e-3)])
        slopes = [
            (read(plan, site, state + step, ways) - read(plan, site, state - step, ways))
            / (2 * step.max())
            for step in np.diag(steps)
        ]
        _memo[key] = np.array(slopes).T, arms
    return _memo[key]


@cache
def _course_of(plan: Plan, table: Table) -> Course:
    rests: list[Part] = []
    turns: list[list[Part]] = [[]]
    led: list[tuple[Part, int]] = []
    now, start, stood = 0.0, np.zeros(len(table.joints)), False
    for step in plan.steps(table):
        rate = float(step.rates[0])
        if rate:
            seconds = TURN / abs(rate)
            ramp = abs(rate) / table.joints[0].max_acceleration
            turned = TURN * (step.turns + 1)
            whole = turned / abs(rate) + ramp, turned / abs(rate) - ramp
            turns[-1].append(
                Part('turn', start, now + seconds / 2, seconds, rate, whole=whole, turned=turned)
            )
            now += seconds * (step.turns + 1)
            continue
        seconds = travel(start, step.angles, table)[0]
        if stood and step.dwell and not np.array_equal(start, step.angles):
            led.append((Part('move', step.angles, now, seconds), len(rests)))
        now += seconds
        start, stood = step.angles, step.dwell > 0
        if stood:
            rests.append(Part('rest', step.angles, now, step.dwell + _SETTLE))
            turns.append([])
            now += step.dwell + _SETTLE
    parts: list[Part] = []
    numbers = []
    for rest, tested in zip(rests, turns, strict=False):
        numbers.append(len(parts))
        parts += [rest, *tested]
    parts += [replace(move, ends=(numbers[k - 1], numbers[k])) for move, k in led]
    stops = np.zeros((3 * len(numbers), len(parts), 3))
    for n, k in enumerate(numbers):
        stops[3 * n : 3 * n + 3, k] = np.eye(3)
    arriving, ends = _arriving(parts)
    return Course(parts, {'stops': stops, 'positioning': arriving, **_erring(parts)}, ends)


def _rows(parts: list[Part], k: int) -> slice:
    first = sum(3 if p.kind == 'move' else 6 for p in parts[:k])
    return slice(first, first + (3 if parts[k].kind == 'move' else 6))


def _own(spec: ImuSpec, parts: list[Part]) -> Floats:
    """Variances of the outputs by random walk and pulses."""
    period = 1 / (spec.sample_rate or 100.0)
    gyro = (spec.gyro.random_walk, spec.gyro.scale_factor, period)
    accel = (spec.accel.random_walk, spec.accel.scale_factor, period)
    if spec.units.name != 'PULSES':
        # What an ADC rounds is white beside noise of its own size.
        gyro, accel = ((w, s * period, period) for w, s, _ in (gyro, accel))
    values: list[float] = []
    for part in parts:
        if part.kind == 'move':
            seconds = part.seconds + 0.5
            values += 3 * [gyro[0] ** 2 * seconds + gyro[1] ** 2 / 6]
            continue
        for triad in (gyro, accel):
            if part.kind == 'rest':
                values += 3 * [variance(part.seconds, *triad)]
            else:
                values += 3 * [variance_between(part.seconds, _BEYOND, *triad)]
    return np.array(values)


def _turned(angles: Floats) -> Floats:
    outer, middle, inner = angles
    return np.array(attitude((outer, middle, inner), World()))


def _flaws() -> Iterator[tuple[str, tuple[Flaw, ...]]]:
    """Each error of a table alone, by the field of `Stand`, of `_STEP` radians."""
    size, wave = _STEP, _STEP / math.sqrt(2)
    none = (0.0, 0.0, 0.0, 0.0)
    for joint in range(3):
        alone = []
        if joint:
            alone += [('zeros', Flaw(zero=size))]
            alone += [('orthogonality', Flaw(lean=lean)) for lean in ((size, 0.0), (0.0, size))]
        for k in range(4):
            c1, s1, c2, s2 = (wave * (k == n) for n in range(4))
            part = (c1, s1, c2, s2)
            alone += [('encoder', Flaw(encoder=part)), ('wobble', Flaw(wobble=(part, none)))]
            alone += [('wobble', Flaw(wobble=(none, part)))]
        for name, flaw in alone:
            flaws = [SOUND, SOUND, SOUND]
            flaws[joint] = flaw
            yield name, tuple(flaws)


def _lean(part: Part, flaws: tuple[Flaw, ...]) -> Floats:
    """By how much errors turn the unit about its axes, in a turn in the mean: per `_STEP`."""
    erring = World(flaws=flaws)
    eighths = range(8) if part.kind == 'turn' else (0,)
    found = []
    for k in eighths:
        outer, middle, inner = part.angles
        angles = (outer + k * TURN / 8, middle, inner)
        meant = transposed(attitude(angles, World()))
        found.append(rotation_vector(times(meant, attitude(angles, erring))))
    return np.mean(found, axis=0) / _STEP


def _erring(parts: list[Part]) -> dict[str, Floats]:
    """How each error of axes, zeros and encoders turns the unit, (e, p, 3) by its name."""
    found: dict[str, list[Floats]] = {}
    for name, flaws in _flaws():
        found.setdefault(name, []).append(np.array([_lean(part, flaws) for part in parts]))
    return {name: np.array(leans) for name, leans in found.items()}


def _arriving(parts: list[Part]) -> tuple[Floats, Floats]:
    """How the error of each joint turns the unit, from when it stops until it moves: (e, p, 3).

    And (e, p) by how much it turns further, about the axis, in a turn that ends or begins there.
    """
    found: list[Floats] = []
    longer: list[Floats] = []

    def stops() -> None:
        found.append(np.zeros((len(parts), 3)))
        longer.append(np.zeros(len(parts)))

    still = [k for k, part in enumerate(parts) if part.kind != 'move']
    order = sorted(still, key=lambda k: parts[k].begin)
    for joint in range(3):
        flaws = [SOUND, SOUND, SOUND]
        flaws[joint] = Flaw(zero=_STEP)
        last = None
        for k in order:
            part = parts[k]
            if last is None or abs(part.angles[joint] - last) > _STEP:
                stops()
            last = float(part.angles[joint])
            if part.kind == 'turn' and joint == 0:
                longer[-1][k] = -1.0
                stops()
                longer[-1][k] = 1.0
                continue
            found[-1][k] = _lean(part, tuple(flaws))
    return np.array(found), np.array(longer)


def _by_leaning(parts: list[Part], model: SensorModel, site: Site) -> Floats:
    """By what outputs change where parts are turned about the unit's axes: (m, 3 p) per rad."""
    result = np.zeros((_rows(parts, len(parts) - 1).stop, len(parts), 3))
    gyro, accel = model.gyro.response, model.accel.response
    for k, part in enumerate(parts):
        body = _turned(part.angles).T
        if part.kind == 'move':
            first, second = part.ends
            result[_rows(parts, k), second] = gyro
            result[_rows(parts, k), first] = -gyro @ body @ _turned(parts[first].angles)
            continue
        rate = body @ site.earth_rate + part.rate * body[:, 2]
        force = body @ site.specific_force
        # A vector that stands still in the room turns the other way in the unit.
        changed = [gyro @ np.cross(rate, axis) for axis in np.eye(3)]
        felt = [accel @ np.cross(force, axis) for axis in np.eye(3)]
        result[_rows(parts, k), k] = np.vstack([np.transpose(changed), np.transpose(felt)])
    return result.reshape(len(result), -1)


def _middle(parts: list[Part]) -> Floats:
    """When each output is seen, s."""
    times_ = [np.full(3 if p.kind == 'move' else 6, p.begin + p.seconds / 2) for p in parts]
    return np.concatenate(times_)


def _drifting(parts: list[Part], jacobian: Floats, stand: Stand) -> Floats:
    """The covariance by biases that wander."""
    middle = _middle(parts)
    kernel = np.exp(-np.abs(middle[:, None] - middle) / _TAU)
    gyros, accels = jacobian[:, 9:12] * stand.drift[0], jacobian[:, 21:24] * stand.drift[1]
    return np.asarray(kernel * (gyros @ gyros.T + accels @ accels.T))


def _ramp(parts: list[Part], jacobian: Floats) -> Floats:
    """How outputs follow biases, and scale factors of each triad together, that drift evenly."""
    middle = _middle(parts)
    scales = [jacobian[:, 0:3].sum(axis=1), jacobian[:, 12:15].sum(axis=1)]
    followed = np.column_stack([jacobian[:, 9:12], jacobian[:, 21:24], *scales])
    return np.asarray(followed * ((middle - middle.mean()) / middle.max())[:, None])
