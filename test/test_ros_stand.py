"""The live stand under real ROS 2: launched, called, asked, recorded, and mixed with the DDS side.

What runs is the workspace as `colcon build` left it, in a domain of its own on the loopback
interface; no process may be left.
"""

import re
import shlex
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import processes
import pytest
import rich
import yaml
from installed import ROS, has_package, needs
from loopback import CHECKOUT, environment, patience, until
from test_interop import SETUP, has_wheel, without_ros

from imu_calib.calibration import Calibration
from imu_calib.cli import main, stand_session
from imu_calib.cli.processes import free_port, private_network
from imu_calib.share import named_file

PACKAGE = None if SETUP is None else SETUP.parent / 'imu_calib'
LAUNCHABLE = PACKAGE is not None and (PACKAGE / 'lib/imu_calib/stand_node').is_file()
pytestmark = [
    needs(
        'rclpy',
        'rmw_cyclonedds_cpp',
        verbs=['action', 'launch', 'node', 'param', 'run', 'service', 'topic'],
    ),
    pytest.mark.skipif(not LAUNCHABLE, reason='not built: colcon build, source install/setup.bash'),
]
LIMIT = 4.5
BAG = has_package('ros2bag')
# Without it all but the view is tested.
VIEW = ('robot_state_publisher',) if has_package('robot_state_publisher') else ()
VALID = 0
"""As in ImuCalibration.msg."""

LATITUDE = 34.65
RECORDED = (
    '/imu/pulses',
    '/imu/temperature',
    '/turntable/joint_states',
    '/turntable/setpoint',
    '/turntable/state',
    '/calibration',
)
GLOBAL = {'/clock', '/diagnostics', '/parameter_events', '/rosout'}
NODES = ('stand_node', 'imu_node', 'calibrator_node', 'turntable_node')
TRIGGER = 'std_srvs/srv/Trigger'
GOAL = ('action', 'send_goal', '--feedback', '/turntable_node/run_calibration')
GOAL += ('imu_calib_msgs/action/RunCalibration',)
CANCEL = 'action_msgs/srv/CancelGoal'


