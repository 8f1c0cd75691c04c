"""The sequencer leads the simulated table: whatever goes wrong, the table stands at the end."""

import math
import re
from contextlib import suppress
from copy import deepcopy
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sequenced_table import ALONE, EPOCH, PERIOD, TABLE, Stand, setpoint, small_plan

from imu_calib.common.errors import InputError
from imu_calib.common.stream import JointBlock, Mode
from imu_calib.common.units import DEG
from imu_calib.live.rules import Phase, Rules
from imu_calib.live.sequencer import Sequencer
from imu_calib.live.table_watch import Encoders, Feedback
from imu_calib.live.trajectory import Lead, Overtaken
from imu_calib.session.table import TURN, Limits
from imu_calib.simulation.table import SimulatedTable


def modes(stand, step):
    """Modes that were sent for a step, one after the other."""
    sent = [s.mode for s in stand.sent if s.step == step]
    return [m for k, m in enumerate(sent) if k == 0 or m is not sent[k - 1]]


def turning(stand, turns=0.5):
    """Bring a stand into the middle of its first turn."""
    stand.started()
    stand.run(lambda state: state.phase is Phase.TURNING and state.turns_done > turns)
    return stand


def moving(stand):
    """Bring a stand half way to its second position."""
    stand.started()
    stand.run(lambda state: state.position == '10' and abs(state.rates[0]) > 20 * DEG)
    return stand


def pauses(stand, *words, seconds=20.0):
    """Hold that the table is paused for a reason and stands; return the reason."""
    state = stand.phase(Phase.PAUSED, seconds)
    assert state.fault
    assert all(word in state.reason for word in words), state.reason
    assert stand.sent[-1].mode is Mode.HOLD
    assert stand.stands()
    assert stand.sequencer.state().phase is Phase.PAUSED
    return state.reason


def shifted(middle):
    """Return a plant whose middle joint has jumped."""
    return lambda time, angles, rates: (angles + np.array([0.0, middle, 0.0]), rates)


def recovers(stand):
    """Resume; the plan runs to its end and the table stands."""
    stand.plant = lambda time, angles, rates: (angles, rates)
    stand.link = lambda setpoint: setpoint
    stand.tick()
    stand.sequencer.start()
    stand.phase(Phase.DONE)
    assert stand.stands()


def test_a_plan_runs_to_its_end_and_the_table_goes_back_to_where_it_began():
    start = np.array([20.0, 5.0, -30.0]) * DEG
    stand = Stand(start=start).started()
    state = stand.phase(Phase.DONE)
    assert stand.refusals == []
    assert stand.stands()
    assert np.abs(np.array(state.angles) - start).max() < 0.01 * DEG
    assert [step for step, phase in stand.phases if phase is Phase.TURNING] == [1, 2]
    assert [step for step, phase in stand.phases if phase is Phase.DWELLING] == [3, 4]
    assert all(modes(stand, step) == [Mode.RATE] for step in (1, 2))


def test_a_dwell_lasts_as_long_as_the_plan_says_by_the_stamps():
    stand = Stand(small_plan(dwell=7.0)).started()
    begin = stand.phase(Phase.DWELLING) and stand.time
    stand.run(lambda state: state.phase is not Phase.DWELLING)
    assert 7.0 - PERIOD <= stand.time - begin <= 7.0 + 2 * stand.block * PERIOD


def test_within_a_step_a_second_is_left_less_each_second():
    stand, seen = Stand(small_plan(dwell=3.0)).started(), []

    def done(state):
        seen.append((stand.time, state))
        return state.phase is Phase.DONE

    stand.run(done)
    spent = {Phase.MOVING: [], Phase.SETTLING: [], Phase.DWELLING: []}
    for (before, earlier), (now, later) in pairwise(seen):
        if (earlier.step, earlier.phase) == (later.step, later.phase) and later.phase in spent:
            fell = earlier.seconds_left - later.seconds_left
            spent[later.phase].append(fell / (now - before))
    assert all(len(rates) > 20 for rates in spent.values())
    # Settling and the dwell are one time: it does not jump where one becomes the other.
    between = [
        (earlier.seconds_left - later.seconds_left) / (now - before)
        for (before, earlier), (now, later) in pairwise(seen)
        if (earlier.phase, later.phase) == (Phase.SETTLING, Phase.DWELLING)
    ]
    assert between == pytest.approx([1.0] * 2, abs=0.3)
    for phase in (Phase.SETTLING, Phase.DWELLING):
        assert spent[phase] == pytest.approx([1.0] * len(spent[phase]), abs=1e-3)
    # A motion may take longer than was reckoned with: then nothing of it is left, and no less.
    assert -1e-3 < min(spent[Phase.MOVING]) <= max(spent[Phase.MOVING]) < 1 + 1e-3
    assert np.mean(spent[Phase.MOVING]) > 0.8


def test_the_time_that_is_left_runs_down_to_nothing():
    stand = Stand().started()
    told = stand.run(lambda state: state.phase is Phase.MOVING).seconds_left
    begin = stand.time
    assert stand.phase(Phase.DONE).seconds_left == 0
    assert stand.time - begin == pytest.approx(told, rel=0.15)


@pytest.mark.parametrize('options', [{'wrapped': True}, {'servo_error': 0.005 * DEG}])
def test_turns_are_counted_through(options):
    stand = Stand(small_plan(rates=(200 * DEG, -30 * DEG)), **options).started()
    most = {}
    while (state := stand.tick()).phase is not Phase.DONE:
        most[state.step] = max(most.get(state.step, 0.0), state.turns_done)
        assert state.phase is not Phase.PAUSED, state.reason
    assert (most[1], most[2]) == (1.0, 1.0)
    assert stand.stands()


def test_joint_states_may_name_their_joints_in_another_order_and_carry_no_rates():
    stand = Stand()
    stand.names, stand.columns = ('inner', 'outer', 'middle'), [2, 0, 1]
    stand.plant = lambda time, angles, rates: (angles, np.full_like(rates, np.nan))
    turning(stand)
    assert stand.sequencer.state().rates[0] == pytest.approx(60 * DEG, rel=0.01)
    stand.phase(Phase.DONE)
    assert stand.stands()


def test_a_table_that_is_slower_than_its_file_says_is_no_fault():
    joints = tuple(
        replace(j, max_rate=0.6 * j.max_rate, max_acceleration=0.6 * j.max_acceleration)
        for j in TABLE.joints
    )
    stand = Stand()
    stand.table = SimulatedTable(replace(TABLE, joints=joints), epoch=EPOCH)
    state = stand.started().run(lambda s: s.phase in {Phase.DONE, Phase.PAUSED})
    assert state.phase is Phase.DONE, state.reason


