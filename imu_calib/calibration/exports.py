"""Exports for imucal, Kalibr, ROS and firmware in C; input and output of every export."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from textwrap import indent

import numpy as np
import yaml

from ..common.errors import InputError, NotObservable
from ..common.stream import Floats, Units
from ..common.units import DEG, HOUR, STANDARD_GRAVITY, Dimension, counted
from ..estimation.evidence import SMALLEST_VARIANCE
from ..model.parameters import AXES, Carried, Product
from ..model.sensors import SensorModel, Triad, terms_of
from ..session.imu import Coefficient, ImuSpec, TriadSpec
from .calibration import Calibration

TOPIC = '/imu/data'  #: Of an IMU's stream, where none is stated.


@dataclass(frozen=True, eq=False)
class ExportSource:
    """A calibration for export."""

    calibration: Calibration  #: The calibration.
    path: Path | None = None  #: Its file, absolute; None without a file.
    sample_rate: float | None = None  #: Of the IMU's stream, Hz; None if not stated.
    topic: str = TOPIC  #: Of the IMU's stream.
    #: Data sheet of the IMU, for noise that the calibration does not state; or None.
    sheet: ImuSpec | None = None
    file: str = 'imu_calib.h'  #: Name of the written header.

    def rate_for(self, purpose: str) -> float:
        """Return the sample rate, Hz."""
        if self.sample_rate is not None:
            return self.sample_rate
        if self.sheet is not None and self.sheet.sample_rate is not None:
            return self.sheet.sample_rate
        raise InputError(f'{purpose}: give `sample_rate` in Hz.')


@dataclass(frozen=True)
class Exported:
    """A calibration in the format of other software."""

    text: str  #: Of the file.
    #: What it cannot represent, and other messages for the user, in sentences.
    findings: tuple[str, ...] = ()

    def __repr__(self) -> str:
        lines = counted(len(self.text.splitlines()), 'line')
        return f'<Exported: {lines}, {counted(len(self.findings), "finding")}>'


def left_out(calibration: Calibration, export: str) -> list[str]:
    """Return sentences on omitted parameters; refuse if the others would be wrong without them."""
    kinds = dict.fromkeys(p.kind for p in calibration.parameters)
    refused = [kind for kind in kinds if kind.value.exports[export] is Carried.REFUSED]
    if refused:
        names = ', '.join(p.name for p in calibration.parameters if p.kind in refused)
        words = ' and '.join(kind.value.words for kind in refused)
        raise InputError(
            f'The format {export} has no {words} ({names}), and without it the other parameters '
            'are wrong: calibrate without it (`terms`), or export another format.'
        )
    return [
        f'The {kind.value.words} is left out.'
        for kind in kinds
        if kind.value.exports[export] is Carried.LEFT_OUT
    ]


def common_omissions(calibration: Calibration, export: str) -> list[str]:
    """Return sentences on the content that most formats omit."""
    sentences = ['The covariance of the parameters is left out.', *left_out(calibration, export)]
    temperature = calibration.provenance.get('temperature')
    if isinstance(temperature, dict) and np.isfinite(float(temperature.get('mean', np.nan))):
        sentences.append(
            f'The parameters hold at {float(temperature["mean"]):.1f} degrees Celsius; the file '
            'does not say so.'
        )
    clock = calibration.clock
    if clock is not None and clock.is_noticed and calibration.imu.units.per_interval:
        sentences.append(
            f'Pulses count over seconds of the {clock.against}; the {clock.name} are of a clock '
            f'that is {clock.pace(1)}: divide an interval by it by {1 + clock.faster:.7f}. The '
            'file does not do that.'
        )
    if calibration.changes is not None and calibration.changes.follows_temperature:
        sentences.append('The dependence on temperature (term thermal) is left out.')
    if not calibration.has_accelerometers:
        sentences.append('The accelerometers were not calibrated: the file describes ideal ones.')
    return sentences


# The JSON of imucal (MaD-Lab FAU): K, R, b of a turntable calibration, m/s^2 and deg/s out.
#
# imucal compensates with f = R_a^-1 K_a^-1 (raw - b_a) and
# w = R_g^-1 K_g^-1 (raw - K_ga f - b_g): the bias is subtracted before the matrix, in units of the
# raw stream, and K R is the response, K diagonal, the rows of R of length one (imucal 2.6,
# FerrarisCalibrationInfo; format 2.0.0).


_FORMAT = '2.0.0'
_UNITS = {
    Units.PULSES: ('pulses', 'pulses'),
    Units.COUNTS: ('counts', 'counts'),
    Units.INCREMENTS: ('increments', 'increments'),
    Units.RATES: ('rates', 'rates'),
    Units.SI: ('m/s^2', 'rad/s'),
}


def export_imucal(source: ExportSource) -> Exported:
    """Return a TurntableCalibrationInfo."""
    calibration = source.calibration
    imu, model = calibration.imu, calibration.model
    per_second, comment = 1.0, f'{calibration.unit_name}, by imu_calib'
    if imu.units.per_interval:
        per_second = source.rate_for('imucal has no sample interval, which pulses need')
        comment += f'; pulses per sample at {per_second:g} Hz'
    gyro_scale = imu.gyro.scale_factor * per_second
    accel_scale = imu.accel.scale_factor * per_second
    acc_unit, gyr_unit = _UNITS[imu.units]
    document = {
        'acc_unit': 'm/s^2',
        'gyr_unit': 'deg/s',
        'from_acc_unit': acc_unit,
        'from_gyr_unit': gyr_unit,
        'comment': comment,
        **_triad('a', model.accel, accel_scale, 1.0),
        **_triad('g', model.gyro, gyro_scale, DEG),
        'K_ga': (model.g_sensitivity / gyro_scale).tolist(),
        'cal_type': 'Turntable',
        '_format_version': _FORMAT,
    }
    sentences = [
        f"Input: accelerometers in '{acc_unit}', gyros in '{gyr_unit}'; output: m/s^2 and deg/s.",
        *common_omissions(calibration, 'imucal'),
    ]
    if imu.units.per_interval:
        sentences.append(
            'A fixed sample interval is built in: intervals that vary are not followed.'
        )
    return Exported(json.dumps(document, indent=4) + '\n', tuple(sentences))


def _triad(letter: str, triad: Triad, scale: float, unit: float) -> dict[str, list[object]]:
    """Return K, R and b: raw = K R input + b, the input in `unit`."""
    response: Floats = triad.response * unit / scale
    lengths = np.linalg.norm(response, axis=1)
    return {
        f'K_{letter}': np.diag(lengths).tolist(),
        f'R_{letter}': (response / lengths[:, None]).tolist(),
        f'b_{letter}': (triad.bias / scale).tolist(),
    }


# Kalibr's imu.yaml with the intrinsics of its scale-misalignment model.
#
# Kalibr's model, in its own frame i (ethz-asl/kalibr, IccSensors.py, IccScaledMisalignedImu):
#
# accelerometers: raw = M a_i + b             M lower triangular
# gyros:          raw = M C_gyro_i w_i + A C_gyro_i a_i + b
#
# so that its frame has X along the input axis of the accelerometer x, Y in the plane of x and y.
# Our frame is that of the table's mount; T_i_b rotates from ours to Kalibr's: I + M_a = M C_i_b,
# and likewise I + M_g = M_gyro C_gyro_i C_i_b and G = A C_gyro_i C_i_b.


_TOPIC = re.compile(r'/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*', re.ASCII)
"""Names that ROS allows (design.ros2.org, "Topic and Service name mapping to DDS")."""

UNITS_OF_KALIBR = """\
# Gyros: density in rad/s/sqrt(Hz), random walk in rad/s^2/sqrt(Hz); accelerometers: m/s^2/sqrt(Hz),
# m/s^3/sqrt(Hz); update_rate in Hz.
"""
_HEAD = """\
# {imu} by imu_calib, in Kalibr's scale-misalignment model: raw = M x + b, x in rad/s and m/s^2.
# Frame i: X along the input axis of accelerometer x, Y in the plane of x and y.
# T_i_b turns the axes of the mount in which the unit was calibrated (b) into it.
# bias: of the raw stream, before the matrix is inverted; Kalibr itself estimates biases anew.
"""


def export_kalibr(source: ExportSource) -> Exported:
    """Return imu.yaml."""
    if not _TOPIC.fullmatch(source.topic):
        raise InputError(f'`topic`: {source.topic!r} is not a valid name of a topic.')
    calibration = source.calibration
    model = calibration.model
    accel, to_i = _lower(model.accel.response, 'accelerometers')
    gyro, to_gyro = _lower(model.gyro.response, 'gyros')
    pose = np.eye(4)
    pose[:3, :3] = to_i
    noise, bounds = _noise(source)
    document = {
        **noise,
        'update_rate': source.rate_for('update_rate of imu.yaml'),
        'rostopic': source.topic,
        'model': 'scale-misalignment',
        'time_offset': 0.0,
        'T_i_b': pose.tolist(),
        'accelerometers': {'M': accel.tolist(), 'bias': model.accel.bias.tolist()},
        'gyroscopes': {
            'M': gyro.tolist(),
            'A': (model.g_sensitivity @ to_gyro.T).tolist(),
            'C_gyro_i': (to_gyro @ to_i.T).tolist(),
            'bias': model.gyro.bias.tolist(),
        },
    }
    text = yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=10**6)
    sentences = [
        *bounds,
        *common_omissions(calibration, 'kalibr'),
        f'Matrices and biases are of raw samples: a topic {source.topic} of compensated ones '
        '(imu-calib compensate, compensator_node) would be corrected twice. For those write '
        '`model: calibrated`.',
    ]
    if calibration.imu.units is not Units.SI:
        sentences.append(
            f'The topic has to carry rad/s and m/s^2: {calibration.imu.units.value} times the '
            'nominal scale factor'
            + (' over the sample interval.' if calibration.imu.units.per_interval else '.')
        )
    head = _HEAD.format(imu=_comment(calibration.unit_name)) + UNITS_OF_KALIBR
    return Exported(head + text, tuple(sentences))


def _lower(response: Floats, name: str) -> tuple[Floats, Floats]:
    """Split a response into a lower triangular matrix and a rotation."""
    rotation, upper = np.linalg.qr(response.T)
    signs = np.where(np.diag(upper) < 0, -1.0, 1.0)
    rotation = (rotation * signs).T
    if np.linalg.det(rotation) < 0:
        raise InputError(f"Kalibr's model has no mirrored axes, and the {name} are.")
    return np.tril((signs[:, None] * upper).T), rotation


def _noise(source: ExportSource) -> tuple[dict[str, float], list[str]]:
    """Return noise densities and random walks of Kalibr, and which of them were not measured."""
    calibration, sheet = source.calibration, source.sheet
    in_the_hand = calibration.by_hand
    # Holds of a plan in the hand show the hand's noise, and nothing states that of the sensor.
    hands_own = in_the_hand and not calibration.in_the_hand
    walk = np.zeros(6) if hands_own else np.nan_to_num(calibration.sensor_walk)
    # A session without noise shows only the rounding of numbers, which is not a noise density.
    walk = np.where(walk**2 > SMALLEST_VARIANCE, walk, 0.0)
    # The drift in the hand is the hand's, too.
    channels = {} if in_the_hand else calibration.noise
    found: dict[str, float] = {}
    notes = []
    for kalibr, name, mine, spec, densities in (
        (
            'accelerometer',
            'accelerometers',
            'xyz',
            None if sheet is None else sheet.accel,
            walk[3:],
        ),
        ('gyroscope', 'gyros', 'xyz', None if sheet is None else sheet.gyro, walk[:3]),
    ):
        density = float(np.sqrt(np.mean(densities**2)))
        if spec is not None and spec.random_walk > 0 and (in_the_hand or not density > 0):
            density = spec.random_walk
            notes.append(f'{kalibr}_noise_density is that of the data sheet.')
        elif in_the_hand and density > 0:
            notes.append(
                f'{kalibr}_noise_density is that of the sensor as the calibration states it, by '
                'the data sheet or by neighbouring samples: a hand trembles more.'
            )
        drifts = [
            channels[c].rate_random_walk for axis in mine if (c := name[0] + axis) in channels
        ]
        drift, note = _drift(drifts, spec)
        if not (density > 0 and drift > 0):
            lacking = 'noise' if not density > 0 else "biases' random walk"
            raise InputError(
                f'The calibration does not hold the {lacking} of the {name} that imu.yaml needs: '
                'give `imu` with its data sheet (random walk and bias instability), or write the '
                'noise of the unit lying still: imu-calib noise BAG --kalibr FILE.'
            )
        if note:
            notes.append(f'{kalibr}_random_walk {note}.')
        found[f'{kalibr}_noise_density'] = density
        found[f'{kalibr}_random_walk'] = drift
    return found, notes


def _drift(drifts: list[Coefficient], spec: TriadSpec | None) -> tuple[float, str]:
    """Return the random walk of the biases per sqrt(s), 0 if it is unknown, and its source."""
    values = [c.value for c in drifts if c.value]
    if values:
        return float(np.sqrt(np.mean(np.square(values)))), ''
    if spec is not None and spec.bias_instability > 0:
        words = "is the data sheet's bias instability over the root of an hour, a rule of thumb"
        return spec.bias_instability / HOUR**0.5, words
    limits = [c.below for c in drifts if np.isfinite(c.below) and c.below > 0]
    if limits:
        return max(limits), 'is an upper limit by the session (95 %), not a value'
    return 0.0, ''


def export_ros(source: ExportSource) -> Exported:
    """Return parameters that name the calibration file for the node.

    The file is not copied: the node reads it again when it changes.
    """
    if source.path is None:
        raise InputError(
            "The format ros names the calibration's file: give its path, or `output`, beside which "
            'one is written.'
        )
    document = {'/**': {'compensator_node': {'ros__parameters': {'calibration': str(source.path)}}}}
    head = (
        f'# Calibration of {_comment(source.calibration.unit_name)} for compensator_node:\n'
        '# ros2 run imu_calib compensator_node --ros-args --params-file THIS_FILE\n'
    )
    return Exported(
        head + yaml.safe_dump(document, sort_keys=False, width=10**6),
        (
            *left_out(source.calibration, 'ros'),
            'The file names the calibration by its path: it has to be there on the robot.',
        ),
    )


# A C header for firmware: constants, and the function that applies them.

_EXACT = 1e-17  #: Remaining relative error: that of a double.
_CONTRACTION = 0.5  #: Factor by which each iteration of an inversion must reduce the error.
_WIDEST_RATE, _WIDEST_FORCE = 2000 * DEG, 16 * STANDARD_GRAVITY
"""Largest range assumed for a unit, also if it states none: that of common MEMS units."""

_OUTPUT = {
    Units.PULSES: ('pulses counted in one sample interval', ' / seconds'),
    Units.COUNTS: ('counts proportional to rate and specific force', ''),
    Units.INCREMENTS: ('angles and velocities gained in one sample interval', ' / seconds'),
    Units.RATES: ('raw_gyro in {}, raw_accel in {}', ''),
    Units.SI: ('raw_gyro in rad/s, raw_accel in m/s^2', ''),
}


def export_c_header(source: ExportSource) -> Exported:
    """Return the header.

    Raises:
        NotObservable: A matrix has no inverse.
    """
    calibration = source.calibration
    imu, model = calibration.imu, calibration.model
    # A singular matrix is refused here with a sentence.
    model.compensate(np.zeros((1, 3)), np.zeros((1, 3)))
    what, per_interval = _OUTPUT[imu.units]
    guard = f'IMU_CALIB_{re.sub(r"[^A-Z0-9]+", "_", imu.id.upper()).strip("_")}_H'
    constants = '\n'.join(
        [
            _scalar('IMU_CALIB_GYRO_SCALE', imu.gyro.scale_factor, 'nominal: raw to rad/s or rad'),
            _scalar('IMU_CALIB_ACCEL_SCALE', imu.accel.scale_factor, 'nominal: to m/s^2 or m/s'),
            _vector('imu_calib_gyro_bias', model.gyro.bias, 'rad/s, subtracted before the matrix'),
            _vector('imu_calib_accel_bias', model.accel.bias, 'm/s^2, likewise'),
            _matrix(
                'imu_calib_gyro_matrix',
                np.asarray(np.linalg.inv(model.gyro.response)),
                '(I + M)^-1: row is the body axis, column the channel',
            ),
            _matrix(
                'imu_calib_accel_matrix',
                np.asarray(np.linalg.inv(model.accel.response)),
                '(I + M)^-1: row is the body axis, column the channel',
            ),
            _matrix(
                'imu_calib_g_sensitivity',
                model.g_sensitivity,
                '(rad/s)/(m/s^2): row is the gyro channel, column the axis of the force',
            ),
        ]
    )
    text = _TEMPLATE.format(
        imu=_comment(calibration.unit_name),
        guard=guard,
        file=source.file,
        what=what.format(_unit(Dimension.RATE, imu.gyro), _unit(Dimension.ACCELERATION, imu.accel)),
        constants=constants,
        per_interval=per_interval,
        interval=_by_clock(calibration) if per_interval else '',
        unused='' if per_interval else '    (void)seconds;\n',
        **_with_terms(model, imu, per_interval),
    )
    return Exported(text, tuple(common_omissions(calibration, 'c')))


def _unit(dimension: Dimension, triad: TriadSpec) -> str:
    """Return the unit of which a scale factor is one, or that many of the SI's."""
    for name, value in dimension.value.items():
        if np.isclose(triad.scale_factor, value, rtol=1e-9, atol=0.0):
            return name
    return f'units of {triad.scale_factor:g} {next(iter(dimension.value))}'


