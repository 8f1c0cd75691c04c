"""What is in a recording, what it can calibrate, and what it contradicts."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from ..bags import Recording, open_recording
from ..errors import NotStated
from ..metadata import COMPENSATED
from .named import Named
from .opening import open_session
from .progress import Progress, silent
from .stated import Stated

if TYPE_CHECKING:
    # Loaded where somebody says how the streams are to be read.
    from .inside import Inside


@dataclass(frozen=True)
class Topic:
    """A topic: its messages, and how many there are a second (None where nobody knows)."""

    name: str
    type: str
    messages: int
    rate: float | None


@dataclass(frozen=True)
class Look:
    """What is in a recording.

    Attributes:
        path: Of the recording.
        seconds: From its first to its last message.
        files: How many.
        compensated: The calibration that it was compensated by; empty where it was not.
        topics: All of them.
        inside: What the streams contain; None where nobody says how they are to be read.
        not_said: What would have to be said for that, in a sentence.

    """

    path: str
    seconds: float
    files: int
    compensated: str
    topics: tuple[Topic, ...]
    inside: Inside | None = None
    not_said: str = ''

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain values, SI units but for headings and latitudes (deg)."""
        return asdict(self)


def look(bag: Named, stated: Stated | None = None, progress: Progress = silent) -> Look:
    """Look at the topics of a recording, then into them as far as it is known what they mean.

    Args:
        bag: Folder of rosbag2, one .mcap or .db3 file, or a URL of one that fsspec reads.
        stated: What is known of the session; None for what the recording says.
        progress: Shows how far it is.

    Raises:
        InputError: Unreadable, or what is stated does not go with it.

    """
    outside = topics(bag, progress)
    return look_inside(outside, stated or Stated(), progress)


def topics(bag: Named, progress: Progress = silent) -> Look:
    """Look at the topics alone."""
    with open_recording(bag) as recording:
        seconds = 0.0
        if recording.start_ns is not None and recording.end_ns is not None:
            seconds = (recording.end_ns - recording.start_ns) * 1e-9
        counts = _counts(recording, progress)
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
        return Look(str(bag), seconds, len(recording.files), by, rows)


def look_inside(outside: Look, stated: Stated, progress: Progress = silent) -> Look:
    """Add what the streams contain, where it is known what they mean."""
    try:
        opened = open_session(outside.path, stated)
    except NotStated as error:
        return Look(**{**vars(outside), 'not_said': str(error)})
    from .inside import inside

    with opened.recording:
        return Look(**{**vars(outside), 'inside': inside(opened, progress)})


def _counts(recording: Recording, progress: Progress) -> Counter[str]:
    """Return how many messages each topic has: as the recording says, else by counting them.

    What was cut off has no summary, which its recorder would have written at the end.
    """
    counts = Counter({t.name: t.count for t in recording.topics if t.count is not None})
    if len(counts) == len(recording.topics):
        return counts
    counts.clear()
    with progress('counting') as show:
        for topic, messages, _ in recording.messages(show):
            counts[topic.name] += len(messages)
    return counts
