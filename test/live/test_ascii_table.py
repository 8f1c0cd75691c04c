"""ascii_table_node against a scripted controller on a socket, and its rules without one."""

import contextlib
import itertools
import math
import os
import select
import signal
import socket
import sys
import threading
import time
from dataclasses import replace

import numpy as np
import processes
import pytest
from ascii_controller import Controller, Servo
from extent import again
from loopback import isolate, patience, start, until
from turntable_bench import PLAN
from turntable_bench import TABLE as NIMBLE

from imu_calib.common.errors import InputError
from imu_calib.common.stream import Mode, Setpoint, SetpointBlock
from imu_calib.live import middleware as ros
from imu_calib.live import table_line
from imu_calib.live.nodes import qos, stop
from imu_calib.live.nodes.ascii_table_node import AsciiTableNode
from imu_calib.live.nodes.turntable_node import TurntableNode
from imu_calib.live.table_line import ControllerLine, Follower, Move, Reading, Stop
from imu_calib.recordings.cdr import Messages
from imu_calib.recordings.cdr_codec import decode_joints, encode_setpoints
from imu_calib.session.table import load_table

NS = 1_000_000_000
DEG = math.pi / 180
TABLE = load_table('three_axis')
REST = Reading(np.zeros(3), np.zeros(3))
STEADY = ros.Clock(clock_type=ros.ClockType.STEADY_TIME)


def setpoint(step=0, mode=Mode.POSITION, angles=(0.0, 90.0, 0.0), rates=(), turns=0.0, stamp=0):
    radians = tuple(DEG * a for a in angles), tuple(DEG * r for r in rates)
    return Setpoint(stamp, 'plan', step, '1', mode, TABLE.names, *radians, turns, 0.0)


def turn(step=1, angles=(0, 0, 0)):
    return setpoint(step, Mode.RATE, angles, (0, 0, -20), 2.0)


# --- the rules ---------------------------------------------------------------------------------


@pytest.fixture
def follower():
    return Follower(TABLE, timeout=0.5, age=0.5)


def test_a_position_moves_every_axis_once_at_its_greatest_rate(follower):
    orders = follower.command(setpoint(), 0, 0.0, REST)
    assert orders[1] == Move(1, pytest.approx(90 * DEG), pytest.approx(200 * DEG))
    assert follower.command(setpoint(), 0, 0.1, REST) == ()
    assert follower.command(setpoint(step=1), 0, 0.2, REST) != ()


def test_a_turn_has_one_turn_more_to_start_and_stop_in(follower):
    orders = follower.command(turn(), 0, 0.0, REST)
    assert orders[2] == Move(2, pytest.approx(-3 * 360 * DEG), pytest.approx(20 * DEG))
    assert orders[0].angle == 0


@pytest.mark.parametrize(
    ('off', 'starts'), [(0.4, True), (-0.4, True), (0.6, False), (-0.6, False)]
)
def test_a_turn_starts_within_half_a_degree_of_its_angles(follower, off, starts):
    for axis in range(3):
        beside = Reading(off * DEG * np.eye(3)[axis], np.zeros(3))
        assert bool(follower.command(turn(step=axis), 0, 0.0, beside)) is starts
        assert ('stands at its angles' in follower.refusal) is not starts


def test_a_stale_setpoint_moves_nothing_and_keeps_nothing_moving(follower):
    assert follower.command(setpoint(), 2 * NS, 0.0, REST) == ()
    assert follower.refusal == 'A setpoint is 2 s old (allowed: 0.5 s).'
    assert follower.command(setpoint(stamp=2 * NS), 2 * NS, 0.1, REST)
    assert follower.refusal == ''
    assert follower.command(setpoint(), 2 * NS, 0.5, REST) == ()
    assert follower.watch(0.7) == (Stop(),)


