"""What the tests of a live stand under real ROS 2 share: a network, the plan, the launch."""

import re
import shlex
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import processes
import pytest
import rich
import yaml
from installed import ROS, SETUP, has_package, needs, without_ros
from loopback import CHECKOUT, completed, environment, patience, until

from imu_calib.calibration.calibration import Calibration
from imu_calib.cli.processes import free_port, private_network
from imu_calib.common.files import named_file

PACKAGE = None if SETUP is None else SETUP.parent / 'imu_calib'
LAUNCHABLE = PACKAGE is not None and (PACKAGE / 'lib/imu_calib/stand_node').is_file()
NEEDS_ROS = [
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
LOSSLESS = ('--qos-profile-overrides-path', str(CHECKOUT / 'config' / 'record_qos.yaml'))
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
        python = {'PYTHONUNBUFFERED': '1', 'PYTHONFAULTHANDLER': '1'}
        return {**without_ros(), **self.own, **python, **more}

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

    def run(self, *words, seconds=60):
        """Run a tool of ROS to its end."""
        return completed(
            self.ros('ros2', *words), timeout=patience(seconds), env=self.environ(), cwd=self.folder
        )

    def ask(self, *words, seconds=60):
        """Run a tool of ROS to its end; return what it wrote."""
        done = self.run(*words, seconds=seconds)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    def look(self, *words, wanted):
        """Have a tool of ROS look around until it sees all that is wanted; see `seen`."""
        return seen(lambda: self.run(*words, *LOOK), wanted)

    def call(self, service):
        """Call a Trigger service with ROS's tool; return whether it agreed, and what it said."""
        while True:
            answer = self.ask('service', 'call', service, TRIGGER)
            found = re.search(r"success=(True|False), message='(.*)'", answer)
            assert found, answer
            # A busy machine holds the node up, too.
            if 'did not run for a while' not in found[2]:
                return found[1] == 'True', found[2]

    def log(self, name):
        return (self.folder / f'{name}.log').read_text(errors='replace')

    def wait_for_text(self, name, *sentences, seconds=60.0):
        """Wait until a log holds all the sentences."""

        def all_there():
            assert self.processes[name].poll() is None, self.log(name)
            return all(sentence in self.log(name) for sentence in sentences)

        assert until(all_there, patience(seconds)), self.log(name)

    def ended(self, name, seconds=60):
        """Wait until a process has ended by itself; return its exit code.

        Raises:
            AssertionError: It goes on; what it was doing and all logs are said.
        """
        process = self.processes[name]
        try:
            process.wait(timeout=patience(seconds))
        except subprocess.TimeoutExpired:
            # Python then writes what its threads are at.
            process.send_signal(signal.SIGABRT)
            process.wait(timeout=patience())
            logs = ''.join(f'\n--- {one} ---\n{self.log(one)}' for one in self.processes)
            pytest.fail(f'{name} does not end.{logs}')
        return self.processes.pop(name).returncode

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
    options = ['-o', str(net.folder / 'bag'), '--disable-keyboard-controls', *LOSSLESS]
    net.start('record', net.ros('ros2', 'bag', 'record', *options, '--topics', *RECORDED))
    net.wait_for_text('record', *(f"Subscribed to topic '{topic}'" for topic in RECORDED))


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


def one_joint_state(net):
    """Return positions and velocities of the table as it says them now."""
    echo = ('topic', 'echo', '--no-daemon', '--once', '--full-length', '/turntable/joint_states')
    message = yaml.safe_load(net.ask(*echo, 'sensor_msgs/msg/JointState').split('\n---')[0])
    return message['position'], message['velocity']


LOOK = ('--no-daemon', '--spin-time', '2')


def seen(look, wanted):
    """Have a tool look around until it writes all the words that are wanted; return its output.

    It looks for two seconds, for which a busy machine may hold up what it is to see.

    Args:
        look: Runs the tool to its end; returns how that went.
        wanted: Words.
    """
    tries = []

    def all_there():
        tries[:] = [look()]
        return tries[0].returncode == 0 and all(word in tries[0].stdout for word in wanted)

    assert until(all_there), tries[0]
    return tries[0].stdout
