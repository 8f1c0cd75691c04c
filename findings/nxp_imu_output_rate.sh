#!/usr/bin/env bash
# Commonly expected: FXAS21002(bw=800) sets the gyroscope to 800 Hz; temperature() is the
# temperature. Its own source lists the bits of the rate as the data sheet does (CTRL_REG1, DR: 0 is
# 800 Hz, 5 is 25 Hz; temperature in register 0x12).
#
# What happens: the bits are counted the other way: asked for 800 Hz the chip gives 25, asked for 25
# it gives 800. temperature() reads CTRL_REG1 (0x13): it tells the rate that was set, here 22 degrees
# for 800 Hz at a true temperature of 31.
#
# Seen with nxp-imu 0.6.2, its bus replaced by registers in memory, Python 3.11, on 28 November 2026.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check nxp-imu==0.6.2 smbus2==0.6.1
"$folder/venv/bin/python" - <<'PROGRAM'
import sys

import smbus2


class Registers:
    """An FXAS21002C at 31 degrees Celsius."""

    def __init__(self, bus):
        self.values = {0x0C: 0xD7, 0x12: 31}

    def read_byte_data(self, address, register):
        return self.values.get(register, 0)

    def write_byte_data(self, address, register, value):
        self.values[register] = value

    def close(self):
        pass


smbus2.SMBus = Registers

from nxp_imu.FXAS21002 import FXAS21002  # noqa: E402

RATES = [800, 400, 200, 100, 50, 25, 12.5, 12.5]
rates, temperatures = {}, {}
for asked in (25, 50, 100, 200, 400, 800):
    gyroscope = FXAS21002(dps=250, bw=asked)
    rates[asked] = RATES[gyroscope.read8(0x13) >> 2 & 7]
    temperatures[asked] = gyroscope.temperature()
    print(f'asked for {asked} Hz: set {rates[asked]} Hz, temperature {temperatures[asked]}')
sys.exit(
    rates != {25: 800, 50: 400, 100: 200, 200: 100, 400: 50, 800: 25}
    or temperatures[800] != 22
    or temperatures[25] != 2
)
PROGRAM
