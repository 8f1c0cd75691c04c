#!/usr/bin/env bash
# Commonly expected: n_eff is the number of independent readings that give the same uncertainty of
# the mean (docstring, after Zhang, Metrologia 43, S276): of n independent readings about n, of n
# means of two neighbours each about n/2 (1/n_eff = (1 + 2 sum (1 - i/n) rho_i)/n, rho_1 = 1/2).
#
# What happens: the last lag found significant is left out of the sum, and where it is the first, the
# sum is empty. Of 100 series of 100 such means, 72 have n_eff = 100: correlation found and ignored.
# The other way a far lag significant by chance takes in all before it: 5 of 100 series of 1000
# independent readings have n_eff = 1, the uncertainty of their mean (use_n_eff=True) is 32 times
# too large.
#
# Seen with MetroloPy 1.1.1, Python 3.11, on 28 November 2026.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check --no-deps \
  metrolopy==1.1.1 lazy-loader==0.4 numpy==2.2.6
"$folder/venv/bin/python" -W ignore - <<'PROGRAM'
import sys

import numpy as np
from metrolopy import mean, n_eff


def of_neighbours(seed, count):
    readings = np.random.default_rng(seed).normal(size=count + 1)
    return (readings[1:] + readings[:-1]) / 2


ignored = sum(n_eff(of_neighbours(seed, 100)) == 100 for seed in range(100))
print(f'100 means of two neighbours: n_eff is 100 in {ignored} of 100 series, expected 50')

independent = [np.random.default_rng(seed).normal(size=1000) for seed in range(100)]
alone = [readings for readings in independent if n_eff(readings) == 1]
print(f'1000 independent readings: n_eff is 1 in {len(alone)} of 100 series, expected 1000')
ratio = mean(alone[0], use_n_eff=True).u / mean(alone[0]).u
print(f'uncertainty of such a mean: {ratio:.1f} times that of independent readings')
sys.exit(not (ignored > 50 and len(alone) >= 3 and ratio > 30))
PROGRAM
