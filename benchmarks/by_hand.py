"""Compare predicted and achieved standard deviations of the plans without a table.

The result of holds in the hand depends on the motion between them. Here it is that of the
predictions: about one axis in two seconds, in free positions on the shortest path, in the six
positions to an unknown heading.

    python benchmarks/by_hand.py [PLAN ...] [--runs 1000] [--jobs 2] [--scheduler ADDRESS]

Exit code 1: a parameter differs by more than 10 % and the scatter of the runs.
"""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path

import numpy as np
from prediction import SITE, judge

sys.path.insert(0, str(Path(__file__).parents[1] / 'test' / 'support'))

from hand_sessions import shortest_turns

from imu_calib.calibration.calibration import Calibration
from imu_calib.calibration.calibrator import calibrator_of
from imu_calib.common.files import named_file
from imu_calib.common.parallel import run_all
from imu_calib.estimation.forecast import forecast
from imu_calib.estimation.hand import NAME as FREE_POSITIONS
from imu_calib.estimation.hand import in_frame_of_accelerometers
from imu_calib.estimation.setup import Setup
from imu_calib.model.parameters import PARAMETERS
from imu_calib.model.sensors import SensorModel
from imu_calib.session.imu import load_imu
from imu_calib.session.plan import load_plan
from imu_calib.simulation.hand import HandSession, as_planned
from imu_calib.simulation.options import ImuOptions

UNIT = 'mems_counts'
PLANS = ('six_position_by_hand', 'free_positions')


def one(setup: Setup, truth: SensorModel, seed: int) -> np.ndarray:
    """Return the errors of a session, (24,)."""
    calibrator = calibrator_of(setup)
    options = ImuOptions(bias_instability=False)
    for block in session(setup, seed).blocks(setup.imu, truth, setup.site, options, seed):
        calibrator.add_block(block)
    return calibrator.finish().calibration.model.vector() - truth.vector()


def session(setup: Setup, seed: int) -> HandSession:
    """Lay out a session with unknown headings."""
    rng = np.random.default_rng([seed, 1])
    if setup.method_name == FREE_POSITIONS:
        ups, seconds = zip(*((p.up, p.dwell) for p in setup.plan.positions), strict=True)
        heading = float(rng.uniform(-np.pi, np.pi))
        return shortest_turns(np.array(ups), np.array(seconds), heading=heading)
    return as_planned(setup.plan, rng)


def compare(name: str, runs: int, jobs: int | None, scheduler: str | None) -> bool:
    """Print one plan; return whether every parameter is within its bounds."""
    setup = Setup(load_imu(UNIT), load_plan(name), None, SITE)
    truth = Calibration.load(named_file('truths', UNIT)).model
    if setup.method_name == FREE_POSITIONS:
        truth = in_frame_of_accelerometers(truth)
    foreseen = forecast(setup, truth).std
    known = foreseen > 0
    errors = np.array(
        run_all(partial(one, setup, truth), range(runs), jobs=jobs, scheduler=scheduler)
    )
    parameters = [p for p, told in zip(PARAMETERS, known, strict=True) if told]
    print(f'{name}: {runs} runs', end=', ')
    return judge(parameters, errors[:, known], foreseen[known])


def main() -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('plans', nargs='*', default=PLANS)
    parser.add_argument('--runs', type=int, default=1000)
    parser.add_argument('--jobs', type=int)
    parser.add_argument('--scheduler', metavar='ADDRESS', help='of a Dask cluster')
    chosen = parser.parse_args()
    kept = [compare(n, chosen.runs, chosen.jobs, chosen.scheduler) for n in chosen.plans]
    return 0 if all(kept) else 1


if __name__ == '__main__':
    # Workers find the function by the name of this module.
    import by_hand

    sys.exit(by_hand.main())
