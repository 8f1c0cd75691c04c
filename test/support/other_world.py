"""A second simulation of a turntable session, made of plain loops.

It shares no code with the package: joints, Earth, sensors, counters and clocks are written here
once more, sample by sample, so that a mistake that the package makes twice shows. SI units, time in
seconds from the start. East, north, up; R = Rz(azimuth + outer) Rx(middle) Rz(inner).
"""

import math
import random
from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass, field
from functools import cache, lru_cache
from itertools import islice, product, tee

EARTH_RATE = 7.292115e-5
DEG = math.pi / 180
TWELVE = ['UEN', 'UWS', 'DWN', 'DES', 'NUE', 'SUW', 'NDW', 'SDE', 'ENU', 'WSU', 'WND', 'ESD']
"""Where X, Y and Z point at positions 1 to 12 (Cao 2022, section 2), the table pointing north."""

TURNED_AT = (0, 4, 8)
COMPASS = {
    'E': (1, 0, 0),
    'W': (-1, 0, 0),
    'N': (0, 1, 0),
    'S': (0, -1, 0),
    'U': (0, 0, 1),
    'D': (0, 0, -1),
}

Vector = tuple[float, float, float]
Matrix = tuple[Vector, Vector, Vector]
NOTHING: Vector = (0.0, 0.0, 0.0)
IDENTITY: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
ZERO: Matrix = (NOTHING, NOTHING, NOTHING)

Given = tuple[Matrix, Vector, Vector]
"""An attitude, and Earth rate and specific force in its body axes."""

Inputs = list[tuple[Vector, Vector]]
"""What every sample is given: integrals of rate and specific force, body axes."""


FAST = 60 * DEG
"""The rate at which coefficients of gyros' terms are stated, rad/s."""
KNEE = 58 * DEG
"""The rate beyond which a gyro may be bent, rad/s."""


@dataclass(frozen=True, kw_only=True)
class Terms:
    """What a channel adds to that, of its own rate w or specific force f, SI units.

    Attributes:
        by_force: To gyro i row i times the specific force.
        by_square: To a gyro, times f^2.
        senses: To a gyro, times |w|.
        size: To a gyro, times w |w| / FAST.
        cube: To a gyro, times w^3 / FAST^2.
        square: To a gyro, times w^2 / FAST.
        bent: To a gyro, times what is beyond `KNEE`.
        accel_square: To an accelerometer, times f^2.
        accel_signs: To an accelerometer, times |f|.
        accel_cube: To an accelerometer, times f^3.
        accel_cross: To accelerometer i row i times (f_x f_y, f_x f_z, f_y f_z).
    """

    by_force: Matrix = ZERO
    by_square: Vector = NOTHING
    senses: Vector = NOTHING
    size: Vector = NOTHING
    cube: Vector = NOTHING
    square: Vector = NOTHING
    bent: Vector = NOTHING
    accel_square: Vector = NOTHING
    accel_signs: Vector = NOTHING
    accel_cube: Vector = NOTHING
    accel_cross: Matrix = ZERO


@dataclass(frozen=True, kw_only=True)
class Unit:
    """What the sensors truly are: out = (I + m) input + d, then noise, then whole pulses.

    Attributes:
        gyro_m, accel_m: Scale-factor errors and misalignments.
        gyro_d, accel_d: Biases, rad/s and m/s^2.
        gyro_walk, accel_walk: rad/sqrt(s) and (m/s)/sqrt(s).
        gyro_pulse, accel_pulse: rad and m/s.
        rate: Samples per second.
        arm: Where the unit is from the inner axis, body axes, m: without `World.misses` from where
            all axes cross.
        places: Where accelerometers x, y and z are in the unit, body axes, m.
        late: How much later than the gyros all three answer, s.
        counts: Whether it delivers rates and forces, rounded to `pulse` per second.
        gyro_drift, accel_drift: Of the biases per second, rad/s^2 and m/s^3.
        gyro_growth, accel_growth: Of the responses per second, 1/s.
        gyro_fade, accel_fade: Of the biases at the start, rad/s and m/s^2.
        fading: They go by exp(-t / fading), s.
        gyro_step, accel_step: Added to the biases from `stepping` on, rad/s and m/s^2.
        stepping: s.
        terms: What the channels add to that.
    """

    gyro_m: Matrix = ZERO
    accel_m: Matrix = ZERO
    gyro_d: Vector = NOTHING
    accel_d: Vector = NOTHING
    gyro_walk: float = 0.05 * DEG / 60
    accel_walk: float = 0.012 / 60
    gyro_pulse: float = 7.8 / 3600 * DEG
    accel_pulse: float = 0.01
    rate: float = 100.0
    arm: Vector = NOTHING
    places: Matrix = ZERO
    late: float = 0.0
    counts: bool = False
    gyro_drift: Vector = NOTHING
    accel_drift: Vector = NOTHING
    gyro_growth: float = 0.0
    accel_growth: float = 0.0
    gyro_fade: Vector = NOTHING
    accel_fade: Vector = NOTHING
    fading: float = 1.0
    gyro_step: Vector = NOTHING
    accel_step: Vector = NOTHING
    stepping: float = math.inf
    terms: Terms | None = None


