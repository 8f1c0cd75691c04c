"""A hand that begins and ends turns gently, and trembles: K_g was 1 to 2 percent too small."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import imu_calib

RATE = 200
UP = np.array([0.0, 0.0, 9.80739])
EARTH = 7.292115e-5 * np.array([0.0, np.cos(np.radians(48.1)), np.sin(np.radians(48.1))])


def slow(rng: np.random.Generator, count: int, low: float, high: float) -> np.ndarray:
    """Noise (count, 3) between two frequencies, Hz, of one root mean square."""
    frequency = np.fft.rfftfreq(count, 1 / RATE)
    gain = (frequency / low) ** 2 / (1 + (frequency / low) ** 2) / (1 + (frequency / high) ** 2)
    spectrum = np.fft.rfft(rng.normal(size=(count, 3)), axis=0) * gain[:, None]
    noise = np.fft.irfft(spectrum, count, axis=0)
    return noise / noise.std(axis=0)


def session(seed: int, tremor: float) -> tuple[np.ndarray, np.ndarray]:
    """Record an ideal unit in twenty attitudes, written down from rotations alone.

    Turns are along minimum-jerk paths (Flash and Hogan 1985, eq. 1), and the hand trembles by
    `tremor` (rad) about each axis, slowly.
    """
    rng = np.random.default_rng(seed)
    attitudes = Rotation.random(20, random_state=seed)
    path = [attitudes[0]] * (5 * RATE)
    for before, after in pairwise(attitudes):
        turn = (before.inv() * after).as_rotvec()
        share = np.linspace(0, 1, int(RATE * max(0.8, 1.09 * np.linalg.norm(turn))))
        share = share**3 * (10 - 15 * share + 6 * share**2)
        path += [before * Rotation.from_rotvec(turn * s) for s in share]
        path += [after] * int(3.8 * RATE)
    count = len(path)
    held = Rotation.concatenate(path) * Rotation.from_rotvec(tremor * slow(rng, count, 0.05, 2.0))
    rates = (held[:-1].inv() * held[1:]).as_rotvec() * RATE
    gyro = np.vstack([rates[:1], rates]) + held.inv().apply(EARTH)
    gyro += np.radians(rng.normal(0, 0.05, (count, 3)))
    accel = held.inv().apply(UP) + 0.03 * slow(rng, count, 2.0, 8.0)
    return gyro, accel + rng.normal(0, 0.04, (count, 3))


@pytest.mark.parametrize('tremor', [0.08, 0.24])
def test_scale_factors_of_gyros_are_not_too_small(tremor: float) -> None:
    """They were so in every session, by up to six deviations."""
    errors, off = [], []
    for seed in range(1, 4):
        found = imu_calib.calibrate(
            session(seed, np.radians(tremor)),
            rate=RATE,
            latitude=48.1,
            height=520,
            plan='free_positions',
        ).calibration
        errors += found.values[:3].tolist()
        off += (found.values[:3] / found.std[:3]).tolist()
    assert np.abs(off).max() < 3.0
    assert np.abs(errors).max() < 1e-3
    assert min(errors) < 0 < max(errors)
