"""The shortest dwells that reach a wanted accuracy.

Between two looks at what a session would give, the variance of a dwell's mean is taken to fall
with its time as a walk does, and what a pulse leaves as the square of it. A parameter's variance
is a sum over the outputs, each by the square of its weight: for weights that are the best ones the
change of the weights themselves counts for nothing, to first order, and those of a closed form do
not change.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from ..calibrator import Setup
from ..errors import InputError, NotObservable
from ..methods import JOINT, method
from ..model import SensorModel
from ..observation.equations import Equations
from ..observation.evidence import Evidence
from ..plan import Plan
from ..stream import Floats
from ..units import PPM
from .forecast import Forecast, forecast, gravity_variances, information, listed, state_at

SHORTEST = 5.0
"""Shortest dwell proposed, s."""

LONGEST = 24 * 3600.0
"""Longest dwell proposed, s."""

_LOOKS = 20
"""Rounds of the iteration; a cap."""
_LONGER = 4.0
"""Factor by which dwells grow where turns leave more than is wanted; a choice."""
_CLOSE = 2e-3
"""Share of a dwell: a second in ten minutes."""
_SLACK = 1.001
"""Of what is wanted: dwells are rounded to seconds."""


@dataclass(frozen=True, eq=False)
class Reached:
    """A plan whose dwells reach what was wanted.

    Attributes:
        plan: The plan with these dwells, its order, attitudes and turns as they were.
        forecast: What it would give.
        wanted: Standard deviations by name of the parameter, SI units.
    """

    plan: Plan
    forecast: Forecast
    wanted: Mapping[str, float]


def reach(
    setup: Setup, truth: SensorModel, wanted: Mapping[str, float], azimuth: float | None = None
) -> Reached:
    """Find the dwells, one for each position, whose sum is least and that reach an accuracy.

    Args:
        setup: Plan, method, table, IMU and site.
        truth: What the sensors are thought to be.
        wanted: Standard deviations by name of the parameter, SI units.
        azimuth: True heading of the table's zero, rad; None for what the table says, or north.

    Raises:
        InputError: There is no such parameter.
        NotObservable: No dwell reaches it; says what stands in the way.
    """
    names = [p.name for p in listed(setup)]
    for name in wanted:
        if name not in names:
            raise InputError(f'There is no parameter {name!r}; there are: {", ".join(names)}.')
    rows = np.array([names.index(name) for name in wanted])
    targets = np.array(list(wanted.values()))
    plan, weights = setup.plan, None
    for _ in range(_LOOKS):
        now = replace(setup, plan=plan)
        found = forecast(now, truth, azimuth)
        if found.refusal:
            raise NotObservable(found.refusal)
        if not found.evidence.segments:
            raise NotObservable(
                f'Plan {plan.name} has no dwells: what its turns give, no dwell can change.'
            )
        _check_observed(found, rows)
        joint = setup.method_name in JOINT
        if weights is None or joint:
            weights = _weights(now, truth, found.evidence)[rows] ** 2
        gravities = gravity_variances(found, truth)[rows]
        wide = targets / _SLACK
        before, plan = plan, _shorter(plan, found, weights, rows, wide, gravities, weighed=joint)
        pairs = zip(plan.positions, before.positions, strict=True)
        if max(abs(p.dwell - q.dwell) - _CLOSE * q.dwell for p, q in pairs) <= 0:
            break
    return Reached(plan, forecast(replace(setup, plan=plan), truth, azimuth), wanted)


def _shorter(
    plan: Plan,
    found: Forecast,
    weights: Floats,
    rows: NDArray[np.intp],
    targets: Floats,
    gravities: Floats,
    *,
    weighed: bool,
) -> Plan:
    """Choose dwells by what one look at a session says of its variances.

    Of k parameters, `rows` of those that were found: `weights` (k, outputs) are the squares of the
    weights of the outputs, which follow the dwells if `weighed`, `targets` (k,) the standard
    deviations wanted, `gravities` (k,) the variances that the doubt of gravity adds.
    """
    evidence = found.evidence
    names = list(dict.fromkeys(str(s.position) for s in evidence.segments))
    dwells = np.array([plan.position(name).dwell for name in names])
    # Twice the same position counts twice for its dwell.
    share = np.array([names.index(str(s.position)) for s in evidence.segments])
    beyond = np.array([s.statistics.duration for s in evidence.segments]) - dwells[share]
    walked = np.array([evidence.walk**2 * s.statistics.walk_gain for s in evidence.segments])
    counted = np.array([s.statistics.quantisation_variance for s in evidence.segments])
    square = found.std[rows] ** 2
    by_segment = np.ascontiguousarray(weights[:, evidence.layout.dwell])
    walk_part = np.einsum('ksc,sc->ks', by_segment, walked)
    count_part = np.einsum('ksc,sc->ks', by_segment, counted)
    fixed = square - (walk_part + count_part).sum(axis=1)
    wanted = [found.parameters[row].name for row in rows]
    _check_gravity(wanted, targets, gravities)
    short = [
        name for name, most, rest in zip(wanted, targets**2, fixed, strict=True) if rest >= most
    ]
    if short and weighed and dwells.min() < LONGEST:
        # By weights for short dwells the turns count more than they will beside long ones.
        longer = np.minimum(np.maximum(dwells, SHORTEST) * _LONGER, LONGEST)
        return _with_dwells(plan, dict(zip(names, longer, strict=True)))
    if short:
        raise NotObservable(
            f'No dwell reaches it for {", ".join(short)}: the turns, the positioning errors and '
            'the clocks contribute more than that. Turn more often.'
        )
    seconds = dwells[share] + beyond

    def left(logs: Floats) -> Floats:
        ratio = seconds / (np.exp(logs)[share] + beyond)
        variances = fixed + walk_part @ ratio + count_part @ ratio**2
        return np.asarray(np.log(variances / targets**2))

    def slopes(logs: Floats) -> Floats:
        times = np.exp(logs)[share]
        ratio = seconds / (times + beyond)
        variances = fixed + walk_part @ ratio + count_part @ ratio**2
        by_ratio = walk_part + 2 * count_part * ratio
        by_log = -by_ratio * ratio * times / (times + beyond) / variances[:, None]
        result = np.zeros((len(rows), len(names)))
        for k, place in enumerate(share):
            result[:, place] += by_log[:, k]
        return result

    start = np.log(np.maximum(dwells, SHORTEST))
    while (left(start) > 0).any() and start.max() < np.log(LONGEST):
        start = np.minimum(start + 0.2, np.log(LONGEST))
    total = float(np.exp(start).sum())
    solved = scipy.optimize.minimize(  # type: ignore[call-overload, unused-ignore]
        lambda logs: float(np.exp(logs).sum()) / total,
        start,
        jac=lambda logs: np.exp(logs) / total,
        bounds=[(float(np.log(SHORTEST)), float(np.log(LONGEST)))] * len(start),
        constraints={
            'type': 'ineq',
            'fun': lambda logs: -left(logs),
            'jac': lambda logs: -slopes(logs),
        },
        method='SLSQP',
        options={'maxiter': 200, 'ftol': 1e-9},
    )
    return _with_dwells(plan, dict(zip(names, np.exp(solved.x), strict=True)))


def _with_dwells(plan: Plan, times: Mapping[str, float]) -> Plan:
    """Return a plan with other dwells, s, at the positions named."""
    positions = tuple(
        replace(p, dwell=float(times[p.id])) if p.id in times else p for p in plan.positions
    )
    return replace(plan, positions=positions)


def _weights(setup: Setup, truth: SensorModel, evidence: Evidence) -> Floats:
    """Return how the parameters follow from the outputs, (n, 6 s + 3 t)."""
    name = setup.method_name
    if name not in JOINT:
        gain = method(name)(replace(evidence, moves=())).gain
        assert gain is not None
        return gain
    equations = Equations(evidence, setup.parameters)
    state = state_at(equations, truth)
    covariance = information(evidence, truth, setup.parameters).covariance
    jacobian = equations.jacobian(state)
    inverse = np.linalg.inv(equations.covariance(state))
    return np.asarray((np.nan_to_num(covariance) @ jacobian.T @ inverse)[: equations.sensors])


def _check_observed(found: Forecast, rows: NDArray[np.intp]) -> None:
    lost = [found.parameters[row].name for row in rows if not np.isfinite(found.std[row])]
    if lost:
        raise NotObservable(
            f'This plan does not observe {", ".join(lost)}, however long it dwells.'
        )


def _check_gravity(wanted: Sequence[str], targets: Floats, gravities: Floats) -> None:
    """Refuse what gravity is not known well enough for."""
    scaled = gravities >= targets**2
    if scaled.any():
        names = ', '.join(name for name, far in zip(wanted, scaled, strict=True) if far)
        least = float(np.sqrt(gravities[scaled].max())) / PPM
        raise NotObservable(
            f'No dwell reaches it for {names}: gravity is known to {least:.0f} ppm. Give `gravity` '
            'as measured, or `height`.'
        )
