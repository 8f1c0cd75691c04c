"""The imperfect stands of docs/imperfections.py: conditions, units, tables, and what is true."""

from __future__ import annotations

import sys
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import yaml

from imu_calib.calibration.calibration import Calibration
from imu_calib.common.config import Section
from imu_calib.common.files import named_file
from imu_calib.common.stream import Block, Floats, TemperatureBlock
from imu_calib.common.units import ARCSEC, DEG
from imu_calib.estimation.equations import GIVEN_AZIMUTH
from imu_calib.estimation.setup import Setup
from imu_calib.model.earth import Site, normal_gravity
from imu_calib.model.sensors import SensorModel, Triad
from imu_calib.model.terms import TERMS, term
from imu_calib.session.imu import load_imu
from imu_calib.session.plan import Plan, load_plan
from imu_calib.session.table import ASSUMED, Table, load_table, read_table
from imu_calib.simulation.options import StandOptions, read_imperfections
from imu_calib.simulation.stand import SimulatedStand

sys.path.insert(0, str(Path(__file__).parents[1] / 'test' / 'support'))
from other_faults import FAULTS

SITE = Site.at(34.65 * DEG, gravity=normal_gravity(34.65 * DEG))
DWELL = 40.0
GRADES = {
    'fog_navigation': 'cao2022_table1',
    'fog_medium': 'cao2022_table1',
    'mems_counts': 'mems_counts',
}
EXACT = 'perfect, and stated exact'
CAUSES = {
    'tilt': 'table is tilted',
    'zeros': 'zeros of the joints that are off',
    'orthogonality': 'joint axes that are not at right angles',
    'wobble': 'joint axes that wobble',
    'encoder': 'encoders that err within the turn',
    'joints': 'scatter by positioning errors of',
    'stops': 'table stops with attitude errors|attitude error of the table of',
    'moves': 'Gyros and encoders disagree on the end of',
    'velocities': 'By the accelerometers .* moves do not end at rest',
    'outliers': ', given less weight',
    'turns': 'turns .* scatter|Turns .* scatter',
    'gyro drift': 'biases of the gyros drift by',
    'accelerometer drift': 'biases of the accelerometers drift by',
    'gyro scatter': 'gyros .*scatter from dwell to dwell',
    'accelerometer scatter': 'accelerometers .*scatter from dwell to dwell',
    'motions': 'At the ends of motions',
    'temperature': 'temperature moved',
    'north': 'gyros see north',
    'course': 'The session (?:shows|hints at) .*(trend|warm_up|step)',
    'attitude step': 'the misalignments are those before it',
    'clock set': 'its clock was set',
    'clocks apart': 'clock of the IMU is .* that of the table',
    'late': 'are stamped late',
    'lost': 'samples are missing|missing in',
    'twice': 'dropped as duplicates',
    'frozen': 'are frozen',
    'moved': 'the unit was moved|shifted in its mount',
    'noise': 'noise of the sensors is unknown',
    **{t.name: rf'The session shows .*\b{t.name}\b' for t in TERMS},
    **{name: one.words for name, one in FAULTS.items() if one.words},
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
    'size_effect': (30.0, 30.0, 5.0),
    'delay': (1.0, 1.0, 5.0),
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
        bound: What of the stand, beyond the description, the information bound must allow for;
            None where the bound does not know the condition.
        thermometer: Whether the temperature is recorded, where it moves.
        fault: Of the second simulation, in place of all that; empty for none.
    """

    file: str = '{}'
    causes: tuple[str, ...] = ()
    plan: str = 'twelve_position'
    exact: bool = False
    term: str = ''
    bound: Mapping[str, float] | None = field(default_factory=dict)
    thermometer: bool = True
    fault: str = ''


_TILTED = 'table: {tilt: {east: 0.1 deg, north: -0.03 deg}}'
_LEVEL = 'table: {tilt: {east: 20 arcsec, north: -10 arcsec}}'
_RAMP = (
    'temperature: {ramp: 10 K/h, gyro: {bias: 0.02 (deg/h)/K, scale_factor: 2 ppm/K}, '
    'accelerometer: {bias: 5 ug/K, scale_factor: 5 ppm/K}}'
)
_SCATTERS = {
    'g_sensitivity': ('gyro scatter',),
    'gyro_g2': ('gyro scatter',),
    'accel_cross': ('accelerometer scatter',),
}
"""What terms that follow the attitude look like where they are too small to be found."""

_DRIFT = ('gyro drift', 'accelerometer drift', 'course')

_ON_THE_WAY = ('late', 'lost', 'twice')

CONDITIONS = {
    EXACT: Condition(exact=True),
    'perfect': Condition(),
    'laboratory: a little of everything': Condition(
        named_file('imperfections', 'laboratory').read_text(encoding='utf-8'),
        ('zeros', 'orthogonality', 'joints', 'stops', 'temperature', *_DRIFT, *_ON_THE_WAY),
        bound=None,
    ),
    'tilt 20 arcsec': Condition(_LEVEL, ('tilt',)),
    'tilt 20 arcsec, six positions': Condition(
        _LEVEL, ('tilt',), 'six_position', bound={'azimuth': GIVEN_AZIMUTH}
    ),
    'tilt 0.1 deg': Condition(_TILTED, ('tilt',)),
    'tilt 0.1 deg, six positions': Condition(
        _TILTED, ('tilt',), 'six_position', bound={'azimuth': GIVEN_AZIMUTH}
    ),
    'zeros 60 arcsec': Condition(
        'table: {zeros: 60 arcsec}', ('zeros',), bound={'zeros': 60 * ARCSEC}
    ),
    'orthogonality 10 arcsec': Condition(
        'table: {orthogonality: 10 arcsec}',
        ('orthogonality', 'moves'),
        bound={'orthogonality': 10 * ARCSEC},
    ),
    'orthogonality 60 arcsec': Condition(
        'table: {orthogonality: 60 arcsec}',
        ('orthogonality', 'moves'),
        bound={'orthogonality': 60 * ARCSEC},
    ),
    'wobble 2 arcsec': Condition('table: {wobble: {once: 2 arcsec, twice: 2 arcsec}}', ('wobble',)),
    'wobble 30 arcsec': Condition(
        'table: {wobble: {once: 30 arcsec, twice: 30 arcsec}}',
        ('wobble',),
        bound={'wobble': 30 * ARCSEC},
    ),
    'encoder harmonics 3 arcsec': Condition(
        'table: {encoder: {once: 3 arcsec, twice: 3 arcsec}}', ('encoder',)
    ),
    'encoder noise 7 arcsec': Condition(
        'joint_states: {noise: 7 arcsec}', bound={'readings': 7 * ARCSEC}
    ),
    'encoder noise 15 arcsec': Condition(
        'joint_states: {noise: 15 arcsec}', bound={'readings': 15 * ARCSEC}
    ),
    'encoder of 16 bits': Condition(
        'joint_states: {resolution: 19.775390625 arcsec}', bound={'step': 19.775390625 * ARCSEC}
    ),
    'encoder in steps of 0.05 deg': Condition(
        'joint_states: {resolution: 0.05 deg}', bound={'step': 0.05 * DEG}
    ),
    'joint stamps jitter 1 ms': Condition('joint_states: {jitter: 1 ms}', bound={'jitter': 1e-3}),
    'positioning errors of joints 5 arcsec': Condition(
        'table: {positioning: {joints: 5 arcsec}}', ('joints',), bound={'positioning': 5 * ARCSEC}
    ),
    'attitude errors of stops 2 arcsec': Condition(
        'table: {positioning: {tilt: 2 arcsec, heading: 2 arcsec}}',
        ('stops', 'joints'),
        bound={'stops': 2 * ARCSEC},
    ),
    'servo 30 arcsec': Condition('table: {servo: 30 arcsec}'),
    'ramps 20 deg/s^2': Condition('table: {acceleration: 20 deg/s^2}'),
    'ramps 10 deg/s^2': Condition('table: {acceleration: 10 deg/s^2}'),
    'stamps jitter 1 ms': Condition('stamps: {jitter: 1 ms}'),
    'stamps late': Condition('stamps: {late: 1 %, delay: 20 ms}', ('late',)),
    '5 % of stamps late by 100 ms': Condition('stamps: {late: 5 %, delay: 100 ms}', ('late',)),
    'stamps in bunches of 4': Condition('stamps: {bunch: 4}'),
    'stamps in bunches of 10': Condition('stamps: {bunch: 10}'),
    'stamps in bunches of 20': Condition('stamps: {bunch: 20}'),
    'stamps in bunches of 50': Condition('stamps: {bunch: 50}'),
    'clock 50 ppm': Condition('stamps: {clock_rate: 50 ppm}'),
    'clock ahead by 2 s': Condition('stamps: {clock_offset: 2 s}', ('clocks apart',)),
    'clock ahead by 20 s': Condition('stamps: {clock_offset: 20 s}', ('clocks apart',)),
    'lost 0.05 %': Condition('samples: {lost: 0.05 %}', ('lost',)),
    'lost 0.5 %': Condition('samples: {lost: 0.5 %}', ('lost',)),
    'lost 2 %': Condition('samples: {lost: 2 %}', ('lost',)),
    'twice 0.05 %': Condition('samples: {twice: 0.05 %}', ('twice',)),
    'twice 2 %': Condition('samples: {twice: 2 %}', ('twice',)),
    # Of a move that ends elsewhere frozen samples are among the causes named.
    'frozen 3 s every 5 min': Condition(
        'samples: {frozen: {every: 5 min, for: 3 s}}', ('frozen', 'moves', 'velocities'), bound=None
    ),
    'ringing': Condition(
        'mounting: {ringing: {rate: 0.5 deg/s, force: 50 mg, decay: 0.5 s}}',
        ('motions',),
        bound=None,
    ),
    'floor shakes': Condition(
        'mounting: {floor: {rate: 0.05 deg/s, force: 2 mg}}',
        ('gyro scatter', 'accelerometer scatter'),
        bound=None,
    ),
    'temperature ramp': Condition(_RAMP, ('temperature', *_DRIFT), bound={'ramp': True}),
    'temperature ramp, not recorded': Condition(
        _RAMP, _DRIFT, bound={'ramp': True}, thermometer=False
    ),
    'warm-up': Condition(
        'temperature: {warm_up: {gyro: 0.1 deg/h, accelerometer: 50 ug}}', _DRIFT, bound=None
    ),
    'biases step by 0.05 deg/h and 50 ug': Condition(
        'bias_step: {time: 9 min, gyro: [0.05 deg/h, -0.035 deg/h, 0.06 deg/h], '
        'accelerometer: [50 ug, -35 ug, 60 ug]}',
        _DRIFT,
        bound=None,
    ),
    'biases step by 1 deg/h and 0.2 mg': Condition(
        'bias_step: {time: 7 min, gyro: [1 deg/h, -0.7 deg/h, 1.2 deg/h], '
        'accelerometer: [200 ug, -150 ug, 250 ug]}',
        _DRIFT,
        bound=None,
    ),
    **{
        name: Condition(causes=(name, *_SCATTERS.get(name, ())), term=name, bound=None)
        for name in SIZES
    },
    **{
        name: Condition(causes=(name,) if one.words else (), bound=None, fault=name)
        for name, one in FAULTS.items()
    },
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
    return simulated, Setup(imu, plan, table, SITE, search_terms=True)


def blocks(condition: str, simulated: SimulatedStand) -> Iterator[Block]:
    """Yield what is recorded of a simulated stand."""
    for _, block in simulated.blocks():
        if CONDITIONS[condition].thermometer or not isinstance(block, TemperatureBlock):
            yield block


def truth(unit: SensorModel, simulated: SimulatedStand) -> Floats:
    """Return the 24 parameters that a session should find, by the table's clock.

    They are means from the first static dwell to the last.
    """
    options = simulated.options
    times = np.linspace(simulated.visits[0].rest, simulated.visits[-1].end, 1000)
    kelvin = float(options.warming.excess(times).mean())
    stepped = float((times >= options.bias_step.time).mean())
    faded = float(np.exp(-times / options.warm_up.time_constant).mean())
    drift, fading = options.thermal_drift, options.warm_up
    gyro, accel = unit.gyro, unit.accel
    gyro_scale = (1 + kelvin * np.broadcast_to(drift.gyro_scale, 3))[:, None]
    accel_scale = (1 + kelvin * np.broadcast_to(drift.accel_scale, 3))[:, None]
    eye = np.eye(3)
    gyro_bias = (
        gyro.bias
        + kelvin * np.asarray(drift.gyro_bias)
        + faded * np.asarray(fading.gyro_bias)
        + stepped * np.asarray(options.bias_step.gyro_bias)
    )
    accel_bias = (
        accel.bias
        + kelvin * np.asarray(drift.accel_bias)
        + faded * np.asarray(fading.accel_bias)
        + stepped * np.asarray(options.bias_step.accel_bias)
    )
    return SensorModel(
        Triad(gyro_scale * gyro.response - eye, gyro_bias),
        Triad(accel_scale * accel.response - eye, accel_bias),
    ).vector()
