"""The live stand under real ROS 2: launched, called, asked, recorded, and mixed with the DDS side.

What runs is the workspace as `colcon build` left it, in a domain of its own on the loopback
interface; no process may be left.
"""

import os
import re
import signal
import sys
import time
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from installed import has_wheel, needs
from loopback import SUPPORT
from ros_stands import (
    BAG,
    CANCEL,
    GOAL,
    LATITUDE,
    LOSSLESS,
    NEEDS_ROS,
    NODES,
    PACKAGE,
    VALID,
    VIEW,
    Network,
    check_truth,
    launch,
    nothing_left,
    one_joint_state,
    record,
    reprocess,
    same,
    short_plan,
)

from imu_calib.api.columns import read
from imu_calib.calibration.calibration import Calibration
from imu_calib.cli import dispatch, stand_session
from imu_calib.cli.processes import free_port

pytestmark = NEEDS_ROS


@pytest.fixture(scope='module')
def session(tmp_path_factory):
    """A session under `ros2 launch`, looked at and, where it can be, recorded with ROS's tools."""
    net = Network(tmp_path_factory.mktemp('session'))
    results = SimpleNamespace(net=net)
    with nothing_left(net):
        launch(net, autostart='false')
        net.wait_for_text('launch', 'Waiting for /imu/pulses.', 'Frames come in.')
        if BAG:
            record(net)
        net.start('goal', net.ros('ros2', *GOAL, '{plan: short}'))
        net.wait_for_text('goal', 'Feedback:')
        look = partial(net.look, 'param')
        results.parameters = look('list', '/turntable_node', wanted=['plan'])
        results.latitude = look('get', '/calibrator_node', 'latitude', wanted=['value'])
        results.described = look('describe', '/turntable_node', 'setpoint_rate', wanted=['Type'])
        net.wait_for_text('launch', 'The plan is done.', 'calibration.yaml is written', seconds=120)
        echo = ('topic', 'echo', '--no-daemon', '--once', '--full-length')
        latched = ('--qos-durability', 'transient_local', '--qos-reliability', 'reliable')
        echoed = net.ask(*echo, *latched, '/calibration', 'imu_calib_msgs/msg/ImuCalibration')
        results.echoed = yaml.safe_load(echoed.split('\n---')[0])
        results.recorded = net.stop('record') if BAG else ''
        assert net.ended('goal') == 0, net.log('goal')
        results.goal = net.log('goal')
        results.launched = net.stop('launch')
    results.live = Calibration.load(net.folder / 'calibration.yaml')
    return results


def test_a_launched_session_ends_in_the_true_parameters(session):
    check_truth(session.live)


def test_the_tool_of_ros_runs_a_goal_to_its_calibration(session):
    assert 'Goal finished with status: SUCCEEDED' in session.goal
    told, result = session.goal.split('Result:\n')
    assert re.search(r'phase: 3\n.*Turning', told)
    # Of the twelve positions' 24 parameters, how far they are.
    assert told.count('standard_deviations:\n- ') > 1
    result = yaml.safe_load(result.split('\n\nGoal')[0].replace('    calibration:', 'calibration:'))
    assert result['calibration']['status'] == VALID
    assert result['calibration']['k_gx'] == session.live.model.vector()[0]
    assert result['file'] == str(session.net.folder / 'calibration.yaml')
    assert result['journal'] == str(session.net.folder / 'journal')


def test_ctrl_c_ends_the_launched_stand_in_order(session):
    assert 'the table stands' in session.launched
    assert 'Traceback' not in session.launched
    assert session.launched.count('process has finished cleanly') == len((*NODES, *VIEW))


def test_the_latched_calibration_is_echoed_to_whoever_asks_late(session):
    message = session.echoed
    assert message['status'] == VALID
    vector = [message[name.lower()] for name in message['parameter_names']]
    assert vector == session.live.model.vector().tolist()
    assert message['covariance'] == session.live.covariance.ravel().tolist()


def test_parameters_are_told_to_the_tools_of_ros(session):
    assert {'plan', 'setpoint_rate', 'use_sim_time'} <= set(session.parameters.split())
    assert float(session.latitude.split()[-1]) == LATITUDE
    assert 'Type: double' in session.described
    assert 'Min value: 10.0' in session.described


def test_the_journal_reprocessed_is_the_live_result(session):
    assert same(reprocess(session.net, 'journal'), session.live)


