"""What lost samples counted, by least squares and chances written out; walks by their blocks."""

import math
from functools import cache
from math import inf, sqrt
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from imu_calib.common.stream import Floats
from imu_calib.segmentation.gaps import Bridged, bridged, filled_at_steady_rate
from imu_calib.segmentation.statistics import Samples, pooled_walk

PERIOD, PERIOD_NS = 0.01, 10_000_000
WALK = np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])


def samples(rows: Floats, values: Floats, pulse: float = 0.0) -> Samples:
    """Samples of which these rows came in."""
    columns = np.tile(values[:, None], 6) if values.ndim == 1 else values
    stamp = np.asarray(rows) * PERIOD_NS + PERIOD_NS
    return Samples(stamp, columns, np.full(6, pulse), PERIOD, np.zeros(6))


def without(count: int, *lost: int) -> list[int]:
    return [k for k in range(count) if k not in lost]


# Values that are no pulses


def test_eight_on_either_side_are_averaged():
    values = np.random.default_rng(1).normal(0, 1, (60, 6))
    rows = without(60, 3, 30, 31, 55)
    whole = bridged(samples(rows, values[rows]), WALK)
    filled = whole.samples
    assert whole.lost == filled.lost == 4
    assert filled.gaps == 3
    assert filled.stamp.tolist() == [(k + 1) * PERIOD_NS for k in range(60)]
    assert filled.filled is not None
    assert np.flatnonzero(filled.filled).tolist() == [3, 30, 31, 55]
    # Of what came in: three before the first, eight after.
    near = [
        [0, 1, 2, *range(4, 12)],
        [*range(22, 30), *range(32, 40)],
        [*range(47, 55), *range(56, 60)],
    ]
    for lost, used in zip(([3], [30, 31], [55]), near, strict=True):
        for row in lost:
            assert filled.increments[row] == pytest.approx(values[used].mean(axis=0))
    # The noise of those that are lost, and that of the mean in their place.
    left = (1 + 1 / 11) + (2 + 4 / 16) + (1 + 1 / 12)
    assert filled.bridged == pytest.approx(left / 3 * WALK**2 * PERIOD)
    assert np.array_equal(filled.increments[rows], values[rows])


def test_others_that_are_lost_are_not_averaged():
    values = np.arange(40.0) ** 2
    rows = without(40, 20, 22)
    found = bridged(samples(rows, values[rows]), WALK).samples.increments[:, 0]
    # Eight that came in on either side, whatever is lost between.
    assert found[20] == pytest.approx(
        np.mean([values[k] for k in (*range(12, 20), 21, *range(23, 30))])
    )
    assert found[22] == pytest.approx(
        np.mean([values[k] for k in (*range(13, 20), 21, *range(23, 31))])
    )


def test_a_long_gap_is_a_wall():
    rows = [*range(20), *range(50, 70)]
    rows = [k for k in rows if k not in (18, 52)]
    values = np.array([1.0 if k < 30 else 5.0 for k in rows])
    whole = bridged(samples(rows, values), WALK)
    assert whole.lost == 2
    assert whole.samples.increments[18, 0] == 1.0
    assert whole.samples.increments[22, 0] == 5.0
    assert whole.rows.tolist() == [*range(18), -1, 18, 19, 20, -1, *range(21, 38)]


def test_one_on_either_side_may_be_asked_for():
    values = np.arange(40.0) ** 2
    rows = without(40, 20)
    found = bridged(samples(rows, values[rows]), WALK, 1).samples
    assert found.increments[20, 0] == (19**2 + 21**2) / 2
    assert found.bridged == pytest.approx((1 + 1 / 2) * WALK**2 * PERIOD)


@pytest.mark.parametrize(('length', 'filled'), [(1, True), (10, True), (11, False)])
def test_a_tenth_of_a_second_is_the_longest_gap(length, filled):
    rows = without(400, *range(100, 100 + length))
    whole = bridged(samples(rows, np.ones(len(rows))), WALK)
    assert whole.lost == (length if filled else 0)
    assert len(whole.rows) == (400 if filled else 400 - length)


