"""What is held against the table's limits before a step is sent, and the setpoints themselves."""

import math
from dataclasses import replace

import numpy as np
import pytest

from imu_calib.common.errors import InputError
from imu_calib.common.stream import Mode
from imu_calib.common.units import DEG
from imu_calib.live.plan_run import (
    check_step,
    end_of,
    motion_time,
    steps_of_plan,
    stopping_setpoint,
)
from imu_calib.live.sequencer import Obstacles, Pacing
from imu_calib.session.plan import Step, load_plan
from imu_calib.session.table import TURN, Limits, load_table

TABLE = load_table('three_axis')
STILL = np.zeros(3)


def step(angles=(0.0, 0.0, 0.0), rates=(0.0, 0.0, 0.0), turns=0, index=3):
    mode = Mode.RATE if any(rates) else Mode.POSITION
    return Step(index, '9', mode, np.array(angles), np.array(rates), turns, 60.0)


def with_acceleration(limit):
    joints = tuple(replace(joint, max_acceleration=limit) for joint in TABLE.joints)
    return replace(TABLE, joints=joints)


@pytest.mark.parametrize('rate', [30 * DEG, 300 * DEG])
@pytest.mark.parametrize('sense', [1.0, -1.0])
def test_a_turn_needs_the_acceleration_to_run_up_and_down_within_a_turn(rate, sense):
    # Half a turn to run up in: v^2 = 2 a pi.
    needed = rate**2 / (2 * math.pi)
    turn = step(rates=(sense * rate, 0.0, 0.0), turns=2)
    check_step(turn, with_acceleration(1.001 * needed))
    with pytest.raises(InputError) as refused:
        check_step(turn, with_acceleration(0.999 * needed))
    message = str(refused.value)
    assert f'to reach {sense * rate / DEG:g} deg/s joint outer needs' in message
    assert f'needs {needed / DEG:.4g} deg/s^2' in message
    assert f'allows {0.999 * needed / DEG:g} deg/s^2' in message
    assert 'Step 4, position 9' in message


def test_a_step_ends_where_its_turns_and_the_turn_to_run_up_and_down_in_end():
    turn = step((0.5, 0.25, 0.0), (0.0, -60 * DEG, 0.0), turns=2)
    np.testing.assert_allclose(end_of(turn), [0.5, 0.25 - 3 * TURN, 0.0])
    np.testing.assert_allclose(end_of(step((0.5, 0.25, 0.0))), [0.5, 0.25, 0.0])


def test_a_motion_takes_as_long_as_its_slowest_joint():
    # 400 deg/s and 200 deg/s^2: 90 deg take 2 sqrt(90 / 200) s, the top rate is not reached.
    goal = step((90 * DEG, 10 * DEG, 0.0))
    assert motion_time(goal, STILL, TABLE) == pytest.approx(2 * math.sqrt(90 / 200))
    # Three turns at 60 deg/s: 1080 / 60 s, and 60 / 200 s for running up and down.
    turn = step(rates=(60 * DEG, 0.0, 0.0), turns=2)
    assert motion_time(turn, STILL, TABLE) == pytest.approx(1080 / 60 + 60 / 200)


def test_a_setpoint_says_what_its_step_is():
    turn = step((0.5, 0.25, 0.0), (60 * DEG, 0.0, 0.0), turns=2)
    sent = turn.setpoint('small', TABLE.names)
    assert (sent.stamp, sent.plan, sent.step, sent.position) == (0, 'small', 3, '9')
    assert (sent.mode, sent.joints) == (Mode.RATE, TABLE.names)
    assert (sent.angles, sent.rates) == ((0.5, 0.25, 0.0), (60 * DEG, 0.0, 0.0))
    assert (sent.turns, sent.dwell) == (2.0, 60.0)


def test_a_hold_is_told_where_the_table_is_within_its_limits():
    joints = (replace(TABLE.joints[0], limits=Limits(-1.0, 2.0)), *TABLE.joints[1:])
    table = replace(TABLE, joints=joints)
    hold = stopping_setpoint(step(), (2.5, 0.25, 0.125), 'small', table)
    assert (hold.mode, hold.step, hold.position, hold.plan) == (Mode.HOLD, 3, '9', 'small')
    assert hold.angles == (2.0, 0.25, 0.125)
    assert stopping_setpoint(step(), (-2.5, 0.25, 0.125), 'small', table).angles[0] == -1.0
    assert (hold.rates, hold.turns, hold.dwell, hold.stamp) == ((0.0, 0.0, 0.0), 0.0, 0.0, 0)
    # Of a table that has not been heard, before any step.
    unknown = stopping_setpoint(None, None, 'small', table)
    assert (unknown.step, unknown.position, unknown.angles) == (0, '', (0.0, 0.0, 0.0))


