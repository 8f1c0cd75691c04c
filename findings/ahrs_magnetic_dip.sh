#!/usr/bin/env bash
# Commonly expected: the magnetic field of the place may be given to an attitude estimator by its
# dip in degrees. The dip that an estimator takes by default, stated, changes the heading by the
# declination at most; the dip of a vector does what the vector does.
#
# What happens: FLAE() has its field in a frame with z down, FLAE(magnetic_dip=...) in one with z
# up, for the same gravity: with the dip of its default field stated the attitude is 64 degrees off.
# OLEQ(magnetic_ref=20, frame='NED') exchanges the sine and the cosine, which is a dip of 70: its
# answer is 25 degrees off where the vector gives a level one.
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
from ahrs.filters import FLAE, OLEQ

np.random.seed(1)  # OLEQ starts at random


def turned(quaternion):
    """Degrees from level and north."""
    scalar = abs(np.ravel(quaternion)[0])
    return float(np.degrees(2 * np.arccos(min(scalar, 1.0))))


down = np.array([0.0, 0.0, 9.81])
default = FLAE().ref[1]
dip = float(np.degrees(np.arcsin(default[2])))
declination = float(np.degrees(np.arctan2(default[1], default[0])))
field = np.array([np.cos(np.deg2rad(20.0)), 0.0, np.sin(np.deg2rad(20.0))])
seen = {
    'FLAE': turned(FLAE().estimate(down, default, method='eig')),
    'FLAE, its dip stated': turned(FLAE(magnetic_dip=dip).estimate(down, default, method='eig')),
    'OLEQ, vector': turned(OLEQ(acc=-down, mag=field, magnetic_ref=field, frame='NED').Q),
    'OLEQ, dip': turned(OLEQ(acc=-down, mag=field, magnetic_ref=20.0, frame='NED').Q),
}
print(f'default field of FLAE: dip {dip:.1f}, declination {declination:.1f} degrees')
for case, angle in seen.items():
    print(f'{case}: {angle:.1f} degrees off')
flae, stated, vector, exchanged = seen.values()
sys.exit(not (flae < 0.1 and stated > 45 and vector < 0.5 and exchanged > 5))
PROGRAM
