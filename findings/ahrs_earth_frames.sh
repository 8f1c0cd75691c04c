#!/usr/bin/env bash
# Commonly expected: a transformation between frames of the Earth is a rotation; latitude is the
# first angle where it is named first; a latitude "in decimal degrees" (docstring) is given so.
#
# What happens: eci2ecef(w, t) multiplies by the time instead of the angle: at time 0 its upper part
# is zero, and after an hour its determinant is 1.3e7. llf2ecef(lat, lon) is right only with the two
# exchanged, in radians. The radii of curvature take the degrees as radians: 4.8 and 14 km off at
# latitude 45.
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
from ahrs.common.frames import eci2ecef, llf2ecef
from ahrs.utils import WGS

RATE = 7.292115e-5
determinant = np.linalg.det(eci2ecef(RATE, 3600.0))
print('eci2ecef, upper part at time 0:', np.abs(eci2ecef(RATE, 0.0)[:2, :2]).max())
print(f'eci2ecef, determinant after an hour: {determinant:.3g}')

latitude, longitude = np.deg2rad([48.0, 11.0])
east = np.array([-np.sin(longitude), np.cos(longitude), 0.0])
got, exchanged = llf2ecef(latitude, longitude)[:, 0], llf2ecef(longitude, latitude)[:, 0]
print(
    'east at 48 N 11 E:',
    east.round(3),
    ' by llf2ecef:',
    got.round(3),
    ' exchanged:',
    exchanged.round(3),
)

# WGS 84: N = a/sqrt(1 - e2 sin^2), M = a(1 - e2)/(1 - e2 sin^2)^1.5, at latitude 45.
ellipsoid = WGS()
left = 1 - ellipsoid.first_eccentricity_squared / 2
truth = np.array([ellipsoid.a / left**0.5, ellipsoid.a * (2 * left - 1) / left**1.5])


def radii(latitude):
    return np.array(
        [
            ellipsoid.vertical_curvature_radius(latitude),
            ellipsoid.meridian_curvature_radius(latitude),
        ]
    )


print(
    'radii of curvature at 45, m too large:',
    (radii(45.0) - truth).round(),
    ' given in radians:',
    (radii(np.pi / 4) - truth).round(),
)
sys.exit(
    not (
        np.all(eci2ecef(RATE, 0.0)[:2, :2] == 0)
        and determinant > 1e6
        and not np.allclose(got, east)
        and np.allclose(exchanged, east)
        and np.all(radii(45.0) - truth > 1000)
        and np.allclose(radii(np.pi / 4), truth)
    )
)
PROGRAM