def test_noise_of_encoder_and_stamps_is_no_fault():
    noise = np.random.default_rng(2)
    stand = Stand(small_plan(rates=(10 * DEG, 200 * DEG)))
    stand.jitter = lambda n: 0.003 * noise.uniform(-1, 1, n)
    stand.plant = lambda time, angles, rates: (
        angles + 0.001 * DEG * noise.standard_normal(angles.shape),
        rates + 0.1 * DEG * noise.standard_normal(rates.shape),
    )
    state = stand.started().run(lambda s: s.phase in {Phase.DONE, Phase.PAUSED}, 300.0)
    assert state.phase is Phase.DONE, state.reason


@pytest.mark.parametrize('rate', [5.0, 20.0])
def test_joint_states_may_come_seldom(rate):
    stand = Stand(small_plan(rates=(200 * DEG,)), wrapped=True)
    take, last = stand.sequencer.add_joint_states, [-1.0]

    def thinned(block):
        now = (block.stamp[-1] - EPOCH) * 1e-9
        if now - last[0] >= 1 / rate - 1e-9:
            last[0] = now
            take(
                JointBlock(block.stamp[-1:], block.names, block.position[-1:], block.velocity[-1:])
            )

    stand.sequencer.add_joint_states = thinned
    state = stand.started().run(lambda s: s.phase in {Phase.DONE, Phase.PAUSED})
    assert state.phase is Phase.DONE, state.reason
    assert stand.stands()


def test_joint_states_at_a_hundredth_of_their_rate_do_not_move_the_table():
    sequencer = Sequencer(small_plan(), TABLE, ALONE)
    for second in range(5):
        stamp = np.array([EPOCH + second * 10**9])
        sequencer.add_joint_states(
            JointBlock(stamp, TABLE.names, np.zeros((1, 3)), np.zeros((1, 3)))
        )
        if second == 1:
            sequencer.start()
        sent = sequencer.setpoint(int(stamp[0]))
        assert sent is None or sent.mode is Mode.HOLD
    assert 'No joint state for 1.00 s' in sequencer.state().reason


@pytest.mark.parametrize('bring', [moving, turning])
def test_a_table_that_stalls_is_stopped(bring):
    stand = bring(Stand())
    frozen = np.array(stand.sequencer.state().angles)
    stand.plant = lambda time, angles, rates: (np.broadcast_to(frozen, angles.shape), 0 * rates)
    pauses(stand, 'outer', 'stalls' if bring is moving else 'commanded is 60 deg/s')
    recovers(stand)


def test_a_table_that_passes_its_goal_is_stopped():
    stand = moving(Stand())
    goal = np.array(stand.sent[-1].angles)
    begin = np.array(stand.sequencer.state().angles)
    stand.plant = lambda time, angles, rates: (angles + 0.02 * (angles - begin), rates)
    assert abs(goal - begin)[0] > 30 * DEG
    stand.run(lambda state: state.phase is Phase.PAUSED)
    # The tolerance, and what the fastest joint goes within the joint states of one tick.
    over = abs(stand.sequencer.state().angles[0] - begin[0]) - abs(goal - begin)[0]
    assert 0.5 * DEG < over < 0.5 * DEG + 400 * DEG * PERIOD * stand.block
    pauses(stand, 'outer', 'passed its goal')


def test_a_joint_beyond_its_limits_is_stopped():
    outer, middle, inner = TABLE.joints
    middle = replace(middle, limits=Limits(-100 * DEG, 100 * DEG))
    stand = moving(Stand(table=replace(TABLE, joints=(outer, middle, inner))))
    stand.plant = shifted(middle=170 * DEG)
    assert stand.tick().phase is Phase.PAUSED
    pauses(stand, 'middle', 'is at 170.000 deg, beyond its limits of -100 to 100 deg')


def of_nothing(_angles, _stamps):
    return 500


def of_a_jump(angles, _):
    angles[330:, 1] += 3 * DEG
    return 500


def of_one_stray(angles, _):
    angles[300, 1] += 3 * DEG
    return 500


def of_a_gap(_, stamps):
    stamps[300:] += 10**10
    return 500


def of_a_step_back(_, stamps):
    """What comes in one block with an invalid joint state, and after it, is not taken."""
    stamps[300:] -= 10**10
    return 301


def of_no_number(angles, _):
    angles[300, 0] = np.nan
    return 301


@pytest.mark.parametrize(
    'happens', [of_nothing, of_a_jump, of_one_stray, of_a_gap, of_a_step_back, of_no_number]
)
@pytest.mark.parametrize('dwell', [100.0, 4.0])
def test_joint_states_of_a_table_that_dwells_say_the_same_however_they_come(happens, dwell):
    """Most of those that come at once are passed over: nothing may change by that."""
    stand = Stand(small_plan(dwell=dwell, rates=(200 * DEG,)), wrapped=True).started()
    stand.run(lambda state: state.phase is Phase.TURNING)
    stand.phase(Phase.DWELLING)
    times = stand.time + PERIOD * np.arange(1, 501)
    angles, rates = stand.table.read(times)
    stamps = EPOCH + np.rint(times * 1e9).astype(np.int64)
    count = happens(angles, stamps)
    seen = []
    for size in (1, 7, 500):
        sequencer = deepcopy(stand.sequencer)
        for k in range(0, count, size):
            part = slice(k, min(k + size, count))
            sequencer.add_joint_states(
                JointBlock(stamps[part], stand.names, angles[part], rates[part])
            )
        seen.append((sequencer.state(), sequencer.feedback, sequencer.revision))
    assert seen[0] == seen[1] == seen[2]
    ended = happens is not of_nothing or dwell < 5.0
    assert (seen[0][0].phase is not Phase.DWELLING) == ended


@pytest.mark.parametrize('bring', [moving, turning])
def test_a_table_that_goes_the_wrong_way_is_stopped(bring):
    stand = bring(Stand(block=1))
    begin = np.array(stand.sequencer.state().angles)
    away = [0.0]

    def back(_, angles, rates):
        away.append(float(abs(angles[0, 0] - begin[0])))
        return 2 * begin - angles, -rates

    stand.plant = back
    stand.phase(Phase.PAUSED, 1.0)
    # The first joint state beyond the tolerance is answered.
    assert away[-2] <= ALONE.overshoot < away[-1]
    assert (stand.sent[-1].mode, stand.sent[-1].stamp) == (
        Mode.HOLD,
        EPOCH + round(stand.time * 1e9),
    )
    pauses(stand, 'outer', 'moves away from its goal')


