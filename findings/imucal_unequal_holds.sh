#!/usr/bin/env bash
# Commonly expected: the Ferraris method gives the true parameters from a recording without noise,
# however long each hold lasts: every hold is a mean.
#
# What happens: the gyro bias of imucal is the mean of all samples of the six holds together. With a
# g-sensitivity, a longer hold pulls it: one of 60 s beside five of 10 s makes the bias wrong by
# 0.45 of what 1 g does to the gyro, and the scale factor with it. With equal holds both are exact.
#
# Seen with imucal 2.6.0, Python 3.11, on 27 November 2026.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check --no-compile imucal==2.6.0 numpy==2.2.6
"$folder/venv/bin/python" - <<'PROGRAM'
import sys

import numpy as np
from imucal import FerrarisCalibration, FerrarisSignalRegions

GRAVITY, BIAS, PER_G = 9.81, 0.2, 0.1  # m/s^2, deg/s, deg/s per g
RATE = 100  # samples a second


def gyro(turning, force):
    return turning + BIAS + PER_G * force / GRAVITY


def calibrate(z_up_seconds):
    regions = {}
    for k, axis in enumerate('xyz'):
        for side, sign in (('p', 1), ('a', -1)):
            seconds = z_up_seconds if axis + side == 'zp' else 10
            force = np.tile(sign * GRAVITY * np.eye(3)[k], (seconds * RATE, 1))
            regions[f'acc_{axis}_{side}'], regions[f'gyr_{axis}_{side}'] = force, gyro(0.0, force)
        force = np.tile(GRAVITY * np.eye(3)[k], (4 * RATE, 1))
        turning = np.tile(-90.0 * np.eye(3)[k], (4 * RATE, 1))  # 4 s at 90 deg/s: one turn
        regions[f'acc_{axis}_rot'], regions[f'gyr_{axis}_rot'] = force, gyro(turning, force)
    made = FerrarisCalibration().compute(FerrarisSignalRegions(**regions), RATE, 'm/s^2', 'deg/s')
    return made.b_g[2], made.K_g[2, 2], made.K_ga[2, 2] * GRAVITY


seen = {seconds: calibrate(seconds) for seconds in (10, 60)}
print('true: bias', BIAS, 'deg/s, scale factor 1, g-sensitivity', PER_G, 'deg/s per g')
for seconds, (bias, scale, per_g) in seen.items():
    print(f'z up for {seconds} s: bias {bias:.4f}, scale factor {scale:.5f}, per g {per_g:.4f}')
# (60 - 10)/(60 + 5*10) of the g-sensitivity is taken for bias.
expected = BIAS + PER_G * 50 / 110
sys.exit(not (abs(seen[10][0] - BIAS) < 1e-9 and abs(seen[60][0] - expected) < 1e-9))
PROGRAM
