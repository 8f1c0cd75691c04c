#!/usr/bin/env bash
# Commonly expected: the mean over days whose scatter is larger than that within a day has days - 1
# degrees of freedom. SunCal's own data set says so.
#
# What happens: the same readings in a model of uncertainty have readings - 1. The standard
# uncertainty is the one of the days, so for two days of four readings the coverage factor for 95 %
# is 2.4 (7 degrees of freedom) instead of 12.7 (1 degree): the expanded uncertainty is five times
# too small.
#
# Seen with suncal 1.7.1, Python 3.11, on 27 November 2026.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check --no-compile suncal==1.7.1 numpy==2.2.6
"$folder/venv/bin/python" - <<'PROGRAM'
import sys

import numpy as np
from suncal import Model
from suncal.datasets.dataset_model import DataSet

days = np.array([[1.1, 1.3, 0.9, 1.2], [1.5, 1.4, 1.6, 1.3]])
of_days = DataSet(days).result.uncertainty
model = Model('f = a')
model.var('a').measure(days)
result = model.calculate_gum()
u, dof = result.uncertainty['f'], result.degf['f']
expanded = result.expanded()['f']
truth = float(np.std(days.mean(axis=1), ddof=1) / np.sqrt(2))
print(f'standard uncertainty of the mean of two days: {truth:.4f}')
print(f'  data set {of_days.stderr:.4f}, model {u:.4f}')
print(f'degrees of freedom: data set {of_days.stderr_degf}, model {dof:.0f}')
print(f'coverage factor of the model: {expanded.k:.2f}; for 1 degree of freedom it is 12.71')
as_found = (
    of_days.reprod_significant
    and of_days.stderr_degf == 1
    and np.isclose(u, truth)
    and np.isclose(dof, 7)
)
sys.exit(not (as_found and np.isclose(expanded.k, 2.365, atol=0.001)))
PROGRAM
