"""turntable_node with a simulated table and a person, on one executor or two processes."""

import math
import os
import time
from pathlib import Path

import numpy as np
import pytest
from loopback import isolate, start, until

from imu_calib.common.errors import InputError
from imu_calib.common.stream import JointBlock, Mode, Setpoint
from imu_calib.live import middleware as ros
from imu_calib.live.nodes import qos
from imu_calib.live.nodes.turntable_node import TurntableNode
from imu_calib.live.rules import Phase
from imu_calib.recordings.cdr import Messages
from imu_calib.recordings.cdr_codec import decode_setpoints, encode_joints
from imu_calib.session.table import load_table
from imu_calib.simulation.options import TableOptions
from imu_calib.simulation.table import SimulatedTable

NAMES = ('outer', 'middle', 'inner')
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
dwell: 0.05 s
rate_test: {rates: [RATE deg/s], turns: 1}
positions:
  - {id: first, axes: [E, N, U], rate_test: true}
  - {id: second, axes: [W, S, U]}
"""


# Where node and table share a thread, what holds up one holds up both.
PATIENT = {'feedback_timeout': 30.0, 'watchdog_timeout': 30.0}


class FakeTable(ros.Node):
    """The simulated table on ROS's wire, at 100 Hz of the wall clock."""

    def __init__(self, table):
        super().__init__('table')
        self.epoch = time.time_ns()
        self.table = SimulatedTable(load_table(table), TableOptions(), epoch=self.epoch)
        self.silent = self.deaf = False
        self.simulated = None
        self.refusals, self.setpoints, self.ticks = [], [], []
        self.create_subscription(
            ros.messages.TurntableSetpoint, 'turntable/setpoint', self.take, qos.command(), raw=True
        )
        self.joints = self.create_publisher(
            ros.messages.JointState, 'turntable/joint_states', qos.stream()
        )
        self.create_timer(0.01, self.tick, clock=STEADY)

    def run_ahead(self, factor):
        """Go on in simulated time, never further ahead of the setpoints than they may be old."""
        self.factor, self.simulated = factor, self.now()
        self.clock = self.create_publisher(ros.messages.Clock, '/clock', 10)

    def now(self):
        if self.simulated is not None:
            return self.simulated
        return (time.time_ns() - self.epoch) * 1e-9

    def stamp(self):
        return self.epoch + round(self.now() * 1e9)

    def take(self, payload):
        (block,) = decode_setpoints(Messages.join([bytes(payload)]))
        self.setpoints += block.setpoints
        if self.deaf:
            return
        try:
            self.table.command(block.setpoints[0], self.now())
        except InputError as error:
            self.refusals.append(str(error))

    def force(self, angles):
        """Set the table in motion as its own panel does: no setpoint is published."""
        still = (0.0,) * len(angles)
        order = Setpoint(self.stamp(), '', 0, '', Mode.POSITION, NAMES, angles, still, 0.0, 0.0)
        self.table.command(order, self.now())

    def turned(self, at):
        """How far the outer joint has gone from (k,) angles, rad."""
        return self.table.angles(np.array([self.now()]))[0][0] - at[0]

    def tick(self):
        self.ticks.append(time.monotonic())
        if self.silent:
            return
        times = np.array([self.now()])
        if self.simulated is not None:
            times = self.pass_time()
        angles, rates = self.table.read(times)
        stamps = self.epoch + np.rint(times * 1e9).astype(np.int64)
        block = JointBlock(stamps, self.table.table.names, angles, rates)
        for payload in encode_joints(block).payloads():
            self.joints.publish(payload)

    def pass_time(self):
        last = (self.setpoints[-1].stamp - self.epoch) * 1e-9 if self.setpoints else math.inf
        if self.simulated - last > 0.25:
            return np.empty(0)
        times = self.simulated + 0.01 * np.arange(1, self.factor + 1)
        if math.floor(times[-1] * 10) > math.floor(self.simulated * 10):
            message = ros.messages.Clock()
            told = ros.Time(nanoseconds=self.epoch + math.floor(times[-1] * 10) * 100_000_000)
            message.clock = told.to_msg()
            self.clock.publish(message)
        self.simulated = float(times[-1])
        return times

    def at_rest(self):
        return self.table.advance(self.now()).at_rest


