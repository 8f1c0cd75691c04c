"""Find the most informative plan for a given time on a table: D-optimal attitudes, turns, dwells.

The determinant of the information on the 24 parameters is maximised: it does not depend on their
units. Attitudes are exchanged one at a time for the candidate of the largest gain, until none
gains (Fedorov 1972, chapter 3). The number of attitudes and of turns per axis is found by trial,
and the remaining time goes to the dwells.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np
import scipy
from numpy.typing import NDArray

from ..common.errors import ImuCalibError, InputError, NotObservable
from ..common.rotations import rotation
from ..common.stream import Floats
from ..common.units import DEG, PPM, counted
from ..model.parameters import PARAMETERS
from ..model.sensors import SensorModel
from ..session.plan import BODY_AXES, COMPASS, Plan, Position, RateTest
from ..session.table import Table
from .equations import Equations
from .evidence import Evidence
from .forecast import Forecast, forecast, gravity_variances, information, listed, state_at
from .information import log_determinant
from .methods import JOINT, method
from .predict import bias_drift_covariance, duration, expected
from .setup import Setup

_SENSORS = len(PARAMETERS)
_SLANTS = (0.0, 45.0)
"""Angles by which candidates are rotated from cube-aligned attitudes, deg: halfway to the next one
is the strongest mixture of two axes."""
_TRIAL_DWELL = 60.0  #: s: dwell while attitudes are compared; the final dwells follow.
_SHORTEST_DWELL = 20.0
"""s: shorter dwells lose more time to motions than they gain in information; a choice."""
_LONGEST = 24 * 3600.0  #: s: a longer session is taken for a typing error.
_SWEEPS = 20  #: Most rounds of exchanges. A cap.
_GAINED = 1e-9
"""Least gain in the logarithm of the determinant that counts: smaller ones are rounding."""


@dataclass(frozen=True, eq=False)
class Optimum:
    """The best plan found."""

    plan: Plan  #: The plan, for the joint estimate.
    information: float  #: Logarithm of the determinant of the information on the 24 parameters.
    seconds: float  #: Time on the table, s.

    def __repr__(self) -> str:
        return (
            f'<Optimum: {counted(len(self.plan.positions), "position")} in '
            f'{self.seconds / 60:.1f} min>'
        )

    def text(self, name: str) -> str:
        """Return the text of the plan's file, under a name."""
        return self.plan.text(name)


def candidates(table: Table) -> list[Floats]:
    """List attitudes (3, 3) within a table's reach: cube-aligned, and slanted by 45 deg."""
    found: list[Floats] = []
    for letters in permutations('ENUWSD', 3):
        matrix = np.array([COMPASS[letter] for letter in letters]).T
        if abs(np.linalg.det(matrix) - 1) > 1e-9:
            continue
        for by, about in product(_SLANTS, 'XYZ'):
            if not by and about != 'X':
                continue
            turned = matrix @ rotation(BODY_AXES[about], by * DEG)
            if any(np.allclose(turned, other) for other in found):
                continue
            try:
                table.angles(turned)
            except InputError:
                continue
            found.append(turned)
    return found


def optimise(
    setup: Setup,
    truth: SensorModel,
    seconds: float,
    rate: float,
    *,
    sizes: Sequence[int] = (6, 8, 10, 12, 16),
    turns: Sequence[int] = (1, 2, 4, 6, 8, 12, 16, 20),
    show: Callable[[int, int], None] = lambda _done, _total: None,
) -> Optimum:
    """Find the most informative plan for a given time.

    Args:
        setup: Table, IMU and site; of its plan only names are used.
        truth: Assumed sensors.
        seconds: Time on the table, s.
        rate: Fastest rate of turning, rad/s.
        sizes: Numbers of positions to try.
        turns: Whole turns in each sense to try.
        show: Called with the number of trials done and their total.

    Raises:
        InputError: The table reaches too few attitudes, or the time is too short for any.
    """
    if not 0 < seconds <= _LONGEST:
        raise InputError(
            f'{seconds / 60:g} minutes: expected more than 0 and no more than {_LONGEST / 60:g}.'
        )
    table = setup.table
    if table is None:
        raise InputError('A plan is optimised for a table: there is none.')
    highest = min(joint.max_rate for joint in table.joints)
    if not 0 < rate <= highest:
        raise InputError(
            f'Turns at {rate / DEG:g} deg/s: expected more than 0 and no more than the '
            f'{highest / DEG:g} deg/s of the slowest joint of table {table.name}.'
        )
    choices = candidates(table)
    missing = [
        name for axis, name in enumerate(BODY_AXES) if not any(_is_up(c, axis) for c in choices)
    ]
    if missing:
        raise InputError(
            f'Table {table.name} brings {" and ".join(missing)} of the unit never up: an optimised '
            'plan turns each of X, Y and Z about the vertical. Plan nineteen_position turns each '
            'axis while level.'
        )
    blocks, prior = _blocks(setup, truth, choices)
    best: Optimum | None = None
    for k, size in enumerate(sizes):
        chosen = [choices[c] for c in _exchange(blocks, prior, choices, size)]
        for m, count in enumerate(turns):
            found = _timed(setup, truth, chosen, RateTest((rate, -rate), count), seconds)
            if found is not None and (best is None or found.information > best.information):
                best = found
            show(k * len(turns) + m + 1, len(sizes) * len(turns))
    if best is None:
        raise InputError(
            f'{seconds / 60:g} minutes on table {table.name} are too short for a calibration.'
        )
    return best


