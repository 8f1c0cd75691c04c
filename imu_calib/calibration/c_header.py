"""A C header for firmware: constants, and the function that applies them."""

from __future__ import annotations

import re
from dataclasses import replace
from textwrap import indent

import numpy as np

from ..common.errors import NotObservable
from ..common.stream import Floats, Units
from ..common.units import DEG, STANDARD_GRAVITY
from ..model.parameters import AXES, Product
from ..model.sensors import SensorModel, terms_of
from ..session.imu import ImuSpec
from .calibration import Calibration
from .exports import (
    Exported,
    ExportSource,
    common_omissions,
)

_EXACT = 1e-17  #: Remaining relative error: that of a double.
_CONTRACTION = 0.5  #: Factor by which each iteration of an inversion must reduce the error.
_WIDEST_RATE, _WIDEST_FORCE = 2000 * DEG, 16 * STANDARD_GRAVITY
"""Largest range assumed for a unit, also if it states none: that of common MEMS units."""

_OUTPUT = {
    Units.PULSES: ('pulses counted in one sample interval', ' / seconds'),
    Units.COUNTS: ('counts proportional to rate and specific force', ''),
    Units.INCREMENTS: ('angles and velocities gained in one sample interval', ' / seconds'),
    Units.RATES: ('rates and specific forces as the sensor gives them', ''),
    Units.SI: ('rad/s and m/s^2 as the sensor gives them', ''),
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
        imu=_comment(imu.id),
        guard=guard,
        what=what,
        constants=constants,
        per_interval=per_interval,
        interval=_by_clock(calibration) if per_interval else '',
        unused='' if per_interval else '    (void)seconds;\n',
        **_with_terms(model, imu, per_interval),
    )
    return Exported(text, tuple(common_omissions(calibration, 'c')))


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
    return text.replace('*/', '* /')


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
 *   #include "imu_calib.h"       define IMU_CALIB_FLOAT before it for single precision
 *   imu_calib_real rate[3], force[3];
 *   imu_calib_compensate(raw_gyro, raw_accel, 0.01, rate, force);
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
