"""Twelve positions without a north reference.

Each axis in turn is vertical, up twice and down twice. Within such a group the horizontal Earth
rate cancels on every gyro for any azimuth, and so does the vertical one: the mean is the bias.

Source: Cao 2022, sections 2 to 4; docs/mathematics.md, 'Twelve positions'.
"""

from __future__ import annotations

import numpy as np

from ...common.errors import NotObservable
from ...common.stream import Floats
from ...model.parameters import AXES
from ..evidence import Evidence
from ..solution import Solution
from .positions import BiasEquation, finish, solve_gyros

_LARGEST_MEAN_INPUT = 3e-3
"""Of the mean input: a complete set cancels to within its positioning errors."""


def solve_twelve_position(evidence: Evidence) -> Solution:
    """Estimate the 24 parameters; the session's azimuth is not used.

    Raises:
        NotObservable: Names what is missing and what cannot be determined without it.
    """
    weights, findings = _bias_weights(evidence)
    gyros = solve_gyros(evidence, BiasEquation(weights, np.zeros(3)))
    return finish(evidence, gyros, findings=findings, north_known=False)


def _bias_weights(evidence: Evidence) -> tuple[Floats, list[str]]:
    """Average the groups in which the Earth rate cancels (eqs. 13 and 14)."""
    axes = [axis for axis, _ in evidence.vertical_axes()]
    names = [s.position for s in evidence.segments]
    shares = evidence.position_weights()[:, :3]
    inputs = np.transpose(evidence.attitudes(), (0, 2, 1))
    rows, incomplete = [], []
    for axis in range(3):
        mine = np.array([k for k, found in enumerate(axes) if found == axis], dtype=int)
        count = len({names[k] for k in mine})
        if not count:
            incomplete.append(axis)
            continue
        weights = np.zeros((len(names), 3))
        weights[mine] = shares[mine] / count
        mean_input = np.einsum('s,sij->ij', weights.mean(axis=1), inputs)
        if np.linalg.norm(mean_input) > _LARGEST_MEAN_INPUT:
            incomplete.append(axis)
        else:
            rows.append(weights)
    named = evidence.missing_words()
    groups = ', '.join(AXES[axis].upper() for axis in incomplete)
    if not rows:
        raise NotObservable(
            'In no group of four positions does the Earth rate cancel'
            f'{named}: D_gx, D_gy, D_gz cannot be determined without north.'
        )
    findings = []
    if incomplete:
        findings.append(
            f'The gyro biases rest on {len(rows)} of 3 groups: in the group of {groups} vertical '
            f'the Earth rate does not cancel{named}.'
        )
    return np.mean(rows, axis=0), findings
