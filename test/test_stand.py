"""The live stand: a session from start to end, and everything that goes wrong on the way.

Every process is real; table and IMU are simulated at the level of hardware. What a fault does to
the table is asserted on the table's own joint states, and every number that was ever published is
held against the truth.
"""

import os
import signal
import subprocess
import sys

import processes
import pytest
from loopback import patience, until

from imu_calib.errors import ImuCalibError

try:
    from live import HERE, Progress, Stand, State, short_plan
except ImuCalibError as error:
    pytest.skip(str(error), allow_module_level=True)

MOVES = (State.MOVING, State.TURNING)
# What publishes with keep-all waits for a subscription that was killed until its lease ends: 10 s
# with Cyclone DDS, 20 s with Fast DDS.
LEASE = 20.0


def finishes(stand, *, resumed=False, clock_rate=0.0):
    """Let a session end; its result must be right, and the journal must give the same bits."""
    if resumed:
        success, message = stand.call('turntable_node/start')
        assert success, message
    final = stand.ended()
    assert final.status == final.VALID, final.status_text
    assert 'Missing' not in final.status_text
    stand.check_numbers(clock_rate)
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
    with Stand(tmp_path) as stand:
        finishes(stand)
        assert stand.progress[-1].state == Progress.FINISHED
        assert any(c.status == c.PROVISIONAL for c in stand.calibrations)
        assert stand.reaches(State.DONE)


def test_imu_node_is_killed_and_started_anew(tmp_path):
    with Stand(tmp_path) as stand:
        assert stand.reaches(State.TURNING, step=1)
        stand.kill('imu_node')
        stand.start('imu_node')
        finishes(stand)


def test_calibrator_is_killed_and_goes_on_from_its_journal(tmp_path):
    waits = {'calibrator_timeout': 2.0, 'watchdog_timeout': LEASE + 10.0}
    with Stand(tmp_path, turntable_node=waits) as stand:
        assert stand.reaches(State.DWELLING, step=5)
        stand.kill('calibrator_node')
        stops(stand, 'calibrator', 'silent')
        stand.start('calibrator_node')
        assert stand.wait(lambda: stand.said('goes on from'))
        final = finishes(stand, resumed=True)
        assert 'interrupted' in final.status_text


def test_turntable_node_is_killed_and_the_table_stops_by_itself(tmp_path):
    waits = {'watchdog_timeout': LEASE + 10.0}
    with Stand(tmp_path, turntable_node=waits) as stand:
        assert stand.reaches(State.TURNING, step=1)
        stand.kill('turntable_node')
        assert stand.table_stands(seconds=15)
        stand.start('turntable_node')
        finishes(stand)


def test_the_table_vanishes(tmp_path):
    with Stand(tmp_path, turntable_node={'watchdog_timeout': 1.0}) as stand:
        assert stand.reaches(State.DWELLING, step=4)
        stand.kill('stand_node')
        assert stand.reaches(State.PAUSED, seconds=20)
        assert 'joint state' in stand.state.reason
        stand.parameters['stand_node']['start'] = 10_000.0
        stand.start('stand_node')
        assert stand.table_stands(seconds=20)
        finishes(stand, resumed=True)


def test_the_imu_is_silent_for_two_seconds(tmp_path):
    with Stand(tmp_path) as stand:
        assert stand.reaches(State.TURNING, step=2)
        stand.fault('silence 2.0')
        finishes(stand)


def test_garbage_in_the_byte_stream(tmp_path):
    with Stand(tmp_path) as stand:
        assert stand.reaches(State.DWELLING, step=3)
        stand.fault('garbage 500')
        finishes(stand)
        assert stand.said('imu_node', 'Bytes come that are no frames')


@pytest.mark.parametrize(
    ('fault', 'phase', 'step', 'word', 'to_the_end'),
    [
        ('stall', State.TURNING, 1, 'Joint', True),
        ('overshoot 5', State.MOVING, 0, 'Joint', False),
        ('refuse', State.DWELLING, 3, 'Joint', False),
        ('joint_rate 1', State.TURNING, 1, 'joint state', True),
    ],
)
def test_a_table_that_does_not_do_as_it_is_told(tmp_path, fault, phase, step, word, to_the_end):
    with Stand(tmp_path) as stand:
        assert stand.reaches(phase, step=step)
        stand.fault(fault)
        stops(stand, word)
        stand.fault('clear')
        if to_the_end:
            finishes(stand, resumed=True)
        else:
            resumes(stand)


def test_setpoints_come_late_and_the_table_refuses_them_as_stale(tmp_path):
    with Stand(tmp_path) as stand:
        assert stand.reaches(State.TURNING, step=1)
        stand.fault('delay 1.0')
        stops(stand)
        assert stand.said('stand_node', 'stamp')
        stand.fault('clear')
        resumes(stand)


@pytest.mark.parametrize('jump', [0.5, -20.0])
def test_the_clock_of_the_device_jumps(tmp_path, jump):
    with Stand(tmp_path) as stand:
        assert stand.reaches(State.DWELLING, step=5)
        stand.fault(f'clock_jump {jump}')
        finishes(stand)
        assert stand.said('imu_node: clock', 'jump')


def test_the_clock_of_the_device_drifts(tmp_path):
    with Stand(tmp_path, stand_node={'clock_drift': 100.0}) as stand:
        finishes(stand, clock_rate=100e-6)


def test_emergency_stop(tmp_path):
    with Stand(tmp_path) as stand:
        assert stand.reaches(State.TURNING, step=1)
        stand.estop(pressed=True)
        stops(stand, 'mergency')
        success, message = stand.call('turntable_node/start')
        assert not success, message
        stand.estop(pressed=False)
        assert not stand.wait(lambda: stand.state.phase in MOVES, 1.0)
        finishes(stand, resumed=True)


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


def test_a_full_disk_stops_the_table_and_loses_nothing(tmp_path):
    resource = pytest.importorskip('resource')
    with Stand(tmp_path) as stand:
        assert stand.reaches(State.DWELLING, step=2)
        number = stand.processes.number('calibrator_node')
        unlimited = resource.prlimit(number, resource.RLIMIT_FSIZE)
        resource.prlimit(number, resource.RLIMIT_FSIZE, (300_000, unlimited[1]))
        stops(stand, 'cannot be written')
        resource.prlimit(number, resource.RLIMIT_FSIZE, unlimited)
        assert stand.wait(lambda: stand.progress[-1].state != Progress.FAILED)
        finishes(stand, resumed=True)


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
