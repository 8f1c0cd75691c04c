"""Forecast the standard deviations of a session, by the plan's method and by the information bound.

The method is given outputs equal to their expectation, with their covariance in such a session.
Bias drift is propagated by the derivatives of the parameters by the outputs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ..common.budget import ErrorSource
from ..common.errors import NotObservable
from ..common.stream import Floats
from ..model.parameters import AXES, PARAMETERS, Parameter
from ..model.sensors import SensorModel, gravity_covariance, has_motion_terms, terms_of
from ..model.session_terms import LOOKED_FOR, Change, Course, session_term
from ..model.terms import TERMS, Term
from ..session.table_errors import clock_share
from . import exact_table
from . import hand as free_positions
from .changing import with_changes
from .closed_forms import skewed
from .closed_forms.skewed import RatePoints
from .components import Blocks, Component
from .equations import Equations
from .evidence import Evidence
from .free_dwells import FreeEquations
from .information import Information, determined
from .methods import JOINT, check_plan, method
from .modulation import warms
from .predict import bias_drift_covariance, expected
from .setup import Setup
from .solution import Solution
from .solve import check_observable


@dataclass(frozen=True, eq=False)
class Forecast:
    """Forecast of a session."""

    evidence: Evidence  #: The evidence of the session.
    method: str  #: Name of the method.
    parameters: tuple[Parameter, ...]  #: The parameters that the method estimates.
    #: (n,) by that method, SI units; NaN for parameters not estimated, or if the method fails.
    std: Floats
    best: Floats  #: (n,) by the Fisher information; NaN for parameters that are not observable.
    refusal: str  #: Why the method gives no result, else empty.


def forecast(
    setup: Setup,
    truth: SensorModel,
    azimuth: float | None = None,
    *,
    drifting: bool = False,
    rise: float = 0.0,
) -> Forecast:
    """Predict the standard deviations of a session.

    Arguments and errors are those of `expected`; `drifting` is whether the biases drift by the
    IMU's bias instability.

    Raises:
        InputError: There is no such method.
    """
    evidence = expected(setup, truth, azimuth, rise=rise)
    if setup.method_name == free_positions.NAME:
        return _with_common(_in_the_hand(truth, evidence), setup, truth)
    # A closed form does not use moves.
    resting = replace(evidence, moves=())
    name = setup.method_name
    solver = method(name, setup.terms)
    refusal = ''
    parameters = listed(setup)
    square = np.full(len(parameters), np.nan)
    if name not in JOINT:
        try:
            extra = bias_drift_covariance(resting, setup.imu) if drifting else None
            parameters, square = _by_closed_form(resting, solver, extra)
            if name == skewed.NAME:
                square = square + skewed.variance_by_weights(evidence)
        except NotObservable as error:
            refusal = str(error)
    else:
        try:
            check_observable(Equations(evidence, parameters))
        except NotObservable as error:
            refusal = str(error)
    extra = bias_drift_covariance(evidence, setup.imu) if drifting else None
    best = _best(evidence, truth, parameters, extra)
    std = best if name in JOINT else np.sqrt(square)
    return _with_common(Forecast(evidence, name, parameters, std, best, refusal), setup, truth)


def best_table_findings(found: Forecast, truth: SensorModel) -> list[str]:
    """List the parameters of a joint estimate that rely on table errors below `FINEST`."""
    if found.method not in JOINT or found.refusal:
        return []
    parameters = tuple(p for p in found.parameters if p.row < len(AXES))
    equations = Equations(found.evidence, parameters)
    std = found.std[: len(parameters)]
    return exact_table.best_table_findings(equations, state_at(equations, truth), std)


def gravity_variances(found: Forecast, truth: SensorModel) -> Floats:
    """Return the part of gravity's uncertainty in the variances of a forecast, (n,)."""
    relative_std = found.evidence.site.gravity_relative_std
    return np.asarray(np.diag(gravity_covariance(truth, found.parameters, relative_std)))


def _with_common(found: Forecast, setup: Setup, truth: SensorModel) -> Forecast:
    """Add the uncertainty of gravity and of the table's clock, as in every calibration."""
    share = gravity_variances(found, truth)
    if setup.table is not None:
        clock = clock_share(truth, found.parameters, setup.imu.units, setup.table.clock)
        share = share + np.diag(clock.covariance)
    return replace(found, std=np.sqrt(found.std**2 + share), best=np.sqrt(found.best**2 + share))


