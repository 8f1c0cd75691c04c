"""A running stand for the tests: real processes, simulated hardware, and ears on the loopback."""

import os
import signal
import time
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import yaml
from loopback import patience, until

from imu_calib.api.calibrate import calibrate
from imu_calib.calibration.calibration import Calibration
from imu_calib.cli import dispatch, stand_session
from imu_calib.cli.processes import Embedded, Processes, private_network
from imu_calib.common.files import named_file
from imu_calib.live import middleware as ros
from imu_calib.live.middleware import messages
from imu_calib.live.nodes import qos
from imu_calib.model.parameters import PARAMETER_NAMES
from imu_calib.recordings.rosbag2 import open_recording

NODES = ('stand_node', 'imu_node', 'calibrator_node', 'turntable_node')
EMBEDDED = ros.RUNTIME != 'rclpy'
"""Of a stand whose test is not about processes: a process that speaks through rclpy embeds none."""
LIMIT = 4.5
# What publishes with keep-all waits for a subscription that was killed until its lease ends: 10 s
# with Cyclone DDS, 20 s with Fast DDS.
LEASE = 20.0
State = messages.TurntableState
MOVES = (State.MOVING, State.TURNING)
Progress = messages.CalibrationProgress


def short_plan(folder, dwell=3.0, rates=(240, -240), name='twelve_position'):
    """Write the positions of a plan with short dwells and one rate as a plan of its own."""
    plan = yaml.safe_load(named_file('plans', name).read_text())
    plan['name'] = 'short'
    plan['dwell'] = f'{dwell} s'
    plan['rate_test']['rates'] = [f'{rate} deg/s' for rate in rates]
    path = folder / 'short.yaml'
    path.write_text(yaml.safe_dump(plan))
    return path


def same_middleware():
    """Return what makes a process speak as this one does, whatever was loaded here first."""
    if ros.RUNTIME == 'dds':
        return {}
    from rclpy.utilities import get_rmw_implementation_identifier

    return {'RMW_IMPLEMENTATION': get_rmw_implementation_identifier()}


