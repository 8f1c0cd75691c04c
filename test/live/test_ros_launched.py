"""Stands under real ROS 2 that are led by its services, launched, and left by their launcher."""

import os
import re
import signal

import processes
import pytest
import yaml
from installed import has_package
from loopback import until
from ros_stands import (
    GLOBAL,
    LATITUDE,
    NEEDS_ROS,
    NODES,
    PACKAGE,
    RECORDED,
    VIEW,
    Network,
    launch,
    nothing_left,
    one_joint_state,
    short_plan,
    viewed,
)

from imu_calib.cli.processes import free_port

pytestmark = NEEDS_ROS


def test_services_lead_a_stand_in_its_namespace(tmp_path):
    net = Network(tmp_path)
    with nothing_left(net):
        # Slow enough that the plan is not at its end when a tool's call arrives on a busy machine.
        launch(net, namespace='lab', speed='1.0')
        net.wait_for_text('launch', 'Turning: step 2')
        assert net.call('/lab/turntable_node/pause')[0]
        net.wait_for_text('launch', 'Paused')
        refused, why = net.call('/lab/calibrator_node/save')
        assert not refused, why
        net.look('node', 'list', wanted=[f'/lab/{node}\n' for node in (*NODES, *VIEW)])
        expected = (*RECORDED, '/estop', *(['/tf'] if VIEW else []))
        wanted = [*GLOBAL, *(f'/lab{topic}' for topic in expected)]
        topics = net.look('topic', 'list', wanted=[f'{topic}\n' for topic in wanted]).split()
        assert {t for t in topics if not t.startswith('/lab/')} == GLOBAL
        assert net.call('/lab/turntable_node/start')[0]
        assert net.call('/lab/turntable_node/abort')[0]
        assert net.call('/lab/calibrator_node/solve')[0]
        # By how far the table has come until the tool's calls arrive.
        lacks = re.compile('nothing can be determined|not observable')
        assert until(lambda: lacks.search(net.log('launch'))), net.log('launch')
        agreed, where = net.call('/lab/calibrator_node/reset')
        assert agreed, where
        assert where.endswith('journal_2.')
        turns = net.log('launch').count('Turning')
        assert net.call('/lab/turntable_node/start')[0]
        assert until(lambda: net.log('launch').count('Turning') > turns)
        written = net.stop('launch')
    # Ctrl-C in the middle of a turn.
    assert 'the table stands' in written
    assert 'Traceback' not in written


def test_a_real_stand_and_a_calibrator_alone_are_launched(tmp_path):
    net = Network(tmp_path)
    port = f'socket://127.0.0.1:{free_port()}'
    real = {'port': port, 'device': 'simulated', 'namespace': 'real', **viewed()}
    alone = {'imu_topic': '/my/imu', 'journal': 'other', 'namespace': 'alone'}
    ours = {'/real/imu/pulses', '/real/turntable/setpoint', '/alone/calibration', '/my/imu'}
    with nothing_left(net):
        for name, given in (('stand', real), ('calibrator', alone)):
            words = [f'{k}:={v}' for k, v in {'latitude': LATITUDE, **given}.items()]
            net.start(name, net.ros('ros2', 'launch', 'imu_calib', f'{name}.launch.py', *words))
        net.wait_for_text('stand', port, 'Nothing is started.', 'Waiting for /real/imu/pulses.')
        net.wait_for_text('calibrator', 'Waiting for /my/imu')
        net.look('topic', 'list', wanted=[f'{topic}\n' for topic in ours])
        written = net.stop('calibrator') + net.stop('stand')
    # The table's leader, the IMU and two calibrators.
    assert written.count('process has finished cleanly') == 4 + len(VIEW)
    assert 'Traceback' not in written


HANGING_UP = pytest.param(
    signal.SIGHUP,
    marks=pytest.mark.skipif(
        signal.getsignal(signal.SIGHUP) is signal.SIG_IGN,
        reason='under nohup all that is started ignores SIGHUP',
    ),
)


