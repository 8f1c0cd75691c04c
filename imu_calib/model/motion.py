"""Motion terms: the size effect (places of the accelerometers) and their delay.

Accelerometer i is at r_i and measures, beyond the specific force f at the point where r_i is zero,

    a_i = ([dw/dt] + [w][w]) r_i,      n_i(t) = [(I + M) (f + a_i)]_i (t - T) + d_i

A common shift of all three places is equivalent to another choice of that point. So the component
of r_i along axis i is zero, and six remain.

Source: Hung, Hunter, Stripling and White 1979, Size effect on navigation using a strapdown IMU, US
Army T-79-73; IEEE Std 1559 (the words); docs/mathematics.md, 'Terms of motion'.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ..common.stream import Floats
from .model_parameters import Parameter
from .parameters import ParameterKind
from .sensors import SensorModel
from .terms import DELAY, SIZE_EFFECT, Term

OF_MOTION = frozenset({ParameterKind.PLACE, ParameterKind.DELAY})
"""Kinds of parameters that neither static dwells nor whole turns determine."""


MOTION = (*SIZE_EFFECT.parameters, *DELAY.parameters)
"""The seven parameters."""


def motion_parameters(parameters: Iterable[Parameter]) -> tuple[Parameter, ...]:
    """Return the parameters of motion terms."""
    return tuple(p for p in parameters if p.kind in OF_MOTION)


def has_motion_terms(terms: Iterable[Term]) -> bool:
    """Return whether any of the terms is a motion term."""
    return any(term.kind in OF_MOTION for term in terms)


def places(model: SensorModel) -> Floats:
    """Return the places of the accelerometers, (3, 3) m: row i is r_i."""
    found = np.zeros((3, 3))
    values = model.values(SIZE_EFFECT.parameters)
    for parameter, value in zip(SIZE_EFFECT.parameters, values, strict=True):
        found[parameter.row, parameter.column] = value
    return found


def delay(model: SensorModel) -> float:
    """Return the delay of the accelerometers after the gyros, s."""
    return float(model.values(DELAY.parameters)[0])


def slopes(model: SensorModel, rate: Floats, spin: Floats, change: Floats) -> Floats:
    """Return the derivatives of the measured specific force by places and delay.

    To first order in the delay. Every sum has a fixed order: a sample has the same bits alone as
    among others.

    Args:
        model: The sensors.
        rate: (n, 3) rad/s.
        spin: (n, 3) angular acceleration, rad/s^2.
        change: (n, 3) rate of change of the specific force, m/s^3.

    Returns:
        (n, 3, 7) m/s^2, in the order of the terms' parameters (`MOTION`).
    """
    x, y, z = spin.T
    nothing = np.zeros_like(x)
    lever = np.stack([nothing, -z, y, z, nothing, -x, -y, x, nothing], axis=-1).reshape(-1, 3, 3)
    lever += rate[:, :, None] * rate[:, None, :]
    lever[:, range(3), range(3)] -= (rate**2).sum(axis=1)[:, None]
    response = model.accel.response
    answer = np.linalg.inv(response)
    columns = []
    for parameter in SIZE_EFFECT.parameters:
        row = (lever[:, :, parameter.column] * response[parameter.row]).sum(axis=1)
        columns.append(row[:, None] * answer[:, parameter.row])
    return np.stack([*columns, -change], axis=-1)
