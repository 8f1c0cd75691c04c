"""Write docs/imperfections.md: what sessions say, and how far they are off, on imperfect stands.

Each condition is a file of imperfections (docs/simulation.md). Sessions that were run are kept as
lines of a file, so that the study goes on where it was stopped; delete the file to begin anew.

Usage: python docs/imperfections.py [--seeds 2] [--jobs 1] [--rows imperfections.jsonl]
       python docs/imperfections.py --only 'stamps late' --seeds 5
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from imu_calib.calibration import Calibration
from imu_calib.calibrator import Calibrator, Setup
from imu_calib.config import Section
from imu_calib.earth import Site, normal_gravity
from imu_calib.errors import ImuCalibError
from imu_calib.imu import load_imu
from imu_calib.model import PARAMETER_NAMES, SensorModel, Triad
from imu_calib.montecarlo import single_threaded
from imu_calib.plan import Plan, load_plan
from imu_calib.share import named_file
from imu_calib.simulation import SimulatedStand, StandOptions
from imu_calib.simulation.imperfections import read_imperfections
from imu_calib.stream import Floats
from imu_calib.turntable import load_table
from imu_calib.units import DEG

SITE = Site.at(34.65 * DEG, gravity=normal_gravity(34.65 * DEG))
DWELL = 40.0
GRADES = {
    'fog_navigation': 'cao2022_table1',
    'fog_medium': 'cao2022_table1',
    'mems_counts': 'mems_counts',
}
PERFECT = 'perfect'
SILENT = 4.5
"""Deviations: chance passes them in one of 6000 sessions of 24 parameters."""

CONDITIONS = {
    PERFECT: '{}',
    'tilt 20 arcsec': 'table: {tilt: {east: 20 arcsec, north: -10 arcsec}}',
    'tilt 20 arcsec, six positions': 'table: {tilt: {east: 20 arcsec, north: -10 arcsec}}',
    'tilt 0.1 deg': 'table: {tilt: {east: 0.1 deg, north: -0.03 deg}}',
    'tilt 0.1 deg, six positions': 'table: {tilt: {east: 0.1 deg, north: -0.03 deg}}',
    'zeros 60 arcsec': 'table: {zeros: 60 arcsec}',
    'orthogonality 10 arcsec': 'table: {orthogonality: 10 arcsec}',
    'wobble 2 arcsec': 'table: {wobble: {once: 2 arcsec, twice: 2 arcsec}}',
    'encoder harmonics 3 arcsec': 'table: {encoder: {once: 3 arcsec, twice: 3 arcsec}}',
    'encoder noise 7 arcsec': 'joint_states: {noise: 7 arcsec}',
    'encoder noise 15 arcsec': 'joint_states: {noise: 15 arcsec}',
    'encoder of 16 bits': 'joint_states: {resolution: 19.775390625 arcsec}',
    'joint stamps jitter 1 ms': 'joint_states: {jitter: 1 ms}',
    'arrivals of joints 5 arcsec': 'table: {arrivals: {joints: 5 arcsec}}',
    'arrivals of stops 2 arcsec': 'table: {arrivals: {tilt: 2 arcsec, heading: 2 arcsec}}',
    'servo 30 arcsec': 'table: {servo: 30 arcsec}',
    'ramps 20 deg/s^2': 'table: {acceleration: 20 deg/s^2}',
    'ramps 10 deg/s^2': 'table: {acceleration: 10 deg/s^2}',
    'stamps jitter 1 ms': 'stamps: {jitter: 1 ms}',
    'stamps late': 'stamps: {late: 1 %, delay: 20 ms}',
    'stamps in bunches of 4': 'stamps: {bunch: 4}',
    'clock 50 ppm': 'stamps: {clock_rate: 50 ppm}',
    'lost 0.05 %': 'samples: {lost: 0.05 %}',
    'lost 0.5 %': 'samples: {lost: 0.5 %}',
    'lost 2 %': 'samples: {lost: 2 %}',
    'twice 0.05 %': 'samples: {twice: 0.05 %}',
    'twice 2 %': 'samples: {twice: 2 %}',
    'frozen 3 s every 5 min': 'samples: {frozen: {every: 5 min, for: 3 s}}',
    'ringing': 'mounting: {ringing: {rate: 0.5 deg/s, force: 50 mg, decay: 0.5 s}}',
    'floor shakes': 'mounting: {floor: {rate: 0.05 deg/s, force: 2 mg}}',
    'temperature ramp': (
        'temperature: {ramp: 10 K/h, gyro: {bias: 0.02 (deg/h)/K, scale_factor: 2 ppm/K}, '
        'accelerometer: {bias: 5 ug/K, scale_factor: 5 ppm/K}}'
    ),
    'warm-up': 'temperature: {warm_up: {gyro: 0.1 deg/h, accelerometer: 50 ug}}',
}


def quick(plan: Plan) -> Plan:
    """Return a plan with shorter dwells."""
    return replace(plan, positions=tuple(replace(p, dwell=DWELL) for p in plan.positions))


def session(grade: str, seed: int, condition: str) -> dict[str, Any]:
    """Simulate and calibrate one session; return what it says as a row."""
    row: dict[str, Any] = {
        'condition': condition,
        'file': CONDITIONS[condition],
        'grade': grade,
        'seed': seed,
    }
    table = load_table('three_axis')
    plan = quick(load_plan('six_position' if 'six' in condition else 'twelve_position'))
    if 'six' in condition:
        table = replace(table, azimuth=0.0)
    perfect = StandOptions(positioning_error=0.0, bias_instability=False)
    # Every grade has noise of its own: figures of one seed would else be one draw thrice.
    draw = seed * len(GRADES) + list(GRADES).index(grade)
    section = Section.parse(CONDITIONS[condition], condition)
    options = read_imperfections(section, perfect, table, draw)
    imu, unit = load_imu(grade), Calibration.load(named_file('truths', GRADES[grade])).model
    stand = SimulatedStand(plan, table, imu, unit, SITE, options, draw)
    calibrator = Calibrator(Setup(imu, plan, table, SITE))
    try:
        for _, block in stand.blocks():
            calibrator.feed(block)
        found = calibrator.finish().calibration
    except ImuCalibError as error:
        return {**row, 'refused': str(error)}
    wanted = truth(unit, options, stand.duration)
    off = (found.values[:24] - wanted) / found.std[:24]
    return {
        **row,
        'off': np.round(off, 2).tolist(),
        'std': found.std[:24].tolist(),
        'findings': list(found.findings),
    }


def truth(unit: SensorModel, options: StandOptions, duration: float) -> Floats:
    """Return the 24 parameters that a session should find: in the mean, by the table's clock."""
    times = np.linspace(0.0, duration, 1000)
    kelvin = float(options.warming.excess(times).mean())
    faded = float(np.exp(-times / options.warm_up.time_constant).mean())
    drift, fading = options.thermal_drift, options.warm_up
    gyro, accel = unit.gyro, unit.accel
    gyro_scale = (1 + kelvin * np.broadcast_to(drift.gyro_scale, 3))[:, None]
    accel_scale = (1 + kelvin * np.broadcast_to(drift.accel_scale, 3))[:, None]
    eye = np.eye(3)
    gyro_bias = (
        gyro.bias + kelvin * np.asarray(drift.gyro_bias) + faded * np.asarray(fading.gyro_bias)
    )
    accel_bias = (
        accel.bias + kelvin * np.asarray(drift.accel_bias) + faded * np.asarray(fading.accel_bias)
    )
    return SensorModel(
        Triad(gyro_scale * gyro.response - eye, gyro_bias),
        Triad(accel_scale * accel.response - eye, accel_bias),
    ).vector()