class Watcher(ros.Node):
    """A person at the stand: sees the state, presses buttons, may play the calibrator."""

    def __init__(self):
        super().__init__('watcher')
        self.states, self.diagnostics = [], []
        kinds = ros.messages
        self.create_subscription(
            kinds.TurntableState, 'turntable/state', self.states.append, qos.latched(100)
        )
        self.create_subscription(kinds.DiagnosticArray, '/diagnostics', self.diagnostics.append, 10)
        self.estop = self.create_publisher(kinds.Bool, 'estop', 10)
        self.progress = self.create_publisher(
            kinds.CalibrationProgress, 'calibration/progress', qos.latched()
        )
        self.buttons = {
            name: self.create_client(ros.Trigger, f'/turntable_node/{name}')
            for name in ('start', 'release', 'pause', 'abort')
        }

    @property
    def phase(self):
        return Phase(self.states[-1].phase) if self.states else None

    def has_report(self, part, level, words):
        """Whether the last word on a part of the node has a level and some words."""
        statuses = [
            s for d in self.diagnostics for s in d.status if s.name.endswith(f'node: {part}')
        ]
        return bool(statuses) and statuses[-1].level[0] == level and words in statuses[-1].message

    def phases(self):
        """The phases, one after the other."""
        phases = [Phase(s.phase) for s in self.states]
        return [p for k, p in enumerate(phases) if k == 0 or p is not phases[k - 1]]

    def calibrate(self, stamp, repeat_steps=(), plan='tiny'):
        steps = list(repeat_steps)
        message = ros.messages.CalibrationProgress(plan=plan, state=1, repeat_steps=steps)
        message.header.stamp = ros.Time(nanoseconds=stamp).to_msg()
        self.progress.publish(message)


MAIN = (
    'import sys\nfrom imu_calib.live.nodes.programs import turntable_node\n'
    'sys.exit(turntable_node())'
)


class Session:
    """Table, person and node on one executor, or the node in a process of its own."""

    def __init__(self, folder):
        self.folder = folder
        (folder / 'table.yaml').write_text(TABLE)
        self.turn_at(1440)
        self.parameters = {
            'plan': str(folder / 'plan.yaml'),
            'table': str(folder / 'table.yaml'),
            'settle': 0.02,
            'supervised': False,
        }
        self.node = None
        self.processes = []

    def turn_at(self, rate):
        (self.folder / 'plan.yaml').write_text(PLAN.replace('RATE', str(rate)))
        return self

    def arguments(self, **changes):
        pairs = {**self.parameters, **changes}
        words = [f'{k}:={str(v).lower() if isinstance(v, bool) else v}' for k, v in pairs.items()]
        return ['--ros-args', *(w for word in words for w in ('-p', word))]

    def open(self, *, with_node=True, **changes):
        ros.init(args=self.arguments(**changes))
        self.executor = ros.SingleThreadedExecutor()
        self.table = FakeTable(self.parameters['table'])
        self.watcher = Watcher()
        for node in (self.table, self.watcher):
            self.executor.add_node(node)
        if with_node:
            self.join()
        return self

    def turning(self, rate=90):
        """Open with a plan that starts by itself and turns at a rate, deg/s; wait for its turn."""
        self.turn_at(rate).open(autostart=True, **PATIENT)
        self.reaches(Phase.TURNING)

    def join(self):
        """Let the node join those who are there already."""
        self.node = TurntableNode()
        self.executor.add_node(self.node)

    def start(self, code=MAIN, **changes):
        """Start the node as a process, which ends with the test at the latest."""
        process = start(code, *self.arguments(**changes))
        self.processes.append(process)
        return process

    def stop_file(self):
        return (
            Path(os.environ['XDG_STATE_HOME'])
            / 'imu_calib'
            / (f'stop_domain_{os.environ["ROS_DOMAIN_ID"]}_turntable_node')
        )

    def until(self, condition, seconds=None):
        return until(condition, seconds, lambda: self.executor.spin_once(timeout_sec=0.05))

    def press(self, name):
        client = self.watcher.buttons[name]
        assert self.until(client.service_is_ready)
        while True:
            future = client.call_async(ros.Trigger.Request())
            assert self.until(future.done)
            # A busy machine holds the node up, too.
            if 'did not run for a while' not in future.result().message:
                return future.result().success, future.result().message

    def reaches(self, phase, seconds=None):
        assert self.until(lambda: self.watcher.phase is phase, seconds), (
            self.watcher.phases(),
            [state.reason for state in self.watcher.states[-1:]],
        )

    def turns(self):
        """Wait for a turn where the node waits for less than a busy machine may hold it up.

        That holds up this process, and table and node with it: the node pauses then, and is started
        again.
        """

        def turning():
            if self.watcher.phase is Phase.PAUSED:
                self.press('start')
            return self.watcher.phase is Phase.TURNING

        assert self.until(turning), self.watcher.phases()

    def ends_stopped(self):
        """Whether the table itself comes to rest, and stays there."""
        return self.until(self.table.at_rest) and not self.until(
            lambda: not self.table.at_rest(), 0.3
        )

    def process(self, code=MAIN, **changes):
        """Start the node as a process; return it when it drives the table through a turn."""
        self.open(with_node=False)
        # On a busy machine the table of this process may be held up for longer than a node waits.
        process = self.start(code, **{'autostart': True, **PATIENT, **changes})
        assert self.until(lambda: self.watcher.phase is Phase.TURNING), process.poll()
        assert self.until(lambda: not self.table.at_rest())
        return process


@pytest.fixture
def session(tmp_path, monkeypatch):
    isolate(monkeypatch)
    session = Session(tmp_path)
    yield session
    for process in session.processes:
        process.kill()
        process.communicate()
    ros.try_shutdown()
