"""Contents of a recording, what it can calibrate, and contradictions."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from ..bags import Recording, open_recording
from ..errors import NotStated
from ..metadata import COMPENSATED
from ..units import counted
from .keywords import Session, with_keywords
from .named import Named
from .opening import open_session
from .progress import Progress, silent
from .stated import Stated

if TYPE_CHECKING:
    from typing_extensions import Unpack

    # Loaded only if it is stated how the streams are to be read.
    from .stream_contents import StreamContents


@dataclass(frozen=True)
class Topic:
    """A topic: its messages, and their rate in 1/s (None if unknown)."""

    name: str
    type: str
    messages: int
    rate: float | None


@dataclass(frozen=True)
class Inspection:
    """Contents of a recording.

    Attributes:
        path: Path of the recording.
        seconds: From its first to its last message.
        files: Number of files.
        compensated: The calibration that compensated it; empty without one.
        topics: All of them.
        lost: Missing or broken data, as far as the topics were examined.
        streams: Contents of the streams; None if it is unknown how to read them.
        missing_input: What must be stated to read them, in a sentence.
    """

    path: str
    seconds: float
    files: int
    compensated: str
    topics: tuple[Topic, ...]
    lost: tuple[str, ...] = ()
    streams: StreamContents | None = None
    missing_input: str = ''

    def __repr__(self) -> str:
        """Return one line."""
        topics = counted(len(self.topics), 'topic')
        return f'<Inspection of {self.path}: {topics}, {self.seconds:.0f} s>'

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain values, SI units except headings and latitudes (deg)."""
        return asdict(self)


@with_keywords(Session)
def inspect(bag: Named, *, progress: Progress = silent, **stated: Unpack[Session]) -> Inspection:
    """Examine the topics of a recording, then the streams if their meaning is known.

    Args:
        bag: Folder of rosbag2, one .mcap or .db3 file, or a URL of one that fsspec reads.
        progress: Shows the progress.
        **stated: The session, by the keywords of `calibrate`; by default as in the recording.

    Raises:
        InputError: Unreadable, or the statements do not match it.
    """
    return inspect_streams(topics(bag, progress), Stated(**stated), progress)


def topics(bag: Named, progress: Progress = silent) -> Inspection:
    """Examine only the topics."""
    with open_recording(bag) as recording:
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
        return Inspection(str(bag), seconds, len(recording.files), by, rows, lost)


def inspect_streams(outside: Inspection, stated: Stated, progress: Progress = silent) -> Inspection:
    """Add the contents of the streams if their meaning is known."""
    try:
        opened = open_session(outside.path, stated)
    except NotStated as error:
        return Inspection(**{**vars(outside), 'missing_input': str(error)})
    from .stream_contents import stream_contents

    with opened.recording:
        return Inspection(**{**vars(outside), 'streams': stream_contents(opened, progress)})


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
