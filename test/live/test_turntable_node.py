"""turntable_node against a simulated table as a second node, on the wire."""

import errno
import os
import signal
import time
from types import SimpleNamespace

import numpy as np
import pytest
import turntable_bench
from loopback import patience, start
from turntable_bench import MAIN, NAMES, PATIENT, STEADY

from imu_calib.common.errors import InputError
from imu_calib.common.stream import JointBlock, Mode, Setpoint, SetpointBlock
from imu_calib.common.units import DEG
from imu_calib.live import middleware as ros
from imu_calib.live.nodes import qos, stop, turntable_node
from imu_calib.live.nodes.run_action import CalibratorProgress
from imu_calib.live.rules import Phase
from imu_calib.recordings.cdr_codec import encode_joints, encode_setpoints

session = turntable_bench.session


HEARTBEAT = {**PATIENT, 'stop_required': True, 'heartbeat_timeout': 3.0}


BROKEN = """
import sys
from imu_calib.live.middleware import run
from imu_calib.live.nodes import turntable_node
class Broken(turntable_node.TurntableNode):
    def _run_round(self):
        super()._run_round()
        if self._sequencer.state().turns_done > 0.1:
            raise RuntimeError('a fault in a callback')
run(Broken)
"""


def test_a_session_starts_by_itself_and_ends_with_the_table_at_rest_where_it_began(session):
    session.open(autostart=True, **PATIENT)
    session.reaches(Phase.DONE)
    assert session.table.refusals == []
    assert session.ends_stopped()
    assert max(abs(a) for a in session.watcher.states[-1].positions) < 1e-4
    phases = {Phase(s.phase) for s in session.watcher.states}
    assert {Phase.MOVING, Phase.TURNING, Phase.SETTLING, Phase.DWELLING} <= phases
    stamps = np.array([s.stamp for s in session.table.setpoints])
    # What holds up the table, on the same executor, holds up the node as well.
    held_up = max(0.0, max(np.diff(session.table.ticks)) - 0.05) * 1e9
    assert np.diff(stamps).max() < 0.2e9 + held_up
    assert np.diff(stamps).mean() < 0.1e9 + held_up


def test_the_services_start_pause_resume_and_abort(session):
    session.turn_at(90).open(**PATIENT)
    session.table.silent = True
    assert session.press('start') == (False, 'There are no joint states from the table.')
    session.table.silent = False
    assert session.until(lambda: session.node._sequencer.feedback is not None)
    assert session.press('pause')[0] is False
    assert session.press('start') == (True, 'Runs tiny.')
    assert session.press('start')[0] is False
    session.reaches(Phase.TURNING)
    assert session.press('pause') == (True, 'Paused on request.')
    session.reaches(Phase.PAUSED)
    assert session.ends_stopped()
    assert session.press('start') == (True, 'Resumes with step 2.')
    session.reaches(Phase.TURNING)
    assert session.press('abort') == (True, 'Aborted on request.')
    session.reaches(Phase.ABORTED)
    assert session.ends_stopped()
    assert session.table.setpoints[-1].mode is Mode.HOLD


def test_no_start_while_the_calibrator_cannot_go_on(session):
    session.turn_at(90).open(supervised=True, **PATIENT)
    assert session.until(lambda: session.node._sequencer.feedback is not None)
    kind = ros.messages.CalibrationProgress

    def say(state, text=''):
        session.watcher.progress.publish(kind(plan='tiny', state=state, text=text))

    say(kind.FAILED, 'the disk is full.')
    words = 'The calibrator has failed: the disk is full.'
    assert session.until(lambda: session.press('start') == (False, words))
    say(kind.FINISHED)
    assert session.until(lambda: 'has finished its session' in session.press('start')[1])
    assert session.table.setpoints == []
    say(kind.COLLECTING)
    assert session.until(lambda: session.press('start')[0])


def test_the_emergency_stop_holds_and_refuses_a_start_until_it_is_released(session):
    session.turning()
    session.watcher.estop.publish(ros.messages.Bool(data=True))
    session.reaches(Phase.ABORTED)
    assert session.ends_stopped()
    started, why = session.press('start')
    assert not started
    assert 'The emergency stop is on.' in why
    assert 'call /turntable_node/release' in why
    released, why = session.press('release')
    assert not released
    assert why == 'A node still publishes stop on /estop: release it there first.'
    session.watcher.estop.publish(ros.messages.Bool(data=False))
    assert session.until(lambda: session.press('release')[0])
    # Neither what was said on the topic nor the release starts anything, autostart or not.
    assert not session.until(lambda: session.watcher.phase is not Phase.ABORTED, 0.5)
    assert not session.node._autostart
    assert session.press('release') == (False, 'The emergency stop is not pressed.')
    assert session.press('start') == (True, 'Runs tiny.')
    session.reaches(Phase.TURNING)


