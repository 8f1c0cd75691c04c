#!/usr/bin/env bash
# Commonly expected: a sensor object holds its own range; a second chip on the same bus changes
# nothing of the first. The two chips here differ in address and type.
#
# What happens: the table of ranges is one for all types, and each new object of another type
# rewrites it. An LSM6DSO32 at rest shows 9.81 m/s2; after an LSM6DSOX is opened beside it, it shows
# 4.90, with no register changed and nothing raised.
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

from adafruit_lsm6ds.lsm6dso32 import LSM6DSO32
from adafruit_lsm6ds.lsm6dsox import LSM6DSOX


class Bus:
    """Chips with 128 registers each, which end a reset at once."""

    def __init__(self, identities):
        self.chips = {address: bytearray(128) for address in identities}
        for address, identity in identities.items():
            self.chips[address][0x0F] = identity

    def try_lock(self):
        return True

    def unlock(self):
        pass

    def writeto(self, address, data, *, start=0, end=None):
        data = bytes(data[start:end])
        if len(data) > 1:
            self.chips[address][data[0] : data[0] + len(data) - 1] = data[1:]
            self.chips[address][0x12] &= ~1

    def writeto_then_readfrom(
        self, address, out, into, *, out_start=0, out_end=None, in_start=0, in_end=None
    ):
        count = (len(into) if in_end is None else in_end) - in_start
        first = out[out_start]
        into[in_start : in_start + count] = self.chips[address][first : first + count]


bus = Bus({0x6A: 0x6C, 0x6B: 0x6C})
first = LSM6DSO32(bus, 0x6A)
# 8 g at 0.244 mg a bit (data sheet of the LSM6DSO32, mechanical characteristics): 1 g is 4098 bits.
bus.chips[0x6A][0x28:0x2E] = struct.pack('<hhh', 0, 0, 4098)
alone, registers = first.acceleration[2], bytes(bus.chips[0x6A])
LSM6DSOX(bus, 0x6B)
beside = first.acceleration[2]
print(f'LSM6DSO32 alone: {alone:.2f} m/s2, with an LSM6DSOX beside it: {beside:.2f} m/s2')
print('its registers are the same:', bytes(bus.chips[0x6A]) == registers)
sys.exit(
    not (
        abs(alone - 9.806) < 0.01
        and abs(beside - alone / 2) < 1e-9
        and bytes(bus.chips[0x6A]) == registers
    )
)
PROGRAM
