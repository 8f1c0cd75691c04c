#!/usr/bin/env bash
# Commonly expected: a message that does not fit its definition is refused when it is written.
#
# What happens: the writer of mcap-ros2-support cuts an array that is too long, fills one that is
# too short with zeros (and appends None to the list of the caller), and writes 0 for a field
# whose name is misspelt. Nothing is raised or logged; a recording made so reads without
# complaint.
#
# Seen with mcap-ros2-support 0.6.0, Python 3.11, on 27 November 2026.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check mcap-ros2-support==0.6.0
"$folder/venv/bin/python" - <<'PROGRAM'
import copy
import io
import sys

from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer

written = [
    {'force': [1.0, 2.0, 3.0, 4.0], 'temperature': 25.0},
    {'force': [1.0, 2.0], 'temperature': 25.0},
    {'force': [1.0, 2.0, 3.0], 'temprature': 25.0},
]
given = copy.deepcopy(written)
file = io.BytesIO()
writer = Writer(file)
schema = writer.register_msgdef('demo_msgs/msg/Reading', 'float64[3] force\nfloat64 temperature')
for k, message in enumerate(given):
    writer.write_message('/reading', schema, message, log_time=k, publish_time=k)
writer.finish()
file.seek(0)
decoded = make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages()
read = [(list(message.force), message.temperature) for _, _, _, message in decoded]
for before, after in zip(written, read):
    print(before, '->', after)
print('the list of the second message is now', given[1]['force'])
sys.exit(read != [([1.0, 2.0, 3.0], 25.0), ([1.0, 2.0, 0.0], 25.0), ([1.0, 2.0, 3.0], 0.0)])
PROGRAM
