#!/usr/bin/env bash
# Commonly expected: an estimator "defaults to the geomagnetic field of Munich" (documentation of
# FQA; that of FLAE says the same of the dip), on the ground; the simulated magnetometer uses the
# "default reference magnetic vector of ahrs.utils.WMM()".
#
# What happens: the height of Munich, 521 m, goes into a model that takes kilometres: the field is
# that of 521 km, a fifth weaker, with a dip 0.7 degrees smaller. WMM() itself has the right height.
# Gravity, in the same lines, takes metres.
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
from ahrs import Sensors
from ahrs.common.constants import MUNICH_LATITUDE, MUNICH_LONGITUDE
from ahrs.filters import FQA
from ahrs.utils import WMM


def field(kilometres):
    model = WMM(latitude=MUNICH_LATITUDE, longitude=MUNICH_LONGITUDE, height=kilometres)
    return model.geodetic_vector


used = Sensors(num_samples=100).reference_magnetic_vector
ground, orbit, default = (
    field(0.521),
    field(521.0),
    WMM(latitude=MUNICH_LATITUDE, longitude=MUNICH_LONGITUDE).geodetic_vector,
)
for name, vector in {
    '0.521 km': ground,
    '521 km': orbit,
    'WMM()': default,
    'used by Sensors': used,
}.items():
    length = np.linalg.norm(vector)
    dip = np.degrees(np.arcsin(vector[2] / length))
    print(f'{name}: {length / 1000:.1f} uT, dip {dip:.1f} degrees')
print('FQA uses the direction at 521 km:', np.allclose(FQA().m_ref, orbit / np.linalg.norm(orbit)))
as_found = np.allclose(used, orbit) and np.allclose(default, ground)
sys.exit(not (as_found and np.allclose(FQA().m_ref, orbit / np.linalg.norm(orbit))))
PROGRAM
