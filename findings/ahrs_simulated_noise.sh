#!/usr/bin/env bash
# Commonly expected: a simulated magnetometer without noise is asked for by mag_noise=0, and the
# noise of a gyroscope in rad/s is given in rad/s ("in the same units as the gyroscope data", says
# the documentation of Sensors).
#
# What happens: a mag_noise smaller than the spread of the signal, as every sensible one is, is
# replaced by 0.5 % of the field: 0 gives about 190 nT, and so does 100. gyr_noise is taken in
# deg/s, though the gyroscopes come in rad/s: 0.1 gives 0.0017. acc_noise does what it says.
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

# Half of the time level, half of it turned about z: the signal of the magnetometer has a spread.
still, turned = [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]
attitudes = np.repeat([still, turned], 5000, axis=0)


def scatter(gyr, acc, mag):
    made = Sensors(quaternions=attitudes, gyr_noise=gyr, acc_noise=acc, mag_noise=mag)
    first = slice(0, 5000)
    signals = made.gyroscopes[first], made.accelerometers[first], made.magnetometers[first]
    return [float(signal.std(axis=0).mean()) for signal in signals]


for asked in ((0.0, 0.0, 0.0), (0.1, 0.1, 100.0)):
    print(
        'asked for',
        asked,
        ' got',
        [round(value, 5) for value in scatter(*asked)],
        ' rad/s, m/s^2, nT',
    )
quiet, noisy = scatter(0.0, 0.0, 0.0), scatter(0.1, 0.1, 100.0)
as_found = (
    quiet[2] > 100
    and abs(noisy[2] / quiet[2] - 1) < 0.1
    and abs(noisy[0] / np.deg2rad(0.1) - 1) < 0.1
    and abs(noisy[1] / 0.1 - 1) < 0.1
)
sys.exit(not as_found)
PROGRAM
