"""What a robot makes of the stream, with the packages that it has for that, as they are.

The chain is that of docs/robot.md, its two files word for word; the source is a simulated unit that
is tilted, turned a quarter about the vertical and tilted the other way, all in seven seconds.
"""

import json
import re
from types import SimpleNamespace

import downstream_peer as robot
import numpy as np
import pytest
from installed import ROS, needs
from loopback import CHECKOUT, SUPPORT, patience, until
from ros_stands import LAUNCHABLE, Network, nothing_left
from scipy.spatial.transform import Rotation

PACKAGES = ('imu_filter_madgwick', 'robot_localization', 'diagnostic_aggregator')
pytestmark = [
    needs(*PACKAGES, verbs=['launch']),
    pytest.mark.skipif(not LAUNCHABLE, reason='not built: colcon build, source install/setup.bash'),
]
PEER = SUPPORT / 'downstream_peer.py'
MRAD = 1e-3
PERIOD = 0.01
NOISE = 5 * MRAD
"""What imu_filter_madgwick does at its gain of 0.1: each step turns by 2 * 0.1 rad/s * 10 ms, that
is 2 mrad, towards the force of one sample, which itself is off by 2 mrad: pulses of 0.5 mm/s."""

SETTLED = 1.5
"""From the tilt of one sample to that, with the dead time of the first 33 samples, s."""


ON_THE_CLOCK = """
from pathlib import Path

from launch import LaunchDescription
from launch.actions import IncludeLaunchDescription
from launch_ros.actions import SetParameter


def generate_launch_description():
    documented = str(Path(__file__).with_name('imu.launch.py'))
    return LaunchDescription(
        [SetParameter('use_sim_time', True), IncludeLaunchDescription(documented)]
    )
"""
"""The documented file, with the source's time for all: see `downstream_peer.listen_and_drive`."""

OUTDONE = """
/**/compensator_node:
  ros__parameters:
    frame_id: of_the_file
"""
"""Parameters of a robot; the documented file gives frame_id as an argument, which counts."""


def documented(language):
    """Return the file of docs/robot.md in a language: the only one that names imu_filter."""
    text = (CHECKOUT / 'docs' / 'robot.md').read_text()
    (found,) = [b for b in re.findall(rf'```{language}\n(.*?)```', text, re.S) if 'imu_filter' in b]
    return found


@pytest.fixture(scope='module')
def run(tmp_path_factory):
    """Run source, filters and monitor once, all but the monitor on the source's time."""
    folder = tmp_path_factory.mktemp('robot')
    net = Network(folder)
    for name, language in (('imu.launch.py', 'python'), ('imu.yaml', 'yaml')):
        (folder / name).write_text(documented(language).replace('/etc/robot', str(folder)))
    (folder / 'on_the_clock.launch.py').write_text(ON_THE_CLOCK)
    (folder / 'outdone.yaml').write_text(OUTDONE)
    (folder / 'imu').mkdir()
    robot.unit().save(folder / 'imu' / 'A1234.yaml')
    groups = CHECKOUT / 'config' / 'nodes' / 'diagnostics.yaml'
    # Not by `ros2 run`, which hands a signal on only where there is a terminal.
    monitor = ROS.parent / 'lib' / 'diagnostic_aggregator' / 'aggregator_node'
    words = ('--ros-args', '--params-file', str(groups))
    with nothing_left(net):
        clocked = str(folder / 'on_the_clock.launch.py')
        given = ('use_sim_time:=true', f'params_file:={folder / "outdone.yaml"}')
        net.start('launch', net.ros('ros2', 'launch', clocked, *given))
        net.start('monitor', net.ros(str(monitor), *words))
        peer = ('python3', str(PEER), str(folder / 'heard.json'), str(patience()))
        net.start('robot', net.ros(*peer))
        process = net.processes['robot']
        assert until(lambda: process.poll() is not None, 2 * patience()), net.log('launch')
        assert net.processes.pop('robot').returncode == 0, net.log('robot') + net.log('launch')
        net.stop('monitor')
        log = net.stop('launch')
    heard = json.loads((folder / 'heard.json').read_text())
    return SimpleNamespace(log=log, **heard)


