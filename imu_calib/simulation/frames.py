"""Binary frames as a simulated IMU sends them over a line."""

from __future__ import annotations

from binascii import crc_hqx

import numpy as np
from numpy.typing import NDArray

from ..common.errors import InputError
from ..common.stream import Floats, ImuBlock

SYNC = 0x55AA
"""First two bytes of a frame: AA 55, low byte first."""
FRAME = np.dtype(
    [
        ('sync', '<u2'),
        ('counter', '<u4'),  # frames since the start, modulo 2^32
        ('time', '<i8'),  # device clock at the end of the sample interval, ns
        ('gyro', '<i4', (3,)),  # pulses or counts of channels x, y, z
        ('accel', '<i4', (3,)),
        ('temperature', '<i2'),  # 0.01 degrees Celsius
        ('status', '<u2'),  # bit 0: a channel is at its limit
        ('crc', '<u2'),  # CRC-16/CCITT-FALSE of all bytes before it
    ]
)
"""One sample, 44 bytes without gaps."""
SKEWED_FRAME = np.dtype(
    [(name, FRAME[name]) for name in ('sync', 'counter', 'time', 'gyro', 'accel')]
    + [('skew', '<i4')]  # pulses or counts of the skewed gyro
    + [(name, FRAME[name]) for name in ('temperature', 'status', 'crc')]
)
"""One sample of a unit with a skewed gyro, 48 bytes."""
Frames = NDArray[np.void]
_INT32 = np.iinfo(np.int32)


def crc16(rows: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """Return CRC-16/CCITT-FALSE (polynomial 0x1021, start 0xFFFF) of each row of (n, m) bytes."""
    # A live line sends a few frames at once, for which NumPy takes ten times as long.
    return np.array([crc_hqx(row, 0xFFFF) for row in np.ascontiguousarray(rows)], np.uint16)


def pack(
    samples: ImuBlock,
    celsius: Floats,
    counter: NDArray[np.intp] | int = 0,
    status: NDArray[np.uint16] | None = None,
    skew: Floats | None = None,
) -> bytes:
    """Write samples as frames.

    Args:
        samples: n samples in whole pulses or counts; stamps in the device's clock.
        celsius: (n,) temperature, degrees Celsius.
        counter: Frame counters of the samples, (n,), or that of the first.
        status: (n,) status bits; zero if not given.
        skew: (n,) counts of a skewed gyro; the frames are `SKEWED_FRAME`s with it.

    Raises:
        InputError: A value is not a whole number within 32 bits.
    """
    frames = np.zeros(len(samples), dtype=FRAME if skew is None else SKEWED_FRAME)
    columns = {'gyro': samples.gyro, 'accel': samples.accel}
    if skew is not None:
        columns['skew'] = skew
    for name, values in columns.items():
        if not ((values == np.rint(values)) & (np.abs(values) <= _INT32.max)).all():
            raise InputError(f'A frame holds whole numbers of 32 bits; {name} has others.')
        frames[name] = values
    frames['sync'] = SYNC
    if isinstance(counter, int):
        counter = counter + np.arange(len(samples))
    frames['counter'] = counter % 2**32
    frames['time'] = samples.stamp
    frames['temperature'] = np.clip(np.rint(100 * celsius), -32768, 32767)
    if status is not None:
        frames['status'] = status
    frames['crc'] = crc16(_bytes(frames)[:, :-2])
    return frames.tobytes()


def unpack(data: bytes) -> Frames:
    """Read consecutive frames without gaps, as an array of dtype `FRAME`.

    Raises:
        InputError: A frame is cut short, out of step or damaged; names it.
    """
    if len(data) % FRAME.itemsize:
        raise InputError(
            f'Frame {len(data) // FRAME.itemsize}: found {len(data) % FRAME.itemsize} bytes, '
            f'expected {FRAME.itemsize}.'
        )
    frames = np.frombuffer(data, dtype=FRAME)
    wrong = (frames['sync'] != SYNC) | (frames['crc'] != crc16(_bytes(frames)[:, :-2]))
    if wrong.any():
        raise InputError(f'Frame {int(wrong.argmax())}: sync bytes or checksum are wrong.')
    return frames


def _bytes(frames: Frames) -> NDArray[np.uint8]:
    return frames.view(np.uint8).reshape(len(frames), frames.dtype.itemsize)
