"""The simulated stand under launch_testing.

launch_test test/support/stand_launch.py plan:=twelve_position frame_port:=5760 latitude:=34.65
"""

import unittest

import launch_testing
import launch_testing.actions
import launch_testing.asserts
from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.substitutions import LaunchConfiguration

from launch import LaunchDescription

PATIENCE = 600.0
"""s for a session of a minute, on a machine that many want."""


def generate_test_description():
    """Describe the stand, and the plan that is run on it."""
    names = ('plan', 'frame_port', 'latitude')
    stand = IncludeLaunchDescription(
        get_package_share_directory('imu_calib') + '/launch/simulated_stand.launch.py',
        launch_arguments={
            **{name: LaunchConfiguration(name) for name in names},
            'view': 'false',
        }.items(),
    )
    arguments = [DeclareLaunchArgument(name) for name in names]
    return LaunchDescription([*arguments, stand, launch_testing.actions.ReadyToTest()])


class TheSession(unittest.TestCase):
    """While it runs."""

    def test_it_ends_in_a_calibration(self, proc_output):
        proc_output.assertWaitFor('The plan is done.', timeout=PATIENCE)
        proc_output.assertWaitFor('calibration.yaml is written', timeout=PATIENCE)


@launch_testing.post_shutdown_test()
class TheEnd(unittest.TestCase):
    """After it."""

    def test_every_node_ends_cleanly(self, proc_info):
        self.assertEqual(len(proc_info.process_names()), 4)
        launch_testing.asserts.assertExitCodes(proc_info)

    def test_the_table_stands(self, proc_output):
        launch_testing.asserts.assertInStderr(proc_output, 'the table stands', 'stand_node')
