"""What happens once, or to samples and clocks, in sessions of `other_world`: drawn by a seed."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from other_sessions import (
    CONSUMER,
    EPOCH,
    MEDIUM,
    NAVIGATION,
    PPM,
    blocks_of,
    fed,
    in_si,
    recorded,
)
from other_world import DEG, Motion, Unit, Vector, World, record, sample_integrals, schedule

from imu_calib.calibration.calibrator import Calibrator
from imu_calib.common.stream import Floats, ImuBlock, JointBlock, Stamps
from imu_calib.session.plan import load_plan
from imu_calib.session.table import Table

DWELL = 20.0  #: s: at each of twelve positions.
FIRST = 1000  #: Seeds begin here: tests have those before.
ARCSEC = DEG / 3600
TICK = 1 / 64  #: s: of the clock of Windows.
WARMING = 150.0  #: s: of a crystal.
GRADES = {'consumer': CONSUMER, 'medium': MEDIUM, 'navigation': NAVIGATION}

Blocks = tuple[JointBlock, ImuBlock]


@dataclass(frozen=True)
class Session:
    """A session without the fault, and what draws where the fault is."""

    world: World
    unit: Unit
    seed: int
    rng: np.random.Generator

    def blocks(self) -> Blocks:
        return recorded(self.world, self.unit, self.seed)

    def move(self, joint: int | None = None) -> Motion:
        """Draw a move between two dwells, of a joint if one is given."""
        ways = [m for m in schedule(self.world)[1:] if 0 < abs(m.way) < 1.1 * math.pi]
        moves = [m for m in ways if joint is None or m.joint == joint]
        return moves[self.rng.integers(len(moves))]

    def direction(self) -> Floats:
        drawn = self.rng.standard_normal(3)
        return np.asarray(drawn / np.linalg.norm(drawn))


def seconds_of(stamp: Stamps) -> Floats:
    return np.asarray((stamp - EPOCH * 10**9) * 1e-9)


def moving(world: World, unit: Unit, seed: int, turned: Floats, ends: Floats) -> Blocks:
    """Record a unit that is turned in its mount by small angles.

    They are stated in the middle of each sample (n, 3), and at the ends of all (n + 1, 3). To the
    second order: on a navigation-grade unit 100 arcsec show it.
    """
    table = sample_integrals(world, unit.rate, 0.0)
    inputs = []
    for column in range(2):
        given = np.array([sample[column] for sample in table])
        first = np.cross(turned, given)
        inputs.append(given - first + np.cross(turned, first) / 2)
    inputs[0] += np.diff(ends, axis=0)
    rows = [[tuple(row) for row in one.tolist()] for one in inputs]
    return blocks_of(record(world, unit, seed, list(zip(*rows, strict=True))))


def loose(world: World, unit: Unit, seed: int, turned: Vector | Floats, instant: float) -> Blocks:
    """Record a unit that turns in its mount by small angles within a tenth of a second."""
    halves = np.arange(2 * len(sample_integrals(world, unit.rate, 0.0)) + 1) / 2
    done = np.clip((halves / unit.rate - instant) / 0.1, 0.0, 1.0)[:, None] * turned
    return moving(world, unit, seed, done[1::2], done[::2])


def on_isolators(world: World, unit: Unit, seed: int, by: Vector | Floats) -> Blocks:
    """Record a unit whose weight is beside its isolators: it turns about across that and gravity.

    By as much per g of the force.
    """
    forces = [pushed for _, pushed, *_ in sample_integrals(world, unit.rate, 0.0)]
    turned = np.cross(by, np.array(forces) * unit.rate / world.gravity)
    ends = np.concatenate([turned[:1], (turned[:-1] + turned[1:]) / 2, turned[-1:]])
    return moving(world, unit, seed, turned, ends)


def stepped(joints: JointBlock, joint: int, angle: float, instant: float) -> JointBlock:
    """Readings of a joint that step by an angle, rad."""
    position = joints.position.copy()
    position[seconds_of(joints.stamp) > instant, joint] += angle
    return replace(joints, position=position)


def slewed(stamp: Stamps, ppm: float, span: tuple[float, float]) -> Stamps:
    """Return stamps, ns, of a clock that runs fast between two shares of the session."""
    passed = (stamp - stamp[0]).astype(float)
    first, last = (share * passed[-1] for share in span)
    return np.asarray(stamp + np.rint(ppm * PPM * np.clip(passed - first, 0, last - first)), int)


def warmed(stamp: Stamps, ppm: float) -> Stamps:
    """Return stamps, ns, of a crystal that comes to run slower by so much as it warms."""
    ahead = ppm * PPM * WARMING * (1 - np.exp(-(stamp - stamp[0]) * 1e-9 / WARMING))
    return np.asarray(stamp + np.rint(ahead * 1e9), int)


def _differenced(session: Session, share: float) -> Blocks:
    joints, imu = session.blocks()
    kept = session.rng.random(len(imu.stamp)) >= share
    kept[[0, -1]] = True
    # A sample holds what was counted since the last one that came.
    first = np.flatnonzero(np.roll(kept, 1))
    gyro, accel = (np.add.reduceat(values, first, axis=0) for values in (imu.gyro, imu.accel))
    return joints, ImuBlock(imu.stamp[kept], gyro, accel)


def _differenced_in_si(session: Session, share: float) -> Blocks:
    joints, imu = _differenced(session, share)
    return joints, in_si(session.unit, imu)


def _false(session: Session, share: float, *, repeats: bool) -> Blocks:
    joints, imu = session.blocks()
    rows = np.flatnonzero(session.rng.random(len(imu.stamp)) < share)
    rows = rows[rows > 0]
    gyro, accel = imu.gyro.copy(), imu.accel.copy()
    for values, before in ((gyro, imu.gyro), (accel, imu.accel)):
        values[rows] = before[rows - 1] if repeats else 0.0
    return joints, ImuBlock(imu.stamp, gyro, accel)


def _slewed(session: Session, ppm: float, *, both: bool) -> Blocks:
    joints, imu = session.blocks()
    start = session.rng.uniform(0.1, 0.7)
    span = (start, start + 0.2)
    if both:
        joints = replace(joints, stamp=slewed(joints.stamp, ppm, span))
    return joints, replace(imu, stamp=slewed(imu.stamp, ppm, span))


def _warmed(session: Session, ppm: float) -> Blocks:
    joints, imu = session.blocks()
    return joints, replace(imu, stamp=warmed(imu.stamp, ppm * session.rng.choice([-1, 1])))


def _rate_changed(session: Session) -> Blocks:
    """By 1 %, at a whole second: there samples of 100 and of 101 Hz end together."""
    joints, imu = session.blocks()
    faster = replace(session.unit, rate=1.01 * session.unit.rate)
    _, later = recorded(session.world, faster, session.seed)
    end = seconds_of(imu.stamp)[-1]
    change = EPOCH * 10**9 + round(session.rng.uniform(0.2, 0.8) * end) * 10**9 + 10**6
    old, new = imu.stamp < change, later.stamp > change
    return joints, ImuBlock(
        np.concatenate([imu.stamp[old], later.stamp[new]]),
        np.concatenate([imu.gyro[old], later.gyro[new]]),
        np.concatenate([imu.accel[old], later.accel[new]]),
    )


def _in_steps(session: Session) -> Blocks:
    joints, imu = session.blocks()
    tick = round(TICK * 1e9)
    phase = int(session.rng.integers(tick))
    return joints, replace(imu, stamp=(imu.stamp + phase) // tick * tick - phase)


def _loose(session: Session) -> Blocks:
    instant = session.move().start + 0.5
    by = 100 * ARCSEC * session.direction()
    return loose(session.world, session.unit, session.seed, by, instant)


def _on_isolators(session: Session, by: float) -> Blocks:
    return on_isolators(session.world, session.unit, session.seed, by * session.direction())


def _stepped(session: Session, angle: float) -> Blocks:
    joints, imu = session.blocks()
    joint = int(session.rng.integers(3))
    return stepped(joints, joint, angle, session.move(joint).start + 0.5), imu


def _opposite(session: Session) -> Blocks:
    joints, imu = session.blocks()
    signs = np.ones(3)
    signs[session.rng.integers(3)] = -1
    return replace(joints, position=joints.position * signs), imu


@dataclass(frozen=True)
class Fault:
    """What happens, and the words by which a finding or a refusal names it.

    Attributes:
        exact: Whether the table is stated to have no errors.
        pulses: Whether a consumer unit, too, delivers pulses: it is a counter that is differenced.
        si: Whether the driver makes rad/s and m/s^2 of them.
        grades: Of units to which it happens.
    """

    blocks: Callable[[Session], Blocks]
    words: str = ''
    exact: bool = False
    pulses: bool = False
    si: bool = False
    grades: tuple[str, ...] = tuple(GRADES)


_DIFFERENCED = partial(_differenced, share=1e-3)
_IN_SI = partial(_differenced_in_si, share=1e-3)
_OVER_LOST = 'differences a counter over lost messages'
_FALSE = 'false, the first at'
_SLEWED = 'the stamps run at another pace'
_BENDS = 'clocks of IMU and table drift unevenly'
_MOVED = 'The unit .*moved by|or the unit turned in its mount'
_TURNS = 'in its mount with the force on it'
_READINGS = 'readings of joint .* step by|readings of joint .* jump by'
FAULTS = {
    'nothing': Fault(Session.blocks),
    'nothing, on an exact table': Fault(Session.blocks, exact=True),
    'nothing, pulses': Fault(Session.blocks, pulses=True, grades=('consumer',)),
    'nothing, in SI': Fault(partial(_differenced_in_si, share=0.0), pulses=True, si=True),
    'counter differenced over 0.1 % lost': Fault(_DIFFERENCED, _OVER_LOST, pulses=True),
    'the same, delivered as it comes': Fault(_DIFFERENCED, _OVER_LOST, grades=('consumer',)),
    'the same, delivered in SI': Fault(_IN_SI, _OVER_LOST, pulses=True, si=True),
    '0.3 % of samples zero': Fault(partial(_false, share=3e-3, repeats=False), _FALSE),
    '0.1 % of samples repeat': Fault(partial(_false, share=1e-3, repeats=True), _FALSE),
    'stamps of the IMU slewed by 50 ppm': Fault(partial(_slewed, ppm=50, both=False), _SLEWED),
    'all stamps slewed by 50 ppm': Fault(partial(_slewed, ppm=50, both=True), _SLEWED),
    'sample rate changes by 1 %': Fault(_rate_changed, 'sample rate changes from'),
    'crystal warms by 5 ppm': Fault(partial(_warmed, ppm=5), _BENDS),
    'crystal warms by 20 ppm': Fault(partial(_warmed, ppm=20), _BENDS),
    'stamps in steps of 15.6 ms': Fault(_in_steps, 'stamps of the IMU come in steps of'),
    'moved by 100 arcsec in its mount': Fault(_loose, _MOVED),
    'the same, on an exact table': Fault(_loose, _MOVED, exact=True),
    'isolators, 60 arcsec/g': Fault(partial(_on_isolators, by=60 * ARCSEC), _TURNS),
    'isolators, 10 arcsec/g': Fault(partial(_on_isolators, by=10 * ARCSEC), _TURNS),
    'readings of a joint step by 100 arcsec': Fault(
        partial(_stepped, angle=100 * ARCSEC), _READINGS
    ),
    'a joint is homed anew by 5 deg': Fault(partial(_stepped, angle=5 * DEG), _READINGS),
    'sign of a joint stated wrongly': Fault(_opposite, 'opposite to .* in the file of table'),
}


def sound(name: str, grade: str) -> str:
    """Return the name of the session in which nothing happens, with such a table and unit."""
    if FAULTS[name].exact:
        return 'nothing, on an exact table'
    if FAULTS[name].si:
        return 'nothing, in SI'
    return 'nothing, pulses' if FAULTS[name].pulses and GRADES[grade].counts else 'nothing'


def fed_with(name: str, grade: str, seed: int, table: Table) -> tuple[Calibrator, Unit]:
    """Feed a session with a fault, at a place and a heading drawn by the seed."""
    seed += FIRST
    rng = np.random.default_rng([seed, 40])
    latitude, azimuth = rng.uniform(-55, 70) * DEG, rng.uniform(0, 360) * DEG
    world = World(dwell=DWELL, latitude=float(latitude), azimuth=float(azimuth))
    fault, unit = FAULTS[name], GRADES[grade]
    if fault.pulses and unit.counts:
        pulses = {key: getattr(unit, key) / unit.rate for key in ('gyro_pulse', 'accel_pulse')}
        unit = replace(unit, counts=False, **pulses)
    drawn = np.random.default_rng([seed, zlib.crc32(f'{name} {grade}'.encode())])
    plan = load_plan('twelve_position')
    plan = replace(plan, positions=tuple(replace(p, dwell=DWELL) for p in plan.positions))
    blocks = fault.blocks(Session(world, unit, seed, drawn))
    of_driver = fed(
        world, unit, seed, plan, find_terms=True, table=table, blocks=blocks, si=fault.si
    )
    return of_driver, unit
