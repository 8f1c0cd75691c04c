"""The live stand: a session from start to end, and everything that goes wrong on the way.

Every process is real; table and IMU are simulated at the level of hardware. What a fault does to
the table is asserted on the table's own joint states, and every number that was ever published is
held against the truth.
"""

import os
import signal
import subprocess
import sys
from contextlib import contextmanager

import numpy as np
import processes
import pytest
from loopback import patience, until

from imu_calib.errors import ImuCalibError

try:
    from live import HERE, Progress, Stand, State, short_plan

    from imu_calib import middleware as ros
    from imu_calib.nodes import qos
except ImuCalibError as error:
    pytest.skip(str(error), allow_module_level=True)

MOVES = (State.MOVING, State.TURNING)
# What publishes with keep-all waits for a subscription that was killed until its lease ends: 10 s
# with Cyclone DDS, 20 s with Fast DDS.
LEASE = 20.0


def finishes(stand, *, resumed=False):
    """Let a session end; its result must be right, and the journal must give the same bits."""
    if resumed:
        success, message = stand.call('turntable_node/start')
        assert success, message
    final = stand.ended()
    assert final.status == final.VALID, final.status_text
    assert 'Missing' not in final.status_text
    stand.check_numbers()
    stand.check_reprocessing()
    assert stand.table_stands()
    return final


def resumes(stand):
    """The table takes the interrupted step up again and gets beyond it; no number was wrong."""
    before = stand.state.step
    success, message = stand.call('turntable_node/start')
    assert success, message
    assert stand.reaches(*MOVES, State.DWELLING, step=before + 1), stand.state
    stand.check_numbers()


def stops(stand, *words):
    """The table stands, by its own word, and it is said why."""
    assert stand.reaches(State.PAUSED, State.ABORTED, seconds=30), stand.state
    assert stand.table_stands(LEASE + 10.0)
    assert all(word in stand.state.reason for word in words), stand.state.reason
    assert stand.said(*words), stand.words[-5:]
    # It does not go on by itself.
    assert not stand.wait(lambda: stand.state.phase in MOVES, 1.0)


def test_a_session_ends_by_itself_in_the_true_parameters(tmp_path):
    """So it does by a device whose clock drifts."""
    with Stand(tmp_path, stand_node={'clock_drift': 100.0}) as stand:
        finishes(stand)
        assert stand.progress[-1].state == Progress.FINISHED
        assert any(c.status == c.PROVISIONAL for c in stand.calibrations)
        assert stand.reaches(State.DONE)


def test_an_imu_whose_node_is_killed_that_falls_silent_and_sends_garbage(tmp_path):
    """On the way the clock of the device jumps, too: forth and far back."""
    with Stand(tmp_path) as stand:
        assert stand.reaches(State.TURNING, step=1)
        stand.kill('imu_node')
        stand.start('imu_node')
        assert stand.reaches(State.DWELLING, step=4)
        stand.fault('silence 2.0')
        for step, jump in (8, 0.5), (12, -20.0):
            assert stand.reaches(State.DWELLING, step=step)
            stand.words.clear()
            stand.fault(f'clock_jump {jump}')
            assert stand.wait(lambda: stand.said('imu_node: clock', 'jump')), jump
        assert stand.reaches(State.DWELLING, step=15)
        stand.fault('garbage 500')
        finishes(stand)
        assert stand.said('imu_node', 'Bytes come that are no frames')


def test_calibrator_and_leader_are_killed_and_the_session_goes_on_from_its_journal(tmp_path):
    """The calibrator twice: the second time its journal is one that had been gone on with."""
    waits = {'calibrator_timeout': 2.0, 'watchdog_timeout': LEASE + 10.0}
    with Stand(tmp_path, turntable_node=waits) as stand:
        for phase, step in ((State.DWELLING, 5), (State.TURNING, 8)):
            assert stand.reaches(phase, step=step)
            stand.kill('calibrator_node')
            stops(stand, 'calibrator', 'silent')
            stand.words.clear()
            stand.start('calibrator_node')
            assert stand.wait(lambda: stand.said('goes on from'))
            resumes(stand)
        assert stand.reaches(State.TURNING, step=10)
        stand.kill('turntable_node')
        # The table stops by itself.
        assert stand.table_stands(seconds=15)
        stand.states.clear()
        stand.start('turntable_node')
        final = finishes(stand)
        assert 'interrupted' in final.status_text


