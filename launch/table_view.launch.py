"""The table as the joint states move it: robot_state_publisher, and RViz where it is wanted."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, LogInfo, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.parameter_descriptions import ParameterValue

from imu_calib.live.launching import checks, node
from launch import LaunchContext, LaunchDescription

SHARE = Path(get_package_share_directory('imu_calib'))
# Two stands in one domain are told apart by their namespaces; so are their frames.
FRAMES = [('/tf', 'tf'), ('/tf_static', 'tf_static')]


def generate_launch_description() -> LaunchDescription:
    """Describe the view of a table."""
    return LaunchDescription(
        [
            DeclareLaunchArgument('table', default_value='three_axis', description='Its name.'),
            DeclareLaunchArgument(
                'urdf', default_value='', description="File; empty: the shipped one of the table's"
            ),
            DeclareLaunchArgument(
                'rviz', default_value='false', description='Whether RViz shows it.'
            ),
            DeclareLaunchArgument(
                'namespace', default_value='', description='Namespace of all topics.'
            ),
            DeclareLaunchArgument(
                'use_sim_time', default_value='false', description='Whether /clock is the time.'
            ),
            checks(view=True),
            OpaqueFunction(function=_view),
        ]
    )


def _view(context: LaunchContext) -> list:
    table, urdf, rviz = (
        LaunchConfiguration(name).perform(context) for name in ('table', 'urdf', 'rviz')
    )
    file = Path(urdf).expanduser() if urdf else SHARE / 'urdf' / f'{table}.urdf'
    if not file.is_file():
        return [LogInfo(msg=f'The table is not shown: there is no {file}.')]
    description = ParameterValue(file.read_text(encoding='utf-8'), value_type=str)
    common = {'namespace': LaunchConfiguration('namespace'), 'output': 'screen'}
    time = {'use_sim_time': ParameterValue(LaunchConfiguration('use_sim_time'), value_type=bool)}
    actions = [
        node(
            foreign=True,
            package='robot_state_publisher',
            executable='robot_state_publisher',
            parameters=[time, {'robot_description': description}],
            remappings=[('joint_states', 'turntable/joint_states'), *FRAMES],
            **common,
        )
    ]
    if rviz.lower() != 'true':
        return actions
    return [
        *actions,
        node(
            foreign=True,
            package='rviz2',
            executable='rviz2',
            arguments=['-d', str(SHARE / 'config' / 'rviz' / 'stand.rviz')],
            parameters=[time],
            remappings=[('/robot_description', 'robot_description'), *FRAMES],
            **common,
        ),
    ]