@pytest.mark.parametrize(('lost', 'filled'), [(10, True), (11, False)])
def test_a_tenth_of_all_is_the_most(lost, filled):
    rows = without(100, *range(4, 4 + 8 * lost, 8))
    assert len(rows) == 100 - lost
    assert bridged(samples(rows, np.ones(len(rows))), WALK).lost == (lost if filled else 0)


def test_what_was_delivered_is_no_number_where_it_was_lost():
    values = np.arange(12.0).reshape(4, 3)
    found = Bridged(samples([0], np.ones(1)), np.array([0, -1, 1, 2, 3])).values(values)
    assert found[[0, 2, 3, 4]].tolist() == values.tolist()
    assert np.isnan(found[1]).all()
    assert Bridged(samples([0], np.ones(1)), np.arange(4)).values(values) is values


def test_gaps_are_filled_anew_from_as_many_as_help():
    values = np.arange(60.0) ** 2
    rows = without(60, 30)
    near = bridged(samples(rows, values[rows]), WALK, 1).samples
    again = filled_at_steady_rate(near, WALK)
    used = [*range(22, 30), *range(31, 39)]
    assert again.increments[30, 0] == pytest.approx(values[used].mean())
    plain = samples(rows, values[rows])
    assert filled_at_steady_rate(plain, WALK) is plain


# Counters: gaps filled one by one in a plain loop


@cache
def line(before: int, after: int, missing: int) -> tuple[Floats, float]:
    """Weights of the samples beside a gap in its count, and the sum of squares of the readings'.

    By least squares: one slope through the readings on either side, which the gap sets apart.
    """
    design = [[1.0, -k, 0.0] for k in range(before + 1)]
    design += [[1.0, missing + k, -1.0] for k in range(after + 1)]
    weights = np.linalg.pinv(np.array(design))[2]
    # A sample moves all readings beyond it, seen from the gap.
    shown, further = weights[: before + 1], weights[before + 1 :]
    of_samples = np.concatenate([-np.cumsum(shown[:0:-1]), np.cumsum(further[:0:-1])[::-1]])
    return of_samples, float(weights @ weights)


def stated(a: int, b: int, rate: float, noise: float, missing: int = 1) -> float:
    """Variance of a gap's count from so many samples: its phase or its readings, and the walk."""
    weights, read = line(a, b, missing)
    passed = min(a, b) * abs(rate - round(rate))
    phase = min(0.25, 0.2 / passed**2) if passed else 0.25
    if noise * math.sqrt(min(a, b)) > 1:
        phase = 0.0
    return max(phase, 1.5 * read / 12) + (float(weights @ weights) + missing) * noise**2


def reach_for(rate: float, noise: float) -> int:
    """No further than a gap takes to be sure of it; else what is best."""
    reaches = [2**k for k in range(14)]
    variances = [stated(k, k, rate, noise) for k in reaches]
    sure = [k for k, variance in zip(reaches, variances, strict=True) if variance <= 0.01]
    return sure[0] if sure else reaches[int(np.argmin(variances))]


def chances(pulses: float, variance: float, expected: float, walked: float) -> tuple[float, float]:
    """Mean and variance over whole numbers by what counts say and what the mean rate does."""
    variance = max(variance, 1e-4)
    if variance + walked > 4:
        # Wide ones are averaged by their variances.
        own, other = 1 / variance, 1 / (walked + 1 / 6)
        return (own * pulses + other * expected) / (own + other), 1 / (own + other)
    nodes, weights = np.polynomial.hermite_e.hermegauss(7)
    whole = round(expected) + np.arange(-8, 9)
    nearest = ((whole - pulses) ** 2).min()
    total = mean = square = 0.0
    for n in whole:
        chance = 1e-9
        for node, weight in zip(nodes, weights, strict=True):
            chance += weight * max(0.0, 1 - abs(n - expected - math.sqrt(walked) * node))
        if variance < 0.25:
            chance *= math.exp(-((n - pulses) ** 2 - nearest) / (2 * variance))
        total, mean, square = total + chance, mean + chance * n, square + chance * n * n
    return mean / total, square / total - (mean / total) ** 2


