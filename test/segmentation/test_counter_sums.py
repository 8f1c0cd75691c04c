"""The weights on a counter's increments and the variances that they leave, by sums term by term."""

import math
from itertools import pairwise

import numpy as np
import pytest

from imu_calib.common.stream import Floats
from imu_calib.segmentation.counters import (
    MeanRate,
    all_in_row,
    any_in_row,
    best_passages,
    block_edges,
    by_columns,
    end_points,
    mean_and_blocks,
    mean_rate,
    passages,
    rate_between,
    smoothed_ends,
)

PERIOD = 0.02
READING = 1 / 12


def counted(rate: float, samples: int, phase: float = 0.3) -> Floats:
    """Increments of a counter without noise, rate in pulses per sample."""
    return np.diff(np.floor(phase + rate * np.arange(samples + 1)))


def best_of(pulses: Floats, walk: float) -> MeanRate | None:
    """The rate from first passages, where it is the best."""
    found = passages(pulses, PERIOD, walk)
    return found and best_passages(found.rate(PERIOD), pulses, PERIOD, walk)


def clinging(step: float, growth: float, lags: int) -> Floats:
    """Covariance of reading errors: 64 harmonics of a saw, and what is left, at once."""
    found = np.zeros(lags)
    alone = READING
    for m in range(1, 65):
        power = 1 / (2 * math.pi**2 * m**2)
        alone -= power
        z = np.exp(2j * math.pi * m * step - 2 * math.pi**2 * m**2 * growth)
        found += power * (z ** np.arange(lags)).real
    found[0] += alone
    return found


def variance_of(weights: Floats, covariance: Floats) -> float:
    """Of a weighted sum of what clings by its lag."""
    n = len(weights)
    lags = abs(np.arange(n)[:, None] - np.arange(n))
    return float(weights @ covariance[lags] @ weights)


# A whole segment


def test_end_points_are_the_sum_over_the_time():
    found = end_points(np.array([3.0, 4.0, 2.0, 1.0]), 0.5)
    assert found.rate == 5.0
    assert found.walk_gain == 0.5
    assert found.quantisation_variance == pytest.approx(1 / 6 / 4)
    assert found.variance(3.0) == pytest.approx(9 * 0.5 + 1 / 24)


@pytest.mark.parametrize(('samples', 'walk'), [(40, 0.3), (40, 3.0), (200, 20.0), (3, 0.5)])
def test_ends_fade_out_as_they_say(samples, walk):
    pulses = counted(3.37, samples)
    growth = walk**2 * PERIOD
    kappa = math.acosh(1 + 6 * growth)
    middle = (samples + 1) / 2
    weights = np.array(
        [
            1 - math.cosh(kappa * (k - middle)) / math.cosh(kappa * middle)
            for k in range(1, samples + 1)
        ]
    )
    time = weights.sum() * PERIOD
    found = smoothed_ends(pulses, PERIOD, walk)
    assert found.rate == pytest.approx(weights @ pulses / time)
    assert found.walk_gain == pytest.approx(PERIOD * (weights**2).sum() / time**2, rel=1e-9)
    # Both ends, each averaged with weights (1 - f) f^k that go on without end.
    fade = math.exp(-kappa)
    lags = math.ceil(45 / kappa)
    end = (1 - fade) * fade ** np.arange(lags)
    error = 2 * variance_of(end, clinging(pulses.mean(), growth, lags))
    assert found.quantisation_variance == pytest.approx(error / time**2, rel=1e-6)
    assert smoothed_ends(pulses, PERIOD, 0.0) is None


def test_the_smallest_variance_is_taken():
    pulses = counted(3.4, 100)
    for walk in (0.0, 1e-3, 0.3, 5.0):
        plain = end_points(pulses - 3, PERIOD)
        smooth = smoothed_ends(pulses - 3, PERIOD, walk)
        best = best_of(pulses - 3, walk)
        wanted = best or min(
            [plain] + ([smooth] if smooth else []), key=lambda one: one.variance(walk)
        )
        found = mean_rate(pulses, PERIOD, walk)
        assert found.rate == pytest.approx(wanted.rate + 3 / PERIOD)
        assert found.walk_gain == wanted.walk_gain
        assert found.quantisation_variance == wanted.quantisation_variance


