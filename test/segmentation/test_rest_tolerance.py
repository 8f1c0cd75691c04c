"""How far a rest may stray and what gyros read in it, window by window."""

import numpy as np
import pytest

from imu_calib.common.stream import Floats
from imu_calib.common.units import DEG, STANDARD_GRAVITY
from imu_calib.model.earth import EARTH_RATE
from imu_calib.segmentation.stillness import (
    ASSUMED_SPREAD,
    GyroOffset,
    RestTolerance,
    StillnessTracker,
)
from imu_calib.segmentation.table_motion import Motion, Rest

LEAN = DEG * STANDARD_GRAVITY
X, Y, Z = np.eye(3)
OFFSET = np.array([1.0, -2.0, 0.5]) * DEG


def windows(count: int, noise: float = 0.0, push: float = 0.0, seed: int = 0) -> Floats:
    """Means of windows at rest; noise in deg/s, push in m/s^2."""
    rng = np.random.default_rng(seed)
    rows = np.tile(np.append(OFFSET, [0.0, 0.0, 9.8]), (count, 1))
    rows[:, :3] += noise * DEG * rng.standard_normal((count, 3))
    rows[:, 3:] += push * rng.standard_normal((count, 3))
    return rows


def by_hand(rows: Floats) -> tuple[float, float]:
    """What nine of ten windows keep to: of the second around, and of the window before."""
    shaken, pushed = [], []
    for k in range(5, len(rows) - 5):
        around = sum(rows[j, :3] for j in range(k - 5, k + 6)) / 11
        shaken.append(max(abs(rows[k, :3] - around)))
        pushed.append(max(abs(rows[k, 3:] - rows[k - 1, 3:])) / np.sqrt(2))
    return float(np.quantile(shaken, 0.9)), float(np.quantile(pushed, 0.9))


# The tolerance


def test_three_times_what_nine_of_ten_keep_to_is_added():
    rows = windows(200, 0.4, 0.05)
    shaken, pushed = by_hand(rows)
    found = RestTolerance.estimate(rows, OFFSET, 0.2 * DEG)
    assert found.rate == pytest.approx(0.2 * DEG + 3 * shaken)
    assert found.force == pytest.approx(LEAN + 3 * pushed)
    assert found.usual == pytest.approx(shaken)


def test_a_count_is_the_least_that_is_added():
    step = np.array([0.1 * DEG, 0.02])
    found = RestTolerance.estimate(windows(200), OFFSET, ASSUMED_SPREAD, step)
    assert found.rate == pytest.approx(ASSUMED_SPREAD + 0.1 * DEG)
    assert found.force == pytest.approx(LEAN + 0.02)
    assert found.usual == pytest.approx(0.1 * DEG / 3)


def test_what_is_not_held_has_no_larger_tolerance():
    found = RestTolerance.estimate(windows(200, 9.0, 3.0), OFFSET)
    assert found.rate == pytest.approx(20 * DEG)
    assert found.force == pytest.approx(0.3 * STANDARD_GRAVITY)


def test_few_windows_tell_nothing():
    step = np.array([0.1 * DEG, 0.02])
    plain = RestTolerance(0.2 * DEG + step[0], LEAN + step[1], step[0])
    noisy = windows(20, 0.4, 0.05)
    assert RestTolerance.estimate(noisy[:10], OFFSET, 0.2 * DEG, step) == plain
    # Eleven quiet seconds have to be among them, and each needs half a second beside.
    assert RestTolerance.estimate(noisy, OFFSET, 0.2 * DEG, step) == plain
    assert RestTolerance.estimate(windows(21, 0.4, 0.05), OFFSET, 0.2 * DEG, step) != plain
    assert RestTolerance() == RestTolerance(ASSUMED_SPREAD, LEAN, 0.0)