def rows_of(path: Path) -> dict[tuple[str, str, str, int], dict[str, Any]]:
    """Return the sessions that were run already."""
    if not path.exists():
        return {}
    rows = map(json.loads, path.read_text(encoding='utf-8').splitlines())
    return {(r['condition'], r['file'], r['grade'], r['seed']): r for r in rows}


def run(wanted: Iterable[tuple[str, str, int]], path: Path, jobs: int) -> None:
    """Run the sessions that are missing and keep each as it ends."""
    done = rows_of(path)
    missing = [w for w in wanted if (w[0], CONDITIONS[w[0]], w[1], w[2]) not in done]
    with single_threaded(), ProcessPoolExecutor(jobs, get_context('spawn')) as pool:
        sessions = pool.map(_session, missing)
        for row in sessions:
            with path.open('a', encoding='utf-8') as file:
                file.write(json.dumps(row) + '\n')
            print(_line(row), flush=True)


def _session(which: tuple[str, str, int]) -> dict[str, Any]:
    condition, grade, seed = which
    return session(grade, seed, condition)


def _line(row: dict[str, Any]) -> str:
    head = f'{row["condition"]}, {row["grade"]}, seed {row["seed"]}'
    if 'refused' in row:
        return f'{head}: refused. {row["refused"]}'
    return f'{head}: {_worst(row)}; {" ".join(row["findings"])}'


def _worst(row: dict[str, Any]) -> str:
    k = int(np.argmax(np.abs(row['off'])))
    return f'{PARAMETER_NAMES[k]} {row["off"][k]:+.1f}'


