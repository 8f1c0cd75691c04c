#!/usr/bin/env bash
# Commonly expected: the World Magnetic Model's own Python module gives the uncertainty of the
# declination by the error model its README points to: sqrt(0.26^2 + (5417 / H)^2) degrees with H
# in nT, 0.37 degrees in Munich. And setup_env(msl=True) takes the height as one above the sea.
#
# What happens: get_uncertainty() takes 0.26 / H for the second term (its 5417 is never read) and the
# whole part of 0.26 for the first, which is nothing: 0.000012 degrees in Munich, 30 000 times too
# sure. msl=True changes nothing: south of India, where the sea lies 100 m below the ellipsoid, the
# field is that of the height 0 on the ellipsoid.
#
# Seen with wmm-calculator 1.4.4 beside pygeomag 1.1.0, Python 3.11, on 28 November 2026.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check --no-compile \
  wmm-calculator==1.4.4 geomaglib==1.2.4 pygeomag==1.1.0 numpy==2.2.6
"$folder/venv/bin/python" - <<'PROGRAM'
import sys

from pygeomag import GeoMag
from wmm import wmm_calc


def model(latitude, longitude, height, **setting):
    it = wmm_calc()
    it.setup_time(dyear=2026.9)
    it.setup_env(latitude, longitude, height, unit='m', **setting)
    return it


munich = 48.14, 11.58
own = model(*munich, 0.0)
peer = GeoMag().calculate(*munich, 0.0, 2026.9)
uncertainty = float(own.get_uncertainty()['declination_uncertainty'][0])
expected = peer.calculate_uncertainty().d
print(f'declination: {own.get_Bdec()[0]:.5f}, of pygeomag {peer.d:.5f} degrees')
print(f'its uncertainty: {uncertainty:.6f}, of pygeomag {expected:.6f} degrees')
low = 5.0, 78.0
fields = [float(model(*low, 0.0, msl=msl).get_Bf()[0]) for msl in (False, True)]
below = float(model(*low, -100.0).get_Bf()[0])
print(f'total field with msl=False {fields[0]:.2f}, msl=True {fields[1]:.2f} nT')
print(f'100 m below the ellipsoid: {below:.2f} nT')
sys.exit(
    not (
        abs(own.get_Bdec()[0] - peer.d) < 1e-4
        and abs(uncertainty - 0.26 / peer.h) < 1e-9
        and abs(expected - 0.3653) < 1e-3
        and fields[0] == fields[1]
        and below - fields[0] > 2
    )
)
PROGRAM