def test_without_setpoints_the_table_stops_once_and_then_only_a_position_is_resumed(follower):
    follower.command(setpoint(), 0, 0.0, REST)
    assert follower.watch(0.5) == ()
    assert follower.watch(0.51) == (Stop(),)
    assert follower.watch(0.6) == ()
    assert follower.command(setpoint(), 0, 1.0, REST) != ()
    follower.command(turn(), 0, 1.1, REST)
    assert follower.watch(1.7) == (Stop(),)
    assert follower.command(turn(), 0, 1.8, REST) == ()
    assert 'not resumed' in follower.refusal


@pytest.mark.parametrize('age', [9.53e7, -9.53e7, 2.0])
def test_hold_is_obeyed_however_old_its_stamp_is(follower, age):
    now = 10**18
    assert follower.command(setpoint(stamp=now), now, 0.0, REST)
    stale = setpoint(mode=Mode.HOLD, stamp=now - round(age * NS))
    assert follower.command(stale, now, 0.1, REST) == (Stop(),)
    assert follower.refusal == ''
    assert follower.command(stale, now, 0.2, REST) == ()


def test_a_table_that_moves_under_hold_and_a_stop_that_was_refused_are_stopped_again(follower):
    hold = setpoint(mode=Mode.HOLD)
    assert follower.command(hold, 0, 0.0, REST) == (Stop(),)
    turning = Reading(np.zeros(3), np.array([0.0, 0.0, 5 * DEG]))
    assert follower.command(hold, 0, 0.1, turning) == (Stop(),)
    assert follower.command(hold, 0, 0.2, REST) == ()
    follower.halt('The controller refuses: 3 busy.')
    assert follower.command(hold, 0, 0.3, REST) == (Stop(),)


def test_hold_stops_and_what_the_controller_refused_is_not_tried_again(follower):
    follower.command(setpoint(), 0, 0.0, REST)
    follower.halt('The controller refuses: 12 axis 2 is not referenced.')
    assert follower.command(setpoint(), 0, 0.1, REST) == ()
    assert 'referenced' in follower.refusal
    assert follower.command(setpoint(mode=Mode.HOLD), 0, 0.2, REST) == (Stop(),)
    assert follower.command(setpoint(), 0, 0.3, REST) != ()


@pytest.mark.parametrize(
    ('wrong', 'at', 'words'),
    [
        (turn(), Reading(np.zeros(3), np.array([0, 0, 1.0])), 'stands at its angles'),
        (turn(), Reading(np.array([0, 0.1, 0]), np.zeros(3)), 'stands at its angles'),
        (setpoint(1, Mode.RATE, (0, 0, 0), (0, 5, 5), 1.0), REST, 'whole turns of one joint'),
        (setpoint(1, Mode.RATE, (0, 0, 0), (0, 0, 500), 1.0), REST, '500'),
        (setpoint(1, Mode.RATE, (0, 0, 0), (0, 0, math.nan), 1.0), REST, 'joint inner at nan deg'),
        (setpoint(1, Mode.RATE, (0, 0, 0), (), 1.0), REST, 'expected those of its 3 joints'),
        (setpoint(1, Mode.RATE, (0, 0, 0), (0, 0, 20), 1e300), REST, 'at 3.6e+302 deg'),
        (setpoint(angles=(0, math.inf, 0)), REST, 'joint middle at inf deg'),
        (setpoint(angles=(0, -math.inf, 0)), REST, 'joint middle at -inf deg'),
        (setpoint(angles=(math.nan, 0, 0)), REST, 'joint outer at nan deg'),
        (setpoint(angles=(0, 0, 1e300)), REST, 'joint inner at 1e+300 deg'),
        (setpoint(angles=(0, 0)), REST, 'found 2 angles and'),
        (replace(setpoint(), joints=('outer', 'outer', 'inner')), REST, 'names a joint twice'),
        (replace(setpoint(), joints=('outer', 'wheel', 'inner')), REST, "found joint 'wheel'"),
    ],
)
def test_what_a_table_must_not_do_is_refused(follower, wrong, at, words):
    assert follower.command(wrong, 0, 0.0, at) == ()
    assert words in follower.refusal