def test_without_a_heartbeat_nothing_starts_and_its_silence_holds_the_table(session):
    session.turn_at(90).open(**HEARTBEAT)
    # Joint states are there: what keeps it from starting is the heartbeat alone.
    assert session.until(lambda: session.node._sequencer.feedback is not None)
    assert session.until(lambda: 'No heartbeat on /heartbeat' in session.press('start')[1])
    beat = session.watcher.create_publisher(ros.messages.Bool, 'heartbeat', 10)
    clear = ros.messages.Bool(data=True)
    timer = session.watcher.create_timer(0.05, lambda: beat.publish(clear), clock=STEADY)
    assert session.until(lambda: session.press('start')[0])
    session.turns()
    timer.cancel()
    session.reaches(Phase.PAUSED)
    assert 'No heartbeat' in session.watcher.states[-1].reason
    assert session.ends_stopped()
    # That it is back starts nothing.
    timer.reset()
    assert session.until(lambda: not session.node._sequencer._obstacles.forbidden)
    assert not session.until(lambda: session.watcher.phase is not Phase.PAUSED, 0.3)
    session.turns()


def test_a_heartbeat_that_says_stop_once_holds_the_table(session):
    session.turn_at(90).open(**HEARTBEAT)
    beat = session.watcher.create_publisher(ros.messages.Bool, 'heartbeat', 10)
    clear, stop = (ros.messages.Bool(data=data) for data in (True, False))
    session.watcher.create_timer(0.05, lambda: beat.publish(clear), clock=STEADY)
    assert session.until(lambda: session.press('start')[0])
    session.turns()
    for message in (stop, clear):
        beat.publish(message)
    session.reaches(Phase.PAUSED)
    assert (
        'The heartbeat on /heartbeat is false, which means stop.'
        in session.watcher.states[-1].reason
    )
    assert session.ends_stopped()


def test_two_heartbeats_hold_the_table(session):
    """The silence of one would not be noticed."""
    session.turn_at(90).open(**HEARTBEAT)
    clear = ros.messages.Bool(data=True)

    def beats(node):
        beat = node.create_publisher(ros.messages.Bool, 'heartbeat', 10)
        node.create_timer(0.05, lambda: beat.publish(clear), clock=STEADY)

    beats(session.watcher)
    assert session.until(lambda: session.press('start')[0])
    session.turns()
    door = ros.Node('door')
    session.executor.add_node(door)
    beats(door)
    session.reaches(Phase.PAUSED)
    reason = session.watcher.states[-1].reason
    assert '2 publishers are on /heartbeat: /door, /watcher.' in reason
    assert session.ends_stopped()


def test_a_start_that_waited_for_a_node_that_hung_moves_nothing(session):
    session.turn_at(90).open(with_node=False)
    session.table.silent = True
    process = session.start(feedback_timeout=30.0)
    client = session.watcher.buttons['start']
    has_report = session.watcher.has_report
    assert session.until(client.service_is_ready)

    def answered():
        return session.until(client.call_async(ros.Trigger.Request()).done, 1.0)

    # A node may see its client a moment later than it is seen: its answer would go nowhere. Without
    # joint states it refuses.
    assert session.until(answered)
    session.table.silent = False
    assert session.until(lambda: has_report('joint states', 0, 'are received'))
    os.kill(process.pid, signal.SIGSTOP)
    future = client.call_async(ros.Trigger.Request())
    assert not session.until(future.done, 3.0)
    os.kill(process.pid, signal.SIGCONT)
    assert session.until(future.done)
    assert not future.result().success
    assert 'did not run for a while' in future.result().message
    assert not session.until(lambda: not session.table.at_rest(), 0.5)
    # Asked again, it starts.
    assert session.until(lambda: session.press('start')[0])
    session.reaches(Phase.TURNING)


def test_a_node_that_is_held_up_again_as_it_goes_on_takes_no_start_of_before(session):
    session.open(watchdog_timeout=1.0, feedback_timeout=30.0)
    assert session.until(lambda: session.node._sequencer.feedback is not None)
    node = session.node
    steady = node._steady = FakeSteady(node._steady.now().nanoseconds * 1e-9)

    def rounds(*lasting):
        for seconds in lasting:
            steady.seconds += seconds
            # Joint states go on.
            node._fed_at = steady.seconds
            node._run_round()

    def answer():
        return node._on_start(None, ros.Trigger.Response())

    # The second time is not too long by itself, and no request was taken in it.
    rounds(3.0, 1.5)
    assert 'did not run for a while' in answer().message
    rounds(*[0.01] * 85)
    assert 'did not run for a while' in answer().message
    rounds(*[0.01] * 10)
    assert answer().success


@pytest.mark.parametrize('name', ['watchdog_timeout', 'calibrator_timeout', 'feedback_timeout'])
@pytest.mark.parametrize('value', ['.inf', '.nan'])
def test_a_watchdog_without_an_end_is_refused(session, name, value):
    with pytest.raises(InputError, match=name):
        session.open(**{name: value})


