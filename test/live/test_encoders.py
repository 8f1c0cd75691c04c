"""Joint states as a table reports them: in its order, continuous, with rates; what is refused."""

import math
from dataclasses import replace

import numpy as np
import pytest

from imu_calib.common.stream import JointBlock
from imu_calib.common.units import DEG
from imu_calib.live.rules import Rules
from imu_calib.live.table_watch import Encoders, Feedback, FeedbackError, IdleWatch
from imu_calib.session.table import load_table

TABLE = load_table('three_axis')
NAMES = TABLE.names
MS, START = 1_000_000, 1_700_000_000_000_000_000
QUIET, PATIENCE = 1e-4, 0.5
NAN = math.nan


def block(
    at_ms: list[int],
    angles: list[tuple[float, float, float]],
    rates: list[tuple[float, float, float]] | None = None,
    names: tuple[str, ...] = NAMES,
) -> JointBlock:
    stamps = START + np.array(at_ms, dtype=np.int64) * MS
    return JointBlock(
        stamps,
        names,
        np.array(angles, dtype=float),
        np.array(rates or [(0.0, 0.0, 0.0)] * len(at_ms), dtype=float),
    )


def encoders() -> Encoders:
    return Encoders(TABLE, QUIET, PATIENCE)


def taken(*blocks: JointBlock) -> list[Feedback]:
    mine = encoders()
    return [feedback for one in blocks for feedback in mine.read_feedback(one)]


def test_joints_come_in_the_order_of_the_table_whatever_that_of_the_message():
    mixed = (NAMES[2], 'door', NAMES[0], NAMES[1])
    stamps = START + np.array([0, 50], dtype=np.int64) * MS
    angles = np.array([[0.3, 9.0, 0.1, 0.2], [0.3, 9.0, 0.11, 0.2]])
    found = taken(JointBlock(stamps, mixed, angles, angles * 0.1))
    assert [f.angles for f in found] == [(0.1, 0.2, 0.3), (0.11, 0.2, 0.3)]
    assert found[1].rates == pytest.approx((0.011, 0.02, 0.03))
    assert [f.gap for f in found] == pytest.approx([0.0, 0.05])
    assert found[0].stamp == START


def test_messages_that_lack_a_joint_are_counted_and_named():
    mine = encoders()
    other = JointBlock(
        START + np.arange(3) * MS, ('door', 'lid'), np.zeros((3, 2)), np.zeros((3, 2))
    )
    assert list(mine.read_feedback(other)) == []
    assert mine.ignored == 3
    assert mine.ignored_names == ('door', 'lid')
    assert len(list(mine.read_feedback(block([0], [(0.0, 0.0, 0.0)])))) == 1
    assert mine.ignored == 3


def test_stamps_that_do_not_advance_are_left_out_and_a_jump_back_is_said():
    still = (0.0, 0.0, 0.0)
    mine = encoders()
    found = list(mine.read_feedback(block([0, 10, 10, 5, 20], [still] * 5)))
    assert [f.stamp - START for f in found] == [0, 10 * MS, 20 * MS]
    # Half a second back is patience yet, a millisecond more is not.
    assert list(mine.read_feedback(block([-480], [still]))) == []
    with pytest.raises(FeedbackError, match=r'jump back by 0\.501 s'):
        list(mine.read_feedback(block([-481], [still])))
    # The stream begins anew there.
    (again,) = mine.read_feedback(block([-470], [(1.0, 2.0, 3.0)]))
    assert again.gap == 0.0
    assert again.angles == (1.0, 2.0, 3.0)


@pytest.mark.parametrize('wrong', [NAN, math.inf])
def test_an_angle_that_is_no_number_is_named(wrong):
    with pytest.raises(FeedbackError, match=f'give {wrong} as the angle of joint {NAMES[1]}'):
        taken(block([0], [(0.0, wrong, NAN)]))


def test_rates_that_nobody_reports_are_the_mean_of_the_last_tenth_of_a_second():
    """Of one joint they are derived, of the others taken as they come."""
    at = list(range(0, 260, 20))
    # Slow for 0.1 s, then ten times as fast.
    way = [0.01 * ms / 1000 if ms <= 100 else 0.001 + 0.1 * (ms - 100) / 1000 for ms in at]
    found = taken(block(at, [(0.0, w, 0.0) for w in way], [(0.5, NAN, 0.25)] * len(at)))
    assert found[0].rates == (0.5, 0.0, 0.25)
    assert [f.rates[0] for f in found] == [0.5] * len(at)
    assert [f.rates[2] for f in found] == [0.25] * len(at)
    derived = dict(zip(at, [f.rates[1] for f in found], strict=True))
    # Before a tenth of a second has come in it is the mean of what has.
    assert derived[40] == pytest.approx(0.01)
    assert derived[100] == pytest.approx(0.01)
    assert derived[140] == pytest.approx((0.06 * 0.01 + 0.04 * 0.1) / 0.1)
    assert derived[200] == pytest.approx(0.1)
    assert derived[240] == pytest.approx(0.1)


