#!/usr/bin/env bash
# Commonly expected: `magnetic` is in microtesla ("in microteslas (uT)", documentation of the
# property, and the comment beside the conversion: 1 gauss is 100 uT).
#
# What happens: the step from gauss to microtesla is missing. The field of the Earth, 50 uT, is shown
# as 0.5 in every range; the attitude is not affected, a check or a calibration of the strength is.
#
# Seen with adafruit-circuitpython-qmc5883p 1.0.4, its bus replaced by registers in memory, Python
# 3.11, on 28 November 2026.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check \
  adafruit-circuitpython-qmc5883p==1.0.4 adafruit-circuitpython-busdevice==5.2.17 \
  adafruit-circuitpython-register==1.13.0 Adafruit-Blinka==10.0.0
"$folder/venv/bin/python" - <<'PROGRAM'
import struct
import sys

import adafruit_qmc5883p as driver


class Bus:
    """One chip, with a new sample always ready."""

    def __init__(self):
        self.registers = bytearray(64)
        self.registers[0x00], self.registers[0x09] = 0x80, 1

    def try_lock(self):
        return True

    def unlock(self):
        pass

    def writeto(self, address, data, *, start=0, end=None):
        data = bytes(data[start:end])
        if data:
            self.registers[data[0] : data[0] + len(data) - 1] = data[1:]

    def writeto_then_readfrom(
        self, address, out, into, *, out_start=0, out_end=None, in_start=0, in_end=None
    ):
        count = (len(into) if in_end is None else in_end) - in_start
        first = out[out_start]
        into[in_start : in_start + count] = self.registers[first : first + count]


bus = Bus()
chip = driver.QMC5883P(bus)
shown = []
# Bits a gauss by the range (data sheet of the QMC5883P, electrical characteristics).
for name, bits in [('30G', 1000), ('12G', 2500), ('8G', 3750), ('2G', 15000)]:
    chip.range = getattr(driver, f'RANGE_{name}')
    bus.registers[1:7] = struct.pack('<hhh', 0, 0, bits // 2)
    shown.append(chip.magnetic[2])
    print(f'a field of 50 uT in the range of {name}: {chip.magnetic[2]} "uT"')
print('the documentation:', driver.QMC5883P.magnetic.__doc__.strip().splitlines()[0])
sys.exit(shown != [0.5] * 4)
PROGRAM