def test_a_full_disk_stops_the_table_and_loses_nothing_and_then_the_table_vanishes(tmp_path):
    resource = pytest.importorskip('resource')
    with Stand(tmp_path, turntable_node={'watchdog_timeout': 1.0}) as stand:
        assert stand.reaches(State.DWELLING, step=2)
        number = stand.processes.number('calibrator_node')
        unlimited = resource.prlimit(number, resource.RLIMIT_FSIZE)
        resource.prlimit(number, resource.RLIMIT_FSIZE, (300_000, unlimited[1]))
        stops(stand, 'cannot be written')
        resource.prlimit(number, resource.RLIMIT_FSIZE, unlimited)
        assert stand.wait(lambda: stand.progress[-1].state != Progress.FAILED)
        resumes(stand)
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
    with Stand(tmp_path) as stand:
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
        assert stand.said('stand_node', 'stamp')
        stand.fault('clear')
        finishes(stand, resumed=True)


def test_emergency_stop(tmp_path):
    waits = {'watchdog_timeout': LEASE + 10.0, 'feedback_timeout': LEASE + 10.0}
    with Stand(tmp_path, turntable_node=waits) as stand:
        assert stand.reaches(State.TURNING, step=1)
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
        a_pressed_stop_outlives_a_killed_turntable_node(stand)
        finishes(stand, resumed=True)


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
    assert stand.wait(lambda: stand.call('turntable_node/release')[0], LEASE)


KINDS = {
    'turntable/setpoint': 'TurntableSetpoint',
    'turntable/joint_states': 'JointState',
    'turntable/state': 'TurntableState',
    'calibration/progress': 'CalibrationProgress',
    'estop': 'Bool',
}
OWNERS = {
    'turntable/setpoint': '/turntable_node',
    'turntable/joint_states': '/stand_node',
    'turntable/state': '/turntable_node',
    'calibration/progress': '/calibrator_node',
    'estop': '/listener',
}


@contextmanager
def stranger(topic):
    """Let a node of another name publish on a topic of the stand."""
    node = ros.Node('stranger')
    try:
        yield node.create_publisher(getattr(ros.messages, KINDS[topic]), topic, qos.latched())
    finally:
        node.destroy_node()


def test_two_publishers_hold_the_table_and_spoofed_words_complete_nothing(tmp_path):
    with Stand(tmp_path) as stand:
        for topic in KINDS:
            assert stand.reaches(State.TURNING, step=1)
            with stranger(topic):
                stops(stand, '2 publishers', f'/{topic}', OWNERS[topic], '/stranger')
                success, message = stand.call('turntable_node/start')
                assert not success
                assert '/stranger' in message
            assert stand.wait(lambda: stand.call('turntable_node/start')[0], 20)
        for step, topic, spoof in (
            (3, 'turntable/state', spoofed_done),
            (5, 'calibration/progress', spoofed_progress),
        ):
            assert stand.reaches(State.DWELLING, step=step)
            stand.words.clear()
            with stranger(topic) as output:
                assert stand.wait(lambda output=output: output.get_subscription_count() >= 2)
                for _ in range(20):
                    output.publish(spoof(stand))
                    stand.wait(lambda: False, 0.05)
                stops(stand, f'/{topic}', '/stranger')
            assert not [c for c in stand.calibrations if c.status != c.PROVISIONAL]
            assert stand.wait(lambda: stand.call('turntable_node/start')[0], 20)
        finishes(stand)


def test_a_stranger_that_turns_a_table_nobody_leads_is_stopped_and_said(tmp_path):
    with Stand(tmp_path, turntable_node={'autostart': False}) as stand:
        assert stand.reaches(State.IDLE)
        a_stranger_is_stopped(stand)
        assert stand.reaches(State.DWELLING, step=3)
        assert stand.call('turntable_node/pause')[0]
        assert stand.reaches(State.PAUSED)
        a_stranger_is_stopped(stand)


def a_stranger_is_stopped(stand):
    """Let a stranger turn the table; it is stopped, and starts when its leader says so."""
    phase = stand.state.phase
    assert stand.table_stands(seconds=30)
    before = stand.joints
    stand.words.clear()
    with stranger('turntable/setpoint') as output:
        assert stand.wait(lambda: output.get_subscription_count() >= 2)
        for _ in range(100):
            output.publish(ten_turns(stand.joints))
            stand.wait(lambda: False, 0.02)
        asked_until = seconds(stand.joints)
        assert stand.said('turntable_node: plan', '/stranger')
        assert not stand.call('turntable_node/start')[0]
    assert stand.table_stands()
    # At 1 rad/s, by the table's own clock, it would have come at least twice as far.
    moved = np.abs(np.array(stand.joints.position) - np.array(before.position)).max()
    assert moved < (asked_until - seconds(before)) / 2
    assert stand.state.phase == phase
    told = []
    assert stand.wait(
        lambda: told.append(stand.call('turntable_node/start')) or told[-1][0], patience(20)
    ), told[-1]
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