@needs(verbs=['bag'])
def test_what_ros_recorded_is_what_the_journal_holds_and_ends_in_the_true_parameters(session):
    assert not re.search('warn|error|lost', session.recorded, re.IGNORECASE), session.recorded
    for topic in ('/imu/pulses', '/turntable/joint_states'):
        journal, bag = (read(session.net.folder / name, topic) for name in ('journal', 'bag'))
        # The journal begins with the launch, and the bag goes on after the session.
        common = slice(int(np.searchsorted(journal.stamp, bag.stamp[0])), None)
        count = len(journal.stamp[common])
        assert count > 0.9 * len(journal.stamp)
        assert np.array_equal(bag.stamp[:count], journal.stamp[common])
        for name, column in journal.columns.items():
            assert np.array_equal(bag.columns[name][:count], column[common]), name
    # Dwells at the ends of the session are of other lengths.
    given = ('--plan', str(session.net.folder / 'short.yaml'), '--imu', 'fog_medium')
    given += ('--table', 'three_axis', '--latitude', str(LATITUDE))
    offline = reprocess(session.net, 'bag', *given)
    check_truth(offline)


@needs(verbs=['bag'])
def test_ros_reads_the_journal_and_what_it_makes_of_it_reads_the_same(session):
    net, journal = session.net, session.net.folder / 'journal'
    forms = [
        {'uri': f'{storage}_{mode or "plain"}', 'storage_id': storage, 'all_topics': True}
        | ({'compression_mode': mode, 'compression_format': 'zstd'} if mode else {})
        # By default it drops what waits to be compressed.
        | {'max_bagfile_size': 3_000_000, 'compression_queue_size': 0}
        for storage in ('mcap', 'sqlite3')
        for mode in ('', 'message', 'file')
    ]
    (net.folder / 'forms.yaml').write_text(yaml.safe_dump({'output_bags': forms}))
    told = net.ask('bag', 'info', str(journal))
    net.ask('bag', 'convert', '-i', str(journal), '-o', 'forms.yaml', seconds=120)
    for topic in ('/imu/pulses', '/turntable/joint_states'):
        expected = read(journal, topic)
        assert re.search(rf'Topic: {topic} .* Count: {len(expected.stamp)} ', told)
        for form in forms:
            folder = net.folder / form['uri']
            assert len(list(folder.iterdir())) > 2  # split
            found = read(folder, topic)
            assert np.array_equal(found.stamp, expected.stamp), folder
            for name, column in expected.columns.items():
                assert np.array_equal(found.columns[name], column), (folder, name)


@needs(verbs=['bag'])
def test_a_played_bag_ends_in_the_true_parameters(session, tmp_path):
    net = Network(tmp_path)
    arguments = {'plan': session.net.folder / 'short.yaml', 'latitude': LATITUDE}
    arguments |= {'imu': 'fog_medium', 'setpoint_topic': '/replayed/setpoint'}
    words = [f'{name}:={value}' for name, value in arguments.items()]
    bag = session.net.folder / 'bag'
    with nothing_left(net):
        net.start('it', net.ros('ros2', 'launch', 'imu_calib', 'calibrator.launch.py', *words))
        net.wait_for_text('it', 'Waiting for /imu/pulses.')
        remapped = ('--remap', '/turntable/setpoint:=/replayed/setpoint')
        net.start('play', net.ros('ros2', 'bag', 'play', str(bag), *remapped, *LOSSLESS))
        net.wait_for_text('it', '/imu/pulses is received.')
        # Two seconds are far more than the ten messages that a player keeps by itself.
        os.killpg(net.processes['it'].pid, signal.SIGSTOP)
        time.sleep(2.0)
        os.killpg(net.processes['it'].pid, signal.SIGCONT)
        net.wait_for_text('it', 'calibration.yaml is written', seconds=120)
        assert net.ended('play') == 0, net.log('play')
        net.stop('it')
    check_truth(Calibration.load(tmp_path / 'calibration.yaml'))
    played, heard = (read(f, '/imu/pulses').stamp for f in (bag, tmp_path / 'journal'))
    between = (heard[0] <= played) & (played <= heard[-1])
    assert np.array_equal(heard, played[between])