def test_what_is_refused_on_the_way_stops_the_table_once(follower):
    """Repeated, it would keep the earlier motion alive."""
    assert len(follower.command(setpoint(), 0, 0.0, REST)) == 3
    wrong = setpoint(1, Mode.RATE, (0, 0, 0), (0, 0, 500), 1.0)
    assert follower.command(wrong, 0, 0.1, REST) == (Stop(),)
    assert follower.command(wrong, 0, 0.2, REST) == ()
    assert '500 deg/s' in follower.refusal
    # It has stopped: the silence of its leader is no other stop.
    assert follower.watch(9.0) == ()
    assert len(follower.command(setpoint(), 0, 0.3, REST)) == 3


@pytest.mark.parametrize(('age', 'moves'), [(0.49, 3), (0.51, 0), (-0.49, 3), (-0.51, 0)])
def test_a_setpoint_is_neither_older_nor_newer_than_its_age(follower, age, moves):
    assert len(follower.command(setpoint(stamp=NS), NS + round(age * NS), 0.0, REST)) == moves


# --- the node and a controller -----------------------------------------------------------------


class Leader(ros.Node):
    """Sends a setpoint over and over, and listens."""

    def __init__(self, name='leader'):
        super().__init__(name)
        self.setpoint, self.payloads, self.statuses = None, [], {}
        kinds = ros.messages
        self.output = self.create_publisher(
            kinds.TurntableSetpoint, 'turntable/setpoint', qos.command()
        )
        self.joints = ros.open_drain(self, kinds.JointState, 'turntable/joint_states', qos.stream())
        self.create_subscription(kinds.DiagnosticArray, '/diagnostics', self.on_diagnostics, 100)
        self.create_timer(0.02, self.tick, clock=STEADY)

    def tick(self):
        self.payloads += ros.drain(self.joints)
        if self.setpoint is not None:
            now = Setpoint(**{**vars(self.setpoint), 'stamp': time.time_ns()})
            for payload in encode_setpoints(SetpointBlock((now,))).payloads():
                self.output.publish(payload)

    def on_diagnostics(self, message):
        for status in message.status:
            self.statuses[status.name.partition(': ')[2]] = status

    def has_report(self, part, level, words):
        status = self.statuses.get(part)
        return status is not None and status.level[0] == level and words in status.message


class Bench:
    def __init__(self):
        self.controller = Controller()
        self.node = None

    def open(self, *more):
        # The controller is a thread of this process, which a busy machine may hold up.
        arguments = [f'port:={self.controller.url}', 'reply_timeout:=0.4', *more]
        ros.init(args=['--ros-args', *(w for a in arguments for w in ('-p', a))])
        self.executor = ros.SingleThreadedExecutor()
        self.leader, self.node = Leader(), AsciiTableNode()
        for node in (self.leader, self.node):
            self.executor.add_node(node)
        assert self.until(lambda: self.controller.count('STATE') > 2)
        assert self.until(lambda: self.leader.output.get_subscription_count() == 1)

    def until(self, condition, seconds=None):
        return until(condition, seconds, lambda: self.executor.spin_once(timeout_sec=0.02))

    def lead(self, what):
        self.leader.setpoint = what

    def stops(self):
        return self.controller.count('STOP')


@pytest.fixture
def bench(monkeypatch, request):
    isolate(monkeypatch)
    bench = Bench()
    bench.open(*getattr(request, 'param', ()))
    yield bench
    bench.node.stop()
    bench.controller.close()
    ros.try_shutdown()


def test_setpoints_become_lines_and_replies_joint_states(bench):
    assert bench.controller.lines[:2] == ['STOP', 'WATCHDOG 1.000']
    bench.lead(setpoint())
    assert bench.until(lambda: bench.controller.angles == [0, 90, 0])
    bench.until(lambda: False, 0.1)
    bench.lead(turn(angles=(0, 90, 0)))
    assert bench.until(lambda: 'MOVE 3 -1080.000000 20.000000' in bench.controller.lines)
    (joints,) = decode_joints(Messages.join(bench.leader.payloads))
    assert joints.names == TABLE.names
    assert joints.position[:, 1].max() == pytest.approx(90 * DEG)
    assert abs(joints.stamp[-1] - time.time_ns()) < NS
    assert (np.diff(joints.stamp) > 0).all()