def test_a_turn_at_another_rate_is_stopped():
    stand = turning(Stand(), turns=0.1)
    begin = np.array(stand.sequencer.state().angles)
    stand.plant = lambda time, angles, rates: (begin + 0.8 * (angles - begin), 0.8 * rates)
    assert float(pauses(stand, 'commanded is 60 deg/s').split()[4]) == pytest.approx(48, rel=0.1)
    recovers(stand)


def test_a_table_that_moves_while_it_is_to_stand_is_stopped():
    stand = Stand().started()
    stand.phase(Phase.DWELLING)
    stand.plant = shifted(middle=0.06 * DEG)
    pauses(stand, 'middle', 'moves while it is to stand')
    recovers(stand)
    assert modes(stand, 3) == [Mode.POSITION, Mode.HOLD, Mode.POSITION]


def test_a_table_that_stops_short_of_its_goal_is_said():
    stand = Stand(servo_error=0.3 * DEG).started()
    pauses(stand, 'off its goal', r'tolerance 0.01 deg')


def test_a_table_that_is_told_to_hold_and_moves_is_said():
    stand = moving(Stand())
    stand.sequencer.pause()
    stand.link = lambda setpoint: None
    drift = stand.time
    stand.plant = lambda time, angles, rates: (
        angles + 5 * DEG * np.maximum(time - drift, 0)[:, None],
        rates,
    )
    state = stand.run(lambda state: state.fault, seconds=20.0)
    assert 'Paused on request' in state.reason
    assert 'still moves' in state.reason


def test_stamps_with_a_gap_stop_the_table_and_it_does_not_go_on_by_itself():
    stand = turning(Stand())
    stand.silent = True
    for _ in range(14):
        stand.tick()
    stand.silent = False
    pauses(stand, 'No joint state for 0.7', '0.5 s')
    recovers(stand)


def test_without_joint_states_the_table_is_held_and_a_start_is_refused():
    stand = turning(Stand())
    stand.silent = True
    stand.sequencer.lose_feedback('No joint state from the table for 0.5 s.')
    with pytest.raises(InputError, match='No joint state'):
        stand.sequencer.start()
    assert stand.stands()
    stand.silent = False
    recovers(stand)


def test_joint_states_that_are_no_numbers_stop_the_table():
    stand = moving(Stand())
    stand.plant = lambda time, angles, rates: (angles * np.nan, rates)
    assert stand.tick().phase is Phase.PAUSED
    pauses(stand, 'nan as the angle of joint')
    recovers(stand)


@pytest.mark.parametrize('names', [('outer', 'middle'), ('wheel',), (), ('outer', 'outer', 'x')])
def test_joint_states_of_others_change_nothing_and_are_counted(names):
    stand = Stand().started()
    stranger = JointBlock(
        np.array([EPOCH + 10**12]),
        names,
        np.full((1, len(names)), 99.0),
        np.zeros((1, len(names))),
    )
    stand.run(lambda state: stand.sequencer.add_joint_states(stranger) or state.phase is Phase.DONE)
    count, latest = stand.sequencer.ignored
    assert count > 100
    assert latest == names


def test_no_plan_starts_while_the_calibrator_cannot_go_on():
    stand = Stand(rules=SUPERVISED)
    stand.tick()
    stand.sequencer.set_calibrator_present(True)
    stand.sequencer.set_calibrator_fault('The calibrator has failed: the disk is full.')
    with pytest.raises(InputError, match='the disk is full'):
        stand.sequencer.start()
    # One that has finished stops nothing, and takes no new plan either.
    stand.sequencer.set_calibrator_fault('')
    stand.started()
    stand.phase(Phase.MOVING)
    stand.sequencer.set_calibrator_fault('It has finished.')
    assert stand.tick().phase is Phase.MOVING


def test_stamps_that_jump_back_stop_the_table():
    stand = moving(Stand())
    block = JointBlock(np.array([EPOCH - 10**9]), TABLE.names, np.zeros((1, 3)), np.zeros((1, 3)))
    assert not stand.sequencer.add_joint_states(block)
    assert stand.sequencer.state().phase is Phase.PAUSED
    pauses(stand, 'jump back')
    recovers(stand)


def test_setpoints_that_the_table_refuses_are_noticed():
    stand = Stand()
    stand.link = lambda setpoint: replace(setpoint, stamp=setpoint.stamp - 10**9)
    stand.started()
    pauses(stand, 'stalls')
    assert 'stamp is 1 s old' in stand.refusals[0]
    assert np.abs(stand.table.angles(np.array([stand.time]))).max() == 0
    recovers(stand)


def test_an_interrupted_turn_is_repeated_from_where_it_starts():
    stand = turning(Stand())
    stand.sequencer.pause()
    assert stand.phase(Phase.PAUSED).reason == 'Paused on request.'
    assert not stand.sequencer.state().fault
    assert stand.stands()
    assert stand.sequencer.start() == 'Resumes with step 2.'
    stand.phase(Phase.DONE)
    assert modes(stand, 1) == [Mode.RATE, Mode.HOLD, Mode.POSITION, Mode.RATE]
    assert stand.refusals == []
    assert stand.stands()


def test_a_turn_that_had_not_begun_is_not_gone_on_with_from_where_the_table_seems_to_be():
    stand = Stand().started()
    stand.link = lambda setpoint: None if setpoint.mode is Mode.RATE else setpoint
    stand.phase(Phase.TURNING)
    stand.sequencer.pause()
    stand.tick()
    stand.link = lambda setpoint: setpoint
    stand.sequencer.start()
    stand.phase(Phase.DWELLING)
    assert modes(stand, 1) == [Mode.RATE, Mode.HOLD, Mode.POSITION, Mode.RATE]


def test_a_turn_that_starts_off_its_angles_goes_there_first():
    stand = Stand().started()
    stand.phase(Phase.SETTLING)
    # Further than an arrival, and less than what counts as a motion.
    stand.plant = shifted(middle=0.03 * DEG)
    stand.run(lambda state: state.step == 1)
    assert modes(stand, 1) == [Mode.POSITION]