def test_at_rest_is_who_has_not_moved_for_a_tenth_of_a_second():
    moved = [(0.0, 0.0, 0.0)] * 8
    moved[3:] = [(0.0, 0.0, 1.1 * QUIET)] * 5
    found = taken(block([0, 20, 40, 60, 80, 100, 160, 200], moved))
    # At 100 ms the joint has moved within the window, at 160 it has stood since 60.
    assert [f.still for f in found] == [False] * 6 + [True, True]
    little = [(0.0, 0.9 * QUIET * (k % 2), 0.0) for k in range(6)]
    found = taken(block([0, 20, 40, 60, 80, 100], little))
    assert [f.still for f in found] == [False] * 5 + [True]


def test_an_encoder_that_wraps_is_followed_through():
    rate = 100 * DEG
    at = list(range(0, 8000, 20))
    true = [rate * ms / 1000 for ms in at]
    shown = [(math.remainder(angle, 2 * math.pi), 0.0, 0.0) for angle in true]
    found = taken(block(at, shown))
    assert [f.angles[0] for f in found] == pytest.approx(true)
    # Backwards likewise, and a table that began beyond half a turn stays where it said it was.
    back = taken(block(at, [(-a, b, c) for a, b, c in shown]))
    assert [f.angles[0] for f in back] == pytest.approx([-angle for angle in true])


def test_a_jump_that_no_wrap_makes_is_left_for_the_watch_to_see():
    # Half a turn and a bit; and a whole turn after a gap longer than patience.
    for at, to in (([0, 20], math.pi + 0.5), ([0, 600], 2 * math.pi)):
        found = taken(block(at, [(0.0, 0.0, 0.0), (to, 0.0, 0.0)]))
        assert found[1].angles[0] == to
    # Within patience a whole turn in no time is a wrap.
    found = taken(block([0, 20], [(0.0, 0.0, 0.0), (2 * math.pi, 0.0, 0.0)]))
    assert found[1].angles[0] == pytest.approx(0.0)


def test_a_wrap_may_be_five_degrees_off_what_the_table_can_have_turned():
    # In 20 ms the outer joint turns 8 deg at the most; a tenth more and 5 deg are granted.
    reach = 1.1 * TABLE.joints[0].max_rate * 0.02 + 5 * DEG
    for sign in (1, -1):
        for beyond, wraps in ((-0.2 * DEG, True), (0.2 * DEG, False)):
            to = sign * (2 * math.pi - reach - beyond)
            found = taken(block([0, 20], [(0.0, 0.0, 0.0), (to, 0.0, 0.0)]))
            expected = to - sign * 2 * math.pi if wraps else to
            assert found[1].angles[0] == pytest.approx(expected)


@pytest.mark.parametrize('wild', [math.inf, -math.inf, math.nan])
def test_a_rate_that_is_no_number_is_that_of_the_angles(wild):
    angles = [(0.001 * k, 0.0, 0.0) for k in range(20)]
    found = taken(block([10 * k for k in range(20)], angles, [(wild, 0.5, 0.0)] * 20))
    assert found[0].rates == (0.0, 0.5, 0.0)
    assert found[-1].rates == pytest.approx((0.1, 0.5, 0.0))


def test_the_mean_rates_are_those_of_the_angles_over_a_tenth_of_a_second():
    times = np.arange(31) * 0.01
    angles = [(float(t * t), 0.0, 0.0) for t in times]
    found = taken(block([10 * k for k in range(31)], angles, [(2.0, 0.0, 0.0)] * 31))
    assert found[0].means == ()
    assert found[-1].means == pytest.approx((0.3 + 0.2, 0.0, 0.0))


@pytest.mark.parametrize('far', [1e308, -1e308, 7e6, -7e6])
def test_an_angle_that_no_table_has_is_refused(far):
    mine = encoders()
    list(mine.read_feedback(block([0], [(0.0, 0.0, 0.0)])))
    with pytest.raises(FeedbackError, match='as the angle of joint middle'):
        list(mine.read_feedback(block([10], [(0.0, far, 0.0)])))


# A table that nobody leads and that moves all the same: what is said of it, and how often


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
