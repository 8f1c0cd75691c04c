"""The JSON of imucal (MaD-Lab FAU): K, R, b of a turntable calibration, m/s^2 and deg/s out.

imucal compensates with f = R_a^-1 K_a^-1 (raw - b_a) and
w = R_g^-1 K_g^-1 (raw - K_ga f - b_g): the bias is subtracted before the matrix, in units of the
raw stream, and K R is the response, K diagonal, the rows of R of length one (imucal 2.6,
FerrarisCalibrationInfo; format 2.0.0).
"""

from __future__ import annotations

import json

import numpy as np

from ..common.stream import Floats, Units
from ..common.units import DEG
from ..model.sensors import Triad
from .exported import Exported, ExportSource, common_omissions

_FORMAT = '2.0.0'
_UNITS = {
    Units.PULSES: ('pulses', 'pulses'),
    Units.COUNTS: ('counts', 'counts'),
    Units.INCREMENTS: ('increments', 'increments'),
    Units.RATES: ('rates', 'rates'),
    Units.SI: ('m/s^2', 'rad/s'),
}


def export_imucal(source: ExportSource) -> Exported:
    """Return a TurntableCalibrationInfo.

    Raises:
        InputError: Pulses without a sample rate.
    """
    calibration = source.calibration
    imu, model = calibration.imu, calibration.model
    per_second, comment = 1.0, f'{imu.id}, by imu_calib'
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
