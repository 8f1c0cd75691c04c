#!/usr/bin/env bash
# Commonly expected: load() returns all epochs of an observation file. An event between them (epoch
# flag 4: lines of the header follow, such as a comment) belongs to the format, and its time may be
# left blank (RINEX 3.04, table A3, epoch record).
#
# What happens: at an event without a time the reading ends as at the end of the file. Of ten epochs
# with a comment behind the fifth, five come back, without a word; gettime() counts ten in the same
# file. With a time on the event all ten come.
#
# Seen with georinex 1.16.2, xarray 2024.7.0, numpy 1.26.4, Python 3.11, on 28 November 2026.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check --no-compile \
  georinex==1.16.2 xarray==2024.7.0 numpy==1.26.4 pandas==2.2.3
"$folder/venv/bin/python" -W ignore - "$folder" <<'PROGRAM'
import sys
from pathlib import Path

import georinex

HEADER = [
    ('     3.04           OBSERVATION DATA    G', 'RINEX VERSION / TYPE'),
    ('G    2 C1C L1C', 'SYS / # / OBS TYPES'),
    ('  2026    11    28     0     0    0.0000000     GPS', 'TIME OF FIRST OBS'),
    ('', 'END OF HEADER'),
]
COMMENT = f'{"ANTENNA TURNED":60}COMMENT\n'


def epochs(seconds):
    text = ''
    for second in seconds:
        text += f'> 2026 11 28 00 00{second:11.7f}  0  2\n'
        text += f'G01{20e6 + second:14.3f}  {105e6:14.3f}\nG02{21e6:14.3f}  {115e6:14.3f}\n'
    return text


def file_with(event):
    path = Path(sys.argv[1]) / 'station.rnx'
    header = ''.join(f'{text:60}{label:20}\n' for text, label in HEADER)
    path.write_text(header + epochs(range(5)) + event + COMMENT + epochs(range(5, 10)))
    return path


counts = {}
for name, time in [('with a time', ' 2026 11 28 00 00  4.5000000'), ('without a time', ' ' * 28)]:
    path = file_with(f'>{time}  4  1\n')
    counts[name] = georinex.load(path).time.size
    print(f'event {name}: load() returns {counts[name]} epochs')
listed = georinex.gettime(path).size
print(f'gettime() of the latter: {listed}')
sys.exit(not (counts == {'with a time': 10, 'without a time': 5} and listed == 10))
PROGRAM
