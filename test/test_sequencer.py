"""The sequencer leads the simulated table: whatever goes wrong, the table stands at the end."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sessions import quick_plan

from imu_calib.errors import InputError
from imu_calib.plan import Plan, Position, RateTest, load_plan
from imu_calib.profile import moving
from imu_calib.sequencing import Lead, Overtaken, Phase, Rules, Sequencer
from imu_calib.simulation.options import TableOptions
from imu_calib.simulation.table import SimulatedTable
from imu_calib.stream import JointBlock, Mode
from imu_calib.turntable import TURN, load_table
from imu_calib.units import DEG

TABLE = load_table('three_axis')
ALONE = Rules(supervised=False)
EPOCH = 1_700_000_000_000_000_000
PERIOD = 0.01
Z_UP = np.eye(3)
X_UP = np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]]).T[[1, 2, 0]].T


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

    def __init__(self, plan=None, rules=ALONE, table=TABLE, start=None, block=1, **options):
        options = {'positioning_error': 0.0, **options}
        self.table = SimulatedTable(
            table, TableOptions(**options), np.random.default_rng(1), epoch=EPOCH, start=start
        )
        self.sequencer = Sequencer(plan or small_plan(), table, rules)
        self.time = 0.0
        self.block = block
        self.plant = lambda time, angles, rates: (angles, rates)
        self.link = lambda setpoint: setpoint
        self.silent = False
        self.names = table.names
        self.columns = list(range(len(self.names)))
        self.sent = []
        self.phases = []
        self.refusals = []
        self.last_sent = -1.0

    def tick(self):
        times = self.time + PERIOD * np.arange(1, self.block + 1)
        self.time = float(times[-1])
        angles, rates = self.table.read(times)
        angles, rates = self.plant(times, angles.copy(), rates.copy())
        stamps = EPOCH + np.rint(times * 1e9).astype(np.int64)
        if not self.silent:
            block = JointBlock(stamps, self.names, angles[:, self.columns], rates[:, self.columns])
            self.sequencer.take(block)
        revision = self.sequencer.revision
        if revision != self.last_sent or self.time - self.sent_at >= 0.1 - 1e-9:
            self.send()
        state = self.sequencer.state()
        if not self.phases or self.phases[-1] != (state.step, state.phase):
            self.phases.append((state.step, state.phase))
        return state

    sent_at = -1.0

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


def test_a_plan_runs_to_its_end_and_the_table_goes_back_to_where_it_began():
    start = np.array([20.0, 5.0, -30.0]) * DEG
    stand = Stand(start=start).started()
    state = stand.phase(Phase.DONE)
    assert stand.refusals == []
    assert stand.stands()
    assert np.abs(np.array(state.angles) - start).max() < 0.01 * DEG
    modes = [s.mode for s in stand.sent if s.mode is not Mode.HOLD]
    assert modes.count(Mode.RATE) > 0
    told = [p for _, p in stand.phases]
    assert told[0] is Phase.IDLE
    assert [p for p in told if p is Phase.TURNING] == [Phase.TURNING] * 2
    assert [p for p in told if p is Phase.DWELLING].count(Phase.DWELLING) >= 2
