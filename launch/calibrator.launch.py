"""The calibrator alone, beside any table and any source of sensor_msgs/Imu."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.parameter_descriptions import ParameterValue

from imu_calib.stand.launching import checks, node
from launch import LaunchDescription

SHARE = Path(get_package_share_directory('imu_calib'))
ARGUMENTS = [
    DeclareLaunchArgument(
        'plan', default_value='twelve_position', description='Name or file of the plan.'
    ),
    DeclareLaunchArgument(
        'imu', default_value='fog_medium', description='Name or file of the IMU.'
    ),
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
        'table', default_value='three_axis', description='Name or file of the turntable.'
    ),
    DeclareLaunchArgument(
        'latitude', description='Latitude of the stand, deg, negative in the south.'
    ),
    DeclareLaunchArgument(
        'latitude_std',
        default_value='nan',
        description='Standard deviation of the latitude, deg; nan: 0.01.',
    ),
    DeclareLaunchArgument(
        'height', default_value='nan', description='Height above the ellipsoid, m; nan: not known.'
    ),
    DeclareLaunchArgument(
        'height_std',
        default_value='nan',
        description='Standard deviation of the height, m; nan: 0 if it is stated.',
    ),
    DeclareLaunchArgument(
        'gravity',
        default_value='nan',
        description='Gravity as measured, m/s^2; nan: normal gravity.',
    ),
    DeclareLaunchArgument(
        'gravity_std',
        default_value='nan',
        description='Standard deviation of gravity, m/s^2; nan: 0 if measured, 30e-5 if not.',
    ),
    DeclareLaunchArgument(
        'azimuth', default_value='nan', description="Heading of the table's zero, deg, if known."
    ),
    DeclareLaunchArgument(
        'method', default_value='', description='The estimator; empty: joint where it applies.'
    ),
    DeclareLaunchArgument(
        'terms',
        default_value='auto',
        description=(
            'Terms that the joint estimate adds: auto (those that are significant), none, or names '
            'with commas between.'
        ),
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
    typed = {
        bool: ('use_sim_time',),
        float: (
            'latitude',
            'latitude_std',
            'height',
            'height_std',
            'gravity',
            'gravity_std',
            'azimuth',
        ),
        str: (
            *('plan', 'imu', 'units', 'without', 'table', 'method', 'terms'),
            *('journal', 'output'),
        ),
    }
    parameters = {
        name: ParameterValue(LaunchConfiguration(name), value_type=kind)
        for kind, names in typed.items()
        for name in names
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
