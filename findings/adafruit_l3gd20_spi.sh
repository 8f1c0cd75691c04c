#!/usr/bin/env bash
# Commonly expected: `gyro` is in rad/s, whichever wires lead to the chip.
#
# What happens: over SPI the conversion from degrees to radians is done twice, in `gyro_raw` (which
# over I2C is the bare number) and in `gyro`. A turn of 90 deg/s is 1.571 rad/s over I2C and 0.0274
# over SPI, 57 times too small.
#
# Seen with adafruit-circuitpython-l3gd20 2.3.27, its buses replaced by registers in memory, Python
# 3.11, on 28 November 2026.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check \
  adafruit-circuitpython-l3gd20==2.3.27 adafruit-circuitpython-busdevice==5.2.17 \
  adafruit-circuitpython-register==1.13.0 Adafruit-Blinka==10.0.0
"$folder/venv/bin/python" - <<'PROGRAM'
import math
import struct
import sys

from adafruit_l3gd20 import L3GD20_I2C, L3GD20_SPI

registers = bytearray(64)
registers[0x0F] = 0xD4
# 90 deg/s about x at 0.00875 deg/s a bit (data sheet of the L3GD20, mechanical characteristics).
registers[0x28:0x2E] = struct.pack('<hhh', round(90 / 0.00875), 0, 0)


class Bus:
    """Both buses: of a register's address the upper two bits say read, and count on."""

    first = 0

    def try_lock(self):
        return True

    def unlock(self):
        pass

    def configure(self, **settings):
        pass

    def write(self, data):
        self.first = data[0] & 0x3F
        registers[self.first : self.first + len(data) - 1] = data[1:]

    def readinto(self, into):
        into[:] = registers[self.first : self.first + len(into)]

    def writeto(self, address, data, *, start=0, end=None):
        if data:
            self.write(bytes(data[start:end]))

    def writeto_then_readfrom(
        self, address, out, into, *, out_start=0, out_end=None, in_start=0, in_end=None
    ):
        first, end = out[out_start] & 0x3F, len(into) if in_end is None else in_end
        into[in_start:end] = registers[first : first + end - in_start]


class Pin:
    """The chip select."""

    value = True

    def switch_to_output(self, value):
        self.value = value


over_i2c, over_spi = L3GD20_I2C(Bus()), L3GD20_SPI(Bus(), Pin())
print('over I2C:', over_i2c.gyro_raw, over_i2c.gyro, 'rad/s')
print('over SPI:', over_spi.gyro_raw, over_spi.gyro, 'rad/s')
true = math.radians(90)
sys.exit(
    not (
        math.isclose(over_i2c.gyro[0], true, rel_tol=1e-4)
        and math.isclose(over_spi.gyro[0], math.radians(true), rel_tol=1e-4)
    )
)
PROGRAM