def test_a_stamp_beyond_what_a_header_can_state_stops_the_table(session):
    session.turn_at(90).open(**PATIENT)
    assert session.until(lambda: session.node._sequencer.feedback is not None)
    assert session.press('start')[0]
    session.reaches(Phase.TURNING)
    late = ros.messages.JointState(name=list(NAMES), position=[0.0] * 3)
    late.header.stamp.sec, late.header.stamp.nanosec = 2**31 - 1, 2**32 - 1
    session.table.joints.publish(late)
    session.reaches(Phase.PAUSED)
    assert 'stamped 2147483651 s after 1970' in session.watcher.states[-1].reason
    assert session.ends_stopped()


def test_a_stop_that_is_taken_back_on_its_topic_alone_stays_pressed(session):
    session.turning()
    session.watcher.estop.publish(ros.messages.Bool(data=True))
    session.reaches(Phase.ABORTED)
    session.watcher.estop.publish(ros.messages.Bool(data=False))
    assert session.until(lambda: not session.node._estop._topic.is_stopping)
    assert not session.press('start')[0]
    assert not session.until(lambda: session.watcher.phase is not Phase.ABORTED, 0.5)
    assert session.ends_stopped()
    assert session.watcher.has_report('stop', 2, 'The emergency stop is on.')


@pytest.mark.parametrize('said', [True, None])
def test_a_pressed_stop_outlives_the_node_that_was_killed(session, said):
    """Whether who pressed it is still there, latched, or has left."""
    process = session.turn_at(60).process()
    estop = session.watcher.create_publisher(ros.messages.Bool, 'estop', qos.latched())
    session.watcher.destroy_publisher(session.watcher.estop)
    assert session.until(lambda: estop.get_subscription_count() > 0)
    estop.publish(ros.messages.Bool(data=True))
    session.reaches(Phase.ABORTED)
    # The table has stopped before the disk has it: what a kill leaves is the next start's.
    assert session.until(session.stop_file().exists)
    process.kill()
    process.communicate()
    assert session.ends_stopped()
    if said is None:
        session.watcher.destroy_publisher(estop)
    session.watcher.states.clear()
    before = len(session.table.setpoints)
    session.start(autostart=True, **PATIENT)
    assert session.until(lambda: session.watcher.phase is Phase.ABORTED), 'it remembers'
    assert session.until(lambda: len(session.table.setpoints) > before + 10)
    assert {s.mode for s in session.table.setpoints[before:]} == {Mode.HOLD}
    assert not session.press('start')[0]
    if said:
        assert 'still publishes stop' in session.press('release')[1]
        estop.publish(ros.messages.Bool(data=False))
    assert session.until(lambda: session.press('release')[0])
    assert not session.until(lambda: session.watcher.phase is not Phase.ABORTED, 0.5)
    # The one that was killed is listed as a publisher until its lease is over.
    assert session.until(lambda: session.press('start')[0])
    session.reaches(Phase.TURNING)


@pytest.mark.parametrize(
    'offered',
    [qos.sensor_data(), qos.command(), qos.latched()],
    ids=['best effort', 'reliable', 'latched'],
)
def test_a_stop_is_heard_whatever_its_publisher_offers(session, offered):
    session.turn_at(90).open(autostart=True, **PATIENT)
    session.watcher.destroy_publisher(session.watcher.estop)
    session.reaches(Phase.TURNING)
    estop = session.watcher.create_publisher(ros.messages.Bool, 'estop', offered)
    assert session.until(lambda: estop.get_subscription_count() > 0)

    def pressed():
        # What is published best effort may be lost: it is said over and over, as a button does.
        estop.publish(ros.messages.Bool(data=True))
        return session.watcher.phase is Phase.ABORTED

    assert session.until(pressed)
    assert session.ends_stopped()


def test_a_latched_stop_that_was_pressed_before_the_node_came_is_heard(session):
    session.open(with_node=False, autostart=True)
    session.watcher.destroy_publisher(session.watcher.estop)
    estop = session.watcher.create_publisher(ros.messages.Bool, 'estop', qos.latched())
    estop.publish(ros.messages.Bool(data=True))
    # Joint states come only when it has been heard: nothing can start before.
    session.table.silent = True
    session.join()
    session.reaches(Phase.ABORTED)
    session.table.silent = False
    assert not session.until(lambda: session.watcher.phase is not Phase.ABORTED, 0.5)
    assert {s.mode for s in session.table.setpoints} == {Mode.HOLD}


def test_where_a_stop_could_not_be_kept_the_table_stays_stopped(session):
    (session.folder / 'state').write_text('a file where a folder is to be')
    session.open(autostart=True, state_folder=str(session.folder / 'state'), **PATIENT)
    session.reaches(Phase.ABORTED)
    started, why = session.press('start')
    assert not started
    assert f'cannot be saved in {session.folder / "state"}' in why
    assert not session.press('release')[0]
    assert session.until(lambda: session.watcher.has_report('stop', 2, 'cannot be saved'))
    (session.folder / 'state').unlink()
    assert session.press('release')[0]
    assert not session.until(lambda: session.watcher.phase is not Phase.ABORTED, 0.3)
    assert session.until(lambda: session.press('start')[0])


