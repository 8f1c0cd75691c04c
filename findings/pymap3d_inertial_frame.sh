#!/usr/bin/env bash
# Commonly expected: eci2ecef takes positions in the "J2000 frame" (docstring), and without astropy
# gives the same less exactly ("Numpy implementation has much less accuracy", its warning).
#
# What happens: without astropy another frame is meant, that of the date: it turns by the sidereal
# time alone, without precession. The answer depends on whether astropy is installed: in 2024 by 42
# km at 7000 km from the centre, and it grows by 1.7 km a year. The height above the equator, 16.5
# km, is 0 without it.
#
# Seen with pymap3d 3.2.0 and astropy 7.1.0, Python 3.11, on 28 November 2026.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check pymap3d==3.2.0 numpy==2.2.6
cat > "$folder/position.py" <<'PROGRAM'
from datetime import datetime

import pymap3d

try:
    from astropy.utils import iers

    iers.conf.auto_download = False
except ImportError:
    pass
print(*pymap3d.eci2ecef(7e6, 0.0, 0.0, datetime(2024, 6, 1, 12)))
PROGRAM
python="$folder/venv/bin/python"
without=$("$python" "$folder/position.py")
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check astropy==7.1.0 numpy==2.2.6
beside=$("$python" -W ignore "$folder/position.py")
echo "without astropy: $without"
echo "with astropy:    $beside"
"$python" - $without $beside <<'PROGRAM'
import sys

import numpy as np

without, beside = np.array(sys.argv[1:], float).reshape(2, 3)
# Precession moves the pole by 2004.2 arc seconds in a century (IAU 1976, theta).
height = 7e6 * np.sin(np.deg2rad(2004.2 / 3600) * 0.24417)
distance = np.linalg.norm(beside - without)
print(f'apart: {distance:.0f} m; height by precession alone: {height:.0f} m')
sys.exit(not (without[2] == 0 and abs(beside[2] / height - 1) < 0.02 and distance > 40e3))
PROGRAM