@pytest.mark.parametrize('number', [signal.SIGTERM, HANGING_UP, signal.SIGKILL])
def test_the_table_stands_when_the_launcher_alone_is_ended(number, tmp_path):
    net = Network(tmp_path)
    port = free_port()
    # A busy machine may hold up the table, and with it the clock, for longer than a node waits.
    patient = tmp_path / 'patient.yaml'
    waits = {f'{what}_timeout': 30.0 for what in ('watchdog', 'feedback', 'calibrator')}
    patient.write_text(yaml.safe_dump({'/**/turntable_node': {'ros__parameters': waits}}))
    table = ['-p', f'port:={port}', '-p', 'speed:=1.0']
    given = {
        'plan': str(short_plan(tmp_path)),
        'latitude': LATITUDE,
        'port': f'socket://127.0.0.1:{port}',
        'device': 'simulated',
        'autostart': 'true',
        'use_sim_time': 'true',
        'view': 'false',
        'params_file': str(patient),
    }
    words = [f'{k}:={v}' for k, v in given.items()]
    with nothing_left(net):
        # The table is no child of the launcher, and outlives it.
        executable = str(PACKAGE / 'lib' / 'imu_calib' / 'stand_node')
        net.start('table', net.ros(executable, '--ros-args', *table))
        net.wait_for_text('table', 'No program reads the frames')
        net.start('launch', net.ros('ros2', 'launch', 'imu_calib', 'stand.launch.py', *words))
        net.wait_for_text('launch', 'Turning: step', seconds=120)
        net.processes['launch'].send_signal(number)
        net.ended('launch')
        launched = ('imu_node', 'calibrator_node', 'turntable_node')
        assert until(
            lambda: not [n for n in launched for line in processes.running().values() if n in line]
        ), processes.running()
        before, rates = one_joint_state(net)
        after, _ = one_joint_state(net)
        assert not any(rates)
        assert after == before
        net.stop('table')


@pytest.mark.parametrize(
    ('name', 'given', 'sentence'),
    [
        ('simulated_stand', {'autostart': 'nope'}, "Argument autostart:=nope: found 'nope'"),
        ('calibrator', {'latitude': '134'}, "Argument latitude:=134: found '134'"),
        ('ascii_table', {'table_port': 'x', 'table_baud': 'fast'}, 'Argument table_baud:=fast'),
        ('bringup', {'baud': 'fast'}, 'Argument baud:=fast'),
        ('table_view', {'rviz': 'perhaps'}, 'Argument rviz:=perhaps'),
        (
            'simulated_stand',
            {'stop_requird': 'true'},
            'no argument stop_requird: is stop_required meant?',
        ),
        # Of a file that it includes.
        ('simulated_stand', {'table_output': 'x'}, 'expected one of setpoint, trajectory'),
        ('simulated_stand', {'rviz': 'true'}, 'apt install ros-jazzy-rviz2'),
        (
            'stand',
            {
                'port': 'socket://127.0.0.1:9',
                'device': 'simulated',
                'latitude': '1',
                'table_output': 'trajectory',
            },
            'apt install ros-jazzy-control-msgs',
        ),
    ],
)
def test_what_cannot_be_launched_is_refused_before_the_first_node(name, given, sentence, tmp_path):
    net = Network(tmp_path)
    wanted = sentence.removeprefix('apt install ros-jazzy-').replace('-', '_')
    if 'apt' in sentence and has_package(wanted):
        pytest.skip(f'{wanted} is here')
    words = [f'{k}:={v}' for k, v in given.items()]
    with nothing_left(net):
        net.start('launch', net.ros('ros2', 'launch', 'imu_calib', f'{name}.launch.py', *words))
        assert net.ended('launch') != 0
    assert sentence.replace('jazzy', os.environ['ROS_DISTRO']) in net.log('launch')
    assert 'process started' not in net.log('launch')


def test_a_table_is_not_launched_in_the_default_domain(tmp_path):
    net = Network(tmp_path)
    given = ['ros2', 'launch', 'imu_calib', 'ascii_table.launch.py', 'table_port:=/dev/ttyUSB9']
    with nothing_left(net):
        net.start('launch', net.ros(*given), ROS_DOMAIN_ID='0')
        assert net.ended('launch') != 0
    assert 'ROS_DOMAIN_ID is 0: in the default domain' in net.log('launch')
    assert 'process started' not in net.log('launch')
