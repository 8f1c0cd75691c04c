#!/usr/bin/env bash
# Commonly expected: an interval of 68 % confidence holds the true deviation in about 68 of 100
# series ("All variants return 68% confidence intervals", README). The degrees of freedom fall as
# the averaging time grows: for white noise of N samples 1.5 N/m, for m samples in each average
# (total deviation, NIST SP 1065, table 7).
#
# What happens: for mdev, ohdev, totdev and theo1 they are a fraction of N (of N less the samples at
# the ends), whatever the averaging time: totdev takes 0.8 N. Of 60 series of 512 samples the
# intervals of totdev at m = 32 hold the truth in 11, those of mdev in 9; those of oadev in 35.
#
# Seen with taustar 0.2.0, Python 3.11, on 28 November 2026.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check taustar==0.2.0 numpy==2.2.6 \
  scipy==1.15.3
"$folder/venv/bin/python" - <<'PROGRAM'
import sys

import numpy as np
from taustar.adev import mdev, oadev, totdev

COUNT, AVERAGED, SERIES = 512, 32, 60
# White noise of variance 1: AVAR = 1/m, MVAR = AVAR (m^2 + 1)/(2 m^2) (NIST SP 1065).
true = {'oadev': AVERAGED**-0.5, 'totdev': AVERAGED**-0.5}
true['mdev'] = AVERAGED**-0.5 * ((AVERAGED**2 + 1) / (2 * AVERAGED**2)) ** 0.5

held = {}
for function in (oadev, mdev, totdev):
    name, inside, scatter, width = function.__name__, 0, [], []
    for seed in range(SERIES):
        samples = np.random.default_rng(seed).normal(size=COUNT)
        taus, deviation, low, high = function(samples, taus=[8, 16, AVERAGED, 64])
        at = int(np.flatnonzero(taus == AVERAGED)[0])
        inside += bool(low[at] <= true[name] <= high[at])
        scatter.append(deviation[at] / true[name])
        width.append((high[at] - low[at]) / 2 / deviation[at])
    held[name] = inside / SERIES
    print(
        f'{name}: scatters by {100 * np.std(scatter):.0f} %, states {100 * np.mean(width):.0f} %,'
        f' 68 % interval holds the truth in {100 * held[name]:.0f} %'
    )
sys.exit(not (held['oadev'] > 0.5 and held['mdev'] < 0.3 and held['totdev'] < 0.3))
PROGRAM