def _with_terms(model: SensorModel, imu: ImuSpec, per_interval: str) -> dict[str, str]:
    """Return the parts of the header that depend on nonlinear terms."""
    if model.linear:
        body = _BODY.format(per_interval=per_interval, of_accel='', of_gyro='')
        return {'formula': '', 'terms': '', 'more': '', 'body': body}
    body = _BODY.format(
        per_interval=per_interval, of_accel=' - accel_terms[i]', of_gyro=' - gyro_terms[i]'
    )
    slope, ends = _slope(model, imu)
    rounds = 1 + int(np.ceil(np.log(_EXACT) / np.log(slope)))
    names = ', '.join(term.name for term in terms_of(model.parameters) if not term.linear)
    sums = [['0'] for _ in range(2 * len(AXES))]
    for term in terms_of(model.parameters):
        values = model.values(term.parameters)
        for (parameter, product), value in zip(term.products, values, strict=True):
            if value and not term.linear:
                sums[parameter.channel].append(_product(product, float(value)))
    lines = [
        f'    {"gyro" if k < len(AXES) else "accel"}[{k % len(AXES)}] = {" + ".join(parts)};'
        for k, parts in enumerate(sums)
    ]
    return {
        'formula': f' *   Both less what {names} add to the outputs at (rate, force): repeated.\n',
        'terms': _TERMS.format(lines='\n'.join(lines), slope=slope, ends=ends, rounds=rounds),
        'more': _MORE,
        'body': _REPEATED.format(body=indent(body, '    ')),
    }


