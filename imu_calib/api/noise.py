"""The noise of a unit that lies still, from a recording, a text file, a data frame or arrays."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from ..calibration.noise_at_rest import NoiseAtRest, noise_at_rest
from ..common.arguments import checked
from ..common.errors import InputError, NotObservable
from ..common.files import printable
from ..common.processes import by_one_thread
from ..common.progress import Progress, silent
from ..recordings.cdr_codec import Kind
from ..recordings.order import StampSorter
from ..recordings.remote import located
from ..recordings.rosbag2 import Recording, is_storage
from ..segmentation.long_rest import LongRestReader
from ..segmentation.stream_facts import separate_messages_sentence
from ..session.imu import GENERIC, ImuSpec
from ..session.keywords import Named, Stated
from .convert import convert, refuse_columns
from .files import Recorded, recording_at
from .opening import ASSUMED_SI, against_si, assumed_si_imu, units_in_doubt
from .session import serial_of, stated_imu
from .streams import Streams, average_findings, refused_by_stamps, streams_of

_TEXT = ('stamp', 'gyro', 'accel')


@checked
@by_one_thread
def noise(
    bag: Recorded,
    *,
    rate: float | None = None,
    imu: ImuSpec | Named | None = None,
    imu_topic: str | None = None,
    serial: str | None = None,
    stamp: str | None = None,
    gyro: str | None = None,
    accel: str | None = None,
    full_overlap: bool = False,
    progress: Progress = silent,
) -> NoiseAtRest:
    """Estimate the noise of a unit that lies still for hours: Allan deviation and coefficients.

    Memory does not grow with the recording, unless `full_overlap` is asked for.

    Args:
        bag: Folder of rosbag2, one .mcap or .db3 file, or a URL of one that fsspec reads; a text
            file; a pandas.DataFrame with the columns of `read`, its index the time; or arrays: gyro
            and accelerometer, (n, 3) each, or one (n, 6).
        rate: Samples per second of arrays, of a frame whose index is no time, or of the rows of a
            text file.
        imu: Units of the samples; by default as in the recording, else SI.
        imu_topic: Of sensor_msgs/Imu, if there are several.
        serial: Serial number of the unit: of several in a recording it chooses the one.
        stamp: Column of a text file with the time of each row, as for `convert`.
        gyro: Its three columns of the gyros: 'wx,wy,wz:deg/s'.
        accel: Its three columns of the accelerometers: 'ax,ay,az:g'.
        full_overlap: Average over every second difference. By default clusters overlap by 15 of 16
            parts, which changes a deviation by less than a tenth of its standard deviation.
        progress: Shows the progress; nothing by default.

    Returns:
        The noise of the six channels.

    Raises:
        InputError: Unreadable, ambiguous, or not in the units stated.
        NotObservable: The unit did not lie still, or not for long enough.
    """
    stated = Stated(imu=imu, imu_topic=imu_topic, serial=serial, imu_only=True)
    with _recording(bag, rate, (stamp, gyro, accel), imu) as recording:
        streams = streams_of(stated, recording)
        known = stated_imu(stated, recording, streams.imu)
        spec = assumed_si_imu(recording, streams.imu) if known is None else known[0]
        reader, order = LongRestReader(spec, full_overlap=full_overlap), StampSorter()
        _read(recording, streams, reader, order, progress)
        with refused_by_stamps(recording, streams):
            if reader.facts.sensors_separate:
                sentence = separate_messages_sentence(streams.imu, spec.units)
                raise InputError(f'{recording.path}: {sentence}')
            try:
                rest = reader.finish()
            except NotObservable as error:
                raise NotObservable(f'{error} {reader.facts.sentence}'.strip()) from None
        number = serial_of(stated, recording, streams.imu)
        kind = recording.path.name if spec.id == GENERIC else spec.id
        found = noise_at_rest(rest, number or kind)
        findings = (
            *_units_in_doubt(found),
            *([] if known else [ASSUMED_SI]),
            *average_findings(recording, streams.imu),
            *found.findings,
            *recording.losses,
            *order.sentences,
        )
        return replace(found, findings=tuple(map(printable, findings)), topic=streams.imu)


def _units_in_doubt(found: NoiseAtRest) -> list[str]:
    """Warn of mean outputs that no unit at rest has: all densities are then of wrong units."""
    seen = against_si(found.mean[None, 3:], found.mean[None, :3])
    return [units_in_doubt(seen)] if seen else []


def _read(
    recording: Recording,
    streams: Streams,
    reader: LongRestReader,
    order: StampSorter,
    progress: Progress,
) -> None:
    kinds = {streams.imu: Kind.IMU}
    if streams.temperature is not None:
        kinds[streams.temperature] = Kind.TEMPERATURES
    with progress('reading') as show:
        for block in order.sorted_blocks(recording.read(kinds, show), streams.imu):
            reader.add_block(block)


@contextmanager
def _recording(
    bag: Recorded,
    rate: float | None,
    columns: tuple[str | None, str | None, str | None],
    imu: ImuSpec | Named | None,
) -> Iterator[Recording]:
    """Open a recording, or make one of a text file for as long as it is read."""
    stamp, gyro, accel = columns
    if not isinstance(bag, str | Path) or not _is_text(bag):
        refuse_columns(dict(zip(_TEXT, columns, strict=True)))
        with recording_at(bag, rate) as recording:
            yield recording
        return
    if gyro is None or accel is None or (stamp is None and rate is None):
        raise InputError(
            f'{bag} is a text file: name its columns with `stamp` NAME:UNIT (or `rate`), `gyro` '
            f'and `accel` NAME,NAME,NAME:UNIT, or use imu-calib convert {bag} -o OUT.'
        )
    if isinstance(imu, ImuSpec):
        raise InputError('`imu`: of a text file it is the name or the path of a file.')
    with TemporaryDirectory() as folder:
        target = Path(folder, Path(bag).stem)
        rows = None if rate is None else f'{rate!r} Hz'
        convert(bag, target, rate=rows, imu=imu, stamp=stamp, gyro=gyro, accel=accel)
        with recording_at(target) as recording:
            yield recording


def _is_text(bag: Named) -> bool:
    path = located(bag)
    return path.is_file() and not is_storage(path) and path.suffix.lower() in _ENDINGS


_ENDINGS = ('.csv', '.txt', '.tsv', '.log', '.dat')
