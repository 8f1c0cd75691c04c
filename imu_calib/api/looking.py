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
    """A topic: its messages, and how many there are a second (None where unknown)."""

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
        lost: What is missing or broken, as far as the topics were looked at.
        inside: What the streams contain; None where it is unknown how they are to be read.
        not_said: What would have to be said for that, in a sentence.

    """

    path: str
    seconds: float
    files: int
    compensated: str
    topics: tuple[Topic, ...]
    lost: tuple[str, ...] = ()
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
        return Look(str(bag), seconds, len(recording.files), by, rows, lost)


def look_inside(outside: Look, stated: Stated, progress: Progress = silent) -> Look:
    """Add what the streams contain, where it is known what they mean."""
    try:
        opened = open_session(outside.path, stated)
    except NotStated as error:
        return Look(**{**vars(outside), 'not_said': str(error)})
    from .inside import inside

    with opened.recording:
        return Look(**{**vars(outside), 'inside': inside(opened, progress)})


def _extent(recording: Recording, progress: Progress) -> tuple[Counter[str], float]:
    """Return how many messages each topic has, and s from the first message to the last.

    A recording says both, but for what was cut off: its summary would have been written at the end.
    Its messages are counted one by one.
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
