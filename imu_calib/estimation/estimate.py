"""The joint estimate: fit all of a session at once, and reduce the weight of outliers.

Bias drift and positioning errors widen the covariance (`excess`); a segment that contradicts the
others gets less weight (`outliers`).

Source: docs/mathematics.md, 'Joint estimate'.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..common.budget import ErrorSource, Share
from ..common.stream import Floats
from ..model.parameters import PARAMETERS, Parameter
from ..model.sensors import motion_parameters
from ..model.session_terms import Change
from .changing import shape_covariance, with_changes, with_shape
from .components import unwhiten
from .equations import Equations
from .evidence import Evidence
from .excess_scatter import ExcessScatter, excess
from .information import Information
from .outliers import (
    MOST_OUTLIERS,
    Outlier,
    RejectedMove,
    candidates,
    downweighted,
    find_outlier,
    moves_that_fit,
    start_from_moves,
    turns_disagree,
    turns_downweighted,
)
from .positioning_errors import NO_POSITIONING_ERRORS
from .score import with_parameters
from .session_model import Nuisance
from .solve import check_observable, fit, headed, levelled, start, with_scatter


@dataclass(frozen=True, eq=False)
class Estimate:
    """Result of the least squares, before checks against other knowledge."""

    equations: Equations  #: With the weights that were used.
    state: Floats  #: (n,) parameters of the sensors, then the nuisances.
    covariance: Floats  #: (n, n) of the state.
    condition: float  #: Condition number of the system solved, columns scaled to unit length.
    scatter: ExcessScatter  #: Scatter beyond the noise.
    outliers: tuple[Outlier, ...]  #: Segments of less weight.
    #: (n, m + k) derivatives of the state by outputs and priors in standard deviations.
    gain: Floats
    #: Largest chi-square per degree of freedom by which the weight of turns about an axis is
    #: reduced; 1 where they agree.
    turns_scatter: float = 1.0
    rejected_moves: tuple[RejectedMove, ...] = ()  #: Moves that were left out.
    #: Coefficients of the session's terms that it does not determine, left out.
    constant: tuple[Change, ...] = ()
    #: (n, n) part of the covariance by the uncertainty of a warm-up's time constant.
    between: Floats | None = None
    #: The covariance of the parameters by source, where other units on the table share in it.
    by_source: dict[ErrorSource, Share] | None = None

    def nuisance(self, which: Nuisance) -> tuple[float, float]:
        """Return one of the nuisances and its standard deviation."""
        index = self.equations.sensors + which
        return float(self.state[index]), float(np.sqrt(self.covariance[index, index]))

    @property
    def without_scatter(self) -> Equations:
        """The equations with the noise known beforehand, without scatter from the session."""
        return replace(self.equations, extra=self.scatter.stated, positioning=NO_POSITIONING_ERRORS)

    @property
    def downweighted_outputs(self) -> int:
        """Number of outputs with less weight or none."""
        inflation = self.equations.inflation
        down = 0 if inflation is None else int(np.count_nonzero(inflation > 1))
        return down + 3 * len(self.rejected_moves)

    def shares(self) -> dict[ErrorSource, Share]:
        """Return the covariance of the parameters by source: of the outputs, and of the priors."""
        found = dict(self.by_source or shares(self.equations, self.state, self.gain))
        if self.between is not None:
            found[ErrorSource.TIME_CONSTANT] = Share.known(
                self.between[: self.equations.sensors, : self.equations.sensors]
            )
        return found


def shares(equations: Equations, state: Floats, gain: Floats) -> dict[ErrorSource, Share]:
    """Return the covariance of the parameters by source: of the outputs, and of the priors.

    `gain` (n, m + k) are derivatives of the state by outputs and priors in standard deviations.
    """
    n, m = equations.sensors, len(equations.outputs)
    factor = equations.factor(state)
    weights = unwhiten(factor, gain[:n, :m])
    found = equations.shares(state, weights)
    for source, which, freedom in equations.prior_sources:
        prior = gain[:n, m + np.array(which, dtype=int)]
        parts = [(prior @ prior.T, freedom)]
        # Some lever arms are in the state; the priors of the others are in the outputs' covariance.
        if source in found:
            parts.append((found[source].covariance, np.inf))
        found[source] = Share.from_parts(parts)
    return found


def estimate(
    evidence: Evidence,
    parameters: tuple[Parameter, ...] = PARAMETERS,
    changes: tuple[Change, ...] = (),
    considered: tuple[tuple[Parameter, float], ...] = (),
) -> Estimate:
    """Fit all of a session at once; `considered` as in `Equations`."""
    equations = Equations(evidence, parameters, considered=considered)
    check_observable(equations)
    equations, constant = with_changes(equations, changes)
    # Moves lead between attitudes of a known table; they hold less information on its azimuth.
    moving = motion_parameters(parameters)
    resting = replace(
        equations,
        parameters=tuple(p for p in parameters if p not in moving),
        evidence=replace(evidence, moves=()),
    )
    resting, state = with_shape(resting, start(resting))
    state = fit(resting, state)
    resting = headed(levelled(resting, state), state)
    state = start_from_moves(resting, fit(resting, state), evidence.moves)
    kept, astray = moves_that_fit(resting, state, evidence.moves)
    equations = replace(resting, evidence=kept)
    if moving:
        equations, state = with_parameters(equations, state, moving)
    observed = Information.from_jacobian(equations.whitened(state)[0]).observed
    if not (moving or np.delete(observed, np.r_[equations.arm_slice]).all()):
        # See `information.nominal_information`. Turns determine lever arms as far as the 24 need.
        equations = resting
    found = _without_outliers(equations, state, turns=True)
    if turns_disagree(evidence, found.outliers):
        equations, scatter = turns_downweighted(equations, state)
        found = _without_outliers(equations, state, turns=False)
        found = replace(found, turns_scatter=scatter)
    between = shape_covariance(found.equations, found.state)
    covariance = found.covariance if between is None else found.covariance + between
    return replace(
        found, covariance=covariance, rejected_moves=astray, constant=constant, between=between
    )


def _without_outliers(equations: Equations, state: Floats, *, turns: bool) -> Estimate:
    """Reduce the weight of outliers, one after the other; of turns too, if requested."""
    outliers: list[Outlier] = []
    plain = state = fit(equations, state)
    scatter = excess(equations, plain)
    weighted = with_scatter(equations, scatter)
    for _ in range(int(MOST_OUTLIERS * len(equations.evidence.segments)) + 1):
        state = fit(weighted, state)
        views = (equations, plain), (weighted, state)
        found = find_outlier(views, candidates(equations.evidence, turns=turns))
        if found is None:
            break
        outliers.append(found)
        equations = downweighted(equations, found.rows, 1 + found.chi_square)
        plain = fit(equations, state)
        scatter = excess(equations, plain)
        weighted = with_scatter(equations, scatter)
    if scatter.shown:
        scatter = excess(equations, plain, doubted=True)
        weighted = with_scatter(equations, scatter)
    state = fit(weighted, state)
    information = Information.from_jacobian(weighted.whitened(state)[0])
    return Estimate(
        weighted,
        state,
        information.covariance,
        information.condition,
        scatter,
        tuple(outliers),
        information.gain,
    )
