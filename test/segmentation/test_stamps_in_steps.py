"""Stamps of a clock that advances in steps as long as a sample interval: 15.6 ms on Windows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from other_sessions import MEDIUM, NAVIGATION, errors, fed
from other_world import Damage, World

from imu_calib.common.errors import NotObservable
from imu_calib.common.stream import Stamps
from imu_calib.segmentation.stamps import read_grid, sampling_times

TICK = 1 / 64
IN_STEPS = World(damage=Damage(tick=TICK))
GRADES = {'medium': MEDIUM, 'navigation': NAVIGATION, 'rates': replace(MEDIUM, counts=True)}


def set_apart(stamp: Stamps) -> Stamps:
    """Return stamps, ns, with samples of one stamp a nanosecond apart, as the intake has them."""
    number = np.arange(len(stamp))
    first = np.diff(stamp, prepend=-1) != 0
    return np.asarray(stamp + number - np.maximum.accumulate(np.where(first, number, 0)))


@pytest.mark.parametrize('grade', GRADES)
def test_a_session_is_as_good_as_with_stamps_that_do_not_step(grade: str) -> None:
    unit = GRADES[grade]
    found = fed(IN_STEPS, unit, find_terms=True).finish().calibration
    whole = fed(World(), unit, find_terms=True).finish().calibration
    off = errors(found, unit)
    assert np.abs(off).max() < 4.5, np.round(off, 1)
    # Of a hundred samples a second, 15.6 ms spread over each turn: 0.1 ppm of its rate, and more.
    assert (found.std[:24] < 2 * whole.std[:24]).all()
    assert found.parameters[24:] == whole.parameters[24:]
    assert any('stamps of the IMU come in steps of 15.6 ms' in f for f in found.findings)


@pytest.mark.parametrize('lost', [0.1, 0.4])
def test_samples_missing_between_such_stamps_are_not_guessed(lost: float) -> None:
    """With 40 % missing all scale factors were off by 35 %."""
    world = World(damage=Damage(tick=TICK, lost=lost))
    words = r'^\d+ of \d+ .* left out: .* stamps in steps of .* ms do not show how many'
    with pytest.raises(NotObservable, match=words):
        fed(world, MEDIUM).finish()


@pytest.mark.parametrize('rate', [50.0, 64.5, 100.0, 200.0, 400.0])
@pytest.mark.parametrize('digits', [9, 3])
def test_the_line_through_them_has_the_interval_of_the_samples(rate: float, digits: int) -> None:
    made = np.arange(round(60 * rate)) / rate + 0.0123
    came = np.floor(np.floor(made / TICK) * TICK * 10**digits) * 10 ** (9 - digits)
    stamp = set_apart(came.astype(np.int64))
    grid = read_grid(stamp)
    assert grid.tick == pytest.approx(TICK, rel=0.05)
    assert (grid.index == np.arange(len(stamp))).all()
    assert grid.period == pytest.approx(1 / rate, abs=4 * grid.period_std)
    assert grid.period_std * rate < 2e-5
    assert sampling_times(stamp)[0] is stamp


@pytest.mark.parametrize('rate', [100.0, 200.0, 400.0])
@pytest.mark.parametrize('lost', [0.02, 0.05, 0.1, 0.2, 0.4])
def test_no_count_is_read_from_them_however_many_are_missing(rate: float, lost: float) -> None:
    kept = np.flatnonzero(np.random.default_rng(2).random(round(60 * rate)) >= lost)
    came = np.rint(np.floor((kept / rate + 0.0123) / TICK) * TICK * 1e9).astype(np.int64)
    assert not read_grid(set_apart(came)).is_counted


@pytest.mark.parametrize('rate', [100.0, 200.0, 400.0])
@pytest.mark.parametrize('tick', [TICK, 0.04])
def test_a_reader_that_misses_some_polls_misses_no_samples(rate: float, tick: float) -> None:
    rng = np.random.default_rng(1)
    made = np.arange(round(60 * rate)) / rate + 0.0123
    polls = np.arange(1, 60 / tick + 20) * tick
    polls = polls[rng.random(len(polls)) > 0.05]
    came = np.rint(polls[np.searchsorted(polls, made)] * 1e9).astype(np.int64)
    grid = read_grid(set_apart(came))
    assert grid.is_counted
    assert (grid.index == np.arange(len(came))).all()
    assert grid.period * rate == pytest.approx(1, abs=1e-5)


def test_stamps_that_are_late_one_by_one_are_no_steps() -> None:
    rng = np.random.default_rng(3)
    stamp = np.arange(12_000) * 10_000_000 + np.rint(rng.normal(size=12_000) * 2e5).astype(int)
    stamp[rng.choice(12_000, 40, replace=False)] += rng.integers(4_000_000, 9_000_000, 40)
    grid = read_grid(np.sort(stamp))
    assert grid.tick == 0
    assert grid.is_counted
    assert (grid.index == np.arange(12_000)).all()


def test_lost_samples_of_regular_stamps_are_no_steps() -> None:
    rng = np.random.default_rng(1)
    for share in (0.02, 0.05, 0.1, 0.3):
        kept = np.flatnonzero(rng.random(3000) >= share)
        grid = read_grid(kept * 10_000_000)
        assert grid.tick == 0
        assert (grid.index == kept - kept[0]).all()
