"""Check whether the parameters of a calibration are plausible for a strapdown IMU."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from ..common.errors import InputError
from ..common.gaussian import is_covariance
from ..common.stream import Floats, Units
from ..common.units import DEG
from ..model.parameters import TRIADS, Parameter, ParameterKind
from ..model.sensors import SensorModel
from .imu import ImuSpec

_SCALE = (0.5, 2.0)
"""Limits of the response along the input axis. A nominal scale factor wrong by a factor of two is
that of another unit, another range or another unit of measure; the worst of the shipped truths,
Cao 2022's Table 1 read literally, is off by 25 %."""
_TILT = 30 * DEG
"""Largest angle between an input axis and its body axis. Beyond it a channel belongs to another
axis; data sheets of MEMS units state up to 2 deg of misalignment."""


class Estimated(Protocol):
    """What is checked of a calibration: its members of these names."""

    @property
    def imu(self) -> ImuSpec: ...  # noqa: D102
    @property
    def model(self) -> SensorModel: ...  # noqa: D102
    @property
    def covariance(self) -> Floats: ...  # noqa: D102
    @property
    def parameters(self) -> tuple[Parameter, ...]: ...  # noqa: D102
    @property
    def values(self) -> Floats: ...  # noqa: D102
    @property
    def has_accelerometers(self) -> bool: ...  # noqa: D102


def is_of_strapdown(response: Floats) -> bool:
    """Return whether the response (3, 3) is plausible: row i the channel, column j the axis."""
    lengths = np.linalg.norm(response, axis=1)
    if not np.all((lengths > _SCALE[0]) & (lengths < _SCALE[1])):
        return False
    return bool(np.all(np.diag(response) / lengths >= np.cos(_TILT)))


def check_plausible(calibration: Estimated, name: str) -> None:
    """Refuse implausible parameters before they are applied.

    Biases of ADC codes are not limited: an ADC may count from any offset.
    """
    _check_scale_factors(calibration, name)
    for parameter, value in zip(calibration.parameters, calibration.values.tolist(), strict=True):
        if not np.isfinite(value):
            raise InputError(f'{name}: {parameter.name}: found {value}, expected a number.')
    model = calibration.model
    _check_response(model.gyro.response, 'gyro', name)
    _check_response(model.accel.response, 'accelerometer', name)
    if model.skewed is not None:
        _check_lengths(model.skewed.response, 'skewed gyro', name)
    _check_limits(calibration, name)
    _check_covariance(calibration, name)


def _check_scale_factors(calibration: Estimated, name: str) -> None:
    for what, spec in (('gyro', calibration.imu.gyro), ('accelerometer', calibration.imu.accel)):
        if not 0 < spec.scale_factor < np.inf:
            raise InputError(
                f'{name}: {what} scale_factor: found {spec.scale_factor}, expected above 0.'
            )


def _check_response(response: Floats, triad: str, name: str) -> None:
    _check_lengths(response, triad, name)
    along = np.diag(response) / np.linalg.norm(response, axis=1)
    for axis, cosine in zip('XYZ', along, strict=True):
        if cosine < np.cos(_TILT):
            angle = np.arccos(np.clip(cosine, -1, 1)) / DEG
            raise InputError(
                f'{name}: the input axis of {triad} {axis} lies {angle:.0f} deg off its body axis; '
                f'expected less than {_TILT / DEG:.0f} deg. Are channels swapped or mirrored?'
            )


def _check_lengths(response: Floats, what: str, name: str) -> None:
    low, high = _SCALE
    for k, length in enumerate(np.linalg.norm(response, axis=1)):
        if not low < length < high:
            raise InputError(
                f'{name}: {what} {"XYZ"[k]} answers {length:.4g} times its nominal scale factor; '
                f'expected {low:g} to {high:g} times. Is it a calibration of another unit?'
            )


def _check_limits(calibration: Estimated, name: str) -> None:
    """Refuse values beyond the limit of their kind, and biases beyond the range."""
    imu = calibration.imu
    ranges = {'g': imu.gyro.range, 'a': imu.accel.range}
    for parameter, value in zip(calibration.parameters, calibration.values.tolist(), strict=True):
        limit = parameter.unit.limit
        words = parameter.kind.value.words
        if parameter.kind is ParameterKind.BIAS:
            # An ADC may count from any offset.
            limit = (
                None if imu.units is Units.COUNTS else min(limit or np.inf, ranges[parameter.triad])
            )
            words = f'{TRIADS[parameter.triad]} bias'
        if limit is not None and abs(value) > limit:
            raise InputError(
                f'{name}: {words}: found {abs(value):.4g} {parameter.unit.si}, expected at most '
                f'{limit:.4g} {parameter.unit.si} ({parameter.name}).'
            )


def _check_covariance(calibration: Estimated, name: str) -> None:
    """Refuse an invalid covariance: not finite, asymmetric, or not positive semidefinite."""
    if (np.diag(calibration.covariance) < 0).any():
        raise InputError(f'{name}: covariance: found a negative variance.')
    # A triad that was not estimated is NaN, and only the accelerometers may be missing.
    estimated = np.array(
        [p.triad == 'g' or calibration.has_accelerometers for p in calibration.parameters]
    )
    covariance = calibration.covariance[np.ix_(estimated, estimated)]
    if not np.isfinite(covariance).all():
        raise InputError(f'{name}: covariance: found values that are not numbers.')
    if not is_covariance(covariance):
        raise InputError(
            f'{name}: covariance: not that of any errors (it must be symmetric and positive '
            'semidefinite).'
        )
