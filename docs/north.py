"""Draw docs/north.png: the gyro bias of six and of twelve positions against an unknown azimuth.

Usage: python docs/north.py
"""

from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from imu_calib.calibration.calibration import Calibration
from imu_calib.calibration.calibrator import Calibrator
from imu_calib.common.files import named_file
from imu_calib.common.units import DEG, DEG_H
from imu_calib.estimation.setup import Setup
from imu_calib.model.earth import Site, normal_gravity
from imu_calib.session.imu import load_imu
from imu_calib.session.plan import Plan, load_plan
from imu_calib.session.table import Table, load_table
from imu_calib.simulation.options import StandOptions
from imu_calib.simulation.stand import simulate

AZIMUTHS = np.arange(0.0, 5.01, 0.5)
TRUTH = Calibration.load(named_file('truths', 'cao2022_table1'))
SITE = Site.at(34.65 * DEG, gravity=normal_gravity(34.65 * DEG))
DARK, LIGHT = '#1b3a5c', '#c8553d'


def bias_error(plan: Plan, table: Table, azimuth: float) -> np.ndarray:
    """Return the error of D_g, deg/h, when the table's zero is `azimuth` deg off."""
    imu = load_imu('fog_medium')
    options = StandOptions(
        azimuth=azimuth * DEG, positioning_error=0.0, bias_instability=False, noise=False
    )
    calibrator = Calibrator(Setup(imu, plan, table, SITE, plan.method))
    for _, block in simulate(plan, table, imu, TRUTH.model, SITE, options, seed=1):
        calibrator.add_block(block)
    found = calibrator.finish().calibration.model.gyro.bias
    return (found - TRUTH.model.gyro.bias) / DEG_H


def main() -> None:
    """Run both methods over the azimuths and draw."""
    table = load_table('three_axis')
    believed = replace(table, azimuth=0.0)
    six = np.array([bias_error(load_plan('six_position'), believed, a) for a in AZIMUTHS])
    twelve = np.array([bias_error(load_plan('twelve_position'), table, a) for a in AZIMUTHS])
    print(f'twelve positions: moves by at most {np.ptp(twelve, axis=0).max():.4f} deg/h')

    figure, axes = plt.subplots(figsize=(7.5, 3.6), layout='constrained')
    sine = SITE.north_rate / DEG_H * np.sin(AZIMUTHS * DEG)
    for k, (name, marker, share) in enumerate(zip('xyz', 'os^', (2 / 3, -1 / 3, 0), strict=True)):
        axes.plot(AZIMUTHS, share * sine, color=LIGHT, linewidth=0.8)
        axes.plot(AZIMUTHS, six[:, k], marker, color=LIGHT, label=f'six positions, D_g{name}')
    for k, (name, marker) in enumerate(zip('xyz', 'os^', strict=True)):
        style = {'color': DARK, 'markerfacecolor': 'none'}
        axes.plot(AZIMUTHS, twelve[:, k], marker, label=f'twelve positions, D_g{name}', **style)
    axes.set_xlabel("how far the table's zero points off north, deg")
    axes.set_ylabel('error of the gyro bias, deg/h')
    axes.legend(fontsize=8, frameon=False, ncols=2)
    axes.spines[['top', 'right']].set_visible(False)
    figure.savefig(Path(__file__).parent / 'north.png', dpi=130)


if __name__ == '__main__':
    main()
