"""Gain by compensation: one hour of free inertial navigation with it, and docs/navigation.md.

A unit with terms beyond the 24 parameters is calibrated by one session of the plan full_model, with
only the 24 parameters and with terms; then it flies (`flight.py`), and its outputs are compensated
by each calibration and navigated (`strapdown.py`). Each seed has other sessions, flights and noise.

    python benchmarks/navigation.py [--seeds 8] [--jobs 2] [--scheduler ADDRESS] [--write]

--write writes docs/navigation.md and docs/navigation.svg. Exit code 1: the error with perfect
sensors is above a metre.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from flight import HEIGHT, HOUR, LATITUDE, Flight, radii
from strapdown import STEP, Start, navigate

from imu_calib.calibration.calibration import Calibration
from imu_calib.calibration.calibrator import Calibrator
from imu_calib.calibration.compensate import Compensation
from imu_calib.common.files import named_file
from imu_calib.common.parallel import run_all
from imu_calib.common.stream import Floats, ImuBlock, Units
from imu_calib.estimation.setup import Setup
from imu_calib.model.earth import Site, normal_gravity
from imu_calib.model.sensors import SensorModel
from imu_calib.model.terms import TERMS, Term, named_terms
from imu_calib.reports.charts import COLOURS, Axis, Panel, drawing, label, tag
from imu_calib.session.imu import ImuSpec, load_imu
from imu_calib.session.plan import load_plan
from imu_calib.session.table import load_table
from imu_calib.simulation.imu import SimulatedImu
from imu_calib.simulation.options import StandOptions
from imu_calib.simulation.repetition import economical
from imu_calib.simulation.stand import simulate

SITE = Site.at(LATITUDE, gravity=normal_gravity(LATITUDE))
UNIT, TRUTH, PLAN = 'fog_navigation', 'fog_navigation_terms', 'full_model'
OWN = 'gyro_asymmetry,gyro_rate_dependence,accel_quadratic'
"""The terms of the unit."""

AT_REST = tuple(term for term in TERMS if not term.moving)
"""The ten that dwells and turns determine."""

SHOWN = {
    'truth': ('the truth: its noise is left', COLOURS[2], '4 3'),
    'usual': ('24 parameters, twelve_position', COLOURS[1], '4 3'),
    'plain': ('24 parameters, full_model', COLOURS[1], ''),
    'found': ('24 and its three terms, full_model', COLOURS[0], ''),
    'all': ('24 and all ten terms, full_model', COLOURS[0], '4 3'),
}
"""Compensations: text, colour and dashes of the curve."""

LIMIT = 1.0
"""Largest error of the navigator in an hour with perfect sensors, m."""

MINUTES = (10, 20, 30, 40, 50, 60)
STYLE = """
text { font: 12px system-ui, sans-serif; fill: #1a1a1a; }
text.tick { font-size: 11px; fill: #333; }
.grid { stroke: #e1e4e8; }
.frame { fill: none; stroke: #888; }
"""
PAGE = """# What compensation gains

Written by `python benchmarks/navigation.py --seeds {seeds} --write`.

One hour of free inertial navigation: only the unit's own compensated increments. The
unit is `fog_navigation` with the truth `fog_navigation_terms`: its gyros have
a scale-factor asymmetry (10 to 20 ppm) and a rate dependence (10 to 20 ppm at 60 deg/s), and its
accelerometers have quadratic terms (10 to 30 ug/g^2), as data sheets state them. Every flight has a
calibration session and noise of its own; biases do not change from the session to the flight.

Horizontal position error, m, root mean square over {seeds} flights; the last column is the largest
of any flight at any time:

| compensated by | 10 min | 20 min | 30 min | 40 min | 50 min | 60 min | largest |
|---|---|---|---|---|---|---|---|
{rows}

![Position error over the hour](navigation.svg)

- *Flight*: level, at 100 m/s, the speed up and down by 10 m/s every 90 s. A quarter of an hour
  straight, half an hour of figures of eight in coordinated turns (up to 47 deg of bank, 4 deg/s,
  1.45 g), a quarter of an hour straight. No vibration.
- *Calibration*: one simulated session of the plan `full_model` for each flight, estimated three
  times: the 24 parameters alone, with the three terms that the unit has
  (`--terms {own}`), and with all ten. Beside
  them stand the 24 parameters of a session of `twelve_position`, whose rates end at 60 deg/s. At
  240 deg/s turns contradict a scale factor that does not depend on the rate: the 24 parameters of
  `full_model` are the worse ones, and the session's findings name the turns that do not fit.
- *The truth*: the unit's own parameters. The remaining errors are random walk and pulses.
- *All ten terms* add the uncertainty of the seven that the unit does not have.
- *Navigator*: strapdown in east, north and up on the WGS 84 ellipsoid, with Earth rate, transport
  rate, coning and sculling. The vertical channel is fixed: height and vertical velocity are those
  of an altimeter without error. Position, velocity and attitude begin without error. With
  error-free sensors its error is within {exact:.3f} m in the hour;
  `test/simulation/test_navigation.py` compares it with the known effect of a bias (Schuler).
"""

_PART = 60.0


def apart(course: Floats, flight: Flight, times: Floats) -> Floats:
    """Return the position errors (m, n, 2) of latitudes and longitudes at (n,) times, m."""
    latitude, longitude = flight.latitude(times), flight.longitude(times)
    along, across = radii(latitude)
    north = (course[..., 0] - latitude) * (along + HEIGHT)
    east = (course[..., 1] - longitude) * (across + HEIGHT) * np.cos(latitude)
    return np.asarray(np.hypot(north, east))


def flown(flight: Flight, imu: ImuSpec, model: SensorModel, seed: int, **wrong: bool) -> ImuBlock:
    """Return the outputs of a unit on a flight, from close to its start on."""
    rng = np.random.default_rng([seed, 3])
    options = economical(StandOptions(positioning_error=0.0, **wrong))
    device = SimulatedImu(imu, model, SITE, options, rng)
    ends = _PART * np.arange(1, math.ceil(flight.seconds / _PART) + 1)
    parts = [device.advance(flight, float(end)) for end in ends]  # type: ignore[arg-type]
    return ImuBlock(
        np.concatenate([p.stamp for p in parts]),
        np.concatenate([p.gyro for p in parts]),
        np.concatenate([p.accel for p in parts]),
        parts[0].frame_id,
    )


def off(flight: Flight, block: ImuBlock, inputs: Sequence[tuple[Floats, Floats]]) -> Floats:
    """Navigate by rates and forces of a block's samples; return times and errors, (1 + m, s)."""
    interval = float(np.median(np.diff(block.stamp))) * 1e-9
    count = len(block.stamp) // STEP * STEP
    begin = block.stamp[0] * 1e-9 - interval
    times = begin + np.arange(count // STEP + 1) * STEP * interval
    first = times[:1]
    start = Start(
        float(flight.latitude(first)[0]),
        float(flight.longitude(first)[0]),
        np.array([float(v[0]) for v in flight.velocity(first)]),
        flight.attitude(first)[0],
    )
    angles, velocities = (
        np.array([pair[k][:count] for pair in inputs]) * interval for k in range(2)
    )
    errors = apart(navigate(start, angles, velocities, interval), flight, times)
    return np.vstack([times, errors])


def session(name: str, seed: int, *terms: tuple[Term, ...]) -> list[Calibration]:
    """Calibrate the unit by one session of a plan, once with each set of terms."""
    imu, table = load_imu(UNIT), load_table('three_axis')
    model = Calibration.load(named_file('truths', TRUTH)).model
    plan = load_plan(name)
    calibrators = [Calibrator(Setup(imu, plan, table, SITE, terms=t)) for t in terms]
    heading = float(np.random.default_rng([seed, 1]).uniform(-np.pi, np.pi))
    options = economical(
        StandOptions(positioning_error=0.0, bias_instability=False, azimuth=heading)
    )
    for _, block in simulate(plan, table, imu, model, SITE, options, seed):
        for calibrator in calibrators:
            calibrator.add_block(block)
    return [c.finish().calibration for c in calibrators]


def flight_of(seed: int) -> Floats:
    """Calibrate, fly and navigate: times, then errors of `SHOWN`, m: (1 + 5, s)."""
    imu, flight = load_imu(UNIT), Flight()
    truth = Calibration.load(named_file('truths', TRUTH))
    found = session('twelve_position', seed, ())
    found += session(PLAN, seed, (), named_terms(OWN), AT_REST)
    block = flown(flight, imu, truth.model, seed, bias_instability=False)
    interval = np.full(len(block.stamp), np.median(np.diff(block.stamp)) * 1e-9)
    inputs = []
    for calibration in (truth, *found):
        values = Compensation(calibration).apply(block.gyro, block.accel, interval)
        inputs.append((values.rate, values.force))
    return off(flight, block, inputs)


def without_errors() -> Floats:
    """Navigate a flight with perfect sensors: times and errors, (2, s)."""
    flight, imu = Flight(), replace(load_imu(UNIT), units=Units.SI)
    block = flown(flight, imu, SensorModel(), 0, noise=False, bias_instability=False)
    return off(flight, block, [(block.gyro, block.accel)])


def write(exact: float, times: Floats, runs: Floats) -> None:
    """Write the page and its plot, from (n, m, s) errors of n seeds, m."""
    rms = np.sqrt((runs**2).mean(axis=0))
    marks = [int(np.searchsorted(times, 60.0 * t)) for t in MINUTES[:-1]] + [-1]
    rows = [
        f'| {words} | {" | ".join(f"{v:.0f}" for v in course[marks])} | {worst:.0f} |'
        for (words, _, _), course, worst in zip(
            SHOWN.values(), rms, runs.max(axis=(0, 2)), strict=True
        )
    ]
    docs = Path(__file__).parent.parent / 'docs'
    text = PAGE.format(seeds=len(runs), exact=exact, rows='\n'.join(rows), own=OWN)
    (docs / 'navigation.md').write_text(text, encoding='utf-8')
    (docs / 'navigation.svg').write_text(plot(times, rms), encoding='utf-8')


def plot(times: Floats, rms: Floats) -> str:
    """Return the drawing of (m, s) errors over the hour."""
    late = times > 60.0
    panel = Panel(
        Axis(0.0, HOUR / 60), Axis.decades(rms[:, late].ravel().tolist()), 60, 26, 560, 300
    )
    panel.frame('time, min', 'horizontal position error, m (root mean square)')
    every = max(1, late.sum() // 300)
    for k, (words, colour, dash) in enumerate(SHOWN.values()):
        points = zip(times[late][::every] / 60, rms[k, late][::every], strict=True)
        panel.curve([(float(t), float(v)) for t, v in points], colour, dash)
        y = 236.0 + 17 * k
        panel.parts.append(
            tag(
                'line',
                x1=330,
                y1=y,
                x2=362,
                y2=y,
                stroke=colour,
                stroke_width=1.5,
                stroke_dasharray=dash or None,
            )
        )
        panel.parts.append(label(words, 368, y + 4, class_='tick'))
    picture = drawing([tag('style', STYLE), *panel.parts], 640, 370, 'Error of free navigation')
    return picture.replace('<svg ', '<svg xmlns="http://www.w3.org/2000/svg" ', 1) + '\n'


def main() -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seeds', type=int, default=8)
    parser.add_argument('--jobs', type=int)
    parser.add_argument('--scheduler', metavar='ADDRESS', help='of a Dask cluster')
    parser.add_argument('--write', action='store_true', help='docs/navigation.md and its plot')
    chosen_ = parser.parse_args()
    exact = float(without_errors()[1].max())
    print(f'sensors without error: {exact:.3f} m at most in an hour', flush=True)
    seeds = range(chosen_.seeds)
    found = run_all(flight_of, seeds, jobs=chosen_.jobs, scheduler=chosen_.scheduler)
    count = min(run.shape[1] for run in found)
    times, runs = found[0][0, :count], np.array([run[1:, :count] for run in found])
    rms = np.sqrt((runs**2).mean(axis=0))[:, -1]
    for (words, _, _), course, worst in zip(
        SHOWN.values(), rms, runs.max(axis=(0, 2)), strict=True
    ):
        print(f'{words}: {course:.0f} m after an hour, at most {worst:.0f} m in any flight')
    if chosen_.write:
        write(exact, times, runs)
    return 0 if exact < LIMIT else 1


if __name__ == '__main__':
    # Workers find the function by the name of this module.
    import navigation

    sys.exit(navigation.main())