class Network:
    """A domain of its own, and what runs in it.

    Args:
        folder: Takes the logs.

    """

    def __init__(self, folder):
        self.folder = folder
        self.own = {**environment(), **private_network()}
        self.own['ROS_LOG_DIR'] = str(folder / 'ros_log')
        self.processes = {}

    def environ(self, **more):
        return {**without_ros(), **self.own, 'PYTHONUNBUFFERED': '1', **more}

    def ros(self, *words):
        """Return a command line in the workspace."""
        # What rosdep would install for ROS's own Python is where these tests find it.
        extra = str(Path(rich.__path__[0]).parent) if sys.version_info[:2] == _ros_python() else ''
        path = f'export PYTHONPATH=$PYTHONPATH:{shlex.quote(extra)}'
        return ['bash', '-c', f'. {ROS} && . {SETUP} && {path} && exec {shlex.join(words)}']

    def start(self, name, words, **more):
        """Start a process whose output goes to a log of its name."""
        with (self.folder / f'{name}.log').open('wb') as log:
            self.processes[name] = processes.start(
                words,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=self.environ(**more),
                cwd=self.folder,
            )

    def ask(self, *words, seconds=60):
        """Run a tool of ROS to its end; return what it wrote."""
        done = subprocess.run(
            self.ros('ros2', *words),
            capture_output=True,
            text=True,
            timeout=patience(seconds),
            env=self.environ(),
            cwd=self.folder,
            check=False,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    def call(self, service):
        """Call a Trigger service with ROS's tool; return whether it agreed, and what it said."""
        answer = self.ask('service', 'call', service, TRIGGER)
        found = re.search(r"success=(True|False), message='(.*)'", answer)
        assert found, answer
        return found[1] == 'True', found[2]

    def log(self, name):
        return (self.folder / f'{name}.log').read_text(errors='replace')

    def says(self, name, *sentences, seconds=60.0):
        """Wait until a log holds all the sentences."""

        def all_there():
            assert self.processes[name].poll() is None, self.log(name)
            return all(sentence in self.log(name) for sentence in sentences)

        assert until(all_there, patience(seconds)), self.log(name)

    def stop(self, name):
        """End a process as a user does; return its log."""
        self.processes[name].send_signal(signal.SIGINT)
        self.processes[name].wait(timeout=patience())
        del self.processes[name]
        return self.log(name)


@contextmanager
def nothing_left(net):
    """End the block with nothing running: the test has stopped all that it started."""
    yield net
    assert not net.processes
    assert until(lambda: not processes.running()), processes.running()


def _ros_python():
    folder = next((ROS.parent / 'lib').glob('python3.*'))
    return tuple(int(part) for part in folder.name.removeprefix('python').split('.'))


def short_plan(folder):
    """Write the twelve positions with short dwells and one pair of rates."""
    plan = yaml.safe_load(named_file('plans', 'twelve_position').read_text())
    plan['name'] = 'short'
    plan['dwell'] = '12 s'
    plan['rate_test']['rates'] = ['60 deg/s', '-60 deg/s']
    path = folder / 'short.yaml'
    path.write_text(yaml.safe_dump(plan))
    return path


def viewed():
    """Return the argument that does without the view where it cannot be shown."""
    return {} if VIEW else {'view': 'false'}


def launch(net, **arguments):
    """Launch the simulated stand with the short plan."""
    given = {
        'plan': str(short_plan(net.folder)),
        'latitude': str(LATITUDE),
        'frame_port': str(free_port()),
        **viewed(),
        **arguments,
    }
    words = [f'{name}:={value}' for name, value in given.items()]
    words = ['ros2', 'launch', 'imu_calib', 'simulated_stand.launch.py', *words]
    net.start('launch', net.ros(*words))


def record(net):
    """Record as the documentation says; return when all topics are subscribed to."""
    options = ['-o', str(net.folder / 'bag'), '--disable-keyboard-controls']
    options += ['--qos-profile-overrides-path', str(CHECKOUT / 'config' / 'record_qos.yaml')]
    net.start('record', net.ros('ros2', 'bag', 'record', *options, '--topics', *RECORDED))
    net.says('record', *(f"Subscribed to topic '{topic}'" for topic in RECORDED))


def reprocess(net, recording, *options):
    """Run `imu-calib calibrate` on a recording; return its calibration."""
    output = net.folder / 'offline.yaml'
    words = ('calibrate', str(net.folder / recording), '-o', str(output))
    net.ask('run', 'imu_calib', 'imu-calib', *words, *options)
    return Calibration.load(output)


def same(one, other):
    """Whether two calibrations are the same, bit for bit."""
    return np.array_equal(one.model.vector(), other.model.vector()) and np.array_equal(
        one.covariance, other.covariance
    )


def check_truth(calibration):
    truth = Calibration.load(named_file('truths', 'cao2022_table1')).model.vector()
    error = np.abs(calibration.model.vector() - truth) / calibration.std
    assert error.max() < LIMIT, error.round(1)


@pytest.fixture(scope='module')
def session(tmp_path_factory):
    """A session under `ros2 launch`, looked at and, where it can be, recorded with ROS's tools."""
    net = Network(tmp_path_factory.mktemp('session'))
    seen = SimpleNamespace(net=net)
    look = ('--no-daemon', '--spin-time', '2')
    with nothing_left(net):
        launch(net, autostart='false')
        net.says('launch', 'Waiting for /imu/pulses.', 'Frames come in.')
        if BAG:
            record(net)
        net.start('goal', net.ros('ros2', *GOAL, '{plan: short}'))
        net.says('goal', 'Feedback:')
        seen.parameters = net.ask('param', 'list', '/turntable_node', *look)
        seen.latitude = net.ask('param', 'get', '/calibrator_node', 'latitude', *look)
        seen.described = net.ask('param', 'describe', '/turntable_node', 'setpoint_rate', *look)
        net.says('launch', 'The plan is done.', 'calibration.yaml is written', seconds=120)
        echo = ('topic', 'echo', '--no-daemon', '--once', '--full-length')
        latched = ('--qos-durability', 'transient_local', '--qos-reliability', 'reliable')
        echoed = net.ask(*echo, *latched, '/calibration', 'imu_calib_msgs/msg/ImuCalibration')
        seen.echoed = yaml.safe_load(echoed.split('\n---')[0])
        seen.recorded = net.stop('record') if BAG else ''
        assert net.processes.pop('goal').wait(timeout=patience()) == 0
        seen.goal = net.log('goal')
        seen.launched = net.stop('launch')
    seen.live = Calibration.load(net.folder / 'calibration.yaml')
    return seen


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
def test_what_ros_recorded_reprocessed_is_the_live_result(session):
    assert not re.search('warn|error|lost', session.recorded, re.IGNORECASE), session.recorded
    given = ('--plan', str(session.net.folder / 'short.yaml'), '--imu', 'fog_medium')
    given += ('--table', 'three_axis', '--latitude', str(LATITUDE))
    offline = reprocess(session.net, 'bag', *given)
    assert offline.provenance['samples'] == session.live.provenance['samples']
    assert same(offline, session.live)


def test_services_lead_a_stand_in_its_namespace(tmp_path):
    net = Network(tmp_path)
    with nothing_left(net):
        launch(net, namespace='lab', speed='3.0')
        net.says('launch', 'Turning: step 2')
        assert net.call('/lab/turntable_node/pause')[0]
        net.says('launch', 'Paused')
        refused, why = net.call('/lab/calibrator_node/save')
        assert not refused, why
        listed = net.ask('node', 'list', '--no-daemon', '--spin-time', '2').split()
        assert {f'/lab/{node}' for node in (*NODES, *VIEW)} <= set(listed)
        topics = net.ask('topic', 'list', '--no-daemon', '--spin-time', '2').split()
        assert {t for t in topics if not t.startswith('/lab/')} == GLOBAL
        expected = (*RECORDED, '/estop', *(['/tf'] if VIEW else []))
        assert {f'/lab{topic}' for topic in expected} <= set(topics)
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
        net.says('stand', port, 'Nothing is started.', 'Waiting for /real/imu/pulses.')
        net.says('calibrator', 'Waiting for /my/imu')
        topics = net.ask('topic', 'list', '--no-daemon', '--spin-time', '2').split()
        written = net.stop('calibrator') + net.stop('stand')
    assert ours <= set(topics)
    # The table's leader, the IMU and two calibrators.
    assert written.count('process has finished cleanly') == 4 + len(VIEW)
    assert 'Traceback' not in written


def one_joint_state(net):
    """Return positions and velocities of the table as it says them now."""
    echo = ('topic', 'echo', '--no-daemon', '--once', '--full-length', '/turntable/joint_states')
    message = yaml.safe_load(net.ask(*echo, 'sensor_msgs/msg/JointState').split('\n---')[0])
    return message['position'], message['velocity']


@pytest.mark.parametrize('number', [signal.SIGTERM, signal.SIGHUP, signal.SIGKILL])
def test_the_table_stands_when_the_launcher_alone_is_ended(number, tmp_path):
    net = Network(tmp_path)
    port = free_port()
    table = ['-p', f'port:={port}', '-p', 'speed:=1.0']
    given = {
        'plan': str(short_plan(tmp_path)),
        'latitude': LATITUDE,
        'port': f'socket://127.0.0.1:{port}',
        'device': 'simulated',
        'autostart': 'true',
        'use_sim_time': 'true',
        'view': 'false',
    }
    words = [f'{k}:={v}' for k, v in given.items()]
    with nothing_left(net):
        # The table is no child of the launcher, and outlives it.
        executable = str(PACKAGE / 'lib' / 'imu_calib' / 'stand_node')
        net.start('table', net.ros(executable, '--ros-args', *table))
        net.says('table', 'wait for a reader')
        net.start('launch', net.ros('ros2', 'launch', 'imu_calib', 'stand.launch.py', *words))
        net.says('launch', 'Turning: step', seconds=120)
        launcher = net.processes.pop('launch')
        launcher.send_signal(number)
        launcher.wait(timeout=60)
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
        process = net.processes.pop('launch')
        assert process.wait(timeout=60) != 0
    assert sentence in net.log('launch')
    assert 'process started' not in net.log('launch')


def test_a_table_is_not_launched_in_the_default_domain(tmp_path):
    net = Network(tmp_path)
    given = ['ros2', 'launch', 'imu_calib', 'ascii_table.launch.py', 'table_port:=/dev/ttyUSB9']
    with nothing_left(net):
        net.start('launch', net.ros(*given), ROS_DOMAIN_ID='0')
        process = net.processes.pop('launch')
        assert process.wait(timeout=patience(60)) != 0
    assert 'ROS_DOMAIN_ID is 0: a table is not led in the default domain' in net.log('launch')
    assert 'process started' not in net.log('launch')


@pytest.mark.skipif(not has_wheel(), reason='the wheel cyclonedds is not in this Python')
def test_the_tool_of_ros_cancels_a_goal_of_a_node_without_ros(tmp_path):
    folder = tmp_path / 'stand'
    words = ['stand', str(short_plan(tmp_path)), '-o', str(folder), '--latitude', str(LATITUDE)]
    parameters = stand_session.parameters(main.build_parser().parse_args(words), folder)
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
            words = ['-m', f'imu_calib.nodes.{name}', '--ros-args', '--params-file', str(file)]
            net.start(name, [sys.executable, *words], **alone)
        net.says('turntable_node', 'Joint states come in.')
        net.start('refused', net.ros('ros2', *GOAL, '{plan: another}'))
        assert net.processes.pop('refused').wait(timeout=patience()) == 0
        net.start('goal', net.ros('ros2', *GOAL, '{plan: short}'))
        net.says('goal', 'phase: 3')
        # No identity and no time: all goals.
        net.ask('service', 'call', f'{GOAL[3]}/_action/cancel_goal', CANCEL, '{}')
        net.processes.pop('goal').wait(timeout=patience())
        net.says('turntable_node', 'Cancelled by the client of run_calibration.')
        rates = one_joint_state(net)[1]
        logs = [net.stop(name) for name in ('turntable_node', 'imu_node', 'stand_node')]
    assert 'Goal finished with status: ABORTED' in net.log('refused')
    assert 'names the plan another, this table runs short' in net.log('refused')
    assert 'Goal finished with status: CANCELED' in net.log('goal')
    assert 'Cancelled; the table stands.' in net.log('goal')
    assert not any(rates)
    assert 'Traceback' not in ''.join(logs)


@needs('launch_testing', 'launch_testing_ros')
@pytest.mark.repeats
def test_the_stand_passes_its_launch_test(tmp_path):
    net = Network(tmp_path)
    given = {'plan': short_plan(tmp_path), 'frame_port': free_port(), 'latitude': LATITUDE}
    words = [f'{name}:={value}' for name, value in given.items()]
    with nothing_left(net):
        file = str(CHECKOUT / 'test' / 'stand_launch.py')
        net.start('test', net.ros('launch_test', file, *words))
        process = net.processes.pop('test')
        assert process.wait(timeout=patience(300)) == 0, net.log('test')
    assert net.log('test').count('OK') == 2


@pytest.mark.skipif(not has_wheel(), reason='the wheel cyclonedds is not in this Python')
@pytest.mark.parametrize('on_ros', [{'calibrator_node'}, set(NODES) - {'calibrator_node'}])
def test_nodes_on_both_runtimes_make_one_stand(on_ros, tmp_path):
    folder = tmp_path / 'stand'
    words = ['stand', str(short_plan(tmp_path)), '-o', str(folder), '--latitude', str(LATITUDE)]
    parameters = stand_session.parameters(main.build_parser().parse_args(words), folder)
    folder.mkdir()
    net = Network(tmp_path)
    library = next((PACKAGE / 'lib').glob('python3*/site-packages'))
    with nothing_left(net):
        for name in NODES:
            file = tmp_path / f'{name}.yaml'
            file.write_text(yaml.safe_dump({name: {'ros__parameters': parameters[name]}}))
            words = ['-m', f'imu_calib.nodes.{name}', '--ros-args', '--params-file', str(file)]
            if name in on_ros:
                net.start(name, net.ros('python3', *words), IMU_CALIB_MIDDLEWARE='rclpy')
            else:
                alone = {'IMU_CALIB_MIDDLEWARE': 'dds', 'PYTHONPATH': str(library)}
                net.start(name, [sys.executable, *words], **alone)
        net.says('turntable_node', 'The plan is done.', seconds=120)
        net.says('calibrator_node', 'calibration.yaml is written')
        logs = [net.stop(name) for name in reversed(NODES)]
    assert 'Traceback' not in ''.join(logs)
    live = Calibration.load(folder / 'calibration.yaml')
    check_truth(live)
    assert same(reprocess(net, 'stand/journal'), live)
