"""A table that nobody leads and that moves all the same: what is said of it, and how often."""

from __future__ import annotations

from dataclasses import replace

import pytest

from imu_calib.common.units import DEG
from imu_calib.live.rules import Rules
from imu_calib.live.table_watch import Feedback, IdleWatch
from imu_calib.session.table import load_table

TABLE = load_table('three_axis')
RULES = Rules()  # arrives within 0.01 deg, so that what stands may stray by 0.05 deg
NOT_LED = 'without a command'


def at(seconds, outer=0.0, middle=0.0, rate=0.0, gap=0.05, still=False):
    """Return a joint state; `rate` is that of the outer joint, deg/s."""
    angles = (outer * DEG, middle * DEG, 0.0)
    return Feedback(round(seconds * 1e9), gap, angles, (rate * DEG, 0.0, 0.0), still)


def standing():
    """Return the watch of a table that has come to rest at zero."""
    watch = IdleWatch(TABLE, RULES, at(0.0))
    assert not watch.check(at(0.1, still=True))
    return watch


def test_a_table_that_stands_is_nothing_to_be_told():
    watch = standing()
    for k in range(1, 9):
        assert not watch.check(at(0.1 + 0.1 * k, outer=0.04 * (k % 2), still=True))
    assert (watch.text, watch.is_moving, watch.excursion, watch.rate) == ('', False, 0.0, 0.0)


def test_a_motion_within_a_gap_has_its_mean_rate():
    watch = standing()
    moved = at(0.7, outer=6.0, gap=0.6)
    assert watch.check(replace(moved, means=(10.0 * DEG, 0.0, 0.0)))
    assert 'moved 6.00 deg, at up to 10 deg/s' in watch.text


def test_what_a_joint_does_is_told_as_it_begins_as_it_doubles_and_as_it_stands():
    watch = standing()
    messages = []
    ways = [0.06, 0.08, 0.119, 0.121, 0.2, 0.23, 0.25, 0.3]
    for k, excursion in enumerate(ways):
        if watch.check(at(0.2 + 0.1 * k, outer=-excursion, rate=-1.0)):
            messages.append(excursion)
            assert watch.is_moving
            assert watch.text == (
                'Joint outer moves while it is to stand at 0.000 deg: it is at -0.060 deg. '
                f'Joint outer moved {excursion:.2f} deg, at up to 1 deg/s, {NOT_LED}; '
                'it still moves.'
            )
    assert messages == [0.06, 0.121, 0.25]
    # On the way back it has gone no further.
    assert not watch.check(at(1.1, outer=-0.1, rate=2.0))
    assert watch.check(at(1.2, outer=-0.1))
    assert watch.text.endswith(f'moved 0.30 deg, at up to 2 deg/s, {NOT_LED}; it stands again.')
    assert (watch.is_moving, watch.excursion, watch.rate) == (
        False,
        pytest.approx(0.3 * DEG),
        pytest.approx(2.0 * DEG),
    )
    # It stands where it is now; a shorter way than the one that was told is no news.
    assert not watch.check(at(1.3, outer=-0.1, still=True))
    assert not watch.is_moving
    assert not watch.check(at(1.4, outer=-0.2))
    assert watch.is_moving
    assert watch.check(at(1.5, outer=-0.7))
    assert f'moved 0.70 deg, at up to 2 deg/s, {NOT_LED}; it still moves.' in watch.text


def test_the_joint_that_went_furthest_is_named():
    watch = standing()
    assert watch.check(at(0.2, outer=0.06, middle=0.05))
    assert 'Joint outer moved 0.06 deg' in watch.text
    assert watch.check(at(0.3, outer=0.06, middle=0.5))
    assert 'Joint middle moved 0.50 deg' in watch.text


@pytest.mark.parametrize(
    ('step', 'rate', 'rests'),
    [
        (0.0, 0.0, True),
        (0.009, 0.0, True),
        (0.011, 0.0, False),
        (-0.011, 0.0, False),
        # 0.01 deg within a tenth of a second.
        (0.0, 0.099, True),
        (0.0, 0.101, False),
        (0.0, -0.101, False),
    ],
)
def test_it_rests_when_neither_angle_nor_rate_shows_a_motion(step, rate, rests):
    watch = standing()
    watch.check(at(0.2, outer=1.0, rate=5.0))
    fault = watch.check(at(0.3, outer=1.0 + step, rate=rate))
    assert (fault, watch.is_moving) == (rests, not rests)


def test_a_table_that_is_still_moving_after_its_time_to_stop_is_told():
    # The longest way to stop is that of the outer joint: 400 / 200 s; twice that, and 1 s.
    watch = IdleWatch(TABLE, RULES, at(0.0), commanded=True)
    for k in range(1, 50):
        assert not watch.check(at(0.1 * k, outer=k, rate=10.0))
    assert watch.check(at(5.2, outer=52.0, rate=10.0))
    assert watch.text.startswith('The table still moves 5.2 s after the command to stand still.')


@pytest.mark.parametrize(('gap', 'again'), [(0.5, False), (0.51, True), (0.0, True)])
def test_what_a_table_did_while_it_was_not_seen_is_not_held_against_it(gap, again):
    watch = IdleWatch(TABLE, RULES, at(0.0), commanded=True)
    assert not watch.check(at(4.5, outer=10.0, rate=10.0, gap=gap))
    # Its time to stop begins anew with what is seen again.
    assert watch.check(at(5.2, outer=17.0, rate=10.0)) != again


def test_a_table_that_stood_before_nobody_saw_it_stands_where_it_stood():
    watch = standing()
    assert watch.check(at(9.0, outer=10.0, gap=8.0, still=True))
    assert 'moved 10.00 deg' in watch.text
    assert watch.text.endswith('it stands again.')
