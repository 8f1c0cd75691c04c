"""Write docs/imperfections.md: what sessions say, and how far they are off, on imperfect stands.

Each condition is a file of imperfections (docs/simulation.md), or a term of the sensors. Sessions
that were run are kept as lines of a file, so that the study goes on where it was stopped; delete
the file to begin anew.

Usage: python docs/imperfections.py [--seeds 2] [--jobs 1] [--rows imperfections.jsonl]
       python docs/imperfections.py --only 'stamps late' --seeds 5
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import zlib
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from imu_calib.calibration import Calibration
from imu_calib.calibrator import Calibrator, Setup
from imu_calib.config import Section
from imu_calib.earth import Site, normal_gravity
from imu_calib.errors import ImuCalibError
from imu_calib.imu import load_imu
from imu_calib.model import PARAMETER_NAMES, SensorModel, Triad
from imu_calib.model.terms import TERMS, term
from imu_calib.montecarlo import single_threaded
from imu_calib.plan import Plan, load_plan
from imu_calib.share import named_file
from imu_calib.simulation import SimulatedStand, StandOptions
from imu_calib.simulation.imperfections import read_imperfections
from imu_calib.stream import Floats
from imu_calib.table_errors import ASSUMED
from imu_calib.turntable import Table, load_table, read_table
from imu_calib.units import DEG

sys.path.insert(0, str(Path(__file__).parent.parent / 'test'))

SITE = Site.at(34.65 * DEG, gravity=normal_gravity(34.65 * DEG))
DWELL = 40.0
GRADES = {
    'fog_navigation': 'cao2022_table1',
    'fog_medium': 'cao2022_table1',
    'mems_counts': 'mems_counts',
}
EXACT = 'perfect, and stated exact'
SILENT = 4.5
"""Deviations: chance passes them in one of 6000 sessions of 24 parameters."""

CAUSES = {
    'tilt': 'table is tilted',
    'zeros': 'zeros of the joints that are off',
    'orthogonality': 'joint axes that are not at right angles',
    'wobble': 'joint axes that wobble',
    'encoder': 'encoders that err within the turn',
    'joints': 'as if joints stopped',
    'stops': 'as if the table leaned',
    'moves': 'By the gyros .* of .* moves end elsewhere',
    'outliers': 'Does not fit the rest',
    'turns': 'turns .* scatter|Turns .* scatter',
    'gyro drift': 'biases of the gyros wander',
    'accelerometer drift': 'biases of the accelerometers wander',
    'temperature': 'temperature moved',
    'north': 'gyros see north',
    'course': 'The session shows .*(trend|warm_up)',
    **{t.name: rf'The session shows .*\b{t.name}\b' for t in TERMS},
}
"""Words by which a finding names a cause."""

SIZES = {
    'g_sensitivity': (0.02, 0.1, 70.0),
    'gyro_asymmetry': (20.0, 100.0, 800.0),
    'gyro_rate_dependence': (20.0, 100.0, 800.0),
    'gyro_cubic': (20.0, 100.0, 800.0),
    'gyro_quadratic': (20.0, 100.0, 800.0),
    'accel_quadratic': (20.0, 50.0, 1000.0),
    'accel_asymmetry': (20.0, 50.0, 1000.0),
    'accel_cubic': (20.0, 50.0, 1000.0),
    'accel_cross': (20.0, 50.0, 1000.0),
    'gyro_g2': (0.02, 0.1, 70.0),
}
"""Largest coefficients of terms, in their units, for each grade."""


@dataclass(frozen=True)
class Condition:
    """What is wrong with a stand.

    Attributes:
        file: Of imperfections.
        causes: Keys of `CAUSES` by which it is named rightly; others are wrong names.
        plan: What is run.
        exact: Whether the description of the table states that it is exact.
        term: That the sensors have; empty for none.

    """

    file: str = '{}'
    causes: tuple[str, ...] = ()
    plan: str = 'twelve_position'
    exact: bool = False
    term: str = ''


_TILTED = 'table: {tilt: {east: 0.1 deg, north: -0.03 deg}}'
_LEVEL = 'table: {tilt: {east: 20 arcsec, north: -10 arcsec}}'
_DRIFT = ('gyro drift', 'accelerometer drift', 'course')

CONDITIONS = {
    EXACT: Condition(exact=True),
    'perfect': Condition(),
    'laboratory: a little of everything': Condition(
        named_file('imperfections', 'laboratory').read_text(encoding='utf-8'),
        ('zeros', 'orthogonality', 'joints', 'stops', 'temperature', *_DRIFT),
    ),
    'tilt 20 arcsec': Condition(_LEVEL, ('tilt',)),
    'tilt 20 arcsec, six positions': Condition(_LEVEL, ('tilt',), 'six_position'),
    'tilt 0.1 deg': Condition(_TILTED, ('tilt',)),
    'tilt 0.1 deg, six positions': Condition(_TILTED, ('tilt',), 'six_position'),
    'zeros 60 arcsec': Condition('table: {zeros: 60 arcsec}', ('zeros',)),
    'orthogonality 10 arcsec': Condition('table: {orthogonality: 10 arcsec}', ('orthogonality',)),
    'wobble 2 arcsec': Condition('table: {wobble: {once: 2 arcsec, twice: 2 arcsec}}', ('wobble',)),
    'encoder harmonics 3 arcsec': Condition(
        'table: {encoder: {once: 3 arcsec, twice: 3 arcsec}}', ('encoder',)
    ),
    'encoder noise 7 arcsec': Condition('joint_states: {noise: 7 arcsec}'),
    'encoder noise 15 arcsec': Condition('joint_states: {noise: 15 arcsec}'),
    'encoder of 16 bits': Condition('joint_states: {resolution: 19.775390625 arcsec}'),
    'joint stamps jitter 1 ms': Condition('joint_states: {jitter: 1 ms}'),
    'arrivals of joints 5 arcsec': Condition('table: {arrivals: {joints: 5 arcsec}}', ('joints',)),
    'arrivals of stops 2 arcsec': Condition(
        'table: {arrivals: {tilt: 2 arcsec, heading: 2 arcsec}}', ('stops', 'joints')
    ),
    'servo 30 arcsec': Condition('table: {servo: 30 arcsec}'),
    'ramps 20 deg/s^2': Condition('table: {acceleration: 20 deg/s^2}'),
    'ramps 10 deg/s^2': Condition('table: {acceleration: 10 deg/s^2}'),
    'stamps jitter 1 ms': Condition('stamps: {jitter: 1 ms}'),
    'stamps late': Condition('stamps: {late: 1 %, delay: 20 ms}'),
    'stamps in bunches of 4': Condition('stamps: {bunch: 4}'),
    'clock 50 ppm': Condition('stamps: {clock_rate: 50 ppm}'),
    'lost 0.05 %': Condition('samples: {lost: 0.05 %}'),
    'lost 0.5 %': Condition('samples: {lost: 0.5 %}'),
    'lost 2 %': Condition('samples: {lost: 2 %}'),
    'twice 0.05 %': Condition('samples: {twice: 0.05 %}'),
    'twice 2 %': Condition('samples: {twice: 2 %}'),
    'frozen 3 s every 5 min': Condition('samples: {frozen: {every: 5 min, for: 3 s}}'),
    'ringing': Condition('mounting: {ringing: {rate: 0.5 deg/s, force: 50 mg, decay: 0.5 s}}'),
    'floor shakes': Condition('mounting: {floor: {rate: 0.05 deg/s, force: 2 mg}}'),
    'temperature ramp': Condition(
        'temperature: {ramp: 10 K/h, gyro: {bias: 0.02 (deg/h)/K, scale_factor: 2 ppm/K}, '
        'accelerometer: {bias: 5 ug/K, scale_factor: 5 ppm/K}}',
        ('temperature', *_DRIFT),
    ),
    'warm-up': Condition('temperature: {warm_up: {gyro: 0.1 deg/h, accelerometer: 50 ug}}', _DRIFT),
    **{name: Condition(causes=(name,), term=name) for name in SIZES},
}


def described(exact: bool) -> Table:
    """Return the table as its file describes it; one that is not exact states nothing of itself."""
    if exact:
        return load_table('three_axis')
    stated = yaml.safe_load(named_file('tables', 'three_axis').read_text(encoding='utf-8'))
    left = {key: value for key, value in stated.items() if key not in ASSUMED}
    return read_table(Section(left, 'three_axis'))


def quick(plan: Plan) -> Plan:
    """Return a plan with shorter dwells."""
    return replace(plan, positions=tuple(replace(p, dwell=DWELL) for p in plan.positions))


def unit_of(grade: str, name: str) -> SensorModel:
    """Return the unit of a grade, with a term if there is one."""
    unit = Calibration.load(named_file('truths', GRADES[grade])).model
    if not name:
        return unit
    parameters = term(name).parameters
    size = SIZES[name][list(GRADES).index(grade)] * parameters[0].unit.scale
    values = size * np.resize([1.0, -0.7, 0.5, 0.3], len(parameters))
    return unit.with_values(parameters, values)


def stand(condition: str, grade: str, seed: int) -> tuple[SimulatedStand, Setup]:
    """Return a simulated stand, and what the calibrator knows of it."""
    one = CONDITIONS[condition]
    table, plan = described(one.exact), quick(load_plan(one.plan))
    if one.plan == 'six_position':
        table = replace(table, azimuth=0.0)
    draw = zlib.crc32(f'{condition} {grade} {seed}'.encode())
    section = Section.parse(one.file, condition)
    options = read_imperfections(section, StandOptions(positioning_error=0.0), table, draw)
    imu = load_imu(grade)
    simulated = SimulatedStand(plan, table, imu, unit_of(grade, one.term), SITE, options, draw)
    return simulated, Setup(imu, plan, table, SITE, look=True)


def session(grade: str, seed: int, condition: str) -> dict[str, Any]:
    """Simulate and calibrate one session; return what it says as a row."""
    one = CONDITIONS[condition]
    row: dict[str, Any] = {
        'condition': condition,
        'file': one.file,
        'grade': grade,
        'seed': seed,
    }
    simulated, setup = stand(condition, grade, seed)
    calibrator = Calibrator(setup)
    try:
        for _, block in simulated.blocks():
            calibrator.feed(block)
        result = calibrator.finish()
    except ImuCalibError as error:
        return {**row, 'refused': str(error)}
    found = result.calibration
    wanted = truth(unit_of(grade, one.term), simulated.options, simulated.duration)
    off = (found.values[:24] - wanted) / found.std[:24]
    assert setup.table is not None
    # What is said of a coefficient that the session does not show, and of what it would move.
    held = [
        [t.name, moved[0].name]
        for t in result.solution.tests
        for least, moved in zip(t.smallest, t.moved, strict=False)
        if moved is not None and not np.isfinite(least)
    ]
    return {
        **row,
        'off': np.round(off, 2).tolist(),
        'std': found.std[:24].tolist(),
        'findings': [f for f in found.findings if f != setup.table.assumption],
        'held': held,
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
    missing = [w for w in wanted if (w[0], CONDITIONS[w[0]].file, w[1], w[2]) not in done]
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
    head = f'{row["condition"]}, {row["grade"]}, seed {row["seed"]}: {outcome(row)}'
    blamed = f' (blames {", ".join(misnamed(row))})' if misnamed(row) else ''
    if 'refused' in row:
        return f'{head}. {row["refused"]}'
    return f'{head}{blamed}: {_worst(row)}; {" ".join(row["findings"])}'


def _worst(row: dict[str, Any]) -> str:
    k = int(np.argmax(np.abs(row['off'])))
    return f'{PARAMETER_NAMES[k]} {row["off"][k]:+.1f}'


def named(row: dict[str, Any]) -> set[str]:
    """Return the causes that findings name."""
    return {
        cause
        for cause, words in CAUSES.items()
        if any(re.search(words, finding) for finding in row.get('findings', ()))
    }


def misnamed(row: dict[str, Any]) -> list[str]:
    """Return the causes that findings name and that are not there."""
    return sorted(named(row) - set(CONDITIONS[row['condition']].causes))


def outcome(row: dict[str, Any]) -> str:
    """Say in a word what a session came to."""
    if 'refused' in row:
        return 'refused'
    wrong = {PARAMETER_NAMES[k] for k in np.flatnonzero(np.abs(row['off']) > SILENT)}
    if not wrong:
        return 'honest'
    causes = set(CONDITIONS[row['condition']].causes)
    held = {parameter for name, parameter in row['held'] if name in causes}
    return 'named' if causes & named(row) or wrong <= held else 'silently wrong'


def verdict(rows: list[dict[str, Any]]) -> str:
    """Say in a word what a condition came to."""
    outcomes = [outcome(row) for row in rows]
    words = [
        f'{outcomes.count(bad)} of {len(rows)} {said}'
        for bad, said in (
            ('refused', 'refused'),
            ('silently wrong', 'silently wrong'),
            ('named', 'wrong, and named'),
        )
        if bad in outcomes
    ]
    blamed = [row for row in rows if misnamed(row)]
    if blamed:
        causes = sorted({cause for row in blamed for cause in misnamed(row)})
        words.append(f'{len(blamed)} of {len(rows)} blamed on {", ".join(causes)}')
    return '; '.join(words) or 'honest'


@cache
def bounds(condition: str, grade: str) -> tuple[float, ...] | None:
    """Return the bound of a condition's deviations, (24,); None where it is not known."""
    return None