def check_session(setup: Setup) -> None:
    """Refuse a plan that the method could not solve even with a perfect session.

    Raises:
        InputError: The table cannot run the plan, or there is no such method.
        NotObservable: Names what cannot be determined, and what is missing.
    """
    check_plan(setup.method_name, setup.plan, setup.site)
    if setup.table is not None and not setup.plan.by_hand:
        setup.plan.steps(setup.table)
    setup.plan.check_range(setup.imu)
    noisy = min(setup.imu.gyro.random_walk, setup.imu.accel.random_walk) > 0
    if noisy and setup.method_name != free_positions.NAME:
        method(setup.method_name)(expected(setup, SensorModel()))


def _best(
    evidence: Evidence, truth: SensorModel, parameters: tuple[Parameter, ...], extra: Floats | None
) -> Floats:
    """Return the least standard deviations that a session allows; NaN for undetermined ones."""
    modelled = tuple(p for p in parameters if p.row < len(AXES))
    found = information(evidence, truth, modelled, extra=extra)
    best = np.where(determined(found, modelled), found.std[: len(modelled)], np.nan)
    if parameters == modelled:
        return np.asarray(best)
    turns = [t for t in evidence.turns if t.skewed is not None]
    square = None if extra is None else extra[-len(turns) :, -len(turns) :]
    askew = np.sqrt(np.diag(skewed.gauss_markov_bound(RatePoints.from_turns(evidence), square)))
    return np.concatenate([best, askew])


def _in_the_hand(truth: SensorModel, evidence: Evidence) -> Forecast:
    """Forecast a session in the hand: its least-squares method reaches the information bound."""
    std, sought = np.zeros(len(PARAMETERS)), free_positions.ESTIMATES
    found = information(evidence, free_positions.in_frame_of_accelerometers(truth), sought)
    std[free_positions.FREE] = found.std[: len(sought)]
    best = np.full(len(PARAMETERS), np.nan)
    return Forecast(evidence, free_positions.NAME, PARAMETERS, std, best, '')


def listed(setup: Setup) -> tuple[Parameter, ...]:
    """Return the parameters of a forecast: the 24, estimated or not, and additional ones."""
    return tuple(dict.fromkeys((*PARAMETERS, *setup.parameters)))


def information(
    evidence: Evidence,
    truth: SensorModel,
    parameters: tuple[Parameter, ...] = PARAMETERS,
    *,
    extra: Floats | None = None,
) -> Information:
    """Return the Fisher information of a session at the truth."""
    kind = FreeEquations if evidence.free else Equations
    return information_of(kind(evidence, parameters), truth, extra)


def information_of(equations: Equations, truth: SensorModel, extra: Floats | None) -> Information:
    """Return the Fisher information of equations at the truth, with bias drift `extra` or None."""
    if extra is not None:
        m = len(equations.outputs)
        part = Blocks(np.arange(m)[None], extra[None, :m, :m])
        equations = replace(equations, extra=(Component(ErrorSource.BIAS_STATED, part),))
    return Information.from_jacobian(equations.whitened(state_at(equations, truth))[0])


def state_at(equations: Equations, truth: SensorModel) -> Floats:
    """Return the state (n,) of `equations` for the assumed sensors."""
    state = equations.nominal()
    state[: equations.sensors] = truth.values(equations.parameters)
    return state


def _by_closed_form(
    evidence: Evidence, solver: Callable[[Evidence], Solution], extra: Floats | None
) -> tuple[tuple[Parameter, ...], Floats]:
    """Return parameters and variances of a method with fixed weights of its outputs."""
    solution = solver(evidence)
    square = np.asarray(solution.std**2)
    if extra is not None:
        gain = solution.gain
        assert gain is not None
        # Dwells come first: with gyros at rest alone, turns have no weight and are left out.
        outputs = slice(0, gain.shape[1])
        square = square + np.einsum('ij,jk,ik->i', gain, extra[outputs, outputs], gain)
    return solution.parameters, square


