"""Six positions at rest, gyros only: the Earth rate is the input (off-axis 2019, section 1.2).

Three responses and a bias per channel by least squares over known attitudes. Any arrangement is
valid whose matrix [w / omega_ie, 1] is well conditioned at the latitude of the site.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...common.budget import total
from ...common.errors import NotObservable
from ...common.stream import Floats
from ...model.earth import EARTH_RATE, Site
from ...model.parameters import PARAMETERS, ParameterKind
from ...session.plan import Plan
from ..evidence import Evidence
from ..solution import Solution
from .linear import Gains, bias_names, inverse, position_weights, response_names
from .methods_linear import BIAS

GYRO_ESTIMATES = tuple(p for p in PARAMETERS if p.triad == 'g')

_MEANINGLESS = 0.1
"""Standard deviation of a ratio from which on it is not worth stating. A judgement: data sheets
know it better."""


def solve_static_six(evidence: Evidence) -> Solution:
    """Estimate the 12 parameters of the gyros; the accelerometers are not estimated.

    Raises:
        NotObservable: North is unknown, the attitudes do not separate parameters, or the Earth is
            too slow for the noise.
    """
    require_north(evidence)
    weights, condition = _static_weights(
        evidence.attitudes(),
        evidence.site,
        position_weights(evidence),
        evidence.positions_in_words(),
    )
    gyro = np.vstack([weights[:BIAS] / EARTH_RATE, weights[BIAS:]])
    return gyros_only(evidence, gyro, condition)


def check_static_six(plan: Plan, site: Site) -> None:
    """Raise if a plan does not separate the parameters at a site, before it is run.

    Raises:
        NotObservable: Names the parameters.
    """
    held = [p for p in plan.positions if p.dwell > 0]
    attitudes = np.array([p.attitude for p in held]).reshape(-1, 3, 3)
    what = f'The {len(held)} positions of plan {plan.name}'
    _static_weights(attitudes, site, np.ones(len(held)), what)


def require_north(evidence: Evidence) -> None:
    """Raise if the north of a session is unknown.

    Raises:
        NotObservable: Names the parameters that cannot be determined.
    """
    if evidence.azimuth is None:
        lost = ', '.join(response_names('g', axis) for axis in range(3))
        raise NotObservable(
            'Where Earth rate is the input, north must be known: give the azimuth of the table (in '
            f'its YAML, or with `azimuth`). {lost}, {bias_names("g")} cannot be determined.'
        )


def gyros_only(evidence: Evidence, gyro: Floats, condition: float) -> Solution:
    """Estimate the gyros with (4, s) weights on the static dwells.

    Raises:
        NotObservable: A response has a relative uncertainty above a tenth.
    """
    at_rest = replace(evidence, turns=())
    gains = Gains(gyro, None, condition)
    deviations = np.sqrt(np.diag(total(gains.shares(at_rest, gains.model(at_rest)))))
    poor = [
        f'{p.name} ({d:.2g})'
        for p, d in zip(PARAMETERS, deviations, strict=True)
        if p.kind is not ParameterKind.BIAS and d > _MEANINGLESS
    ]
    if poor:
        raise NotObservable(
            'The Earth turns too slowly for the noise of these gyros and these dwells: known no '
            f'better than to a tenth are {", ".join(poor)}.'
        )
    findings = ['The accelerometers were not calibrated: this method knows the gyros alone.']
    return gains.conclude(at_rest, findings=findings, north_known=True)


def _static_weights(
    attitudes: Floats, site: Site, weights: Floats, what: str
) -> tuple[Floats, float]:
    """Return (4, s) weights for responses to omega_ie and bias, and the condition number."""
    rates = attitudes.transpose(0, 2, 1) @ site.earth_rate / EARTH_RATE
    names = [*(response_names('g', axis) for axis in range(3)), bias_names('g')]
    root = np.sqrt(weights)
    design = np.column_stack([rates, np.ones(len(rates))]) * root[:, None]
    gain, condition = inverse(design, names, what)
    return gain * root, condition
