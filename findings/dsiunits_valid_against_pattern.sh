#!/usr/bin/env bash
# Commonly expected: a unit that the library calls valid matches the pattern of valid units that
# the same library exports.
#
# What happens: a kibimetre, a milli-one, a squared percent and a millihour are valid and come
# without a remark on them; the pattern, which holds the rules of D-SI for prefixes and exponents,
# refuses all four. A certificate with them is called valid here and refused by who uses the
# pattern.
#
# Seen with dsiunits 3.1.3, Python 3.11, on 27 November 2026.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check dsiunits==3.1.3
"$folder/venv/bin/python" - <<'PROGRAM'
import re
import sys

from dsi_unit import DsiUnit, dsi_re

right = [r'\metre\second\tothe{-2}', r'\milli\metre']
wrong = [r'\kibi\metre', r'\milli\one', r'\percent\tothe{2}', r'\milli\hour']
seen = {}
for unit in (*right, *wrong):
    made = DsiUnit(unit)
    seen[unit] = made.valid, re.match(dsi_re.DSI_UNIT_REGEX, unit) is not None
    print(f'{unit}: valid {seen[unit][0]}, warnings {made.warnings}, by the pattern {seen[unit][1]}')
as_found = all(seen[u] == (True, True) for u in right) and all(seen[u] == (True, False) for u in wrong)
sys.exit(not as_found)
PROGRAM
