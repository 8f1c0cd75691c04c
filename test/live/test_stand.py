"""The live stand: sessions from start to end, and everything that goes wrong on the way.

Every process is real, but where the table alone is at fault; table and IMU are simulated at the
level of hardware. What a fault does to
the table is asserted on the table's own joint states, and every number that was ever published is
held against the truth."""

import numpy as np
import pytest
from live import (
    EMBEDDED,
    KINDS,
    LEASE,
    MOVES,
    Progress,
    Stand,
    State,
    finishes,
    resumes,
    spoofed_done,
    stops,
    stranger,
)
from loopback import patience

from imu_calib.live import middleware as ros
from imu_calib.live.nodes import qos


def test_an_imu_that_falls_silent_sends_garbage_and_whose_clock_jumps(tmp_path):
    """Forth and far back, and the plan is paused and gone on with on the way.

    Slow enough that steps are left when a word of a jump comes, a quarter of a second after it.
    """
    with Stand(tmp_path, '--speed', '30', embedded=EMBEDDED) as stand:
        assert stand.reaches(State.DWELLING, step=2)
        assert stand.call('turntable_node/pause')[0]
        assert stand.reaches(State.PAUSED)
        assert stand.table_stands()
        assert stand.call('turntable_node/start')[0]
        assert stand.reaches(State.DWELLING, step=4)
        stand.fault('silence 2.0')
        for step, jump in (8, 0.5), (12, -20.0):
            assert stand.reaches(State.DWELLING, step=step)
            stand.words.clear()
            jumped = len(stand.states)
            stand.fault(f'clock_jump {jump}')
            assert stand.wait(lambda: stand.has_status('imu_node: clock', 'jump')), jump
        # A busy machine may hear of the jump when the session is over.
        assert stand.reaches(State.DWELLING, step=15, since=jumped), stand.state
        stand.fault('garbage 500')
        finishes(stand)
        # On a busy machine the session may be over before imu_node says so.
        garbage = 'Bytes are received that belong to no frame'
        assert stand.wait(lambda: stand.has_status('imu_node', garbage))


def test_calibrator_and_leader_are_killed_and_the_session_goes_on_from_its_journal(tmp_path):
    """The calibrator twice: the second time its journal is one that had been gone on with.

    The node of the IMU is killed, too: the table goes on.
    """
    # On a busy machine a calibrator that lives may be silent for seconds.
    waits = {'calibrator_timeout': 5.0, 'watchdog_timeout': LEASE + 10.0}
    # At this speed a second of a busy machine is half of the clock offset that motions can show.
    with Stand(tmp_path, '--speed', '30', turntable_node=waits) as stand:
        assert stand.reaches(State.TURNING, step=1)
        stand.kill('turntable_node')
        # The table stops by itself.
        assert stand.table_stands(seconds=15)
        done_without_its_leader_ends_no_session(stand)
        stand.states.clear()
        # It begins anew.
        stand.start('turntable_node')
        for phase, step in ((State.DWELLING, 5), (State.TURNING, 8)):
            assert stand.reaches(phase, step=step)
            stand.kill('calibrator_node')
            stops(stand, 'calibrator', 'silent')
            stand.words.clear()
            stand.start('calibrator_node')
            assert stand.wait(lambda: stand.has_status('is resumed from'))
            resumes(stand)
        assert stand.reaches(State.DWELLING, step=10)
        paused = [s for s in stand.states if s.phase == State.PAUSED]
        stand.kill('imu_node')
        stand.start('imu_node')
        final = finishes(stand)
        assert [s for s in stand.states if s.phase == State.PAUSED] == paused
        assert 'interrupted' in final.status_text


def done_without_its_leader_ends_no_session(stand):
    """The leader is dead and forgotten, and somebody says DONE in its place, over and over.

    Most of the plan was never commanded.
    """
    steps = stand.state.steps
    listed = stand.node.get_publishers_info_by_topic
    assert stand.wait(lambda: not listed('/turntable/state'))
    with stranger(stand, 'turntable/state') as output:
        assert stand.wait(lambda: output.get_subscription_count() >= 2)
        for _ in range(20):
            output.publish(spoofed_done(stand))
            stand.wait(lambda: False, 0.05)
        assert stand.wait(
            lambda: stand.has_status('turntable state', 'is ignored', f'to {steps} of short')
        )
    assert not [c for c in stand.calibrations if c.status != c.PROVISIONAL]
    assert stand.progress[-1].state != Progress.FINISHED


