#!/usr/bin/env bash
# Commonly expected: DataFlash("a.bin") and DataFlash("b.bin") are two logs (README: "Create a new
# instance with DataFlash class").
#
# What happens: their tables are one and the same, kept in the class. Whichever is asked first for
# the IMU fills it, and the other returns those samples as its own: -9.80 m/s2 five times, where its
# file has -9.70 seven times.
#
# Seen with MAVdataflash 3.0.0, pymavlink 2.4.50 and polars 2.1.0, Python 3.11, on 28 November 2026.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check pymavlink==2.4.50 polars==2.1.0
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check --no-deps MAVdataflash==3.0.0
"$folder/venv/bin/python" - "$folder" <<'PROGRAM'
import struct
import sys
from pathlib import Path

from MAVdataflash import MAVdataflash


def write_log(path, count, acceleration):
    """Write a DataFlash log: two definitions (FMT, message 128), then IMU (message 129)."""
    head = b'\xa3\x95'
    definitions = [
        (128, 89, 'FMT', 'BBnNZ', 'Type,Length,Name,Format,Columns'),
        (129, 24, 'IMU', 'QBfff', 'TimeUS,I,AccX,AccY,AccZ'),
    ]
    with path.open('wb') as log:
        for number, length, *texts in definitions:
            texts = [text.encode() for text in texts]
            log.write(head + struct.pack('<BBB4s16s64s', 128, number, length, *texts))
        for k in range(count):
            sample = 1_000_000 + 2500 * k, 0, 0.0, 0.0, acceleration
            log.write(head + struct.pack('<BQBfff', 129, *sample))


def vertical(log):
    return [round(value, 2) for value in log.GetData('IMU', in_polars=True)['AccZ'].to_list()]


first, second = Path(sys.argv[1]) / 'a.bin', Path(sys.argv[1]) / 'b.bin'
write_log(first, 5, -9.8)
write_log(second, 7, -9.7)
a, b = MAVdataflash.DataFlash(str(first)), MAVdataflash.DataFlash(str(second))
together = vertical(a), vertical(b)
alone = vertical(MAVdataflash.DataFlash(str(second)))
print('a.bin beside b.bin:', together[0])
print('b.bin beside a.bin:', together[1])
print('b.bin alone:       ', alone)
sys.exit(not (together == ([-9.8] * 5, [-9.8] * 5) and alone == [-9.7] * 7))
PROGRAM
