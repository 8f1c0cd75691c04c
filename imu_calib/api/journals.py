"""Journals of live sessions: whether one is complete, and when it ends."""

from __future__ import annotations

from pathlib import Path

from ..common.stream import NS
from ..recordings.rosbag2 import Recording, open_recording
from ..recordings.storage import RecordingError
from ..recordings.writer import FINISHED
from ..simulation.options import StandOptions


def is_finished(journal: Path) -> bool:
    """Return whether the session of a journal is complete; not so if it is unreadable."""
    recording = _opened(journal)
    return recording is not None and FINISHED in recording.custom_data


def end_of_journal(journal: Path) -> float | None:
    """Return the last whole second of a journal, s after the epoch of simulated hardware.

    None if it is unreadable or empty.
    """
    recording = _opened(journal)
    if recording is None:
        return None
    with recording:
        end = recording.end_ns
        if end is None:
            logged = (times.log for _, _, times in recording.messages())
            end = max((int(log.max()) for log in logged if len(log)), default=None)
    return None if end is None else float((end - StandOptions.start_time) // NS)


def _opened(journal: Path) -> Recording | None:
    try:
        return open_recording(journal)
    except RecordingError:
        return None
