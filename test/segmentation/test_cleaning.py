"""What of a dwell is sound, by windows whose sums and scatter are written down."""

from collections.abc import Sequence
from math import sqrt
from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq

from imu_calib.common.stream import Floats
from imu_calib.common.units import DEG
from imu_calib.segmentation.dwells import (
    ShiftingDisturbance,
    Sound,
    _Means,
    _one_way,
    _robust_line,
    find_step,
    sound_samples,
)
from imu_calib.segmentation.segments import Statistics
from imu_calib.segmentation.statistics import Samples

PERIOD, LENGTH = 0.01, 50
WALK = np.array([1e-3, 2e-3, 3e-3, 0.01, 0.02, 0.03])
NONE = np.zeros(6)


def dwell(sums: Floats, spreads: Floats | None = None, **more: Any) -> Samples:
    """Windows of half a second with these (w, 6) sums; samples to and fro by (w, 6)."""
    rows = np.repeat(sums / LENGTH, LENGTH, axis=0)
    if spreads is not None:
        to_and_fro = np.tile([1.0, -1.0], len(rows) // 2)[:, None]
        rows = rows + np.repeat(spreads, LENGTH, axis=0) * to_and_fro
    stamp = np.arange(1, len(rows) + 1) * 10_000_000
    return Samples(stamp, rows, **{'pulse': NONE, 'grid': NONE, 'period': PERIOD, **more})


def one(channel: int, window: int, value: float, count: int = 12) -> Floats:
    found = np.zeros((count, 6))
    found[window, channel] = value
    return found


def cut(sound: Sound) -> list[int]:
    """The windows that are not sound; each is sound or not as a whole."""
    whole = len(sound.mask) // LENGTH * LENGTH
    windows = sound.mask[:whole].reshape(-1, LENGTH)
    assert (windows.all(axis=1) | ~windows.any(axis=1)).all()
    return np.flatnonzero(~windows.any(axis=1)).tolist()


# Windows


@pytest.mark.parametrize('channel', range(6))
def test_sums_stay_within_seven_of_the_scatter(channel):
    pulse, carried, grid = np.full(6, 1e-4), np.full(6, 2e-4), np.full(6, 1e-5)
    limit = 7 * WALK[channel] * np.sqrt(0.5) + 2.5 * 3e-4 + 50 * 1e-5
    for factor, gone in ((0.999, []), (1.001, [6]), (-0.999, []), (-1.001, [6])):
        held = dwell(one(channel, 6, factor * limit), pulse=pulse, carried=carried, grid=grid)
        assert cut(sound_samples(held, WALK)) == gone


def test_the_scatter_is_the_one_that_is_seen_where_it_is_larger():
    sums = np.zeros((24, 6))
    sums[:, 1] = np.tile([1.0, -1.0], 12)
    for size, gone in ((7 * 1.4826 - 0.01, []), (7 * 1.4826 + 0.01, [12])):
        sums[12, 1] = size
        assert cut(sound_samples(dwell(sums), WALK)) == gone


def test_rounding_of_large_numbers_is_no_disturbance():
    for size, gone in ((0.9e-8, []), (1.1e-8, [6])):
        sums = one(5, 6, size)
        sums[:, 5] += 10.0
        assert cut(sound_samples(dwell(sums), NONE)) == gone


def test_scatter_within_a_window_stays_within_three_times_the_usual():
    for factor, gone in ((2.99, []), (3.01, [6])):
        spreads = np.full((12, 6), 1e-4)
        spreads[6, 3] *= factor
        assert cut(sound_samples(dwell(np.zeros((12, 6)), spreads), WALK)) == gone


def test_a_counter_goes_to_and_fro_by_a_pulse():
    pulse, carried, grid = np.full(6, 1e-4), np.full(6, 2e-4), np.full(6, 3e-4)
    for factor, gone in ((0.99, []), (1.01, [6])):
        spreads = one(2, 6, factor * 3 * 0.5 * 6e-4)
        held = dwell(np.zeros((12, 6)), spreads, pulse=pulse, carried=carried, grid=grid)
        assert cut(sound_samples(held, WALK)) == gone


def test_many_windows_are_looked_at_as_few_are():
    for window in (15, 16, 17, 33):
        spreads = np.full((40, 6), 1e-4)
        spreads[window, 0] *= 4
        assert cut(sound_samples(dwell(np.zeros((40, 6)), spreads), WALK)) == [window]


def test_fewer_than_four_windows_are_not_judged():
    assert sound_samples(dwell(one(0, 1, 1.0, 3)), WALK).mask.all()
    assert cut(sound_samples(dwell(one(0, 1, 1.0, 4)), WALK)) == [0, 1]
    spoilt = np.zeros(150, bool)
    spoilt[7] = True
    found = sound_samples(dwell(np.zeros((3, 6))), WALK, spoilt)
    assert np.flatnonzero(~found.mask).tolist() == [7]


@pytest.mark.parametrize('count', [4, 7, 10, 11])
def test_a_line_goes_through_the_medians_of_both_ends(count):
    sums = np.random.default_rng(count).normal(0, 1, (count, 2))
    third = max(1, count // 3)
    for c in range(2):
        first = sorted(sums[:third, c])
        last = sorted(sums[count - third :, c])
        middle = (third - 1) / 2
        start, end = ((row[third // 2] + row[(third - 1) // 2]) / 2 for row in (first, last))
        slope = (end - start) / (count - 1 - 2 * middle)
        wanted = [start + slope * (k - middle) for k in range(count)]
        assert _robust_line(sums)[:, c] == pytest.approx(wanted)


def test_a_drift_is_no_disturbance():
    sums = np.outer(np.arange(12.0), np.ones(6))
    assert sound_samples(dwell(sums), WALK).mask.all()


# Settling


def bad_windows(bad: Sequence[int], count: int = 12, more: int = 0) -> Sound:
    spoilt = np.zeros(count * LENGTH + more, bool)
    spoilt[[k * LENGTH + 7 for k in bad]] = True
    held = dwell(np.zeros((count, 6)))
    if more:
        stamp = np.arange(1, count * LENGTH + more + 1) * 10_000_000
        rows = np.zeros((count * LENGTH + more, 6))
        held = Samples(stamp, rows, NONE, PERIOD, NONE)
    return sound_samples(held, WALK, spoilt)


@pytest.mark.parametrize(
    ('bad', 'gone', 'note'),
    [
        ([], [], None),
        ([0], [0], None),
        ([0, 2], [0, 1, 2], None),
        ([2], [0, 1, 2], None),
        ([1, 4], [0, 1, 2, 3, 4], None),
        ([0, 4], [0, 4], (2.0, 0.5)),
        ([3], [3], (1.5, 0.5)),
        ([11], [11], None),
        ([9, 11], [9, 10, 11], None),
        ([9], [9, 10, 11], None),
        ([8], [8], (4.0, 0.5)),
        ([0, 5, 6, 11], [0, 5, 6, 11], (2.5, 1.0)),
        ([4, 7], [4, 7], (2.0, 1.0)),
    ],
)
def test_it_is_quiet_from_three_windows_in_a_row_on(bad, gone, note):
    found = bad_windows(bad)
    assert cut(found) == gone
    words = (
        ''
        if note is None
        else (f'disturbed {note[0]} s after it came to rest; {note[1]} s left out')
    )
    assert found.notes == ((words,) if words else ())
    assert found.mount_shift is None


def test_fewer_in_a_row_are_quiet_where_there_are_no_three():
    assert cut(bad_windows([0, 2, 5], 6)) == [0, 1, 2, 5]
    assert cut(bad_windows([0, 2, 4], 6)) == [0, 2, 4]
    found = bad_windows(range(6), 6)
    assert not found.mask.any()
    assert found.notes == ('no half second of it was quiet',)


def test_what_is_less_than_a_window_goes_with_the_last_one():
    assert bad_windows([5], more=20).mask[600:].all()
    assert not bad_windows([11], more=20).mask[600:].any()
    assert bad_windows([], more=20).mask.all()


# Shocks that leave the unit turned


def shocked(
    angle: float,
    axis: int = 0,
    tilt: float = 1.0,
    at: Sequence[int] = (15,),
    count: int = 30,
    walk: Floats = WALK,
) -> Sound:
    """A unit with Z up that turns by an angle; accelerometers see a share of the tilt."""
    sums = np.zeros((count, 6))
    sums[list(at), axis] = angle / len(at)
    force = np.array([0.0, 0.0, 9.8 * 0.5])
    turned = np.zeros(3)
    turned[axis] = angle
    sums[:, 3:] = force
    sums[at[-1] + 1 :, 3:] -= tilt * np.cross(turned, force)
    return sound_samples(dwell(sums), walk)


@pytest.mark.parametrize('axis', [0, 1])
def test_a_turn_that_tilts_is_a_shift(axis):
    found = shocked(0.5, axis).mount_shift
    assert (found.start, found.stop) == (750, 800)
    assert found.angle == pytest.approx(0.5, rel=1e-6)
    for tilt, shifted in ((0.51, True), (0.49, False), (0.0, False), (-1.0, False)):
        assert (shocked(0.5, axis, tilt).mount_shift is not None) is shifted


def test_a_turn_about_up_tilts_nothing():
    found = shocked(0.5, 2).mount_shift
    assert found.angle == pytest.approx(0.5, rel=1e-6)


def test_few_windows_beside_it_do_not_tell_a_tilt():
    for at, told in ((3, False), (4, True), (25, True), (26, False)):
        # Not told, it counts whatever the accelerometers see.
        assert (shocked(0.5, 0, 0.0, (at,)).mount_shift is None) is told


def test_shocks_with_one_quiet_window_between_are_one():
    found = shocked(0.6, 0, 1.0, (12, 14)).mount_shift
    assert (found.start, found.stop) == (600, 750)
    assert found.angle == pytest.approx(0.6, rel=1e-6)
    # With two between the first one is it.
    found = shocked(0.6, 2, 1.0, (12, 15)).mount_shift
    assert (found.start, found.stop) == (600, 650)
    assert found.angle == pytest.approx(0.3, rel=1e-6)


@pytest.mark.parametrize(('pulse', 'grid'), [(0.0, 0.0), (1e-3, 0.0), (0.0, 1e-4)])
def test_a_shift_is_more_than_five_of_the_scatter(pulse, grid):
    limit = 5 * np.sqrt(4) * WALK[2] * np.sqrt(0.5) + pulse + 50 * grid
    for factor, shifted in ((0.99, False), (1.01, True)):
        sums = np.zeros((30, 6))
        sums[:, 5] = 4.9
        sums[12:16, 2] = factor * limit / 4
        spoilt = np.zeros(1500, bool)
        spoilt[600:800] = True
        held = dwell(sums, pulse=np.full(6, pulse), grid=np.full(6, grid))
        found = sound_samples(held, WALK, spoilt)
        assert (found.mount_shift is not None) is shifted


def test_a_shift_is_more_than_18_arcsec():
    for degrees, shifted in ((0.0049, False), (0.0051, True)):
        found = shocked(degrees * DEG, 2, walk=WALK * 1e-6)
        assert (found.mount_shift is not None) is shifted


def test_what_goes_to_and_fro_is_no_turn():
    """Within a window, samples of one size: five of the root of their squares."""
    for factor, shifted in ((0.99, False), (1.01, True)):
        sums, spreads = one(2, 15, 0.5, 30), one(2, 15, 0.0, 30)
        # n (s^2 + (0.5 / n)^2) is the sum of squares.
        spreads[15, 2] = np.sqrt((0.5 / 5 / factor) ** 2 / LENGTH - (0.5 / LENGTH) ** 2)
        sums[:, 5] = 4.9
        found = sound_samples(dwell(sums, spreads), WALK)
        assert cut(found) == [15]
        assert (found.mount_shift is not None) is shifted


# Steps


def statistics(rows: Floats, channel: int = 0) -> Statistics:
    """Blocks (b, 4) of one channel; the others show nothing."""
    flat = rows.copy()
    flat[:, 0] = 0.0
    blocks = tuple(rows if c == channel else flat for c in range(6))
    return Statistics(1, 0, 1.0, NONE, NONE, NONE, NONE, blocks, NONE)


def blocks_of(means: Sequence[float], gain: float = 0.1, rounding: float = 0.0) -> Floats:
    rows = [[m, gain, rounding, 10.0 * k + 5] for k, m in enumerate(means)]
    return np.array(rows)


def largest_by_hand(rows: Floats, walk: float) -> tuple[float, int, float, float, float]:
    """Try every cut: score, first block after it, size, and what two levels and a line leave."""
    variance = [
        walk**2 * gain + rounding if walk > 0 else gain for _, gain, rounding, _ in rows.tolist()
    ]
    mean, weight = rows[:, 0], [1 / v for v in variance]
    squares = sorted(
        (mean[k + 1] - mean[k]) ** 2 / (variance[k] + variance[k + 1]) for k in range(len(rows) - 1)
    )[:-1]
    least = 1.0 if walk > 0 else max(r[2] / r[1] for r in rows)
    excess = max(sum(squares) / len(squares) / 0.7, least)

    def level(part: range) -> float:
        return sum(weight[k] * mean[k] for k in part) / sum(weight[k] for k in part)

    best = (0.0, 0, 0.0, 0.0)
    for cut_at in range(1, len(rows)):
        before, after = range(cut_at), range(cut_at, len(rows))
        size = level(after) - level(before)
        spread = sum(1 / sum(weight[k] for k in part) for part in (before, after))
        left = sum(weight[k] * (mean[k] - level(p)) ** 2 for p in (before, after) for k in p)
        score = abs(size) / np.sqrt(excess * spread)
        if score > best[0]:
            best = (score, cut_at, size, left)
    line = np.polynomial.Polynomial.fit(rows[:, 3], mean, 1, w=np.sqrt(weight))
    by_drift = sum(w * (m - line(t)) ** 2 for w, m, t in zip(weight, mean, rows[:, 3], strict=True))
    return (*best, by_drift)


@pytest.mark.parametrize('walk', [0.0, 2.0])
@pytest.mark.parametrize('seed', range(6))
def test_the_largest_step_is_that_of_the_best_cut(seed, walk):
    rng = np.random.default_rng(seed)
    rows = blocks_of(rng.normal(0, 1 + seed, 5 + seed))
    rows[:, 1] *= rng.uniform(0.5, 2, len(rows))
    rows[:, 2] = rng.uniform(0.0, 0.3, len(rows))

    def by_hand(step):
        stepped = rows + step * np.outer(np.arange(len(rows)) >= 2 + seed // 2, [1, 0, 0, 0])
        return largest_by_hand(stepped, walk), stepped

    limit = brentq(lambda step: by_hand(step)[0][0] - 8.0, 3.0, 300.0)
    for step in (0.999 * limit, 1.001 * limit, -3 * limit):
        (score, after, size, left, by_drift), stepped = by_hand(step)
        found = find_step(statistics(stepped), np.full(6, walk))
        assert (found is not None) == (score >= 8 and left <= 0.25 * by_drift)
        if found is not None:
            assert found[0] == pytest.approx((10.0 * after - 10, 10.0 * after + 10))
            assert float(found[1].split()[-2]) == pytest.approx(size / DEG * 3600, rel=5e-3)


def test_four_blocks_show_no_step():
    assert find_step(statistics(blocks_of([0, 1, 0, 99])), np.ones(6)) is None
    assert find_step(statistics(blocks_of([0, 1, 0, 99, 99])), np.ones(6)) is not None


@pytest.mark.parametrize(
    ('channel', 'words'),
    [
        (0, 'the mean of gx steps by 36 deg/h'),
        (2, 'the mean of gz steps by 36 deg/h'),
        (3, 'the mean of ax steps by 17.8 ug'),
        (5, 'the mean of az steps by 17.8 ug'),
    ],
)
def test_a_step_is_said_in_units_of_its_channel(channel, words):
    size = 0.01 * DEG  # 17.8 ug, as m/s^2
    found = find_step(statistics(blocks_of([0, 0, 0, 0, size, size, size]), channel), 1e-6 + NONE)
    assert found == (pytest.approx((30.0, 50.0)), words)


def test_the_channel_with_the_clearest_step_is_named():
    step = blocks_of([0, 0, 0, 1, 1, 1])
    rows = list(statistics(step).blocks)
    rows[4] = blocks_of([0, 0, 2, 2, 2, 2])
    many = Statistics(1, 0, 1.0, NONE, NONE, NONE, NONE, tuple(rows), NONE)
    found = find_step(many, np.full(6, 0.01))
    assert found[0] == pytest.approx((10.0, 30.0))
    assert found[1].startswith('the mean of ay')


def test_a_step_is_eight_deviations_and_explains_four_times_a_drift():
    # Levels of n blocks each, walk 1, gain 0.1: size over sqrt(0.1 (1 / 4 + 1 / 4)).
    for factor, stepped in ((7.99, False), (8.01, True)):
        size = factor * np.sqrt(0.1 * 0.5)
        rows = blocks_of([0.0] * 4 + [size] * 4)
        assert (find_step(statistics(rows), np.ones(6)) is not None) is stepped
    # Levels that drift themselves by d a block: seen and found by both ways of fitting.
    calls = set()
    for drift in (0.0, 0.5, 0.6):
        rows = blocks_of([k * drift + 5.0 * (k > 3) for k in range(8)])
        _, _, _, left, by_drift = largest_by_hand(rows, 1.0)
        wanted = bool(left <= 0.25 * by_drift)
        calls.add(wanted)
        assert (find_step(statistics(rows), np.full(6, 1.0)) is not None) is wanted
    assert calls == {False, True}


# What a shock left: turns that go one way, tilts that accelerometers see, by sums over windows


STILL = np.zeros(3)


# To and fro, or one way


def shaken(count: int, size: float, turned: float, drift: float = 0.0) -> tuple[Floats, Floats]:
    """Samples to and fro by a size about a turn and a drift, gyro by gyro alike; their sum."""
    rows = np.resize([size, -size], count) + (turned + drift) / count
    return np.tile(rows[:, None], 3), np.full(3, rows.sum())


@pytest.mark.parametrize('drift', [0.0, 0.7])
def test_a_turn_stands_out_of_the_root_of_squares_by_five(drift):
    # A hundred samples of 0.01 and of a hundredth of the turn: the squares are 0.01 + t^2 / 100.
    limit = sqrt(25 * 0.01 / (1 - 25 / 100))
    for factor, one_way in ((0.99, False), (1.01, True), (-0.99, False), (-1.01, True)):
        samples, total = shaken(100, 0.01, factor * limit, drift)
        turned = np.full(3, factor * limit)
        assert _one_way(samples, total, turned, STILL).tolist() == [one_way] * 3


def test_gyros_are_judged_each_by_itself():
    samples, total = shaken(100, 0.01, 0.4)
    samples[:, 1] = 0.004
    total[1] = 0.4
    assert _one_way(samples, total, np.full(3, 0.4), STILL).tolist() == [False, True, False]


@pytest.mark.parametrize(('count', 'told'), [(24, True), (26, False)])
def test_fewer_than_25_samples_of_one_size_tell_nothing(count, told):
    samples, total = shaken(count, 0.01, 0.0)
    assert _one_way(samples, total, STILL, STILL).all() == told


def test_a_counter_may_flip_by_half_a_pulse_about_its_mean():
    # 100 samples of 0.01 beyond the flips of 0.02, of which a quarter of a square is each one's.
    samples, total = shaken(100, sqrt(0.01**2 + 0.02**2), 0.0)
    pulses = np.array([0.04, 0.0, 0.08])
    limit = 5 * sqrt(100) * 0.01
    for factor, first in ((0.98, False), (1.02, True)):
        # What turned is not in the samples: only its size counts.
        turned = np.full(3, factor * limit)
        found = _one_way(samples, total + turned, turned, pulses)
        assert found.tolist() == [first, False, True]


# Tilts


def windows(before: Floats, after: Floats, count: int = 12) -> Floats:
    """Sums of windows, as many with one force as with another; no gyro sees anything."""
    sums = np.zeros((2 * count, 6))
    sums[:count, 3:], sums[count:, 3:] = before, after
    return sums


def means(sums: Floats, scatter: Floats | None = None) -> _Means:
    scatter = np.full(6, 1e-3) if scatter is None else scatter
    return _Means(sums, sums - sums.mean(axis=0), scatter, np.zeros(6))


FORCE = np.array([3.0, 0.0, 4.0])
TURNED = np.array([0.01, 0.02, -0.01])


def tilted(share: float, scatter: Floats | None = None, count: int = 12) -> bool | None:
    """A turn that takes f to f - a x f, of which accelerometers see a share."""
    change = -np.array([0.02 * 4.0, -0.01 * 3.0 - 0.01 * 4.0, -0.02 * 3.0])
    sums = windows(FORCE, FORCE + share * change, count)
    # What is not sound has no say.
    bad = np.zeros(len(sums), bool)
    bad[[2, count + 3]] = True
    sums[bad, 3:] = 99.0
    before, after = slice(1, count), slice(count, 2 * count)
    return means(sums, scatter)._tilted(TURNED, bad, before, after)


def test_half_of_a_tilt_is_seen_at_least():
    shares = [0.49, 0.51, 1.0, 0.0, -1.0]
    assert [tilted(share) for share in shares] == [False, True, True, False, False]


def test_a_tilt_is_told_from_five_deviations_on():
    # -a x f, of size (0.08^2 + 0.07^2 + 0.06^2)^(1/2).
    change = np.array([-0.08, 0.07, 0.06])
    size = sqrt(change @ change)
    # Ten windows before and eleven after; of each channel what lies along the tilt.
    of_one = np.array([1.0, 2.0, 0.5])
    along = sqrt(((change / size * of_one) ** 2).sum()) * sqrt(1 / 10 + 1 / 11)
    for factor, told in ((0.99, True), (1.01, None)):
        scatter = np.append(np.full(3, 9.0), factor * size / (5 * along) * of_one)
        assert tilted(1.0, scatter) is told


@pytest.mark.parametrize(('count', 'told'), [(5, None), (6, True)])
def test_four_sound_windows_on_either_side_tell_a_tilt(count, told):
    assert tilted(1.0, None, count) is told


def test_what_no_accelerometer_sees_is_about_up():
    sums = windows(FORCE, FORCE)
    sums[3, 3:] = -99.0
    # Up is (0.6, 0, 0.8): of the turn 0.6 * 0.01 - 0.8 * 0.01.
    found = means(sums)._about_up(TURNED)
    assert found == pytest.approx(-0.002 * np.array([0.6, 0.0, 0.8]))


# Which run of windows


def shift(
    turns: dict[int, Floats], tilt: float = 0.0, floor: float = 0.0, scatter: float = 1e-4
) -> ShiftingDisturbance | None:
    """Of 40 windows of 10 samples those that turn are not sound; accelerometers see 1 m/s^2 up."""
    sums = np.zeros((40, 6))
    sums[:, 5] = 1.0
    last = max(turns)
    sums[last + 1 :, 3] += tilt
    for window, turned in turns.items():
        sums[window, :3] = turned
    bad = np.isin(np.arange(40), list(turns))
    left = sums.copy()
    left[:, 3:] = 0.0
    samples = np.repeat(sums[:, None, :] / 10, 10, axis=1)
    held = _Means(sums, left, np.full(6, scatter), np.zeros(6))
    return held.mount_shift(bad, 1, 38, np.full(6, floor), samples, np.zeros(6))


ABOUT_UP = np.array([0.0, 0.0, 0.01])


def test_the_first_run_that_turned_the_unit_is_it():
    assert shift({10: ABOUT_UP, 11: ABOUT_UP}) == ShiftingDisturbance(100, 120, 0.02)
    # One sound window between is of the run, two are not.
    assert shift({10: ABOUT_UP, 12: ABOUT_UP}) == ShiftingDisturbance(100, 130, 0.02)
    assert shift({10: ABOUT_UP, 13: ABOUT_UP}) == ShiftingDisturbance(100, 110, 0.01)
    # There and back again is none, and the next one is asked.
    back = {10: ABOUT_UP, 11: -ABOUT_UP, 20: -ABOUT_UP}
    assert shift(back) == ShiftingDisturbance(200, 210, 0.01)
    # Of what is cut at the ends nothing is asked.
    assert shift({0: ABOUT_UP, 38: ABOUT_UP, 20: 0.0 * ABOUT_UP}) is None
    assert shift({1: ABOUT_UP}) == ShiftingDisturbance(10, 20, 0.01)
    assert shift({37: ABOUT_UP}) == ShiftingDisturbance(370, 380, 0.01)


def test_of_a_turn_without_its_tilt_what_is_about_up_counts():
    both = np.array([0.0, 0.04, 0.03])
    # a x f is (0.04, 0, 0): the force tilts by -0.04 along x.
    whole = shift({20: both}, -0.04)
    assert whole.angle == pytest.approx(0.05)
    part = shift({20: both}, 0.0)
    assert part.angle == pytest.approx(0.03)


def test_a_shift_passes_five_deviations_of_its_windows_and_the_floor():
    # Two windows of 0.01: 5 * sqrt(2) of the scatter, and what rounding may do.
    for floor in (0.0, 0.004):
        limit = (0.02 - floor) / (5 * sqrt(2))
        two = {20: ABOUT_UP, 21: ABOUT_UP}
        assert shift(two, floor=floor, scatter=0.99 * limit) is not None
        assert shift(two, floor=floor, scatter=1.01 * limit) is None
