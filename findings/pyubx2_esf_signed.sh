#!/usr/bin/env bash
# Commonly expected: a parser of u-blox's messages returns measurements as the interface description
# types them. In UBX-ESF-MEAS, the IMU's message, the 24 bits of a rate are "deg/s *2^-12 signed",
# those of an acceleration "m/s2 *2^-10 signed". Fields typed I4 come out signed (UBX-ESF-INS).
#
# What happens: the 24 bits are read without their sign. -1 deg/s is +4095 deg/s, -1 m/s2 is 16383
# m/s2; positive values are right. In UBX-ESF-RAW the four bytes come out as they are.
#
# Seen with pyubx2 1.4.0, Python 3.11, on 28 November 2026 (its issue 163, of negative speeds that
# cannot be written, is open since 2024).
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check pyubx2==1.4.0
"$folder/venv/bin/python" - <<'PROGRAM'
import struct
import sys

from pyubx2 import UBXReader, calc_checksum

GYRO_Y, GYRO_Z, ACCEL_X = 13, 5, 16
measured = [(GYRO_Y, 1.0, 2**12), (GYRO_Z, -1.0, 2**12), (ACCEL_X, -1.0, 2**10)]
payload = struct.pack('<IHH', 1000, len(measured) << 11, 0)
for kind, value, scale in measured:
    payload += struct.pack('<I', round(value * scale) & 0xFFFFFF | kind << 24)
body = b'\x10\x02' + struct.pack('<H', len(payload)) + payload
message = UBXReader.parse(b'\xb5\x62' + body + calc_checksum(body))
read = [
    getattr(message, f'dataField_{k:02}') / scale for k, (_, _, scale) in enumerate(measured, 1)
]
for (kind, value, _), got in zip(measured, read):
    print(f'type {kind}: sent {value}, dataField over its scale {got}')
sys.exit(read != [1.0, 4095.0, 16383.0])
PROGRAM