# Passages


def test_passages_are_the_first_of_each_new_count():
    pulses = np.array([0.0, -1, 0, 1, -1, -2, 0, -1, 1, 0, -1, -1])
    # -0, -1, -1, 0, -1, -3, -3, -4, -3, -3, -4, -5
    found = passages(pulses, 1.0, 0.1)
    assert found.index.tolist() == [1, 5, 7, 11]
    assert found.level.tolist() == [1.0, 3.0, 4.0, 5.0]
    assert found.drift == pytest.approx(-5 / 12)
    rate = found.rate(1.0)
    assert rate.rate == pytest.approx(-(5 - 1) / 10)
    assert rate.walk_gain == pytest.approx(0.1)
    assert rate.quantisation_variance == pytest.approx(2 * (5 / 12) ** 2 / 12 / 100)


def test_a_drift_leads_by_six_deviations_over_three_levels():
    pulses = np.tile([0.0, 1.0], 8)
    # 8 pulses in 16 samples of 2 s: drift sqrt(n) against the walk in a sample.
    limit = 0.5 * 4 / 6 / math.sqrt(2.0)
    assert passages(pulses, 2.0, limit * 0.999) is not None
    assert passages(pulses, 2.0, limit * 1.001) is None
    assert passages(np.array([0.0, 1, 0, 1]), 1.0, 1e-6) is None
    assert passages(np.array([0.0, 1, 0, 1, 1]), 1.0, 1e-6) is not None


def test_passages_are_taken_where_they_are_better_and_enough():
    walk = 1e-4
    for rate, wanted in ((0.0101, True), (0.02, True), (0.0045, False)):
        # 500 samples: five levels, ten, and two.
        assert (best_of(counted(rate, 500), walk) is not None) is wanted
    quick = counted(0.41, 500)
    passed = passages(quick, PERIOD, walk)
    alone = passed.rate(PERIOD)
    for loud in (1e-4, 0.1, 1.0, 3.0):
        found = best_of(quick, loud)
        # One level is lost on the way from end to end.
        time = (1 - 1 / (abs(alone.rate) * 10)) * 10
        own = loud**2 / time + 2 * (alone.rate * PERIOD) ** 2 * READING / time**2
        ends = [end_points(quick, PERIOD), smoothed_ends(quick, PERIOD, loud)]
        other = min(one.variance(loud) for one in ends if one is not None)
        assert (found is not None) is bool(own < other)


def test_what_rings_is_not_read_by_its_passages():
    rising = counted(0.1, 200, 0.05)
    assert best_of(rising, 1e-4) is not None
    # Ten pulses on the way that are counted back at the end.
    ringing = rising.copy()
    ringing[150] += 10
    ringing[-1] -= 10
    assert best_of(ringing, 1e-4) is None


# Between two instants


@pytest.mark.parametrize(
    ('first', 'last', 'samples', 'walk'),
    [
        (10.3, 50.8, 60, 2.0),
        (10.3, 50.8, 60, 0.0),
        (0.4, 39.5, 40, 2.0),
        (3.0, 43.0, 60, 0.5),
        (10.3, 50.8, 60, 40.0),
        (20.5, 24.7, 60, 1.0),
    ],
)
def test_counts_at_both_instants_are_read_from_those_around(first, last, samples, walk):
    pulses = counted(2.83, samples)
    growth = walk**2 * PERIOD
    kappa = math.acosh(1 + 6 * growth)
    reach = max(1.0, min(first, samples - last, (last - first) / 4, 256.0))
    if walk:
        reach = max(1.0, min(reach, 12 / kappa))
    count = np.concatenate([[0.0], np.cumsum(pulses)])
    step = pulses[math.floor(first) : math.ceil(last)].mean()
    centres, levels, left = [], [], 0.0
    on_counts = np.zeros(samples + 1)
    for instant, sign in ((first, -1), (last, 1)):
        window = np.zeros(samples + 1)
        for k in range(samples + 1):
            away = reach - abs(k - instant)
            if away > 0:
                window[k] = math.sinh(kappa * away) if walk else away
        window /= window.sum()
        centres.append(sum(k * w for k, w in enumerate(window)))
        levels.append(float(window @ count))
        left += variance_of(window, clinging(step, growth, samples + 1))
        on_counts += sign * window
    seconds = (centres[1] - centres[0]) * PERIOD
    found = rate_between(pulses, PERIOD, first, last, walk)
    assert found.rate == pytest.approx((levels[1] - levels[0]) / seconds)
    squares = sum(sum(on_counts[k + 1 :]) ** 2 for k in range(samples))
    assert found.walk_gain == pytest.approx(PERIOD * squares / seconds**2)
    assert found.quantisation_variance == pytest.approx(left / seconds**2, rel=1e-6)


