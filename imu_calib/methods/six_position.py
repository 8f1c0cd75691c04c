"""Six positions with a north reference: the baseline of Cao 2022 (methods.md, section 4)."""

from __future__ import annotations

import numpy as np

from ..errors import NotObservable
from ..stream import Floats
from .checks import conclude
from .evidence import UP, Evidence
from .positions import assemble, solve_accelerometers, solve_gyros
from .solution import Solution


def solve(evidence: Evidence) -> Solution:
    """Estimate the 24 parameters; D_i is the mean of n_i - [(I + M_g) w] over the positions.

    Where the session was turned by hand no north is needed: the horizontal Earth rate then counts
    as an unknown of its own size and widens the biases' standard deviations.

    Raises:
        NotObservable: North is unknown, or positions are missing.

    """
    if evidence.azimuth is None and not evidence.plan.by_hand:
        raise NotObservable(
            'Six positions need north: give the azimuth of the table (in its YAML, or with '
            '--azimuth), or run twelve positions. D_gx, D_gy, D_gz cannot be determined.'
        )
    weights, mean_input, uncertain = _bias_equation(evidence)
    gyros, covariance, condition = solve_gyros(evidence, (weights, mean_input))
    covariance[9:12, 9:12] += uncertain
    solved = assemble(evidence, (gyros, covariance, condition), solve_accelerometers(evidence))
    north = evidence.azimuth is not None
    return conclude(evidence, *solved, findings=[], north_known=north)


def _bias_equation(evidence: Evidence) -> tuple[Floats, Floats, Floats]:
    """Return weights (s, 3), the mean input (3,) and the covariance (3, 3) of what is unknown."""
    shares = evidence.shares()[:, :3]
    positions = len({s.position for s in evidence.segments})
    if not positions:
        raise NotObservable('No position of the plan was found: nothing can be determined.')
    weights = shares / positions
    mean = np.einsum('s,sij->ji', weights.mean(axis=1), evidence.attitudes())
    earth = evidence.site.earth_rate
    if evidence.azimuth is None:
        level = mean[:, :2] * evidence.site.north_rate
        return weights, mean @ (UP * earth), level @ level.T / 2
    return weights, mean @ earth, np.zeros((3, 3))