def filled(
    counts: Floats, gaps: list[tuple[int, int]], noise: float, reach: int | None
) -> tuple[Floats, float]:
    """What gaps are filled with, and what they leave of the variance of a sum, pulses squared."""
    came = [k for k in range(len(counts)) if not any(a <= k < b for a, b in gaps)]
    rate = counts[came].mean()
    chosen = reach or reach_for(rate, noise)
    held = counts.astype(float).copy()
    for a, b in gaps:
        held[a:b] = rate
    found = [rate] * len(gaps)
    for _ in range(4):
        before, left = list(found), 0.0
        for k, (a, b) in enumerate(gaps):
            low, high = max(0, a - chosen), min(len(counts), b + chosen)
            m = b - a
            beside = np.concatenate([held[low:a], held[b:high]])
            pulses, variance = float(line(a - low, high - b, m)[0] @ beside), 0.0
            if reach is None:
                spread = stated(a - low, high - b, rate, noise, m)
                pulses, variance = chances(pulses, spread, rate * m, m * noise**2)
            found[k], left = pulses, left + variance
            held[a:b] = pulses / m
        if max(abs(x - y) for x, y in zip(found, before, strict=True)) < 0.05:
            break
    carried = 0.0
    for (a, b), pulses in zip(gaps, found, strict=True):
        whole, m = round(pulses + carried), b - a
        edges = [round(whole * j / m) for j in range(m + 1)]
        held[a:b] = np.diff(edges)
        carried += pulses - whole
    return held, left


@pytest.mark.parametrize('pulse', [1.0, 0.25])
@pytest.mark.parametrize(
    ('rate', 'noise', 'reach'),
    [
        (2.37, 1e-3, None),
        (0.043, 1e-3, None),
        (9.797, 0.5, None),
        (1.5, 0.2, None),
        (3.29, 2.5, None),
        (3.0, 0.0, None),
        (3.25, 0.3, None),
        (0.4, 0.002, None),
        (0.001, 1.5, None),
        (9.797, 0.02, None),
        (2.37, 0.3, 1),
        (2.37, 0.3, 4),
    ],
)
def test_gaps_are_read_one_after_the_other_until_they_settle(rate, noise, reach, pulse):
    rng = np.random.default_rng(7)
    total = np.cumsum(rate + noise * rng.standard_normal(601)) + 0.4
    counts = np.diff(np.floor(total))
    # Near the ends, near each other, and of several samples.
    gaps = [(2, 3), (100, 103), (104, 105), (250, 259), (300, 301), (303, 304), (596, 598)]
    rows = [k for k in range(600) if not any(a <= k < b for a, b in gaps)]
    walk = np.full(6, noise * pulse / sqrt(PERIOD))
    whole = bridged(samples(rows, counts[rows] * pulse, pulse), walk, reach).samples
    wanted, left = filled(counts, gaps, noise, reach)
    assert (whole.increments[:, 0] / pulse).tolist() == pytest.approx(wanted.tolist())
    assert whole.bridged[0] == pytest.approx(left / len(gaps) * pulse**2)


def test_what_comes_after_a_long_gap_tells_nothing_of_one_before_it():
    # 2 pulses a sample before 40 that are missing, 3 after them.
    counts = np.where(np.arange(200) < 100, 2.0, 3.0)
    rows = [k for k in range(200) if k not in (95, 144) and not 100 <= k < 140]
    whole = bridged(samples(rows, counts[rows], 1.0), np.zeros(6), 8)
    assert whole.lost == 2
    assert whole.samples.increments[[95, 104], 0].tolist() == [2.0, 3.0]


@pytest.mark.parametrize('pulse', [1.0, 0.25])
def test_a_counter_gives_back_what_it_counted(pulse):
    counts = np.diff(np.floor(0.3 + 2.37 * np.arange(401)))
    rows = without(400, 100, 101, 102, 250, 390)
    quiet = np.full(6, 1e-6)
    whole = bridged(samples(rows, counts[rows] * pulse, pulse), quiet)
    found = whole.samples.increments[:, 0] / pulse
    assert found[100:103].sum() == pytest.approx(counts[100:103].sum())
    assert found[[250, 390]].tolist() == pytest.approx(counts[[250, 390]].tolist())
    # Whole pulses, spread evenly: 7 over three samples.
    assert counts[100:103].sum() == 7
    assert found[100:103].tolist() == pytest.approx([2.0, 3.0, 2.0])
    assert (whole.samples.bridged < 0.01 * pulse**2).all()


