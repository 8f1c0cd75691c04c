"""Comparison with imucal (FAU Erlangen, PyPI): the same sessions, the error of each parameter.

Simulated are sessions of six positions with turns about each axis, of a tactical-grade unit
(fog_medium) and of a MEMS unit (mems_counts), each with the table's positioning errors. imucal's
TurntableCalibration gets the samples at rest and, from rest to rest, the 720 deg of one turn about
each axis; ours gets the streams. The real session by hand (test/data/hand_session) has no truth:
the difference in our standard deviations is shown.

imucal's model, calibrated = R^-1 K^-1 (raw - K_ga acc - b), means raw = K R input + b + K_ga acc,
so that I + M = K R and d = b: all 24 can be compared.

    pip install imucal; python benchmarks/imucal.py [--runs 20]
"""

from __future__ import annotations

import argparse
import csv
import sys
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from types import ModuleType

import numpy as np

from imu_calib.calibration.calibration import Calibration
from imu_calib.calibration.calibrator import Calibrator
from imu_calib.common.errors import NotObservable
from imu_calib.common.files import named_file
from imu_calib.common.stream import Floats, ImuBlock, Mode, Units
from imu_calib.common.units import ARCSEC, DEG
from imu_calib.estimation.setup import Setup
from imu_calib.model.earth import Site, normal_gravity
from imu_calib.model.parameters import AXES, PARAMETERS, engineering
from imu_calib.model.sensors import SensorModel, Triad
from imu_calib.recordings.cdr_codec import Kind
from imu_calib.recordings.rosbag2 import open_recording
from imu_calib.session.imu import ImuSpec, load_imu
from imu_calib.session.plan import load_plan
from imu_calib.session.table import load_table
from imu_calib.simulation.options import StandOptions
from imu_calib.simulation.stand import SimulatedStand

SITE = Site.at(34.65 * DEG, gravity=normal_gravity(34.65 * DEG))
HEADING = 20 * DEG
TURN_RATE = 60 * DEG
HAND = Path(__file__).parent.parent / 'test' / 'data' / 'hand_session'
REASONS = {
    'K_g': 'one turn in one sense against six turns at three rates; the IMU clock counts for it, '
    'the encoders for ours',
    'E_g': 'the level Earth rate of one hold passes for sensitivity to g (K_ga) and is subtracted '
    'from the turn: up to 12 deg/h in 60 deg/s, 0.2 arcmin; ours averages it out over whole turns',
    'D_g': 'in these six attitudes the Earth rate cancels from its mean too; what is left: a '
    'plain mean keeps a pulse at both ends of a hold, and the bias drifts (both alike)',
    'K_a': 'the same two holds; a line through the count is surer than its ends (no pulses, no '
    'difference)',
    'E_a': 'the same; six positions cannot tell E_a from a table that leans, which our stated '
    'deviation allows for (20 arcsec) and imucal does not mention',
    'D_a': 'its bias of an axis is that of its own two holds, ours of all six',
    'by hand': 'K_gy and K_gz are 0.4 deg of a turn apart: its K_ga explains 50 ppm of that, the '
    'rest may be where the turn is cut, which nobody knows; it states no deviations',
}


def package() -> ModuleType:
    """Import imucal, which the name of this file would hide."""
    here = Path(__file__).resolve().parent
    sys.path = [p for p in sys.path if Path(p or '.').resolve() != here]
    return import_module('imucal')


@dataclass(frozen=True, eq=False)
class Unit:
    """A type of IMU, and one unit of it."""

    title: str
    spec: ImuSpec
    truth: SensorModel


def units() -> list[Unit]:
    """The two simulated units."""
    fog = load_imu('fog_medium')
    mems = replace(load_imu('mems_counts'), sample_rate=100.0)
    rng = np.random.default_rng(4)
    gyro = Triad(rng.normal(0, 5e-3, (3, 3)), rng.normal(0, 0.3 * DEG, 3))
    accel = Triad(rng.normal(0, 5e-3, (3, 3)), rng.normal(0, 0.2, 3))
    paper = Calibration.load(named_file('truths', 'cao2022_table1')).model
    return [
        Unit('tactical grade (fog_medium)', fog, paper),
        Unit('MEMS (mems_counts)', mems, SensorModel(gyro, accel)),
    ]


def run(unit: Unit, seed: int) -> tuple[Floats, Floats, Floats]:
    """Return errors of imucal and of ours, and our standard deviations, (24,) each."""
    plan = load_plan('six_position')
    table = replace(load_table('three_axis'), azimuth=HEADING)
    options = StandOptions(azimuth=HEADING, positioning_error=2 * ARCSEC, block_length=300.0)
    stand = SimulatedStand(plan, table, unit.spec, unit.truth, SITE, options, seed)
    calibrator = Calibrator(Setup(unit.spec, plan, table, SITE, 'joint'))
    blocks: list[ImuBlock] = []
    for _, block in stand.blocks():
        calibrator.add_block(block)
        if isinstance(block, ImuBlock):
            blocks.append(block)
    try:
        calibration = calibrator.finish().calibration
        ours, std = calibration.model.vector(), calibration.std[:24]
    except NotObservable:
        # Drifting biases resemble another Earth rate, and ours refuses to guess.
        ours = std = np.full(24, np.nan)
    regions: dict[str, Floats] = {}
    for visit in stand.visits:
        name = visit.step.position
        if visit.step.mode is Mode.RATE:
            rate = visit.step.rates[np.argmax(np.abs(visit.step.rates))]
            if abs(rate - TURN_RATE) < 1e-6:
                cut = (visit.begin - 0.5, visit.rest + 0.5)
                put(regions, f'{name[0]}_rot', blocks, unit.spec, cut, options.start_time)
        elif visit.step.dwell:
            kind = {'up': 'p', 'down': 'a'}[name[2:]]
            cut = (visit.end - visit.step.dwell, visit.end)
            put(regions, f'{name[0]}_{kind}', blocks, unit.spec, cut, options.start_time)
    imucal = package()
    theirs = imucal.TurntableCalibration(grav=SITE.gravity, expected_angle=720.0).compute(
        imucal.FerrarisSignalRegions(**regions), 100.0, 'm/s^2', 'deg/s'
    )
    real = unit.truth.vector()
    return as_vector(theirs) - real, ours - real, std


