"""What the error of the table's own clock does to the parameters of a calibration.

A table's clock runs fast or slow against the second by some ppm, and nothing in a session shows
it: the rates that it states and the intervals between samples are all by that clock.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .budget import Share
from .model import Parameter, ParameterKind, SensorModel
from .stream import Floats, Units


def clock_slope(model: SensorModel, parameters: Sequence[Parameter], units: Units) -> Floats:
    """Return by how much parameters change with the relative error of the table's clock, (n,).

    With seconds that are (1 + e) too long, pulses per second come out (1 + e) times as many: the
    accelerometers' parameters are of pulses per second, the gyros' responses of pulses per angle.
    Counts and SI values are rates already: the table's rates come out (1 + e) times as large, and
    the gyros' responses 1 / (1 + e) times.

    Source: docs/mathematics.md, 'Uncertainty budget'.
    """
    values = model.values(tuple(parameters))
    one = np.array([p.kind is ParameterKind.SCALE_FACTOR_ERROR for p in parameters])
    gyro = np.array([p.triad == 'g' for p in parameters])
    of_force = np.array(
        [p.kind in {ParameterKind.BIAS, ParameterKind.G_SENSITIVITY} for p in parameters]
    )
    if units is Units.PULSES:
        return np.asarray(np.where(gyro & ~of_force, 0.0, one + values))
    return np.asarray(np.where(gyro & ~of_force, -(one + values), 0.0))


def clock_share(
    model: SensorModel, parameters: Sequence[Parameter], units: Units, deviation: float
) -> Share:
    """Return what the doubt of the table's clock adds to a covariance.

    Args:
        model: The values of the parameters.
        parameters: What the rows stand for.
        units: Of the IMU's numbers.
        deviation: Standard deviation of the clock's rate, relative.

    """
    slope = clock_slope(model, parameters, units) * deviation
    return Share.known(np.outer(slope, slope))
