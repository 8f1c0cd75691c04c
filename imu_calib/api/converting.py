"""Convert recordings of other software to recordings that every command reads."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from ..common.config import checked
from ..common.errors import InputError
from ..common.files import refuse_device, require, user_path
from ..common.other_formats import BAG_OF_ROS_1
from ..common.parallel import Progress, silent
from ..recordings.remote import AnyPath, local, located
from ..recordings.rosbag2 import Kind, is_storage, open_recording
from ..recordings.storage import RecordingError
from ..recordings.text import read_sensors, read_text
from .convert import joined
from .convert_text import from_text
from .converted import Converted
from .named import Named
from .outputs import removed_on_failure


@checked
def convert(
    source: Named,
    output: Named,
    *,
    stamp: str | None = None,
    rate: str | None = None,
    gyro: str | None = None,
    accel: str | None = None,
    joints: str | None = None,
    temperature: str | None = None,
    delimiter: str | None = None,
    gyro_topic: str | None = None,
    accel_topic: str | None = None,
    accel_file: Named | None = None,
    accel_stamp: str | None = None,
    imu: Named | None = None,
    progress: Progress = silent,
) -> Converted:
    """Convert a recording of other software to rosbag2 (mcap).

    State the columns of a text file: 'NAME,NAME,NAME:UNIT', each NAME as in its heading or a place
    counted from 1. A bag of ROS 1 needs no such options. Gyros and accelerometers on separate
    topics (`gyro_topic`, `accel_topic`) or in separate text files (`accel_file`) are joined: the
    accelerometers are interpolated linearly at the stamps of the gyros. So are those in rows or
    messages of their own: name one topic twice.

    Args:
        source: Text file, bag of ROS 1, recording of rosbag2, or a URL of one that fsspec reads.
        output: Folder to create.
        stamp: Column of each row's time, for instance 't:s' (s, ms, us, ns).
        rate: Of the rows, if there is no column of time: '200 Hz'; a number alone is in Hz.
        gyro: Three columns, for instance 'wx,wy,wz:deg/s'; units of rate or angle, pulse, or count.
        accel: Three columns, for instance '5,6,7:g'; units of acceleration or velocity, pulse,
            or count.
        joints: Columns with the names of the table's joints, for instance 'outer,inner:deg'.
        temperature: One column, 'NAME:degC'.
        delimiter: Between fields; None detects it.
        gyro_topic: sensor_msgs/Imu whose angular velocity is used.
        accel_topic: sensor_msgs/Imu whose linear acceleration is used.
        accel_file: Text file of the accelerometers, if `source` holds only the gyros.
        accel_stamp: Column of the time in `accel_file`; None: as `stamp`.
        imu: Meaning of pulses or counts, written into the recording.
        progress: Shows the progress; nothing by default.

    Raises:
        InputError: Unreadable, the options do not match the file, or the output exists.
    """
    target = user_path(output)
    if target.exists():
        raise InputError(f'{target}: exists already; name a folder that does not.')
    path = located(source)
    refuse_device(path)
    columns = {'stamp': stamp, 'gyro': gyro, 'accel': accel, 'joints': joints}
    columns |= {'temperature': temperature, 'rate': rate, 'accel_stamp': accel_stamp}
    columns |= {'accel_file': None if accel_file is None else str(accel_file)}
    of_ros_1 = path.suffix.lower() == '.bag' or _is_bag_of_ros_1(path)
    if of_ros_1 or path.is_dir() or is_storage(path):
        given = [name for name, value in columns.items() if value is not None]
        if given:
            raise InputError(f'`{given[0]}` names columns of a text file; {path} is a recording.')
        if of_ros_1:
            return _from_ros1(path, target)
        if path.is_dir() and not any(is_storage(file) for file in path.iterdir()):
            raise InputError(f'{path} is a folder without a recording; name a file to convert.')
        if gyro_topic is None or accel_topic is None:
            raise InputError(
                f'{path} is a recording of rosbag2 already. Where gyros and accelerometers are on '
                'topics of their own, give `gyro_topic` and `accel_topic`.'
            )
        return joined(path, target, gyro_topic, accel_topic, imu, progress)
    text, own = read_sensors(path, delimiter)
    needed = {'`gyro` NAME,NAME,NAME:UNIT': gyro, '`accel` NAME,NAME,NAME:UNIT': accel}
    needed |= {'`stamp` NAME:UNIT or `rate` HZ': stamp or rate}
    lacking = [name for name, value in needed.items() if value is None]
    if gyro is None or accel is None or lacking:
        other = '' if accel_file else ' Accelerometers in a file of their own: `accel_file`.'
        raise InputError(
            f'{path}: its columns are {", ".join(text.names)}. Say which are which: '
            f'{", ".join(lacking)} {"is" if len(lacking) == 1 else "are"} not stated.{other}'
        )
    if stamp is not None and rate is not None:
        raise InputError(
            f'`stamp` {stamp} and `rate` {rate} both say when the rows were: give the one or the '
            'other.'
        )
    if accel_file is None and own is None:
        if accel_stamp is not None:
            raise InputError('`accel_stamp` is the time in `accel_file`, which is not given.')
        return from_text(text, target, stamp, rate, gyro, accel, joints, temperature, imu)
    if stamp is None:
        raise InputError(
            'Gyros and accelerometers in rows of their own are joined by the time of the rows: '
            'give `stamp`, no `rate`.'
        )
    forces = own if accel_file is None else read_text(located(accel_file), delimiter)
    others = (joints, temperature, imu, forces, accel_stamp)
    return from_text(text, target, stamp, None, gyro, accel, *others)


def _is_bag_of_ros_1(path: AnyPath) -> bool:
    try:
        with path.open('rb') as file:
            return file.read(len(BAG_OF_ROS_1)) == BAG_OF_ROS_1
    except OSError:
        return False


def _from_ros1(path: AnyPath, target: Path) -> Converted:
    """Convert a bag of ROS 1, with the messages that calibration uses."""
    require('rosbags', f'{path}: a bag of ROS 1', 'ros1')
    from rosbags.convert import ConverterError
    from rosbags.convert import convert as rewritten
    from rosbags.typesys import Stores, get_typestore

    stores = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_JAZZY)
    types = [k.type_name for k in (Kind.IMU, Kind.JOINTS, Kind.TEMPERATURES)]
    bag = Path()
    try:
        with removed_on_failure(target), TemporaryDirectory() as folder:
            # rosbags goes by the ending.
            bag = Path(folder, 'bag.bag')
            bag.symlink_to(local(path).resolve())
            rewritten([bag], target, 'mcap', 9, None, 'none', *stores, [], [], [], types)
            with open_recording(target) as recording:
                counts = {topic.name: topic.count or 0 for topic in recording.topics}
    except (ConverterError, RecordingError) as error:
        reason = str(error).replace(str(bag), str(path))
        raise InputError(
            f'{path}: cannot be converted: {reason} Expected a bag of ROS 1 with one of '
            f'{", ".join(types)}; rosbag reindex completes one whose recorder did not finish.'
        ) from None
    return Converted(target, counts, ())