def test_a_pause_while_the_table_still_brakes_may_be_taken_back_at_once():
    stand = turning(Stand())
    stand.sequencer.pause()
    stand.tick()
    stand.sequencer.start()
    stand.phase(Phase.DONE)
    assert stand.refusals == []
    assert stand.stands()


def test_many_pauses_lose_no_step():
    stand = Stand(small_plan(dwell=0.5)).started()
    done = []
    for k in range(500):
        state = stand.tick()
        if k % 50 == 49:
            stand.sequencer.pause()
            stand.tick()
            stand.sequencer.start()
        done.append(state.step)
    stand.phase(Phase.DONE)
    turns = [s for s in stand.sent if s.mode is Mode.RATE]
    assert {s.step for s in turns} == {1, 2}
    assert [step for step, phase in stand.phases if phase is Phase.DWELLING] == [3, 4]


def test_after_an_abort_the_plan_starts_anew():
    stand = turning(Stand())
    stand.sequencer.abort()
    assert stand.phase(Phase.ABORTED).reason == 'Aborted on request.'
    assert stand.stands()
    with pytest.raises(InputError, match='Nothing is running'):
        stand.sequencer.pause()
    assert stand.sequencer.start() == 'Runs small.'
    assert stand.run(lambda state: state.phase is Phase.TURNING).step == 1
    stand.phase(Phase.DONE)


@pytest.mark.parametrize('phase', [Phase.MOVING, Phase.TURNING, Phase.SETTLING, Phase.DWELLING])
@pytest.mark.parametrize('then', [[], ['pause'], ['calibrator']])
def test_after_an_abort_in_any_phase_every_step_is_run_again(phase, then):
    """Also if it was paused before, and if the calibrator is not there when it is started."""
    stand = Stand(rules=Rules())
    stand.tick()
    stand.sequencer.set_calibrator_present(present=True)
    stand.sequencer.start()
    stand.run(lambda state: state.step > 0 and state.phase is phase)
    if 'pause' in then:
        stand.sequencer.pause()
    stand.sequencer.abort()
    assert stand.stands()
    if 'calibrator' in then:
        stand.sequencer.set_calibrator_present(present=False)
    before = len(stand.sent)
    stand.sequencer.start()
    stand.tick()
    stand.sequencer.set_calibrator_present(present=True)
    stand.run(lambda _: stand.sequencer.reviewing)
    moved = [s.step for s in stand.sent[before:] if s.mode is not Mode.HOLD]
    assert list(dict.fromkeys(moved)) == list(range(stand.sequencer.state().steps))


def test_the_emergency_stop_holds_and_its_release_moves_nothing():
    stand = turning(Stand())
    stand.sequencer.emergency(True)
    assert stand.tick().phase is Phase.ABORTED
    assert stand.stands()
    with pytest.raises(InputError, match='The emergency stop is on'):
        stand.sequencer.start()
    stand.sequencer.emergency(False)
    assert stand.stands()
    assert stand.sequencer.state().phase is Phase.ABORTED
    stand.sequencer.start()
    stand.phase(Phase.DONE)
    assert stand.stands()


def test_a_stop_that_is_said_again_changes_nothing_and_hides_nothing():
    """A button repeats it ten times a second, and meanwhile somebody turns the table."""
    stand = Stand()
    for _ in range(40):
        stand.tick()
    stand.sequencer.emergency(True)
    revision = stand.sequencer.revision
    for k in range(40):
        if k == 20:
            stand.plant = shifted(middle=1 * DEG)
        stand.sequencer.emergency(True)
        state = stand.tick()
    assert stand.sequencer.revision == revision
    assert 'Joint middle moves while it is to stand' in state.reason


@pytest.mark.parametrize('stop', ['emergency', 'pause then emergency'])
def test_a_table_that_had_just_set_out_brakes_without_reproach(stop):
    """Joint states come a tenth of a second late: they show it still where it moves by then."""
    stand = Stand().started()
    stand.phase(Phase.TURNING)
    seen_late = stand.time + 0.1
    at_rest = stand.table.angles(np.array([stand.time]))[0]
    stand.plant = lambda time, angles, rates: (
        (at_rest + 0 * angles, 0 * rates) if time[-1] <= seen_late + 1e-9 else (angles, rates)
    )
    stand.tick()
    if stop != 'emergency':
        stand.sequencer.pause()
    stand.sequencer.emergency(True)
    assert stand.tick().phase is Phase.ABORTED
    assert np.abs(stand.table.angles(np.array([stand.time]))[0] - at_rest).max() > 0.1 * DEG
    assert stand.stands()
    assert stand.sequencer.state().reason == 'Emergency stop.'


def test_an_idle_table_that_turns_is_held_and_it_is_said_how_far_and_how_fast():
    """A stranger turns it by eleven rounds at 200 deg/s; nothing was ever started."""
    stand = Stand()
    stand.run(lambda state: stand.time > 1.0)
    assert stand.sent == []
    begin = stand.time
    seconds = 3960 / 200

    def turned(time, angles, rates):
        turning = (time > begin) & (time < begin + seconds)
        way = 200 * DEG * np.clip(time - begin, 0, seconds)
        return angles + way[:, None] * [1, 0, 0], rates + 200 * DEG * turning[:, None] * [1, 0, 0]

    stand.plant = turned
    # Five times the arrival tolerance, 0.05 deg, is passed with the first joint state.
    assert stand.run(lambda state: state.fault, 2 * stand.block * PERIOD).phase is Phase.IDLE
    assert stand.sent[-1].mode is Mode.HOLD
    told = set()
    while stand.time < begin + seconds + 1.0:
        told.add(stand.tick().reason)
        assert stand.sent[-1].mode is Mode.HOLD
        if stand.time < begin + seconds:
            with pytest.raises(InputError, match='it still moves'):
                stand.sequencer.start()
    reason = stand.sequencer.state().reason
    assert 'Joint outer moves while it is to stand at 0.000 deg' in reason
    assert 'Joint outer moved 3960.00 deg, at up to 200 deg/s, without a command' in reason
    assert reason.endswith('it stands again.')
    assert len(told) < 20, 'a long turn is no sentence for every joint state'
    assert stand.sequencer.start() == 'Runs small.'
    assert not stand.sequencer.fault