class Course:
    """Messages of one topic as columns, beside the truth at their stamps."""

    def __init__(self, run, messages, mounting=0.0):
        self.time = np.array([m['stamp'] - run.epoch for m in messages]) * 1e-9
        truth = Rotation.from_matrix(robot.motion().attitude(self.time))
        self.truth = truth * Rotation.from_euler('z', -mounting)
        self.attitude = Rotation.from_quat([m['orientation'] for m in messages])

    def tilt_error(self):
        """Return the angle between up as found and up as it is, root mean square, rad."""
        settled = self.time > SETTLED
        found, true = (r.as_matrix()[settled, 2] for r in (self.attitude, self.truth))
        return np.sqrt(np.mean(np.sum((found - true) ** 2, axis=1)))

    def turn_error(self):
        """Return by how much the turn between the two rests is missed, rad."""
        error = (self.truth * self.attitude.inv()).as_rotvec()[:, 2]
        before = (self.time > SETTLED) & (self.time < robot.STILL)
        after = self.time > robot.motion().track.end + 0.5
        return error[after].mean() - error[before].mean()


def test_the_filters_orientation_shows_gravity_and_the_turn(run):
    course = Course(run, run.imu)
    assert course.time[-1] > robot.END - 0.1
    assert course.tilt_error() < NOISE
    assert abs(course.turn_error()) < NOISE


def test_the_filters_message_holds_our_rates_frame_and_covariances(run):
    assert {message['frame'] for message in run.imu} == {'imu_link'}
    variances = np.array([message['variances'] for message in run.imu])
    assert (variances > 0).all()
    # Sample by sample: best effort may lose one.
    end = robot.pulses().stamp * 1e-9
    true, _ = robot.motion().increments(np.append(end[0] - PERIOD, end), robot.SITE, np.zeros(3))
    sample = np.searchsorted(end, Course(run, run.imu).time - PERIOD / 2)
    assert len(sample) > 0.9 * len(end)
    found = PERIOD * np.array([message['rate'] for message in run.imu])
    # The unit's own errors are a milliradian in this turn and more; what is left is noise.
    assert np.abs((found - true[sample]).sum(axis=0)).max() < 0.1 * MRAD


def test_the_ekf_takes_what_it_is_given(run):
    assert {tuple(message['frames']) for message in run.odometry} == {('odom', 'base_link')}
    course = Course(run, run.odometry, mounting=1.5708)
    assert course.tilt_error() < NOISE
    assert abs(course.turn_error()) < NOISE
    # It never leaves its place. A tilt error adds g times itself to the velocity each second; the
    # tilt itself, were gravity left in, would add 2 m/s, and the unit's errors 2.5 m/s.
    velocity = np.array([message['velocity'] for message in run.odometry])
    velocity = velocity[course.time > SETTLED]
    assert np.abs(velocity - velocity[0]).max() < 9.8 * NOISE * robot.END


def test_nobody_downstream_has_anything_to_complain_about(run):
    complaints = [
        line
        for line in run.log.splitlines()
        if re.match(r'\[(imu_filter|ekf|static)', line)
        and re.search(r'WARN|ERROR|FATAL', line)
        # A busy machine may hold the filter up; that is not about what it receives.
        and 'Failed to meet update rate' not in line
    ]
    assert complaints == []
    assert run.log.count('process has finished cleanly') == 4


def test_a_sample_that_is_no_number_ends_nobody(run):
    assert np.isfinite([message['orientation'] for message in run.imu]).all()
    figures = run.aggregated['/Calibration stand/Compensation/compensator_node: range'][2]
    assert figures['values that are not numbers'] == '1'


def test_the_monitor_groups_what_the_nodes_say(run):
    head = '/Calibration stand'
    group = f'{head}/Compensation'
    assert run.aggregated[group][0] == 0
    level, sentence, figures = run.aggregated[f'{group}/compensator_node: stream']
    assert (level, sentence) == (0, '/driver/raw is received and compensated.')
    assert {'in', 'out', 'sample interval', 'left out'} <= set(figures)
    # Groups that nobody speaks for on a robot are no error.
    for other in ('Table', 'IMU', 'Calibration'):
        assert run.aggregated[f'{head}/{other}'][0] == 0, run.aggregated
    assert not [n for n in run.aggregated if n.startswith(f'{head}/Other') and 'compens' in n]