def put(
    regions: dict[str, Floats],
    name: str,
    blocks: list[ImuBlock],
    spec: ImuSpec,
    cut: tuple[float, float],
    epoch: int,
) -> None:
    """Cut a region out of the stream, in m/s^2 and deg/s as imucal requires."""
    first, last = (epoch + round(t * 1e9) for t in cut)
    stamp = np.concatenate([b.stamp for b in blocks])
    inside = slice(int(np.searchsorted(stamp, first)), int(np.searchsorted(stamp, last)))
    per_second = 100.0 if spec.units is Units.PULSES else 1.0
    for kind, scale in (('gyr', spec.gyro.scale_factor / DEG), ('acc', spec.accel.scale_factor)):
        values = np.vstack([b.gyro if kind == 'gyr' else b.accel for b in blocks])[inside]
        regions[f'{kind}_{name}'] = values * (scale * per_second)


def as_vector(found: object) -> Floats:
    """Return imucal's result as our 24 parameters, SI units (from m/s^2 and deg/s)."""
    gyro = Triad(found.K_g @ found.R_g - np.eye(3), found.b_g * DEG)
    return SensorModel(gyro, Triad(found.K_a @ found.R_a - np.eye(3), found.b_a)).vector()


def compare(unit: Unit, runs: int) -> None:
    """Print the errors of both over some sessions."""
    theirs, ours, std = np.swapaxes([run(unit, seed) for seed in range(runs)], 0, 1)
    kept = np.isfinite(ours[:, 0])
    print(f'\n{unit.title}: root-mean-square error of {runs} sessions')
    if not kept.all():
        print(f'ours refuses {runs - kept.sum()}, whose biases contradict the Earth rate; of both')
        print('the others are shown')
    theirs, ours, std = theirs[kept], ours[kept], std[kept]
    print(f'{"":7s}{"imucal":>12s}{"ours":>12s}{"stated":>12s}{"ratio":>9s}')
    for k, parameter in enumerate(PARAMETERS):
        shown = engineering(parameter)
        sizes = [np.sqrt(np.mean(x[:, k] ** 2)) / shown.scale for x in (theirs, ours, std)]
        cells = ''.join(f'{s:12.4g}' for s in sizes)
        print(f'{parameter.name:7s}{cells}{sizes[0] / sizes[1]:9.1f}  {shown.unit}')


def by_hand(counts: Path | None) -> None:
    """Print both results of the real session."""
    site = Site.at(49.6 * DEG, gravity=9.81)
    spec = load_imu('mems_counts')
    calibrator = Calibrator(Setup(spec, load_plan('six_position_by_hand'), None, site))
    with open_recording(HAND) as recording:
        for _, block in recording.read({'/imu/raw': Kind.IMU}):
            calibrator.add_block(block)
    try:
        ours = calibrator.finish().calibration
    except NotObservable as error:
        print(f'\nreal session by hand: {error}')
        return
    if counts is None:
        print('\nreal session by hand: give --counts hand_session_counts.csv, whose parts are cut')
        return
    theirs = as_vector(_of_parts(counts, spec))
    print('\nreal session by hand: no truth, the difference in our standard deviations')
    print(f'{"":7s}{"imucal":>12s}{"ours":>12s}{"stated":>12s}{"apart":>9s}')
    for k, parameter in enumerate(PARAMETERS):
        shown = engineering(parameter)
        values = [theirs[k], ours.values[k], ours.std[k]]
        cells = ''.join(f'{v / shown.scale:12.4g}' for v in values)
        print(f'{parameter.name:7s}{cells}{(theirs[k] - values[1]) / values[2]:9.1f}  {shown.unit}')


def _of_parts(counts: Path, spec: ImuSpec) -> object:
    with counts.open(newline='') as file:
        rows = list(csv.DictReader(file))
    regions: dict[str, Floats] = {}
    for part in dict.fromkeys(row['part'] for row in rows):
        mine = [row for row in rows if row['part'] == part]
        for kind, scale in (
            ('gyr', spec.gyro.scale_factor / DEG),
            ('acc', spec.accel.scale_factor),
        ):
            values = [[float(row[f'{kind}_{axis}']) for axis in AXES] for row in mine]
            regions[f'{kind}_{part}'] = np.array(values) * scale
    # The counts of this session integrate to +360 deg.
    imucal = package()
    return imucal.FerrarisCalibration(grav=9.81, expected_angle=360.0).compute(
        imucal.FerrarisSignalRegions(**regions), 204.8, 'm/s^2', 'deg/s'
    )


def main() -> None:
    """Run all three."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--runs', type=int, default=20)
    parser.add_argument('--counts', type=Path, help='the real session as imucal publishes it')
    chosen = parser.parse_args()
    for unit in units():
        compare(unit, chosen.runs)
    by_hand(chosen.counts)
    print('\nwhy they differ')
    for name, reason in REASONS.items():
        print(f'  {name}: {reason}')


if __name__ == '__main__':
    main()