# Blocks


def test_blocks_are_equal_and_long_enough():
    assert block_edges(10, 1.0, 3.0) == [(0, 3), (3, 6), (6, 10)]
    assert block_edges(10, 0.5, 5.0) == [(0, 10)]
    assert block_edges(10, 0.5, 6.0) == [(0, 10)]
    assert block_edges(10, 1.0, 0.1) == [(k, k + 1) for k in range(10)]
    assert block_edges(9, 2.0, 6.0) == [(0, 3), (3, 6), (6, 9)]


def test_a_quick_counter_is_cut_into_equal_times():
    pulses = counted(40.37, 100)
    mean, found = mean_and_blocks(pulses, PERIOD, 1.0, 0.5)
    assert mean == mean_rate(pulses, PERIOD, 1.0)
    assert [middle for middle, _ in found] == pytest.approx([0.25, 0.75, 1.25, 1.75])
    for (_, rate), (a, b) in zip(found, pairwise([0, 25, 50, 75, 100]), strict=True):
        assert rate == mean_rate(pulses[a:b], PERIOD, 1.0)


@pytest.mark.parametrize('whole', [0.0, 7.0])
def test_a_slow_counter_is_cut_where_it_passes_a_new_count(whole):
    pulses = counted(0.0501, 1000, 0.96)
    walk, seconds = 1e-4, 3.0
    mean, found = mean_and_blocks(pulses + whole, PERIOD, walk, seconds)
    assert mean == mean_rate(pulses + whole, PERIOD, walk)
    index = [k for k in range(1000) if pulses[k]]
    cuts = [index[0]]
    for k in index:
        if (k - cuts[-1]) * PERIOD >= seconds - 1e-9:
            cuts.append(k)
    assert len(found) == len(cuts) - 1 > 4
    for (middle, rate), (a, b) in zip(found, pairwise(cuts), strict=True):
        # The count is new at the end of its sample.
        assert middle == pytest.approx(((a + 1) + (b + 1)) / 2 * PERIOD)
        gained = sum(pulses[a + 1 : b + 1])
        time = (b - a) * PERIOD
        assert rate.rate == pytest.approx(gained / time + whole / PERIOD)
        assert rate.walk_gain == pytest.approx(1 / time)
        drift = pulses.sum() / 1000
        assert rate.quantisation_variance == pytest.approx(2 * drift**2 / 12 / time**2)


# What holds in rows of flags is what numpy says of them


@pytest.mark.parametrize('columns', [1, 3, 6])
@pytest.mark.parametrize('rows', [0, 1, 200])
def test_column_by_column_rows_are_what_they_are(rows, columns):
    flags = np.random.default_rng(0).random((rows, columns)) < 0.5
    assert any_in_row(flags).tolist() == flags.any(axis=1).tolist()
    assert all_in_row(flags).tolist() == flags.all(axis=1).tolist()


@pytest.mark.parametrize('rows', [1, 63, 64, 200])
def test_columns_reduced_abreast_are_what_they_are(rows):
    values = np.random.default_rng(0).normal(size=(rows, 6))
    flags = values > 1.0
    assert by_columns(np.maximum, values).tolist() == values.max(axis=0).tolist()
    assert by_columns(np.maximum, values[:, :3]).tolist() == values[:, :3].max(axis=0).tolist()
    assert by_columns(np.logical_or, flags).tolist() == flags.any(axis=0).tolist()
    assert by_columns(np.logical_and, flags).tolist() == flags.all(axis=0).tolist()