def test_the_table_stops_when_setpoints_end_and_when_the_node_ends(bench):
    bench.lead(setpoint(angles=(0, 9000, 0)))
    assert bench.until(lambda: bench.controller.count('MOVE') == 3)
    before, asked = bench.stops(), bench.controller.count('STATE')
    bench.lead(None)
    assert bench.until(lambda: bench.stops() > before)
    # Within a second, at 50 a second: the controller counts them, however busy the machine is.
    assert bench.controller.count('STATE') - asked <= 50
    bench.node.stop()
    assert bench.controller.lines[-1] == 'STOP'


def test_an_order_that_the_controller_refuses_stops_all_axes_and_is_said(bench):
    bench.controller.script['MOVE'] = 'ERR 12 axis 2 is not referenced'
    before = bench.stops()
    bench.lead(setpoint())
    assert bench.until(
        lambda: bench.leader.has_report('setpoints', 2, '12 axis 2 is not referenced')
    )
    bench.until(lambda: False, 0.2)
    # Once, though the setpoint was repeated.
    assert (bench.controller.count('MOVE'), bench.stops()) == (1, before + 1)


def test_an_order_whose_answer_cannot_be_read_is_a_broken_line(bench):
    bench.controller.script['MOVE'] = 'O?K'
    before = bench.stops()
    bench.lead(setpoint())
    assert bench.until(
        lambda: bench.leader.has_report('controller', 2, 'reply to an order cannot be')
    )
    assert bench.stops() > before
    assert bench.controller.count('MOVE') == 1


def test_a_controller_that_falls_silent_is_told_to_stop_and_met_anew(bench):
    bench.lead(setpoint(angles=(0, 9000, 0)))
    assert bench.until(lambda: bench.controller.count('MOVE') == 3)
    # From now on: its thread answers on while this one is held up.
    bench.controller.silent = True
    asked = bench.controller.count('STATE')
    assert bench.until(lambda: bench.controller.lines[-1] == 'STOP')
    # The first question without an answer; another may have been answered meanwhile.
    assert bench.controller.count('STATE') - asked <= 2
    assert bench.until(lambda: bench.leader.has_report('controller', 2, "no reply to 'STATE'"))
    bench.lead(None)
    bench.controller.silent = False
    assert bench.until(lambda: bench.leader.has_report('controller', 0, 'answers'))
    assert bench.controller.connections >= 2


def test_a_controller_that_hangs_up_is_said_and_called_again(bench):
    bench.controller.line.shutdown(socket.SHUT_RDWR)
    assert bench.until(lambda: bench.leader.has_report('controller', 2, 'is lost'))
    assert bench.until(lambda: bench.leader.has_report('controller', 0, 'answers'))


@pytest.mark.parametrize('bench', [('setpoint_timeout:=2.0',)], indirect=True)
def test_after_a_hang_up_a_position_is_gone_on_with_and_no_turn(bench):
    bench.lead(FAR)
    assert bench.until(lambda: bench.controller.count('MOVE') == 3)
    bench.controller.line.shutdown(socket.SHUT_RDWR)
    assert bench.until(lambda: bench.controller.count('MOVE') == 6)
    bench.lead(setpoint(mode=Mode.HOLD))
    assert bench.until(lambda: bench.controller.goals == bench.controller.angles)
    at = bench.controller.angles
    assert bench.until(lambda: bench.controller.lines[-3:] == ['STATE'] * 3)
    bench.lead(turn(angles=at))
    assert bench.until(lambda: bench.controller.count('MOVE') == 9)
    bench.controller.line.shutdown(socket.SHUT_RDWR)
    assert bench.until(lambda: bench.leader.has_report('setpoints', 2, 'is not resumed'))
    assert bench.controller.count('MOVE') == 9


