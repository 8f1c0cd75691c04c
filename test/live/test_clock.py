"""Simulated time that begins late, in 1970, or jumps back: no node ends, no recording lies."""

import numpy as np
import pytest
from loopback import environment, isolate, patience, start, until

from imu_calib.common.stream import ImuBlock
from imu_calib.live import middleware as ros
from imu_calib.live.nodes import intake, qos
from imu_calib.live.nodes.calibrator_node import CalibratorNode
from imu_calib.live.rules import Phase
from imu_calib.recordings.cdr_codec import Kind, encode_imu
from imu_calib.recordings.rosbag2 import open_recording
from imu_calib.recordings.writer import Journal

M = ros.messages
NS = 1_000_000_000
EPOCH = 1_700_000_000
TOPIC = '/imu/pulses'


def samples(first, count=10):
    stamp = first * NS + np.arange(count) * 10_000_000
    return encode_imu(ImuBlock(stamp, np.zeros((count, 3)), np.zeros((count, 3)), 'imu_link'))


def log_times(path):
    with open_recording(path) as recording:
        found = [(t.name, times.log) for t, _, times in recording.messages()]
    return {name: np.concatenate([log for n, log in found if n == name]) for name, _ in found}


class Bench:
    """A calibrator_node and whoever keeps the time, in one thread."""

    def __init__(self, monkeypatch, folder):
        isolate(monkeypatch)
        given = {
            'use_sim_time': 'true',
            'latitude': '34.65',
            'journal': folder / 'journal',
            'output': folder / 'calibration.yaml',
        }
        words = [w for k, v in given.items() for w in ('-p', f'{k}:={v}')]
        ros.init(args=['--ros-args', *words])
        self.node, self.peer = CalibratorNode(), ros.Node('peer')
        self.words = {}
        self.peer.create_subscription(M.DiagnosticArray, '/diagnostics', self._hear, 100)
        self.pulses = self.peer.create_publisher(M.Imu, 'imu/pulses', qos.stream())
        self.states = self.peer.create_publisher(M.TurntableState, 'turntable/state', qos.latched())
        self.clock = self.peer.create_publisher(M.Clock, '/clock', 10)
        assert self.until(
            lambda: (
                self.peer.count_subscribers('imu/pulses')
                and self.peer.count_subscribers('/clock')
                and self.states.get_subscription_count()
            )
        )

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.node.stop()
        self.node.destroy_node()
        self.peer.destroy_node()
        ros.try_shutdown()

    def _hear(self, message):
        self.words |= {s.name.partition(': ')[2]: s.message for s in message.status}

    def until(self, condition):
        return until(condition, step=self._spin)

    def _spin(self):
        ros.spin_once(self.node, timeout_sec=0.002)
        ros.spin_once(self.peer, timeout_sec=0.002)

    def set_time(self, seconds):
        self.clock.publish(M.Clock(clock=M.TimeMsg(sec=seconds)))
        assert self.until(lambda: int(self.node.get_clock().now().nanoseconds) == seconds * NS)

    def send(self, first):
        before = self.count
        ros.publish_all(self.pulses, samples(first).payloads())
        return lambda: self.count == before + 10

    @property
    def count(self):
        return self.node._sessions.all[0].intakes[Kind.IMU].count


def test_what_waits_at_the_end_is_recorded_however_much_it_is(monkeypatch, tmp_path):
    # More than two rounds take, as after a long solve of another session.
    count = 3 * intake._MOST
    with Bench(monkeypatch, tmp_path) as bench:
        bench.set_time(EPOCH)
        ros.publish_all(bench.pulses, samples(EPOCH, count).payloads())
        assert ros.acknowledged(bench.pulses, patience())
        assert bench.count == 0
    assert len(log_times(tmp_path / 'journal')[TOPIC]) == count


def test_nothing_is_recorded_before_the_clock_begins_and_nothing_is_lost(monkeypatch, tmp_path):
    with Bench(monkeypatch, tmp_path) as bench:
        bench.states.publish(M.TurntableState(plan='twelve_position'))
        all_came = bench.send(EPOCH)
        assert bench.until(lambda: 'is no message on /clock yet' in bench.words.get('time', ''))
        assert bench.until(lambda: bench.node._turntable._unrecorded)
        assert bench.count == 0
        bench.set_time(EPOCH)
        assert bench.until(all_came)
        assert bench.until(lambda: bench.words['time'] == 'The clock runs.')
        # Back in 1970, and on from there.
        for seconds in (0, 1, 2):
            bench.set_time(seconds)
            assert bench.until(bench.send(EPOCH + 1 + seconds))
        assert bench.until(lambda: 'jumped back by 1.7e+09 s' in bench.words['time'])
    logged = log_times(tmp_path / 'journal')
    assert {len(times) for times in logged.values()} == {1, 40}
    for times in logged.values():
        assert EPOCH * NS <= times.min() <= times.max() < (EPOCH + 1) * NS


NODES = {
    'calibrator_node': ['latitude:=34.65', 'journal:={}/journal', 'output:={}/result.yaml'],
    'turntable_node': [],
    'compensator_node': [],
    'imu_node': ['port:={}/frames'],
}
MAIN = 'import sys\nfrom imu_calib.live.nodes.programs import start\nsys.exit(start("{}"))'