@pytest.mark.parametrize('rate', [0.2, 20.0])
def test_a_table_that_creeps_when_the_plan_is_done_is_said(rate):
    stand = Stand().started()
    stand.phase(Phase.DONE)
    assert stand.stands()
    begin = stand.time
    stand.plant = lambda time, angles, rates: (
        angles + rate * DEG * (time - begin)[:, None] * [0, 0, 1],
        rates + rate * DEG * np.ones_like(time)[:, None] * [0, 0, 1],
    )
    state = stand.run(lambda state: state.fault, 0.05 / rate + 2 * stand.block * PERIOD)
    assert state.phase is Phase.DONE
    assert 'Joint inner moves' in state.reason


def test_a_table_that_still_brakes_when_its_leader_comes_has_its_time():
    stand = Stand()
    braking = lambda time: np.maximum(0.5 - time, 0)[:, None] * [1.0, 0, 0]  # noqa: E731
    stand.plant = lambda time, angles, rates: (angles - braking(time) ** 2, rates + braking(time))
    stand.run(lambda state: stand.time > 3.0)
    assert not stand.sequencer.fault
    assert stand.sent == []


def test_what_forbids_to_lead_the_table_holds_it_and_its_end_moves_nothing():
    stand = turning(Stand())
    stand.sequencer.forbid('estop', '2 publishers are on /estop.')
    assert pauses(stand, '2 publishers are on /estop.') == '2 publishers are on /estop.'
    with pytest.raises(InputError, match='2 publishers are on /estop'):
        stand.sequencer.start()
    stand.sequencer.forbid('estop', '')
    assert stand.stands()
    assert stand.sequencer.state().phase is Phase.PAUSED
    recovers(stand)


def test_a_start_that_waits_for_the_calibrator_is_called_off():
    stand = Stand(rules=SUPERVISED)
    stand.tick()
    stand.sequencer.start()
    stand.sequencer.forbid('estop', 'Two.')
    stand.sequencer.forbid('estop', '')
    stand.sequencer.set_calibrator_present(True)
    for _ in range(20):
        state = stand.tick()
        assert state.phase is Phase.IDLE
    assert (state.reason, state.fault) == ('Two.', True)
    assert {s.mode for s in stand.sent} == {Mode.HOLD}


def test_a_start_that_waits_for_the_calibrator_waits_for_what_else_is_awaited():
    stand = Stand(rules=SUPERVISED)
    stand.tick()
    stand.sequencer.start()
    stand.sequencer.forbid('controller', 'No controller.', awaited=True)
    for _ in range(20):
        stand.sequencer.set_calibrator_present(True)
        assert stand.tick().phase is Phase.IDLE
    assert stand.sent == []
    stand.sequencer.forbid('controller', '', awaited=True)
    stand.sequencer.set_calibrator_present(True)
    stand.run(lambda state: state.phase is Phase.MOVING, 1.0)


def test_the_word_of_a_calibrator_that_is_ahead_of_the_table_does_not_count():
    stand = supervised()
    stand.run(lambda state: stand.sequencer.reviewing)
    now = EPOCH + round(stand.time * 1e9)
    stand.sequencer.review(now + 10**9, [])
    assert stand.sequencer.reviewing
    stand.sequencer.review(now, [])
    stand.phase(Phase.DONE)


def test_a_start_while_it_runs_or_without_joint_states_is_refused():
    stand = Stand()
    with pytest.raises(InputError, match='no joint states'):
        stand.sequencer.start()
    stand.started()
    with pytest.raises(InputError, match='is running, at step 1'):
        stand.sequencer.start()


@pytest.mark.parametrize(
    ('change', 'rates', 'words'),
    [
        ({'max_rate': 50 * DEG}, (60 * DEG,), 'outer at 60 deg/s.*allows 50 deg/s'),
        (
            {'max_acceleration': 9 * DEG},
            (60 * DEG,),
            'outer of .* 400 deg, and only one',
        ),
        ({'limits': Limits(-10 * DEG, 170 * DEG)}, (), 'limits'),
    ],
)
def test_a_plan_beyond_the_limits_is_refused_at_the_start(change, rates, words):
    joints = tuple(replace(j, **change) for j in TABLE.joints)
    plan = small_plan(rates=rates)
    if not rates:
        plan = replace(plan, positions=tuple(replace(p, rate_test=None) for p in plan.positions))
    table = replace(TABLE, joints=joints)
    sequencer = Sequencer(plan, table, ALONE)
    stamp = np.array([EPOCH])
    angles = np.array([[0.0, 175 * DEG, 0]]) * (not rates)
    sequencer.add_joint_states(JointBlock(stamp, table.names, angles, np.zeros((1, 3))))
    with pytest.raises(InputError, match=words if rates else '175 deg.*allows -10 to 170 deg'):
        sequencer.start()
    assert sequencer.setpoint(EPOCH) is None


# No multiple of the joint states' period: what happens at the end of the wait is past it.
SUPERVISED = Rules(repeats=2, repeat_wait=20.0 + PERIOD / 2)


def supervised(rules=SUPERVISED):
    stand = Stand(rules=rules)
    stand.sequencer.set_calibrator_present(True)
    return stand.started()


def test_a_start_waits_for_the_calibrator():
    stand = Stand(rules=SUPERVISED)
    assert stand.tick().turns_done == 0
    assert 'calibrator' in stand.sequencer.start()
    for _ in range(20):
        state = stand.tick()
        assert (state.phase, state.reason) == (Phase.IDLE, '')
        assert 'calibrator' in state.waits_for
    assert stand.sent == []
    stand.sequencer.set_calibrator_present(True)
    stand.run(lambda state: state.phase is Phase.MOVING, 1.0)


def test_a_session_that_is_gone_on_with_runs_what_the_calibrator_lacks_and_then_everything():
    stand = Stand(rules=SUPERVISED)
    stand.sequencer.resume()
    stand.tick()
    stand.sequencer.set_calibrator_present(True)
    assert 'Waits' in stand.sequencer.start(), 'what it has is not known yet'
    # Four of the five steps have been seen, of those the third left too little; the last was not.
    stand.sequencer.skip_done(4, [2, 4])
    stand.sequencer.set_calibrator_present(True)
    stand.run(lambda state: stand.sequencer.reviewing)
    assert [step for step, phase in stand.phases if phase is Phase.DWELLING] == [4]
    assert [step for step, phase in stand.phases if phase is Phase.TURNING] == [2]
    stand.sequencer.review(EPOCH + round(stand.time * 1e9), [])
    stand.phase(Phase.DONE)
    stand.phases.clear()
    stand.sequencer.skip_done(4, [2])
    stand.sequencer.start()
    stand.run(lambda state: stand.sequencer.reviewing)
    assert [step for step, phase in stand.phases if phase is Phase.TURNING] == [1, 2]


