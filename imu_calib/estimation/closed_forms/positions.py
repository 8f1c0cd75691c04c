"""Positions with one axis vertical: the equations common to twelve and six positions.

Sources: Cao 2022, sections 3.2 and 4, with the corrections of docs/mathematics.md, 'Twelve
positions'.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...common.errors import NotObservable
from ...common.stream import Floats
from ...model.parameters import AXES
from ...model.sensors import SensorModel
from ..conclusion import conclude
from ..evidence import Evidence
from ..solution import Solution
from .linear import Gains
from .methods_linear import BIAS, UNKNOWNS, ChannelSystem, SolvedTriad, solve_triad
from .rate_test import RateTestEquations

_PASSES = 2
"""Rounds: tilts are milliradians, so that each reduces the error to a thousandth."""


@dataclass(frozen=True, eq=False)
class BiasEquation:
    """The gyro biases as weighted means of the outputs at rest.

    Attributes:
        weights: (s, 3) of the static dwells, per channel.
        mean_input: (3,) rad/s, weighted mean of the Earth rate.
    """

    weights: Floats
    mean_input: Floats


def solve_gyros(evidence: Evidence, bias: BiasEquation) -> SolvedTriad:
    """Solve the gyros from the rate test and one equation for the bias.

    Raises:
        NotObservable: An axis without turns.
    """
    test = RateTestEquations.of(evidence)
    solved = _gyros(evidence, test, bias, test.outputs)
    for _ in range(_PASSES):
        outputs = test.outputs - test.off_axis @ solved.triad.response.T
        solved = _gyros(evidence, test, bias, outputs)
    return solved


def _gyros(
    evidence: Evidence, test: RateTestEquations, bias: BiasEquation, turned: Floats
) -> SolvedTriad:
    """Solve for (t, 3) outputs of turns, as if about exactly the vertical axis."""
    at_rest = len(evidence.segments)
    outputs = np.vstack([evidence.outputs()[:, :3], turned])
    systems = [ChannelSystem(len(outputs)) for _ in range(3)]
    for channel, system in enumerate(systems):
        for axis in range(3):
            test.add_to(system, axis, at_rest)
        row = np.zeros(len(outputs))
        row[:at_rest] = bias.weights[:, channel]
        system.add(np.append(bias.mean_input, 1.0), row)
    return solve_triad(systems, outputs)


def solve_accelerometers(evidence: Evidence) -> SolvedTriad:
    """Solve the accelerometers: response and bias from differences and means of up and down.

    delta_ij + M_ij = (n_i(u) - n_i(d)) / (2 g); d_i = mean over the axes of (n_i(u) + n_i(d)) / 2:
    Cao 2022, eqs. (15) to (18).

    Raises:
        NotObservable: An axis that was never up, or never down.
    """
    outputs = evidence.outputs()[:, 3:]
    off_axis = evidence.site.gravity * evidence.off_axis()
    solved = _accelerometers(evidence, outputs)
    for _ in range(_PASSES):
        solved = _accelerometers(evidence, outputs - off_axis @ solved.triad.response.T)
    return solved


def _accelerometers(evidence: Evidence, outputs: Floats) -> SolvedTriad:
    """Solve for (s, 3) outputs, as if the vertical axis stood exactly so."""
    up_weights, down_weights = _up_and_down(evidence)
    systems = [ChannelSystem(len(outputs)) for _ in range(3)]
    for channel, system in enumerate(systems):
        up, down = up_weights[:, :, channel], down_weights[:, :, channel]
        for axis in range(3):
            coefficients = np.zeros(UNKNOWNS)
            coefficients[axis] = 2 * evidence.site.gravity
            system.add(coefficients, up[axis] - down[axis])
        coefficients = np.zeros(UNKNOWNS)
        coefficients[BIAS] = 1.0
        system.add(coefficients, (up + down).sum(axis=0) / 6)
    return solve_triad(systems, outputs)


def _up_and_down(evidence: Evidence) -> tuple[Floats, Floats]:
    """Weights that average an axis's up and down positions, each (3, s, 6 - 3)."""
    axes = evidence.vertical_axes()
    shares = evidence.position_weights()[:, 3:]
    names = [s.position for s in evidence.segments]
    result = []
    for sign, word in ((1, 'up'), (-1, 'down')):
        weights = np.zeros((3, len(names), 3))
        for axis in range(3):
            mine = [k for k, found in enumerate(axes) if found == (axis, sign)]
            positions = {names[k] for k in mine}
            if not positions:
                raise NotObservable(
                    f'No position with {AXES[axis].upper()} {word} was found'
                    f'{evidence.missing_words()}: K_a{AXES[axis]} and the responses of the '
                    f'accelerometers to {AXES[axis].upper()} cannot be determined.'
                )
            weights[axis, mine] = shares[mine] / len(positions)
        result.append(weights)
    return result[0], result[1]


def finish(
    evidence: Evidence, gyros: SolvedTriad, *, findings: Sequence[str] = (), north_known: bool
) -> Solution:
    """Solve the accelerometers too, and check both triads against the data.

    Raises:
        NotObservable: An axis that was never up or down, or data that contradicts the estimate.
    """
    accels = solve_accelerometers(evidence)
    model = SensorModel(gyros.triad, accels.triad)
    gains = Gains(gyros.gain, accels.gain, max(gyros.condition, accels.condition))
    return conclude(
        evidence,
        model,
        gains.shares(evidence, model),
        gains.condition,
        gain=gains.derivatives(evidence),
        findings=findings,
        north_known=north_known,
        accelerometers=lambda other: solve_accelerometers(other).triad,
    )
