"""Convert text files, bags of ROS 1 and separate topics to recordings."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from ..common.errors import InputError
from ..common.files import BAG_OF_ROS_1, first_bytes, refuse_device, require
from ..common.progress import Progress, silent
from ..recordings.cdr_codec import Kind
from ..recordings.remote import AnyPath, local, located
from ..recordings.rosbag2 import is_storage, open_recording
from ..recordings.storage import RecordingError
from ..recordings.writer import RecordingWriter
from ..session.keywords import InColumns, Named, Stated, with_keywords
from .converted import Converted, joined
from .files import new_folder, removed_on_failure
from .recorded import refuse_columns
from .tables import from_text

if TYPE_CHECKING:
    from typing_extensions import Unpack


@with_keywords(InColumns)
def convert(
    source: Named,
    output: Named,
    *,
    gyro_topic: str | None = None,
    accel_topic: str | None = None,
    imu: Named | None = None,
    progress: Progress = silent,
    **columns: Unpack[InColumns],
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
        gyro_topic: sensor_msgs/Imu whose angular velocity is used.
        accel_topic: sensor_msgs/Imu whose linear acceleration is used.
        imu: Meaning of pulses or counts, written into the recording.
        KEYWORDS
        progress: Shows the progress; nothing by default.
        **columns: The keywords from `stamp` on, all optional.

    Raises:
        InputError: Unreadable, the options do not match the file, or the output exists.
    """
    target = new_folder(output)
    path, stated = located(source), Stated(**columns)
    refuse_device(path)
    of_ros_1 = path.suffix.lower() == '.bag' or first_bytes(path).startswith(BAG_OF_ROS_1)
    if of_ros_1 or path.is_dir() or is_storage(path):
        refuse_columns(stated)
        if of_ros_1:
            return _from_ros1(path, target)
        if path.is_dir() and not any(is_storage(file) for file in path.iterdir()):
            raise InputError(f'{path} is a folder without a recording; name a file to convert.')
        if gyro_topic is None or accel_topic is None:
            raise InputError(
                f'{path} is a recording of rosbag2 already. To join gyros and accelerometers of '
                'two topics, give `gyro_topic` and `accel_topic`.'
            )
        return joined(path, target, gyro_topic, accel_topic, imu, progress)
    table = from_text(path, stated.columns, imu)
    with removed_on_failure(target), RecordingWriter(target, table.custom_data) as writer:
        for topic, samples in table.samples.items():
            samples.write(writer, topic)
    counts = {topic: len(samples) for topic, samples in table.samples.items()}
    return Converted(target, counts, tuple(table.losses))


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
