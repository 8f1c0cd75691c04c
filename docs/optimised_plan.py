"""Make config/plans/optimised_twelve.yaml anew, and say what it gains.

    python docs/optimised_plan.py > config/plans/optimised_twelve.yaml

The plan goes to the output, what it gains to the terminal.
"""

from __future__ import annotations

import sys

import numpy as np

from imu_calib.calibration import Calibration
from imu_calib.calibrator import Setup
from imu_calib.earth import Site, normal_gravity
from imu_calib.imu import load_imu
from imu_calib.model import PARAMETER_NAMES
from imu_calib.plan import load_plan
from imu_calib.prediction import duration, forecast
from imu_calib.prediction.optimise import Optimum, optimise
from imu_calib.share import named_file
from imu_calib.turntable import load_table
from imu_calib.units import DEG

RATE = 60 * DEG


def main() -> None:
    """Optimise for the time that twelve positions take."""
    table = load_table('three_axis')
    plan = load_plan('twelve_position')
    truth = Calibration.load(named_file('truths', 'cao2022_table1')).model
    setup = Setup(
        load_imu('fog_medium'),
        plan,
        table,
        Site.at(34.65 * DEG, gravity=normal_gravity(34.65 * DEG)),
        'joint',
    )
    seconds = duration(plan.steps(table), table)
    found = optimise(setup, truth, seconds, RATE)
    print(written(found))
    optimised = Setup(setup.imu, found.plan, table, setup.site, 'joint')
    before, after = forecast(setup, truth).std, forecast(optimised, truth).std
    for name, ratio in zip(PARAMETER_NAMES, after / before, strict=True):
        print(f'{name} {ratio:.2f}', file=sys.stderr)
    print(
        f'{found.seconds / 60:.1f} min against {seconds / 60:.1f}; geometric mean of the standard '
        f'deviations {np.exp(np.log(after / before).mean()):.2f} of twelve positions',
        file=sys.stderr,
    )


def written(found: Optimum) -> str:
    """Return the plan as its file."""
    test = next(p.rate_test for p in found.plan.positions if p.rate_test is not None)
    rates = ', '.join(f'{rate / DEG:g} deg/s' for rate in test.rates)
    lines = [
        'name: optimised_twelve',
        'title: Twelve attitudes chosen to tell most in the time of twelve positions, any azimuth',
        'source: D-optimal exchange, Fedorov 1972; docs/optimised_plan.md',
        'method: joint',
        f'dwell: {found.plan.positions[0].dwell:g} s',
        'rate_test:',
        f'  rates: [{rates}]',
        f'  turns: {test.turns}',
        'positions:',
    ]
    for position, attitude in zip(found.plan.positions, found.attitudes, strict=True):
        turning = ', rate_test: true' if position.rate_test is not None else ''
        lines.append(f'  - {{id: {position.id}, {attitude.text()}{turning}}}')
    return '\n'.join(lines)


if __name__ == '__main__':
    main()
