"""The launch file that a robot includes: which file, which names, and words for what is missing."""

import importlib.util
import re

import pytest
from installed import has_wheel, load_launch, needs
from loopback import CHECKOUT, until
from ros_stands import LAUNCHABLE, Network, nothing_left
from sessions import truth

from imu_calib.cli.processes import free_port
from imu_calib.common.errors import ImuCalibError

pytestmark = [
    needs('rclpy', 'rmw_cyclonedds_cpp', verbs=['launch', 'topic']),
    pytest.mark.skipif(not LAUNCHABLE, reason='not built: colcon build, source install/setup.bash'),
]
FILE = CHECKOUT / 'launch' / 'bringup.launch.py'


@pytest.fixture
def folder(tmp_path):
    for serial in ('A1', 'B2'):
        truth().save(tmp_path / f'{serial}.yaml')
    return tmp_path


def bringup():
    load_launch()
    spec = importlib.util.spec_from_file_location('bringup', FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def described(**arguments):
    """Return the nodes that the launch file makes of arguments."""
    module = bringup()
    context = load_launch().LaunchContext()
    for name, (default, _) in module.ARGUMENTS.items():
        context.launch_configurations[name] = str(arguments.pop(name, default))
    assert not arguments
    return {node.node_executable: node for node in module._nodes(context)}


def test_the_serial_number_tells_the_file(folder):
    given = {'calibration': '', 'calibrations': str(folder), 'serial': 'B2'}
    assert bringup()._calibration(given) == folder / 'B2.yaml'
    assert set(described(calibrations=folder, serial='B2')) == {'compensator_node'}


def test_a_port_brings_the_imu_node(folder):
    given = {'port': '/dev/null', 'device': 'simulated', 'imu': 'fog_medium'}
    assert set(described(calibration=folder / 'A1.yaml', **given)) == {
        'imu_node',
        'compensator_node',
    }


@pytest.mark.parametrize(
    ('arguments', 'sentence'),
    [
        ({'serial': 'C3'}, 'serial number C3: expected the file .*C3.yaml.* there are: A1, B2'),
        ({'serial': ''}, 'needs serial'),
        ({'serial': 'A1', 'calibration': 'x.yaml'}, 'either calibration'),
        ({'serial': 'A1', 'port': '/dev/null'}, 'give device and imu too'),
        ({'serial': 'A1', 'imu_topic': 'imu/data_raw'}, 'found /imu/data_raw for both'),
        (
            {'serial': 'A1', 'namespace': '/robot/', 'imu_topic': '/robot/imu/data_raw'},
            'found /robot/imu/data_raw for both',
        ),
    ],
)
def test_what_cannot_be_used_is_said_in_a_sentence(folder, arguments, sentence):
    with pytest.raises(RuntimeError, match=sentence):
        described(calibrations=folder, **arguments)


@pytest.mark.parametrize(
    ('started', 'sentence'),
    [
        (['imu_calib', 'bringup.launch.py'], 'no argument seriel: is serial meant?'),
        ([str(FILE)], 'no argument seriel: is serial meant?'),
        # Of a robot, under another name or the same.
        (['robot', 'robot.launch.py'], None),
        (['robot', 'bringup.launch.py'], None),
    ],
)
def test_arguments_of_a_file_that_includes_this_one_are_its_own(started, sentence, monkeypatch):
    module = bringup()
    context = load_launch().LaunchContext()
    context.extend_locals({'current_launch_file_path': str(FILE)})
    monkeypatch.setattr('sys.argv', ['ros2', 'launch', *started, 'seriel:=A1', 'port:=/dev/null'])
    check = module.checks(port=False)
    if sentence is None:
        check.execute(context)
    else:
        with pytest.raises(ImuCalibError, match=re.escape(sentence)):
            check.execute(context)


def test_arguments_of_an_including_file_are_not_checked_as_this_ones(monkeypatch):
    module = bringup()
    context = load_launch().LaunchContext()
    context.extend_locals({'current_launch_file_path': str(FILE)})
    monkeypatch.setattr('sys.argv', ['ros2', 'launch', 'robot', 'robot.launch.py'])
    context.launch_configurations.update(plan='patrol', method='ekf', speed='fast')
    module.checks(port=False).execute(context)
    context.launch_configurations['baud'] = 'fast'
    with pytest.raises(ImuCalibError, match='Argument baud:=fast'):
        module.checks(port=False).execute(context)


OF_A_ROBOT = """
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch_ros.actions import SetParameter


def generate_launch_description():
    ours = IncludeLaunchDescription(
        {file!r}, launch_arguments={{'calibrations': {folder!r}, 'serial': 'A1'}}.items()
    )
    own = DeclareLaunchArgument('plan')
    return LaunchDescription([own, SetParameter('use_sim_time', True), ours])
"""


@needs('lifecycle_msgs', verbs=['param'])
def test_a_robots_file_keeps_its_arguments_and_sets_the_clock_of_all_nodes(folder, tmp_path):
    net = Network(tmp_path)
    robots = tmp_path / 'bringup.launch.py'
    robots.write_text(OF_A_ROBOT.format(file=str(FILE), folder=str(folder)))
    with nothing_left(net):
        net.start('launch', net.ros('ros2', 'launch', str(robots), 'plan:=patrol'))
        net.wait_for_text('launch', 'A1.yaml is applied')
        assert 'True' in net.ask('param', 'get', '--no-daemon', '/compensator_node', 'use_sim_time')
        net.stop('launch')


@needs('lifecycle_msgs', verbs=['param'])
def test_on_a_robot_nobody_waits_for_a_frozen_subscriber(folder, tmp_path):
    net = Network(tmp_path)
    given = {
        'calibrations': folder,
        'serial': 'A1',
        'port': f'socket://127.0.0.1:{free_port()}',
        'device': 'simulated',
        'imu': 'fog_medium',
        'namespace': 'robot',
    }
    listed = [f'{name}:={value}' for name, value in given.items()]
    asked = 'qos_overrides./robot/imu/pulses.publisher.history'
    with nothing_left(net):
        net.start('launch', net.ros('ros2', 'launch', 'imu_calib', 'bringup.launch.py', *listed))
        net.wait_for_text('launch', 'A1.yaml is applied')
        told = until(
            lambda: 'keep_last' in net.ask('param', 'get', '--no-daemon', '/robot/imu_node', asked)
        )
        net.stop('launch')
    assert told


@needs('lifecycle_msgs', verbs=['service'])
def test_a_manager_makes_the_nodes_active(folder, tmp_path):
    net = Network(tmp_path)
    given = {'calibrations': folder, 'serial': 'A1', 'autostart': 'false'}
    listed = [f'{name}:={value}' for name, value in given.items()]

    def change(number):
        """Ask for a transition of lifecycle_msgs/Transition."""
        request = f'{{transition: {{id: {number}}}}}'
        kind = 'lifecycle_msgs/srv/ChangeState'
        answer = net.ask('service', 'call', '/compensator_node/change_state', kind, request)
        return 'success=True' in answer

    with nothing_left(net):
        net.start('launch', net.ros('ros2', 'launch', 'imu_calib', 'bringup.launch.py', *listed))
        # No node becomes active before it is configured.
        assert not change(3)
        assert change(1)
        net.wait_for_text('launch', 'A1.yaml is applied')
        assert change(3)
        net.wait_for_text('launch', 'Active.')
        assert change(4)
        net.wait_for_text('launch', 'Not active: nothing is published.')
        written = net.stop('launch')
    assert 'Traceback' not in written
    assert written.index('A1.yaml is applied') < written.index('Active.')


@pytest.mark.skipif(not has_wheel(), reason='the wheel cyclonedds is not in this Python')
def test_in_a_namespace_the_robots_topics_carry_rates(folder, tmp_path):
    net = Network(tmp_path)
    with nothing_left(net):
        given = {
            'namespace': 'robot',
            'calibrations': str(folder),
            'serial': 'A1',
            'imu_topic': 'driver/raw',
            'frame_id': 'base_imu',
        }
        listed = [f'{name}:={value}' for name, value in given.items()]
        net.start('launch', net.ros('ros2', 'launch', 'imu_calib', 'bringup.launch.py', *listed))
        net.wait_for_text('launch', 'A1.yaml is applied')
        net.look('topic', 'list', wanted=['/robot/driver/raw\n', '/robot/imu/data_raw\n'])
        net.start('source', _python(net, _SOURCE))
        message = net.ask('topic', 'echo', '--no-daemon', '--once', *_TYPED)
        assert 'frame_id: base_imu' in message
        assert '- -1.0' in message
        net.wait_for_text('launch', 'is received and compensated')
        net.stop('source')
        net.stop('launch')


_TYPED = ('/robot/imu/data_raw', 'sensor_msgs/msg/Imu')
_SOURCE = """
import time
import numpy as np
from imu_calib.live import middleware as ros
from imu_calib.recordings.cdr_codec import encode_imu
from imu_calib.live.nodes import qos
from imu_calib.common.stream import ImuBlock


class Driver(ros.Node):
    def __init__(self):
        super().__init__('driver')
        self.publisher = self.create_publisher(ros.messages.Imu, '/robot/driver/raw', qos.stream())
        self.create_timer(0.01, self.publish)

    def publish(self):
        ones = np.ones((1, 3))
        block = ImuBlock(np.array([time.time_ns()]), ones, ones, 'imu_link')
        self.publisher.publish(encode_imu(block).payloads()[0])


ros.run(Driver, args=[])
"""


def _python(net, code):
    return net.ros('python3', '-c', code)
