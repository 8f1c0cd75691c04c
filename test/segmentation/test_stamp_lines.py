"""Lines through stamps: of one segment, and through the segments of a session; figures by hand."""

from math import inf, isinf, sqrt

import numpy as np
import pytest

from imu_calib.common.stream import Floats, Stamps
from imu_calib.segmentation.segments import Pace, Timing
from imu_calib.segmentation.stamps import (
    SampleGrid,
    _first_period,
    _in_common,
    _laid,
    _missing_before,
    _near,
    clock_steps,
    read_grid,
)

START = 1_700_000_000_000_000_000
MS = 1_000_000


def stamps(milliseconds: Floats) -> Stamps:
    return START + np.rint(np.asarray(milliseconds) * MS).astype(np.int64)


# The interval at first sight


def alternating(short: float, long: float, count: int = 41) -> Floats:
    """Times whose steps are long, short, long, ..."""
    steps = np.resize([long, short], count)
    return np.append(0.0, np.cumsum(steps))


def test_eight_samples_tell_the_interval_where_single_ones_agree():
    # The middle one of 41 steps is a long one; eight of them are eight times the mean.
    assert _first_period(alternating(9.7, 10.3)) == (pytest.approx(10.0), False)
    assert _first_period(alternating(9.4, 10.6)) == (pytest.approx(10.6), False)
    assert _first_period(alternating(9.5, 10.5, 4)) == (pytest.approx(10.0), False)
    assert _first_period(np.array([0.0, 7.0])) == (7.0, False)
    # Mostly eight of 101 without a gap, one in twenty with one.
    gaps = np.cumsum(np.where(np.arange(101) % 20 == 0, 20.0, 10.0))
    assert _first_period(gaps) == (pytest.approx(10.0), False)