def test_only_who_is_supervised_can_go_on_with_a_session():
    with pytest.raises(InputError, match='supervise'):
        Stand().sequencer.resume()


def test_phases_have_the_numbers_of_the_message():
    text = (Path(__file__).parents[2] / 'msg_defs/msg/TurntableState.msg').read_text()
    stated = dict(re.findall(r'^uint8 ([A-Z]+)=(\d+)', text, re.MULTILINE))
    assert {phase.name: str(phase.value) for phase in Phase} == stated


def test_a_start_that_waits_while_joint_states_stop_ends_in_a_fault():
    stand = turning_supervised()
    stand.sequencer.set_calibrator_present(False)
    stand.phase(Phase.PAUSED)
    stand.sequencer.start()
    stand.sequencer.lose_feedback('No joint states come.')
    stand.sequencer.set_calibrator_present(True)
    state = stand.sequencer.state()
    assert (state.phase, state.fault, state.waits_for) == (Phase.PAUSED, True, '')
    assert state.reason == 'No joint states come.'


def test_a_silent_calibrator_stops_the_table():
    stand = turning_supervised()
    stand.sequencer.set_calibrator_present(False, 'The calibrator is silent for 5 s.')
    pauses(stand, 'The calibrator is silent for 5 s.')
    stand.sequencer.start()
    assert 'Waits for the calibrator' in stand.tick().reason
    stand.sequencer.set_calibrator_present(True)
    stand.run(lambda state: state.phase is Phase.TURNING, 20.0)


def turning_supervised():
    stand = supervised()
    stand.run(lambda state: state.phase is Phase.TURNING and state.turns_done > 0.5)
    return stand


def test_the_calibrator_has_steps_repeated_but_not_for_ever():
    stand = supervised()
    state = stand.run(lambda state: stand.sequencer.reviewing)
    assert state.phase is Phase.DWELLING
    now = EPOCH + round(stand.time * 1e9)
    stand.sequencer.review(now - 10 * 10**9, [0, 1, 2, 3, 4])
    assert stand.sequencer.reviewing, 'what was said before the end of the plan does not count'
    for _ in range(2):
        stand.sequencer.review(now, [2, 4])
        stand.run(lambda state: stand.sequencer.reviewing)
        now = EPOCH + round(stand.time * 1e9)
    stand.sequencer.review(now, [2, 4])
    stand.phase(Phase.DONE)
    assert modes(stand, 2) == [Mode.RATE, Mode.POSITION, Mode.RATE, Mode.POSITION, Mode.RATE]
    assert modes(stand, 1) == [Mode.RATE]
    assert [step for step, phase in stand.phases if phase is Phase.TURNING] == [1, 2, 2, 2]
    dwells = [step for step, phase in stand.phases if phase is Phase.DWELLING]
    assert dwells.count(4) >= 3
    assert stand.stands()


def test_the_way_home_does_not_wait_for_ever_for_the_calibrators_word():
    stand = supervised()
    stand.run(lambda state: stand.sequencer.reviewing)
    begin = stand.time
    state = stand.phase(Phase.DONE)
    assert 20.0 <= stand.time - begin <= 30.0
    assert 'did not report within 20.005 s' in state.reason


def test_a_pause_while_the_calibrator_is_awaited_repeats_nothing():
    stand = supervised()
    stand.run(lambda state: stand.sequencer.reviewing)
    stand.sequencer.pause()
    stand.phase(Phase.PAUSED)
    stand.sequencer.start()
    stand.run(lambda state: stand.sequencer.reviewing)
    stand.sequencer.review(EPOCH + round(stand.time * 1e9), [])
    stand.phase(Phase.DONE)
    assert [step for step, phase in stand.phases if phase is Phase.TURNING] == [1, 2]


EVENTS = st.lists(
    st.tuples(
        st.sampled_from(['pause', 'start', 'abort', 'estop', 'freeze', 'jump', 'silence', 'deaf']),
        st.floats(0.0, 6.0),
    ),
    max_size=6,
)


@settings(max_examples=30)
@given(
    EVENTS,
    st.lists(st.floats(-180.0, 180.0), min_size=3, max_size=3),
    st.floats(20.0, 200.0),
    st.booleans(),
)
def test_no_setpoint_ever_leaves_that_the_table_does_not_allow(events, start, rate, wrapped):
    """`Stand.send` checks each; and whatever happened, an abort leaves the table at rest."""
    stand = Stand(
        small_plan(dwell=0.3, rates=(rate * DEG, -rate * DEG)),
        start=np.array(start) * DEG,
        wrapped=wrapped,
        block=10,
    )
    stand.started()
    for event, seconds in events:
        happen(stand, event)
        end = stand.time + seconds
        while stand.time < end:
            stand.tick()
    try:
        stand.sequencer.abort()
    except InputError:
        assert not stand.sequencer.running
    stand.silent, stand.link = False, lambda setpoint: setpoint
    assert stand.stands(3.0)


@settings(max_examples=12)
@given(EVENTS, st.floats(20.0, 200.0))
def test_whatever_happened_a_start_leads_to_the_end(events, rate):
    stand = Stand(small_plan(dwell=0.3, rates=(rate * DEG,)), block=10).started()
    for event, seconds in events:
        happen(stand, event)
        end = stand.time + seconds
        while stand.time < end:
            stand.tick()
    stand.silent, stand.link = False, lambda setpoint: setpoint
    stand.plant = lambda time, angles, rates: (angles, rates)
    for _ in range(60):
        stand.tick()
    with suppress(InputError):
        stand.sequencer.start()
    stand.refusals.clear()
    stand.phase(Phase.DONE)
    assert stand.refusals == []
    assert stand.stands()


def happen(stand, event):
    frozen = stand.sequencer.state().angles
    if event in {'pause', 'start', 'abort'}:
        with suppress(InputError):
            getattr(stand.sequencer, event)()
    elif event == 'estop':
        stand.sequencer.emergency(True)
        stand.tick()
        stand.sequencer.emergency(False)
    elif event == 'freeze':
        stand.plant = lambda time, angles, rates: (np.broadcast_to(frozen, angles.shape), 0 * rates)
    elif event == 'jump':
        stand.plant = lambda time, angles, rates: (angles + 0.3, rates)
    elif event == 'silence':
        stand.silent = not stand.silent
    else:
        stand.link = lambda setpoint: None