def _slope(model: SensorModel, imu: ImuSpec) -> tuple[float, str]:
    """Return the error factor of an iteration at the ends of the range, and the ends."""
    rate, force = (
        min(spec.range, widest)
        for spec, widest in ((imu.gyro, _WIDEST_RATE), (imu.accel, _WIDEST_FORCE))
    )
    # The slopes are largest at the largest inputs, where all contributions have one sign.
    most = model.with_values(model.parameters, np.abs(model.values(model.parameters)))
    ends = np.repeat([rate, force], len(AXES))
    linear = replace(model, terms={}).slopes(np.zeros(3), np.zeros(3))
    slope = float((np.abs(np.linalg.inv(linear)) @ most.extra_slopes(ends)).sum(axis=1).max())
    words = f'{rate / DEG:.4g} deg/s and {force / STANDARD_GRAVITY:.4g} g'
    if slope > _CONTRACTION:
        raise NotObservable(
            f'The terms {", ".join(model.terms)} outgrow the responses at {words}: the header '
            "could not subtract them. State the unit's range, or calibrate without them (`terms`)."
        )
    return max(slope, float(np.finfo(float).tiny)), words


def _product(product: Product, value: float) -> str:
    """Write one product of inputs and its coefficient."""
    inputs = [f'{name}[{k}]' for name in ('rate', 'force') for k in range(len(AXES))]
    factors = [inputs[k] for k in product.factors]
    factors += [f'IMU_CALIB_ABS({inputs[k]})' for k in product.absolute]
    return ' * '.join([_number(value * product.scale), *factors])


