"""Draw docs/temperature.png: a unit that drifts, calibrated at three temperatures and combined.

Usage: python docs/temperature.py
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from imu_calib.calibration.calibration import Calibration
from imu_calib.calibration.calibrator import Calibrator
from imu_calib.calibration.thermal import combine
from imu_calib.common.files import named_file
from imu_calib.common.units import DEG, DEG_H, MICRO_G
from imu_calib.estimation.setup import Setup
from imu_calib.model.earth import Site, normal_gravity
from imu_calib.model.parameters import PARAMETER_NAMES
from imu_calib.session.imu import load_imu
from imu_calib.session.plan import load_plan
from imu_calib.session.table import load_table
from imu_calib.simulation.options import StandOptions, ThermalDrift, Warming
from imu_calib.simulation.stand import simulate

TEMPERATURES = (-20.0, 20.0, 55.0)
CHECKS = (-5.0, 5.0, 35.0, 45.0)
REFERENCE = 25.0
DRIFT = ThermalDrift(
    gyro_bias=(0.01 * DEG_H, -0.02 * DEG_H, 0.015 * DEG_H),
    gyro_scale=(2e-6, -3e-6, 1e-6),
    accel_bias=(10 * MICRO_G, -6 * MICRO_G, 8 * MICRO_G),
    accel_scale=(3e-6, 5e-6, -2e-6),
)
TRUTH = Calibration.load(named_file('truths', 'cao2022_table1')).model
SITE = Site.at(34.65 * DEG, gravity=normal_gravity(34.65 * DEG))
DARK, LIGHT = '#1b3a5c', '#c8553d'


def calibrated(celsius: float, seed: int) -> Calibration:
    """Run a session of twelve positions at a temperature."""
    plan, table, imu = (
        load_plan('twelve_position'),
        load_table('three_axis'),
        load_imu('fog_medium'),
    )
    options = StandOptions(
        positioning_error=0.0,
        bias_instability=False,
        warming=Warming(reference=REFERENCE, offset=celsius - REFERENCE),
        thermal_drift=DRIFT,
    )
    calibrator = Calibrator(Setup(imu, plan, table, SITE))
    for _, block in simulate(plan, table, imu, TRUTH, SITE, options, seed):
        calibrator.add_block(block)
    return calibrator.finish().calibration


def truth(celsius: np.ndarray, name: str) -> np.ndarray:
    """Return a parameter of channel x as the simulation has it, SI units."""
    excess = celsius - REFERENCE
    triad, drift_bias, drift_scale = {
        'g': (TRUTH.gyro, DRIFT.gyro_bias, DRIFT.gyro_scale),
        'a': (TRUTH.accel, DRIFT.accel_bias, DRIFT.accel_scale),
    }[name[2]]
    if name[0] == 'D':
        return triad.bias[0] + excess * drift_bias[0]
    return (1 + excess * drift_scale[0]) * triad.response[0, 0] - 1


def main() -> None:
    """Calibrate at three temperatures, combine, and look at others."""
    points = [calibrated(celsius, seed) for seed, celsius in enumerate(TEMPERATURES)]
    combined = combine(points, [str(t) for t in TEMPERATURES])
    checks = [calibrated(celsius, 10 + seed) for seed, celsius in enumerate(CHECKS)]
    course = np.linspace(-30.0, 65.0, 96)
    found = [combined.at(float(celsius)) for celsius in course]
    figure, axes = plt.subplots(2, 2, figsize=(7.5, 4.6), layout='constrained', sharex=True)
    shown = {
        'D_gx': (DEG_H, 'deg/h'),
        'K_gx': (1e-6, 'ppm'),
        'D_ax': (MICRO_G, 'micro-g'),
        'K_ax': (1e-6, 'ppm'),
    }
    for part, (name, (unit, text)) in zip(axes.flat, shown.items(), strict=True):
        k = PARAMETER_NAMES.index(name)
        # Everything against the line that the truth is on.
        base = truth(course, name)
        value = (np.array([c.values[k] for c in found]) - base) / unit
        doubt = np.array([c.std[k] for c in found]) / unit
        part.axhline(0, color=LIGHT, linewidth=0.8, label='truth')
        part.plot(course, value, color=DARK, label='combined')
        part.fill_between(course, value - 2 * doubt, value + 2 * doubt, color=DARK, alpha=0.15)
        for celsius, mark, known in (
            *((t, 'o', c) for t, c in zip(TEMPERATURES, points, strict=True)),
            *((t, '^', c) for t, c in zip(CHECKS, checks, strict=True)),
        ):
            error = (known.values[k] - truth(np.array(celsius), name)) / unit
            style = {'color': DARK if mark == 'o' else LIGHT, 'markersize': 4, 'capsize': 2}
            style['label'] = {
                TEMPERATURES[0]: 'what is combined',
                CHECKS[0]: 'other sessions',
            }.get(celsius)
            part.errorbar(celsius, error, 2 * known.std[k] / unit, fmt=mark, **style)
        inside = (course >= TEMPERATURES[0]) & (course <= TEMPERATURES[-1])
        span = 3.5 * float(doubt[inside].max())
        part.set_ylim(-span, span)
        for end in (TEMPERATURES[0], TEMPERATURES[-1]):
            part.axvline(end, color='0.7', linewidth=0.6, linestyle=':')
        part.set_title(f'error of {name}, {text}', fontsize=9)
        part.spines[['top', 'right']].set_visible(False)
        worst = np.abs(value / doubt)[inside].max()
        print(f'{name}: at most {worst:.1f} standard deviations off between the ends')
    for part in axes[1]:
        part.set_xlabel('temperature, degC')
    axes[0, 0].legend(fontsize=7, frameon=False, ncols=2, loc='lower left')
    figure.savefig(Path(__file__).parent / 'temperature.png', dpi=130)


if __name__ == '__main__':
    main()
