#!/usr/bin/env bash
# Commonly expected: a pose graph that GTSAM writes and reads back is the same graph, up to the last
# digits of a double.
#
# What happens: writeG2o writes six significant digits. A position in UTM coordinates comes back up
# to half a metre off, and its neighbour 0.2 m away at the same place. There is no option for more
# digits, and no remark.
#
# Seen with gtsam 4.3.0, Python 3.11, on 27 November 2026.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check gtsam==4.3.0 numpy==2.2.6
cd "$folder"
"$folder/venv/bin/python" - <<'PROGRAM'
import sys

import gtsam
import numpy as np

places = np.array([[691_608.37, 334_160.43, 519.2], [691_608.17, 334_160.43, 519.2]])
values = gtsam.Values()
for key, place in enumerate(places):
    values.insert(key, gtsam.Pose3(gtsam.Rot3(), place))
graph = gtsam.NonlinearFactorGraph()
step = values.atPose3(0).between(values.atPose3(1))
graph.add(gtsam.BetweenFactorPose3(0, 1, step, gtsam.noiseModel.Unit.Create(6)))
gtsam.writeG2o(graph, values, 'graph.g2o')
_, read = gtsam.readG2o('graph.g2o', True)
back = np.array([read.atPose3(key).translation() for key in (0, 1)])
print('written:', *places, sep='\n  ')
print('read:', *back, sep='\n  ')
sys.exit(not (np.abs(back - places).max() > 0.3 and np.array_equal(back[0], back[1])))
PROGRAM