def test_an_error_that_nobody_foresaw_stops_the_table_and_does_not_end_its_control(bench):
    bench.node._control._follower.watch = lambda _: 1 / 0
    assert bench.until(lambda: bench.leader.has_report('controller', 2, 'division by zero'))
    assert bench.controller.lines[-1] == 'STOP'
    del bench.node._control._follower.watch
    assert bench.until(lambda: bench.leader.has_report('controller', 0, 'answers'))


def test_garbage_is_no_joint_state_and_much_of_it_is_a_broken_line(bench):
    bench.controller.script['STATE'] = 'STATE 0.0 nan 0.0 0 0 0'
    assert bench.until(lambda: bench.leader.has_report('controller', 2, "Found 'STATE 0.0 nan"))
    assert 'STOP' in bench.controller.lines[-5:]
    del bench.controller.script['STATE']
    assert bench.until(lambda: bench.leader.has_report('controller', 0, 'answers'))
    (joints,) = decode_joints(Messages.join(bench.leader.payloads))
    assert np.isfinite(joints.position).all()


def test_a_subscriber_that_holds_the_publisher_up_does_not_hold_the_stop_up(bench, monkeypatch):
    bench.lead(setpoint(angles=(0, 9000, 0)))
    assert bench.until(lambda: bench.controller.count('MOVE') == 3)
    before, stopped = bench.stops(), []

    def held_up(*_):
        stopped.append(until(lambda: bench.stops() > before))

    monkeypatch.setattr('imu_calib.live.nodes.ascii_table_node.publish_all', held_up)
    assert bench.until(lambda: stopped)
    assert stopped[0]


FAR = setpoint(angles=(0, 9000, 0))


def test_a_second_source_of_setpoints_is_refused_and_the_table_stands(bench):
    bench.lead(FAR)
    assert bench.until(lambda: bench.controller.count('MOVE') == 3)
    before = bench.stops()
    second = Leader('second')
    bench.executor.add_node(second)
    second.setpoint = setpoint(step=7, angles=(0, -9000, 0))
    assert bench.until(lambda: bench.leader.has_report('source', 2, 'two sources'))
    assert bench.until(lambda: bench.stops() > before)
    (named,) = [v.value for v in bench.leader.statuses['source'].values if v.key == 'publishers']
    assert named == '/leader, /second'
    # The one that is left has not seen the stop: it asks for the same all the time.
    second.setpoint = None
    assert bench.until(lambda: bench.leader.has_report('source', 2, 'of a refused motion'))
    assert bench.controller.count('MOVE') == 3
    bench.lead(None)
    bench.until(lambda: False, 1.0)
    bench.lead(FAR)
    assert bench.until(lambda: bench.controller.count('MOVE') == 6)
    assert bench.until(lambda: bench.leader.has_report('source', 0, 'one source'))


def test_where_a_message_does_not_tell_its_source_two_that_are_listed_are_two(bench, monkeypatch):
    told = stop.drain_sources
    monkeypatch.setattr(stop, 'drain_sources', lambda s: [(p, b'') for p, _ in told(s)])
    bench.lead(FAR)
    assert bench.until(lambda: bench.controller.count('MOVE') == 3)
    before = bench.stops()
    bench.executor.add_node(Leader('second'))
    assert bench.until(lambda: bench.stops() > before)
    assert bench.until(lambda: bench.leader.has_report('source', 2, 'two sources'))


@pytest.mark.parametrize('bench', [('stop_required:=true',)], indirect=True)
def test_without_a_heartbeat_nothing_moves_and_its_silence_is_a_stop(bench):
    beat = bench.leader.create_publisher(ros.messages.Bool, 'heartbeat', 10)
    clear = ros.messages.Bool(data=True)
    timer = bench.leader.create_timer(0.05, lambda: beat.publish(clear), clock=STEADY)
    timer.cancel()
    bench.lead(FAR)
    assert bench.until(lambda: bench.leader.has_report('source', 2, 'No heartbeat on /heartbeat'))
    assert bench.controller.count('MOVE') == 0
    bench.lead(None)
    timer.reset()
    assert bench.until(lambda: bench.leader.has_report('source', 0, 'one source'))
    # Longer than the setpoints' timeout: nobody asks for a movement any more.
    bench.until(lambda: False, 1.0)
    bench.lead(FAR)
    assert bench.until(lambda: bench.controller.count('MOVE') == 3)
    before, asked = bench.stops(), bench.controller.count('STATE')
    timer.cancel()
    assert bench.until(lambda: bench.stops() > before)
    # Within a second, at 50 a second.
    assert bench.controller.count('STATE') - asked <= 50
    assert bench.until(lambda: bench.leader.has_report('source', 2, 'No heartbeat'))
    # It is back, and publishes stop.
    bench.lead(None)
    clear.data = False
    timer.reset()
    assert bench.until(lambda: bench.leader.has_report('source', 2, 'is false, which means stop'))
    bench.lead(FAR)
    bench.until(lambda: False, 0.2)
    assert bench.controller.count('MOVE') == 3