def test_where_the_disk_is_full_a_stop_counts_as_pressed_and_stays(tmp_path, monkeypatch):
    write = stop._write

    def full(path, text):
        raise OSError(errno.ENOSPC, 'No space left on device')

    monkeypatch.setattr(stop, '_write', full)
    record = stop.StopRecord(tmp_path, 'domain 1 /turntable_node')
    assert record.pressed
    assert 'No space left on device' in record.trouble
    with pytest.raises(InputError, match='the table stays stopped'):
        record.release()
    assert record.pressed
    # There is room: what was pressed is released, and what is pressed again is kept.
    monkeypatch.setattr(stop, '_write', write)
    record.release()
    assert (record.pressed, record.trouble) == (False, '')
    monkeypatch.setattr(stop, '_write', full)
    record.press('a button')
    assert (record.pressed, bool(record.trouble)) == (True, True)
    monkeypatch.setattr(stop, '_write', write)
    record.press('a button')
    assert record.trouble == ''
    assert stop.StopRecord(tmp_path, 'domain 1 /turntable_node').pressed


def test_joint_states_that_cease_stop_the_table(session):
    session.turn_at(90).open(autostart=True)
    session.turns()
    session.table.silent = True
    session.reaches(Phase.PAUSED)
    assert session.ends_stopped()
    assert 'No joint state from the table for 0.5 s' in session.watcher.states[-1].reason
    statuses = [s for d in session.watcher.diagnostics for s in d.status if s.level == b'\x02']
    assert any('No joint state' in s.message and s.name == 'turntable_node: plan' for s in statuses)
    session.table.silent = False
    assert not session.until(lambda: session.watcher.phase is not Phase.PAUSED, 0.5)
    assert session.until(lambda: session.press('start')[0])
    session.reaches(Phase.TURNING)


@pytest.mark.parametrize('frozen', [False, True])
def test_joint_states_of_others_and_repeated_ones_are_no_word_of_the_table(session, frozen):
    session.turn_at(90).open(autostart=True, watchdog_timeout=2.0, feedback_timeout=30.0)
    session.reaches(Phase.TURNING)
    session.table.silent = True
    other = ros.messages.JointState(name=['door', 'lid'], position=[0.0] * 2)
    if frozen:
        other = ros.messages.JointState(name=list(NAMES), position=[0.0] * 3)
        last = session.node._sequencer.feedback.stamp
        other.header.stamp = ros.Time(nanoseconds=last).to_msg()
    session.watcher.create_timer(0.05, lambda: session.table.joints.publish(other), clock=STEADY)
    session.reaches(Phase.PAUSED)
    reason = session.watcher.states[-1].reason
    assert reason.startswith('No joint state from the table for 2 s.')
    assert ('of other joints (door, lid) are ignored' in reason) != frozen
    assert session.ends_stopped()


def test_a_calibrator_is_waited_for_and_has_steps_repeated(session):
    session.open(supervised=True, autostart=True, use_sim_time=True, watchdog_timeout=5.0)
    session.table.run_ahead(10)
    assert not session.until(lambda: session.watcher.phase is Phase.MOVING, 0.5)
    session.watcher.calibrate(session.table.stamp())
    assert session.until(lambda: session.node._sequencer.reviewing)
    session.watcher.calibrate(session.table.stamp(), [1])
    assert session.until(lambda: not session.node._sequencer.reviewing)
    assert session.until(lambda: session.node._sequencer.reviewing)
    session.watcher.calibrate(session.table.stamp())
    session.reaches(Phase.DONE)
    turns = [p for p in session.watcher.phases() if p is Phase.TURNING]
    assert len(turns) == 2
    assert session.ends_stopped()


def test_a_calibrator_that_falls_silent_stops_the_table(session):
    session.turn_at(90).open(supervised=True, autostart=True, calibrator_timeout=1.5, **PATIENT)
    assert session.until(lambda: session.node._sequencer.feedback is not None)
    session.watcher.calibrate(session.table.stamp())
    session.reaches(Phase.PAUSED)
    assert session.watcher.states[-1].reason == 'The calibrator is silent for 1.5 s.'
    assert session.ends_stopped()


def test_ctrl_c_stops_the_table_before_the_node_ends(session):
    process = session.turn_at(60).process()
    process.send_signal(signal.SIGINT)
    assert session.until(lambda: process.poll() is not None)
    _, err = process.communicate()
    assert process.returncode == 0, err
    assert session.until(lambda: session.table.setpoints[-1].mode is Mode.HOLD)
    assert session.table.table.advance(session.table.now()).stopped == ''
    assert session.ends_stopped()
    assert session.watcher.states[-1].reason == turntable_node._ENDS


def test_an_error_in_a_callback_stops_the_table(session):
    process = session.turn_at(360).process(BROKEN)
    assert session.until(lambda: process.poll() is not None)
    assert 'a fault in a callback' in process.communicate()[1]
    assert session.until(lambda: session.table.setpoints[-1].mode is Mode.HOLD)
    assert session.ends_stopped()


