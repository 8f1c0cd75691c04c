#!/usr/bin/env bash
# Commonly expected: a deviation for each averaging time that is asked for.
#
# What happens: times become whole numbers of samples, halves to the even one, and equal ones are
# merged. Of five times asked for two come back, and none of the five is among them. Nothing is
# printed: whoever zips the answer with the times asked for pairs them wrongly.
#
# Seen with AllanTools 2024.6, Python 3.11, on 27 November 2026.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check allantools==2024.6 numpy==2.2.6
"$folder/venv/bin/python" - <<'PROGRAM'
import sys

import allantools
import numpy as np

rate, asked = 2.0, np.array([0.25, 0.75, 1.25, 1.75, 2.25])
samples = np.random.default_rng(1).normal(size=100_000)
got = allantools.oadev(samples, rate=rate, data_type='freq', taus=asked)[0]
print('asked for', asked, 's, samples in each', asked * rate)
print('came back', got, 's')
sys.exit(not np.array_equal(got, [1.0, 2.0]))
PROGRAM
