"""What a session would show of each further term of the model, one at a time."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..calibrator import Setup
from ..methods import JOINT
from ..model import TERMS, Parameter, SensorModel, Term, terms_of
from ..model.motion import has_motion_terms
from ..stream import Floats
from .forecast import Forecast, listed, with_parameters


@dataclass(frozen=True, eq=False)
class TermForecast:
    """What a session would tell of a term.

    Attributes:
        term: Added to what is estimated.
        std: (n,) of its parameters, SI units; NaN for those that the session does not determine.
        worsened: Parameters whose standard deviations it takes more than `_DEARER` times as large,
            and by how many times: NaN for those that the session then does not determine.

    """

    term: Term
    std: Floats
    worsened: tuple[tuple[Parameter, float], ...]

    @property
    def determined(self) -> bool:
        """Whether the session determines all of it, and what it determines without it."""
        return bool(np.isfinite([*self.std, *(times for _, times in self.worsened)]).all())


_DEARER = 1.1
"""Below, no other plan would be chosen for it."""


def forecast_terms(
    found: Forecast, setup: Setup, truth: SensorModel, *, drifting: bool = False
) -> tuple[TermForecast, ...]:
    """Return what a session would tell of each term that its joint estimate leaves out.

    Args:
        found: What is forecast of the session without it.
        setup: As the forecast was asked for.
        truth: Likewise.
        drifting: Likewise.

    """
    if found.method not in JOINT or found.refusal:
        return ()
    asked = terms_of(found.parameters)
    return tuple(
        _of_term(term, found, setup, truth, drifting) for term in TERMS if term not in asked
    )


def _of_term(
    term: Term, found: Forecast, setup: Setup, truth: SensorModel, drifting: bool
) -> TermForecast:
    more = replace(setup, terms=(*setup.terms, term))
    evidence = replace(found.evidence, coarse=has_motion_terms(more.terms))
    parameters = listed(more)
    std = dict(
        zip(
            parameters,
            with_parameters(evidence, more, truth, parameters, drifting=drifting).tolist(),
            strict=True,
        )
    )
    before = dict(zip(found.parameters, found.std.tolist(), strict=True))
    times = [(p, std[p] / s) for p, s in before.items() if s > 0]
    dearer = tuple((p, t) for p, t in times if not t <= _DEARER)
    return TermForecast(term, np.array([std[p] for p in term.parameters]), dearer)