@pytest.mark.parametrize(('rate', 'turns'), [(4.9, False), (5.1, True), (-5.1, True)])
def test_a_turn_tells_nothing_of_rests_nor_the_second_beside_it(rate, turns):
    quiet = windows(100, 0.1, 0.01, 1)
    turning = windows(100, 0.1, 0.01, 2)
    turning[:, 1] += rate * DEG
    rows = np.vstack([quiet, turning])
    found = RestTolerance.estimate(rows, OFFSET)
    if turns:
        # Windows around which some second is a turn: its middle is at least five off.
        first = next(
            k
            for k in range(5, 195)
            if (abs(rows[k - 5 : k + 6, :3].mean(axis=0) - OFFSET) > 5 * DEG).any()
        )
        shaken, pushed = [], []
        for k in range(5, first - 5):
            around = rows[k - 5 : k + 6, :3].mean(axis=0)
            shaken.append(max(abs(rows[k, :3] - around)))
            pushed.append(max(abs(rows[k, 3:] - rows[k - 1, 3:])) / np.sqrt(2))
        assert found.rate == pytest.approx(ASSUMED_SPREAD + 3 * float(np.quantile(shaken, 0.9)))
        assert found.force == pytest.approx(LEAN + 3 * float(np.quantile(pushed, 0.9)))
    else:
        shaken_all, pushed_all = by_hand(rows)
        assert found.rate == pytest.approx(ASSUMED_SPREAD + 3 * shaken_all)
        assert found.force == pytest.approx(LEAN + 3 * pushed_all)


# What gyros read at rest


def feed(offset: GyroOffset, rate: Floats, up: Floats, seconds: float) -> None:
    for _ in range(round(seconds * 10)):
        offset.add_window(np.append(rate, 9.8 * up))


def test_nothing_is_known_before_a_second_is_steady():
    offset = GyroOffset()
    assert offset.value.tolist() == [0.0] * 3
    assert offset.spread == ASSUMED_SPREAD
    feed(offset, OFFSET, Z, 0.9)
    assert offset.value.tolist() == [0.0] * 3
    feed(offset, OFFSET, Z, 0.1)
    assert offset.value == pytest.approx(OFFSET)
    assert offset.spread == ASSUMED_SPREAD


def test_two_half_seconds_are_averaged():
    offset = GyroOffset()
    for k in range(10):
        offset.add_window(np.append(OFFSET + 0.09 * k * DEG * X, 9.8 * Z))
    assert offset.value == pytest.approx(OFFSET + 0.405 * DEG * X)


@pytest.mark.parametrize(
    ('rate', 'force', 'steady'),
    [(0.99, 0.0, True), (1.01, 0.0, False), (0.0, 0.049, True), (0.0, 0.051, False)],
)
def test_steady_is_within_a_degree_a_second_and_a_twentieth_of_gravity(rate, force, steady):
    offset = GyroOffset()
    feed(offset, OFFSET, Z, 0.5)
    for _ in range(5):
        offset.add_window(
            np.append(OFFSET + rate * DEG * Y, 9.8 * Z + force * STANDARD_GRAVITY * X)
        )
    assert bool(offset.value.any()) is steady


def test_the_rate_of_most_attitudes_is_the_offset():
    offset = GyroOffset()
    turning = OFFSET + 10 * DEG * Z
    feed(offset, turning, Z, 30.0)
    assert offset.value == pytest.approx(turning)
    feed(offset, OFFSET, X, 1.0)
    # One way up each: the earliest.
    assert offset.value == pytest.approx(turning)
    feed(offset, OFFSET, Y, 1.0)
    assert offset.value == pytest.approx(OFFSET)


def test_of_equals_the_one_below_a_degree_a_second_is_it():
    offset = GyroOffset()
    feed(offset, 10 * DEG * Z, Z, 5.0)
    feed(offset, 0.9 * DEG * Z, Z, 1.0)
    assert offset.value == pytest.approx(0.9 * DEG * Z)
    other = GyroOffset()
    feed(other, 10 * DEG * Z, Z, 5.0)
    feed(other, 1.1 * DEG * Z, Z, 1.0)
    assert other.value == pytest.approx(10 * DEG * Z)


def leaning(degrees: float) -> Floats:
    return np.array([np.sin(degrees * DEG), 0.0, np.cos(degrees * DEG)])