def bunches(of: int, count: int, waits: Floats | None = None) -> Floats:
    """Samples that come `of` at a time, a hundredth after one another."""
    every = of * 10.0 if waits is None else waits
    begins = np.cumsum(np.broadcast_to(every, count // of))
    return (begins[:, None] + 0.01 * np.arange(of)).ravel()


@pytest.mark.parametrize(('count', 'lag'), [(105, 25), (505, 125), (1500, 240)])
def test_of_bunches_the_lower_lags_tell_the_interval(count, lag):
    waits = 50.0 + np.random.default_rng(2).uniform(-1, 1, count // 5)
    time = bunches(5, count, waits)
    lasting = sorted(time[k + lag] - time[k] for k in range(count - lag))
    # One tenth of the way up the sorted list.
    place = 0.1 * (len(lasting) - 1)
    low = int(place)
    wanted = lasting[low] + (place - low) * (lasting[low + 1] - lasting[low])
    assert _first_period(time) == (pytest.approx(wanted / lag), True)


def test_samples_are_in_bunches_where_a_quarter_of_the_steps_is_short():
    # Pairs: 0.49 and 1.51 of the interval, 0.51 and 1.49.
    assert _first_period(alternating(4.9, 15.1))[1]
    assert not _first_period(alternating(5.1, 14.9))[1]
    # One wait alone: as many as fit four times.
    time = np.array([0.0, 0.1, 0.2, 0.3, 0.4, 90.0, 90.1, 90.2, 90.3])
    assert _first_period(time) == (pytest.approx(0.2 / 2), True)


# What is missing


@pytest.mark.parametrize(
    ('time', 'window', 'missing'),
    [
        ([0, 1, 2, 5, 6, 7], 9, [0, 0, 0, 2, 2, 2]),
        ([0, 1, 2, 4, 5, 8, 9], 9, [0, 0, 0, 1, 1, 3, 3]),
        # Steps up to one and a half hide none.
        ([0, 1, 2.49, 3.98, 5.47], 9, [0, 0, 0, 0, 0]),
        ([0, 1, 2.51, 4, 5.4], 9, [0, 0, 1, 1, 1]),
        # A stamp that is late is followed by others that are not, if one looks far enough.
        ([0, 1, 2, 3.9, 4, 5], 9, [0] * 6),
        ([0, 1, 2, 4.6, 4.61, 5, 6], 3, [0] * 7),
        ([0, 1, 2, 4.6, 4.61, 5, 6], 2, [0, 0, 0, 1, 1, 1, 1]),
        # And those before may have been late.
        ([0, 1.5, 2.5, 3.5, 5.6, 6.6, 7.6], 2, [0, 0, 0, 0, 1, 1, 1]),
        ([0, 1.5, 2.5, 3.5, 5.6, 6.6, 7.6], 4, [0, 0, 0, 0, 2, 2, 2]),
        ([0, 2, 3, 4.2, 7.6, 8.6], 3, [0, 1, 1, 1, 4, 4]),
    ],
)
def test_stamps_that_stay_late_lack_a_sample(time, window, missing):
    for period in (1.0, 0.01):
        found = _missing_before(period * np.array(time), period, window, bunched=False)
        assert found.tolist() == missing


def test_the_last_32_in_bunches_are_not_asked():
    def gap(at, *, bunched):
        time = np.arange(100.0) + 2 * (np.arange(100) >= at)
        return int(_missing_before(time, 1.0, 128, bunched=bunched)[-1])

    assert [gap(68, bunched=True), gap(69, bunched=True)] == [2, 0]
    assert [gap(69, bunched=False), gap(99, bunched=False)] == [2, 2]


# A line through the stamps of a segment


def test_two_stamps_are_a_line_of_unknown_error():
    for index, step in ((np.array([0, 1]), 0.03), (np.array([0, 3]), 0.01)):
        grid = _laid(np.array([0.0, 0.03]), index, 0.01)
        assert (grid.origin, grid.period) == (0.0, pytest.approx(step))
        assert isinf(grid.period_std)
        assert grid.scatter == 0.0
        assert grid.kept.tolist() == [True, True]


def test_a_line_rests_on_the_stamps_that_are_not_late():
    index = np.delete(np.arange(31), [7, 8, 20])
    late = 1e-4 * np.resize([1.0, -1.0, 0.6, -0.4, 0.2], 28)
    late[[4, 15]] += [5e-3, 2e-3]
    grid = _laid(0.002 + 0.01001 * index + late, index, 0.01)
    sound = np.delete(np.arange(28), [4, 15])
    assert np.flatnonzero(grid.kept).tolist() == sound.tolist()
    slope, origin = np.polyfit(index[sound], (0.002 + 0.01001 * index + late)[sound], 1)
    assert grid.period == pytest.approx(slope, rel=1e-10)
    assert grid.origin == pytest.approx(origin, rel=1e-9)
    residuals = (0.002 + 0.01001 * index + late - origin - slope * index)[sound]
    assert grid.scatter == pytest.approx(sqrt((residuals**2).mean()))
    # Too few for blocks: white.
    spread = ((index[sound] - index[sound].mean()) ** 2).sum()
    assert grid.period_std == pytest.approx(sqrt((residuals**2).mean() / spread))


def test_stamps_without_scatter_are_known_to_a_twelfth_of_a_square_nanosecond():
    grid = _laid(0.01 * np.arange(5), np.arange(5), 0.01)
    assert grid.period_std == pytest.approx(1e-9 / sqrt(12) / sqrt(10), rel=1e-6)


def test_outliers_are_four_robust_deviations_off():
    # The median of what they are off by is 1.
    for off, near in ((4 * 1.4826 - 0.001, True), (4 * 1.4826 + 0.001, False)):
        assert _near(5.0 + np.array([-1.0, -1.0, -1.0, 0.0, 1.0, 1.0, off]))[-1] == near
    # Two nanoseconds for rounding.
    assert _near(np.array([0.0, 0.0, 0.0, 1.9e-9, 2.1e-9])).tolist() == [True] * 4 + [False]


def test_what_is_late_together_counts_by_its_blocks():
    # 16 blocks of 3, 0.5 early and late by turns; to and fro by 1, 0, -1 within.
    residuals = np.tile([1.0, 0.0, -1.0], 17)[:50] + np.resize([0.5] * 3 + [-0.5] * 3, 50)
    own = float((residuals**2).mean())
    assert _in_common(residuals) == pytest.approx(max(own, 3 * 0.25))
    together = np.resize([0.5] * 3 + [-0.5] * 3, 50)
    assert _in_common(together) == pytest.approx(3 * 0.25)
    assert _in_common(together[:31]) == pytest.approx(0.25)
    pairs = np.resize([0.5, 0.5, -0.5, -0.5], 32)
    assert _in_common(pairs) == pytest.approx(2 * 0.25)


def test_stamps_within_a_thousandth_of_an_interval_stay():
    every = np.ones(3, dtype=bool)
    grid = SampleGrid(np.array([0, 1, 3]), 1e-3, 0.01, 0.0, 0.0, every)
    for off, stays in ((9.9e-3, True), (-9.9e-3, True), (10.1e-3, False), (-10.1e-3, False)):
        came = stamps(np.array([0.0, 10.0, 30.0 + off]))
        clean = SampleGrid(grid.index, 0.0, 0.01, 0.0, 0.0, every)
        assert (clean.stamps(came) is came) is stays
    # Else they are those of the line, 1 ms after the first stamp.
    assert grid.stamps(came).tolist() == stamps(np.array([1.0, 11.0, 31.0])).tolist()


@pytest.mark.parametrize(
    ('hint', 'index'),
    [(None, [0, 1, 2]), (0.0119, [0, 1, 2]), (0.0121, [0, 1, 3]), (0.0181, [0, 1, 2])],
)
def test_an_interval_that_is_known_counts_within_a_fifth(hint, index):
    # Of 10 and 20 ms the median is 15: none is missing; beside 12.1 ms one is.
    assert read_grid(stamps(np.array([0.0, 10.0, 30.0])), hint).index.tolist() == index


# A clock that was set


def set_by(jump: float, at: int = 50, count: int = 100, jitter: float = 0.0) -> list[int]:
    """Where stamps are found to go on off their grid of 10 ms; jump and jitter in intervals."""
    late = np.where(np.arange(count) >= at, jump, 0.0)
    late = late + jitter * (np.arange(count) % 2)
    return clock_steps(stamps(10.0 * (np.arange(count) + late)))


@pytest.mark.parametrize(
    ('jump', 'found'),
    [(0.029, []), (0.031, [50]), (0.5, [50]), (-0.4, [50]), (3.0, []), (3.1, [50])],
)
def test_a_step_is_off_the_grid_by_three_hundredths(jump, found):
    assert set_by(jump) == found


def test_a_step_has_three_stamps_before_and_after_it():
    # Its own stamp says nothing.
    assert [set_by(0.4, at) for at in (2, 3, 96, 97)] == [[], [3], [96], []]
    assert [set_by(0.4, 16, count) for count in (31, 32)] == [[], [16]]


def test_a_step_is_more_than_six_deviations_of_stamps_that_jitter():
    # To and fro by a fifth of an interval: steps count that are off by 6 * 1.4826 * 0.2 = 1.78.
    jitter = 0.2
    assert set_by(1.57, 10_001, 20_001, jitter) == []
    assert set_by(1.6, 10_001, 20_001, jitter) == [10_001]


@pytest.mark.parametrize('count', [40, 63, 120, 1000])
def test_a_late_sample_of_a_short_motion_is_no_clock_that_was_set(count):
    """Stamps jitter by a fiftieth of an interval, and a median step is off by up to 0.4 % of it.

    The phases of 16 stamps scatter by 0.02 / 4, their difference by 0.007: six of that are 0.042.
    By the median of spans of an eighth of the motion the interval is known to 0.0006 at worst, and
    adds 17 times six of that. Steps count from six deviations of a step on, 0.17.
    """
    told, at = [], count // 2
    for seed in range(100):
        came = np.arange(count) + 0.02 * np.random.default_rng(seed).standard_normal(count)
        late, after = np.arange(count) == at, np.arange(count) >= at
        told.append(clock_steps(stamps(10.0 * (came + 0.2 * late))))
        told.append(clock_steps(stamps(10.0 * (came + 0.01 * after + 0.2 * late))))
        for jump in (0.3, 0.41, 2.41):
            assert clock_steps(stamps(10.0 * (came + jump * after))) == [at]
    assert not any(told)


@pytest.mark.parametrize(('steps', 'count', 'told'), [(2, 400, 2), (3, 1400, 0), (3, 1500, 3)])
def test_stamps_with_many_steps_have_no_grid(steps, count, told):
    late = sum(0.3 * (np.arange(count) >= (k + 1) * count // (steps + 1)) for k in range(steps))
    assert len(clock_steps(stamps(10.0 * (np.arange(count) + late)))) == told


def test_stamps_in_bunches_have_no_steps():
    pairs = alternating(4.9, 10.0, 98)
    assert clock_steps(stamps(pairs)) == []


# A line through the segments of a session


def segment(first: int, count: int, period: float, std: float) -> tuple[float, SampleGrid]:
    """When a segment of a steady clock begins, s, and its grid."""
    index = np.arange(count)
    kept = index >= 0
    return first * 0.01, SampleGrid(index, 0.0, period, std, 0.0, kept)


def session(late: list[float], firsts: list[int], std: float = 1e-6) -> Pace:
    """Segments of 101 samples that are late by so much, s."""
    pace = Pace()
    pace._reference = 0.01
    for first, by in zip(firsts, late, strict=True):
        start, grid = segment(first, 101, 0.01, std)
        pace._note(start + by, grid)
    return pace


LATE = [0.0, 2e-4, -1e-4, 3e-4]
FIRSTS = [0, 300, 700, 1000]


def test_the_interval_is_that_of_a_line_through_the_segments():
    pace = session(LATE, FIRSTS)
    slope, level = np.polyfit(FIRSTS, LATE, 1)
    assert pace.interval == pytest.approx(0.01 + slope, rel=1e-12)
    period, std = pace._long()
    assert period == pytest.approx(0.01 + slope, rel=1e-12)
    # A level is known as well as the interval over the scatter of the samples: 29.15 of 101.
    own = 1e-6 * sqrt((101**2 - 1) / 12)
    spread = ((np.array(FIRSTS) - np.mean(FIRSTS)) ** 2).sum()
    residuals = np.array(LATE) - level - slope * np.array(FIRSTS)
    # They scatter by more than that, with two degrees of freedom.
    assert std == pytest.approx(sqrt((residuals @ residuals) / 2 / spread))
    assert std > 2 * own / sqrt(spread)
    # They scatter by less: what their own errors make of it.
    _, quiet = session([1e-3 * late for late in LATE], FIRSTS)._long()
    assert quiet == pytest.approx(own / sqrt(spread))


def test_segments_count_by_their_own_errors():
    pace = Pace()
    pace._reference = 0.01
    stds = [1e-7, 4e-7, 1e-7, 8e-7]
    for first, late, std in zip(FIRSTS, LATE, stds, strict=True):
        start, grid = segment(first, 101, 0.01, std)
        pace._note(start + late, grid)
    slope = np.polyfit(FIRSTS, LATE, 1, w=1 / np.array(stds))[0]
    assert pace.interval == pytest.approx(0.01 + slope, rel=1e-12)


def test_a_segment_is_timed_by_its_own_stamps_and_by_all():
    pace = session(LATE, FIRSTS)
    long, long_std = pace._long()
    own, own_std = 0.0100004, 3e-7
    a, b = long_std**-2, own_std**-2
    found = pace.combined(Timing(own, own, own_std))
    assert found == (pytest.approx((a * long + b * own) / (a + b)), pytest.approx((a + b) ** -0.5))
    # Three segments leave one degree of freedom: nothing that tells.
    few = session(LATE[:3], FIRSTS[:3])
    assert few.combined(Timing(own, own, own_std)) == (own, own_std)
    assert few._long() == (0.0, inf)
    assert few.interval == 0.01


def test_a_segment_off_the_line_begins_another_piece():
    # By 0.3 of an interval; a quarter would do no harm.
    late = [0.0, 0.0, 0.0, 0.003, 0.003, 0.003, 0.003]
    firsts = [0, 300, 700, 1000, 1400, 1500, 1900]
    pace = session(late, firsts)
    assert len(pace._knots) == 4
    # Two pieces of three and four segments, of one slope: none.
    assert pace._long()[0] == pytest.approx(0.01, rel=1e-12)
    own = 1e-6 * sqrt((101**2 - 1) / 12)
    parts = [np.array(firsts[:3]), np.array(firsts[3:])]
    spread = sum(((part - part.mean()) ** 2).sum() for part in parts)
    assert pace._long()[1] == pytest.approx(own / sqrt(spread))
    assert (pace._pieces + pace._pieces)[0] == 4
    for by, knots in ((0.0024, 4), (-0.0024, 4), (0.0026, 1), (-0.0026, 1)):
        assert len(session([0.0, 0.0, 0.0, by], FIRSTS)._knots) == knots


@pytest.mark.parametrize(('first', 'knots'), [(990, 2), (1010, 1)])
def test_how_many_lie_between_is_sure_to_a_tenth(first, knots):
    # Known to a ten-thousandth: after 1000 intervals to a tenth of one.
    assert len(session([0.0, 0.0], [0, first], std=1e-6)._knots) == knots


def test_the_first_segment_is_where_counting_begins():
    pace = Pace()
    grid, timing = pace.read(stamps(10.0 * np.arange(50)))
    assert timing == Timing(grid.period, grid.period, grid.period_std)
    assert pace.interval == grid.period == pytest.approx(0.01)
    for first in (300, 700, 1000):
        _, timing = pace.read(stamps(10.0 * (first + np.arange(50))))
    assert [knot.number for knot in pace._knots] == [24.5, 324.5, 724.5, 1024.5]
    assert [knot.time for knot in pace._knots] == pytest.approx([0.245, 3.245, 7.245, 10.245])
    # Two stamps have no error that could count.
    pace.read(stamps(10.0 * (2000 + np.arange(2))))
    assert len(pace._knots) == 4
