#!/usr/bin/env bash
# Commonly expected: AhrsSettings(convention=CONVENTION_ENU) gives settings in east, north, up, as
# gain=... gives a gain.
#
# What happens: the keyword is accepted, and the convention stays north, west, up; the same for
# the first positional argument. An unknown keyword is refused, so nothing seems wrong. Only the
# attribute sets it, after construction.
#
# Seen with imufusion 1.3.3, Python 3.11, on 27 November 2026.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check imufusion==1.3.3 numpy==2.2.6
"$folder/venv/bin/python" - <<'PROGRAM'
import sys

from imufusion import CONVENTION_ENU, CONVENTION_NWU, AhrsSettings

names = {CONVENTION_NWU: 'NWU', CONVENTION_ENU: 'ENU'}
by_keyword = AhrsSettings(convention=CONVENTION_ENU)
by_attribute = AhrsSettings()
by_attribute.convention = CONVENTION_ENU
print('asked for ENU by keyword:  ', names[by_keyword.convention])
print('asked for ENU by attribute:', names[by_attribute.convention])
print('asked for gain 7 by keyword:', AhrsSettings(gain=7.0).gain)
wrong = by_keyword.convention == CONVENTION_NWU and by_attribute.convention == CONVENTION_ENU
sys.exit(not wrong)
PROGRAM
