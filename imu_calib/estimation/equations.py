"""A session as equations: predicted outputs, their covariance, and priors.

Source: docs/mathematics.md, 'Joint estimate'.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, wraps
from typing import Any, cast

import numpy as np

from ..common.budget import ErrorSource, Share
from ..common.stream import Floats
from ..common.units import ARCMIN, DEG
from ..model.parameters import BIASES, Parameter, ParameterKind
from .components import Blocks, Component, Diagonal, Factor, add_all, shares, whiten
from .evidence import SMALLEST_VARIANCE, Evidence
from .modulation import stated_changes
from .positioning_errors import NO_POSITIONING_ERRORS, PositioningErrors
from .session_model import Nuisance, SessionModel, Value

ANY_AZIMUTH = 180 * DEG / np.sqrt(3)
"""Standard deviation of an unknown heading, rad: uniform over a whole turn (GUM 4.3.7)."""

_FEW = 32
"""Outputs of five dwells, which determine nothing: numpy solves so few in 0.1 ms, and loading scipy
takes longer than the rest of the work on such a session."""

_ROUNDING = 4 * float(np.finfo(float).eps)
"""Of a variance, for each output: loss by rounding in a root of the covariance (Higham 2002,
Accuracy and Stability of Numerical Algorithms, theorem 10.7)."""

GIVEN_AZIMUTH = 1 * ARCMIN
"""Standard deviation of a table's azimuth where its configuration states it, rad. A
judgement."""

LEAST_AZIMUTH = 0.05 * DEG
"""Least reported difference between north by the gyros and a table's stated azimuth, rad: rounding
to a tenth of a degree has this error."""


def cached_by_weights(method: Callable[[Any, Floats], Value]) -> Callable[[Any, Floats], Value]:
    """Cache results that depend on the weights alone, at the last states (n,).

    A fit ends where the next step begins, often with new equation objects.
    """

    @wraps(method)
    def remembered(self: Equations, state: Floats) -> Value:
        what = method.__name__, type(self), self.weights
        return self.remembered(what, state, method, self.inflation)

    return remembered


@dataclass(frozen=True, eq=False)
class Equations(SessionModel):
    """The equations of a session."""

    #: Standard deviation of the table's tilt about either axis, rad; None for that of the table's
    #: file.
    levelled: float | None = None
    #: Whether the azimuth is unknown, though the table's configuration states one.
    any_heading: bool = False
    #: Scatter of positioning errors beyond that of the table's file.
    positioning: PositioningErrors = NO_POSITIONING_ERRORS
    #: Further parts of the covariance of the outputs.
    extra: tuple[Component, ...] = field(default=(), repr=False)
    #: (m,) factors on the variance of each output's own noise, or None.
    inflation: Floats | None = field(default=None, repr=False)
    #: Consider parameters: not in the state, each with its standard deviation about zero.
    considered: tuple[tuple[Parameter, float], ...] = ()
    #: Kinds of parameters of motion that are exactly zero: for others that are not in the state the
    #: covariance allows.
    held: frozenset[ParameterKind] = frozenset()

    @property
    def north_known(self) -> bool:
        """Whether the attitudes are against north."""
        return self.evidence.azimuth is not None and not self.any_heading

    @cached_property
    def prior_deviations(self) -> Floats:
        """Prior standard deviations of the nuisances about zero, (k,)."""
        evidence = self.evidence
        azimuth = GIVEN_AZIMUTH if self.north_known else ANY_AZIMUTH
        clock_std = evidence.clock_rate()[1]
        # Whitening divides by each deviation: one of zero is replaced by 1e-15.
        level = evidence.levelling if self.levelled is None else self.levelled
        return np.array([azimuth, level, level, max(clock_std, 1e-15), *evidence.arms.deviations])

    def prior_rows(self, state: Floats) -> Floats:
        """Return the priors as equations: (k, n + 1), derivatives and residuals.

        An unknown azimuth has residual zero: its prior only bounds the standard deviations.
        """
        deviation = self.prior_deviations
        rows = np.zeros((self.nuisances, self.size + 1))
        rows[:, self.nuisance_slice] = np.diag(1 / deviation)
        rows[:, -1] = -state[self.nuisance_slice] / deviation
        if not self.north_known:
            rows[Nuisance.AZIMUTH, -1] = 0.0
        return rows

    @cached_property
    def own(self) -> tuple[Component, ...]:
        """The parts of the covariance that are independent for each output, at any state."""
        return own_parts(self.evidence, self.inflation)

    @cached_property
    def own_variances(self) -> Floats:
        """Variances of the outputs by walk, quantisation and encoders, (m,)."""
        diagonals = [c.part.variances for c in self.own if isinstance(c.part, Diagonal)]
        own = np.asarray(np.sum(diagonals, axis=0)).reshape(len(self.outputs))
        # The parts of the smallest variance may round above it, and zero noise is zero scatter.
        least = own < SMALLEST_VARIANCE * (1 + 1e-9)
        return np.asarray(np.where(least, SMALLEST_VARIANCE, own))

    def shared(self, state: Floats) -> tuple[Component, ...]:
        """Return the parts of the covariance that are common to several outputs.

        The outputs of one turn share the error of the encoder's rate, those of neighbours the
        positioning error of the table, and all of them the error of the latitude.
        """
        evidence, response = self.evidence, self.model(state).gyro.response
        turning, errors = evidence.turn_inputs[0], self.encoder_rate_effects(state)
        ups = np.vstack([evidence.dwell_attitudes[:, 2], turning])
        found = [
            *(
                Component(ErrorSource.ENCODER_RATE, Factor(error[:, None]), ENCODER_FREEDOM)
                for error in errors.T
            ),
            unknown_north(evidence, ups, response),
            level_gravity(evidence, turning, float(self.prior_deviations[Nuisance.TILT_X])),
            *self.extra,
            *self._positioning_error_parts(state),
        ]
        if self.considered:
            parameters, deviations = zip(*self.considered, strict=True)
            columns = self.parameter_derivatives(state, parameters) * np.array(deviations)
            found.append(Component(ErrorSource.TERMS, Factor(columns)))
        if self.layout.moves_with_accels:
            # The effect of lever arms and the accelerometers' delay on the velocities of moves.
            known = self.held | {p.kind for p in self.parameters}
            rate, model = self.surroundings(state).rate, self.model(state)
            by_moves = evidence.used_moves.shared_velocity_errors(model, rate, known)
            for source, in_moves in zip(
                (ErrorSource.ARM, ErrorSource.DELAY), by_moves, strict=True
            ):
                found.append(Component(source, Factor(self._at_move_outputs(in_moves))))
        if (by_table := self.table_error_effects(state)).shape[1]:
            found.append(Component(ErrorSource.TABLE, Factor(by_table)))
        if evidence.site.latitude_std:
            slope = self.latitude_derivatives(state) * evidence.site.latitude_std
            found.append(Component(ErrorSource.LATITUDE, Factor(slope[:, None])))
        if evidence.temperature is not None and evidence.thermal.any():
            # By the coefficients that the data sheet states.
            changes, sizes = stated_changes(self.parameters, evidence.thermal)
            warmth = self.columns(changes, self.jacobian(state)) * sizes
            found.append(Component(ErrorSource.TEMPERATURE, Factor(warmth)))
        return tuple(found)

    def _at_move_outputs(self, in_moves: Floats) -> Floats:
        """Return values (m, 6, ...) of moves in the order of the outputs, zero for all others."""
        at_rest, turned = (
            np.zeros((count, *in_moves.shape[1:]))
            for count in (self.layout.dwells, self.layout.turns)
        )
        return self.layout.joined(at_rest, turned, in_moves)

    @cached_by_weights
    def covariance(self, state: Floats) -> Floats:
        """Return the covariance of the outputs, (m,) square."""
        result = np.diag(self.own_variances)
        common = [part for part in self.own if not isinstance(part.part, Diagonal)]
        add_all((*common, *self.shared(state)), result)
        # Without noise, common errors leave only rounding of the outputs, and there is no root.
        result[np.diag_indices(len(result))] *= 1 + _ROUNDING * len(result)
        result.flags.writeable = False
        return result

    def shares(self, state: Floats, gain: Floats) -> dict[ErrorSource, Share]:
        """Return by source the covariance of parameters that are gain (p, m) times the outputs."""
        return shares((*self.own, *self.shared(state)), gain)

    @property
    def prior_sources(self) -> tuple[tuple[ErrorSource, list[int], float], ...]:
        """Sources of the priors in `prior_rows`, and degrees of freedom of their size."""
        return (
            (ErrorSource.AZIMUTH, [Nuisance.AZIMUTH], np.inf),
            (ErrorSource.TILT, [Nuisance.TILT_X, Nuisance.TILT_Y], np.inf),
            (ErrorSource.CLOCK, [Nuisance.CLOCK], self.evidence.clock_freedom),
            (ErrorSource.ARM, list(range(len(Nuisance), self.nuisances)), np.inf),
        )

    def _positioning_error_parts(self, state: Floats) -> list[Component]:
        """Return the parts of the covariance by positioning errors, stated and found."""
        found = self.positioning
        sizes = (
            (ErrorSource.POSITIONING_STATED, 0, self.evidence.positioning),
            (ErrorSource.POSITIONING_FOUND, 0, found.joints),
            (ErrorSource.STOPS, 1, found.stops),
        )
        parts = [
            Component(source, Factor(self.positioning_error_effects(state)[which] * size))
            for source, which, size in sizes
            if size
        ]
        if self.evidence.plan.by_hand and (square := found.joints**2 + found.stops**2):
            parts.append(
                Component(ErrorSource.STOPS, Factor(self._by_tilt_cosines(state) * square))
            )
        return parts

    def _by_tilt_cosines(self, state: Floats) -> Floats:
        """Return the changes of outputs by 1 - cos of tilts of holds, (m, 1 + s + t).

        For tilts of variance s^2 about two level axes 1 - cos has the mean s^2, common to all
        holds and turns, and the standard deviation s^2 about it, independent for each.
        """
        biases = self.parameter_derivatives(state, BIASES) @ self.model(state).values(BIASES)
        vertical = self.predict(state) - biases
        own = self.layout.segment[:, None] == np.arange(self.layout.dwells + self.layout.turns)
        return np.column_stack([vertical, vertical[:, None] * own])

    def whitened(self, state: Floats) -> tuple[Floats, Floats]:
        """Return derivatives (m + k, n) and residuals in deviations, the priors' rows last."""
        columns = self._factor_and_whitened(state)[1]
        return columns[:, :-1], columns[:, -1]

    def chi_square(self, state: Floats) -> float:
        """Return the sum of squares of `whitened` residuals."""
        residuals = self.whitened(state)[1]
        return float(residuals @ residuals)

    def factor(self, state: Floats) -> Floats:
        """Return the lower root of `covariance`, (m,) square, by which outputs are whitened."""
        return self._factor_and_whitened(state)[0]

    @cached_by_weights
    def _factor_and_whitened(self, state: Floats) -> tuple[Floats, Floats]:
        """Return `factor` and `whitened_by` it."""
        factor = np.asarray(np.linalg.cholesky(self.covariance(state)), dtype=float)
        return factor, self.whitened_by(factor, state)

    @property
    def weights(self) -> tuple[object, ...]:
        """All but session, state and `inflation` on which the equations depend."""
        return (
            self.parameters,
            self.changes,
            self.shape,
            self.levelled,
            self.any_heading,
            self.positioning,
            self.extra,
            self.considered,
            self.held,
        )

    def whitened_by(self, factor: Floats, state: Floats) -> Floats:
        """Return derivatives and residuals, (m + k, n + 1), by a root (m, m) of a covariance."""
        columns = np.column_stack([self.jacobian(state), self.outputs - self.predict(state)])
        if len(columns):
            few = len(factor) <= _FEW
            columns = np.asarray((np.linalg.solve if few else whiten)(factor, columns))
        columns = np.vstack([columns, self.prior_rows(state)])
        columns.flags.writeable = False
        return columns


