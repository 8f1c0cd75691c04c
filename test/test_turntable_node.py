"""turntable_node against a simulated table as a second node, on the wire."""

import os
import signal
import time

import numpy as np
import pytest
from loopback import environment, start, until

from imu_calib.cdr import Messages, decode_setpoints, encode_joints
from imu_calib.errors import ImuCalibError, InputError
from imu_calib.nodes import qos
from imu_calib.simulation.options import TableOptions
from imu_calib.simulation.table import SimulatedTable
from imu_calib.stream import JointBlock, Mode
from imu_calib.turntable import load_table

# ROS reads this when it loads its messages.
os.environ.setdefault('ROS_PYTHON_CHECK_FIELDS', '1')
try:
    from imu_calib import middleware as ros
    from imu_calib.nodes.turntable_node import TurntableNode
    from imu_calib.sequencing import Phase
except ImuCalibError as error:
    pytest.skip(str(error), allow_module_level=True)

STEADY = ros.Clock(clock_type=ros.ClockType.STEADY_TIME)
TABLE = """
name: nimble
joints:
  - {name: outer, axis: z, limits: continuous, max_rate: 2000 deg/s, max_acceleration: 9000 deg/s^2}
  - {name: middle, axis: x, limits: continuous, max_rate: 900 deg/s, max_acceleration: 9000 deg/s^2}
  - {name: inner, axis: z, limits: continuous, max_rate: 900 deg/s, max_acceleration: 9000 deg/s^2}
mount: [x, y, z]
"""
PLAN = """
name: tiny
title: One turn and one dwell
source: here
method: twelve_position
dwell: 0.2 s
rate_test: {rates: [720 deg/s], turns: 1}
positions:
  - {id: first, axes: [E, N, U], rate_test: true}
  - {id: second, axes: [W, S, U]}
"""


class FakeTable(ros.Node):
    """The simulated table on ROS's wire, at 100 Hz of the wall clock."""

    def __init__(self, table):
        super().__init__('table')
        self.epoch = time.time_ns()
        self.table = SimulatedTable(load_table(table), TableOptions(), epoch=self.epoch)
        self.silent = self.still = False
        self.refusals, self.setpoints = [], []
        self.create_subscription(
            ros.messages.TurntableSetpoint, 'turntable/setpoint', self.take, qos.command(), raw=True
        )
        self.joints = self.create_publisher(
            ros.messages.JointState, 'turntable/joint_states', qos.stream()
        )
        self.create_timer(0.01, self.tick, clock=STEADY)

    def now(self):
        return (time.time_ns() - self.epoch) * 1e-9

    def take(self, payload):
        (block,) = decode_setpoints(Messages.join([bytes(payload)]))
        self.setpoints += block.setpoints
        try:
            self.table.command(block.setpoints[0], self.now())
        except InputError as error:
            self.refusals.append(str(error))

    def tick(self):
        if self.silent:
            return
        now = self.now()
        angles, rates = self.table.read(np.array([now]))
        stamp = np.array([self.epoch + round(now * 1e9)])
        block = JointBlock(stamp, self.table.table.names, angles, rates)
        for payload in encode_joints(block).payloads():
            self.joints.publish(payload)

    def at_rest(self):
        return self.table.advance(self.now()).at_rest


class Watcher(ros.Node):
    """A person at the stand: sees the state, presses buttons, may play the calibrator."""

    def __init__(self):
        super().__init__('watcher')
        self.states, self.trajectories, self.diagnostics = [], [], []
        kinds = ros.messages
        self.create_subscription(
            kinds.TurntableState, 'turntable/state', self.states.append, qos.latched()
        )
        self.create_subscription(
            kinds.JointTrajectory,
            'joint_trajectory_controller/joint_trajectory',
            self.trajectories.append,
            10,
        )
        self.create_subscription(kinds.DiagnosticArray, '/diagnostics', self.diagnostics.append, 10)
        self.estop = self.create_publisher(kinds.Bool, 'estop', 10)
        self.progress = self.create_publisher(
            kinds.CalibrationProgress, 'calibration/progress', qos.latched()
        )
        self.buttons = {
            name: self.create_client(ros.Trigger, f'/turntable_node/{name}')
            for name in ('start', 'pause', 'abort')
        }

    @property
    def phase(self):
        return Phase(self.states[-1].phase) if self.states else None

    def calibrate(self, repeat_steps=()):
        message = ros.messages.CalibrationProgress(repeat_steps=list(repeat_steps))
        message.header.stamp = ros.Time(nanoseconds=time.time_ns()).to_msg()
        self.progress.publish(message)


class Session:
    def __init__(self, folder):
        (folder / 'table.yaml').write_text(TABLE)
        (folder / 'plan.yaml').write_text(PLAN)
        self.parameters = {
            'plan': str(folder / 'plan.yaml'),
            'table': str(folder / 'table.yaml'),
            'settle': 0.1,
            'supervised': False,
        }
        self.executor = ros.SingleThreadedExecutor()
        self.node = None

    def arguments(self, **changes):
        pairs = {**self.parameters, **changes}
        words = [f'{k}:={str(v).lower() if isinstance(v, bool) else v}' for k, v in pairs.items()]
        return ['--ros-args', *(w for word in words for w in ('-p', word))]

    def open(self, *, with_node=True, **changes):
        ros.init(args=self.arguments(**changes))
        self.table = FakeTable(self.parameters['table'])
        self.watcher = Watcher()
        nodes = [self.table, self.watcher]
        if with_node:
            self.node = TurntableNode()
            nodes.append(self.node)
        for node in nodes:
            self.executor.add_node(node)
        return self

    def until(self, condition, seconds=10.0):
        return until(condition, seconds, lambda: self.executor.spin_once(timeout_sec=0.05))

    def press(self, name):
        client = self.watcher.buttons[name]
        assert self.until(client.service_is_ready)
        future = client.call_async(ros.Trigger.Request())
        assert self.until(future.done)
        return future.result().success, future.result().message

    def reaches(self, phase, seconds=10.0):
        assert self.until(lambda: self.watcher.phase is phase, seconds), self.watcher.states[-1:]

    def ends_stopped(self):
        return self.until(lambda: self.table.at_rest(), 3.0)


@pytest.fixture
def session(tmp_path, monkeypatch):
    for name, value in environment().items():
        monkeypatch.setenv(name, value)
    session = Session(tmp_path)
    yield session
    ros.try_shutdown()


def test_a_session_starts_by_itself_and_ends_with_the_table_at_rest_where_it_began(session):
    session.open(autostart=True)
    session.reaches(Phase.DONE)
    assert session.table.refusals == []
    assert session.ends_stopped()
    assert max(abs(session.watcher.states[-1].positions[k]) for k in range(3)) < 1e-4
    phases = {Phase(s.phase) for s in session.watcher.states}
    assert {Phase.MOVING, Phase.TURNING, Phase.SETTLING, Phase.DWELLING} <= phases
