"""A robot's IMU: its device, where there is one to read, and the calibration applied.

    ros2 launch imu_calib bringup.launch.py port:=/dev/ttyUSB0 device:=my_frames.yaml \
        imu:=my_imu.yaml calibrations:=/etc/robot/imu serial:=A1234

applies /etc/robot/imu/A1234.yaml. Without a port another driver's raw stream is taken (imu_topic).
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.parameter_descriptions import ParameterValue

from imu_calib.live.launching import arguments, checks, node
from launch import Action, LaunchContext, LaunchDescription

SHARE = Path(get_package_share_directory('imu_calib'))
_AGAIN = 1.0
"""s until a node that ended is started again: one that fails at once does not fill the log."""
_KEPT = 1000
"""Samples of the raw stream kept for a slow subscriber: half a second at 2 kHz. A choice."""
ARGUMENTS = {
    'calibrations': ('', 'Folder of calibration files, one per unit: SERIAL.yaml.'),
    'serial': ('', 'Serial number of the unit; calibrations of other units are refused.'),
    'calibration': ('', 'File instead of that folder; neither: the topic calibration.'),
    'port': ('', 'Port of the IMU; empty: another driver publishes imu_topic.'),
    'device': ('', "Name or file of the frames' format; needed with a port."),
    'imu': ('', 'Name or file of the IMU; needed with a port.'),
    'baud': ('0', "Baud rate of a serial port, bit/s; 0: as the device's file says, else 115200."),
    'frame_id': ('', "Frame of imu/data_raw; empty: the raw stream's (imu_link from a port)."),
    'namespace': ('', 'Namespace of nodes and topics.'),
    'imu_topic': ('imu/pulses', 'Raw sensor_msgs/Imu.'),
    'skew_topic': ('imu/skew', 'Topic of a skewed gyro, where there is one.'),
    'temperature_topic': ('imu/temperature', 'sensor_msgs/Temperature of the unit.'),
    'output_topic': ('imu/data_raw', 'Rates and specific forces, SI units.'),
    'autostart': ('true', 'Whether the nodes become active by themselves; false: by a manager.'),
    'use_sim_time': ('', 'Whether /clock is the time; empty: as set for all nodes, else false.'),
    'params_file': (
        str(SHARE / 'config' / 'nodes' / 'bringup.yaml'),
        'File of parameters that are not arguments.',
    ),
}


class BringupError(RuntimeError):
    """An argument that cannot be used; the text is for a person."""


def generate_launch_description() -> LaunchDescription:
    """Describe the IMU of a robot."""
    return LaunchDescription(
        [
            *arguments(ARGUMENTS),
            # On a robot the device may come later.
            checks(port=False),
            OpaqueFunction(function=_nodes),
        ]
    )


def _nodes(context: LaunchContext) -> list:
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    raw, output = (_full(given[name], given) for name in ('imu_topic', 'output_topic'))
    if raw == output:
        raise BringupError(
            f'imu_topic and output_topic: found {raw} for both. Give another output_topic, for '
            'example output_topic:=imu/data_calibrated.'
        )
    compensator = {'calibration': str(_calibration(given)), 'serial_number': given['serial']}
    nodes = []
    if given['port']:
        missing = [name for name in ('device', 'imu') if not given[name]]
        if missing:
            raise BringupError(f'With port:={given["port"]}, give {" and ".join(missing)} too.')
        read = {name: given[name] for name in ('port', 'device', 'imu')}
        read['baud'] = int(given['baud'])
        # On a stand a sample is worth a wait; on a robot one frozen subscriber must not silence
        # the unit for all others.
        history = f'qos_overrides.{raw}.publisher'
        read |= {f'{history}.history': 'keep_last', f'{history}.depth': _KEPT}
        if given['frame_id']:
            read['frame_id'] = given['frame_id']
        nodes.append(_node('imu_node', given, read))
    if given['frame_id']:
        compensator['frame_id'] = given['frame_id']
    return [*nodes, _node('compensator_node', given, compensator)]


def _full(topic: str, given: dict[str, str]) -> str:
    """Return the name of a topic from the root on."""
    return topic if topic.startswith('/') else f'/{given["namespace"]}/{topic}'.replace('//', '/')


def _calibration(given: dict[str, str]) -> Path | str:
    """Return the file of the unit, which must be there; nothing where none is named."""
    if given['calibration'] and given['calibrations']:
        raise BringupError('Give either calibration, or calibrations and serial.')
    if given['calibration']:
        file = Path(given['calibration']).expanduser()
        if not file.is_file():
            raise BringupError(f'calibration: there is no file {file}.')
        return file
    if not given['calibrations']:
        return ''
    if not given['serial']:
        raise BringupError('calibrations (a folder) needs serial (which unit of it).')
    folder = Path(given['calibrations']).expanduser()
    file = folder / f'{given["serial"]}.yaml'
    if not file.is_file():
        known = ', '.join(sorted(path.stem for path in folder.glob('*.yaml'))) or 'none'
        raise BringupError(
            f'No calibration of the unit with serial number {given["serial"]}: expected the file '
            f'{file}; the serial numbers there are: {known}.'
        )
    return file


def _node(name: str, given: dict[str, str], parameters: dict[str, object]) -> Action:
    """Return a node that is started, and made active, anew where it ends: a robot goes on."""
    flags = {
        key: ParameterValue(given[key].lower() in {'true', '1'}, value_type=bool)
        for key in ('use_sim_time', 'autostart')
        if given[key]
    }
    typed = {
        key: ParameterValue(value, value_type=type(value)) for key, value in parameters.items()
    }
    return node(
        package='imu_calib',
        executable=name,
        namespace=given['namespace'],
        parameters=[given['params_file'], {**flags, **typed}],
        remappings=[
            ('imu/pulses', given['imu_topic']),
            ('imu/skew', given['skew_topic']),
            ('imu/temperature', given['temperature_topic']),
            ('imu/data_raw', given['output_topic']),
        ],
        output='screen',
        respawn=True,
        respawn_delay=_AGAIN,
    )
