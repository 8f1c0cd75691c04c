"""The estimators of a counter's mean rate against counters drawn from their definition."""

import numpy as np
import pytest
from bound import variance_between
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2

from imu_calib.common.stream import Floats
from imu_calib.segmentation.counters import (
    end_points,
    mean_rate,
    rate_between,
    smoothed_ends,
)

PERIOD = 0.01
SAMPLES = 12000


def counter(rng: np.random.Generator, rate: float, walk: float, samples: int = SAMPLES) -> Floats:
    """Increments of floor(phase + rate t + walk W(t)), the definition of an ideal counter."""
    steps = rate * PERIOD + walk * np.sqrt(PERIOD) * rng.standard_normal(samples)
    true = rng.uniform() + np.concatenate([[0.0], np.cumsum(steps)])
    return np.diff(np.floor(true))


# Pulses per second: horizontal and vertical accelerometers of Cao 2022's unit, its gyros at rest,
# and a gyro that turns; walk in pulses per root second from 0.012 (m/s)/sqrt(h), 0.05 deg/sqrt(h).
CASES = [
    (0.1, 0.02),
    (0.3, 0.02),
    (2.0, 0.02),
    (45.0, 0.02),
    (890.6, 0.02),
    (899.9, 0.02),
    (0.0, 0.386),
    (2.0, 0.386),
    (-7.0, 0.386),
    (4601.0, 0.386),
]


@pytest.mark.parametrize(('rate', 'walk'), CASES)
def test_the_stated_variance_is_the_true_one(rate, walk):
    rng = np.random.default_rng(7)
    runs = 300
    estimates = [mean_rate(counter(rng, rate, walk), PERIOD, walk) for _ in range(runs)]
    normalised = [(m.rate - rate) / np.sqrt(m.variance(walk)) for m in estimates]
    # The spread of `runs` normal values is known to 1 / sqrt(2 runs) = 4 %; 3.5 of those.
    assert np.sqrt(np.mean(np.square(normalised))) == pytest.approx(
        1.0, abs=3.5 / np.sqrt(2 * runs)
    )


def test_the_end_points_of_a_noise_free_counter_err_by_a_sixth_of_a_pulse_squared():
    # c (1 - c) averaged over the fraction c is 1/6 (docs/mathematics.md, 'Noise of a mean').
    rng = np.random.default_rng(3)
    rates = rng.uniform(0, 1000, 4000)
    errors = [end_points(counter(rng, r, 0.0, 100), PERIOD).rate - r for r in rates]
    # A fourth of the errors' kurtosis bounds the spread of a mean square: 2 % here, 4 of those.
    assert np.var(errors) == pytest.approx(1 / 6, rel=0.08)


def test_the_accelerometer_of_table_1_reaches_the_walk():
    # docs/mathematics.md, 'Noise of a mean': 120 s, ends 3.9 micro-g, optimum 1.9, 1.86 of it walk.
    rng = np.random.default_rng(5)
    best = mean_rate(counter(rng, 890.6, 0.02), PERIOD, 0.02)
    plain = end_points(counter(rng, 890.6, 0.02), PERIOD)
    micro_g = 0.01 / 9.80665e-6
    assert np.sqrt(plain.variance(0.02)) * micro_g == pytest.approx(3.9, abs=0.1)
    assert np.sqrt(best.variance(0.02)) * micro_g == pytest.approx(1.9, abs=0.05)


@pytest.mark.parametrize('levels', [4.5, 5.85, 6.5])
def test_what_is_chosen_does_not_follow_the_phase(levels):
    # Six levels are passed or five, by the phase: to do otherwise with five errs by 0.3.
    runs, samples, period, walk = 1600, 1200, 0.05, 0.02
    rate = -levels / (samples * period)
    rng = np.random.default_rng(21)
    errors = []
    for phase in (np.arange(runs) + 0.5) / runs:
        steps = rng.standard_normal(samples) * walk * np.sqrt(period) + rate * period
        pulses = np.diff(np.floor(phase + np.append(0.0, np.cumsum(steps))))
        found = mean_rate(pulses, period, walk)
        errors.append((found.rate - rate) / np.sqrt(found.variance(walk)))
    assert abs(np.mean(errors)) < 4 / np.sqrt(runs)


