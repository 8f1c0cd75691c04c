#!/usr/bin/env bash
# Commonly expected: Q2EV undoes EV2Q: an axis and its angle come back from their quaternion. The
# documentation of both writes the quaternion as [q1,q2,q3,q4], the axis and angle as [m1,m2,m3,MU].
#
# What happens: EV2Q (and Q2DCM, DCM2Q) puts the scalar first, Q2EV reads it last. Half a radian
# about z comes back as 3.64 rad about -x, a smaller turn about x as half a turn about another axis.
#
# Seen with PSpincalc 0.2.7, Python 3.11, on 28 November 2026.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check PSpincalc==0.2.7 numpy==2.2.6
"$folder/venv/bin/python" - <<'PROGRAM'
import sys

import numpy as np
from PSpincalc import EV2Q, Q2DCM, Q2EV

back = {}
for name, turn in {'z': [0.0, 0.0, 1.0, 0.5], 'x': [1.0, 0.0, 0.0, 0.2]}.items():
    quaternion = EV2Q(np.array([turn]), ignoreAllChk=True)
    back[name] = Q2EV(quaternion.copy())[0]
    print('axis and angle', turn, '-> quaternion', quaternion[0].round(3), '->', end=' ')
    print(back[name].round(3) + 0.0)

about_z = Q2DCM(EV2Q(np.array([[0.0, 0.0, 1.0, 0.5]]), ignoreAllChk=True))
print('cosine of the first turn in Q2DCM:', about_z[0, 0].round(4), ' true:', np.cos(0.5).round(4))
sys.exit(
    not (
        np.allclose(back['z'], [-1.0, 0.0, 0.0, np.pi + 0.5])
        and abs(back['x'][3]) > 3
        and np.isclose(about_z[0, 0], np.cos(0.5))
    )
)
PROGRAM
