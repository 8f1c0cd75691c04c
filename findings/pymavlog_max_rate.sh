#!/usr/bin/env bash
# Commonly expected: max_rate_hz thins each sensor of a log to that rate; a sensor that is no faster
# keeps all it has.
#
# What happens: in a DataFlash log the time since the last message is counted by the name alone, not
# by the instance (field I): of two GPS receivers of 5 Hz each, 90 ms apart, max_rate_hz=5.1 leaves
# the first and not one message of the second. In a telemetry log the setting is accepted and not
# used: all 500 messages of 50 Hz come with max_rate_hz=1.
#
# Seen with pymavlog 0.4.2 and pymavlink 2.4.50, Python 3.11, on 28 November 2026.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check --no-compile \
  pymavlog==0.4.2 pymavlink==2.4.50 numpy==1.26.4
"$folder/venv/bin/python" - "$folder" <<'PROGRAM'
import struct
import sys
from pathlib import Path

from pymavlink.dialects.v20 import ardupilotmega
from pymavlog import MavLog, MavTLog

flash, telemetry = Path(sys.argv[1]) / 'flight.bin', Path(sys.argv[1]) / 'flight.tlog'
head = b'\xa3\x95'
definitions = [
    (128, 89, 'FMT', 'BBnNZ', 'Type,Length,Name,Format,Columns'),
    (129, 31, 'GPS', 'QBBIHLLf', 'TimeUS,I,Status,GMS,GWk,Lat,Lng,Alt'),
]
with flash.open('wb') as log:
    for number, length, *texts in definitions:
        texts = [text.encode() for text in texts]
        log.write(head + struct.pack('<BBB4s16s64s', 128, number, length, *texts))
    for k in range(50):
        for receiver in (0, 1):
            ms = 200 * k + 90 * receiver
            place = 481400000, 115800000, 520.0
            sample = 1000 * (1000 + ms), receiver, 3, 100_000 + ms, 2446, *place
            log.write(head + struct.pack('<BQBBIHiif', 129, *sample))
link = ardupilotmega.MAVLink(None)
with telemetry.open('wb') as log:
    for k in range(500):
        message = ardupilotmega.MAVLink_scaled_imu2_message(20 * k, 0, 0, -1000, 0, 0, 0, 0, 0, 0)
        log.write(struct.pack('>Q', 1_790_000_000_000_000 + 20_000 * k) + message.pack(link))

counts = {}
for rate in (None, 10, 1):
    log = MavLog(str(flash), types=['GPS'], max_rate_hz=rate)
    log.parse()
    instances = list(log['GPS']['I'])
    counts[rate] = instances.count(0), instances.count(1)
    print(f'DataFlash, max_rate_hz={rate}: messages of the two receivers {counts[rate]}')
lengths = []
for rate in (None, 1):
    log = MavTLog(str(telemetry), types=['SCALED_IMU2'], max_rate_hz=rate)
    log.parse()
    lengths.append(len(log['SCALED_IMU2']['zacc']))
    print(f'telemetry, max_rate_hz={rate}: {lengths[-1]} messages')
sys.exit(not (counts == {None: (50, 50), 10: (50, 0), 1: (10, 0)} and lengths == [500, 500]))
PROGRAM