def test_white_weights_are_those_of_generalised_least_squares():
    # The tridiagonal covariance written out and inverted is the independent truth.
    rng = np.random.default_rng(2)
    walk, n = 3.0, 40
    pulses = counter(rng, 2325.0, walk, n)
    covariance = (
        walk**2 * PERIOD * np.eye(n) + (2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)) / 12
    )
    weights = np.linalg.solve(covariance, np.ones(n))
    found = smoothed_ends(pulses, PERIOD, walk)
    assert found.rate == pytest.approx(weights @ pulses / weights.sum() / PERIOD, rel=1e-12)
    # 23 pulses and a quarter of one pass in a sample: no harmonic of the error stays in phase, and
    # with a walk of 0.3 pulses a sample the error is white indeed.
    assert found.variance(walk) == pytest.approx(1 / weights.sum() / PERIOD**2, rel=0.02)


@given(st.integers(-100, 100), st.integers(0, 2**31))
def test_whole_pulses_per_sample_shift_the_rate_and_nothing_else(whole, seed):
    pulses = counter(np.random.default_rng(seed), 12.3, 0.1, 2000)
    base = mean_rate(pulses, PERIOD, 0.1)
    shifted = mean_rate(pulses + whole, PERIOD, 0.1)
    assert shifted.rate == pytest.approx(base.rate + whole / PERIOD, rel=1e-12, abs=1e-9)
    assert shifted.variance(0.1) == pytest.approx(base.variance(0.1), rel=1e-9)


# A turn of 6 s at 60 deg/s: along the axis and across it, by the gyros of Cao 2022's unit and by
# accelerometers; the last is in step with the samples, which hides the fraction of a pulse.
TURNING = [(27692.3, 0.386), (40.0, 0.386), (3.0, 0.386), (890.6, 0.02), (700.0, 0.1)]
FIRST, LAST = 150.37, 750.37


@pytest.mark.parametrize(('rate', 'walk'), TURNING)
def test_the_stated_variance_between_two_instants_is_the_true_one(rate, walk):
    rng = np.random.default_rng(11)
    runs = 600
    found = [
        rate_between(counter(rng, rate, walk, 900), PERIOD, FIRST, LAST, walk) for _ in range(runs)
    ]
    normalised = [(m.rate - rate) / np.sqrt(m.variance(walk)) for m in found]
    assert np.sqrt(np.mean(np.square(normalised))) == pytest.approx(
        1.0, abs=3.5 / np.sqrt(2 * runs)
    )


def test_between_two_instants_next_to_nothing_is_lost_to_the_bound():
    # Two bare readings, a sixth of a pulse squared together, would cost 9 % of the variance.
    rate, walk = 27692.3, 0.386
    floor = variance_between(6.0, 1.5, walk, 1.0, PERIOD)
    errors = []
    rng = np.random.default_rng(12)
    for _ in range(600):
        found = rate_between(counter(rng, rate, walk, 900), PERIOD, FIRST, LAST, walk)
        errors.append(found.rate - rate)
        assert found.variance(walk) < 1.01 * floor
    assert np.mean(np.square(errors)) < 1.01 * floor * chi2.isf(1e-3, len(errors)) / len(errors)


def test_what_swings_once_between_the_instants_averages_to_nothing():
    # The horizontal Earth rate on a turning axis, 12 deg/h in pulses of 7.8 arcsec, at any phase.
    time = (np.arange(900) + 0.5 - FIRST) * PERIOD
    for phase in (0.0, 1.0, 2.0):
        swing = 1.6 * np.cos(2 * np.pi * time / 6.0 + phase)
        pulses = (4.0 + swing) * PERIOD
        found = rate_between(pulses, PERIOD, FIRST, LAST, 0.386)
        assert found.rate == pytest.approx(4.0, abs=0.005 * np.sqrt(found.variance(0.386)))


def test_without_spare_samples_a_cut_shares_the_one_that_straddles_it():
    found = rate_between(np.array([1.0, 2, 3, 4]), 1.0, 0.5, 2.25, 0.0)
    assert found.rate == pytest.approx((0.5 + 2 + 0.75) / 1.75)
    # Half of the first, the second and a quarter of the third, squared.
    assert found.walk_gain == pytest.approx((0.25 + 1 + 0.0625) / 1.75**2)