def test_a_node_that_is_killed_leaves_a_table_that_stops(session):
    process = session.turn_at(60).process()
    process.kill()
    process.communicate()
    assert session.ends_stopped()
    assert 'no setpoint for' in session.table.table.advance(session.table.now()).stopped


@pytest.mark.parametrize(
    ('changes', 'words'),
    [
        ({'plan': 'none'}, "No plan is called 'none'"),
        ({'plan': 'six_position_by_hand'}, 'for a unit in the hand'),
        ({'setpoint_rate': 5.0}, 'setpoint_rate'),
        ({'output': 'light'}, "found 'light', expected 'setpoint' or 'trajectory'"),
    ],
)
def test_what_cannot_work_is_a_sentence_and_an_exit_code(session, changes, words):
    process = start(MAIN, *session.arguments(**changes))
    _, err = process.communicate(timeout=patience())
    assert process.returncode == 2
    assert words in err
    assert 'Traceback' not in err


def test_simulated_time_may_run_ahead_of_the_wall_clock(session):
    """Twenty times faster, /clock in steps of 0.1 s, and no setpoint is ever too old."""
    session.open(autostart=True, use_sim_time=True, watchdog_timeout=5.0)
    session.table.run_ahead(20)
    begin = time.process_time()
    session.reaches(Phase.DONE)
    assert session.table.simulated > 3.0
    # Table and node in one process: what others do with the processor does not count.
    assert time.process_time() - begin < session.table.simulated / 2
    assert session.table.refusals == []
    assert session.ends_stopped()


KINDS = {
    'turntable/setpoint': (ros.messages.TurntableSetpoint, qos.command()),
    'turntable/joint_states': (ros.messages.JointState, qos.stream()),
    'turntable/state': (ros.messages.TurntableState, qos.latched()),
    'calibration/progress': (ros.messages.CalibrationProgress, qos.latched()),
    'estop': (ros.messages.Bool, 10),
}


STRANGERS_RATE = 720 * DEG


class Stranger(ros.Node):
    """Somebody else on the topics of the stand."""

    def __init__(self, topic):
        super().__init__('stranger')
        kind, profile = KINDS[topic]
        self.output = self.create_publisher(kind, topic, profile)

    def turn(self, stamp, rate=STRANGERS_RATE, step=0):
        """Send the table round ten times."""
        still = (0.0, 0.0)
        turn = Setpoint(
            stamp, 'mine', step, '', Mode.RATE, NAMES, (0.0, *still), (rate, *still), 10.0, 0.0
        )
        (payload,) = encode_setpoints(SetpointBlock((turn,))).payloads()
        self.output.publish(payload)


def answers_to_listed(node, topic):
    """Gather the mode in force after each check before which a stranger was listed.

    By the node's own order of events: when a check comes depends on the machine, too.
    """
    sent, listed, answers = [], [], []
    check, send, send_what_is_due = node._own.faults, node._send, node._send_what_is_due

    def faults(now):
        publishers = node.get_publishers_info_by_topic(f'/{topic}')
        listed.append('stranger' in {p.node_name for p in publishers})
        return check(now)

    def sends(setpoint):
        sent.append(setpoint.mode)
        send(setpoint)

    def sends_what_is_due(now):
        send_what_is_due(now)
        if listed and listed.pop():
            answers.append(sent[-1])

    node._own.faults, node._send, node._send_what_is_due = faults, sends, sends_what_is_due
    return answers


@pytest.mark.parametrize('topic', list(KINDS))
def test_two_publishers_hold_the_table_are_named_and_nothing_starts(session, topic):
    session.turning(60)
    answers = answers_to_listed(session.node, topic)
    stranger = Stranger(topic)
    owner = {'turntable/joint_states': '/table'}.get(topic, '/watcher')
    owner = '/turntable_node' if topic in {'turntable/setpoint', 'turntable/state'} else owner
    session.reaches(Phase.PAUSED)
    # The check that sees the second one holds the table.
    assert turntable_node._CHECK_PERIOD == 0.1
    assert answers[0] is Mode.HOLD
    names = ', '.join(sorted([owner, '/stranger']))
    words = f'2 publishers are on /{topic}: {names}.'
    assert words in session.watcher.states[-1].reason
    assert session.until(lambda: session.watcher.has_report('publishers', 2, words))
    assert session.until(lambda: session.watcher.has_report('plan', 2, words))
    assert session.ends_stopped()
    assert session.table.setpoints[-1].mode is Mode.HOLD
    started, why = session.press('start')
    assert not started
    assert words in why
    stranger.destroy_node()
    assert session.until(lambda: session.watcher.has_report('publishers', 0, 'one publisher'))
    assert not session.until(lambda: session.watcher.phase is not Phase.PAUSED, 0.5)
    assert session.press('start')[0]
    session.reaches(Phase.TURNING)


