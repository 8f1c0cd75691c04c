#!/usr/bin/env bash
# Commonly expected: the rate of the Earth "resolved on NED axes" (docstring, after Groves) has no
# part to the east and -w sin(latitude) down; a rate of transport is the same for 45 degrees as for
# pi/4 with lat_unit='rad'.
#
# What happens: earthrate puts the vertical part into the east. navrate turns the latitude from
# degrees to radians once more: at 45 degrees its vertical part is 73 times too small. angle2quat
# halves the arrays of angles that it is given.
#
# Seen with NavPy 1.0, Python 3.11, on 27 November 2026.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check navpy==1.0 numpy==2.2.6
"$folder/venv/bin/python" -W ignore - <<'PROGRAM'
import sys

import navpy
import numpy as np

RATE = 7.292115e-5
rate = navpy.earthrate(45.0) / RATE
print('rate of the Earth at 45 N: true [0.707 0 -0.707], by NavPy', rate.round(3))

degrees = navpy.navrate(0.0, 100.0, 0.0, 45.0, 0.0)
radians = navpy.navrate(0.0, 100.0, 0.0, np.pi / 4, 0.0, lat_unit='rad')
print('transport down, 100 m/s east: in degrees', degrees[2], ' in radians', radians[2])

angles = [np.array([0.2, 0.4]) for _ in range(3)]
navpy.angle2quat(*angles)
print('angles [0.2 0.4] after angle2quat:', angles[0])
sys.exit(
    not (
        np.allclose(rate, [0.5**0.5, -(0.5**0.5), 0.0], rtol=1e-5)
        and abs(degrees[2] / radians[2] - 1 / np.tan(np.deg2rad(np.pi / 4))) < 1e-6
        and np.allclose(angles[0], [0.1, 0.2])
    )
)
PROGRAM