def widened(rows: list[dict[str, Any]], kind: str) -> list[float]:
    """Return by how much the stated deviations are beyond the perfect session's, for each of a kind.

    Of seeds the geometric mean.
    """
    stated = [r['std'] for r in rows if 'std' in r]
    of = [k for k, name in enumerate(PARAMETER_NAMES) if name.startswith(kind)]
    return list(np.exp(np.log(stated).mean(axis=0))[of]) if stated else []


def widening(these: list[dict[str, Any]], perfect: list[dict[str, Any]], kind: str) -> str:
    """Return the largest ratio of deviations to the perfect session's, and that of the bounds."""
    here, there = widened(these, kind), widened(perfect, kind)
    if not here or not there:
        return '-'
    ratios = np.array(here) / np.array(there)
    return f'{ratios.max():.2f}'


def page(rows: list[dict[str, Any]], seeds: int) -> str:
    """Return the page."""
    lines = [HEAD.format(dwell=DWELL, seeds=seeds)]
    for condition in CONDITIONS:
        for grade in GRADES:
            these = [r for r in rows if (r['condition'], r['grade']) == (condition, grade)]
            perfect = [r for r in rows if (r['condition'], r['grade']) == (EXACT, grade)]
            if not these:
                continue
            solved = [r for r in these if 'off' in r]
            worst = max(solved, key=lambda r: float(np.abs(r['off']).max()), default=None)
            said = {f for r in these for f in r.get('findings', [r.get('refused', '')])}
            lines.append(
                f'| {condition} | {grade} | {"-" if worst is None else _worst(worst)} '
                f'| {widening(these, perfect, "K")} | {widening(these, perfect, "D")} '
                f'| {verdict(these)} | {_short(said)} |'
            )
    lines.append('\nThe files:\n')
    run_already = {r['condition'] for r in rows}
    lines += [
        f'- {name}: `{one.file}`'
        for name, one in CONDITIONS.items()
        if name in run_already and one.file != '{}'
    ]
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
"""


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
        if a.only in condition
    ]
    run(wanted, a.rows, a.jobs)
    rows = [
        r
        for r in rows_of(a.rows).values()
        if r['condition'] in CONDITIONS and r['file'] == CONDITIONS[r['condition']].file
    ]
    if not a.only:
        text = page([r for r in rows if r['seed'] < a.seeds], a.seeds)
        Path(__file__).with_suffix('.md').write_text(text, encoding='utf-8')


if __name__ == '__main__':
    main()
