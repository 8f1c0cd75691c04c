"""Six positions with a north reference: the baseline of Cao 2022.

Source: docs/mathematics.md, 'Twelve positions'.
"""

from __future__ import annotations

import numpy as np

from ...common.errors import NotObservable
from ..evidence import UP, Evidence
from ..solution import Solution
from .positions import BiasEquation, finish, solve_gyros


def solve_six_position(evidence: Evidence) -> Solution:
    """Estimate the 24 parameters; D_i is the mean of n_i - [(I + M_g) w] over the positions.

    Sessions turned by hand need no north: every hold has a separate unknown heading, and the level
    Earth rate widens the biases' standard deviations.

    Raises:
        NotObservable: North is unknown, or positions are missing.
    """
    if evidence.azimuth is None and not evidence.plan.by_hand:
        raise NotObservable(
            'Six positions need north: give the azimuth of the table (in its YAML, or with '
            '`azimuth`), or run twelve positions. D_gx, D_gy, D_gz cannot be determined.'
        )
    gyros = solve_gyros(evidence, _bias_equation(evidence))
    return finish(evidence, gyros, north_known=evidence.azimuth is not None)


def _bias_equation(evidence: Evidence) -> BiasEquation:
    shares = evidence.position_weights()[:, :3]
    positions = len({s.position for s in evidence.segments})
    if not positions:
        raise NotObservable('No position of the plan was found: nothing can be determined.')
    weights = shares / positions
    mean = np.einsum('s,sij->ji', weights.mean(axis=1), evidence.attitudes())
    earth = evidence.site.earth_rate
    if evidence.azimuth is not None:
        return BiasEquation(weights, mean @ earth)
    return BiasEquation(weights, mean @ (UP * earth))
