"""Six holds and three turns by hand, by plain loops that share no code with the package.

Attitudes are matrices that body axes turn by; every sample is worked out from its middle.
"""

import math
import random
from dataclasses import dataclass

from other_world import Matrix, Vector, about, applied, times, transposed, turned_into

EARTH = 7.292115e-5
"""rad/s."""
STEP = 0.01
"""s, between samples."""
MOVE = 1.6
"""From one hold to the next, and of a whole turn, s."""

X_UP = ((0.0, -1.0, 0.0), (0.0, 0.0, -1.0), (1.0, 0.0, 0.0))
X_DOWN = ((0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (-1.0, 0.0, 0.0))
Y_UP = ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0))
Y_DOWN = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))
Z_UP = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
Z_DOWN = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))
FACES: tuple[Matrix, ...] = (X_UP, X_DOWN, Y_UP, Y_DOWN, Z_UP, Z_DOWN)
"""Body axes in east, north and up, one row for each of these."""


@dataclass(frozen=True)
class HeldUnit:
    """A unit and where it is held; rad, m, s."""

    gyro: Matrix
    accel: Matrix
    gyro_bias: Vector
    accel_bias: Vector
    gyro_walk: float
    accel_walk: float
    latitude: float
    gravity: float


Samples = list[tuple[float, Vector, Vector]]
"""Stamp, s, and what gyros and accelerometers read."""


def held(unit: HeldUnit, leans: list[tuple[float, float]], seed: int) -> Samples:
    """Record a session whose six holds and three turns lean about east and north, rad.

    The heading of each is another. Turns are about the vertical, whatever leans, and begin and end
    in holds of two seconds.
    """
    draw = random.Random(seed)
    samples: Samples = []
    before: Matrix | None = None
    for k, (east, north) in enumerate(leans):
        face = FACES[k] if k < len(FACES) else FACES[2 * (k - len(FACES))]
        upright = times(about(2, draw.uniform(-math.pi, math.pi)), face)
        attitude = times(times(about(0, east), about(1, north)), upright)
        if before is not None:
            _turn(samples, unit, before, *_way(before, attitude), draw)
        _stand(samples, unit, attitude, 3.0 if k < len(FACES) else 2.0, draw)
        if k >= len(FACES):
            _turn(
                samples, unit, attitude, turned_into(attitude, (0.0, 0.0, 1.0)), 2 * math.pi, draw
            )
            _stand(samples, unit, attitude, 2.0, draw)
        before = attitude
    return samples


def _way(first: Matrix, last: Matrix) -> tuple[Vector, float]:
    """The body axis and the angle from one attitude to another."""
    r = times(transposed(first), last)
    x, y, z = r[2][1] - r[1][2], r[0][2] - r[2][0], r[1][0] - r[0][1]
    size = math.sqrt(x * x + y * y + z * z)
    if size < 1e-9:
        # Half a turn: a column of 1 + r lies along its axis.
        x, y, z = max(
            ((r[0][k] + (k == 0), r[1][k] + (k == 1), r[2][k] + (k == 2)) for k in range(3)),
            key=lambda column: math.hypot(*column),
        )
        size = math.hypot(x, y, z)
        return (x / size, y / size, z / size), math.pi
    return (x / size, y / size, z / size), math.atan2(size, r[0][0] + r[1][1] + r[2][2] - 1)


def _about(axis: Vector, angle: float) -> Matrix:
    """Rodrigues' formula."""
    x, y, z = axis
    c, s = math.cos(angle), math.sin(angle)
    d = 1 - c
    return (
        (c + d * x * x, d * x * y - s * z, d * x * z + s * y),
        (d * y * x + s * z, c + d * y * y, d * y * z - s * x),
        (d * z * x - s * y, d * z * y + s * x, c + d * z * z),
    )


def _stand(
    samples: Samples, unit: HeldUnit, attitude: Matrix, seconds: float, draw: random.Random
) -> None:
    for _ in range(round(seconds / STEP)):
        _read(samples, unit, attitude, (0.0, 0.0, 0.0), draw)


def _turn(
    samples: Samples,
    unit: HeldUnit,
    before: Matrix,
    axis: Vector,
    angle: float,
    draw: random.Random,
) -> None:
    """Turn by angle (u - sin(2 pi u) / (2 pi)), u from 0 to 1: from rest to rest without a jerk."""
    count = round(MOVE / STEP)

    def gone(u: float) -> float:
        return angle * (u - math.sin(2 * math.pi * u) / (2 * math.pi))

    for k in range(count):
        rate = (gone((k + 1) / count) - gone(k / count)) / STEP
        middle = times(before, _about(axis, gone((k + 0.5) / count)))
        _read(samples, unit, middle, (rate * axis[0], rate * axis[1], rate * axis[2]), draw)


def _read(
    samples: Samples, unit: HeldUnit, attitude: Matrix, turning: Vector, draw: random.Random
) -> None:
    c, s = math.cos(unit.latitude), math.sin(unit.latitude)
    earth = turned_into(attitude, (0.0, EARTH * c, EARTH * s))
    rate = tuple(a + b for a, b in zip(turning, earth, strict=True))
    force = turned_into(attitude, (0.0, 0.0, unit.gravity))
    read = []
    for answer, given, bias, walk in (
        (unit.gyro, rate, unit.gyro_bias, unit.gyro_walk),
        (unit.accel, force, unit.accel_bias, unit.accel_walk),
    ):
        noise = walk / math.sqrt(STEP)
        clean = applied(answer, given)
        read.append(tuple(v + b + draw.gauss(0, noise) for v, b in zip(clean, bias, strict=True)))
    samples.append(((len(samples) + 1) * STEP, read[0], read[1]))
