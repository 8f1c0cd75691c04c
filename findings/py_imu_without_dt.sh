#!/usr/bin/env bash
# Commonly expected: Madgwick(frequency=100) integrates the gyroscope at 100 Hz ("frequency ...
# sampling frequency in Hertz", docstring of the class; `dt` of update is "default: None"). Two
# functions of one module for the heading of the same attitude and field agree.
#
# What happens: the frequency is kept and never used. Without `dt` in each call, update starts anew
# from the accelerometer: two seconds at 0.5 rad/s leave the attitude where it was, without a word.
# rpymag2h tilts the field by the two angles in the wrong order: at 23 degrees of roll and 17 of
# pitch its heading is 2.9 degrees off that of accelmag2rpy, which is true.
#
# Seen with py-imu 0.1.0, Python 3.11, on 28 November 2026.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check py-imu==0.1.0 numpy==2.2.6
"$folder/venv/bin/python" - <<'PROGRAM'
import sys

import numpy as np
from loguru import logger
from py_imu.fusion.madgwick import Madgwick
from py_imu.fusion.quaternion import Vector3D
from py_imu.fusion.utilities import accelmag2rpy, rpymag2h

logger.remove()
rate, up = Vector3D(0.0, 0.0, 0.5), Vector3D(0.0, 0.0, 9.81)
angles = []
for keywords in ({}, {'dt': 0.01}):
    fusion = Madgwick(frequency=100.0)
    for _ in range(201):
        attitude = fusion.update(rate, up, **keywords)
    angles.append(2 * np.arctan2(attitude.z, attitude.w))
    print(f'2 s at 0.5 rad/s, update(gyr, acc) with {keywords}: turned by {angles[-1]:.3f} rad')

# North, east, down by roll, pitch, yaw (z-y-x); at rest py-imu's accelerometer shows +g on z.
roll, pitch, yaw = 0.4, 0.3, 1.0
cr, sr, cp, sp, cy, sy = (f(a) for a in (roll, pitch, yaw) for f in (np.cos, np.sin))
body = (
    np.array([[1, 0, 0], [0, cr, sr], [0, -sr, cr]])
    @ np.array([[cp, 0, -sp], [0, 1, 0], [sp, 0, cp]])
    @ np.array([[cy, sy, 0], [-sy, cy, 0], [0, 0, 1]])
)
acceleration, field = body @ [0.0, 0.0, 9.81], body @ [20.0, 0.0, 45.0]
found = accelmag2rpy(acceleration, field)
headings = np.degrees([found.z, rpymag2h(found, field)])
print(f'heading {np.degrees(yaw):.1f} degrees: by accelmag2rpy {headings[0]:.1f},', end=' ')
print(f'by rpymag2h {headings[1]:.1f}')
sys.exit(
    not (
        angles[0] == 0
        and abs(angles[1] - 1) < 0.01
        and abs(headings[0] - np.degrees(yaw)) < 1e-6
        and abs(headings[1] - np.degrees(yaw)) > 2
    )
)
PROGRAM