def verdict(rows: list[dict[str, Any]]) -> str:
    """Say in a word what a condition came to."""
    refused = sum('refused' in r for r in rows)
    wrong = [r for r in rows if 'off' in r and np.abs(r['off']).max() > SILENT]
    silent = [r for r in wrong if not r['findings']]
    words = []
    if refused:
        words.append(f'{refused} of {len(rows)} refused')
    if silent:
        words.append(f'{len(silent)} of {len(rows)} silently wrong')
    if len(wrong) > len(silent):
        words.append(f'{len(wrong) - len(silent)} of {len(rows)} wrong, with findings')
    return '; '.join(words) or 'honest'


def widened(rows: list[dict[str, Any]], perfect: list[dict[str, Any]], kind: str) -> str:
    """Return the largest ratio of deviations to the perfect session's, geometric mean of seeds."""
    of = [k for k, name in enumerate(PARAMETER_NAMES) if name.startswith(kind)]
    here = [r['std'] for r in rows if 'std' in r]
    there = [r['std'] for r in perfect if 'std' in r]
    if not here or not there:
        return '-'
    ratio = np.exp(np.log(here).mean(axis=0) - np.log(there).mean(axis=0))
    return f'{ratio[of].max():.2f}'


def page(rows: list[dict[str, Any]], seeds: int) -> str:
    """Return the page."""
    lines = [HEAD.format(dwell=DWELL, seeds=seeds)]
    for condition in CONDITIONS:
        for grade in GRADES:
            these = [r for r in rows if (r['condition'], r['grade']) == (condition, grade)]
            perfect = [r for r in rows if (r['condition'], r['grade']) == (PERFECT, grade)]
            if not these:
                continue
            solved = [r for r in these if 'off' in r]
            worst = max(solved, key=lambda r: float(np.abs(r['off']).max()), default=None)
            said = {f for r in these for f in r.get('findings', [r.get('refused', '')])}
            lines.append(
                f'| {condition} | {grade} | {"-" if worst is None else _worst(worst)} '
                f'| {widened(these, perfect, "K")} | {widened(these, perfect, "D")} '
                f'| {verdict(these)} | {_short(said)} |'
            )
    lines.append('\nThe files:\n')
    run_already = {r['condition'] for r in rows}
    lines += [f'- {name}: `{text}`' for name, text in CONDITIONS.items() if name in run_already]
    return '\n'.join(lines) + '\n'


def _short(said: set[str]) -> str:
    """Return the shortest of what was said, and how many other sentences there were."""
    if not said:
        return ''
    first = min(said, key=len)
    more = f' (and {len(said) - 1} more)' if len(said) > 1 else ''
    return first.replace('|', '/') + more


HEAD = """\
# What sessions say on imperfect stands

Written by `docs/imperfections.py`: sessions of {dwell:g} s per position, {seeds} seeds each, of
three units of [config/imus](../config/imus), on the table `three_axis`. The keys of the files are
in [simulation.md](simulation.md). Worst: the parameter whose error is the largest in its stated
standard deviations. Widened: the largest ratio of the stated deviations of K and of D to those of
the perfect stand. Wrong: an error of more than 4.5 deviations; silently, where nothing is said.

The file of the table states nothing of its axes, zeros and encoders here: they are taken as exact.
One that states them ([tables.md](tables.md)) has them in the covariance.

The truth is that of the mean over the session, in seconds of the table's clock.

| condition | unit | worst | K widened | D widened | verdict | what is said |
|---|---|---|---|---|---|---|"""


def main() -> None:
    """Run what is missing and write the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--seeds', type=int, default=2)
    parser.add_argument('--jobs', type=int, default=1)
    parser.add_argument('--rows', type=Path, default=Path('imperfections.jsonl'))
    parser.add_argument('--grades', nargs='+', choices=GRADES, default=list(GRADES))
    parser.add_argument('--only', default='', help='conditions whose names hold this')
    a = parser.parse_args()
    wanted = [
        (condition, grade, seed)
        for seed in range(a.seeds)
        for condition in CONDITIONS
        for grade in a.grades
        if a.only in condition or condition == PERFECT
    ]
    run(wanted, a.rows, a.jobs)
    rows = [r for r in rows_of(a.rows).values() if r['file'] == CONDITIONS.get(r['condition'])]
    if not a.only:
        text = page([r for r in rows if r['seed'] < a.seeds], a.seeds)
        Path(__file__).with_suffix('.md').write_text(text, encoding='utf-8')


if __name__ == '__main__':
    main()
