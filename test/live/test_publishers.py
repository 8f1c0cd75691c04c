"""One publisher per topic: when two are listed, do two live, or is one the ghost of a kill?"""

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from loopback import isolate, until

from imu_calib.common.errors import ImuCalibError, InputError
from imu_calib.common.stream import Mode, Setpoint
from imu_calib.live.network import LONGEST_LEASE
from imu_calib.live.nodes.qos import OnePublisher
from imu_calib.live.nodes.stop import OneSource, state_folder

UNKNOWN = '_NODE_NAME_UNKNOWN_'


def publisher(name, participant=1, entity=1, namespace='/'):
    gid = [participant] * 12 + [entity] * 4
    return SimpleNamespace(node_name=name, node_namespace=namespace, endpoint_gid=gid)


def watched(*publishers):
    graph = SimpleNamespace(listed=list(publishers))
    graph.get_publishers_info_by_topic = lambda topic: graph.listed
    return OnePublisher(graph, '/estop'), graph


def test_one_publisher_is_alone():
    topic, _ = watched(publisher('plc'))
    assert topic.fault(0.0) == ''
    assert topic.is_alone(0.0)


@pytest.mark.parametrize(
    ('second', 'name'),
    [
        (publisher('stranger', 2), '/stranger'),
        (publisher('plc', 2, namespace='/lab'), '/lab/plc'),
        (publisher('plc', 1, 2), '/plc, /plc'),
    ],
    ids=['another name', 'another namespace', 'the same process'],
)
def test_two_that_live_are_named_at_once(second, name):
    topic, graph = watched(publisher('plc'), second)
    words = topic.fault(0.0)
    assert words.startswith('2 publishers are on /estop: ')
    assert name in words
    assert '/plc' in words
    graph.listed.pop()
    assert topic.fault(0.1) == ''
    # What the other one said may still be under way.
    assert not topic.is_alone(0.1)
    assert topic.is_alone(10.0)


def test_a_node_that_was_killed_and_started_anew_is_let_be_until_the_lease_is_over():
    topic, graph = watched(publisher('plc', 1), publisher('plc', 2))
    assert topic.fault(0.0) == ''
    assert topic.fault(LONGEST_LEASE) == ''
    assert '/plc, /plc' in topic.fault(math.nextafter(LONGEST_LEASE, math.inf))
    graph.listed.pop()
    assert topic.fault(LONGEST_LEASE + 1) == ''
    graph.listed.append(publisher('plc', 3))
    assert topic.fault(LONGEST_LEASE + 2) == '', 'the next one has a time of its own'


def test_two_that_are_heard_live_whatever_they_are_called():
    topic, _ = watched(publisher('plc', 1), publisher('plc', 2))
    assert topic.fault(0.0) == ''
    topic.note_two_sources(0.1)
    assert '2 publishers' in topic.fault(0.1)


def test_somebody_who_is_heard_and_gone_is_told_for_a_while():
    topic, _ = watched(publisher('plc'))
    topic.note_two_sources(1.0)
    assert 'A second node published on /estop and has ended since' in topic.fault(1.1)
    assert topic.fault(9.0) == ''


def test_a_name_comes_later_than_its_publisher_but_not_much():
    topic, _ = watched(publisher('plc', 1), publisher(UNKNOWN, 2))
    assert topic.fault(0.0) == ''
    assert 'a node without a name' in topic.fault(2.1)


@pytest.mark.parametrize('topic', ['imu/pulses', 'driver/raw'])
def test_two_devices_end_a_session_whatever_their_topic_is_called(monkeypatch, tmp_path, topic):
    try:
        from imu_calib.live import middleware as ros
        from imu_calib.live.nodes import calibrator_node, qos
    except ImuCalibError as error:
        pytest.skip(str(error))
    monkeypatch.setattr(ros, 'LEASE', 0.2)
    isolate(monkeypatch)
    given = {
        'latitude': '34.65',
        'journal': tmp_path / 'journal',
        'output': tmp_path / 'calibration.yaml',
    }
    words = [w for k, v in given.items() for w in ('-p', f'{k}:={v}')]
    ros.init(args=['--ros-args', *words, '-r', f'calibrator_node:imu/pulses:={topic}'])
    node, peer, heard = calibrator_node.CalibratorNode(), ros.Node('peer'), []
    try:
        kind = ros.messages.ImuCalibration
        peer.create_subscription(kind, 'calibration', heard.append, qos.results())
        for _ in range(2):
            peer.create_publisher(ros.messages.Imu, topic, qos.stream())

        def step():
            ros.spin_once(node, timeout_sec=0.002)
            ros.spin_once(peer, timeout_sec=0.002)

        assert until(lambda: any(m.status == kind.REFUSED for m in heard), step=step)
        assert f'Two publishers on /{topic}' in heard[-1].status_text
    finally:
        node.stop()
        node.destroy_node()
        peer.destroy_node()
        ros.try_shutdown()


