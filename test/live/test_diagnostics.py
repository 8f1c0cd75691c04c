"""What the nodes say on /diagnostics: its form, its documentation, and the groups of a monitor."""

import ast

import pytest
import yaml
from loopback import CHECKOUT, isolate, until

from imu_calib.cli.processes import free_port
from imu_calib.live import middleware as ros
from imu_calib.live.nodes import stand_node
from imu_calib.live.nodes.calibrator_node import CalibratorNode
from imu_calib.live.nodes.diagnostics import Diagnostics
from imu_calib.live.nodes.stand_node import StandNode
from imu_calib.live.nodes.turntable_node import TurntableNode
from imu_calib.live.rules import Severity
from imu_calib.simulation.hardware import SimulatedHardware

HEALTH = CHECKOUT / 'imu_calib' / 'live' / 'devices' / 'health.py'


def first_texts(path, name, at=0):
    """Return the texts that stand as an argument in all calls of a function or method."""
    calls = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)]
    named = [c for c in calls if getattr(c.func, 'attr', getattr(c.func, 'id', '')) == name]
    values = [c.args[at].value for c in named if c.args and isinstance(c.args[at], ast.Constant)]
    return {value for value in values if isinstance(value, str)}


def reported(path):
    """Return the parts that a source reports, or judges."""
    return first_texts(path, 'report') | first_texts(path, 'report_fault')


def spoken():
    """Return node and part of everything that the sources report."""
    words = CHECKOUT / 'imu_calib' / 'live' / 'nodes' / 'session_reports.py'
    parts = {('calibrator_node', part) for part in reported(words)}
    for taken in ('run_action.py', 'diagnostics.py'):
        told = reported(words.with_name(taken))
        parts |= {('turntable_node', part) for part in told}
    for path in (CHECKOUT / 'imu_calib' / 'live' / 'nodes').glob('*_node.py'):
        parts |= {(path.stem, part) for part in reported(path)}
        if 'FollowedSetpoints(' in path.read_text():
            taken = path.with_name('stop.py')
            parts |= {(path.stem, part) for part in reported(taken)}
    return parts | {('imu_node', part) for part in first_texts(HEALTH, 'PartStatus')}


def test_the_documentation_names_every_part_of_every_node():
    lines = (CHECKOUT / 'docs' / 'diagnostics.md').read_text().splitlines()
    rows = [[cell.strip() for cell in line.strip('|').split('|')] for line in lines]
    assert {(row[0], row[1]) for row in rows if row[0].endswith('_node')} == spoken()


def test_the_aggregator_puts_every_part_into_one_group():
    text = (CHECKOUT / 'config' / 'nodes' / 'diagnostics.yaml').read_text()
    groups = yaml.safe_load(text)['analyzers']['ros__parameters']
    assert groups.pop('path') == 'Calibration stand'
    for namespace in ('', 'lab/'):
        for node, part in spoken():
            name = f'{namespace}{node}: {part}'
            found = [g for g in groups if any(words in name for words in groups[g]['contains'])]
            assert len(found) == 1, (name, found)


@pytest.fixture
def wire(monkeypatch, tmp_path):
    isolate(monkeypatch)
    monkeypatch.chdir(tmp_path)
    heard = {}

    class Monitor(ros.Node):
        def __init__(self):
            super().__init__('monitor')
            kind = ros.messages.DiagnosticArray
            self.create_subscription(kind, '/diagnostics', self.hear, 100)

        def hear(self, message):
            for status in message.status:
                heard.setdefault(status.name, []).append(status)

    def open_wire(*makers, **parameters):
        words = [w for k, v in parameters.items() for w in ('-p', f'{k}:={v}')]
        ros.init(args=['--ros-args', '-r', '__ns:=/lab', *words])
        executor = ros.SingleThreadedExecutor()
        made = [Monitor(), *(make() for make in makers)]
        for node in made:
            executor.add_node(node)
        opened.extend(made[1:])
        return heard, lambda until_true, seconds=None: until(
            until_true, seconds, lambda: executor.spin_once(timeout_sec=0.05)
        )

    opened = []
    yield open_wire
    for node in opened:
        if hasattr(node, 'stop'):
            node.stop()
        node.destroy_node()
    ros.try_shutdown()


