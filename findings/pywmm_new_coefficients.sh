#!/usr/bin/env bash
# Commonly expected: update_coefficients "allows updating the model's coefficients without
# reinitializing the entire object" (docstring): with the file that the model already has, the
# declination stays what it was.
#
# What happens: the new coefficients are read, but not brought to the normalisation that the sum
# needs. It returns True, and the declination of 48 N 11 E falls from 4.2 to 1.9 degrees, the
# intensity by 827 nT.
#
# Seen with pywmm 1.1.1 and its own WMM.COF of 2025, Python 3.11, on 28 November 2026.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check pywmm==1.1.1 numpy==2.2.6
"$folder/venv/bin/python" - <<'PROGRAM'
import sys
from pathlib import Path

import pywmm

where = (48.0, 11.0, 2026.9, 0.5)
file = str(Path(pywmm.__file__).parent / 'data' / 'WMM.COF')
updated, anew = pywmm.WMMv2(), pywmm.WMMv2(coeff_file=file)
before = updated.get_declination(*where), updated.get_intensity(*where)
print('update_coefficients returns', updated.update_coefficients(new_coeff_file=file))
after = updated.get_declination(*where), updated.get_intensity(*where)
fresh = anew.get_declination(*where), anew.get_intensity(*where)
for name, (declination, intensity) in {'before': before, 'after': after, 'a new one': fresh}.items():
    print(f'{name}: declination {declination:.2f} degrees, intensity {intensity:.0f} nT')
sys.exit(not (fresh == before and before[0] - after[0] > 2 and before[1] - after[1] > 500))
PROGRAM