def _comment(text: str) -> str:
    """Return a text, which a user chose, as it may stand in a line of a comment."""
    return ' '.join(text.split()).replace('*/', '* /')


def _number(value: float) -> str:
    return f'IMU_CALIB_C({float(value)!r})'


def _scalar(name: str, value: float, comment: str) -> str:
    return f'#define {name} {_number(value)} /* {comment} */'


def _vector(name: str, values: Floats, comment: str) -> str:
    row = ', '.join(_number(v) for v in values)
    return f'/* {comment} */\nstatic const imu_calib_real {name}[3] = {{{row}}};'


def _by_clock(calibration: Calibration) -> str:
    """Return the clock of the interval as text, if the session compared two that differ."""
    clock = calibration.clock
    if clock is None or not clock.is_noticed:
        return ''
    return (
        f'\n * By the {_comment(clock.against)}: the {_comment(clock.name)} are of a clock that '
        f'is {clock.pace(2)};\n * divide an interval between them by '
        f'{1 + clock.faster:.9f}.'
    )


def _matrix(name: str, matrix: Floats, comment: str) -> str:
    rows = ',\n'.join(f'    {{{", ".join(_number(v) for v in row)}}}' for row in matrix)
    return f'/* {comment} */\nstatic const imu_calib_real {name}[3][3] = {{\n{rows}}};'


