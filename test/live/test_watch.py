"""What counts as arrived, late, stalled and astray, and the sentence that says it."""

from dataclasses import replace

import numpy as np
import pytest

from imu_calib.common.stream import Mode
from imu_calib.common.units import DEG
from imu_calib.live.rules import Rules
from imu_calib.live.table_watch import Feedback, Standing, Watch
from imu_calib.session.plan import Step
from imu_calib.session.table import Limits, load_table

TABLE = load_table('three_axis')  # outer 400 deg/s and 200 deg/s^2
GOAL = np.array([40.0, 5.0, 0.0])


def at(seconds, outer=40.0, middle=5.0, still=False):
    angles = tuple(DEG * np.array([outer, middle, 0.0]))
    return Feedback(round(seconds * 1e9), 0.05, angles, (0.0, 0.0, 0.0), still)


def watch(rules=None):
    """Return the watch of a move of the outer joint from 0 to 40 deg: 0.894 s at the limits."""
    step = Step(0, '1', Mode.POSITION, GOAL * DEG, np.zeros(3), 0, 0.0)
    return Watch(TABLE, rules or Rules(), step, at(0.0, outer=0.0))


def test_a_motion_has_arrived_when_it_stands_within_the_tolerance():
    assert watch().check(at(1.0, 39.991, still=True)) == (True, '')
    assert watch().check(at(1.0, 39.991, still=False)) == (False, '')
    assert watch().check(at(1.0, 39.989, still=True)) == (False, '')


def test_a_joint_that_comes_nearer_and_nearer_may_take_twice_its_time_and_2_s():
    late = watch()
    for seconds, outer in ((1.0, 30.0), (2.0, 36.0), (3.0, 38.5), (3.7, 39.0)):
        assert late.check(at(seconds, outer)) == (False, '')
    arrived, fault = late.check(at(3.85, 39.2))
    assert not arrived
    assert fault == (
        'Joint outer is 0.8000 deg off its goal of 40.000 deg after 3.9 s (tolerance 0.01 deg); at '
        'its limits the table needs 0.9 s.'
    )


@pytest.mark.parametrize(
    ('outer', 'since', 'until', 'said'),
    [
        # A second, and what the joint needs to full rate.
        (10.0, 2.99, 3.01, 'stalls at 10.000 deg moving to 40.000 deg: 10.000 deg in 3.0 s.'),
        (
            39.8,
            1.0,
            4.1,
            'stops at 39.8000 deg, 0.2000 deg off its goal (tolerance 0.01 deg).',
        ),
    ],
    ids=['on its way', 'beside its goal'],
)
def test_a_joint_that_gets_nowhere_is_a_fault_after_a_while(outer, since, until, said):
    stalled = watch()
    assert stalled.check(at(since, outer)) == (False, '')
    assert stalled.check(at(until, outer)) == (False, f'Joint outer {said}')


def test_half_a_degree_beyond_the_goal_or_back_is_let_pass():
    there = watch()
    assert there.check(at(0.5, 30.0)) == (False, '')
    assert there.check(at(0.6, 29.6)) == (False, '')
    assert there.check(at(0.7, 40.4)) == (False, '')
    assert there.check(at(0.8, 40.6)) == (
        False,
        'Joint outer is at 40.600 deg, it has passed its goal of 40.000 deg.',
    )
    back = watch()
    back.check(at(0.5, 30.0))
    assert back.check(at(0.6, 29.4)) == (
        False,
        'Joint outer is at 29.400 deg and moves away from its goal of 40.000 deg.',
    )


def turning(rates):
    """Return what the watch of turns at 60 deg/s says at these rates, each for 0.3 s, deg/s."""
    step = Step(0, '1', Mode.RATE, GOAL * DEG, np.array([60.0, 0.0, 0.0]) * DEG, 3, 0.0)
    turns = Watch(TABLE, Rules(), step, at(0.0))
    assert turns.check(at(4.0, outer=280.0)) == (False, '')
    outer, seconds = 280.0, 4.0
    messages = []
    for rate in rates:
        outer += 0.3 * rate
        seconds += 0.3
        arrived, fault = turns.check(at(seconds, outer))
        assert not arrived
        messages.append(fault)
    return messages


def test_turns_are_held_against_the_rate_that_was_commanded():
    said = turning([60.0, 53.0, 54.5, 53.5, 60.0, 66.5, 67.5])
    assert said[:-1] == [''] * 6
    assert said[-1] == 'Joint outer turns at 67.5 deg/s, commanded is 60 deg/s.'


def test_one_late_joint_state_is_no_wrong_rate():
    # 35 ms late: an eighth too slow, and an eighth too fast after it.
    assert turning([60.0, 53.0, 67.0, 60.0, 53.0, 67.0]) == [''] * 6


def test_a_wrong_rate_counts_at_the_second_look_and_a_very_wrong_one_at_once():
    slow = 'Joint outer turns at 53 deg/s, commanded is 60 deg/s.'
    assert turning([53.0, 53.0]) == ['', slow]
    assert turning([31.0, 60.0]) == turning([89.0, 60.0]) == ['', '']
    for rate in (29.0, 91.0):
        assert turning([rate]) == [f'Joint outer turns at {rate:g} deg/s, commanded is 60 deg/s.']


@pytest.mark.parametrize(('arrival', 'stray'), [(0.01, 0.05), (1.0, 0.5)])
@pytest.mark.parametrize('side', [-1.0, 1.0])
def test_what_is_to_stand_may_stray_by_five_tolerances_and_never_by_the_overshoot(
    arrival, stray, side
):
    rules = replace(Rules(), arrival=arrival * DEG)
    standing = Standing(TABLE, rules, None)
    standing.keep(at(0.0).angles)
    within, beyond = 5.0 + 0.9 * side * stray, 5.0 + 1.1 * side * stray
    said = (
        False,
        f'Joint middle moves while it is to stand at 5.000 deg: it is at {beyond:.3f} deg.',
    )
    assert standing.check(at(0.1, middle=within)) == (True, '')
    assert standing.check(at(0.1, middle=beyond)) == said
    assert watch(rules).check(at(0.1, outer=5.0, middle=within)) == (False, '')
    assert watch(rules).check(at(0.1, outer=5.0, middle=beyond)) == said


@pytest.mark.parametrize('side', [-1.0, 1.0])
def test_a_joint_beyond_its_limits_is_a_fault_on_either_side(side):
    joints = (replace(TABLE.joints[0], limits=Limits(-45.0 * DEG, 45.0 * DEG)), *TABLE.joints[1:])
    table = replace(TABLE, joints=joints)
    step = Step(0, '1', Mode.POSITION, np.array([side * 45.0, 5.0, 0.0]) * DEG, np.zeros(3), 0, 0.0)
    # A motion to the limit may overshoot by half a degree, as any.
    motion = Watch(table, Rules(), step, at(0.0, outer=0.0))
    assert motion.check(at(0.8, side * 45.4)) == (False, '')
    arrived, fault = motion.check(at(0.9, side * 45.6))
    assert not arrived
    assert 'beyond its limits of -45 to 45 deg' in fault
