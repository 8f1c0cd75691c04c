"""IMU devices: the bytes of a line to columns of samples with the host's stamps."""

from .checksum import CATALOGUE, Checksums, Crc, Sum, Xor
from .decoder import Counts, Decoder, Samples
from .device_clock import DeviceClock, Drift, Jump
from .format import FrameFormat, load_format, read_format
from .health import Health, Severity, Word
from .source import Chunk, Source, State, check_port

__all__ = [
    'CATALOGUE',
    'Checksums',
    'Chunk',
    'Counts',
    'Crc',
    'Decoder',
    'DeviceClock',
    'Drift',
    'FrameFormat',
    'Health',
    'Jump',
    'Samples',
    'Severity',
    'Source',
    'State',
    'Sum',
    'Word',
    'Xor',
    'check_port',
    'load_format',
    'read_format',
]
