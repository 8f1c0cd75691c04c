"""Errors of a table beyond its description: levelling, positioning, axes, zeros and encoders.

A joint nominally turns by R(axis, a): its axis may lean, its zero be off, its encoder err within
the turn and its axis wobble with the angle a. The frame that it turns leans with its axis, which
has the described direction there. Errors are small: attitudes follow them to first order.

Source: docs/mathematics.md, "The table's own errors".
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..common.budget import Share
from ..common.config import Section
from ..common.errors import InputError
from ..common.keys import key
from ..common.rotations import across
from ..common.stream import Floats, Units
from ..common.units import ARCSEC, DEG, Dimension
from ..model.parameters import Parameter, ParameterKind
from ..model.sensors import PRODUCTS, SensorModel

LEVELLED = 20 * ARCSEC
"""Standard deviation of a table's tilt about either axis: a tenth of a millimetre on a metre, five
divisions of a machinist's level of 0.02 mm/m."""

FINEST = 1 * ARCSEC
"""Least standard deviation assumed for any error of a table.

Makers of the best tables, on rotary air bearings, state a wobble below 1 arcsec
(physikinstrumente.com, "Air Bearing Technology"), and for axes on custom-built air bearings right
angles within 2 arcsec (Dover Motion, "Motion Control Handbook", linear positioning accuracy), as a
uniform law 1.2. Autocollimators and polygons, by which tables are measured, are not better (a
judgement).
"""

_WORST = 1 * DEG
"""Largest error: beyond it the description is wrong, since angles follow errors to first order."""


def read_deviation(section: Section, name: str, *, above: float = -math.inf) -> float:
    """Read the standard deviation of an error of a table: 0, or more than `above`, to 1 deg."""
    size = section.quantity(name, Dimension.ANGLE)
    if not 0 <= size <= _WORST or not size > above:
        lowest = '0' if above < 0 else f'more than {above:g}'
        raise InputError(
            f'{section.key(name)}: found {size / DEG:g} deg, expected {lowest} to '
            f'{_WORST / DEG:g} deg.'
        )
    return size


# The defaults in files are the standard deviations of a good laboratory table, assumed where a
# table's file states none.
#
# For units of navigation grade Ruyang Precision, a manufacturer of such tables, requires
# positions within 10 arcsec and axes perpendicular within 5 arcsec ("Standard process for IMU
# two-dimensional calibration using a dual axis turntable", ruya-t.com). As limits of a uniform
# law (GUM 4.3.7) these are 5.8 and 2.9 arcsec. The 5.8 are shared among positioning errors, the
# encoder's two harmonics and those of the wobble: the root of 2^2 + 2 x 3^2 + 2 x 2^2 is 5.5.
#
# A zero is an angle between two joints. Without an autocollimator it is set with the level used
# for levelling the table: on the plate, against gravity, with the axis before vertical to 20
# arcsec. The root of 20^2 + 20^2 is 28, rounded up. With the 20 arcsec of one levelling, 4 of 60
# sessions on zeros off by 60 were wrong by up to 6.5 deviations ("zeros 60 arcsec" of
# docs/imperfect_stands.py); only the frame depends on a zero.
#
# Right angles are assumed to be less accurate, by a mechanic's square and dial gauge: 0.05 mm on
# 200 mm, 52 arcsec, and 30 as a uniform law (a judgement). Each session estimates the errors of
# the axes that its moves determine.


def error_key(meaning: str, assumed: str, value: float = 0.0, **bounds: Any) -> Any:
    """Return a field for the standard deviation of an error, and what is assumed without it."""
    return key(meaning, read_deviation, default=assumed, value=value, **bounds)


@dataclass(frozen=True)
class TableErrors:
    """Standard deviations of a table's unknown errors, rad; 0 for none."""

    zeros: float = error_key(
        'of the zeros of all joints but the first, whose zero is the azimuth', '30 arcsec'
    )
    orthogonality: float = error_key(
        'of each axis to the one before it, about either direction across', '30 arcsec'
    )
    wobble: float = error_key('of an axis as it turns: once and twice per turn, each', '2 arcsec')
    encoder: float = error_key(
        'of an encoder within the turn: once and twice per turn, each', '3 arcsec'
    )

    @property
    def exact(self) -> bool:
        """Whether there are no unknown errors."""
        return not any((self.zeros, self.orthogonality, self.wobble, self.encoder))


@dataclass(frozen=True, eq=False)
class JointPoses:
    """A joint at n attitudes of a table."""

    axis: Floats  #: (3,) in the frame of the joint before it.
    read: Floats  #: (n,) its encoder readings, rad.
    turned: Floats  #: (n, 3, 3) its rotation.
    body: Floats  #: (n, 3, 3) from body axes to its rotated frame.


def attitude_errors(joints: Sequence[JointPoses], errors: TableErrors) -> Floats:
    """Return the rotation of attitudes about the body axes by one standard deviation of each error.

    Returns:
        (n, 3, e) rad.
    """
    columns: list[Floats] = []
    for k, joint in enumerate(joints):
        inside = np.swapaxes(joint.body, 1, 2)
        # From the frame of the joint before, in which its axis wobbles and leans.
        outside = inside @ np.swapaxes(joint.turned, 1, 2)
        # Cosine and sine share the variance, so that the error itself has the stated size.
        waves = [f(m * joint.read) / math.sqrt(2) for m in (1, 2) for f in (np.cos, np.sin)]
        about = inside @ joint.axis
        if errors.encoder:
            columns += [errors.encoder * wave[:, None] * about for wave in waves]
        if k and errors.zeros:
            columns.append(errors.zeros * about)
        for direction in across(joint.axis):
            if errors.wobble:
                columns += [errors.wobble * wave[:, None] * (outside @ direction) for wave in waves]
            if k and errors.orthogonality:
                columns.append(errors.orthogonality * outside @ direction)
    return np.stack(columns, axis=2) if columns else np.zeros((len(joints[0].read), 3, 0))


# Effect of the table clock's error on the parameters of a calibration.
#
# A table's clock runs fast or slow against the second by some ppm, which a session does not show:
# the rates that it states and the intervals between samples are all by that clock.


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
    """Return the contribution of the table clock's relative uncertainty to a covariance."""
    slope = clock_slope(model, parameters, units) * deviation
    return Share.known(np.outer(slope, slope))
