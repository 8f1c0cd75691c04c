"""The calibrator alone, beside any table and any source of sensor_msgs/Imu."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.parameter_descriptions import ParameterValue

from imu_calib.live.launching import arguments, checks, node, session_arguments, session_parameters
from launch import LaunchDescription

SHARE = Path(get_package_share_directory('imu_calib'))
ARGUMENTS = {
    'units': ('', 'File of several units on the table, in place of imu; empty: one unit.'),
    'without': ('', 'Serial numbers of units of that file that are left out, commas between.'),
    'journal': ('', 'Folder of the recording; empty: journal, in a namespace NAMESPACE/journal.'),
    'output': ('', 'File that takes the result; of several units the folder; empty: as journal.'),
    'namespace': ('', 'Namespace of nodes and topics.'),
    'use_sim_time': ('false', 'Whether /clock is the time.'),
    'params_file': (
        str(SHARE / 'config' / 'nodes' / 'stand.yaml'),
        'File of parameters that are not arguments.',
    ),
    'imu_topic': ('imu/pulses', 'sensor_msgs/Imu of the device.'),
    'joint_topic': ('turntable/joint_states', 'sensor_msgs/JointState of the table.'),
    'setpoint_topic': ('turntable/setpoint', 'imu_calib_msgs/TurntableSetpoint that lead it.'),
}


def generate_launch_description() -> LaunchDescription:
    """Describe the calibrator."""
    typed = dict.fromkeys(('units', 'without', 'journal', 'output'), str)
    parameters = session_parameters() | {
        name: ParameterValue(LaunchConfiguration(name), value_type=kind)
        for name, kind in {**typed, 'use_sim_time': bool}.items()
    }
    calibrator = node(
        package='imu_calib',
        executable='calibrator_node',
        namespace=LaunchConfiguration('namespace'),
        parameters=[LaunchConfiguration('params_file'), parameters],
        remappings=[
            ('imu/pulses', LaunchConfiguration('imu_topic')),
            ('turntable/joint_states', LaunchConfiguration('joint_topic')),
            ('turntable/setpoint', LaunchConfiguration('setpoint_topic')),
        ],
        output='screen',
        # It ends when it cannot go on, not when it is done: then the rest of a stand ends too.
        on_exit=Shutdown(reason='calibrator_node has ended'),
    )
    return LaunchDescription([*session_arguments(), *arguments(ARGUMENTS), checks(), calibrator])
