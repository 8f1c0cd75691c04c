"""Forecast how well a session would determine each further term of the model, one at a time."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..common.errors import NotObservable
from ..common.stream import Floats
from ..model.parameters import AXES, Parameter
from ..model.sensors import SensorModel, has_motion_terms, terms_of
from ..model.session_terms import LOOKED_FOR, Change, Course, session_term
from ..model.terms import TERMS, Term
from .equations import Equations
from .forecast import Forecast, information_of, listed, with_parameters
from .methods import JOINT
from .modulation import warms
from .predict import bias_drift_covariance
from .setup import Setup
from .solve import with_changes


@dataclass(frozen=True, eq=False)
class TermForecast:
    """How well a session would determine a term.

    Attributes:
        term: The term, added to the estimated parameters.
        std: (n,) of its parameters, SI units; NaN for those that the session does not determine.
        worsened: Parameters whose standard deviation grows by more than `_DEARER` times with the
            term, and the factor: NaN for those that the session then does not determine.
    """

    term: Term
    std: Floats
    worsened: tuple[tuple[Parameter, float], ...]

    @property
    def determined(self) -> bool:
        """Whether all its parameters, and all that were without it, are determined."""
        return bool(np.isfinite([*self.std, *(times for _, times in self.worsened)]).all())


@dataclass(frozen=True, eq=False)
class ChangeForecast:
    """How well a session would determine parameters that change during it.

    Attributes:
        changes: The k coefficients added, of one course and one kind of parameter.
        std: (k,) of them, SI units; NaN where the session does not determine them. A warm-up is
            assumed to fade within a quarter of the session, with a known time constant.
        worsened: As in `TermForecast`.
    """

    changes: tuple[Change, ...]
    std: Floats
    worsened: tuple[tuple[Parameter, float], ...]

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
    """Forecast each term that the joint estimate of a session leaves out.

    Args:
        found: Forecast of the session without it.
        setup: As in that forecast.
        truth: Likewise.
        drifting: Likewise.
    """
    if found.method not in JOINT or found.refusal:
        return ()
    included = terms_of(found.parameters)
    return tuple(
        _of_term(term, found, setup, truth, drifting) for term in TERMS if term not in included
    )


def _of_term(
    term: Term, found: Forecast, setup: Setup, truth: SensorModel, drifting: bool
) -> TermForecast:
    more = replace(setup, terms=(*setup.terms, term))
    evidence = replace(found.evidence, coarse=has_motion_terms(more.terms))
    parameters = listed(more)
    found_std = with_parameters(evidence, more, truth, parameters, drifting=drifting)
    std = dict(zip(parameters, found_std.tolist(), strict=True))
    before = dict(zip(found.parameters, found.std.tolist(), strict=True))
    times = [(p, std[p] / s) for p, s in before.items() if s > 0]
    dearer = tuple((p, t) for p, t in times if not t <= _DEARER)
    return TermForecast(term, np.array([std[p] for p in term.parameters]), dearer)


def forecast_changes(
    found: Forecast, setup: Setup, truth: SensorModel, *, drifting: bool = False
) -> tuple[ChangeForecast, ...]:
    """Forecast biases and scale factors that follow a trend, a warm-up or the temperature.

    The temperature is included if its stated change is large enough.

    Args:
        found: As in `forecast_terms`.
        setup: Likewise.
        truth: Likewise.
        drifting: Likewise.
    """
    if found.method not in JOINT or found.refusal:
        return ()
    modelled = tuple(p for p in found.parameters if p.row < len(AXES))
    extra = bias_drift_covariance(found.evidence, setup.imu) if drifting else None
    plain = Equations(found.evidence, modelled)
    before = _std(plain, truth, extra)
    return tuple(
        _of_changes(session_term(f'{course.value}:{kind}'), plain, before, truth, extra)
        for course in (*LOOKED_FOR, *([Course.THERMAL] if warms(found.evidence) else []))
        for kind in course.by_default
    )


def _of_changes(
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
    std = _std(equations, truth, extra)
    times = std[: plain.sensors] / before[: plain.sensors]
    dearer = ((p, float(t)) for p, t in zip(plain.parameters, times, strict=True) if t > _DEARER)
    return ChangeForecast(changes, std[equations.change_slice], tuple(dearer))


def _std(equations: Equations, truth: SensorModel, extra: Floats | None) -> Floats:
    return np.asarray(np.sqrt(np.diag(information_of(equations, truth, extra).covariance)))