def test_the_way_home_of_a_plan_is_where_the_table_stood():
    start = np.array([0.1, 0.2, 0.3])
    steps, return_step = steps_of_plan(load_plan('twelve_position'), TABLE, start)
    assert return_step.index == steps[-1].index
    np.testing.assert_array_equal(return_step.angles, start)
    assert (return_step.mode, return_step.dwell, return_step.turns) == (Mode.POSITION, 0.0, 0)
    assert not return_step.rates.any()


@pytest.mark.parametrize(('turns', 'fits'), [(1, True), (2, False)])
def test_a_turn_ends_within_the_limits_of_its_joint(turns, fits):
    joints = (replace(TABLE.joints[0], limits=Limits(-1.0, 2.5 * TURN)), *TABLE.joints[1:])
    turn, table = step(rates=(60 * DEG, 0.0, 0.0), turns=turns), replace(TABLE, joints=joints)
    if fits:
        check_step(turn, table)
    else:
        with pytest.raises(InputError, match='joint outer at 1080 deg'):
            check_step(turn, table)


def test_what_forbids_is_new_once():
    obstacles = Obstacles()
    assert obstacles.forbid('estop', '') is False
    assert [obstacles.forbid('estop', 'Two.') for _ in range(2)] == [True, False]
    assert obstacles.forbid('estop', 'Three.') is True
    assert obstacles.forbid('door', 'Open.') is True
    assert obstacles.forbidden == 'Three. Open.'
    assert obstacles.forbid('estop', '') is False
    assert obstacles.forbidden == 'Open.'


# When a setpoint is due: by the table's time, by the steady clock, and at once where it is new


MS = 1_000_000


def test_a_new_setpoint_is_due_at_once_and_once():
    pacing = Pacing(10.0)
    pacing.sent(0, 0.0, 1)
    assert not pacing.is_due(50 * MS, 0.05, 1)
    assert pacing.is_due(50 * MS, 0.05, 2)
    pacing.sent(50 * MS, 0.05, 2)
    assert not pacing.is_due(60 * MS, 0.06, 2)


def test_without_joint_states_the_steady_clock_counts():
    pacing = Pacing(10.0)
    assert pacing.is_due(None, 5.0, 1)
    pacing.sent(None, 5.0, 1)
    assert not pacing.is_due(None, 5.099, 1)
    assert pacing.is_due(None, 5.101, 1)
    # Joint states that stand still are no time either.
    pacing.sent(0, 6.0, 1)
    assert not pacing.is_due(0, 6.099, 1)
    assert pacing.is_due(0, 6.101, 1)


def test_a_fast_table_is_led_by_its_own_time():
    pacing, stamps = Pacing(10.0), []
    for k in range(1000):
        stamp = k * 10 * MS
        if pacing.is_due(stamp, 1e-5 * k, 1):
            pacing.sent(stamp, 1e-5 * k, 1)
            stamps.append(stamp)
    assert stamps == [k * 100 * MS for k in range(100)]


def test_a_delay_does_not_lower_the_rate():
    """Joint states every 30 ms, setpoints every 100 ms: ten in a second in the mean."""
    pacing, count = Pacing(10.0), 0
    for k in range(1000):
        if pacing.is_due(k * 30 * MS, 1e-6 * k, 0):
            pacing.sent(k * 30 * MS, 1e-6 * k, 0)
            count += 1
    assert abs(count - 300) <= 1


def test_a_table_whose_time_begins_anew_is_led_on():
    pacing = Pacing(10.0)
    pacing.sent(10_000 * MS, 0.0, 1)
    assert not pacing.is_due(10_050 * MS, 0.01, 1)
    assert pacing.is_due(0, 0.02, 1)
    pacing.sent(0, 0.02, 1)
    assert not pacing.is_due(50 * MS, 0.03, 1)
    assert pacing.is_due(100 * MS, 0.04, 1)
