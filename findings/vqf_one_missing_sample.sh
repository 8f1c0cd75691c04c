#!/usr/bin/env bash
# Commonly expected: one missing sample (nan) of an accelerometer costs an orientation filter that
# sample, or makes all that follows nan, so that it is seen.
#
# What happens: VQF goes on with finite unit quaternions, and ignores the gyroscope to the end: its
# bias has become nan, and so has the norm of the rate, which is then not greater than 0. After one
# missing sample at 10 s a unit that turns at 30 deg/s stands still. BasicVQF of the same package
# skips the sample.
#
# Seen with vqf 2.1.2, Python 3.11, on 27 November 2026.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check vqf==2.1.2 numpy==2.2.6
"$folder/venv/bin/python" - <<'PROGRAM'
import sys

import numpy as np
from vqf import VQF, BasicVQF

PERIOD, LENGTH = 0.01, 3000
gyr = np.tile([0.0, 0.0, np.deg2rad(30.0)], (LENGTH, 1))
complete = np.tile([0.0, 0.0, 9.81], (LENGTH, 1))
missing = complete.copy()
missing[1000] = np.nan


def turned(kind, acc):
    quaternions = kind(PERIOD).updateBatch(gyr, acc)['quat6D']
    angle = np.degrees(np.unwrap(2 * np.arctan2(quaternions[:, 3], quaternions[:, 0])))[-1]
    return float(angle), bool(np.isfinite(quaternions).all())


seen = [turned(VQF, complete), turned(VQF, missing), turned(BasicVQF, missing)]
cases = ('VQF, complete', 'VQF, one missing', 'BasicVQF, one missing')
for case, (angle, finite) in zip(cases, seen, strict=True):
    print(f'{case}: turned by {angle:.1f} of 900 degrees, all finite: {finite}')
angles = np.array([angle for angle, _ in seen])
as_found = all(finite for _, finite in seen) and np.allclose(angles, [900, 300.3, 900], atol=0.5)
sys.exit(not as_found)
PROGRAM
