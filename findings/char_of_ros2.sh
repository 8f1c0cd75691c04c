#!/usr/bin/env bash
# Commonly expected: two readers of ROS 2 messages agree on one byte of type char, and the type
# hash that rosbags computes is the one that ROS 2 writes into its recordings.
#
# What happens: in ROS 2 char is an unsigned byte (uint8). rosbags reads 200 as 200, mcap-
# ros2-support as -56. The hash by rosbags of std_msgs/msg/Char, and of any message that holds a
# char, is not the one of ROS 2.
#
# Seen with rosbags 0.11.9, mcap-ros2-support 0.6.0, Python 3.11, on 27 November 2026.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check rosbags==0.11.9 mcap-ros2-support==0.6.0
"$folder/venv/bin/python" - <<'PROGRAM'
import sys

from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

# type_hashes of share/std_msgs/msg/Char.json in ROS 2 Jazzy (std_msgs 5.3.5).
JAZZY = 'RIHS01_3ad2d04dd29ba19d04b16659afa3ccaedd691914b02a64e82e252f2fa6a586a9'
NAME, DEFINITION = 'demo_msgs/msg/Letter', 'char value'
byte = bytes([0, 1, 0, 0, 200])  # CDR: little-endian header, then the byte

types = get_typestore(Stores.ROS2_JAZZY)
types.register(get_types_from_msg(DEFINITION, NAME))
by_rosbags = types.deserialize_cdr(byte, NAME).value
schema = Schema(id=1, name=NAME, encoding='ros2msg', data=DEFINITION.encode())
by_mcap = DecoderFactory().decoder_for('cdr', schema)(byte).value
computed = types.hash_rihs01('std_msgs/msg/Char')
print('the byte 200:', by_rosbags, 'by rosbags,', by_mcap, 'by mcap-ros2-support')
print('hash by ROS 2:  ', JAZZY)
print('hash by rosbags:', computed)
sys.exit((by_rosbags, by_mcap) != (200, -56) or computed == JAZZY)
PROGRAM
