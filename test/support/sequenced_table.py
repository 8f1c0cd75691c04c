"""The sequencer and the simulated table, joined as by the node."""

from dataclasses import replace

import numpy as np

from imu_calib.common.errors import InputError
from imu_calib.common.stream import JointBlock, Setpoint
from imu_calib.common.units import DEG
from imu_calib.live.rules import Rules
from imu_calib.live.sequencer import Sequencer
from imu_calib.session.plan import RateTest, load_plan
from imu_calib.session.table import TURN, load_table
from imu_calib.simulation.options import TableOptions
from imu_calib.simulation.table import SimulatedTable

TABLE = load_table('three_axis')
ALONE = Rules(supervised=False)
EPOCH = 1_700_000_000_000_000_000
PERIOD = 0.01


def small_plan(dwell=2.0, rates=(60 * DEG, -60 * DEG)):
    """Two positions, the first with turns about the vertical."""
    plan = load_plan('twelve_position')
    first = replace(plan.position('9'), dwell=dwell, rate_test=RateTest(tuple(rates), 1))
    second = replace(plan.position('10'), dwell=dwell)
    return replace(plan, name='small', positions=(first, second))


class Stand:
    """The simulated table and the sequencer, joined as by the node: 100 Hz of joint states.

    `plant(time, angles, rates)` may bend what the sequencer sees; `link(setpoint)` may swallow a
    setpoint on its way to the table by returning None.
    """

    def __init__(self, plan=None, rules=ALONE, table=TABLE, start=None, block=5, **options):
        options = {'positioning_error': 0.0, **options}
        self.table = SimulatedTable(
            table, TableOptions(**options), np.random.default_rng(1), epoch=EPOCH, start=start
        )
        self.sequencer = Sequencer(plan or small_plan(), table, rules)
        self.time = 0.0
        self.block = block
        self.plant = lambda time, angles, rates: (angles, rates)
        self.link = lambda setpoint: setpoint
        self.jitter = lambda n: 0.0
        self.silent = False
        self.names = table.names
        self.columns = list(range(len(self.names)))
        self.sent = []
        self.phases = []
        self.refusals = []
        self.last_sent, self.sent_at = -1, -1.0

    def tick(self):
        times = self.time + PERIOD * np.arange(1, self.block + 1)
        self.time = float(times[-1])
        angles, rates = self.table.read(times)
        angles, rates = self.plant(times, angles.copy(), rates.copy())
        stamps = EPOCH + np.rint((times + self.jitter(len(times))) * 1e9).astype(np.int64)
        if not self.silent:
            block = JointBlock(stamps, self.names, angles[:, self.columns], rates[:, self.columns])
            self.sequencer.add_joint_states(block)
        revision = self.sequencer.revision
        if revision != self.last_sent or self.time - self.sent_at >= 0.1 - 1e-9:
            self.send()
        state = self.sequencer.state()
        if not self.phases or self.phases[-1] != (state.step, state.phase):
            self.phases.append((state.step, state.phase))
        return state

    def send(self):
        self.last_sent, self.sent_at = self.sequencer.revision, self.time
        setpoint = self.sequencer.setpoint(EPOCH + round(self.time * 1e9))
        if setpoint is None:
            return
        assert_within_limits(self.table.table, setpoint)
        self.sent.append(setpoint)
        setpoint = self.link(setpoint)
        if setpoint is not None:
            try:
                self.table.command(setpoint, self.time)
            except InputError as error:
                self.refusals.append(str(error))

    def run(self, until, seconds=200.0):
        """Tick until a condition on the state holds; return the state."""
        end = self.time + seconds
        while True:
            state = self.tick()
            if until(state):
                return state
            assert self.time < end, f'{state} {self.phases}'

    def phase(self, phase, seconds=200.0):
        return self.run(lambda state: state.phase is phase, seconds)

    def started(self):
        self.tick()
        self.sequencer.start()
        return self

    def stands(self, seconds=5.0):
        """Whether the table itself, left alone with what is sent, is at rest and stays."""
        end = self.time + seconds
        while self.time < end:
            self.tick()
        before = self.table.angles(np.array([self.time]))
        while self.time < end + 2.0:
            self.tick()
        assert self.table.advance(self.time).at_rest
        return bool(np.abs(self.table.angles(np.array([self.time])) - before).max() < 1e-9)


def assert_within_limits(table, setpoint):
    table.check(np.array(setpoint.angles), np.array(setpoint.rates), 'sent')
    for joint, rate in zip(table.joints, setpoint.rates, strict=True):
        assert rate**2 / joint.max_acceleration <= TURN * (1 + 1e-9)


def setpoint(mode, angles=(0.0, 0.0, 0.0), rates=(0.0, 0.0, 0.0), stamp=0, turns=1.0):
    return Setpoint(EPOCH + stamp, 'p', 0, '1', mode, TABLE.names, angles, rates, turns, 0.0)
