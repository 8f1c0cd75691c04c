"""A clone in a workspace: what docs/ros.md says builds both packages; what lacks is said."""

import re
import shutil
import sys
import xml.etree.ElementTree as ET

import pytest
from installed import ROS, needs, without_ros
from loopback import CHECKOUT, completed, environment, patience, start

COLCON = shutil.which('colcon')
in_ros = [
    needs('ament_cmake', 'rclpy', verbs=['run']),
    pytest.mark.skipif(COLCON is None, reason='colcon is not installed'),
]
# What a node runs of ROS's own Python has to be found there.
UNBUILT = """
import sys
class Block:
    def find_spec(self, name, path=None, target=None):
        if name.partition('.')[0] == 'imu_calib_msgs':
            raise ModuleNotFoundError("No module named 'imu_calib_msgs'")
        if name == 'rclpy':
            from importlib.machinery import ModuleSpec
            return ModuleSpec('rclpy', self)
    def create_module(self, spec): return None
    def exec_module(self, module): pass
sys.meta_path.insert(0, Block())
from importlib.metadata import EntryPoint
name, program = sys.argv[1:]
sys.argv = [name]
raise SystemExit(EntryPoint(name, program, 'console_scripts').load()())
"""


def link():
    """Return the line of docs/ros.md that makes both packages visible."""
    return re.search(r'^ln -s .*$', (CHECKOUT / 'docs' / 'ros.md').read_text(), re.MULTILINE)[0]


@pytest.fixture
def workspace(tmp_path):
    """Return a workspace with this checkout in it, as a clone would lie there."""
    (tmp_path / 'src').mkdir()
    (tmp_path / 'src' / 'imu_calib').symlink_to(CHECKOUT)
    return tmp_path


def run(folder, command):
    """Run a line of bash where ROS is sourced, and nothing else."""
    return completed(
        ['bash', '-c', f'. {ROS} && {command}'],
        cwd=folder,
        env={**without_ros(), **environment()},
        timeout=patience(120),
    )


def ros_only(test):
    """Skip a test where colcon or ROS lacks something, by name."""
    for mark in in_ros:
        test = mark(test)
    return test


@ros_only
def test_the_page_on_ros_makes_both_packages_visible(workspace):
    assert 'imu_calib_msgs' not in run(workspace, 'colcon list --names-only').stdout.split()
    assert run(workspace, link()).returncode == 0
    listed = run(workspace, 'colcon list --names-only --topological-order')
    # The messages first: what the nodes import is there when they are built.
    assert listed.stdout.split() == ['imu_calib_msgs', 'imu_calib'], listed.stderr


@ros_only
def test_a_build_without_messages_says_so_and_so_does_the_node(workspace):
    built = run(workspace, 'colcon build --packages-select imu_calib')
    assert built.returncode == 0
    errors = re.search(r'ln -s .*', built.stderr)
    assert errors, built.stderr
    ran = run(workspace, '. install/setup.bash && ros2 run imu_calib turntable_node')
    assert ran.returncode == 2
    assert 'Traceback' not in ran.stderr
    assert 'The package imu_calib_msgs is not built' in ran.stderr
    assert link() in ran.stderr
    # What the build told to do, done.
    assert run(workspace, errors[0]).returncode == 0
    assert (workspace / 'src' / 'imu_calib_msgs' / 'package.xml').is_file()


@pytest.mark.parametrize('node', ['turntable_node', 'imu_node'])
def test_a_node_without_its_messages_ends_with_a_sentence(node):
    programs = dict(re.findall(r"\*\(f'\{(node)\} = \{NAME\}([.\w]+):\{node\}'",
                               (CHECKOUT / 'setup.py').read_text()))  # fmt: skip
    program = f'imu_calib{programs["node"]}:{node}'
    process = start(UNBUILT, node, program, IMU_CALIB_MIDDLEWARE='rclpy')
    _, output = process.communicate(timeout=patience())
    assert process.returncode == 2, output
    assert output.startswith(f'{node}: The package imu_calib_msgs is not built')
    assert 'Traceback' not in output


def test_a_robot_needs_no_rviz():
    needed = {e.text for e in ET.parse(CHECKOUT / 'package.xml').iter() if 'depend' in e.tag}
    assert 'robot_state_publisher' in needed
    assert 'rviz2' not in needed


@needs('launch_testing', 'launch_testing_ros', 'launch_pytest')
def test_the_tests_run_in_a_shell_where_ros_is_sourced():
    words = f'{sys.executable} -m pytest test/estimation/test_rows.py'
    ran = run(CHECKOUT, f'env -u PYTEST_DISABLE_PLUGIN_AUTOLOAD -u PYTEST_ADDOPTS {words}')
    assert ran.returncode == 0, ran.stderr
