"""Frames of IMUs as bytes: of the simulated one, and by the makers' documents."""

import binascii
import itertools
import os
import pty
import struct
import tty
from contextlib import contextmanager

import yaml

from imu_calib.common.config import Section
from imu_calib.live.devices.fields import (
    DeviceTime,
    Number,
)
from imu_calib.live.devices.format import load_format

NS = 1_000_000_000
SIMULATED = load_format('simulated')


def frame(counter, nanoseconds, counts, celsius=2500, status=0):
    """A frame of the simulated IMU, by its description alone."""
    body = struct.pack('<HIq6ihH', 0x55AA, counter % 2**32, nanoseconds, *counts, celsius, status)
    return body + struct.pack('<H', binascii.crc_hqx(body, 0xFFFF))


@contextmanager
def pseudo_terminal():
    """A serial port for pyserial: our end, theirs, and its name."""
    ours, theirs = pty.openpty()
    tty.setraw(theirs)
    yield ours, theirs, os.ttyname(theirs)
    os.close(ours)
    os.close(theirs)


def cut(data, places):
    bounds = [0, *sorted(p % (len(data) + 1) for p in places), len(data)]
    return [data[a:b] for a, b in itertools.pairwise(bounds)]


def described(text=None, **changes):
    """The simulated format, with keys 'a.b.c' replaced or, by None, removed."""
    data = yaml.safe_load(text or (load_path('simulated')).read_text())
    for path, value in changes.items():
        *folders, key = path.split('__')
        inner = data
        for folder in folders:
            inner = inner[folder]
        if value is None:
            del inner[key]
        else:
            inner[key] = value
    return Section(data, 'device.yaml')


def load_path(name):
    from imu_calib.common.files import named_file

    return named_file('devices', name)


NANOSECONDS = DeviceTime(Number('i', 8, 6, '<'), 1.0, 2**64)


def crc32(data):
    """CRC of both makers: polynomial 0x04C11DB7 from all ones, bit by bit."""
    register = 0xFFFFFFFF
    for byte in data:
        register ^= byte << 24
        for _ in range(8):
            register = (register << 1) ^ (0x04C11DB7 if register & 0x80000000 else 0)
            register &= 0xFFFFFFFF
    return struct.pack('>I', register)


def kvh(counter, rates=(0.5, -0.25, 2.0), g=(0.0, 0.5, -1.0), status=0x77, celsius=29):
    body = b'\xfe\x81\xff\x55' + struct.pack('>6fBBh', *rates, *g, status, counter % 128, celsius)
    return body + crc32(body)


def stim(counter, angles=(1, -2, 3), velocities=(4, 5, -6), gyro=0, accelerometer=0):
    """Table 5-20: three clusters of 24 bits, status; temperatures of 16 bits, status."""

    def cluster(values, status):
        return b''.join((v % 2**24).to_bytes(3, 'big') for v in values) + bytes([status])

    body = b'\xa5' + cluster(angles, gyro) + cluster(velocities, accelerometer)
    body += struct.pack('>3hB', 0x2380, 0x23C0, 0x2380, 0)  # gyros: 35.5, 35.75, 35.5 degrees
    body += struct.pack('>3hB', 0x2318, 0x2309, 0x231C, 0)
    body += struct.pack('>BH', counter % 256, 506)  # latency 506 us
    return body + crc32(body + bytes(2))


def mti(counter, ticks, accel=(0.0, 9.75, -0.5), rate=(0.125, 0.0, -1.0), status=3):
    data = struct.pack('>HBH', 0x1020, 2, counter % 2**16)
    data += struct.pack('>HBI', 0x1060, 4, ticks % 2**32)
    data += struct.pack('>HB3f', 0x4020, 12, *accel) + struct.pack('>HB3f', 0x8020, 12, *rate)
    data += struct.pack('>HBI', 0xE020, 4, status)
    message = bytes([0xFF, 0x36, len(data)]) + data
    return b'\xfa' + message + bytes([-sum(message) % 256])