def _blocks(setup: Setup, truth: SensorModel, choices: list[Floats]) -> tuple[Floats, Floats]:
    """Return the information of a dwell at each candidate (c, n, n), and that of turns and priors.

    The turns are those about X, Y and Z that every plan makes.
    """
    positions = [Position(str(k), choice, _TRIAL_DWELL) for k, choice in enumerate(choices)]
    test = RateTest((30 * DEG, -30 * DEG), 1)
    for axis in range(3):
        k = next(k for k, c in enumerate(choices) if _is_up(c, axis))
        positions[k] = replace(positions[k], rate_test=test)
    plan = replace(setup.plan, positions=tuple(positions), by_hand=False)
    # The order in which the table visits them is not known yet.
    evidence = replace(expected(replace(setup, plan=plan), truth), moves=())
    equations = Equations(evidence)
    state = state_at(equations, truth)
    jacobian, variances = equations.jacobian(state), equations.own_variances
    rows = jacobian / np.sqrt(variances)[:, None]
    each, turned = (
        rows[equations.layout.dwell],
        np.delete(rows, equations.layout.dwell.ravel(), axis=0),
    )
    prior = equations.prior_rows(state)[:, :-1]
    rest = turned.T @ turned + prior.T @ prior
    return np.einsum('cri,crj->cij', each, each), rest


def _is_up(attitude: Floats, axis: int) -> bool:
    return bool(attitude[2, axis] > 1 - 1e-9)


def _exchange(blocks: Floats, prior: Floats, choices: list[Floats], size: int) -> list[int]:
    """Exchange attitudes until none gains; X, Y and Z up are among them, for the turns."""
    upright = [next(k for k, c in enumerate(choices) if _is_up(c, axis)) for axis in range(3)]
    # Any start is sufficient: the candidates in order, spread over the list.
    spread = np.linspace(0, len(choices) - 1, size - len(upright)).astype(int)
    chosen = [*upright, *spread.tolist()]
    for _ in range(_SWEEPS):
        changed = False
        for place in range(len(chosen)):
            others = prior + blocks[[c for k, c in enumerate(chosen) if k != place]].sum(axis=0)
            axis = place if place < len(upright) else None
            value = [
                log_determinant(others + blocks[k], _SENSORS)
                if axis is None or _is_up(choices[k], axis)
                else -np.inf
                for k in range(len(choices))
            ]
            gain = int(np.argmax(value))
            if value[gain] > value[chosen[place]] + _GAINED:
                chosen[place], changed = gain, True
        if not changed:
            break
    return chosen


def _timed(
    setup: Setup, truth: SensorModel, attitudes: list[Floats], test: RateTest, seconds: float
) -> Optimum | None:
    """Distribute the remaining time to the dwells and evaluate the plan."""
    table = setup.table
    assert table is not None
    tested: set[int] = set()
    positions = []
    for k, attitude in enumerate(attitudes[k] for k in _order(attitudes)):
        axis = int(np.argmax(attitude[2]))
        turning = _is_up(attitude, axis) and axis not in tested
        if turning:
            tested.add(axis)
        positions.append(Position(str(k + 1), attitude, 1.0, test if turning else None))
    plan = replace(setup.plan, positions=tuple(positions), method='joint', by_hand=False)
    try:
        overhead = duration(plan.steps(table), table) - len(positions)
    except InputError:
        return None
    dwell = (seconds - overhead) / len(positions)
    if dwell < _SHORTEST_DWELL:
        return None
    # Whole seconds, for a readable file.
    positions = [replace(p, dwell=float(int(dwell))) for p in positions]
    lasting = duration(replace(plan, positions=tuple(positions)).steps(table), table)
    plan = replace(
        plan,
        positions=tuple(positions),
        title=f'{len(positions)} attitudes chosen to tell most in {lasting / 60:.1f} min, '
        'any azimuth',
        source='D-optimal exchange, Fedorov 1972; docs/optimised_plan.md',
    )
    try:
        value = log_information(replace(setup, plan=plan), truth)
    except ImuCalibError:
        return None
    return Optimum(plan, value, lasting)


def log_information(setup: Setup, truth: SensorModel) -> float:
    """Return the logarithm of the determinant of a plan's information on the 24 parameters."""
    equations = Equations(expected(setup, truth))
    rows = equations.whitened(state_at(equations, truth))[0]
    return log_determinant(rows.T @ rows, _SENSORS)