@pytest.mark.parametrize('topic', ['turntable/setpoint', 'estop'])
def test_two_publishers_forbid_a_start_by_itself_even_when_one_has_left(session, topic):
    stranger = None
    session.open(with_node=False, autostart=True)
    stranger = Stranger(topic)
    session.table.silent = True
    session.join()
    assert session.until(lambda: session.watcher.has_report('publishers', 2, '/stranger'))
    session.table.silent = False
    stranger.destroy_node()
    assert session.until(lambda: session.watcher.has_report('publishers', 0, 'one publisher'))
    assert not session.until(lambda: session.watcher.phase is not Phase.IDLE, 0.5)
    assert session.press('start')[0]


def test_two_leaders_of_one_name_hear_each_other_and_hold(session):
    """A stand that is launched twice: the names say nothing, the states do."""
    session.turning(60)
    session.start()
    session.reaches(Phase.PAUSED)
    words = '/turntable_node, /turntable_node'
    assert words in session.watcher.states[-1].reason or session.until(
        lambda: session.watcher.has_report('publishers', 2, words)
    )
    assert session.ends_stopped()
    session.processes[0].kill()
    session.processes[0].communicate()
    # The one that was killed is listed until its lease is over, and is not heard any more.
    assert session.until(lambda: session.node._sequencer.obstacle == '')
    assert session.until(lambda: session.press('start')[0])


def test_a_leader_that_was_killed_and_started_anew_is_not_locked_out(session):
    process = session.turn_at(60).process()
    process.kill()
    process.communicate()
    assert session.ends_stopped()
    session.watcher.states.clear()
    # What publishes with keep-all waits for the subscription that was killed, as long as it lasts:
    # the table of this process stands meanwhile, which may seem a stall.
    session.start(autostart=True, **PATIENT)
    session.turns()


IDLE_STATES = {
    Phase.IDLE: lambda session: None,
    Phase.PAUSED: lambda session: (session.press('start'), session.press('pause')),
    Phase.ABORTED: lambda session: (session.press('start'), session.press('abort')),
    Phase.DONE: lambda session: (session.press('start'), session.reaches(Phase.DONE)),
}


@pytest.mark.parametrize('phase', list(IDLE_STATES))
def test_a_table_that_a_stranger_turns_is_held_and_it_is_said_how_far_and_how_fast(session, phase):
    """The stranger has left before anybody looks for publishers: the encoders tell."""
    session.open(**PATIENT)
    assert session.until(lambda: session.node._sequencer.feedback is not None)
    IDLE_STATES[phase](session)
    session.reaches(phase)
    assert session.ends_stopped()
    # By a hand, or by the controller's own panel: no setpoint is heard.
    at = session.table.table.angles(np.array([session.table.now()]))[0]
    # The panel leads until the encoder shows it: a HOLD on its way would stop it within an instant.
    session.table.deaf = True
    session.table.force(tuple(at + np.array([360 * DEG, 0.0, 0.0])))
    assert session.until(lambda: session.table.turned(at) > 1 * DEG)
    session.table.deaf = False
    assert session.until(lambda: session.watcher.has_report('plan', 2, 'without a command'))
    assert session.watcher.phase is phase
    assert session.until(
        lambda: session.table.setpoints and session.table.setpoints[-1].mode is Mode.HOLD
    )
    assert session.ends_stopped()
    assert session.until(lambda: session.watcher.has_report('plan', 2, 'it stands again'))
    assert session.until(lambda: 'it stands again' in session.watcher.states[-1].reason)
    told = session.watcher.states[-1].reason
    assert 'Joint outer moves while it is to stand at' in told
    went, fast = (float(told.split(word)[1].split()[0]) for word in (' moved ', ' up to '))
    # Two decimals, and the encoder's own steps.
    assert went == pytest.approx(session.table.turned(at) / DEG, abs=0.02)
    assert 1 < went < 360.02
    assert 0 < fast <= 2000
    assert session.press('start')[0]
    session.reaches(Phase.MOVING)


def test_nothing_starts_while_the_table_moves_by_itself(session):
    session.open()
    assert session.until(lambda: session.node._sequencer.feedback is not None)
    assert session.until(lambda: session.node._sequencer.feedback.still)
    session.table.deaf = True
    session.table.force((1e6 * DEG, 0.0, 0.0))
    assert session.until(lambda: session.watcher.has_report('plan', 2, 'it still moves'))
    started, why = session.press('start')
    assert not started
    assert 'it still moves' in why


def test_a_setpoint_of_a_stranger_is_answered_by_hold_at_once(session):
    """An idle table is not turned by one whole round, though the stranger goes on for ten."""
    session.open()
    assert session.until(lambda: session.node._sequencer.feedback is not None)
    stranger = Stranger('turntable/setpoint')
    assert session.until(lambda: stranger.output.get_subscription_count() >= 2)
    at = session.table.table.angles(np.array([session.table.now()]))[0]
    began = session.table.now()
    for _ in range(30):
        stranger.turn(session.table.stamp())
        session.until(lambda: False, 0.03)
    assert session.until(lambda: session.watcher.has_report('plan', 2, '/stranger'))
    # On a busy machine the HOLD is late as well: the stranger alone would turn it all the time.
    alone = STRANGERS_RATE * (session.table.now() - began)
    assert session.table.turned(at) < 0.6 * alone
    assert not session.press('start')[0]
    stranger.destroy_node()
    assert session.ends_stopped()


