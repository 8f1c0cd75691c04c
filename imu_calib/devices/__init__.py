"""IMU devices: bytes of a line to columns of samples with the host's stamps."""

from .baud import Baud, choose_baud, too_slow
from .checksum import CATALOGUE, Checksums, Crc, Sum, Xor
from .decoder import Counts, Decoder, Samples
from .delays import Drift
from .device_clock import DeviceClock, Jump
from .format import FrameFormat, load_format, read_format
from .health import Health, PartStatus, Severity
from .in_memory import SCHEME, InMemoryLine, InMemorySource
from .reception import GAP_TIMEOUT, Reception
from .source import Chunk, Source, SourceState, check_port, is_serial, steady_time

__all__ = [
    'CATALOGUE',
    'GAP_TIMEOUT',
    'SCHEME',
    'Baud',
    'Checksums',
    'Chunk',
    'Counts',
    'Crc',
    'Decoder',
    'DeviceClock',
    'Drift',
    'FrameFormat',
    'Health',
    'InMemoryLine',
    'InMemorySource',
    'Jump',
    'PartStatus',
    'Reception',
    'Samples',
    'Severity',
    'Source',
    'SourceState',
    'Sum',
    'Xor',
    'check_port',
    'choose_baud',
    'is_serial',
    'load_format',
    'read_format',
    'steady_time',
    'too_slow',
]
