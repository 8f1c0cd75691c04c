"""Recordings of rosbag2, in and out: storage only, the bytes of the messages go to `cdr`."""

from ..definitions import definition
from .journal import FINISHED, Journal
from .recording import Recording, open_recording
from .storage import RecordingError, Topic
from .writer import RecordingWriter

__all__ = [
    'FINISHED',
    'Journal',
    'Recording',
    'RecordingError',
    'RecordingWriter',
    'Topic',
    'definition',
    'open_recording',
]
