#!/usr/bin/env bash
# Commonly expected: set_gyroscope(random_walk=...) gives a random walk ("deg/s/sqrt(Hz)", comment of
# the parameter), and set_gyroscope sets: the last call counts.
#
# What happens: the random walk is only added if a bias instability is given, too. The errors are
# added to the ideal sensor itself: after three calls with an offset of 1 deg/s it is 3, and a last
# call without any error leaves it.
#
# Seen with imusim 1.1.2, Python 3.11, on 28 November 2026.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check imusim==1.1.2 numpy==2.2.6 \
  scipy==1.15.3 matplotlib==3.10.3
MPLBACKEND=agg "$folder/venv/bin/python" - "$folder/still.csv" <<'PROGRAM'
import sys

import imusim
import numpy as np

seconds = np.arange(0.0, 100.0, 0.01)
rows = np.column_stack([seconds, np.zeros((len(seconds), 6))])
np.savetxt(sys.argv[1], rows, delimiter=',', header='time, position, angles')

walk = {'random_walk': np.full(3, 0.1)}
alone = imusim.Simulator(sys.argv[1])
alone.set_gyroscope(**walk)
beside = imusim.Simulator(sys.argv[1])
beside.set_gyroscope(bias_instability=np.full(3, 1e-9), **walk)
spread = alone.gyroscope.std(), beside.gyroscope.std()
print('random walk alone: standard deviation', spread[0], 'deg/s')
print('beside a bias instability of 1e-9 deg/s:', spread[1].round(2), 'deg/s')

simulator = imusim.Simulator(sys.argv[1])
offsets = []
for offset in (1.0, 1.0, 1.0, 0.0):
    simulator.set_gyroscope(offset=np.full(3, offset))
    offsets.append(float(simulator.gyroscope.mean().round(6)))
print('offset set to 1, 1, 1 and 0 deg/s: it is', offsets)
sys.exit(not (spread[0] == 0 and spread[1] > 0.05 and offsets == [1.0, 2.0, 3.0, 3.0]))
PROGRAM
