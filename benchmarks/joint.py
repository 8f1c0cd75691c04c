"""The joint estimate over many seeds of a twelve-position session, against the Cramer-Rao bound.

Every session is simulated and cut completely, and solved twice: with the moves between dwells,
against the bound that includes them, and without, against the bound of dwells and turns only.
Printed are the root-mean-square error over the bound (random walk and quantisation of the full
stream, azimuth and tilts unknown) of all parameters together and of each, that of the closed form,
and whether the normalised errors are standard normal. A perfect estimator stays below the limits in
99 of 100 cases. The bound uses the stream beyond whole turns only for the positions of the counters
at the cuts, not for the rate.

    python benchmarks/joint.py [--seeds 500] [--jobs 2] [--scheduler ADDRESS] [--drifting]

Exit code 1: a ratio is above its limit.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.stats import chi2, kstest, norm

sys.path.insert(0, str(Path(__file__).parents[1] / 'test' / 'support'))

from bound import bound
from sessions import SITE, paper_imu, simulated, stand, truth

from imu_calib.common.parallel import run_all
from imu_calib.common.stream import Floats
from imu_calib.estimation import joint
from imu_calib.estimation.closed_forms import positions as twelve_position
from imu_calib.model.parameters import PARAMETER_NAMES
from imu_calib.session.imu import load_imu
from imu_calib.session.plan import load_plan
from imu_calib.session.table import load_table
from imu_calib.simulation.repetition import economical

VARIANTS = ('with moves', 'without moves')
SETTLE = 1.0
ONE_IN_A_HUNDRED = 0.01


def run(seed: int, *, drifting: bool) -> Floats:
    """Return errors, deviations, those of the closed form, and the bound: (2, 5, 24).

    First with the moves, then without.
    """
    azimuth = float(np.random.default_rng(seed + 1000).uniform(-np.pi, np.pi))
    plan, model = load_plan('twelve_position'), truth().model
    options = economical(replace(stand(azimuth=azimuth), bias_instability=drifting))
    spec = load_imu('fog_medium') if drifting else paper_imu()
    evidence = simulated(plan, options, seed, spec=spec)
    closed, real = twelve_position.solve_twelve_position(evidence), model.vector()
    at_rest = {position.id: position.dwell + SETTLE for position in plan.positions}
    variants = []
    for moves in (True, False):
        found = joint.solve(evidence if moves else replace(evidence, moves=()))
        table = load_table('three_axis') if moves else None
        floor = bound(plan, spec, model, SITE, azimuth, at_rest, table)
        errors = [found.model.vector() - real, found.std, closed.model.vector() - real, closed.std]
        variants.append([*errors, floor])
    return np.array(variants)


def report(runs: Floats) -> bool:
    """Print the table of (n, 5, 24) runs; return whether the ratios are within their limits."""
    error, std, closed, closed_std, floor = np.swapaxes(runs, 0, 1)
    count = len(error)
    ratios, of_closed = root_mean_square(error / floor), root_mean_square(closed / floor)
    normal, closed_normal = root_mean_square(error / std), root_mean_square(closed / closed_std)
    limit = np.sqrt(chi2.isf(ONE_IN_A_HUNDRED, count) / count)
    print(f'{count} sessions; error over the bound, error over its standard deviation')
    print(f'{"":6s} {"joint":>7s} {"closed":>7s}   {"joint":>7s} {"closed":>7s}')
    rows = zip(PARAMETER_NAMES, ratios, of_closed, normal, closed_normal, strict=True)
    for name, *values in rows:
        print('{:6s} {:7.3f} {:7.3f}   {:7.3f} {:7.3f}'.format(name, *values))
    size = error.size
    pooled = float(np.sqrt(np.mean((error / floor) ** 2)))
    pooled_closed = float(np.sqrt(np.mean((closed / floor) ** 2)))
    pooled_limit = float(np.sqrt(chi2.isf(ONE_IN_A_HUNDRED, size) / size))
    each = float(np.sqrt(chi2.isf(ONE_IN_A_HUNDRED / len(ratios), count) / count))
    print(f'pooled {pooled:.4f} (closed form {pooled_closed:.4f}), limit {pooled_limit:.4f}')
    print(f'worst  {ratios.max():.4f}, limit {each:.4f} (of a single one {limit:.4f})')
    scaled = (error / std).ravel()
    print(
        f'normalised errors: {np.sqrt(np.mean(scaled**2)):.4f}, largest {np.abs(scaled).max():.2f} '
        f'(expected {norm.isf(0.5 / size):.2f}), Kolmogorov-Smirnov p = '
        f'{kstest(scaled, "norm").pvalue:.3f}'
    )
    return pooled <= pooled_limit and bool(ratios.max() <= each)


def root_mean_square(values: Floats) -> Floats:
    """Return the root mean square of every parameter over the runs."""
    return np.asarray(np.sqrt(np.mean(values**2, axis=0)))


def main() -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seeds', type=int, default=500)
    parser.add_argument('--jobs', type=int)
    parser.add_argument('--scheduler', metavar='ADDRESS', help='of a Dask cluster')
    parser.add_argument('--drifting', action='store_true', help='biases drift by the data sheet')
    chosen = parser.parse_args()
    one = partial(run, drifting=chosen.drifting)
    runs = np.array(run_all(one, range(chosen.seeds), jobs=chosen.jobs, scheduler=chosen.scheduler))
    kept = True
    for words, variant in zip(VARIANTS, np.swapaxes(runs, 0, 1), strict=True):
        print(f'\n{words}: ', end='')
        kept &= report(variant)
    gained = runs[0, 0, 4] / runs[0, 1, 4]
    cells = [f'{n} {g:.3f}' for n, g in zip(PARAMETER_NAMES, gained, strict=True) if g < 0.995]
    print(f'\nbound with moves over without, where they tell: {"  ".join(cells)}')
    return 0 if kept or chosen.drifting else 1


if __name__ == '__main__':
    # Workers find the function by the name of this module.
    import joint

    sys.exit(joint.main())