@pytest.mark.parametrize(('lean', 'other'), [(19.0, False), (21.0, True)])
def test_ways_up_are_twenty_degrees_apart(lean, other):
    offset = GyroOffset()
    feed(offset, 10 * DEG * Z, X, 2.0)
    feed(offset, 30 * DEG * Z, Z, 2.0)
    feed(offset, 30 * DEG * Z, leaning(lean), 2.0)
    assert offset.value == pytest.approx((30 if other else 10) * DEG * Z)


def test_a_rate_is_averaged_over_what_was_read_in_one_way_up():
    offset = GyroOffset()
    feed(offset, 0.0 * Z, Z, 1.0)
    # Halves of seconds: (0 + 0.5) / 2, then 0.5 twice.
    feed(offset, 0.5 * DEG * Z, Z, 1.5)
    assert offset.value == pytest.approx((0 + 0.25 + 0.5 + 0.5) / 4 * DEG * Z)
    # From twenty on the older ones fade.
    feed(offset, 0.0 * Z, Z, 0.5)
    total, count = (0 + 0.25 + 0.5 + 0.5 + 0.25) / 5, 5
    assert offset.value == pytest.approx(total * DEG * Z)
    feed(offset, 0.0 * Z, Z, 20.0)
    for _ in range(40):
        count = min(count + 1, 20)
        total += (0.0 - total) / count
    assert offset.value == pytest.approx(total * DEG * Z)


def rates_in(offset: GyroOffset, rates: list[float]) -> None:
    """One second in each of as many ways up, rates about z in deg/s."""
    for k, rate in enumerate(rates):
        up = np.array([np.cos(k * 45 * DEG), np.sin(k * 45 * DEG), 0.0])
        feed(offset, rate * DEG * Z, up, 1.0)


def test_ways_up_tell_by_how_much_rates_differ():
    offset = GyroOffset()
    rates_in(offset, [0.0, 0.1, 0.3, 0.2])
    assert offset.spread == ASSUMED_SPREAD
    assert offset.value == pytest.approx(0.15 * DEG * Z)
    feed(offset, 0.6 * DEG * Z, -X, 1.0)
    # Median 0.2; off by 0.2, 0.1, 0.1, 0, 0.4: their median is 0.1.
    assert offset.value == pytest.approx(0.2 * DEG * Z)
    assert offset.spread == pytest.approx(3 * 1.4826 * 0.1 * DEG)
    alike = GyroOffset()
    rates_in(alike, [0.2] * 5)
    assert alike.spread == pytest.approx(2 * EARTH_RATE)


def test_the_last_five_ways_up_are_the_rate():
    offset = GyroOffset()
    rates_in(offset, [0.0, 0.0, 0.0, 0.4, 0.5, 0.6])
    # 0, 0, 0.4, 0.5 and 0.6.
    assert offset.value == pytest.approx(0.4 * DEG * Z)


def test_of_many_rates_the_least_supported_makes_room():
    offset = GyroOffset()
    for k in range(1, 33):
        feed(offset, 10.0 * k * DEG * Z, Z, 1.0)
    feed(offset, 20 * DEG * Z, X, 1.0)
    assert offset.value == pytest.approx(20 * DEG * Z)
    feed(offset, -10 * DEG * Z, Z, 1.0)
    # The first of those with one way up is gone: another way up is its only one.
    feed(offset, 10 * DEG * Z, X, 1.0)
    feed(offset, 10 * DEG * Z, Y, 1.0)
    assert offset.value == pytest.approx(20 * DEG * Z)
    feed(offset, 10 * DEG * Z, Z, 1.0)
    assert offset.value == pytest.approx(10 * DEG * Z)


# Rests and motions


def tracked(rows: Floats, period: float = 0.01, cut: int = 10**9) -> list[Rest | Motion]:
    tracker = StillnessTracker(period)
    stamp = np.arange(1, len(rows) + 1) * round(period * 1e9)
    found: list[Rest | Motion] = []
    for k in range(0, len(rows), cut):
        found += tracker.track(stamp[k : k + cut], rows[k : k + cut])
    return [*found, *tracker.finish()]