_TEMPLATE = """\
/* Calibration of {imu}, written by imu_calib.
 *
 * Raw values: {what}.
 *   force = accel_matrix * (raw_accel * ACCEL_SCALE{per_interval} - accel_bias)
 *   rate  = gyro_matrix * (raw_gyro * GYRO_SCALE{per_interval} - gyro_bias - g_sensitivity * force)
{formula} * Matrices are stored row by row and multiply column vectors from the left. SI units.
 *
 * Usage:
 *   #include "{file}"       define IMU_CALIB_FLOAT before it for single precision
 *   imu_calib_real rate[3], force[3];
 *   imu_calib_compensate(raw_gyro, raw_accel, seconds, rate, force);
 */
#ifndef {guard}
#define {guard}

#ifdef IMU_CALIB_FLOAT
typedef float imu_calib_real;
#else
typedef double imu_calib_real;
#endif
#define IMU_CALIB_C(x) ((imu_calib_real)(x))

{constants}

{terms}/* seconds: the sample interval; it counts for pulses alone.{interval} */
static inline void imu_calib_compensate(const imu_calib_real raw_gyro[3],
                                        const imu_calib_real raw_accel[3],
                                        imu_calib_real seconds, imu_calib_real rate[3],
                                        imu_calib_real force[3])
{{
    imu_calib_real free_accel[3], free_gyro[3];
    int i, j;
{more}
{unused}{body}}}

#endif
"""