def test_a_full_disk_stops_the_table_and_loses_nothing_and_then_the_table_vanishes(tmp_path):
    resource = pytest.importorskip('resource')
    # The journal is written once a second of the computer: a faster table is at its end by then.
    with Stand(tmp_path, '--speed', '30', turntable_node={'watchdog_timeout': 3.0}) as stand:
        assert stand.reaches(State.DWELLING, step=2)
        number = stand.processes.number('calibrator_node')
        unlimited = resource.prlimit(number, resource.RLIMIT_FSIZE)
        # Full from now on: a busy machine reaches a size that is fixed at a late step, or never.
        written = max(f.stat().st_size for f in (stand.folder / 'journal').rglob('*'))
        resource.prlimit(number, resource.RLIMIT_FSIZE, (written, unlimited[1]))
        stops(stand, 'cannot be written')
        resource.prlimit(number, resource.RLIMIT_FSIZE, unlimited)
        assert stand.wait(lambda: stand.progress[-1].state != Progress.FAILED)
        resumes(stand, once_heard=True)
        assert stand.reaches(State.DWELLING, step=stand.state.step + 2)
        stand.kill('stand_node')
        assert stand.reaches(State.PAUSED, seconds=20)
        assert 'joint state' in stand.state.reason
        stand.parameters['stand_node']['start'] = 10_000.0
        stand.start('stand_node')
        assert stand.table_stands(seconds=20)
        finishes(stand, resumed=True)


def test_a_table_that_does_not_do_as_it_is_told(tmp_path):
    """It stands and says why, time after time; then the session ends as if nothing had been."""
    with Stand(tmp_path, '--speed', '60', embedded=EMBEDDED) as stand:
        for fault, phase, step, word in (
            ('stall', State.TURNING, 1, 'Joint'),
            ('overshoot 5', State.MOVING, 3, 'Joint'),
            ('refuse', State.DWELLING, 5, 'Joint'),
            ('joint_rate 1', State.TURNING, 8, 'joint state'),
        ):
            assert stand.reaches(phase, step=step), (fault, stand.state)
            stand.words.clear()
            stand.fault(fault)
            stops(stand, word)
            stand.fault('clear')
            resumes(stand)
        # Setpoints that come late are refused as stale.
        assert stand.reaches(State.TURNING)
        stand.words.clear()
        stand.fault('delay 1.0')
        stops(stand)
        assert stand.has_status('stand_node', 'stamp')
        stand.fault('clear')
        finishes(stand, resumed=True)


# The live stand: what a person, a stranger or a second publisher does to it


OWNERS = {
    'turntable/setpoint': '/turntable_node',
    'turntable/joint_states': '/stand_node',
    'turntable/state': '/turntable_node',
    'calibration/progress': '/calibrator_node',
    'estop': '/listener',
}


def test_two_publishers_or_an_emergency_stop_the_table_and_spoofed_words_complete_nothing(
    tmp_path,
):
    """So it goes by a device whose clock drifts. After an emergency stop all is run anew.

    Slow enough that steps are left when a stranger is seen.
    """
    waits = {'watchdog_timeout': LEASE + 10.0, 'feedback_timeout': LEASE + 10.0}
    with Stand(
        tmp_path, '--speed', '12', stand_node={'clock_drift': 100.0}, turntable_node=waits
    ) as stand:
        for topic in KINDS:
            assert stand.reaches(*MOVES, step=1)
            with stranger(stand, topic):
                stops(stand, '2 publishers', f'/{topic}', OWNERS[topic], '/stranger')
                success, message = stand.call('turntable_node/start')
                assert not success
                assert '/stranger' in message
            assert stand.wait(lambda: stand.call('turntable_node/start')[0])
        for step, topic, spoof in (
            (3, 'turntable/state', spoofed_done),
            (5, 'calibration/progress', spoofed_progress),
        ):
            assert stand.reaches(State.DWELLING, step=step)
            stand.words.clear()
            with stranger(stand, topic) as output:
                assert stand.wait(lambda output=output: output.get_subscription_count() >= 2)
                for _ in range(20):
                    output.publish(spoof(stand))
                    stand.wait(lambda: False, 0.05)
                stops(stand, f'/{topic}', '/stranger')
            assert not [c for c in stand.calibrations if c.status != c.PROVISIONAL]
            assert stand.wait(lambda: stand.call('turntable_node/start')[0])
        an_emergency_stop_holds_until_it_is_released(stand)
        a_pressed_stop_outlives_a_killed_turntable_node(stand)
        finishes(stand, resumed=True)
        assert any(c.status == c.PROVISIONAL for c in stand.calibrations)


def spoofed_progress(stand):
    progress = Progress(plan='short', steps=stand.state.steps, state=Progress.FINISHED)
    progress.header.stamp = stand.joints.header.stamp
    return progress


def an_emergency_stop_holds_until_it_is_released(stand):
    assert stand.reaches(*MOVES)
    stand.estop(pressed=True)
    stops(stand, 'mergency')
    success, message = stand.call('turntable_node/start')
    assert not success, message
    stand.estop(pressed=False)
    assert not stand.wait(lambda: stand.state.phase in MOVES, 1.0)
    assert not stand.call('turntable_node/start')[0], 'not released by the topic alone'
    success, message = stand.call('turntable_node/release')
    assert success, message
    assert not stand.wait(lambda: stand.state.phase in MOVES, 1.0)
    success, message = stand.call('turntable_node/start')
    assert success, message
    assert stand.reaches(State.TURNING)