@dataclass(frozen=True, eq=False)
class TermForecast:
    """How well a session would determine a term."""

    term: Term  #: The term, added to the estimated parameters.
    #: (n,) of its parameters, SI units; NaN for those that the session does not determine.
    std: Floats
    #: Parameters whose standard deviation grows by more than `_DEARER` times with the term, and the
    #: factor: NaN for those that the session then does not determine.
    worsened: tuple[tuple[Parameter, float], ...]

    @property
    def determined(self) -> bool:
        """Whether all its parameters, and all that were without it, are determined."""
        return bool(np.isfinite([*self.std, *(times for _, times in self.worsened)]).all())


@dataclass(frozen=True, eq=False)
class ChangeForecast:
    """How well a session would determine parameters that change during it."""

    #: The k coefficients added, of one course and one kind of parameter.
    changes: tuple[Change, ...]
    #: (k,) of them, SI units; NaN where the session does not determine them. A warm-up is assumed
    #: to fade within a quarter of the session, with a known time constant.
    std: Floats
    worsened: tuple[tuple[Parameter, float], ...]  #: As in `TermForecast`.

    @property
    def determined(self) -> bool:
        """Whether the session determines all coefficients."""
        return bool(np.isfinite(self.std).all())

    @property
    def follows_temperature(self) -> bool:
        """Whether the parameters change with the temperature of the unit."""
        return self.changes[0].course is Course.THERMAL


_DEARER = 1.1
"""Growth of standard deviations below which no other plan would be chosen. A judgement."""


def forecast_terms(
    found: Forecast, setup: Setup, truth: SensorModel, *, drifting: bool = False
) -> tuple[TermForecast, ...]:
    """Forecast each term that the joint estimate leaves out of a forecast, set up alike."""
    if found.method not in JOINT or found.refusal:
        return ()
    included = terms_of(found.parameters)
    return tuple(
        _forecast_term(term, found, setup, truth, drifting)
        for term in TERMS
        if term not in included
    )


def _forecast_term(
    term: Term, found: Forecast, setup: Setup, truth: SensorModel, drifting: bool
) -> TermForecast:
    more = replace(setup, terms=(*setup.terms, term))
    evidence = replace(found.evidence, coarse=has_motion_terms(more.terms))
    parameters = listed(more)
    extra = bias_drift_covariance(evidence, more.imu) if drifting else None
    best = _best(evidence, truth, parameters, extra)
    other = _with_common(Forecast(evidence, found.method, parameters, best, best, ''), more, truth)
    std = dict(zip(parameters, other.std.tolist(), strict=True))
    before = dict(zip(found.parameters, found.std.tolist(), strict=True))
    times = [(p, std[p] / s) for p, s in before.items() if s > 0]
    dearer = tuple((p, t) for p, t in times if not t <= _DEARER)
    return TermForecast(term, np.array([std[p] for p in term.parameters]), dearer)


def forecast_changes(
    found: Forecast, setup: Setup, truth: SensorModel, *, drifting: bool = False
) -> tuple[ChangeForecast, ...]:
    """Forecast biases and scale factors that follow a trend, a warm-up or the temperature.

    The temperature is included if its stated change is large enough.
    """
    if found.method not in JOINT or found.refusal:
        return ()
    modelled = tuple(p for p in found.parameters if p.row < len(AXES))
    extra = bias_drift_covariance(found.evidence, setup.imu) if drifting else None
    plain = Equations(found.evidence, modelled)
    before = information_of(plain, truth, extra).std
    return tuple(
        _forecast_change(session_term(f'{course.value}:{kind}'), plain, before, truth, extra)
        for course in (*LOOKED_FOR, *([Course.THERMAL] if warms(found.evidence) else []))
        for kind in course.by_default
    )


def _forecast_change(
    changes: tuple[Change, ...],
    plain: Equations,
    before: Floats,
    truth: SensorModel,
    extra: Floats | None,
) -> ChangeForecast:
    try:
        equations, _ = with_changes(plain, changes)
    except NotObservable:
        return ChangeForecast(changes, np.full(len(changes), np.nan), ())
    std = information_of(equations, truth, extra).std
    times = std[: plain.sensors] / before[: plain.sensors]
    dearer = ((p, float(t)) for p, t in zip(plain.parameters, times, strict=True) if t > _DEARER)
    return ChangeForecast(changes, std[equations.change_slice], tuple(dearer))
