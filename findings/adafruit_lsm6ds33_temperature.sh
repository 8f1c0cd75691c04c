#!/usr/bin/env bash
# Commonly expected: `temperature` is the chip's temperature in degrees Celsius. The LSM6DS33 has 16
# bits a degree (data sheet, temperature sensor characteristics), the later LSM6DSOX 256.
#
# What happens: 256 is used for both. An LSM6DS33 at 45 degrees shows 26.25, one at 0 degrees 23.4:
# always about room temperature, so nobody wonders. (Adafruit's library in C++ was corrected in
# 2021, its issue 24.)
#
# Seen with adafruit-circuitpython-lsm6ds 4.6.3, its bus replaced by registers in memory, Python
# 3.11, on 28 November 2026.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check \
  adafruit-circuitpython-lsm6ds==4.6.3 adafruit-circuitpython-busdevice==5.2.17 \
  adafruit-circuitpython-register==1.13.0 Adafruit-Blinka==10.0.0
"$folder/venv/bin/python" - <<'PROGRAM'
import struct
import sys

from adafruit_lsm6ds.lsm6ds33 import LSM6DS33
from adafruit_lsm6ds.lsm6dsox import LSM6DSOX


class Bus:
    """One chip of 128 registers, which ends a reset at once."""

    def __init__(self, identity):
        self.registers = bytearray(128)
        self.registers[0x0F] = identity

    def try_lock(self):
        return True

    def unlock(self):
        pass

    def writeto(self, address, data, *, start=0, end=None):
        data = bytes(data[start:end])
        if len(data) > 1:
            self.registers[data[0] : data[0] + len(data) - 1] = data[1:]
            self.registers[0x12] &= ~1

    def writeto_then_readfrom(
        self, address, out, into, *, out_start=0, out_end=None, in_start=0, in_end=None
    ):
        count = (len(into) if in_end is None else in_end) - in_start
        first = out[out_start]
        into[in_start : in_start + count] = self.registers[first : first + count]


shown = {}
for name, chip, identity, bits in [('33', LSM6DS33, 0x69, 16), ('OX', LSM6DSOX, 0x6C, 256)]:
    bus = Bus(identity)
    sensor = chip(bus)
    for true in (0, 25, 45):
        bus.registers[0x20:0x22] = struct.pack('<h', bits * (true - 25))
        shown[name, true] = sensor.temperature
        print(f'{chip.__name__} at {true} degrees shows {shown[name, true]}')
sys.exit(
    shown
    != {
        ('33', 0): 23.4375,
        ('33', 25): 25.0,
        ('33', 45): 26.25,
        ('OX', 0): 0.0,
        ('OX', 25): 25.0,
        ('OX', 45): 45.0,
    }
)
PROGRAM
