#!/usr/bin/env bash
# Commonly expected: in the D-SI notation \per\hour\tothe{2} and \hour\tothe{-2} are the same
# unit, one over hours squared.
#
# What happens: behind \per with an exponent the factor of an hour or of a prefix is taken twice:
# m/h^2 comes out 3600^2 too small, and m/ms^2 a million times too large. With a negative exponent
# both are right. Both notations are called valid.
#
# Seen with dsiunits 3.1.3, Python 3.11, on 27 November 2026.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check dsiunits==3.1.3
"$folder/venv/bin/python" - <<'PROGRAM'
import sys

from dsi_unit import DsiUnit

second = DsiUnit(r'\metre\second\tothe{-2}')
# How many of each unit are one m/s^2.
truth = {'hour': 3600.0**2, r'milli\second': 1e-6}
ratios = []
for unit, right in truth.items():
    per = DsiUnit(rf'\metre\per\{unit}\tothe{{2}}')
    negative = DsiUnit(rf'\metre\{unit}\tothe{{-2}}')
    by_per, by_negative = per.get_scale_factor(second), negative.get_scale_factor(second)
    print(f'{unit}: right {right:g}, by a negative exponent {by_negative:g}, by per {by_per:g}')
    print(f'  valid: {per.valid}, {negative.valid}')
    ratios += [by_negative / right, by_per / right / right]
sys.exit(any(abs(ratio - 1) > 1e-9 for ratio in ratios))
PROGRAM
