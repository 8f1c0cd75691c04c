"""The driver of a table whose controller speaks ASCII lines, beside stand.launch.py."""

from launch.actions import DeclareLaunchArgument, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.parameter_descriptions import ParameterValue

from imu_calib.live.launching import checks, node
from launch import LaunchDescription

ARGUMENTS = [
    DeclareLaunchArgument(
        'table_port', description='Port of the controller: a serial port or socket://host:port.'
    ),
    DeclareLaunchArgument(
        'table_baud', default_value='115200', description='Baud rate of a serial port, bit/s.'
    ),
    DeclareLaunchArgument(
        'table', default_value='three_axis', description='Name or file of the turntable.'
    ),
    DeclareLaunchArgument(
        'stop_required',
        default_value='false',
        description='Whether the table moves only while a heartbeat comes on the topic heartbeat.',
    ),
    DeclareLaunchArgument('namespace', default_value='', description='Namespace of all names.'),
]


def generate_launch_description() -> LaunchDescription:
    """Describe the driver."""
    return LaunchDescription(
        [
            *ARGUMENTS,
            checks(table=True),
            node(
                package='imu_calib',
                executable='ascii_table_node',
                namespace=LaunchConfiguration('namespace'),
                parameters=[
                    {
                        'port': ParameterValue(LaunchConfiguration('table_port'), value_type=str),
                        'baud': ParameterValue(LaunchConfiguration('table_baud'), value_type=int),
                        'table': ParameterValue(LaunchConfiguration('table'), value_type=str),
                        'stop_required': ParameterValue(
                            LaunchConfiguration('stop_required'), value_type=bool
                        ),
                    }
                ],
                output='screen',
                on_exit=Shutdown(reason='ascii_table_node has ended'),
            ),
        ]
    )