def moving_by_heartbeat(bench):
    """Let the table move, as a heartbeat allows; return its publisher and its timer."""
    beat = bench.leader.create_publisher(ros.messages.Bool, 'heartbeat', 10)
    timer = bench.leader.create_timer(
        0.05, lambda: beat.publish(ros.messages.Bool(data=True)), clock=STEADY
    )
    assert bench.until(lambda: bench.leader.has_report('source', 0, 'one source'))
    bench.lead(FAR)
    assert bench.until(lambda: bench.controller.count('MOVE') == 3)
    return beat, timer


@pytest.mark.parametrize('bench', [('stop_required:=true', 'setpoint_timeout:=2.0')], indirect=True)
def test_a_heartbeat_that_says_stop_is_no_matter_of_the_next_setpoint(bench):
    beat, timer = moving_by_heartbeat(bench)
    bench.lead(None)
    # No setpoint is on its way any more.
    bench.until(lambda: False, 0.2)
    timer.cancel()
    before, asked = bench.stops(), bench.controller.count('STATE')
    beat.publish(ros.messages.Bool(data=False))
    assert bench.until(lambda: bench.stops() > before)
    # Within a second, at 50 a second; the silence of its leader alone is a stop after two.
    assert bench.controller.count('STATE') - asked <= 50


@pytest.mark.parametrize('bench', [('stop_required:=true',)], indirect=True)
def test_a_heartbeat_that_says_stop_once_is_a_stop(bench):
    beat, timer = moving_by_heartbeat(bench)
    before = bench.stops()
    for clear in (False, True):
        beat.publish(ros.messages.Bool(data=clear))
    assert bench.until(lambda: bench.stops() > before)
    # Its leader did not notice, and is not followed when the heartbeat is as before.
    assert not bench.until(lambda: bench.controller.count('MOVE') > 3, 1.5)
    timer.cancel()


UNHEARD = """
import select, sys
from imu_calib.live import middleware as ros
from imu_calib.live.nodes.ascii_table_node import AsciiTableNode
class Cut(AsciiTableNode):
    def __init__(self):
        super().__init__()
        steady = ros.Clock(clock_type=ros.ClockType.STEADY_TIME)
        self.create_timer(0.05, self.cut, clock=steady)
    def cut(self):
        if select.select([sys.stdin], [], [], 0)[0]:
            ros.try_shutdown()
ros.run(Cut)
"""
"""Ends its context at a line of its input."""


def test_the_table_stops_when_the_context_is_gone_before_the_node(monkeypatch):
    isolate(monkeypatch)
    controller = Controller()
    process = start(UNHEARD, '--ros-args', '-p', f'port:={controller.url}')
    assert until(lambda: controller.count('STATE') > 2), process.poll()
    _, errors = process.communicate('\n')
    assert process.returncode == 0, errors
    assert controller.lines[-1] == 'STOP'
    controller.close()


def test_of_two_publishers_that_no_message_tells_apart_every_message_is_of_another(bench):
    rival = bench.leader.create_publisher(
        ros.messages.TurntableSetpoint, 'turntable/setpoint', qos.command()
    )
    assert bench.until(lambda: len(bench.node._commands._listed()) == 2)
    assert len({bench.node._commands._known() for _ in range(5)}) == 5
    bench.leader.destroy_publisher(rival)
    assert bench.until(lambda: len(bench.node._commands._listed()) == 1)
    assert len({bench.node._commands._known() for _ in range(5)}) == 1


