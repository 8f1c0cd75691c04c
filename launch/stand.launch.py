"""A stand: an IMU's device, the leader of a table, and the calibrator.

The table's own driver is the user's. It follows turntable/setpoint, or where table_output says so a
joint_trajectory_controller follows trajectories, and it publishes turntable/joint_states.
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import (
    DeclareLaunchArgument,
    GroupAction,
    IncludeLaunchDescription,
    OpaqueFunction,
    Shutdown,
)
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.parameter_descriptions import ParameterValue

from imu_calib.live.launching import arguments, checks, devices, node, session_arguments
from launch import Action, LaunchContext, LaunchDescription

SHARE = Path(get_package_share_directory('imu_calib'))
ARGUMENTS = {
    'port': (
        '',
        'Port of the IMU: a serial port, socket://host:port, udp://host:port, '
        'or a file; needed without units.',
    ),
    'device': ('', "Name or file of the frames' format; needed without units."),
    'units': ('', 'File of several units on the table, with the port of each; empty: one unit.'),
    'without': ('', 'Serial numbers of units of that file that are left out, commas between.'),
    'baud': ('0', "Baud rate of a serial port, bit/s; 0: as the device's file says, else 115200."),
    'autostart': ('false', 'Whether the plan starts by itself; else call turntable_node/start.'),
    'stop_required': ('false', 'Whether nothing moves without a heartbeat on the topic heartbeat.'),
    'view': ('true', 'Whether robot_state_publisher shows the table.'),
    'rviz': ('false', 'Whether RViz shows it.'),
}


def generate_launch_description() -> LaunchDescription:
    """Describe the stand."""
    return LaunchDescription(
        [
            *session_arguments('latitude'),
            *arguments(ARGUMENTS),
            DeclareLaunchArgument(
                'table_output',
                default_value='setpoint',
                choices=['setpoint', 'trajectory'],
                description='How the table is driven: setpoints, or trajectories of ros2_control.',
            ),
            checks(view=True, table=True),
            _include('calibrator.launch.py', latitude=LaunchConfiguration('latitude')),
            OpaqueFunction(function=_devices),
            _node(
                'turntable_node',
                ('output', 'table_output'),
                plan=str,
                table=str,
                autostart=bool,
                stop_required=bool,
            ),
            GroupAction(
                [_include('table_view.launch.py')],
                scoped=False,
                condition=IfCondition(LaunchConfiguration('view')),
            ),
        ]
    )


def _devices(context: LaunchContext) -> list[Action]:
    """Return an imu_node for each unit; of several, one that ends takes no other with it."""
    given = dict(context.launch_configurations)
    units = devices(given)
    if not units:
        return [_node('imu_node', imu=str, port=str, device=str, baud=int)]
    clock = {'use_sim_time': given['use_sim_time'].lower() == 'true'}
    return [
        node(
            package='imu_calib',
            executable='imu_node',
            namespace='/'.join(filter(None, [given['namespace'], unit.namespace])),
            parameters=[given['params_file'], {**clock, **unit.parameters}],
            remappings=unit.remappings,
            output='screen',
        )
        for unit in units
    ]


def _include(name: str, **required: LaunchConfiguration) -> IncludeLaunchDescription:
    """Include a launch file; what it does not require, it takes from this one's arguments."""
    return IncludeLaunchDescription(str(SHARE / 'launch' / name), launch_arguments=required.items())


def _node(name: str, *renamed: tuple[str, str], **arguments: type) -> Action:
    """Return a node whose parameters are arguments, of other names where they are renamed."""
    typed = {name: (name, kind) for name, kind in {'use_sim_time': bool, **arguments}.items()}
    typed |= {parameter: (argument, str) for parameter, argument in renamed}
    return node(
        package='imu_calib',
        executable=name,
        namespace=LaunchConfiguration('namespace'),
        parameters=[
            LaunchConfiguration('params_file'),
            {
                parameter: ParameterValue(LaunchConfiguration(argument), value_type=kind)
                for parameter, (argument, kind) in typed.items()
            },
        ],
        output='screen',
        # Half a stand is none: what ends early ends all, and the table stops.
        on_exit=Shutdown(reason=f'{name} has ended'),
    )
