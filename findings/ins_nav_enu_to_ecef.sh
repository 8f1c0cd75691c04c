#!/usr/bin/env bash
# Commonly expected: ecef2enu undoes enu2ecef, as their names say and as the page that both cite
# has it: the columns of the one rotation are the rows of the other.
#
# What happens: enu2ecef takes the cosine of the latitude where that of the longitude belongs. A
# point 100 m east, 200 m north and 50 m up of 48 N 11 E comes back as 69, 204 and 46 m; its matrix
# is no rotation. Over NED the point comes back exactly. Where latitude and longitude have the same
# cosine nothing is seen.
#
# Seen with ins-nav 2023.7.2, Python 3.11, on 28 November 2026.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check ins-nav==2023.7.2 numpy==2.2.6
"$folder/venv/bin/python" - <<'PROGRAM'
import sys

import numpy as np
from ins_nav.nav_frames import NavigationFrame

frame = NavigationFrame((48.0, 11.0, 500.0))
enu = np.array([100.0, 200.0, 50.0])
back = frame.ecef2enu(frame.enu2ecef(enu))
over_ned = frame.ned2enu(frame.ecef2ned(frame.ned2ecef(frame.enu2ned(enu))))
origin = frame.enu2ecef(np.zeros(3))
matrix = np.array([frame.enu2ecef(axis) - origin for axis in np.eye(3)]).T
print('east, north, up:', enu, ' there and back:', back.round(1), ' over NED:', over_ned.round(6))
print('length of the east axis in ECEF:', np.linalg.norm(matrix[:, 0]).round(3))
sys.exit(
    not (
        np.allclose(over_ned, enu)
        and np.abs(back - enu).max() > 30
        and abs(np.linalg.norm(matrix[:, 0]) - 1) > 0.3
    )
)
PROGRAM