_BODY = """\
    for (i = 0; i < 3; ++i)
        free_accel[i] =
            raw_accel[i] * IMU_CALIB_ACCEL_SCALE{per_interval} - imu_calib_accel_bias[i]{of_accel};
    for (i = 0; i < 3; ++i) {{
        force[i] = 0;
        for (j = 0; j < 3; ++j)
            force[i] += imu_calib_accel_matrix[i][j] * free_accel[j];
    }}
    for (i = 0; i < 3; ++i) {{
        free_gyro[i] =
            raw_gyro[i] * IMU_CALIB_GYRO_SCALE{per_interval} - imu_calib_gyro_bias[i]{of_gyro};
        for (j = 0; j < 3; ++j)
            free_gyro[i] -= imu_calib_g_sensitivity[i][j] * force[j];
    }}
    for (i = 0; i < 3; ++i) {{
        rate[i] = 0;
        for (j = 0; j < 3; ++j)
            rate[i] += imu_calib_gyro_matrix[i][j] * free_gyro[j];
    }}
"""

_TERMS = """\
#define IMU_CALIB_ABS(x) ((x) < 0 ? -(x) : (x))
/* Rounds of taking the terms off: each leaves {slope:.2g} of an error at most, at {ends}. */
#define IMU_CALIB_ROUNDS {rounds}

/* What the terms add to the outputs, rad/s and m/s^2. */
static inline void imu_calib_terms(const imu_calib_real rate[3], const imu_calib_real force[3],
                                   imu_calib_real gyro[3], imu_calib_real accel[3])
{{
    (void)rate;
    (void)force;
{lines}
}}

"""

_MORE = """\
    imu_calib_real gyro_terms[3] = {0, 0, 0}, accel_terms[3] = {0, 0, 0};
    int k;
"""

_REPEATED = """\
    for (k = 0; k < IMU_CALIB_ROUNDS; ++k) {{
{body}        imu_calib_terms(rate, force, gyro_terms, accel_terms);
    }}
"""


EXPORTS: dict[str, Callable[[ExportSource], Exported]] = {
    'ros': export_ros,
    'kalibr': export_kalibr,
    'imucal': export_imucal,
    'c': export_c_header,
}
"""The formats of `imu-calib export`, by name."""
