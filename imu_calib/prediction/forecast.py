"""The standard deviations that a session would reach: by the plan's method, and by the best.

A method is asked with outputs that hit their expectation and the covariance that a session would
give them. What wanders goes through the derivatives of its parameters by its outputs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ..calibrator import Setup
from ..errors import NotObservable
from ..methods import free, method
from ..methods.equations import G_SENSITIVITIES, SENSORS, Equations
from ..methods.evidence import Evidence
from ..methods.free.ahead import deviations
from ..methods.information import Information, told
from ..methods.solution import Solution
from ..model import PARAMETERS, Parameter, SensorModel, extended_parameters
from ..stream import Floats
from .expected import expected, wandering

JOINT = {'joint': False, 'joint_33': True}
"""The methods that reach what the Fisher information allows, and whether with g-sensitivity."""

_STEP = 0.1
"""Of an output, in its standard deviations: small against all, large against rounding."""

BIAS_TIME_CONSTANT = 1000.0
"""Correlation time of a bias that wanders, s, as the simulation has it."""


@dataclass(frozen=True, eq=False)
class Forecast:
    """What a session would reach.

    Attributes:
        evidence: What the session would give.
        method: Name of the method asked.
        parameters: What the method estimates.
        std: (n,) by that method, SI units; NaN for what it leaves alone, or where it cannot be
            asked.
        best: (n,) by the Fisher information; NaN for what the session does not observe.
        refusal: Why the method cannot be asked, else empty.

    """

    evidence: Evidence
    method: str
    parameters: tuple[Parameter, ...]
    std: Floats
    best: Floats
    refusal: str


def forecast(
    setup: Setup,
    truth: SensorModel,
    azimuth: float | None = None,
    *,
    wander: bool = False,
) -> Forecast:
    """Predict the standard deviations of a session.

    Args:
        setup: Plan, method, table, IMU and site.
        truth: What the sensors are thought to be.
        azimuth: True heading of the table's zero, rad; None for what the table says, or north.
        wander: Whether the biases wander by the IMU's bias instability.

    Raises:
        InputError: The table cannot run the plan, the IMU states no noise, or there is no such
            method.

    """
    evidence = expected(setup, truth, azimuth)
    if setup.method_name == free.NAME:
        return _in_the_hand(setup, truth, evidence)
    extra = wandering(evidence, setup.imu, BIAS_TIME_CONSTANT) if wander else None
    name = setup.method_name
    solver = method(name)
    refusal, square = '', np.full(SENSORS, np.nan)
    if name not in JOINT:
        try:
            square = _by_closed_form(evidence, solver, extra)
        except NotObservable as error:
            refusal = str(error)
    with_g = JOINT.get(name, len(square) == SENSORS + G_SENSITIVITIES)
    parameters = extended_parameters(with_g=with_g)
    found = information(evidence, truth, extra=extra, with_g=with_g)
    best = np.sqrt(np.diag(found.covariance)[: len(parameters)])
    best[:SENSORS] = np.where(told(found), best[:SENSORS], np.nan)
    std = best if name in JOINT else np.sqrt(square)
    return Forecast(evidence, name, parameters, std, best, refusal)


def _in_the_hand(setup: Setup, truth: SensorModel, evidence: Evidence) -> Forecast:
    """Ask what holds would tell: the method is the least squares that is the best."""
    model = free.in_frame_of_accelerometers(truth)
    std = deviations(setup.plan.positions, setup.imu, setup.site, model)
    return Forecast(evidence, free.NAME, PARAMETERS, std, std, '')


def information(
    evidence: Evidence,
    truth: SensorModel,
    *,
    extra: Floats | None = None,
    with_g: bool = False,
) -> Information:
    """Return what a session tells at the truth (methods.md, section 11)."""
    equations = Equations(evidence, with_g=with_g, extra=extra)
    return Information.of(equations.whitened(state_at(equations, truth))[0])


def state_at(equations: Equations, truth: SensorModel) -> Floats:
    """Return the state of sensors that are what they are thought to be."""
    state = equations.nominal()
    state[:SENSORS] = truth.vector()
    if equations.with_g:
        state[SENSORS : equations.parameters] = truth.g_sensitivity.ravel()
    return state


def _by_closed_form(
    evidence: Evidence, solver: Callable[[Evidence], Solution], extra: Floats | None
) -> Floats:
    """Return the variances of a method that weighs its outputs once and for all."""
    square = np.asarray(solver(evidence).std ** 2)
    if extra is None:
        return square
    gain = gains(evidence, solver)
    return np.asarray(square + np.einsum('ij,jk,ik->i', gain, extra, gain))


def gains(evidence: Evidence, solver: Callable[[Evidence], Solution]) -> Floats:
    """Return the derivatives of a method's parameters by its outputs, (n, 6 s + 3 t)."""

    def parameters(output: int, step: float) -> Floats:
        solution = solver(_moved(evidence, output, step))
        with_g = len(solution.covariance) == SENSORS + G_SENSITIVITIES
        return solution.model.values(extended_parameters(with_g=with_g))

    steps = _STEP * np.sqrt(Equations(evidence).own_variances)
    columns = [
        (parameters(k, step) - parameters(k, -step)) / (2 * step) for k, step in enumerate(steps)
    ]
    return np.array(columns).T


def _moved(evidence: Evidence, output: int, step: float) -> Evidence:
    """Return the evidence with one of its outputs changed."""
    at_rest = 6 * len(evidence.segments)
    if output < at_rest:
        k, c = divmod(output, 6)
        segment = evidence.segments[k]
        mean = segment.statistics.mean.copy()
        mean[c] += step
        changed = replace(segment, statistics=replace(segment.statistics, mean=mean))
        segments = (*evidence.segments[:k], changed, *evidence.segments[k + 1 :])
        return replace(evidence, segments=segments)
    k, c = divmod(output - at_rest, 3)
    turn = evidence.turns[k]
    mean = turn.statistics.mean.copy()
    mean[c] += step
    turned = replace(turn, statistics=replace(turn.statistics, mean=mean))
    return replace(evidence, turns=(*evidence.turns[:k], turned, *evidence.turns[k + 1 :]))
