#!/usr/bin/env bash
# Commonly expected: OpenCV's FileStorage reads the YAML that PyYAML writes; filters such as OpenVINS
# and VINS-Fusion take their configuration by it.
#
# What happens: it refuses a list at the same place as its key, which YAML allows and PyYAML writes
# by default, if the key lies within another one: "Incorrect indentation". With the list farther in
# the same file is read.
#
# Seen with opencv-python-headless 5.0.0.93, PyYAML 6.0.3, Python 3.11, on 27 November 2026; OpenCV
# 4.6 of Debian does the same.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check opencv-python-headless==5.0.0.93 pyyaml==6.0.3
cd "$folder"
"$folder/venv/bin/python" - <<'PROGRAM'
import sys
from pathlib import Path

import cv2
import yaml

document = {'imu0': {'Tw': [[1.0, 0.0], [0.0, 1.0]], 'update_rate': 200.0}}
plain = yaml.safe_dump(document, default_flow_style=None)
farther_in = plain.replace('  - [', '    - [')
assert yaml.safe_load(farther_in) == document


def read(text):
    Path('chain.yaml').write_text('%YAML:1.0\n' + text)
    try:
        storage = cv2.FileStorage('chain.yaml', cv2.FILE_STORAGE_READ)
        return storage.getNode('imu0').getNode('update_rate').real()
    except (SystemError, cv2.error) as error:
        return f'refused: {error.__cause__ or error}'


seen = [read(plain), read(farther_in)]
for text, result in zip((plain, farther_in), seen):
    print(f'{text}-> {result}\n')
sys.exit(not (str(seen[0]).startswith('refused') and seen[1] == 200.0))
PROGRAM