class Stand:
    """The nodes of `imu-calib stand`, one by one, and what they say."""

    def __init__(self, folder, *options, plan=None, nodes=NODES, embedded=False, **changed):
        """Start nodes, as processes of their own or all in this process."""
        self.folder = folder / 'stand'
        words = ['stand', str(plan or short_plan(folder)), '-o', str(self.folder), *options]
        arguments = dispatch.build_parser().parse_args(
            words if embedded else [*words, '--processes']
        )
        self.parameters = stand_session.parameters(arguments, self.folder)
        for name, more in changed.items():
            self.parameters[name] |= more
        self.folder.mkdir()
        self.embedded = embedded
        self._environ = dict(os.environ)
        if embedded:
            self.environment = {}
            self.processes = Embedded(self.folder, in_step=not arguments.speed)
        else:
            self.environment = {**private_network(), **same_middleware()}
            self.processes = Processes(self.folder, self.environment)
        self.states, self.progress, self.calibrations, self.words = [], [], [], []
        self.setpoints = []
        self.joints = None
        self.node = self.processes.join('listener')
        listen = self.node.create_subscription
        listen(State, 'turntable/state', self.states.append, qos.latched(100))
        listen(Progress, 'calibration/progress', self.progress.append, qos.latched(100))
        listen(messages.ImuCalibration, 'calibration', self.calibrations.append, qos.results())
        listen(messages.DiagnosticArray, '/diagnostics', self._on_words, 100)
        listen(messages.TurntableSetpoint, 'turntable/setpoint', self.setpoints.append, 1)
        listen(messages.JointState, 'turntable/joint_states', self._on_joints, 1)
        self._faults = self.node.create_publisher(messages.String, 'stand_node/fault', 10)
        self._estop = self.node.create_publisher(messages.Bool, 'estop', 10)
        for name in nodes:
            self.start(name)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.processes.end_all_but(())
        self.processes.leave(self.node)
        self.processes.__exit__(None, None, None)
        os.environ.clear()
        os.environ.update(self._environ)

    def start(self, name):
        if name == 'stand_node':
            self.joints = None
        self.processes.start(name, self.parameters[name])

    def kill(self, name, number=signal.SIGKILL):
        self.processes.kill(name, number)

    def end(self, name):
        self.processes.end_all_but({one for one in self.processes.names if one != name})

    def fault(self, text):
        log = self.folder / 'nodes' / 'stand_node.log'
        before = log.read_text().count('fault:')

        def ordered():
            # A publisher that sees its subscription may be seen by it only a moment later.
            if self._faults.get_subscription_count():
                self._faults.publish(messages.String(data=text))
            return self.wait(lambda: log.read_text().count('fault:') > before, 0.5)

        assert self.wait(ordered), log.read_text()

    def estop(self, *, pressed):
        assert self.wait(lambda: self._estop.get_subscription_count() > 0)
        self._estop.publish(messages.Bool(data=pressed))

    def call(self, service):
        """Call a Trigger service; return (success, message)."""
        client = self.node.create_client(ros.Trigger, service)
        assert client.wait_for_service(timeout_sec=patience())
        while True:
            future = client.call_async(ros.Trigger.Request())
            assert self.wait(future.done), f'{service} does not answer'
            # A busy machine holds the node up, too.
            if 'did not run for a while' not in future.result().message:
                break
        self.node.destroy_client(client)
        return future.result().success, future.result().message

    def wait(self, condition, seconds=None, pause=0.02):
        """Listen until a condition holds, see `until`; it is asked once in `pause` seconds.

        A stand that runs at a multiple of real time sends thousands of messages a second: each by
        itself would keep a processor busy that the nodes need.
        """

        def listen():
            if isinstance(self.processes, Embedded):
                self.processes.spin(self.node, pause)
                return
            time.sleep(pause)
            # Of rclpy one callback runs at a time.
            for _ in range(1 if ros.RUNTIME == 'dds' else 20):
                ros.spin_once(self.node, timeout_sec=0)

        return until(condition, seconds, listen)

    @property
    def state(self):
        return self.states[-1] if self.states else State()

    def reaches(self, *phases, step=None, seconds=60.0, since=None):
        """Wait until the table's leader is in one of the phases, at a step or beyond.

        A phase that comes and goes between two looks counts: a turn takes less than a busy machine
        may need to look again. So does one that came since so many states, where they are given.
        """
        newest = max(0, len(self.states) - 1) if since is None else since

        def been():
            return any(
                state.phase in phases and (step is None or state.step >= step)
                for state in self.states[newest:]
            )

        return self.wait(been, patience(seconds))

    def table_stands(self, seconds=15.0):
        """Whether the table itself, by its encoders, comes to rest and stays there for a second."""
        since = None

        def stands():
            nonlocal since
            now = self.joints
            if now is None or np.any(now.velocity):
                since = None
            elif since is None or not np.array_equal(since.position, now.position):
                since = now
            return since is not None and _seconds(now) > _seconds(since) + 1.0

        return self.wait(stands, patience(seconds))

    def has_status(self, *words):
        """Whether one sentence on /diagnostics held all of the words."""
        return any(all(word in text for word in words) for text in self.words)

    def ended(self, seconds=90.0):
        """Wait for the final word of the calibrator; return its message."""
        kinds = messages.ImuCalibration
        final = {kinds.VALID, kinds.REFUSED, kinds.INCOMPLETE}
        assert self.wait(
            lambda: any(c.status in final for c in self.calibrations), patience(seconds)
        ), (
            self.state,
            self.progress[-1:],
            self.words[-5:],
        )
        return next(c for c in self.calibrations if c.status in final)

    def check_numbers(self):
        """Hold every number that was ever published against the truth.

        They are by the table's clock, however fast the device's runs.
        """
        truth = Calibration.load(named_file('truths', 'cao2022_table1')).model.vector()
        for message in self.calibrations:
            if message.status != messages.ImuCalibration.REFUSED:
                # One session in a thousand shows a term by chance (estimation/search.CHANCE): the
                # numbers beside it hold all the same.
                std = dict(zip(message.parameter_names, message.standard_deviations, strict=True))
                values = [getattr(message, name.lower()) for name in PARAMETER_NAMES]
                error = np.abs(np.array(values) - truth) / [std[n] for n in PARAMETER_NAMES]
                assert error.max() < LIMIT, (message.status, error.round(1), message.status_text)

    def check_reprocessing(self):
        """Reprocess the journal, and find the live result in it, bit for bit."""
        assert self.wait((self.folder / 'calibration.yaml').exists)
        live = Calibration.load(self.folder / 'calibration.yaml')
        again = calibrate(self.folder / 'journal').calibration
        assert np.array_equal(again.model.vector(), live.model.vector())
        assert np.array_equal(again.covariance, live.covariance)
        return SimpleNamespace(live=live, again=again)

    def recorded_samples(self):
        with open_recording(self.folder / 'journal') as recording:
            return {topic.name: topic.count for topic in recording.topics}

    def _on_joints(self, message):
        self.joints = message

    def _on_words(self, message):
        self.words += [f'{s.name}: {s.message}' for s in message.status]


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
    assert stand.wait(lambda: stand.progress[-1].state == Progress.FINISHED)
    assert stand.reaches(State.DONE)
    assert stand.table_stands()
    return final


def resumes(stand, *, once_heard=False):
    """The table takes the interrupted step up again and gets beyond it; no number was wrong.

    The leader may hear later than this test that what held it up is gone: then it is asked again.
    """
    before, answers = stand.state.step, []

    def started():
        answers.append(stand.call('turntable_node/start'))
        return answers[-1][0]

    assert stand.wait(started) if once_heard else started(), answers
    assert stand.reaches(*MOVES, State.DWELLING, step=before + 1), stand.state
    stand.check_numbers()


def stops(stand, *words):
    """The table stands, by its own word, and it is said why."""
    assert stand.reaches(State.PAUSED, State.ABORTED, seconds=30), stand.state
    assert stand.table_stands(LEASE + 10.0)
    assert all(word in stand.state.reason for word in words), stand.state.reason
    assert stand.has_status(*words), stand.words[-5:]
    # It does not go on by itself.
    assert not stand.wait(lambda: stand.state.phase in MOVES, 1.0)


KINDS = {
    'turntable/setpoint': 'TurntableSetpoint',
    'turntable/joint_states': 'JointState',
    'turntable/state': 'TurntableState',
    'calibration/progress': 'CalibrationProgress',
    'estop': 'Bool',
}


@contextmanager
def stranger(stand, topic):
    """Let a node of another name publish on a topic of the stand."""
    node = stand.processes.join('stranger') if stand.embedded else ros.Node('stranger')
    try:
        yield node.create_publisher(getattr(messages, KINDS[topic]), topic, qos.latched())
    finally:
        if stand.embedded:
            stand.processes.leave(node)
        else:
            node.destroy_node()


def spoofed_done(stand):
    """Return DONE as the table's leader would say it, word for word."""
    steps = stand.state.steps
    done = State(plan='short', step=steps - 1, steps=steps, phase=State.DONE)
    done.header.stamp = stand.joints.header.stamp
    return done


def _seconds(message):
    return message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
