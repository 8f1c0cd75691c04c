#!/usr/bin/env bash
# Commonly expected: overlap makes an Allan variance smoother, not another one. For white noise it
# falls with the averaging time whatever the overlap.
#
# What happens: with any overlap, the default 0.5 of compute_allan_variances too, the averages are
# one sample apart and each is compared to the next one: the variance falls with the square of the
# time. At 100 samples a cluster it is 100 times too small. The overlap is counted in samples and
# then read as a fraction. Without overlap it is right.
#
# Seen with allan-variance-analyzer 1.0.4, Python 3.11, on 27 November 2026.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check --no-compile allan-variance-analyzer==1.0.4 numpy==2.2.6
"$folder/venv/bin/python" - 2>"$folder/progress" <<'PROGRAM'
import sys

import numpy as np
from allan_variance_analyzer.statistics import compute_allan_variances

RATE = 10  # samples a second
samples = np.random.default_rng(1).normal(size=(100_000, 6))
periods = np.array([0.1, 1.0, 10.0])
truth = 1 / (periods * RATE)  # white noise of variance 1, averaged
ratios = {}
for name, extra in {'overlap 0': (0,), 'overlap 0.25': (0.25,), 'the default': ()}.items():
    ratios[name] = compute_allan_variances(samples, periods, RATE, *extra).mean(axis=1) / truth
    print(f'{name}: {ratios[name].round(4)} of the true variance at {periods} s')
right, *wrong = ratios.values()
as_found = np.allclose(right, 1, rtol=0.1) and all(np.allclose(r, truth, rtol=0.1) for r in wrong)
sys.exit(not as_found)
PROGRAM
