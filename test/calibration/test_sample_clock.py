"""The sample interval: by the stamps, past gaps and jumps, the same however the stream is cut."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imu_calib.calibration.sample_clock import SampleClock

NS = 1_000_000_000
START = 1_700_000_000 * NS


def timed(stamps, cuts=()):
    clock = SampleClock()
    edges = [0, *sorted(cuts), len(stamps)]
    parts = [clock.time_samples(stamps[a:b]).interval for a, b in pairwise(edges)]
    return np.concatenate([*parts, clock.finish().interval]), clock


def regular(count, period_ns):
    return START + np.rint(np.arange(count) * period_ns).astype(np.int64)


def test_the_interval_is_that_of_the_stamps_clock_from_the_first_sample_on():
    # 100 Hz by a quartz that is 50 ppm fast.
    intervals, clock = timed(regular(5000, 0.01 * NS * (1 - 50e-6)))
    assert len(intervals) == 5000
    assert intervals == pytest.approx(0.01 * (1 - 50e-6), rel=1e-7)
    assert clock.irregular_steps == clock.lost == 0


def test_stamps_in_whole_microseconds_do_not_show():
    # 1/3000 s is 333.3 us: single steps are 333 or 334, a thousand ppm off.
    stamps = START + np.rint(np.arange(6000) / 3000 * 1e6).astype(np.int64) * 1000
    intervals, _ = timed(stamps)
    # Rounding moves either end of a window by half a microsecond; a full one spans 341 ms.
    assert np.abs(intervals[1100:] * 3000 - 1).max() < 1e-6 / (1024 / 3000)


def test_jitter_of_a_millisecond_is_averaged():
    rng = np.random.default_rng(0)
    stamps = regular(8000, 0.01 * NS) + np.rint(rng.normal(0, 1e-3, 8000) * NS).astype(np.int64)
    intervals, _ = timed(stamps)
    error = intervals[1100:] / 0.01 - 1
    assert error.std() == pytest.approx(2**0.5 * 1e-3 / 10.24, rel=0.3)


def test_a_gap_and_a_jump_back_are_no_sample_interval():
    stamps = np.delete(regular(3000, 0.005 * NS), slice(1000, 1100))
    stamps[2000:] -= 3600 * NS
    intervals, clock = timed(stamps)
    assert intervals == pytest.approx(0.005, rel=1e-12)
    assert clock.irregular_steps == 2


def test_a_new_rate_is_learnt():
    stamps = np.concatenate([regular(2000, 0.01 * NS), regular(2000, 0.001 * NS) + 30 * NS])
    intervals, _ = timed(stamps)
    assert intervals[:2000] == pytest.approx(0.01, rel=1e-12)
    assert intervals[2040:] == pytest.approx(0.001, rel=1e-12)


@settings(max_examples=60)
@given(st.data())
def test_how_the_stream_is_cut_carries_no_meaning(data):
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32)))
    steps = np.full(3000, 5_000_000) + rng.integers(-400_000, 400_000, 3000)
    for _ in range(data.draw(st.integers(0, 6))):
        first = int(rng.integers(0, 2900))
        length = int(rng.choice([1, 5, 33, 80]))
        steps[first : first + length] = int(rng.choice([-NS, 0, 1_000_000, 20_000_000, NS]))
    stamps = START + np.cumsum(steps)
    whole, clock = timed(stamps)
    cuts = rng.integers(0, 3001, int(rng.integers(0, 60)))
    parts, other = timed(stamps, cuts)
    assert np.array_equal(whole, parts)
    assert (clock.irregular_steps, clock.lost) == (other.irregular_steps, other.lost)
    alone, _ = timed(stamps[:300], range(1, 300))
    assert np.array_equal(alone, timed(stamps[:300])[0])