class Slow:
    """A line on which what is told to move takes three seconds, by a clock of its own."""

    def __init__(self):
        self.lines, self.ahead = [], 0.0
        self.state = itertools.repeat('STATE 0 0 0 0 0 0')

    def monotonic(self):
        return time.monotonic() + self.ahead

    def request(self, text):
        self.lines.append(text)
        if text.startswith('MOVE'):
            self.ahead += 3.0
        return next(self.state) if text == 'STATE' else 'OK'

    def close(self):
        """Nothing is to be closed."""


def test_orders_that_are_held_up_midway_are_not_gone_on_with(monkeypatch, follower):
    line = Slow()
    monkeypatch.setattr(table_line, 'time', line)
    at_work = table_line.Control(lambda: line, follower, TABLE.names, lambda: 0, 0.001)
    at_work.start()
    assert until(lambda: 'STATE' in line.lines)
    at_work.command(setpoint())
    assert until(lambda: any(text.startswith('MOVE') for text in line.lines))
    assert until(lambda: line.lines[-1] == 'STATE')
    assert at_work.stop(5.0)
    first = next(k for k, text in enumerate(line.lines) if text.startswith('MOVE'))
    assert line.lines[first + 1] == 'STOP'
    assert sum(text.startswith('MOVE') for text in line.lines) == 1


def test_a_reading_is_stamped_in_the_middle_between_question_and_answer(follower):
    clock = itertools.count(0, 100)
    at_work = table_line.Control(Slow, follower, TABLE.names, lambda: next(clock), 0.001)
    at_work.start()
    assert until(lambda: len(at_work._readings) > 3)
    assert at_work.stop(5.0)
    assert at_work.pop_joint_states().stamp[:3].tolist() == [50, 250, 450]


def test_an_answer_to_an_earlier_question_is_none_to_this_one():
    with socket.create_server(('127.0.0.1', 0)) as server:
        line = ControllerLine(f'socket://127.0.0.1:{server.getsockname()[1]}', 0, 5.0)
        other, _ = server.accept()
        with contextlib.closing(line), other, other.makefile('rw') as controller:
            controller.write('LATE\r\n')
            controller.flush()
            assert until(lambda: select.select([line._port._socket], [], [], 0)[0])

            def answer():
                controller.readline()
                controller.write('OK\r\n')
                controller.flush()

            answers = threading.Thread(target=answer)
            answers.start()
            assert line.request('STOP') == 'OK'
            answers.join()


def test_the_third_bad_answer_in_a_row_is_another_device(follower):
    line = Slow()
    line.state = iter(['STATE 0 0 0 0 0 0', 'STAT', '?', 'STATE 0 0 0 0 0 0', *'abcdef'])
    at_work = table_line.Control(lambda: line, follower, TABLE.names, lambda: 0, 0.001)
    at_work.start()
    assert until(lambda: at_work.status.breaks == 1)
    assert at_work.stop(5.0)
    head = ['STOP', 'WATCHDOG 1.000']
    assert line.lines[:10] == [*head, *['STATE'] * 7, 'STOP']


def test_what_was_wanted_before_the_line_was_open_moves_nothing(follower):
    line = Slow()
    at_work = table_line.Control(lambda: line, follower, TABLE.names, lambda: 0, 0.001)
    at_work.command(setpoint())
    at_work.start()
    assert until(lambda: line.lines.count('STATE') > 5)
    assert at_work.stop(5.0)
    assert not any(text.startswith('MOVE') for text in line.lines)