# Parts of the covariance that do not depend on the prediction.

ENCODER_FREEDOM = 14.0
"""Least degrees of freedom of an encoder's rate: sixteen blocks less a line's two unknowns
(`segmentation.plateaus`)."""
UNREST_FREEDOM = 3.0
"""Least degrees of freedom of the noise of a single dwell: four blocks less their mean
(`segmentation.statistics`)."""
_ANGLES, _VELOCITIES = np.repeat(np.eye(2), 3, axis=1)
"""(6,) masks, one or zero, of the angles and of the velocities among the outputs of a move."""


def own_parts(evidence: Evidence, inflation: Floats | None) -> tuple[Component, ...]:
    """Return the independent errors of each output: noise, quantisation, the encoders' noise.

    `inflation` are factors (m,) on these variances, or None. The first six parts are the random
    walk of the channels.
    """
    # Most equations of a session differ only in the other parts.
    if 'own' not in evidence.cache:
        evidence.cache['own'] = _without_inflation(evidence)
    parts = cast(tuple[Component, ...], evidence.cache['own'])
    if inflation is None:
        return parts
    total = np.sum([c.part.variances for c in parts if isinstance(c.part, Diagonal)], axis=0)
    more = total * (inflation - 1)
    inflated = []
    for c in range(6):
        own = np.where(evidence.layout.channels == c, more, 0.0)
        # Degrees of freedom of the scatter: less the two unknowns of a line.
        freedom = max(1.0, np.count_nonzero(own) - 2.0)
        inflated.append(Component(ErrorSource.SCATTER, Diagonal(own), freedom))
    return (*parts, *inflated)


