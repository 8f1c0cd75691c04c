#!/usr/bin/env bash
# Commonly expected: a Kalman filter with exact gyroscopes, accelerometers and magnetometers follows
# a steady turn about the vertical; a sensor object gives it its rates in rad/s, the unit that the
# documentation states for both; a keyword "for tuning the filter" tunes it.
#
# What happens: after 3 s at 30 deg/s, 90 degrees, kalman() says 149: it adds the turn of the
# reference to the integrated rate. The same recording in a sensor object says 104, because there
# the rates, already in rad/s, are turned from degrees to radians once more. The keyword D has no
# effect.
#
# Seen with scikit-kinematics 0.10.4, Python 3.11, on 27 November 2026; the lines are the same in
# 0.12.0, for Python 3.12.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check --no-compile numpy==2.2.6 scipy==1.15.3 pandas==2.3.3 matplotlib==3.10.7 sympy==1.14.0
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check --no-compile --no-deps scikit-kinematics==0.10.4
"$folder/venv/bin/python" -W ignore - <<'PROGRAM'
import sys
from importlib import import_module
from unittest.mock import MagicMock

import numpy as np

# It imports the toolkit of its windows, which a server need not have.
sys.modules.update({'tkinter': MagicMock(), 'tkinter.filedialog': MagicMock()})
kalman = import_module('skinematics.imus').kalman
MyOwnSensor = import_module('skinematics.sensors.manual').MyOwnSensor

RATE, SPEED = 100.0, np.deg2rad(30.0)
azimuth = SPEED * np.arange(301) / RATE
level = np.zeros_like(azimuth)
omega = np.column_stack([level, level, level + SPEED])
acc = np.column_stack([level, level, level + 9.81])
mag = np.column_stack([np.cos(azimuth), -np.sin(azimuth), level - 1.0])


def turned(quaternions):
    return float(np.degrees(np.unwrap(2 * np.arctan2(quaternions[:, 3], quaternions[:, 0])))[-1])


recording = {'rate': RATE, 'acc': acc, 'omega': omega, 'mag': mag}
sensor = MyOwnSensor(in_file='none', in_data=recording, q_type='kalman')
by_function = kalman(RATE, acc, omega, mag)
tuned = kalman(RATE, acc, omega, mag, D=[40.0, 40.0, 40.0])
print('turned by 90 degrees')
print(f'kalman() says {turned(by_function):.1f}, the sensor object {turned(sensor.quat):.1f}')
print('D a hundred times larger changes', np.abs(tuned - by_function).max())
as_found = (
    turned(by_function) > 130
    and 95 < turned(sensor.quat) < 115
    and np.array_equal(tuned, by_function)
)
sys.exit(not as_found)
PROGRAM
