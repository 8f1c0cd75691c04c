#!/usr/bin/env bash
# Commonly expected: Quaternion(rpy=...) and DCM(rpy=...) of one package are the same rotation. Its
# documentation of Quaternion.from_rpy says: "With both approaches the same quaternion is obtained."
#
# What happens: the quaternion takes roll, pitch, yaw; the matrix takes the first number about z and
# the last about x. For 10, 20, 30 degrees they are 33 degrees apart. DCM.to_rpy gives neither: it
# expects the transposed matrix.
#
# Seen with ahrs 0.4.0, Python 3.11, on 27 November 2026.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check ahrs==0.4.0 numpy==2.2.6
"$folder/venv/bin/python" - <<'PROGRAM'
import sys

import numpy as np
from ahrs import DCM, Quaternion


def about(axis, angle):
    turn = np.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    turn[[i, j], [i, j]] = np.cos(angle)
    turn[i, j], turn[j, i] = -np.sin(angle), np.sin(angle)
    return turn


def zyx(yaw, pitch, roll):
    return about(2, yaw) @ about(1, pitch) @ about(0, roll)


angles = np.deg2rad([10.0, 20.0, 30.0])
truth, swapped = zyx(*angles[::-1]), zyx(*angles)
quaternion = Quaternion(rpy=angles).to_DCM()
matrix = DCM(rpy=angles)
apart = np.degrees(np.arccos((np.trace(quaternion.T @ np.asarray(matrix)) - 1) / 2))
back = np.degrees(matrix.to_rpy())
print('roll, pitch, yaw given:', np.degrees(angles))
print('the quaternion is yaw, pitch, roll about z, y, x:', np.allclose(quaternion, truth))
print(
    'so is the matrix:',
    np.allclose(matrix, truth),
    ' with roll and yaw swapped:',
    np.allclose(matrix, swapped),
)
print(f'they are {apart:.1f} degrees apart; DCM.to_rpy gives', back.round(2))
as_found = (
    np.allclose(quaternion, truth)
    and np.allclose(matrix, swapped)
    and not np.allclose(truth, swapped)
)
sys.exit(
    not (as_found and not np.allclose(back, [10, 20, 30]) and not np.allclose(back, [30, 20, 10]))
)
PROGRAM