def _order(attitudes: list[Floats]) -> list[int]:
    """Order the attitudes so that each is near the one before; groups of one axis up stay whole."""
    remaining, order = set(range(1, len(attitudes))), [0]
    while remaining:
        here = attitudes[order[-1]]
        order.append(
            max(
                remaining,
                key=lambda k: (round(float(np.trace(here.T @ attitudes[k])), 6), -k),
            )
        )
        remaining.remove(order[-1])
    return order


# Between two forecasts of a session, the random-walk variance of a dwell's mean is taken to fall
# with its duration, and the quantisation variance with the square of it. A parameter's variance is
# a sum over the outputs, each by the square of its weight. Optimal weights are stationary: their
# own change has no effect to first order; those of a closed form are constant.

SHORTEST = 5.0
"""Shortest dwell proposed, s. A choice: a table takes as long to move and to settle."""

LONGEST = 24 * 3600.0
"""Longest dwell proposed, s: a day. A choice: nobody waits longer for one position."""

_GROWTH = 0.2  #: Logarithm by which the first dwells grow until they are long enough: a choice.
_STEPS = 200  #: Most steps of the minimisation. A cap.
_ALIKE = 1e-9
"""Relative change of the total at which it ends: a choice, since seconds are rounded."""
_LOOKS = 20  #: Most rounds of the iteration. A cap.
_LONGER = 4.0
"""Factor by which dwells grow where turns contribute more than the wanted variance; a choice."""
_CLOSE = 2e-3  #: Relative change of a dwell at convergence: a second in ten minutes.
_SLACK = 1.001  #: Relative margin on the wanted std: dwells are rounded to seconds.


@dataclass(frozen=True, eq=False)
class Reached:
    """A plan whose dwells reach the wanted accuracy."""

    plan: Plan  #: The plan with these dwells; order, attitudes and turns are unchanged.
    forecast: Forecast  #: Its forecast.
    wanted: Mapping[str, float]  #: Standard deviations by name of the parameter, SI units.

    def __repr__(self) -> str:
        total = sum(position.dwell for position in self.plan.positions)
        return f'<Reached: plan {self.plan.name} with dwells of {total:.0f} s in all>'


def reach(
    setup: Setup,
    truth: SensorModel,
    wanted: Mapping[str, float],
    azimuth: float | None = None,
    *,
    drifting: bool = False,
) -> Reached:
    """Find one dwell for each position, of least sum, that reach an accuracy.

    `wanted` are standard deviations by name of the parameter, SI units; other arguments are those
    of `forecast`.

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
    plan, weights, step, before = setup.plan, None, 1.0, 0.0
    for _ in range(_LOOKS):
        now = replace(setup, plan=plan)
        found = forecast(now, truth, azimuth, drifting=drifting)
        if found.refusal:
            raise NotObservable(found.refusal)
        if not found.evidence.segments:
            raise NotObservable(
                f'Plan {plan.name} has no dwells: what its turns give, no dwell can change.'
            )
        _check_observed(found, rows)
        joint = setup.method_name in JOINT
        if weights is None or joint:
            weights = _weights(now, truth, found.evidence, drifting)[rows] ** 2
        gravities = gravity_variances(found, truth)[rows]
        wide = targets / _SLACK
        sought = _shorter(plan, found, weights, rows, wide, gravities, weights_follow=joint)
        ways = [
            math.log(q.dwell / p.dwell) if p.dwell else 0.0
            for p, q in zip(plan.positions, sought.positions, strict=True)
        ]
        # What biases drift changes with the dwells, too: whole steps would go to and fro.
        step = step / 2 if sum(ways) * before < 0 else step
        before, stays = sum(ways), plan.positions
        times = {p.id: p.dwell * math.exp(step * way) for p, way in zip(stays, ways, strict=True)}
        plan = _with_dwells(plan, times)
        if max(map(abs, ways)) <= _CLOSE:
            break
    final = forecast(replace(setup, plan=plan), truth, azimuth, drifting=drifting)
    return Reached(plan, final, wanted)


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
            f'No dwell reaches it for {", ".join(short)}: the turns, the positioning errors, the '
            'clocks and what the biases drift contribute more than that. Turn more often.'
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
    positions = tuple(
        replace(p, dwell=float(times[p.id])) if p.id in times else p for p in plan.positions
    )
    return replace(plan, positions=positions)


def _weights(setup: Setup, truth: SensorModel, evidence: Evidence, drifting: bool) -> Floats:
    """Return the derivatives of the parameters by the outputs, (n, 6 s + 3 t)."""
    name = setup.method_name
    if name not in JOINT:
        gain = method(name)(replace(evidence, moves=())).gain
        assert gain is not None
        return gain
    equations = Equations(evidence, setup.parameters)
    state = state_at(equations, truth)
    extra = bias_drift_covariance(evidence, setup.imu) if drifting else None
    covariance = information(evidence, truth, setup.parameters, extra=extra).covariance
    jacobian = equations.jacobian(state)
    inverse = np.linalg.inv(equations.covariance(state) + (0.0 if extra is None else extra))
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
