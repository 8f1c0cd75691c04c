"""Compare predicted and achieved standard deviations of every supplied plan for a table.

Every session is simulated by the hardware-level simulation, cut and solved by the plan's method.
The prediction uses plan, table, data sheet and truth, and no session. For a good one the ratio is
within the uncertainty of the spread of the runs.

    python benchmarks/prediction.py [PLAN ...] [--runs 1000] [--jobs 2] [--scheduler ADDRESS]
                                    [--sample-rate 20] [--keep FOLDER]

Exit code 1: a parameter differs by more than 10 % and that uncertainty.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from imu_calib.calibration.calibration import Calibration
from imu_calib.common.errors import ImuCalibError, InputError
from imu_calib.common.files import named_file, share_folder
from imu_calib.common.units import DEG
from imu_calib.estimation.forecast import forecast
from imu_calib.estimation.setup import Setup
from imu_calib.model.earth import Site, normal_gravity
from imu_calib.model.parameters import Parameter
from imu_calib.model.terms import TERMS
from imu_calib.session.imu import load_imu
from imu_calib.session.plan import Plan, load_plan
from imu_calib.session.table import Table, load_table
from imu_calib.simulation.options import StandOptions
from imu_calib.simulation.repetition import Study, economical, repeat

SITE = Site.at(34.65 * DEG, gravity=normal_gravity(34.65 * DEG))
TOLERANCE = 0.1
UNLIKELY = 0.01
HEADING = 30 * DEG
TABLES = ('two_axis', 'two_axis_off_axis', 'two_axis_level', 'three_axis')
USUAL = ('fog_medium', 'cao2022_table1')
UNITS = {
    'skewed': ('fog_skewed', 'fog_skewed'),
    'full_model': ('fog_navigation', 'fog_navigation_terms'),
}
"""Unit and truth by plan, if not the usual one."""
ASKED = {'full_model': TERMS}
"""Terms by plan, if it is designed for more than its method's parameters."""
PLACED = {'P_axy': 30e-3, 'P_axz': -21e-3, 'P_ayz': 15e-3, 'P_azx': 9e-3, 'T_a': 1e-3}
"""Terms of motion, m and s, if requested: no truth of that grade has any."""


def study(name: str, sample_rate: float | None = None) -> Study:
    """Return a supplied plan with its method, a unit, and the simplest table that runs it.

    The heading of the table is known if the method requires it, else it differs in each run.
    """
    plan = load_plan(name)
    unit, truth = UNITS.get(plan.name, USUAL)
    table = plainest_table(plan)
    model = Calibration.load(named_file('truths', truth)).model
    options = economical(StandOptions(positioning_error=0.0, bias_instability=False))
    imu = load_imu(unit)
    if sample_rate is not None:
        imu = replace(imu, sample_rate=sample_rate)
    setup = Setup(imu, plan, table, SITE, plan.method, terms=ASKED.get(plan.name, ()))
    placed = [p for p in setup.parameters if p.name in PLACED]
    model = model.with_values(placed, [PLACED[p.name] for p in placed])
    if not np.isfinite(forecast(setup, model).std).any():
        setup = replace(setup, table=replace(table, azimuth=HEADING))
        return Study(setup, model, options, HEADING)
    return Study(setup, model, options)


def plainest_table(plan: Plan) -> Table:
    """Return the supplied table with the fewest joints that can run a plan."""
    reasons = []
    for name in TABLES:
        table = load_table(name)
        try:
            plan.steps(table)
        except ImuCalibError as error:
            reasons.append(str(error))
        else:
            return table
    raise InputError(f'No table runs plan {plan.name}. {" ".join(reasons)}')


def compare(
    case: Study, runs: int, jobs: int | None, keep: Path | None, scheduler: str | None = None
) -> bool:
    """Print one plan; return whether every parameter is within its bounds."""
    name = case.setup.plan.name
    setup = case.setup
    foreseen = forecast(setup, case.truth, case.azimuth)
    if foreseen.refusal:
        print(f'{name}: {foreseen.refusal}')
        return True
    outcome = repeat(case, runs, jobs=jobs, scheduler=scheduler)
    if keep is not None:
        np.savez(keep / f'{name}.npz', errors=outcome.errors, stated=outcome.stated)
    print(f'{name} ({setup.method_name}): {len(outcome.errors)} of {runs} runs', end=', ')
    known = np.isfinite(foreseen.std)
    parameters = [p for p, told in zip(foreseen.parameters, known, strict=True) if told]
    return judge(parameters, outcome.errors[:, known], foreseen.std[known])


def judge(parameters: Sequence[Parameter], errors: np.ndarray, foreseen: np.ndarray) -> bool:
    """Print the spread of (runs, n) errors over (n,) predictions; return whether all hold."""
    count = len(errors)
    spread = errors.std(axis=0, ddof=1)
    ratio = spread / foreseen
    each = UNLIKELY / len(ratio) / 2
    low, high = np.sqrt(chi2.ppf([each, 1 - each], count - 1) / (count - 1))
    print('achieved over predicted')
    for triad in ('g', 'a'):
        cells = [
            f'{parameter.name} {value:.3f}'
            for parameter, value in zip(parameters, ratio, strict=True)
            if parameter.triad == triad
        ]
        if cells:
            print('  ' + '  '.join(cells))
    bias = np.abs(errors.mean(axis=0) / spread * np.sqrt(count)).max()
    print(
        f'  {ratio.min():.3f} to {ratio.max():.3f}; so many runs alone spread from {low:.3f} to '
        f'{high:.3f}; largest bias {bias:.1f} of its deviations\n',
        flush=True,
    )
    return bool((ratio > (1 - TOLERANCE) * low).all() and (ratio < (1 + TOLERANCE) * high).all())


def shipped() -> list[str]:
    """Supplied plans for a table."""
    paths = sorted((share_folder() / 'config' / 'plans').glob('*.yaml'))
    return [path.stem for path in paths if not load_plan(path).by_hand]


def main() -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('plans', nargs='*')
    parser.add_argument('--runs', type=int, default=1000)
    parser.add_argument('--jobs', type=int)
    parser.add_argument('--scheduler', metavar='ADDRESS', help='of a Dask cluster')
    parser.add_argument(
        '--sample-rate', type=float, metavar='HZ', help="of the IMU; default: its data sheet's"
    )
    parser.add_argument('--keep', type=Path, help='folder for errors and deviations of all runs')
    chosen = parser.parse_args()
    if chosen.keep is not None:
        # Before the hours of work, not after them.
        chosen.keep.mkdir(parents=True, exist_ok=True)
    names = chosen.plans or shipped()
    cases = (study(name, chosen.sample_rate) for name in names)
    kept = [
        compare(case, chosen.runs, chosen.jobs, chosen.keep, chosen.scheduler) for case in cases
    ]
    return 0 if all(kept) else 1


if __name__ == '__main__':
    sys.exit(main())