def test_every_status_is_a_sentence_with_figures_about_something(wire):
    port = free_port()
    heard, spin = wire(StandNode, CalibratorNode, port=port, latitude=34.65)
    expected = {
        'lab/stand_node: table', 'lab/stand_node: IMU', 'lab/calibrator_node: calibration',
        'lab/calibrator_node: stream', 'lab/calibrator_node: joint states',
        'lab/calibrator_node: journal',
    }  # fmt: skip
    assert spin(lambda: expected <= set(heard))
    assert spin(lambda: heard['lab/calibrator_node: joint states'][-1].level == b'\x00')
    assert {status.hardware_id for status in heard['lab/stand_node: IMU']} == {'simulated stand'}
    for statuses in heard.values():
        for status in statuses:
            assert status.level[0] in set(Severity)
            assert status.message.endswith('.')
            assert not status.message[0].islower()
            assert status.hardware_id
            assert all(value.key and value.value for value in status.values)
    figures = {v.key: v.value for v in heard['lab/calibrator_node: joint states'][-1].values}
    assert int(figures['samples']) > 0


def test_the_table_says_where_it_is_and_what_it_does(wire):
    heard, spin = wire(TurntableNode, StandNode, port=free_port(), supervised='false')
    name = 'lab/turntable_node: plan'
    assert spin(lambda: name in heard and len(heard[name][-1].values) > 5)
    figures = {v.key: v.value for v in heard[name][-1].values}
    assert figures['phase'] == 'IDLE'
    assert figures['joint middle'] == '0.0000 deg, 0.000 deg/s'
    assert heard[name][-1].message == 'Nothing is started.'
    assert heard[name][-1].hardware_id == 'three_axis'


def test_a_table_that_rests_and_is_led_lives_in_longer_steps(wire, monkeypatch):
    advance, steps, made = SimulatedHardware.advance, [], []

    def noted(self, seconds):
        steps.append(seconds)
        return advance(self, seconds)

    monkeypatch.setattr(SimulatedHardware, 'advance', noted)
    _, spin = wire(lambda: made.append(StandNode()) or made[0], port=free_port())
    pace = made[0]._pace
    assert spin(lambda: len(steps) > 2)
    assert set(steps) == {0.1}
    # Setpoints come; then the table is held.
    assert spin(lambda: pace.record_setpoint(0.0) or steps[-1] == 0.2)
    pace.use_wall_clock()
    assert spin(lambda: steps[-1] == 0.1)


@pytest.mark.parametrize(('speed', 'held'), [(0.0, 1.0), (0.5, 0.5), (1.0, 1.0), (30.0, 1.0)])
def test_a_table_that_is_held_keeps_to_the_wall_clock(monkeypatch, speed, held):
    wall = [1000.0]
    monkeypatch.setattr(stand_node.time, 'monotonic', lambda: wall[0])
    pace, now = stand_node._Pace(speed), 0.0
    # A step led, and then the table is held.
    pace.record_setpoint(now)
    assert pace.rest(now, connected=True) == 0.0
    pace.use_wall_clock()
    while wall[0] < 1010.0:
        rest = pace.rest(now, connected=True)
        now, wall[0] = (now, wall[0] + rest) if rest else (now + 0.1, wall[0])
    # To within a step.
    assert now == pytest.approx(10.0 * held, abs=0.2)


def test_a_node_speaks_every_second_and_at_once_when_it_gets_worse(wire):
    heard, spin = wire(lambda: ros.Node('speaker'))
    assert heard == {}
    node = ros.Node('talker')
    diagnostics = Diagnostics(node, 'thing')
    diagnostics.report('part', Severity.OK, 'It works', mass='2 kg')
    assert spin(lambda: diagnostics.publisher.get_subscription_count() == 1)
    diagnostics.publish()
    assert spin(lambda: 'lab/talker: part' in heard)
    # Whatever a busy machine takes: the word that comes once a second is not waited for.
    diagnostics._timer.cancel()
    diagnostics.report('part', Severity.ERROR, 'It is broken.', mass='0 kg')
    assert spin(lambda: heard['lab/talker: part'][-1].message == 'It is broken.')
    assert heard['lab/talker: part'][0].message == 'It works.'
    assert [(v.key, v.value) for v in heard['lab/talker: part'][-1].values] == [('mass', '0 kg')]
    node.destroy_node()
