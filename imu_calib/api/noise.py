"""The noise of a unit that lies still, from a recording, a text file, a data frame or arrays."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from ..calibration.noise_at_rest import NoiseAtRest, noise_at_rest
from ..common.errors import InputError, NotObservable
from ..common.files import printable
from ..common.finding import is_warning
from ..common.processes import by_one_thread
from ..common.progress import Progress, silent
from ..common.stream import Floats
from ..recordings.cdr_codec import Kind
from ..recordings.order import StampSorter
from ..recordings.rosbag2 import Recording
from ..segmentation.long_rest import LongRestReader
from ..segmentation.stream_facts import separate_messages_sentence
from ..session.imu import GENERIC
from ..session.keywords import Columned, Stated, with_keywords
from .opening import ASSUMED_SI, assumed_si_imu
from .recorded import Recorded, recording_at
from .session import serial_of, stated_imu
from .streams import (
    Streams,
    against_si,
    average_findings,
    refused_by_stamps,
    streams_of,
    units_in_doubt,
)

if TYPE_CHECKING:
    from typing_extensions import Unpack


@with_keywords(Columned)
@by_one_thread
def noise(
    bag: Recorded,
    *,
    full_overlap: bool = False,
    progress: Progress = silent,
    **stated: Unpack[Columned],
) -> NoiseAtRest:
    """Estimate the noise of a unit that lies still for hours: Allan deviation and coefficients.

    Memory does not grow with a recording of rosbag2, unless `full_overlap` is asked for.

    Args:
        bag: Recording, text file, data frame or arrays, as for `calibrate`.
        full_overlap: Average over every second difference. By default clusters overlap by 15 of 16
            parts, which changes a deviation by less than a tenth of its standard deviation.
        KEYWORDS
        progress: Shows the progress; nothing by default.
        **stated: The unit and its samples, by the keywords from `imu` on, all optional.

    Returns:
        The noise of the six channels.

    Raises:
        InputError: Unreadable, ambiguous, or not in the units stated.
        NotObservable: The unit did not lie still, or not for long enough.
    """
    session = Stated(**stated, imu_only=True)
    with recording_at(bag, session) as recording:
        streams = streams_of(session, recording)
        known = stated_imu(session, recording, streams.imu)
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
        number = serial_of(session, recording, streams.imu)
        kind = recording.path.name if spec.id == GENERIC else spec.id
        found = noise_at_rest(rest, number or kind)
        findings = (
            *([] if any(map(is_warning, recording.losses)) else _units_in_doubt(rest.means)),
            *([] if known else [ASSUMED_SI]),
            *average_findings(recording, streams.imu),
            *found.findings,
            *recording.losses,
            *order.sentences,
        )
        return replace(found, findings=tuple(map(printable, findings)), topic=streams.imu)


def _units_in_doubt(means: Floats) -> list[str]:
    """Warn of outputs (k, 6) that no unit at rest has: all densities are then of wrong units."""
    seen = against_si(means[:, 3:], means[:, :3])
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
