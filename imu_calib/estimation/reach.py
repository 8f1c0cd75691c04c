"""Find the shortest dwells that reach a wanted accuracy.

Between two forecasts of a session, the random-walk variance of a dwell's mean is taken to fall with
its duration, and the quantisation variance with the square of it. A parameter's variance is a sum
over the outputs, each by the square of its weight. Optimal weights are stationary: their own change
has no effect to first order; those of a closed form are constant.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from ..common.errors import InputError, NotObservable
from ..common.stream import Floats
from ..common.units import PPM
from ..model.sensors import SensorModel
from ..session.plan import Plan
from .equations import Equations
from .evidence import Evidence
from .forecast import Forecast, forecast, gravity_variances, information, listed, state_at
from .methods import JOINT, method
from .setup import Setup

SHORTEST = 5.0
"""Shortest dwell proposed, s. A choice: a table takes as long to move and to settle."""

LONGEST = 24 * 3600.0
"""Longest dwell proposed, s: a day. A choice: nobody waits longer for one position."""

_GROWTH = 0.2
"""Logarithm by which the first dwells grow until they are long enough: a choice."""
_STEPS = 200
"""Most steps of the minimisation. A cap."""
_ALIKE = 1e-9
"""Relative change of the total at which it ends: a choice, since seconds are rounded."""
_LOOKS = 20
"""Most rounds of the iteration. A cap."""
_LONGER = 4.0
"""Factor by which dwells grow where turns contribute more than the wanted variance; a choice."""
_CLOSE = 2e-3
"""Relative change of a dwell at convergence: a second in ten minutes."""
_SLACK = 1.001
"""Relative margin on the wanted std: dwells are rounded to seconds."""


@dataclass(frozen=True, eq=False)
class Reached:
    """A plan whose dwells reach the wanted accuracy.

    Attributes:
        plan: The plan with these dwells; order, attitudes and turns are unchanged.
        forecast: Its forecast.
        wanted: Standard deviations by name of the parameter, SI units.
    """

    plan: Plan
    forecast: Forecast
    wanted: Mapping[str, float]

    def __repr__(self) -> str:
        """Return one line."""
        total = sum(position.dwell for position in self.plan.positions)
        return f'<Reached: plan {self.plan.name} with dwells of {total:.0f} s in all>'


def reach(
    setup: Setup, truth: SensorModel, wanted: Mapping[str, float], azimuth: float | None = None
) -> Reached:
    """Find one dwell for each position, of least sum, that reach an accuracy.

    Args:
        setup: Plan, method, table, IMU and site.
        truth: Assumed sensors.
        wanted: Standard deviations by name of the parameter, SI units.
        azimuth: True heading of the table's zero, rad; None for the table's own, or north.

    Raises:
        InputError: There is no such parameter.
        NotObservable: No dwell reaches it; names the limiting errors.
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
        before, plan = (
            plan,
            _shorter(plan, found, weights, rows, wide, gravities, weights_follow=joint),
        )
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
    weights_follow: bool,
) -> Plan:
    """Choose dwells from the variances of one forecast.

    `rows` are the k wanted parameters among the forecast ones; `weights` (k, outputs) the squared
    weights of the outputs, which depend on the dwells if `weights_follow`; `targets` (k,) the
    wanted standard deviations; `gravities` (k,) the variances from the uncertainty of gravity.
    """
    evidence = found.evidence
    names = list(dict.fromkeys(str(s.position) for s in evidence.segments))
    dwells = np.array([plan.position(name).dwell for name in names])
    # A position that occurs twice counts twice for its dwell.
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
    if short and weights_follow and dwells.min() < LONGEST:
        # With weights for short dwells, turns count more than they will with long ones.
        longer = np.minimum(np.maximum(dwells, SHORTEST) * _LONGER, LONGEST)
        return _with_dwells(plan, dict(zip(names, longer, strict=True)))
    if short:
        raise NotObservable(
            f'No dwell reaches it for {", ".join(short)}: the turns, the positioning errors and '
            'the clocks contribute more than that. Turn more often.'
        )
    seconds = dwells[share] + beyond

    def excess(logs: Floats) -> Floats:
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
    while (excess(start) > 0).any() and start.max() < np.log(LONGEST):
        start = np.minimum(start + _GROWTH, np.log(LONGEST))
    total = float(np.exp(start).sum())
    solved = scipy.optimize.minimize(  # type: ignore[call-overload, unused-ignore]
        lambda logs: float(np.exp(logs).sum()) / total,
        start,
        jac=lambda logs: np.exp(logs) / total,
        bounds=[(float(np.log(SHORTEST)), float(np.log(LONGEST)))] * len(start),
        constraints={
            'type': 'ineq',
            'fun': lambda logs: -excess(logs),
            'jac': lambda logs: -slopes(logs),
        },
        method='SLSQP',
        options={'maxiter': _STEPS, 'ftol': _ALIKE},
    )
    return _with_dwells(plan, dict(zip(names, np.exp(solved.x), strict=True)))


def _with_dwells(plan: Plan, times: Mapping[str, float]) -> Plan:
    """Return a plan with other dwells, s, at the positions named."""
    positions = tuple(
        replace(p, dwell=float(times[p.id])) if p.id in times else p for p in plan.positions
    )
    return replace(plan, positions=positions)


def _weights(setup: Setup, truth: SensorModel, evidence: Evidence) -> Floats:
    """Return the derivatives of the parameters by the outputs, (n, 6 s + 3 t)."""
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
    """Refuse an accuracy for which gravity is not known well enough."""
    scaled = gravities >= targets**2
    if scaled.any():
        names = ', '.join(name for name, far in zip(wanted, scaled, strict=True) if far)
        least = float(np.sqrt(gravities[scaled].max())) / PPM
        raise NotObservable(
            f'No dwell reaches it for {names}: gravity is known to {least:.0f} ppm. Give `gravity` '
            'as measured, or `height`.'
        )
