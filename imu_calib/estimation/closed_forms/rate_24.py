"""Rate test and 24 positions, north known, 24 parameters (off-axis 2019, section 1.1).

Scale factors and misalignments of the gyros from whole turns; each axis in turn points north and
the unit turns about it in steps of 45 degrees: D_i is the mean of n_i - [(I + M_g) w] over the
positions (eq. 3). The accelerometers, which the document does not treat, by least squares over the
same positions (Luo 2018, eqs. 2-187 to 2-189).
"""

from __future__ import annotations

import numpy as np

from ...common.errors import NotObservable
from ...model.parameters import PARAMETERS
from ..evidence import Evidence
from ..solution import Solution
from .linear import Gains, bias_names, position_weights, rate_test_weights
from .methods_linear import BIAS
from .n_positions import force_weights


def solve_rate_24(evidence: Evidence) -> Solution:
    """Estimate the 24 parameters.

    Raises:
        NotObservable: North is unknown, or turns or positions are missing.
    """
    if evidence.azimuth is None:
        raise NotObservable(
            'Positions held against north need it: give the azimuth of the table (in its YAML, or '
            f'with `azimuth`). {bias_names("g")} cannot be determined.'
        )
    turned, condition = rate_test_weights(evidence)
    count = len({s.position for s in evidence.segments})
    mean = position_weights(evidence) / count
    rates = evidence.attitudes().transpose(0, 2, 1) @ evidence.site.earth_rate
    gyro = np.zeros((BIAS + 1, len(rates) + len(evidence.turns)))
    gyro[:BIAS, len(rates) :] = turned
    gyro[BIAS] = np.concatenate([mean, -(mean @ rates) @ turned])
    ups = evidence.attitudes()[:, 2]
    fitted, spread = force_weights(
        ups, position_weights(evidence), f'{count} positions', PARAMETERS
    )
    accel = np.vstack([fitted[1:] / evidence.site.gravity, fitted[:1]])
    return Gains(gyro, accel, max(condition, spread)).conclude(evidence, north_known=True)