@pytest.mark.parametrize('button', ['pause', 'abort'])
def test_a_start_by_itself_that_is_called_off_does_not_come(session, button):
    session.open(autostart=True, **PATIENT)
    session.table.silent = True
    words = 'The automatic start is cancelled.'
    assert session.press(button) == (True, words)
    session.table.silent = False
    assert session.until(lambda: session.node._sequencer.feedback is not None)
    assert not session.until(lambda: session.watcher.phase is not Phase.IDLE, 0.5)
    assert not session.node._autostart
    assert session.press('start')[0]


def test_a_pressed_stop_is_answered_by_hold_before_anything_else_is_done(session):
    session.turn_at(90).open(**PATIENT)
    assert session.until(lambda: session.node._sequencer.feedback is not None)
    assert session.press('start')[0]
    session.reaches(Phase.TURNING)
    sent = []
    session.node._send = sent.append
    session.node._estop._record.press = sent.append
    session.node._estop._receive(True)
    assert [getattr(one, 'mode', one) for one in sent] == [Mode.HOLD, 'heard on /estop']


@pytest.mark.parametrize(('mode', 'answers'), [(Mode.RATE, 3), (Mode.POSITION, 3), (Mode.HOLD, 0)])
def test_each_movement_that_a_stranger_asks_for_is_answered_and_no_hold_is(session, mode, answers):
    session.open(**PATIENT)
    assert session.until(lambda: session.node._sequencer.feedback is not None)
    still = (0.0,) * 3
    order = Setpoint(session.table.stamp(), 'mine', 0, '', mode, NAMES, still, still, 1.0, 0.0)
    (payload,) = encode_setpoints(SetpointBlock((order,))).payloads()
    # The first one is a fault, whose HOLD is due.
    session.node._on_foreign('turntable/setpoint', bytes(payload))
    sent = []
    session.node._send = sent.append
    session.node._send_what_is_due = lambda _: None
    for _ in range(3):
        session.node._on_foreign('turntable/setpoint', bytes(payload))
    assert [s.mode for s in sent] == [Mode.HOLD] * answers


def test_setpoints_are_no_older_than_the_joint_states_they_answer(session):
    """The table's clock may be ahead, or /clock late: it refuses what seems old."""
    session.open(watchdog_timeout=30.0)
    session.table.silent = True
    assert session.until(lambda: session.table.joints.get_subscription_count() > 0)
    ahead = session.table.stamp() + 100 * 10**9
    block = JointBlock(np.array([ahead]), NAMES, np.zeros((1, 3)), np.zeros((1, 3)))
    for payload in encode_joints(block).payloads():
        session.table.joints.publish(payload)
    assert session.until(lambda: session.press('start')[0])
    assert session.until(lambda: session.table.setpoints)
    assert session.table.setpoints[-1].stamp == ahead


@pytest.mark.parametrize(
    'spoof',
    [
        {'plan': ''},
        {'plan': 'another'},
        {'ahead': 60.0},
    ],
    ids=['no plan', 'another plan', 'of the future'],
)
def test_progress_that_cannot_be_the_calibrators_completes_nothing(session, spoof):
    session.open(supervised=True, autostart=True, use_sim_time=True, watchdog_timeout=5.0)
    session.table.run_ahead(10)
    session.watcher.calibrate(session.table.stamp())
    assert session.until(lambda: session.node._sequencer.reviewing)
    stamp = session.table.stamp() + round(spoof.get('ahead', 0.0) * 1e9)
    for _ in range(5):
        session.watcher.calibrate(stamp, plan=spoof.get('plan', 'tiny'))
        session.until(lambda: False, 0.05)
    assert session.node._sequencer.reviewing
    session.watcher.calibrate(session.table.stamp())
    session.reaches(Phase.DONE)


@pytest.mark.parametrize(('running', 'plan'), [(True, 'tiny'), (True, 'x'), (False, 'tiny')])
def test_a_calibrator_that_fails_stops_a_run_whoever_it_is(running, plan):
    failed = []
    sequencer = SimpleNamespace(
        plan=SimpleNamespace(name='tiny'),
        running=running,
        fail=failed.append,
        review=lambda stamp, steps: None,
        skip_done=lambda seen, steps: None,
        set_calibrator_fault=lambda _: None,
    )
    diagnostics = SimpleNamespace(report=lambda *_: None)
    progress = CalibratorProgress(sequencer, diagnostics, 1.0, lambda _: False)
    kind = ros.messages.CalibrationProgress
    assert progress.on_progress(kind(plan=plan, state=kind.FAILED, text='full.'), 0.0) == (
        plan == 'tiny'
    )
    assert failed == ['The calibrator has failed: full.'] * running


