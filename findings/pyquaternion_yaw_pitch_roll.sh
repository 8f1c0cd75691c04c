#!/usr/bin/env bash
# Commonly expected: yaw_pitch_roll gives the "intrinsic Tait-Bryan angles following the z-y'-x''
# convention" (docstring), those of aerospace: yaw about z, then pitch about the new y, then roll
# about the newest x. Interpolating between two attitudes leaves both as they are, but for their
# length ("will implicitly normalise the endpoints").
#
# What happens: the angles are those of the turns in the other order (the docstring's last line,
# R_x R_y R_z, which is not z-y'-x''). An attitude made of 30, 20 and 10 degrees by its own
# rotations is told as 28, 22 and -1. slerp turns the sign of its first argument if the two lie on
# different sides: a list of attitudes interpolated pair by pair is changed by it.
#
# Seen with pyquaternion 0.9.9, Python 3.11, on 28 November 2026.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check pyquaternion==0.9.9 numpy==2.2.6
"$folder/venv/bin/python" - <<'PROGRAM'
import sys

import numpy as np
from pyquaternion import Quaternion

yaw, pitch, roll = (
    Quaternion(axis=axis, degrees=angle) for axis, angle in zip(np.eye(3)[::-1], (30, 20, 10))
)
# Turns about axes that move along are multiplied from the left to the right.
moving, other = (np.degrees(q.yaw_pitch_roll) for q in (yaw * pitch * roll, roll * pitch * yaw))
print('30, 20 and 10 degrees about z, y\', x\'\':', moving.round(1))
print('the other order, x, y\', z\'\':          ', other.round(1))

start, stop = Quaternion(axis=[0, 0, 1], degrees=10), -Quaternion(axis=[0, 0, 1], degrees=30)
before = start.elements.copy()
Quaternion.slerp(start, stop)
print('first argument of slerp, before and after:', before.round(3), start.elements.round(3))
sys.exit(
    not (
        np.allclose(other, [30, 20, 10])
        and np.abs(moving - [30, 20, 10]).max() > 5
        and np.allclose(start.elements, -before)
    )
)
PROGRAM
