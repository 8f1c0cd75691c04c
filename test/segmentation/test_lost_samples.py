"""What lost samples counted, by least squares and chances written out."""

import math

import numpy as np
import pytest

from imu_calib.common.stream import Floats
from imu_calib.segmentation.gaps import (
    Bridged,
    _best_reach,
    _gain,
    _likely,
    bridged,
    filled_at_steady_rate,
)
from imu_calib.segmentation.statistics import Samples

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


# Counters


def fitted(a: Floats, b: Floats, missing: int) -> float:
    """What lies between, so that one slope fits the counts before and after: least squares."""
    rows, counts, total = [], [], 0.0
    for k in range(len(a) + 1):
        rows.append([1.0, -k, 0.0])
        counts.append(-total)
        total += a[-1 - k] if k < len(a) else 0.0
    total = 0.0
    for k in range(len(b) + 1):
        rows.append([1.0, missing + k, -1.0])
        counts.append(total)
        total += b[k] if k < len(b) else 0.0
    return float(np.linalg.lstsq(np.array(rows), np.array(counts), rcond=None)[0][2])


@pytest.mark.parametrize(('before', 'after', 'missing'), [(1, 1, 1), (4, 4, 1), (8, 3, 5)])
def test_lines_of_one_slope_tell_what_lies_between(before, after, missing):
    rng = np.random.default_rng(before)
    a, b = rng.normal(3, 1, before), rng.normal(3, 1, after)
    gain = _gain(before, after, missing)
    shown = [-sum(a[len(a) - k :]) for k in range(before + 1)]
    further = [sum(b[:k]) for k in range(after + 1)]
    assert gain.before @ shown + gain.after @ further == pytest.approx(fitted(a, b, missing))
    assert gain.read == pytest.approx(sum(w * w for w in (*gain.before, *gain.after)))
    # What each sample moves it by, one after the other, and the noise of what is lost.
    whole, moved = fitted(a, b, missing), float(missing)
    for row in (a, b):
        for k in range(len(row)):
            row[k] += 1.0
            moved += (fitted(a, b, missing) - whole) ** 2
            row[k] -= 1.0
    assert gain.walked == pytest.approx(moved)


def stated(reach: int, rate: float, noise: float, missing: int = 1) -> float:
    """Variance of a gap's count: its phase or its readings, and the walk."""
    gain = _gain(reach, reach, missing)
    passed = reach * abs(rate - round(rate))
    phase = min(0.25, 0.2 / passed**2) if passed else 0.25
    if noise * math.sqrt(reach) > 1:
        phase = 0.0
    return max(phase, 1.5 * gain.read / 12) + gain.walked * noise**2


@pytest.mark.parametrize('rate', [3.0, 3.25, -0.4, 0.001, 9.797])
@pytest.mark.parametrize('noise', [0.0, 0.002, 0.3, 1.5])
def test_a_gap_is_read_from_no_further_than_it_takes(rate, noise):
    reaches = [2**k for k in range(14)]
    for reach in (1, 8, 64):
        found = _gain(reach, reach, 2).variance(rate, noise, reach)
        assert found == pytest.approx(stated(reach, rate, noise, 2))
    variances = [stated(reach, rate, noise) for reach in reaches]
    sure = [r for r, v in zip(reaches, variances, strict=True) if v <= 0.01]
    wanted = sure[0] if sure else reaches[int(np.argmin(variances))]
    assert _best_reach(rate, noise) == wanted


def chances(pulses: float, variance: float, expected: float, walked: float) -> tuple[float, float]:
    """Mean and variance over whole numbers by what counts say and what the mean rate does."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(7)
    total = mean = square = 0.0
    whole = [round(expected) + k for k in range(-8, 9)]
    nearest = min((n - pulses) ** 2 for n in whole)
    for n in whole:
        chance = 1e-9
        for node, weight in zip(nodes, weights, strict=True):
            chance += weight * max(0.0, 1 - abs(n - expected - math.sqrt(walked) * node))
        if variance < 0.25:
            chance *= math.exp(-((n - pulses) ** 2 - nearest) / (2 * variance))
        total, mean, square = total + chance, mean + chance * n, square + chance * n * n
    return mean / total, square / total - (mean / total) ** 2


@pytest.mark.parametrize('pulses', [4.1, 4.6, 7.0])
@pytest.mark.parametrize('variance', [0.0, 0.02, 0.24, 0.26])
@pytest.mark.parametrize('walked', [0.0, 0.3])
def test_a_gap_holds_a_whole_number(pulses, variance, walked):
    found = _likely(pulses, variance, 4.3, walked)
    wanted = chances(pulses, max(variance, 1e-4), 4.3, walked)
    assert found == pytest.approx(wanted, rel=1e-6, abs=1e-9)


@pytest.mark.parametrize(('variance', 'walked'), [(4.1, 0.0), (1.0, 3.2), (9.0, 20.0)])
def test_wide_ones_are_averaged_by_their_variances(variance, walked):
    own, other = 1 / variance, 1 / (walked + 1 / 6)
    mean, left = _likely(10.0, variance, 4.0, walked)
    assert mean == pytest.approx((own * 10 + other * 4) / (own + other))
    assert left == pytest.approx(1 / (own + other))


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