@dataclass(frozen=True)
class Stop:
    """Where a program brings the joints, rad, and at which rates it turns one before the dwell."""

    angles: Vector
    rates: tuple[float, ...] = ()
    turning: int = 0


Course = tuple[float, float, float, float]
"""An error of an angle a: c1 cos(a) + s1 sin(a) + c2 cos(2 a) + s2 sin(2 a), rad."""

FLAT: Course = (0.0, 0.0, 0.0, 0.0)
STEADY = (FLAT, FLAT)


@dataclass(frozen=True)
class Flaw:
    """What is wrong with a joint, rad: outer and inner turn about z, the middle one about x.

    Attributes:
        zero: To add to its angle.
        lean: Of its axis, and of all that it turns, about the next letter but one and the one
            after that: of z about x and y, of x about y and z.
        wobble: The same, with the angle that its encoder reads.
        encoder: What the encoder reads beyond the angle, with that angle.
    """

    zero: float = 0.0
    lean: tuple[float, float] = (0.0, 0.0)
    wobble: tuple[Course, Course] = STEADY
    encoder: Course = FLAT


SOUND = Flaw()
NO_FLAWS = (SOUND, SOUND, SOUND)
LEVEL = (0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class Damage:
    """What happens to the samples of an IMU on their way.

    Attributes:
        lost: Chance that a sample never comes.
        differenced: Whether the next one that comes holds what lost ones counted: a driver
            differences a counter.
        twice: That it comes twice.
        late: That it is held up, and all behind it.
        delay: For how long at most, s.
        bunch: Samples that are stamped together.
        tick: Of the clock that stamps them, which stands still in between, s; 0 for none.
        freezes: When the device begins to repeat one sample, s.
        frozen: For how long, s.
    """

    lost: float = 0.0
    differenced: bool = False
    twice: float = 0.0
    late: float = 0.0
    delay: float = 0.0
    bunch: int = 1
    tick: float = 0.0
    freezes: tuple[float, ...] = ()
    frozen: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Stops:
    """How the table misses where it stops, each time anew; standard deviations, rad.

    Attributes:
        joints: Of a joint, unseen by its encoder until it moves again.
        tilt: Of the whole table about east and about north.
        heading: Of the whole table about up.
        seed: Of the errors.
    """

    joints: float = 0.0
    tilt: float = 0.0
    heading: float = 0.0
    seed: int = 12


@dataclass(frozen=True, kw_only=True)
class Shaking:
    """What shakes the unit: about and along each body axis a rate and a force that swing.

    Attributes:
        rate, force: Amplitudes, rad/s and m/s^2.
        tones: Hz.
        decay: From the end of each motion on, s; 0 for a floor that shakes all the time.
        moving: Whether it shakes during the motions alone.
    """

    rate: float
    force: float
    tones: tuple[float, ...]
    decay: float = 0.0
    moving: bool = False


@dataclass(frozen=True, kw_only=True)
class World:
    """Where the session takes place, and what the table does and shows.

    Attributes:
        latitude: rad.
        gravity: m/s^2.
        azimuth: Heading of the table's zero, about up, rad.
        tilt: Rotation of the base about east and about north, rad.
        rates: Of the rate tests, rad/s, each in both senses.
        turns: By how much each turn is longer than its ramps, whole turns.
        acceleration: Of the joints, rad/s^2.
        slew: Rate of motions between positions, rad/s.
        dwell: At each position, s.
        joint_rate: Joint states per second.
        encoder_noise: Standard deviation of one reading, rad.
        encoder_step: Resolution of a reading, rad; 0 for none.
        joint_jitter: Standard deviation of a stamp of the joints, s.
        stamp_jitter: Standard deviation of a stamp of the IMU, s.
        clock: By how much the IMU's clock is fast, a ratio.
        offset: By how much it is ahead at the start, s.
        program: What the table does; the twelve positions if empty.
        flaws: Of outer, middle and inner joint.
        misses: Where the middle axis is in what the outer joint turns, and the inner axis in what
            the middle joint turns, m.
        damage: What happens to the samples.
        stops: How the table misses.
        shaking: What shakes the unit.
    """

    latitude: float = 34.65 * DEG
    gravity: float = 9.797
    azimuth: float = 0.0
    tilt: tuple[float, float] = LEVEL
    rates: tuple[float, ...] = (30 * DEG, 60 * DEG)
    turns: float = 1.0
    acceleration: float = 200 * DEG
    slew: float = 60 * DEG
    dwell: float = 30.0
    joint_rate: float = 100.0
    encoder_noise: float = 0.0
    encoder_step: float = 0.0
    joint_jitter: float = 0.0
    stamp_jitter: float = 0.0
    clock: float = 0.0
    offset: float = 0.0
    program: tuple[Stop, ...] = ()
    flaws: tuple[Flaw, Flaw, Flaw] = NO_FLAWS
    misses: tuple[Vector, Vector] = (NOTHING, NOTHING)
    damage: Damage | None = None
    stops: Stops | None = None
    shaking: Shaking | None = None


@dataclass
class Recording:
    """What a recorder would hold: lists of equal length, stamps in seconds."""

    imu_stamps: list[float] = field(default_factory=list)
    gyro: list[Vector] = field(default_factory=list)
    accel: list[Vector] = field(default_factory=list)
    joint_stamps: list[float] = field(default_factory=list)
    angles: list[Vector] = field(default_factory=list)


# Spelled out: called for every sample, they are half of what a session costs.
def times(a: Matrix, b: Matrix) -> Matrix:
    (c, d, e), (f, g, h), (i, j, k) = a
    (p, q, r), (s, t, u), (v, w, x) = b
    return (
        (c * p + d * s + e * v, c * q + d * t + e * w, c * r + d * u + e * x),
        (f * p + g * s + h * v, f * q + g * t + h * w, f * r + g * u + h * x),
        (i * p + j * s + k * v, i * q + j * t + k * w, i * r + j * u + k * x),
    )


def applied(a: Matrix, v: Vector) -> Vector:
    x, y, z = v
    (c, d, e), (f, g, h), (i, j, k) = a
    return c * x + d * y + e * z, f * x + g * y + h * z, i * x + j * y + k * z


def turned_into(a: Matrix, v: Vector) -> Vector:
    """A vector from the axes that a matrix turns."""
    x, y, z = v
    (c, d, e), (f, g, h), (i, j, k) = a
    return c * x + f * y + i * z, d * x + g * y + j * z, e * x + h * y + k * z


def transposed(a: Matrix) -> Matrix:
    (c, d, e), (f, g, h), (i, j, k) = a
    return (c, f, i), (d, g, j), (e, h, k)


def about(axis: int, angle: float) -> Matrix:
    """The rotation by an angle about one of the axes."""
    c, s = math.cos(angle), math.sin(angle)
    if axis == 0:
        return (1.0, 0.0, 0.0), (0.0, c, -s), (0.0, s, c)
    if axis == 1:
        return (c, 0.0, s), (0.0, 1.0, 0.0), (-s, 0.0, c)
    return (c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)


def rotation_vector(r: Matrix) -> Vector:
    """The axis times the angle of a small rotation."""
    x, y, z = r[2][1] - r[1][2], r[0][2] - r[2][0], r[1][0] - r[0][1]
    sine = 0.5 * math.sqrt(x * x + y * y + z * z)
    if sine == 0.0:
        return NOTHING
    scale = 0.5 * math.atan2(sine, 0.5 * (r[0][0] + r[1][1] + r[2][2] - 1)) / sine
    return scale * x, scale * y, scale * z


@dataclass
class Motion:
    """One joint from rest to rest with constant acceleration, rate and deceleration.

    And by how much joints and table are off before and after it.
    """

    start: float
    joint: int
    before: Vector
    way: float
    rate: float
    acceleration: float
    missing: tuple[Vector, Vector] = (NOTHING, NOTHING)
    leaning: tuple[Vector, Vector] = (NOTHING, NOTHING)

    def __post_init__(self) -> None:
        way = abs(self.way)
        self.rate = min(self.rate, math.sqrt(way * self.acceleration))
        self.ramp = self.rate / self.acceleration
        self.end = self.start + (way / self.rate + self.ramp if way else 0.0)
        self.after = self._angles(self.end)

    def angles(self, time: float) -> Vector:
        return self.after if time >= self.end else self._angles(time)

    def _angles(self, time: float) -> Vector:
        t = min(max(time - self.start, 0.0), self.end - self.start)
        remaining = self.end - self.start - t
        if t < self.ramp:
            done = 0.5 * self.acceleration * t * t
        elif remaining < self.ramp:
            done = abs(self.way) - 0.5 * self.acceleration * remaining * remaining
        else:
            done = self.rate * (t - 0.5 * self.ramp)
        moved = list(self.before)
        moved[self.joint] += math.copysign(done, self.way)
        return tuple(moved)

    def off(self, angles: Vector) -> tuple[Vector, Vector]:
        """By how much joints, and the table about east, north and up, are off at these angles.

        What was off goes as it speeds up, and what will be off comes as it slows down.
        """
        ramp = 0.5 * self.acceleration * self.ramp**2
        done = abs(angles[self.joint] - self.before[self.joint])
        remaining = abs(self.way) - done
        old, new = max(0.0, 1 - done / ramp), max(0.0, 1 - remaining / ramp)
        missing = list(self.missing[0])
        missing[self.joint] = sum(
            share * errors[self.joint]
            for share, errors in zip((old, new), self.missing, strict=True)
        )
        leaning = tuple(old * a + new * b for a, b in zip(*self.leaning, strict=True))
        return tuple(missing), leaning


def joints_of(axes: str) -> Vector:
    """Find outer, middle and inner, multiples of 90 deg, that point the body as asked."""
    for o, m, i in product(range(4), repeat=3):
        r = attitude((o * math.pi / 2, m * math.pi / 2, i * math.pi / 2), World())
        if all(
            abs(r[row][k] - COMPASS[letter][row]) < 1e-9
            for k, letter in enumerate(axes)
            for row in range(3)
        ):
            return o * math.pi / 2, m * math.pi / 2, i * math.pi / 2
    raise AssertionError(axes)


def attitude(angles: Vector, world: World) -> Matrix:
    """Body to east, north, up."""
    if world.flaws is not NO_FLAWS:
        result = times(leaning(world.tilt), about(2, world.azimuth))
        for axis, angle, flaw in zip((2, 0, 2), angles, world.flaws, strict=True):
            result = times(result, joint_turned(axis, angle, flaw))
        return result
    table = on_level(world.azimuth + angles[0], angles[1], angles[2])
    return table if world.tilt == LEVEL else times(leaning(world.tilt), table)


def on_level(outer: float, middle: float, inner: float) -> Matrix:
    """Rz(outer) Rx(middle) Rz(inner), multiplied out."""
    co, so = math.cos(outer), math.sin(outer)
    cm, sm = math.cos(middle), math.sin(middle)
    ci, si = math.cos(inner), math.sin(inner)
    return (
        (co * ci - so * cm * si, -co * si - so * cm * ci, so * sm),
        (so * ci + co * cm * si, -so * si + co * cm * ci, -co * sm),
        (sm * si, sm * ci, cm),
    )


@cache
def leaning(tilt: tuple[float, float]) -> Matrix:
    """The table's base to east, north, up."""
    return times(about(0, tilt[0]), about(1, tilt[1]))


def place(angles: Vector, world: World, arm: Vector) -> Vector:
    """Where a point of the unit is, east, north, up, m: on a table without flaws."""
    p = applied(about(2, angles[2]), arm)
    p = applied(about(0, angles[1]), _sum(world.misses[1], p))
    p = applied(about(2, world.azimuth + angles[0]), _sum(world.misses[0], p))
    return applied(leaning(world.tilt), p)


@lru_cache(maxsize=8)
def joint_turned(axis: int, reads: float, flaw: Flaw) -> Matrix:
    """How a joint with its flaws stands when its encoder reads an angle."""
    first, second = (axis + 1) % 3, (axis + 2) % 3
    turned = about(axis, reads - course(flaw.encoder, reads) + flaw.zero)
    if flaw.lean != LEVEL:
        turned = times(times(about(second, flaw.lean[1]), about(first, flaw.lean[0])), turned)
    if flaw.wobble == STEADY:
        return turned
    wobble = times(
        about(first, course(flaw.wobble[0], reads)), about(second, course(flaw.wobble[1], reads))
    )
    return times(wobble, turned)


def course(errors: Course, angle: float) -> float:
    if errors is FLAT:
        return 0.0
    c1, s1, c2, s2 = errors
    return (
        c1 * math.cos(angle)
        + s1 * math.sin(angle)
        + c2 * math.cos(2 * angle)
        + s2 * math.sin(2 * angle)
    )


def twelve(world: World) -> tuple[Stop, ...]:
    """The twelve positions, with rate tests at three of them."""
    return tuple(
        Stop(joints_of(axes), world.rates if k in TURNED_AT else ())
        for k, axes in enumerate(TWELVE)
    )


def schedule(world: World) -> list[Motion]:
    """All motions of the program, rate tests included, in order."""
    motions: list[Motion] = []
    program = world.program or twelve(world)
    now, at = 2.0, program[0].angles

    def move(joint: int, way: float, rate: float) -> None:
        nonlocal now, at
        motion = Motion(now, joint, at, way, rate, world.acceleration)
        motions.append(motion)
        now, at = motion.end + 1.5, motion.angles(motion.end)

    for stop in program:
        for joint in range(3):
            way = stop.angles[joint] - at[joint]
            way -= 2 * math.pi * round(way / (2 * math.pi))
            if abs(way) > 1e-9:
                move(joint, way, world.slew)
        for rate in stop.rates:
            ramps = rate * rate / world.acceleration
            turn = 2 * math.pi * math.ceil(world.turns + ramps / (2 * math.pi) - 1e-9)
            move(stop.turning, turn, rate)
            move(stop.turning, -turn, rate)
        now += world.dwell
    if world.stops is not None:
        _miss(motions, world.stops)
    return motions


def _miss(motions: list[Motion], stops: Stops) -> None:
    """Let every motion end wrong by an error of its joint, and one of the whole table."""
    noise = normals(random.Random(stops.seed))
    missing, leaning = NOTHING, NOTHING
    for motion in motions:
        after = list(missing)
        after[motion.joint] = stops.joints * next(noise)
        leans = tuple(size * next(noise) for size in (stops.tilt, stops.tilt, stops.heading))
        motion.missing = missing, (after[0], after[1], after[2])
        motion.leaning = leaning, leans
        missing, leaning = motion.missing[1], motion.leaning[1]


def angles_at(
    motions: list[Motion], sample_times: Iterator[float]
) -> Iterator[tuple[Vector, Motion]]:
    """Yield the joint angles at times that rise, and the last motion that has begun."""
    queue = list(reversed(motions))
    current = queue.pop()
    for time in sample_times:
        while queue and time >= queue[-1].start:
            current = queue.pop()
        yield current.angles(time), current


def record(world: World, unit: Unit, seed: int, given: Inputs | None = None) -> Recording:
    """Run the session sample by sample, of a unit that is given what the table does or this."""
    motions = schedule(world)
    duration = motions[-1].end + 1.5 + world.dwell
    recording = Recording()
    noise = copy(_drawn(seed))
    _record_joints(recording, world, motions, duration, noise)
    _record_imu(recording, world, unit, noise, given)
    if world.damage is None:
        return recording
    return damaged(recording, world.damage, random.Random(f'damage {seed}'))


@lru_cache(maxsize=1)
def _drawn(seed: int) -> Iterator[float]:
    """The normal deviates of a seed, to be copied: what one session has drawn the next one has."""
    return tee(normals(random.Random(seed)), 1)[0]


def normals(draw: random.Random) -> Iterator[float]:
    """Yield normal deviates: by Box and Muller, two at a time."""
    while True:
        angle, length = 2 * math.pi * draw.random(), math.sqrt(-2 * math.log(1 - draw.random()))
        yield math.cos(angle) * length
        yield math.sin(angle) * length


def damaged(recording: Recording, damage: Damage, draw: random.Random) -> Recording:
    """Send the samples of an IMU over a bad line, one by one."""
    sent = Recording(joint_stamps=recording.joint_stamps, angles=recording.angles)
    count = len(recording.imu_stamps)
    free = 0.0
    held: tuple[Vector, Vector] = NOTHING, NOTHING
    owed: tuple[Vector, Vector] = NOTHING, NOTHING
    for k, made in enumerate(recording.imu_stamps):
        said = recording.gyro[k], recording.accel[k]
        if any(begin <= made < begin + damage.frozen for begin in damage.freezes):
            said = held
        held = said
        ready = recording.imu_stamps[
            min(k // damage.bunch * damage.bunch + damage.bunch, count) - 1
        ]
        if draw.random() < damage.late:
            ready += damage.delay * draw.random()
        # Whoever is held up holds up the others; a queue empties by one in 50 us.
        stamp = free = max(ready, free + 5e-5)
        if damage.tick:
            stamp = math.floor(stamp / damage.tick) * damage.tick
        times_sent = 0 if draw.random() < damage.lost else 1 + (draw.random() < damage.twice)
        if damage.differenced:
            said = _sum(said[0], owed[0]), _sum(said[1], owed[1])
            owed = (NOTHING, NOTHING) if times_sent else said
        for _ in range(times_sent):
            sent.imu_stamps.append(stamp)
            sent.gyro.append(said[0])
            sent.accel.append(said[1])
    return sent


def _record_joints(
    recording: Recording,
    world: World,
    motions: list[Motion],
    duration: float,
    noise: Iterator[float],
) -> None:
    count = int(duration * world.joint_rate)
    instants = [k / world.joint_rate for k in range(count)]
    exact = not world.encoder_noise and not world.joint_jitter
    if exact:
        # What a noisy table draws is passed over, so that an IMU on either has the same noise.
        next(islice(noise, 3 * count, 3 * count), None)
    for time, (true, _) in zip(instants, angles_at(motions, iter(instants)), strict=True):
        angles = true
        jitter = world.joint_jitter * next(noise) if world.joint_jitter else 0.0
        recording.joint_stamps.append(time + jitter)
        if not exact:
            angles = tuple(a + world.encoder_noise * next(noise) for a in true)
        if world.encoder_step:
            step = world.encoder_step
            angles = tuple(math.floor(a / step + 0.5) * step for a in angles)
        recording.angles.append(angles)


def _record_imu(
    recording: Recording,
    world: World,
    unit: Unit,
    noise: Iterator[float],
    inputs: Inputs | None,
) -> None:
    dt = 1.0 / unit.rate
    motions = schedule(world)
    moved = Moved(world, unit, motions[0])
    afterwards = sample_integrals(world, unit.rate, unit.late)
    earth = earth_of(world)
    sums = [0.0] * 6
    told, counted = [0] * 6, [0] * 6
    sensors, floor = range(6), math.floor
    pulses = [unit.gyro_pulse] * 3 + [unit.accel_pulse] * 3
    walks = [w * math.sqrt(dt) for w in [unit.gyro_walk] * 3 + [unit.accel_walk] * 3]
    changes = unit.gyro_growth or unit.accel_growth or any(unit.gyro_drift + unit.accel_drift)
    changes = changes or any(unit.gyro_fade + unit.accel_fade)
    changes = changes or unit.stepping < math.inf
    given: tuple[Vector, Vector] | None = None
    swung = Swung(world.shaking)
    if inputs is None:
        at_once = sample_integrals(world, unit.rate, 0.0)
        inputs = [(now[0], later[1]) for now, later in zip(at_once, afterwards, strict=True)]
    for k, (turned, pushed) in enumerate(inputs):
        _, _, middle, motion = afterwards[k]
        # Samples at rest are given the same, and answer the same but for what changes with time.
        if middle is not None or given is None or given[0] is not turned or given[1] is not pushed:
            given = (turned, pushed) if middle is None else None
            beyond = [NOTHING] * 3
            if middle is not None:
                beyond = moved.on(middle, earth, motion, (k + 1) * dt - unit.late)
            answers = _answer(unit.gyro_m, unit.gyro_d, turned, dt)
            if any(map(any, beyond)):
                # Each accelerometer feels all three components where it is.
                answers += [
                    _answer(unit.accel_m, unit.accel_d, _sum(pushed, more), dt)[c]
                    for c, more in enumerate(beyond)
                ]
            else:
                answers += _answer(unit.accel_m, unit.accel_d, pushed, dt)
            if unit.terms is not None:
                added = _added(unit.terms, turned, pushed, dt)
        outputs = _changed(answers, unit, (k + 0.5) * dt, dt) if changes else answers
        if unit.terms is not None:
            outputs = [a + b for a, b in zip(outputs, added, strict=True)]
        if world.shaking is not None:
            more = swung.on((k + 1) * dt, motion)
            outputs = [a + b for a, b in zip(outputs, more, strict=True)]
        for c in sensors:
            sums[c] += outputs[c] + walks[c] * next(noise)
            if unit.counts:
                counted[c] = floor(sums[c] / dt / pulses[c] + 0.5)
                sums[c] = 0.0
                continue
            total = floor(sums[c] / pulses[c])
            counted[c], told[c] = total - told[c], total
        time = (k + 1) * dt
        stamp = time * (1 + world.clock) + world.offset + world.stamp_jitter * next(noise)
        recording.imu_stamps.append(stamp)
        recording.gyro.append((float(counted[0]), float(counted[1]), float(counted[2])))
        recording.accel.append((float(counted[3]), float(counted[4]), float(counted[5])))


class Swung:
    """What shaking adds to each sample: how far a swing of angle and velocity went meanwhile."""

    def __init__(self, shaking: Shaking | None) -> None:
        self.shaking = shaking
        draw = random.Random(5)
        tones = () if shaking is None else shaking.tones
        self.phases = [[2 * math.pi * draw.random() for _ in tones] for _ in range(6)]
        self.reached = [0.0] * 6

    def on(self, time: float, motion: Motion) -> list[float]:
        assert self.shaking is not None
        size, since = 1.0, time
        if self.shaking.decay:
            since = time - motion.end
            size = math.exp(-since / self.shaking.decay) if since > 0 else 0.0
        elif self.shaking.moving:
            along = (time - motion.start) / max(motion.end - motion.start, 1e-9)
            size = math.sin(math.pi * along) ** 2 if 0 < along < 1 else 0.0
        now = []
        for c, phases in enumerate(self.phases):
            swing = 0.0
            for tone, phase in zip(self.shaking.tones, phases, strict=True):
                # Ringing begins from rest at the end of a motion.
                begun = 0.0 if self.shaking.decay else phase
                swing += math.sin(2 * math.pi * tone * since + begun) / (2 * math.pi * tone)
            now.append(size * swing * (self.shaking.rate if c < 3 else self.shaking.force))
        went = [a - b for a, b in zip(now, self.reached, strict=True)]
        self.reached = now
        return went


class Moved:
    """What accelerometers feel of where they are: how much faster each one is after a sample.

    Velocities are differences of places a tenth of a millisecond before and after: however it
    moves, from rest to rest they add up to nothing.
    """

    def __init__(self, world: World, unit: Unit, motion: Motion) -> None:
        self.world = world
        self.arms = [_sum(unit.arm, place) for place in unit.places]
        self.together = unit.places == ZERO
        self.still = unit.arm == NOTHING and unit.places == ZERO and not any(map(any, world.misses))
        self.places, self.speeds = self.at(motion, 0.0)

    def at(self, motion: Motion, time: float) -> tuple[list[Vector], list[Vector]]:
        if self.still:
            return [NOTHING] * 3, [NOTHING] * 3
        places, speeds, step = [], [], 1e-4
        now, early, late = (motion.angles(t) for t in (time, time - step, time + step))
        for arm in self.arms[:1] if self.together else self.arms:
            places.append(place(now, self.world, arm))
            if early == late:
                speeds.append(NOTHING)
                continue
            a, b = (place(angles, self.world, arm) for angles in (early, late))
            speeds.append(tuple((v - u) / (2 * step) for u, v in zip(a, b, strict=True)))
        return (places * 3, speeds * 3) if self.together else (places, speeds)

    def on(self, middle: Matrix, earth: Vector, motion: Motion, time: float) -> list[Vector]:
        """By accelerometer, along the body axes half way through the sample that ends then."""
        if self.still:
            return [NOTHING] * 3
        places, speeds = self.at(motion, time)
        sample_integrals = []
        for c in range(3):
            way = tuple(b - a for a, b in zip(self.places[c], places[c], strict=True))
            faster = tuple(b - a for a, b in zip(self.speeds[c], speeds[c], strict=True))
            coriolis = tuple(2 * v for v in _cross(earth, way))
            sample_integrals.append(turned_into(middle, _sum(faster, coriolis)))
        self.places, self.speeds = places, speeds
        return sample_integrals


def _sum(a: Vector, b: Vector) -> Vector:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def earth_of(world: World) -> Vector:
    return 0.0, EARTH_RATE * math.cos(world.latitude), EARTH_RATE * math.sin(world.latitude)


@lru_cache(maxsize=3)
def sample_integrals(
    world: World, rate: float, late: float
) -> list[tuple[Vector, Vector, Matrix | None, Motion]]:
    """What every sample is given: integrals of rate and specific force in body axes, so much late.

    And the attitude in its middle where it moves, and which motion it is.
    """
    motions = schedule(world)
    duration = motions[-1].end + 1.5 + world.dwell
    dt = 1.0 / rate
    count = int(duration * rate)
    halves = angles_at(motions, (0.5 * dt * k - late for k in range(2 * count + 1)))
    earth = earth_of(world)

    def given_at(angles: Vector, motion: Motion) -> Given:
        if world.stops is None:
            r = attitude(angles, world)
        else:
            missing, leans = motion.off(angles)
            r = times(about(0, leans[0]), times(about(1, leans[1]), about(2, leans[2])))
            r = times(r, attitude(_sum(angles, missing), world))
        return r, turned_into(r, earth), turned_into(r, (0.0, 0.0, world.gravity))

    before, motion = next(halves)
    first = given_at(before, motion)
    still: tuple[Vector, Vector, Vector] | None = None
    given: list[tuple[Vector, Vector, Matrix | None, Motion]] = []
    for _ in range(count):
        (middle, on_way), (after, motion) = next(halves), next(halves)
        r_middle = None
        if after == before and still is not None and still[0] == after:
            turned, pushed = still[1], still[2]
        else:
            half_way, last = given_at(middle, on_way), given_at(after, motion)
            turned, pushed = _felt(first, half_way, last, dt)
            still = (after, turned, pushed) if after == before else None
            r_middle, first = half_way[0], last
        before = after
        given.append((turned, pushed, r_middle, motion))
    return given


def _felt(first: Given, middle: Given, last: Given, dt: float) -> tuple[Vector, Vector]:
    """Integrals of angular rate and specific force over a sample, body axes."""
    table = rotation_vector(times(transposed(first[0]), last[0]))
    # The Earth turns the east-north-up frame: Simpson's rule of its rate in body axes.
    earth = simpson(first[1], middle[1], last[1], dt)
    return _sum(earth, table), simpson(first[2], middle[2], last[2], dt)


def simpson(first: Vector, middle: Vector, last: Vector, dt: float) -> Vector:
    """The integral of what is known at the ends and half way."""
    (a, b, c), (d, e, f), (g, h, i) = first, middle, last
    return (
        a / 6 * dt + 4 / 6 * d * dt + g / 6 * dt,
        b / 6 * dt + 4 / 6 * e * dt + h / 6 * dt,
        c / 6 * dt + 4 / 6 * f * dt + i / 6 * dt,
    )


def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _answer(m: Matrix, d: Vector, given: Vector, dt: float) -> list[float]:
    extra = applied(m, given)
    return [given[c] + extra[c] + d[c] * dt for c in range(3)]


def _changed(answers: list[float], unit: Unit, since: float, dt: float) -> list[float]:
    """What the answers have become so long after the start."""
    outputs = []
    for c, answer in enumerate(answers):
        growth, bias, drift, fade, step = (
            (unit.gyro_growth, unit.gyro_d, unit.gyro_drift, unit.gyro_fade, unit.gyro_step)
            if c < 3
            else (
                unit.accel_growth,
                unit.accel_d,
                unit.accel_drift,
                unit.accel_fade,
                unit.accel_step,
            )
        )
        grown = answer + growth * since * (answer - bias[c % 3] * dt)
        remaining = fade[c % 3] * math.exp(-since / unit.fading)
        if since >= unit.stepping:
            remaining += step[c % 3]
        outputs.append(grown + (drift[c % 3] * since + remaining) * dt)
    return outputs


def _added(terms: Terms, turned: Vector, pushed: Vector, dt: float) -> list[float]:
    """What the terms add to the six outputs of a sample."""
    w, f = [v / dt for v in turned], [v / dt for v in pushed]
    mixed = f[0] * f[1], f[0] * f[2], f[1] * f[2]
    added = []
    for c in range(3):
        rate = terms.senses[c] * abs(w[c]) + terms.by_square[c] * f[c] ** 2
        rate += terms.size[c] * w[c] * abs(w[c]) / FAST + terms.square[c] * w[c] ** 2 / FAST
        rate += terms.cube[c] * w[c] ** 3 / FAST**2
        rate += terms.bent[c] * math.copysign(max(abs(w[c]) - KNEE, 0.0), w[c])
        rate += sum(terms.by_force[c][j] * f[j] for j in range(3))
        added.append(rate * dt)
    for c in range(3):
        push = terms.accel_square[c] * f[c] ** 2 + terms.accel_signs[c] * abs(f[c])
        push += terms.accel_cube[c] * f[c] ** 3
        push += sum(terms.accel_cross[c][j] * mixed[j] for j in range(3))
        added.append(push * dt)
    return added