def _without_inflation(evidence: Evidence) -> tuple[Component, ...]:
    """Return `own_parts` without factors on the variances."""
    segments, turns, walk = evidence.segments, evidence.turns, evidence.walk
    used = evidence.used_moves
    statistics = [s.statistics for s in segments]
    turned = [t.statistics for t in turns]
    site = evidence.site

    def joined(at_rest: Sequence[Floats], turned: Sequence[Floats], moved: Floats) -> Floats:
        rest, turn = (np.array(part).reshape(-1, 6) for part in (at_rest, turned))
        return evidence.layout.joined(rest, turn, moved)

    by_gyros, by_accels = used.noise(evidence.walk_of_moves)
    noise = joined(
        [walk**2 * s.walk_gain for s in statistics],
        [walk**2 * s.walk_gain for s in turned],
        by_gyros * _ANGLES + by_accels,
    )
    # Effect of the gyros' noise on velocities.
    none = np.zeros(6)
    by_rotation = joined([none for _ in segments], [none for _ in turns], by_gyros * _VELOCITIES)
    quantisation = joined(
        [s.quantisation_variance for s in statistics],
        [s.quantisation_variance for s in turned],
        used.quantisation(),
    )
    encoder = joined(
        [s.encoder_variance(site.gravity) for s in segments],
        [np.append(t.encoder_variance(), t.lean_variance(site.gravity)) for t in turns],
        used.encoders(),
    )
    total = noise + by_rotation + quantisation + encoder
    quantisation = quantisation + np.maximum(SMALLEST_VARIANCE - total, 0.0)
    channel = evidence.layout.channels
    parts = [
        Component(ErrorSource.NOISE, Diagonal(np.where(channel == c, noise, 0.0)), freedom)
        for c, freedom in enumerate(evidence.walk_freedom.tolist())
    ]
    parts += [
        Component(ErrorSource.NOISE, Diagonal(by_rotation), float(evidence.walk_freedom[:3].sum())),
        Component(ErrorSource.QUANTISATION, Diagonal(quantisation)),
        Component(ErrorSource.ENCODER_NOISE, Diagonal(encoder)),
    ]
    if held := used.with_accels:
        # The remainder of a level channel is an error along both level axes.
        across = used.by_remainders[list(held)] * (1 - np.eye(3))
        rows = np.array(evidence.layout.velocity)
        parts.append(Component(ErrorSource.QUANTISATION, Blocks(rows, across)))
    for k, segment in enumerate(segments):
        if segment.excess_covariance is not None:
            rows = evidence.layout.dwell[k : k + 1, 3:]
            blocks = Blocks(rows, segment.excess_covariance[None])
            parts.append(Component(ErrorSource.NOISE, blocks, UNREST_FREEDOM))
        if segment.sliding:
            rows = evidence.layout.dwell[k : k + 1, :3]
            blocks = Blocks(rows, segment.sliding**2 * np.eye(3)[None])
            parts.append(Component(ErrorSource.NOISE, blocks, UNREST_FREEDOM))
    return tuple(parts)