@pytest.mark.parametrize('seconds', [3.0, again(30.0)])
def test_a_node_that_hangs_moves_nothing_when_it_goes_on(monkeypatch, request, seconds):
    isolate(monkeypatch)
    controller = Controller()
    words = ['--ros-args', '-p', f'port:={controller.url}', '-p', 'reply_timeout:=0.4']
    node = processes.start([sys.executable, '-m', 'imu_calib.live.nodes.ascii_table_node', *words])
    ros.init(args=[])
    request.addfinalizer(ros.try_shutdown)
    leader, executor = Leader(), ros.SingleThreadedExecutor()
    executor.add_node(leader)

    def comes(condition, seconds=None):
        return until(condition, seconds, lambda: executor.spin_once(timeout_sec=0.02))

    assert comes(lambda: leader.output.get_subscription_count() == 1)
    assert comes(lambda: controller.count('STATE') > 2)
    leader.setpoint = FAR
    assert comes(lambda: controller.count('MOVE') == 3)
    os.kill(node.pid, signal.SIGSTOP)
    # Its leader is gone meanwhile: nobody tells it to hold.
    leader.setpoint = None
    end = time.monotonic() + seconds
    comes(lambda: time.monotonic() > end, seconds + 1.0)
    before = controller.count('STOP')
    os.kill(node.pid, signal.SIGCONT)
    assert comes(lambda: controller.count('STOP') > before)
    states = controller.count('STATE')
    assert comes(lambda: controller.count('STATE') > states + 10)
    assert controller.count('MOVE') == 3
    node.terminate()
    assert node.wait(patience()) == 0
    assert controller.lines[-1] == 'STOP'
    controller.close()


@pytest.mark.parametrize('port', ["''", 'socket://nowhere', 'http://127.0.0.1:80'])
def test_a_port_that_cannot_be_is_refused_in_a_sentence(monkeypatch, port):
    isolate(monkeypatch)
    ros.init(args=['--ros-args', '-p', f'port:={port}'])
    with pytest.raises(InputError, match='socket://host:port'):
        AsciiTableNode()
    ros.try_shutdown()


def test_turntable_node_leads_a_plan_with_turns_through_lines_of_text(monkeypatch, tmp_path):
    isolate(monkeypatch)
    (tmp_path / 'nimble.yaml').write_text(NIMBLE)
    (tmp_path / 'tiny.yaml').write_text(PLAN.replace('RATE deg/s', '700 deg/s, -700 deg/s'))
    # The servo goes by the clock, whose replies a busy machine lets lie. How well rates are held is
    # tested in test_watch and test_sequencer, without delays, and silence above.
    for bound in ('_RATE_TOLERANCE', '_RATE_ASTRAY'):
        monkeypatch.setattr(f'imu_calib.live.table_watch.{bound}', 10.0)
    controller = Servo()
    given = {
        'port': controller.url,
        'table': tmp_path / 'nimble.yaml',
        'plan': tmp_path / 'tiny.yaml',
        'supervised': 'false',
        'autostart': 'true',
        'settle': 0.05,
        'joint_state_rate': 100.0,
        'reply_timeout': 0.4,
        # What holds up this process holds up both nodes and the controller.
        'setpoint_timeout': 2.0,
        'feedback_timeout': 30.0,
        'watchdog_timeout': 30.0,
    }
    ros.init(args=['--ros-args', *(w for k, v in given.items() for w in ('-p', f'{k}:={v}'))])
    executor = ros.SingleThreadedExecutor()
    driver, leader = AsciiTableNode(), TurntableNode()
    states = []
    leader.create_subscription(
        ros.messages.TurntableState, 'turntable/state', states.append, qos.latched(100)
    )
    for node in (driver, leader):
        executor.add_node(node)
    done = ros.messages.TurntableState.DONE
    ended = until(
        lambda: states and states[-1].phase >= done, None, lambda: executor.spin_once(0.02)
    )
    for node in (leader, driver):
        node.stop()
    controller.close()
    ros.try_shutdown()
    assert ended, states[-1]
    assert (states[-1].phase, states[-1].reason) == (done, '')
    # One turn each way, with one more to start and stop in.
    turns = [line.split() for line in controller.lines if line.endswith(' 700.000000')]
    assert [(axis, round(float(goal))) for _, axis, goal, _ in turns] == [('1', 720), ('1', 0)]
    assert controller.lines[-1] == 'STOP'
