"""Compute the angles between the input axes of a unit, which do not depend on the body frame.

Misalignments refer to the body axes, which a table defines with the accuracy of its own axes.
Angles between input axes do not change when the whole unit is rotated.

Source: docs/mathematics.md, 'Free of frame'.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..common.rotations import rotation_vector
from ..common.stream import Floats
from ..common.units import ARCMIN
from .parameters import RESPONSES, Parameter, indices_of
from .sensors import SensorModel, Triad

SHOWN, SCALE = 'arcmin', ARCMIN  #: Unit in which engineers state these angles, as misalignments.

_OF_A_TRIAD = len(RESPONSES) // 2  #: Number of responses of gyros, and of accelerometers.
_PAIRS = ((0, 1), (0, 2), (1, 2))  #: Pairs of axes.
_STEP = 1e-5
"""Step of a response: truncation (third order) and rounding of the central difference are 1e-11."""


@dataclass(frozen=True)
class Group:
    """Three angles of one kind."""

    key: str  #: In calibration.yaml.
    words: str  #: For people.
    names: tuple[str, str, str]  #: Of the angles: pairs of channels, or axes.
    triads: str  #: Triads that must have been estimated.


GROUPS = (
    Group('gyro_nonorthogonality', 'gyros', ('xy', 'xz', 'yz'), 'g'),
    Group('accelerometer_nonorthogonality', 'accelerometers', ('xy', 'xz', 'yz'), 'a'),
    Group('gyro_to_accelerometer', 'gyros to accelerometers', ('X', 'Y', 'Z'), 'ga'),
)


@dataclass(frozen=True, eq=False)
class Angles:
    """The three angles of a group."""

    group: Group  #: The group.
    values: Floats  #: (3,) rad.
    std: Floats  #: (3,) their standard deviations, rad.


def free_of_frame(
    model: SensorModel, covariance: Floats, parameters: Sequence[Parameter]
) -> tuple[Angles, ...]:
    """Return the angles between input axes, of the groups whose triads were estimated.

    Args:
        model: The calibrated unit.
        covariance: (n, n) SI units; NaN for a triad that was not estimated.
        parameters: (n,) of the rows; the 24 are among them.
    """
    mine = indices_of(RESPONSES, parameters)
    square = covariance[np.ix_(mine, mine)]
    estimated = {
        triad
        for triad, own in (('g', slice(_OF_A_TRIAD)), ('a', slice(_OF_A_TRIAD, None)))
        if np.isfinite(np.diag(square)[own]).all()
    }
    at = model.values(RESPONSES)
    steps = _STEP * np.eye(len(at))
    slopes = np.array([_angles(at + h) - _angles(at - h) for h in steps]).T / (2 * _STEP)
    variances = np.diag(slopes @ np.nan_to_num(square) @ slopes.T)
    # If all uncertainty is common to the unit, cancellation may leave rounding below zero.
    std = np.sqrt(np.maximum(variances, 0.0))
    values = _angles(at)
    return tuple(
        Angles(group, values[3 * k : 3 * k + 3], std[3 * k : 3 * k + 3])
        for k, group in enumerate(GROUPS)
        if set(group.triads) <= estimated
    )


def _angles(responses: Floats) -> Floats:
    """Return the nine angles (rad) of (18,) scale-factor errors and misalignments."""
    axes = [_input_axes(part) for part in responses.reshape(2, _OF_A_TRIAD)]
    between = [np.arcsin(own[i] @ own[j]) for own in axes for i, j in _PAIRS]
    gyros, accels = (_orthogonal(own) for own in axes)
    return np.concatenate([between, rotation_vector(accels @ gyros.T)])


def _input_axes(part: Floats) -> Floats:
    """Return the directions of the input axes of a triad as rows (3, 3), body axes."""
    response = Triad.from_vector(np.append(part, np.zeros(3))).response
    return np.asarray(response / np.linalg.norm(response, axis=1, keepdims=True))


def _orthogonal(axes: Floats) -> Floats:
    """Return the orthogonal triad nearest to three axes (rows): their polar factor."""
    left, _, right = np.linalg.svd(axes)
    return np.asarray(left @ right)
