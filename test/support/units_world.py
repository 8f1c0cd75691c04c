"""Several units on one table, simulated with plain arrays: it shares no code with the package.

R = Rz(azimuth + outer) Rx(middle) Rz(inner) in east, north, up, on a base that is tilted. A joint
that has moved stands off what its encoder reads until it moves again. SI units.
"""

from dataclasses import dataclass

import numpy as np

EARTH, LATITUDE, GRAVITY = 7.292115e-5, np.deg2rad(34.65), 9.797
ARCSEC = np.pi / 180 / 3600
ATTITUDES = np.deg2rad(
    [
        [0, 0, 0], [180, 0, 0], [0, 180, 0], [180, 180, 0], [0, 90, 0], [180, 90, 0],
        [0, -90, 0], [180, -90, 0], [0, 90, 90], [180, 90, 90], [0, 90, -90], [180, 90, -90],
    ]
)  # fmt: skip
"""Outer, middle and inner: each axis up and down, at two headings."""
SPUN = (0, 4, 8)
EDGE = 10
STEP, DWELL, SLEW, RAMP = 0.02, 25.0, np.deg2rad(60), np.deg2rad(120)


@dataclass
class Table:
    """What all units have in common: read angles and true ones at times, and what they hide."""

    azimuth: float
    tilt: np.ndarray
    time: np.ndarray
    read: np.ndarray
    true: np.ndarray
    stops: list[tuple[int, float, float]]


def moved(read, at, joint, way, rate):
    """Append a trapezoid of one joint to a list of angles."""
    rate = min(rate, np.sqrt(abs(way) * RAMP))
    ramp, length = rate / RAMP, abs(way) / rate + rate / RAMP
    t = np.arange(1, int(np.ceil(length / STEP)) + 1) * STEP
    t = np.minimum(t, length)
    remaining = length - t
    done = np.where(
        t < ramp,
        RAMP * t**2 / 2,
        np.where(remaining < ramp, abs(way) - RAMP * remaining**2 / 2, rate * (t - ramp / 2)),
    )
    for value in done:
        q = at.copy()
        q[joint] += np.sign(way) * value
        read.append(q)
    after = at.copy()
    after[joint] += way
    return after


def turned(seed, arrival=3 * ARCSEC, tilt=5 * ARCSEC):
    """Run the table once."""
    rng = np.random.default_rng(seed)
    at = ATTITUDES[0].copy()
    read, motions = [at] * int(DWELL / STEP), []

    def rest(seconds):
        read.extend([at] * int(seconds / STEP))

    def go(joint, way, rate):
        nonlocal at
        first = len(read)
        at = moved(read, at, joint, way, rate)
        motions.append((joint, first, len(read)))
        rest(1.5)

    for k, goal in enumerate(ATTITUDES):
        for joint in range(3):
            way = (goal[joint] - at[joint] + np.pi) % (2 * np.pi) - np.pi
            if abs(way) > 1e-9:
                go(joint, way, SLEW)
        if k in SPUN:
            for rate in np.deg2rad([30, 60]):
                whole = 2 * np.pi * np.ceil(1 + rate**2 / RAMP / (2 * np.pi))
                go(0, whole, rate)
                go(0, -whole, rate)
        rest(DWELL)
    read = np.array(read)
    error = np.zeros_like(read)
    error[:] = arrival * rng.standard_normal(3)
    stops = []
    for joint, first, last in motions:
        before, after = error[first, joint], arrival * rng.standard_normal()
        # While it turns the encoder is right: what it leaves and what it comes to take 0.2 s.
        error[first:last, joint] = 0.0
        error[first : first + EDGE, joint] = before * np.linspace(1, 0, EDGE)
        error[last - EDGE : last, joint] = after * np.linspace(0, 1, EDGE)
        error[last:, joint] = after
        stops.append((joint, last * STEP, after))
    time = np.arange(len(read)) * STEP
    azimuth = rng.uniform(-np.pi, np.pi)
    return Table(azimuth, tilt * rng.standard_normal(2), time, read, read + error, stops)


def about(axis, angle):
    angle = np.asarray(angle)
    c, s, one, zero = np.cos(angle), np.sin(angle), np.ones_like(angle), np.zeros_like(angle)
    rows = {
        0: [[one, zero, zero], [zero, c, -s], [zero, s, c]],
        1: [[c, zero, s], [zero, one, zero], [-s, zero, c]],
        2: [[c, -s, zero], [s, c, zero], [zero, zero, one]],
    }[axis]
    return np.moveaxis(np.array(rows), [0, 1], [-2, -1])


@dataclass
class Sensors:
    """out = (I + m) input + d, noise, whole pulses; `mount` turns the unit on the fixture."""

    m: np.ndarray
    d: np.ndarray
    walk: tuple[float, float]
    pulse: tuple[float, float]
    mount: np.ndarray


def drawn(rng, walk, pulse, mount):
    return Sensors(
        1e-3 * rng.standard_normal((2, 3, 3)),
        np.array([5e-6, 5e-3])[:, None] * rng.standard_normal((2, 3)),
        walk,
        pulse,
        mount,
    )


def sampled(table, unit, rng):
    """Return counts (n, 6) of the intervals that end at `table.time[1:]`."""
    base = about(0, table.tilt[0]) @ about(1, table.tilt[1])
    a = table.true
    r = (
        base
        @ about(2, table.azimuth + a[:, 0])
        @ about(0, a[:, 1])
        @ about(2, a[:, 2])
        @ unit.mount
    )
    earth = EARTH * np.array([0, np.cos(LATITUDE), np.sin(LATITUDE)])
    axis = earth / EARTH
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    angle = EARTH * STEP
    once = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    step = np.swapaxes(r[:-1], 1, 2) @ once @ r[1:]
    pairs = ((2, 1), (0, 2), (1, 0))
    vee = np.column_stack([step[:, i, j] - step[:, j, i] for i, j in pairs]) / 2
    sine = np.linalg.norm(vee, axis=1)
    scale = np.where(sine > 1e-12, np.arcsin(np.clip(sine, 0, 1)) / np.maximum(sine, 1e-300), 1.0)
    force = GRAVITY * r[:, 2]
    both = [vee * scale[:, None], (force[:-1] + force[1:]) / 2 * STEP]
    counts = []
    for k in range(2):
        out = both[k] @ (np.eye(3) + unit.m[k]).T + unit.d[k] * STEP
        out += unit.walk[k] * np.sqrt(STEP) * rng.standard_normal(out.shape)
        whole = np.floor(np.cumsum(out, axis=0) / unit.pulse[k] + rng.uniform(size=3))
        counts.append(np.diff(whole, axis=0, prepend=0))
    return np.hstack(counts)