def spoofed_done(stand):
    """Return DONE as the table's leader would say it, word for word."""
    steps = stand.state.steps
    done = State(plan='short', step=steps - 1, steps=steps, phase=State.DONE)
    done.header.stamp = stand.joints.header.stamp
    return done


def spoofed_progress(stand):
    progress = Progress(plan='short', steps=stand.state.steps, state=Progress.FINISHED)
    progress.header.stamp = stand.joints.header.stamp
    return progress


def test_done_without_its_leader_ends_no_session(tmp_path):
    """The leader is dead and forgotten, and somebody says DONE in its place, over and over."""
    with Stand(tmp_path) as stand:
        assert stand.reaches(State.DWELLING, step=3)
        steps = stand.state.steps
        stand.kill('turntable_node')
        listed = stand.node.get_publishers_info_by_topic
        assert stand.wait(lambda: not listed('/turntable/state'), LEASE + 10.0)
        with stranger('turntable/state') as output:
            assert stand.wait(lambda: output.get_subscription_count() >= 2)
            for _ in range(20):
                output.publish(spoofed_done(stand))
                stand.wait(lambda: False, 0.2)
        assert stand.said('turntable state', 'ends nothing', f'to {steps} of short')
        assert not [c for c in stand.calibrations if c.status != c.PROVISIONAL]
        assert stand.progress[-1].state != Progress.FINISHED


def test_a_session_that_is_ended_early_says_which_positions_are_missing(tmp_path):
    with Stand(tmp_path, '--speed', '10') as stand:
        assert stand.wait(
            lambda: (
                stand.state.phase == State.DWELLING and stand.state.step == stand.state.steps - 3
            )
        )
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


def test_two_imu_publishers(tmp_path):
    with Stand(tmp_path, '--speed', '5') as stand:
        assert stand.reaches(State.DWELLING, step=1)
        other = stand.node.create_publisher(stand_imu(), 'imu/pulses', keep_all())
        assert stand.wait(lambda: other.get_subscription_count() > 0)
        message = stand_imu()()
        message.header.stamp.sec = 1_700_000_000
        other.publish(message)
        final = stand.ended()
        assert final.status == final.REFUSED
        assert 'publishers' in final.status_text
        stops(stand, 'publishers')
        stand.check_numbers()


def stand_imu():
    from imu_calib.middleware import messages

    return messages.Imu


def keep_all():
    from imu_calib.nodes import qos

    return qos.stream()


def test_ctrl_c_stops_the_table_and_leaves_nothing_running(tmp_path):
    process, nodes = turning_session(tmp_path)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=patience())
    assert process.returncode == 130, errors
    assert 'Traceback' not in errors
    assert 'the table stands' in (nodes / 'stand_node.log').read_text()
    assert not running(str(tmp_path))


def test_a_killed_command_line_leaves_nothing_running(tmp_path):
    process, nodes = turning_session(tmp_path)
    process.kill()
    process.communicate()
    assert until(lambda: not running(str(tmp_path)))
    assert 'the table stands' in (nodes / 'stand_node.log').read_text()


def turning_session(tmp_path):
    """Start `imu-calib stand`; return it, and the folder of its logs, when the table turns."""
    nodes = tmp_path / 'session' / 'nodes'
    command = [sys.executable, '-m', 'imu_calib.cli.main', 'stand', str(short_plan(tmp_path))]
    path = os.pathsep.join([str(HERE.parent), os.environ.get('PYTHONPATH', '')])
    process = processes.start(
        [*command, '-o', str(nodes.parent)],
        env={**os.environ, 'PYTHONPATH': path},
        stderr=subprocess.PIPE,
        text=True,
    )
    log = nodes / 'turntable_node.log'

    def turning():
        assert process.poll() is None, process.communicate()[1]
        return log.exists() and 'Turning' in log.read_text()

    assert until(turning)
    return process, nodes


def running(text):
    command = ['ps', '-eww', '-o', 'args']
    listed = subprocess.run(command, capture_output=True, text=True, check=True)
    return [line for line in listed.stdout.splitlines() if text in line]
