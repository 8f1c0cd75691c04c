"""The calibrator alone, beside any table and any source of sensor_msgs/Imu."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.parameter_descriptions import ParameterValue

from imu_calib.stand.launching import checks, node, session_arguments, session_parameters
from launch import LaunchDescription

SHARE = Path(get_package_share_directory('imu_calib'))
ARGUMENTS = [
    *session_arguments(),
    DeclareLaunchArgument(
        'units',
        default_value='',
        description='File of several units on the table, in place of imu; empty: one unit.',
    ),
    DeclareLaunchArgument(
        'without',
        default_value='',
        description='Serial numbers of units of that file that are left out, commas between.',
    ),
    DeclareLaunchArgument(
        'journal', default_value='journal', description='Folder of the recording.'
    ),
    DeclareLaunchArgument(
        'output',
        default_value='calibration.yaml',
        description='File that takes the result; of several units the folder.',
    ),
    DeclareLaunchArgument(
        'namespace', default_value='', description='Namespace of nodes and topics.'
    ),
    DeclareLaunchArgument(
        'use_sim_time', default_value='false', description='Whether /clock is the time.'
    ),
    DeclareLaunchArgument(
        'params_file',
        default_value=str(SHARE / 'config' / 'nodes' / 'stand.yaml'),
        description='File of parameters that are not arguments.',
    ),
    DeclareLaunchArgument(
        'imu_topic', default_value='imu/pulses', description='sensor_msgs/Imu of the device.'
    ),
    DeclareLaunchArgument(
        'joint_topic',
        default_value='turntable/joint_states',
        description='sensor_msgs/JointState of the table.',
    ),
    DeclareLaunchArgument(
        'setpoint_topic',
        default_value='turntable/setpoint',
        description='imu_calib_msgs/TurntableSetpoint that lead it.',
    ),
]


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
    return LaunchDescription([*ARGUMENTS, checks(), calibrator])
