"""A stand with simulated devices: the launch file of real ones, and what stands in for them."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import IncludeLaunchDescription, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.parameter_descriptions import ParameterValue

from imu_calib.live.launching import arguments, checks, node
from launch import LaunchDescription

SHARE = Path(get_package_share_directory('imu_calib'))
ARGUMENTS = {
    'plan': ('twelve_position', 'Name or file of the plan.'),
    'imu': ('fog_medium', 'Name or file of the IMU.'),
    'table': ('three_axis', 'Name or file of the turntable.'),
    'truth': ('cao2022_table1', "Name or file of the unit's true parameters."),
    'latitude': ('34.65', 'Latitude of the stand, deg, negative in the south.'),
    'height': ('0.0', 'Height above the ellipsoid, m.'),
    'true_azimuth': ('0.0', "True heading of the table's zero, deg."),
    'seed': ('0', 'Same seed, same errors of the devices.'),
    'speed': ('0.0', 'Highest speed in multiples of real time; 0: as fast as the nodes follow.'),
    'frame_port': ('5760', 'TCP port of the simulated IMU.'),
    'autostart': ('true', 'Whether the plan starts by itself; else call turntable_node/start.'),
    'stop_required': ('false', 'Whether nothing moves without a heartbeat on heartbeat.'),
    'params_file': (
        str(SHARE / 'config' / 'nodes' / 'simulated_stand.yaml'),
        'File of parameters that are not arguments.',
    ),
    'namespace': ('', 'Namespace of nodes and topics.'),
    'view': ('true', 'Whether robot_state_publisher shows the table.'),
    'rviz': ('false', 'Whether RViz shows it.'),
}


def generate_launch_description() -> LaunchDescription:
    """Describe the stand."""
    typed = {
        str: {'imu': 'imu', 'table': 'table', 'truth': 'truth'},
        float: {name: name for name in ('latitude', 'height', 'speed')}
        | {'azimuth': 'true_azimuth'},
        int: {'seed': 'seed', 'port': 'frame_port'},
        bool: {'stop_required': 'stop_required'},
    }
    parameters = {
        parameter: ParameterValue(LaunchConfiguration(argument), value_type=kind)
        for kind, names in typed.items()
        for parameter, argument in names.items()
    }
    devices = node(
        package='imu_calib',
        executable='stand_node',
        namespace=LaunchConfiguration('namespace'),
        parameters=[LaunchConfiguration('params_file'), parameters],
        output='screen',
        on_exit=Shutdown(reason='stand_node has ended'),
    )
    stand = IncludeLaunchDescription(
        str(SHARE / 'launch' / 'stand.launch.py'),
        launch_arguments={
            'port': ['socket://127.0.0.1:', LaunchConfiguration('frame_port')],
            'device': 'simulated',
            'latitude': LaunchConfiguration('latitude'),
            'use_sim_time': 'true',
        }.items(),
    )
    return LaunchDescription(
        [
            *arguments(ARGUMENTS),
            checks(view=True),
            devices,
            stand,
        ]
    )
