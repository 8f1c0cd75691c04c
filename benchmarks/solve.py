"""Time of a solution: thirty dwells, thirty turns and all terms together, on one core.

A session of the plan full_model followed by the twelve positions is simulated and cut, and solved
by the joint estimate. The measure is processor time of one thread, which does not depend on other
load.

    python benchmarks/solve.py [--times 5] [--profile]

Exit code 1: the median is above two seconds.
"""

from __future__ import annotations

import argparse
import os
import sys

# Small matrices gain nothing from threads; NumPy reads the variable when it is loaded.
os.environ['OMP_NUM_THREADS'] = '1'

import cProfile
import pstats
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / 'test'))

from sessions import SITE, fed, gathered, quick_plan, stand

from imu_calib.calibration.calibration import Calibration
from imu_calib.common.files import named_file
from imu_calib.estimation import joint
from imu_calib.estimation.evidence import Evidence
from imu_calib.estimation.setup import Setup
from imu_calib.model.terms import TERMS
from imu_calib.session.imu import load_imu
from imu_calib.session.table import load_table
from imu_calib.simulation.repetition import economical
from imu_calib.simulation.stand import simulate

ALLOWED = 2.0
DWELLS = 30
DWELL = 30.0


def evidence() -> Evidence:
    """Return a session of thirty dwells with turns at five rates in both senses about each axis."""
    full, twelve = quick_plan('full_model', DWELL), quick_plan('twelve_position', DWELL)
    more = [replace(p, rate_test=None) for p in twelve.positions]
    plan = replace(full, positions=(*full.positions, *more))
    imu, table = replace(load_imu('fog_navigation'), sample_rate=50.0), load_table('three_axis')
    model = Calibration.load(named_file('truths', 'fog_navigation_terms')).model
    setup = Setup(imu, plan, table, SITE, terms=TERMS)
    blocks = simulate(plan, table, imu, model, SITE, economical(stand(azimuth=0.4)), 1)
    return gathered(fed(blocks, setup))


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--times', type=int, default=5)
    parser.add_argument('--profile', action='store_true', help='say where the time goes')
    chosen = parser.parse_args()
    session = evidence()
    dwells, turns, moves = len(session.segments), len(session.turns), len(session.used_moves)
    solution = joint.solve(session, terms=TERMS)  # loads what is loaded once
    print(f'{dwells} dwells, {turns} turns, {moves} moves, {len(solution.parameters)} parameters')
    if chosen.profile:
        with cProfile.Profile() as profile:
            joint.solve(session, terms=TERMS)
        pstats.Stats(profile).sort_stats('cumulative').print_stats(35)
        return 0
    taken = []
    for _ in range(chosen.times):
        # Values that an evidence caches are part of a solution.
        fresh = replace(session)
        begin = time.process_time()
        joint.solve(fresh, terms=TERMS)
        taken.append(time.process_time() - begin)
    median = float(np.median(taken))
    print(f'{median:.2f} s of one core ({min(taken):.2f} to {max(taken):.2f}), allowed {ALLOWED} s')
    return 0 if dwells == DWELLS and median <= ALLOWED else 1


if __name__ == '__main__':
    sys.exit(main())
