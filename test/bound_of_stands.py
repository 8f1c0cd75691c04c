"""The Cramer-Rao bound of a session on a table that is not perfect.

What is wrong with the stand enters as errors of known size: their covariance is that of what they
do to the outputs. How the table leans by them comes from rotations written out in plain loops
(`other_world`), by differences.
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

from imu_calib.earth import Site
from imu_calib.imu import ImuSpec
from imu_calib.model import SensorModel
from imu_calib.plan import Plan
from imu_calib.stream import Floats
from imu_calib.turntable import TURN, Table

_STEP = 1e-6
_TAU = 1000.0
_SETTLE = 1.0
_READINGS = 100
"""Of the encoders, per second."""


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
        ends: Of a move: the rests between which it lies, among the parts.

    """

    kind: str
    angles: Floats
    begin: float
    seconds: float
    rate: float = 0.0
    ends: tuple[int, int] = (0, 0)


@dataclass(frozen=True)
class Course:
    """What a table does in a plan, and how its errors turn the unit.

    Attributes:
        parts: In the order of `bound.read`.
        leans: (e, p, 3) by one radian of each of e errors, about the unit's axes, in a turn in the
            mean, by the field of `Stand`.

    """

    parts: list[Part]
    leans: dict[str, Floats]


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
    for name, leans in course.leans.items():
        columns = leaning @ leans.reshape(len(leans), -1).T * getattr(stand, name)
        covariance += columns @ columns.T
    for k, part in enumerate(course.parts):
        reading = float(np.hypot(stand.readings, stand.jitter * part.rate))
        if part.kind == 'turn' and reading:
            # A line through all readings of a turn.
            slope = reading * np.sqrt(12 / (_READINGS * part.seconds)) / part.seconds
            column = np.zeros(len(covariance))
            first = _rows(course.parts, k).start
            column[first : first + 3] = model.gyro.response @ _turned(part.angles)[2] * slope
            covariance += np.outer(column, column)
    covariance += _drifting(course.parts, jacobian, stand)
    if stand.ramp:
        jacobian = np.hstack([jacobian, _ramp(course.parts, jacobian)])
    white = np.linalg.solve(np.linalg.cholesky(covariance), jacobian)
    information = white.T @ white
    north = 0.0 if stand.azimuth is None else stand.azimuth**-2
    known = range(24, 27 + arms)
    information[known, known] += [north, *[_LEVELLED**-2] * 2, *[_WITHIN**-2] * arms]
    scale = 1 / np.sqrt(np.diag(information))
    found = np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)
    return np.asarray(np.sqrt(np.diag(found))[:24])


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
            turns[-1].append(Part('turn', start, now + seconds / 2, seconds, rate))
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
    return Course(parts, {'stops': stops, 'positioning': _arriving(parts), **_erring(parts)})


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
    erring = World(flaws=flaws)  # type: ignore[arg-type]
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


def _arriving(parts: list[Part]) -> Floats:
    """How the error of each joint turns the unit, from when it stops until it moves: (e, p, 3)."""
    found: list[Floats] = []
    still = [k for k, part in enumerate(parts) if part.kind != 'move']
    order = sorted(still, key=lambda k: parts[k].begin)
    for joint in range(3):
        flaws = [SOUND, SOUND, SOUND]
        flaws[joint] = Flaw(zero=_STEP)
        last = None
        for k in order:
            part = parts[k]
            if part.kind == 'turn' and joint == 0:
                last = None
                continue
            if last is None or abs(part.angles[joint] - last) > _STEP:
                found.append(np.zeros((len(parts), 3)))
            found[-1][k] = _lean(part, tuple(flaws))
            last = float(part.angles[joint])
    return np.array(found)


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
