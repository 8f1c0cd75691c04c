"""One publisher per topic: when two are listed, do two live, or is one the ghost of a kill?"""

import math
from pathlib import Path
from types import SimpleNamespace

import pytest
from loopback import environment, until

from imu_calib.common.errors import ImuCalibError, InputError
from imu_calib.live.network import LONGEST_LEASE
from imu_calib.live.nodes.qos import OnePublisher
from imu_calib.live.nodes.stop import state_folder

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
    for name, value in environment().items():
        monkeypatch.setenv(name, value)
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
