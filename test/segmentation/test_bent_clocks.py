"""A crystal that warms stamps the samples: its clock bends against that of the table."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import other_sessions
import pytest
from extent import again
from other_sessions import MEDIUM, NAVIGATION, errors, fed, recorded
from other_world import Unit, World

from imu_calib.common.stream import ImuBlock, JointBlock
from imu_calib.segmentation.clock import ClockSample, fit_clock

PPM = 1e-6
UNITS = {'medium': MEDIUM, 'navigation': NAVIGATION, 'rates': replace(MEDIUM, counts=True)}
WARMING = 150.0  #: s.


@pytest.mark.parametrize('ppm', [5, 20])
@pytest.mark.parametrize('grade', ['navigation', again('medium'), again('rates')])
def test_seconds_follow_the_curve(grade: str, ppm: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 5 ppm nothing was said, and K_g was off by six deviations; 20 ppm were a warm-up."""

    def blocks(world: World, unit: Unit, seed: int) -> tuple[JointBlock, ImuBlock]:
        of_table, of_imu = recorded(world, unit, seed)
        passed = (of_imu.stamp - of_imu.stamp[0]) * 1e-9
        ahead = ppm * PPM * WARMING * (1 - np.exp(-passed / WARMING))
        return of_table, replace(of_imu, stamp=of_imu.stamp + np.rint(ahead * 1e9).astype(int))

    monkeypatch.setattr(other_sessions, 'recorded', blocks)
    unit = UNITS[grade]
    found = fed(World(dwell=20.0), unit, find_terms=True).finish().calibration
    off = errors(found, unit)
    assert np.abs(off).max() < 4.5, np.round(off, 1)
    assert not found.parameters[24:]
    assert any('clocks of IMU and table bend by' in one for one in found.findings)


def offsets(scatter: float, bend: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    time = np.sort(np.random.default_rng(seed).uniform(0, 600, 25))
    noise = scatter * np.random.default_rng(seed + 10**6).standard_normal(25)
    return time, 0.1 + 30e-6 * time + bend * np.exp(-time / 150) + noise


def test_the_rate_of_each_part_is_that_of_the_curve_there() -> None:
    time, offset = offsets(2e-6, 1e-3, 0)
    fit = fit_clock([ClockSample(1e9 * t, o) for t, o in zip(time, offset, strict=True)])
    assert fit.bend is not None
    for start in range(50, 500, 50):
        end = start + 40
        found = fit.rate + fit.rate_over((start + 0.1) * 1e9, (end + 0.1) * 1e9)
        true = 30e-6 + 1e-3 * (np.exp(-end / 150) - np.exp(-start / 150)) / 40
        assert found == pytest.approx(true, abs=5 * fit.bend.rate_std)
    assert fit.bend.rate_std < 0.2 * PPM


def test_even_clocks_do_not_bend_by_chance() -> None:
    for seed in range(500):
        time, offset = offsets(1e-5, 0.0, seed)
        samples = [ClockSample(1e9 * t, o) for t, o in zip(time, offset, strict=True)]
        assert fit_clock(samples).bend is None, seed
