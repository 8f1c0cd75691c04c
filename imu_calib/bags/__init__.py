"""Read and write recordings of rosbag2: storage only, `cdr` converts the bytes of messages."""

from ..definitions import definition
from .journal import FINISHED, Journal
from .recorded_clock import Extent, RecordedClock
from .recording import Recording, open_recording
from .remote import AnyPath, RemotePath, is_url, local, located
from .storage import RecordingError, Topic
from .writer import RecordingWriter

__all__ = [
    'FINISHED',
    'AnyPath',
    'Extent',
    'Journal',
    'RecordedClock',
    'Recording',
    'RecordingError',
    'RecordingWriter',
    'RemotePath',
    'Topic',
    'definition',
    'is_url',
    'local',
    'located',
    'open_recording',
]