@pytest.mark.parametrize('name', NODES)
def test_no_node_ends_whatever_the_clock_says(monkeypatch, tmp_path, name):
    network = environment()
    for key, value in network.items():
        monkeypatch.setenv(key, value)
    (tmp_path / 'frames').write_bytes(b'')
    words = [w for p in NODES[name] for w in ('-p', p.format(tmp_path))]
    process = start(MAIN.format(name), '--ros-args', '-p', 'use_sim_time:=true', *words, **network)
    ros.init(args=[])
    peer = ros.Node('peer')
    messages = []
    try:
        peer.create_subscription(M.DiagnosticArray, '/diagnostics', messages.append, 100)
        clock = peer.create_publisher(M.Clock, '/clock', 10)
        joints = peer.create_publisher(M.JointState, 'turntable/joint_states', qos.stream())
        pulses = peer.create_publisher(M.Imu, 'imu/pulses', qos.stream())
        progress = peer.create_publisher(
            M.CalibrationProgress, 'calibration/progress', qos.latched()
        )

        def set_time(seconds):
            clock.publish(M.Clock(clock=M.TimeMsg(sec=seconds)))
            # What was measured before the clock began is older than 1970.
            stamp = M.TimeMsg(sec=seconds - 1)
            state = M.JointState(name=['outer', 'middle', 'inner'], position=[0.0] * 3)
            state.header.stamp = stamp
            joints.publish(state)
            ros.publish_all(pulses, samples(seconds - 1).payloads())
            message = M.CalibrationProgress(plan='twelve_position', state=1)
            message.header.stamp = stamp
            progress.publish(message)
            messages.clear()
            # Two words of it: the second was said after the clock was heard.
            assert until(
                lambda: len(messages) > 1 or process.poll() is not None,
                step=lambda: ros.spin_once(peer, timeout_sec=0.01),
            )
            assert process.poll() is None, process.stderr.read()

        for seconds in (0, 1, EPOCH, EPOCH + 1, 0, 3, 2**31 - 1, 7):
            set_time(seconds)
        process.terminate()
        assert process.wait(patience()) == 0
    finally:
        process.kill()
        process.communicate()
        peer.destroy_node()
        ros.try_shutdown()


def test_a_reset_that_is_refused_leaves_the_session_running(monkeypatch, tmp_path):
    with Bench(monkeypatch, tmp_path) as bench:
        bench.set_time(1)
        before = bench.node._sessions
        # What an earlier start of the node ended with.
        finished = Journal(
            tmp_path / 'journal_2', bench.node._factory._description, {TOPIC: Kind.IMU}
        )
        finished.write(TOPIC, Kind.IMU.type_name, samples(EPOCH), EPOCH * NS)
        finished.close(finished=True)
        answer = bench.node._on_reset(None, ros.Trigger.Response())
        assert not answer.success
        assert 'holds a completed session' in answer.message
        assert bench.node._sessions is before
        # It takes samples in, is secured, and solves.
        assert bench.until(bench.send(1))
        bench.node._on_second()
        assert bench.until(lambda: before.all[0].review is not None or before.poll())
        # The next folder is free.
        assert bench.node._on_reset(None, ros.Trigger.Response()).success
        assert bench.node._sessions.journal.path.name == 'journal_3'


def test_two_simulated_stands_in_one_domain_are_named(monkeypatch, tmp_path):
    with Bench(monkeypatch, tmp_path) as bench:
        bench.set_time(EPOCH)
        assert bench.until(lambda: bench.words.get('time') == 'The clock runs.')
        bench.peer.create_publisher(M.Clock, '/clock', 10)
        assert bench.until(lambda: bench.words['time'].startswith('2 publishers are on /clock: '))
        assert '/peer, /peer. Samples are stamped by both' in bench.words['time']
        assert 'ROS_DOMAIN_ID' in bench.words['time']
        # Of two clocks each goes back behind the other; it is said once what is wrong.
        bench.set_time(1)
        bench.node._on_tick()
        assert bench.words['time'].startswith('2 publishers')


def test_while_the_plan_runs_no_new_session_begins(monkeypatch, tmp_path):
    # It would lack the steps before, and end without a calibration.
    with Bench(monkeypatch, tmp_path) as bench:
        bench.set_time(1)
        before = bench.node._sessions

        def reset_in(phase):
            bench.states.publish(
                M.TurntableState(plan='twelve_position', phase=int(phase), seconds_left=9.0)
            )
            assert bench.until(lambda: bench.node._turntable.phase == phase)
            return bench.node._on_reset(None, ros.Trigger.Response())

        refused = reset_in(Phase.TURNING)
        assert not refused.success
        assert 'The plan is running' in refused.message
        assert bench.node._sessions is before
        agreed = reset_in(Phase.PAUSED)
        assert agreed.success
        assert 'abort it to run all steps' in agreed.message
        assert reset_in(Phase.ABORTED).success
        # A session that is over lacks nothing more.
        bench.node._sessions.all[0].fail('Two publishers.')
        assert reset_in(Phase.DWELLING).success
        # Nor does it depend on the last word of a node that is gone.
        assert not reset_in(Phase.DWELLING).success
        bench.peer.destroy_publisher(bench.states)
        assert bench.until(lambda: bench.node._on_reset(None, ros.Trigger.Response()).success)


def test_without_a_result_saving_says_that_nothing_is_written(monkeypatch, tmp_path):
    with Bench(monkeypatch, tmp_path) as bench:
        answer = bench.node._on_save(None, ros.Trigger.Response())
        assert not answer.success
        assert answer.message.startswith('Nothing is written: there is no result yet.')
        assert not (tmp_path / 'calibration.yaml').exists()
