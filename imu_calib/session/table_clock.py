"""Effect of the table clock's error on the parameters of a calibration.

A table's clock runs fast or slow against the second by some ppm, which a session does not show: the
rates that it states and the intervals between samples are all by that clock.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..common.budget import Share
from ..common.stream import Floats, Units
from ..model.parameters import Parameter, ParameterKind
from ..model.sensors import PRODUCTS, SensorModel


def clock_slope(model: SensorModel, parameters: Sequence[Parameter], units: Units) -> Floats:
    """Return the derivatives of parameters by the relative error of the table's clock, (n,).

    If the table counts 1 / (1 + e) of the true seconds, its rates are (1 + e) times as large, and
    so are pulses per second; counts and SI values do not change. The factor of a product of p rates
    is multiplied by (1 + e)^(1 - p) for pulses, else by (1 + e)^-p: pulses per angle do not depend
    on a clock, and neither do accelerations in counts.

    Source: docs/mathematics.md, 'Uncertainty budget'.
    """
    one = np.array([p.kind is ParameterKind.SCALE_FACTOR_ERROR for p in parameters])
    rates = np.array([PRODUCTS[p].degree_in_rate for p in parameters])
    degree = (1 if units.per_interval else 0) - rates
    # Before a session a skewed gyro is unknown: its values are NaN, and count as zero.
    return np.asarray(degree * (one + np.nan_to_num(model.values(parameters))))


def clock_share(
    model: SensorModel, parameters: Sequence[Parameter], units: Units, deviation: float
) -> Share:
    """Return the contribution of the table clock's uncertainty to a covariance.

    Args:
        model: The values of the parameters.
        parameters: The parameters of the rows.
        units: Of the IMU's numbers.
        deviation: Standard deviation of the clock's rate, relative.
    """
    slope = clock_slope(model, parameters, units) * deviation
    return Share.known(np.outer(slope, slope))
