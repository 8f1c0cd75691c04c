#!/usr/bin/env bash
# Commonly expected: calibrating a sensor that has no errors changes nothing, and a calibration of
# the magnetometer makes its axes equal. The sensitivity in the AK8963's fuse ROM is applied as
# (value - 128) / 256 + 1 (its data sheet, sensitivity adjustment values).
#
# What happens: the mean of each position is taken over 100 rows of which 99 are filled, so a perfect
# accelerometer shows 1 % too much afterwards (9.91 m/s2). caliberateMagApprox() multiplies where it
# should divide: an axis that reads 1.2 times the others reads 1.44 times after it. And the + 1 of the
# sensitivity stands below the line: a magnetometer of the nominal one, 128, reads zero.
#
# Seen with imusensor 1.0.1, its bus replaced by registers in memory, Python 3.11, on 28 November
# 2026.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check --no-compile \
  imusensor==1.0.1 numpy==1.26.4 easydict==1.13
"$folder/venv/bin/python" - <<'PROGRAM'
import contextlib
import io
import math
import struct
import sys
import types


class SMBus:
    """An MPU-9250 in a resting world: 1 g along one axis, a magnetic field that goes round."""

    def __init__(self, sensitivity):
        self.registers = bytearray(128)
        self.registers[0x75] = 0x71
        self.sensitivity = sensitivity
        self.gravity = (0, 0, 16384)
        self.reads = 0

    def write_byte_data(self, address, register, value):
        self.registers[register] = value

    def read_i2c_block_data(self, address, register, count):
        if register == 0x3B:
            self.reads += 1
            shift = self.registers[0x1C] >> 3 & 3
            turned = self.gravity[1], self.gravity[0], -self.gravity[2]
            acceleration = struct.pack('>hhh', *(value >> shift for value in turned))
            angle = math.radians(7 * self.reads)
            a, b = round(1000 * math.cos(angle)), round(1000 * math.sin(angle))
            field = [(a, round(1.2 * b), 0), (0, round(1.2 * a), b), (b, 0, a)][self.reads % 3]
            return list(acceleration + bytes(8) + struct.pack('<hhh', *field) + bytes(1))
        if register == 0x49 and self.registers[0x26] == 0x10:
            return [self.sensitivity] * count
        return list(self.registers[register : register + count])


sys.modules['smbus'] = types.SimpleNamespace(SMBus=SMBus)
from imusensor.MPU9250 import MPU9250 as driver  # noqa: E402

bus = SMBus(176)
axes = [(0, 0, 1), (0, 0, -1), (0, 1, 0), (0, -1, 0), (1, 0, 0), (-1, 0, 0)]
positions = iter(axes)


def sleep(seconds):
    if seconds == 3:
        bus.gravity = tuple(16384 * value for value in next(positions))


driver.time = types.SimpleNamespace(sleep=sleep)
with contextlib.redirect_stdout(io.StringIO()):
    chip = driver.MPU9250(bus, 0x68)
    chip.begin()
    bus.gravity = (0, 0, 16384)
    chip.readSensor()
    before = math.hypot(*chip.AccelVals)
    chip.caliberateAccelerometer()
    bus.gravity = (0, 0, 16384)
    chip.readSensor()
    after = math.hypot(*chip.AccelVals)
    chip.caliberateMagApprox()
    other = driver.MPU9250(SMBus(128), 0x68)
    other.begin()
    other.readSensor()
print(f'gravity before the calibration {before:.3f}, after it {after:.3f} m/s2')
ratio = 1.2 * chip.Mags[1] / chip.Mags[0]
print(f'an axis that read 1.2 times the others reads {ratio:.2f} times after the calibration')
print('magnetometer with the sensitivity 128:', other.MagVals, 'uT')
sys.exit(
    not (
        abs(before - 9.807) < 0.002
        and abs(after / before - 100 / 99) < 1e-4
        and abs(ratio - 1.44) < 1e-3
        and not other.MagVals.any()
    )
)
PROGRAM