def test_from_one_on_either_side_a_ramp_is_read():
    ramp = 10.0 * np.arange(60)
    rows = without(60, 30, 31)
    whole = bridged(samples(rows, ramp[rows], 1.0), WALK, 1)
    # 290 before and 320 after: as much as both ends' mean twice.
    assert whole.samples.increments[[30, 31], 0].sum() == 610.0
    assert whole.samples.bridged.tolist() == [0.0] * 6


# The random walk by the scatter of blocks


def dwell(rng: np.random.Generator, gains: Floats, rounding: Floats) -> Any:
    """Blocks of unequal lengths about a mean of their own."""
    n = len(gains)
    scatter = np.sqrt(4.0 * gains + rounding) * rng.standard_normal(n)
    rows = np.column_stack([rng.normal() + scatter, gains, rounding, np.arange(n)])
    return SimpleNamespace(blocks=(rows,) * 6)


def criterion(square: float, dwells: list[Floats]) -> float:
    """Twice the negative log likelihood of blocks, each freed of its part of the dwell's mean."""
    total = 0.0
    for mean, gain, rounding, _ in (rows.T for rows in dwells):
        variance = square * gain + rounding
        middle = (mean / variance).sum() / (1 / variance).sum()
        share = (len(mean) - 1) / len(mean)
        total += (share * np.log(variance) + (mean - middle) ** 2 / variance).sum()
    return total


def test_a_walk_is_the_likeliest_beside_what_quantisation_leaves():
    rng = np.random.default_rng(9)
    dwells = [
        dwell(rng, rng.uniform(0.05, 0.2, n), rng.uniform(0.0, 1.0, n)) for n in (6, 9, 14, 2)
    ]
    lone = dwell(rng, np.array([0.1]), np.array([0.3]))
    rows = [one.blocks[0] for one in dwells]
    likeliest = minimize_scalar(criterion, bounds=(0.5, 20.0), args=(rows,)).x
    found = pooled_walk([*dwells, lone])
    assert found.square == pytest.approx(np.full(6, likeliest), rel=1e-4)
    # The information of the blocks, each its part of a degree of freedom.
    information = 0.0
    for _, gain, rounding, _ in (part.T for part in rows):
        share = (len(gain) - 1) / len(gain)
        information += share * ((gain / (likeliest * gain + rounding)) ** 2).sum()
    assert found.deviation == pytest.approx(np.full(6, sqrt(2 / information)), rel=1e-4)
    assert found.freedom == pytest.approx(np.full(6, information * likeliest**2), rel=1e-4)
    nothing = pooled_walk([lone])
    assert nothing.deviation.tolist() == [inf] * 6


# Holds in the hand


@pytest.mark.parametrize('missing', [3, 12, 30])
def test_what_a_trembling_hand_does_in_a_gap_is_known_by_the_rest(missing):
    """The noise is not stated, and what was filled in counted as exact."""
    time = PERIOD * np.arange(400)
    errors, stated = [], []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        phase = rng.uniform(0, 2 * np.pi, (2, 6))
        values = 3 * np.sin(2 * np.pi * 9 * time[:, None] + phase[0]) + rng.normal(0, 0.5, (400, 6))
        first = rng.integers(20, 350)
        rows = without(400, *range(first, first + missing))
        whole = bridged(samples(rows, values[rows]), np.zeros(6), held=True)
        assert whole.lost == missing
        errors.append(whole.samples.increments.sum(axis=0) - values.sum(axis=0))
        stated.append(whole.samples.bridged)
    assert np.sqrt(np.mean(np.square(errors) / stated)) == pytest.approx(1, abs=0.15)


def test_a_gap_of_more_than_a_second_or_a_quarter_is_not_filled_in_the_hand_either():
    for count, missing, lost in ((1000, 100, 100), (1000, 101, 0), (100, 25, 25), (100, 26, 0)):
        rows = without(count, *range(30, 30 + missing))
        assert bridged(samples(rows, np.ones(len(rows))), WALK, held=True).lost == lost