def at(angles=(0.0, 0.0, 0.0), rates=(0.0, 0.0, 0.0), still=True, stamp=0):
    return Feedback(EPOCH + stamp, 0.01, angles, rates, still)


def test_a_turn_is_led_by_pieces_that_coincide_and_each_end_at_rest():
    lead = Lead(TABLE)
    pieces = []
    for tick in range(1000):
        turn = setpoint(Mode.RATE, rates=(30 * DEG, 0.0, 0.0), stamp=tick * 50_000_000)
        if (piece := lead.piece(turn, at())) is not None:
            pieces.append((tick * 0.05, piece))
    seconds = 2 * TURN / (30 * DEG)
    assert seconds - 3 <= len(pieces) <= seconds
    whole = pieces[-1][1].course
    assert whole.angles[-1, 0] == pytest.approx(2 * TURN)
    assert len({piece.stamp for _, piece in pieces}) == 1
    for (_, piece), (sent, following) in pairwise(pieces):
        course = piece.course
        assert (course.rates[-1] == 0).all()
        assert (np.diff(course.time) > 0).all()
        assert len(course.time) <= 5
        times = np.linspace(0.0, sent + 0.2, 50)
        assert np.allclose(course.at(times)[0], following.course.at(times)[0])
        assert course.end < sent + 3.5
    times = np.linspace(0.0, whole.end, 2000)
    rates = whole.at(times)[1][:, 0]
    assert rates.max() <= 30 * DEG * (1 + 1e-9)
    assert np.abs(np.diff(rates) / np.diff(times)).max() <= 200 * DEG * (1 + 1e-6)


def test_a_move_is_one_trajectory_within_the_limits_of_every_joint():
    goal = (90 * DEG, -90 * DEG, 10 * DEG)
    piece = Lead(TABLE).piece(setpoint(Mode.POSITION, angles=goal), at())
    assert np.allclose(piece.course.angles[-1], goal)
    assert piece.stamp > EPOCH
    times = np.linspace(0.0, piece.course.end, 5000)
    rates = piece.course.at(times)[1]
    for k, joint in enumerate(TABLE.joints):
        accelerations = np.abs(np.diff(rates[:, k]) / np.diff(times))
        assert accelerations.max() <= joint.max_acceleration * (1 + 1e-6)
        assert np.abs(rates[:, k]).max() <= joint.max_rate


def test_a_hold_is_the_way_to_the_nearest_stopping_point():
    lead = Lead(TABLE)
    lead.piece(setpoint(Mode.RATE, rates=(60 * DEG, 0.0, 0.0)), at())
    fast = at(angles=(1.0, 0.0, 0.0), rates=(60 * DEG, 0.0, 0.0), still=False, stamp=10**9)
    piece = lead.piece(setpoint(Mode.HOLD, stamp=10**9), fast)
    assert piece.stamp == 0
    assert piece.course.time.tolist() == pytest.approx([60 / 200 + 0.1])
    assert piece.course.angles[0, 0] == pytest.approx(1.0 + 60 * DEG * 0.4 / 2)
    assert lead.piece(setpoint(Mode.HOLD, stamp=int(3e9)), at()) is None


def reported(rate, angles, wild, joint=0, count=20):
    """The last of joint states at 100 Hz whose angles go at a rate, and which report another."""
    encoders = Encoders(TABLE, 1e-4, 0.5)
    stamps = EPOCH + 10_000_000 * np.arange(count)
    course = np.tile(angles, (count, 1)).astype(float)
    course[:, joint] += 0.01 * rate * np.arange(count)
    rates = np.zeros((count, 3))
    rates[:, joint] = wild
    *_, last = encoders.read_feedback(JointBlock(stamps, TABLE.names, course, rates))
    return last


@pytest.mark.parametrize('wild', [10.0, 1e9, math.inf, -10.0])
def test_a_stop_from_a_rate_in_another_unit_is_no_motion(wild):
    last = reported(10 * DEG, (0.0, 0.0, 0.0), wild)
    (stop,) = Lead(TABLE).piece(setpoint(Mode.HOLD, stamp=last.stamp - EPOCH), last).course.angles
    # From 10 deg/s, and at most 10 deg/s more, as 200 deg/s^2 allow in half of the window.
    assert np.abs(stop - last.angles).max() <= 20 * DEG * (20 / 200 + 0.1) / 2 + 1e-9


def test_a_stop_from_a_jump_of_an_encoder_that_reports_no_rate_is_no_motion():
    encoders = Encoders(TABLE, 1e-4, 0.5)
    course = np.zeros((20, 3))
    course[15:, 0] = 0.3
    stamps = EPOCH + 10_000_000 * np.arange(20)
    *_, last = encoders.read_feedback(JointBlock(stamps, TABLE.names, course, np.zeros((20, 3))))
    piece = Lead(TABLE).piece(setpoint(Mode.HOLD, stamp=last.stamp - EPOCH), last)
    assert piece.course.angles.tolist() == [[0.3, 0.0, 0.0]]


def test_a_stop_from_the_first_joint_state_is_from_a_rate_that_the_table_has():
    last = reported(0.0, (0.0, 0.0, 0.0), 1e9, count=1)
    *_, stop = Lead(TABLE).piece(setpoint(Mode.HOLD), last).course.angles
    fastest = TABLE.joints[0].max_rate
    assert stop[0] == pytest.approx(
        fastest * (fastest / TABLE.joints[0].max_acceleration + 0.1) / 2
    )


@pytest.mark.parametrize(('angle', 'end'), [(0.9, 1.0), (1.0, 1.0), (1.4, 1.4)])
@pytest.mark.parametrize('sense', [1, -1])
def test_a_stop_is_no_way_beyond_the_limits_and_none_back(angle, end, sense):
    outer = replace(TABLE.joints[0], limits=Limits(-1.0, 1.0))
    table = replace(TABLE, joints=(outer, *TABLE.joints[1:]))
    rates = (sense * 200 * DEG, 0.0, 0.0)
    fast = at(angles=(sense * angle, 0.0, 0.0), rates=rates, still=False)
    (stop,) = Lead(table).piece(setpoint(Mode.HOLD), fast).course.angles
    assert stop[0] == pytest.approx(sense * end)


