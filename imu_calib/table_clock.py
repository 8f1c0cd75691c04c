"""What the error of the table's own clock does to the parameters of a calibration.

A table's clock runs fast or slow against the second by some ppm, and nothing in a session shows
it: the rates that it states and the intervals between samples are all by that clock.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .budget import Share
from .model import PRODUCTS, Parameter, ParameterKind, SensorModel
from .stream import Floats, Units


def clock_slope(model: SensorModel, parameters: Sequence[Parameter], units: Units) -> Floats:
    """Return by how much parameters change with the relative error of the table's clock, (n,).

    Where the table counts 1 / (1 + e) of the seconds that pass, its rates are (1 + e) times as
    large, and so are pulses per second; counts and SI values are what they are. The factor of a
    product of p rates comes out (1 + e)^(1 - p) times for pulses, else (1 + e)^-p times: pulses
    per angle know no clock, and accelerations in counts neither.

    Source: docs/mathematics.md, 'Uncertainty budget'.
    """
    one = np.array([p.kind is ParameterKind.SCALE_FACTOR_ERROR for p in parameters])
    rates = np.array([PRODUCTS[p].degree_in_rate for p in parameters])
    degree = (1 if units is Units.PULSES else 0) - rates
    # Before a session a skewed gyro is unknown: its values are NaN, and count as zero.
    return np.asarray(degree * (one + np.nan_to_num(model.values(parameters))))


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
