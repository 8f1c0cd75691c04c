"""Positions with one axis vertical: the equations that twelve and six positions share.

Sources: Cao 2022, sections 3.2 and 4, with the corrections of methods.md, sections 3 and 4.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ..errors import NotObservable
from ..model import AXES, PARAMETERS, ParameterKind, SensorModel, Triad
from ..stream import Floats
from .evidence import Evidence
from .linear import BIAS, UNKNOWNS, ChannelSystem, solve_triad
from .rate_test import RateTest

_PASSES = 2


@dataclass(frozen=True, eq=False)
class BiasEquation:
    """The gyro biases as weighted means of the outputs at rest.

    Attributes:
        weights: (s, 3) of the stretches at rest, per channel.
        mean_input: (3,) rad/s that these weights leave.
        unknown: (3,) variance of what they leave and nobody knows, (rad/s)^2.

    """

    weights: Floats
    mean_input: Floats
    unknown: Floats = field(default_factory=lambda: np.zeros(3))


def solve_gyros(evidence: Evidence, bias: BiasEquation) -> tuple[Triad, Floats, float]:
    """Solve the gyros from the rate test and one equation for the bias.

    Args:
        evidence: The session.
        bias: The equation for the biases.

    Returns:
        Triad, its (12, 12) covariance, condition number.

    Raises:
        NotObservable: An axis about which nothing turned.

    """
    test = RateTest.of(evidence)
    triad, covariance, condition = _gyros(evidence, test, bias, test.outputs)
    for _ in range(_PASSES):
        test = RateTest.of(evidence, triad.response)
        outputs = test.outputs - test.off_axis @ triad.response.T
        triad, covariance, condition = _gyros(evidence, test, bias, outputs)
    # All three scale factors share the error of the clocks' rate.
    covariance[:3, :3] += evidence.clock_rate()[1] ** 2
    return triad, covariance, condition


def _gyros(
    evidence: Evidence, test: RateTest, bias: BiasEquation, turned: Floats
) -> tuple[Triad, Floats, float]:
    """Solve for (t, 3) outputs of the turns as if the vertical axis alone had turned."""
    at_rest = len(evidence.segments)
    # The last output is what the bias equation does not know: zero, but for its variance.
    outputs = np.vstack([evidence.outputs()[:, :3], turned, np.zeros(3)])
    variances = np.vstack([evidence.variances()[:, :3], test.variances, bias.unknown])
    systems = [ChannelSystem(len(outputs)) for _ in range(3)]
    for channel, system in enumerate(systems):
        for axis in range(3):
            test.add_to(system, axis, at_rest)
        row = np.zeros(len(outputs))
        row[:at_rest], row[-1] = bias.weights[:, channel], 1.0
        system.add(np.append(bias.mean_input, 1.0), row)
    return solve_triad(systems, outputs, variances)


def solve_accelerometers(evidence: Evidence) -> tuple[Triad, Floats, float]:
    """Solve the accelerometers: half the difference of up and down is the response, the mean bias.

    delta_ij + M_ij = (n_i(u) - n_i(d)) / (2 g); d_i = mean over the axes of (n_i(u) + n_i(d)) / 2:
    Cao 2022, eqs. (15) to (18).

    Returns:
        Triad, its (12, 12) covariance, condition number.

    Raises:
        NotObservable: An axis that was never up, or never down.

    """
    outputs = evidence.outputs()[:, 3:]
    off_axis = evidence.site.gravity * evidence.off_axis()
    triad, covariance, condition = _accelerometers(evidence, outputs)
    for _ in range(_PASSES):
        corrected = outputs - off_axis @ triad.response.T
        triad, covariance, condition = _accelerometers(evidence, corrected)
    return triad, covariance, condition


def accelerometers(evidence: Evidence) -> Triad:
    """Return the accelerometers of `solve_accelerometers` alone."""
    return solve_accelerometers(evidence)[0]


def _accelerometers(evidence: Evidence, outputs: Floats) -> tuple[Triad, Floats, float]:
    """Solve for (s, 3) outputs as if the vertical axis stood exactly so."""
    up_weights, down_weights = _up_and_down(evidence)
    variances = evidence.variances()[:, 3:]
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
    return solve_triad(systems, outputs, variances)


def _up_and_down(evidence: Evidence) -> tuple[Floats, Floats]:
    """Weights that average an axis's up and down positions, each (3, s, 6 - 3)."""
    axes = evidence.vertical_axes()
    shares = evidence.shares()[:, 3:]
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
                    f'{_missing_words(evidence)}: K_a{AXES[axis]} and the responses of the '
                    f'accelerometers to {AXES[axis].upper()} cannot be determined.'
                )
            weights[axis, mine] = shares[mine] / len(positions)
        result.append(weights)
    return result[0], result[1]


def _missing_words(evidence: Evidence) -> str:
    missing = evidence.missing()
    return f' (missing: {", ".join(missing)})' if missing else ''


def assemble(
    evidence: Evidence, gyros: tuple[Triad, Floats, float], accels: tuple[Triad, Floats, float]
) -> tuple[SensorModel, Floats, float]:
    """Join the two triads: model, (24, 24) covariance, condition number."""
    covariance = np.zeros((24, 24))
    covariance[:12, :12], covariance[12:, 12:] = gyros[1], accels[1]
    covariance[np.diag_indices(24)] += _arrival_variances(evidence)
    return SensorModel(gyros[0], accels[0]), covariance, max(gyros[2], accels[2])


def _arrival_variances(evidence: Evidence) -> Floats:
    """Return the variances (24,) that the table's stated positioning error adds.

    While an axis stays vertical the other joints do not move: the error of their arrival is one and
    the same for all positions of that axis up, and for its turns. It goes whole into the gyros'
    misalignments, by half the difference of up and down into the accelerometers', and into their
    biases from the four of six such arrivals in which a channel lies level.
    """
    square = evidence.positioning**2
    misalignment = [p.kind is ParameterKind.MISALIGNMENT for p in PARAMETERS]
    bias = [p.kind is ParameterKind.BIAS for p in PARAMETERS]
    gyro = np.arange(24) < 12
    result = np.zeros(24)
    result[misalignment & gyro] = square
    result[misalignment & ~gyro] = square / 2
    result[bias & ~gyro] = 4 / 36 * square * evidence.site.gravity**2
    return result