def test_a_user_without_a_home_is_told_to_name_a_folder_for_the_stop(monkeypatch):
    def nobody(number):
        raise KeyError(number)

    monkeypatch.delenv('HOME', raising=False)
    monkeypatch.delenv('XDG_STATE_HOME', raising=False)
    monkeypatch.setattr('pwd.getpwuid', nobody)
    for given in ('', '~/stops'):
        with pytest.raises(InputError, match='state_folder'):
            state_folder(given)
    assert state_folder('/var/lib/stand') == Path('/var/lib/stand')


# Whose setpoints a driver follows: one source's, and none that something forbids


TIMEOUT = 0.5
GO = Setpoint(0, 'plan', 1, '1', Mode.POSITION, ('outer',), (1.0,), (), 0.0, 0.0)
HOLD = replace(GO, mode=Mode.HOLD)
A, B = b'one', b'two'


@pytest.fixture
def gate():
    return OneSource(TIMEOUT)


def test_setpoints_of_one_source_pass_as_they_came(gate):
    for k in range(20):
        assert gate.checked(replace(GO, stamp=k), A, 0.1 * k) == replace(GO, stamp=k)
    assert gate.reason == ''


@pytest.mark.parametrize('second', [GO, HOLD, replace(GO, mode=Mode.RATE)])
def test_a_second_source_makes_the_table_stand_whoever_speaks(gate, second):
    gate.checked(GO, A, 0.0)
    assert gate.checked(second, B, 0.1).mode is Mode.HOLD
    # The first one's too: nobody knows which of them is right.
    assert gate.checked(GO, A, 0.2).mode is Mode.HOLD
    assert 'two sources' in gate.reason


def test_of_two_that_go_on_neither_moves_the_table_and_neither_does_the_one_that_is_left(gate):
    for k in range(40):
        assert (gate.checked(GO, (A, B)[k % 2], 0.05 * k).mode is Mode.HOLD) == (k > 0)
    for k in range(40, 80):
        assert gate.checked(GO, B, 0.05 * k).mode is Mode.HOLD
    assert 'of a refused motion' in gate.reason


@pytest.mark.parametrize('pause', [HOLD, None])
def test_who_ceases_to_ask_for_a_movement_is_followed_again(gate, pause):
    gate.checked(GO, A, 0.0)
    gate.checked(GO, B, 0.1)
    gate.checked(GO, A, 0.2)
    for k in range(6):
        if pause is not None:
            assert gate.checked(pause, A, 0.3 + 0.1 * k) == pause
    assert gate.checked(GO, A, 0.2 + TIMEOUT + 0.2) == GO
    assert gate.reason == ''


def test_another_may_lead_when_the_first_has_been_silent_until_the_table_stopped(gate):
    gate.checked(GO, A, 0.0)
    assert gate.checked(GO, B, TIMEOUT + 0.01) == GO
    assert gate.checked(GO, A, TIMEOUT + 0.02).mode is Mode.HOLD


def test_a_source_that_holds_the_table_has_it(gate):
    gate.checked(HOLD, A, 0.0)
    assert gate.checked(GO, B, 0.3).mode is Mode.HOLD


def test_what_forbids_stops_once_and_nothing_goes_on_by_itself(gate):
    assert gate.forbid('No heartbeat.') is None
    assert gate.checked(GO, A, 0.0).mode is Mode.HOLD
    assert gate.reason == 'No heartbeat.'
    assert gate.forbid('') is None
    assert gate.reason == ''
    # It is still asked for: whoever leads has not seen the stop.
    assert gate.checked(GO, A, 0.1).mode is Mode.HOLD
    assert gate.checked(HOLD, A, 0.2) == HOLD
    assert gate.checked(GO, A, 0.7) == GO
    stop = gate.forbid('No heartbeat.')
    assert stop == HOLD
    assert gate.forbid('No heartbeat.') is None
    assert gate.checked(HOLD, A, 0.8) == HOLD
    assert gate.reason == 'No heartbeat.'


# The whole timeout counts, and no more: seconds after the last word of the cause.
WAITS = [(0.75 * TIMEOUT, Mode.HOLD), (0.99 * TIMEOUT, Mode.HOLD), (1.01 * TIMEOUT, GO.mode)]


@pytest.mark.parametrize(('wait', 'mode'), WAITS)
def test_another_leads_after_the_whole_timeout(gate, wait, mode):
    gate.checked(GO, A, 0.0)
    assert gate.checked(GO, B, wait).mode is mode


@pytest.mark.parametrize(('wait', 'mode'), WAITS)
def test_of_two_one_is_followed_after_the_whole_timeout_without_the_other(gate, wait, mode):
    gate.checked(HOLD, A, 0.0)
    gate.checked(HOLD, B, 0.1)
    # The first holds meanwhile: it is silent for less than the timeout.
    gate.checked(HOLD, A, 0.1 + wait / 2)
    assert gate.checked(GO, A, 0.1 + wait).mode is mode


@pytest.mark.parametrize(('wait', 'mode'), WAITS)
def test_what_was_refused_is_followed_after_the_whole_timeout_of_holding(gate, wait, mode):
    gate.forbid('No heartbeat.')
    gate.checked(GO, A, 0.0)
    gate.forbid('')
    gate.checked(HOLD, A, wait / 2)
    assert gate.checked(GO, A, wait).mode is mode
