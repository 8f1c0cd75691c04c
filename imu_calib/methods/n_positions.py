"""n known positions by least squares, with g-sensitivity: 33 parameters (Luo 2018, section 6).

After the rate test n attitudes at rest: bias and g-sensitivity of the gyros by eqs. (2-184) to
(2-186), bias and responses of the accelerometers by (2-187) to (2-189). North must be known.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..errors import NotObservable
from ..model import G_SENSITIVITIES
from ..plan import Plan
from ..stream import Floats
from .evidence import Evidence
from .gains import BIAS, Gains, biases, inverse, once, rate_test, responses
from .solution import Solution


def solve(evidence: Evidence) -> Solution:
    """Estimate the 33 parameters.

    Raises:
        NotObservable: North is unknown, or turns or positions do not tell parameters apart.

    """
    if evidence.azimuth is None:
        raise NotObservable(
            'Positions by least squares need north: give the azimuth of the table (in its YAML, or '
            f'with --azimuth). {biases("g")} and the g-sensitivities cannot be determined.'
        )
    turned, _ = rate_test(evidence)
    fitted, condition = force_weights(
        evidence.attitudes()[:, 2], once(evidence), _positions(evidence), with_g=True
    )
    g = evidence.site.gravity
    rates = evidence.attitudes().transpose(0, 2, 1) @ evidence.site.earth_rate
    at_rest = np.vstack([np.zeros_like(fitted[1:]), fitted[:1], fitted[1:] / g])
    # n_g - (I + M_g) w: the rate test has its share in whatever is fitted to that.
    gyro = np.hstack([at_rest, -(at_rest @ rates) @ turned])
    gyro[:BIAS, len(rates) :] = turned
    accel = np.vstack([fitted[1:] / g, fitted[:1]])
    return Gains(gyro, accel, condition).conclude(evidence, north_known=True)


def check(plan: Plan) -> None:
    """Refuse a plan that cannot tell the 33 parameters apart, before it is run.

    Raises:
        NotObservable: Names the parameters.

    """
    check_positions(plan, with_g=True)
    check_turns(plan)


def check_positions(plan: Plan, *, with_g: bool) -> None:
    """Refuse a plan whose positions cannot tell the parameters apart.

    Args:
        plan: To be run.
        with_g: Whether the g-sensitivities are parameters too.

    Raises:
        NotObservable: Names the parameters.

    """
    held = [p for p in plan.positions if p.dwell > 0]
    ups = np.array([p.up for p in held]).reshape(-1, 3)
    what = f'The {len(held)} positions of plan {plan.name}'
    force_weights(ups, np.ones(len(held)), what, with_g=with_g)


def check_turns(plan: Plan) -> None:
    """Refuse a plan that does not turn about each axis.

    Raises:
        NotObservable: Names the parameters.

    """
    turned = [np.abs(p.up) for p in plan.positions if p.rate_test is not None]
    for axis, name in enumerate('XYZ'):
        if not any(up[axis] > 1 - 1e-6 for up in turned):
            raise NotObservable(
                f'Plan {plan.name} has no rate test about {name}: {responses("g", axis)} cannot be '
                'determined.'
            )


def force_weights(ups: Floats, weights: Floats, what: str, *, with_g: bool) -> tuple[Floats, float]:
    """Fit outputs by a constant and the direction of specific force.

    Args:
        ups: (s, 3) up in body axes.
        weights: (s,) weight of each row.
        what: Where the rows come from, for the message.
        with_g: Whether the gyros are fitted too, for the message.

    Returns:
        (4, s) weights on the outputs that give the constant and, per g, the response to X, Y, Z;
        condition number.

    Raises:
        NotObservable: Names the parameters that the attitudes cannot tell apart.

    Source: Luo 2018, eqs. (2-184) to (2-189), [1 f^T] with f in units of gravity.
    """
    names = _names(with_g=with_g)
    root = np.sqrt(weights)
    design = np.column_stack([np.ones(len(ups)), ups]) * root[:, None]
    gain, condition = inverse(design, names, what)
    return gain * root, condition


def _names(*, with_g: bool) -> Sequence[str]:
    names = [biases('a'), *(responses('a', axis) for axis in range(3))]
    if not with_g:
        return names
    sensitive = [
        ', '.join(p.name for p in G_SENSITIVITIES if p.column == axis) for axis in range(3)
    ]
    own = [biases('g'), *sensitive]
    return [f'{a}, {b}' for a, b in zip(own, names, strict=True)]


def _positions(evidence: Evidence) -> str:
    count = len({s.position for s in evidence.segments})
    missing = evidence.missing()
    lost = f' (missing: {", ".join(missing)})' if missing else ''
    return f'{count} positions{lost}'
