#!/usr/bin/env bash
# Commonly expected: a library of units finds a way from degree Celsius to kelvin, at least for
# differences of temperature (factor 1), or refuses with an error.
#
# What happens: both units are valid, and the factor between them is not a number. It goes on
# silently into whatever it is multiplied by.
#
# Seen with dsiunits 3.1.3, Python 3.11, on 27 November 2026.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check dsiunits==3.1.3
"$folder/venv/bin/python" - <<'PROGRAM'
import math
import sys

from dsi_unit import DsiUnit

celsius, kelvin = DsiUnit(r'\degreecelsius'), DsiUnit(r'\kelvin')
factor = celsius.get_scale_factor(kelvin)
print('degree Celsius valid:', celsius.valid, '  kelvin valid:', kelvin.valid)
print('factor between them:', factor)
sys.exit(not (celsius.valid and kelvin.valid and math.isnan(factor)))
PROGRAM