def a_pressed_stop_outlives_a_killed_turntable_node(stand):
    stand.words.clear()
    stand.estop(pressed=True)
    stops(stand, 'mergency')
    assert stand.wait(lambda: list((stand.folder / 'state').glob('stop_*')))
    stand.kill('turntable_node')
    stand.states.clear()
    stand.start('turntable_node')
    # It would start by itself: the parameter says so.
    assert stand.reaches(State.ABORTED), stand.state
    before = stand.joints
    assert not stand.wait(lambda: stand.state.phase in MOVES, 2.0)
    success, message = stand.call('turntable_node/start')
    assert not success
    assert 'call /turntable_node/release' in message
    stand.estop(pressed=False)
    assert stand.table_stands(LEASE + 10.0)
    assert list(stand.joints.position) == list(before.position)
    assert stand.wait(lambda: stand.call('turntable_node/release')[0])


def test_who_turns_a_table_nobody_leads_is_stopped_and_no_session_is_more_than_its_data(tmp_path):
    """One stand: strangers, a session that is ended early, and one with two IMUs."""
    # Slow enough that a session is not done while a busy machine takes a second for a call.
    waits = {'autostart': False}
    with Stand(tmp_path, '--speed', '5', turntable_node=waits, embedded=EMBEDDED) as stand:
        assert stand.reaches(State.IDLE)
        a_stranger_is_stopped(stand)
        assert stand.reaches(State.DWELLING, step=3)
        assert stand.call('turntable_node/pause')[0]
        assert stand.reaches(State.PAUSED)
        a_stranger_is_stopped(stand)
        a_session_that_is_ended_early_says_which_positions_are_missing(stand)
        stand.calibrations.clear()
        assert stand.call('calibrator_node/reset')[0]
        assert stand.wait(lambda: stand.call('turntable_node/start')[0])
        two_imu_publishers(stand)


def a_stranger_is_stopped(stand):
    """Let a stranger turn the table; it is stopped, and starts when its leader says so."""
    phase = stand.state.phase
    assert stand.table_stands(seconds=30)
    before = stand.joints
    stand.words.clear()
    with stranger(stand, 'turntable/setpoint') as output:
        assert stand.wait(lambda: output.get_subscription_count() >= 2)
        for _ in range(100):
            output.publish(ten_turns(stand.joints))
            stand.wait(lambda: False, 0.02)
        asked_until = seconds(stand.joints)
        assert stand.wait(lambda: stand.has_status('turntable_node: plan', '/stranger'))
        assert not stand.call('turntable_node/start')[0]
    assert stand.table_stands()
    # At 1 rad/s, by the table's own clock, it would have come at least twice as far.
    moved = np.abs(np.array(stand.joints.position) - np.array(before.position)).max()
    assert moved < (asked_until - seconds(before)) / 2
    assert stand.state.phase == phase
    messages = []
    assert stand.wait(
        lambda: messages.append(stand.call('turntable_node/start')) or messages[-1][0], patience(20)
    ), messages[-1]
    assert stand.reaches(*MOVES)


def seconds(joints):
    """Return the table's own time, s."""
    return joints.header.stamp.sec + joints.header.stamp.nanosec * 1e-9


def ten_turns(joints):
    """Return a setpoint that sends the outer joint round ten times."""
    turn = ros.messages.TurntableSetpoint(
        plan='mine',
        mode=1,
        joint_names=list(joints.name),
        positions=list(joints.position),
        rates=[1.0, 0.0, 0.0],
        turns=10.0,
    )
    turn.header.stamp = joints.header.stamp
    return turn


def a_session_that_is_ended_early_says_which_positions_are_missing(stand):
    # All turns are done.
    assert stand.reaches(State.DWELLING, step=17)
    assert stand.call('turntable_node/pause')[0]
    assert stand.reaches(State.PAUSED)
    assert stand.call('calibrator_node/solve')[0]
    final = stand.ended()
    assert final.status == final.INCOMPLETE, (final.status, final.status_text)
    assert final.status_text.startswith('Positions of the plan are missing: ')
    missing = final.status_text.split(': ')[1].split('.')[0].split(', ')
    # The twelve go by their numbers; the one that it was held in may have lasted long enough.
    held = int(stand.state.position_id)
    assert missing in ([str(k) for k in range(first, 13)] for first in (held, held + 1))
    stand.check_numbers()


def two_imu_publishers(stand):
    assert stand.reaches(*MOVES, State.DWELLING)
    other = stand.node.create_publisher(ros.messages.Imu, 'imu/pulses', qos.stream())
    assert stand.wait(lambda: other.get_subscription_count() > 0)
    message = ros.messages.Imu()
    message.header.stamp.sec = 1_700_000_000
    other.publish(message)
    final = stand.ended()
    assert final.status == final.REFUSED
    assert 'publishers' in final.status_text
    stops(stand, 'publishers')
    stand.check_numbers()
