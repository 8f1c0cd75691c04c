"""Sessions by hand as people record them, written down from the physics and not from the package.

A unit is turned from attitude to attitude along minimum-jerk paths (Flash and Hogan 1985, eq. 1)
about one axis each, and trembles all the time about all three: a narrow band at 8 to 12 Hz. What
gyros and accelerometers read follows from the rotation matrices alone, by differences.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from imu_calib.common.stream import ImuBlock
from imu_calib.model.sensors import SensorModel

GRAVITY = 9.797
LATITUDE = np.radians(49.6)
EARTH = 7.292115e-5 * np.array([0.0, np.cos(LATITUDE), np.sin(LATITUDE)])
EPOCH = 1_650_000_000_000_000_000
_FINER = 8
_LINES = 24


@dataclass(frozen=True)
class Shaky:
    """A session: its samples, when it was held (s), and the sample interval (s)."""

    block: ImuBlock
    holds: np.ndarray
    period: float


def shaky(
    unit: SensorModel,
    *,
    rate: float,
    scales: tuple[float, float] = (0.0, 0.0),
    tremble: float = 0.0,
    noise: tuple[float, float] = (0.0, 0.0),
    holds: int = 24,
    jitter: float = 0.0,
    lost: float = 0.0,
    limit: float = np.inf,
    swaying: tuple[int, float] | None = None,
    sliding: tuple[int, float] | None = None,
    attitudes: Rotation | None = None,
    seed: int = 0,
) -> Shaky:
    """Record a session that begins in the middle of a turn.

    Args:
        unit: The sensors.
        rate: Samples a second.
        scales: (rad/s, m/s^2) per count; 0 for values in SI.
        tremble: Root mean square about each axis, rad/s.
        noise: White, of a sample: rad/s and m/s^2.
        holds: How many.
        jitter: Of a stamp, s: it comes late by anything up to this, in order.
        lost: Share of the samples that never come, one at a time.
        limit: End of the gyros' range, rad/s.
        swaying: A hold that leans to and fro slowly, and by how much, rad.
        sliding: A hold that turns on about its axes, and at which rate about each, rad/s.
        attitudes: Of the holds, and the one before; of any direction if not given.
        seed: Of attitudes, lengths, tremble and noise.
    """
    rng = np.random.default_rng([seed, 83])
    turn, still = rng.uniform(1.2, 2.2, holds), rng.uniform(3.0, 5.0, holds)
    begins = np.cumsum(turn + still) - turn[0] / 2 - still
    ends = begins + still
    times = np.arange(0.0, ends[-1], 1 / (rate * _FINER))
    times = times[: (len(times) - 1) // _FINER * _FINER + 1]
    drawn = Rotation.random(holds + 1, random_state=int(rng.integers(1 << 30)))
    attitudes = drawn if attitudes is None else attitudes
    steps = (attitudes[:-1].inv() * attitudes[1:]).as_rotvec()
    # R_nb: of the last hold, turned on about one body axis, and trembling about it.
    after = np.clip(np.searchsorted(begins - turn, times, side='right') - 1, 0, holds - 1)
    u = np.clip((times - begins[after]) / turn[after] + 1, 0.0, 1.0)
    path = u**3 * (10 - 15 * u + 6 * u**2)
    body = attitudes[:-1][after] * Rotation.from_rotvec(steps[after] * path[:, None])
    body = body * Rotation.from_rotvec(_tremble(times, tremble, rng))
    if swaying is not None:
        hold, lean = swaying
        share = np.clip((times - begins[hold]) / still[hold], 0.0, 1.0)
        cycles = 2 * np.pi * share[:, None] * np.array([1.0, 0.5, 1.0])
        body = body * Rotation.from_rotvec(lean * np.sin(cycles))
    if sliding is not None:
        hold, pace = sliding
        # The next turn begins where it ends, and leads to where it would have led.
        remains = np.where(after > hold, np.where(after == hold + 1, 1 - path, 0.0), 1.0)
        slid = pace * np.clip(times - begins[hold], 0.0, still[hold]) * remains
        body = body * Rotation.from_rotvec(slid[:, None] * np.array([1.0, -1.0, 1.0]))
    angles = (body[:-1].inv() * body[1:]).as_rotvec()
    angles += body.inv().apply(EARTH)[1:] / (rate * _FINER)
    gyro = angles.reshape(-1, _FINER, 3).sum(axis=1) * rate
    force = body.inv().apply([0.0, 0.0, GRAVITY])[1:].reshape(-1, _FINER, 3).mean(axis=1)
    gyro, accel = unit.predict(gyro, force)
    gyro = np.clip(gyro, -limit, limit)
    read = [
        _counted(values + spread * rng.standard_normal(values.shape), scale)
        for values, spread, scale in zip((gyro, accel), noise, scales, strict=True)
    ]
    late = np.random.default_rng([seed, 84])
    sampled = (np.arange(len(gyro)) + 1) / rate + jitter * late.random(len(gyro))
    stamp = EPOCH + np.rint(np.maximum.accumulate(sampled) * 1e9).astype(np.int64)
    stamp += np.arange(len(stamp))
    kept = late.random(len(gyro)) >= lost
    block = ImuBlock(stamp[kept], *(values[kept] for values in read))
    return Shaky(block, np.column_stack([begins, ends]), 1 / rate)


def _tremble(times: np.ndarray, size: float, rng: np.random.Generator) -> np.ndarray:
    """Angles of a hand: lines at 8 to 12 Hz whose rates have the root mean square `size`."""
    angles = np.zeros((len(times), 3))
    if size:
        for axis in range(3):
            for frequency in rng.uniform(8.0, 12.0, _LINES):
                swing = 2 * np.pi * frequency
                phase = rng.uniform(0, 2 * np.pi)
                angles[:, axis] += (
                    np.sqrt(2 / _LINES) * size / swing * np.sin(swing * times + phase)
                )
    return angles


def _counted(values: np.ndarray, scale: float) -> np.ndarray:
    return np.rint(values / scale) if scale else values