def test_a_hold_is_told_again_every_second_while_the_table_moves():
    lead = Lead(TABLE)
    messages = []
    for tick in range(50):
        stamp = 50_000_000 * tick
        fast = at(rates=(60 * DEG, 0.0, 0.0), still=False, stamp=stamp)
        if lead.piece(setpoint(Mode.HOLD, stamp=stamp), fast) is not None:
            messages.append(stamp * 1e-9)
    assert messages == pytest.approx([0.0, 1.0, 2.0], abs=0.06)


def test_a_piece_that_comes_too_late_is_no_jump():
    lead = Lead(TABLE)
    rates = (30 * DEG, 0.0, 0.0)
    lead.piece(setpoint(Mode.RATE, rates=rates), at())
    with pytest.raises(Overtaken, match='brakes already'):
        lead.piece(setpoint(Mode.RATE, rates=rates, stamp=int(3.5e9)), at())


def test_a_hold_without_joint_states_brakes_on_the_way():
    lead = Lead(TABLE)
    turn = lead.piece(setpoint(Mode.RATE, rates=(60 * DEG, 0.0, 0.0)), at())
    piece = lead.piece(setpoint(Mode.HOLD, stamp=10**9), at(still=False))
    assert piece.stamp == turn.stamp
    times = np.linspace(0.0, 1.0, 50)
    assert np.allclose(piece.course.at(times)[0], turn.course.at(times)[0])
    assert piece.course.end == pytest.approx(1.0 + 60 / 200)


@pytest.mark.parametrize(
    ('age', 'unseen', 'known'),
    [
        (0.05, 0.0, True),
        (0.19, 0.0, True),
        (0.21, 0.0, False),
        (0.0, 0.19, True),
        (0.0, 0.21, False),
    ],
)
def test_a_joint_state_of_a_fifth_of_a_second_by_either_clock_still_says_where_the_table_is(
    age, unseen, known
):
    lead = Lead(TABLE)
    turn = lead.piece(setpoint(Mode.RATE, rates=(60 * DEG, 0.0, 0.0)), at())
    last = at(rates=(60 * DEG, 0.0, 0.0), still=False, stamp=10**9 - round(age * 1e9))
    piece = lead.piece(setpoint(Mode.HOLD, stamp=10**9), last, unseen)
    assert piece.stamp == (0 if known else turn.stamp)


def test_a_hold_without_joint_states_says_nothing_to_a_table_that_brakes_already():
    lead = Lead(TABLE)
    lead.piece(setpoint(Mode.RATE, rates=(60 * DEG, 0.0, 0.0)), at())
    # The first piece ends after 3 s, from 0.1 s on.
    for seconds, brakes in ((2.9, True), (3.2, False), (9.0, False)):
        other = deepcopy(lead)
        hold = setpoint(Mode.HOLD, stamp=round(seconds * 1e9))
        assert (other.piece(hold, at(still=False)) is not None) == brakes


class Controller:
    """joint_trajectory_controller, as far as it moves joints: stands in for the table."""

    def __init__(self):
        self.time, self.angles, self.rates = 0.0, np.zeros(3), np.zeros(3)
        self.piece, self.start = None, 0.0
        self.lead = Lead(TABLE)

    def follow(self, setpoint, feedback):
        piece = self.lead.piece(setpoint, feedback)
        if piece is None:
            return
        course, self.start = piece.course, (piece.stamp - EPOCH) * 1e-9
        if piece.stamp == 0:
            self.start = self.time
            # Cubic from the state at the start to the only point; at rest there, it is a parabola.
            course = replace(
                course,
                time=np.array([0.0, *course.time]),
                angles=np.vstack([self.angles, course.angles]),
                rates=np.vstack([self.rates, course.rates]),
            )
        self.piece = course

    def at(self, time):
        self.time = time
        if self.piece is not None:
            angles, rates = self.piece.at(np.array([time - self.start]))
            jump = np.abs(angles[0] - self.angles).max()
            assert jump < 10 * DEG, 'the controller would jump'
            self.angles, self.rates = angles[0], rates[0]
        return self.angles, self.rates


def led(until, seconds=120.0, act=None):
    """Lead a controller through the small plan; return it and the sequencer."""
    controller, sequencer = Controller(), Sequencer(small_plan(rates=(30 * DEG,)), TABLE, ALONE)
    time, revision = 0.0, -1
    while not until(sequencer.state()):
        time += PERIOD
        assert time < seconds, sequencer.state()
        angles, rates = controller.at(time)
        stamp = EPOCH + round(time * 1e9)
        block = JointBlock(np.array([stamp]), TABLE.names, angles[None], rates[None])
        sequencer.add_joint_states(block)
        if sequencer.state().phase is Phase.IDLE:
            sequencer.start()
        if act is not None:
            act(sequencer)
        if sequencer.revision != revision or round(time / PERIOD) % 10 == 0:
            revision = sequencer.revision
            controller.follow(sequencer.setpoint(stamp), sequencer.feedback)
    return controller, sequencer


def test_a_trajectory_controller_is_led_through_a_plan():
    controller, _ = led(lambda state: state.phase is Phase.DONE)
    assert np.abs(controller.angles).max() < 0.01 * DEG
    assert np.abs(controller.rates).max() == 0


def test_a_trajectory_controller_whose_node_dies_stops_by_itself():
    controller, _ = led(lambda state: state.turns_done > 0.5)
    assert controller.rates[0] == pytest.approx(30 * DEG)
    for _ in range(350):
        controller.at(controller.time + PERIOD)
    assert np.abs(controller.rates).max() == 0


def test_a_trajectory_controller_is_paused_in_a_turn_and_goes_on():
    paused = []

    def act(sequencer):
        if not paused and sequencer.state().turns_done > 0.5:
            sequencer.pause()
            paused.append(sequencer)
        elif sequencer.state().phase is Phase.PAUSED and sequencer.feedback.still:
            sequencer.start()

    controller, sequencer = led(lambda state: state.phase is Phase.DONE, act=act)
    assert paused
    assert sequencer.state().reason == ''
    assert np.abs(controller.angles).max() < 0.01 * DEG


def test_a_table_that_nobody_saw_for_a_while_is_not_late():
    """Joint states stay away for longer than the motion may take, but not for longer than allowed:
    the table stands at its goal when they come again."""
    stand = Stand(rules=replace(ALONE, feedback_timeout=60.0)).started()
    stand.run(lambda state: state.step == 4 and state.phase is Phase.MOVING)
    stand.silent = True
    gap = stand.time + 30.0
    while stand.time < gap:
        stand.tick()
    stand.silent = False
    assert stand.run(lambda state: state.phase is Phase.DWELLING or state.fault).fault is False
