"""n known positions by least squares, with g-sensitivity: 33 parameters (Luo 2018, section 6).

After the rate test n attitudes at rest: bias and g-sensitivity of the gyros by eqs. (2-184) to
(2-186), bias and responses of the accelerometers by (2-187) to (2-189). North must be known.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...common.errors import NotObservable
from ...common.stream import Floats
from ...model.parameters import Parameter
from ...model.sensors import parameters_of
from ...model.terms import G_SENSITIVITIES, G_SENSITIVITY
from ...session.plan import Plan
from ..evidence import Evidence
from ..solution import Solution
from .linear import Gains, bias_names, inverse, position_weights, rate_test_weights, response_names
from .methods_linear import BIAS

N_POSITIONS_ESTIMATES = parameters_of([G_SENSITIVITY])


def solve_n_positions(evidence: Evidence) -> Solution:
    """Estimate the 33 parameters.

    Raises:
        NotObservable: North is unknown, or turns or positions do not separate parameters.
    """
    if evidence.azimuth is None:
        raise NotObservable(
            'Positions by least squares need north: give the azimuth of the table (in its YAML, or '
            f'with `azimuth`). {bias_names("g")} and the g-sensitivities cannot be determined.'
        )
    turned, _ = rate_test_weights(evidence)
    fitted, condition = force_weights(
        evidence.attitudes()[:, 2],
        position_weights(evidence),
        evidence.positions_in_words(),
        N_POSITIONS_ESTIMATES,
    )
    g = evidence.site.gravity
    rates = evidence.attitudes().transpose(0, 2, 1) @ evidence.site.earth_rate
    at_rest = np.vstack([np.zeros_like(fitted[1:]), fitted[:1], fitted[1:] / g])
    # n_g - (I + M_g) w: the rate test enters all that is fitted to it.
    gyro = np.hstack([at_rest, -(at_rest @ rates) @ turned])
    gyro[:BIAS, len(rates) :] = turned
    accel = np.vstack([fitted[1:] / g, fitted[:1]])
    return Gains(gyro, accel, condition).conclude(evidence, north_known=True)


def check_positions(plan: Plan, parameters: tuple[Parameter, ...] = N_POSITIONS_ESTIMATES) -> None:
    """Raise if a plan does not separate the parameters of its method, before it is run.

    Raises:
        NotObservable: Names the parameters.
    """
    held = [p for p in plan.positions if p.dwell > 0]
    ups = np.array([p.up for p in held]).reshape(-1, 3)
    what = f'The {len(held)} positions of plan {plan.name}'
    force_weights(ups, np.ones(len(held)), what, parameters)
    check_turns(plan)


def check_turns(plan: Plan) -> None:
    """Raise if a plan does not turn about each axis.

    Raises:
        NotObservable: Names the parameters.
    """
    turned = [np.abs(p.up) for p in plan.positions if p.rate_test is not None]
    for axis, name in enumerate('XYZ'):
        if not any(up[axis] > 1 - 1e-6 for up in turned):
            raise NotObservable(
                f'Plan {plan.name} has no rate test about {name}: {response_names("g", axis)} '
                'cannot be determined.'
            )


def force_weights(
    ups: Floats, weights: Floats, what: str, parameters: tuple[Parameter, ...]
) -> tuple[Floats, float]:
    """Fit outputs by a constant and the direction of specific force.

    Args:
        ups: (s, 3) up in body axes.
        weights: (s,) weight of each row.
        what: Source of the rows, for the message.
        parameters: Those that depend on them, for the message.

    Returns:
        (4, s) weights on the outputs that give the constant and, per g, the response to X, Y, Z;
        condition number.

    Raises:
        NotObservable: Names the parameters that the attitudes do not separate.

    Source: Luo 2018, eqs. (2-184) to (2-189), [1 f^T] with f in units of gravity.
    """
    names = _names(parameters)
    root = np.sqrt(weights)
    design = np.column_stack([np.ones(len(ups)), ups]) * root[:, None]
    gain, condition = inverse(design, names, what)
    return gain * root, condition


def _names(parameters: tuple[Parameter, ...]) -> Sequence[str]:
    names = [bias_names('a'), *(response_names('a', axis) for axis in range(3))]
    sensitive = [p for p in parameters if p in G_SENSITIVITIES]
    if not sensitive:
        return names
    own = [', '.join(p.name for p in sensitive if p.column == axis) for axis in range(3)]
    return [f'{a}, {b}' for a, b in zip([bias_names('g'), *own], names, strict=True)]
