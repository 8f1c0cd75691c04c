"""Values of the core as messages."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..calibration import Calibration
from ..imu import ImuSpec
from ..middleware import messages
from ..model import G_SENSITIVITIES, PARAMETER_NAMES
from ..stream import Units

_UNITS = {
    Units.PULSES: messages.ImuCalibration.UNIT_PULSES,
    Units.COUNTS: messages.ImuCalibration.UNIT_COUNTS,
    Units.SI: messages.ImuCalibration.UNIT_SI,
}


def calibration_message(calibration: Calibration, status: int, frame_id: str, stamp: Any) -> Any:
    """Return imu_calib_msgs/ImuCalibration.

    Args:
        calibration: The result.
        status: VALID or PROVISIONAL.
        frame_id: The IMU's frame.
        stamp: builtin_interfaces/Time of now.

    """
    text = ' '.join(calibration.findings)
    message = _empty(calibration.imu, status, text, frame_id, stamp)
    where = calibration.provenance
    message.plan = str(where['plan'])
    message.method = str(where['method'])
    message.gravity = float(where['gravity'])
    message.latitude = math.radians(float(where['latitude_deg']))
    # What was not estimated has no deviation, and is no number.
    known = np.isfinite(calibration.std[: len(PARAMETER_NAMES)])
    vector = np.where(known, calibration.model.vector(), math.nan)
    for name, value in zip(PARAMETER_NAMES, vector.tolist(), strict=True):
        setattr(message, name.lower(), value)
    message.parameter_names = [parameter.name for parameter in calibration.parameters]
    message.standard_deviations = calibration.std.tolist()
    message.covariance = calibration.covariance.ravel().tolist()
    sensitivity = calibration.model.g_sensitivity
    message.has_g_sensitivity = set(G_SENSITIVITIES) <= set(calibration.parameters)
    message.g_sensitivity = sensitivity.ravel().tolist()
    skewed = calibration.model.skewed
    if skewed is not None:
        message.has_skew = True
        message.skew_response = skewed.response[0].tolist()
        message.skew_bias = float(skewed.bias[0])
    message.segments = int(where['segments']) + int(where['turns'])
    message.samples = int(where['samples'])
    residuals = np.array(where['residual_rms'], dtype=float)
    message.residual_rms_gyro, message.residual_rms_accel = (
        float(np.sqrt(np.mean(part**2))) for part in (residuals[:3], residuals[3:])
    )
    message.condition_number = float(where['condition_number'])
    return message


def refusal_message(imu: ImuSpec, plan: str, text: str, frame_id: str, stamp: Any) -> Any:
    """Return imu_calib_msgs/ImuCalibration that holds no number, and says why."""
    message = _empty(imu, messages.ImuCalibration.REFUSED, text, frame_id, stamp)
    message.plan = plan
    for name in PARAMETER_NAMES:
        setattr(message, name.lower(), math.nan)
    return message


def _empty(imu: ImuSpec, status: int, text: str, frame_id: str, stamp: Any) -> Any:
    message = messages.ImuCalibration()
    message.header.stamp = stamp
    message.header.frame_id = frame_id
    message.imu_id = imu.id
    message.status = status
    message.status_text = text
    message.units = _UNITS[imu.units]
    message.gyro_scale_factor = float(imu.gyro.scale_factor)
    message.accel_scale_factor = float(imu.accel.scale_factor)
    message.reference_temperature = math.nan
    return message