def held(seconds: float, up: Floats, turning: float = 0.0) -> Floats:
    rate = OFFSET + turning * DEG * X
    return np.tile(np.append(rate, 9.8 * up), (round(seconds * 100), 1))


def spans(found: list[Rest | Motion]) -> list[tuple[str, float, float]]:
    return [(type(f).__name__, f.start * 1e-9, f.end * 1e-9) for f in found]


def test_rests_begin_with_the_second_quiet_window_and_end_with_the_last():
    rows = np.vstack([held(3, Z), held(1, Z, 50.0), held(3, Y)])
    wanted = [
        ('Motion', 0.01, 0.11),
        ('Rest', 0.11, 3.0),
        ('Motion', 3.0, 4.11),
        ('Rest', 4.11, 7.0),
    ]
    for cut in (10**9, 7, 333):
        found = spans(tracked(rows, cut=cut))
        assert [f[0] for f in found] == [w[0] for w in wanted]
        assert [f[1:] for f in found] == [pytest.approx(w[1:]) for w in wanted]


def test_what_ends_in_a_turn_ends_with_a_motion():
    found = spans(tracked(np.vstack([held(3, Z), held(1.05, Z, 50.0)])))
    assert [f[0] for f in found] == ['Motion', 'Rest', 'Motion']
    # A window that is not whole is not judged.
    assert found[-1][1:] == pytest.approx((3.0, 4.0))
    assert tracked(held(0.05, Z)) == []


def test_another_attitude_is_another_rest():
    for lean, rests in ((0.9, 1), (1.2, 2)):
        found = spans(tracked(np.vstack([held(3, Z), held(3, leaning(lean))])))
        assert [f[0] for f in found].count('Rest') == rests


def test_the_quietest_two_seconds_are_told():
    rng = np.random.default_rng(2)
    rows = np.vstack([held(5, Z), held(5, Z), held(5, Z)])
    noise = np.repeat([0.5, 0.1, 0.4], 500)[:, None] * DEG
    rows[:, :3] += noise * rng.standard_normal((1500, 3))
    rows[:, 3:] += 0.01 * rng.standard_normal((1500, 3))
    means = [rows[10 * k : 10 * k + 10].mean(axis=0) for k in range(150)]
    least = (np.inf, np.inf)
    for k in range(131):
        span = np.array(means[k : k + 20])
        off = abs(span - span.mean(axis=0)).max(axis=0)
        least = min(least, (off[:3].max(), off[3:].max()))
    for cut in (1500, 13):
        tracker = StillnessTracker(0.01)
        stamp = np.arange(1, 1501) * 10_000_000
        for k in range(0, 1500, cut):
            tracker.track(stamp[k : k + cut], rows[k : k + cut])
        found = tracker.quietest
        assert (found.rate, found.force) == pytest.approx(least)
        assert found.length == pytest.approx(9.8, rel=0.01)
    brief = StillnessTracker(0.01)
    brief.track(stamp[:199], rows[:199])
    assert brief.quietest is None
    brief.track(stamp[199:200], rows[199:200])
    assert brief.quietest is not None


def test_a_rest_that_goes_on_can_be_parted():
    tracker = StillnessTracker(0.01)
    assert (tracker.known_until, tracker.rest_since) == (None, None)
    assert tracker.split_rest(5) is None
    rows = held(40, Z)
    stamp = np.arange(1, 4001) * 10_000_000
    assert [type(f) for f in tracker.track(stamp, rows)] == [Motion]
    # Half a minute is waited for: a hundred windows are judged.
    assert tracker.known_until == 10_000_000_000
    assert tracker.rest_since == 110_000_000
    rest = tracker.split_rest(5_000_000_000)
    assert (rest.start, rest.end) == (110_000_000, 5_000_000_000)
    assert tracker.rest_since == 5_000_000_000
    (last,) = tracker.finish()
    assert (last.start, last.end) == (5_000_000_000, 40_000_000_000)
