"""A C header of constants for firmware, with the function that applies them."""

from __future__ import annotations

import re

import numpy as np

from ..stream import Floats, Units
from .exported import Exported, Source, always_left_out

_OUTPUT = {
    Units.PULSES: ('pulses counted in one sample interval', ' / seconds'),
    Units.COUNTS: ('counts proportional to rate and specific force', ''),
    Units.SI: ('rad/s and m/s^2 as the sensor gives them', ''),
}


def export(source: Source) -> Exported:
    """Return the header.

    Raises:
        NotObservable: A matrix has no inverse.

    """
    calibration = source.calibration
    imu, model = calibration.imu, calibration.model
    # What has no inverse is refused here, in words.
    model.compensate(np.zeros((1, 3)), np.zeros((1, 3)))
    what, per_interval = _OUTPUT[imu.units]
    guard = f'IMU_CALIB_{re.sub(r"[^A-Z0-9]+", "_", imu.id.upper()).strip("_")}_H'
    constants = '\n'.join(
        [
            _scalar('IMU_CALIB_GYRO_SCALE', imu.gyro.scale_factor, 'nominal: raw to rad/s or rad'),
            _scalar('IMU_CALIB_ACCEL_SCALE', imu.accel.scale_factor, 'nominal: to m/s^2 or m/s'),
            _vector('imu_calib_gyro_bias', model.gyro.bias, 'rad/s, taken off before the matrix'),
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
        unused='' if per_interval else '    (void)seconds;\n',
    )
    return Exported(text, tuple(always_left_out(calibration)))


def _comment(text: str) -> str:
    return text.replace('*/', '* /')


def _number(value: float) -> str:
    return f'IMU_CALIB_C({float(value)!r})'


def _scalar(name: str, value: float, comment: str) -> str:
    return f'#define {name} {_number(value)} /* {comment} */'


def _vector(name: str, values: Floats, comment: str) -> str:
    row = ', '.join(_number(v) for v in values)
    return f'/* {comment} */\nstatic const imu_calib_real {name}[3] = {{{row}}};'


def _matrix(name: str, matrix: Floats, comment: str) -> str:
    rows = ',\n'.join(f'    {{{", ".join(_number(v) for v in row)}}}' for row in matrix)
    return f'/* {comment} */\nstatic const imu_calib_real {name}[3][3] = {{\n{rows}}};'


_TEMPLATE = """\
/* Calibration of {imu}, written by imu_calib.
 *
 * Raw values: {what}.
 *   force = accel_matrix * (raw_accel * ACCEL_SCALE{per_interval} - accel_bias)
 *   rate  = gyro_matrix * (raw_gyro * GYRO_SCALE{per_interval} - gyro_bias - g_sensitivity * force)
 * Matrices are stored row by row and multiply column vectors from the left. rad/s and m/s^2.
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

/* seconds: the sample interval; it counts for pulses alone. */
static inline void imu_calib_compensate(const imu_calib_real raw_gyro[3],
                                        const imu_calib_real raw_accel[3],
                                        imu_calib_real seconds, imu_calib_real rate[3],
                                        imu_calib_real force[3])
{{
    imu_calib_real free_accel[3], free_gyro[3];
    int i, j;

{unused}    for (i = 0; i < 3; ++i)
        free_accel[i] =
            raw_accel[i] * IMU_CALIB_ACCEL_SCALE{per_interval} - imu_calib_accel_bias[i];
    for (i = 0; i < 3; ++i) {{
        force[i] = 0;
        for (j = 0; j < 3; ++j)
            force[i] += imu_calib_accel_matrix[i][j] * free_accel[j];
    }}
    for (i = 0; i < 3; ++i) {{
        free_gyro[i] = raw_gyro[i] * IMU_CALIB_GYRO_SCALE{per_interval} - imu_calib_gyro_bias[i];
        for (j = 0; j < 3; ++j)
            free_gyro[i] -= imu_calib_g_sensitivity[i][j] * force[j];
    }}
    for (i = 0; i < 3; ++i) {{
        rate[i] = 0;
        for (j = 0; j < 3; ++j)
            rate[i] += imu_calib_gyro_matrix[i][j] * free_gyro[j];
    }}
}}

#endif
"""