@pytest.mark.skipif(not has_wheel(), reason='the wheel cyclonedds is not in this Python')
def test_the_tool_of_ros_cancels_a_goal_of_a_node_without_ros(tmp_path):
    folder = tmp_path / 'stand'
    words = ['stand', str(short_plan(tmp_path)), '-o', str(folder), '--processes']
    words += ['--latitude', str(LATITUDE)]
    parameters = stand_session.parameters(dispatch.build_parser().parse_args(words), folder)
    parameters['turntable_node'] |= {'autostart': False, 'supervised': False}
    parameters['stand_node']['speed'] = 2.0
    folder.mkdir()
    net = Network(tmp_path)
    library = next((PACKAGE / 'lib').glob('python3*/site-packages'))
    alone = {'IMU_CALIB_MIDDLEWARE': 'dds', 'PYTHONPATH': str(library)}
    with nothing_left(net):
        for name in ('stand_node', 'imu_node', 'turntable_node'):
            file = tmp_path / f'{name}.yaml'
            file.write_text(yaml.safe_dump({name: {'ros__parameters': parameters[name]}}))
            words = ['-m', f'imu_calib.live.nodes.{name}', '--ros-args', '--params-file', str(file)]
            net.start(name, [sys.executable, *words], **alone)
        net.wait_for_text('turntable_node', 'Joint states are received.')
        net.start('refused', net.ros('ros2', *GOAL, '{plan: another}'))
        assert net.ended('refused') == 0, net.log('refused')
        net.start('goal', net.ros('ros2', *GOAL, '{plan: short}'))
        net.wait_for_text('goal', 'phase: 3')
        # No identity and no time: all goals.
        net.ask('service', 'call', f'{GOAL[3]}/_action/cancel_goal', CANCEL, '{}')
        net.ended('goal')
        net.wait_for_text('turntable_node', 'The run was cancelled by who started it.')
        rates = one_joint_state(net)[1]
        logs = [net.stop(name) for name in ('turntable_node', 'imu_node', 'stand_node')]
    assert 'Goal finished with status: ABORTED' in net.log('refused')
    assert 'names plan another, this table runs short' in net.log('refused')
    assert 'Goal finished with status: CANCELED' in net.log('goal')
    assert 'Cancelled; the table stands.' in net.log('goal')
    assert not any(rates)
    assert 'Traceback' not in ''.join(logs)


@needs('launch_testing', 'launch_testing_ros')
def test_the_stand_passes_its_launch_test(tmp_path):
    net = Network(tmp_path)
    given = {'plan': short_plan(tmp_path), 'frame_port': free_port(), 'latitude': LATITUDE}
    words = [f'{name}:={value}' for name, value in given.items()]
    with nothing_left(net):
        file = str(SUPPORT / 'stand_launch.py')
        net.start('test', net.ros('launch_test', file, *words))
        assert net.ended('test', 300) == 0, net.log('test')
    assert net.log('test').count('OK') == 2


@pytest.mark.skipif(not has_wheel(), reason='the wheel cyclonedds is not in this Python')
@pytest.mark.parametrize('on_ros', [{'calibrator_node'}, set(NODES) - {'calibrator_node'}])
def test_nodes_on_both_runtimes_make_one_stand(on_ros, tmp_path):
    folder = tmp_path / 'stand'
    words = ['stand', str(short_plan(tmp_path)), '-o', str(folder), '--processes']
    words += ['--latitude', str(LATITUDE)]
    parameters = stand_session.parameters(dispatch.build_parser().parse_args(words), folder)
    folder.mkdir()
    net = Network(tmp_path)
    library = next((PACKAGE / 'lib').glob('python3*/site-packages'))
    with nothing_left(net):
        for name in NODES:
            file = tmp_path / f'{name}.yaml'
            file.write_text(yaml.safe_dump({name: {'ros__parameters': parameters[name]}}))
            words = ['-m', f'imu_calib.live.nodes.{name}', '--ros-args', '--params-file', str(file)]
            if name in on_ros:
                net.start(name, net.ros('python3', *words), IMU_CALIB_MIDDLEWARE='rclpy')
            else:
                alone = {'IMU_CALIB_MIDDLEWARE': 'dds', 'PYTHONPATH': str(library)}
                net.start(name, [sys.executable, *words], **alone)
        net.wait_for_text('turntable_node', 'The plan is done.', seconds=120)
        net.wait_for_text('calibrator_node', 'calibration.yaml is written')
        logs = [net.stop(name) for name in reversed(NODES)]
    assert 'Traceback' not in ''.join(logs)
    live = Calibration.load(folder / 'calibration.yaml')
    check_truth(live)
    assert same(reprocess(net, 'stand/journal'), live)