def level_gravity(evidence: Evidence, ups: Floats, levelled: float) -> Component:
    """Return the error in turns by cuts within samples and level gravity on a tilted table.

    `levelled` is the standard deviation of the table's tilt about either axis, rad.
    """
    which, rows = evidence.arms.turns, evidence.layout.turn_accels
    level_gravities = [
        evidence.turns[k].level_share * levelled * evidence.site.gravity for k in which
    ]
    variances = np.zeros(len(evidence.layout))
    variances[rows] = np.square(level_gravities).reshape(-1, 1) * (1 - ups[which] ** 2)
    return Component(ErrorSource.NORTH, Diagonal(variances))


def unknown_north(evidence: Evidence, ups: Floats, response: Floats) -> Component:
    """Return the level Earth rate as noise of its size where its direction is unknown.

    By hand every static dwell has an independent heading, and a turn from rest to rest does not
    average all of it out. Where attitudes are estimated it is in the state.
    """
    segments, turns = evidence.segments, evidence.turns
    by_hand = 1.0 if evidence.plan.by_hand and not evidence.free else 0.0
    shares = np.array([*(by_hand for _ in segments), *(t.level_share for t in turns)])
    across = np.eye(3) - ups[:, :, None] * ups[:, None, :]
    square = (shares * evidence.site.north_rate)[:, None, None] ** 2 / 2
    rows = np.vstack([evidence.layout.dwell[:, :3], evidence.layout.turn])
    some = shares > 0
    blocks = Blocks(rows[some], (response @ across @ response.T * square)[some])
    return Component(ErrorSource.NORTH, blocks)
