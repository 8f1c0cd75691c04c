"""Contents of a recording, what it can calibrate, and contradictions."""

from __future__ import annotations

from collections import Counter
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..common.config import Section
from ..common.errors import InputError, NotStated
from ..common.progress import Progress, silent
from ..common.units import DEG, counted
from ..model.earth import VAGUE
from ..recordings.cdr_codec import Kind
from ..recordings.order import Extent
from ..recordings.rosbag2 import Recording
from ..session.keywords import Inspected, Stated, with_keywords
from ..session.metadata import (
    COMPENSATED,
    SERIAL_NUMBER,
    SIMULATED,
    described_imu,
    serial_key,
)
from .opening import open_session
from .recorded import Recorded, recording_at
from .streams import contradiction, difference, units_of

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from .stream_contents import StreamContents


@dataclass(frozen=True)
class Topic:
    """A topic: its messages, and their rate in 1/s (None if unknown)."""

    name: str
    type: str
    messages: int
    rate: float | None


@dataclass(frozen=True)
class TopicClock:
    """Header stamps of a topic against the recorder's log times."""

    topic: str  #: Its name.
    seconds: float  #: From the least stamp to the largest.
    rate: float | None  #: Messages per second of stamps; None without a duration.
    log_seconds: float  #: From the first log time to the last.
    log_rate: float | None  #: Messages per second of log times, likewise.
    #: Ratio of the clock of the stamps to that of the log times, less one; None where the recording
    #: does not show it.
    faster: float | None
    faster_std: float | None  #: Its standard deviation.
    #: Where log times step against stamps: s from the start, and by how much, s.
    log_steps: tuple[tuple[float, float], ...]
    contradiction: str  #: Why the stamps cannot be right; empty if they can.


@dataclass(frozen=True)
class Inspection:
    """Contents of a recording."""

    path: str  #: Path of the recording.
    seconds: float  #: From its first to its last message.
    files: int  #: Number of files.
    compensated: str  #: The calibration that compensated it; empty without one.
    topics: tuple[Topic, ...]  #: All of them.
    units: tuple[str, ...] = ()  #: Type and serial number of each unit, as far as it states them.
    simulated: bool = False  #: Whether its data were simulated.
    lost: tuple[str, ...] = ()  #: Missing or broken data, as far as the topics were examined.
    #: Contents of the streams; None if it is unknown how to read them.
    streams: StreamContents | None = None
    missing_input: str = ''
    """What must be stated to read them, or else to calibrate, in a sentence."""
    clocks: tuple[TopicClock, ...] = ()  #: Stamps of the topics with samples, if these were read.

    def __repr__(self) -> str:
        topics = counted(len(self.topics), 'topic')
        return f'<Inspection of {self.path}: {topics}, {self.seconds:.0f} s>'

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain values, SI units except headings and latitudes (deg)."""
        return asdict(self)


@with_keywords(Inspected)
def inspect(
    bag: Recorded, *, progress: Progress = silent, **stated: Unpack[Inspected]
) -> Inspection:
    """Examine the topics of a recording, then the streams if their meaning is known.

    Args:
        bag: Recording, text file, data frame or arrays, as for `calibrate`.
        progress: Shows the progress.
        **stated: The session, by the keywords of `calibrate`; by default as in the recording.
    """
    session = Stated(**stated)
    return inspect_streams(bag, topics(bag, session, progress), session, progress)


def topics(bag: Recorded, stated: Stated | None = None, progress: Progress = silent) -> Inspection:
    """Examine only the topics."""
    with recording_at(bag, stated) as recording:
        counts, seconds = _extent(recording, progress)
        rows = tuple(
            Topic(
                t.name,
                t.type,
                counts[t.name],
                counts[t.name] / seconds if counts[t.name] and seconds > 0 else None,
            )
            for t in recording.topics
        )
        by = recording.custom_data.get(COMPENSATED, '')
        lost = tuple(recording.losses)
        path = bag if isinstance(bag, str | Path) else recording.path
        units, simulated = _units(recording), SIMULATED in recording.custom_data
        files = len(recording.files)
        return Inspection(str(path), seconds, files, by, rows, units, simulated, lost)


def _units(recording: Recording) -> tuple[str, ...]:
    data, names = recording.custom_data, []
    for topic in units_of(recording) or ('',):
        imu = ''
        with suppress(InputError):
            imu = Section.parse(described_imu(data, topic) or '{}', '').text('id', '')
        serial = data.get(serial_key(topic), data.get(SERIAL_NUMBER, ''))
        names.append(f'{imu} {serial}'.strip())
    return tuple(filter(None, names))


def inspect_streams(
    bag: Recorded, outside: Inspection, stated: Stated, progress: Progress = silent
) -> Inspection:
    """Add the contents of the streams if their meaning is known."""
    try:
        try:
            opened = open_session(bag, stated)
        except NotStated as error:
            # Streams are read at any latitude, and calibrated at one.
            outside = replace(outside, missing_input=str(error))
            opened = open_session(bag, replace(stated, latitude=45.0, latitude_std=VAGUE / DEG))
    except NotStated:
        return replace(outside, clocks=_clocks_alone(bag, stated, progress))

    from .stream_contents import stream_contents

    with opened.recording as recording:
        streams = stream_contents(opened, progress)
        return replace(outside, streams=streams, clocks=_clocks(recording))


def _clocks_alone(bag: Recorded, stated: Stated, progress: Progress) -> tuple[TopicClock, ...]:
    """Read the stamps of samples whose meaning is not known."""
    with recording_at(bag, stated) as recording:
        types = {kind.type_name: kind for kind in (Kind.IMU, Kind.JOINTS)}
        kinds = {
            t.name: types[t.message_type]
            for t in recording.topics
            if t.message_type in types and t.encoding == 'cdr' and t.count != 0
        }
        if kinds:
            with suppress(InputError), progress('reading') as show:
                for _ in recording.read(kinds, show):
                    pass
        return _clocks(recording)


def _clocks(recording: Recording) -> tuple[TopicClock, ...]:
    return tuple(
        _topic_clock(recording, topic, clock.stamps, clock.log)
        for topic, clock in recording.clocks.items()
        if clock.stamps is not None and clock.log is not None
    )


def _topic_clock(recording: Recording, topic: str, stamps: Extent, log: Extent) -> TopicClock:
    clock = recording.clocks[topic]
    ratio, start = clock.ratio(), recording.start_ns or log.first
    wrong = contradiction(recording, topic)
    if not wrong and (said := difference(clock)):
        wrong = f'the header stamps run {said}.'
    return TopicClock(
        topic,
        stamps.seconds,
        stamps.rate,
        log.seconds,
        log.rate,
        None if ratio is None else ratio.value - 1,
        None if ratio is None else ratio.std,
        tuple(((at - start) * 1e-9, by) for at, by in clock.log_steps()),
        wrong,
    )


def _extent(recording: Recording, progress: Progress) -> tuple[Counter[str], float]:
    """Return the number of messages of each topic, and s from the first message to the last.

    A complete recording states both. The summary of a truncated one is missing: its messages are
    counted.
    """
    counts = Counter({t.name: t.count for t in recording.topics if t.count is not None})
    first, last = recording.start_ns, recording.end_ns
    if len(counts) < len(recording.topics):
        counts.clear()
        first = last = None
        with progress('counting') as show:
            for topic, messages, times in recording.messages(show):
                counts[topic.name] += len(messages)
                begins, ends = int(times.log.min()), int(times.log.max())
                first = begins if first is None else min(first, begins)
                last = ends if last is None else max(last, ends)
    return counts, 0.0 if first is None or last is None else (last - first) * 1e-9
