"""Gaps of a counter filled one by one in a plain loop; walks by the likelihood of blocks."""

from math import inf, sqrt
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from imu_calib.common.stream import Floats
from imu_calib.segmentation.gaps import _best_reach, _gain, _likely, bridged
from imu_calib.segmentation.statistics import Samples, pooled_walk

PERIOD = 0.01


def samples(counts: Floats, rows: list[int], pulse: float) -> Samples:
    """A counter in the first channel, of which these samples came."""
    increments = np.zeros((len(rows), 6))
    increments[:, 0] = counts[rows] * pulse
    pulses = np.array([pulse, 0, 0, 0, 0, 0])
    return Samples((np.array(rows) + 1) * 10_000_000, increments, pulses, PERIOD, np.zeros(6))


def filled(
    counts: Floats, gaps: list[tuple[int, int]], noise: float, reach: int | None
) -> tuple[Floats, float]:
    """What gaps are filled with, and what they leave of the variance of a sum, pulses squared."""
    came = [k for k in range(len(counts)) if not any(a <= k < b for a, b in gaps)]
    rate = counts[came].mean()
    chosen = reach or _best_reach(rate, noise)
    held = counts.astype(float).copy()
    for a, b in gaps:
        held[a:b] = rate
    found = [rate] * len(gaps)
    for _ in range(4):
        before, left = list(found), 0.0
        for k, (a, b) in enumerate(gaps):
            low, high = max(0, a - chosen), min(len(counts), b + chosen)
            m = b - a
            # Counts from the gap backwards and onwards, and their weights of one slope.
            back = [-held[a - j : a].sum() for j in range(a - low + 1)]
            on = [held[b : b + j].sum() for j in range(high - b + 1)]
            gain = _gain(a - low, high - b, m)
            pulses, variance = float(gain.before @ back + gain.after @ on), 0.0
            if reach is None:
                spread = gain.variance(rate, noise, min(a - low, high - b))
                pulses, variance = _likely(pulses, spread, rate * m, m * noise**2)
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
    walk = np.array([noise * pulse / sqrt(PERIOD), 0, 0, 0, 0, 0])
    whole = bridged(samples(counts, rows, pulse), walk, reach).samples
    wanted, left = filled(counts, gaps, noise, reach)
    assert (whole.increments[:, 0] / pulse).tolist() == pytest.approx(wanted.tolist())
    assert whole.bridged[0] == pytest.approx(left / len(gaps) * pulse**2)


def test_what_comes_after_a_long_gap_tells_nothing_of_one_before_it():
    # 2 pulses a sample before 40 that are missing, 3 after them.
    counts = np.where(np.arange(200) < 100, 2.0, 3.0)
    rows = [k for k in range(200) if k not in (95, 144) and not 100 <= k < 140]
    whole = bridged(samples(counts, rows, 1.0), np.zeros(6), 8)
    assert whole.lost == 2
    assert whole.samples.increments[[95, 104], 0].tolist() == [2.0, 3.0]


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