def test_a_stop_that_is_sent_once_may_be_sent_again_until_it_is_heard():
    """`ros2 topic pub --once` ends before a check: half of its stops were not heard."""
    profiles = []
    node = SimpleNamespace(
        resolve_topic_name=lambda name: f'/{name}',
        create_subscription=lambda *words, **_: profiles.append(words[3].reliability),
    )
    stop.StopTopic(node, 'estop', lambda _: None)
    assert set(profiles) == {qos.command().reliability, qos.sensor_data().reliability}


@pytest.mark.parametrize(('publishers', 'is_stopping'), [(1, False), (2, True), (0, False)])
def test_a_stop_is_taken_back_by_its_only_publisher(publishers, is_stopping):
    messages = []
    count = [2]
    node = SimpleNamespace(
        resolve_topic_name=lambda name: f'/{name}',
        create_subscription=lambda *_, **__: None,
        count_publishers=lambda _: count[0],
    )
    topic = stop.StopTopic(node, 'estop', messages.append)
    assert not topic.is_stopping
    topic._receive(ros.messages.Bool(data=True))
    assert topic.is_stopping
    count[0] = publishers
    topic._receive(ros.messages.Bool(data=False))
    assert topic.is_stopping == is_stopping
    assert messages == [True, False]


@pytest.mark.parametrize('alone', [True, False])
def test_progress_counts_of_one_publisher_only(alone):
    messages = []
    sequencer = SimpleNamespace(
        plan=SimpleNamespace(name='tiny'),
        review=lambda stamp, steps: messages.append(('review', stamp, steps)),
        skip_done=lambda seen, steps: messages.append(('done', seen, steps)),
        set_calibrator_fault=lambda _: None,
        set_calibrator_present=lambda heard, _: messages.append(heard),
    )
    diagnostics = SimpleNamespace(report=lambda *_: None)
    progress = CalibratorProgress(sequencer, diagnostics, 1.0, lambda _: alone)
    message = ros.messages.CalibrationProgress(plan='tiny', state=1, step=4, repeat_steps=[2])
    message.header.stamp.sec = 7
    assert progress.on_progress(message, 10.0)
    assert messages == [('review', 7 * 10**9, [2]), ('done', 4, [2])] * alone
    # That somebody is there is heard in any case; what he says is not believed.
    progress.check(11.0)
    progress.check(11.1)
    assert messages[-2:] == [True, False]


def test_progress_of_another_plan_keeps_no_calibrator_alive(session):
    session.turn_at(90).open(supervised=True, autostart=True)
    assert session.until(lambda: session.node._sequencer.feedback is not None)
    for _ in range(5):
        session.watcher.calibrate(session.table.stamp(), plan='another')
        session.until(lambda: False, 0.05)
    assert session.watcher.phase is Phase.IDLE
    assert session.until(
        lambda: session.watcher.has_report('calibrator', 2, 'The calibrator expects plan another')
    )


class FakeSteady:
    """A steady clock that a test sets."""

    def __init__(self, now):
        self.seconds = now

    def now(self):
        return ros.Time(nanoseconds=round(self.seconds * 1e9))


@pytest.mark.parametrize('timeout', [0.5, 3.0])
def test_the_watchdog_bites_when_its_time_is_over_and_not_before(session, timeout):
    session.turn_at(90).open(autostart=True, watchdog_timeout=timeout)
    session.turns()
    node = session.node
    session.table.silent = True
    ros.drain(node._joints)
    steady = node._steady = FakeSteady(node._fed_at + timeout - 1e-3)
    node._run_round()
    assert node._sequencer.running
    session.table.setpoints.clear()
    steady.seconds += 2e-3
    node._run_round()
    assert not node._sequencer.running
    assert node._sequencer.state().reason == f'No joint state from the table for {timeout:g} s.'
    assert session.until(lambda: session.table.setpoints)
    assert session.table.setpoints[0].mode is Mode.HOLD
    assert session.ends_stopped()


@pytest.mark.parametrize('timeout', [1.0, 5.0])
def test_a_calibrator_is_given_its_time_and_no_more(session, timeout):
    waits = {**PATIENT, 'calibrator_timeout': timeout}
    session.turn_at(60).open(supervised=True, autostart=True, **waits)
    assert session.until(lambda: session.node._sequencer.feedback is not None)
    node = session.node

    def turning():
        session.watcher.calibrate(session.table.stamp())
        if session.watcher.phase is Phase.PAUSED:
            # Held up for longer than the calibrator may be silent.
            session.press('start')
        return session.watcher.phase is Phase.TURNING

    assert session.until(turning)
    steady = node._steady = FakeSteady(node._calibrator._received_at + timeout - 1e-3)
    node._fed_at = steady.seconds
    node._run_round()
    assert node._sequencer.running
    steady.seconds += 2e-3
    node._fed_at = steady.seconds
    node._run_round()
    assert node._sequencer.state().reason == f'The calibrator is silent for {timeout:g} s.'
    assert session.ends_stopped()
